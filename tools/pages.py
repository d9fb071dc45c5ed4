"""The pages of the documentation as blocks of code: which there are, and which of them are run.

A block is marked by a comment on the line before it:

``<!-- not run: WHY -->``
    The block isn't executed; WHY is one of ``NOT_RUN``. It is parsed, and the commands in it must exist.
``<!-- file: NAME -->``
    The block is the content of a file, which commands further down on the page use.
``<!-- exit: CODE -->``
    The commands of the block end with this exit code.

A ``text`` block right below a block that is executed is what that one prints; ``...`` stands for anything.
Uses the standard library alone, because ``tools/readme.py`` runs before anything is installed.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
#: Reasons for not running a block.
NOT_RUN = {
    "docker": "it needs Docker",
    "environment": "it changes the Python environment",
    "minutes": "it takes minutes",
    "store": "it needs a bucket and its credentials",
    "torch": "it needs torch, several gigabytes",
    "viewer": "it waits for a viewer",
    "weights": "it needs weights of a network, which are fetched",
    "reference data": "it needs recordings whose licences don't let them come along",
}
#: Languages of blocks; text is output.
LANGUAGES = ("sh", "python", "sql", "toml", "json", "text")
_MARK = re.compile(r"<!-- (not run|file|exit): (.+?) -->")


class Block(NamedTuple):
    """A fenced block: where it begins, its language, its text, and its marks by kind."""

    page: str
    line: int
    language: str
    text: str
    marks: dict[str, str]

    @property
    def place(self) -> str:
        """Where it stands, as editors take it."""
        return f"{self.page}:{self.line}"


def pages() -> list[Path]:
    """All pages: the README and everything below docs/."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def with_links_that_lead(text: str) -> str:
    """A page in which links to pages of extensions that aren't there are text."""

    def link(match: re.Match[str]) -> str:
        return match[0] if (ROOT / "docs" / "extensions" / match[2]).exists() else match[1]

    return re.sub(r"\[([^\]]+)\]\((?:[\w./]*/)?extensions/(\w+\.md)[^)]*\)", link, text)


def blocks(path: Path) -> list[Block]:
    """The fenced blocks of a page, in order. Raises ValueError for a fence without an end or a mark without a block."""
    name = path.relative_to(ROOT).as_posix()
    found: list[Block] = []
    marks: dict[str, str] = {}
    begun: tuple[int, str, str] | None = None
    lines: list[str] = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        fence = re.match(r"( *)(```+)(.*)$", line)
        if begun is None and fence:
            begun, lines = (number, fence[2], fence[3].strip()), []
        elif begun is not None and fence and fence[2] == begun[1] and not fence[3].strip():
            indent = len(fence[1])
            text = "".join(f"{one[indent:]}\n" for one in lines)
            found.append(Block(name, begun[0], begun[2], text, marks))
            begun, marks = None, {}
        elif begun is not None:
            lines.append(line)
        elif mark := _MARK.fullmatch(line.strip()):
            marks = marks | {mark[1]: mark[2]}
        elif line.strip() and marks:
            raise ValueError(f"{name}:{number}: a mark stands above something that is no block")
    if begun is not None or marks:
        raise ValueError(f"{name}: the last block or mark has no end")
    return found
