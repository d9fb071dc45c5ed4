"""Warnings: what was assumed, left out or looks odd, said from anywhere below a command without printing.

A note (which stage runs, where a file went) is routine and goes to a ``say`` callable. A warning is something that
changes results or casts doubt on them; it is never hidden, and stands in the JSON of every command. Code warns with
``warn``; whoever started the work hears it with ``listening`` or ``collected``. Where no one listens, warnings become
Python's own (``McaptrackWarning``), so that a script or a notebook sees them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final, Literal, NamedTuple, get_args

#: What kind of thing a warning is about, for programs. docs/warnings.md says what each means.
Code = Literal[
    "assumed-ground-plane",
    "camera-moves",
    "chosen-camera",
    "classes",
    "clock",
    "extrapolated",
    "held-back",
    "journal",
    "left-out",
    "lost",
    "memory",
    "not-compared",
    "nothing-found",
    "option-not-used",
    "other",
    "other-settings",
    "other-version",
    "out-of-date",
    "view-lost",
    "worse",
]


def known_code(text: str) -> Code:
    """A code that was read; "other" for one that this version doesn't know."""
    return next((code for code in get_args(Code) if code == text), "other")


class McaptrackWarning(UserWarning):
    """A warning that no listener heard."""


class Notice(NamedTuple):
    """A warning: one line for people, a code for programs, and the log that it is about, if it is about one."""

    message: str
    code: Code = "other"
    log: str | None = None

    def __str__(self) -> str:
        """The line, with the name of the log in front unless it is there already."""
        named = self.log is None or self.message.startswith(self.log)
        return self.message if named else f"{self.log}: {self.message}"


Listener = Callable[[Notice], None]

_LISTENER: Final[ContextVar[Listener | None]] = ContextVar("listener", default=None)
_LOG: Final[ContextVar[str | None]] = ContextVar("log", default=None)


def warn(message: str, code: Code = "other") -> None:
    """Say something that changes results or casts doubt on them: what, where, and what to do."""
    _pass_on(Notice(" ".join(message.splitlines()), code, _LOG.get()), _LISTENER.get())


def _pass_on(notice: Notice, listener: Listener | None) -> None:
    if listener is None:
        warnings.warn(str(notice), McaptrackWarning, stacklevel=3)
    else:
        listener(notice)


@contextmanager
def about(log: object) -> Iterator[None]:
    """Warnings inside are about this log."""
    token = _LOG.set(str(log))
    try:
        yield
    finally:
        _LOG.reset(token)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Warnings inside go to ``listener`` and nowhere else."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


@contextmanager
def collected() -> Iterator[list[Notice]]:
    """Warnings inside are put into a list, and go on to whoever listens outside."""
    outside, found = _LISTENER.get(), list[Notice]()

    def hear(notice: Notice) -> None:
        found.append(notice)
        _pass_on(notice, outside)

    with listening(hear):
        yield found
