"""Ingest label files alone: without pictures, or for the pictures of an existing log.

Letters: N rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import ORIENTED_COLUMNS
from mcaptrack.geometry.clocks import NS_PER_S, parse_ns
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.geometry.transform_tree import plain_frame
from mcaptrack.notices import collected, warn
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Rows
from mcaptrack.schema.framing import frame_times, split_rows, unique_values
from mcaptrack.schema.provenance import CLOCK, INGEST, Provenance, frame_id_of
from mcaptrack.sources.camera_motion import planes_in
from mcaptrack.sources.cameras import DEFAULT_CAMERA, camera_at
from mcaptrack.sources.corrections import CORRECTED, CORRECTED_FROM
from mcaptrack.sources.fixed_frame import named_detections, transforms_of
from mcaptrack.sources.foreign import holds_boxes, holds_pictures
from mcaptrack.sources.foreign.flatten import frame_of
from mcaptrack.sources.ingest.job import FOR_VIDEOS, SCHEMA_OF, IngestJob, IngestOptions
from mcaptrack.sources.ingest.labels.frames import MAX_FRAMES, Numbered, described, share_numbers
from mcaptrack.sources.ingest.labels.roles import describe_classes
from mcaptrack.sources.ingest.labels.table import BoxTable
from mcaptrack.sources.ingest.labels.timeline import (
    ExistingLabels,
    Placed,
    Timeline,
    camera_of,
    camera_prefix,
    count_frames,
    detections_topic,
    frame_times_ns,
    labels_of,
    picture_size,
    timeline_of,
)
from mcaptrack.sources.video import SEQINFO, find_seqinfo

_ASSUMED: Final = "assumption"


class _Known(NamedTuple):
    """The known frame rate and number of frames of a label file, and the source of this information."""

    fps: Fraction | None
    frames: int | None
    of: str
    is_assumed: bool = False


# Compare corrections with the log that they go into: with the ids of its tracks, and with earlier corrections.


def with_new_ids(into: log.Log, prefix: str, labels: BoxTable) -> BoxTable:
    """Give tracks without an id of their own ids that no track of the log has.

    Otherwise the half of a track that was split could get the id of a track that was removed.
    """
    used = [
        int(unique_values(TRACKS, into.frame_columns(topic, TRACKS), "track_id").max(initial=0))
        for topic in (f"{prefix}/{name}" for name in CORRECTED_FROM)
        if into.holds(topic, TRACKS)
    ]
    made = labels.facts.made_ids
    if made is None or not used:
        return labels
    first = max(*used, int(labels.id.max())) + 1
    new = first + np.searchsorted(made, labels.id)
    facts = replace(labels.facts, made_ids=first + np.arange(len(made)))
    return replace(labels, id=np.where(np.isin(labels.id, made), new, labels.id), facts=facts)


def warn_uncovered(into: log.Log, topic: str, placed: Placed) -> None:
    """Warn of pictures that were corrected before, and that new corrections don't cover: they take the place of all."""
    if not into.holds(topic, TRACKS) or not len(placed.t_ns):
        return
    before = frame_times(into.frame_columns(topic, TRACKS))
    lost = before[(before < placed.t_ns[0]) | (before > placed.t_ns[-1])]
    if len(lost):
        span = " to ".join(f"{(int(t_ns) - into.start_ns) / NS_PER_S:.2f}" for t_ns in (lost[0], lost[-1]))
        warn(
            f"{topic} covered {len(lost)} pictures more ({span} s), and these corrections take its place: there the "
            "tracks are those of the tracker again",
            "left-out",
        )


