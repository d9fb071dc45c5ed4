"""Limits of this process on its machine: memory and folders; and packages that lack something."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
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


def broken_packages() -> dict[str, str]:
    """Return what can't be done because files of an installed package are missing, and why, by package."""
    out = {}
    for name, (what, work) in _TRIED.items():
        try:
            work()
        except Exception as error:
            out[name] = f"{what} ({_first_line(error)})"
    return out


def _write_table() -> None:
    import pyarrow as pa
    import pyarrow.dataset  # queries and tables of many logs
    import pyarrow.parquet as pq

    stream = pa.BufferOutputStream()
    table = pa.table({"recording": ["doctor"], "t_ns": [1]})
    pq.write_table(table, stream, compression="zstd")
    if pq.read_table(pa.BufferReader(stream.getvalue())) != table:
        raise ValueError("it is read back as another one")


def _assign() -> None:
    from scipy.optimize import linear_sum_assignment

    linear_sum_assignment([[1.0, 0.0], [0.0, 1.0]])


def _resize() -> None:
    import cv2
    import numpy as np

    cv2.resize(np.zeros((4, 4), np.uint8), (2, 2))


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)


#: What is tried of packages of which parts are often left out or not found: their names, what else can't be done, how.
_TRIED: Final[Mapping[str, tuple[str, Callable[[], None]]]] = {
    "pyarrow": ("no table can be written as Parquet and read back", _write_table),
    "scipy": ("nothing can be assigned", _assign),
    "opencv-python-headless": ("no picture can be worked on", _resize),
}


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
