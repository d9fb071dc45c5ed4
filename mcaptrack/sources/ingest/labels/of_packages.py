"""Label formats of other packages (``contracts.LabelFormat``): which file is of which, and their boxes, checked.

Letters: N rows, F frames.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.contracts import LabelBoxes, is_in_space
from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.registry import BUILT_IN, Entry, blamed, find, others
from mcaptrack.schema.classes import PERSON, is_person
from mcaptrack.schema.provenance import Plugin
from mcaptrack.sources.ingest.labels.content import (
    MAX_FRAME,
    NO_CLASS,
    NO_ID,
    BoxRows3D,
    Labels,
    WantedClasses,
    numbered,
)

_KIND: Final = "label_format"


class FormatOfPackage(NamedTuple):
    """A format, as the registry found it, and its object."""

    entry: Entry
    format: Any
    in_space: bool

    @property
    def plugin(self) -> Plugin:
        """Its description in the provenance of a channel."""
        return Plugin(self.entry.name, self.entry.implementation, self.entry.distribution, self.entry.version)

    def recognises(self, path: Path) -> bool:
        """Whether a file is of this format, as far as it can tell."""
        if not hasattr(self.format, "recognises"):
            return False
        with blamed(self.entry, f"failed to look at {path}"):
            return bool(self.format.recognises(path))

    def boxes(self, path: Path) -> LabelBoxes:
        """The boxes of a file. Raises McaptrackError, with the format, if it can't be read."""
        refuse_special(path)
        with blamed(self.entry, f"can't read {path}"):
            boxes = self.format.read(path)
        if not isinstance(boxes, LabelBoxes):
            raise McaptrackError(f"{self.entry} gave a {type(boxes).__name__} of {path}; read has to give LabelBoxes")
        return boxes

    def labels(self, path: Path, role: Role, wanted: WantedClasses) -> Labels:
        """The boxes of a file in pictures, checked as those of all formats are."""
        given = self._columns(path)
        rows = Labels(
            path, self.entry.name, given.at, given.frame, given.id, given.boxes, given.score, given.kind,
            labelled=given.labelled, first_frame=given.first_frame, plugin=self.plugin, times_s=given.times_s,
            states_labelled=bool(len(given.labelled)),
        )  # fmt: skip
        numbers = _numbers_of(given.names)
        rows.class_id = np.array([*numbers, NO_CLASS])[given.kind]
        with self._named():
            settled = rows.settled(role, wanted, dict(zip(numbers, given.names, strict=True)) or None)
            if role != "detections":
                settled.refuse_repeated_ids()
        return settled

    def rows_3d(self, path: Path, role: Role) -> BoxRows3D:
        """The boxes of a file in space, checked as those of all formats are."""
        given = self._columns(path)
        if given.times_s is not None:
            times = np.rint(given.times_s * NS_PER_S).astype(np.int64)
            given = given._replace(frame=times[given.frame], labelled=times[given.labelled])
        rows = BoxRows3D(
            path, self.entry.name, given.at, given.frame, given.id, given.boxes, given.score, given.kind,
            labelled=np.union1d(given.labelled, given.frame), plugin=self.plugin, names=given.names,
            is_timed=given.times_s is not None, frame_id=given.frame_id,
        )  # fmt: skip
        with self._named():
            rows.check(role)
        return rows

    def _named(self) -> Any:
        return blamed(self.entry, "gave boxes that can't be labels")

    def _columns(self, path: Path) -> _Columns:
        given = self.boxes(path)
        with blamed(self.entry, f"gave what are no boxes of {path}"):
            return _columns_of(path, given, self.in_space)


class _Columns(NamedTuple):
    """``LabelBoxes`` as arrays. ``frame`` (N,) and ``labelled`` (F,) are numbers of frames, or places in ``times_s``.
    ``kind`` (N,) are places in ``names``, or -1.
    """

    path: Path
    boxes: Floats
    frame: Ints
    id: Ints
    kind: Ints
    names: list[str]
    score: Floats
    labelled: Ints
    times_s: Floats | None
    first_frame: int
    frame_id: str

    def at(self, row: int) -> str:
        """The place of a row in messages."""
        return f"{self.path}: box {row + 1}"


def _columns_of(path: Path, given: LabelBoxes, in_space: bool) -> _Columns:
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
    return _Columns(
        path, boxes, frame, _ids(given, count), kind, names, score, labelled, times_s, int(first), str(given.frame_id)
    )


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
    out[has_id] = numbered(ids[has_id].tolist())[0]
    return out


def _classes(given: LabelBoxes, count: int) -> tuple[Ints, list[str]]:
    """The place of the class of each box (N,) among the names, or -1; and the names, in alphabetical order."""
    if given.class_name is None:
        return np.full(count, NO_CLASS), []
    texts = list(given.class_name)
    if isinstance(given.class_name, str) or len(texts) != count or not all(isinstance(text, str) for text in texts):
        raise ValueError(f"class_name that are not {count} texts")
    names = sorted({text for text in texts if text.strip()})
    places = {name: place for place, name in enumerate(names)}
    return np.array([places.get(text, NO_CLASS) for text in texts], np.int64), names


def _numbers_of(names: list[str]) -> list[int]:
    """The class ids of names: people are 1, the others follow in their order."""
    rest = iter(range(PERSON + 1, PERSON + 1 + len(names)))
    return [PERSON if is_person(name) else next(rest) for name in names]


def format_of_package(name: str) -> FormatOfPackage | None:
    """The format of another package that has this name; None for "auto" and built-in ones.

    Raises McaptrackError if there is none, or if it can't be used.
    """
    return None if name == "auto" or name in BUILT_IN[_KIND] else _made(find(_KIND, name))


@lru_cache(maxsize=16)
def _made(entry: Entry) -> FormatOfPackage:
    made = entry.made("read")
    return FormatOfPackage(entry, made, is_in_space(entry, made))


def recognised(path: Path) -> FormatOfPackage | None:
    """The format of another package that a file is of, by what these say; one that can't say is named in a warning.

    Raises McaptrackError if several say so.
    """
    found: list[FormatOfPackage] = []
    for name in others(_KIND):
        try:
            made = format_of_package(name)
            found += [made] if made is not None and made.recognises(path) else []
        except McaptrackError as error:
            warn(str(error), "other")
    if len(found) > 1:
        names = " and ".join(str(made.entry) for made in found)
        raise McaptrackError(f"{path} is of the {names}; choose one with `label_format=`")
    return found[0] if found else None
