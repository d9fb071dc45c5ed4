"""Make logs of videos, folders of images, recordings and label files."""

from __future__ import annotations

import re
from array import array
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack import foxglove, log, notices
from mcaptrack.errors import McaptrackError
from mcaptrack.files import is_same_file, refuse_special
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS
from mcaptrack.schema.provenance import CLOCK, Provenance
from mcaptrack.sources.calibrations import frame_of
from mcaptrack.sources.cameras import camera_at
from mcaptrack.sources.ingest.bags.rosbag2 import open_recording
from mcaptrack.sources.ingest.calibration import is_calibration
from mcaptrack.sources.ingest.job import MOTION, IngestJob, IngestOptions, IngestReport, Progress
from mcaptrack.sources.ingest.label_job import Boxes3DJob, LabelJob, label_frames
from mcaptrack.sources.ingest.labels.content import OTHERS, Format
from mcaptrack.sources.ingest.labels.cvat import is_cvat
from mcaptrack.sources.ingest.labels.reading import is_3d
from mcaptrack.sources.ingest.labels.timeline import (
    Timeline,
    boxes_extent,
    camera_of,
    labels_of,
    picture_size,
    timeline_of,
)
from mcaptrack.sources.ingest.labels.yolo import is_label_folder
from mcaptrack.sources.ingest.recording_job import RecordingJob
from mcaptrack.sources.video import IMAGE_SUFFIXES, Video, open_video

__all__ = ["Format", "IngestOptions", "IngestReport", "ingest", "label_frames"]

VIDEO_SUFFIXES: Final = (
    ".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".ts", ".h264", ".264", ".mpg", ".mpeg", ".h265", ".265", ".hevc",
    ".ivf", ".obu",
)  # fmt: skip
#: Files with these endings hold text, whatever their first bytes are.
_TEXT_SUFFIXES: Final = (".csv", ".tsv", ".txt", ".json", ".xml")


# Ingest a video or a folder of images as a camera, with labels for its pictures.


_FOXGLOVE_ALONE: Final = {"vp9": "VP9", "av1": "AV1"}
#: Frame rates with a smaller relative difference are equal: 29.97 and 30000/1001.
_SAME_FPS: Final = Fraction(1, 1000)


