"""Find detectors, trackers, exporters and so on (``KINDS``) by name: built-in ones and those of other packages.

There are three kinds of names, on the command line, in files for ``--config`` and in Python:

* Built-in names, as in ``find("tracker", "sort")``.
* Names of entry points. A package declares them in its ``pyproject.toml``, in the group of their kind
  (``mcaptrack.detectors``, ``mcaptrack.label_formats`` and so on)::

      [project.entry-points."mcaptrack.trackers"]
      nearest = "my_package.tracking:NearestTracker"

* ``module:Class``, as in ``my_module:NearestTracker``. Installed modules are searched first, then the working folder.

Extensions (``mcaptrack.extensions``) name theirs in the same way, in mcaptrack's own ``pyproject.toml``. Entry points
of other packages can't replace these, or built-in names, and their names hold no colon. ``names`` imports nothing;
``find`` imports the module of the entry that it finds. ``entry_of`` is the inverse: from a class to its entry. The
provenance of a channel stores the fields of an ``Entry``: name, module and class, and the name and version of the
distribution (the installed package).

Interfaces are defined in ``mcaptrack.transforms.protocol``, ``mcaptrack.predictors.forecast`` and
``mcaptrack.contracts``. To add a built-in entry: a line in ``BUILT_IN``.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from traceback import extract_tb
from types import MappingProxyType
from typing import Any, Final, Literal, TypeVar, get_args

from mcaptrack import _MODULES, __version__
from mcaptrack.errors import McaptrackError, did_you_mean
from mcaptrack.installed import (
    Declared,
    Point,
    declared,
    distribution_of,
    entry_points,
    missing_extension,
    missing_names,
)
from mcaptrack.registry.guard import Guard, contained_import

__all__ = ["Entry", "blamed", "find", "names", "of_type", "others"]

Kind = Literal[
    "detector",
    "tracker",
    "predictor",
    "retracker",
    "fuser",
    "stage",
    "label_format",
    "message_reader",
    "recording",  # other containers than MCAP, by what their names or first bytes say
    "exporter",
    "judge",
    "finisher",
    "report_section",
    "command",
    "page",
    "player",
    "viewer",  # on the web, which `mcaptrack view` links besides Lichtblick and Foxglove
    "name",  # in Python, such as classes of results; those of the core are in mcaptrack/__init__.py
    "scene",  # what makes a scene of several cameras (mcaptrack.pipeline.scenes)
    "doctor_line",  # what `mcaptrack doctor` says of a part
    "crew",  # what processes many logs elsewhere (mcaptrack.fleet.Crew)
    "store",  # what holds objects, by the scheme of their URLs (mcaptrack.objects.Store)
]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
T = TypeVar("T")
_OWN: Final = "mcaptrack"
_FOLDER: Final = Path(__file__).parent.parent
#: Exit codes of processes that end by a signal.
_SIGNALLED: Final = frozenset(128 + number for number in (signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", 1)))

_LABELS: Final = "mcaptrack.sources.ingest.labels"
_SOLIDS: Final = "mcaptrack.sources.foreign.solids"
#: Commands that a function of the library of this name declares, in the order of the help.
_COMMANDS: Final = (
    "demo ingest run view info detect motion track sample predict retrack export cut "
    "evaluate events check recover drop doctor"
)
#: Kinds that only entry points name.
_BY_ENTRY_POINT: Final = (
    *("stage", "message_reader", "recording", "finisher", "report_section", "command", "page", "player", "viewer"),
    *("name", "scene", "doctor_line", "crew", "store"),
)
#: Module and class, or function, of the built-in entries, by kind and name; the first of a kind is its default.
BUILT_IN: Final[Mapping[str, Mapping[str, str]]] = MappingProxyType(
    {
        **{kind: {} for kind in KINDS},
        "detector": {
            "median": "mcaptrack.transforms.detect.median:MedianDetector",
            "knn": "mcaptrack.transforms.detect.background:KnnDetector",
        },
        "tracker": {
            "sort": "mcaptrack.transforms.sort:Sort",
            "bytetrack": "mcaptrack.transforms.sort:ByteTrack",
            "ocsort": "mcaptrack.transforms.sort:OcSort",
            "ground": "mcaptrack.transforms.ground:GroundTracker",
        },
        "predictor": {
            "blend": "mcaptrack.predictors.red:blend",
            "red": "mcaptrack.predictors.red:red",
            "social": "mcaptrack.predictors.social:social",
            "cv": "mcaptrack.predictors.linear:cv",
            "holt-cv": "mcaptrack.predictors.linear:holt_cv",
            "kalman": "mcaptrack.predictors.linear:kalman",
            "lstm": "mcaptrack.predictors.lstm:lstm",
        },
        "retracker": {
            "likelihood": "mcaptrack.transforms.retrack:Retrack",
            "consistency": "mcaptrack.transforms.retrack:RetrackByConsistency",
        },
        # The default transform of each; mcaptrack.transforms.stages says the rest.
        "stage": {
            "detect": "mcaptrack.transforms.detect.median:MedianDetector",
            "motion": "mcaptrack.transforms.motion:EstimateMotion",
            "track": "mcaptrack.transforms.sort:Sort",
            "sample": "mcaptrack.transforms.sample:Sample",
            "predict": "mcaptrack.transforms.predict:Predict",
            "retrack": "mcaptrack.transforms.retrack:Retrack",
        },
        "label_format": {
            "mot": f"{_LABELS}.mot:Mot",
            "sdd": f"{_LABELS}.sdd:Sdd",
            "trajnet": f"{_LABELS}.positions:Trajnet",
            "obsmat": f"{_LABELS}.positions:Obsmat",
            "csv": f"{_LABELS}.delimited:Csv",
            "records": f"{_LABELS}.records:Records",
        },
        # By the name of the type of message, as in ROS 1 and Foxglove: drawings. Others are read by their fields.
        "message_reader": {
            "foxglove.SceneUpdate": f"{_SOLIDS}:scene_solids",
            "visualization_msgs/MarkerArray": f"{_SOLIDS}:marker_solids",
            "visualization_msgs/Marker": f"{_SOLIDS}:marker_solids",
        },
        "exporter": {
            **dict.fromkeys(("parquet", "arrow", "csv", "jsonl"), "mcaptrack.tables.export:export"),
            "mot": "mcaptrack.sources.box_files:MotFile",
        },
        # What is made of the results of stages at the end of a run.
        "finisher": {"events": "mcaptrack.pipeline.events:Watch"},
        "command": {name: f"{_MODULES[name]}:{name}" for name in _COMMANDS.split()}
        | {"docs": "mcaptrack.cli.docs:documentation"},
        "page": {"tables": "mcaptrack.api.viewing:tables_page"},
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
        The class; a predictor may be a function that returns one, and a command is a function.
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
        """Whether it is a part of mcaptrack, in the core or in an extension."""
        return self.distribution == _OWN and ":" not in self.name

    def __str__(self) -> str:
        """Its name in messages: ``tracker nearest (my-package 1.0)``."""
        return titled(self.kind, self.name, ("", "") if self.is_built_in else (self.distribution, self.version))

    def made(self, *methods: str) -> Any:
        """An object of the class, with these methods. Raises McaptrackError if it can't be made, or lacks one."""
        with blamed(self, "could not be made"):
            instance = self.cls()
        for method in methods:
            if not callable(getattr(instance, method, None)):
                raise McaptrackError(f"{self} has no method {method}, so it is no {in_words(self.kind)}")
        return instance