class LabelJob(IngestJob):
    """Label files without pictures, or for the pictures of a log. The first of ``inputs`` is the input itself.

    If its role is None, it depends on whether the file has ids. ``default_fps`` is the frame rate of files without one.
    ``ground`` is the ground plane, if it is given or in the log.
    """

    def __init__(
        self,
        inputs: Sequence[tuple[Role | None, Path]],
        options: IngestOptions,
        into: log.Log | None = None,
        default_fps: Fraction | None = None,
    ) -> None:
        super().__init__(inputs[0][1], options, into)
        for role, path in reversed(inputs):
            self.add(path, self.read(path, role), is_first=True)
        if name := options.given(*FOR_VIDEOS):
            raise McaptrackError(f"{self.source} is a label file; {name} is for videos")
        if options.frames is not None and not 0 < options.frames <= MAX_FRAMES:
            raise McaptrackError(f"`frames=` is a number from 1 to {MAX_FRAMES}, not {options.frames}")
        if "corrections" in self.labels and into is None:
            raise McaptrackError(f"{self.source}: corrections are of tracks in a log; name it with `into=`")
        self._fps: Fraction | None = None
        self._clock = ("", False)  # remark on times that don't come from pictures, and whether they are assumed
        self._other_rates: list[str] = []
        self._start_ns = options.start_ns or 0
        beside: list[Numbered] = []
        if into is not None:
            self.prefix, self.pictures = camera_of(into, options.camera)
            existing = labels_of(into, self.prefix).items()
            beside = [
                Numbered(f"{topic} of {into.path}", "mot", 0, 0, labels.frames - 1)
                for topic, labels in existing
                if labels.counts_from_0
            ]
        share_numbers(self.labels, beside)
        if into is not None and "corrections" in self.labels:
            self.labels["corrections"] = with_new_ids(into, self.prefix, self.labels["corrections"])
            self.frame_id = frame_of(into, self.pictures) if self.pictures else ""
        seen = detections_topic(into, self.prefix) if into is not None and not self.pictures else ""
        pictures_of = partial(picture_size, into, self.pictures) if into is not None and self.pictures else None
        self.fit_to_pictures(pictures_of)
        size = self._boxes_extent()
        if into is not None and (self.pictures or seen):
            self.timeline = self._of_pictures(into, self.pictures or seen)
            needs_size = self.has_ground_given or self.motions is not None
            size = pictures_of() if needs_size and pictures_of else size
        else:
            self.timeline = self._of_rate(default_fps)
        self._size = size
        is_stated = bool(into is not None and self.pictures)
        if not is_stated and options.size and options.calibration:
            size, is_stated = options.size, True
        self.ground = self.plane(*size, is_stated) or self._measured_plane()

    def _boxes_extent(self) -> tuple[int, int]:
        """The image size that contains all boxes, (width, height) in pixels."""
        corners = [labels.extent.high for labels in self.labels.values() if labels.boxes_px is not None]
        if not corners:
            return 0, 0
        x_px, y_px = np.ceil(np.max(corners, axis=0)).tolist()
        return max(0, int(x_px)), max(0, int(y_px))

    def _measured_plane(self) -> GroundPlane | None:
        """The ground plane of the camera in the log, if it was measured and doesn't change."""
        topic = "" if self.into is None else camera_at(self.into, self.prefix).ground_plane
        if self.into is None or topic not in self.into.channels:
            return None
        planes = [plane for _, plane in planes_in(self.into, topic)]
        return planes[0] if len(planes) == 1 and not planes[0].assumed else None

    def _of_pictures(self, into: log.Log, topic: str) -> Timeline:
        """The pictures in the log. Raises McaptrackError if options contradict them."""
        options, timeline = self.options, timeline_of(into, topic)
        if options.fps and not timeline.fits(options.fps):
            raise McaptrackError(
                f"{into.path}: {timeline.of} are {timeline.fps:.6g} a second, not {float(options.fps):g}; labels take "
                "the times of their pictures, so leave `fps=` out"
            )
        if name := options.given("start_ns", "frames"):
            raise McaptrackError(f"{into.path}: labels take the times of {timeline.of}; leave {name} out")
        return timeline

    def _of_rate(self, default: Fraction | None) -> Timeline:
        """The times of missing pictures, by the frame rate from the options, the files or the log."""
        existing = labels_of(self.into, self.prefix) if self.into else {}
        timed = {labels.path: labels.times_s for labels in self.labels.values() if labels.times_s is not None}
        if timed and self.options.frames is not None:
            raise McaptrackError(f"{next(iter(timed))} has times; leave `frames=` out")
        if timed:
            return self._of_times(timed)
        counted = [_known(labels) for labels in self.labels.values()]
        rates = {clock.fps: clock.of for clock in counted if clock.fps}
        if self.options.fps:
            self._other_rates = [
                f"{self.source}: {float(rate):g} frames a second by {of}, and {float(self.options.fps):g} by `fps=`, "
                "which is used"
                for rate, of in rates.items()
                if rate != self.options.fps
            ]
            rates = {self.options.fps: "`fps=`"}
        rates = rates or {labels.fps: topic for topic, labels in existing.items() if labels.fps}
        if len(rates) > 1:
            text = " and ".join(f"{float(fps):g} by {of}" for fps, of in rates.items())
            raise McaptrackError(f"{self.source}: {text}: give the frames per second with `fps=`")
        if not rates and default is None:
            raise McaptrackError(self._no_clock())
        fps, of = next(iter(rates.items()), (default or Fraction(1), _ASSUMED))
        self._fps = fps
        if self.into:
            self._check_existing(self.into, existing, fps)
            if self.options.start_ns is None:
                metadata = self.into.metadata(CLOCK) or {}
                self._start_ns = parse_ns(metadata.get("start_ns", "")) or 0
        count, counted_by = self._count(counted, existing)
        timeline = Timeline.spaced(count, fps, self._start_ns, f"the frames that {counted_by} counts")
        if self.into and any(part.index.counts for part in self.into.parts):
            self._check_overlap(self.into, timeline)
        first = next(iter(self.labels.values())).first_frame
        self._clock = (
            f"{self.source}: {count} frames (by {counted_by}) from {first} on, {float(fps):g} a second (by {of})",
            of == _ASSUMED or of in {clock.of for clock in counted if clock.is_assumed},
        )
        return timeline

    def _of_times(self, timed: Mapping[Path, Floats]) -> Timeline:
        """The times of missing pictures, by the times in the files: regular ones with empty frames in between."""
        path, seconds = next(iter(timed)), np.unique(np.concatenate(list(timed.values())))
        if self.options.start_ns is not None:
            seconds = seconds - seconds[0] + self.options.start_ns / NS_PER_S
        self._start_ns = round(float(seconds[0]) * NS_PER_S)
        timeline, text = Timeline.of_times(path, seconds, self.options.fps)
        if self.into and any(part.index.counts for part in self.into.parts):
            self._check_overlap(self.into, timeline)
        self._clock = (f"{self.source}: {text}", False)
        return timeline

    def report_assumptions(self) -> None:
        """Report also the assumed times of labels without pictures."""
        super().report_assumptions()
        for text in self._other_rates:
            warn(text, "clock")
        text, is_assumed = self._clock
        if is_assumed:
            warn(f"{text}; `fps=` sets another rate", "clock")
        elif text:
            self.report.remarks.append(text)

    def _check_existing(self, into: log.Log, existing: Mapping[str, ExistingLabels], fps: Fraction) -> None:
        """Check that the labels of one camera have one frame rate."""
        for topic, labels in existing.items():
            if topic not in self.topics() and labels.fps not in (None, fps):
                raise McaptrackError(
                    f"{into.path}: {topic} has {float(labels.fps or 0):g} frames a second, not {float(fps):g}, and "
                    "labels of one camera are of the same pictures; give the same `fps=`, or another `camera=`"
                )

    def _count(self, counted: Sequence[_Known], existing: Mapping[str, ExistingLabels]) -> tuple[int, str]:
        """The number of frames, and the source of this number."""
        if self.options.frames is not None:
            return self.options.frames, "`frames=`"
        frame_counts = {entry.frames: entry.of for entry in counted if entry.frames}
        if frame_counts:
            return max(frame_counts), frame_counts[max(frame_counts)]
        counts = [count_frames(labels) for labels in self.labels.values()]
        last = max(*counts, *(label.frames for label in existing.values()), 1)
        ends = [end for _, end in self.options.frame_ranges.ranges if end] if self.options.frame_ranges else []
        stated = min(max(ends, default=0) - next(iter(self.labels.values())).first_frame, MAX_FRAMES)
        return (stated, "`frames=`") if stated > last else (last, "the last label")

    def _check_overlap(self, into: log.Log, timeline: Timeline) -> None:
        """Check that labels without pictures overlap in time with the log."""
        first, last = int(timeline.t_ns[0]), int(timeline.t_ns[-1])
        if first > into.end_ns or last < into.start_ns:
            raise McaptrackError(
                f"{into.path} is from {_seconds(into.start_ns)} to {_seconds(into.end_ns)}, the labels would be "
                f"from {_seconds(first)} to {_seconds(last)}, and {self.prefix} has no pictures to take times from; "
                f"say when frame {next(iter(self.labels.values())).first_frame} was with `start_time=`"
            )

    def _no_clock(self) -> str:
        text = f"{self.source} has no clock of its own; give the frames per second with `fps=`"
        pictures = sorted(c.topic for c in self.into.channels.values() if holds_pictures(c)) if self.into else []
        if pictures and self.into:
            camera = pictures[0].strip("/")
            text += f", or choose the pictures of {', '.join(pictures)} in {self.into.path} with `camera={camera!r}`"
        return text

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write the ground plane and the labels."""
        if not has_clock and not self.pictures:
            writer.add_metadata(CLOCK, {"start_ns": str(self._start_ns)})
        self.write_plane(writer, self.ground, int(self.timeline.t_ns[0]))
        if self.into is not None and "corrections" in self.labels:
            placed = self.timeline.place(self.labels["corrections"], "corrections", [])
            warn_uncovered(self.into, f"{self.prefix}/{CORRECTED}", placed)
        self.write_labels(writer, self.ground, self.timeline)
        self.write_motion(writer, self.timeline, self._size)

    def label_parameters(self, role: Role, labels: BoxTable) -> dict[str, Any]:
        """The frame rate, if there were no pictures."""
        return super().label_parameters(role, labels) | ({} if self._fps is None else {"fps": str(self._fps)})

    def all_frames(self, role: Role) -> list[Frame]:
        """The labels of a role as frames, including empty frames."""
        return self.placed_frames(role)[0]

    def placed_frames(self, role: Role) -> tuple[list[Frame], Placed]:
        """As ``all_frames``, and which frames these are."""
        placed = self.timeline.place(self.labels[role], role, self.report.lost, self.ranges_of(role))
        return list(self.frames(role, self.ground, placed)()), placed


def _seconds(t_ns: int) -> str:
    return f"{t_ns / NS_PER_S:.3f} s"


def _known(labels: BoxTable) -> _Known:
    """Frame rate and number of frames by the format of a label file, or by seqinfo.ini."""
    facts = labels.facts
    fps = facts.fps or (labels.step / facts.interval_s if facts.interval_s else None)
    if fps is not None:
        return _Known(fps, None, facts.clock_of, is_assumed=True)
    info = find_seqinfo(labels.path.parent)
    return _Known(info.fps, info.frames, SEQINFO) if info else _Known(None, None, "")


def label_frames(files: Mapping[Role, Path], options: IngestOptions) -> dict[Role, list[Frame]]:
    """Read label files with a common clock as frames, without writing a log.

    Raises McaptrackError as ``ingest`` does. For comparisons only the order and intervals of times matter, so files
    without a frame rate get one frame per second unless the options give one.
    """
    job = LabelJob([(role, path) for role, path in files.items()], options, default_fps=Fraction(1))
    job.report_assumptions()
    return {role: job.all_frames(role) for role in files}


# Ingest label files with 3D boxes: for a recorded log, or as a log of their own.
#
# Letters: N rows, F frames.


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
    if camera != DEFAULT_CAMERA:
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
        return holds_boxes(opened, channel.topic, in_space=True)
    is_ingested = provenance.transform == INGEST and channel.schema_name in (DETECTIONS.name, TRACKS.name)
    return is_ingested and bool(provenance.frame_id) and not channel.topic.endswith(f"/{_TRUTH}")


def box_times(opened: log.Log, topic: str) -> Ints:
    """The times of the frames of 3D boxes (F,): the stamps of recorded messages."""
    if Provenance.from_metadata(opened.channel(topic).metadata) is not None:
        return np.asarray(opened.times(topic), np.int64)
    with collected():  # the command that tracks the boxes says it
        return frame_times(named_detections(opened, topic).frames)


def warn_of_frame(opened: log.Log, frame_id: str, labels: Path) -> None:
    """Warn if a log has frames of reference, and not the one of labels."""
    tree = transforms_of(opened)
    of_channels = {frame_id_of(channel.metadata) for channel in opened.channels.values()} - {""}
    frames = sorted({*(tree.frames() if tree else ()), *of_channels})
    if frames and plain_frame(frame_id) not in frames:
        some = list_names(frames, _LISTED)
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
        if name := options.given(*FOR_VIDEOS, "ground_plane", "calibration", "motion", "size", "frames"):
            raise McaptrackError(f"{self.source} holds 3D boxes; {name} is for pictures and boxes in them")
        for stated, path in (*inputs, *options.labels.items()):
            if stated == "corrections":
                raise McaptrackError(f"{path} holds 3D boxes; corrections are boxes in pictures")
            rows = options.read(path, stated, options.classes)
            if not rows.in_space:
                raise McaptrackError(f"{path} holds boxes in pictures, and {self.source} holds 3D boxes")
            self.add(path, rows)
        self._topic = boxes_topic(into, options.camera) if into else ""
        if self._topic and options.camera == DEFAULT_CAMERA:
            self.prefix = self._topic.rpartition("/")[0] or self.prefix
        share_numbers(self.labels)
        self.labels = {role: self._at_times(self._described(self._placed(rows))) for role, rows in self.labels.items()}

    def _placed(self, rows: BoxTable) -> BoxTable:
        """Rows in the frame of reference that the user says, or the format, or the root of the log's transforms."""
        if self.options.frame_id is not None:
            if self.into:
                warn_of_frame(self.into, self.options.frame_id, rows.path)
            return replace(rows, facts=replace(rows.facts, frame_id=self.options.frame_id))
        tree, stated = transforms_of(self.into) if self.into else None, rows.facts.frame_id
        roots = tree.roots() if tree is not None else []
        root = roots[0] if len(roots) == 1 else ""
        frame_id = stated or root or FRAME
        reason = "by its format" if stated else "the root of the log's transforms" if root else "assumed"
        text = f": boxes are taken as those of the frame {frame_id!r} ({reason}); `frame=` names another"
        (rows.find if reason == "assumed" else rows.remark)(text)
        return replace(rows, facts=replace(rows.facts, frame_id=frame_id))

    def _described(self, rows: BoxTable) -> BoxTable:
        """Rows of the frames that were labelled, which are also those without boxes between others."""
        ranges = self.ranges_of(rows.role)
        if rows.facts.is_timed:
            if ranges is not None:
                raise McaptrackError(f"{rows.path} has times, which say what it describes; leave `frames=` out")
            return rows
        at = rows.labelled
        if rows.role == "truth" and not rows.facts.states_labelled and at[-1] - at[0] < MAX_FRAMES:
            at = np.arange(at[0], at[-1] + 1, rows.step)
        shown = described(rows, "tracks", at, rows.labelled, ranges, str(rows.path)) if ranges else None
        at = at if shown is None else at[shown.pictures]
        kept = np.isin(rows.frame, at)
        return replace(rows if kept.all() else rows.take(kept), facts=replace(rows.facts, labelled=at))

    def _at_times(self, rows: BoxTable) -> BoxTable:
        t_ns, labelled = self._times(rows, rows.frame, rows.labelled)
        timed = replace(rows, frame=t_ns, facts=replace(rows.facts, labelled=labelled, is_timed=True))
        if self.into is not None and any(part.index.counts for part in self.into.parts):
            first, last = int(timed.labelled[0]), int(timed.labelled[-1])
            if first > self.into.end_ns + _MARGIN_NS or last < self.into.start_ns - _MARGIN_NS:
                raise McaptrackError(
                    f"{rows.path} is from {first / NS_PER_S:.3f} to {last / NS_PER_S:.3f} s, {self.into.path} from "
                    f"{self.into.start_ns / NS_PER_S:.3f} to {self.into.end_ns / NS_PER_S:.3f} s; give the time of the "
                    "first labels with `start_time=`"
                )
        return timed

    def _times(self, rows: BoxTable, number: Ints, labelled: Ints) -> tuple[Ints, Ints]:
        """The times of rows (N,) and of labelled frames (F,), by their own times, a frame rate, or the log."""
        options = self.options
        if rows.facts.is_timed:
            if name := options.given("fps", "first_frame"):
                raise McaptrackError(f"{rows.path} has times; leave {name} out")
            shift = 0 if options.start_ns is None else options.start_ns - int(labelled[0])
            return number + shift, labelled + shift
        first = rows.first_frame
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
        times = box_times(self.into, self._topic)
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
        return int(box_times(self.into, self._topic)[0]) if self._topic else self.into.start_ns

    def report_assumptions(self) -> None:
        """Report how the boxes were understood, and what of them is left out."""
        for role, rows in self.labels.items():
            self.report_table(role, rows)
            text = describe_classes(*rows.extent.classes, rows.classes)
            self.report.remarks.append(f"{rows.path}: class_id is {text}")

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write the boxes."""
        if self.into is None and not has_clock:
            start = min(int(rows.labelled[0]) for rows in self.labels.values())
            writer.add_metadata(CLOCK, {"start_ns": str(start)})
        for role, rows in self.labels.items():
            parameters = {"file": rows.path.name, "format": rows.format} | self.label_parameters(role, rows)
            frames = partial(iter, self.all_frames(role))
            self.write_rows(writer, role, SCHEMA_OF[role], frames, parameters, rows, rows.facts.frame_id)

    def label_parameters(self, role: Role, labels: BoxTable) -> dict[str, Any]:
        """Also the frames that were labelled, the part of a data set, and the frame rate."""
        options, ranges = self.options, self.ranges_of(role)
        out = super().label_parameters(role, labels) | ({"scene": options.scene} if options.scene else {})
        out |= {"frames": str(ranges), "frames_by": "frames"} if ranges else {}
        return out | ({} if options.fps is None else {"fps": str(options.fps)})

    def all_frames(self, role: Role) -> list[Frame]:
        """The boxes of a role as frames, at all times that the file describes."""
        rows = self.labels[role]
        ends = np.searchsorted(rows.frame, rows.labelled, "right")
        return split_rows(rows.labelled, range(len(ends)), label_rows_3d(rows, role), ends)


def label_rows_3d(labels: BoxTable, role: Role) -> Rows:
    """Convert the N rows of labels to rows of detections or tracks."""
    assert labels.boxes_m is not None
    columns = dict(zip(ORIENTED_COLUMNS, labels.boxes_m.T, strict=True))
    if labels.velocity is not None:
        columns |= dict(zip(("vx_m_per_s", "vy_m_per_s"), labels.velocity.T, strict=True))
    columns |= {"score": labels.score, "class_id": labels.class_id, "source_id": np.full(len(labels.frame), -1)}
    if role == "detections":
        return DETECTIONS.rows(**columns)
    return TRACKS.rows(track_id=labels.id, observed=np.ones(len(labels.frame), bool), **columns)
