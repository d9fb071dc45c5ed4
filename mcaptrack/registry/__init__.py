"""Find detectors, trackers, predictors, re-trackers and fusers by name: built-in ones and those of other packages.

There are three kinds of names, on the command line, in files for ``--config`` and in Python:

* Built-in names, as in ``find("tracker", "sort")``.
* Names of entry points. A package declares them in its ``pyproject.toml``, in the group of their kind
  (``mcaptrack.detectors``, ``.trackers``, ``.predictors``, ``.retrackers``, ``.fusers``)::

      [project.entry-points."mcaptrack.trackers"]
      nearest = "my_package.tracking:NearestTracker"

* ``module:Class``, as in ``my_module:NearestTracker``. Installed modules are searched first, then the working folder.

Entry points can't replace built-in names, and their names hold no colon. ``names`` imports nothing; ``find`` imports
the module of the entry that it finds. ``entry_of`` is the inverse: from a class to its entry. The provenance of a
channel stores the fields of an ``Entry``: name, module and class, and the name and version of the distribution (the
installed package).

Interfaces are defined in ``mcaptrack.transforms.protocol`` and ``mcaptrack.predictors.forecast``. To add a built-in
entry: a line in ``BUILT_IN``.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module, metadata
from importlib.metadata import Distribution, EntryPoint
from pathlib import Path
from traceback import extract_tb
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

from mcaptrack import __version__
from mcaptrack.errors import McaptrackError, did_you_mean
from mcaptrack.registry.guard import Guard, contained_import

Kind = Literal["detector", "tracker", "predictor", "retracker", "fuser"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
_OWN: Final = "mcaptrack"
_FOLDER: Final = Path(__file__).parent.parent
#: Exit codes of processes that end by a signal.
_SIGNALLED: Final = frozenset(128 + number for number in (signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", 1)))

#: Module and class of the built-in entries, by kind and name; the first of a kind is its default.
BUILT_IN: Final[Mapping[str, Mapping[str, str]]] = MappingProxyType(
    {
        "detector": {
            "median": "mcaptrack.transforms.detect.median:MedianDetector",
            "knn": "mcaptrack.transforms.detect.background:KnnDetector",
            "onnx": "mcaptrack.transforms.detect.onnx.detector:OnnxDetector",
            "yolox-nano": "mcaptrack.transforms.detect.onnx.detector:YoloxNano",
            "yolox-tiny": "mcaptrack.transforms.detect.onnx.detector:YoloxTiny",
            "yolox-s": "mcaptrack.transforms.detect.onnx.detector:YoloxS",
        },
        "tracker": {
            "sort": "mcaptrack.transforms.sort:Sort",
            "bytetrack": "mcaptrack.transforms.sort:ByteTrack",
            "ocsort": "mcaptrack.transforms.sort:OcSort",
            "ground": "mcaptrack.transforms.ground:GroundTracker",
        },
        "predictor": {
            "red": "mcaptrack.predictors.built_in:red",
            "social": "mcaptrack.predictors.built_in:social",
            "cv": "mcaptrack.predictors.built_in:cv",
            "holt-cv": "mcaptrack.predictors.built_in:holt_cv",
            "kalman": "mcaptrack.predictors.built_in:kalman",
            "lstm": "mcaptrack.predictors.built_in:lstm",
            "onnx": "mcaptrack.predictors.built_in:onnx",
        },
        "retracker": {
            "likelihood": "mcaptrack.transforms.retrack:Retrack",
            "consistency": "mcaptrack.transforms.retrack:RetrackByConsistency",
        },
        "fuser": {
            "feet": "mcaptrack.transforms.fuse:FootFuser",
        },
    }
)


@dataclass(frozen=True)
class Entry:
    """An entry of the registry.

    Attributes
    ----------
    name : str
        Its name: built-in, of an entry point, or ``module:Class``.
    kind : str
        One of ``KINDS``.
    cls : type
        The class; a predictor may be a function that returns one.
    module : str
        The module that defines the class.
    distribution, version : str
        The installed package of the module, and its version; "" if unknown.
    """

    name: str
    kind: str
    cls: Any
    module: str
    distribution: str
    version: str

    @property
    def implementation(self) -> str:
        """The place where the class is defined, as in ``my_package.tracking:NearestTracker``."""
        return f"{self.module}:{self.cls.__qualname__}"

    @property
    def is_built_in(self) -> bool:
        """Whether it is part of mcaptrack."""
        return self.name in BUILT_IN.get(self.kind, ())

    def __str__(self) -> str:
        """Its name in messages: ``tracker nearest (my-package 1.0)``."""
        package = f"{self.distribution} {self.version}".strip()
        return f"{self.kind} {self.name}" + (f" ({package})" if package and not self.is_built_in else "")


def _group(kind: str) -> str:
    """The group of entry points of a kind."""
    return f"{_OWN}.{kind}s"


# Installed packages: their entry points, and which of them a module is of.


def distribution_of(module: str) -> tuple[str, str]:
    """Name and version of the distribution of a module; "" and "" if unknown, as for those installed as editable."""
    names = _owners(_places()).get(module.partition(".")[0])
    return (names[0], metadata.version(names[0])) if names else ("", "")


def entry_points(group: str, unreadable: list[str] | None = None) -> list[EntryPoint]:
    """The entry points of a group.

    Packages with entry points that can't be read are left out; their names are added to ``unreadable``.
    """
    points, failed = _declared(_places(), group)
    if unreadable is not None:
        unreadable += failed
    return [point for point in points if ":" not in point.name]


def package_of(point: EntryPoint) -> tuple[str, str]:
    """Name and version of the distribution that declares an entry point."""
    return _name_and_version(point.dist)


def running_program() -> str:
    """The program that runs, without its place: its distribution with the version, or else the name of its script."""
    main = sys.modules.get("__main__")
    spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
    if spec is not None:
        module = str(spec.name).removesuffix(".__main__")
        return " ".join(filter(None, distribution_of(module))) or module
    if not file:
        return "a notebook" if "ipykernel" in sys.modules else "Python"
    script = Path(file)
    points = [] if script.suffix else entry_points("console_scripts")
    package = next((package_of(point) for point in points if point.name == script.name), ())
    plain = "".join(character if character.isprintable() else "?" for character in script.name)
    return " ".join(filter(None, package)) or plain


def _places() -> tuple[tuple[str, int], ...]:
    """The folders of ``sys.path`` and when each last changed: they tell whether something was installed."""
    return tuple((place, _changed_ns(place)) for place in sys.path)


def _changed_ns(place: str) -> int:
    """The time when a folder of ``sys.path`` last gained or lost an entry; 0 if it is no folder."""
    try:
        return Path(place or ".").stat().st_mtime_ns
    except OSError:
        return 0


@lru_cache(maxsize=4)
def _owners(_places: tuple[tuple[str, int], ...]) -> Mapping[str, list[str]]:
    """The distributions of each top-level module; kept until something is installed, for it reads all metadata."""
    try:
        return metadata.packages_distributions()
    except Exception:  # metadata of another package that can't be read
        return {}


@lru_cache(maxsize=32)
def _declared(_places: tuple[tuple[str, int], ...], group: str) -> tuple[list[EntryPoint], list[str]]:
    """Entry points of a group, and packages with entry points that can't be read; kept until something is installed."""
    try:
        return list(metadata.entry_points(group=group)), []
    except Exception:  # those of one package can't be read; the others count all the same
        points: list[EntryPoint] = []
        failed: list[str] = []
    for distribution in metadata.distributions():
        try:
            points += [point for point in distribution.entry_points if point.group == group]
        except Exception:
            failed.append(_name_and_version(distribution)[0])
    return points, failed


