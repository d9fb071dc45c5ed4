"""Find detectors, trackers, predictors, re-trackers and fusers by name: built-in ones and those of other packages.

A name is one of three things, everywhere: on the command line, in files for ``--config``, and in Python.

* A built-in name, as in ``find("tracker", "sort")``.
* The name of an entry point. A package declares it in its ``pyproject.toml``, in the group of its kind
  (``mcaptrack.detectors``, ``.trackers``, ``.predictors``, ``.retrackers``, ``.fusers``)::

      [project.entry-points."mcaptrack.trackers"]
      nearest = "my_package.tracking:NearestTracker"

* ``module:Class``, as in ``my_module:NearestTracker``. The module is imported as Python would import it in the working
  folder, after all that is installed.

Built-in names come first: an entry point can't replace one. ``names`` imports nothing; ``find`` imports the module of
the one that it finds and of no other. ``entry_of`` is the way back: what a class is called. An ``Entry`` has what the
provenance of a channel keeps: name, module and class, and the name and version of the distribution (the installed
package) that they come from.

What a class has to be stands in ``mcaptrack.transforms.protocol`` and ``mcaptrack.predictors.forecast``. To add a
built-in one: a line in ``BUILT_IN``.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, packages_distributions, version
from pathlib import Path
from traceback import extract_tb
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

from mcaptrack import __version__
from mcaptrack.errors import McaptrackError

Kind = Literal["detector", "tracker", "predictor", "retracker", "fuser"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
_OWN: Final = "mcaptrack"

#: Where the built-in ones are defined, by kind and name; the first of a kind is its default.
BUILT_IN: Final[Mapping[str, Mapping[str, str]]] = MappingProxyType(
    {
        "detector": {
            "knn": "mcaptrack.transforms.detect.background:KnnDetector",
            "mog2": "mcaptrack.transforms.detect.background:Mog2Detector",
            "frame-difference": "mcaptrack.transforms.detect.background:FrameDifferenceDetector",
        },
        "tracker": {
            "sort": "mcaptrack.transforms.sort:Sort",
            "bytetrack": "mcaptrack.transforms.sort:ByteTrack",
            "ocsort": "mcaptrack.transforms.sort:OcSort",
        },
        "predictor": {
            "red": "mcaptrack.predictors.built_in:red",
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
        "fuser": {},
    }
)


@dataclass(frozen=True)
class Entry:
    """What a name stands for.

    Attributes
    ----------
    name : str
        The name it was found by: built-in, of an entry point, or ``module:Class``.
    kind : str
        One of ``KINDS``.
    cls : type
        The class; of a predictor it may be a function that makes one.
    module : str
        The module that defines the class.
    distribution, version : str
        The installed package that the module comes from, and its version; "" where that is not known.

    """

    name: str
    kind: str
    cls: Any
    module: str
    distribution: str
    version: str

    @property
    def implementation(self) -> str:
        """Where the class is defined, as in ``my_package.tracking:NearestTracker``."""
        return f"{self.module}:{self.cls.__qualname__}"

    @property
    def is_built_in(self) -> bool:
        """Whether it comes with mcaptrack."""
        return self.name in BUILT_IN.get(self.kind, ())

    def __str__(self) -> str:
        """As messages name it: ``tracker nearest (my-package 1.0)``."""
        package = f"{self.distribution} {self.version}".strip()
        return f"{self.kind} {self.name}" + (f" ({package})" if package and not self.is_built_in else "")


def names(kind: Kind) -> tuple[str, ...]:
    """All names of a kind: built-in ones, then those of installed packages. Imports nothing."""
    return (*BUILT_IN[kind], *sorted({point.name for point in _installed(kind)} - set(BUILT_IN[kind])))


def find(kind: Kind, name: str) -> Entry:
    """Find what a name stands for, and import it.

    Parameters
    ----------
    kind : str
        One of ``KINDS``.
    name : str
        A built-in name, the name of an entry point, or ``module:Class``.

    Returns
    -------
    Entry

    Raises
    ------
    McaptrackError
        If there is none of that name, or several, or if it can't be imported.

    Examples
    --------
    >>> find("tracker", "ocsort").implementation
    'mcaptrack.transforms.sort.ocsort:OcSort'

    """
    if name in BUILT_IN[kind]:
        found = _load(f"{kind} {name}", BUILT_IN[kind][name])
        return Entry(name, kind, found, found.__module__, _OWN, __version__)
    if ":" in name:
        with _working_folder():
            found = _load(f"{kind} {name}", name)
        return Entry(name, kind, found, found.__module__, *distribution_of(found.__module__))
    points = [point for point in _installed(kind) if point.name == name]
    if not points:
        raise McaptrackError(_unknown(kind, name))
    if len(points) > 1:
        theirs = " and ".join(sorted(f"{point.value} ({' '.join(_of_point(point))})" for point in points))
        raise McaptrackError(f"several installed packages have a {kind} {name}: {theirs}; name one as module:Class")
    package = _of_point(points[0])
    found = _load(f"{kind} {name} ({' '.join(package)})", points[0].value)
    return Entry(name, kind, found, found.__module__, *package)


def entry_of(kind: str, cls: type) -> Entry:
    """The entry of a class: by its built-in name, by that of an entry point, or else as ``module:Class``.

    A class that inherits from a built-in one is not built in: it does something else.
    """
    built_in = BUILT_IN.get(kind, {})
    for name, where in built_in.items():
        if where.partition(":")[2] == cls.__qualname__ and _load(name, where) is cls:
            return Entry(name, kind, cls, cls.__module__, _OWN, __version__)
    top = cls.__module__.partition(".")[0]
    for point in _installed(kind):
        same_package = point.value.partition(":")[0].partition(".")[0] == top
        if same_package and point.name not in built_in and _is(point, cls):
            return Entry(point.name, kind, cls, cls.__module__, *_of_point(point))
    return Entry(f"{cls.__module__}:{cls.__qualname__}", kind, cls, cls.__module__, *distribution_of(cls.__module__))


def is_installed(kind: Kind, name: str) -> bool:
    """Whether a name is built in or an entry point's, so that it can be imported though only a log names it."""
    return name in names(kind)


