"""All that commands print for people goes through here: names from files may hold anything.

Nothing else in the command line writes to a terminal, but data for programs (JSON, CSV) and Typer's help.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Final, NoReturn

import typer

from mcaptrack.cli.flags import with_flags

if TYPE_CHECKING:
    from rich.console import Console

WRONG_USAGE: Final = 2
#: Wider than any line: a file or a pipe has no width to keep to, and a line that isn't broken can be searched.
_UNBROKEN: Final = 100_000


def printable(text: str) -> str:
    r"""``text`` on one line, with control characters, line ends and bidirectional marks as escapes: ``\n``, ``\x1b``.

    What a terminal would act on, and what could pass for another line, is everything that Unicode doesn't call
    printable, lone surrogates (bytes of a file name that are not UTF-8) among it.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def show(*lines: str) -> None:
    """Lines on stdout: what was asked for."""
    print("\n".join(map(printable, lines)), flush=True)


def say(line: str) -> None:
    """Print a line to stderr: what is done, and what is odd about it."""
    print(printable(with_flags(line)), file=sys.stderr)


def refuse_usage(line: str) -> NoReturn:
    """End the command because of how it was called or configured: one line on stderr, exit code 2."""
    say(f"mcaptrack: {line}")
    raise typer.Exit(WRONG_USAGE)


def console() -> Console:
    """A console for tables and trees on stdout: text in them is taken as it is, and each piece of it printable.

    Text that is given as ``rich.text.Text`` has to be printable already.
    """
    from rich.console import Console

    class Plain(Console):
        def render_str(self, text: str, **given: Any) -> Any:
            return super().render_str(printable(text), **given)

    width = None if sys.stdout.isatty() else _UNBROKEN
    return Plain(file=sys.stdout, width=width, markup=False, emoji=False, highlight=False)
