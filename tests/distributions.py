"""Packages that seem to be installed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path


def package(
    folder: Path, name: str, version: str, points: Mapping[str, Mapping[str, str]], modules: Iterable[str] = ()
) -> None:
    """What pip leaves of a package with these entry points; ``modules`` are its own, one of its name by default."""
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = [line for group, own in points.items() for line in (f"[{group}]", *(f"{k} = {v}" for k, v in own.items()))]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    (info / "top_level.txt").write_text("\n".join([*modules] or [name.replace("-", "_")]) + "\n")
