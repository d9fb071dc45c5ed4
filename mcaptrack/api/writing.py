"""Rows of a user into a log, as a channel like any other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api.common import warnings_about
from mcaptrack.api.rows import UNNUMBERED, frames_of
from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish_bytes
from mcaptrack.geometry.plane import Planes, plane_at
from mcaptrack.pipeline.write import Made, write
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.provenance import INGEST, Provenance
from mcaptrack.sources.ingest.sidecar import SidecarChoice

#: What channels usually hold, by the end of their topic.
_HOLDS: Final[Mapping[str, Schema]] = {"detections": DETECTIONS, "tracks": TRACKS, "truth": TRACKS}


def write_rows(path: Path, topic: str, rows: Any, *, replace: bool, sidecar: bool | None) -> int:
    """Write rows as a channel of the log; returns the number of frames. See ``Recording.write``."""
    place = SidecarChoice(sidecar)
    with warnings_about(path), logs.read(path, sidecar=place) as opened:
        opened.lock()
        prefix = pipeline.find_camera(opened, None, None) if "/" not in topic else ""
        name = f"{prefix}/{topic}" if prefix else topic
        if not name.startswith("/") or name.endswith("/"):
            raise McaptrackError(f"{topic} is no topic; give one such as detections or /camera/detections")
        prefix = prefix or name.rpartition("/")[0]
        schema, frames = frames_of(rows, _HOLDS.get(name.rpartition("/")[2]))
        if name in opened.channels and not replace:
            raise McaptrackError(f"{path} has {name} already; `replace=True` replaces it")
        planes = pipeline.read_planes(opened, prefix) or ()
        frames = _numbered(
            opened, prefix, [_in_metres(frame, planes) if schema is TRACKS else frame for frame in frames]
        )
        made = Made.of(schema, frames, Provenance(INGEST, {"written_with": "mcaptrack.open"}))
        layouts = write(opened, prefix, {name: made}, planes, {}, None)
        for layout, content in layouts.items():
            publish_bytes(pipeline.layout_path(path, layout), content)
    return len(frames)


def _numbered(opened: logs.Log, prefix: str, frames: Sequence[Frame]) -> list[Frame]:
    """Give each frame without a number that of the picture shown then, or its place in order without pictures."""
    pictures = pipeline.camera_at(opened, prefix).pictures
    times = opened.times(pictures) if pictures else np.empty(0, np.int64)
    out = []
    for order, frame in enumerate(frames):
        number = int(np.searchsorted(times, frame.t_ns, "right")) - 1 if len(times) else order
        out.append(frame._replace(index=max(number, 0)) if frame.index == UNNUMBERED else frame)
    return out


def _in_metres(frame: Frame, planes: Planes) -> Frame:
    """Positions on the ground for tracks that have boxes only."""
    plane, rows = plane_at(planes, frame.t_ns) if planes else None, frame.rows
    missing = np.isnan(rows["x_m"]) & np.isfinite(rows["x_px"])
    if plane is None or not missing.any():
        return frame
    rows = rows.copy()
    boxes = np.stack([rows[name][missing] for name in ("x_px", "y_px", "w_px", "h_px")], axis=-1)
    rows["x_m"][missing], rows["y_m"][missing] = plane.boxes_to_metres(boxes).T
    return frame._replace(rows=rows)
