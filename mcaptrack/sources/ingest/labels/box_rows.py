"""Rows of boxes of other detectors and annotation tools, and how they become ``Labels``: classes, bounds, doubts.

Letters: N rows, F frames.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any, Final

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.notices import Code
from mcaptrack.schema.classes import PERSON, UNKNOWN, is_person
from mcaptrack.sources.ingest.labels.content import NO_ID, ClassIds, Format, IgnoredBoxes, Labels, WantedClasses
from mcaptrack.sources.ingest.labels.formats import MAX_FRAME, MAX_PLACE, MAX_SCORE
from mcaptrack.sources.ingest.labels.number_table import EXACT

#: Formats of other detectors and annotation tools.
OTHERS: Final[tuple[Format, ...]] = ("coco", "cvat", "yolo", "supervision", "csv")
#: A class that a row doesn't state.
NO_CLASS: Final = -1
_MAX_CLASS: Final = 2**31 - 1
_NUMBERED: Final = re.compile(r"(.*?)([0-9]{1,18})(\D*)", re.DOTALL)
#: What Roboflow appends to the names of pictures, a hash among it.
_HASHED: Final = re.compile(r"(_(jpe?g|png|bmp|webp))?\.rf\.[0-9A-Za-z]{8,64}$", re.IGNORECASE)
_SHOWN: Final = 8
#: Boxes that are cut off at the edge of the picture reach a little beyond its whole size.
_MOST_SHARE: Final = 2.0
#: So many texts are read as ids of tracks, at most; the number that stands for the first; so many are listed.
_MAX_TEXTS: Final = 1_000_000
_TEXTS: Final = -(2**40)
_TEXTS_SHOWN: Final = 3
_FRAME: Final = "the frame (a count of pictures, no time)"


@dataclass
class BoxRows:
    """The rows of a file: ``boxes`` (N, 4) of left, top, width, height; ``number`` (N,) is the class or ``NO_CLASS``.

    ``names`` are the class names by number, None if the file has none. ``at`` names the place of a row in messages.
    ``crowd`` (N,) marks regions of people that have no boxes of their own. ``labelled`` (F,) are frames that the file
    describes, with or without boxes. ``times_s`` (F,): the times of frames, which are then numbered from 0.
    ``is_normalised``: boxes are in shares of the picture's size. ``observed`` (N,), ``made_ids``: see ``Labels``.
    """

    path: Path
    format: Format
    at: Callable[[int], str]
    frame: Floats
    boxes: Floats
    id: Floats
    score: Floats
    number: Floats
    names: Mapping[int, str] | None = None
    crowd: Bools | None = None
    labelled: Ints | None = None
    first_frame: int | None = None
    times_s: Floats | None = None
    is_normalised: bool = False
    observed: Bools | None = None
    made_ids: Ints | None = None
    remarks: list[str] = field(default_factory=list)
    doubts: list[tuple[str, Code]] = field(default_factory=list)

    def labels(self, role: Role, wanted: WantedClasses) -> Labels:
        """Check the rows and convert them; tracks and ground truth are of ``wanted`` classes.

        Raises McaptrackError, with the row, if they can't be labels.
        """
        if not len(self.frame):
            raise McaptrackError(f"{self.path} holds no boxes")
        frame = self._whole(self.frame, _FRAME, 0, MAX_FRAME)
        track_id = self._whole(self.id, "the id", NO_ID, EXACT - 1)
        self._whole(self.number, "the class", NO_CLASS, _MAX_CLASS)
        self._check_boxes()
        self.refuse(np.abs(self.score) > MAX_SCORE, lambda row: f"a score can't be {self.score[row]:g}")
        class_id, classes = class_ids(self)
        kept, left = self._kept(role, track_id, class_id, classes, wanted)
        self._doubt_scores()
        self._doubt_repeated(frame, track_id, class_id)
        labelled = np.unique(frame) if self.labelled is None else np.union1d(self.labelled, frame)
        first = self.first_frame
        if first is None:
            first = min(int(labelled[0]), 1)
            if labelled[0] > 0:
                text = f"{self.path}: frames begin with {labelled[0]}; frame {first} is assumed to be the first picture"
                self.doubts.append((f"{text}, `first_frame=` sets the number", "clock"))
        crowd = np.zeros(len(frame), bool) if self.crowd is None else self.crowd
        ignored = IgnoredBoxes(frame[crowd], self.boxes[crowd], ~crowd[crowd], crowd[crowd]) if crowd.any() else None
        occurring = set(np.unique(class_id[kept]).tolist())
        return Labels(
            self.format,
            first,
            frame[kept],
            track_id[kept],
            self.boxes[kept],
            None,
            self.score[kept],
            labelled,
            class_id[kept],
            {number: name for number, name in classes.items() if number in occurring},
            left,
            ignored if role == "truth" else None,
            tuple(self.remarks),
            tuple(self.doubts),
            self.is_normalised,
            self.times_s,
            None if self.observed is None else self.observed[kept],
            self.made_ids,
        )

    def take_shares(self) -> None:
        """Take boxes as shares of the picture's size if they are fractions, and none is larger than shares are."""
        is_small = len(self.boxes) > 0 and bool((np.abs(self.boxes) <= _MOST_SHARE).all())
        if is_small and (self.boxes != np.rint(self.boxes)).any():
            self.is_normalised = True
            text = f"no number of a box is above {_MOST_SHARE:g}, so they are taken as shares of the picture's size"
            self.remarks.append(f"{self.path}: {text}")

    def leave_out_empty(self, is_empty: Bools) -> None:
        """Remove rows (N,) without a box; their frames stay labelled, as frames without boxes."""
        if not is_empty.any():
            return
        self.labelled = np.unique(self._whole(self.frame, _FRAME, 0, MAX_FRAME))
        kept, at = np.flatnonzero(~is_empty), self.at
        self.frame, self.boxes, self.id = self.frame[kept], self.boxes[kept], self.id[kept]
        self.score, self.number = self.score[kept], self.number[kept]
        self.at = lambda row: at(int(kept[row]))
        self.remarks.append(
            f"{self.path}: {len(is_empty) - len(kept)} rows have no box; they only say that frames exist"
        )

    def refuse(self, wrong: Any, describe: Callable[[int], str]) -> None:
        """Raise McaptrackError for the first row where ``wrong`` (N,) is true."""
        if wrong.any():
            row = int(wrong.argmax())
            raise McaptrackError(f"{self.at(row)}: {describe(row)}")

    def doubt_outside(self, size: Floats) -> None:
        """Warn of boxes that lie outside of their pictures, of these sizes (N, 2)."""
        if text := outside(self.path, self.boxes, size):
            self.doubts.append((text, "other"))

    def _whole(self, values: Floats, what: str, least: int, most: int) -> Ints:
        wrong = ~((values == np.rint(values)) & (values >= least) & (values <= most))
        self.refuse(wrong, lambda row: f"{what} has to be a whole number from {least} to {most}, not {values[row]:g}")
        return values.astype(np.int64)

    def _check_boxes(self) -> None:
        boxes = self.boxes
        self.refuse(~np.isfinite(boxes).all(axis=1), lambda _: "a number of the box is missing or not finite")
        largest = np.abs(boxes).max(axis=1)
        self.refuse(largest > MAX_PLACE, lambda row: f"a coordinate can't be {largest[row]:g}; at most {MAX_PLACE:g}")
        self.refuse(
            (boxes[:, 2] < 0) | (boxes[:, 3] < 0),
            lambda row: f"a box can't be {boxes[row, 2]:g} wide and {boxes[row, 3]:g} high",
        )

    def _kept(
        self, role: Role, track_id: Ints, class_id: ClassIds, classes: Mapping[int, str], wanted: WantedClasses
    ) -> tuple[Bools, str]:
        """Mask the rows that suit a role (N,), and describe the others."""
        crowd = np.zeros(len(class_id), bool) if self.crowd is None else self.crowd
        others = ~crowd & (class_id != PERSON) & (role != "detections")
        if role != "detections" and not wanted.is_people:
            others = ~crowd & ~wanted.mask(self.path, class_id, classes)
        lacks_id = ~crowd & ~others & (track_id == NO_ID) & (role != "detections") & bool((track_id != NO_ID).any())
        left = []
        if others.any():
            counts = Counter(class_id[others].tolist()).most_common()
            counted = [f"{count} {_name(number, classes)}" for number, count in counts[:_SHOWN]]
            more = sum(count for _, count in counts[_SHOWN:])
            left.append(", ".join(counted) + (f", {more} of other classes" if more else ""))
        if crowd.any():
            left.append(f"{int(crowd.sum())} regions of crowds (iscrowd)")
        if lacks_id.any():
            left.append(f"{int(lacks_id.sum())} boxes without a track id")
        kept = ~crowd & ~others & ~lacks_id
        if not kept.any():
            is_people = role != "detections" and wanted.is_people
            what, take = ("people", "; `classes=` takes others") if is_people else ("boxes", "")
            raise McaptrackError(f"{self.path} holds no {what}, only {' and '.join(left)}{take}")
        return kept, " and ".join(left)

    def _doubt_scores(self) -> None:
        high, low = self.score > 1, self.score < 0
        if high.any() or low.any():
            parts = [f"{int(high.sum())} above 1 (up to {self.score[high].max():g})"] if high.any() else []
            parts += [f"{int(low.sum())} below 0"] if low.any() else []
            text = f"{self.path}: of {len(self.score)} scores {' and '.join(parts)}; they stay as they are"
            self.doubts.append((text, "other"))

    def _doubt_repeated(self, frame: Ints, track_id: Ints, class_id: ClassIds) -> None:
        columns = np.column_stack([frame, track_id, class_id, self.boxes])
        repeated = len(columns) - len(np.unique(columns, axis=0))
        if repeated:
            text = f"{self.path}: {repeated} of {len(columns)} boxes are there before, with the same frame and class"
            self.doubts.append((f"{text}; they stay as they are", "other"))


