"""Boxes as lines of text: KITTI tracking, and a table with a header.

Numbers are written with as many digits as it takes to read the same number again.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np

from mcaptrack.schema.classes import is_person
from mcaptrack.tables.box_files import BoxFile, ExportedBoxes, joined_lines, merged_classes, score_text, unscored

#: What KITTI's tools write for numbers that are not known: angle, size and position of a 3D box, rotation.
_KITTI_UNKNOWN: Final = "-10 {box} -1 -1 -1 -1000 -1000 -1000 -10"


class KittiFile(BoxFile):
    """KITTI tracking: frame, id, type, truncated, occluded, and the box by its corners; the score as column 18."""

    title, end, holds = "KITTI", ".kitti.txt", frozenset({"scores"})

    def content(self, boxes: ExportedBoxes) -> Iterator[bytes]:
        """Yield the lines."""
        names = {kind: kitti_name(name) for kind, name in boxes.classes.items()}
        has_scores = bool(np.isfinite(boxes.score).any())

        def line(frame: int, track: int, name: str, box: list[float], score: np.float32) -> str:
            x, y, w, h = box
            unknown = _KITTI_UNKNOWN.format(box=f"{x!r} {y!r} {x + w!r} {y + h!r}")
            return f"{frame} {track} {name} 0 0 {unknown}{f' {score_text(score) or 1}' if has_scores else ''}\n"

        columns = (boxes.frame.tolist(), boxes.id.tolist(), boxes.class_id.tolist(), boxes.boxes.tolist(), boxes.score)
        yield from joined_lines(
            line(frame, track, names[kind], box, score) for frame, track, kind, box, score in zip(*columns, strict=True)
        )

    def remarks(self, boxes: ExportedBoxes) -> Iterable[str]:
        """Say which boxes have no score, and which classes one name."""
        names = {kind: kitti_name(name) for kind, name in boxes.classes.items()}
        return unscored(boxes), merged_classes(boxes.classes, names)


def kitti_name(name: str) -> str:
    """The name of a class in KITTI: people are pedestrians, and names are single words."""
    word = re.sub(r"[\W_]+", "_", name).strip("_")
    return "Pedestrian" if is_person(name) else word if word[:1].isalpha() else f"class_{word}"


class BoxesCsvFile(BoxFile):
    """A table with a header; frames without boxes have a row of their own, without a box."""

    title, end, holds = "this table", ".boxes.csv", frozenset({"scores", "observed", "metres"})

    def content(self, boxes: ExportedBoxes) -> Iterator[bytes]:
        """Yield the lines."""
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
                        score_text(boxes.score[row]),
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
