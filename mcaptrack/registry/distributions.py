"""Installed packages: their entry points, and which of them a module is of."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import lru_cache
from importlib import metadata
from importlib.metadata import Distribution, EntryPoint
from pathlib import Path


def distribution_of(module: str) -> tuple[str, str]:
    """Name and version of the distribution of a module; "" and "" if unknown, as for those installed as editable."""
    names = _owners(_places()).get(module.partition(".")[0])
    return (names[0], metadata.version(names[0])) if names else ("", "")


def entry_points(group: str, unreadable: list[str] | None = None) -> list[EntryPoint]:
    """The entry points of a group.

    Packages with entry points that can't be read are left out; their names are added to ``unreadable``.
    """
    found, failed = _declared(_places(), group)
    if unreadable is not None:
        unreadable += failed
    return [point for point in found if ":" not in point.name]


def package_of(point: EntryPoint) -> tuple[str, str]:
    """Name and version of the distribution that declares an entry point."""
    return _name_and_version(point.dist)


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
        found: list[EntryPoint] = []
        failed: list[str] = []
    for distribution in metadata.distributions():
        try:
            found += [point for point in distribution.entry_points if point.group == group]
        except Exception:
            failed.append(_name_and_version(distribution)[0])
    return found, failed


def _name_and_version(distribution: Distribution | None) -> tuple[str, str]:
    """Name and version of a distribution; "" for what its metadata lack."""
    try:
        fields = distribution.metadata if distribution is not None else None
        # some versions of importlib raise an error at fields["Name"] where it is missing
        name, version = (fields.get_all(name, [""])[0] if fields else "" for name in ("Name", "Version"))
    except Exception:  # metadata that can't be read
        return "", ""
    return name or "", version or ""
