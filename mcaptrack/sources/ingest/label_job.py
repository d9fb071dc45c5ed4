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
from mcaptrack.choices import Point, Role
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.clocks import NS_PER_S, parse_ns
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import warn
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.framing import frame_times, unique_values
from mcaptrack.schema.provenance import CLOCK
from mcaptrack.sources.calibrations import frame_of
from mcaptrack.sources.camera_motion import planes_in
from mcaptrack.sources.cameras import camera_at
from mcaptrack.sources.corrections import CORRECTED, CORRECTED_FROM
from mcaptrack.sources.foreign import holds_pictures
from mcaptrack.sources.ingest.job import IngestJob, IngestOptions
from mcaptrack.sources.ingest.labels.camera import (
    ExistingLabels,
    camera_of,
    detections_topic,
    labels_of,
    picture_size,
    timeline_of,
)
from mcaptrack.sources.ingest.labels.content import Format, Labels, WantedClasses
from mcaptrack.sources.ingest.labels.timeline import MAX_FRAMES, Placed, Timeline, count_frames
from mcaptrack.sources.video import SEQINFO, find_seqinfo

_SDD_FPS: Final = Fraction(30)
#: Formats with a known frame rate, and its reason.
_BY_FORMAT: Final[Mapping[Format, str]] = {
    "sdd": "Stanford Drone",
    "trajnet": "trajnet, a label every 0.4 s",
    "obsmat": "obsmat, a label every 0.4 s",
}
_ASSUMED: Final = "assumption"
#: The label interval of formats that are annotated at the sampling rate of prediction benchmarks.
_LABEL_STEP_S: Final = Fraction(2, 5)


class _Known(NamedTuple):
    """The known frame rate and number of frames of a label file, and the source of this information."""

    fps: Fraction | None
    frames: int | None
    of: str


# Compare corrections with the log that they go into: with the ids of its tracks, and with earlier corrections.


def with_new_ids(into: log.Log, prefix: str, labels: Labels) -> Labels:
    """Give tracks without an id of their own ids that no track of the log has.

    Otherwise the half of a track that was split could get the id of a track that was removed.
    """
    topics = [f"{prefix}/{name}" for name in CORRECTED_FROM]
    written = [topic for topic in topics if topic in into.channels and into.channels[topic].holds(TRACKS)]
    used = [
        int(unique_values(TRACKS, into.frame_columns(topic, TRACKS), "track_id").max(initial=0)) for topic in written
    ]
    if labels.made_ids is None or not used:
        return labels
    first = max(*used, int(labels.id.max())) + 1
    is_made = np.isin(labels.id, labels.made_ids)
    new = first + np.searchsorted(labels.made_ids, labels.id)
    return replace(labels, id=np.where(is_made, new, labels.id), made_ids=first + np.arange(len(labels.made_ids)))


