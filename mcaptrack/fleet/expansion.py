"""Find the logs that arguments name: files, folders, URLs, patterns, and a list on standard input."""

from __future__ import annotations

import glob
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from mcaptrack.api.common import as_location
from mcaptrack.api.declared import checked
from mcaptrack.errors import McaptrackError
from mcaptrack.files import place_of, refuse_special, refuse_url
from mcaptrack.location import Location, Url, sibling
from mcaptrack.log import results_path
from mcaptrack.log.recording_files import format_of, listing_of, logs_in, not_mcap, refuse_non_mcap
from mcaptrack.log.records import MAGIC
from mcaptrack.notices import collected, warn
from mcaptrack.objects import store_of

#: The argument that stands for a list of names on standard input.
LIST: Final = "-"


# Find the logs that the URL of a store names: an object, a prefix, or a pattern.


_SUFFIX: Final = ".mcap"


def logs_in_store(url: Url, leave_out: str) -> Iterator[tuple[Url, Path]]:
    """Yield the logs that a URL names, each with its name below the prefix or pattern.

    A prefix stands for all logs below it. A pattern is matched as for files: "*" within a part of the name, "**" over
    several. Raises McaptrackError if nothing fits, or if the store can't be read.
    """
    if glob.has_magic(url.key):
        members = [*_in_store_matching(url, leave_out)]
        if not members:
            raise McaptrackError(f"no object matches {url}")
        yield from members
        return
    is_log = url.suffix.lower() == _SUFFIX and not url.endswith("/")
    members = [] if is_log else [*_below(url, leave_out)]
    if not members and (url.endswith("/") or not url.key):
        raise McaptrackError(f"{url} has no log: no object below it ends with {_SUFFIX}")
    yield from members or [(url, Path(url.name))]


def _below(prefix: Url, leave_out: str) -> Iterator[tuple[Url, Path]]:
    """Yield all logs below a prefix, in order of their names."""
    for url, _ in sorted(store_of(prefix).list_objects(prefix)):
        name = url.key.removeprefix(prefix.key.rstrip("/")).lstrip("/")
        if _is_log(url, leave_out) and not any(part.startswith(".") for part in name.split("/")):
            yield url, Path(name)


def _in_store_matching(pattern: Url, leave_out: str) -> Iterator[tuple[Url, Path]]:
    """Yield the objects that a pattern matches, and the logs below prefixes that it matches."""
    parts = pattern.key.rstrip("/").split("/")
    fixed = next(number for number, part in enumerate(parts) if glob.has_magic(part))
    prefix = Url(f"{pattern.scheme}://{pattern.bucket}")
    for part in parts[:fixed]:
        prefix /= part
    for url, _ in sorted(store_of(prefix).list_objects(prefix)):
        names = url.key.split("/")
        is_below = _is_log(url, leave_out) and any(_fits(names[:end], parts) for end in range(1, len(names)))
        if is_below or _fits(names, parts):
            yield url, Path(*names[fixed:])


def _is_log(url: Url, leave_out: str) -> bool:
    return url.suffix.lower() == _SUFFIX and not (leave_out and url.endswith(leave_out))


def _fits(names: Sequence[str], parts: Sequence[str]) -> bool:
    """Whether the parts of a name fit those of a pattern."""
    if not parts:
        return not names
    if parts[0] == "**":
        return any(_fits(names[start:], parts[1:]) for start in range(len(names) + 1))
    return bool(names) and fnmatchcase(names[0], parts[0]) and _fits(names[1:], parts[1:])


@dataclass(frozen=True)
class NamedLog:
    """A log, and its name below the folder, pattern or list that named it, which is its name in an output folder."""

    path: Location
    below: Path


