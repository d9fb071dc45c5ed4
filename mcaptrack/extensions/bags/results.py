"""A log as a ROS 2 bag, for RViz and ``ros2 bag``: a folder with metadata.yaml and a file of messages.

<topic>            vision_msgs/Detection3DArray of rows in metres, Detection2DArray of rows in pixels
<topic>/markers    visualization_msgs/MarkerArray of tracks and forecasts in metres
<topic>            nav_msgs/Path for each forecast
/tf, /tf_static    tf2_msgs/TFMessage, the transforms of the log
"""

from __future__ import annotations

import heapq
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from itertools import product
from math import cos, sin
from pathlib import Path
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np

from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.bags.files import METADATA
from mcaptrack.foxglove.views import ground
from mcaptrack.foxglove.views.people import base_heights, bodies_of
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import Progress, warn
from mcaptrack.schema import DETECTIONS, PREDICTIONS, TRACKS, Frame, Rows, Schema
from mcaptrack.schema.classes import class_name, class_names
from mcaptrack.schema.encodings import CDR, encoded, ros_definition, ros_name
from mcaptrack.schema.provenance import frame_id_of, input_of
from mcaptrack.sources.cameras import cameras
from mcaptrack.sources.fixed_frame import namespaces_of, transforms_of
from mcaptrack.sources.foreign.definitions import typestore_of

#: The version of the format of metadata.yaml: readers accept earlier ones, not later ones.
_VERSION: Final = 8
#: ROS stamps have seconds of 32 bits.
_LAST_S: Final = 2**31


class _Stream(NamedTuple):
    """The messages of a topic of the bag, sorted by time in ns; as bytes if their ``definition`` is not one of ROS."""

    topic: str
    kind: str
    messages: Iterator[tuple[int, Any]]
    is_latched: bool = False
    definition: str = ""


class Rosbag2:
    """A ROS 2 bag in MCAP, as an exporter."""

    end, is_folder, marker = ".rosbag2", True, METADATA
    storage: ClassVar[str] = "MCAP"

    def write(self, recording: Any, path: Path, progress: Progress = lambda *_: None) -> dict[str, int]:
        """Write detections, tracks and forecasts of a log as a folder; returns the number of messages of each topic.

        Raises McaptrackError if the log has none, if the folder can't be written, and if a time is later than ROS can
        express.
        """
        with log.read(recording.path) as opened:
            job = _Job(opened)
            streams = [stream for topic, schema in job.channels() for stream in job.streams(topic, schema)]
            if not streams:
                raise McaptrackError(f"{opened.path} has no detections, tracks or predictions to write as ROS messages")
            streams += job.transforms()
            try:
                return _write(path, streams, self.storage, lambda count: progress("export", count, job.total))
            except sqlite3.Error as error:
                raise McaptrackError(f"{path.name} can't be written: {error}") from error


class Rosbag2Sqlite3(Rosbag2):
    """A ROS 2 bag in a database, as an exporter."""

    storage = "SQLITE3"


# Frames as ROS messages: detections and tracks as arrays of vision_msgs, drawings as markers, forecasts as paths.
#
# Letters: N rows.


_CUBE, _CYLINDER, _LINE_STRIP, _TEXT = 1, 3, 4, 9  # Marker.type
_ADD, _DELETE_ALL = 0, 3  # Marker.action
#: Width and height of the cylinder of a person without a 3D box.
_WIDE_M, _HIGH_M = 0.4, 1.7
_TEXT_M: Final = 0.5
_LINE_M: Final = 0.1
#: Markers have ids of 32 bits.
_MARKERS: Final = 2**31


# The ROS messages of bags: those of ROS 2 Humble.


@cache
def typestore() -> Any:
    """The types of ROS 2 Humble with vision_msgs."""
    return typestore_of("ros2_humble")


def message(name: str, *values: Any) -> Any:
    """A message, such as "geometry_msgs/Point", with the values of its fields in order."""
    return _class(name)(*values)


@cache
def _class(name: str) -> Any:
    return typestore().types[name.replace("/", "/msg/")]


def header(t_ns: int, frame_id: str) -> Any:
    """A std_msgs/Header."""
    seconds, nanos = divmod(t_ns, NS_PER_S)
    return message("std_msgs/Header", message("builtin_interfaces/Time", seconds, nanos), frame_id)


