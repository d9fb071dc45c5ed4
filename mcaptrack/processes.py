"""Whether a process that left something behind has ended: on this machine, since its start, in this space of ids."""

from __future__ import annotations

import hashlib
import os
import platform
from contextlib import suppress
from functools import cache
from pathlib import Path

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
    except ProcessLookupError:
        return False
    except OSError:
        return True
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
