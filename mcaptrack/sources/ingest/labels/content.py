"""The content of a label file: its rows, and what is known of the file as a whole.

Letters: N rows, F frames, C classes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.choices import LabelFormat
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.notices import Code
from mcaptrack.schema.classes import PERSON, is_person

Format = LabelFormat
#: Formats that hold 3D boxes alone; tables ("csv") may hold either.
FORMATS_3D: Final[tuple[str, ...]] = ("kitti-3d", "nuscenes", "argoverse")
ClassIds = NDArray[np.uint32]

NO_ID: Final = -1
#: Formats in which labels at regular steps are the rule.
_POSITIONS: Final = ("trajnet", "obsmat")
#: With fewer labelled frames a regular step of boxes may be a coincidence.
_SPARSE_FRAMES: Final = 3


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


@dataclass(frozen=True)
class Labels:
    """The rows of a label file, sorted by frame and id.

    ``frame`` (N,) is the number in the file; ``first_frame`` is that of the first picture. ``id`` (N,) is -1 in
    detections. ``boxes_px`` (N, 4) or ``xy_m`` (N, 2) is None if the format has none. ``score`` (N,) is NaN for missing
    scores. ``labelled`` (F,) are the sorted frames with rows in the file, including rows that were left out.
    ``class_id`` (N,) is as in the schema of detections; ``classes`` are names by class id. ``left_out`` describes the
    rows that were left out; those of ground truth are in ``ignored``. ``remarks`` and ``doubts`` (warnings and their
    codes) say how the file was understood. ``is_normalised``: boxes are in shares of the picture's size. ``times_s``
    (F,): the times of frames by the file itself; its frames are then numbered from 0. ``observed`` (N,): which boxes
    were seen, and not filled in or occluded, if the file says so. ``made_ids``: rising ids that are not of the file.
    """

    format: Format
    first_frame: int
    frame: Ints
    id: Ints
    boxes_px: Floats | None
    xy_m: Floats | None
    score: Floats
    labelled: Ints
    class_id: ClassIds
    classes: Mapping[int, str] = field(default_factory=dict)
    left_out: str = ""
    ignored: IgnoredBoxes | None = None
    remarks: tuple[str, ...] = ()
    doubts: tuple[tuple[str, Code], ...] = ()
    is_normalised: bool = False
    times_s: Floats | None = None
    observed: Bools | None = None
    made_ids: Ints | None = None

    @property
    def step(self) -> int:
        """The step of labelled frames: 12 if every twelfth frame is labelled."""
        return step_of(self.format, self.labelled)

    @property
    def has_ids(self) -> bool:
        """Whether the rows have ids."""
        return bool((self.id != NO_ID).any())

    @property
    def has_boxes(self) -> bool:
        """Whether the rows have boxes in pixels."""
        return self.boxes_px is not None

    def frame_counts(self) -> tuple[Ints, Ints]:
        """The frames with rows (F,), sorted, and the number of rows of each."""
        return np.unique(self.frame, return_counts=True)

    def class_counts(self) -> tuple[ClassIds, Ints]:
        """The classes of rows (C,), sorted, and the number of rows of each."""
        return np.unique(self.class_id, return_counts=True)

    def corner_px(self) -> Floats:
        """The largest x and y (2,) of boxes, -inf without rows."""
        assert self.boxes_px is not None
        corner: Floats = (self.boxes_px[:, :2] + self.boxes_px[:, 2:]).max(axis=0, initial=-np.inf)
        return corner

    def take(self, rows: Ints | slice) -> Labels:
        """Select or reorder rows; facts about the file stay."""
        boxes, xy, observed = self.boxes_px, self.xy_m, self.observed
        return replace(
            self,
            frame=self.frame[rows],
            id=self.id[rows],
            boxes_px=None if boxes is None else boxes[rows],
            xy_m=None if xy is None else xy[rows],
            score=self.score[rows],
            class_id=self.class_id[rows],
            observed=None if observed is None else observed[rows],
        )

    @property
    def parts(self) -> Sequence[Callable[[], Labels]]:
        """The rows in parts of whole frames, in their order: one part of all rows, except of long files."""
        return [lambda: self]


def step_of(name: Format, labelled: Ints) -> int:
    """The step of the labelled frames (F,) of a file of a format."""
    least = 2 if name in _POSITIONS else _SPARSE_FRAMES
    return int(np.gcd.reduce(np.diff(labelled))) if len(labelled) >= least else 1


# Which classes of label files become tracks and ground truth. Letters: N rows, C classes.


_ALL: Final = "all"
_SHOWN: Final = 10
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
                called = [names.get(number) or f"{number}" for number in occurring]
                more = f" and {len(called) - _SHOWN} more" if len(called) > _SHOWN else ""
                raise McaptrackError(
                    f"{path} has no class {word!r:.60}; `classes=` takes {', '.join(called[:_SHOWN])}{more}, or {_ALL}"
                )
            wanted |= numbers
        return np.isin(class_id, sorted(wanted))


#: The default: people alone.
ONLY_PEOPLE: Final[WantedClasses] = WantedClasses()


def describe_classes(ids: NDArray[np.integer], counts: Ints, names: Mapping[int, str]) -> str:
    """List classes (C,), each with its name and the number of its rows; "" for one class."""
    if len(ids) < 2:
        return ""
    called = [f"{number} {names[number]}" if number in names else f"{number}" for number in ids.tolist()]
    listed = [f"{name} ({count})" for name, count in zip(called, counts.tolist(), strict=True)][:_MAX_LISTED]
    return ", ".join(listed) + (f" and {len(ids) - _MAX_LISTED} more" if len(ids) > _MAX_LISTED else "")
