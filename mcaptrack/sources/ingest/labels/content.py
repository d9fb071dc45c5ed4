"""The table of boxes that label files become, whatever their format: its checks, its classes, and what is said of it.

``Labels`` are boxes, or positions, of pictures; ``BoxRows3D`` are boxes in metres.

Letters: N rows, F frames, C classes.
"""

from __future__ import annotations

import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any, ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray

from mcaptrack.choices import LabelFormat, Role
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.files import refuse_special
from mcaptrack.geometry.angles import wrapped
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S
from mcaptrack.geometry.oriented_boxes import COLUMNS
from mcaptrack.notices import Code
from mcaptrack.schema.classes import PEOPLE, PERSON, UNKNOWN, is_person
from mcaptrack.schema.provenance import Plugin

#: The name of a format: a built-in one, or of another package.
Format = LabelFormat | str
#: Formats that hold 3D boxes alone; tables ("csv") may hold either.
FORMATS_3D: Final[tuple[str, ...]] = ("kitti-3d", "nuscenes", "argoverse")
#: Formats of data sets: their boxes suit the pictures. Those of other formats are checked against the pictures.
DATA_SETS: Final = ("mot", "kitti", "sdd", "trajnet", "obsmat")
ClassIds = NDArray[np.uint32]

#: The id of a row without a track, and the class of a row that states none.
NO_ID: Final = -1
NO_CLASS: Final = -1
#: The number of the first picture, until it is known.
UNKNOWN_FIRST: Final = -1
_MAX_CLASS: Final = 2**31 - 1
#: Formats in which labels at regular steps are the rule.
_POSITIONS: Final = ("trajnet", "obsmat")
#: With fewer labelled frames a regular step of boxes may be a coincidence.
_SPARSE_FRAMES: Final = 3


# Read text files of numbers line by line, within limits; errors name the line.
#
# Letters: N rows, C columns.


#: Line numbers and lines, without empty lines and comments.
Lines = Iterator[tuple[int, str]]

_MAX_ROWS: Final = 10_000_000
_MAX_LINE: Final = 4096
#: Integers from here on are not exact as float64.
EXACT: Final = 2**53
#: Coordinates, in pixels or metres, and scores can't be larger.
MAX_PLACE: Final = 1e8
MAX_SCORE: Final = 1e9
MAX_FRAME: Final = 2**31 - 1
#: The name of the column of frames in messages.
FRAME: Final = "the frame (a count of pictures, no time)"
#: The number of characters of a line that errors show.
_LINE_SHOWN: Final = 60


def lines_of(path: Path, most: int = _MAX_LINE, has_comments: bool = False) -> Lines:
    """The lines of a text file, of at most ``most`` characters, without empty lines and, unless they are wanted,
    comments.

    Raises McaptrackError if it can't be read, isn't text, or has longer lines.
    """
    refuse_special(path)
    try:
        with path.open(encoding="utf-8-sig") as stream:
            number = 0
            while line := stream.readline(most + 1):
                number += 1
                if len(line) > most:
                    raise McaptrackError(f"{path}:{number}: a line of more than {most} characters is no row")
                if line.strip() and (has_comments or not line.lstrip().startswith("#")):
                    yield number, line
    except UnicodeDecodeError:
        raise McaptrackError(f"{path} is not text in UTF-8, as labels and homographies are") from None
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror}") from None


def is_count(text: str, digits: int) -> bool:
    """Whether a text is a whole number from 0 on, with at most so many digits."""
    return text.isascii() and text.isdecimal() and len(text) <= digits


def split(line: str) -> list[str]:
    """Split a line at commas, or at blanks if it has no commas."""
    return [part.strip() for part in line.split(",")] if "," in line else line.split()


def check_columns(parts: Sequence[str], least: int, most: int) -> None:
    """Raise ValueError if a line has fewer or more parts."""
    if not least <= len(parts) <= most:
        raise ValueError(f"{len(parts)} column{'s' * (len(parts) != 1)}")


