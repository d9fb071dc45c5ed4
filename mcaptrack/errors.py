"""The one exception for faults that a user can mend, and the commands that its messages propose."""

from __future__ import annotations

import shlex
from pathlib import Path


class McaptrackError(Exception):
    """A fault in the input, the options or the machine that its reader can mend.

    The message is one line: what is wrong, where, what there is instead, and what to do. Every other exception is a
    fault of the program and keeps its traceback.
    """


class DamagedError(McaptrackError):
    """A file whose bytes are not what was written; what can be saved of it, `mcaptrack recover` saves."""


def command(*words: str | Path) -> str:
    """A command to propose in a message, in backquotes and as a shell takes it: ("run", Path("my log.mcap")).

    A path can't be taken for an option, whatever its name. What the user has to fill in is in capitals (LABELS).
    """
    return f"`mcaptrack {' '.join(_quoted(word) for word in words)}`"


def _quoted(word: str | Path) -> str:
    text = f"./{word}" if isinstance(word, Path) and str(word).startswith("-") else str(word)
    if text.isprintable():
        return shlex.quote(text)
    escaped = "".join(c if c.isprintable() and c not in "\\'" else _escape(c) for c in text)
    return f"$'{escaped}'"


def _escape(character: str) -> str:
    """A character as bash and zsh read it between $' and '."""
    return "".join(f"\\x{byte:02x}" for byte in character.encode("utf-8", "surrogateescape"))
