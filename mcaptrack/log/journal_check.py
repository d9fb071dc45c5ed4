"""What is found beside a log, and what is said of a log that another process changes."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from mcaptrack.errors import McaptrackError, command
from mcaptrack.files import follow_links
from mcaptrack.log.byte_source import OpenFile
from mcaptrack.log.journal import Journal, Unfit, find, find_content, journal_of, remove_words


class Found(NamedTuple):
    """What lies at LOG.journal: ``journal`` if the log is to be seen through it, and words for people."""

    words: str
    journal: Journal | None = None
    is_busy: bool = False


def find_journal(path: Path, file: OpenFile) -> Found | None:
    """What lies beside an open log, for whoever only reads; None if nothing does."""
    real_path = follow_links(path)
    try:
        journal = find(real_path, file)
        state = journal.state() if journal else None
    except Unfit as why:
        words = f"{journal_of(real_path)} {why}; it is not used, and {path} is taken as it is. "
        if find_content(real_path, file):
            words += f"If it was left half written, {recover_command(path)} saves it as it was before. Then"
        else:
            words += "If nothing else needs it,"
        return Found(f"{words} remove it with {remove_words(real_path)}")
    if state == "busy":
        return Found(f"{path} is being written to by another process; it is seen as it was before", journal, True)
    if state == "between":
        half = f"{path} was left half written by a change that was interrupted; it is seen as it was before"
        return Found(f"{half}. The next command that writes to it puts that back on the disk", journal)
    left = f"{journal_of(real_path)} was left behind by a change of {path} that was interrupted; the log is whole"
    return Found(f"{left}. The next command that writes to it removes the journal") if state else None


def changed(path: Path) -> McaptrackError:
    """What is said of a file that turned out to be another one while it was read."""
    return McaptrackError(f"{path} was changed by another process while it was being read; try again")


def recover_words(path: Path) -> str:
    """What to do about a damaged log."""
    return f"{recover_command(path)} saves what is whole"


def recover_command(path: Path) -> str:
    """The command that saves a damaged log."""
    return command("recover", path)
