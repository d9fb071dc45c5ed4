"""Parse the formats of label files into ``Labels``.

| format  | columns                                                                        | frames | unit |
|---------|--------------------------------------------------------------------------------|--------|------|
| mot     | frame, id, left, top, width, height[, score[, ...]]; 6 to 10, comma separated  | from 1 | px   |
| kitti   | frame id type truncated occluded alpha left top right bottom ...; 17 or 18     | from 0 | px   |
| sdd     | id xmin ymin xmax ymax frame lost occluded generated "label"; blank separated  | from 0 | px   |
| trajnet | frame id x y; comma or blank separated                                         | from 0 | m    |
| obsmat  | frame id x z y vx vz vy; blank separated                                       | from 0 | m    |

Ground truth of MOTChallenge has the class of a box in column 8 since MOT16; MOT15, with 10 columns, has a position
there. Ground truth also contains boxes that are not scored: see ``IgnoredBoxes``. Tracks and ground truth are
restricted to people unless other classes are wanted; detections keep all classes.

Letters: N rows, F frames.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.schema.classes import PERSON
from mcaptrack.sources.ingest.labels.content import (
    FRAME,
    MAX_FRAME,
    NO_ID,
    BoxRows3D,
    ClassIds,
    Format,
    IgnoredBoxes,
    Labels,
    Lines,
    NumberTable,
    WantedClasses,
    check_columns,
    lines_of,
)

#: The classes of MOT16, 17 and 20.
_MOT_NAMES: Final = (
    "pedestrian,person on vehicle,car,bicycle,motorbike,non motorized vehicle,static person,distractor,occluder,"
    "occluder on the ground,occluder full,reflection,crowd"
)
MOT_CLASSES: Final = dict(enumerate(_MOT_NAMES.split(","), start=1))
#: Distractor classes of MOT16, 17 and 20: person on a vehicle, static person, distractor, reflection.
_DISTRACTORS: Final = (2, 7, 8, 12)
#: People in KITTI that are occluded more than this, or truncated, are not scored; boxes up to this height are not
#: counted as false positives.
_KITTI_OCCLUDED: Final = 2
KITTI_HEIGHT_PX: Final = 25.0
#: Class ids of the class names in formats; other names get the following ids. Person in the tracking labels of KITTI is
#: Person_sitting in its detection labels.
_KITTI_NAMES: Final = ("pedestrian", "cyclist", "car", "van", "truck", "tram", "person_sitting", "misc")
_KITTI_CLASSES: Final = {name: number for number, name in enumerate(_KITTI_NAMES, start=PERSON)} | {"person": 7}
_SDD_CLASSES: Final = {"pedestrian": PERSON, "biker": 2, "skater": 3, "cart": 4, "car": 5, "bus": 6}
_KITTI_REGION: Final = "dontcare"
#: The frame of reference: of the camera, with z up.
CAMERA_FRAME: Final = "camera_link"
#: The number of class names of a column, at most: there are data sets with 21,841 classes.
_MAX_NAMES: Final = 65_536


class ClassNames:
    """The class names of a column, numbered from 0 in order of appearance."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}

    @property
    def names(self) -> list[str]:
        """The names in order of appearance."""
        return list(self._numbers)

    def number(self, name: str) -> int:
        """The number of a name. Raises ValueError if there are too many names."""
        if name not in self._numbers and len(self._numbers) == _MAX_NAMES:
            raise ValueError(f"the column of classes has more than {_MAX_NAMES:,} names")
        return self._numbers.setdefault(name, len(self._numbers))

    def are(self, numbers: Floats, name: str) -> Bools:
        """Mask the entries of a column that have this name (lower case)."""
        same = np.array([other.lower() == name for other in self._numbers], bool)
        return np.asarray(same[numbers.astype(int)], bool)

    def count(self, numbers: Floats) -> str:
        """The number of occurrences of each name, as text."""
        counts = Counter(numbers.astype(int).tolist())
        return ", ".join(f"{count} {self.names[number]}" for number, count in counts.most_common())

    def ids(self, numbers: Floats, usual: Mapping[str, int]) -> tuple[ClassIds, dict[int, str]]:
        """Convert a column to class ids; returns them and their names."""
        others = sorted({name.lower() for name in self._numbers} - usual.keys())
        places = {**usual, **{name: number for number, name in enumerate(others, start=max(usual.values()) + 1)}}
        ids = np.array([places[name.lower()] for name in self._numbers], np.uint32)
        names = dict(zip(ids.tolist(), self._numbers, strict=True))
        return ids[numbers.astype(int)], names


