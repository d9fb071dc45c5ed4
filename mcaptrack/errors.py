"""The exceptions for faults that a user can fix, and the calls and commands that messages propose.

Messages name parameters as Python writes them, in backquotes: `fps=`, or with a value `first_frame=1`. The command line
shows the option instead, and a command instead of a call.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

__all__ = [
    "DamagedError", "McaptrackError", "call", "command", "did_you_mean", "in_one_line", "lacks", "list_names",
    "needing", "offer",
]  # fmt: skip


class McaptrackError(Exception):
    """A fault in the input, the options or the machine that the user can fix.

    The message is one line: what is wrong, where, what there is instead, and what to do. All other exceptions are
    faults of the program and keep their traceback.
    """


class DamagedError(McaptrackError):
    """A damaged log; `mcaptrack.recover` saves what is intact."""


def in_one_line(error: Exception, most: int | None = None) -> str:
    """The message of an error in one line, of ``most`` characters at most; without one, the name of its type."""
    return " ".join(str(error).split())[:most] or type(error).__name__


def lacks(what: str, package: str, extra: str) -> str:
    """Say that ``what`` needs a package that isn't installed, and which extra of mcaptrack brings it."""
    return f"{what} needs {package}, which is not installed; `pip install 'mcaptrack[{extra}]'` installs it"


@contextmanager
def needing(what: str, package: str, extra: str) -> Iterator[None]:
    """A block that imports a package, for ``what``. Raises McaptrackError, with its ``extra``, if it isn't there."""
    try:
        yield
    except ImportError:
        raise McaptrackError(lacks(what, package, extra)) from None


#: From this share of letters on, names are nearly the same.
_NEARLY: Final = 0.85
#: The most names that are listed beside the one that is meant.
_BESIDE: Final = 10


def similar(name: str, names: Iterable[str], least: float = 0.6) -> str:
    """The name that is meant by one that there isn't; "" if none is close. All messages ask here.

    It is the same but for capitals, slashes around it, and dashes for other marks; or nearly the same; or the only one
    that ends or begins with it, as a topic and an option with a unit do; or the most similar one, if ``least`` of it,
    as ``difflib`` counts, is the same; or the first one with nearly the same end, as of a topic.
    """
    from difflib import SequenceMatcher, get_close_matches

    wanted, plain = _plain(name), {_plain(each): each for each in names}
    if not wanted or wanted in plain:
        return plain.get(wanted, "")
    ends = [each for each in plain if each.endswith(f"/{wanted}") or each.startswith(f"{wanted}-")]
    nearly, close = (get_close_matches(wanted, list(plain), 1, cutoff) for cutoff in (_NEARLY, least))
    tails = {each.split("/", each.count("/") - wanted.count("/"))[-1]: each for each in reversed(plain) if "/" in each}
    if not nearly and not ends and (tail := get_close_matches(wanted, list(tails), 1, cutoff=_NEARLY)):
        return plain[tails[tail[0]]]
    meant = (nearly or (ends if len(ends) == 1 else close) or [""])[0]
    # names below one folder are alike by that alone
    shared = os.path.commonprefix([wanted, meant]).rfind("/") + 1  # noqa: RUF071  # characters are meant
    is_close = meant in ends or SequenceMatcher(None, wanted[shared:], meant[shared:]).ratio() >= least
    return plain[meant] if meant and is_close else ""


def _plain(name: str) -> str:
    return re.sub(r"[_ ]", "-", name.casefold()).strip("/")


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """A question for a message, about the name that is meant; "" if none is close."""
    meant = similar(name, names)
    return f"did you mean {meant}? " if meant and meant != name else ""


def offer(name: str, names: Iterable[str], has: str = "it has") -> str:
    """The end of a message about a name that there isn't: which one may be meant, and what there is.

    Examples
    --------
    >>> offer("/lidar/box", ["/lidar/boxes", "/imu"])
    'did you mean /lidar/boxes? it has /lidar/boxes, /imu'
    >>> offer("boxs", ["/lidar/boxes"])
    'did you mean /lidar/boxes? it has /lidar/boxes'
    """
    every = list(names)
    question = did_you_mean(name, every)
    return f"{question}{has} {list_names(every, _BESIDE) if question else list_names(every)}"


def call(function: str, *values: str | Path, **parameters: Any) -> str:
    """A call to propose in a message, in backquotes. Placeholders for the user to fill in are in capitals.

    ``function`` is its name, ``values`` its arguments without a name, and ``parameters`` those with one.

    Examples
    --------
    >>> call("ingest", "LABELS", into=Path("my log.mcap"))
    "`mcaptrack.ingest('LABELS', into='my log.mcap')`"
    """
    arguments = [_literal(value) for value in values]
    arguments += [f"{name}={_literal(value)}" for name, value in parameters.items()]
    return f"`mcaptrack.{function}({', '.join(arguments)})`"


def list_names(names: Sequence[str], most: int = 30) -> str:
    """Names for a message: all, or the first and the number of the rest.

    Examples
    --------
    >>> list_names(["a", "b", "c", "d"], most=2), list_names([])
    ('a, b and 2 more', 'none')
    """
    more = f" and {len(names) - most:,} more" if len(names) > most else ""
    return (", ".join(names[:most]) or "none") + more


def _literal(value: Any) -> str:
    return repr(str(value) if isinstance(value, Path) else value).replace("`", "\\x60")


def command(*parts: str | Path) -> str:
    """A command to propose at a terminal or on a page, in backquotes and quoted for a shell.

    A path is never mistaken for an option, whatever its name. Placeholders for the user to fill in are in capitals.

    ``parts`` are the words after ``mcaptrack``.

    Examples
    --------
    >>> command("run", Path("my log.mcap"), "--truth", "LABELS")
    "`mcaptrack run 'my log.mcap' --truth LABELS`"
    """
    return f"`mcaptrack {' '.join(_quoted(word) for word in parts)}`"


def _quoted(word: str | Path) -> str:
    text = f"./{word}" if isinstance(word, Path) and str(word).startswith("-") else str(word)
    if text.isprintable():
        return shlex.quote(text)
    escaped = "".join(c if c.isprintable() and c not in "\\'" else _escape(c) for c in text)
    return f"$'{escaped}'"


def _escape(character: str) -> str:
    """A character in the $'...' syntax of bash and zsh."""
    return "".join(f"\\x{byte:02x}" for byte in character.encode("utf-8", "surrogateescape"))
