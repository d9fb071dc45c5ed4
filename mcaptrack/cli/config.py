"""mcaptrack.toml: options in a file, a table a command. Which files are read, and how far each is trusted.

A file that ``--config`` names, and one in the user's config folder, may set every option. One in the working folder may
have come along with other people's data: it may tune, and nothing else.
"""

from __future__ import annotations

import os
import re
import stat
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import typer

from mcaptrack.cli.text import refuse_usage
from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish_bytes

NAME: Final = "mcaptrack.toml"
#: A larger file is refused before it is read.
MAX_BYTES: Final = 2**20
_BOM: Final = "\N{ZERO WIDTH NO-BREAK SPACE}"
_BARE_NEWLINE: Final = re.compile(r"(?<!\r)\n")


class ConfigFile(NamedTuple):
    """The tables of one file. Only a ``trusted`` one may set options that don't tune."""

    path: Path
    tables: dict[str, Any]
    trusted: bool


def user_file() -> Path:
    """The file in the user's config folder: ~/.config/mcaptrack/mcaptrack.toml on Linux."""
    return Path(typer.get_app_dir("mcaptrack")) / NAME


def read_files(named: Path | None) -> list[ConfigFile]:
    """The files that apply, the strongest first: the one that is named, or those of the working folder and the user.

    A file that can't be read ends the command with exit code 2.
    """
    if named is not None:
        tables = _read(named)
        if tables is None:
            refuse_usage(f"--config {named}: there is no such file")
        return [ConfigFile(named, tables, trusted=True)]
    own = user_file()
    found = [(Path(NAME), _is_same(Path(NAME), own)), (own, True)]
    if found[0][1]:
        del found[0]
    return [ConfigFile(path, tables, trusted) for path, trusted in found if (tables := _read(path)) is not None]


def _is_same(one: Path, other: Path) -> bool:
    try:
        return one.samefile(other)
    except OSError:
        return False


def _read(path: Path) -> dict[str, Any] | None:
    """The tables of a file; None if there is none."""
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
    """Read a file of options; None if there is none. Opening a FIFO must not wait for a writer.

    Raises McaptrackError for whatever is no regular file of TOML of at most ``MAX_BYTES``.
    """
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise McaptrackError(f"{path} can't be read: {getattr(error, 'strerror', None) or error}") from None
    try:
        about = os.fstat(handle)
        if not stat.S_ISREG(about.st_mode):
            raise McaptrackError(f"{path} is no regular file; options are read from a file of TOML")
        with open(handle, "rb", closefd=False) as stream:
            data = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror}") from None
    finally:
        os.close(handle)
    if len(data) > MAX_BYTES:
        raise McaptrackError(f"{path} has {about.st_size} bytes; a file of options has at most {MAX_BYTES}")
    try:
        text = data.decode("utf-8")
        return Toml(text, tomllib.loads(text.removeprefix(_BOM)))
    except RecursionError:
        raise McaptrackError(f"{path} is no TOML that can be read: it is nested too deeply") from None
    except ValueError as error:
        raise McaptrackError(f"{path} is no TOML: {error}") from None


def write_settings(path: Path, command: str, settings: Mapping[str, Any], was: Mapping[str, str]) -> None:
    """Put settings of a command into a file of options, by their names, as in ``{"max-age-s": 2.0}``.

    Everything else in the file stays as it is, comments and line endings included. ``was`` has the names that settings
    had before. Raises McaptrackError for a file that holds something else.
    """
    old = read_toml(path)
    text = edited(path, old.text if old else "", command, settings, was)
    publish_bytes(path, text.encode("utf-8"))


def edited(path: Path, text: str, command: str, settings: Mapping[str, Any], was: Mapping[str, str]) -> str:
    """Edit the text of ``path``, see ``write_settings``."""
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    bom = _BOM if text.startswith(_BOM) else ""
    text = text.removeprefix(_BOM)
    tables = tomllib.loads(text)
    found = tables.get(command, {})
    if not isinstance(found, dict):
        raise McaptrackError(f"{path}: {command} is a command; write its options below [{command}]")
    wanted = dict(found)
    try:
        document: Any = tomlkit.parse(text)
        if command not in document:
            document[command] = tomlkit.table()
        table = document[command]
        for name, value in settings.items():
            spelt = [key for key in wanted if key.replace("_", "-") == name]
            for key in spelt or [name]:
                table[key] = wanted[key] = value
            for key in [key for key in wanted if key.replace("_", "-") == was.get(name)]:
                del table[key], wanted[key]
        new: str = tomlkit.dumps(document)
        if "\r\n" in text and not _BARE_NEWLINE.search(text):
            new = _BARE_NEWLINE.sub("\r\n", new)
        same = tomllib.loads(new) == {**tables, command: wanted}
    except (TOMLKitError, ValueError):
        same = False
    if not same:  # nothing may be lost by an editor that misses something
        raise McaptrackError(f"{path} is written in a way that can't be edited; write to another file with -o")
    return bom + new