def _boxes(table: NumberTable, columns: slice, corners: bool = False) -> Floats:
    """Boxes (N, 4) of left, top, width, height; ``corners``: the columns are left, top, right, bottom."""
    boxes = table.values[:, columns]
    if corners:
        boxes = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)
    table.check_boxes(boxes)
    return boxes


def _ids(table: NumberTable, frame: int, track: int, least: int = NO_ID) -> tuple[Ints, Ints]:
    """The frame and the track (N,) of rows, from these columns."""
    frames = table.whole(table.values[:, frame], FRAME, 0, MAX_FRAME)
    return frames, table.whole(table.values[:, track], "the id", least)


def read_mot(path: Path, lines: Lines, role: Role, wanted: WantedClasses) -> Labels:
    """MOTChallenge."""

    def parse(parts: list[str]) -> list[float]:
        check_columns(parts, 6, 10)
        # With 10 columns it is MOT15, where column 8 is not a class.
        more = parts[6:8] if len(parts) < 10 else parts[6:7]
        return [*map(float, parts[:6]), *map(float, more), *[np.nan] * (2 - len(more))]

    table = NumberTable(path, lines, "MOTChallenge (frame, id, left, top, width, height, score, ...)", 8, parse)
    frame, track_id = _ids(table, 0, 1)
    boxes, score, kind = _boxes(table, slice(2, 6)), table.values[:, 6], table.values[:, 7]
    table.check_scores(score)
    named = np.isfinite(kind)
    kept = np.ones(len(frame), bool)
    has_others = role != "detections" and not wanted.is_people
    stated = np.where(named & (kind >= 0) & (kind < 2**31), kind, PERSON).astype(np.int64)
    if has_others:
        kept = wanted.mask(path, stated, MOT_CLASSES) & ((stated != PERSON) | (score != 0) | (role != "truth"))
    elif role == "truth":
        if (kind == 0).all():
            raise McaptrackError(
                f"{path}: the class of all {len(kind)} boxes (column 8) is 0; pedestrians are 1 there since MOT16, and "
                "-1 or no column 8 means that there are no classes"
            )
        # A score of 0 marks boxes that are not scored.
        kept = (score != 0) & ((kind == PERSON) | (kind == NO_ID) | np.isnan(kind))
        if not kept.any():
            raise McaptrackError(f"{path}: all {len(kept)} boxes are marked as not counting (score 0 or a class but 1)")
    class_id = np.full(len(frame), PERSON, np.uint32)
    if role == "detections":
        table.refuse(
            named & ~((kind == np.rint(kind)) & (kind >= NO_ID) & (kind < 2**32)),
            lambda row: f"a class (column 8) is a whole number from -1 (none) on, not {kind[row]:g}",
        )
        class_id = np.where(named & (kind != NO_ID), kind, PERSON).astype(np.uint32)
    class_id = stated.astype(np.uint32) if has_others else class_id
    gone = ~kept
    others = f"{int(gone.sum())} boxes that don't count (score 0 or a class but 1)" if gone.any() else ""
    if has_others:
        others = f"{int(gone.sum())} boxes of other classes (column 8), or with a score of 0" if gone.any() else ""
    elif role == "tracks" and ((kind > 0) & (kind != PERSON)).any():
        others = f"the classes of {int(((kind > 0) & (kind != PERSON)).sum())} boxes that aren't people (column 8)"
    ignored = IgnoredBoxes(frame[gone], boxes[gone], np.isin(kind[gone], _DISTRACTORS), np.zeros(int(gone.sum()), bool))
    classes = {number: name for number, name in MOT_CLASSES.items() if has_others}
    score = np.full(len(frame), np.nan) if role == "truth" else score
    out = Labels(path, "mot", table.at, frame, track_id, boxes, score, class_id, classes, others, np.unique(frame))
    out.ignored = ignored if (kind > 0).any() else None
    out.is_first_assumed = not (frame == 0).any()  # some programs number frames from 0 in this format, too
    out.first_frame = int(out.is_first_assumed)
    return out.keep(kept)