def warn_uncovered(into: log.Log, topic: str, placed: Placed) -> None:
    """Warn of pictures that were corrected before, and that new corrections don't cover: they take the place of all."""
    if topic not in into.channels or not into.channels[topic].holds(TRACKS) or not len(placed.t_ns):
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
            self._add(role, path)
        self.check_labels()
        if options.for_videos():
            raise McaptrackError(f"{self.source} is a label file; {options.for_videos()} is for videos")
        if options.frames is not None and not 0 < options.frames <= MAX_FRAMES:
            raise McaptrackError(f"`frames=` is a number from 1 to {MAX_FRAMES}, not {options.frames}")
        if "corrections" in self.labels and into is None:
            raise McaptrackError(f"{self.source}: corrections are of tracks in a log; name it with `into=`")
        self._fps: Fraction | None = None
        self._clock = ("", False)  # remark on times that don't come from pictures, and whether they are assumed
        self._other_rates: list[str] = []
        self._start_ns = options.start_ns or 0
        if into is not None:
            self.prefix, self.pictures = camera_of(into, options.camera)
        if into is not None and "corrections" in self.labels:
            path, labels = self.labels["corrections"]
            self.labels = {**self.labels, "corrections": (path, with_new_ids(into, self.prefix, labels))}
            self.frame_id = frame_of(into, self.pictures) if self.pictures else ""
        seen = detections_topic(into, self.prefix) if into is not None and not self.pictures else ""
        pictures_of = partial(picture_size, into, self.pictures) if into is not None and self.pictures else None
        self.fit_to_pictures(pictures_of)
        size = self._boxes_extent()
        if into is not None and (self.pictures or seen):
            self.timeline = self._of_pictures(into, self.pictures or seen)
            needs_size = self.ground_given.is_given or self.motions is not None
            size = pictures_of() if needs_size and pictures_of else size
        else:
            self.timeline = self._of_rate(default_fps)
        self._size = size
        is_stated = bool(into is not None and self.pictures)
        if not is_stated and options.size and options.calibration:
            size, is_stated = options.size, True
        self.ground = self.plane(*size, is_stated) or self._measured_plane()

    def _role_of(self, path: Path) -> Role:
        """The role of a file: tracks if its rows have ids. Detections keep boxes that tracks leave out."""
        try:
            return "tracks" if self.read(path, "tracks").has_ids else "detections"
        except McaptrackError:
            if self.read(path, "detections").has_ids:
                raise
            return "detections"

    def _add(self, role: Role | None, path: Path) -> None:
        if role is None:
            role = self._role_of(path)
        labels = self.read(path, role)
        if role in self.labels:
            raise McaptrackError(
                f"{path} and {self.labels[role][0]} are both {role}; give the role of {path} with `role=`"
            )
        self.labels = {role: (path, labels), **self.labels}

    def _boxes_extent(self) -> tuple[int, int]:
        """The image size that contains all boxes, (width, height) in pixels."""
        corners = [labels.corner_px() for _, labels in self.labels.values() if labels.has_boxes]
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
        for value, name in ((options.start_ns, "`start_time=`"), (options.frames, "`frames=`")):
            if value is not None:
                raise McaptrackError(f"{into.path}: labels take the times of {timeline.of}; leave {name} out")
        return timeline

    def _of_rate(self, default: Fraction | None) -> Timeline:
        """The times of missing pictures, by the frame rate from the options, the files or the log."""
        existing = labels_of(self.into, self.prefix) if self.into else {}
        timed = {path: labels.times_s for path, labels in self.labels.values() if labels.times_s is not None}
        if timed and self.options.frames is not None:
            raise McaptrackError(f"{next(iter(timed))} has times; leave `frames=` out")
        if timed:
            return self._of_times(timed)
        counted = [_known(path, labels) for path, labels in self.labels.values()]
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
        first = next(iter(self.labels.values()))[1].first_frame
        self._clock = (
            f"{self.source}: {count} frames (by {counted_by}) from {first} on, {float(fps):g} a second (by {of})",
            of in (*_BY_FORMAT.values(), _ASSUMED),
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
        counts = [count_frames(path, labels) for path, labels in self.labels.values()]
        return max(*counts, *(label.frames for label in existing.values()), 1), "the last label"

    def _check_overlap(self, into: log.Log, timeline: Timeline) -> None:
        """Check that labels without pictures overlap in time with the log."""
        first, last = int(timeline.t_ns[0]), int(timeline.t_ns[-1])
        if first > into.end_ns or last < into.start_ns:
            raise McaptrackError(
                f"{into.path} is from {_seconds(into.start_ns)} to {_seconds(into.end_ns)}, the labels would be "
                f"from {_seconds(first)} to {_seconds(last)}, and {self.prefix} has no pictures to take times from; "
                f"say when frame {next(iter(self.labels.values()))[1].first_frame} was with `start_time=`"
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
            path, labels = self.labels["corrections"]
            placed = self.timeline.place(path, labels, []).between(int(labels.labelled[0]), int(labels.labelled[-1]))
            warn_uncovered(self.into, f"{self.prefix}/{CORRECTED}", placed)
        self.write_labels(writer, self.ground, self.timeline)
        self.write_motion(writer, self.timeline, self._size)

    def label_parameters(self, role: Role, labels: Labels) -> dict[str, Any]:
        """The frame rate, if there were no pictures."""
        return super().label_parameters(role, labels) | ({} if self._fps is None else {"fps": str(self._fps)})

    def all_frames(self, role: Role) -> list[Frame]:
        """The labels of a role as frames, including empty frames."""
        path, labels = self.labels[role]
        return list(self.frames(role, self.ground, self.timeline.place(path, labels, self.report.lost))())


def _seconds(t_ns: int) -> str:
    return f"{t_ns / NS_PER_S:.3f} s"


def _known(path: Path, labels: Labels) -> _Known:
    """Frame rate and number of frames by the format of a label file, or by seqinfo.ini."""
    if labels.format == "sdd":
        return _Known(_SDD_FPS, None, _BY_FORMAT[labels.format])
    if labels.format in ("trajnet", "obsmat"):  # annotated at 2.5 Hz, whatever the video's rate
        return _Known(labels.step / _LABEL_STEP_S, None, _BY_FORMAT[labels.format])
    info = find_seqinfo(path.parent)
    return _Known(info.fps, info.frames, SEQINFO) if info else _Known(None, None, "")


def label_frames(
    files: Mapping[Role, Path],
    fps: Fraction | None,
    ground_plane: Path | None,
    point: Point,
    label_format: Format = "auto",
    classes: WantedClasses | None = None,
) -> dict[Role, list[Frame]]:
    """Read label files with a common clock as frames, without writing a log.

    Raises McaptrackError as ``ingest`` does. For comparisons only the order and intervals of times matter, so files
    without a frame rate get one frame per second unless ``fps`` is given.
    """
    options = IngestOptions(fps=fps, ground_plane=ground_plane, point=point, label_format=label_format, classes=classes)
    job = LabelJob([(role, path) for role, path in files.items()], options, default_fps=Fraction(1))
    job.report_assumptions()
    return {role: job.all_frames(role) for role in files}
