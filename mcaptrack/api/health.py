"""Versions, codecs, memory, folders and plug-ins of an installation, and what it lacks."""

from __future__ import annotations

import os
import platform
import re
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib import metadata
from itertools import islice
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

from mcaptrack import __version__, log, objects
from mcaptrack.environment import CONTROL_GROUPS, THREADS, cache_folder, control_groups, share_of_cores
from mcaptrack.errors import McaptrackError
from mcaptrack.location import SCHEMES, Url, hide_secrets, parse
from mcaptrack.notices import Notice, collected, warn
from mcaptrack.objects import Version, described

#: Extras for people who work on mcaptrack itself, or read its examples.
_NOT_SHOWN: Final = ("docs", "examples", "test")
_LITTLE_BYTES: Final = 1_000_000_000
_REQUIREMENT: Final = re.compile(r"([\w.-]+)\s*(?:\[[^]]*\])?\s*(?:[^;]*?>=\s*([\d.]+))?[^;]*(?:;(.*))?")


# Limits of this process on its machine: memory and folders; and packages that lack something.


#: Version 1 of control groups states a number beyond all memory where there is no limit.
_NO_LIMIT: Final = 1 << 60


def memory_bytes() -> int | None:
    """Return how much memory this process may use: that of the machine, or the limit of its control group."""
    limits = memory_limits()
    with suppress(ValueError, OSError, AttributeError):
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    return min(limits, default=None)


def memory_limits(root: Path = CONTROL_GROUPS, own: str | None = None) -> list[int]:
    """Return the limits of memory of this process's control group and those above it, in bytes."""
    limits = []
    for folder in control_groups(root, own):
        with suppress(OSError, ValueError):
            limits.append(int((folder / "memory.max").read_text()))  # "max" is no number
    with suppress(OSError, ValueError):
        limits.append(int((root / "memory/memory.limit_in_bytes").read_text()))
    return [limit for limit in limits if 0 < limit < _NO_LIMIT]


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


# Try a bucket or a prefix in a store with a small hidden object, which is removed again.


#: The operations, and the consequence of one that fails.
_STORE_CHECK_TRIED: Final = {
    "list": "objects can't be listed",
    "write": "objects can't be written",
    "read": "objects can't be read",
    "put-if-absent": "two commands at once may both write the first results of a log",
    "replace": "results of two commands at once may replace each other",
    "delete": "objects can't be removed",
}
_REASON: Final = re.compile(r"^.*? can't be (?:read|written|removed): ")


@dataclass(frozen=True)
class StoreCheck:
    """The operations that a bucket or a prefix allows.

    Attributes
    ----------
    url : str
        The bucket or prefix.
    server, region : str
        The address of the server, or the name of the service; and its region ("" where there are none).
    credentials : str
        Where they come from.
    access : dict of str to str
        Why each of "list", "write", "read", "put-if-absent" (write an object only if it is absent), "replace" (only if
        it is unchanged) and "delete" fails; "" where it works. What could not be tried is not there.

    """

    url: str
    server: str
    region: str
    credentials: str
    access: dict[str, str]

    @property
    def faults(self) -> tuple[str, ...]:
        """One line for each reason."""
        reasons: dict[str, list[str]] = {}
        for name, why in self.access.items():
            if why:
                reasons.setdefault(why, []).append(_STORE_CHECK_TRIED[name])
        return tuple(f"{self.url}: {' and '.join(tried)}: {why}" for why, tried in reasons.items())


def url_of_store(store: str) -> Url:
    """Return the URL of a bucket or prefix; that of a log stands for the prefix with it.

    Raises McaptrackError for anything else, and if what reads the store is not installed.
    """
    url = parse(store)
    if not isinstance(url, Url):
        examples = ", ".join(f"{scheme}://" for scheme in SCHEMES)
        name = hide_secrets(store) if "://" in store else store
        raise McaptrackError(f"{name:.200} is no bucket or prefix in a store; give a URL with {examples}")
    objects.library(url)
    return url.parent if url.suffix.lower() == ".mcap" else url


def check_store(url: Url) -> StoreCheck:
    """Try the operations of a run on a store."""
    server, region, credentials = described(url)
    access = dict(_tries(url))
    return StoreCheck(
        str(url), server, region, credentials, {name: access[name] for name in _STORE_CHECK_TRIED if name in access}
    )