class CheckedRows:
    """Rows of a file, with errors that name the place of a row in the file, by ``at``."""

    at: Callable[[int], str]

    def refuse(self, wrong: Any, describe: Callable[[int], str]) -> None:
        """Raise McaptrackError for the first row where ``wrong`` (N,) is true, with its text by ``describe``."""
        if wrong.any():
            row = int(wrong.argmax())
            raise McaptrackError(f"{self.at(row)}: {describe(row)}")

    def whole(self, values: NDArray[Any], what: str, least: int, most: int = EXACT - 1) -> Ints:
        """Values (N,) as whole numbers."""
        wrong = ~((values == np.rint(values)) & (values >= least) & (values <= most))
        self.refuse(wrong, lambda row: f"{what} has to be a whole number from {least} to {most}, not {values[row]:g}")
        return values.astype(np.int64)

    def check_places(self, places: Floats, what: str = "a coordinate", unit: str = "") -> None:
        """Check that no coordinate (N, C) is too large."""
        largest = np.abs(places).max(axis=1, initial=0)
        text = f"at most {MAX_PLACE:g}{unit}"
        self.refuse(largest > MAX_PLACE, lambda row: f"{what} can't be {largest[row]:g}; {text}")

    def check_boxes(self, boxes: Floats) -> None:
        """Check that boxes (N, 4) of left, top, width, height can be some."""
        self.refuse(~np.isfinite(boxes).all(axis=1), lambda _: "a number of the box is missing or not finite")
        self.check_places(boxes)
        self.refuse(
            (boxes[:, 2:] < 0).any(axis=1),
            lambda row: f"a box can't be {boxes[row, 2]:g} wide and {boxes[row, 3]:g} high",
        )

    def check_scores(self, score: Floats) -> None:
        """Check that no score (N,) is too large."""
        self.refuse(np.abs(score) > MAX_SCORE, lambda row: f"a score can't be {score[row]:g}")


class NumberTable(CheckedRows):
    """Rows of numbers: ``values`` (N, C), and their line numbers ``line`` (N,).

    ``parse`` converts the parts of a line to C numbers, and raises ValueError if they are not a valid row; without it
    they are the numbers. ``what`` names the format and its columns. Raises McaptrackError, with the line, for an
    invalid row and for too many rows.
    """

    def __init__(
        self,
        path: Path,
        lines: Lines,
        what: str,
        columns: int,
        parse: Callable[[list[str]], Sequence[float]] | None = None,
        split: Callable[[str], list[str]] = split,
    ) -> None:
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
            if len(numbers) > _MAX_ROWS:
                raise McaptrackError(
                    f"{path} has more than {_MAX_ROWS} rows; give it in parts, or as detections or tracks of "
                    "MOTChallenge, sorted by frame"
                )
        self.values: Floats = np.frombuffer(values, np.float64).reshape(-1, columns)
        self.line: Ints = np.frombuffer(numbers, np.int64)
        places = self.line  # a place doesn't keep the values in memory
        self.at = lambda row: f"{path}:{places[row]}"


_SHOWN: Final = 8
#: Boxes that are cut off at the edge of the picture reach a little beyond its whole size.
_MOST_SHARE: Final = 2.0


