"""Limits of workers: their threads and their memory."""

from __future__ import annotations

import os
import re
from typing import Final

from mcaptrack.environment import THREADS, cores
from mcaptrack.errors import McaptrackError

_SIZE: Final = re.compile(r"([0-9]+(?:\.[0-9]+)?)\s*([kmgt]?)(i?)b?", re.IGNORECASE)


def environment_of_worker(workers: int) -> dict[str, str]:
    """Return the environment of a worker: each of them gets its share of the cores, unless the user said otherwise."""
    share = str(max(1, cores() // workers))
    return dict.fromkeys(THREADS, share) | dict(os.environ)


def size_in_bytes(size: str | float | None, name: str) -> int | None:
    """Return a size such as "2GB", "1.5 GiB" or a number of bytes; None for None.

    Raises McaptrackError for text that is no size, and for less than a megabyte.
    """
    if size is None:
        return None
    found = _SIZE.fullmatch(str(size).strip())
    if found is None:
        raise McaptrackError(f"`{name}=` needs a size such as 2GB or 500MB, not {str(size)!r:.40}")
    number, unit, binary = found.groups()
    amount = int(float(number) * (1024 if binary else 1000) ** (" kmgt".index(unit.lower() or " ")))
    if amount < 1_000_000:
        raise McaptrackError(f"`{name}=` needs a size such as 2GB or 500MB, not {str(size)!r:.40}: that is too little")
    return amount