def in_words(kind: str) -> str:
    """A kind in messages: "label format"."""
    return kind.replace("_", " ")


def titled(kind: str, name: str, package: tuple[str, str] = ("", "")) -> str:
    """An entry in messages: ``tracker nearest (my-package 1.0)``, by its kind, its name, and package and version."""
    return f"{in_words(kind)} {name}" + (f" ({' '.join(package).strip()})" if any(package) else "")


def _a(noun: str) -> str:
    """The article of a noun."""
    return "an" if noun[0].lower() in "aeiou" else "a"


def _group(kind: str) -> str:
    """The group of entry points of a kind."""
    return f"{_OWN}.{kind}s"


def names(kind: Kind) -> tuple[str, ...]:
    """All names of a kind: built-in ones, then those of entry points. Imports nothing."""
    return (*BUILT_IN[kind], *sorted({point.name for point in points(kind)}))


def own(kind: Kind) -> dict[str, str]:
    """Module and class of what mcaptrack itself has of a kind, in the core and in extensions, by name."""
    return {**BUILT_IN[kind], **{point.name: point.value for point in sorted(points(kind)) if point.is_own}}


def points(kind: Kind) -> tuple[Point, ...]:
    """The entry points of a kind; those with a name that is taken don't count."""
    return _points(kind, declared())


