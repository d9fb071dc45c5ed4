"""Versions, codecs, memory, folders and plug-ins of an installation, and what it lacks."""

from __future__ import annotations

import operator
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Final

from mcaptrack import __version__
from mcaptrack.api.declared import Argument, declared
from mcaptrack.environment import THREADS, memory_bytes, share_of_cores
from mcaptrack.errors import McaptrackError
from mcaptrack.installed import missing_extensions
from mcaptrack.location import SCHEMES, Url, hide_secrets, parse
from mcaptrack.notices import Notice, collected, warn
from mcaptrack.objects import StoreCheck, store_of

#: Extras for people who work on mcaptrack itself, or read its examples.
_NOT_SHOWN: Final = ("docs", "examples", "test")
#: How the signs of requirements compare versions.
_COMPARED: Final[Mapping[str, Callable[[Any, Any], bool]]] = {
    ">=": operator.ge, "~=": operator.ge, "<=": operator.le, "==": operator.eq, "!=": operator.ne, ">": operator.gt,
    "<": operator.lt,
}  # fmt: skip
_LITTLE_BYTES: Final = 1_000_000_000
#: The line of a module in the list of files that pip keeps of a package.
_MODULES: Final = re.compile(r"^([^/,\n]+)/__init__\.py,", re.MULTILINE)
#: A requirement of a package: its name, the limits of its version, and its marker; and one of these limits.
_REQUIREMENT: Final = re.compile(r"([\w.-]+)\s*(?:\[[^]]*\])?\s*([^;]*?)\s*(?:;(.*))?")
_LIMIT: Final = re.compile(r"(>=|<=|~=|==|!=|>|<)\s*([\d.]+)(?![\d.]|\*)")


def temporary_folder() -> tuple[Path | None, str]:
    """Return the folder for temporary files, and why a log can't be written to it and read back ("" if it can)."""
    from mcaptrack import log

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
    parts : dict of str to str
        What parts say of themselves, such as what networks can run on, by its heading.
    extensions : dict of str to str
        What to do about each extension that isn't installed, by name; "" for those that are.
    plugins : dict of str to str
        Parts of other packages, as "tracker nearest (my-package 1.0)", and why each can't be imported; "" where it can.
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
    cores: float
    memory_bytes: int | None
    threads: dict[str, str]
    temporary_folder: Path | None
    temporary_bytes_free: int | None
    parts: dict[str, str]
    extensions: dict[str, str]
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
        return data | {"temporary_folder": str(self.temporary_folder) if self.temporary_folder else None}


@declared(heading="Improve and repair", printed_by="mcaptrack.cli.doctor:Doctor")
def doctor(
    store: Annotated[
        str | None, Argument("store", "STORE", "A bucket or prefix to try, such as s3://robots/night.")
    ] = None,
) -> DoctorResult:
    """Print what this installation, or a store, has and lacks.

    Versions, codecs, memory, folders and plug-ins are listed. Pictures are encoded and decoded, a table is written, and
    a log is written to the temporary folder and read back. The network is used for a store only: objects are listed
    there, and a small hidden one is written, read, replaced and removed. The exit code is 0 if all that a plain run
    needs is there, and 1 otherwise, with one line for each fault.

    Parameters
    ----------
    store : str, optional
        The URL of a bucket or prefix in a store, such as "s3://robots/night".

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
    On the command line:

        mcaptrack doctor

        mcaptrack doctor s3://robots/night

    >>> import mcaptrack
    >>> mcaptrack.doctor().faults
    ()
    """
    from mcaptrack.sources.video.codecs import codec_faults

    url = None if store is None else _url_of_store(store)
    with collected() as warnings:
        packages, extras, faults = _packages()
        faults += list(_overwritten(packages))
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
        plugins = _plugins()
        checked = None if url is None else store_of(url).check(url)
        faults += checked.faults if checked else ()
        return DoctorResult(
            version=__version__,
            python=platform.python_version(),
            system=platform.platform(),
            packages=packages,
            extras=extras,
            codecs=codecs,
            cores=share_of_cores(),
            memory_bytes=memory_bytes(),
            threads=_threads(broken),
            temporary_folder=folder,
            temporary_bytes_free=free,
            parts=_parts(),
            extensions=missing_extensions(),
            plugins=plugins,
            faults=tuple(faults),
            store=checked,
            warnings=tuple(warnings),
        )


