"""Rows from elsewhere as frames: NumPy arrays, structured arrays, tables, ``supervision.Detections``.

Letters: N objects in one frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mcaptrack import tables
from mcaptrack.api.declared import checked
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.classes import PERSON, UNKNOWN, class_name, is_person
from mcaptrack.sources.own_rows import (
    OURS,
    UNNUMBERED,
    BoxFormat,
    boxes_of,
    check_frames,
    checked_names,
    columns_in_space,
    columns_of_dtype,
    columns_of_objects,
    columns_of_type,
    derived,
    frame_of,
    frames_of_columns,
    is_dataclass,
    kind_of,
    number_of,
    numbered_columns,
    numbers_of,
    schema_of_columns,
    time_of,
)

if TYPE_CHECKING:
    from supervision import Detections

# ``supervision.Detections`` as frames of rows, and back; the package need not be installed to write them.
#
# Letters: N objects in one frame.


_SUPERVISION: Final = ("confidence", "class_id", "tracker_id", "mask", "data")
#: The key of names of classes in ``data``.
_NAMES: Final = "class_name"
#: What is added to the classes of a detector that names them, so that none of them is 0 (unknown) or 1 (person).
_OTHERS: Final = 2


def is_supervision(rows: Any) -> bool:
    """Whether an object is a ``supervision.Detections``, by its attributes: the package need not be installed.

    Raises McaptrackError for boxes of another package that look alike.
    """
    if not hasattr(rows, "xyxy"):
        return False
    lacks = [name for name in _SUPERVISION if not hasattr(rows, name)]
    if lacks:
        kind = f"{type(rows).__module__}.{type(rows).__qualname__}"
        raise McaptrackError(f"{kind} has no {lacks[0]}, unlike supervision.Detections; give its boxes as an array")
    return True


def frame_of_supervision(
    detections_: Any, t_ns: int | np.datetime64, index: int = UNNUMBERED, schema: Schema | None = None
) -> Frame:
    """Return ``supervision.Detections`` as a frame: of tracks where they have tracker ids, otherwise of detections.

    Trackers give -1 to boxes of tracks that are not confirmed yet: a frame of tracks leaves these out. A frame without
    boxes needs no tracker ids.
    """
    boxes = boxes_of(detections_.xyxy, "xyxy")
    ids = None if detections_.tracker_id is None else np.asarray(detections_.tracker_id, np.int64)
    schema = schema or (DETECTIONS if ids is None else TRACKS)
    if detections_.mask is not None and len(boxes):
        warn("rows hold boxes: masks of supervision.Detections are left out", "left-out")
    if schema is DETECTIONS:
        columns = {"score": detections_.confidence, "class_id": _classes_of(detections_)}
        return frame_of(DETECTIONS, boxes, columns, t_ns, index)
    if ids is None and len(boxes):
        raise McaptrackError(f"the detections at {t_ns} ns have no tracker ids; tracks need them")
    ids = np.empty(0, np.int64) if ids is None else ids
    columns = {"score": detections_.confidence, "track_id": ids, "class_id": _classes_of(detections_)}
    frame = frame_of(TRACKS, boxes, columns, t_ns, index)
    if (ids < 0).any():
        warn("boxes without a tracker id (-1: the track is not confirmed yet) are left out", "left-out")
    return frame._replace(rows=frame.rows[ids >= 0])


def _classes_of(detections_: Any) -> Any:
    """Return class ids (N,) as the schema of detections has them: 0 unknown, 1 a person.

    Detectors count from 0 or from 1, and person may be any number, so names decide where there are some.
    """
    count, names = len(detections_.xyxy), detections_.data.get(_NAMES)
    ids = np.zeros(count, np.uint32) if detections_.class_id is None else np.asarray(detections_.class_id)
    if names is None or not count:
        return ids
    raised = f"other numbers are {_OTHERS} higher than the detector's"
    out = _ids_of(detections_)
    if (out != ids).any() and (out != PERSON).any():
        warn(f"supervision.Detections name their classes: in class_id 1 is a person, {raised}", "classes")
    return out


def _ids_of(detections_: Any) -> Any:
    """Class ids (N,) of detections that name their classes: 1 is a person, others are raised by ``_OTHERS``.

    0 stays what it is if its name says that it is unknown, as in what ``supervision_of`` gives.
    """
    names = np.array([str(name).lower() for name in detections_.data[_NAMES]])
    are_people = np.array([is_person(name) for name in names], bool)
    if detections_.class_id is None:
        return np.where(are_people, PERSON, 0)
    ids = np.asarray(detections_.class_id)
    is_unknown = (ids == UNKNOWN) & (names == class_name(UNKNOWN, {}))
    return np.where(are_people, PERSON, np.where(is_unknown, UNKNOWN, ids + _OTHERS))


def names_of_supervision(detections_: Any) -> dict[int, str]:
    """Return the names of the classes by the ids that ``frame_of_supervision`` gives them."""
    names = detections_.data.get(_NAMES)
    if names is None or not len(detections_.xyxy):
        return {}
    out = dict(zip(np.asarray(_ids_of(detections_)).tolist(), (str(name) for name in names), strict=True))
    return checked_names({number: name for number, name in out.items() if number != UNKNOWN})


def supervision_of(frames: Iterable[Frame], names: Mapping[int, str]) -> Iterator[tuple[int, Detections]]:
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


@checked
def detections(
    boxes: Any = None,
    scores: ArrayLike | None = None,
    classes: ArrayLike | None = None,
    t_ns: int | np.datetime64 = 0,
    *,
    box_format: BoxFormat | None = None,
    positions_m: ArrayLike | None = None,
    sizes_m: ArrayLike | None = None,
    headings_rad: ArrayLike | None = None,
    velocities_m_per_s: ArrayLike | None = None,
    source_ids: ArrayLike | None = None,
    index: int = UNNUMBERED,
    class_names: Mapping[int, str] | None = None,
) -> Frame:
    """Make a frame of detections, to be tracked or to be written into a log.

    Parameters
    ----------
    boxes : array_like of shape (N, 4), or supervision.Detections, optional
        Boxes in pixels; (0, 4) for a picture without detections. Not needed with ``positions_m``. Of
        ``supervision.Detections``, boxes, confidence and classes are taken; where ``data["class_name"]`` names the
        classes, persons become class 1, and the numbers of other classes are raised by 2.
    scores : array_like of shape (N,), optional
        Confidence of each box, from 0 to 1.
    classes : array_like of shape (N,), optional
        Class of each box: 0 unknown, 1 person, other numbers as the detector counts; or, with ``class_names``, names.
    t_ns : int or numpy.datetime64
        Time of the picture in whole nanoseconds; each picture has its own.
    box_format : {"xyxy", "xywh"}
        What the columns of ``boxes`` are: corners (left, top, right, bottom), or left, top, width and height. Not
        needed for ``supervision.Detections``.
    positions_m : array_like of shape (N, 2) or (N, 3), optional
        Centres in metres, in a frame that doesn't move; with or instead of ``boxes``.
    sizes_m : array_like of shape (N, 3), optional
        Length (along the heading), width and height in metres.
    headings_rad : array_like of shape (N,), optional
        Direction of the length in radians, counter-clockwise from the first axis.
    velocities_m_per_s : array_like of shape (N, 2), optional
        Velocity along the first two axes.
    source_ids : array_like of shape (N,), optional
        Ids that the detector gave; -1 for none.
    index : int, optional
        Number of the picture in the video; by default frames are numbered when they are written.
    class_names : mapping of int to str, optional
        Names of classes by number, to give ``classes`` by name. ``Recording.write(classes=...)`` keeps them in a log.

    Returns
    -------
    mcaptrack.schema.Frame
        The frame: ``t_ns``, ``index`` and ``rows``.

    Raises
    ------
    McaptrackError
        If shapes do not fit, numbers are missing or infinite, a box has a negative size, ``t_ns`` is no whole number,
        or ``box_format`` is not given.

    Examples
    --------
    >>> import mcaptrack
    >>> frame = mcaptrack.detections([[10, 20, 30, 60]], [0.9], [1], t_ns=0, box_format="xyxy")
    >>> frame.rows["w_px"].tolist(), frame.rows["h_px"].tolist()
    ([20.0], [40.0])
    >>> frame = mcaptrack.detections(positions_m=[[4.0, 2.5]], scores=[0.9], classes=[1], t_ns=0)
    >>> frame.rows["x_m"].tolist(), frame.rows["y_m"].tolist()
    ([4.0], [2.5])
    """
    in_space = {
        ("x_m", "y_m", "z_m"): positions_m,
        ("length_m", "width_m", "height_m"): sizes_m,
        ("heading_rad",): headings_rad,
        ("vx_m_per_s", "vy_m_per_s"): velocities_m_per_s,
        ("source_id",): source_ids,
    }
    if is_supervision(boxes):
        others = (scores, classes, *in_space.values())
        if box_format not in (None, "xyxy") or any(values is not None for values in others):
            raise McaptrackError("supervision.Detections are boxes in pixels with scores and classes; give no others")
        return frame_of_supervision(boxes, t_ns, index, DETECTIONS)
    columns = columns_in_space(in_space)
    if boxes is None and positions_m is None:
        raise McaptrackError("detections need boxes in pixels (`boxes=`), or positions in metres (`positions_m=`)")
    classes = classes if class_names is None else numbers_of(classes, class_names)
    columns |= {"score": scores, "class_id": classes}
    return frame_of(DETECTIONS, _in_pixels(boxes, box_format), columns, t_ns, index)


def _in_pixels(boxes: Any, box_format: BoxFormat | None) -> Floats | None:
    if boxes is None and box_format is not None:
        raise McaptrackError("`box_format=` says what the columns of `boxes=` are, and there are none")
    if boxes is None:
        return None
    if box_format is None:
        raise McaptrackError("say what the columns of boxes are with `box_format='xyxy'` or `box_format='xywh'`")
    return boxes_of(boxes, box_format)


@checked
def schema_of(
    name: str, columns: Any, *, units: Mapping[str, str] | None = None, doc: Mapping[str, str] | None = None
) -> Schema:
    """Make a schema of your own, for the rows of a channel that ``Recording.write`` writes.

    Parameters
    ----------
    name : str
        Its name, such as "Speed" or "my_tool.Speed". Viewers and ROS tools show it, so one name stands for one set of
        columns.
    columns : dataclass, dtype with names, or Arrow schema
        The columns: numbers and flags. Floating-point numbers may be missing: NaN in rows, None in dataclasses, null in
        tables. ``t_ns`` and ``frame`` are left out: each message has its time and its frame number itself.
    units : mapping of str to str, optional
        Units by column. By default those of the end of a name (speed_m_per_s), of
        ``Annotated[float, "m/s"]`` or ``field(metadata={"unit": "m/s"})`` in a dataclass, or of the metadata of a field
        of Arrow.
    doc : mapping of str to str, optional
        Descriptions by column; by default those in the metadata of fields, as ``doc`` or ``description``.

    Returns
    -------
    mcaptrack.schema.Schema
        The schema: ``name``, ``columns``, ``dtype`` and ``arrow``.

    Raises
    ------
    McaptrackError
        If rows can't hold a column, or if a name can't be one in protobuf, ROS and SQL.

    Examples
    --------
    >>> import mcaptrack
    >>> speed = mcaptrack.schema_of("Speed", [("track_id", "i8"), ("speed", "f4")], units={"speed": "m/s"})
    >>> [(column.name, column.kind, column.unit) for column in speed.columns]
    [('track_id', 'sfixed64', ''), ('speed', 'float', 'm/s')]
    """
    is_of_arrow = hasattr(columns, "__arrow_c_schema__")
    listed = tables.columns_of_arrow(columns) if is_of_arrow else columns_of_type(columns)
    return derived(name, listed, units, doc)


#: What tables of pyarrow, pandas, Polars and DuckDB have.
_OF_ARROW: Final = ("__arrow_c_stream__", "__arrow_c_array__")


def frames_of(rows: Any, schema: Schema | None, own_name: str) -> tuple[Schema, list[Frame], dict[int, str]]:
    """Return the schema and the frames, by time, of rows in any form that ``Recording.write`` takes; and the names of
    classes that these rows bring along, by number.

    Without a schema, their columns decide; ``own_name`` is the name of one of its own, if mcaptrack has none for them.
    Raises McaptrackError for anything else, and for rows that do not fit a schema.
    """
    names: dict[int, str] = {}
    if isinstance(rows, np.ndarray):
        if rows.dtype.names is None or rows.ndim != 1:
            raise McaptrackError(
                f"an array {rows.shape} of {rows.dtype} is no table; make frames with `mcaptrack.detections`, or give "
                "an array (N,) with named columns"
            )
        columns, names = numbered_columns({name: rows[name] for name in rows.dtype.names})
        schema, frames = frames_of_columns(columns, schema, own_name)
    elif any(hasattr(rows, name) for name in _OF_ARROW):
        table = tables.as_arrow(rows)
        columns, names = numbered_columns(tables.columns_of(table))
        schema, frames = frames_of_columns(columns, schema, own_name, tables.columns_of_arrow(table.schema))
    else:
        members = _members(rows)
        if members and is_dataclass(members[0]) and not is_supervision(members[0]):
            arrays, about = columns_of_objects(members)
            schema, frames = frames_of_columns(dict(arrays), schema, own_name, about)
        else:
            schema, frames = _of_frames(members, schema, own_name, names)
    frames.sort(key=lambda frame: (frame.t_ns, frame.index))
    for before, after in pairwise(frames):
        if before[:2] == after[:2]:
            raise McaptrackError(
                f"two frames are at {after.t_ns} ns; each picture has a time of its own: give it with `t_ns=`, or "
                "number pictures of the same time with `index=`"
            )
    check_frames(schema, frames)
    return schema, frames, names


def _members(rows: Any) -> list[Any]:
    """The members of an iterable: frames, instances of a dataclass, or supervision.Detections by time."""
    if is_supervision(rows):
        raise McaptrackError(
            "supervision.Detections have no time; give them by time in nanoseconds: {t_ns: detections}"
        )
    if isinstance(rows, Frame) or is_dataclass(rows):
        return [rows]
    if not isinstance(rows, Iterable) or isinstance(rows, str | bytes):
        raise McaptrackError(
            "rows are frames, an array, a table, instances of a dataclass or supervision.Detections, not "
            f"{kind_of(rows)}"
        )
    return list(rows.items() if hasattr(rows, "items") else rows)


def _of_frames(
    members: Sequence[Any], schema: Schema | None, own_name: str, names: dict[int, str]
) -> tuple[Schema, list[Frame]]:
    """The schema and the frames of their members; adds the names of classes that they give to ``names``."""
    frames = [_frame(item, schema, names) for item in members]
    schema = schema or _schema_of(frames, own_name)
    return schema, [_checked(schema, frame) for frame in frames]


def _schema_of(frames: Sequence[Frame], own_name: str) -> Schema:
    """The schema that all frames fit; any fits one without rows beside others with some."""
    layouts = {frame.rows.dtype for frame in [frame for frame in frames if frame.rows.size] or frames}
    for schema in OURS:
        if layouts and all(schema.has_columns(layout.names) for layout in layouts):
            return schema
    if len(layouts) != 1 or not next(iter(layouts)).names:
        raise McaptrackError(
            "it is not clear whether these are detections or tracks; all frames have to be of one kind, and without "
            "frames the topic has to end in detections or tracks, or `schema=` says what they are"
        )
    return schema_of_columns(own_name, columns_of_dtype(layouts.pop()))


def _checked(schema: Schema, frame: Frame) -> Frame:
    try:
        return frame._replace(rows=schema.check(frame.rows) if frame.rows.size else schema.empty())
    except ValueError as error:
        raise McaptrackError(f"the frame at {frame.t_ns} ns: {error}") from None


def _frame(item: Any, schema: Schema | None, names: dict[int, str]) -> Frame:
    if isinstance(item, Frame):
        if not isinstance(item.rows, np.ndarray):
            raise McaptrackError(f"the rows of a frame are a structured array, not {kind_of(item.rows)}")
        if any(np.ma.getmaskarray(item.rows).tobytes()):
            raise McaptrackError(
                "the rows of a frame are masked; give frames without a mask, with NaN for missing numbers"
            )
        return Frame(time_of(item.t_ns), number_of(item.index), item.rows)
    if isinstance(item, Sequence) and len(item) == 2 and is_supervision(item[1]):
        names |= names_of_supervision(item[1]) | names
        return frame_of_supervision(item[1], item[0], schema=schema)
    kind = "a mapping of columns" if isinstance(item, tuple) and item and isinstance(item[0], str) else kind_of(item)
    raise McaptrackError(
        f"each frame is one of `mcaptrack.detections`, or a time in nanoseconds with supervision.Detections, not "
        f"{kind}; columns are given as a structured array, or a table of pandas, Polars or Arrow"
    )