@dataclass
class BoxTable(CheckedRows):
    """The rows of a label file, and what is known of the file as a whole.

    ``at`` names the place of a row in messages. ``frame`` (N,) is the number of its frame in the file, ``id`` (N,) that
    of its track or ``NO_ID``, ``boxes`` (N, ...) its box, ``score`` (N,) NaN where there is none, ``class_id`` (N,) the
    class as the file has it (``NO_CLASS``: none), and as the schema of detections has it once the rows are settled.
    ``classes`` are then names by class id. ``labelled`` (F,) are the frames that the file describes, with or without
    boxes; ``states_labelled``: the file says so, and it isn't concluded from the boxes. ``left_out`` describes the rows
    that were left out. ``remarks`` and ``doubts`` (warnings and their codes) say how the file was understood.
    ``plugin`` is the format, if it is of another package.
    """

    path: Path
    format: Format
    at: Callable[[int], str]
    frame: NDArray[Any]
    id: NDArray[Any]
    boxes: Floats | None
    score: Floats
    class_id: NDArray[Any]
    classes: Mapping[int, str] = field(default_factory=dict)
    left_out: str = ""
    labelled: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    states_labelled: bool = False
    remarks: list[str] = field(default_factory=list)
    doubts: list[tuple[str, Code]] = field(default_factory=list)
    plugin: Plugin | None = None

    #: The fields with a value for each row.
    COLUMNS: ClassVar[tuple[str, ...]] = ("frame", "id", "boxes", "score", "class_id")

    @property
    def has_ids(self) -> bool:
        """Whether any row has a track id."""
        return bool((self.id != NO_ID).any())

    @property
    def is_of_data_set(self) -> bool:
        """Whether the format is that of a data set, and not of a detector or annotation tool."""
        return self.format in DATA_SETS

    def take(self, rows: Ints | Bools | slice) -> Self:
        """Select or reorder rows; facts about the file stay."""
        where, at = np.arange(len(self.frame))[rows], self.at
        columns: dict[str, Any] = {name: getattr(self, name) for name in self.COLUMNS}
        columns = {name: None if values is None else values[rows] for name, values in columns.items()}
        return replace(self, at=lambda row: at(int(where[row])), **columns)

    def keep(self, rows: Ints | Bools) -> Self:
        """Select rows, and of the names of classes those that occur in them."""
        occurring = set(np.unique(self.class_id[rows]).tolist())
        return replace(self.take(rows), classes={n: name for n, name in self.classes.items() if n in occurring})

    def with_boxes(self, numbers: Floats) -> Self:
        """Leave out rows of which all numbers (N, K) are missing; their frames stay labelled, without boxes."""
        has_box: Bools = np.asarray(~np.isnan(numbers).all(axis=1))
        if has_box.all():
            return self
        self.labelled = np.unique(self.frame)
        self.remark(f": {int((~has_box).sum())} rows have no box; they only say that frames exist")
        return self.take(has_box)

    def remark(self, text: str) -> None:
        """Say something about the file, after its name."""
        self.remarks.append(f"{self.path}{text}")

    def doubt(self, text: str, code: Code = "other") -> None:
        """Warn of something about the file, after its name."""
        self.doubts.append((f"{self.path}{text}", code))

    def assume_first(self, least: int) -> int:
        """The number of the first picture where frames begin with ``least``: 0 or 1, with a warning if it isn't 0."""
        first = min(least, 1)
        if least > 0:
            text = f": frames begin with {least}; frame {first} is assumed to be the first"
            self.doubt(f"{text} picture, `first_frame=` sets the number", "clock")
        return first

    def repeated_id(self) -> int:
        """The first row with the id of another one in its frame; -1 if there is none."""
        order = np.lexsort((self.id, self.frame))
        frame, track_id = self.frame[order], self.id[order]
        again = np.flatnonzero((frame[1:] == frame[:-1]) & (track_id[1:] == track_id[:-1])) + 1
        return int(order[again[0]]) if len(again) else -1

    def count_classes(self, rows: Bools) -> str:
        """The classes of some rows, each with their number."""
        counts = Counter(self.class_id[rows].tolist()).most_common()
        names = {UNKNOWN: "of unknown class", **self.classes}
        counted = [f"{count} {names.get(number, f'of class {number}')}" for number, count in counts[:_SHOWN]]
        more = sum(count for _, count in counts[_SHOWN:])
        return ", ".join(counted) + (f", {more} of other classes" if more else "")


@dataclass(frozen=True)
class IgnoredBoxes:
    """Labelled boxes that are not scored: frames (N,) as in the file, boxes (N, 4) in px.

    ``forgiven`` (N,): a track that is matched with the box is ignored, instead of counted as a false positive.
    ``region`` (N,): tracks inside the box without a match are ignored, too.
    """

    frame: Ints
    boxes_px: Floats
    forgiven: Bools
    region: Bools


