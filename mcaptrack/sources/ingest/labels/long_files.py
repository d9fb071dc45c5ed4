"""Label files that are too long for memory: their rows in a temporary file, in parts of whole frames.

Formats in which a row says all about itself are read so if their rows come in the order of their frames, as programs
write detections and tracks. Others are in memory as a whole.

Letters: N rows, F frames, C classes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any, ClassVar, Final, TypeAlias, TypeVar

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.notices import Code
from mcaptrack.schema.spill import SpillFile, Stored
from mcaptrack.sources.ingest.labels.content import ONLY_PEOPLE, ClassIds, Format, Labels, WantedClasses, step_of
from mcaptrack.sources.ingest.labels.cvat import is_cvat
from mcaptrack.sources.ingest.labels.formats import READERS
from mcaptrack.sources.ingest.labels.json_boxes import is_json
from mcaptrack.sources.ingest.labels.number_table import lines_of
from mcaptrack.sources.ingest.labels.reading import in_order, read_labels, refuse_repeated_ids, text_format

_Values = TypeVar("_Values", Ints, ClassIds)

#: Files from this size on are read in parts, of about so many rows.
_LONG_BYTES: Final = 20_000_000
_PART_ROWS: Final = 200_000
_FORMATS: Final[tuple[Format, ...]] = ("mot", "trajnet", "obsmat")
#: Columns of ``Labels`` with a value for each row that these formats have.
_COLUMNS: Final = ("frame", "id", "boxes_px", "xy_m", "score", "class_id")


def read_labels_of_any_length(
    path: Path,
    label_format: Format = "auto",
    role: Role = "tracks",
    first_frame: int | None = None,
    columns: Mapping[str, str] | None = None,
    wanted: WantedClasses = ONLY_PEOPLE,
) -> LabelFile:
    """Read a label file, in parts if it is long. Parameters and errors are those of ``read_labels``.

    Long ones are read in parts if they are detections, or tracks of people, in a format without names of classes, and
    sorted by frame.
    """
    may_be_long = role == "detections" or (role == "tracks" and wanted.is_people)
    if may_be_long and not columns and path.is_file() and path.stat().st_size >= _LONG_BYTES:
        if label_format == "auto" and not is_json(path) and not is_cvat(path):
            label_format = text_format(path)
        labels = _read_in_parts(path, label_format, role, wanted) if label_format in _FORMATS else None
        if labels is not None:
            return labels if first_frame is None else replace(labels, first_frame=first_frame)
    return read_labels(path, label_format, role, first_frame, columns, wanted)


@dataclass(frozen=True)
class LongLabels:
    """A label file with its rows in a temporary file; ``parts`` reads them.

    What it has in common with ``Labels`` is the same. ``kind`` are no rows, with the types of columns; ``stored`` are
    the places of the columns of each part in ``file``. ``of_frames`` and ``of_classes`` are values, sorted, and how
    many rows have them.
    """

    kind: Labels
    first_frame: int
    has_ids: bool
    left_out: str
    of_frames: tuple[Ints, Ints]
    of_classes: tuple[ClassIds, Ints]
    corner: Floats
    file: SpillFile
    stored: Sequence[Mapping[str, Stored]]

    classes: ClassVar[Mapping[int, str]] = {}
    remarks: ClassVar[tuple[str, ...]] = ()
    doubts: ClassVar[tuple[tuple[str, Code], ...]] = ()
    is_normalised: ClassVar[bool] = False
    times_s: ClassVar[Floats | None] = None

    @property
    def format(self) -> Format:
        """The format of the file."""
        return self.kind.format

    @property
    def labelled(self) -> Ints:
        """The frames with rows (F,), sorted."""
        return self.of_frames[0]

    @property
    def step(self) -> int:
        """The step of labelled frames."""
        return step_of(self.format, self.labelled)

    @property
    def has_boxes(self) -> bool:
        """Whether the rows have boxes in pixels."""
        return self.kind.has_boxes

    def frame_counts(self) -> tuple[Ints, Ints]:
        """The frames with rows (F,), sorted, and the number of rows of each."""
        return self.of_frames

    def class_counts(self) -> tuple[ClassIds, Ints]:
        """The classes of rows (C,), sorted, and the number of rows of each."""
        return self.of_classes

    def corner_px(self) -> Floats:
        """The largest x and y (2,) of boxes."""
        return self.corner

    @property
    def parts(self) -> Sequence[Callable[[], Labels]]:
        """The rows in parts of whole frames, in their order."""
        return [partial(self._part, columns) for columns in self.stored]

    def _part(self, stored: Mapping[str, Stored]) -> Labels:
        columns: dict[str, Any] = {}
        for name, place in stored.items():
            like = getattr(self.kind, name)
            columns[name] = np.frombuffer(self.file.get(place), like.dtype).reshape(-1, *like.shape[1:])
        return in_order(replace(self.kind, **columns), self.has_ids)


LabelFile: TypeAlias = Labels | LongLabels


def _read_in_parts(path: Path, name: Format, role: Role, wanted: WantedClasses) -> LongLabels | None:
    """Read a label file in parts; None if it isn't sorted by frame."""
    lines, file, stored = lines_of(path), SpillFile(), list[Mapping[str, Stored]]()
    frames, classes = list[tuple[Ints, Ints]](), list[tuple[ClassIds, Ints]]()
    corner, has_ids, left_out, first_frame = np.full(2, -np.inf), False, list[str](), 1
    rest: Labels | None = None  # the last frame, which may go on
    while (line := next(lines, None)) is not None:
        read = READERS[name](path, chain([line], islice(lines, _PART_ROWS - 1)), role, wanted)
        if rest is not None and read.frame.min() < rest.frame[0]:
            return None
        frames.append(read.frame_counts())
        classes.append(read.class_counts())
        corner = np.maximum(corner, read.corner_px()) if read.has_boxes else corner
        has_ids, first_frame = has_ids or read.has_ids, min(first_frame, read.first_frame)
        left_out += [read.left_out] if read.left_out else []
        read = in_order(read if rest is None else _joined(rest, read), has_ids=False)
        last = int(np.searchsorted(read.frame, read.frame[-1]))
        if last:
            stored.append(_put(file, read.take(slice(last))))
        rest = read.take(slice(last, None))
    if rest is None:
        return None
    stored.append(_put(file, rest))
    kind = replace(rest.take(slice(0)), ignored=None)
    out = LongLabels(
        kind, first_frame, has_ids, _summed(left_out), _merged(frames), _merged(classes), corner, file, stored
    )
    if has_ids and role != "detections":
        for part in out.parts:
            refuse_repeated_ids(path, part())
    return out


def _merged(counts: Sequence[tuple[_Values, Ints]]) -> tuple[_Values, Ints]:
    """The values of parts, sorted, and how many rows have each."""
    values, which = np.unique(np.concatenate([part for part, _ in counts]), return_inverse=True)
    return values, np.bincount(which, np.concatenate([count for _, count in counts])).astype(np.int64)


def _joined(first: Labels, second: Labels) -> Labels:
    """The rows of both, one after the other."""
    columns: dict[str, Any] = {}
    for name in _COLUMNS:
        before, other = getattr(first, name), getattr(second, name)
        columns[name] = None if other is None else np.concatenate([before, other])
    return replace(second, **columns)


def _put(file: SpillFile, part: Labels) -> dict[str, Stored]:
    columns = {name: getattr(part, name) for name in _COLUMNS}
    return {name: file.put(values.tobytes()) for name, values in columns.items() if values is not None}


def _summed(texts: Sequence[str]) -> str:
    """Merge texts that differ only in their first number, which is summed; "" if there are none."""
    total = sum(int(number[0]) for text in texts if (number := re.search(r"\d+", text)))
    return re.sub(r"\d+", str(total), texts[0], count=1) if texts else ""
