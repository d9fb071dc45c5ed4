"""Make logs of videos, folders of images, recordings and label files."""

from __future__ import annotations

import re
from array import array
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack import foxglove, log, notices
from mcaptrack.contracts import ReadingNotes, RecordedChannel, RecordedMessage, RecordingReader
from mcaptrack.errors import McaptrackError
from mcaptrack.files import is_same_file, missing, refuse_special
from mcaptrack.geometry.clocks import LAST_NS
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import Progress, warn
from mcaptrack.schema import DETECTIONS
from mcaptrack.schema.encodings import CDR
from mcaptrack.schema.provenance import CLOCK, Provenance
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import camera_at
from mcaptrack.sources.foreign.decoding import decoder_with_errors, frame_named
from mcaptrack.sources.foreign.definitions import MessageType
from mcaptrack.sources.foreign.flatten import frame_of
from mcaptrack.sources.ingest.calibration import is_calibration
from mcaptrack.sources.ingest.job import (
    CALIBRATION,
    FOR_VIDEOS,
    MOTION,
    IngestJob,
    IngestOptions,
    IngestReport,
)
from mcaptrack.sources.ingest.label_job import Boxes3DJob, LabelJob, label_frames
from mcaptrack.sources.ingest.labels.of_packages import FormatOfPackage, format_named
from mcaptrack.sources.ingest.labels.reading import known_format, label_file
from mcaptrack.sources.ingest.labels.timeline import (
    Timeline,
    boxes_extent,
    camera_of,
    choose_camera,
    labels_of,
    picture_predicate,
    picture_size,
    timeline_of,
)
from mcaptrack.sources.ingest.recording import compare_counts, open_recording
from mcaptrack.sources.pictures import size_of
from mcaptrack.sources.sidecar import encoding_for
from mcaptrack.sources.video import IMAGE_SUFFIXES, EncodedPicture, Video, open_video

__all__ = ["IngestOptions", "IngestReport", "ingest", "label_frames"]

VIDEO_SUFFIXES: Final = (
    ".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".ts", ".h264", ".264", ".mpg", ".mpeg", ".h265", ".265", ".hevc",
    ".ivf", ".obu", ".y4m", ".mjpeg", ".mjpg",
)  # fmt: skip
#: Files with these endings hold text, whatever their first bytes are.
_TEXT_SUFFIXES: Final = (".csv", ".tsv", ".txt", ".json", ".jsonl", ".ndjson", ".xml")


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
        self.video: Video = open_video(source, options)
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
        options, video = self.options, self.video
        start_ns = video.start_ns if options.start_ns is None else options.start_ns
        start_ns = 0 if start_ns is None else start_ns
        schema_name = foxglove.IMAGE if options.is_still else foxglove.VIDEO
        parameters: dict[str, str | int | float] = {"file": video.path.name, "image_format": video.format}
        if options.fps is not None:
            parameters["fps"] = str(options.fps)
            own = video.fps
            if own and abs(options.fps - own) > _SAME_FPS * own:
                rates = f"{float(own):g} frames a second; its pictures are written at {float(options.fps):g}"
                warn(f"{video.path} has {rates} by `fps=`", "clock")
        if options.stream is not None:
            parameters["stream"] = options.stream
        if video.every > 1:
            parameters["every"] = video.every
        if video.why_transcode:
            parameters |= {"encoded_again_because": video.why_transcode}
            parameters |= {"crf": options.crf, "keyframe_interval_s": options.key_every_s}
            self.report.remarks.append(f"{video.path} is encoded again, as H.264 for viewers: {video.why_transcode}")
        elif video.format in _FOXGLOVE_ALONE:
            kept = f"{video.path} is kept as {_FOXGLOVE_ALONE[video.format]}, which Foxglove plays"
            self.report.remarks.append(f"{kept} and Lichtblick does not (`image_format='h264'` is for both)")
        elif video.format == "jpeg":
            parameters["quality"] = options.jpeg_quality
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
    if options.label_format != "auto":
        format_named(options.label_format)  # refused before anything is read
    if not re.fullmatch(r"[A-Za-z0-9_\-/]+", options.camera) or options.camera.strip("/") == "":
        raise McaptrackError(f"a camera's name is made of letters, digits, _, - and /, not {options.camera!r}")
    if not source.exists():
        raise McaptrackError(missing(source))
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
        job.report.uses_camera = bool(job.has_labels or job.has_ground_given or job.options.motion) or isinstance(
            job, VideoJob
        )
    for lost in job.report.lost:
        warn(f"lost: {lost}", "lost")
    _warn_unused(job, options)
    return job.report