def _name_and_version(distribution: Distribution | None) -> tuple[str, str]:
    """Name and version of a distribution; "" for what its metadata lack."""
    try:
        fields = distribution.metadata if distribution is not None else None
        # some versions of importlib raise an error at fields["Name"] where it is missing
        name, version = (fields.get_all(name, [""])[0] if fields else "" for name in ("Name", "Version"))
    except Exception:  # metadata that can't be read
        return "", ""
    return name or "", version or ""


def names(kind: Kind) -> tuple[str, ...]:
    """All names of a kind: built-in ones, then those of entry points. Imports nothing."""
    return (*BUILT_IN[kind], *sorted({point.name for point in entry_points(_group(kind))} - set(BUILT_IN[kind])))


def find(kind: Kind, name: str, distribution: str = "") -> Entry:
    """Find an entry by its name, and import it.

    Parameters
    ----------
    kind : str
        One of ``KINDS``.
    name : str
        A built-in name, the name of an entry point, or ``module:Class``.
    distribution : str, optional
        The package to take if several have an entry point of this name.

    Returns
    -------
    Entry

    Raises
    ------
    McaptrackError
        If there is no such entry, if several packages have one, or if it can't be imported.

    Examples
    --------
    >>> find("tracker", "ocsort").implementation
    'mcaptrack.transforms.sort.ocsort:OcSort'
    """
    if name in BUILT_IN[kind]:
        implementation = _load(f"{kind} {name}", BUILT_IN[kind][name])
        return Entry(name, kind, implementation, implementation.__module__, _OWN, __version__)
    if ":" in name:
        with _working_folder():
            implementation = _load(f"{kind} {name}", name)
        return Entry(name, kind, implementation, implementation.__module__, *distribution_of(implementation.__module__))
    points = [point for point in entry_points(_group(kind)) if point.name == name]
    if not points:
        raise McaptrackError(_unknown(kind, name))
    points = [point for point in points if package_of(point)[0] == distribution] or points
    if len(points) > 1:
        values = " and ".join(sorted(f"{point.value} ({' '.join(package_of(point))})" for point in points))
        raise McaptrackError(f"several installed packages have a {kind} {name}: {values}; name one as module:Class")
    package = package_of(points[0])
    implementation = _load(f"{kind} {name} ({' '.join(package)})", points[0].value)
    return Entry(name, kind, implementation, implementation.__module__, *package)


