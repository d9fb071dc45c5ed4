"""Keep the library's own messages about a failed request from standard error: the error is said in one line.

Where a store refuses to take a file, threads of the library panic, and Rust prints that to the file descriptor of
standard error, which Python code can't prevent otherwise than by reading what is written there.
"""

from __future__ import annotations

import os
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

_STDERR: Final = 2
#: The first line of a panic, and those that may follow after its message.
_PANIC: Final = re.compile(rb"thread '[^']*'.* panicked at ")
_TRACE: Final = re.compile(rb"stack backtrace:|note: |\s+\d+: |\s+at ")
#: The first bytes of a line that may become one of a panic.
_BEGINNING: Final = b"thread '"
#: Seconds in which other threads of the library may still panic after an error.
_LATE_S: Final = 0.1
_LOCK: Final = threading.Lock()
_OPEN: Final[list[_Filter]] = []


@contextmanager
def without_panics() -> Iterator[None]:
    """Leave out messages of panics from standard error, if the block fails; all else is passed on at once."""
    with _LOCK:
        if not _OPEN:
            with suppress(OSError):  # standard error is closed, or there are no more file descriptors
                _OPEN.append(_Filter())
        found = _OPEN[0] if _OPEN else None
        if found is not None:
            found.users += 1
    try:
        yield
    except BaseException:
        if found is not None:
            found.has_failed = True
            time.sleep(_LATE_S)
        raise
    finally:
        with _LOCK:
            if found is not None:
                found.users -= 1
                if not found.users:
                    _OPEN.clear()
                    found.close()


class _Filter:
    """A pipe in the place of standard error, and a thread that passes on what comes through it."""

    def __init__(self) -> None:
        self.users = 0
        self.has_failed = False
        self._kept = bytearray()  # messages of panics
        self._blank = bytearray()  # an empty line, which begins a panic if one follows
        self._is_message = self._is_trace = False
        self._end = b"\0" + os.urandom(16)
        self._before = os.dup(_STDERR)
        try:
            self._from, to = os.pipe()
        except OSError:
            os.close(self._before)
            raise
        os.dup2(to, _STDERR)
        os.close(to)
        self._thread = threading.Thread(target=self._pass_on, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Put standard error back. Panics that led to no error are printed."""
        os.write(_STDERR, self._end)
        self._thread.join()
        os.dup2(self._before, _STDERR, inheritable=True)
        os.close(self._from)
        if self._kept and not self.has_failed:
            self._say(bytes(self._kept))
        os.close(self._before)

    def _pass_on(self) -> None:
        waiting, is_last = b"", False
        while not is_last:
            waiting += os.read(self._from, 65536)
            before, mark, after = waiting.partition(self._end)
            is_last, waiting = bool(mark), before + after
            *lines, waiting = waiting.split(b"\n")
            for line in lines:
                self._take(line + b"\n")
            # A progress bar has no end of line. What may become a panic, or the end, is kept until it is known.
            is_open = (
                self._is_message
                or self._is_trace
                or b"\0" in waiting
                or _BEGINNING.startswith(waiting[: len(_BEGINNING)])
            )
            if waiting and (is_last or not is_open):
                self._take(waiting)
                waiting = b""
        self._say(bytes(self._blank))

    def _take(self, line: bytes) -> None:
        """Keep a line of a panic, with the empty line before it, and pass on all others."""
        if _PANIC.match(line):
            self._say(bytes(self._blank[:-1]))
            del self._blank[:-1]
            self._is_message, self._is_trace = True, False
        elif self._is_message:
            self._is_message, self._is_trace = False, True
        elif self._is_trace and not _TRACE.match(line):
            self._is_trace = False
        if self._is_message or self._is_trace:
            self._kept += self._blank + line
            self._blank.clear()
        elif line == b"\n":
            self._blank += line
        else:
            self._say(bytes(self._blank) + line)
            self._blank.clear()

    def _say(self, data: bytes) -> None:
        while data:
            data = data[os.write(self._before, data) :]
