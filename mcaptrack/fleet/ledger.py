"""The ledger of a fleet, JSON lines for each log and try; and claims, which keep other fleets away from a log."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import pickle
from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from time import monotonic, time
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special, writing
from mcaptrack.location import Location, Url
from mcaptrack.log import results_path
from mcaptrack.notices import warn
from mcaptrack.objects import store_of
from mcaptrack.processes import host, is_running, started

#: Keys that every line has.
_KEYS: Final = ("location", "command", "settings", "state", "digest")


@contextmanager
def _opened(path: Path, flags: int) -> Iterator[int]:
    handle = os.open(path, flags | os.O_CLOEXEC, 0o644)
    try:
        yield handle
    finally:
        os.close(handle)


class Ledger:
    """The lines of one command in a ledger: those that stand, those that other fleets add, and own ones.

    A line that isn't complete (its writer was killed, or the file was cut) is left out, with a warning.
    """

    def __init__(self, path: Path, command: str, settings: str) -> None:
        refuse_special(path)
        self._path, self._command, self._settings = path, command, settings
        self._read = 0
        self._last: dict[str, Mapping[str, Any]] = {}
        self._bad = 0
        self._can_append = True
        with writing(f"the ledger {path}"), _opened(path, os.O_RDWR | os.O_CREAT) as handle:
            start = os.pread(handle, 4096, 0).lstrip()
        if start and not start.startswith(b"{"):
            raise McaptrackError(f"{path} is not a ledger: it does not begin with a line of JSON; give another name")
        self.refresh()
        self._bad += path.stat().st_size > self._read  # a line without an end
        if self._bad:
            which = f"{self._bad} lines of the ledger {path}" if self._bad > 1 else f"a line of the ledger {path}"
            were = "were" if self._bad > 1 else "was"
            warn(f"{which} can't be read and {were} left out; these logs may be done again", "left-out")

    def refresh(self) -> None:
        """Read the lines that were added since the last time."""
        try:
            with self._path.open("rb") as stream:
                if os.fstat(stream.fileno()).st_size < self._read:
                    self._read, self._last = 0, {}
                stream.seek(self._read)
                for line in stream:
                    if not line.endswith(b"\n"):
                        break
                    self._read += len(line)
                    self._take(line)
        except OSError as error:
            raise McaptrackError(f"the ledger {self._path} can't be read: {error.strerror or error}") from error

    def _take(self, line: bytes) -> None:
        if not line.strip():
            return
        try:
            values = json.loads(line)
        except ValueError:
            self._bad += 1
            return
        if not isinstance(values, dict) or any(not isinstance(values.get(key), str) for key in _KEYS):
            self._bad += 1
        elif values["command"] == self._command:
            self._last[values["location"]] = {key: values.get(key) for key in (*_KEYS, "outputs")}

    def is_done(self, location: str, digest: str) -> bool:
        """Whether the log is done with these settings, and neither it nor what was written has changed since."""
        line = self._last.get(location)
        if line is None or line["state"] not in ("done", "up-to-date") or line["settings"] != self._settings:
            return False
        has_outputs = all(os.path.exists(output) for output in line["outputs"] or ())
        return has_outputs and bool(digest) and line["digest"] == digest

    def append(self, **values: Any) -> None:
        """Add a line, in one write. Warns once if it can't be written."""
        whole = {"location": values.pop("location"), "command": self._command, "settings": self._settings, **values}
        line = json.dumps(whole, allow_nan=False).encode("ascii") + b"\n"
        try:
            with _opened(self._path, os.O_RDWR | os.O_APPEND | os.O_CREAT) as handle:
                with suppress(OSError):  # a file system without locks
                    fcntl.flock(handle, fcntl.LOCK_EX)
                size = os.fstat(handle).st_size
                if size and os.pread(handle, 1, size - 1) != b"\n":
                    line = b"\n" + line  # after a line that was cut
                if os.write(handle, line) != len(line):
                    raise OSError(None, "no space left on the device")
        except OSError as error:
            if self._can_append:
                warn(
                    f"the ledger {self._path} can't be written ({error.strerror}); these logs may be done again", "lost"
                )
            self._can_append = False