@checked
def find_logs(
    arguments: Iterable[str | os.PathLike[str]],
    *,
    each: bool = False,
    leave_out: str = "",
    read_list: Callable[[], bytes] | None = None,
) -> list[NamedLog]:
    """Return the logs that arguments name, each once, in order.

    A folder, or the prefix of objects in a store, stands for all logs in it and in the folders below; hidden ones are
    left out. LOG.results.mcap is left out if LOG is there, because it is a part of LOG; with ``each`` it is kept.

    Parameters
    ----------
    arguments : iterable of path
        Files, folders, URLs of objects in a store, patterns, or "-" for a list of them on standard input: one a line,
        or ended by a zero byte as by ``find -print0``.
    each : bool, default False
        Whether results beside a log are logs of their own.
    leave_out : str
        In folders, leave out files with this ending.
    read_list : callable, optional
        Returns the list instead of standard input.

    Raises
    ------
    McaptrackError
        If a folder has no log, if a pattern matches no file, or for another URL, a pipe or a device.

    """
    named_logs: list[NamedLog] = []
    for argument in arguments:
        named_logs += _logs_of(argument, leave_out, read_list or _standard_input)
    once: dict[object, NamedLog] = {}
    for log in named_logs if each else _without_results(named_logs):
        once.setdefault(_identity(log.path), log)
    return list(once.values())


def find_inputs(
    arguments: Iterable[str | os.PathLike[str]], *, each: bool = False, folders: bool = False
) -> list[NamedLog]:
    """Return the inputs that arguments name, as they are and in order: files, folders, URLs; patterns, "-" for a list.

    With ``folders``, a folder or prefix stands for the logs in it, if there are any. LOG.results.mcap is left out if
    LOG is there, because it is a part of LOG; with ``each`` it is kept. Raises McaptrackError as ``find_logs`` does.
    """
    inputs: list[NamedLog] = []
    for argument in arguments:
        if str(argument) == LIST:
            inputs += _listed(_standard_input(), has_folders=not folders)
            continue
        location = as_location(argument)
        if folders and (isinstance(location, Url) or (location.is_dir() and _has_logs(location))):
            inputs += _logs_of(argument, "", _standard_input)
        elif isinstance(location, Url) or _is_no_pattern(location):
            if isinstance(location, Path):
                refuse_url(location)
            inputs.append(NamedLog(location, Path(location.name)))
        else:
            refuse_url(location)
            inputs += _matching(location, None)
    return inputs if each else _without_results(inputs)


def _without_results(named_logs: Sequence[NamedLog]) -> list[NamedLog]:
    """Leave out LOG.results.mcap where LOG is there."""
    results = {results_path(place_of(log.path)) for log in named_logs}
    return [log for log in named_logs if place_of(log.path) not in results]


def _has_logs(folder: Path) -> bool:
    with collected():
        return next(_logs_in(folder, "", is_named=True), None) is not None


def _is_no_pattern(path: Path) -> bool:
    return path.exists() or path.is_symlink() or not glob.has_magic(str(path))


def outputs_in(folder: Path, logs: Sequence[NamedLog], suffix: str) -> list[Path]:
    """Return a name in a folder for the output of each log, which ends with ``suffix``.

    Raises McaptrackError if two logs have the same name.
    """
    names: dict[Path, Location] = {}
    for log in logs:
        stem = log.below.name.removesuffix(log.below.suffix) if log.below.suffix.lower() == _SUFFIX else log.below.name
        name = folder / sibling(log.below, suffix, of=stem)
        other = names.setdefault(name, log.path)
        if other != log.path:
            are_logs = log.path.suffix.lower() == other.suffix.lower() == _SUFFIX  # folders stand for logs only
            apart = ", or give the folder that holds both, which keeps those below it apart" if are_logs else ""
            raise McaptrackError(
                f"the results of {other} and {log.path} would both be {name}; process them one by one, each with "
                f"a name of its own (`output=`){apart}"
            )
    return list(names)


def _logs_of(named: str | os.PathLike[str], leave_out: str, read_list: Callable[[], bytes]) -> Iterator[NamedLog]:
    if str(named) == LIST:
        yield from _listed(read_list())
        return
    argument = as_location(named)
    if isinstance(argument, Url):
        yield from (NamedLog(url, below) for url, below in logs_in_store(argument, leave_out))
        return
    refuse_url(argument)
    refuse_special(argument)
    if argument.is_dir():
        members = list(_logs_in(argument, leave_out, is_named=True))
        if not members:
            refuse_non_mcap(argument)
            raise McaptrackError(
                f"the folder {argument} has no log, which is a file that ends with {_SUFFIX} and no part of a recording"
            )
        yield from members
    elif _is_no_pattern(argument):
        yield NamedLog(argument, Path(argument.name))
    else:
        yield from _matching(argument, leave_out)


