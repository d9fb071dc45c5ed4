"""Parts of all readers of label files: text of numbers, line by line, and names of classes, tracks and pictures.

Letters: N rows, C columns.
"""

from __future__ import annotations

import re
from array import array
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable, Iterable, Iterator, Sequence
from io import TextIOWrapper
from pathlib import Path, PurePath
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.files import unreadable, visible
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.sources.ingest import plain_yaml
from mcaptrack.sources.ingest.decompression import opened
from mcaptrack.sources.ingest.labels.table import NO_CLASS, NO_ID, BoxTable, refuse

#: Line numbers and lines, without empty lines and comments.
Lines = Iterator[tuple[int, str]]

MAX_ROWS: Final = 10_000_000
#: The largest number of characters of a row of numbers.
MAX_ROW: Final = 4096
_UTF16: Final = (BOM_UTF16_LE, BOM_UTF16_BE)
#: The number of characters of a line that errors show.
_LINE_SHOWN: Final = 60
#: The number of class names of a file, at most: there are data sets with 21,841 classes.
MAX_NAMES: Final = 65_536
MAX_NAME: Final = 256


def lines_of(path: Path, most: int = MAX_ROW, has_comments: bool = False) -> Lines:
    """The lines of a text file, perhaps packed, of at most ``most`` characters, without empty lines and, unless they
    are wanted, comments.

    Raises McaptrackError if it can't be read, isn't text, or has longer lines.
    """
    try:
        with opened(path) as data:
            is_wide = data.read(2) in _UTF16
            data.seek(0)
            stream = TextIOWrapper(data, "utf-16" if is_wide else "utf-8-sig")
            number = 0
            while line := stream.readline(most + 1):
                number += 1
                if len(line) > most:
                    raise McaptrackError(f"{path}:{number}: a line of more than {most} characters is no row")
                if is_wide and "\0" in line:
                    raise UnicodeError
                if line.strip() and (has_comments or not line.lstrip().startswith("#")):
                    yield number, line
    except UnicodeError:
        raise McaptrackError(f"{path} is not text in UTF-8 or UTF-16; save it as UTF-8") from None
    except OSError as error:
        raise unreadable(path, error) from None


def is_count(text: str, digits: int) -> bool:
    """Whether a text is a whole number from 0 on, with at most so many digits."""
    return text.isascii() and text.isdecimal() and len(text) <= digits


def states_number(text: str) -> bool:
    """Whether a text is a number, as Python reads it."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def split(line: str) -> list[str]:
    """Split a line at commas, or at blanks if it has no commas."""
    return [part.strip() for part in line.split(",")] if "," in line else line.split()


def check_columns(parts: Sequence[str], least: int, most: int) -> None:
    """Raise ValueError if a line has fewer or more parts."""
    if not least <= len(parts) <= most:
        raise ValueError(f"{len(parts)} column{'s' * (len(parts) != 1)}")


class Numbers(NamedTuple):
    """Rows of numbers (N, C), and the place of a row in messages."""

    values: Floats
    at: Callable[[int], str]


def read_numbers(
    path: Path,
    lines: Lines,
    what: str,
    columns: int,
    parse: Callable[[list[str]], Sequence[float]] | None = None,
    split: Callable[[str], list[str]] = split,
) -> Numbers:
    """Read lines of numbers.

    ``parse`` converts the parts of a line to C numbers, and raises ValueError if they are not a valid row; without it
    they are the numbers. ``what`` names the format and its columns. Raises McaptrackError, with the line, for an
    invalid row and for too many rows.
    """
    values, numbers = array("d"), array("q")
    for number, line in lines:
        try:
            parts = split(line)
            if parse is None:
                check_columns(parts, columns, columns)
            values.extend(parse(parts) if parse else map(float, parts))
        except ValueError as error:
            why = str(error) if "column" in str(error) else "not all are numbers"
            raise McaptrackError(f"{path}:{number}: not {what}, {why}: {line.strip()[:_LINE_SHOWN]}") from None
        numbers.append(number)
        if len(numbers) > MAX_ROWS:
            raise McaptrackError(
                f"{path} has more than {MAX_ROWS} rows; give it in parts, or as detections or tracks of "
                "MOTChallenge, sorted by frame"
            )
    places: Ints = np.frombuffer(numbers, np.int64)
    return Numbers(np.frombuffer(values, np.float64).reshape(-1, columns), lambda row: f"{path}:{places[row]}")


def as_boxes(corners: Floats) -> Floats:
    """Boxes (N, 4) of left, top, width, height from left, top, right, bottom."""
    return np.concatenate([corners[:, :2], corners[:, 2:] - corners[:, :2]], axis=1)


class ClassNames:
    """The class names of a column, numbered from 0 in order of appearance."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}

    @property
    def names(self) -> dict[int, str]:
        """The names by their numbers."""
        return {number: name for name, number in self._numbers.items()}

    def number(self, name: str) -> int:
        """The number of a name; ``NO_CLASS`` for a blank. Raises ValueError if there are too many names."""
        name = " ".join(name.split())[:MAX_NAME]
        if not name:
            return NO_CLASS
        if name not in self._numbers and len(self._numbers) == MAX_NAMES:
            raise ValueError(f"the column of classes has more than {MAX_NAMES:,} names")
        return self._numbers.setdefault(name, len(self._numbers))


