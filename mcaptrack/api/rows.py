"""Rows from elsewhere as frames: NumPy arrays, structured arrays, Arrow tables, ``supervision.Detections``.

Letters: N objects in one frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Rows, Schema
from mcaptrack.sources.foreign.boxes import PEOPLE, PERSON

BoxFormat = Literal["xyxy", "xywh"]
#: The frame number of a frame that was not numbered; ``Recording.write`` gives it one.
UNNUMBERED: Final = -1
_SUPERVISION: Final = ("confidence", "class_id", "tracker_id", "mask", "data")
#: What is added to the classes of a detector that names them, so that none of them is 0 (unknown) or 1 (person).
_OTHERS: Final = 2
#: Columns of tables and arrays that are not part of rows.
_BESIDE: Final = ("t", "t_ns", "frame", "index", "row", "topic", "recording", "class")


def detections(
    boxes: Any,
    scores: ArrayLike | None = None,
    classes: ArrayLike | None = None,
    t_ns: int = 0,
    *,
    box_format: BoxFormat | None = None,
    index: int = UNNUMBERED,
) -> Frame:
    """Make a frame of detections, to be tracked or to be written into a log.

    Parameters
    ----------
    boxes : array_like, shape (N, 4), or supervision.Detections
        Boxes in pixels; (0, 4) for a picture without detections. Of ``supervision.Detections``, boxes, confidence and
        classes are taken; where ``data["class_name"]`` names the classes, persons become class 1, and the numbers of
        other classes are raised by 2.
    scores : array_like, shape (N,), optional
        Confidence of each box, from 0 to 1.
    classes : array_like, shape (N,), optional
        Class of each box: 0 unknown, 1 person, other numbers as the detector counts.
    t_ns : int
        Time of the picture in nanoseconds.
    box_format : {"xyxy", "xywh"}
        What the columns of ``boxes`` are: corners (left, top, right, bottom), or left, top, width and height. Not
        needed for ``supervision.Detections``.
    index : int, optional
        Number of the picture in the video; by default frames are numbered when they are written.

    Returns
    -------
    mcaptrack.schema.Frame
        The frame: ``t_ns``, ``index`` and ``rows``.

    Raises
    ------
    McaptrackError
        If shapes do not fit, numbers are missing, or ``box_format`` is not given.

    Examples
    --------
    >>> import mcaptrack
    >>> frame = mcaptrack.detections([[10, 20, 30, 60]], [0.9], [1], t_ns=0, box_format="xyxy")
    >>> frame.rows["w_px"].tolist(), frame.rows["h_px"].tolist()
    ([20.0], [40.0])
    """
    if is_supervision(boxes):
        if scores is not None or classes is not None or box_format not in (None, "xyxy"):
            raise McaptrackError("supervision.Detections bring scores, classes and the format of their boxes along")
        return frame_of_supervision(boxes, t_ns, index, DETECTIONS)
    if box_format not in ("xyxy", "xywh"):
        raise McaptrackError("say what the columns of boxes are with `box_format='xyxy'` or `box_format='xywh'`")
    xywh = _boxes(boxes, box_format)
    columns: dict[str, Any] = dict(zip(("x_px", "y_px", "w_px", "h_px"), xywh.T, strict=True))
    columns["class_id"] = np.zeros(len(xywh), np.uint32) if classes is None else np.asarray(classes)
    if scores is not None:
        columns["score"] = np.asarray(scores, np.float64)
    return Frame(int(t_ns), index, _rows(DETECTIONS, columns, t_ns))


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


def frame_of_supervision(found: Any, t_ns: int, index: int = UNNUMBERED, schema: Schema | None = None) -> Frame:
    """Return ``supervision.Detections`` as a frame: of tracks where they have tracker ids, otherwise of detections.

    Trackers give -1 to boxes of tracks that are not confirmed yet: a frame of tracks leaves these out. A frame without
    boxes needs no tracker ids.
    """
    xywh = _boxes(found.xyxy, "xyxy")
    ids = None if found.tracker_id is None else np.asarray(found.tracker_id, np.int64)
    schema = schema or (DETECTIONS if ids is None else TRACKS)
    columns: dict[str, Any] = dict(zip(("x_px", "y_px", "w_px", "h_px"), xywh.T, strict=True))
    if found.confidence is not None:
        columns["score"] = np.asarray(found.confidence, np.float64)
    if found.mask is not None and len(xywh):
        warn("rows hold boxes: masks of supervision.Detections are left out", "left-out")
    if schema is DETECTIONS:
        columns["class_id"] = _classes_of(found)
        return Frame(int(t_ns), index, _rows(DETECTIONS, columns, t_ns))
    if ids is None and len(xywh):
        raise McaptrackError(f"the detections at {t_ns} ns have no tracker ids; tracks need them")
    columns["track_id"] = np.empty(0, np.int64) if ids is None else ids
    columns |= {"observed": np.ones(len(xywh), bool), "source_id": np.full(len(xywh), -1)}
    rows = _rows(TRACKS, columns, t_ns)
    if (rows["track_id"] < 0).any():
        warn("boxes without a tracker id (-1: the track is not confirmed yet) are left out", "left-out")
    return Frame(int(t_ns), index, rows[rows["track_id"] >= 0])


def _classes_of(found: Any) -> Any:
    """Return class ids (N,) as the schema of detections has them: 0 unknown, 1 a person.

    Detectors count from 0 or from 1, and person may be any number, so names decide where there are some.
    """
    count, names = len(found.xyxy), found.data.get("class_name")
    ids = np.zeros(count, np.uint32) if found.class_id is None else np.asarray(found.class_id)
    if names is None or not count:
        return ids
    is_person = np.array([str(name).lower() in PEOPLE for name in names])
    if not is_person.all() and found.class_id is not None:
        raised = f"other numbers are {_OTHERS} higher than the detector's"
        warn(f"supervision.Detections name their classes: in class_id 1 is a person, {raised}", "classes")
        ids = ids + _OTHERS
    return np.where(is_person, PERSON, ids)


def frames_of(rows: Any, schema: Schema | None) -> tuple[Schema, list[Frame]]:
    """Return the schema and the frames, by time, of rows in any form that ``Recording.write`` takes.

    Raises McaptrackError for anything else, and for rows that do not fit a schema.
    """
    if hasattr(rows, "column_names"):  # an Arrow table
        names = rows.column_names
        return _of_columns({name: rows.column(name).to_numpy() for name in names}, schema)
    if isinstance(rows, np.ndarray):
        if rows.dtype.names is None:
            raise McaptrackError("an array without named columns is no table; make frames with `mcaptrack.detections`")
        return _of_columns({name: rows[name] for name in rows.dtype.names}, schema)
    if is_supervision(rows):
        raise McaptrackError(
            "supervision.Detections have no time; give them by time in nanoseconds: {t_ns: detections}"
        )
    if not isinstance(rows, Iterable):
        raise McaptrackError(f"rows are frames, an array, a table or supervision.Detections, not {type(rows).__name__}")
    frames = [_frame(one, schema) for one in (rows.items() if hasattr(rows, "items") else rows)]
    if schema is None:
        found = {frame.rows.dtype.names for frame in [frame for frame in frames if len(frame.rows)] or frames}
        fitting = [one for one in (DETECTIONS, TRACKS) if found == {one.dtype.names}]
        if not fitting:
            raise McaptrackError("it is not clear whether these are detections or tracks; all frames have to be of one")
        schema = fitting[0]
        frames = [frame if len(frame.rows) else frame._replace(rows=schema.empty()) for frame in frames]
    for frame in frames:
        _check(schema, frame.rows, frame.t_ns)
    return schema, sorted(frames, key=lambda frame: frame.t_ns)


def _frame(one: Any, schema: Schema | None) -> Frame:
    if isinstance(one, Frame):
        return one
    if isinstance(one, Sequence) and len(one) == 2 and is_supervision(one[1]):
        return frame_of_supervision(one[1], int(one[0]), schema=schema)
    raise McaptrackError(
        f"each frame is a Frame, or a time in nanoseconds with supervision.Detections, not {type(one).__name__}"
    )


def _of_columns(columns: dict[str, Any], schema: Schema | None) -> tuple[Schema, list[Frame]]:
    """Frames of a table: rows of the same ``t_ns`` are a frame."""
    if "t_ns" not in columns:
        raise McaptrackError(f"the table has no column t_ns (times in nanoseconds); it has {', '.join(columns)}")
    schema = schema or (TRACKS if "track_id" in columns else DETECTIONS)
    known = {column.name for column in schema.columns}
    strange = sorted(set(columns) - known - set(_BESIDE))
    if strange:
        raise McaptrackError(f"{schema.name} has no column {', '.join(strange)}; it has {', '.join(sorted(known))}")
    given = {name: values for name, values in columns.items() if name in known}
    count = len(columns["t_ns"])
    if schema is TRACKS:
        given.setdefault("observed", np.ones(count, bool))
        given.setdefault("source_id", np.full(count, -1))
    else:
        given.setdefault("class_id", np.zeros(count, np.uint32))
    whole = {name: _whole(values) if schema.dtype[name].kind in "iu" else values for name, values in given.items()}
    t_ns = _whole(columns["t_ns"])
    rows = _rows(schema, whole, int(t_ns[0]) if count else 0)
    numbers = _whole(columns["frame"]) if "frame" in columns else np.full(count, UNNUMBERED)
    order = np.argsort(t_ns, kind="stable")
    times, first = np.unique(t_ns[order], return_index=True)
    parts = np.split(order, first[1:]) if count else []
    return schema, [Frame(int(t), int(numbers[part[0]]), rows[part]) for t, part in zip(times, parts, strict=True)]


def _whole(values: Any) -> Any:
    """Whole numbers of a column; pandas and NumPy make floats of columns in which some are missing."""
    array = np.asarray(values)
    return array.astype(np.int64) if array.dtype.kind == "f" and (array == np.round(array)).all() else array


def _boxes(boxes: Any, box_format: BoxFormat) -> Floats:
    """Boxes (N, 4) as left, top, width, height."""
    array = np.asarray(boxes, np.float64)
    array = array.reshape(0, 4) if array.size == 0 else array
    if array.ndim != 2 or array.shape[1] != 4:
        raise McaptrackError(f"boxes are an array of shape (N, 4), not {array.shape}")
    xywh: Floats = (
        np.concatenate([array[:, :2], array[:, 2:] - array[:, :2]], axis=1) if box_format == "xyxy" else array
    )
    if (xywh[:, 2:] < 0).any():
        first = int(np.flatnonzero((xywh[:, 2:] < 0).any(axis=1))[0])
        raise McaptrackError(f"box {first} has a negative size: {array[first].tolist()} read as {box_format}")
    return xywh


def _rows(schema: Schema, columns: dict[str, Any], t_ns: int) -> Rows:
    try:
        return schema.rows(**columns)
    except ValueError as error:
        raise McaptrackError(f"rows at {t_ns} ns: {error}") from None


def _check(schema: Schema, rows: Rows, t_ns: int) -> None:
    try:
        schema.check(rows)
    except ValueError as error:
        raise McaptrackError(f"rows at {t_ns} ns: {error}") from None


def supervision_of(frames: Iterable[Frame]) -> Iterator[tuple[int, Any]]:
    """Yield the time in nanoseconds and the ``supervision.Detections`` of each frame of detections or tracks.

    Rows without a box are left out. Raises McaptrackError if supervision is not installed.
    """
    try:
        from supervision import Detections
    except ImportError:
        raise McaptrackError("supervision is not installed; install it with: pip install supervision") from None
    for frame in frames:
        rows = frame.rows[np.isfinite(frame.rows["x_px"])]
        # With NaN for missing scores: supervision merges frames only if all have a confidence, or none.
        columns: dict[str, Any] = {"confidence": rows["score"].astype(np.float32)}
        for name, column in (("tracker_id", "track_id"), ("class_id", "class_id")):
            if column in (rows.dtype.names or ()):
                columns[name] = rows[column].astype(int)
        left, top = rows["x_px"], rows["y_px"]
        xyxy = np.stack([left, top, left + rows["w_px"], top + rows["h_px"]], axis=-1).astype(np.float32)
        yield frame.t_ns, Detections(xyxy=xyxy, **columns)
