"""Other processes: whether one has ended, what one holds in memory, and that one ends with the one that started it."""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import signal
import subprocess
import sys
from contextlib import suppress
from functools import cache
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


#: Hexadecimal digits of a mark.
MARK_DIGITS = 12


def host() -> str:
    """Return a name of this machine since its start, and of the space of process ids: containers have their own."""
    parts = [platform.node()]
    for file in ("/proc/sys/kernel/random/boot_id", "/proc/self/ns/pid"):
        with suppress(OSError):
            parts.append(os.readlink(file) if file.endswith("pid") else Path(file).read_text().strip())
    return "/".join(parts)


def started(pid: int) -> str | None:
    """Return when a process was started, in the system's own count; None where that is unknown or it has ended."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return None
    return None if text[0] in ("Z", "X") else text[19]


def is_running(pid: int) -> bool:
    """Return whether there is a process of this id, whoever owns it."""
    try:
        os.kill(pid, 0)
    except OSError as error:  # such as that it is of another user
        return not isinstance(error, ProcessLookupError)
    return True


def mark_of(pid: int) -> str:
    """Return a text that tells a process of this id from others that have had it: half of it is that of the host."""
    return _digest(_own_host()) + _digest(started(pid) or "")


def has_ended(pid: int, mark: str) -> bool | None:
    """Return whether the process with this id and ``mark_of`` it has ended; None if it was on another machine."""
    half = MARK_DIGITS // 2
    if mark[:half] != _digest(_own_host()):
        return None
    return not is_running(pid) or _digest(started(pid) or "") != mark[half:]


@cache
def _own_host() -> str:
    return host()


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[: MARK_DIGITS // 2]