# Ids of tracks that are texts, and frames that are named by pictures.


_NUMBERED: Final = re.compile(r"(.*?)([0-9]{1,18})(\D*)", re.DOTALL)
#: What Roboflow appends to the names of pictures, a hash among it.
_HASHED: Final = re.compile(r"(_(jpe?g|png|bmp|webp))?\.rf\.[0-9A-Za-z]{8,64}$", re.IGNORECASE)
#: So many texts are read as ids of tracks, at most; the number that stands for the first; so many are listed.
_MAX_TEXTS: Final = 1_000_000
_TEXTS: Final = -(2**40)
_TEXTS_SHOWN: Final = 3


class TrackIds:
    """Track ids of a file: as they are if all are numbers, otherwise numbered from 1 on as they come."""

    def __init__(self) -> None:
        self._texts: dict[str, int] = {}

    def number(self, text: str) -> float:
        """A negative number for a text, until all are known. Raises ValueError if there are too many."""
        if text not in self._texts and len(self._texts) == _MAX_TEXTS:
            raise ValueError(f"the column of ids has more than {_MAX_TEXTS:,} texts")
        return float(_TEXTS - self._texts.setdefault(text, len(self._texts)))

    def of(self, path: Path, values: Floats) -> tuple[Floats, list[str]]:
        """The ids of rows (N,), and remarks, from numbers (N,) of the file and of ``number``; NaN is no id."""
        ids = np.nan_to_num(values, nan=NO_ID)
        if not self._texts:
            return ids, []
        has_id = ids != NO_ID
        _, first, which = np.unique(ids[has_id], return_index=True, return_inverse=True)
        rank = np.empty(len(first), np.int64)
        rank[np.argsort(first)] = np.arange(1, len(first) + 1)
        ids[has_id] = rank[which]
        first_texts = list(self._texts)[:_TEXTS_SHOWN]
        shown = [f"{text!r:.40} is {int(ids[(values == self.number(text)).argmax()])}" for text in first_texts]
        said = f"its ids are texts; tracks are numbered from 1 on as they come: {', '.join(shown)}"
        return ids, [f"{path}: {said}{', ...' if len(self._texts) > len(shown) else ''}"]


def are_numbers(texts: Iterable[str]) -> bool:
    """Whether all track ids are whole numbers, so that they stay as they are."""
    return all(is_count(text.removesuffix(".0"), 16) for text in texts)


def numbered(texts: list[str]) -> Ints:
    """Track ids (N,): the texts as numbers if all are, otherwise numbered from 1 on as they come."""
    if are_numbers(texts):
        return np.array([int(text.removesuffix(".0")) for text in texts], np.int64)
    numbers: dict[str, int] = {}
    return np.array([numbers.setdefault(text, len(numbers) + 1) for text in texts], np.int64)


