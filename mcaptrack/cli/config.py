"""mcaptrack.toml: options in a file, a table a command. Order: option, MCAPTRACK_*, file, default."""

from __future__ import annotations

import difflib
import tomllib
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Final

import typer

NAME: Final = "mcaptrack.toml"
#: The tables of the file that was read for the running command.
_TABLES: Final[ContextVar[dict[str, Any]]] = ContextVar("tables", default={})  # noqa: B039


def read_config(context: typer.Context, path: Path | None) -> Path | None:
    """Take the defaults of this command from ``path``, or from mcaptrack.toml in the current folder if there is one.

    An option's callback. Anything in the file that is no command or no option of its command is refused, with the
    nearest name.
    """
    source = path or Path(NAME)
    if path is None and not source.is_file():
        return None
    try:
        tables = tomllib.loads(source.read_text(encoding="utf-8"))
    except OSError as error:
        raise typer.BadParameter(f"{source} can't be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise typer.BadParameter(f"{source} is no TOML: {error}") from None
    group: Any = context.parent.command if context.parent else None
    commands = dict(group.commands) if group is not None else {}
    for name, values in tables.items():
        if name not in commands:
            raise typer.BadParameter(f"{source}: there is no command {name}{_nearest(name, commands)}")
        if not isinstance(values, dict):
            raise typer.BadParameter(f"{source}: {name} is a command; write its options below [{name}]")
        known = {p.name for p in commands[name].params if p.param_type_name == "option"} - {"config", "help"}
        for key in values:
            if key.replace("-", "_") not in known:
                options = {option.replace("_", "-") for option in known}
                raise typer.BadParameter(
                    f"{source}: {name} has no option {key}{_nearest(key.replace('_', '-'), options)}"
                )
    _TABLES.set(tables)
    mine = tables.get(context.info_name or "", {})
    context.default_map = {key.replace("-", "_"): value for key, value in mine.items()}
    return path


def settings_of(command: str) -> dict[str, Any]:
    """What the file that was read for the running command says of another one, by parameter; {} if nothing."""
    table = _TABLES.get().get(command, {})
    return {key.replace("-", "_"): value for key, value in table.items()}


def _nearest(name: str, known: Any) -> str:
    close = difflib.get_close_matches(name, [str(word) for word in known], 1)
    return f"; did you mean {close[0]}?" if close else ""