def pose(x: float, y: float, z: float, turn: float = 0.0) -> Any:
    """A geometry_msgs/Pose with a turn about the vertical in radians."""
    rotation = message("geometry_msgs/Quaternion", 0.0, 0.0, sin(turn / 2), cos(turn / 2))
    return message("geometry_msgs/Pose", message("geometry_msgs/Point", x, y, z), rotation)


_NO_COVARIANCE: Final = np.zeros(36)


def boxes_2d(frame: Frame, frame_id: str, names: Mapping[int, str]) -> Any:
    """A vision_msgs/Detection2DArray of the rows with a box in pixels."""
    rows = frame.rows[has_pixels(frame.rows)]
    head = header(frame.t_ns, frame_id)
    boxes = []
    for row, guess in zip(rows, _guesses(rows, names, [pose(0.0, 0.0, 0.0)] * len(rows)), strict=True):
        x, y, w, h = (float(row[name]) for name in ("x_px", "y_px", "w_px", "h_px"))
        centre = message("vision_msgs/Pose2D", message("vision_msgs/Point2D", x + w / 2, y + h / 2), 0.0)
        box = message("vision_msgs/BoundingBox2D", centre, w, h)
        boxes.append(message("vision_msgs/Detection2D", head, [guess], box, _id_of(row)))
    return message("vision_msgs/Detection2DArray", head, boxes)


def boxes_3d(frame: Frame, frame_id: str, names: Mapping[int, str]) -> Any:
    """A vision_msgs/Detection3DArray of the rows with a position in metres; sizes that are not known are 0."""
    rows = frame.rows[has_place(frame.rows)]
    head = header(frame.t_ns, frame_id)
    centre, size, heading = _bodies(rows)
    places = [pose(x, y, z, turn) for (x, y, z), turn in zip(centre.tolist(), heading.tolist(), strict=True)]
    boxes = []
    for row, extent, at, guess in zip(rows, size.tolist(), places, _guesses(rows, names, places), strict=True):
        box = message("vision_msgs/BoundingBox3D", at, message("geometry_msgs/Vector3", *extent))
        boxes.append(message("vision_msgs/Detection3D", head, [guess], box, _id_of(row)))
    return message("vision_msgs/Detection3DArray", head, boxes)


def has_pixels(rows: Rows) -> Any:
    """Which rows (N,) have a box in pixels."""
    return np.isfinite(np.stack([rows[name] for name in ("x_px", "y_px", "w_px", "h_px")])).all(axis=0)


def has_place(rows: Rows) -> Any:
    """Which rows (N,) have a position in metres."""
    return np.isfinite(rows["x_m"]) & np.isfinite(rows["y_m"])


def _bodies(rows: Rows) -> tuple[Floats, Floats, Floats]:
    """Centres (N, 3), sizes (N, 3) and headings (N,) with 0 for what is not known."""
    boxes = bodies_of(rows)
    return np.nan_to_num(boxes.centre_m), np.nan_to_num(boxes.size_m), boxes.heading_rad


def _id_of(row: Any) -> str:
    """The id of a track; that of the detector for a detection, "" if it gave none."""
    names = row.dtype.names
    number = int(row["track_id"] if "track_id" in names else row["source_id"])
    return "" if number == -1 and "track_id" not in names else str(number)


def _guesses(rows: Rows, names: Mapping[int, str], places: list[Any]) -> Iterator[Any]:
    for number, score, at in zip(rows["class_id"].tolist(), rows["score"].tolist(), places, strict=True):
        said = class_name(number, names) if number in names else str(number)
        hypothesis = message("vision_msgs/ObjectHypothesis", said, score)
        where = message("geometry_msgs/PoseWithCovariance", at, _NO_COVARIANCE)
        yield message("vision_msgs/ObjectHypothesisWithPose", hypothesis, where)


# Markers


def _marker(head: Any, space: str, number: int, kind: int, **fields: Any) -> Any:
    """A visualization_msgs/Marker; fields that are not given have their default."""
    first = {"header": head, "ns": space, "id": number, "type": kind}
    return message("visualization_msgs/Marker", *(first | _marker_defaults() | fields).values())


