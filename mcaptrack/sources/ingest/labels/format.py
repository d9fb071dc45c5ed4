"""Formats of labels: each is a class in a module of its own, and an entry point, or in the core a line in the registry.

To add one, write a module of an extension, name it in pyproject.toml, and write a test with a file of it.
"""

from __future__ import annotations

import json
import re
from codecs import BOM_UTF8, BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Mapping
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, Final

from mcaptrack.errors import McaptrackError, call, list_names
from mcaptrack.files import read_json, visible
from mcaptrack.installed import missing_parts
from mcaptrack.registry import names
from mcaptrack.sources.ingest.decompression import opened
from mcaptrack.sources.ingest.labels.table import Asked, BoxTable
from mcaptrack.sources.ingest.labels.text import MAX_ROW, Lines, lines_of, split
from mcaptrack.sources.video.image_folder import IMAGE_SUFFIXES, instead_of_images, natural_order

_BEGIN_BYTES: Final = 4096
#: The largest number of characters of a row.
MAX_LINE: Final = 65536
_MAX_BYTES: Final = 512 * 2**20
_SHOWN: Final = 60
_LISTED: Final = 10
#: The first element of XML, after what may stand before it.
_ROOT: Final = re.compile(rb"\s*(?:<[?!][^>]*>\s*)*<([\w.-]+)")
#: Where labels lie in the folders that data sets and tools have, the most particular first.
PLACES: Final = (
    *("gt/gt.txt", "det/det.txt", "annotations/instances_*.json", "annotations/*.json", "annotations/*.csv"),
    *("labels/*", "obj_*_data", "Annotations", "Annotations/*", "label_2", "*/label_2"),
    *("annotations.xml", "default.xml", "result.json"),
)
#: What begins so is no text, and never labels: its kind, and what to do.
_OTHERS: Final = {
    b"PK\x03\x04": "an Excel workbook or another zip file; save the table as CSV or Parquet",
    b"MATLAB": "a file of MATLAB; save its table as CSV (writetable)",
    b"\x89HDF": "an HDF5 file; save its table as CSV or Parquet",
    b"\x93NUMPY": "an array of NumPy; save it with numpy.savetxt and a header that names its columns, or as CSV",
    b"\x80": "a pickle of Python, which could run anything; save it as CSV, Parquet or JSON",
    b"FEA1": "a table of Feather V1; save it as Parquet, or as Feather V2",
}


