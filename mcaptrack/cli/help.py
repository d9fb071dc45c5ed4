"""Pages of help, as plain text: of all commands, and of one. No command is made for a page."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, get_args

from mcaptrack.api.declared import Parameter
from mcaptrack.choices import limits

#: The first heading, that of options without a theme below it, and the last ones: input and output, many logs, and the
#: options of all commands.
FIRST_PANEL: Final = "Most used"
OPTIONS: Final = "Options"
MORE_PANEL: Final = "More options"
LAST_PANELS: Final = ("Input and output", "Many logs", "Options of all commands")
#: The option that shows all options; ``--help`` shows those that most people need.
ALL: Final = "--help-all"
HELP: Final = ("--help", "-h", ALL)
#: What the options that show help mean.
SHOWN_BY: Final = {
    "-h, --help": "Show the options that most people need, and exit.",
    ALL: "Show all options, by theme, and exit.",
}
#: The heading of a theme that not all detectors, trackers or predictors have: the names of those that have it.
_THOSE: Final = re.compile(r"\((.+)\)$|^Options of (.+)$")
#: The widest column of the names of options; a longer name has a line of its own.
_NAMES_WIDTH: Final = 24
_VALUES: Final[Mapping[Any, str]] = {str: "TEXT", Path: "PATH", int: "N", float: "X", bool: ""}


def arranged(first: Sequence[str], parameters: Iterable[Parameter]) -> list[Parameter]:
    """The options of a command in the order of its help, with their headings; ``first`` come first."""

    def place(parameter: Parameter) -> tuple[int, int]:
        panel = parameter.option.panel
        if panel == FIRST_PANEL:
            return -1, first.index(parameter.name)
        return (1 + LAST_PANELS.index(panel), 0) if panel in LAST_PANELS else (0, 0)

    return sorted((_below_heading(first, parameter) for parameter in parameters), key=place)


def _below_heading(first: Sequence[str], parameter: Parameter) -> Parameter:
    """An option below its heading. Those of input and output, and of all commands, show no default of their own."""
    panel, text, shown = parameter.option.panel, parameter.help, parameter.shown
    if shown is None and panel in (LAST_PANELS[0], LAST_PANELS[-1]):
        shown = False
    if parameter.name in first:
        if those := _THOSE.search(panel):
            text = f"{text.rstrip('.')} ({those[1] or those[2]})."
        panel = FIRST_PANEL
    elif first and not panel:
        panel = MORE_PANEL
    return parameter._replace(option=replace(parameter.option, panel=panel), help=text, shown=shown)


def write_page(formatter: Any, path: str, function: Callable[..., None], is_all: bool) -> None:
    """Write the help of a command, of its function (``declared.command``): all of it, or what most people need."""
    about: Any = function
    text, *examples = about.help.split("\n\nExample: ")
    summary, *more = re.split(r"\n{2,}", text)
    formatter.write_usage(path, " ".join(["[OPTIONS]", *(usage for usage, *_ in about.places)]))
    for paragraph in (summary, *(more if is_all else more[:1])):
        write_paragraph(formatter, paragraph)
    write_section(formatter, "Examples", [(example, "") for example in (examples if is_all else examples[:2])])
    write_section(formatter, "Arguments", [(metavar, meaning) for _, metavar, meaning in about.places])
    panels: dict[str, list[tuple[str, str]]] = {}
    for parameter in about.parameters:
        panels.setdefault(parameter.option.panel or OPTIONS, []).append(_row(parameter, is_all))
    panels[LAST_PANELS[-1]] += SHOWN_BY.items()
    first = {FIRST_PANEL} if about.most_used else panels.keys() - LAST_PANELS[1:]
    shown = [panel for panel in panels if is_all or panel in first]
    for panel in shown:
        write_section(formatter, panel, panels[panel])
    if others := dict.fromkeys(re.sub(r" \(.*", "", panel) for panel in panels if panel not in shown):
        write_paragraph(formatter, f"`{ALL}` shows all options, also: {', '.join(others)}.")


def write_paragraph(formatter: Any, text: str) -> None:
    """Write a paragraph of help; lines that begin with a dash are entries of a list."""
    formatter.write("\n")
    for part in re.split(r"\n(?=- )", text):
        indent = "  " if part.startswith("- ") else ""
        lines = textwrap.wrap(" ".join(part.split()), formatter.width, subsequent_indent=indent, break_on_hyphens=False)
        formatter.write("".join(f"{line}\n" for line in lines))


def write_section(formatter: Any, heading: str, rows: Sequence[tuple[str, str]]) -> None:
    """Write a heading and rows in two columns below it, unless there are none."""
    if rows:
        with formatter.section(heading):
            formatter.write_dl(rows, col_max=_NAMES_WIDTH)


def _row(parameter: Parameter, is_all: bool) -> tuple[str, str]:
    """The names of an option with its values, and what it means: with its range if all is shown."""
    flag, *short = parameter.flags
    values = parameter.option.metavar or "|".join(get_args(parameter.kind)) or _VALUES[parameter.kind]
    text, default = parameter.help, parameter.shown
    if is_all and (ends := limits(parameter.option.least, parameter.option.most)):
        text += f" {ends[0].upper()}{ends[1:]}."
    if default is None and parameter.kind is not bool and parameter.default is not None:
        default = str(parameter.default)
    is_shown = isinstance(default, str) and default != "none"
    return f"{', '.join([*short, flag])} {values}".strip(), f"{text} [{default}]" if is_shown else text
