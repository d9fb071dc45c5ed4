"""Whatever exists becomes a log: a video, a folder of images, label files beside them or alone.

Letters: N rows.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack import foxglove, log
from mcaptrack.clock import NS_PER_S
from mcaptrack.errors import McaptrackError
from mcaptrack.ingest.labels import Format, Labels, Role, read_homography, read_labels
from mcaptrack.plane import GroundPlane, Point
from mcaptrack.provenance import CLOCK, Provenance, digest
from mcaptrack.schema import DETECTIONS, GROUND_PLANE, TRACKS, Frame, Rows, Schema
from mcaptrack.schema.ground import plane_to_rows
from mcaptrack.video import IMAGE_SUFFIXES, ImageFormat, Video, open_video, seqinfo_fps

__all__ = ["Format", "ImageFormat", "IngestOptions", "Report", "Role", "ingest", "label_frames"]

Ints = NDArray[np.int64]
Progress = Callable[[str, int, int], None]

VIDEO_SUFFIXES: Final = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".ts", ".h264", ".264", ".mpg", ".mpeg")
#: The step of labels in formats that are annotated on the clock of prediction.
_LABEL_STEP_S: Final = Fraction(2, 5)
_SDD_FPS: Final = Fraction(30)
_SCHEMA_OF: Final[Mapping[Role, Schema]] = {"detections": DETECTIONS, "tracks": TRACKS, "truth": TRACKS}


@dataclass(frozen=True, kw_only=True)
class IngestOptions:
    """How to make a log. ``labels`` maps what a label file says to the file; ``role`` is for an input that is one."""

    camera: str = "camera"
    fps: Fraction | None = None
    start_ns: int | None = None
    image_format: ImageFormat = "h264"
    ground_plane: Path | None = None
    point: Point = "foot"
    labels: Mapping[Role, Path] = field(default_factory=dict)
    label_format: Format = "auto"
    role: Role | None = None


@dataclass
class Report:
    """What became of an input: messages by topic, words worth saying, and what was lost."""

    messages: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


def ingest(
    source: Path,
    output: Path,
    options: IngestOptions,
    *,
    into: log.Log | None = None,
    force: bool = False,
    progress: Progress = lambda *_: None,
) -> Report:
    """Make the log ``output`` from ``source``, or add its channels to the log ``into``, which then is the output.

    Raises McaptrackError, and writes nothing, if anything of the input can't be understood.
    """
    if not re.fullmatch(r"[A-Za-z0-9_\-/]+", options.camera) or options.camera.strip("/") == "":
        raise McaptrackError(f"a camera's name is made of letters, digits, _, - and /, not {options.camera!r}")
    if not source.exists():
        raise McaptrackError(f"{source} does not exist")
    if into is None and output.exists() and source.exists() and output.samefile(source):
        raise McaptrackError(f"{source} is both input and output; give another name with -o")
    is_video = source.is_dir() or source.suffix.lower() in VIDEO_SUFFIXES or _is_binary(source)
    job = _VideoJob(source, options, progress) if is_video else _LabelJob(source, options)
    topics = set(job.topics())
    taken = topics & set(into.channels) if into else set()
    if taken and not force:
        raise McaptrackError(f"{output} has {', '.join(sorted(taken))} already; --force replaces them")
    opened = log.extend(into, drop=taken, drop_metadata=[CLOCK] if is_video else []) if into else log.create(output)
    with opened as writer:
        job.write(writer, has_clock=bool(into and not is_video and into.metadata(CLOCK)))
    return job.report


def _is_binary(source: Path) -> bool:
    if source.suffix.lower() in (".mcap", ".bag", ".db3"):
        raise McaptrackError(
            f"{source} is a log, not a video, image folder or label file; run stages on a log directly"
        )
    if source.suffix.lower() in IMAGE_SUFFIXES:
        raise McaptrackError(f"{source} is a single image; give the folder that the images lie in")
    with source.open("rb") as stream:
        return b"\0" in stream.read(4096)


class _Job:
    """What videos and labels have in common: the topics of a camera, its ground plane, rows to messages."""

    def __init__(self, source: Path, options: IngestOptions) -> None:
        self.source, self.options, self.report = source, options, Report()
        self.prefix = "/" + options.camera.strip("/")
        self.homography = read_homography(options.ground_plane) if options.ground_plane else None
        self.labels: dict[Role, tuple[Path, Labels]] = {
            role: (path, read_labels(path, options.label_format, role)) for role, path in options.labels.items()
        }
        self.check_labels()

    def check_labels(self) -> None:
        for role, (path, labels) in self.labels.items():
            if role == "detections" and labels.boxes_px is None:
                raise McaptrackError(f"{path} holds positions, not boxes; detections are boxes")
            if role != "detections" and not labels.identified:
                raise McaptrackError(f"{path} says of nobody who it is (all ids are -1); {role} need ids")
            if labels.left_out:
                self.report.notes.append(f"{path} also holds {labels.left_out}; they are left out")

    def topics(self) -> Iterator[str]:
        yield from (f"{self.prefix}/{role}" for role in self.labels)
        if self.homography:
            yield f"{self.prefix}/ground_plane"

    def plane(self, width_px: int, height_px: int) -> GroundPlane | None:
        if self.homography is None:
            return None
        try:
            return GroundPlane(self.homography, width_px, height_px, self.options.point)
        except McaptrackError as error:
            raise McaptrackError(f"{self.options.ground_plane}: {error}") from None

    def write_plane(self, writer: log.LogWriter, plane: GroundPlane | None, t_ns: int) -> None:
        if plane is not None and self.options.ground_plane:
            rows = plane_to_rows(plane)
            words = {"file": self.options.ground_plane.name, "point": self.options.point}
            self.write_rows(writer, "ground_plane", GROUND_PLANE, [Frame(t_ns, 0, rows)], words)

    def write_labels(
        self, writer: log.LogWriter, plane: GroundPlane | None, times: dict[Role, tuple[Ints, Ints]]
    ) -> None:
        """``times`` gives for each label file its frames (in the file's numbers) and their times."""
        for role, (path, labels) in self.labels.items():
            numbers, t_ns = times[role]
            frames = self.frames(role, plane, numbers, t_ns)
            words = {"file": path.name, "format": labels.format}
            self.write_rows(writer, role, _SCHEMA_OF[role], frames, words)

    def frames(self, role: Role, plane: GroundPlane | None, numbers: Ints, t_ns: Ints) -> list[Frame]:
        """The labels of the frames with these ``numbers`` in the file, at these times; empty ones too."""
        labels = self.labels[role][1]
        rows = _label_rows(labels, role, plane)
        first, last = (np.searchsorted(labels.frame, numbers, side) for side in ("left", "right"))
        columns = (t_ns, self.frame_index(labels, numbers), first, last)
        spans = zip(*(column.tolist() for column in columns), strict=True)
        return [Frame(time, index, rows[low:high]) for time, index, low, high in spans]

    def frame_index(self, labels: Labels, numbers: Ints) -> Ints:
        return numbers

    def write_rows(
        self, writer: log.LogWriter, suffix: str, schema: Schema, frames: list[Frame], words: Mapping[str, Any]
    ) -> None:
        messages = [(frame.t_ns, frame.index, schema.codec.encode(schema.check(frame.rows))) for frame in frames]
        provenance = Provenance("ingest", words, digest=digest(messages))
        topic = f"{self.prefix}/{suffix}"
        channel = writer.add_channel(
            topic, (schema.name, "protobuf", schema.descriptor), "protobuf", provenance.to_metadata()
        )
        for message in messages:
            writer.add_message(channel, *message)
        self.report.messages[topic] = len(messages)


class _VideoJob(_Job):
    """A video or image folder, with labels beside it."""

    def __init__(self, source: Path, options: IngestOptions, progress: Progress) -> None:
        super().__init__(source, options)
        self._progress = progress
        if options.role:
            raise McaptrackError(f"{source} is no label file; --as is for those")
        self.video: Video = open_video(source)
        if self.video.images and not (options.fps or self.video.fps):
            raise McaptrackError(f"{source}: a folder of images has no clock; give the frames per second with --fps")
        self._plane = self.plane(self.video.width_px, self.video.height_px)

    def topics(self) -> Iterator[str]:
        yield f"{self.prefix}/video"
        yield from super().topics()

    def frame_index(self, labels: Labels, numbers: Ints) -> Ints:
        return numbers - labels.first_frame

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        options, video = self.options, self.video
        start_ns = video.start_ns if options.start_ns is None else options.start_ns
        start_ns = 0 if start_ns is None else start_ns
        is_video = options.image_format == "h264"
        schema_name = foxglove.VIDEO if is_video else foxglove.IMAGE
        words = {"file": video.path.name, "image_format": options.image_format}
        if is_video and video.why_transcode:
            words["encoded_again_because"] = video.why_transcode
            self.report.notes.append(f"{video.path} is encoded again: {video.why_transcode}")
        channel = writer.add_channel(
            f"{self.prefix}/video",
            foxglove.schema_record(schema_name),
            "protobuf",
            Provenance("ingest", words).to_metadata(),
            kind="media",
        )
        writer.add_metadata(CLOCK, {"start_ns": str(start_ns)})
        times: list[int] = []
        frame_id = self.prefix.lstrip("/")
        for picture in video.pictures(options.image_format, options.fps, start_ns):
            data = foxglove.pack_picture(schema_name, picture.t_ns, frame_id, options.image_format, picture.data)
            writer.add_message(channel, picture.t_ns, picture.index, data)
            times.append(picture.t_ns)
            self._progress("ingest", len(times), max(video.frames, len(times)))
        if not times:
            raise McaptrackError(f"{video.path} is a video without frames")
        self.report.messages[f"{self.prefix}/video"] = len(times)
        self.report.lost += video.lost
        self.write_plane(writer, self._plane, times[0])
        self.write_labels(writer, self._plane, {role: self._times(role, times) for role in self.labels})

    def _times(self, role: Role, times: list[int]) -> tuple[Ints, Ints]:
        """The labelled frames among those of the video, and their times."""
        path, labels = self.labels[role]
        index = labels.frame - labels.first_frame
        beyond = int((index >= len(times)).sum())
        if beyond == len(index):
            raise McaptrackError(f"{path}: all labels are of frames after the video's last, {len(times) - 1}")
        if beyond:
            self.report.lost.append(
                f"{path}: {beyond} labels are of frames after the video's last; "
                f"the last labelled frame is {labels.frame.max()}"
            )
        first = int(index[0] % labels.step) if labels.step > 1 else 0
        known = np.arange(first, len(times), labels.step)
        return known + labels.first_frame, np.array(times, np.int64)[known]


class _LabelJob(_Job):
    """Label files without pictures."""

    def __init__(self, source: Path, options: IngestOptions, default_fps: Fraction | None = None) -> None:
        super().__init__(source, options)
        role = options.role
        labels = read_labels(source, options.label_format, role or "tracks")
        role = role or ("tracks" if labels.identified else "detections")
        if role in self.labels:
            raise McaptrackError(f"{source} and {self.labels[role][0]} are both {role}; say with --as what {source} is")
        if options.image_format != "h264":
            raise McaptrackError(f"{source} is a label file; --image-format is for videos")
        self.labels = {role: (source, labels), **self.labels}
        self.check_labels()
        self._fps = {
            part: options.fps or _label_fps(path, found, default_fps) for part, (path, found) in self.labels.items()
        }
        self._plane = self.plane(*self._extent())

    def _extent(self) -> tuple[int, int]:
        """The size of the image as far as boxes tell."""
        boxes = [labels.boxes_px for _, labels in self.labels.values() if labels.boxes_px is not None]
        if not boxes:
            return 0, 0
        corner = np.concatenate([part[:, :2] + part[:, 2:] for part in boxes]).max(axis=0)
        return int(np.ceil(corner[0])), int(np.ceil(corner[1]))

    def times(self, start_ns: int) -> dict[Role, tuple[Ints, Ints]]:
        """The frames of each file, from its first to its last, in its own numbers, and their times."""
        times: dict[Role, tuple[Ints, Ints]] = {}
        for role, (_, labels) in self.labels.items():
            numbers = np.arange(int(labels.frame.min()), int(labels.frame.max()) + 1, labels.step)
            fps = self._fps[role]
            t_ns = [start_ns + round(Fraction(number) / fps * NS_PER_S) for number in numbers.tolist()]
            times[role] = (numbers, np.array(t_ns, np.int64))
        return times

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        start_ns = self.options.start_ns or 0
        times = self.times(start_ns)
        if not has_clock:
            writer.add_metadata(CLOCK, {"start_ns": str(start_ns)})
        self.write_plane(writer, self._plane, min(int(t_ns[0]) for _, t_ns in times.values()))
        self.write_labels(writer, self._plane, times)


def _label_fps(path: Path, labels: Labels, default: Fraction | None) -> Fraction:
    """Frames per second of a label file that stands alone."""
    if labels.format == "sdd":
        return _SDD_FPS
    if labels.format in ("trajnet", "obsmat"):  # annotated at 2.5 Hz, whatever the video's rate
        return labels.step / _LABEL_STEP_S
    fps = seqinfo_fps(path.parent) or default
    if fps:
        return fps
    raise McaptrackError(f"{path} has no clock of its own; give the frames per second with --fps")


def label_frames(
    files: Mapping[Role, Path],
    fps: Fraction | None,
    ground_plane: Path | None,
    point: Point,
    label_format: Format = "auto",
) -> dict[Role, list[Frame]]:
    """Label files that share a clock as frames, without a log between. Raises McaptrackError as ``ingest`` does.

    Only the order and the distances of times matter to whoever compares such files; without ``fps`` a file that has no
    clock counts one frame a second.
    """
    (first, source), *others = files.items()
    options = IngestOptions(fps=fps, ground_plane=ground_plane, point=point, labels=dict(others), role=first)
    job = _LabelJob(source, replace(options, label_format=label_format), default_fps=Fraction(1))
    return {role: job.frames(role, job._plane, *times) for role, times in job.times(0).items()}


def _label_rows(labels: Labels, role: Role, plane: GroundPlane | None) -> Rows:
    if role == "detections" and labels.boxes_px is not None:
        x, y, w, h = labels.boxes_px.T
        return DETECTIONS.rows(
            x_px=x, y_px=y, w_px=w, h_px=h, score=labels.score, class_id=np.ones(len(labels.frame), np.uint32)
        )
    nowhere = np.full((len(labels.frame), 4), np.nan)
    boxes = nowhere if labels.boxes_px is None else labels.boxes_px
    xy_m = labels.xy_m
    if xy_m is None:
        xy_m = plane.boxes_to_metres(boxes) if plane else nowhere[:, :2]
    return TRACKS.rows(
        track_id=labels.id,
        x_px=boxes[:, 0],
        y_px=boxes[:, 1],
        w_px=boxes[:, 2],
        h_px=boxes[:, 3],
        x_m=xy_m[:, 0],
        y_m=xy_m[:, 1],
        score=labels.score,
        observed=np.ones(len(labels.frame), bool),
        source_id=np.full(len(labels.frame), -1),
    )
