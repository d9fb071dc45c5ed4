"""Whatever exists becomes a log: a video, a folder of images, label files beside them or alone."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack import foxglove, log
from mcaptrack.atomic import is_same_file
from mcaptrack.clock import NS_PER_S
from mcaptrack.errors import McaptrackError
from mcaptrack.ingest.bags import LogJob
from mcaptrack.ingest.job import IngestOptions, Ints, Job, PictureJob, Progress, Report
from mcaptrack.ingest.labels import Format, Labels, Role, read_labels
from mcaptrack.ingest.source import open_source
from mcaptrack.plane import Point
from mcaptrack.provenance import CLOCK, Provenance
from mcaptrack.schema import Frame
from mcaptrack.video import IMAGE_SUFFIXES, ImageFormat, Video, open_video, seqinfo_fps

__all__ = ["Format", "ImageFormat", "IngestOptions", "Report", "Role", "ingest", "label_frames"]

VIDEO_SUFFIXES: Final = (
    ".mp4",
    ".mov",
    ".mkv",
    ".avi",
    ".webm",
    ".m4v",
    ".ts",
    ".h264",
    ".264",
    ".mpg",
    ".mpeg",
    ".h265",
    ".265",
    ".hevc",
    ".ivf",
    ".obu",
)
#: The step of labels in formats that are annotated on the clock of prediction.
_LABEL_STEP_S: Final = Fraction(2, 5)
_FOXGLOVE_ALONE: Final = {"vp9": "VP9", "av1": "AV1"}
_SDD_FPS: Final = Fraction(30)


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
    if into is None and is_same_file(output, source):
        raise McaptrackError(f"{source} is both input and output; give another name with -o")
    with _job(source, options, progress) as job:
        with job.opened(output, into, force) as writer:
            job.write(writer, has_clock=bool(into and into.metadata(CLOCK)))
        job.check(output)
    return job.report


def _job(source: Path, options: IngestOptions, progress: Progress) -> Job:
    recorded = open_source(source)
    if recorded is not None:
        return LogJob(source, options, recorded, progress)
    is_video = source.is_dir() or source.suffix.lower() in VIDEO_SUFFIXES or _is_binary(source)
    return _VideoJob(source, options, progress) if is_video else _LabelJob(source, options)


def _is_binary(source: Path) -> bool:
    if source.suffix.lower() in IMAGE_SUFFIXES:
        raise McaptrackError(f"{source} is a single image; give the folder that the images lie in")
    with source.open("rb") as stream:
        return b"\0" in stream.read(4096)


class _VideoJob(PictureJob):
    """A video or image folder, with labels beside it."""

    drops_clock = True

    def __init__(self, source: Path, options: IngestOptions, progress: Progress) -> None:
        super().__init__(source, options)
        self._progress = progress
        if options.role:
            raise McaptrackError(f"{source} is no label file; --as is for those")
        self.video: Video = open_video(source, options.keep)
        if self.video.images and not (options.fps or self.video.fps):
            raise McaptrackError(f"{source}: a folder of images has no clock; give the frames per second with --fps")
        self._plane = self.plane(self.video.width_px, self.video.height_px)

    def topics(self) -> Iterator[str]:
        yield f"{self.prefix}/video"
        yield from super().topics()

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        options, video, keep = self.options, self.video, self.options.keep
        start_ns = video.start_ns if options.start_ns is None else options.start_ns
        start_ns = 0 if start_ns is None else start_ns
        schema_name = foxglove.IMAGE if keep.is_still else foxglove.VIDEO
        words: dict[str, str | int | float] = {"file": video.path.name, "image_format": video.format}
        if options.fps is not None:
            words["fps"] = str(options.fps)
        if video.why_transcode:
            words |= {"encoded_again_because": video.why_transcode}
            words |= {"crf": keep.crf, "keyframe_interval_s": keep.key_every_s}
            self.report.said.append(f"{video.path} is encoded again, as H.264: {video.why_transcode}")
        elif video.format in _FOXGLOVE_ALONE:
            kept = f"{video.path} is kept as {_FOXGLOVE_ALONE[video.format]}, which Foxglove plays"
            self.report.said.append(f"{kept} and Lichtblick does not (--image-format h264 is for both)")
        elif video.format == "jpeg":
            words["quality"] = keep.jpeg_quality
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
        for picture in video.pictures(start_ns):
            data = foxglove.pack_picture(schema_name, picture.t_ns, frame_id, video.format, picture.data)
            writer.add_message(channel, picture.t_ns, picture.index, data)
            times.append(picture.t_ns)
            self._progress("ingest", len(times), max(video.frames, len(times)))
        if not times:
            raise McaptrackError(f"{video.path} is a video without frames")
        self.report.messages[f"{self.prefix}/video"] = len(times)
        self.report.said += video.notes
        self.report.lost += video.lost
        self.write_plane(writer, self._plane, times[0])
        self.write_labels(writer, self._plane, {role: self.label_times(role, times) for role in self.labels})


class _LabelJob(Job):
    """Label files without pictures."""

    def __init__(self, source: Path, options: IngestOptions, default_fps: Fraction | None = None) -> None:
        super().__init__(source, options)
        role = options.role
        labels = read_labels(source, options.label_format, role or "tracks")
        role = role or ("tracks" if labels.identified else "detections")
        if role in self.labels:
            raise McaptrackError(f"{source} and {self.labels[role][0]} are both {role}; say with --as what {source} is")
        if options.for_videos():
            raise McaptrackError(f"{source} is a label file; {options.for_videos()} is for videos")
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
