"""3D boxes of a label file, whatever its format: checks, classes and times.

Boxes are (N, 7) of x, y, z (the centre), length, width, height, heading, see ``geometry.oriented_boxes``; z is up.

Letters: N rows, F frames.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.angles import wrapped
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S
from mcaptrack.notices import Code
from mcaptrack.schema.classes import PEOPLE, PERSON, UNKNOWN
from mcaptrack.sources.ingest.labels.content import ClassIds, Format, WantedClasses
from mcaptrack.sources.ingest.labels.formats import MAX_FRAME, MAX_PLACE, MAX_SCORE

#: The track id of rows without one.
NO_ID: Final = -1
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
_SHOWN: Final = 8
_SIZE: Final = slice(3, 6)
#: The columns of boxes.
_NAMES: Final = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad")


class TimedLabels(NamedTuple):
    """3D boxes with times: ``t_ns`` (F,) rising, ``ends`` (F,) the index of the row after the last one of each frame.

    The other columns are those of ``BoxRows3D``, ordered by time and id.
    """

    t_ns: Ints
    ends: Ints
    boxes: Floats
    track_id: Ints
    class_id: ClassIds
    classes: Mapping[int, str]
    score: Floats
    velocity: Floats


@dataclass
class BoxRows3D:
    """The rows of a file.

    Parameters
    ----------
    path : Path
    format : str
    at : callable
        Names the place of a row in messages.
    boxes : array (N, 7)
        Missing sizes, heights and headings are NaN.
    track_id : int array (N,)
        ``NO_ID`` for none.
    kind : int array (N,)
        The class of each row: an index into ``names``, or -1.
    names : list of str
        Names of classes; numbers as text if the file has no names.
    score : array (N,)
    velocity : array (N, 2), m/s
    t_ns, frame : int array (N,), optional
        The time of each row, or its frame number.
    labelled : int array (F,), optional
        Times or frame numbers that the file describes, with or without boxes.
    frame_id : str
        The frame of reference that the format names; "" if it names none.
    left_out : str
        The rows that the format has and that were left out.
    usual : set of str, optional
        The classes that are taken unless others are named; all by default.
    """

    path: Path
    format: Format
    at: Callable[[int], str]
    boxes: Floats
    track_id: Ints
    kind: Ints
    names: list[str]
    score: Floats
    velocity: Floats
    t_ns: Ints | None = None
    frame: Ints | None = None
    labelled: Ints | None = None
    frame_id: str = ""
    left_out: str = ""
    usual: frozenset[str] | None = None
    remarks: list[str] = field(default_factory=list)
    doubts: list[tuple[str, Code]] = field(default_factory=list)

    @property
    def has_ids(self) -> bool:
        """Whether any row has a track id."""
        return bool((self.track_id != NO_ID).any())

    @property
    def number(self) -> Ints:
        """The time or the frame number of each row (N,)."""
        number = self.t_ns if self.t_ns is not None else self.frame
        assert number is not None
        return number

    def refuse(self, wrong: Any, describe: Callable[[int], str]) -> None:
        """Raise McaptrackError for the first row where ``wrong`` (N,) is true."""
        if wrong.any():
            row = int(wrong.argmax())
            raise McaptrackError(f"{self.at(row)}: {describe(row)}")

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
            names = ", ".join(name for name, odd in zip(_NAMES, is_odd[row].tolist(), strict=True) if odd)
            return f"a number of the box is missing or not finite ({names}), which other boxes have"

        self.refuse(is_odd.any(axis=1), odd)
        largest = np.abs(boxes[:, :3]).max(axis=1, where=~np.isnan(boxes[:, :3]), initial=0)
        self.refuse(largest > MAX_PLACE, lambda row: f"a coordinate can't be {largest[row]:g}; at most {MAX_PLACE:g} m")
        self.refuse((boxes[:, _SIZE] < 0).any(axis=1), lambda row: f"a size can't be {np.nanmin(boxes[row, _SIZE]):g}")
        self.refuse(np.abs(self.score) > MAX_SCORE, lambda row: f"a score can't be {self.score[row]:g}")
        if self.t_ns is not None:
            wrong = (self.t_ns < 0) | (self.t_ns > LAST_NS)
            self.refuse(wrong, lambda row: "times have to lie between 1970 and 2262")
        elif self.frame is not None:
            wrong = (self.frame < 0) | (self.frame > MAX_FRAME)
            self.refuse(wrong, lambda row: f"a frame can be 0 to {MAX_FRAME}, not {self.number[row]}")

    def _check_units(self) -> None:
        length = self.boxes[:, _SIZE].max(axis=1)
        usual = float(np.median(length)) if np.isfinite(length).all() else 1.0
        if not _LEAST_LENGTH_M <= usual <= _MOST_LENGTH_M:
            raise McaptrackError(
                f"{self.path}: the median length of its boxes is {usual:g}; sizes have to be in metres"
            )
        turned = np.abs(self.boxes[:, 6])
        self.refuse(
            turned > _MOST_HEADING,
            lambda row: (
                f"a heading of {self.boxes[row, 6]:g} is not in radians; if it is in degrees, name its column with "
                "`columns='heading_deg=NAME'`"
            ),
        )

    def _check_ids(self, role: Role) -> None:
        if not self.has_ids:
            raise McaptrackError(f"{self.path} has no ids; {role} need ids")
        self.refuse(self.track_id == NO_ID, lambda _: f"the id is missing; {role} need ids")
        order = np.lexsort((self.track_id, self.number))
        number, track_id = self.number[order], self.track_id[order]
        again = np.flatnonzero((number[1:] == number[:-1]) & (track_id[1:] == track_id[:-1])) + 1
        if len(again):
            row = int(order[again[0]])
            when = "one time" if self.t_ns is not None else f"frame {self.number[row]}"
            raise McaptrackError(f"{self.at(row)}: id {self.track_id[row]} appears twice at {when}")
        if len(np.unique(track_id)) == len(track_id) and len(np.unique(number)) > 1:
            raise McaptrackError(f"{self.path}: every row has another id, so that these number rows, not tracks")

    def _doubt_axes(self) -> None:
        """Warn where z may not be up, or where objects move across their heading."""
        x, y, z = (float(np.ptp(np.percentile(part, [5, 95]))) for part in self.boxes[:, :3].T)
        if z > _WIDE_M and min(x, y) < _FLAT_M:
            flat = "x" if x < y else "y"
            text = f"{self.path}: positions spread over {z:.0f} m along z, and {min(x, y):.1f} m along {flat}"
            self.doubts.append((f"{text}; z has to be the vertical axis", "other"))
        across, moving = self._moving_across()
        if moving >= _MANY_MOVING and across > moving / 2:
            text = f"{self.path}: {across} of {moving} boxes of moving objects move across their heading"
            self.doubts.append((f"{text}; the axes, the zero of the heading, or length and width may differ", "other"))

    def _moving_across(self) -> tuple[int, int]:
        """The number of rows that move more across than along their heading, and that of all moving ones."""
        if self.t_ns is None or not self.has_ids:
            return 0, 0
        order = np.lexsort((self.t_ns, self.track_id))
        same = np.diff(self.track_id[order]) == 0
        seconds = np.diff(self.t_ns[order]) / NS_PER_S
        step = np.diff(self.boxes[order, :2], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            is_moving = same & (np.hypot(*step.T) / seconds > _MOVING_M_PER_S)
        turn = np.arctan2(step[:, 1], step[:, 0]) - self.boxes[order[:-1], 6]
        away = np.abs(np.remainder(turn[is_moving] + np.pi / 2, np.pi) - np.pi / 2)  # either way along the heading
        return int((away > _ALONG).sum()), int(np.isfinite(away).sum())

    def timed(self, t_ns: Ints, labelled_ns: Ints, role: Role, wanted: WantedClasses | None) -> TimedLabels:
        """The rows at times (N,), in frames at all times that are labelled; what is left out is added to ``left_out``.

        ``wanted`` are the classes that are kept; None: the usual ones.
        """
        class_id, classes = self._classes()
        kept = self._kept(role, class_id, classes, wanted)
        order = np.flatnonzero(kept)
        order = order[np.lexsort((self.track_id[order], t_ns[order]))]
        frames = np.union1d(labelled_ns, t_ns)
        occurring = set(np.unique(class_id[order]).tolist())
        return TimedLabels(
            frames,
            np.searchsorted(t_ns[order], frames, "right"),
            self.boxes[order],
            self.track_id[order] if role != "detections" else np.full(len(order), NO_ID),
            class_id[order],
            {number: name for number, name in classes.items() if number in occurring},
            self.score[order],
            self.velocity[order],
        )

    def _classes(self) -> tuple[ClassIds, dict[int, str]]:
        """The class ids (N,) of rows and the names by class id: people are 1, others follow by name."""
        stated = self.kind >= 0
        if not stated.any():
            self.remarks.append(f"{self.path} states no classes; class_id is {UNKNOWN}")
            return np.full(len(self.kind), UNKNOWN, np.uint32), {}
        if not stated.all():
            self.doubts.append(
                (f"{self.path}: {int((~stated).sum())} boxes without a class have class_id 0", "classes")
            )
        if all(name.isascii() and name.isdecimal() and len(name) < 10 for name in self.names):
            self.doubts.append((f"{self.path} has no class names; class 1 is taken as people", "classes"))
            ids, classes = [int(name) for name in self.names], {}
        else:
            used = {self.names[number] for number in np.unique(self.kind[stated]).tolist()}
            unusual = {name.casefold() for name in used - (self.usual or used)}
            others = sorted({name.casefold() for name in used} - set(PEOPLE), key=lambda name: (name in unusual, name))
            places = {name: place for place, name in enumerate(others, start=PERSON + 1)}
            ids = [places.get(name.casefold(), PERSON) for name in self.names]
            named = [(number, name) for number, name in zip(ids, self.names, strict=True) if name in used]
            classes = dict(reversed(named))
        out = np.full(len(self.kind), UNKNOWN, np.uint32)
        out[stated] = np.array(ids, np.uint32)[self.kind[stated]]
        return out, classes

    def _kept(self, role: Role, class_id: ClassIds, classes: Mapping[int, str], wanted: WantedClasses | None) -> Bools:
        """Mask the rows of classes that are wanted (N,)."""
        kept = np.ones(len(class_id), bool)
        if wanted is not None and role != "detections":
            kept = wanted.mask(self.path, class_id, classes)
        elif self.usual is not None:
            kept = np.isin(class_id, [number for number, name in classes.items() if name in self.usual])
        if not kept.all():
            counts = Counter(class_id[~kept].tolist()).most_common()
            counted = [f"{count} {classes.get(number, f'of class {number}')}" for number, count in counts[:_SHOWN]]
            more = sum(count for _, count in counts[_SHOWN:])
            self.left_out = " and ".join(
                filter(None, [self.left_out, ", ".join(counted) + (f", {more} of other classes" if more else "")])
            )
        if not kept.any():
            raise McaptrackError(f"{self.path} holds none of the wanted boxes, only {self.left_out}")
        return kept


def numbered(texts: list[str]) -> tuple[Ints, bool]:
    """Track ids (N,): the texts as numbers if all are, otherwise numbered from 1 on as they come; and which it is."""
    whole = [text.removesuffix(".0") for text in texts]
    if all(text.isascii() and text.isdecimal() and len(text) < 17 for text in whole):
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
