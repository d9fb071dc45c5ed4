"""Text for a terminal: names from files may hold anything."""

from __future__ import annotations

import sys
from typing import NoReturn

import typer

WRONG_USAGE = 2


def printable(text: str) -> str:
    r"""``text`` on one line, with control characters, line ends and bidirectional marks as escapes: ``\n``, ``\x1b``.

    What a terminal would act on, and what could pass for another line, is everything that Unicode doesn't call
    printable, lone surrogates (bytes of a file name that are not UTF-8) among it.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def refuse_usage(text: str) -> NoReturn:
    """End the command because of how it was called or configured: one line on stderr, exit code 2."""
    print(f"mcaptrack: {printable(text)}", file=sys.stderr)
    raise typer.Exit(WRONG_USAGE)
