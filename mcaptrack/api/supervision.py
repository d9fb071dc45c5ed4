"""``supervision.Detections`` as frames of rows, and back; the package need not be installed to write them.

Letters: N objects in one frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

import numpy as np

from mcaptrack.api.class_names import checked_names
from mcaptrack.api.columns import UNNUMBERED, boxes_of, frame_of
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.classes import PERSON, UNKNOWN, class_name, is_person

_SUPERVISION: Final = ("confidence", "class_id", "tracker_id", "mask", "data")
#: The key of names of classes in ``data``.
_NAMES: Final = "class_name"
#: What is added to the classes of a detector that names them, so that none of them is 0 (unknown) or 1 (person).
_OTHERS: Final = 2


def is_supervision(given: Any) -> bool:
    """Whether an object is a ``supervision.Detections``, by its attributes: the package need not be installed.

    Raises McaptrackError for boxes of another package that look alike.
    """
    if not hasattr(given, "xyxy"):
        return False
    lacks = [name for name in _SUPERVISION if not hasattr(given, name)]
    if lacks:
        kind = f"{type(given).__module__}.{type(given).__qualname__}"
        raise McaptrackError(f"{kind} has no {lacks[0]}, unlike supervision.Detections; give its boxes as an array")
    return True


def frame_of_supervision(
    found: Any, t_ns: int | np.datetime64, index: int = UNNUMBERED, schema: Schema | None = None
) -> Frame:
    """Return ``supervision.Detections`` as a frame: of tracks where they have tracker ids, otherwise of detections.

    Trackers give -1 to boxes of tracks that are not confirmed yet: a frame of tracks leaves these out. A frame without
    boxes needs no tracker ids.
    """
    boxes = boxes_of(found.xyxy, "xyxy")
    ids = None if found.tracker_id is None else np.asarray(found.tracker_id, np.int64)
    schema = schema or (DETECTIONS if ids is None else TRACKS)
    if found.mask is not None and len(boxes):
        warn("rows hold boxes: masks of supervision.Detections are left out", "left-out")
    if schema is DETECTIONS:
        columns = {"score": found.confidence, "class_id": _classes_of(found)}
        return frame_of(DETECTIONS, boxes, columns, t_ns, index)
    if ids is None and len(boxes):
        raise McaptrackError(f"the detections at {t_ns} ns have no tracker ids; tracks need them")
    ids = np.empty(0, np.int64) if ids is None else ids
    columns = {"score": found.confidence, "track_id": ids, "class_id": _classes_of(found)}
    frame = frame_of(TRACKS, boxes, columns, t_ns, index)
    if (ids < 0).any():
        warn("boxes without a tracker id (-1: the track is not confirmed yet) are left out", "left-out")
    return frame._replace(rows=frame.rows[ids >= 0])


def _classes_of(found: Any) -> Any:
    """Return class ids (N,) as the schema of detections has them: 0 unknown, 1 a person.

    Detectors count from 0 or from 1, and person may be any number, so names decide where there are some.
    """
    count, names = len(found.xyxy), found.data.get(_NAMES)
    ids = np.zeros(count, np.uint32) if found.class_id is None else np.asarray(found.class_id)
    if names is None or not count:
        return ids
    raised = f"other numbers are {_OTHERS} higher than the detector's"
    out = _ids_of(found)
    if (out != ids).any() and (out != PERSON).any():
        warn(f"supervision.Detections name their classes: in class_id 1 is a person, {raised}", "classes")
    return out


def _ids_of(found: Any) -> Any:
    """Class ids (N,) of detections that name their classes: 1 is a person, others are raised by ``_OTHERS``.

    0 stays what it is if its name says that it is unknown, as in what ``supervision_of`` gives.
    """
    names = np.array([str(name).lower() for name in found.data[_NAMES]])
    are_people = np.array([is_person(name) for name in names], bool)
    if found.class_id is None:
        return np.where(are_people, PERSON, 0)
    ids = np.asarray(found.class_id)
    is_unknown = (ids == UNKNOWN) & (names == class_name(UNKNOWN, {}))
    return np.where(are_people, PERSON, np.where(is_unknown, UNKNOWN, ids + _OTHERS))


def names_of_supervision(found: Any) -> dict[int, str]:
    """Return the names of the classes by the ids that ``frame_of_supervision`` gives them."""
    names = found.data.get(_NAMES)
    if names is None or not len(found.xyxy):
        return {}
    out = dict(zip(np.asarray(_ids_of(found)).tolist(), (str(name) for name in names), strict=True))
    return checked_names({number: name for number, name in out.items() if number != UNKNOWN})


def supervision_of(frames: Iterable[Frame], names: Mapping[int, str]) -> Iterator[tuple[int, Any]]:
    """Yield the time in nanoseconds and the ``supervision.Detections`` of each frame of detections or tracks.

    ``names`` are the names of classes by number, for ``data["class_name"]``, if there are others than people. Rows
    without a box are left out. Raises McaptrackError if supervision is not installed.
    """
    try:
        from supervision import Detections
    except ImportError:
        raise McaptrackError("supervision is not installed; install it with: pip install supervision") from None
    for frame in frames:
        rows = frame.rows[np.isfinite(frame.rows["x_px"])]
        if len(rows) < len(frame.rows):
            warn("supervision.Detections hold boxes in pixels: rows without one are left out", "left-out")
        # With NaN for missing scores: supervision merges frames only if all have a confidence, or none.
        columns: dict[str, Any] = {"confidence": rows["score"].astype(np.float32)}
        for name, column in (("tracker_id", "track_id"), ("class_id", "class_id")):
            if column in (rows.dtype.names or ()):
                columns[name] = rows[column].astype(int)
        left, top = rows["x_px"], rows["y_px"]
        xyxy = np.stack([left, top, left + rows["w_px"], top + rows["h_px"]], axis=-1).astype(np.float32)
        if set(names) - {PERSON}:
            called = [class_name(number, names) for number in rows["class_id"].tolist()]
            columns["data"] = {_NAMES: np.array(called, np.str_)}
        yield frame.t_ns, Detections(xyxy=xyxy, **columns)