@dataclass
class Labels(BoxTable):
    """Labels of pictures, as ``BoxTable``: boxes (N, 4) of left, top, width, height in pixels, or positions.

    ``first_frame`` is the number of the first picture; ``is_first_assumed``: the file doesn't tell. ``xy_m`` (N, 2) are
    positions, None if the format has none.
    ``crowd`` (N,) marks regions of people without boxes of their own; boxes of ground truth that don't count are in
    ``ignored``. ``is_normalised``: boxes are in shares of the picture's size. ``times_s`` (F,): the times of frames by
    the file itself; its frames are then numbered from 0. ``observed`` (N,): which boxes were seen, and not filled in or
    occluded, if the file says so. ``made_ids``: rising ids that are not of the file.
    """

    first_frame: int = 0
    is_first_assumed: bool = False
    xy_m: Floats | None = None
    crowd: Bools | None = None
    ignored: IgnoredBoxes | None = None
    is_normalised: bool = False
    times_s: Floats | None = None
    observed: Bools | None = None
    made_ids: Ints | None = None

    COLUMNS: ClassVar[tuple[str, ...]] = (*BoxTable.COLUMNS, "xy_m", "crowd", "observed")

    @property
    def boxes_px(self) -> Floats | None:
        """The boxes (N, 4); None if the format has positions."""
        return self.boxes

    @property
    def step(self) -> int:
        """The step of labelled frames: 12 if every twelfth frame is labelled."""
        return self.step_of(self.labelled)

    def step_of(self, frames: Ints) -> int:
        """The step of the numbers (F,) of labelled frames, which rise."""
        least = 2 if self.format in _POSITIONS else _SPARSE_FRAMES
        return int(np.gcd.reduce(np.diff(frames))) if len(frames) >= least else 1

    @property
    def has_boxes(self) -> bool:
        """Whether the rows have boxes in pixels."""
        return self.boxes is not None

    def frame_counts(self) -> tuple[Ints, Ints]:
        """The frames with rows (F,), sorted, and the number of rows of each."""
        return np.unique(self.frame, return_counts=True)

    def class_counts(self) -> tuple[ClassIds, Ints]:
        """The classes of rows (C,), sorted, and the number of rows of each."""
        return np.unique(self.class_id, return_counts=True)

    def corner_px(self) -> Floats:
        """The largest x and y (2,) of boxes, -inf without rows."""
        assert self.boxes is not None
        corner: Floats = (self.boxes[:, :2] + self.boxes[:, 2:]).max(axis=0, initial=-np.inf)
        return corner

    @property
    def parts(self) -> Sequence[Callable[[], Labels]]:
        """The rows in parts of whole frames, in their order: one part of all rows, except of long files."""
        return [lambda: self]

    def settled(self, role: Role, wanted: WantedClasses, names: Mapping[int, str] | None = None) -> Labels:
        """Check the rows, and take those that suit a role; tracks and ground truth are of ``wanted`` classes.

        ``names`` are those of the file's classes by number, None if it has none. Raises McaptrackError, with the row,
        if they can't be labels.
        """
        if not len(self.frame):
            raise McaptrackError(f"{self.path} holds no boxes")
        self.frame = self.whole(self.frame, FRAME, 0, MAX_FRAME)
        self.id = self.whole(self.id, "the id", NO_ID)
        number = self.whole(self.class_id, "the class", NO_CLASS, _MAX_CLASS)
        boxes = self.boxes
        assert boxes is not None
        self.check_boxes(boxes)
        self.check_scores(self.score)
        self.class_id, self.classes = self._class_ids(number, names)
        kept = self._kept(role, wanted)
        high, low = self.score > 1, self.score < 0
        if high.any() or low.any():
            parts = [f"{int(high.sum())} above 1 (up to {self.score[high].max():g})"] if high.any() else []
            parts += [f"{int(low.sum())} below 0"] if low.any() else []
            self.doubt(f": of {len(self.score)} scores {' and '.join(parts)}; they stay as they are")
        columns = np.column_stack([self.frame, self.id, self.class_id, boxes])
        if repeated := len(columns) - len(np.unique(columns, axis=0)):
            text = f": {repeated} of {len(columns)} boxes are there before, with the same frame and class"
            self.doubt(f"{text}; they stay as they are")
        self.labelled = np.union1d(self.labelled, self.frame)
        if self.first_frame == UNKNOWN_FIRST:
            self.first_frame = self.assume_first(int(self.labelled[0]))
            self.is_first_assumed = self.first_frame > 0
        crowd = self.crowd
        if role == "truth" and crowd is not None and crowd.any():
            self.ignored = IgnoredBoxes(self.frame[crowd], boxes[crowd], ~crowd[crowd], crowd[crowd])
        return self.keep(kept)

    def take_shares(self) -> None:
        """Take boxes as shares of the picture's size if they are fractions, and none is larger than shares are."""
        assert self.boxes is not None
        if (np.abs(self.boxes) <= _MOST_SHARE).all() and (self.boxes != np.rint(self.boxes)).any():
            self.is_normalised = True
            text = f": no number of a box is above {_MOST_SHARE:g}, so they are taken as shares of the picture's size"
            self.remark(text)

    def doubt_outside(self, size: Floats) -> None:
        """Warn of boxes that lie outside of pictures of this size (2,) or these sizes (N, 2), as a whole or by half of
        their area.
        """
        assert self.boxes is not None
        low, high = self.boxes[:, :2], self.boxes[:, :2] + self.boxes[:, 2:]
        beyond = ((low >= size) | (high <= 0)).any(axis=1)
        inner = np.maximum(np.minimum(high, size) - np.maximum(low, 0), 0).prod(axis=1)
        half = ~beyond & (inner < self.boxes[:, 2:].prod(axis=1) / 2)
        parts = [f"{int(beyond.sum())} lie outside of their pictures"] if beyond.any() else []
        parts += [f"{int(half.sum())} lie outside of their pictures by more than half"] if half.any() else []
        if parts:
            self.doubt(f": of {len(self.boxes)} boxes {' and '.join(parts)}; they stay as they are")

    def refuse_repeated_ids(self) -> None:
        """Raise McaptrackError if an id appears twice in a frame."""
        if self.has_ids and (row := self.repeated_id()) >= 0:
            raise McaptrackError(f"{self.path}: id {self.id[row]} appears twice in frame {self.frame[row]}")

    def fit(self, size: tuple[int, int]) -> None:
        """Fit boxes to pictures of a size in pixels: shares of it become pixels, and boxes outside of it a doubt."""
        if self.is_normalised and self.boxes is not None:
            self.boxes, self.is_normalised = self.boxes * np.array([*size, *size], float), False
        if self.format != "coco":  # has sizes of its own
            self.doubt_outside(np.array(size, float))

    def _kept(self, role: Role, wanted: WantedClasses) -> Bools:
        """Mask the rows that suit a role (N,), and describe the others."""
        crowd = np.zeros(len(self.frame), bool) if self.crowd is None else self.crowd
        others, lacks_id = np.zeros(len(crowd), bool), np.zeros(len(crowd), bool)
        if role != "detections":
            is_wanted = self.class_id == PERSON
            if not wanted.is_people:
                is_wanted = wanted.mask(self.path, self.class_id, self.classes)
            others = ~crowd & ~is_wanted
            lacks_id = ~crowd & ~others & (self.id == NO_ID) & self.has_ids
        left = [self.count_classes(others)] if others.any() else []
        left += [f"{int(crowd.sum())} regions of crowds (iscrowd)"] if crowd.any() else []
        left += [f"{int(lacks_id.sum())} boxes without a track id"] if lacks_id.any() else []
        kept = ~crowd & ~others & ~lacks_id
        self.left_out = " and ".join(left)
        if not kept.any():
            is_people = role != "detections" and wanted.is_people
            what, take = ("people", "; `classes=` takes others") if is_people else ("boxes", "")
            raise McaptrackError(f"{self.path} holds no {what}, only {self.left_out}{take}")
        return kept

    def _class_ids(self, kind: Ints, names: Mapping[int, str] | None) -> tuple[ClassIds, dict[int, str]]:
        """The class ids (N,) of the file's classes, and their names by class id, as the schema of detections has them.

        People are 1. Other classes keep their number, unless it is 0 (unknown) or 1, which become the next numbers
        after the largest. Without names, numbers that begin with 0 are taken to begin with people, as in COCO, and are
        raised by one. What is said about it is added to the rows.
        """
        stated = kind != NO_CLASS
        if not stated.any():
            self.remark(" states no classes; all boxes are taken as people")
            return np.full(len(kind), PERSON, np.uint32), {}
        if not stated.all():
            self.doubt(f": {int((~stated).sum())} boxes without a class have class_id 0", "classes")
        if names is None:
            begins_with_0 = bool((kind == 0).any()) or self.format == "yolo"
            text = ", and class_id is one higher than the file's numbers" if begins_with_0 else ""
            self.doubt(f" has no class names; class {int(not begins_with_0)} is taken as people{text}", "classes")
            return np.where(stated, kind + begins_with_0, UNKNOWN).astype(np.uint32), {}
        largest = max(max(names, default=0), PERSON)
        places: dict[int, int] = {}
        classes: dict[int, str] = {}
        for own_number, name in sorted(names.items()):
            if is_person(name):
                place = PERSON
            elif own_number > PERSON or (own_number == UNKNOWN and name.casefold() == "unknown"):
                place = own_number
            else:
                place = largest = largest + 1
            places[own_number] = place
            classes.setdefault(place, name)
        used = np.unique(kind[stated]).tolist()
        if nameless := [number for number in used if number not in places]:
            count = int(np.isin(kind, nameless).sum())
            shown = list_names([*map(str, nameless)], _SHOWN)
            self.doubt(f": {count} boxes have classes without a name ({shown}); their class_id is 0", "classes")
        moved = [f"{names[own]} ({own}) is {places[own]}" for own in used if places.get(own, own) != own]
        if moved:
            self.remark(f": in class_id 1 is a person: {list_names(moved, _SHOWN)}")
        ids = np.array([places.get(number, UNKNOWN) for number in used], np.uint32)
        out = np.full(len(kind), UNKNOWN, np.uint32)
        out[stated] = ids[np.searchsorted(used, kind[stated])]
        return out, classes


