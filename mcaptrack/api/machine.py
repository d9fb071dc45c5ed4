"""Limits of this process on its machine: memory and folders."""

from __future__ import annotations

import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

from mcaptrack import log
from mcaptrack.environment import CONTROL_GROUPS, control_groups
from mcaptrack.errors import McaptrackError

#: Version 1 of control groups states a number beyond all memory where there is no limit.
_NO_LIMIT: Final = 1 << 60


def memory_bytes() -> int | None:
    """Return how much memory this process may use: that of the machine, or the limit of its control group."""
    found = memory_limits()
    with suppress(ValueError, OSError, AttributeError):
        found.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    return min(found, default=None)


def memory_limits(root: Path = CONTROL_GROUPS, own: str | None = None) -> list[int]:
    """Return the limits of memory of this process's control group and those above it, in bytes."""
    found = []
    for folder in control_groups(root, own):
        with suppress(OSError, ValueError):
            found.append(int((folder / "memory.max").read_text()))  # "max" is no number
    with suppress(OSError, ValueError):
        found.append(int((root / "memory/memory.limit_in_bytes").read_text()))
    return [limit for limit in found if 0 < limit < _NO_LIMIT]


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
