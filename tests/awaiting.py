"""Wait for a state, and never for a time: a busy machine may take ten times as long as a quiet one."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def until(ask: Callable[[], T], bound_s: float = 600.0) -> T:
    """Ask until the answer is true, and return it; a test that never gets there fails after a long time."""
    end = time.monotonic() + bound_s
    while not (answer := ask()):
        assert time.monotonic() < end, "it never comes to this"
        time.sleep(0.01)
    return answer