@lru_cache(maxsize=64)
def _points(kind: Kind, _: Declared) -> tuple[Point, ...]:
    return tuple(point for point, owner in _owners(kind) if not owner)


def ignored(kind: Kind) -> dict[str, str]:
    """Why entry points of a kind don't count, by their title. Imports nothing."""
    owners = {titled(kind, point.name, point.package): owner for point, owner in _owners(kind)}
    return {what: f"{what} is ignored: there is {owner}; rename it" for what, owner in owners.items() if owner}


def strays() -> dict[str, str]:
    """Why entry points of groups that there are not don't count, by their title. Imports nothing."""
    groups = {_group(kind) for kind in KINDS}
    out = {}
    for point in declared().points:
        if point.group not in groups:
            what = titled("entry_point", point.name, point.package)
            hint = did_you_mean(point.group, groups) or f"there are {', '.join(sorted(groups))}"
            out[what] = f"{what} is ignored: {point.group} is no group of entry points; {hint}".rstrip()
    return out


def _owners(kind: Kind) -> Iterator[tuple[Point, str]]:
    """Each entry point of a kind, and the entry that has its name already: a built-in one, one of an extension, or a
    command; "" if none.
    """
    listed = entry_points(_group(kind))
    own = {point.name for point in listed if point.is_own}
    commands = names("command") if kind == "stage" else BUILT_IN["command"] if kind == "finisher" else ()
    for point in listed:
        if point.name in BUILT_IN[kind] or (point.name in own and not point.is_own):
            yield point, f"a built-in {titled(kind, point.name)}"
        else:
            yield point, f"a {titled('command', point.name)}" if point.name in commands else ""


def split_file(kind: Kind, name: str) -> tuple[str, str | None]:
    """A name, and the file that it ends with: ("red", "FILE") for "red:FILE", and None for names without a file.

    A name of the registry, or of an extension that isn't installed, has a file behind its colon; others are
    ``module:Class``.
    """
    own, colon, file = name.partition(":")
    return (own, file) if colon and own in (*names(kind), *missing_names(kind)) else (name, None)


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
        implementation = load(titled(kind, name), BUILT_IN[kind][name])
        return Entry(name, kind, implementation, implementation.__module__, _OWN, __version__)
    if ":" in name:
        with _working_folder():
            implementation = load(titled(kind, name), name)
        return Entry(name, kind, implementation, implementation.__module__, *distribution_of(implementation.__module__))
    named = [point for point in points(kind) if point.name == name]
    if not named:
        raise McaptrackError(missing_extension(name, kind) or _unknown(kind, name))
    named = [point for point in named if point.package[0] == distribution] or named
    if len(named) > 1:
        values = " and ".join(sorted(f"{point.value} ({' '.join(point.package)})" for point in named))
        what = f"{_a(kind)} {titled(kind, name)}"
        hint = "remove one of them" if kind in _BY_ENTRY_POINT else "name one as module:Class"
        raise McaptrackError(f"several installed packages have {what}: {values}; {hint}")
    package = (_OWN, __version__) if named[0].is_own else named[0].package
    implementation = load(titled(kind, name, package), named[0].value)
    return Entry(name, kind, implementation, implementation.__module__, *package)


def entry_of(kind: str, cls: type) -> Entry:
    """The entry of a class: built-in, of an entry point, or else ``module:Class``.

    A subclass of a built-in class is not built in.
    """
    built_in = BUILT_IN.get(kind, {})
    for name, where in built_in.items():
        if where.partition(":")[2] == cls.__qualname__ and load(name, where) is cls:
            return Entry(name, kind, cls, cls.__module__, _OWN, __version__)
    top = cls.__module__.partition(".")[0]
    for point in entry_points(_group(kind)):
        same_package = point.value.partition(":")[0].partition(".")[0] == top
        if same_package and point.name not in built_in and _is(point, cls):
            return Entry(point.name, kind, cls, cls.__module__, *point.package)
    return Entry(f"{cls.__module__}:{cls.__qualname__}", kind, cls, cls.__module__, *distribution_of(cls.__module__))


