"""What extensions bring to the tests of the core: tables in tests/extensions/NAME/cases.py, as many as are there."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

EXTENSIONS = Path(__file__).parent / "extensions"


def of_extensions(table: str) -> dict[Any, Any]:
    """The entries of a table of this name in the cases of all extensions."""
    entries: dict[Any, Any] = {}
    for path in sorted(EXTENSIONS.glob("*/cases.py")):
        own = getattr(import_module(f"tests.extensions.{path.parent.name}.cases"), table, {})
        assert not entries.keys() & own.keys(), f"{path}: {table} has what another extension has"
        entries |= own
    return entries