class LabelFile:
    """A file or folder that may hold labels, of which formats look at the beginning; what was read is kept."""

    def __init__(self, path: Path, lines: Lines | None = None) -> None:
        self.path: Path = path
        self._lines = lines

    @cached_property
    def is_folder(self) -> bool:
        """Whether it is a folder."""
        return self.path.is_dir()

    @cached_property
    def head(self) -> bytes:
        """Its first bytes without blanks before them; of a folder, and of what can't be read, none."""
        try:
            if self.is_folder:
                return b""
            with opened(self.path) as stream:
                data = stream.read(_BEGIN_BYTES)
            is_wide = data.startswith((BOM_UTF16_LE, BOM_UTF16_BE))
            data = data.decode("utf-16", "ignore").encode() if is_wide else data
            return data.removeprefix(BOM_UTF8).lstrip()
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

    @cached_property
    def entries(self) -> list[Path]:
        """The content of a folder, in natural order."""
        return sorted(visible(self.path.iterdir()), key=natural_order) if self.is_folder else []

    @cached_property
    def root(self) -> str:
        """The name of the first element of XML; "" if it is none."""
        match = _ROOT.match(self.head)
        return match[1].decode("utf-8", "replace") if match else ""

    @property
    def holds_pictures(self) -> bool:
        """Whether a folder holds pictures."""
        return any(path.suffix.lower() in IMAGE_SUFFIXES for path in self.entries)

    def refuse_binary(self) -> None:
        """Raise McaptrackError for a kind of file that never holds labels, with what to do."""
        if not self.is_folder and not self.head:
            with opened(self.path):  # says so if it is packed and damaged
                pass
        for magic, kind in _OTHERS.items():
            if self.head.startswith(magic):
                raise McaptrackError(f"{self.path} is {kind}: that is read as labels{_not_installed()}")

    @property
    def is_json(self) -> bool:
        """Whether it begins as a JSON list or object does."""
        return self.head[:1] in (b"{", b"[")

    @cached_property
    def json(self) -> Any:
        """Its content as JSON. Raises McaptrackError if it is none."""
        return read_json(self.path, "JSON", _MAX_BYTES, opened)

    @cached_property
    def has_json_lines(self) -> bool:
        """Whether each of its first two lines is a JSON object."""
        lines = lines_of(self.path, MAX_LINE) if self.is_json else iter(())
        try:
            first = [line.strip() for _, line in islice(lines, 2)]
        except McaptrackError:
            return False
        return len(first) == 2 and all(line[0] == "{" and line[-1] == "}" for line in first)

    @cached_property
    def records(self) -> list[Any]:
        """Its content as a list: of JSON lines, of a JSON list, or of tables as pandas writes them; none of others.

        Raises McaptrackError if a line is no JSON.
        """
        if self.has_json_lines:
            return [self._of_line(number, line) for number, line in lines_of(self.path, MAX_LINE)]
        content = self.json if self.is_json else None
        if not isinstance(content, dict):
            return content if isinstance(content, list) else []
        columns = [*content.values()]
        if columns and all(isinstance(column, dict) and column.keys() == columns[0].keys() for column in columns):
            return [{name: content[name][row] for name in content} for row in columns[0]]
        return []

    def _of_line(self, number: int, line: str) -> Any:
        try:
            return json.loads(line)
        except (ValueError, RecursionError) as error:
            raise McaptrackError(f"{self.path}:{number}: not valid JSON: {str(error)[:200]}") from None

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

    def unknown(self) -> McaptrackError:
        """The error for a file of no known format, with what it is instead."""
        instead = self._instead()
        return McaptrackError(f"{instead}{_not_installed()}" if instead else f"{self.path} holds no boxes")

    def _instead(self) -> str:
        formats = ", ".join(names("label_format"))
        if self.is_folder:
            held = list_names([path.name for path in self.entries], _LISTED) or "nothing"
            hint = instead_of_images(self.entries)
            hint = hint or "; give the label file, or the folder that label files lie in, with `label_format=`"
            looked = f"looked in {', '.join(PLACES)}, and in itself for files of {formats}"
            return (
                f"{self.path} holds no images ({', '.join(IMAGE_SUFFIXES)}) and no labels that are known; {looked}; "
                f"it holds {held}{hint}"
            )
        if self.is_json and self.json != []:
            kind = "an object" if isinstance(self.json, dict) else "a list"
            keys = f" with {', '.join(self.keys)}"[:300] if self.keys else ""
            is_of_pictures = {"data", "annotations"} <= set(self.keys) or "annotation_id" in self.keys
            hint = "; export tasks of Label Studio with pictures as COCO or Pascal VOC" if is_of_pictures else ""
            return f"{self.path} is JSON ({kind}{keys}) of no label format ({formats}){hint}"
        if self.root:
            return f"{self.path}:1: XML that begins with <{self.root[:40]}> is of no label format ({formats})"
        number, line = next(lines_of(self.path, MAX_LINE), (0, ""))
        if not number or self.is_json:
            return ""
        text = f"a row of {len(split(line))} columns fits no label format ({formats}): {line.strip()[:_SHOWN]}"
        if "," in line and any(cell[:1].isalpha() for cell in split(line)):
            text += "; a table with names of classes needs a first line that names its columns, separated by commas, "
            text += "semicolons or tabs: frame,id,class,left,top,width,height,score"
        if [len(split(line)) for _, line in islice(lines_of(self.path, MAX_LINE), 4)] == [3, 3, 3]:
            text += f"; a ground plane is given with the video: {call('ingest', 'VIDEO', ground_plane=self.path)}"
        return f"{self.path}:{number}: {text}"


def _not_installed() -> str:
    missing = missing_parts("label_format")
    return f"; {missing}" if missing else ""


class Format:
    """A format of labels.

    ``title`` and ``row`` describe it in documents, ``takes`` are options that it reads. ``in_parts``: a row says all
    about itself, so that long files may be read in parts. ``rank``: of several that recognise a file, the one with the
    least reads it, or else the first by name; it is below 0 where a wider format recognises the same files, and above 0
    for what recognises any table or folder. ``name`` is that of its entry.
    """

    name: str = ""
    rank: ClassVar[int] = 0
    title: ClassVar[str] = ""
    row: ClassVar[str] = ""
    takes: ClassVar[tuple[str, ...]] = ()
    in_space: bool = False
    reads_folders: ClassVar[bool] = False
    reads_files: ClassVar[bool] = True
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
