"""Formats of labels: each is a class in a module of its own, and a line in the registry.

To add one, write a module like ``sdd``, name it in ``registry.BUILT_IN["label_format"]``, and add a file of it to
tests/test_border.py. Nothing else names a format.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.files import read_beginning, read_json
from mcaptrack.sources.ingest.labels.table import Asked, BoxTable
from mcaptrack.sources.ingest.labels.text import MAX_ROW, Lines, lines_of, split

_BEGIN_BYTES: Final = 4096
#: The largest number of characters of a row.
MAX_LINE: Final = 65536
_MAX_BYTES: Final = 512 * 2**20
_SHOWN: Final = 60
#: The way that is open for all labels, for messages.
WAY: Final = "labels can be written as CSV with a header, such as frame,id,x,y,w,h,score,class"


class LabelFile:
    """A file or folder that may hold labels, of which formats look at the beginning; what was read is kept."""

    def __init__(self, path: Path, lines: Lines | None = None) -> None:
        self.path, self._lines = path, lines

    @cached_property
    def is_folder(self) -> bool:
        """Whether it is a folder."""
        return self.path.is_dir()

    @cached_property
    def head(self) -> bytes:
        """Its first bytes without blanks before them; of a folder, and of what can't be read, none."""
        try:
            return read_beginning(self.path, _BEGIN_BYTES).removeprefix(b"\xef\xbb\xbf").lstrip()
        except McaptrackError:
            return b""

    @cached_property
    def row(self) -> str:
        """Its first row, without comments; "" if it has none, as JSON, XML and what isn't text."""
        is_other = self.is_folder or b"\0" in self.head.partition(b"\n")[0] or self.head[:1] in (b"{", b"[", b"<")
        try:
            return "" if is_other else next(lines_of(self.path, MAX_LINE), (0, ""))[1]
        except McaptrackError:
            return ""

    @cached_property
    def cells(self) -> list[str]:
        """The parts of its first row."""
        return split(self.row)

    @property
    def is_json(self) -> bool:
        """Whether it begins as a JSON list or object does."""
        return self.head[:1] in (b"{", b"[")

    @cached_property
    def json(self) -> Any:
        """Its content as JSON. Raises McaptrackError if it is none."""
        return read_json(self.path, "JSON", _MAX_BYTES)

    @cached_property
    def keys(self) -> list[str]:
        """The keys of its JSON object, or of the first one in its list; none if it is no JSON."""
        try:
            content = self.json if self.is_json else {}
        except McaptrackError:
            return []
        content = content[0] if isinstance(content, list) and content else content
        return list(content) if isinstance(content, dict) else []

    def lines(self, most: int = MAX_ROW) -> Lines:
        """Its lines as ``lines_of`` gives them. Raises McaptrackError if it isn't text."""
        return lines_of(self.path, most) if self._lines is None else self._lines

    def unknown(self, formats: str) -> McaptrackError:
        """The error for a file of none of these formats, with what it is instead, and what to do."""
        of_none = f"of no label format ({formats}); {WAY}"
        if self.is_folder:
            return McaptrackError(f"{self.path} is a folder {of_none}")
        if self.is_json and (rows := self._json_lines):
            keys = f" with {', '.join(rows)}"[:300]
            return McaptrackError(f"{self.path} is JSON in lines (objects{keys}) {of_none}")
        if self.is_json and self.json != []:
            kind = "an object" if isinstance(self.json, dict) else "a list"
            keys = f" with {', '.join(self.keys)}"[:300] if self.keys else ""
            return McaptrackError(f"{self.path} is JSON ({kind}{keys}) {of_none}")
        number, line = next(lines_of(self.path, MAX_LINE), (0, ""))
        if not number or self.is_json:
            return McaptrackError(f"{self.path} holds no boxes")
        text = f"a row of {len(split(line))} columns fits no label format ({formats}): {line.strip()[:_SHOWN]}"
        return McaptrackError(f"{self.path}:{number}: {text}; {WAY}")

    @property
    def _json_lines(self) -> list[str]:
        """The keys of the first object of a file with an object in each line; none if it is no such file."""
        try:
            objects = [json.loads(line) for _, line in islice(lines_of(self.path, MAX_LINE), 2)]
        except (McaptrackError, ValueError, RecursionError):
            return []
        is_each = len(objects) > 1 and all(isinstance(entry, dict) for entry in objects)
        return list(objects[0]) if is_each else []


class Format:
    """A format of labels.

    ``title`` and ``row`` describe it in documents, ``takes`` are options that it reads. ``in_parts``: a row says all
    about itself, so that long files may be read in parts.
    """

    title: ClassVar[str] = ""
    row: ClassVar[str] = ""
    takes: ClassVar[tuple[str, ...]] = ()
    in_space: bool = False
    reads_folders: ClassVar[bool] = False
    in_parts: ClassVar[bool] = False

    def recognises(self, file: LabelFile) -> bool:
        """Whether a file is of this format, by its beginning, or by the keys of its JSON."""
        raise NotImplementedError

    def holds_3d(self, file: LabelFile, columns: Mapping[str, str]) -> bool:
        """Whether a file of this format holds boxes in metres."""
        return self.in_space

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a file. Raises McaptrackError, with the place in it, if it isn't of this format."""
        raise NotImplementedError
