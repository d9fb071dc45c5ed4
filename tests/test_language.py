"""The words of the source and of the documentation are those of the field: see the house style in ARCHITECTURE.md."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
SOURCES = sorted((ROOT / "mcaptrack").rglob("*.py"))
PAGES = [
    *(ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "schemas").glob("*.proto")),
]
#: Riddles, and words with a term of the field: identity, predicted, synthetic, again.
WORDS = re.compile(r"\b(nobody|somebody|whose|whom|foret(old|ells?)|anew|who is who|made up)\b", re.IGNORECASE)
#: A summary names a thing or says what a function does.
OPENINGS = re.compile(r"(what|who|how)\b", re.IGNORECASE)
#: A name is a noun or a verb.
NAME_PARTS = {"what", "who", "whom", "whose", "how", "said", "told", "foretold", "anew", "nobody", "somebody"}


def words_of(text: str) -> list[str]:
    return [f"{number}: {line.strip()}" for number, line in enumerate(text.splitlines(), 1) if WORDS.search(line)]


def summaries(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield (ast.get_docstring(node) or "").partition("\n")[0]


def names(tree: ast.AST) -> Iterator[str]:
    """The names of functions and classes; and of attributes, which other modules use."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.name
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            yield node.target.id


def riddles(text: str) -> list[str]:
    tree = ast.parse(text)
    return [
        *words_of(text),
        *(summary for summary in summaries(tree) if OPENINGS.match(summary)),
        *(name for name in names(tree) if NAME_PARTS & set(name.lower().split("_"))),
    ]


def test_the_source_holds_no_riddles():
    assert len(SOURCES) > 200
    found = {str(path.relative_to(ROOT)): riddles(path.read_text(encoding="utf-8")) for path in SOURCES}
    assert {path: lines for path, lines in found.items() if lines} == {}


def test_the_documentation_holds_no_riddles():
    assert len(PAGES) > 20
    found = {str(path.relative_to(ROOT)): words_of(path.read_text(encoding="utf-8")) for path in PAGES}
    assert {path: lines for path, lines in found.items() if lines} == {}