def _kitti(path: Path, lines: Lines) -> tuple[NumberTable, ClassNames]:
    """Rows of KITTI tracking, with the type as the number of a name. Column 18 is the score of a tracker, if any."""
    names = ClassNames()

    def parse(parts: list[str]) -> list[float]:
        check_columns(parts, 17, 18)
        numbers = [float(part) if place != 2 else names.number(part) for place, part in enumerate(parts)]
        return numbers + [np.nan] * (18 - len(parts))

    columns = "frame id type truncated occluded alpha left top right bottom height width length x y z rotation score"
    return NumberTable(path, lines, f"KITTI tracking ({columns})", 18, parse), names


def read_kitti(path: Path, lines: Lines, role: Role, wanted: WantedClasses) -> Labels:
    """KITTI tracking."""
    table, names = _kitti(path, lines)
    frame, track_id = _ids(table, 0, 1)
    boxes, score, kind = _boxes(table, slice(6, 10), corners=True), table.values[:, 17], table.values[:, 2]
    table.check_scores(score)
    truncated, occluded = table.values[:, 3], table.values[:, 4]
    people, region = names.are(kind, "pedestrian"), names.are(kind, _KITTI_REGION)
    class_id, classes = names.ids(kind, _KITTI_CLASSES)
    if role != "detections" and not wanted.is_people:
        people = ~region
        people[~region] = wanted.mask(path, class_id[~region], classes)
    if role == "detections":
        kept = ~region
        if not kept.any():
            raise McaptrackError(f"{path} holds no boxes, only {names.count(kind)}")
    else:
        kept = people.copy()
        if not people.any():
            raise McaptrackError(f"{path} holds no pedestrians, only {names.count(kind)}")
    if role == "truth":
        kept &= (truncated <= 0) & (occluded <= _KITTI_OCCLUDED)
    hidden = int((people & ~kept).sum())
    left = [names.count(kind[~people & ~kept])] if (~people & ~kept).any() else []
    who = "Pedestrian" if wanted.is_people else "boxes"
    left += [f"{hidden} {who}, hidden or cut off"] if hidden else []
    sitting = (names.are(kind, "person_sitting") | names.are(kind, "person")) & wanted.is_people
    ignored = ~kept & (people | sitting | region)
    left_out, labelled = " and ".join(left), np.unique(frame)
    out = Labels(path, "kitti", table.at, frame, track_id, boxes, score, class_id, classes, left_out, labelled)
    if role == "truth":
        out.ignored = IgnoredBoxes(frame[ignored], boxes[ignored], ~region[ignored], region[ignored])
    return out.keep(kept)


