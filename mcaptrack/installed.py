"""Installed packages: the entry points that they declare, and the package that a module is of.

Entry points are read from the files that pip writes. ``importlib.metadata`` reads them, too, but its import takes
longer than all else that lists the commands. Extensions, the parts of mcaptrack that it can do without, declare
theirs in its own pyproject.toml.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Final, NamedTuple

_OWN: Final = "mcaptrack."
_EXTENSIONS: Final = f"{_OWN}extensions"
#: How the stub names an extension.
_PLACE: Final = rf"{re.escape(_EXTENSIONS)}\.(?P<extension>\w+)"
#: A folder with what pip says of a package, and the name of the package in it.
_INFO: Final = re.compile(r"(.+?)(-.*)?\.(dist|egg)-info")
_FILES: Final = ("METADATA", "PKG-INFO")


class Point(NamedTuple):
    """An entry point of an installed package: ``info`` is the folder with what pip says of the package."""

    group: str
    name: str
    value: str
    info: Path

    @property
    def package(self) -> tuple[str, str]:
        """Name and version of the package; "" for what its metadata lack."""
        return _name_and_version(self.info)

    @property
    def is_own(self) -> bool:
        """Whether it is of an extension, and not of the package of a stranger."""
        return _name_of(self.info.name) == _OWN[:-1]


class Declared(NamedTuple):
    """The entry points of all packages for mcaptrack, and the names of packages where they can't be read."""

    points: tuple[Point, ...]
    unreadable: tuple[str, ...]


def entry_points(group: str) -> list[Point]:
    """The entry points of a group, by package. Names with a colon, or that can't be printed, are left out."""
    points = [point for point in declared().points if point.group == group]
    return [point for point in points if ":" not in point.name and point.name.isprintable()]


def declared() -> Declared:
    """The entry points of all packages; kept until something is installed."""
    return _declared(_places())


def missing_extension(name: str, kind: str = "name", what: str = "") -> str:
    """Say what to do about a name that is of an extension which isn't installed; "" for other names.

    The stub for type checkers says which names those are, in Python and, in comments, of other kinds: it alone names
    extensions from outside. ``what`` is said in place of the name.
    """
    if (extension := _missing(kind).get(name)) is None:
        return ""
    text = f"{what or name} is an extension that isn't installed; install mcaptrack again, with mcaptrack/extensions/"
    return f"{text}{extension}"


def missing_extensions() -> dict[str, str]:
    """The advice about each extension that isn't installed, by name; "" for those that are."""
    present = _extensions()
    again = "isn't installed; install mcaptrack again, with mcaptrack/extensions/"
    return {name: "" if name in present else f"{again}{name}" for name in sorted({*re.findall(_PLACE, _stub())})}


def missing_names(kind: str) -> list[str]:
    """The names of a kind that are of extensions which aren't installed."""
    return [*_missing(kind)]


def missing_parts(kind: str) -> str:
    """Say which names of a kind extensions have that aren't installed, and what to do; "" if there are none."""
    missing = _missing(kind)
    folders = " and ".join(sorted({f"mcaptrack/extensions/{extension}" for extension in missing.values()}))
    names = ", ".join(missing)
    return f"{names} are of an extension that isn't installed; install mcaptrack again, with {folders}" if names else ""


def _missing(kind: str) -> dict[str, str]:
    """The extensions that aren't installed by the names of a kind that they have, by the stub."""
    in_python = kind in ("name", "command")
    line = rf"^from {_PLACE}\S* import (?P<name>\w+) as" if in_python else rf"^# {kind} (?P<name>\S+): {_PLACE}$"
    named = {match["name"]: match["extension"] for match in re.finditer(line, _stub(), re.M)}
    present = _extensions()
    return {name: extension for name, extension in named.items() if extension not in present}


def _stub() -> str:
    return Path(__file__).with_name("__init__.pyi").read_text(encoding="utf-8")


def _extensions() -> set[str]:
    """The extensions that are installed: the folder is there, and an entry point leads to it."""
    return {extension for point in declared().points if (extension := _extension_of(point))}


def _extension_of(point: Point) -> str:
    """The extension that an entry point of mcaptrack itself leads to; "" for others."""
    match = re.match(rf"{_PLACE}\b", point.value)
    return match["extension"] if match and point.is_own else ""


