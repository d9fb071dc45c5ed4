"""A log as a ROS 2 bag, for RViz and ``ros2 bag``: a folder with metadata.yaml and a file of messages.

<topic>            vision_msgs/Detection3DArray of rows in metres, Detection2DArray of rows in pixels
<topic>/markers    visualization_msgs/MarkerArray of tracks and forecasts in metres
<topic>            nav_msgs/Path for each forecast
/tf, /tf_static    tf2_msgs/TFMessage, the transforms of the log
"""

from __future__ import annotations

import heapq
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.foxglove.views import ground
from mcaptrack.foxglove.views.people import base_heights
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.location import Location, local_name, shortened
from mcaptrack.schema import DETECTIONS, PREDICTIONS, SCHEMAS, TRACKS, Frame, Schema
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.provenance import frame_id_of, input_of
from mcaptrack.sources.cameras import cameras
from mcaptrack.sources.fixed_frame import transforms_of
from mcaptrack.tables.rosbag2 import messages
from mcaptrack.tables.rosbag2.messages import message, typestore

__all__ = ["Storage", "WrittenBag", "default_folder", "write_bag"]

Storage = Literal["mcap", "sqlite3"]
#: The version of the format of metadata.yaml: readers accept earlier ones, not later ones.
_VERSION: Final = 8
_METADATA: Final = "metadata.yaml"
#: ROS stamps have seconds of 32 bits.
_LAST_S: Final = 2**31


@dataclass
class WrittenBag:
    """The messages of a bag by topic, and notes for people."""

    messages: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


class _Stream(NamedTuple):
    """The messages of a topic of the bag, sorted by time in ns."""

    topic: str
    kind: str
    messages: Iterator[tuple[int, Any]]
    is_latched: bool = False


#: How much of a name the name of a temporary folder begins with, in bytes; files in it have longer ones.
_PART_BYTES: Final = 200


def default_folder(path: Location) -> Path:
    """The default folder for the bag of a log: log.mcap -> log.rosbag2 beside it."""
    return local_name(path, ".rosbag2.mcap").with_suffix("")  # a file in it has its name, and a suffix