def _warn_unused(job: IngestJob, options: IngestOptions) -> None:
    """Warn of options that were given and change nothing."""
    is_calibrated = bool(options.calibration) or any(topic.endswith(f"/{CALIBRATION}") for topic in job.report.messages)
    is_sized = bool(job.options.calibration) and not job.pictures
    uses: dict[str, tuple[object, *tuple[str, ...]]] = {
        "there is no label file": (job.has_labels, "label_format", "columns", "frame_ranges", "class_map", "scene"),
        "no label file has boxes in pictures": (
            is_sized or any(labels.boxes_px is not None for labels in job.labels.values()), "size",
        ),
        "there are no tracks and no ground truth": (job.roles - {"detections"}, "classes"),
        "there are no 3D boxes": (isinstance(job, Boxes3DJob), "frame_id"),
        "the input is a folder of images": (not isinstance(job, VideoJob) or not job.video.images, "stream"),
        "there is no ground plane": (options.ground_plane or is_calibrated, "point"),
        "there is no calibration": (is_calibrated, "calibration_name", "calibration_unit"),
        "the channels of a recording keep their names": (job.report.uses_camera, "camera"),
    }  # fmt: skip
    for reason, (is_used, *names) in uses.items():
        for name in () if is_used else names:
            if given := options.given(name):
                warn(f"{given} changes nothing here: {reason}", "option-not-used")


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


# Ingest recordings: a log with all of their messages, schemas and times unchanged.


#: A larger message would need a chunk that readers with a size limit refuse.
_MAX_MESSAGE_BYTES: Final = 2**28 - 2**24
_PROGRESS_EVERY: Final = 256


