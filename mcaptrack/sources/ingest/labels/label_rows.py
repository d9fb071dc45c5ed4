"""Labels as rows of detections and tracks. Letters: N rows."""

from __future__ import annotations

import numpy as np

from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, TRACKS, Rows
from mcaptrack.sources.ingest.labels.formats import Labels, Role


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
