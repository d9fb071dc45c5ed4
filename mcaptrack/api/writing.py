"""Write rows of a user into a log, as a channel like any other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api.common import warnings_about
from mcaptrack.api.options import no_progress
from mcaptrack.api.products import write_products
from mcaptrack.api.rows import frames_of
from mcaptrack.api.running import warn_stale
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import Planes, plane_at
from mcaptrack.location import Location
from mcaptrack.pipeline.views import make_views
from mcaptrack.pipeline.write import Made, RunState, write
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.provenance import INGEST, Provenance
from mcaptrack.sources.cameras import USUAL
from mcaptrack.sources.own_rows import UNNUMBERED, checked_names
from mcaptrack.sources.sidecar import SidecarChoice

#: What channels usually hold, by the end of their topic.
_HOLDS: Final[Mapping[str, Schema]] = {"detections": DETECTIONS, "tracks": TRACKS, "truth": TRACKS}
#: The ends of names of channels that stand beside others.
_BESIDE: Final = ("events", "counts", "errors", "scores", "view")
_SUCH: Final = "/own/detections or /own/tracks"
#: The frame of detections in metres, unless it is given.
_FRAME: Final = "map"
#: The longest topic in bytes.
_LONGEST: Final = 1024


def write_rows(
    path: Location,
    topic: str,
    rows: Any,
    *,
    classes: Mapping[int, str] | None,
    frame_id: str,
    replace: bool,
    sidecar: bool | None,
) -> int:
    """Write rows as a channel of the log; returns the number of frames. See ``Recording.write``."""
    place, names_by_number = SidecarChoice(sidecar), checked_names(classes)
    with warnings_about(path), logs.read(path, sidecar=place) as opened:
        opened.lock()
        name = _topic(opened, topic)
        prefix, _, last = name.rpartition("/")
        schema, frames, names_in_rows = frames_of(rows, _HOLDS.get(last))
        names = {str(number): class_name for number, class_name in sorted((names_in_rows | names_by_number).items())}
        _refuse_to_replace(opened, name, schema, replace)
        planes = pipeline.read_planes(opened, prefix) or ()
        frames = _numbered(
            opened, prefix, [_in_metres(frame, planes) if schema is TRACKS else frame for frame in frames]
        )
        own_frame = frame_id or (_FRAME if schema is DETECTIONS and _in_space(frames) else "")
        how = Provenance(INGEST, {"written_with": "mcaptrack.open"}, classes=names, frame_id=own_frame)
        channel = Made.of(schema, frames, how)
        state = RunState(opened, prefix, {name: channel})
        write(state, None, make_views(state, planes))
        stale = pipeline.outdated_by(opened, {name: channel.provenance.digest})
        for topic_of_stage in stale:
            warn_stale(topic_of_stage, path, {topic_of_stage: pipeline.camera_to_name(opened, topic_of_stage)})
    write_products(path, is_new=True, progress=no_progress)
    return len(frames)


def _in_space(frames: Sequence[Frame]) -> bool:
    """Return whether rows are positions in metres alone."""
    parts = [frame.rows for frame in frames if len(frame.rows)]
    return bool(parts) and all(np.isnan(rows["x_px"]).all() for rows in parts)


def _topic(opened: logs.Log, topic: str) -> str:
    """Return the topic of a channel to write: as it is given, or below the only camera."""
    if not isinstance(topic, str):
        raise McaptrackError(f"a topic is text such as detections or /camera/detections, not {topic!r:.40}")
    name = topic if "/" in topic else f"{pipeline.find_camera(opened, None, None)}/{topic}"
    if not topic or not name.startswith("/") or not all(name[1:].split("/")) or not name.isprintable():
        raise McaptrackError(f"{topic!r:.80} is no topic; give one such as detections or /camera/detections")
    if len(name.encode()) > _LONGEST:
        raise McaptrackError(f"{topic:.80}... is longer than {_LONGEST} bytes; give the channel a shorter topic")
    taken = [*(usual for usual in USUAL if usual not in _HOLDS), *_BESIDE]
    if "/view/" in name or name.endswith(tuple(f"/{end}" for end in taken)):
        raise McaptrackError(f"{name} is a name of what stages make or of pictures; write to another, such as {_SUCH}")
    return name


def _refuse_to_replace(opened: logs.Log, name: str, schema: Schema, replace: bool) -> None:
    """Raise McaptrackError if there is a channel of this name that has to stay."""
    channel = opened.channels.get(name)
    if channel is None:
        return
    if channel.schema_name != schema.name:
        raise McaptrackError(
            f"{opened.path} has {name}, which holds {channel.schema_name or 'no schema'} and is not replaced by "
            f"{schema.name}; write to another channel, such as {_SUCH}"
        )
    if not replace:
        raise McaptrackError(f"{opened.path} has {name} already; `replace=True` replaces it")


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
