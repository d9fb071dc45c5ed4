"""The standard streams of the command line, also if they are closed, full, or pipes without a reader.

A stream that is closed when the program starts is opened on the null device: otherwise the next file that is opened
gets its number, and what is printed goes into it.
"""

from __future__ import annotations

import io
import os
import sys
from typing import Any, Final

_NAMES: Final = ("stdin", "stdout", "stderr")
_STDOUT, _STDERR = 1, 2


class LostOutputError(Exception):
    """The output of a command can't be written to stdout."""


class _Output(io.FileIO):
    """Standard output or error. After a fault all that is written is dropped, also what buffers still hold."""

    is_broken = False

    def write(self, data: Any) -> int:
        """Write bytes. On stdout the first fault is raised: BrokenPipeError, or LostOutputError for all others."""
        if not self.is_broken:
            try:
                return super().write(data)
            except OSError as error:
                self.is_broken = True
                if self.fileno() == _STDOUT:
                    if isinstance(error, BrokenPipeError):
                        raise
                    raise LostOutputError(f"stdout can't be written: {error.strerror}") from None
        return memoryview(data).nbytes


def open_streams() -> None:
    """Open those of the three streams that are closed, and replace ``sys.stdout`` and ``sys.stderr``.

    Notes that can't be written to stderr are dropped. Characters that an encoding lacks become escapes.
    """
    for number in range(len(_NAMES)):
        try:
            os.fstat(number)
        except OSError:
            # Writing to stdout is to fail, as what is printed is lost.
            handle = os.open(os.devnull, os.O_WRONLY if number == _STDERR else os.O_RDONLY)
            os.dup2(handle, number)  # also lets child processes have it
            if handle != number:
                os.close(handle)
    for number in (_STDOUT, _STDERR):
        old: Any = getattr(sys, _NAMES[number])
        raw = _Output(number, "w", closefd=False)
        new = io.TextIOWrapper(
            io.BufferedWriter(raw),
            encoding=old.encoding if old else "utf-8",
            errors="backslashreplace",
            line_buffering=number == _STDERR or raw.isatty(),
            write_through=bool(old and old.write_through),
        )
        setattr(sys, _NAMES[number], new)
