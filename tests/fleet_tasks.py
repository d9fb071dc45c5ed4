"""Functions that workers of a fleet run on files in tests. The text of a file says what happens to its worker."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from mcaptrack.errors import McaptrackError
from mcaptrack.notices import warn

#: A block of memory that a worker fills, in bytes.
_BLOCK = 300_000_000


@dataclass(frozen=True)
class Seen:
    text: str
    process: int
    is_up_to_date: bool = False


def _never() -> None:
    while True:
        time.sleep(600)


def touch(log, *, output=None, add="", progress=None) -> Seen:
    """Do what the text of a file says, then append to it, or write to ``output``."""
    text = Path(log).read_text(encoding="utf-8", errors="replace")
    word, _, rest = text.partition(" ")
    if word == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if word == "orphan":
        os.kill(os.getppid(), signal.SIGKILL)
        _never()
    if word == "leave":
        os._exit(7)
    if word == "crash":
        print("last words", flush=True)
        os.abort()
    if word == "once" and not Path(rest).exists():
        Path(rest).write_text("it was here")
        os.kill(os.getpid(), signal.SIGKILL)
    if word == "hang":
        Path(log).with_suffix(".hangs").write_text(str(os.getpid()))
        _never()
    if word == "eat":
        kept = bytearray(_BLOCK)
        _never()
        del kept
    if word == "exit":
        sys.exit(3)
    if word == "refuse":
        raise McaptrackError(f"{log} is refused")
    if word == "break":
        raise ZeroDivisionError("nothing is divided")
    if word == "wait":
        while not Path(rest).exists():
            time.sleep(0.02)
    if word == "warn":
        warn("it looks odd", "clock")
        print("printed by a library")
    target = Path(output or log)
    if add and not text.endswith(add):
        target.write_text(text + add)
    return Seen(text, os.getpid(), bool(add) and text.endswith(add))


def parity(log, *, progress=None) -> str:
    return Path(log).name
