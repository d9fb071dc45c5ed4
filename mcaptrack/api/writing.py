"""Write rows of a user into a log, as a channel like any other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api.common import detail, warnings_about
from mcaptrack.api.options import no_progress
from mcaptrack.api.rows import frames_of
from mcaptrack.api.running import warn_stale, write_products
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import Planes, plane_at
from mcaptrack.installed import running_program
from mcaptrack.location import Location
from mcaptrack.pipeline.views import WITH_VIEWS, make_views
from mcaptrack.pipeline.write import Made, RunState, write
from mcaptrack.schema import DETECTIONS, EVENTS, PREDICTIONS, SCHEMAS, TRACKS, Frame, Schema
from mcaptrack.schema.classes import has_classes
from mcaptrack.schema.own import columns_in_metadata, name_for
from mcaptrack.schema.proto import Column
from mcaptrack.schema.provenance import INGEST, WRITTEN_BY, Provenance
from mcaptrack.sources.cameras import USUAL, name_above
from mcaptrack.sources.own_rows import UNNUMBERED, checked_names
from mcaptrack.sources.sidecar import SidecarChoice

#: What channels hold, by the end of their topic.
_HOLDS: Final[Mapping[str, Schema]] = {
    "detections": DETECTIONS,
    "tracks": TRACKS,
    "truth": TRACKS,
    "predictions": PREDICTIONS,
    "events": EVENTS,
}
#: The ends of names of channels that stand beside others.
_BESIDE: Final = ("events", "counts", "errors", "scores", "view")
_SUCH: Final = "/own/detections or /own/tracks"
#: The frame of detections in metres, unless it is given.
_FRAME: Final = "map"
#: The longest topic in bytes, and the longest name of a program.
_LONGEST: Final = 1024
_LONGEST_NAME: Final = 200


def write_rows(
    path: Location,
    topic: str,
    rows: Any,
    schema: Schema | None,
    classes: Mapping[int, str] | None,
    frame_id: str,
    by: str | None,
    replace: bool,
    sidecar: bool | None,
) -> int:
    """Write rows as a channel of the log; returns the number of frames. See ``Recording.write``."""
    place, names_by_number, program = SidecarChoice(sidecar), checked_names(classes), _program(by)
    with warnings_about(path), logs.read(path, sidecar=place) as opened:
        opened.lock()
        name = _topic(opened, topic)
        prefix = name_above(name)
        schema, frames, names_in_rows = frames_of(rows, _schema_of(name, schema), name_for(name))
        names = {str(number): class_name for number, class_name in sorted((names_in_rows | names_by_number).items())}
        if names_by_number and not has_classes(schema):
            raise McaptrackError(f"`classes=` names classes of rows, and {schema.name} has no column class_id")
        _refuse_other_columns(opened, name, schema)
        _refuse_to_replace(opened, name, schema, replace)
        detail(f"{name}: rows of {schema.name}, with {', '.join(map(_described, schema.columns))}")
        planes = pipeline.read_planes(opened, prefix) or ()
        frames = [_in_metres(frame, planes) for frame in frames] if schema is TRACKS else frames
        frames = _numbered(opened, prefix, frames)
        own_frame = frame_id or (_FRAME if _is_in_space(schema, frames) else "")
        how = Provenance(INGEST, {WRITTEN_BY: program}, classes=names, frame_id=own_frame)
        channel = Made.of(schema, frames, how)
        state = RunState(opened, prefix, {name: channel})
        write(state, None, make_views(state, planes) if schema in WITH_VIEWS else None)
        warn_stale(opened, pipeline.outdated_by(opened, {name: channel.provenance.digest}))
    write_products(path, is_new=True, progress=no_progress)
    return len(frames)


def _is_in_space(schema: Schema, frames: Sequence[Frame]) -> bool:
    """Return whether rows are detections in metres alone, or tracks with 3D boxes: no ground plane is their frame."""
    parts = [frame.rows for frame in frames if len(frame.rows)]
    if schema is TRACKS:
        return any(np.isfinite(rows["z_m"]).any() for rows in parts)
    return schema is DETECTIONS and bool(parts) and all(np.isnan(rows["x_px"]).all() for rows in parts)


def _described(column: Column) -> str:
    """Return a column with its unit, as text."""
    return f"{column.name} ({column.unit})" if column.unit else column.name


def _program(by: str | None) -> str:
    """Return the name of the program that writes: as it is given, or that of the running one."""
    if by is None:
        return running_program()[:_LONGEST_NAME]
    if not isinstance(by, str) or not by.strip() or not by.isprintable() or len(by) > _LONGEST_NAME:
        raise McaptrackError(
            f"`by=` is the name of a program, such as 'my_tool 1.2', of at most {_LONGEST_NAME} characters, not "
            f"{by!r:.60}"
        )
    return by


def _schema_of(name: str, schema: Schema | None) -> Schema | None:
    """Return the schema that a channel is written with; None if its rows decide."""
    last = name.rpartition("/")[2]
    usual = _HOLDS.get(last)
    if schema is None:
        return usual
    if not isinstance(schema, Schema) or not (schema.is_own or SCHEMAS.get(schema.name) is schema):
        raise McaptrackError(
            "`schema=` is a schema of mcaptrack.schema, such as PREDICTIONS, or one that `mcaptrack.schema_of` makes, "
            f"not {schema!r:.60}"
        )
    if usual not in (None, schema):
        raise McaptrackError(f"a channel named {last} holds {usual.name}; write {schema.name} to another one")
    return schema


def _topic(opened: logs.Log, topic: str) -> str:
    """Return the topic of a channel to write: as it is given, or below the only camera."""
    if not isinstance(topic, str):
        raise McaptrackError(f"a topic is text such as detections or /camera/detections, not {topic!r:.40}")
    name = topic if "/" in topic else f"{pipeline.find_camera(opened, None, None)}/{topic}"
    if not topic or not name.startswith("/") or not all(name[1:].split("/")) or not name.isprintable():
        raise McaptrackError(f"{topic!r:.80} is no topic; give one such as detections or /camera/detections")
    if len(name.encode()) > _LONGEST:
        raise McaptrackError(f"{topic:.80}... is longer than {_LONGEST} bytes; give the channel a shorter topic")
    if _is_reserved(opened, name):
        raise McaptrackError(f"{name} is a name of what stages make or of pictures; write to another, such as {_SUCH}")
    return name


def _is_reserved(opened: logs.Log, name: str) -> bool:
    """Return whether a topic is that of pictures, of results of stages, or of what stands beside a channel."""
    above, _, last = name.rpartition("/")
    is_above_usual = above in opened.channels or above.endswith(tuple(f"/{end}" for end in USUAL))
    is_beside = last == "view" or "/view/" in name or (last in _BESIDE and is_above_usual)
    return is_beside or name.endswith(tuple(f"/{end}" for end in USUAL if end not in _HOLDS))


def _refuse_other_columns(opened: logs.Log, name: str, schema: Schema) -> None:
    """Raise McaptrackError if another channel has other columns of a user's own schema: its name stands for one set."""
    if not schema.is_own:
        return
    columns = columns_in_metadata(schema)
    for channel in opened.channels.values():
        is_other = channel.topic != name and channel.schema_name == schema.name
        if is_other and (channel.schema is None or columns_in_metadata(channel.schema) != columns):
            raise McaptrackError(
                f"{opened.path}: {channel.topic} has other columns of {schema.name}; give this schema another name, as "
                "in `schema=mcaptrack.schema_of(name, columns)`"
            )


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