def entry_of(kind: str, cls: type) -> Entry:
    """The entry of a class: built-in, of an entry point, or else ``module:Class``.

    A subclass of a built-in class is not built in.
    """
    built_in = BUILT_IN.get(kind, {})
    for name, where in built_in.items():
        if where.partition(":")[2] == cls.__qualname__ and _load(name, where) is cls:
            return Entry(name, kind, cls, cls.__module__, _OWN, __version__)
    top = cls.__module__.partition(".")[0]
    for point in entry_points(_group(kind)):
        same_package = point.value.partition(":")[0].partition(".")[0] == top
        if same_package and point.name not in built_in and _is(point, cls):
            return Entry(point.name, kind, cls, cls.__module__, *package_of(point))
    return Entry(f"{cls.__module__}:{cls.__qualname__}", kind, cls, cls.__module__, *distribution_of(cls.__module__))


def is_installed(kind: Kind, name: str) -> bool:
    """Whether a name is built in or of an entry point: only these are imported because a log names them."""
    return name in names(kind)


@contextmanager
def blamed(entry: Entry, what: str, guard: Guard | None = None) -> Iterator[None]:
    """Run the code of another package: whatever it raises becomes a McaptrackError that names it.

    What it changes in this process is undone, with a warning; ``guard`` remembers that for all calls of one object.
    Interruptions pass as they are: Ctrl-C, and the exit that a signal asks for.
    """
    guard = guard or Guard(str(entry))
    try:
        try:
            with guard.step():
                yield
        finally:
            guard.end()
    except BaseException as error:
        if is_interruption(error):
            raise
        raise failure(entry, what, error) from error


def is_interruption(error: BaseException) -> bool:
    """Whether this ends the process from outside: Ctrl-C or a signal, and not ``sys.exit`` in the code of others."""
    return isinstance(error, KeyboardInterrupt) or (isinstance(error, SystemExit) and error.code in _SIGNALLED)


def failure(entry: Entry, what: str, error: BaseException) -> McaptrackError:
    """An exception of the code of another package, as one line with the entry and the place in its source."""
    if isinstance(error, McaptrackError):
        return McaptrackError(f"{entry}: {error}")
    frames = [frame for frame in extract_tb(error.__traceback__) if _FOLDER not in Path(frame.filename).parents]
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return McaptrackError(f"{entry} {what}: {_words(error)}{where}")


def _words(error: BaseException) -> str:
    try:
        return " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
    except Exception:  # an exception of others that can't even be printed
        return type(error).__name__


def _is(point: EntryPoint, cls: type) -> bool:
    try:
        with contained_import(f"the package of {point.name}"):
            return point.load() is cls
    except BaseException as error:  # an entry point that can't be imported is another class
        if is_interruption(error):
            raise
        return False


def _load(what: str, reference: str) -> Any:
    """Import ``module:Class``. Raises McaptrackError, also if its module raises any exception."""
    module, _, path = reference.partition(":")
    parts = path.split("[")[0].strip().split(".")
    if not all(part.isidentifier() for part in (*module.strip().split("."), *parts)):
        raise McaptrackError(f"{what}: {reference} is not of the form module:Class")
    try:
        with nullcontext() if module.startswith(f"{_OWN}.") else contained_import(what):
            member: Any = import_module(module.strip())
    except BaseException as error:  # code of other packages may raise anything
        if is_interruption(error):
            raise
        raise McaptrackError(f"{what} can't be imported: {_words(error)}") from error
    for part in parts:
        member = getattr(member, part, None)
    if member is None:
        raise McaptrackError(f"{what}: {module} has no class {path}")
    if not callable(member) or not hasattr(member, "__qualname__"):
        raise McaptrackError(f"{what}: {path} in {module} is no class but of type {type(member).__name__}")
    return member


@contextmanager
def _working_folder() -> Iterator[None]:
    """Search modules in the working folder, too, after all others."""
    sys.path.append("")
    try:
        yield
    finally:
        sys.path.reverse()
        sys.path.remove("")
        sys.path.reverse()


def _unknown(kind: Kind, name: str) -> str:
    all_names, unreadable = names(kind), list[str]()
    entry_points(_group(kind), unreadable)
    choices = f"there are {', '.join(all_names)}" if all_names else f"no {kind} is built in or installed"
    return (
        f"no {kind} is called {name}; {did_you_mean(name, all_names)}{choices}; an installed package gives more by its "
        f"entry points in {_OWN}.{kind}s, and module:Class names any class"
        + (f". The entry points of {', '.join(unreadable)} can't be read" if unreadable else "")
    )