# Which classes of label files become tracks and ground truth. Letters: N rows, C classes.


_ALL: Final = "all"
_NAMED: Final = 10
_MAX_LISTED: Final = 20


@dataclass(frozen=True)
class WantedClasses:
    """Names or numbers of classes with commas between them, or "all".

    ``may_lack``: a file may lack some of them, as tracks may that are compared with ground truth.
    """

    text: str = "person"
    may_lack: bool = False

    @property
    def is_people(self) -> bool:
        """Whether people alone are wanted."""
        return is_person(self.text)

    def mask(self, path: Path, class_id: NDArray[np.integer], names: Mapping[int, str]) -> Bools:
        """Mask the rows (N,) of wanted classes; ``names`` are those of the file by class id.

        Raises McaptrackError for a class that the file doesn't have, or if there is none at all in the text.
        """
        if self.text.strip().casefold() == _ALL:
            return np.ones(len(class_id), bool)
        occurring = np.unique(class_id).tolist()
        by_name: dict[str, set[int]] = {}
        for number in occurring:
            by_name.setdefault(names.get(number, "").strip().casefold(), set()).add(number)
        wanted: set[int] = set()
        for word in (word.strip() for word in self.text.split(",")):
            numbers = by_name.get(word.casefold(), set()) if word else set()
            numbers = {PERSON} & {*occurring} if is_person(word) else numbers
            if not numbers and word.isascii() and word.isdecimal() and int(word[:12]) in occurring:
                numbers = {int(word)}
            if not numbers and not (self.may_lack and word):
                called = list_names([names.get(number) or f"{number}" for number in occurring], _NAMED)
                raise McaptrackError(f"{path} has no class {word!r:.60}; `classes=` takes {called}, or {_ALL}")
            wanted |= numbers
        return np.isin(class_id, sorted(wanted))


