"""The ground planes of a camera: given, or guessed from its boxes."""

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
    """The ground planes of a camera with the times from which they hold; None if there are none."""
    topic = camera_at(opened, prefix).ground_plane
    if topic not in opened.channels:
        return None
    frames = opened.frames(topic, GROUND_PLANE)
    return [(frame.t_ns, rows_to_plane(frame.rows)) for frame in frames] or None


def planes_to_json(planes: Planes) -> list[Any]:
    """Planes as the parameters of a channel have them."""
    kept: list[Any] = json.loads(json.dumps([(t_ns, asdict(plane)) for t_ns, plane in planes]))
    return kept


def guess_plane(
    frames: Sequence[Frame], source: str, digest: str
) -> tuple[Planes | None, tuple[list[Frame], Provenance] | None]:
    """A scale from boxes where no ground plane is given: planes, and the frames and making of the channel for them.

    ``source`` is where the boxes are from, and ``digest`` what that holds. None and None if there are no boxes.
    """
    rows = np.concatenate([frame.rows[["x_px", "y_px", "w_px", "h_px"]] for frame in frames]) if frames else None
    if rows is None or not np.isfinite(rows["h_px"]).any():
        return None, None  # nothing in pixels: nothing to bring to metres
    width, height = (int(np.nanmax(rows[a] + rows[b]).round()) for a, b in (("x_px", "w_px"), ("y_px", "h_px")))
    plane: GroundPlane = assumed_plane(rows["h_px"], width, height)
    start = frames[0].t_ns
    return [(start, plane)], ([Frame(start, 0, plane_to_rows(plane))], Provenance(_ASSUME, {}, source, digest))


def is_poor(frames: Sequence[Frame]) -> bool:
    """Whether one scale can't hold for all of the picture, by the boxes of tracks."""
    boxes = columns_to_boxes(TRACKS.joined([frame.rows for frame in frames]))
    return ground_depth(boxes[np.isfinite(boxes).all(axis=1)]) < LEAST_DEPTH
