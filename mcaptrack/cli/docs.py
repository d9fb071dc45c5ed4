"""``mcaptrack docs``: show the documentation that is installed with the package.

A page holds ``<!-- generated: NAME -->`` where a part of ``PARTS`` belongs that is written from declarations (options,
environment variables, tables); `mcaptrack docs` and the site put it there.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, get_args

from mcaptrack.api.declared import Argument, Parameter, declared, parameter_of
from mcaptrack.choices import limits
from mcaptrack.cli import common
from mcaptrack.cli.declared import Once
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


MARK = re.compile(r"<!-- generated: (\w+) -->")
_HEAD = "| option | values | default | meaning |\n|---|---|---|---|"
_KINDS = {bool: "yes or no", int: "whole number", float: "number", str: "text"}


def with_parts(page: str, parts: Mapping[str, Callable[[], str]]) -> str:
    """The text of a page with its generated parts. Raises KeyError for a part that there isn't."""
    return MARK.sub(lambda found: parts[found[1]](), page)


def environment() -> str:
    """The environment variables that are not options, as a table in Markdown."""
    from mcaptrack.environment import VARIABLES

    rows = (f"| `{name}` | {meaning} |" for name, meaning in VARIABLES.items())
    return "\n".join(["| variable | meaning |", "|---|---|", *rows])


def stage_options() -> str:
    """All parameters of stages, a table for each implementation with parameters of its own, as Markdown."""
    from mcaptrack.cli.chosen import has_flag, options_of
    from mcaptrack.cli.stages import hint_of
    from mcaptrack.transforms import STAGES

    sections = []
    for command, stage in STAGES.items():
        listed: set[str] = set()
        for name, kind in stage.built_in().items():
            rows = [
                _row(parameter_of(option, hint_of(kind, field), None), "" if has_flag(field) else f"--set {option}=")
                for option, field in options_of(kind).items()
                if option not in listed
            ]
            if not rows:
                continue
            heading = f"### {command}"
            if listed:
                heading += f", with `--{stage.kind} {name}` alone"
            elif stage.kind:
                names = " ".join(f"`{each}`" for each in stage.built_in())
                values = f"{names}, one of an installed package, or `module:Class`"
                rows.insert(0, f"| `--{stage.kind}` | {values} | {name} | The {stage.kind} to use |")
            listed |= options_of(kind).keys()
            sections.append("\n".join([heading, "", _HEAD, *rows]))
    return "\n\n".join(sections)


def _row(option: Parameter, name: str = "") -> str:
    """The row of an option; ``name`` is what it is called, if it is not by its flag."""
    ends = limits(option.option.least, option.option.most)
    values = " ".join(f"`{choice}`" for choice in get_args(option.kind)) or f"{_KINDS[option.kind]} {ends}".strip()
    default = option.shown if isinstance(option.shown, str) else option.default
    called = name or option.flags[0].partition("/")[0]
    return f"| `{called}` | {values} | {default} | {option.help.removesuffix('.')} |"


def other_numbers() -> str:
    """The options with numbers of commands that are no stages, as Markdown; those for many logs with `run` alone."""
    from mcaptrack.cli.group import Commands
    from mcaptrack.cli.many import NAMES
    from mcaptrack.transforms import STAGES

    sections = []
    for name, command in Commands().items():
        numbers = [option for option in command.parameters if option.kind in (int, float)]
        rows = [_row(option) for option in numbers if name == "run" or option.name not in NAMES]
        rows += [_row(option, f"--set {option.name}=") for option in command.set_parameters]
        if rows and name not in STAGES:
            sections.append("\n".join([f"### {name}", "", _HEAD, *rows]))
    return "\n\n".join(sections)


def tables() -> str:
    """All tables with their columns, as Markdown."""
    from mcaptrack.tables import TABLES

    sections = []
    for table in TABLES.values():
        key = ", ".join(f"`{name}`" for name in dict.fromkeys(("recording", *table.key)))
        order = f" Sorted by {', '.join(f'`{name}`' for name in table.order)}." if table.order else ""
        rows = []
        for field in table.arrow:
            about = {name.decode(): value.decode() for name, value in field.metadata.items()}
            kind = re.sub(r"^(string|dictionary<.*)$", "text", str(field.type))
            kind += ", may be null" if field.nullable else ""
            rows.append(f"| `{field.name}` | {kind} | {about['unit']} | {about['description']} |")
        head = ["| column | type | unit | meaning |", "|---|---|---|---|"]
        sections.append("\n".join([f"### {table.name}", "", table.doc, "", f"Key: {key}.{order}", "", *head, *rows]))
    return "\n\n".join(sections)


def class_limits() -> str:
    """The limits of motion of each class, as a table in Markdown."""
    from mcaptrack.transforms.motion_limits import LIMITS

    rows = (
        f"| {row.name} | {row.speed_m_per_s:g} | {row.max_speed_m_per_s:g} | {row.drift_m_per_s:g} | {row.noise_m:g} "
        f"| {row.gate_m:g} | {'yes' if row.turns else 'no'} | {', '.join(f'{side:g}' for side in row.size_m)} |"
        for row in LIMITS.values()
    )
    head = (
        "| class | usual speed, m/s | most, m/s | drift, m/s within 1 s | noise, m | gate, m | arcs "
        "| length, width, height, m |"
    )
    return "\n".join([head, "|---" * 8 + "|", *rows])


def label_formats() -> str:
    """The formats of label files, of the core and of extensions, as a table in Markdown."""
    from mcaptrack.registry import find, own

    forms = {name: find("label_format", name).cls for name in own("label_format")}
    rows = (f"| `{name}` | {form.title} | {form.row} |" for name, form in forms.items())
    return "\n".join(["| `--format` | | a row, or a file |", "|---|---|---|", *rows])


#: The parts by name.
PARTS: dict[str, Callable[[], str]] = {
    part.__name__: part for part in (environment, stage_options, other_numbers, tables, class_limits, label_formats)
}