def write_bag(
    opened: log.Log,
    folder: Path,
    progress: Callable[[str, int, int], None] = lambda *_: None,
    *,
    storage: Storage = "mcap",
    force: bool = False,
) -> WrittenBag:
    """Write detections, tracks and forecasts of a log as a ROS 2 bag.

    Parameters
    ----------
    opened : Log
    folder : Path
        The folder of the bag. It appears when it is complete.
    progress : callable
        Called with a text, the number of finished messages and their total.
    storage : {"mcap", "sqlite3"}
    force : bool
        Whether to replace a bag that is there.

    Returns
    -------
    WrittenBag

    Raises
    ------
    McaptrackError
        If the log has nothing to write, if the folder exists or can't be written, and if a time is later than ROS can
        express.
    """
    _refuse_folder(folder, force)
    done = WrittenBag()
    job = _Job(opened, done.notes)
    streams = [stream for topic, schema in job.channels() for stream in job.streams(topic, schema)]
    if not streams:
        raise McaptrackError(f"{opened.path} has no detections, tracks or predictions to write as ROS messages")
    streams += job.transforms()
    part = folder.with_name(shortened(f".{folder.name}", _PART_BYTES) + ".part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        part.mkdir(parents=True)
        # The file of messages has the name of its folder.
        _write(part / folder.name, streams, storage, done, lambda count: progress("export", count, job.total))
        if folder.exists():
            folder.rename(part / "before")  # removed in one step: half of a bag would be taken for no bag
        (part / folder.name).rename(folder)
    except (OSError, sqlite3.Error) as error:
        raise McaptrackError(f"{folder} can't be written: {getattr(error, 'strerror', None) or error}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return done


def _refuse_folder(folder: Path, force: bool) -> None:
    """Raise McaptrackError if a bag can't get this folder."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    if not (folder.is_dir() and (folder / _METADATA).is_file()):
        raise McaptrackError(f"{folder} exists and is no bag; name another folder with `output=`")
    if not force:
        raise McaptrackError(f"{folder} exists; `force=True` replaces it")


def _write(
    folder: Path, streams: Sequence[_Stream], storage: Storage, done: WrittenBag, progress: Callable[[int], None]
) -> None:
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
    from rosbags.rosbag2 import StoragePlugin, Writer

    forever = QosTime(2**31 - 1, 2**32 - 1)
    latched = Qos(
        QosHistory.KEEP_LAST, 100, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, forever, forever,
        QosLiveliness.AUTOMATIC, forever, False,
    )  # fmt: skip
    store = typestore()
    count = 0
    with Writer(folder, version=_VERSION, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        pending = []
        for stream in streams:
            profiles = [latched] if stream.is_latched else []
            connection = writer.add_connection(
                stream.topic, stream.kind, typestore=store, offered_qos_profiles=profiles
            )
            done.messages[stream.topic] = 0
            pending.append(_with(stream, connection))
        for t_ns, stream, connection, content in heapq.merge(*pending, key=lambda item: item[0]):
            writer.write(connection, t_ns, store.serialize_cdr(content, stream.kind))
            done.messages[stream.topic] += 1
            count += 1
            progress(count)


def _with(stream: _Stream, connection: Any) -> Iterator[tuple[int, _Stream, Any, Any]]:
    return ((t_ns, stream, connection, content) for t_ns, content in stream.messages)


class _Job:
    """The streams of a log for a bag. ``total`` is the number of their messages so far."""

    def __init__(self, opened: log.Log, notes: list[str]) -> None:
        self._opened, self._notes = opened, notes
        self._prefixes = {topic: camera.prefix for camera in cameras(opened) for topic in camera.topics}
        self.total = 0

    def channels(self) -> list[tuple[str, Schema]]:
        """The channels with rows to write."""
        wanted = (DETECTIONS, TRACKS, PREDICTIONS)
        channels = log.topics_with_schema(self._opened, [schema.name for schema in wanted])
        return [
            (channel.topic, SCHEMAS[channel.schema_name])
            for channel in sorted(channels, key=lambda channel: channel.topic)
            if channel.holds(SCHEMAS[channel.schema_name])
        ]

    def streams(self, topic: str, schema: Schema) -> list[_Stream]:
        """The topics of the bag for a channel."""
        frames = [self._checked(topic, frame) for frame in self._opened.frames(topic, schema)]
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
                    ((f.t_ns, messages.forecast_markers(f, in_metres, b)) for f, b in zip(frames, bases, strict=True)),
                ),
            ]
            self.total += len(frames) + sum(len(np.unique(frame.rows["track_id"])) for frame in frames)
            return out
        rows = schema.joined([frame.rows for frame in frames])
        pixels, places = messages.has_pixels(rows), messages.has_place(rows)
        is_flat = bool(pixels.any()) and not np.isfinite(rows["z_m"]).any()
        lost = int((~pixels if is_flat else ~places).sum())
        if lost:
            lacking = "box in pixels" if is_flat else "position in metres"
            self._notes.append(f"{topic}: {lost:,} rows without a {lacking} are not in the bag")
        if is_flat:
            flat = prefix.strip("/")
            boxes = ((frame.t_ns, messages.boxes_2d(frame, flat, names)) for frame in frames)
            out.append(_Stream(topic, "vision_msgs/msg/Detection2DArray", boxes))
        else:
            boxes = ((frame.t_ns, messages.boxes_3d(frame, in_metres, names)) for frame in frames)
            out.append(_Stream(topic, "vision_msgs/msg/Detection3DArray", boxes))
        if schema is TRACKS and places.any():
            drawn = ((frame.t_ns, messages.track_markers(frame, in_metres, names)) for frame in frames)
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
            channel = self._opened.channels.get(name)
            if channel is None or channel.schema_name != TRACKS.name:
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
        tree = transforms_of(self._opened)
        out = []
        for topic, is_static in (("/tf_static", True), ("/tf", False)):
            wanted = [series for series in (tree.series.values() if tree else ()) if series.is_static == is_static]
            poses = sorted(
                (int(t_ns), number, at)
                for number, series in enumerate(wanted)
                for at, t_ns in enumerate(series.t_ns.tolist())
                if 0 <= t_ns < _LAST_S * NS_PER_S
            )
            if poses:
                self.total += len(poses)
                moved = ((t_ns, _transform(wanted[number], at)) for t_ns, number, at in poses)
                out.append(_Stream(topic, "tf2_msgs/msg/TFMessage", moved, is_static))
        return out


def _paths(frames: Sequence[Frame], frame_id: str, bases: Sequence[Mapping[int, float]]) -> Iterator[tuple[int, Any]]:
    for frame, base_m in zip(frames, bases, strict=True):
        yield from ((frame.t_ns, path) for path in messages.paths(frame, frame_id, base_m))


def _transform(series: Any, at: int) -> Any:
    place = message("geometry_msgs/Vector3", *series.translation[at].tolist())
    moved = message(
        "geometry_msgs/Transform", place, message("geometry_msgs/Quaternion", *series.quaternion[at].tolist())
    )
    head = messages.header(int(series.t_ns[at]), series.parent)
    return message("tf2_msgs/TFMessage", [message("geometry_msgs/TransformStamped", head, series.child, moved)])