def outside(path: Path, boxes: Floats, size: Floats) -> str:
    """Say how many boxes (N, 4) lie outside of pictures of this size (2,) or these sizes (N, 2), as a whole or by half
    of their area; "" if none does.
    """
    low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
    beyond = ((low >= size) | (high <= 0)).any(axis=1)
    inner = np.maximum(np.minimum(high, size) - np.maximum(low, 0), 0).prod(axis=1)
    half = ~beyond & (inner < boxes[:, 2:].prod(axis=1) / 2)
    parts = [f"{int(beyond.sum())} lie outside of their pictures"] if beyond.any() else []
    parts += [f"{int(half.sum())} lie outside of their pictures by more than half"] if half.any() else []
    return f"{path}: of {len(boxes)} boxes {' and '.join(parts)}; they stay as they are" if parts else ""


def fitted(path: Path, labels: Labels, size: tuple[int, int]) -> Labels:
    """Labels for pictures of a size in pixels: shares of it become pixels, and boxes outside of it a doubt."""
    assert labels.boxes_px is not None
    boxes, doubts = labels.boxes_px, labels.doubts
    if labels.is_normalised:
        boxes = boxes * np.array([*size, *size], float)
    text = outside(path, boxes, np.array(size, float)) if labels.format != "coco" else ""  # has sizes of its own
    doubts += ((text, "other"),) if text else ()
    return replace(labels, boxes_px=boxes, doubts=doubts, is_normalised=False)


