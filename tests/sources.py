"""The texts in the source of the package."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "mcaptrack"


def texts(path: Path, with_help: bool = False) -> Iterator[tuple[str, str]]:
    """The place and the value of each string of a module but docstrings; help of options only if it is asked for."""
    nodes = [*ast.walk(ast.parse(path.read_text("utf-8")))]
    left_out = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    if not with_help:
        helping = [node for node in nodes if isinstance(node, ast.keyword) and node.arg == "help"]
        helping += [
            node
            for node in nodes
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("option", "setting")
        ]
        left_out |= {id(part) for node in helping for part in ast.walk(node)}
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in left_out:
            yield f"{path.relative_to(PACKAGE)}:{node.lineno}", node.value
