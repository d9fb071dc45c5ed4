"""Frames as ROS messages: detections and tracks as arrays of vision_msgs, drawings as markers, forecasts as paths.

Letters: N rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from math import cos, sin
from typing import Any, Final

import numpy as np

from mcaptrack import foxglove
from mcaptrack.foxglove.views.people import bodies_of
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import Frame, Rows
from mcaptrack.schema.classes import class_name

_CUBE, _CYLINDER, _LINE_STRIP, _TEXT = 1, 3, 4, 9  # Marker.type
_ADD, _DELETE_ALL = 0, 3  # Marker.action
#: Width and height of the cylinder of a person without a 3D box.
_WIDE_M, _HIGH_M = 0.4, 1.7
_TEXT_M: Final = 0.5
_LINE_M: Final = 0.1
#: Markers have ids of 32 bits.
_MARKERS: Final = 2**31


# The ROS messages of bags: those that rosbags knows, and those of vision_msgs 4 (ROS 2 Humble and since).


_VISION: Final = {
    "Point2D": "float64 x\nfloat64 y",
    "Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "Detection2D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox2D bbox\n"
        "string id"
    ),
    "Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\n"
        "string id"
    ),
    "Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections",
    "Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}


@cache
def typestore() -> Any:
    """The types of ROS 2 Humble with vision_msgs."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _VISION.items():
        store.register(get_types_from_msg(text, f"vision_msgs/msg/{name}"))
    return store


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
