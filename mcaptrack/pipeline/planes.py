"""Read the ground planes of a camera, or estimate a scale from the heights of its boxes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from mcaptrack import log
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.plane import LEAST_DEPTH, GroundPlane, Planes, assumed_plane, ground_depth
from mcaptrack.schema import GROUND_PLANE, TRACKS, Frame
from mcaptrack.schema.ground_plane import plane_to_rows, rows_to_plane
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.cameras import camera_at

_ASSUME: Final = "assume-ground-plane"


def read_planes(opened: log.Log, prefix: str) -> Planes | None:
    """Return the ground planes of a camera, each with its start time in ns; None if the log has none."""
    topic = camera_at(opened, prefix).ground_plane
    if topic not in opened.channels:
        return None
    frames = opened.frames(topic, GROUND_PLANE)
    return [(frame.t_ns, rows_to_plane(frame.rows)) for frame in frames] or None


def planes_to_json(planes: Planes) -> list[Any]:
    """Convert ground planes to the JSON values that the parameters of a channel contain."""
    kept: list[Any] = json.loads(json.dumps([(t_ns, asdict(plane)) for t_ns, plane in planes]))
    return kept


def guess_plane(
    frames: Sequence[Frame], source: str, digest: str
) -> tuple[Planes | None, tuple[list[Frame], Provenance] | None]:
    """Estimate a ground plane from the heights of boxes: the planes, and the frames and provenance of their channel.

    ``source`` is the topic of the boxes, and ``digest`` the digest of its messages. Both results are None if no frame
    has boxes in pixels.
    """
    rows = np.concatenate([frame.rows[["x_px", "y_px", "w_px", "h_px"]] for frame in frames]) if frames else None
    if rows is None or not np.isfinite(rows["h_px"]).any():
        return None, None  # without boxes in pixels there is nothing to convert to metres
    width, height = (int(np.nanmax(rows[a] + rows[b]).round()) for a, b in (("x_px", "w_px"), ("y_px", "h_px")))
    plane: GroundPlane = assumed_plane(rows["h_px"], width, height)
    start = frames[0].t_ns
    return [(start, plane)], ([Frame(start, 0, plane_to_rows(plane))], Provenance(_ASSUME, {}, source, digest))


def is_poor(frames: Sequence[Frame]) -> bool:
    """Return whether the size of boxes varies too much over the picture for one scale."""
    boxes = columns_to_boxes(TRACKS.joined([frame.rows for frame in frames]))
    return ground_depth(boxes[np.isfinite(boxes).all(axis=1)]) < LEAST_DEPTH
