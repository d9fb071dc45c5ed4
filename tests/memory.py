"""Memory that Python code holds."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable


def held(work: Callable[[], object]) -> tuple[int, int]:
    """Bytes that are alive at the end of a piece of work, and the most while it lasted."""
    tracemalloc.start()
    try:
        kept = work()
        alive, most = tracemalloc.get_traced_memory()
        del kept
        return alive, most
    finally:
        tracemalloc.stop()