class VideoJob(IngestJob):
    """A video or image folder, with its labels."""

    drops_clock = True
    other_camera = "{camera}2"

    def __init__(self, source: Path, options: IngestOptions, progress: Progress, into: log.Log | None) -> None:
        super().__init__(source, options, into)
        self._progress = progress
        if options.role:
            raise McaptrackError(f"{source} is not a label file; `role=` applies to those")
        if options.frames is not None:
            raise McaptrackError(f"{source} is not a label file; `frames=` applies to labels without pictures")
        self.video: Video = open_video(source, options.video_options)
        if self.video.images and not (options.fps or self.video.fps):
            raise McaptrackError(f"{source}: a folder of images has no clock; give the frames per second with `fps=`")
        self.fit_to_pictures(lambda: (self.video.width_px, self.video.height_px))
        self._plane = self.plane(self.video.width_px, self.video.height_px)
        self.pictures = f"{self.prefix}/video"
        self._existing_labels = {} if into is None else labels_of(into, self.prefix)

    def topics(self) -> Iterator[str]:
        """The topics of pictures and labels."""
        yield self.pictures
        yield from super().topics()

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write the pictures, then the labels at the times of their pictures."""
        options, video, keep = self.options, self.video, self.options.video_options
        start_ns = video.start_ns if options.start_ns is None else options.start_ns
        start_ns = 0 if start_ns is None else start_ns
        schema_name = foxglove.IMAGE if keep.is_still else foxglove.VIDEO
        parameters: dict[str, str | int | float] = {"file": video.path.name, "image_format": video.format}
        if options.fps is not None:
            parameters["fps"] = str(options.fps)
            own = video.fps
            if own and abs(options.fps - own) > _SAME_FPS * own:
                rates = f"{float(own):g} frames a second; its pictures are written at {float(options.fps):g}"
                warn(f"{video.path} has {rates} by `fps=`", "clock")
        if video.every > 1:
            parameters["every"] = video.every
        if video.why_transcode:
            parameters |= {"encoded_again_because": video.why_transcode}
            parameters |= {"crf": keep.crf, "keyframe_interval_s": keep.key_every_s}
            self.report.remarks.append(f"{video.path} is encoded again, as H.264: {video.why_transcode}")
        elif video.format in _FOXGLOVE_ALONE:
            kept = f"{video.path} is kept as {_FOXGLOVE_ALONE[video.format]}, which Foxglove plays"
            self.report.remarks.append(f"{kept} and Lichtblick does not (`image_format='h264'` is for both)")
        elif video.format == "jpeg":
            parameters["quality"] = keep.jpeg_quality
        channel = writer.add_channel(
            self.pictures,
            foxglove.record_in(schema_name, self.encoding),
            self.encoding,
            Provenance("ingest", parameters).to_metadata(),
            kind="media",
        )
        writer.add_metadata(CLOCK, {"start_ns": str(start_ns)})
        times, numbers = array("q"), array("q")
        frame_id = self.prefix.lstrip("/")
        packed = (
            (
                picture.t_ns,
                picture.index,
                foxglove.pack_picture(schema_name, picture.t_ns, frame_id, video.format, picture.data),
            )
            for picture in video.pictures(start_ns)
        )
        for t_ns, index, data in foxglove.messages_in(schema_name, packed, self.encoding):
            writer.add_message(channel, t_ns, index, data)
            times.append(t_ns)
            numbers.append(index)
            self._progress("ingest", len(times), max(video.frames, len(times)))
        if not times:
            raise McaptrackError(f"{video.path} is a video without frames")
        self.report.messages[self.pictures] = len(times)
        self.report.remarks += video.notes
        self.report.lost += video.lost
        of = f"the pictures of {video.path}"
        timeline = Timeline(np.array(numbers), np.array(times), of, not video.lost, video.every)
        self._check_existing(timeline)
        self.write_plane(writer, self._plane, times[0])
        self.write_labels(writer, self._plane, timeline)
        self.write_motion(writer, timeline, (self.video.width_px, self.video.height_px))

    def _check_existing(self, timeline: Timeline) -> None:
        """Check that existing labels in the log have the times of these pictures."""
        for topic, labels in self._existing_labels.items():
            if self.into and topic not in self.topics() and not np.isin(labels.t_ns, timeline.t_ns).all():
                advice = (
                    f"give `fps={str(labels.fps)!r}`"
                    if labels.fps
                    else "give the `fps=` and `start_time=` that they have"
                )
                raise McaptrackError(
                    f"{self.into.path}: {topic} has labels at other times than {timeline.of}; {advice}, or `camera=` "
                    "for another camera"
                )


def ingest(
    source: Path,
    output: Path,
    options: IngestOptions,
    *,
    into: log.Log | None = None,
    force: bool = False,
    progress: Progress = lambda *_: None,
) -> IngestReport:
    """Make a log of a video, image folder, recording or label file, or add its channels to a log.

    Parameters
    ----------
    source : Path
        The input; its format is detected.
    output : Path
        The log to write; the path of ``into``, if that is given.
    options : IngestOptions
        How to make the log, and label files beside the input.
    into : Log, optional
        An existing log to which the channels are added.
    force : bool
        Replace channels that the log has already.
    progress : callable, optional
        Called with "ingest", the number of messages written, and their total.

    Returns
    -------
    IngestReport
        Messages by topic, warnings, and what could not be read.

    Raises
    ------
    McaptrackError
        If a part of the input can't be understood; then nothing is written.
    """
    if not re.fullmatch(r"[A-Za-z0-9_\-/]+", options.camera) or options.camera.strip("/") == "":
        raise McaptrackError(f"a camera's name is made of letters, digits, _, - and /, not {options.camera!r}")
    if not source.exists():
        raise McaptrackError(f"{source} does not exist")
    refuse_special(source)
    if into is None and is_same_file(output, source):
        raise McaptrackError(f"{source} is both input and output; give another name with `output=`")
    with notices.collected() as warned, _job(source, options, progress, into) as job:
        if options.first_frame is not None and not job.has_labels:
            raise McaptrackError(f"{source}: `first_frame=` is about label files, and none is given")
        job.report_assumptions()
        with job.opened(output, into, force) as writer:
            job.write(writer, has_clock=bool(into and into.metadata(CLOCK)))
        job.check(output)
        job.report.warnings, job.report.has_labels = warned, job.has_labels
        job.report.uses_classes = bool(job.roles - {"detections"})
        job.report.holds_boxes_3d = isinstance(job, Boxes3DJob)
        is_sized = bool(job.options.calibration) and not job.pictures
        job.report.uses_size = is_sized or any(labels.format in OTHERS for labels in job.labels.values())
        job.report.uses_camera = bool(job.has_labels or job.has_ground_given or job.options.motion) or isinstance(
            job, VideoJob
        )
    return job.report


# Ingest the motion of a camera alone, for the pictures or the detections of an existing log.


_BOXES: Final = "detections"


class MotionJob(IngestJob):
    """The motion of the camera of a log: a file that is itself the input."""

    def __init__(self, source: Path, options: IngestOptions, into: log.Log | None) -> None:
        if options.motion is not None:
            raise McaptrackError(f"{source} and {options.motion} are both the motion of the camera; give one")
        if into is None:
            raise McaptrackError(
                f"{source}: the motion of a camera belongs to a log with its pictures or boxes; name it with `into=`"
            )
        if options.calibration:
            raise McaptrackError(f"{source} is the motion of a camera; its calibration is added in a call of its own")
        super().__init__(source, replace(options, motion=source), into)
        self.prefix, self.pictures = camera_of(into, options.camera)
        boxes = into.channels.get(f"{self.prefix}/{_BOXES}")
        if self.pictures:
            self._timeline, self._size = timeline_of(into, self.pictures), picture_size(into, self.pictures)
        elif boxes is not None and boxes.messages and boxes.schema_name == DETECTIONS.name:
            self._timeline = timeline_of(into, boxes.topic)
            self._size = boxes_extent(into, boxes.topic)
        else:
            raise McaptrackError(f"{into.path}: {self.prefix} has no pictures or detections that {source} is about")

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write the motion."""
        self.write_motion(writer, self._timeline, self._size)


