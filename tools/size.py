"""Print how large the package and its tests are: code lines, files, options and test lines, by room.

Code lines hold something else than a docstring, a comment or nothing. Options are those of all commands.

.venv/bin/python tools/size.py
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections import Counter
from pathlib import Path

from typer.main import get_command

from mcaptrack.cli import app

ROOT = Path(__file__).parent.parent
_SILENT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def code_lines(source: str) -> int:
    """Number of lines of a module with code."""
    lines = {
        number
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type not in _SILENT
        for number in range(token.start[0], token.end[0] + 1)
    }
    for node in ast.walk(ast.parse(source)):
        is_documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if is_documented and ast.get_docstring(node, clean=False) is not None:
            lines -= set(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    return len(lines)


def options() -> Counter[str]:
    """Number of options of all commands, shown and hidden."""
    counts: Counter[str] = Counter()
    for command in get_command(app).commands.values():  # type: ignore[attr-defined]
        for parameter in command.params:
            if parameter.param_type_name == "option":
                counts["hidden" if parameter.hidden else "shown"] += 1
    return counts


def main() -> None:
    lines: Counter[str] = Counter()
    files: Counter[str] = Counter()
    for path in (ROOT / "mcaptrack").rglob("*.py"):
        inside = path.relative_to(ROOT / "mcaptrack").parts
        room = inside[0] if len(inside) > 1 else "(top)"
        room = "/".join(inside[:2]) if room == "extensions" and len(inside) > 2 else room
        lines[room] += code_lines(path.read_text())
        files[room] += 1
    print(f"{'room':<24}{'code lines':>12}{'files':>8}")
    for is_extension in (False, True):
        rooms = [room for room, _ in lines.most_common() if room.startswith("extensions") is is_extension]
        for room in rooms:
            print(f"{room:<24}{lines[room]:>12}{files[room]:>8}")
        name = "all extensions" if is_extension else "the core"
        print(f"{name:<24}{sum(lines[room] for room in rooms):>12}{sum(files[room] for room in rooms):>8}")
    print(f"{'all':<24}{lines.total():>12}{files.total():>8}")
    for folder in ("tests", "tools"):
        sources = [path.read_text() for path in (ROOT / folder).rglob("*.py")]
        every_line = sum(len(source.splitlines()) for source in sources)
        print(f"{folder:<24}{sum(map(code_lines, sources)):>12}{len(sources):>8}   ({every_line} lines with text)")
    shown, hidden = options()["shown"], options()["hidden"]
    print(f"options: {shown + hidden}, {hidden} of them hidden")


if __name__ == "__main__":
    main()