def _name(number: int, classes: Mapping[int, str]) -> str:
    return classes.get(number, f"of class {number}" if number != UNKNOWN else "of unknown class")


def class_ids(rows: BoxRows) -> tuple[ClassIds, dict[int, str]]:
    """The class ids (N,) of rows, and their names by class id, as the schema of detections has them.

    People are 1. Other classes keep their number, unless it is 0 (unknown) or 1, which become the next numbers after
    the largest. Without names, numbers that begin with 0 are taken to begin with people, as in COCO, and are raised by
    one. What is said about it is added to the rows.
    """
    kind = rows.number.astype(np.int64)
    stated = kind != NO_CLASS
    if not stated.any():
        rows.remarks.append(f"{rows.path} states no classes; all boxes are taken as people")
        return np.full(len(kind), PERSON, np.uint32), {}
    if not stated.all():
        rows.doubts.append((f"{rows.path}: {int((~stated).sum())} boxes without a class have class_id 0", "classes"))
    if rows.names is None:
        return _unnamed(rows, kind, stated), {}
    largest = max(max(rows.names, default=0), PERSON)
    places: dict[int, int] = {}
    classes: dict[int, str] = {}
    for own_number, name in sorted(rows.names.items()):
        if is_person(name):
            place = PERSON
        elif own_number == UNKNOWN and name.casefold() == "unknown":
            place = UNKNOWN
        elif own_number > PERSON:
            place = own_number
        else:
            place = largest = largest + 1
        places[own_number] = place
        classes.setdefault(place, name)
    used = np.unique(kind[stated]).tolist()
    nameless = [kind for kind in used if kind not in places]
    if nameless:
        count = int(np.isin(kind, nameless).sum())
        shown = ", ".join(map(str, nameless[:_SHOWN])) + (", ..." if len(nameless) > _SHOWN else "")
        rows.doubts.append(
            (f"{rows.path}: {count} boxes have classes without a name ({shown}); their class_id is 0", "classes")
        )
    moved = [f"{rows.names[kind]} ({kind}) is {places[kind]}" for kind in used if places.get(kind, kind) != kind]
    if moved:
        shown = ", ".join(moved[:_SHOWN]) + (", ..." if len(moved) > _SHOWN else "")
        rows.remarks.append(f"{rows.path}: in class_id 1 is a person: {shown}")
    ids = np.array([places.get(kind, UNKNOWN) for kind in used], np.uint32)
    out = np.full(len(kind), UNKNOWN, np.uint32)
    out[stated] = ids[np.searchsorted(used, kind[stated])]
    return out, classes