# Ingest the calibration of a camera alone, for the pictures or the boxes of an existing log.


class CalibrationJob(IngestJob):
    """The calibration of a camera of a log: a file that is itself the input, and those that were given beside it."""

    def __init__(self, source: Path, options: IngestOptions, into: log.Log | None) -> None:
        if into is None:
            raise McaptrackError(
                f"{source}: a calibration belongs to a log with pictures or boxes of the camera; name it with `into=`, "
                "or give the calibration with `calibration=` while the log is made"
            )
        if options.labels or options.motion is not None:
            raise McaptrackError(
                f"{source} is a calibration; add labels and motions of the camera in a call of their own"
            )
        super().__init__(source, replace(options, calibration=(source, *options.calibration)), into)
        self.prefix, self.pictures = camera_of(into, options.camera)
        below = [topic for topic in into.channels if topic.startswith(f"{self.prefix}/")]
        if not below:
            names = sorted({topic.strip("/").partition("/")[0] for topic in into.channels})
            raise McaptrackError(
                f"{into.path} has no camera {self.prefix[1:]} that {source} could be of (`camera=`); its topics begin "
                f"with {', '.join(names) or 'nothing'}"
            )
        # In the frame of what the camera recorded, as the transforms name it, the calibration replaces a recorded one.
        recorded = self.pictures or camera_at(into, self.prefix).boxes
        self.frame_id = frame_of(into, recorded) if recorded else ""
        size = picture_size(into, self.pictures) if self.pictures else options.size
        extent = size or boxes_extent(into, f"{self.prefix}/detections")
        self._plane = self.plane(*extent, is_stated=size is not None)
        self._t_ns = int(into.times(self.pictures)[0]) if self.pictures else into.start_ns

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write the calibration, and the ground plane that follows from it."""
        self.write_plane(writer, self._plane, self._t_ns)


def _job(source: Path, options: IngestOptions, progress: Progress, into: log.Log | None) -> IngestJob:
    recorded = open_recording(source)
    if recorded is not None:
        return RecordingJob(source, options, recorded, progress, into)
    role = options.role
    if role == "calibration" or (role is None and is_calibration(source)):
        return CalibrationJob(source, options, into)
    if role != MOTION and is_3d(source, options.label_format, options.columns):
        return Boxes3DJob([(role, source)], options, into)
    if source.is_dir() and role != MOTION and (role or is_label_folder(source)):
        return LabelJob([(role, source)], options, into)
    is_zip = role != MOTION and source.suffix.lower() == ".zip" and is_cvat(source)
    is_video = source.is_dir() or source.suffix.lower() in VIDEO_SUFFIXES or (not is_zip and _is_binary(source))
    if is_video:
        return VideoJob(source, options, progress, into)
    if role == MOTION:
        return MotionJob(source, options, into)
    return LabelJob([(role, source)], options, into)


def _is_binary(source: Path) -> bool:
    if source.suffix.lower() in IMAGE_SUFFIXES:
        raise McaptrackError(f"{source} is a single image; give the folder that the images lie in")
    with source.open("rb") as stream:
        head = stream.read(4096)
    if head.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        raise McaptrackError(f"{source} is text in UTF-16; save it as UTF-8, in which labels are read")
    return b"\0" in head and source.suffix.lower() not in _TEXT_SUFFIXES
