"""Names in the source: each public class has its own; no stage is special-cased by name."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from pathlib import Path

from mcaptrack.transforms import STAGES

PACKAGE = Path(__file__).parent.parent / "mcaptrack"


def public_classes() -> dict[str, list[str]]:
    """The modules that define each public class; a re-export is no definition."""
    found = defaultdict(list)
    for path in sorted(PACKAGE.rglob("*.py")):
        for name in re.findall(r"^class ([A-Za-z]\w*)", path.read_text(), re.MULTILINE):
            found[name].append(str(path.relative_to(PACKAGE)))
    return found


def test_no_two_public_classes_have_the_same_name():
    found = public_classes()
    assert len(found) > 100
    assert {name: places for name, places in found.items() if len(places) > 1} == {}


def compared_names(tree: ast.AST) -> list[tuple[int, str]]:
    """Lines and texts that a comparison or a ``match`` tests for, also as members of a collection."""
    tested = [
        part for node in ast.walk(tree) if isinstance(node, ast.Compare) for part in (node.left, *node.comparators)
    ]
    tested += [node.value for node in ast.walk(tree) if isinstance(node, ast.MatchValue)]
    members = [each for part in tested for each in (part.elts if hasattr(part, "elts") else [part])]
    return [(one.lineno, one.value) for one in members if isinstance(one, ast.Constant) and isinstance(one.value, str)]


def test_no_stage_is_special_cased_by_name_outside_of_transforms():
    """What sets a stage apart is declared: by its attributes, and by the schemas of its transform."""
    texts = {path.relative_to(PACKAGE): path.read_text() for path in sorted(PACKAGE.rglob("*.py"))}
    found = [
        f"{path}:{line}: {name}"
        for path, text in texts.items()
        if path.parts[0] != "transforms" and any(f'"{name}"' in text for name in STAGES)
        for line, name in compared_names(ast.parse(text))
        if name in STAGES
    ]
    assert found == []
