"""Print text safely: names from files may contain control characters.

All text that commands print for people goes through this module; only data for programs (JSON, CSV) and Typer's help
don't. With ``--log-format json`` each line on stderr is an object of JSON instead, with its time, its level and what it
is about. Messages of the library are translated: parameters become options, calls become commands.
"""

from __future__ import annotations

import ast
import json
import os
import re
import sys
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NoReturn

import typer

import mcaptrack
from mcaptrack.errors import command

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

__all__ = ["console", "counted", "print_table", "printable", "say", "show", "show_left_out", "with_flags"]

WRONG_USAGE: Final = 2
_STDOUT, _STDERR = 1, 2
Level = Literal["debug", "info", "warning", "error"]
#: What precedes the text of a line.
_BEGINNINGS: Final = {"warning": "warning: ", "error": "mcaptrack: "}
#: Whether lines on stderr are JSON, and the name of the command then.
_JSON: Final[ContextVar[str | None]] = ContextVar("json", default=None)
#: Width of output that is not a terminal: lines are not broken, so that they can be searched.
_UNBROKEN: Final = 100_000


def printable(text: str) -> str:
    r"""Return text with characters that are not printable as escapes: ``\n``, ``\x1b``.

    These are control characters, line ends, bidirectional marks, and lone surrogates (bytes of a file name that are not
    UTF-8). A terminal would act on them, or show them as another line.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def counted(count: int, singular: str) -> str:
    """A count with its noun: 1 track, 2 tracks, 1,000 tracks.

    ``singular`` is the noun for one; an s makes it several.
    """
    return f"{count:,} {singular}{'' if count == 1 else 's'}"


def show(*lines: str) -> None:
    """Print lines to stdout: the answer of a command."""
    print("\n".join(map(printable, lines)), flush=True)


def say(line: str, level: Level = "info", event: str = "", **about: Any) -> None:
    """Print a line to stderr: a note, a warning or an error; with ``--log-format json`` as an object.

    ``event`` says what kind of line it is (by default "note", or the level), and ``about`` what it is about: values of
    JSON, which are not printed as text.
    """
    text = with_flags(line)
    if _JSON.get() is None:
        print(printable(_BEGINNINGS.get(level, "") + text), file=sys.stderr)
        return
    time = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    kind = event or (level if level in _BEGINNINGS else "note")
    whole = {"time": time, "level": level, "event": kind, "command": _JSON.get(), "message": text.strip(), **about}
    print(json.dumps(whole, allow_nan=False), file=sys.stderr, flush=True)


def is_json() -> bool:
    """Whether lines on stderr are objects of JSON."""
    return _JSON.get() is not None


@contextmanager
def log_format(name: str, command: str) -> Iterator[None]:
    """Print lines of this block on stderr as "text" or as "json"."""
    token = _JSON.set(command if name == "json" else None)
    try:
        yield
    finally:
        _JSON.reset(token)


@contextmanager
def stdout_to_stderr() -> Iterator[None]:
    """Send to stderr what plug-ins print, also their libraries and child processes: stdout is for results."""
    with redirect_stdout(sys.stderr):
        try:
            results = os.dup(_STDOUT)
            os.dup2(_STDERR, _STDOUT)
        except OSError:  # one of them is closed
            yield
            return
        try:
            yield
        finally:
            os.dup2(results, _STDOUT)
            os.close(results)


def refuse_usage(line: str) -> NoReturn:
    """End the command with one line on stderr and exit code 2: it was called or configured wrongly."""
    say(line, "error")
    raise typer.Exit(WRONG_USAGE)


def console() -> Console:
    """Return a console for tables and trees on stdout, without markup, that makes text printable.

    Only ``rich.text.Text`` has to be printable already.
    """
    from rich.console import Console

    class Plain(Console):
        def render_str(self, text: str, **options: Any) -> Any:
            return super().render_str(printable(text), **options)

    width = None if sys.stdout.isatty() else _UNBROKEN
    return Plain(file=sys.stdout, width=width, markup=False, emoji=False, highlight=False)


def print_table(
    names: Sequence[str],
    rows: Sequence[Sequence[str | Text]],
    numbers: Collection[str] = (),
    spare: Sequence[str] = (),
    ruled: bool = False,
) -> list[str]:
    """Print a table of which no number is ever cut; returns the names of the columns that were left out.

    Parameters
    ----------
    names : sequence of str
        Names of the columns.
    rows : sequence of sequences
        Their cells; a shorter row ends early, and an empty one is an empty line.
    numbers : collection of str
        Names of the columns of numbers. The others are broken over lines where even the least columns don't fit.
    spare : sequence of str
        Names of columns that are left out, in this order, as long as the table is wider than the terminal.
    ruled : bool
        Whether a line is drawn below the names.

    """
    from rich import box
    from rich.cells import cell_len
    from rich.table import Table

    out = console()
    cells = [[cell if isinstance(cell, str) else cell.plain for cell in row] for row in (names, *rows)]
    widths = [max(cell_len(printable(row[at])) for row in cells if at < len(row)) for at in range(len(names))]
    kept, left_out, between = list(range(len(names))), [], 3 if ruled else 2
    for name in spare:
        if sum(widths[at] + between for at in kept) - between <= out.width:
            break
        kept.remove(next(at for at in reversed(kept) if names[at] == name))
        left_out.append(name)
    table = Table(box=box.SIMPLE_HEAD if ruled else None, show_edge=False, pad_edge=False, header_style="bold")
    for at in kept:
        is_number = names[at] in numbers
        justify: Literal["left", "right"] = "right" if is_number else "left"
        least = widths[at] if is_number else None
        table.add_column(names[at], justify=justify, overflow="fold", no_wrap=is_number, min_width=least)
    for row in rows:
        table.add_row(*(row[at] for at in kept if at < len(row)))
    out.print(table)
    return left_out


def show_left_out(names: Sequence[str], where: str = "--json") -> None:
    """Print which columns a table has no room for, and where they are.

    ``names`` are those of the columns; nothing is printed without any.
    """
    if names:
        show(f"no room for {', '.join(names)}: a wider window, a pipe and {where} have all")


#: Typer's context of the command that runs.
RUNNING: Final[ContextVar[Any]] = ContextVar("running", default=None)

_CALL: Final = re.compile(r"`mcaptrack\.(\w+)\(([^`]*)\)`")
_PARAMETER: Final = re.compile(r"`([a-z]\w*)=([^`]*)`")


def with_flags(message: str) -> str:
    """Return a message with "`fps=`" as "--fps", and "`mcaptrack.run('a.mcap')`" as "`mcaptrack run a.mcap`"."""
    return _PARAMETER.sub(_option, _CALL.sub(_command, message))


def _command(match: re.Match[str]) -> str:
    name, arguments = match.groups()
    try:
        call = ast.parse(f"call({arguments})", mode="eval").body
        assert isinstance(call, ast.Call)
        values = [ast.literal_eval(value) for value in call.args]
        options = {keyword.arg or "": ast.literal_eval(keyword.value) for keyword in call.keywords}
    except (SyntaxError, ValueError, AssertionError):
        return match[0]
    line, more = getattr(getattr(mcaptrack, name, None), "done_by", ((name,), {}))
    arguments_: list[str | Path] = [Path(value) if value.startswith("-") else value for value in values]
    for parameter, value in (options | more).items():
        flag = flag_of(parameter, value, line[0])
        if flag.endswith("="):  # Python alone has it
            return match[0]
        if flag.startswith("--set "):
            arguments_ += ["--set", f"{parameter}={_text(value)}"]
        else:
            arguments_ += [flag] if isinstance(value, bool) else [flag, str(value)]
    return command(*line, *arguments_)


def _option(match: re.Match[str]) -> str:
    parameter, text = match.groups()
    if not text:
        return flag_of(parameter)
    try:
        value = ast.literal_eval(text)
    except (SyntaxError, ValueError):
        return match[0]
    flag = flag_of(parameter, value)
    if flag.startswith("--set "):
        return f"{flag}={_text(value)}"
    if flag.endswith("="):
        return f"{flag}{value!r} in Python"
    return flag if isinstance(value, bool) else f"{flag} {value}"


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def flag_of(parameter: str, value: object = None, name: str = "") -> str:
    """Return the option for a parameter of the command ``name``, by default of the one that runs."""
    context = RUNNING.get()
    commands = context.parent.command.commands if context is not None and context.parent is not None else {}
    running = commands.get(name) or (context.command if context is not None else None)
    for option in running.params if running is not None else ():
        if option.name == parameter and option.param_type_name == "option":
            names = option.secondary_opts if value is False and option.secondary_opts else option.opts
            return str(min(names, key=len))
    for elsewhere in getattr(running, "elsewhere", {}).values():
        if elsewhere.parameter == parameter:
            return f"--set {parameter}" if elsewhere.is_set else f"{parameter}="
    return f"--{parameter.replace('_', '-')}"