@cache
def _marker_defaults() -> dict[str, Any]:
    """The other fields of a marker, in order."""
    nothing = np.empty(0, np.uint8)
    return {
        "action": _ADD,
        "pose": pose(0.0, 0.0, 0.0),
        "scale": _extent(0.0, 0.0, 0.0),
        "color": _painted((0.0, 0.0, 0.0), 0.0),
        "lifetime": message("builtin_interfaces/Duration", 0, 0),
        "frame_locked": False,
        "points": [],
        "colors": [],
        "texture_resource": "",
        "texture": message("sensor_msgs/CompressedImage", header(0, ""), "", nothing),
        "uv_coordinates": [],
        "text": "",
        "mesh_resource": "",
        "mesh_file": message("visualization_msgs/MeshFile", "", nothing),
        "mesh_use_embedded_materials": False,
    }


def _drawn(head: Any, markers: list[Any]) -> Any:
    """A visualization_msgs/MarkerArray that replaces all markers of its topic."""
    return message("visualization_msgs/MarkerArray", [_marker(head, "", 0, 0, action=_DELETE_ALL), *markers])


def _painted(rgb: tuple[float, float, float], alpha: float) -> Any:
    return message("std_msgs/ColorRGBA", *map(float, rgb), alpha)


def _extent(x: float, y: float, z: float) -> Any:
    return message("geometry_msgs/Vector3", x, y, z)


def track_markers(frame: Frame, frame_id: str, names: Mapping[int, str]) -> Any:
    """Cubes in the colours of classes, or cylinders for people on the ground plane, with ids above."""
    rows = frame.rows[has_place(frame.rows)]
    head = header(frame.t_ns, frame_id)
    boxes = bodies_of(rows)
    is_solid = np.isfinite(np.column_stack([boxes.centre_m, boxes.size_m])).all(axis=1)
    columns = (rows["track_id"], rows["class_id"], is_solid, boxes.centre_m, boxes.size_m, boxes.heading_rad)
    markers = []
    for track_id, class_id, solid, at, size, turn in zip(*(column.tolist() for column in columns), strict=True):
        x, y = at[:2]
        if solid:
            kind, rgb, up, extent = _CUBE, foxglove.class_colour(class_id, names.get(class_id, "")), at[2], size
        else:
            kind, rgb, up, extent = _CYLINDER, foxglove.colour(track_id)[:3], _HIGH_M / 2, (_WIDE_M, _WIDE_M, _HIGH_M)
        number, above = track_id % _MARKERS, pose(x, y, up + extent[2] / 2 + _TEXT_M)
        box = {"pose": pose(x, y, up, turn), "scale": _extent(*extent), "color": _painted(rgb, 0.75)}
        text = {"pose": above, "scale": _extent(0.0, 0.0, _TEXT_M), "text": str(track_id)}
        markers.append(_marker(head, "boxes", number, kind, **box))
        markers.append(_marker(head, "ids", number, _TEXT, color=_painted((1.0, 1.0, 1.0), 1.0), **text))
    return _drawn(head, markers)


# Forecasts


def paths(frame: Frame, frame_id: str, base_m: Mapping[int, float]) -> list[Any]:
    """A nav_msgs/Path for each track, in the order of ids; each pose has the time at which it is expected.

    ``base_m`` are the heights of tracks by id.
    """
    head = header(frame.t_ns, frame_id)
    out = []
    for track_id, steps in _by_track(frame.rows):
        poses = [
            message(
                "geometry_msgs/PoseStamped",
                header(frame.t_ns + round(ahead * NS_PER_S), frame_id),
                pose(x, y, base_m.get(track_id, 0.0)),
            )
            for ahead, x, y in zip(steps["ahead_s"].tolist(), steps["x_m"].tolist(), steps["y_m"].tolist(), strict=True)
        ]
        out.append(message("nav_msgs/Path", head, poses))
    return out


def forecast_markers(frame: Frame, frame_id: str, base_m: Mapping[int, float]) -> Any:
    """The forecasts as lines with the ids of their tracks."""
    head = header(frame.t_ns, frame_id)
    markers = []
    for track_id, steps in _by_track(frame.rows):
        up = base_m.get(track_id, 0.0)
        points = [
            message("geometry_msgs/Point", x, y, up)
            for x, y in zip(steps["x_m"].tolist(), steps["y_m"].tolist(), strict=True)
        ]
        look = {"scale": _extent(_LINE_M, 0.0, 0.0), "color": _painted(foxglove.colour(track_id)[:3], 1.0)}
        markers.append(_marker(head, "forecasts", track_id % _MARKERS, _LINE_STRIP, points=points, **look))
    return _drawn(head, markers)


