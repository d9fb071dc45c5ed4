"""Ingest label files with 3D boxes: for a recorded log, or as a log of their own.

Letters: N rows, F frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack import log, notices
from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.oriented_boxes import COLUMNS
from mcaptrack.geometry.transform_tree import plain_frame
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Rows
from mcaptrack.schema.framing import frame_times as frame_times_of
from mcaptrack.schema.framing import split_rows
from mcaptrack.schema.provenance import CLOCK, INGEST, Provenance, frame_id_of
from mcaptrack.sources.fixed_frame import holds_boxes_3d, named_detections
from mcaptrack.sources.frames import transforms_of
from mcaptrack.sources.ingest.job import SCHEMA_OF, IngestJob, IngestOptions
from mcaptrack.sources.ingest.labels.boxes_3d.reading import read_boxes_3d
from mcaptrack.sources.ingest.labels.camera import DEFAULT, camera_prefix
from mcaptrack.sources.ingest.labels.content import BoxRows3D, describe_classes
from mcaptrack.sources.ingest.labels.timeline import frame_times_ns

#: The frame of reference of boxes, if neither the user nor the format nor the log names one.
FRAME: Final = "map"
#: Stamps may differ from the times of a log by this much.
_MARGIN_NS: Final = 60 * NS_PER_S


# Find the 3D boxes of a log that labels belong to.


_TRUTH: Final = "truth"
_LISTED: Final = 8


def boxes_topic(opened: log.Log, camera: str) -> str:
    """The topic of the 3D boxes below the name of a camera, or the only one of the log; "" if there is none.

    Raises McaptrackError if there are several, and no name is given.
    """
    topics = sorted(
        channel.topic for channel in opened.channels.values() if channel.messages and _holds_boxes(opened, channel)
    )
    if camera != DEFAULT:
        topics = [topic for topic in topics if camera_prefix(topic) == "/" + camera.strip("/")]
        return topics[0] if topics else ""
    prefixes = sorted({camera_prefix(topic) for topic in topics})
    if len(prefixes) > 1:
        raise McaptrackError(
            f"{opened.path} has 3D boxes in several places, {', '.join(topics)}; labels belong to those of one: choose "
            f"with `camera={prefixes[0].strip('/')!r}`"
        )
    return topics[0] if topics else ""


def _holds_boxes(opened: log.Log, channel: log.Channel) -> bool:
    provenance = Provenance.from_metadata(channel.metadata)
    if provenance is None:
        return holds_boxes_3d(opened, channel.topic)
    is_truth = channel.topic.endswith(f"/{_TRUTH}")
    return (
        provenance.transform == INGEST
        and channel.schema_name in (DETECTIONS.name, TRACKS.name)
        and bool(provenance.frame_id and not is_truth)
    )


def frame_times(opened: log.Log, topic: str) -> Ints:
    """The times of the frames of 3D boxes (F,): the stamps of recorded messages."""
    if Provenance.from_metadata(opened.channel(topic).metadata) is not None:
        return np.asarray(opened.times(topic), np.int64)
    with notices.collected():  # the command that tracks the boxes says it
        return frame_times_of(named_detections(opened, topic).frames)


def root_frame(opened: log.Log) -> str:
    """The only root of the transforms of a log; "" if it has none, or several."""
    tree = transforms_of(opened)
    roots = tree.roots() if tree is not None else []
    return roots[0] if len(roots) == 1 else ""


def warn_of_frame(opened: log.Log, frame_id: str, labels: Path) -> None:
    """Warn if a log has frames of reference, and not the one of labels."""
    tree = transforms_of(opened)
    frames = set(tree.frames() if tree else ()) | {
        frame_id_of(channel.metadata) for channel in opened.channels.values()
    } - {""}
    if frames and plain_frame(frame_id) not in frames:
        listed = sorted(frames)
        some = ", ".join(listed[:_LISTED]) + (", ..." if len(listed) > _LISTED else "")
        text = f"there is no frame {frame_id} in {opened.path} (but {some}), so that its tracks can't be compared"
        warn(f"{labels}: {text} with these boxes", "transforms")


class Boxes3DJob(IngestJob):
    """Label files with 3D boxes. The first of ``inputs`` is the input itself.

    If its role is None, it depends on whether the file has ids.
    """

    def __init__(
        self, inputs: Sequence[tuple[Role | None, Path]], options: IngestOptions, into: log.Log | None = None
    ) -> None:
        super().__init__(inputs[0][1], replace(options, labels={}), into)
        self._refuse_options(options)
        self.boxes: dict[Role, BoxRows3D] = {}
        for stated, path in (*inputs, *options.labels.items()):
            if stated == "corrections":
                raise McaptrackError(f"{path} holds 3D boxes; corrections are boxes in pictures")
            rows = read_boxes_3d(path, stated or "detections", options.label_format, options.columns, options.scene)
            role = stated or ("tracks" if rows.has_ids else "detections")
            if role != "detections":
                rows.check(role)
            if role in self.boxes:
                raise McaptrackError(
                    f"{path} and {self.boxes[role].path} are both {role}; give the role of {path} with `role=`"
                )
            self.boxes[role] = rows
        self._topic = boxes_topic(into, options.camera) if into else ""
        if self._topic and options.camera == DEFAULT:
            self.prefix = self._topic.rpartition("/")[0] or self.prefix
        self._frame_ids = {role: self._frame_id(rows) for role, rows in self.boxes.items()}
        self._timed = {role: self._at_times(role, rows) for role, rows in self.boxes.items()}

    @property
    def roles(self) -> Set[Role]:
        """The roles of label files."""
        return self.boxes.keys()

    def _refuse_options(self, options: IngestOptions) -> None:
        is_option_given = {
            options.for_videos(): bool(options.for_videos()),
            "`ground_plane=`": options.ground_plane is not None,
            "`calibration=`": bool(options.calibration),
            "`motion=`": options.motion is not None,
            "`size=`": options.size is not None,
            "`frames=`": options.frames is not None,
        }
        for name, is_given in is_option_given.items():
            if is_given:
                raise McaptrackError(f"{self.source} holds 3D boxes; {name} is for pictures and boxes in them")

    def _frame_id(self, rows: BoxRows3D) -> str:
        """The frame of reference of rows: as the user says, as the format says, or the root of the log's transforms."""
        if self.options.frame_id is not None:
            if self.into:
                warn_of_frame(self.into, self.options.frame_id, rows.path)
            return self.options.frame_id
        root = root_frame(self.into) if self.into else ""
        frame_id = rows.frame_id or root or FRAME
        reason = "by its format" if rows.frame_id else "the root of the log's transforms" if root else "assumed"
        text = f": boxes are taken as those of the frame {frame_id!r} ({reason}); `frame=` names another"
        if reason == "assumed":
            rows.doubt(text)
        else:
            rows.remark(text)
        return frame_id

    def _at_times(self, role: Role, rows: BoxRows3D) -> BoxRows3D:
        t_ns, labelled = self._times(rows, rows.frame, rows.labelled)
        timed = rows.settled(t_ns, labelled, role, self.options.classes)
        if self.into is not None and any(part.index.counts for part in self.into.parts):
            first, last = int(timed.labelled[0]), int(timed.labelled[-1])
            if first > self.into.end_ns + _MARGIN_NS or last < self.into.start_ns - _MARGIN_NS:
                raise McaptrackError(
                    f"{rows.path} is from {first / NS_PER_S:.3f} to {last / NS_PER_S:.3f} s, {self.into.path} from "
                    f"{self.into.start_ns / NS_PER_S:.3f} to {self.into.end_ns / NS_PER_S:.3f} s; give the time of the "
                    "first labels with `start_time=`"
                )
        return timed

    def _times(self, rows: BoxRows3D, number: Ints, labelled: Ints) -> tuple[Ints, Ints]:
        """The times of rows (N,) and of labelled frames (F,), by their own times, a frame rate, or the log."""
        options = self.options
        if rows.is_timed:
            for name, value in (("fps", options.fps), ("first_frame", options.first_frame)):
                if value is not None:
                    raise McaptrackError(f"{rows.path} has times; leave `{name}=` out")
            shift = 0 if options.start_ns is None else options.start_ns - int(labelled[0])
            return number + shift, labelled + shift
        first = options.first_frame
        if first is None:
            first = rows.assume_first(int(labelled[0])) if rows.format == "csv" else 0
        if int(labelled[0]) < first:
            raise McaptrackError(f"{rows.path}: its first frame is {labelled[0]}, before `first_frame={first}`")
        if options.fps is not None:
            start = options.start_ns if options.start_ns is not None else self._log_start_ns()
            rows.remark(f": frame {first} is at {start / NS_PER_S:.3f} s")
            both = (start + frame_times_ns(numbers - first, options.fps) for numbers in (number, labelled))
            return next(both), next(both)
        if self.into is None or not self._topic:
            raise McaptrackError(
                f"{rows.path} counts frames and has no clock; give the frames per second with `fps=`, or add it to the "
                "log of its boxes with `into=`"
            )
        times = frame_times(self.into, self._topic)
        if int(labelled[-1]) - first >= len(times):
            raise McaptrackError(
                f"{rows.path}: its last frame is {labelled[-1]}, and {self._topic} has {len(times)} messages, from "
                f"frame {first} on; give the number of the first with `first_frame=`, or the rate with `fps=`"
            )
        rows.remark(f": frame {first} is the first message of {self._topic}")
        return times[number - first], times[labelled - first]

    def _log_start_ns(self) -> int:
        if self.into is None:
            return 0
        return int(frame_times(self.into, self._topic)[0]) if self._topic else self.into.start_ns

    def topics(self) -> Iterator[str]:
        """The topics that will be written."""
        yield from (f"{self.prefix}/{role}" for role in self.boxes)

    def report_assumptions(self) -> None:
        """Report how the boxes were understood, and what of them is left out."""
        for role, rows in self.boxes.items():
            self.report.remarks += rows.remarks
            for text, code in rows.doubts:
                warn(text, code)
            if rows.left_out:
                warn(f"{rows.path} also holds {rows.left_out}; left out of {role}", "left-out")
            timed = self._timed[role]
            text = describe_classes(*np.unique(timed.class_id, return_counts=True), timed.classes)
            self.report.remarks.append(f"{rows.path}: class_id is {text}")

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write the boxes."""
        if self.into is None and not has_clock:
            start = min(int(timed.labelled[0]) for timed in self._timed.values())
            writer.add_metadata(CLOCK, {"start_ns": str(start)})
        for role, rows in self.boxes.items():
            timed = self._timed[role]
            frames = self.all_frames(role)
            parameters: dict[str, Any] = {"file": rows.path.name, "format": rows.format} | self._parameters(role)
            self.write_rows(
                writer,
                role,
                SCHEMA_OF[role],
                lambda frames=frames: iter(frames),  # type: ignore[misc]
                parameters,
                timed.classes,
                self._frame_ids[role],
            )

    def _parameters(self, role: Role) -> dict[str, Any]:
        options = self.options
        parameters: Mapping[str, Any] = {
            "first_frame": options.first_frame,
            "columns": ",".join(f"{key}={name}" for key, name in (options.columns or {}).items()) or None,
            "classes": options.classes.text if options.classes and role != "detections" else None,
            "scene": options.scene,
            "fps": None if options.fps is None else str(options.fps),
        }
        return {name: value for name, value in parameters.items() if value is not None}

    def classes(self, role: Role) -> Mapping[int, str]:
        """The names of the classes of a role by class id."""
        return self._timed[role].classes

    def all_frames(self, role: Role) -> list[Frame]:
        """The boxes of a role as frames, at all times that the file describes."""
        timed = self._timed[role]
        ends = np.searchsorted(timed.frame, timed.labelled, "right")
        return split_rows(timed.labelled, range(len(ends)), label_rows_3d(timed, role), ends)


def label_rows_3d(labels: BoxRows3D, role: Role) -> Rows:
    """Convert the N rows of labels to rows of detections or tracks."""
    columns = dict(zip(COLUMNS, labels.boxes.T, strict=True))
    if labels.velocity is not None:
        columns |= dict(zip(("vx_m_per_s", "vy_m_per_s"), labels.velocity.T, strict=True))
    none = np.full(len(labels.boxes), -1)
    if role == "detections":
        return DETECTIONS.rows(score=labels.score, class_id=labels.class_id, source_id=none, **columns)
    return TRACKS.rows(
        track_id=labels.id,
        score=labels.score,
        observed=np.ones(len(none), bool),
        source_id=none,
        class_id=labels.class_id,
        **columns,
    )
