"""Claims: small files that keep several fleets from working on the same log."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, time
from typing import Any, Final, NamedTuple

from mcaptrack.processes import host, is_running, started

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
            handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o644)
        except FileExistsError:
            return self._take_over(location, path, content)
        except OSError:  # a folder that can't be written: the command says so, if it matters
            return Taken(is_mine=True)
        try:
            is_written = _write(handle, content)
        finally:
            os.close(handle)
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
        return Taken(is_mine=True, note=_taken_over(location, owner))

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


def _taken_over(location: str, owner: Mapping[str, Any]) -> str:
    machine, pid = str(owner.get("host", "?")).partition("/")[0], owner.get("pid", "?")
    return f"{location}: taken over from process {pid} on {machine}, which has ended"


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
    handle = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield handle
    finally:
        os.close(handle)


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
