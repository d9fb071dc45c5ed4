"""Labels as rows of detections and tracks. Letters: N rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Final

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Rows
from mcaptrack.sources.ingest.labels.content import Labels
from mcaptrack.sources.ingest.labels.timeline import Placed

#: The number of frames of a block, for which times are converted together.
_BLOCK: Final = 4096


def label_rows(labels: Labels, role: Role, plane: GroundPlane | None) -> Rows:
    """Convert the N rows of labels to rows of detections or tracks, with positions in metres if a plane is given."""
    if role == "detections" and labels.boxes_px is not None:
        x, y, w, h = labels.boxes_px.T
        return DETECTIONS.rows(x_px=x, y_px=y, w_px=w, h_px=h, score=labels.score, class_id=labels.class_id)
    nowhere = np.full((len(labels.frame), 4), np.nan)
    boxes = nowhere if labels.boxes_px is None else labels.boxes_px
    xy_m = labels.xy_m
    if xy_m is None:
        xy_m = plane.boxes_to_metres(boxes) if plane else nowhere[:, :2]
    return TRACKS.rows(
        track_id=labels.id,
        x_px=boxes[:, 0],
        y_px=boxes[:, 1],
        w_px=boxes[:, 2],
        h_px=boxes[:, 3],
        x_m=xy_m[:, 0],
        y_m=xy_m[:, 1],
        score=labels.score,
        observed=np.ones(len(labels.frame), bool) if role != "tracks" or labels.observed is None else labels.observed,
        source_id=np.full(len(labels.frame), -1),
        class_id=labels.class_id,
    )


def frames_of_labels(
    parts: Sequence[Callable[[], Labels]], role: Role, plane: GroundPlane | None, placed: Placed
) -> Callable[[], Iterator[Frame]]:
    """The rows of labels, in parts of whole frames, as frames: those that are ``placed``, also empty ones.

    They are made as often as the result is called, and converted once if there is one part.
    """

    @lru_cache(maxsize=1)
    def converted(number: int) -> tuple[Ints, Rows]:
        labels = parts[number]()
        return labels.frame, label_rows(labels, role, plane)

    def frames() -> Iterator[Frame]:
        low = 0
        for number in range(len(parts)):
            frame, rows = converted(number)
            is_last = number == len(parts) - 1
            high = len(placed.number) if is_last else int(np.searchsorted(placed.number, frame[-1], "right"))
            for start in range(low, high, _BLOCK):
                some = slice(start, min(start + _BLOCK, high))
                ends = (np.searchsorted(frame, placed.number[some], side) for side in ("left", "right"))
                columns = (column.tolist() for column in (placed.t_ns[some], placed.index[some], *ends))
                for t_ns, index, first, last in zip(*columns, strict=True):
                    yield Frame(t_ns, index, rows[first:last])
            low = high

    return frames