def _unnamed(rows: BoxRows, number: Ints, stated: Bools) -> ClassIds:
    """Class ids of numbers without names: as they are, or raised by one if they begin with 0."""
    begins_with_0 = bool((number == 0).any()) or rows.format == "yolo"
    text = f"{rows.path} has no class names; class {0 if begins_with_0 else 1} is taken as people"
    if begins_with_0:
        text += ", and class_id is one higher than the file's numbers"
    rows.doubts.append((text, "classes"))
    return np.where(stated, number + begins_with_0, UNKNOWN).astype(np.uint32)


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
        shown = list(self._texts)[:_TEXTS_SHOWN]
        shown = [f"{text!r:.40} is {int(ids[(values == self.number(text)).argmax()])}" for text in shown]
        more = ", ..." if len(self._texts) > len(shown) else ""
        return ids, [f"{path}: its ids are texts; tracks are numbered from 1 on as they come: {', '.join(shown)}{more}"]


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
            raise ValueError(
                f"the column of frames has names of several sequences, {''.join(self._around)!r:.40} and "
                f"{''.join(around)!r:.40}"
            )
        return int(match[2])


def numbers_of_names(names: list[str]) -> list[int] | None:
    """The frame numbers of pictures by their names; None if the names aren't numbered, or not uniquely."""
    reader = FrameNames()
    try:
        numbers = [reader.number(name) for name in names]
    except ValueError:
        return None
    return numbers if len(set(numbers)) == len(numbers) and max(numbers, default=0) <= MAX_FRAME else None