def _by_track(rows: Rows) -> Iterator[tuple[int, Rows]]:
    """The steps of each forecast, in order, by rising id."""
    order = np.lexsort((rows["step"], rows["track_id"]))
    rows = rows[order]
    ids = np.unique(rows["track_id"])
    begins = np.searchsorted(rows["track_id"], ids)
    ends = np.searchsorted(rows["track_id"], ids, "right")
    for number, begin, end in zip(ids.tolist(), begins, ends, strict=True):
        yield number, rows[begin:end]


def _write(folder: Path, streams: Sequence[_Stream], storage: str, progress: Callable[[int], None]) -> dict[str, int]:
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import get_types_from_msg

    forever = QosTime(2**31 - 1, 2**32 - 1)
    latched = Qos(
        QosHistory.KEEP_LAST, 100, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, forever, forever,
        QosLiveliness.AUTOMATIC, forever, False,
    )  # fmt: skip
    store = typestore()
    counts: dict[str, int] = {}
    with Writer(folder, version=_VERSION, storage_plugin=StoragePlugin[storage]) as writer:
        pending = []
        for stream in streams:
            if stream.definition:
                store.register(get_types_from_msg(stream.definition, stream.kind))
            profiles = [latched] if stream.is_latched else []
            connection = writer.add_connection(
                stream.topic, stream.kind, typestore=store, offered_qos_profiles=profiles
            )
            counts[stream.topic] = 0
            pending.append(_with(stream, connection))
        merged = heapq.merge(*pending, key=lambda item: item[0])
        for count, (t_ns, stream, connection, content) in enumerate(merged, start=1):
            payload = content if stream.definition else store.serialize_cdr(content, stream.kind)
            writer.write(connection, t_ns, payload)
            counts[stream.topic] += 1
            progress(count)
    return counts


def _with(stream: _Stream, connection: Any) -> Iterator[tuple[int, _Stream, Any, Any]]:
    return ((t_ns, stream, connection, content) for t_ns, content in stream.messages)


