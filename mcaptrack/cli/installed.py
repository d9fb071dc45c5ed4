"""Commands by their entry points, of extensions and of other packages: functions that ``api.declared`` declares."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any

from mcaptrack.api.declared import OneOfMany, arguments_of, options_of
from mcaptrack.cli import common
from mcaptrack.cli.declared import Called, OfAll, Once, Printed, parameters_of
from mcaptrack.cli.many import EachLog
from mcaptrack.cli.text import show
from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location
from mcaptrack.registry import blamed, find, load


class Plain(Called[Any]):
    """A command that prints what its function returns."""

    More = Printed

    def data(self, done: Any) -> dict[str, Any]:
        """Return a result as values of JSON."""
        return {"result": plain(done)}


class PlainOnce(Plain, Once[Any]):
    """A command that calls its function once."""

    def show(self, done: Any, talk: common.Talk) -> None:
        """Print the result for people."""
        if lines := list(lines_of(done)):
            show(*lines)


class PlainEachLog(Plain, EachLog[Any]):
    """A command that calls its function with each log."""

    writes = False
    prints_results = True

    def show(self, log: Location, done: Any, talk: common.Talk) -> None:
        """Print the result of a log for people, below its name if there are several."""
        if not self.values["json"]:
            named = [f"{log}:"] if len(self.inputs) > 1 else []
            if lines := [*named, *lines_of(done)]:
                show(*lines)


def class_of(name: str) -> type[Called[Any]]:
    """The class of a command: the one that its function names, or one that prints what the function returns.

    One that takes a log can take many. Raises McaptrackError for what is no command.
    """
    entry = find("command", name)
    if not hasattr(entry.cls, "most_used"):
        raise McaptrackError(f"{entry} is not declared; `@declared()` of mcaptrack.api.declared makes it a command")
    with blamed(entry, "can't be a command"):
        each = any(isinstance(about, OneOfMany) for about in arguments_of(entry.cls).values())
        usual = PlainEachLog if each else PlainOnce
        kind: type[Called[Any]] = load(str(entry), entry.cls.printed_by) if entry.cls.printed_by else usual
        if not entry.is_built_in:
            own = {option.name for option in options_of(entry.cls)}
            if taken := sorted(own & {option.name for option in (*kind.options(name), *parameters_of(OfAll))}):
                raise McaptrackError(f"a parameter can't have the name of the option {', '.join(taken)}")
            kind.function_of(name)
    return kind


def plain(value: Any) -> Any:
    """A result as values of JSON: numbers that are not finite are None."""
    import numpy as np  # here: most commands print their results by themselves

    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(member) for key, member in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(member) for member in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def lines_of(value: Any) -> Iterator[str]:
    """A result as lines of text: of a mapping name and value, of a sequence each member."""
    value = plain(value)
    if isinstance(value, dict):
        width = max(map(len, value), default=0)
        yield from (f"{name:<{width}}  {_text(member)}" for name, member in value.items())
    elif isinstance(value, list):
        yield from map(_text, value)
    elif value is not None:
        yield from _text(value).splitlines()


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
