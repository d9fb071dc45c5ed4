"""Boxes as a table with a header, which is read as any other such table.

Numbers are written with as many digits as it takes to read the same number again.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator

import numpy as np

from mcaptrack.sources.box_files import BoxFile, ExportedBoxes, score_text


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
