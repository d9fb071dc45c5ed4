"""mcaptrack.toml: options in a file, a table a command. Which files are read, and how far each is trusted.

A file that ``--config`` names, and one in the user's config folder, may set every option. One in the working folder may
have come along with other people's data: it may tune, and nothing else.
"""

from __future__ import annotations

import os
import stat
import tomllib
from pathlib import Path
from typing import Any, Final, NamedTuple

import typer

from mcaptrack.cli.text import refuse_usage

NAME: Final = "mcaptrack.toml"
#: A larger file is refused before it is read.
MAX_BYTES: Final = 2**20


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
    """The tables of a file; None if there is none. Opening a FIFO must not wait for a writer."""
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        refuse_usage(f"{path} can't be read: {getattr(error, 'strerror', None) or error}")
    try:
        about = os.fstat(handle)
        if not stat.S_ISREG(about.st_mode):
            refuse_usage(f"{path} is no regular file; options are read from a file of TOML")
        with open(handle, "rb", closefd=False) as stream:
            data = stream.read(MAX_BYTES + 1)
    except OSError as error:
        refuse_usage(f"{path} can't be read: {error.strerror}")
    finally:
        os.close(handle)
    if len(data) > MAX_BYTES:
        refuse_usage(f"{path} has {about.st_size} bytes; a file of options has at most {MAX_BYTES}")
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except RecursionError:
        refuse_usage(f"{path} is no TOML that can be read: it is nested too deeply")
    except ValueError as error:
        refuse_usage(f"{path} is no TOML: {error}")