class RecordingJob(IngestJob):
    """A recording, with labels for its pictures."""

    def __init__(
        self, source: Path, options: IngestOptions, recorded: RecordingReader, progress: Progress, into: log.Log | None
    ) -> None:
        self._recorded, self._progress = recorded, progress
        try:
            if name := options.given("fps", "start_ns", *FOR_VIDEOS, "role", "frames"):
                raise McaptrackError(
                    f"{source} is a log: its messages stay as they are, and so do their times; leave {name} out"
                )
            super().__init__(source, options, into)
            #: The MCAP file that is copied as a whole, if the recording is one.
            self._copied_log: log.Log | None = None
            #: The channels of the pictures that labels belong to.
            self._picture_channels: list[RecordedChannel] = []
            self._channels: dict[RecordedChannel, int] = {}
            self._written: dict[int, int] = {}
            if self.labels or self.has_ground_given or self.motions is not None:
                self._find_pictures()
                self.fit_to_pictures(self._picture_size)
        except BaseException:
            recorded.close()
            raise
        self._close.callback(recorded.close)

    def _find_pictures(self) -> None:
        """Find the camera that labels belong to: the only one with pictures, or the one that ``camera`` names."""
        by_topic: dict[str, list[RecordedChannel]] = {}
        for channel in self._recorded.channels:
            is_empty = self._recorded.declared_counts is not None and not self._recorded.declared_counts.get(channel)
            if foreign.is_picture(channel.schema[0]) and not is_empty:
                by_topic.setdefault(channel.topic, []).append(channel)
        self.prefix, self.pictures = choose_camera(self.source, self.options.camera, by_topic)
        if not self.pictures:
            raise McaptrackError(
                f"{self.source}: labels and ground planes belong to the pictures of one camera; the log has "
                f"{', '.join(sorted(by_topic)) or 'none'}. Choose one with `camera=`, the part of its topic before the "
                "last /"
            )
        self._picture_channels = by_topic[self.pictures]

    def topics(self) -> Iterator[str]:
        """The new topics: only those of labels, if an MCAP file is copied."""
        if not self._copied_log:
            yield from {channel.topic: None for channel in self._recorded.channels}
        yield from super().topics()

    def opened(self, output: Path, into: log.Log | None, force: bool) -> AbstractContextManager[log.LogWriter]:
        """As in the base class; an MCAP file that becomes a new log is copied as a whole."""
        if into is not None:
            itself = self._recorded.as_log
            if itself is not None and itself.real_path == into.real_path:
                raise McaptrackError(f"{self.source} can't be added to itself")
            self._warn_encodings(into)
            return log.extend(into, drop=self.topics_to_replace(into, force))
        self._copied_log = self._recorded.as_log
        if self._copied_log is not None:
            self.encoding = encoding_for(self._copied_log)
            return log.extend(self._copied_log, output, drop=self.topics_to_replace(self._copied_log, force))
        recorded = {channel.topic for channel in self._recorded.channels}
        doubled = recorded & set(super().topics())
        if doubled:
            raise McaptrackError(
                f"{self.source} has {', '.join(sorted(doubled))} already; {super().hint_other_topic(recorded)}"
            )
        return log.create(output, self._recorded.profile)

    def _warn_encodings(self, into: log.Log) -> None:
        """Warn if a recording of ROS 2 gets messages that ROS 2 can't read."""
        odd = sorted({channel.encoding or "none" for channel in self._recorded.channels} - {CDR})
        if self.encoding == CDR and odd:
            text = f"{into.path} gets messages that are not of ROS 2 (encoding: {', '.join(odd)})"
            warn(f"{text}; ROS tools may stumble over them", "other")

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write everything in the recording, then the labels."""
        self.report.notes += self._recorded.findings.notes
        self.report.lost += self._recorded.findings.lost
        timeline = self._count_copied(writer) if self._copied_log else self._write_messages(writer)
        self._recorded.extras(writer, has_clock, self._copied_log is not None)
        if self._picture_channels:
            if not len(timeline.t_ns):
                raise McaptrackError(f"{self.source}: {self.pictures} has no pictures that labels could be of")
            plane = self._plane()
            self.write_plane(writer, plane, int(timeline.t_ns[0]))
            self.write_labels(writer, plane, timeline)
            if self.motions is not None:
                self.write_motion(writer, timeline, self._picture_size())

    def hint_other_topic(self, topics: Collection[str]) -> str:
        """A hint for topics that exist already."""
        return super().hint_other_topic(topics) if self._copied_log else "write it to a separate log with `output=`"

    def check(self, output: Path) -> None:
        """Check that every channel has all of its messages."""
        with log.read(output) as done:
            index = done.parts[-1].index
            for number, count in self._written.items():
                written = index.counts.get(number, 0)
                if written != count:
                    topic = index.channels[number].topic if number in index.channels else "a channel"
                    raise McaptrackError(
                        f"{output} is not complete: {written} messages of {topic} where {self.source} has {count}"
                    )

    # Messages

    def _count_copied(self, writer: log.LogWriter) -> Timeline:
        """Count the messages of the copied log; returns the pictures that labels belong to."""
        opened = self._copied_log
        assert opened is not None
        for number in writer.channels:
            self._written[number] = opened.index.counts.get(number, 0)
            if not self._written[number]:  # some writers write channels without messages only to the summary
                writer.write_description(number)
        self._report({number: channel.topic for number, channel in writer.channels.items()})
        if len(self._picture_channels) == 1:
            return timeline_of(opened, self.pictures)
        holds_picture = self._holds_picture()
        return self._timeline(m.t_ns for m in self._recorded.messages(ReadingNotes()) if holds_picture(m))

    def _timeline(self, t_ns: Iterable[int]) -> Timeline:
        in_order = sorted(t_ns)
        if in_order and in_order[-1] > LAST_NS:
            raise McaptrackError(
                f"{self.source}: {self.pictures} has pictures later than the year 2262, the last at {in_order[-1]} ns; "
                "labels can't be placed on such times"
            )
        times = np.array(in_order, np.int64)
        return Timeline(np.arange(len(times)), times, f"the pictures of {self.pictures}", not self.report.lost)

    def _holds_picture(self) -> Callable[[RecordedMessage], bool]:
        """A predicate: whether a message is one of the pictures that labels belong to."""
        kinds = {channel: picture_predicate(_type_of(channel)) for channel in self._picture_channels}
        return lambda message: message.channel in kinds and kinds[message.channel](message.payload)

    def _write_messages(self, writer: log.LogWriter) -> Timeline:
        """Write all channels and messages; returns the pictures that labels belong to."""
        reading_notes, done, times, holds_picture = ReadingNotes(), 0, array("Q"), self._holds_picture()
        for channel in self._recorded.channels:
            self._add_channel(writer, channel)
        total = sum((self._recorded.declared_counts or {}).values())
        for message in self._recorded.messages(reading_notes):
            channel, t_ns, payload, publish_ns, sequence = message
            number = self._channels[channel]
            if len(payload) > _MAX_MESSAGE_BYTES:
                raise McaptrackError(
                    f"{self.source}: {channel.topic} at {t_ns} ns: "
                    f"a message of {len(payload)} bytes; at most {_MAX_MESSAGE_BYTES} go into a log"
                )
            sequence = self._written[number] % 2**32 if sequence is None else sequence
            writer.add_message(number, t_ns, sequence, payload, t_ns if publish_ns is None else publish_ns)
            self._written[number] += 1
            if holds_picture(message):
                times.append(t_ns)
            done += 1
            if done % _PROGRESS_EVERY == 0:
                self._progress("ingest", done, max(total, done))
        self._progress("ingest", done, max(total, done))
        self.report.notes += reading_notes.notes
        self.report.lost += reading_notes.lost
        counts = {channel: self._written[number] for channel, number in self._channels.items()}
        compare_counts(self._recorded, self.source, counts, self.report.lost)
        self._report({number: channel.topic for channel, number in self._channels.items()})
        return self._timeline(times)

    def _add_channel(self, writer: log.LogWriter, channel: RecordedChannel) -> None:
        number = writer.add_channel(
            channel.topic,
            channel.schema,
            channel.encoding,
            channel.metadata,
            kind="media" if foreign.is_compressed(channel.schema[0]) else "rows",
            another=True,
        )
        self._channels[channel] = number
        self._written[number] = 0

    def _report(self, topics: dict[int, str]) -> None:
        counts: Counter[str] = Counter()
        for number, topic in topics.items():
            counts[topic] += self._written.get(number, 0)
        self.report.messages |= counts

    # Pictures

    def _plane(self) -> GroundPlane | None:
        if not self.has_ground_given:
            return None
        self.frame_id = self._picture_frame()
        return self.plane(*self._picture_size())

    def _picture_frame(self) -> str:
        """The frame of reference of the pictures that labels belong to, by the first of them; "" if it names none."""
        for message in self._recorded.messages(ReadingNotes()):
            if message.channel in self._picture_channels:
                return str(decoder_with_errors(_type_of(message.channel), frame_named)(message.payload))
        return ""

    def _picture_size(self) -> tuple[int, int]:
        """Width and height of the pictures that labels belong to."""
        size = size_of(self._encoded())
        if size is None:
            raise McaptrackError(f"{self.source}: {self.pictures} has no picture that can be decoded")
        return size

    def _encoded(self) -> Iterator[EncodedPicture]:
        """The pictures that labels belong to, lazily."""
        decoders = {channel: foreign.picture_decoder(_type_of(channel)) for channel in self._picture_channels}
        for index, message in enumerate(self._recorded.messages(ReadingNotes())):
            if message.channel in decoders:
                where = f"{self.source}: {self.pictures} at {message.t_ns} ns"
                yield decoders[message.channel](message.payload).encoded(message.t_ns, index, where)


def _type_of(channel: RecordedChannel) -> MessageType:
    return MessageType(*channel.schema, channel.encoding)


def _job(source: Path, options: IngestOptions, progress: Progress, into: log.Log | None) -> IngestJob:
    is_packed_text = Path(source.stem).suffix.lower() in _TEXT_SUFFIXES  # labels.csv.zst begins as logs may
    recorded = None if is_packed_text and source.is_file() else open_recording(source)
    if recorded is not None:
        return RecordingJob(source, options, recorded, progress, into)
    role = options.role
    if role == "calibration" or (role is None and is_calibration(source)):
        return CalibrationJob(source, options, into)
    file, columns = label_file(source, options.label_format), options.columns or {}
    if role == MOTION:
        is_text = not (file.is_folder or _is_video(source) or _is_binary(source))
        return MotionJob(source, options, into) if is_text else VideoJob(source, options, progress, into)
    form = known_format(file, options.label_format, columns)
    if form is not None and form.holds_3d(file, columns):
        return Boxes3DJob([(role, source)], options, into)
    is_foreign = isinstance(form, FormatOfPackage) and not file.is_folder  # bytes may be labels, as its format has it
    is_labels = form is not None and (is_foreign or form.recognises(file))
    is_of_pictures = file.holds_pictures and not role and options.label_format == "auto"
    if (is_labels and not is_of_pictures and not _is_video(source)) or (file.is_folder and role):
        return LabelJob([(role, source)], options, into)
    file.refuse_binary()
    if file.is_folder and not file.holds_pictures:
        raise file.unknown()
    if file.is_folder or _is_video(source) or _is_binary(source):
        return VideoJob(source, options, progress, into)
    return LabelJob([(role, source)], options, into)


def _is_video(source: Path) -> bool:
    return source.suffix.lower() in VIDEO_SUFFIXES


def _is_binary(source: Path) -> bool:
    with source.open("rb") as stream:
        head = stream.read(4096)
    if head[8:12] == b"WEBP" and b"ANIM" in head[:64]:
        raise McaptrackError(f"{source} is an animated WebP, which is not read; convert it to a video")
    if source.suffix.lower() in IMAGE_SUFFIXES:
        raise McaptrackError(f"{source} is a single image; give the folder that the images lie in")
    if head.startswith(b"#EXTM3U"):
        raise McaptrackError(f"{source} is a playlist; give a video file of all its parts")
    if head.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        return False
    return b"\0" in head and source.suffix.lower() not in _TEXT_SUFFIXES