def _logs_in(folder: Path, leave_out: str, *, is_named: bool) -> Iterator[NamedLog]:
    """Yield all logs in a folder and below it, in order of their names.

    A folder below it that is a recording of another format, or of which the files are listed as parts of one, is left
    out with a warning. One file that is a whole recording is a log. A folder of a recording that a user named is
    refused.
    """

    def unreadable(error: OSError) -> None:
        warn(f"{error.filename} can't be listed ({error.strerror}); logs in it are left out", "left-out")

    for place, folders, files in os.walk(folder, onerror=unreadable):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        names = [name for name in sorted(files) if name.lower().endswith(_SUFFIX) and not name.startswith(".")]
        is_top = is_named and Path(place) == folder
        is_listed = names and (is_top or len(logs_in(Path(place))) > 1) and listing_of(Path(place, names[0]))
        recognised = format_of(Path(place)) if is_listed or not (names or is_top) else None
        if is_listed or recognised:
            text = not_mcap(Path(place), str(recognised.answer) if recognised else "a recording")
            if is_top:
                raise McaptrackError(text)
            warn(f"{text}; its files are left out", "left-out")
            continue
        for name in names:
            if not (leave_out and name.endswith(leave_out)):
                path = Path(place, name)
                yield NamedLog(path, path.relative_to(folder))


def _matching(pattern: Path, leave_out: str | None) -> Iterator[NamedLog]:
    """Yield the files that a pattern matches, and the logs in folders (the folders if ``leave_out`` is None)."""
    names = sorted(glob.glob(str(pattern), recursive=True))
    if not names:
        raise McaptrackError(f"no file matches {pattern}")
    fixed = Path()
    for part in pattern.parts[:-1]:
        if glob.has_magic(part):
            break
        fixed /= part
    for name in names:
        path = Path(name)
        if leave_out is not None and path.is_dir():
            logs = _logs_in(path, leave_out, is_named=False)
            yield from (replace(log, below=path.relative_to(fixed) / log.below) for log in logs)
        else:
            yield NamedLog(path, path.relative_to(fixed))


def _standard_input() -> bytes:
    if sys.stdin is None or sys.stdin.closed:
        raise McaptrackError("- is a list of logs on standard input, which is closed")
    if sys.stdin.isatty():
        raise McaptrackError("- is a list of logs on standard input, which is a terminal; pipe names of logs into it")
    return sys.stdin.buffer.read()


def _listed(text: bytes, has_folders: bool = False) -> Iterator[NamedLog]:
    """Yield the logs of a list; their names are relative to the folder that all of them are in."""
    if text.startswith(MAGIC):
        raise McaptrackError("- is a list of logs on standard input, which holds a log itself; give its name")
    lines = text.split(b"\0") if b"\0" in text else text.splitlines()
    named = [as_location(os.fsdecode(line)) for line in lines if line.strip()]
    yield from (NamedLog(url, Path(url.bucket, url.key)) for url in named if isinstance(url, Url))
    paths = [path for path in named if isinstance(path, Path)]
    for path in paths:
        refuse_url(path)
        refuse_special(path)
        if path.is_dir() and not has_folders:
            raise McaptrackError(
                f"the list of logs names {path}, which is a folder; list files, or give the folder itself"
            )
    full = [Path(os.path.abspath(path)) for path in paths]
    common = os.path.commonpath([path.parent for path in full]) if full else ""
    for path, whole in zip(paths, full, strict=True):
        yield NamedLog(path, whole.relative_to(common))


def _identity(path: Location) -> object:
    """Return the same value for all names of one file."""
    if isinstance(path, Url):
        return str(path)
    try:
        about = path.stat()
    except OSError:
        return str(place_of(path))
    return about.st_dev, about.st_ino
