"""Digests that tell whether a log is still as a ledger says, and whether it was done with the same settings."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack import objects
from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location, Url
from mcaptrack.log import results_path

#: Bytes at the end of a file that count: in MCAP they hold the summary, with the number and the sizes of all chunks.
_TAIL: Final = 65536


def digest_of_log(path: Location) -> str:
    """Return a digest of a log and of the results beside it; "" if it can't be read.

    It is made of sizes, times of modification and the ends of the files: reading all of a night's recordings to learn
    that nothing has changed would take longer than many commands.
    """
    if isinstance(path, Url):
        return _digest_in_store(path)
    total = hashlib.sha256()
    try:
        results = results_path(path)
        for part in dict.fromkeys((path, results)):
            if part is results and part != path and not part.exists():
                continue
            if part.is_dir():
                total.update(_about_folder(part))
                continue
            with part.open("rb") as stream:
                about = os.fstat(stream.fileno())
                stream.seek(max(0, about.st_size - _TAIL))
                total.update(f"{about.st_size} {about.st_mtime_ns} ".encode())
                total.update(stream.read(_TAIL))
    except OSError:
        return ""
    return total.hexdigest()[:32]


def _about_folder(folder: Path) -> bytes:
    """Return the names, sizes and times of the files in a folder: of pictures, or of a bag."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    stats = [(path, path.stat()) for path in files]
    lines = [f"{path.relative_to(folder)} {about.st_size} {about.st_mtime_ns}\n" for path, about in stats]
    return "".join(lines).encode("utf-8", "surrogateescape")


def _digest_in_store(url: Url) -> str:
    try:
        parts = [objects.find(part) for part in dict.fromkeys((url, results_path(url)))]
    except McaptrackError:
        return ""
    return hashlib.sha256(repr([part and tuple(part) for part in parts]).encode()).hexdigest()[:32] if parts[0] else ""


def digest_of_settings(*settings: object) -> str:
    """Return a digest of a function and its options; it is the same in every process."""
    text = json.dumps([_plain(setting) for setting in settings], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _plain(value: Any) -> Any:
    """Return a value as values of JSON, such that equal settings are equal."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, os.PathLike):
        return [os.path.abspath(value), _content(Path(value))]
    if isinstance(value, partial):
        return [_plain(value.func), _plain(value.args), _plain(value.keywords)]
    if is_dataclass(value) and not isinstance(value, type):
        return [_name(type(value)), {field.name: _plain(getattr(value, field.name)) for field in fields(value)}]
    if isinstance(value, Mapping):
        return {str(key): _plain(member) for key, member in value.items()}
    if isinstance(value, AbstractSet):
        return sorted((_plain(member) for member in value), key=repr)
    if isinstance(value, Sequence) and not isinstance(value, bytes):
        return [_plain(member) for member in value]
    if callable(value) and hasattr(value, "__qualname__"):
        return _name(value)
    return [_name(type(value)), hashlib.sha256(pickle.dumps(value, protocol=5)).hexdigest()]


def _name(value: Any) -> str:
    return f"{value.__module__}:{value.__qualname__}"


def _content(path: Path) -> str:
    """Return a digest of a file that an option names; "" for one that isn't there, and for a folder."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError:
        return ""
