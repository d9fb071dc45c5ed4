"""Names of logs and channels as names of folders: they can't leave the folder, and do not collide."""

from __future__ import annotations

import os
import re
import unicodedata
from typing import Final

from mcaptrack.location import Location, shortened

#: Longer names are cut, with a digest of the whole name; file systems allow 255 bytes.
_MAX_BYTES: Final = 200


#: Words that readers of partitions do not take for text.
_NO_TEXT: Final = ("nan", "inf", "infinity", "true", "false", "null", "none")


def recording_name(path: Location) -> str:
    """The name of a log for a path and a partition: without slashes, equals signs and leading dots.

    Names that readers would take for numbers or dates (0001 would become 1) get "log-" before them.
    """
    name = shortened(re.sub(r"[^\w.\-]+", "_", path.stem).lstrip(".") or "log", _MAX_BYTES)
    is_text = re.search(r"[^\W\d_]", name) and not re.fullmatch(r"[-\d._]*e[-\d]+", name, re.IGNORECASE)
    return name if is_text and name.lower().lstrip("-") not in _NO_TEXT else f"log-{name}"


def recording_key(name: str) -> str:
    """The name of a recording without capitals and composed letters, which some file systems don't tell apart."""
    return unicodedata.normalize("NFC", name).casefold()


def file_name(path: Location) -> str:
    """The name of a file as text; bytes that are not UTF-8 are escaped, because tables hold only text."""
    return os.fsencode(path.name).decode("utf-8", "backslashreplace")


def topic_folder(topic: str) -> str:
    """The folder of a channel's table: /imu/data -> imu.data; other signs as %XX, so that no two channels share one."""
    body = topic.removeprefix("/")
    parts = (
        "".join(c if c.isascii() and (c.isalnum() or c in "_-") else _escaped(c) for c in p) for p in body.split("/")
    )
    name = ".".join(parts)
    name = name or "%2F" * len(topic)
    return shortened(name if topic.startswith("/") and name.strip(".") else "~" + name, _MAX_BYTES)


def _escaped(character: str) -> str:
    return "".join(f"%{byte:02X}" for byte in character.encode("utf-8", "surrogatepass"))
