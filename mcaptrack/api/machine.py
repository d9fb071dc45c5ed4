"""Limits of this process on its machine: cores, memory, folders."""

from __future__ import annotations

import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

from mcaptrack import environment, log
from mcaptrack.errors import McaptrackError

_CONTROL_GROUPS: Final = Path("/sys/fs/cgroup")
#: Version 1 of control groups states a number beyond all memory where there is no limit.
_NO_LIMIT: Final = 1 << 60


def cores() -> float:
    """Return how many cores this process may use: those that it may run on, or the quota of its control group."""
    return min([float(environment.cores()), *cpu_quotas()])


def cpu_quotas(root: Path = _CONTROL_GROUPS, own: str | None = None) -> list[float]:
    """Return the limits of processor time of this process's control group and those above it, in cores."""
    found = []
    for folder in _groups(root, own):
        with suppress(OSError, ValueError):
            quota, period = (folder / "cpu.max").read_text().split()
            if quota != "max":
                found.append(int(quota) / int(period))
    with suppress(OSError, ValueError):
        old = int((root / "cpu/cpu.cfs_quota_us").read_text()), int((root / "cpu/cpu.cfs_period_us").read_text())
        if old[0] > 0:
            found.append(old[0] / old[1])
    return [quota for quota in found if quota > 0]


def memory_bytes() -> int | None:
    """Return how much memory this process may use: that of the machine, or the limit of its control group."""
    found = memory_limits()
    with suppress(ValueError, OSError, AttributeError):
        found.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    return min(found, default=None)


def memory_limits(root: Path = _CONTROL_GROUPS, own: str | None = None) -> list[int]:
    """Return the limits of memory of this process's control group and those above it, in bytes."""
    found = []
    for folder in _groups(root, own):
        with suppress(OSError, ValueError):
            found.append(int((folder / "memory.max").read_text()))  # "max" is no number
    with suppress(OSError, ValueError):
        found.append(int((root / "memory/memory.limit_in_bytes").read_text()))
    return [limit for limit in found if 0 < limit < _NO_LIMIT]


def _groups(root: Path, own: str | None) -> list[Path]:
    """Return the folders of this process's control group and those above it. ``own`` is /proc/self/cgroup."""
    text = own
    if text is None:
        text = ""
        with suppress(OSError):
            text = Path("/proc/self/cgroup").read_text()
    name = next((line.removeprefix("0::/") for line in text.splitlines() if line.startswith("0::/")), "")
    inside = root / name
    return [inside, *(folder for folder in inside.parents if folder.is_relative_to(root))]


def temporary_folder() -> tuple[Path | None, str]:
    """Return the folder for temporary files, and why a log can't be written to it and read back ("" if it can)."""
    folder = None
    try:
        folder = Path(tempfile.gettempdir())
        with tempfile.TemporaryDirectory(prefix="mcaptrack-") as place:
            path = Path(place) / "doctor.mcap"
            with log.create(path) as writer:
                channel = writer.add_channel("/doctor", ("", "", b""), "", {})
                for number in range(3):
                    writer.add_message(channel, number, number, bytes([number]))
            wrong = log.check(path).findings
            return folder, wrong[0].words if wrong else ""
    except McaptrackError as error:
        return folder, str(error)
    except OSError as error:
        return folder, error.strerror or str(error)


def free_bytes(folder: Path) -> int | None:
    """Return the free space of the disk of a folder, which need not exist yet."""
    for place in (folder, *folder.parents):
        with suppress(OSError):
            return shutil.disk_usage(place).free
    return None


def can_be_written(folder: Path) -> bool:
    """Whether files can be made in a folder, or the folder itself."""
    there = next(place for place in (folder, *folder.parents) if place.exists())
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)