#: The default: people alone.
ONLY_PEOPLE: Final[WantedClasses] = WantedClasses()


def describe_classes(ids: NDArray[np.integer], counts: Ints, names: Mapping[int, str]) -> str:
    """List classes (C,), each with its name and the number of its rows."""
    called = [f"{number} {names.get(number, '')}".strip() for number in ids.tolist()]
    counted = [f"{name} ({count})" for name, count in zip(called, counts.tolist(), strict=True)]
    return list_names(counted, _MAX_LISTED)


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
        shown = [f"{text!r:.40} is {int(ids[(values == self.number(text)).argmax()])}" for text in self._first()]
        text = f"its ids are texts; tracks are numbered from 1 on as they come: {', '.join(shown)}"
        return ids, [f"{path}: {text}{', ...' if len(self._texts) > len(shown) else ''}"]

    def _first(self) -> list[str]:
        return list(self._texts)[:_TEXTS_SHOWN]


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


def numbers_of_names(names: list[str]) -> list[int] | None:
    """The frame numbers of pictures by their names; None if the names aren't numbered, or not uniquely."""
    reader = FrameNames()
    try:
        numbers = [reader.number(name) for name in names]
    except ValueError:
        return None
    return numbers if len(set(numbers)) == len(numbers) and max(numbers, default=0) <= MAX_FRAME else None


# 3D boxes: (N, 7) of x, y, z (the centre), length, width, height, heading, see ``geometry.oriented_boxes``; z is up.


#: Lengths are metres if the median lies between these.
_LEAST_LENGTH_M, _MOST_LENGTH_M = 0.05, 60.0
#: Headings are radians if none is larger than two turns.
_MOST_HEADING: Final = 4 * np.pi
#: Objects that are faster than this, in m/s, should move along their heading.
_MOVING_M_PER_S: Final = 1.0
_MANY_MOVING: Final = 20
_ALONG: Final = np.pi / 4
#: Positions that spread this much along z, and this little along y or x, in m, may have another vertical axis.
_WIDE_M, _FLAT_M = 20.0, 3.0
_SIZE: Final = slice(3, 6)


