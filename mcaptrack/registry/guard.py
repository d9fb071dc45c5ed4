"""Run code of other packages: what it changes in this process is undone, and one warning names it.

Imports, constructors and calls all pass here. Between two steps of one object, such as two frames of a detector, its
changes are undone for us and put back for it: a package that works with ``numpy.errstate`` around its loop keeps that.
"""

from __future__ import annotations

import locale
import os
import random
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import copy_context
from typing import Any, Final, NamedTuple, NoReturn

from mcaptrack.notices import warn

#: How the warning of a change ends.
UNDONE: Final = "; this was undone"
#: After so long the import of another package is said to take long.
_LONG_S: Final = 10.0
_SIGNALS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGPIPE") if hasattr(signal, name)
)
_Filters = tuple[Any, ...]


class _Facet(NamedTuple):
    """A part of the state of this process: its name, how to read and write it, and whether a change of it, from a value
    to another, counts.
    """

    name: str
    read: Callable[[], Any]
    write: Callable[[Any], object]
    differs: Callable[[Any, Any], bool] = lambda before, after: before != after


def _read_folder() -> str:
    try:
        return os.getcwd()
    except OSError:  # the folder was removed
        return ""


def _write_folder(folder: str) -> None:
    if folder:
        os.chdir(folder)


def _numpy() -> Any:
    import numpy  # here: commands that run no code of others may not need NumPy

    return numpy


def _plain_state(state: Any) -> tuple[Any, ...]:
    return (state[0], state[1].tobytes(), *state[2:])


def _is_broad(entry: Any) -> bool:
    """Whether a filter concerns Python's own warnings, of all texts and modules: others only serve their package."""
    return entry[1] is None and entry[3] is None and entry[2].__module__ == "builtins"


def _write_filters(before: _Filters) -> None:
    added = [entry for entry in warnings.filters if entry not in before and not _is_broad(entry)]
    warnings.resetwarnings()  # also tells the interpreter that filters have changed
    warnings.filters[:] = [*added, *before]  # type: ignore[index]


def _write_handlers(handlers: dict[signal.Signals, Any]) -> None:
    if threading.current_thread() is not threading.main_thread():
        return  # others can't set handlers
    for number, handler in handlers.items():
        if handler is not None and signal.getsignal(number) is not handler:
            signal.signal(number, handler)


def _read_path() -> list[Any]:
    places: Any = sys.path
    if not isinstance(places, list):
        sys.path = []
    return list(sys.path)


def _write_path(places: list[Any]) -> None:
    """Restore the places; those that others have added stay, since their later imports may need them."""
    sys.path[:] = [*places, *(place for place in _read_path() if place not in places)]


def _lacks_some(before: list[Any], after: list[Any]) -> bool:
    return before != [place for place in after if place in before]


_FACETS: Final = (
    _Facet("sys.path", _read_path, _write_path, _lacks_some),
    _Facet("the working folder", _read_folder, _write_folder),
    *(
        _Facet(
            f"the handling of {number.name}",
            lambda number=number: {number: signal.getsignal(number)},  # type: ignore[misc]
            _write_handlers,
        )
        for number in _SIGNALS
    ),
    _Facet("NumPy's handling of errors", lambda: _numpy().geterr(), lambda state: _numpy().seterr(**state)),
    _Facet("the recursion limit", sys.getrecursionlimit, sys.setrecursionlimit),
    _Facet(
        "the filters of warnings",
        lambda: tuple(warnings.filters),
        _write_filters,
        lambda before, after: list(filter(_is_broad, before)) != list(filter(_is_broad, after)),
    ),
    _Facet("the locale", lambda: locale.setlocale(locale.LC_ALL), lambda name: locale.setlocale(locale.LC_ALL, name)),
)
#: These take long to read, and nothing of ours depends on them: they are compared at the end of a run only.
_RANDOM: Final = (
    _Facet("the random state of Python", random.getstate, random.setstate),
    _Facet(
        "the random state of NumPy",
        lambda: _numpy().random.get_state(),  # noqa: PLW0108  # the global one, which others may seed
        lambda state: _numpy().random.set_state(state),  # noqa: PLW0108  # without NumPy until it is called
        lambda before, after: _plain_state(before) != _plain_state(after),
    ),
)


class Guard:
    """The code of one object of another package, or its import.

    Attributes
    ----------
    name : str
        Its name in the warning, as in ``tracker nearest (my-package 1.0)``.
    changed : list of str
        What it has changed so far.
    unsaid : tuple of str
        Changes that are undone without a warning.
    """

    def __init__(self, name: str, unsaid: tuple[str, ...] = ()) -> None:
        self.name = name
        self.unsaid = unsaid
        self.changed: list[str] = []
        self._ours: dict[_Facet, Any] = {}
        self._theirs: dict[_Facet, Any] = {}
        self._warned = 0

    @contextmanager
    def step(self) -> Iterator[None]:
        """Run a part of its code. ``os._exit``, which would end the command without a word, raises instead."""
        self._enter()
        try:
            yield
        finally:
            self._leave()

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Run our code within a step, such as the input that it iterates."""
        self._leave()
        try:
            yield
        finally:
            self._enter()

    def _enter(self) -> None:
        self._exit, process = os._exit, os.getpid()

        def refuse(status: int) -> NoReturn:
            if os.getpid() != process:  # child processes end like this
                self._exit(status)
            raise RuntimeError(f"it called os._exit({status})")

        self._begin(_FACETS if _RANDOM[0] in self._ours else (*_FACETS, *_RANDOM))
        os._exit = refuse

    def _leave(self) -> None:
        os._exit = self._exit
        self._end(_FACETS)

    def _begin(self, facets: Iterable[_Facet]) -> None:
        """Note our state, and put theirs in its place."""
        self._ours |= {facet: facet.read() for facet in facets}
        for facet in facets:
            if facet in self._theirs:
                facet.write(self._theirs[facet])

    def _end(self, facets: Iterable[_Facet]) -> None:
        """Note their state where it differs from ours, and put ours in its place."""
        for facet in facets:
            before, after = self._ours.pop(facet), facet.read()
            self._theirs.pop(facet, None)
            if facet.differs(before, after):
                self._theirs[facet] = after
                facet.write(before)
                self.changed += [facet.name] if facet.name not in self.changed else []

    def end(self) -> None:
        """End the run, and warn of what was changed since the last warning."""
        self._end(_RANDOM if _RANDOM[0] in self._ours else ())
        names = [name for name in self.changed[self._warned :] if name not in self.unsaid]
        self._warned = len(self.changed)
        if names:
            warn(f"{self.name} changed {' and '.join(names)}{UNDONE}")


@contextmanager
def contained_import(what: str) -> Iterator[None]:
    """Import code of another package. One that doesn't end can't be ended from here, but a warning names it."""
    text = f"the import of {what} has taken {_LONG_S:g} s and goes on; Ctrl-C ends it"
    waiting = threading.Timer(_LONG_S, copy_context().run, (warn, text))
    waiting.daemon = True
    waiting.start()
    guard = Guard(f"the import of {what}", tuple(facet.name for facet in _RANDOM))  # many draw numbers, such as Rich
    try:
        with guard.step():
            yield
    finally:
        guard.end()
        waiting.cancel()