# Claims: small files that keep several fleets from working on the same log.


#: Seconds between signs of life of a fleet, and without one after which its claims count as left behind.
BEAT_S: Final = 10.0
STALE_S: Final = 120.0
#: Seconds after which a claim without content counts as left behind: its writer was killed between two instructions.
_EMPTY_S: Final = 5.0


class Taken(NamedTuple):
    """Whether a claim was taken, and a note if it was taken over from a fleet that ended."""

    is_mine: bool
    note: str = ""


class Claims:
    """The claims of this process. Claims of fleets that ended are taken over."""

    def __init__(self) -> None:
        self._mine: dict[str, Path] = {}
        self._beaten = monotonic()
        self._me = {"host": host(), "pid": os.getpid(), "started": started(os.getpid())}

    def take(self, location: str, folder: Path | None) -> Taken:
        """Claim a log by a file in ``folder``; without one, or where nothing can be written, there is no claim."""
        if folder is None:
            return Taken(is_mine=True)
        path = folder / claim_name(location)
        content = json.dumps({"location": location, **self._me, "since": round(time(), 3)}).encode()
        try:
            with _opened(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY) as handle:
                is_written = _write(handle, content)
        except FileExistsError:
            return self._take_over(location, path, content)
        except OSError:  # a folder that can't be written: the command says so, if it matters
            return Taken(is_mine=True)
        if is_written:
            self._mine[location] = path
        else:
            path.unlink(missing_ok=True)
        return Taken(is_mine=True)

    def _take_over(self, location: str, path: Path, content: bytes) -> Taken:
        """Take a claim over if its fleet has ended; a lock keeps two fleets from doing so at the same time."""
        try:
            with _locked(path) as handle:
                owner, is_stale = _owner(handle)
                if not is_stale or os.fstat(handle).st_ino != path.stat().st_ino:
                    return Taken(is_mine=False)
                os.ftruncate(handle, 0)
                if not _write(handle, content):
                    path.unlink()
                    return Taken(is_mine=True)
        except OSError:  # it was given up at this moment, or is taken over by another fleet
            return Taken(is_mine=False)
        self._mine[location] = path
        machine, pid = str(owner.get("host", "?")).partition("/")[0], owner.get("pid", "?")
        return Taken(is_mine=True, note=f"{location}: taken over from process {pid} on {machine}, which has ended")

    def beat(self) -> None:
        """Give a sign of life, if it is time."""
        if monotonic() - self._beaten >= BEAT_S:
            self._beaten = monotonic()
            for path in self._mine.values():
                with suppress(OSError):
                    os.utime(path)

    def release(self, location: str) -> None:
        """Give a claim up."""
        path = self._mine.pop(location, None)
        if path is None:
            return
        with suppress(OSError), _locked(path, wait=True) as handle:
            owner, _ = _owner(handle)
            if all(owner.get(key) == value for key, value in self._me.items()):
                path.unlink()

    def release_all(self) -> None:
        """Give all claims up."""
        for location in list(self._mine):
            self.release(location)


def claim_name(location: str) -> str:
    """Return the name of the file that claims a log."""
    return f".mcaptrack-{hashlib.sha256(os.fsencode(location)).hexdigest()[:24]}.claim"


def _write(handle: int, content: bytes) -> bool:
    """Write a claim. Returns False if the disk is full: the command says so where it matters."""
    try:
        return os.write(handle, content) == len(content)
    except OSError:
        return False


def sweep(folder: Path, locations: set[str]) -> None:
    """Remove claims on these logs that fleets which ended have left."""
    wanted = {claim_name(location) for location in locations}
    try:
        left = [entry.name for entry in os.scandir(folder) if entry.name in wanted]
    except OSError:
        return
    for name in left:
        with suppress(OSError), _locked(folder / name) as handle:
            if _owner(handle)[1]:
                (folder / name).unlink()


@contextmanager
def _locked(path: Path, wait: bool = False) -> Iterator[int]:
    """Open a claim with a lock. Raises OSError if another fleet has the lock."""
    with _opened(path, os.O_RDWR) as handle:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield handle