def _tries(url: Url) -> Iterator[tuple[str, str]]:
    """Yield each operation, and why it failed; "" if it didn't."""
    listed: list[Url] = []
    yield "list", _why(lambda: listed.extend(member for member, _ in islice(objects.list_objects(url), 1)))
    probe = url / f".mcaptrack-doctor-{uuid4().hex}"
    texts = [f"{number} {uuid4().hex}".encode() for number in range(4)]
    versions: list[Version | None] = []
    why = _why(lambda: versions.append(objects.put_if_unchanged(probe, texts[0], None)))
    yield "write", why
    if why or versions[0] is None:
        if listed:
            yield "read", _why(lambda: objects.read_end(listed[0], 1))
        return
    first = versions[0]
    try:
        yield "read", _why(lambda: _compare(probe, first, texts[0]))
        yield "put-if-absent", _why(lambda: _refuse(objects.put_if_unchanged(probe, texts[1], None)))
        yield "replace", _why(lambda: _replace(probe, first, texts))
    finally:
        why = _why(lambda: objects.delete(probe))
    yield "delete", why


def _why(attempt: Callable[[], object]) -> str:
    """Do something, and return why it failed; "" if it didn't."""
    try:
        attempt()
    except McaptrackError as error:
        return _REASON.sub("", str(error))
    return ""


def _compare(url: Url, version: Version, text: bytes) -> None:
    if objects.read_ranges(url, version, [(0, len(text))]) != [text]:
        raise McaptrackError("the store gives other bytes than were written")


def _refuse(written: Version | None) -> None:
    if written is not None:
        raise McaptrackError("the store overwrites an object although it was asked not to")


def _replace(url: Url, first: Version, texts: list[bytes]) -> None:
    with suppress(McaptrackError):  # a store that overwrote it has another version now
        first = objects.find(url) or first
    second = objects.put_if_unchanged(url, texts[2], first)
    if second is None:
        raise McaptrackError("the store does not replace an object that is unchanged")
    _refuse(objects.put_if_unchanged(url, texts[3], first))


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
    existing = next(place for place in (folder, *folder.parents) if place.exists())
    return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)


