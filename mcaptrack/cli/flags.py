"""Translate messages of the library for the command line: parameters become options, calls become commands."""

from __future__ import annotations

import ast
import re
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Final

import mcaptrack
from mcaptrack.errors import command

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
