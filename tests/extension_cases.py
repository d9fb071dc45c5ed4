"""What extensions bring to the tests of the core: tables in tests/extensions/NAME/cases.py, as many as are there."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import mcaptrack

EXTENSIONS = Path(__file__).parent / "extensions"


def of_extensions(table: str) -> dict[Any, Any]:
    """The entries of a table of this name in the cases of all extensions."""
    entries: dict[Any, Any] = {}
    for path in sorted(EXTENSIONS.glob("*/cases.py")):
        own = getattr(import_module(f"tests.extensions.{path.parent.name}.cases"), table, {})
        assert not entries.keys() & own.keys(), f"{path}: {table} has what another extension has"
        entries |= own
    return entries


def is_gone(path: str) -> bool:
    """Whether this is a path of an extension that was taken away."""
    name = path.partition("extensions/")[2].partition("/")[0]
    return bool(name) and not (EXTENSIONS / name).is_dir()


def needs(*names: str) -> pytest.MarkDecorator:
    """Skip tests of what the core does for an extension, where its names in Python are gone."""
    return pytest.mark.skipif(not {*names} <= {*mcaptrack.__all__}, reason="an extension is gone")
