"""Print text safely: names from files may contain control characters.

All text that commands print for people goes through this module; only data for programs (JSON, CSV) and Typer's help
don't.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any, Final, NoReturn

import typer

from mcaptrack.cli.flags import with_flags

if TYPE_CHECKING:
    from rich.console import Console

WRONG_USAGE: Final = 2
_STDOUT, _STDERR = 1, 2
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


def show(*lines: str) -> None:
    """Print lines to stdout: the answer of a command."""
    print("\n".join(map(printable, lines)), flush=True)


def say(line: str) -> None:
    """Print a line to stderr: a note, a warning or an error."""
    print(printable(with_flags(line)), file=sys.stderr)


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
    say(f"mcaptrack: {line}")
    raise typer.Exit(WRONG_USAGE)


def console() -> Console:
    """Return a console for tables and trees on stdout, without markup, that makes text printable.

    Only ``rich.text.Text`` has to be printable already.
    """
    from rich.console import Console

    class Plain(Console):
        def render_str(self, text: str, **given: Any) -> Any:
            return super().render_str(printable(text), **given)

    width = None if sys.stdout.isatty() else _UNBROKEN
    return Plain(file=sys.stdout, width=width, markup=False, emoji=False, highlight=False)