def others(kind: Kind) -> tuple[str, ...]:
    """The names of the entry points of a kind. Imports nothing."""
    return names(kind)[len(BUILT_IN[kind]) :]


def is_installed(kind: Kind, name: str) -> bool:
    """Whether a name is built in or of an entry point: only these are imported because a log names them."""
    return name in names(kind)


@contextmanager
def blamed(entry: Entry, what: str, guard: Guard | None = None) -> Iterator[None]:
    """Run the code of another package: whatever it raises becomes a McaptrackError that names it.

    What it changes in this process is undone, with a warning; ``guard`` remembers that for all calls of one object.
    Interruptions pass as they are: Ctrl-C, and the exit that a signal asks for. Nothing is caught of our own code.

    ``entry`` names the package, and ``what`` says what failed, as in "can't read FILE".
    """
    if entry.is_built_in:
        yield
        return
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


def of_type(entry: Entry, value: Any, wanted: type[T], function: str) -> T:
    """Return what a function of an entry gave, if it is of this type. Raises McaptrackError, with both types.

    ``value`` is what it gave and ``wanted`` the type; ``function`` names the function in the message.
    """
    if not isinstance(value, wanted):
        gave, kind = type(value).__name__, wanted.__name__
        raise McaptrackError(f"{entry} gave {_a(gave)} {gave}; {function} has to give {_a(kind)} {kind}")
    return value


def answer_of(entry: Entry, wanted: type[T], name: str, function: Callable[..., Any], *arguments: object) -> T:
    """Return what a function of an entry, ``name``, gives. Raises McaptrackError if it fails, or gives another type."""
    with blamed(entry, "failed"):
        gave = function(*arguments)
    return of_type(entry, gave, wanted, name)


def is_interruption(error: BaseException) -> bool:
    """Whether this ends the process from outside: Ctrl-C or a signal, and not ``sys.exit`` in the code of others."""
    return isinstance(error, KeyboardInterrupt) or (isinstance(error, SystemExit) and error.code in _SIGNALLED)


def failure(entry: Entry, what: str, error: BaseException) -> McaptrackError:
    """An exception of the code of another package, as one line with the entry and the place in its source."""
    if isinstance(error, McaptrackError):
        return McaptrackError(f"{entry}: {error}")
    return McaptrackError(f"{entry} {what}: {_words(error)}{_where(error)}")


def _where(error: BaseException) -> str:
    """The last place in the code of another package that an exception passed, as in " (speeds.py, line 3)"."""
    if isinstance(error, SyntaxError):
        return ""  # its text names the place
    places = [(Path(frame.filename), frame.lineno) for frame in extract_tb(error.__traceback__)]
    theirs = [
        f" ({path.name}, line {number})"
        for path, number in places
        if _FOLDER not in path.parents and path.parent.name != "importlib" and not path.name.startswith("<frozen")
    ]
    return theirs[-1] if theirs else ""


def _words(error: BaseException) -> str:
    try:
        if isinstance(error, McaptrackError):
            return str(error)
        return " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
    except Exception:  # an exception of others that can't even be printed
        return type(error).__name__


def _is(point: Point, cls: type) -> bool:
    try:
        return load(f"the package of {point.name}", point.value) is cls
    except McaptrackError:  # an entry point that can't be imported is another class
        return False


def load(what: str, reference: str) -> Any:
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
        raise McaptrackError(f"{what} can't be imported: {_words(error)}{_where(error)}") from error
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
    all_names, unreadable, what = names(kind), declared().unreadable, in_words(kind)
    choices = f"there are {', '.join(all_names)}" if all_names else f"no {what} is built in or installed"
    return (
        f"no {what} is called {name:.80}; {did_you_mean(name, all_names)}{choices}; an installed package gives more by "
        f"its entry points in {_OWN}.{kind}s, and module:Class names any class"
        + (f". The entry points of {', '.join(unreadable)} can't be read" if unreadable else "")
    )
