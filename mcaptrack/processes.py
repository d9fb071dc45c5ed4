"""Other processes: what they hold in memory, and that they end with the one that started them."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

_IS_LINUX: Final = sys.platform.startswith("linux")


def resident_bytes(pid: int) -> int:
    """Return the resident memory of a process; 0 if it has ended."""
    with suppress(OSError, ValueError, IndexError):
        if _IS_LINUX:
            return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        listed = subprocess.run(["/bin/ps", "o", "rss=", "p", str(pid)], capture_output=True, check=False)
        return int(listed.stdout) * 1024
    return 0


def resident_bytes_with_children(pid: int) -> int:
    """Return the resident memory of a process and of those that it started (on Linux; elsewhere of itself)."""
    pids, total = [pid], 0
    while pids:
        pid = pids.pop()
        total += resident_bytes(pid)
        with suppress(OSError, ValueError):
            for thread in Path(f"/proc/{pid}/task").iterdir():
                with suppress(OSError):
                    pids += map(int, (thread / "children").read_text().split())
    return total


def die_with(handle: int) -> None:
    """Let the system end this process as soon as the other end of a socket is closed, whatever this process does then.

    The socket is of no other use: a byte that arrives ends this process as well.
    """
    signal.signal(signal.SIGIO, signal.SIG_DFL)  # which ends the process
    fcntl.fcntl(handle, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(handle, fcntl.F_SETFL, fcntl.fcntl(handle, fcntl.F_GETFL) | os.O_ASYNC | os.O_NONBLOCK)
    with suppress(BlockingIOError):
        os.read(handle, 1)  # the end, which came before the line above
        os._exit(0)
