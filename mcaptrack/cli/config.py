"""Read mcaptrack.toml, which sets options in one table for each command.

A file that ``--config`` names and the file in the user's config folder may set all options. A file in the working
folder may set tuning options only, because it may have come with other people's data.
"""

from __future__ import annotations

import os
import stat
import tomllib
from pathlib import Path
from typing import Any, Final, NamedTuple

import typer

from mcaptrack.cli.text import refuse_usage
from mcaptrack.errors import McaptrackError
from mcaptrack.files import missing, unreadable

NAME: Final = "mcaptrack.toml"
#: A larger file is refused before it is read.
MAX_BYTES: Final = 2**20
BOM: Final = "\N{ZERO WIDTH NO-BREAK SPACE}"


class ConfigFile(NamedTuple):
    """The tables of one file. Only a ``trusted`` file may set options other than tuning ones."""

    path: Path
    tables: dict[str, Any]
    trusted: bool


def user_file() -> Path:
    """Return the file in the user's config folder: ~/.config/mcaptrack/mcaptrack.toml on Linux."""
    return Path(typer.get_app_dir("mcaptrack")) / NAME


def read_files(named: Path | None) -> list[ConfigFile]:
    """Return the files to use, the strongest first: ``named``, or those of the working folder and of the user.

    A file that can't be read ends the command with exit code 2.
    """
    if named is not None:
        tables = _read(named)
        if tables is None:
            refuse_usage(f"--config: {missing(named)}")
        return [ConfigFile(named, tables, trusted=True)]
    own = user_file()
    candidates = [(Path(NAME), _is_same(Path(NAME), own)), (own, True)]
    if candidates[0][1]:
        del candidates[0]
    return [ConfigFile(path, tables, trusted) for path, trusted in candidates if (tables := _read(path)) is not None]


def _is_same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:
        return False


def _read(path: Path) -> dict[str, Any] | None:
    """Return the tables of a file; None if it does not exist."""
    try:
        content = read_toml(path)
    except McaptrackError as error:
        refuse_usage(str(error))
    return None if content is None else content.tables


class Toml(NamedTuple):
    """A file of TOML: its text, line endings as they are, and its tables."""

    text: str
    tables: dict[str, Any]


def read_toml(path: Path) -> Toml | None:
    """Read a file of options; returns None if it does not exist.

    Raises McaptrackError if it is not a regular file of TOML of at most ``MAX_BYTES``. It is opened without blocking,
    because opening a FIFO would wait for a writer.
    """
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from None
    try:
        about = os.fstat(handle)
        if not stat.S_ISREG(about.st_mode):
            raise McaptrackError(f"{path} is not a regular file; options are read from a TOML file")
        with open(handle, "rb", closefd=False) as stream:
            data = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise unreadable(path, error) from None
    finally:
        os.close(handle)
    if len(data) > MAX_BYTES:
        raise McaptrackError(f"{path} has {about.st_size} bytes; a file of options has at most {MAX_BYTES}")
    try:
        text = data.decode("utf-8")
        return Toml(text, tomllib.loads(text.removeprefix(BOM)))
    except RecursionError:
        raise McaptrackError(f"{path} is not valid TOML: it is nested too deeply") from None
    except ValueError as error:
        raise McaptrackError(f"{path} is not valid TOML: {error}") from None