def _url_of_store(store: str) -> Url:
    """Return the URL of a bucket or prefix; that of a log stands for the prefix with it.

    Raises McaptrackError for anything else, and if what reads the store is not installed.
    """
    url = parse(store)
    if not isinstance(url, Url):
        examples = ", ".join(f"{scheme}://" for scheme in SCHEMES)
        name = hide_secrets(store) if "://" in store else store
        raise McaptrackError(f"{name:.200} is no bucket or prefix in a store; give a URL with {examples}")
    store_of(url)
    return url.parent if url.suffix.lower() == ".mcap" else url


def _packages() -> tuple[dict[str, str], dict[str, tuple[str, ...]], list[str]]:
    """Return the versions of the packages that are needed, what each extra lacks, and faults."""
    packages: dict[str, str] = {}
    lacking: dict[str, list[str]] = {}
    faults = []
    for name, limits, marker, lack in _requirements("mcaptrack"):
        extra = re.search(r"extra\s*==\s*['\"]([\w-]+)['\"]", marker)
        if extra is None:
            packages[name] = _version_of(name)
            faults += [f"{name}: {lack}; `pip install '{name}{limits}'` installs what is needed"] if lack else []
        elif extra[1] not in _NOT_SHOWN:
            lacking.setdefault(extra[1], []).extend([name] if lack else [])
    return packages, {name: tuple(names) for name, names in lacking.items()}, faults


def _overwritten(packages: Collection[str]) -> Iterator[str]:
    """Yield a fault for each module of these packages that another installed package brings, too, in the same files."""
    owners: dict[str, set[str]] = {}
    for package in metadata.distributions():
        with suppress(Exception):  # metadata of another package that can't be read
            for module in _MODULES.findall(package.read_text("RECORD") or ""):
                owners.setdefault(module, set()).add(package.name)
    for module, names in owners.items():
        several = sorted(names)
        needed = [name for name in several if name in packages]
        if len(several) > 1 and needed:
            those = " and ".join(f"{name} {_version_of(name)}" for name in several)
            yield (
                f"{module} is of {those}, of which the one installed last has overwritten the other; "
                f"`pip uninstall -y {' '.join(several)}`, then `pip install {needed[0]}`"
            )


def _requirements(package: str) -> Iterator[tuple[str, str, str, str]]:
    """Yield what a package needs: its name, limits of its version, the marker, and what is lacking; "" if nothing."""
    try:
        texts = metadata.requires(package) or []
    except metadata.PackageNotFoundError:
        warn(f"{package} is not installed as a package: which versions of others it needs is unknown")
        return
    for match in filter(None, map(_REQUIREMENT.fullmatch, texts)):
        name, limits, marker = match.groups(default="")
        have = _version_of(name)
        fits = all(_COMPARED[sign](_numbers(have), _numbers(limit)) for sign, limit in _LIMIT.findall(limits))
        lack = f"version {have} is installed" if have else "it is not installed"
        yield name, limits, marker, "" if have and fits else lack


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
    """Import the parts of installed packages; return why each can't be used, or "", and warn of it."""
    from mcaptrack.registry import KINDS, find, ignored, points, strays, titled
    from mcaptrack.transforms.stages import declared_stage

    reasons, packages = strays(), dict[str, None]()
    for kind in KINDS:
        reasons |= ignored(kind)
        for point in [point for point in points(kind) if not point.is_own]:
            name = titled(kind, point.name, point.package)
            reasons[name] = ""
            packages[point.package[0]] = None
            try:
                entry = find(kind, point.name)
                if kind == "stage":
                    declared_stage(entry)
            except McaptrackError as error:
                reasons[name] = str(error)
    for reason in filter(None, reasons.values()):
        warn(reason, "other")
    for package in packages:
        for name, limits, marker, lack in _requirements(package):
            if lack and not marker:  # with a marker it isn't needed everywhere
                needs = f"{package} {_version_of(package)} needs {name}{limits}"
                warn(f"{needs}, and {lack}; install another version of one", "other-version")
    return reasons


def _parts() -> dict[str, str]:
    """Return the lines of extensions and packages, by their headings; warn of those that can't say theirs."""
    from mcaptrack.registry import answer_of, find, names

    lines: dict[str, str] = {}
    for name in names("doctor_line"):
        try:
            entry = find("doctor_line", name)
            lines |= answer_of(entry, dict, "it", entry.cls)
        except McaptrackError as error:
            warn(str(error), "other")
    return {str(heading): str(text) for heading, text in lines.items()}
