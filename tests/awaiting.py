"""Wait for a state, and never for a time: a busy machine may take ten times as long as a quiet one."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


def until(ask: Callable[[], T], bound_s: float = 600.0) -> T:
    """Ask until the answer is true, and return it; a test that never gets there fails after a long time."""
    end = time.monotonic() + bound_s
    while not (answer := ask()):
        assert time.monotonic() < end, "it never comes to this"
        time.sleep(0.01)
    return answer


def is_running(process: int) -> bool:
    """Whether a process runs; one that has ended may wait for long to be noticed by the process that adopted it."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