class FrameNames:
    """Frame numbers from names of pictures: "cam_000012.jpg" is 12. All names have to be of one sequence."""

    def __init__(self) -> None:
        self._around: tuple[str, str] | None = None

    def number(self, name: str) -> int:
        """The number of a name. Raises ValueError if it has none, or if names differ in more than their number."""
        match = _NUMBERED.fullmatch(_HASHED.sub("", PurePath(name.replace("\\", "/")).stem))
        if match is None:
            raise ValueError("the column of frames holds names without a number")
        around = (match[1], match[3])
        self._around = self._around or around
        if around != self._around:
            names = f"{''.join(self._around)!r:.40} and {''.join(around)!r:.40}"
            raise ValueError(f"the column of frames has names of several sequences, {names}")
        return int(match[2])


def headings(quaternions: Floats, path: Path, at: Callable[[int], str]) -> tuple[Floats, Floats]:
    """The heading of boxes (N,) by their quaternions (N, 4) of w, x, y, z, and their tilt (N,): of their z from up.

    Raises McaptrackError if they are no rotations, or if z of most boxes isn't up.
    """
    length = np.linalg.norm(quaternions, axis=1)
    refuse(at, ~(np.abs(length - 1) < 0.1), lambda row: f"a quaternion of length {length[row]:g} is no rotation")
    w, x, y, z = (quaternions / length[:, None]).T
    tilt = np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1))
    if len(tilt) and np.median(tilt) > np.pi / 4:
        raise McaptrackError(
            f"{path}: z of the boxes is {np.degrees(np.median(tilt)):.0f} degrees from up; it has to be up"
        )
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), tilt


LISTS: Final = ("labels.txt", "classes.txt", "obj.names", "_classes.txt")
_YAML: Final = ("data.yaml", "data.yml", "dataset.yaml")
#: A line of a list that states its number: `2: person`, `2 person`, `2,person`.
_WITH_NUMBER: Final = re.compile(r"([0-9]{1,9})(?: ?[:=,] ?| )(\D.*)")


def name_classes(table: BoxTable, folders: Iterable[Path], first: int) -> None:
    """Name the classes of a table by a file in the first of ``folders`` that has one.

    Names in a list count from ``first``, where it states no numbers. What can't be read is said.
    """
    for folder in dict.fromkeys(folders):
        others = visible(folder.glob("*.names")) if folder.is_dir() else []
        for path in (*(folder / name for name in (*LISTS, *_YAML)), *others[:1]):
            if not path.is_file() or path == table.path:
                continue
            try:
                names = _of_yaml(path) if path.name in _YAML else _of_list(path, first)
            except McaptrackError as error:
                table.find(f": {error}; class names are not known", "classes")
                continue
            if names:
                table.facts.names, table.facts.named_by = names, str(path)
                table.remark(f": class names by {path}")
                return


def _of_list(path: Path, first: int) -> dict[int, str]:
    lines = [" ".join(line.split())[:MAX_NAME] for _, line in lines_of(path)]
    numbered = [match for match in map(_WITH_NUMBER.fullmatch, lines) if match]
    if len(numbered) == len(lines) == len({int(match[1]) for match in numbered}):
        return {int(match[1]): match[2] for match in numbered}
    return dict(enumerate(lines[:MAX_NAMES], start=first))


def _of_yaml(path: Path) -> dict[int, str]:
    """The field "names" of a data.yaml: a list, or a map from numbers to names."""
    with path.open("rb") as stream:
        data = stream.read(plain_yaml.MAX_BYTES + 1)
    try:
        content: Any = plain_yaml.load(data)
    except plain_yaml.UnsupportedYamlError as error:
        raise McaptrackError(f"{path} is not valid YAML ({str(error)[:200]})") from None
    names = content.get("names") if isinstance(content, dict) else None
    if isinstance(names, list):
        names = {str(number): name for number, name in enumerate(names)}
    if not isinstance(names, dict) or not names:
        return {}
    if not all(isinstance(name, str) and is_count(key, 9) for key, name in names.items()):
        raise McaptrackError(f"{path}: `names` is neither a list of names nor a map from numbers to names")
    return {int(key): " ".join(str(name).split())[:MAX_NAME] for key, name in names.items()}
