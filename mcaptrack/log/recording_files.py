"""Tell recordings of other formats than MCAP, which `mcaptrack ingest` converts, and the files that belong to a log."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcaptrack.errors import McaptrackError, call
from mcaptrack.files import refuse_special, visible
from mcaptrack.installed import missing_extension, missing_names
from mcaptrack.location import P, sibling
from mcaptrack.log.records import MAGIC
from mcaptrack.notices import warn
from mcaptrack.registry import Entry, blamed, find, others

_MATROSKA: Final = b"\x1a\x45\xdf\xa3"  # and WebM
#: The first bytes of what zstd has compressed.
ZSTD: Final = b"\x28\xb5\x2f\xfd"


class Answer(NamedTuple):
    """The answer of a recording format, as the registry found it, and its object."""

    entry: Entry
    form: Any
    answer: Any


def format_of(path: Path) -> Answer | None:
    """The recording format of a file or folder, and how it describes it; None for MCAP files and all else.

    Raises McaptrackError if several formats say so.
    """
    answers = [] if is_mcap(path) else [asked for asked in _asked("recognises", path) if asked.answer]
    if len(answers) > 1:
        raise McaptrackError(f"{path} is of the {' and '.join(str(asked.entry) for asked in answers)}")
    return answers[0] if answers else None


def listing_of(log: Path) -> Path | None:
    """The file beside a log that lists it as a part of a recording, such as the metadata.yaml of ROS 2, or None."""
    return next((Path(asked.answer) for asked in _asked("listing", log) if asked.answer), None)


def update_listing(log: Path) -> None:
    """Bring the file that lists a log up to date, after the log has changed."""
    for _ in _asked("update", log):
        pass


def _asked(method: str, path: Path) -> Iterator[Answer]:
    """Call a method of all recording formats that have it. One of a package that fails is named in a warning."""
    for name in others("recording"):
        entry = None
        try:
            entry = find("recording", name)
            form = entry.made("recognises", "open")
            with blamed(entry, f"failed to look at {path}"):
                answer = getattr(form, method, lambda _: None)(path)
        except McaptrackError as error:
            if entry and entry.is_built_in:
                raise
            warn(str(error), "other")
        else:
            yield Answer(entry, form, answer)


def is_mcap(path: Path) -> bool:
    """Whether a file begins with the magic bytes of MCAP; False if it can't be read."""
    refuse_special(path)
    try:
        with path.open("rb") as stream:
            return stream.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def is_video(path: Path) -> bool:
    """Whether a file begins as MP4, Matroska, WebM or AVI do, whatever its name."""
    with path.open("rb") as stream:
        head = stream.read(16)
    return head[4:8] == b"ftyp" or head.startswith(_MATROSKA) or (head[:4], head[8:12]) == (b"RIFF", b"AVI ")


def refuse_non_mcap(path: Path) -> None:
    """Raise McaptrackError for a recording in another format, with the command that converts it to a log.

    Other files pass: opening them reports what is wrong.
    """
    try:
        description = _description(path) if path.is_dir() or path.is_file() else ""
        if not description:
            refuse_missing(path)
    except OSError:
        return
    if description:
        raise McaptrackError(not_mcap(path, description))


def not_mcap(path: Path, description: str) -> str:
    """Say that a recording is in another format, with the command that converts it to a log."""
    other_name = {"output": "OTHER.mcap"} if path.suffix == ".mcap" else {}  # the default output has the same name
    return f"{path} is {description}, not an MCAP file; {call('ingest', path, **other_name)} makes a log of it"


def _description(path: Path) -> str:
    """The format of a recording or a video in words, "" for MCAP files, a folder with one of them, and all else."""
    if path.is_dir():
        logs = logs_in(path)
        if len(logs) == 1 and listing_of(logs[0]) is None:
            return ""  # it can be given itself
    elif is_mcap(path):
        return ""
    elif is_video(path):
        return "a video"
    recognised = format_of(path)
    return str(recognised.answer) if recognised else ""


def refuse_missing(path: Path) -> None:
    """Raise McaptrackError for a file or folder of a format of an extension that isn't installed, by its names."""
    endings = missing_names("ending")
    names = [path.name, *(entry.name for entry in path.iterdir())] if endings and path.is_dir() else [path.name]
    for ending in endings:
        if any(name.endswith(ending) for name in names):
            raise McaptrackError(f"{path} can't be read: {missing_extension(ending, 'ending', 'its format')}")


def logs_in(folder: Path) -> list[Path]:
    """The logs in a folder, by name, without their sidecars and hidden files."""
    files = sorted(visible(folder.iterdir()))
    return [path for path in files if path.suffix.lower() == ".mcap" and not path.name.endswith(RESULTS_SUFFIX)]


# Names of files that belong to a log.


#: Suffix of a sidecar: a log that holds the results of another.
RESULTS_SUFFIX: Final = ".results.mcap"


def results_path(path: P) -> P:
    """The location of the sidecar of a log, which holds its results if they are not in the log itself."""
    return sibling(path, RESULTS_SUFFIX, of=path.name.removesuffix(".mcap"))