@dataclass(frozen=True)
class DoctorResult:
    """An installation: what it has, and what it lacks.

    Attributes
    ----------
    version, python, system : str
        Versions of mcaptrack and Python, and the operating system.
    packages : dict of str to str
        Version of each package that mcaptrack needs; "" for one that is missing.
    extras : dict of str to tuple of str
        The packages that each extra lacks; () for an extra that is installed.
    codecs : dict of str to str
        Why pictures of a codec can't be decoded, or encoded ("h264 encoder"); "" where they can.
    onnx_providers : tuple of str
        What ONNX Runtime can run networks on; () if it is not installed.
    cores : float
        How many cores this process may use; a quota may be a fraction.
    memory_bytes : int or None
        How much memory this process may use; None if that is unknown.
    threads : dict of str to str
        Threads of OpenCV, and of the libraries for which the environment sets them.
    temporary_folder : pathlib.Path or None
        Where temporary files are written; None if no folder for them can be written.
    temporary_bytes_free : int or None
        Free space there.
    cache_folder : pathlib.Path
        Where fetched weights of detectors are kept; it is made when it is first needed.
    cache_can_be_written : bool
        Whether it can be made and written.
    plugins : dict of str to str
        Detectors, trackers, re-trackers and predictors of other packages, as "tracker nearest", and why each can't be
        imported; "" where it can.
    faults : tuple of str
        What a plain run needs, and this installation lacks.
    store : StoreCheck or None
        What may be done with a store; None if none was named.
    warnings : tuple of mcaptrack.Notice
        What is missing or scarce, but not needed by a plain run.

    """

    version: str
    python: str
    system: str
    packages: dict[str, str]
    extras: dict[str, tuple[str, ...]]
    codecs: dict[str, str]
    onnx_providers: tuple[str, ...]
    cores: float
    memory_bytes: int | None
    threads: dict[str, str]
    temporary_folder: Path | None
    temporary_bytes_free: int | None
    cache_folder: Path
    cache_can_be_written: bool
    plugins: dict[str, str]
    faults: tuple[str, ...]
    store: StoreCheck | None = None
    warnings: tuple[Notice, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return all but the warnings as values of JSON.

        Returns
        -------
        dict
            What ``mcaptrack doctor --json`` prints.

        Examples
        --------
        >>> import mcaptrack
        >>> mcaptrack.doctor().to_json()["faults"]
        ()

        """
        data = asdict(self)
        del data["warnings"]
        folder = self.temporary_folder
        return data | {"temporary_folder": str(folder) if folder else None, "cache_folder": str(self.cache_folder)}


def doctor(store: str | None = None) -> DoctorResult:
    """Find out what this installation has, and whether a plain run would work.

    Pictures are encoded and decoded, a table is written, and a log is written to the temporary folder and read back.
    The network is used for ``store`` only.

    Parameters
    ----------
    store : str, optional
        The URL of a bucket or prefix in a store, such as "s3://robots/night". Objects are listed there; a small hidden
        one is written, read, replaced and removed.

    Returns
    -------
    DoctorResult
        Versions, codecs, cores, memory, folders, plug-ins; ``faults`` is () if nothing is missing.

    Raises
    ------
    McaptrackError
        If ``store`` is not the URL of a store, or if what reads stores is not installed.

    Examples
    --------
    >>> import mcaptrack
    >>> mcaptrack.doctor().faults
    ()
    """
    from mcaptrack.networks import providers
    from mcaptrack.sources.video.self_test import codec_faults

    url = None if store is None else url_of_store(store)
    with collected() as warnings:
        packages, extras, faults = _packages()
        broken = broken_packages()
        faults += [
            f"{name}: {problem}; install {name} again"
            for name, problem in broken.items()
            if packages.get(name, "?")  # that it is not installed is said already
        ]
        codecs = codec_faults()
        faults += [
            f"{name}: pictures can't be {'en' if name.endswith('encoder') else 'de'}coded ({why}); "
            "`pip install av` brings it"
            for name, why in codecs.items()
            if why
        ]
        folder, why = temporary_folder()
        if why:
            place = folder or "the temporary folder"
            faults.append(
                f"{place}: a log can't be written there and read back ({why}); TMPDIR may name another folder"
            )
        free = free_bytes(folder) if folder else None
        if free is not None and free < _LITTLE_BYTES:
            warn(f"{folder} has only {free / 1e6:,.0f} MB free; TMPDIR may name another folder")
        cache = cache_folder()
        plugins = _plugins()
        checked = None if url is None else check_store(url)
        faults += checked.faults if checked else ()
        return DoctorResult(
            version=__version__,
            python=platform.python_version(),
            system=platform.platform(),
            packages=packages,
            extras=extras,
            codecs=codecs,
            onnx_providers=providers(),
            cores=share_of_cores(),
            memory_bytes=memory_bytes(),
            threads=_threads(broken),
            temporary_folder=folder,
            temporary_bytes_free=free,
            cache_folder=cache,
            cache_can_be_written=can_be_written(cache),
            plugins=plugins,
            faults=tuple(faults),
            store=checked,
            warnings=tuple(warnings),
        )


def _packages() -> tuple[dict[str, str], dict[str, tuple[str, ...]], list[str]]:
    """Return the versions of the packages that are needed, what each extra lacks, and faults."""
    packages: dict[str, str] = {}
    lacking: dict[str, list[str]] = {}
    faults = []
    for text in _requirements():
        match = _REQUIREMENT.match(text)
        if match is None:
            continue
        name, least, marker = match.groups(default="")
        extra = re.search(r"extra\s*==\s*['\"]([\w-]+)['\"]", marker)
        have = _version_of(name)
        is_enough = bool(have) and _numbers(have) >= _numbers(least)
        if extra is None:
            packages[name] = have
            if not is_enough:
                lack = f"only version {have} is installed" if have else "it is not installed"
                faults.append(f"{name}: {lack}; `pip install '{name}>={least}'` installs what is needed")
        elif extra[1] not in _NOT_SHOWN:
            lacking.setdefault(extra[1], []).extend([] if is_enough else [name])
    return packages, {name: tuple(names) for name, names in lacking.items()}, faults


def _requirements() -> list[str]:
    try:
        return metadata.requires("mcaptrack") or []
    except metadata.PackageNotFoundError:
        warn("mcaptrack is not installed as a package: which versions of others it needs is unknown")
        return []


def _version_of(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _numbers(version: str) -> tuple[int, ...]:
    """Return the numbers at the beginning of a version; zeros at their end say nothing."""
    match = re.match(r"\d+(?:\.\d+)*", version)
    numbers = [int(number) for number in match[0].split(".")] if match else []
    while numbers and not numbers[-1]:
        numbers.pop()
    return tuple(numbers)


def _threads(broken: Collection[str]) -> dict[str, str]:
    settings = {name: os.environ[name] for name in THREADS if name in os.environ}
    if "opencv-python-headless" in broken:
        return settings
    import cv2

    return {"OpenCV": str(cv2.getNumThreads())} | settings


def _plugins() -> dict[str, str]:
    """Import the plug-ins of installed packages; return why each can't be imported, or "", and warn of it."""
    from mcaptrack.registry import BUILT_IN, KINDS, find, names

    reasons = {}
    for kind in KINDS:
        for name in names(kind):
            if name in BUILT_IN[kind]:
                continue
            reasons[f"{kind} {name}"] = ""
            try:
                find(kind, name)
            except McaptrackError as error:
                reasons[f"{kind} {name}"] = str(error)
                warn(str(error), "other")
    return reasons
