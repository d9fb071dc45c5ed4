"""``mcaptrack docs``: show the documentation that is installed with the package."""

from __future__ import annotations

import sys
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated

import typer

from mcaptrack.cli import common
from mcaptrack.cli.generated import PARTS, with_parts
from mcaptrack.cli.text import console, show
from mcaptrack.errors import McaptrackError


@common.one_line
def docs(
    page: Annotated[
        str | None, typer.Argument(metavar="[PAGE]", help="The page to print.", show_default="a list of the pages")
    ] = None,
    output: common.Printed = None,
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """List the pages of the documentation, or print one.

    The pages are installed with mcaptrack and describe its version. A pipe or a file gets their Markdown.

    Example: mcaptrack docs

    Example: mcaptrack docs tables
    """
    pages = documentation()
    if page is None:
        titles = {name: _title(path) for name, path in pages.items()}
        with common.printed_to(output, force):
            if json:
                common.print_json({"pages": [{"name": name, "title": title} for name, title in titles.items()]})
            else:
                width = max(map(len, titles)) + 2
                show(*(f"{name:<{width}}{title}" for name, title in titles.items()))
        return
    name = Path(page).name.lower().removesuffix(".md")
    if name not in pages:
        near = get_close_matches(name, pages, 1)
        raise McaptrackError(
            f"there is no page {page}; {f'did you mean {near[0]}? ' if near else ''}There are {', '.join(pages)}"
        )
    text = with_parts(pages[name].read_text(encoding="utf-8"), PARTS)
    with common.printed_to(output, force):
        if json:
            common.print_json({"name": name, "title": _title(pages[name]), "text": text})
        elif output is None and sys.stdout.isatty():
            from rich.markdown import Markdown

            console().print(Markdown(text))
        else:
            show(*text.splitlines())


def documentation() -> dict[str, Path]:
    """Return the pages by name: those in the installed package, or those beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "docs"
    pages = [path for path in package.parent.glob("*.md") if path.stem in ("README", "CHANGELOG")]
    shown = inside.glob("*.md") if inside.is_dir() else [*pages, *(package.parent / "docs").glob("*.md")]
    return {
        path.stem.lower(): path for path in sorted(shown, key=lambda path: (path.stem != "README", path.stem.lower()))
    }


def _title(path: Path) -> str:
    """Return the first heading of a page."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return next((line.lstrip("# ") for line in lines if line.startswith("# ")), path.stem)
