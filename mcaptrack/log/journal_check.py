"""Detect the journal that lies beside a log, and the messages about logs that changed or are damaged."""

from __future__ import annotations

from typing import NamedTuple

from mcaptrack.errors import McaptrackError, call
from mcaptrack.files import follow_links
from mcaptrack.location import Location, Url
from mcaptrack.log.byte_source import OpenFile, ReadFile
from mcaptrack.log.journal import Journal, UnusableJournal, find, journal_of, load_old_content, remove_hint


class JournalFinding(NamedTuple):
    """A file at LOG.journal: a message about it, and ``journal`` if the log must be read through it."""

    message: str
    journal: Journal | None = None
    is_busy: bool = False


def find_journal(path: Location, file: ReadFile) -> JournalFinding | None:
    """The state of the journal beside a log that is opened for reading; None if there is no journal."""
    if isinstance(path, Url) or not isinstance(file, OpenFile):
        return None  # objects are replaced as a whole
    real_path = follow_links(path)
    try:
        journal = find(real_path, file)
        state = journal.state() if journal else None
    except UnusableJournal as why:
        message = f"{journal_of(real_path)} {why}; it is ignored, and {path} is read as it is. "
        if load_old_content(real_path, file):
            message += (
                f"If it was left half written, {recover_command(path)} restores its state before the change. Then"
            )
        else:
            message += "If no other program needs it,"
        return JournalFinding(f"{message} remove it with {remove_hint(real_path)}")
    if state == "busy":
        return JournalFinding(
            f"{path} is being written to by another process; its state before that is read", journal, True
        )
    if state == "between":
        half = f"{path} was left half written by an interrupted change; its state before that change is read"
        return JournalFinding(f"{half}. The next command that writes to it restores that state on the disk", journal)
    left = f"{journal_of(real_path)} was left behind by an interrupted change of {path}; the log is complete"
    return JournalFinding(f"{left}. The next command that writes to it removes the journal") if state else None


def changed(path: Location) -> McaptrackError:
    """The error for a file that another process changed while it was read."""
    return McaptrackError(f"{path} was changed by another process while it was being read; try again")


def recover_hint(path: Location) -> str:
    """The hint for a damaged log: the command that recovers what is intact."""
    return f"{recover_command(path)} saves what is intact"


def recover_command(path: Location) -> str:
    """The command that recovers a damaged log."""
    return call("recover", path)