def read_kitti_3d(path: Path) -> BoxRows3D:
    """Read a file of one sequence.

    In the file, x is right, y down and z forward, the position is the centre of the box's bottom, and the rotation
    about y is 0 for an object that faces right. Here x is forward, y left and z up.
    """
    table, names = _kitti(path, lines_of(path))
    frame, track_id = _ids(table, 0, 1)
    kind, is_region = table.values[:, 2].astype(np.int64), names.are(table.values[:, 2], _KITTI_REGION)
    has_no_box = ~is_region & (table.values[:, 10:13] <= 0).any(axis=1)  # results of detectors in pictures
    kept = np.flatnonzero(~is_region & ~has_no_box)
    if not len(kept):
        raise McaptrackError(f"{path} holds no 3D boxes")
    height, width, length, x, y, z, rotation = table.values[kept, 10:17].T
    heading = -rotation - np.pi / 2
    left = [f"{int(is_region.sum())} regions (DontCare)"] if is_region.any() else []
    left += [f"{int(has_no_box.sum())} rows without a 3D box"] if has_no_box.any() else []
    axes = "x is forward, y left, z up (in the file x is right, y down, z forward); positions are centres of boxes"
    boxes, score = np.full((len(frame), 7), np.nan), table.values[:, 17]
    boxes[kept] = np.stack([z, -x, -y + height / 2, length, width, height, heading], axis=-1)
    rows = BoxRows3D(path, "kitti-3d", table.at, frame, track_id, boxes, score, kind, frame_id=CAMERA_FRAME)
    rows.names, rows.left_out, rows.labelled = names.names, " and ".join(left), np.unique(frame)
    rows.remark(f": {axes}")
    return rows.take(kept)


def read_sdd(path: Path, lines: Lines, role: Role, wanted: WantedClasses) -> Labels:
    """Stanford Drone annotations."""
    names = ClassNames()

    def parse(parts: list[str]) -> list[float]:
        check_columns(parts, 10, 10)
        return [*map(float, parts[:9]), names.number(parts[9].strip('"'))]

    columns = 'id xmin ymin xmax ymax frame lost occluded generated "label"'
    table = NumberTable(path, lines, f"Stanford Drone annotations ({columns})", 10, parse)
    frame, track_id = _ids(table, 5, 0, least=0)
    boxes, kind = _boxes(table, slice(1, 5), corners=True), table.values[:, 9]
    lost = table.values[:, 6] != 0
    other = ~names.are(kind, "pedestrian") & (role != "detections")
    class_id, classes = names.ids(kind, _SDD_CLASSES)
    if role != "detections" and not wanted.is_people:
        other = ~wanted.mask(path, class_id, classes)
    kept = ~lost & ~other
    if not kept.any():
        what = ("pedestrians" if wanted.is_people else "such boxes") if other.any() else "boxes in sight"
        raise McaptrackError(f"{path} holds no {what}, only {names.count(kind)}")
    left = [names.count(kind[other & ~lost])] if (other & ~lost).any() else []
    left += [f"{int(lost.sum())} boxes out of sight (lost)"] if lost.any() else []
    none, left_out, labelled = np.full(len(frame), np.nan), " and ".join(left), np.unique(frame)
    out = Labels(path, "sdd", table.at, frame, track_id, boxes, none, class_id, classes, left_out, labelled)
    return out.keep(kept)


def _positions(
    name: Format, what: str, columns: int, place: slice, path: Path, lines: Lines, role: Role, wanted: WantedClasses
) -> Labels:
    """Positions in metres of people."""
    table = NumberTable(path, lines, what, columns)
    frame, track_id = _ids(table, 0, 1, least=0)
    xy_m, none, people = table.values[:, place], np.full(len(frame), np.nan), np.full(len(frame), PERSON, np.uint32)
    table.refuse(~np.isfinite(xy_m).all(axis=1), lambda _: "a number is not finite")
    table.check_places(xy_m, "a position")
    wanted.mask(path, people, {})
    return Labels(path, name, table.at, frame, track_id, None, none, people, labelled=np.unique(frame), xy_m=xy_m)


def read_trajnet(path: Path, lines: Lines, role: Role, wanted: WantedClasses) -> Labels:
    """TrajNet."""
    return _positions("trajnet", "TrajNet (frame id x y)", 4, slice(2, 4), path, lines, role, wanted)


def read_obsmat(path: Path, lines: Lines, role: Role, wanted: WantedClasses) -> Labels:
    """Matrices of observations of ETH."""
    what = "an ETH obsmat (frame id x z y vx vz vy)"
    return _positions("obsmat", what, 8, slice(2, 5, 2), path, lines, role, wanted)
