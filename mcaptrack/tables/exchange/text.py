"""Boxes as lines of text: MOTChallenge, KITTI tracking, and a table with a header.

Numbers are written with as many digits as it takes to read the same number again.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Final

import numpy as np

from mcaptrack.schema.classes import PERSON, is_person
from mcaptrack.sources.ingest.labels.mot import MOT_CLASSES
from mcaptrack.tables.exchange.boxes import ExportedBoxes

_LINES: Final = 4096
#: What KITTI's tools write for numbers that are not known: angle, size and position of a 3D box, rotation.
_KITTI_UNKNOWN: Final = "-10 {box} -1 -1 -1 -1000 -1000 -1000 -10"


def mot(boxes: ExportedBoxes) -> Iterator[bytes]:
    """MOTChallenge with 9 columns: frame from 1, id, left, top, width, height, confidence, class, visibility (-1)."""
    number = mot_numbers(boxes.classes)
    kinds = [number[kind] for kind in boxes.class_id.tolist()]
    yield from _joined(
        f"{frame + 1},{track},{x!r},{y!r},{w!r},{h!r},{_text(score) or 1},{kind},-1\n"
        for frame, track, (x, y, w, h), score, kind in zip(
            boxes.frame.tolist(), boxes.id.tolist(), boxes.boxes.tolist(), boxes.score, kinds, strict=True
        )
    )


def mot_numbers(classes: dict[int, str]) -> dict[int, int]:
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


def describe_mot_numbers(classes: dict[int, str]) -> str:
    """Say which classes have no number of MOTChallenge; "" if all have one."""
    numbers = mot_numbers(classes)
    renumbered = [f"{name} is {numbers[kind]}" for kind, name in classes.items() if numbers[kind] not in MOT_CLASSES]
    return f"MOTChallenge has no number for some classes, and no names: {', '.join(renumbered)}" if renumbered else ""


def kitti(boxes: ExportedBoxes) -> Iterator[bytes]:
    """KITTI tracking: frame, id, type, truncated, occluded, and the box by its corners; the score as column 18."""
    names = {kind: kitti_name(name) for kind, name in boxes.classes.items()}
    has_scores = bool(np.isfinite(boxes.score).any())

    def line(frame: int, track: int, name: str, box: list[float], score: np.float32) -> str:
        x, y, w, h = box
        unknown = _KITTI_UNKNOWN.format(box=f"{x!r} {y!r} {x + w!r} {y + h!r}")
        return f"{frame} {track} {name} 0 0 {unknown}{f' {_text(score) or 1}' if has_scores else ''}\n"

    columns = (boxes.frame.tolist(), boxes.id.tolist(), boxes.class_id.tolist(), boxes.boxes.tolist(), boxes.score)
    yield from _joined(
        line(frame, track, names[kind], box, score) for frame, track, kind, box, score in zip(*columns, strict=True)
    )


def kitti_name(name: str) -> str:
    """The name of a class in KITTI: people are pedestrians, and names are single words."""
    word = re.sub(r"[\W_]+", "_", name).strip("_")
    return "Pedestrian" if is_person(name) else word if word[:1].isalpha() else f"class_{word}"


def describe_merged(form: str, classes: dict[int, str]) -> str:
    """Say which classes have one name in KITTI, or one number in MOTChallenge; "" if none have."""
    numbers = mot_numbers(classes)
    groups: dict[str, list[str]] = {}
    for kind, name in classes.items():
        groups.setdefault(kitti_name(name) if form == "kitti" else str(numbers[kind]), []).append(name)
    merged = [f"{' and '.join(names)} are both {shared}" for shared, names in groups.items() if len(names) > 1]
    return f"classes that the file can't tell apart: {', '.join(merged)}" if merged else ""


def boxes_csv(boxes: ExportedBoxes) -> Iterator[bytes]:
    """A table with a header; frames without boxes have a row of their own, without a box."""
    held = io.StringIO()
    writer = csv.writer(held, lineterminator="\n")
    held.write("frame,t_ns,track_id,x,y,w,h,score,class_id,class_name,observed,ground_x_m,ground_y_m\n")
    names = boxes.classes
    ends = np.searchsorted(boxes.frame, boxes.frames, "right").tolist()
    starts = np.searchsorted(boxes.frame, boxes.frames, "left").tolist()
    for frame, t_ns, start, end in zip(boxes.frames.tolist(), boxes.t_ns.tolist(), starts, ends, strict=True):
        if start == end:
            writer.writerow([frame, t_ns, *[""] * 11])
        for row in range(start, end):
            kind, track = int(boxes.class_id[row]), int(boxes.id[row])
            writer.writerow(
                [
                    frame,
                    t_ns,
                    track if boxes.has_ids else "",
                    *map(repr, boxes.boxes[row].tolist()),
                    _text(boxes.score[row]),
                    kind if kind else "",
                    names[kind] if kind else "",
                    int(boxes.observed[row]),
                    *(repr(value) if np.isfinite(value) else "" for value in boxes.xy_m[row].tolist()),
                ]
            )
        if held.tell() > 2**16:
            yield _taken(held)
    yield _taken(held)


def _taken(held: io.StringIO) -> bytes:
    out = held.getvalue().encode("utf-8")
    held.seek(0)
    held.truncate()
    return out


def _text(score: np.float32) -> str:
    """A score with as many digits as it takes to read it again; "" if there is none."""
    return str(score) if np.isfinite(score) else ""


def _joined(lines: Iterable[str]) -> Iterator[bytes]:
    """Lines as bytes, many at once."""
    rest = iter(lines)
    while part := "".join(islice(rest, _LINES)):
        yield part.encode("utf-8")
