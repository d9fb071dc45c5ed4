"""One name, one thing: no two public classes of the package have the same name."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "mcaptrack"


def public_classes() -> dict[str, list[str]]:
    """The modules that define each public class; a re-export is no definition."""
    found = defaultdict(list)
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found[node.name].append(str(path.relative_to(PACKAGE)))
    return found


def test_no_two_public_classes_have_the_same_name():
    found = public_classes()
    assert len(found) > 100
    assert {name: places for name, places in found.items() if len(places) > 1} == {}
