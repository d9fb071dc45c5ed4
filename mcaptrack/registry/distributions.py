"""Installed packages: their entry points, and which of them a module is of."""

from __future__ import annotations

import json
import re
import sys
from functools import lru_cache
from importlib.metadata import Distribution, EntryPoint, distributions
from pathlib import Path
from urllib.parse import urlsplit


def distribution_of(module: str) -> tuple[str, str]:
    """Name and version of the distribution of a module; "" and "" if unknown."""
    found = _installed(_places(), module.partition(".")[0])
    return _name_and_version(_editable(module) if found is None else found)


def _editable(module: str) -> Distribution | None:
    """The distribution of an imported module that was installed from its folder by ``pip install --editable``.

    The modules of such a distribution are not listed in its metadata: ``direct_url.json`` says where they lie, and they
    are imported from there, or from a folder in it, such as src.
    """
    file = getattr(sys.modules.get(module.partition(".")[0]), "__file__", None)
    if file is None:
        return None
    path = Path(file).resolve()
    place = path.parent.parent if path.stem == "__init__" else path.parent
    return next((found for found in distributions() if _project(found) in (place, place.parent)), None)


def _project(distribution: Distribution) -> Path | None:
    """The folder that a distribution was installed from, if it is used there; None for others."""
    from urllib.request import url2pathname

    try:
        source = json.loads(distribution.read_text("direct_url.json") or "{}")
        is_used_there = source.get("dir_info", {}).get("editable")
        return Path(url2pathname(urlsplit(source["url"]).path)).resolve() if is_used_there else None
    except Exception:  # metadata that can't be read
        return None


def _places() -> tuple[tuple[str, int], ...]:
    """The folders of ``sys.path`` and when each last changed: they tell whether something was installed."""
    return tuple((place, _changed_ns(place)) for place in sys.path)


def _changed_ns(place: str) -> int:
    """The time when a folder of ``sys.path`` last gained or lost an entry; 0 if it is no folder."""
    try:
        return Path(place or ".").stat().st_mtime_ns
    except OSError:
        return 0


@lru_cache(maxsize=32)
def _installed(_places: tuple[tuple[str, int], ...], top: str) -> Distribution | None:
    """The distribution that installed a top-level module, by its metadata; kept until something is installed.

    ``importlib.metadata.packages_distributions`` would parse the metadata and all files of every distribution.
    """
    return next((one for one in distributions() if _has_module(one, top) and _name(one)), None)


def _has_module(distribution: Distribution, top: str) -> bool:
    """Whether a distribution installed a top-level module, by what it declares, or else by its list of files."""
    try:
        declared = (distribution.read_text("top_level.txt") or "").split()
        files = distribution.read_text("RECORD") or ""
    except Exception:  # metadata of another package that can't be read
        return False
    return top in declared if declared else bool(re.search(rf"^{re.escape(top)}(/[^,\n]*)?\.py,", files, re.MULTILINE))


def _name_and_version(distribution: Distribution | None) -> tuple[str, str]:
    """Name and version of a distribution; "" for what its metadata lack."""
    if distribution is None:
        return "", ""
    try:
        fields = distribution.metadata
        # some versions of importlib raise an error at fields["Name"] where it is missing
        name, version = (fields.get_all(name, [""])[0] for name in ("Name", "Version"))
    except Exception:  # metadata that can't be read
        return "", ""
    return name or "", version or ""


def entry_points(group: str, unreadable: list[str] | None = None) -> list[EntryPoint]:
    """The entry points of a group, without duplicates.

    Packages with entry points that can't be read are left out; their names are added to ``unreadable``.
    """
    found, failed = _declared(_places(), group)
    if unreadable is not None:
        unreadable += failed
    return list(found)


@lru_cache(maxsize=32)
def _declared(_places: tuple[tuple[str, int], ...], group: str) -> tuple[list[EntryPoint], list[str]]:
    """Entry points of a group, and packages with entry points that can't be read; kept until something is installed.

    A command asks several times for each of its stages, and each time all metadata would be read.
    """
    points = [(found, _points(found, group)) for found in distributions()]
    if not any(point is None or point for _, point in points):
        return [], []
    first: dict[str, tuple[str, list[EntryPoint] | None]] = {}
    for distribution, found in points:
        name = _name(distribution)
        key = name.lower().replace("-", "_") or f"{distribution!r}"
        first.setdefault(key, (name, found))  # the first one on the path is the one that is imported
    failed = [name for name, found in first.values() if found is None]
    return [point for _, found in first.values() for point in found or () if ":" not in point.name], failed


def _name(distribution: Distribution) -> str:
    """Name of a distribution; "" if its metadata lack it. Only their line is read: they may hold a long description."""
    try:
        text = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO") or ""
    except Exception:  # metadata that can't be read
        return ""
    found = re.search(r"^Name:[ \t]*(\S+)", text, re.MULTILINE)
    return found[1] if found else _name_and_version(distribution)[0]


def _points(distribution: Distribution, group: str) -> list[EntryPoint] | None:
    """The entry points of a group that a distribution declares; None if they can't be read."""
    try:
        return [point for point in distribution.entry_points if point.group == group]
    except Exception:  # whatever parsing raises
        return None


def package_of(point: EntryPoint) -> tuple[str, str]:
    """Name and version of the distribution that declares an entry point."""
    return _name_and_version(point.dist)
