"""Limits of workers: their threads, their memory, and their life, which ends with that of their parent."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from mcaptrack.environment import THREADS, cores
from mcaptrack.errors import McaptrackError

_SIZE: Final = re.compile(r"([0-9]+(?:\.[0-9]+)?)\s*([kmgt]?)(i?)b?", re.IGNORECASE)
_IS_LINUX: Final = sys.platform.startswith("linux")
_PARENT_DIES: Final = 1  # PR_SET_PDEATHSIG of <sys/prctl.h>


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


def resident_bytes(pid: int) -> int:
    """Return the resident memory of a process; 0 if it has ended."""
    with suppress(OSError, ValueError, IndexError):
        if _IS_LINUX:
            return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        listed = subprocess.run(["/bin/ps", "o", "rss=", "p", str(pid)], capture_output=True, check=False)
        return int(listed.stdout) * 1024
    return 0


def killed_with_parent() -> bool:
    """Let the system kill this process when the one that started it ends. Returns whether it can."""
    if not _IS_LINUX:
        return False
    import ctypes

    try:
        return bool(ctypes.CDLL(None).prctl(_PARENT_DIES, signal.SIGKILL, 0, 0, 0) == 0)
    except (OSError, AttributeError):
        return False
