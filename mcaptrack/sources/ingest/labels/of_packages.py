"""Label formats of other packages (``contracts.Format``): which file is of which, and their boxes, checked.

Letters: N rows, F frames.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.contracts import LabelBoxes, is_in_space
from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.registry import Entry, blamed, find, load, names, own
from mcaptrack.schema.provenance import Plugin
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import MAX_FRAME, NO_CLASS, NO_ID, Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import ClassNames, numbered

_KIND: Final = "label_format"


class FormatOfPackage(Format):
    """A format of another package, as the registry found it, and its object."""

    reads_folders = True

    def __init__(self, entry: Entry, made: Any) -> None:
        self.entry, self._made, self.in_space, self.name = entry, made, is_in_space(entry, made), entry.name

    @property
    def recognises_any(self) -> bool:
        """Whether it can tell its files from others."""
        return hasattr(self._made, "recognises")

    def recognises(self, file: LabelFile) -> bool:
        """Whether a file is of this format, as far as it can tell."""
        if not self.recognises_any:
            return False
        with blamed(self.entry, f"failed to look at {file.path}"):
            return bool(self._made.recognises(file.path))

    def boxes(self, path: Path) -> LabelBoxes:
        """The boxes of a file. Raises McaptrackError, with the format, if it can't be read."""
        refuse_special(path)
        with blamed(self.entry, f"can't read {path}"):
            boxes = self._made.read(path)
        if not isinstance(boxes, LabelBoxes):
            raise McaptrackError(f"{self.entry} gave a {type(boxes).__name__} of {path}; read has to give LabelBoxes")
        return boxes

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The boxes of a file."""
        path, boxes = file.path, self.boxes(file.path)
        with blamed(self.entry, f"gave what are no boxes of {path}"):
            table = _table_of(path, boxes, self.in_space)
        entry = self.entry
        table.facts.plugin = Plugin(entry.name, entry.implementation, entry.distribution, entry.version)
        return table

    def checking(self) -> AbstractContextManager[None]:
        """A block in which refusals are of this format."""
        return blamed(self.entry, "gave boxes that can't be labels")


def _table_of(path: Path, given: LabelBoxes, in_space: bool) -> BoxTable:
    """Raise ValueError for what has another type, shape or range."""
    width = 7 if in_space else 4
    boxes = np.asarray(given.boxes, np.float64)
    boxes = boxes.reshape(0, width) if not boxes.size else boxes
    if boxes.ndim != 2 or boxes.shape[1] != width:
        raise ValueError(f"boxes of shape {boxes.shape}; with in_space = {in_space} they are (N, {width})")
    count = len(boxes)
    if (given.frame is None) == (given.t_s is None):
        raise ValueError("frame and t_s; one of the two says which picture a box is of")
    frame, labelled, times_s = _frames(given, count) if given.t_s is None else _timed_frames(given, count)
    kind, names = _classes(given, count)
    score = np.full(count, np.nan) if given.score is None else _column("score", given.score, count)
    first = given.first_frame
    if isinstance(first, bool) or not isinstance(first, int | np.integer):
        raise ValueError(f"first_frame={first!r:.40}, which is no whole number")
    facts = LabelFacts(
        path, first_frame=int(first), times_s=times_s, labelled=labelled, frame_id=str(given.frame_id),
        states_labelled=given.labelled is not None,
    )  # fmt: skip
    facts.name(names)
    table = BoxTable(
        facts=facts, at=lambda row: f"{path}: box {row + 1}", frame=frame, id=_ids(given, count), score=score,
        class_id=kind, boxes_px=None if in_space else boxes, boxes_m=boxes if in_space else None,
    )  # fmt: skip
    if in_space and times_s is not None:
        times = np.rint(times_s * NS_PER_S).astype(np.int64)
        table.frame, facts.labelled, facts.times_s, facts.is_timed = times[frame], times[labelled], None, True
    return table


def _frames(given: LabelBoxes, count: int) -> tuple[Ints, Ints, None]:
    """The frames of boxes, and those that are labelled."""
    frame, labelled = _column("frame", given.frame, count), _labelled(given)
    for name, values in (("frame", frame), ("labelled", labelled)):
        _refuse(name, values, (values != np.rint(values)) | (values < 0) | (values > MAX_FRAME), "number of a picture")
    return frame.astype(np.int64), np.unique(labelled).astype(np.int64), None


def _timed_frames(given: LabelBoxes, count: int) -> tuple[Ints, Ints, Floats]:
    """The frames of boxes, and those that are labelled, as places in the times, which rise."""
    seconds, labelled = _column("t_s", given.t_s, count), _labelled(given)
    for name, values in (("t_s", seconds), ("labelled", labelled)):
        _refuse(name, values, (values < 0) | (values > LAST_NS // NS_PER_S), "second from 0 to the year 2262")
    times_s, places = np.unique(np.concatenate([seconds, labelled]), return_inverse=True)
    return places[:count], np.unique(places[count:]), times_s


def _labelled(given: LabelBoxes) -> Floats:
    return np.asarray([] if given.labelled is None else given.labelled, np.float64).reshape(-1)


def _column(name: str, values: Any, count: int) -> Floats:
    array = np.asarray(values, np.float64)
    if array.shape != (count,):
        raise ValueError(f"{name} of shape {array.shape} for {count} boxes")
    return array


def _refuse(name: str, values: Floats, wrong: Bools, what: str) -> None:
    wrong = wrong | ~np.isfinite(values)
    if wrong.any():
        raise ValueError(f"{name} with {values[wrong][0]:g}, which is no {what}")


def _ids(given: LabelBoxes, count: int) -> Ints:
    if given.track_id is None or not count:
        return np.full(count, NO_ID)
    ids = np.asarray(given.track_id)
    if ids.shape != (count,):
        raise ValueError(f"track_id of shape {ids.shape} for {count} boxes")
    if ids.dtype.kind in "iu":
        return ids.astype(np.int64)
    if ids.dtype.kind not in "UO" or not all(isinstance(text, str) for text in ids.tolist()):
        raise ValueError(f"track_id of type {ids.dtype}; ids are whole numbers or texts")
    has_id = ids.astype(str) != ""
    out = np.full(count, NO_ID)
    out[has_id] = numbered(ids[has_id].tolist())
    return out


def _classes(given: LabelBoxes, count: int) -> tuple[Ints, dict[int, str]]:
    """The class of each box (N,), as the number of a name, or ``NO_CLASS``; and the names."""
    if given.class_name is None:
        return np.full(count, NO_CLASS), {}
    texts = list(given.class_name)
    if isinstance(given.class_name, str) or len(texts) != count or not all(isinstance(text, str) for text in texts):
        raise ValueError(f"class_name that are not {count} texts")
    names = ClassNames()
    return np.array([names.number(text) for text in texts], np.int64), names.names


def format_named(name: str) -> Format:
    """The format of this name, our own or of another package.

    Raises McaptrackError if there is none, or if it can't be used.
    """
    entry = find(_KIND, name)
    return _of_class(name, entry.cls) if entry.is_built_in else _made(entry)


def _of_class(name: str, cls: type[Format]) -> Format:
    made = cls()
    made.name = name
    return made


def own_formats() -> list[Format]:
    """The formats of mcaptrack, of the core and of extensions, in the order in which they are asked about a file."""
    return [_of_class(name, cls) for name, cls in _own_classes(tuple(own(_KIND).items()))]


@lru_cache(maxsize=4)
def _own_classes(formats: tuple[tuple[str, str], ...]) -> list[tuple[str, type[Format]]]:
    classes = [(name, load(name, value)) for name, value in formats]
    return sorted(classes, key=lambda entry: (entry[1].rank, entry[0]))


@lru_cache(maxsize=16)
def _made(entry: Entry) -> FormatOfPackage:
    return FormatOfPackage(entry, entry.made("read"))


def recognised(file: LabelFile) -> Format | None:
    """The format by an entry point that a file is of, by what these say; one that can't say is named in a warning.

    Raises McaptrackError if several say so.
    """
    formats: dict[str, Format] = {}
    for name in sorted({*names(_KIND)} - {*own(_KIND)}):
        try:
            made = format_named(name)
            formats |= {name: made} if made.recognises(file) else {}
        except McaptrackError as error:
            warn(str(error), "other")
    if len(formats) > 1:
        several = " and ".join(str(find(_KIND, name)) for name in formats)
        raise McaptrackError(f"{file.path} is of the {several}; choose one with `label_format=`")
    return next(iter(formats.values()), None)
