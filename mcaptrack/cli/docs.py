"""``mcaptrack docs``: show the documentation that is installed with the package."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

from mcaptrack.api.declared import Argument, declared
from mcaptrack.cli import common
from mcaptrack.cli.declared import Once
from mcaptrack.cli.generated import PARTS, with_parts
from mcaptrack.cli.text import console, show
from mcaptrack.errors import McaptrackError, did_you_mean

Pages = dict[str, Path]


@declared(heading="Improve and repair", printed_by="mcaptrack.cli.docs:Docs")
def documentation(
    page: Annotated[str | None, Argument("page", "PAGE", "The page to print.", shown="a list of the pages")] = None,
) -> Pages:
    """List the pages of the documentation, or print one.

    The pages are installed with mcaptrack and describe its version. A pipe or a file gets their Markdown.

    Parameters
    ----------
    page : str, optional
        The page.

    Returns
    -------
    dict of str to pathlib.Path
        The pages by name: those in the installed package, or those beside it in a checkout; or one of them.

    Raises
    ------
    McaptrackError
        If there is no such page.

    Examples
    --------
    On the command line:

        mcaptrack docs

        mcaptrack docs tables
    """
    package = Path(__file__).resolve().parent.parent
    folder, beside = package / "docs", []
    if not folder.is_dir():
        folder, beside = package.parent / "docs", [package.parent / f"{name}.md" for name in ("README", "CHANGELOG")]
    paths = [*beside, *folder.glob("*.md"), *folder.glob("extensions/*.md")]
    paths.sort(key=lambda path: (path.stem != "README", path.stem.lower()))
    pages = {path.stem.lower(): path for path in paths}
    if page is None:
        return pages
    name = Path(page).name.lower().removesuffix(".md")
    if name not in pages:
        about = " or ".join(each for each, path in pages.items() if name in _title(path).lower())
        hint = f"did you mean {about}? " if about else did_you_mean(name, pages)
        raise McaptrackError(f"there is no page {page}; {hint}{'There' if hint else 'there'} are {', '.join(pages)}")
    return {name: pages[name]}


class Docs(Once[Pages]):
    """List the pages, or print one."""

    def data(self, done: Pages) -> dict[str, Any]:
        """Return the list, or the page, as values of JSON."""
        titles = [{"name": name, "title": _title(path)} for name, path in done.items()]
        return {"pages": titles} if self.values["page"] is None else {**titles[0], "text": _text(done)}

    def show(self, done: Pages, talk: common.Talk) -> None:
        """Print the list; or the page, on a terminal with its headings and tables."""
        if self.values["page"] is None:
            width = max(map(len, done)) + 2
            show(*(f"{name:<{width}}{_title(path)}" for name, path in done.items()))
        elif sys.stdout.isatty():
            from rich.markdown import Markdown

            console().print(Markdown(_text(done)))
        else:
            show(*_text(done).splitlines())


def _text(done: Pages) -> str:
    (path,) = done.values()
    return with_parts(path.read_text(encoding="utf-8"), PARTS)


def _title(path: Path) -> str:
    """Return the first heading of a page."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return next((line.lstrip("# ") for line in lines if line.startswith("# ")), path.stem)
