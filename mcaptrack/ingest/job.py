"""What all inputs have in common: options, what is reported, labels and the ground plane of a camera.

Letters: N rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.ingest.labels import Format, Labels, Role, read_homography, read_labels
from mcaptrack.plane import GroundPlane, Point
from mcaptrack.provenance import CLOCK, Provenance, digest
from mcaptrack.schema import DETECTIONS, GROUND_PLANE, TRACKS, Frame, Rows, Schema
from mcaptrack.schema.ground import plane_to_rows
from mcaptrack.video import ImageFormat, Keep

Ints = NDArray[np.int64]
Progress = Callable[[str, int, int], None]

_SCHEMA_OF: Final[Mapping[Role, Schema]] = {"detections": DETECTIONS, "tracks": TRACKS, "truth": TRACKS}


@dataclass(frozen=True, kw_only=True)
class IngestOptions:
    """How to make a log. ``labels`` maps what a label file says to the file; ``role`` is for an input that is one.

    ``fps``, ``image_format``, ``quality`` and ``keyframe_interval_s`` are as in ``video.Keep``.
    """

    camera: str = "camera"
    fps: Fraction | None = None
    start_ns: int | None = None
    image_format: ImageFormat = "auto"
    quality: int | None = None
    keyframe_interval_s: float | None = None
    ground_plane: Path | None = None
    point: Point = "foot"
    labels: Mapping[Role, Path] = field(default_factory=dict)
    label_format: Format = "auto"
    role: Role | None = None

    @property
    def keep(self) -> Keep:
        """How pictures are kept. Raises McaptrackError for what does not go together."""
        return Keep(
            image_format=self.image_format,
            quality=self.quality,
            keyframe_interval_s=self.keyframe_interval_s,
            fps=self.fps,
        )

    def for_videos(self) -> str:
        """The first option given that is about the pictures of videos; "" if there is none."""
        given = {
            "--image-format": self.image_format != "auto",
            "--quality": self.quality is not None,
            "--keyframe-interval-s": self.keyframe_interval_s is not None,
        }
        return next((name for name, is_given in given.items() if is_given), "")


@dataclass
class Report:
    """What became of an input: messages by topic, what to say of it (``notes``: to some), what was lost."""

    messages: dict[str, int] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


class Job:
    """What videos and labels have in common: the topics of a camera, its ground plane, rows to messages."""

    #: Whether a clock that a log has is replaced by the job's own.
    drops_clock = False

    def __init__(self, source: Path, options: IngestOptions) -> None:
        self._close = ExitStack()
        self.source, self.options, self.report = source, options, Report()
        self.prefix = "/" + options.camera.strip("/")
        self.homography = read_homography(options.ground_plane) if options.ground_plane else None
        self.labels: dict[Role, tuple[Path, Labels]] = {
            role: (path, read_labels(path, options.label_format, role)) for role, path in options.labels.items()
        }
        self.check_labels()

    def check_labels(self) -> None:
        """Refuse labels that can't be what they are given as."""
        for role, (path, labels) in self.labels.items():
            if role == "detections" and labels.boxes_px is None:
                raise McaptrackError(f"{path} holds positions, not boxes; detections are boxes")
            if role != "detections" and not labels.identified:
                raise McaptrackError(f"{path} says of nobody who it is (all ids are -1); {role} need ids")
            if labels.left_out:
                self.report.notes.append(f"{path} also holds {labels.left_out}; they are left out")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close.close()

    def opened(self, output: Path, into: log.Log | None, force: bool) -> AbstractContextManager[log.LogWriter]:
        """What writes to ``output``, which is new or is the log ``into``.

        Raises McaptrackError if the log has a channel of this job already and ``force`` is not given.
        """
        taken = self.taken(into, force)
        if into is None:
            return log.create(output)
        return log.extend(into, drop=taken, drop_metadata=[CLOCK] if self.drops_clock else [])

    def taken(self, there: log.Log | None, force: bool) -> set[str]:
        """The topics of a log that this job replaces."""
        taken = set(self.topics()) & set(there.channels) if there else set()
        if taken and there and not force:
            raise McaptrackError(f"{there.path} has {', '.join(sorted(taken))} already; --force replaces them")
        return taken

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write all channels; ``has_clock`` says that the log has a clock already."""
        raise NotImplementedError

    def check(self, output: Path) -> None:
        """Compare what stands in ``output`` with the input. Raises McaptrackError for a difference."""

    def topics(self) -> Iterator[str]:
        """The topics that this job writes."""
        yield from (f"{self.prefix}/{role}" for role in self.labels)
        if self.homography:
            yield f"{self.prefix}/ground_plane"

    def plane(self, width_px: int, height_px: int) -> GroundPlane | None:
        """The ground plane for pictures of this size; None if none was given."""
        if self.homography is None:
            return None
        try:
            return GroundPlane(self.homography, width_px, height_px, self.options.point)
        except McaptrackError as error:
            raise McaptrackError(f"{self.options.ground_plane}: {error}") from None

    def write_plane(self, writer: log.LogWriter, plane: GroundPlane | None, t_ns: int) -> None:
        """Write the ground plane, if there is one, as it holds from a time on."""
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
        rows = label_rows(labels, role, plane)
        first, last = (np.searchsorted(labels.frame, numbers, side) for side in ("left", "right"))
        columns = (t_ns, self.frame_index(labels, numbers), first, last)
        spans = zip(*(column.tolist() for column in columns), strict=True)
        return [Frame(time, index, rows[low:high]) for time, index, low, high in spans]

    def frame_index(self, labels: Labels, numbers: Ints) -> Ints:
        """The frames, counted from 0, of a label file's numbers."""
        return numbers

    def write_rows(
        self, writer: log.LogWriter, suffix: str, schema: Schema, frames: list[Frame], words: Mapping[str, Any]
    ) -> None:
        """Write a channel below the camera's; ``words`` say what it was made of."""
        messages = [(frame.t_ns, frame.index, schema.codec.encode(schema.check(frame.rows))) for frame in frames]
        provenance = Provenance("ingest", words, digest=digest(messages))
        topic = f"{self.prefix}/{suffix}"
        channel = writer.add_channel(
            topic, (schema.name, "protobuf", schema.descriptor), "protobuf", provenance.to_metadata()
        )
        for message in messages:
            writer.add_message(channel, *message)
        self.report.messages[topic] = len(messages)


class PictureJob(Job):
    """Pictures with labels beside them, whose frames are the pictures in their order."""

    def frame_index(self, labels: Labels, numbers: Ints) -> Ints:
        """The pictures, counted from 0, of a label file's numbers."""
        return numbers - labels.first_frame

    def label_times(self, role: Role, times: list[int]) -> tuple[Ints, Ints]:
        """The labelled frames among the pictures, and their times."""
        path, labels = self.labels[role]
        index = labels.frame - labels.first_frame
        beyond = int((index >= len(times)).sum())
        if beyond == len(index):
            raise McaptrackError(f"{path}: all labels are of frames after the last picture, {len(times) - 1}")
        if beyond:
            self.report.lost.append(
                f"{path}: {beyond} labels are of frames after the last picture; "
                f"the last labelled frame is {labels.frame.max()}"
            )
        first = int(index[0] % labels.step) if labels.step > 1 else 0
        known = np.arange(first, len(times), labels.step)
        return known + labels.first_frame, np.array(times, np.int64)[known]


def label_rows(labels: Labels, role: Role, plane: GroundPlane | None) -> Rows:
    """The N rows of labels as rows of detections or tracks; in metres too, given a plane."""
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
