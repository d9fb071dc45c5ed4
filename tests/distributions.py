"""Packages that seem to be installed."""

from __future__ import annotations

from pathlib import Path


def package(folder: Path, name: str, version: str, group: str, points: dict[str, str]) -> None:
    """What pip leaves of a package that has entry points."""
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = [f"{key} = {value}" for key, value in points.items()]
    (info / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines]) + "\n")
    (info / "top_level.txt").write_text(name.replace("-", "_") + "\n")
