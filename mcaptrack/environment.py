"""The list of environment variables that are not options of a command (others are mistakes), and cores and threads."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Final

from mcaptrack.errors import McaptrackError

PREFIX: Final = "MCAPTRACK_"
CONTROL_GROUPS: Final = Path("/sys/fs/cgroup")
#: Variables that say how many threads a library uses: OpenMP (also Arrow and torch), OpenBLAS, MKL, Accelerate, OpenCV.
THREADS: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)
#: Names and descriptions.
VARIABLES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "MCAPTRACK_CONFIG": "the file of options",
        "MCAPTRACK_LOG_FORMAT": "`text` or `json`: the form of notes, progress and errors",
        "MCAPTRACK_MAX_CHUNK_MIB": "chunks of a log with a larger stated size are refused, in MiB",
        "MCAPTRACK_MAX_MEGAPIXELS": "pictures with a larger stated size are refused, in millions of pixels",
        "MCAPTRACK_MAX_NETWORK_MB": "a predictor in ONNX format that takes more memory is ended, in MB",
        "MCAPTRACK_MAX_NETWORK_S": "a network in ONNX format that takes longer for one call is ended, in seconds",
        "MCAPTRACK_MAX_UNPACKED_MIB": "compressed data that unpacks to more is refused, in MiB",
        "MCAPTRACK_MAX_WORKER_MB": "a worker for many logs that takes more resident memory is ended, in MB",
        "MCAPTRACK_MODELS": "the folder of fetched weights of detectors",
        "MCAPTRACK_SCHEDULER": "the address of the scheduler of a Dask cluster that is to process many logs",
        "MCAPTRACK_DATA": "a folder with reference recordings, for the tests",
    }
)


def variable(name: str) -> str:
    """The value of one of ``VARIABLES``; "" if it is not set. Raises KeyError for a name that isn't listed."""
    VARIABLES[name]
    return os.environ.get(name, "")


def whole_number(name: str, otherwise: int) -> int:
    """The value of one of ``VARIABLES`` as a whole number, at least 1; ``otherwise`` if it is not set.

    Raises McaptrackError if the value is not such a number.
    """
    text = variable(name)
    if not text:
        return otherwise
    if not (text.isascii() and text.isdecimal() and len(text) <= 9 and int(text) > 0):
        raise McaptrackError(f"{name} needs a whole number from 1 to 999999999, not {text[:20]!r}")
    return int(text)


def without(name: str) -> dict[str, str]:
    """The environment for another process, without one of its variables."""
    return {own: text for own, text in os.environ.items() if own != name}


def cache_folder() -> Path:
    """The user's folder for files that can be fetched again."""
    usual = Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")
    return Path(os.environ.get("XDG_CACHE_HOME") or usual) / "mcaptrack"


def release_memory() -> None:
    """Give memory that is free back to the system. Allocators keep what the largest piece of work so far took."""
    if sys.platform == "linux":
        import ctypes

        with suppress(OSError, AttributeError):  # another C library
            ctypes.CDLL(None).malloc_trim(0)


def cores() -> int:
    """The number of cores that this process may use; a part of one counts as one."""
    return math.ceil(share_of_cores())


def share_of_cores() -> float:
    """The number of cores that this process may use: those that it may run on, or the quota of its control group."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min([float(allowed), *cpu_quotas()])


def cpu_quotas(root: Path = CONTROL_GROUPS, own: str | None = None) -> list[float]:
    """The limits of processor time of this process's control group and those above it, in cores."""
    quotas = []
    for folder in control_groups(root, own):
        with suppress(OSError, ValueError):
            quota, period = (folder / "cpu.max").read_text().split()
            if quota != "max":
                quotas.append(int(quota) / int(period))
    with suppress(OSError, ValueError):
        old = int((root / "cpu/cpu.cfs_quota_us").read_text()), int((root / "cpu/cpu.cfs_period_us").read_text())
        if old[0] > 0:
            quotas.append(old[0] / old[1])
    return [quota for quota in quotas if quota > 0]


#: Version 1 of control groups states a number beyond all memory where there is no limit.
_NO_LIMIT: Final = 1 << 60


def memory_bytes() -> int | None:
    """The memory that this process may use: that of the machine, or the limit of its control group."""
    limits = memory_limits()
    with suppress(ValueError, OSError, AttributeError):
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    return min(limits, default=None)


def memory_limits(root: Path = CONTROL_GROUPS, own: str | None = None) -> list[int]:
    """The limits of memory of this process's control group and those above it, in bytes."""
    limits = []
    for folder in control_groups(root, own):
        with suppress(OSError, ValueError):
            limits.append(int((folder / "memory.max").read_text()))  # "max" is no number
    with suppress(OSError, ValueError):
        limits.append(int((root / "memory/memory.limit_in_bytes").read_text()))
    return [limit for limit in limits if 0 < limit < _NO_LIMIT]


def control_groups(root: Path = CONTROL_GROUPS, own: str | None = None) -> list[Path]:
    """The folders of this process's control group and those above it. ``own`` is /proc/self/cgroup."""
    text = own
    if text is None:
        text = ""
        with suppress(OSError):
            text = Path("/proc/self/cgroup").read_text()
    name = next((line.removeprefix("0::/") for line in text.splitlines() if line.startswith("0::/")), "")
    inside = root / name
    return [inside, *(folder for folder in inside.parents if folder.is_relative_to(root))]


def threads() -> int:
    """The number of threads for computing: as OMP_NUM_THREADS says, otherwise one for each core.

    Workers that share a machine get their share of the cores in this variable, which libraries read as well.
    """
    said = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    return int(said) if said.isascii() and said.isdecimal() and int(said) > 0 else cores()


def set_up_libraries() -> None:
    """Choose what libraries read from the environment as they are loaded, unless the user chose otherwise.

    Arrow takes memory from the allocator of all others: what it frees there can be used again, and be given back, where
    its own pool keeps tens of megabytes. OpenCV's messages about damaged pictures are left to the command, which says
    them in a line. NumPy computes with one thread: its matrices here are small, and threads would wait for each other.
    """
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
