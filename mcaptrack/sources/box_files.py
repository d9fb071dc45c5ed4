"""The boxes of one channel as a file of another program: what every such format shares, and MOTChallenge.

Letters: N rows, F frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.notices import Progress, warn
from mcaptrack.schema import DETECTIONS, SCHEMAS, TRACKS
from mcaptrack.schema.classes import PERSON, class_name, class_names, is_person
from mcaptrack.schema.framing import joined_parts
from mcaptrack.sources.cameras import cameras
from mcaptrack.sources.ingest.labels.mot import MOT_CLASSES
from mcaptrack.sources.pictures import size_of_pictures

__all__ = ["BoxFile", "ExportedBoxes", "boxes_topic", "joined_lines", "merged_classes", "score_text", "unscored"]

#: The id of boxes without one.
NO_ID: Final = -1
#: Below the name of a camera, the best first: re-tracked boxes of every picture before those of the tracker.
_PREFERRED: Final = ("retracks/full", "tracks", "retracks", "detections")
#: Lines of text that are encoded together.
_LINES: Final = 4096


@dataclass(frozen=True)
class ExportedBoxes:
    """Rows with a box in pixels, in order of frames.

    ``frame`` (N,) are numbers of pictures from 0; ``frames`` (F,) those of all frames, with or without rows, and
    ``t_ns`` (F,) their times. ``id`` (N,) is -1 for detections. ``boxes`` (N, 4) are left, top, width and height in px;
    ``xy_m`` (N, 2) is NaN where it isn't known; ``score`` (N,) is float32, NaN where there is none. ``size`` is that of
    pictures, None if there are none. ``has_ids``: the rows are tracks.

    ``class_id`` (N,) are classes, with ``names`` by class id; ``observed`` (N,) says which boxes were not filled in.
    ``has_3d``: the channel has boxes in space. ``topic`` is the channel, and ``notes`` are lines on what was left out
    of it.
    """

    topic: str
    frames: Ints
    t_ns: Ints
    frame: Ints
    id: Ints
    boxes: Floats
    xy_m: Floats
    score: NDArray[np.float32]
    class_id: Ints
    observed: Bools
    names: Mapping[int, str]
    has_ids: bool
    has_3d: bool
    size: tuple[int, int] | None
    notes: tuple[str, ...]

    @property
    def classes(self) -> dict[int, str]:
        """The names of the classes that rows have, by number, rising."""
        return {number: class_name(number, self.names) for number in np.unique(self.class_id).tolist()}

    @property
    def last_frame(self) -> int:
        """The number of the last frame."""
        return int(self.frames[-1])


def boxes_topic(opened: log.Log, topic: str | None = None) -> str:
    """The channel with this topic, or the best tracks of the only camera, or else its detections.

    Raises McaptrackError, with the channels that there are, if there is none or if there are several cameras.
    """
    with_boxes = sorted(
        channel.topic
        for channel in log.topics_with_schema(opened, [DETECTIONS.name, TRACKS.name])
        if channel.messages and any(channel.holds(schema) for schema in (DETECTIONS, TRACKS))
    )
    if topic is not None:
        topic = opened.find(topic)
        if topic in with_boxes:
            return topic
        opened.channel(topic)  # says what there is
        raise McaptrackError(f"{opened.path}: {topic} has no detections and no tracks; {_listed(with_boxes)} have")
    if not with_boxes:
        raise McaptrackError(f"{opened.path} has no detections and no tracks to write; run a stage first")
    best: list[str] = []
    for camera in cameras(opened):
        names = (f"{prefix}/{name}" for name in _PREFERRED for prefix in (camera.prefix, *camera.names))
        preferred = next((name for name in names if name in with_boxes), None)
        best += [preferred] if preferred else []
    best = best or with_boxes
    if len(best) > 1:
        raise McaptrackError(f"{opened.path} has boxes in {_listed(best)}; choose one with `topic=`")
    return best[0]


def _listed(topics: list[str]) -> str:
    return ", ".join(topics) or "no channels"


def read_boxes(opened: log.Log, topic: str) -> ExportedBoxes:
    """The boxes of a channel. Raises McaptrackError if no row has a box in pixels."""
    channel = opened.channel(topic)
    schema = SCHEMAS[channel.schema_name]
    columns = opened.frame_columns(topic, schema)
    numbers, notes = _frame_numbers(topic, columns.numbers)
    parts: list[tuple[NDArray[np.generic], ...]] = []
    without = 0
    has_3d = False
    for first, _, joined in joined_parts(schema, columns):
        rows = joined.rows
        boxes = columns_to_boxes(rows)
        kept = np.isfinite(boxes).all(axis=1)
        without += int((~kept).sum())
        has_3d = has_3d or bool(np.isfinite(rows["z_m"]).any())
        is_detections = schema is DETECTIONS
        parts.append(
            (
                numbers[joined.frame[kept] + first],
                np.full(int(kept.sum()), NO_ID) if is_detections else rows["track_id"][kept].copy(),
                boxes[kept],
                np.stack([rows["x_m"][kept], rows["y_m"][kept]], axis=-1),
                rows["score"][kept].copy(),
                rows["class_id"][kept].astype(np.int64),
                np.ones(int(kept.sum()), bool) if is_detections else rows["observed"][kept].copy(),
            )
        )
    if not parts or not sum(len(part[0]) for part in parts):
        what = "positions in metres, and no boxes in pixels" if without else "no rows"
        raise McaptrackError(f"{opened.path}: {topic} has {what}; a file of boxes needs boxes in pixels")
    if without:
        notes.append(f"{topic}: {without:,} rows without a box in pixels are left out")
    frame, track_id, boxes, xy_m, score, class_id, observed = (
        np.concatenate([part[k] for part in parts]) for k in range(7)
    )
    return ExportedBoxes(
        topic, numbers, columns.t_ns, frame, track_id, boxes, xy_m, score, class_id, observed,
        class_names(channel.metadata), schema is not DETECTIONS, has_3d, _size(opened, topic), tuple(notes),
    )  # fmt: skip


def _frame_numbers(topic: str, numbers: Ints) -> tuple[Ints, list[str]]:
    """The numbers of frames (F,), and notes: numbers that don't rise are replaced by the order of the frames."""
    if len(numbers) and (numbers[0] < 0 or (np.diff(numbers) <= 0).any()):
        text = f"{topic}: several of its frames are of one picture; its frames are counted instead, from 0"
        return np.arange(len(numbers)), [text]
    return numbers, []


