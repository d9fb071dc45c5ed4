"""Warnings: what was assumed, left out or looks unusual, reported from any layer without printing.

A note (which stage runs, where a file was written) is routine and goes to a ``say`` callable. A warning is something
that changes results or casts doubt on them; it is never hidden, and is part of the JSON of every command. Code warns
with ``warn``; callers receive warnings with ``listening`` or ``collected``. Without a listener, warnings become
Python warnings (``McaptrackWarning``), so that scripts and notebooks show them.
"""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Final, Literal, NamedTuple, get_args

__all__ = ["Notice", "Progress", "Say", "collected", "warn"]

#: Called with the name of a stage, the amount that is done, and the total.
Progress = Callable[[str, int, int], None]
#: Called with a note: a line that says what is done.
Say = Callable[[str], None]

#: The codes of warnings, for programs. docs/warnings.md explains them.
Code = Literal[
    "assumed-ground-plane",
    "camera-moves",
    "cameras-disagree",
    "chosen-camera",
    "classes",
    "clock",
    "clock-jump",
    "definitions",
    "device",
    "ellipses",
    "estimated-ground-plane",
    "extrapolated",
    "few-pictures",
    "fields",
    "heights",
    "held-back",
    "journal",
    "labelled",
    "left-out",
    "lost",
    "memory",
    "not-blurred",
    "not-compared",
    "no-pictures",
    "nothing-found",
    "option-not-used",
    "other",
    "other-settings",
    "other-version",
    "out-of-date",
    "outside",
    "pictures",
    "repeated",
    "scores",
    "shared",
    "transforms",
    "units",
    "view-lost",
    "weak-predictor",
    "worse",
]


def known_code(text: str) -> Code:
    """A code from a file; "other" if this version doesn't know it."""
    return next((code for code in get_args(Code) if code == text), "other")


class McaptrackWarning(UserWarning):
    """A warning as Python shows it: something was assumed, left out or looks odd."""


class Notice(NamedTuple):
    """A warning.

    Attributes
    ----------
    message : str
        One line: what was assumed, left out or looks odd.
    code : str
        Its kind, for programs, such as "clock"; docs/warnings.md lists them.
    log : str or None
        The log that it is about, if any.

    """

    message: str
    code: Code = "other"
    log: str | None = None

    def __str__(self) -> str:
        """The text, preceded by the name of the log unless it starts with it."""
        named = self.log is None or self.message.startswith(self.log)
        return self.message if named else f"{self.log}: {self.message}"


Listener = Callable[[Notice], None]

_LISTENER: Final[ContextVar[Listener | None]] = ContextVar("listener", default=None)
_LOG: Final[ContextVar[str | None]] = ContextVar("log", default=None)


def warn(message: str, code: Code = "other") -> None:
    """Warn of something that changes results or casts doubt on them: what, where, and what to do.

    A log that keeps the warning names no file, so the name of the log that it is about goes.

    ``message`` is one line, and ``code`` says which kind of warning it is, for programs.
    """
    line, log = " ".join(message.splitlines()), _LOG.get()
    _pass_on(Notice(line.removeprefix(f"{log}: "), code, log), _LISTENER.get())


def _pass_on(notice: Notice, listener: Listener | None) -> None:
    if listener is None:
        warnings.warn(str(notice), McaptrackWarning, stacklevel=_level_of_caller())
    else:
        listener(notice)


def _level_of_caller() -> int:
    """The number of calls from the caller of this function up to the first line outside of the package."""
    package = str(Path(__file__).parent) + os.sep
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and (
        frame.f_code.co_filename.startswith(package) or frame.f_globals.get("__name__") == "contextlib"
    ):
        frame, level = frame.f_back, level + 1
    return level


@contextmanager
def about(log: object) -> Iterator[None]:
    """Warnings in this block are about this log."""
    token = _LOG.set(str(log))
    try:
        yield
    finally:
        _LOG.reset(token)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Warnings in this block go to ``listener`` only."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


@contextmanager
def naming(name: str) -> Iterator[None]:
    """Warnings in this block begin with this name, unless they have it already."""
    outside = _LISTENER.get()

    def hear(notice: Notice) -> None:
        is_named = name in re.split(r"[^\w.-]+", notice.message)
        message = notice.message if is_named else f"{name}: {notice.message}"
        _pass_on(notice._replace(message=message), outside)

    with listening(hear):
        yield


@contextmanager
def collected() -> Iterator[list[Notice]]:
    """Collect the warnings of this block in a list, and pass them on to the outer listener."""
    outside, notices = _LISTENER.get(), list[Notice]()

    def hear(notice: Notice) -> None:
        notices.append(notice)
        _pass_on(notice, outside)

    with listening(hear):
        yield notices