def _leads_somewhere(point: Point) -> bool:
    """Whether the extension of an own entry point is there, with more than what Python has compiled of it."""
    if not point.is_own:
        return True
    try:
        spec = find_spec(f"{_EXTENSIONS}.{name}") if (name := _extension_of(point)) else None
    except ModuleNotFoundError:  # the folder of all extensions
        return False
    return spec is not None and spec.origin is not None


def distribution_of(module: str) -> tuple[str, str]:
    """Name and version of the package of a module; "" and "" if unknown, as for those installed as editable."""
    from importlib import metadata

    names = _owners(_places()).get(module.partition(".")[0])
    return (names[0], metadata.version(names[0])) if names else ("", "")


def running_program() -> str:
    """The program that runs, without its place: its package with the version, or else the name of its script."""
    from importlib import metadata

    main = sys.modules.get("__main__")
    spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
    if spec is not None:
        module = str(spec.name).removesuffix(".__main__")
        return " ".join(filter(None, distribution_of(module))) or module
    if not file:
        return "a notebook" if "ipykernel" in sys.modules else "Python"
    script = Path(file)
    try:
        points = () if script.suffix else metadata.entry_points(group="console_scripts", name=script.name)
        package = next((f"{point.dist.name} {point.dist.version}" for point in points if point.dist), "")
    except Exception:  # metadata of another package that can't be read
        package = ""
    return package or "".join(character if character.isprintable() else "?" for character in script.name)


def _places() -> tuple[tuple[str, int], ...]:
    """The folders of ``sys.path`` and when each last changed: they tell whether something was installed."""
    return tuple((place, _changed_ns(place)) for place in sys.path)


def _changed_ns(place: str) -> int:
    """The time when a folder of ``sys.path`` last gained or lost an entry; 0 if it is no folder."""
    try:
        return os.stat(place or ".").st_mtime_ns
    except OSError:
        return 0


@lru_cache(maxsize=4)
def _owners(_places: tuple[tuple[str, int], ...]) -> Mapping[str, list[str]]:
    """The packages of each top-level module; kept until something is installed, for it reads all metadata."""
    from importlib import metadata

    try:
        return metadata.packages_distributions()
    except Exception:  # metadata of another package that can't be read
        return {}


@lru_cache(maxsize=4)
def _declared(places: tuple[tuple[str, int], ...]) -> Declared:
    points: list[Point] = []
    unreadable: list[str] = []
    for info in _packages(place for place, _ in places):
        try:
            data = (info / "entry_points.txt").read_bytes()
        except OSError:
            continue  # most packages have none
        if _OWN.encode() not in data:
            continue
        try:
            declared = [Point(*entry, info) for entry in _entries(data.decode()) if entry[0].startswith(_OWN)]
        except ValueError:
            unreadable.append(_name_and_version(info)[0])
            continue
        points += filter(_leads_somewhere, declared)
    return Declared(tuple(points), tuple(unreadable))


def _packages(places: Iterator[str]) -> Iterator[Path]:
    """The folders with what pip says of each package. Of two packages of one name the first counts, as for imports."""
    names: set[str] = set()
    for place in places:
        try:
            entries = sorted(os.listdir(place or "."))
        except OSError:
            continue
        for entry in entries:
            name = _name_of(entry)
            if name and name not in names:
                names.add(name)
                yield Path(place, entry)


def _name_of(info: str) -> str:
    """The name of the package that a folder is about; "" for other folders."""
    match = _INFO.fullmatch(info)
    return re.sub(r"[-_.]+", "-", match[1]).lower() if match else ""


def _entries(text: str) -> Iterator[tuple[str, str, str]]:
    """Group, name and value of each line. Raises ValueError for a line that is none."""
    group = ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("[") and line.endswith("]"):
            group = line[1:-1].strip()
        elif line and not line.startswith(("#", ";")):
            name, equals, value = line.partition("=")
            if not (group and equals and name.strip()):
                raise ValueError(line)
            yield group, name.strip(), value.strip()


@lru_cache(maxsize=256)
def _name_and_version(info: Path) -> tuple[str, str]:
    """Name and version in the metadata of a package; "" for what they lack."""
    headers: dict[str, str] = {}
    for file in _FILES:
        try:
            text = (info / file).read_text(encoding="utf-8", errors="replace")
        except OSError:
            continue
        for line in text.splitlines():
            if not line.strip():
                break  # the description follows
            name, _, value = line.partition(":")
            headers.setdefault(name.strip(), value.strip())
        break
    return headers.get("Name", ""), headers.get("Version", "")
