"""The words of the source and of the documentation are those of the field: see the house style in ARCHITECTURE.md."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from mcaptrack.transforms import STAGES

ROOT = Path(__file__).parent.parent
SOURCES = sorted((ROOT / "mcaptrack").rglob("*.py"))
PAGES = [
    *(ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "schemas").glob("*.proto")),
]
#: Riddles, and words with a term of the field: identity, predicted, synthetic, again.
WORDS = re.compile(r"\b(nobody|somebody|whose|whom|foret(old|ells?)|anew|who is who|made up)\b", re.IGNORECASE)
#: A summary names a thing or says what a function does.
OPENINGS = re.compile(r"(what|who|how)\b", re.IGNORECASE)
#: A name is a noun or a verb.
NAME_PARTS = {"what", "who", "whom", "whose", "how", "said", "told", "foretold", "anew", "nobody", "somebody"}


def words_of(text: str) -> list[str]:
    lines = enumerate(text.splitlines(), 1) if WORDS.search(text) else ()
    return [f"{number}: {line.strip()}" for number, line in lines if WORDS.search(line)]


def riddles(text: str) -> Iterator[str]:
    """Lines, summaries and names that are none: of functions and classes, and of attributes, which other modules use."""
    yield from words_of(text)
    for node in ast.walk(ast.parse(text)):
        name = ""
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            name = node.name
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            name = node.attr
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            name = node.target.id
        if NAME_PARTS & set(name.lower().split("_")):
            yield name
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            summary = (ast.get_docstring(node, clean=False) or "").lstrip().partition("\n")[0]
            if OPENINGS.match(summary):
                yield summary


def test_the_source_holds_no_riddles():
    assert len(SOURCES) > 200
    found = {str(path.relative_to(ROOT)): [*riddles(path.read_text(encoding="utf-8"))] for path in SOURCES}
    assert {path: lines for path, lines in found.items() if lines} == {}


def test_the_documentation_holds_no_riddles():
    assert len(PAGES) > 20
    found = {str(path.relative_to(ROOT)): words_of(path.read_text(encoding="utf-8")) for path in PAGES}
    assert {path: lines for path, lines in found.items() if lines} == {}


# Names in the source: each public class has its own; no stage is special-cased by name.


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