def _size(opened: log.Log, topic: str) -> tuple[int, int] | None:
    """Width and height of the pictures of a channel's camera; None if there are none that can be decoded."""
    for camera in cameras(opened):
        if topic in camera.topics and camera.pictures:
            return size_of_pictures(opened, camera.pictures)
    return None


# Files.


class BoxFile:
    """A format of files with the boxes of one channel; as an exporter it warns of what the file can't hold.

    ``title`` is its name in warnings, ``end`` the end of the names of files. ``holds`` are those of "scores",
    "observed" and "metres" that have a place in it.
    """

    title: ClassVar[str]
    end: ClassVar[str]
    holds: ClassVar[frozenset[str]] = frozenset()

    def content(self, boxes: ExportedBoxes) -> Iterator[bytes]:
        """Yield the bytes of a file."""
        raise NotImplementedError

    def remarks(self, boxes: ExportedBoxes) -> Iterable[str]:
        """Say how the file differs from the channel; "" is nothing to say."""
        return ()

    def write(
        self,
        recording: Any,
        path: Path,
        topic: str | None = None,
        progress: Progress = lambda *_: None,
    ) -> dict[str, int]:
        """Write one channel of a log: by default the best tracks of the only camera, or its detections.

        Raises McaptrackError if there is no such channel, or if it has no boxes in pixels.
        """
        with log.read(recording.path) as opened:
            boxes = read_boxes(opened, boxes_topic(opened, topic))
        rows = len(boxes.frame)
        progress("export", 0, rows)
        with path.open("wb") as file:
            for number, part in enumerate(self.content(boxes), start=1):
                file.write(part)
                progress("export", min(number, rows), rows)
        progress("export", rows, rows)
        for remark in filter(None, (*boxes.notes, self._left_out(boxes), *self.remarks(boxes))):
            warn(remark, "left-out")
        return {boxes.topic: rows}

    def _left_out(self, boxes: ExportedBoxes) -> str:
        """The contents of rows that the file lacks, as text; "" if nothing is missing."""
        has_contents = {
            "sizes and headings of 3D boxes": boxes.has_3d,
            "positions in metres": "metres" not in self.holds and bool(np.isfinite(boxes.xy_m).any()),
            "scores": "scores" not in self.holds and bool(np.isfinite(boxes.score).any()),
            "which boxes were filled in": "observed" not in self.holds and not boxes.observed.all(),
        }
        lacking = [what for what, is_there in has_contents.items() if is_there]
        return f"{self.title} has no place for {' and '.join(lacking)}; they are left out" if lacking else ""


