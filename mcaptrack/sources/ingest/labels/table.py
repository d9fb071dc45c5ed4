"""The table of boxes that every source of labels becomes, and the record of facts beside it.

A reader of a format gives both, and judges nothing: what is checked, assumed and left out comes after it, for all
formats alike (``checks``, ``roles``).

Letters: N rows, F frames, C classes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.notices import Code
from mcaptrack.schema.classes import UNKNOWN, ClassMap
from mcaptrack.schema.provenance import Plugin

if TYPE_CHECKING:
    from mcaptrack.sources.ingest.labels.roles import WantedClasses

ClassIds = NDArray[np.uint32]

#: The id of a row without a track, and the class of a row that states none.
NO_ID: Final = -1
NO_CLASS: Final = -1
MAX_FRAME: Final = 2**31 - 1
#: What a labelled box that is no row of ground truth means there: nothing, a thing that a track may be matched with, so
#: that it is counted as false; the same, but then it isn't counted at all; a region in which no track is counted.
NOTHING, OCCUPIED, FORGIVEN, REGION = range(4)
#: With fewer labelled frames a regular step of boxes may be a coincidence.
_SPARSE_FRAMES: Final = 3
_SHOWN: Final = 8


@dataclass
class LabelFacts:
    """The facts about a source of labels, beside its rows.

    Attributes
    ----------
    path : Path
    format : str
        The name of its format.
    found_by : str
        How the format was found: "option" or "content".
    first_frame : int, optional
        The number of the first picture; None until it is known.
    is_first_assumed : bool
        Whether the source doesn't tell it.
    is_in_order : bool
        Whether frames are numbered by the order of their names, which hold no numbers of frames.
    times_s : float array (F,), optional, s
        Rising times of labelled frames, if the source has times; its frames are then places in them.
    is_timed : bool
        The frames of rows are times in ns.
    fps : Fraction, optional
        The frame rate by the format.
    interval_s : Fraction, optional
        The time from a labelled frame to the next, by the format.
    clock_of : str
        Where these two are from.
    size : (int, int), optional, px
        Width and height of the pictures, if the source states them; ``sizes`` has those of each frame.
    is_normalised : bool, optional
        Whether boxes are in shares of the picture's size; None: the numbers tell.
    names : dict of int to str, optional
        Names of classes by the numbers in rows; None if there are none.
    numbering : dict of str to int, optional
        Classes are texts, and ``names`` number them as they came: class ids by name (lower case), as far as the format
        has any; others follow.
    first_class : int, optional
        The first number of classes without names, by the format.
    named_by : str
        Where names are from: "the file", a path, "the format", "the option"; "" without names.
    usual : set of str, optional
        The classes that are taken unless others are named.
    labelled : int array (F,)
        The frames that the source describes, with or without boxes.
    states_labelled : bool
        Whether the source says so, and it isn't concluded from the boxes.
    frame_id : str
        The frame of reference of places in metres, if the source names it.
    scores_truth : bool
        Ground truth has scores; otherwise the column holds something else there.
    not_counting, region : str
        What ``counts`` and ``REGION`` mean in this format, for messages.
    least_height_px : float
        Tracks without a match that are not higher are not counted as false, by the rules of the data set.
    made_ids : int array, optional
        Rising ids that are not of the file.
    plugin : Plugin, optional
        The format, if it is of another package.
    """

    path: Path
    format: str = ""
    found_by: str = ""
    first_frame: int | None = None
    is_first_assumed: bool = False
    is_in_order: bool = False
    times_s: Floats | None = None
    is_timed: bool = False
    fps: Fraction | None = None
    interval_s: Fraction | None = None
    clock_of: str = ""
    size: tuple[int, int] | None = None
    sizes: Mapping[int, tuple[float, float]] | None = None
    is_normalised: bool | None = None
    names: Mapping[int, str] | None = None
    numbering: Mapping[str, int] | None = None
    first_class: int | None = None
    named_by: str = ""
    usual: frozenset[str] | None = None
    labelled: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    states_labelled: bool = False
    frame_id: str = ""
    scores_truth: bool = True
    not_counting: str = ""
    region: str = ""
    least_height_px: float = 0.0
    made_ids: Ints | None = None
    plugin: Plugin | None = None

    @property
    def meaning(self) -> tuple[Any, ...]:
        """The meaning of classes, which is the same in all parts of a file."""
        return self.names, self.named_by, self.is_normalised

    def name(self, names: Mapping[int, str], numbering: Mapping[str, int] | None = None, by: str = "file") -> None:
        """Take classes as texts, of which ``names`` are numbered as they came; they have no names if there are none."""
        self.names, self.numbering, self.named_by = (names, numbering or {}, by) if names else (None, None, "")

    def measure(self, sizes: Mapping[int, tuple[float, float]], pictures: int) -> None:
        """Take the sizes of pictures by frame, as far as they can be; all of ``pictures`` may have one."""
        self.sizes = {frame: size for frame, size in sizes.items() if all(0 < side < np.inf for side in size)} or None
        if self.sizes and len(self.sizes) == pictures and len(different := {*self.sizes.values()}) == 1:
            ((width, height),) = different
            self.size = (int(width), int(height))

    def to_json(self) -> dict[str, Any]:
        """The facts that a reader of ``--json`` can use."""
        return {
            "file": str(self.path),
            "format": self.format,
            "found_by": self.found_by,
            "clock": "times" if self.is_timed or self.times_s is not None else "frames",
            "first_frame": self.first_frame,
            "size": None if self.size is None else list(self.size),
            "classes_by": self.named_by,
            "labelled": [int(number) for number in (*self.labelled[:1], *self.labelled[-1:])],
            "labelled_by": "file" if self.states_labelled else "boxes",
            "frame_id": self.frame_id,
        }


class LabelFinding(NamedTuple):
    """The finding of a check: a code, and a text with places for counts, ``{0}``, ``{1}``, and for the extreme value
    ``{most}`` and the number of all rows ``{rows}``. Findings of parts of a file are summed.
    """

    code: Code
    text: str
    counts: tuple[int, ...] = ()
    most: float = 0.0


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


class Extent(NamedTuple):
    """Counts of all rows of a file, of which not all may be in memory: values, sorted, and how many rows have
    each; ``low`` and ``high`` (2,) are the least and the largest x and y of boxes.
    """

    frames: tuple[Ints, Ints]
    classes: tuple[ClassIds, Ints]
    has_ids: bool
    low: Floats
    high: Floats

    def joined(self, other: Extent) -> Extent:
        """That of the rows of both."""
        return Extent(
            _summed(self.frames, other.frames), _summed(self.classes, other.classes), self.has_ids or other.has_ids,
            np.minimum(self.low, other.low), np.maximum(self.high, other.high),
        )  # fmt: skip


def _summed(first: tuple[NDArray[Any], Ints], second: tuple[NDArray[Any], Ints]) -> tuple[NDArray[Any], Ints]:
    values, which = np.unique(np.concatenate([first[0], second[0]]), return_inverse=True)
    return values, np.bincount(which, np.concatenate([first[1], second[1]])).astype(np.int64)


#: The columns of a table, with a value for each row.
COLUMNS: Final = (
    *("frame", "id", "boxes_px", "xy_m", "boxes_m", "velocity", "score", "class_id", "observed", "counts", "aside"),
)


@dataclass(kw_only=True)
class BoxTable:
    """The rows of a source of labels, in any order; columns that its format lacks are None.

    Attributes
    ----------
    facts : LabelFacts
    at : callable
        The place of a row in messages.
    frame, id : array (N,)
        The number of the picture, or a time (see ``LabelFacts``); and of the track, or ``NO_ID``.
    boxes_px : float array (N, 4), optional, px
        Left, top, width, height.
    xy_m : float array (N, 2), optional, m
        Positions.
    boxes_m : float array (N, 7), optional, m and rad
        Boxes in space: x, y, z of the centre, length, width, height, heading; z is up.
    velocity : float array (N, 2), optional, m/s
    score : float array (N,)
        NaN where there is none.
    class_id : array (N,)
        As the source has it, or ``NO_CLASS``; and as the schema of detections has it once rows are settled.
    observed : bool array (N,), optional
        Which boxes were seen, and not filled in or occluded.
    counts : bool array (N,), optional
        Which boxes count as ground truth; and ``aside``, int array (N,), what others mean there (``OCCUPIED``, ...).
    classes : dict of int to str
        Names by class id, once rows are settled.
    ignored : IgnoredBoxes, optional
        Boxes of ground truth that don't count, once rows are settled.
    left_out : str
        The rows that were left out.
    remarks, findings : list
        How the source was understood, and what is odd about it or was assumed.
    role : str
        What the rows are, once they are settled.
    parts : sequence of callables, optional
        The rows of a file that is too long for memory, in parts of whole frames; the table has none then.
    """

    facts: LabelFacts
    at: Callable[[int], str] = str
    frame: NDArray[Any]
    id: NDArray[Any]
    boxes_px: Floats | None = None
    xy_m: Floats | None = None
    boxes_m: Floats | None = None
    velocity: Floats | None = None
    score: Floats
    class_id: NDArray[Any]
    observed: Bools | None = None
    counts: Bools | None = None
    aside: NDArray[Any] | None = None
    classes: Mapping[int, str] = field(default_factory=dict)
    ignored: IgnoredBoxes | None = None
    left_out: str = ""
    remarks: list[str] = field(default_factory=list)
    findings: list[LabelFinding] = field(default_factory=list)
    role: Role = "detections"
    stored: Sequence[Callable[[], BoxTable]] = ()
    stored_extent: Extent | None = None

    @property
    def path(self) -> Path:
        """The file."""
        return self.facts.path

    @property
    def format(self) -> str:
        """The name of its format."""
        return self.facts.format

    @property
    def first_frame(self) -> int:
        """The number of the first picture."""
        return self.facts.first_frame or 0

    @property
    def labelled(self) -> Ints:
        """The frames (F,) that the file describes."""
        return self.facts.labelled

    @property
    def times_s(self) -> Floats | None:
        """The times of these, if the file has times."""
        return self.facts.times_s

    @property
    def is_normalised(self) -> bool:
        """Whether boxes are in shares of the picture's size."""
        return bool(self.facts.is_normalised)

    @property
    def in_space(self) -> bool:
        """Whether the rows are boxes in metres."""
        return self.boxes_m is not None

    @property
    def parts(self) -> Sequence[Callable[[], BoxTable]]:
        """The rows in parts of whole frames, in their order: one part of all rows, except of long files."""
        return self.stored or [lambda: self]

    @cached_property
    def extent(self) -> Extent:
        """Counts of all rows."""
        if self.stored_extent is not None:
            return self.stored_extent
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        if self.boxes_px is not None and len(self.boxes_px):
            low = self.boxes_px[:, :2].min(axis=0)
            high = (self.boxes_px[:, :2] + self.boxes_px[:, 2:]).max(axis=0)
        frames = np.unique(self.frame, return_counts=True)
        return Extent(frames, np.unique(self.class_id, return_counts=True), bool((self.id != NO_ID).any()), low, high)

    @property
    def has_ids(self) -> bool:
        """Whether any row has a track id."""
        return self.extent.has_ids

    @property
    def rows(self) -> int:
        """The number of rows, also of those that are not in memory."""
        return int(self.extent.frames[1].sum())

    @property
    def step(self) -> int:
        """The step of labelled frames: 12 if every twelfth frame is labelled."""
        return self.step_of(self.labelled)

    def step_of(self, frames: Ints) -> int:
        """The step of the numbers (F,) of labelled frames, which rise."""
        least = 2 if self.facts.interval_s is not None else _SPARSE_FRAMES
        return int(np.gcd.reduce(np.diff(frames))) if len(frames) >= least else 1

    def columns(self, rows: Ints | Bools | slice = slice(None)) -> dict[str, Any]:
        """The columns of some rows by name."""
        values = {name: getattr(self, name) for name in COLUMNS}
        return {name: None if column is None else column[rows] for name, column in values.items()}

    def take(self, rows: Ints | Bools | slice) -> Self:
        """Select or reorder rows; facts about the file stay."""
        where, at = np.arange(len(self.frame))[rows], self.at
        return replace(self, at=lambda row: at(int(where[row])), **self.columns(rows))

    def in_order(self) -> Self:
        """The rows sorted by frame, and by id if there are any; otherwise each frame as the file has it."""
        if self.has_ids:
            return self.take(np.lexsort((self.id, self.frame)))
        return self.take(np.argsort(self.frame, kind="stable"))

    def with_boxes(self, numbers: Floats) -> Self:
        """Leave out rows of which all numbers (N, K) are missing; their frames stay labelled, without boxes."""
        has_box: Bools = np.asarray(~np.isnan(numbers).all(axis=1))
        if has_box.all():
            return self
        self.facts.labelled = np.unique(self.frame)
        self.remark(f": {int((~has_box).sum())} rows have no box; they only say that frames exist")
        return self.take(has_box)

    def remark(self, text: str) -> None:
        """Say something about the file, after its name."""
        self.remarks.append(f"{self.path}{text}")

    def find(self, text: str, code: Code = "other", *counts: int, most: float = 0.0) -> None:
        """Warn of something about the file, after its name; see ``LabelFinding``."""
        self.findings.append(LabelFinding(code, text, counts, most))

    @property
    def doubts(self) -> list[tuple[str, Code]]:
        """The findings as texts with their codes, those of parts in one."""
        summed: dict[tuple[Code, str], LabelFinding] = {}
        for finding in self.findings:
            before = summed.get((finding.code, finding.text))
            counts, most = finding.counts, finding.most
            if before is not None:
                counts = tuple(map(sum, zip(before.counts, counts, strict=True)))
                most = max(before.most, most, key=abs)
            summed[finding.code, finding.text] = finding._replace(counts=counts, most=most)
        texts = (
            (code, text.format(*found.counts, most=found.most, rows=self.rows) if found.counts or found.most else text)
            for (code, text), found in summed.items()
        )
        return [(f"{self.path}{text}", code) for code, text in texts]

    def refuse(self, wrong: Any, describe: Callable[[int], str]) -> None:
        """Raise McaptrackError for the first row where ``wrong`` (N,) is true, with its text by ``describe``."""
        refuse(self.at, wrong, describe)

    def count_classes(self, rows: Bools) -> str:
        """The classes of some rows, each with their number."""
        counts = Counter(self.class_id[rows].tolist()).most_common()
        names = {UNKNOWN: "of unknown class", **self.classes}
        counted = [f"{count} {names.get(number, f'of class {number}')}" for number, count in counts[:_SHOWN]]
        more = sum(count for _, count in counts[_SHOWN:])
        return ", ".join(counted) + (f", {more} of other classes" if more else "")


def refuse(at: Callable[[int], str], wrong: Any, describe: Callable[[int], str]) -> None:
    """Raise McaptrackError for the first row where ``wrong`` (N,) is true: its place, and its text."""
    if wrong.any():
        row = int(wrong.argmax())
        raise McaptrackError(f"{at(row)}: {describe(row)}")


@dataclass(frozen=True)
class Asked:
    """The wishes of a user about a source of labels.

    ``role`` is what its rows are, None: tracks if they have ids; ``columns`` are names of the columns of a table by
    what they hold; ``scene`` the name of a part of a data set; ``classes`` are those of tracks and ground truth
    (detections keep all), by default people, and of boxes in space all; ``first_frame`` is the number of the first
    picture; ``class_map`` are names of classes by what the source calls them.
    """

    label_format: str = "auto"
    role: Role | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    scene: str | None = None
    classes: WantedClasses | None = None
    first_frame: int | None = None
    class_map: ClassMap | None = None