def _owner(handle: int) -> tuple[dict[str, Any], bool]:
    """Return who claims a log, and whether that fleet has ended."""
    age = time() - os.fstat(handle).st_mtime
    try:
        owner = json.loads(os.pread(handle, 65536, 0))
        whole = {key: owner[key] for key in ("host", "pid", "started")}
    except (ValueError, TypeError, KeyError):
        return {}, age > _EMPTY_S
    ended = _has_ended(whole)
    return owner, age > STALE_S if ended is None else ended


def _has_ended(owner: Mapping[str, Any]) -> bool | None:
    """Whether the process of a claim has ended; None if it is on another machine, or unknown."""
    pid, since = owner.get("pid"), owner.get("started")
    if owner.get("host") != host() or not isinstance(pid, int):
        return None
    return started(pid) != since if since is not None else not is_running(pid)


# Digests that tell whether a log is still as a ledger says, and whether it was done with the same settings.


#: Bytes at the end of a file that count: in MCAP they hold the summary, with the number and the sizes of all chunks.
_TAIL: Final = 65536


def digest_of_log(path: Location) -> str:
    """Return a digest of a log and of the results beside it; "" if it can't be read.

    It is made of sizes, times of modification and the ends of the files: reading all of a night's recordings to learn
    that nothing has changed would take longer than many commands.
    """
    if isinstance(path, Url):
        return _digest_in_store(path)
    total = hashlib.sha256()
    try:
        results = results_path(path)
        for part in dict.fromkeys((path, results)):
            if part is results and part != path and not part.exists():
                continue
            if part.is_dir():
                total.update(_about_folder(part))
                continue
            with part.open("rb") as stream:
                about = os.fstat(stream.fileno())
                stream.seek(max(0, about.st_size - _TAIL))
                total.update(f"{about.st_size} {about.st_mtime_ns} ".encode())
                total.update(stream.read(_TAIL))
    except OSError:
        return ""
    return total.hexdigest()[:32]


def _about_folder(folder: Path) -> bytes:
    """Return the names, sizes and times of the files in a folder: of pictures, or of a bag."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    stats = [(path, path.stat()) for path in files]
    lines = [f"{path.relative_to(folder)} {about.st_size} {about.st_mtime_ns}\n" for path, about in stats]
    return "".join(lines).encode("utf-8", "surrogateescape")


def _digest_in_store(url: Url) -> str:
    try:
        parts = [store_of(part).find(part) for part in dict.fromkeys((url, results_path(url)))]
    except McaptrackError:
        return ""
    return hashlib.sha256(repr([part and tuple(part) for part in parts]).encode()).hexdigest()[:32] if parts[0] else ""


def digest_of_settings(*settings: object) -> str:
    """Return a digest of a function and its options; it is the same in every process."""
    text = json.dumps([_plain(setting) for setting in settings], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _plain(value: Any) -> Any:
    """Return a value as values of JSON, such that equal settings are equal."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, os.PathLike):
        return [os.path.abspath(value), _content(Path(value))]
    if isinstance(value, partial):
        return [_plain(value.func), _plain(value.args), _plain(value.keywords)]
    if is_dataclass(value) and not isinstance(value, type):
        return [_name(type(value)), {field.name: _plain(getattr(value, field.name)) for field in fields(value)}]
    if isinstance(value, Mapping):
        return {str(key): _plain(member) for key, member in value.items()}
    if isinstance(value, AbstractSet):
        return sorted((_plain(member) for member in value), key=repr)
    if isinstance(value, Sequence) and not isinstance(value, bytes):
        return [_plain(member) for member in value]
    if callable(value) and hasattr(value, "__qualname__"):
        return _name(value)
    return [_name(type(value)), hashlib.sha256(pickle.dumps(value, protocol=5)).hexdigest()]


def _name(value: Any) -> str:
    return f"{value.__module__}:{value.__qualname__}"


def _content(path: Path) -> str:
    """Return a digest of a file that an option names; "" for one that isn't there, and for a folder."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError:
        return ""