def failure(entry: Entry, what: str, error: BaseException) -> McaptrackError:
    """What the code of others raised, in one line that names it and the place in its files."""
    frames = [frame for frame in extract_tb(error.__traceback__) if f"/{_OWN}/" not in Path(frame.filename).as_posix()]
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    words = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
    return McaptrackError(f"{entry} {what}: {words}{where}")


def distribution_of(module: str) -> tuple[str, str]:
    """Name and version of the distribution that a module was installed with; "" and "" if that isn't known."""
    found = packages_distributions().get(module.partition(".")[0], [])
    return (found[0], _version_of(found[0])) if found else ("", "")


def _version_of(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return ""


def _installed(kind: str) -> list[EntryPoint]:
    """The entry points of a kind, each once."""
    return list({(p.name, p.value, *_of_point(p)): p for p in entry_points(group=f"{_OWN}.{kind}s")}.values())


def _of_point(point: EntryPoint) -> tuple[str, str]:
    return (point.dist.name, point.dist.version) if point.dist else ("", "")


def _is(point: EntryPoint, cls: type) -> bool:
    try:
        return point.load() is cls
    except Exception:  # an entry point that can't be imported is not this class
        return False


def _load(what: str, reference: str) -> Any:
    """Import what ``module:Class`` names. Raises McaptrackError, also for whatever its module raises."""
    module, _, path = reference.partition(":")
    parts = path.split("[")[0].strip().split(".")
    if not all(part.isidentifier() for part in (*module.strip().split("."), *parts)):
        raise McaptrackError(f"{what}: {reference} is not of the form module:Class")
    try:
        found: Any = import_module(module.strip())
    except (Exception, SystemExit) as error:  # the code of others may raise anything
        words = " ".join(f"{type(error).__name__}: {error}".split())
        raise McaptrackError(f"{what} can't be imported: {words}") from error
    for part in parts:
        found = getattr(found, part, None)
    if not callable(found) or not hasattr(found, "__qualname__"):
        raise McaptrackError(f"{what}: {module} has no class {path}")
    return found


@contextmanager
def _working_folder() -> Iterator[None]:
    """Look for modules in the working folder, too, after all others."""
    sys.path.append("")
    try:
        yield
    finally:
        sys.path.reverse()
        sys.path.remove("")
        sys.path.reverse()


def _unknown(kind: Kind, name: str) -> str:
    known = names(kind)
    close = difflib.get_close_matches(name, known, 1)
    meant = f"did you mean {close[0]}? " if close else ""
    there = f"there are {', '.join(known)}" if known else f"no {kind} is built in or installed"
    return (
        f"no {kind} is called {name}; {meant}{there}; an installed package gives more by its entry points in "
        f"{_OWN}.{kind}s, and module:Class names any class"
    )
