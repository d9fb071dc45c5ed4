"""The ledger of a fleet: JSON lines, one for each log and try, which several fleets can append to."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special
from mcaptrack.notices import warn

#: Keys that every line has.
_KEYS: Final = ("location", "command", "settings", "state", "digest")


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
        try:
            with self._opened(os.O_RDWR | os.O_CREAT) as handle:
                start = os.pread(handle, 4096, 0).lstrip()
        except OSError as error:
            raise McaptrackError(f"the ledger {path} can't be written: {error.strerror or error}") from error
        if start and not start.startswith(b"{"):
            raise McaptrackError(f"{path} is not a ledger: it does not begin with a line of JSON; give another name")
        self.refresh()
        self._bad += path.stat().st_size > self._read  # a line without an end
        if self._bad:
            which = f"{self._bad} lines of the ledger {path}" if self._bad > 1 else f"a line of the ledger {path}"
            were = "were" if self._bad > 1 else "was"
            warn(
                f"{which} can't be read and {were} left out; these logs may be done again",
                "left-out",
            )

    @contextmanager
    def _opened(self, flags: int) -> Iterator[int]:
        handle = os.open(self._path, flags | os.O_CLOEXEC, 0o644)
        try:
            yield handle
        finally:
            os.close(handle)

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
            with self._opened(os.O_RDWR | os.O_APPEND | os.O_CREAT) as handle:
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