class _Job:
    """The streams of a log for a bag: ``total`` counts their messages so far."""

    def __init__(self, opened: log.Log) -> None:
        self._opened = opened
        self._prefixes = {topic: camera.prefix for camera in cameras(opened) for topic in camera.topics}
        self.total = 0

    def channels(self) -> list[tuple[str, Schema]]:
        """The channels with rows to write: detections, tracks, forecasts, and rows of a user's own."""
        return [
            (topic, channel.schema)
            for topic, channel in sorted(self._opened.channels.items())
            if channel.schema is not None
            and (channel.schema.is_own or channel.schema in (DETECTIONS, TRACKS, PREDICTIONS))
        ]

    def streams(self, topic: str, schema: Schema) -> list[_Stream]:
        """The topics of the bag for a channel."""
        frames = [self._checked(topic, frame) for frame in self._opened.frames(topic, schema)]
        if schema.is_own:
            self.total += len(frames)
            messages = ((t_ns, payload) for t_ns, _, payload in encoded(schema, frames, CDR))
            return [_Stream(topic, ros_name(schema.name), messages, definition=ros_definition(schema.definition))]
        metadata = self._opened.channel(topic).metadata
        names, prefix = class_names(metadata), self._prefixes.get(topic, "")
        in_metres = frame_id_of(metadata) or ground.frame_of(prefix)
        out = []
        if schema is PREDICTIONS:
            bases = self._bases(topic, frames)
            out = [
                _Stream(topic, "nav_msgs/msg/Path", _paths(frames, in_metres, bases)),
                _Stream(
                    f"{topic}/markers",
                    "visualization_msgs/msg/MarkerArray",
                    ((f.t_ns, forecast_markers(f, in_metres, b)) for f, b in zip(frames, bases, strict=True)),
                ),
            ]
            self.total += len(frames) + sum(len(np.unique(frame.rows["track_id"])) for frame in frames)
            return out
        rows = schema.joined([frame.rows for frame in frames])
        pixels, places = has_pixels(rows), has_place(rows)
        is_flat = bool(pixels.any()) and not np.isfinite(rows["z_m"]).any()
        lost = int((~pixels if is_flat else ~places).sum())
        if lost:
            lacking = "box in pixels" if is_flat else "position in metres"
            warn(f"{topic}: {lost:,} rows without a {lacking} are not in the bag", "left-out")
        if is_flat:
            flat = prefix.strip("/")
            boxes = ((frame.t_ns, boxes_2d(frame, flat, names)) for frame in frames)
            out.append(_Stream(topic, "vision_msgs/msg/Detection2DArray", boxes))
        else:
            boxes = ((frame.t_ns, boxes_3d(frame, in_metres, names)) for frame in frames)
            out.append(_Stream(topic, "vision_msgs/msg/Detection3DArray", boxes))
        if schema is TRACKS and places.any():
            drawn = ((frame.t_ns, track_markers(frame, in_metres, names)) for frame in frames)
            out.append(_Stream(f"{topic}/markers", "visualization_msgs/msg/MarkerArray", drawn))
        self.total += len(out) * len(frames)
        return out

    def _checked(self, topic: str, frame: Frame) -> Frame:
        """A frame with a time that ROS can express. Raises McaptrackError otherwise."""
        if not 0 <= frame.t_ns < _LAST_S * NS_PER_S:
            raise McaptrackError(
                f"{self._opened.path}: {topic} at {frame.t_ns} ns: ROS has times from 1970 to 2038 only"
            )
        return frame

    def _bases(self, topic: str, frames: Sequence[Frame]) -> list[Mapping[int, float]]:
        """The heights of the tracks of forecasts, by id, for each frame; empty if they have no 3D boxes."""
        beside = topic.removesuffix("/predictions")
        for name in (f"{beside}/online", beside, input_of(self._opened.channel(topic).metadata)):
            if not self._opened.holds(name, TRACKS):
                continue
            tracks = self._opened.frames(name, TRACKS)
            out: list[Mapping[int, float]] = []
            for frame in frames:
                ids = np.unique(frame.rows["track_id"]).astype(np.int64)
                heights = base_heights(tracks, np.full(len(ids), frame.t_ns), ids)
                out.append({id_: up for id_, up in zip(ids.tolist(), heights.tolist(), strict=True) if np.isfinite(up)})
            return out
        return [{} for _ in frames]

    def transforms(self) -> list[_Stream]:
        """The transforms of the log: those that hold for ever, and those that move."""
        out = []
        for namespace, is_static in product(namespaces_of(self._opened), (True, False)):
            tree = transforms_of(self._opened, namespace)
            topic = f"{namespace or '/'}{'tf_static' if is_static else 'tf'}"
            wanted = [series for series in (tree.series.values() if tree else ()) if series.is_static == is_static]
            poses = sorted(
                (int(t_ns), number, at)
                for number, series in enumerate(wanted)
                for at, t_ns in enumerate(series.t_ns.tolist())
                if 0 <= t_ns < _LAST_S * NS_PER_S
            )
            if poses:
                self.total += len(poses)
                out.append(_Stream(topic, "tf2_msgs/msg/TFMessage", _transforms(wanted, poses), is_static))
        return out


def _paths(frames: Sequence[Frame], frame_id: str, bases: Sequence[Mapping[int, float]]) -> Iterator[tuple[int, Any]]:
    for frame, base_m in zip(frames, bases, strict=True):
        yield from ((frame.t_ns, path) for path in paths(frame, frame_id, base_m))


def _transforms(series: Sequence[Any], poses: Sequence[tuple[int, int, int]]) -> Iterator[tuple[int, Any]]:
    """The messages of poses: the time of each, the number of its series, and its number there."""
    yield from ((t_ns, _transform(series[number], at)) for t_ns, number, at in poses)


def _transform(series: Any, at: int) -> Any:
    place = message("geometry_msgs/Vector3", *series.translation[at].tolist())
    moved = message(
        "geometry_msgs/Transform", place, message("geometry_msgs/Quaternion", *series.quaternion[at].tolist())
    )
    head = header(int(series.t_ns[at]), series.parent)
    return message("tf2_msgs/TFMessage", [message("geometry_msgs/TransformStamped", head, series.child, moved)])