@dataclass
class BoxRows3D(BoxTable):
    """3D boxes, as ``BoxTable``: boxes (N, 7), of which missing sizes, heights and headings are NaN.

    Parameters
    ----------
    class_id : int array (N,)
        The class of each row: an index into ``names``, or ``NO_CLASS``, until the rows are settled.
    names : list of str
        Names of classes; numbers as text if the file has no names.
    velocity : array (N, 2), optional, m/s
    is_timed : bool
        ``frame`` and ``labelled`` are times in ns, not numbers of frames.
    frame_id : str
        The frame of reference that the format names; "" if it names none.
    usual : set of str, optional
        The classes that are taken unless others are named; all by default.
    """

    boxes: Floats
    names: list[str] = field(default_factory=list)
    velocity: Floats | None = None
    is_timed: bool = False
    frame_id: str = ""
    usual: frozenset[str] | None = None

    COLUMNS: ClassVar[tuple[str, ...]] = (*BoxTable.COLUMNS, "velocity")

    def check(self, role: Role) -> None:
        """Check that the rows are boxes in metres with z up, each id once in a frame. Raises McaptrackError if not."""
        if not len(self.boxes):
            raise McaptrackError(f"{self.path} holds no boxes")
        self._check_numbers()
        self._check_units()
        if role != "detections":
            self._check_ids(role)
        self.boxes[:, 6] = wrapped(self.boxes[:, 6])
        self._doubt_axes()

    def _check_numbers(self) -> None:
        boxes = self.boxes
        self.refuse(~np.isfinite(boxes[:, :2]).all(axis=1), lambda _: "x or y of the box is missing or not finite")
        is_odd = ~np.isfinite(boxes) & ~np.isnan(boxes).all(axis=0)

        def odd(row: int) -> str:
            names = ", ".join(name for name, odd in zip(COLUMNS, is_odd[row].tolist(), strict=True) if odd)
            return f"a number of the box is missing or not finite ({names}), which other boxes have"

        self.refuse(is_odd.any(axis=1), odd)
        self.check_places(np.nan_to_num(boxes[:, :3]), unit=" m")
        self.refuse((boxes[:, _SIZE] < 0).any(axis=1), lambda row: f"a size can't be {np.nanmin(boxes[row, _SIZE]):g}")
        self.check_scores(self.score)
        wrong = (self.frame < 0) | (self.frame > (LAST_NS if self.is_timed else MAX_FRAME))
        if self.is_timed:
            self.refuse(wrong, lambda row: "times have to lie between 1970 and 2262")
        self.refuse(wrong, lambda row: f"a frame can be 0 to {MAX_FRAME}, not {self.frame[row]}")

    def _check_units(self) -> None:
        length = self.boxes[:, _SIZE].max(axis=1)
        usual = float(np.median(length)) if np.isfinite(length).all() else 1.0
        if not _LEAST_LENGTH_M <= usual <= _MOST_LENGTH_M:
            raise McaptrackError(
                f"{self.path}: the median length of its boxes is {usual:g}; sizes have to be in metres"
            )
        self.refuse(
            np.abs(self.boxes[:, 6]) > _MOST_HEADING,
            lambda row: (
                f"a heading of {self.boxes[row, 6]:g} is not in radians; if it is in degrees, name its column with "
                "`columns='heading_deg=NAME'`"
            ),
        )

    def _check_ids(self, role: Role) -> None:
        if not self.has_ids:
            raise McaptrackError(f"{self.path} has no ids; {role} need ids")
        self.refuse(self.id == NO_ID, lambda _: f"the id is missing; {role} need ids")
        if (row := self.repeated_id()) >= 0:
            when = "one time" if self.is_timed else f"frame {self.frame[row]}"
            raise McaptrackError(f"{self.at(row)}: id {self.id[row]} appears twice at {when}")
        if len(np.unique(self.id)) == len(self.id) and len(np.unique(self.frame)) > 1:
            raise McaptrackError(f"{self.path}: every row has another id, so that these number rows, not tracks")

    def _doubt_axes(self) -> None:
        """Warn where z may not be up, or where objects move across their heading."""
        x, y, z = (float(np.ptp(np.percentile(part, [5, 95]))) for part in self.boxes[:, :3].T)
        if z > _WIDE_M and min(x, y) < _FLAT_M:
            flat = "x" if x < y else "y"
            text = f": positions spread over {z:.0f} m along z, and {min(x, y):.1f} m along {flat}"
            self.doubt(f"{text}; z has to be the vertical axis")
        across, moving = self._moving_across()
        if moving >= _MANY_MOVING and across > moving / 2:
            text = f": {across} of {moving} boxes of moving objects move across their heading"
            self.doubt(f"{text}; the axes, the zero of the heading, or length and width may differ")

    def _moving_across(self) -> tuple[int, int]:
        """The number of rows that move more across than along their heading, and that of all moving ones."""
        if not self.is_timed or not self.has_ids:
            return 0, 0
        order = np.lexsort((self.frame, self.id))
        same = np.diff(self.id[order]) == 0
        seconds = np.diff(self.frame[order]) / NS_PER_S
        step = np.diff(self.boxes[order, :2], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            is_moving = same & (np.hypot(*step.T) / seconds > _MOVING_M_PER_S)
        turn = np.arctan2(step[:, 1], step[:, 0]) - self.boxes[order[:-1], 6]
        away = np.abs(np.remainder(turn[is_moving] + np.pi / 2, np.pi) - np.pi / 2)  # either way along the heading
        return int((away > _ALONG).sum()), int(np.isfinite(away).sum())

    def settled(self, t_ns: Ints, labelled_ns: Ints, role: Role, wanted: WantedClasses | None) -> BoxRows3D:
        """The rows at times (N,), by time and id, and all times that are labelled; ``left_out`` says what isn't there.

        ``wanted`` are the classes that are kept; None: the usual ones.
        """
        class_id, classes = self._class_ids()
        out = replace(self, frame=t_ns, class_id=class_id, classes=classes, is_timed=True)
        out.labelled = np.union1d(labelled_ns, t_ns)
        order = np.flatnonzero(out._kept(role, wanted))
        self.left_out = out.left_out
        out = out.keep(order[np.lexsort((out.id[order], t_ns[order]))])
        return out if role != "detections" else replace(out, id=np.full(len(order), NO_ID))

    def _class_ids(self) -> tuple[ClassIds, dict[int, str]]:
        """The class ids (N,) of rows and the names by class id: people are 1, others follow by name."""
        kind = self.class_id
        stated = kind != NO_CLASS
        if not stated.any():
            self.remark(f" states no classes; class_id is {UNKNOWN}")
            return np.full(len(kind), UNKNOWN, np.uint32), {}
        if not stated.all():
            self.doubt(f": {int((~stated).sum())} boxes without a class have class_id 0", "classes")
        if all(is_count(name, 9) for name in self.names):
            self.doubt(" has no class names; class 1 is taken as people", "classes")
            ids, classes = [int(name) for name in self.names], {}
        else:
            used = {self.names[number] for number in np.unique(kind[stated]).tolist()}
            unusual = {name.casefold() for name in used - (self.usual or used)}
            others = sorted({name.casefold() for name in used} - set(PEOPLE), key=lambda name: (name in unusual, name))
            places = {name: place for place, name in enumerate(others, start=PERSON + 1)}
            ids = [places.get(name.casefold(), PERSON) for name in self.names]
            named = [(number, name) for number, name in zip(ids, self.names, strict=True) if name in used]
            classes = dict(reversed(named))
        out = np.full(len(kind), UNKNOWN, np.uint32)
        out[stated] = np.array(ids, np.uint32)[kind[stated]]
        return out, classes

    def _kept(self, role: Role, wanted: WantedClasses | None) -> Bools:
        """Mask the rows of classes that are wanted (N,), and describe the others."""
        kept = np.ones(len(self.class_id), bool)
        if wanted is not None and role != "detections":
            kept = wanted.mask(self.path, self.class_id, self.classes)
        elif self.usual is not None:
            kept = np.isin(self.class_id, [number for number, name in self.classes.items() if name in self.usual])
        if not kept.all():
            self.left_out = " and ".join(filter(None, [self.left_out, self.count_classes(~kept)]))
        if not kept.any():
            raise McaptrackError(f"{self.path} holds none of the wanted boxes, only {self.left_out}")
        return kept


def numbered(texts: list[str]) -> tuple[Ints, bool]:
    """Track ids (N,): the texts as numbers if all are, otherwise numbered from 1 on as they come; and which it is."""
    whole = [text.removesuffix(".0") for text in texts]
    if all(is_count(text, 16) for text in whole):
        return np.array([int(text) for text in whole], np.int64), True
    numbers: dict[str, int] = {}
    return np.array([numbers.setdefault(text, len(numbers) + 1) for text in texts], np.int64), False


def headings(quaternions: Floats, path: Path, at: Callable[[int], str]) -> tuple[Floats, Floats]:
    """The heading of boxes (N,) by their quaternions (N, 4) of w, x, y, z, and their tilt (N,): of their z from up.

    Raises McaptrackError if they are no rotations, or if z of most boxes isn't up.
    """
    length = np.linalg.norm(quaternions, axis=1)
    wrong = ~(np.abs(length - 1) < 0.1)
    if wrong.any():
        row = int(wrong.argmax())
        raise McaptrackError(f"{at(row)}: a quaternion of length {length[row]:g} is no rotation")
    w, x, y, z = (quaternions / length[:, None]).T
    tilt = np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1))
    if len(tilt) and np.median(tilt) > np.pi / 4:
        raise McaptrackError(
            f"{path}: z of the boxes is {np.degrees(np.median(tilt)):.0f} degrees from up; it has to be up"
        )
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), tilt