def unscored(boxes: ExportedBoxes) -> str:
    """Say how many boxes have the score 1 in a file in which each has one; "" if none do."""
    scored = np.isfinite(boxes.score)
    is_mixed = scored.any() and not scored.all()
    return f"{int((~scored).sum()):,} boxes without a score have 1 there" if is_mixed else ""


def merged_classes(classes: Mapping[int, str], written: Mapping[int, object]) -> str:
    """Say which classes are written alike, each as ``written`` has it; "" if none are."""
    groups: dict[object, list[str]] = {}
    for kind, name in classes.items():
        groups.setdefault(written[kind], []).append(name)
    alike = [f"{' and '.join(names)} are both {shared}" for shared, names in groups.items() if len(names) > 1]
    return f"classes that the file can't tell apart: {', '.join(alike)}" if alike else ""


def score_text(score: np.float32) -> str:
    """A score with as many digits as it takes to read it again; "" if there is none."""
    return str(score) if np.isfinite(score) else ""


def joined_lines(lines: Iterable[str]) -> Iterator[bytes]:
    """Lines as bytes, many at once."""
    rest = iter(lines)
    while part := "".join(islice(rest, _LINES)):
        yield part.encode("utf-8")


class MotFile(BoxFile):
    """MOTChallenge with 9 columns: frame from 1, id, left, top, width, height, confidence, class, visibility (-1)."""

    title, end, holds = "MOTChallenge", ".mot.txt", frozenset({"scores"})

    def content(self, boxes: ExportedBoxes) -> Iterator[bytes]:
        """Yield the lines; numbers have as many digits as it takes to read the same number again."""
        number = mot_numbers(boxes.classes)
        kinds = [number[kind] for kind in boxes.class_id.tolist()]
        yield from joined_lines(
            f"{frame + 1},{track},{x!r},{y!r},{w!r},{h!r},{score_text(score) or 1},{kind},-1\n"
            for frame, track, (x, y, w, h), score, kind in zip(
                boxes.frame.tolist(), boxes.id.tolist(), boxes.boxes.tolist(), boxes.score, kinds, strict=True
            )
        )

    def remarks(self, boxes: ExportedBoxes) -> Iterable[str]:
        """Say which boxes have no score, and which classes no number of MOTChallenge, or one number."""
        numbers = mot_numbers(boxes.classes)
        others = [
            f"{name} is {numbers[kind]}" for kind, name in boxes.classes.items() if numbers[kind] not in MOT_CLASSES
        ]
        renumbered = f"MOTChallenge has no number for some classes, and no names: {', '.join(others)}" if others else ""
        return unscored(boxes), renumbered, merged_classes(boxes.classes, numbers)


def mot_numbers(classes: Mapping[int, str]) -> dict[int, int]:
    """The numbers of MOTChallenge for classes; others get numbers after the last one of MOTChallenge."""
    number_of_name = {name: number for number, name in MOT_CLASSES.items()}
    out: dict[int, int] = {}
    following = max(MOT_CLASSES) + 1
    for kind, name in classes.items():
        if is_person(name):
            out[kind] = PERSON
        elif name.casefold() in number_of_name:
            out[kind] = number_of_name[name.casefold()]
        else:
            out[kind] = following
            following += 1
    return out
