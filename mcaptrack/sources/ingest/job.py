"""Common parts of all inputs: options, the report, labels and the ground plane of a camera.

Letters: N rows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence, Set
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from mcaptrack import foxglove, log
from mcaptrack.choices import InputRole, LengthUnit, Point, Role
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.affine import IDENTITY, compose, scale_of
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.camera_path import Verdict, poses_of
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import Notice, collected, warn
from mcaptrack.schema import CAMERA_MOTION, DETECTIONS, GROUND_PLANE, TRACKS, Frame, Schema
from mcaptrack.schema.as_rows import is_motion, plane_to_rows, pose_to_rows
from mcaptrack.schema.classes import ClassMap, classes_beside_rows, only_class, without_class
from mcaptrack.schema.encodings import PROTOBUF, Encoding, encoded, record_of
from mcaptrack.schema.provenance import CLOCK, INGEST, Provenance, digest
from mcaptrack.sources.calibrations import is_rectified_topic
from mcaptrack.sources.cameras import corrected_plane
from mcaptrack.sources.corrections import CORRECTED
from mcaptrack.sources.ingest.calibration import Calibrated, GivenCalibration
from mcaptrack.sources.ingest.labels.checks import find_outside
from mcaptrack.sources.ingest.labels.frames import FrameRanges, share_numbers, warn_of_firsts
from mcaptrack.sources.ingest.labels.reading import is_3d, read_homography, read_labels
from mcaptrack.sources.ingest.labels.roles import ONLY_PEOPLE, WantedClasses, describe_classes
from mcaptrack.sources.ingest.labels.table import BoxTable, refuse
from mcaptrack.sources.ingest.labels.text import lines_of, read_numbers
from mcaptrack.sources.ingest.labels.timeline import Placed, Timeline, frames_of_labels
from mcaptrack.sources.sidecar import encoding_for
from mcaptrack.sources.video import VideoOptions

#: A function that yields frames, from the beginning with each call.
Frames = Callable[[], Iterator[Frame]]

#: The schema of each role.
SCHEMA_OF: Final[Mapping[Role, Schema]] = {
    "detections": DETECTIONS,
    "tracks": TRACKS,
    "truth": TRACKS,
    "corrections": TRACKS,
}
#: The last part of the topic of each role, if it isn't its name.
TOPIC_OF: Final[Mapping[Role, str]] = {"corrections": CORRECTED}
#: The role of a file with the motion of the camera, and the last part of its topic.
MOTION: Final = "motion"


#: Options that apply only to videos, and options that are written otherwise than they are named here.
FOR_VIDEOS: Final = ("image_format", "quality", "keyframe_interval_s", "stream")
_WRITTEN: Final[Mapping[str, str]] = {"start_ns": "start_time", "frame_id": "frame", "frame_ranges": "frames"}


@dataclass(frozen=True, kw_only=True)
class IngestOptions(VideoOptions):
    """The parameters of ``mcaptrack.ingest``, which explains them, as values: paths, fractions, names of columns.

    Those of ``VideoOptions`` are among them. ``labels`` are label files by role; ``frame_id`` is its ``frame``, and
    ``frame_ranges`` its ``frames`` if these are no number.
    """

    camera: str = "camera"
    start_ns: int | None = None
    ground_plane: Path | None = None
    calibration: tuple[Path, ...] = ()
    calibration_name: str | None = None
    calibration_unit: LengthUnit = "auto"
    point: Point = "foot"
    labels: Mapping[Role, Path] = field(default_factory=dict)
    label_format: str = "auto"
    first_frame: int | Mapping[str, int] | None = None
    frames: int | None = None
    frame_ranges: FrameRanges | None = None
    role: InputRole | None = None
    motion: Path | None = None
    columns: Mapping[str, str] | None = None
    size: tuple[int, int] | None = None
    classes: WantedClasses | None = None
    class_map: ClassMap | None = None
    frame_id: str | None = None
    scene: str | None = None

    def first_of(self, role: Role | None) -> int | None:
        """The number of the first picture in files with this role; None if it wasn't given."""
        return self.first_frame.get(role or "") if isinstance(self.first_frame, Mapping) else self.first_frame

    def read(self, path: Path, role: Role | None, wanted: WantedClasses | None, in_parts: bool = False) -> BoxTable:
        """Read a label file as these options say, but for the ``wanted`` classes. Raises McaptrackError."""
        given = (self.label_format, role, self.first_of(role), self.columns, wanted, in_parts, self.scene)
        return read_labels(path, *given, self.class_map)

    def given(self, *names: str) -> str:
        """The first of these options that was given, as a user writes it; "" if none was."""
        defaults = IngestOptions()
        given = next((name for name in names if getattr(self, name) != getattr(defaults, name)), "")
        return given and f"`{_WRITTEN.get(given, given)}=`"


@dataclass
class IngestReport:
    """The result of ``ingest``: messages by topic, ``remarks``, details (``notes``), and what was lost.

    ``warnings`` report what was assumed, left out or looks unusual. ``has_labels``: there were label files.
    ``uses_camera``: topics below the camera's name were written. ``facts`` is what is known of label files, by role.
    """

    messages: dict[str, int] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    warnings: list[Notice] = field(default_factory=list)
    has_labels: bool = False
    uses_camera: bool = False
    facts: dict[str, Mapping[str, Any]] = field(default_factory=dict)


def fitted(labels: BoxTable, size: tuple[int, int]) -> BoxTable:
    """Labels of pictures of this width and height: boxes in shares of it become pixels, and those outside of it are
    warned of.
    """
    facts = labels.facts
    if labels.boxes_px is not None and facts.is_normalised:
        facts = replace(facts, is_normalised=False, size=None)
        labels = replace(labels, boxes_px=labels.boxes_px * np.array([*size, *size], float), facts=facts)
    if facts.size not in (None, size):
        text = f": its pictures are {facts.size[0]}x{facts.size[1]}, and those here {size[0]}x{size[1]}"
        labels.find(f"{text}; boxes stay as they are", "outside")
    if facts.size != size:
        find_outside(labels, np.array(size, float))
    return labels


#: The last parts of the topics of the ground plane and the calibration that a user gave.
PLANE, CALIBRATION = "ground_plane", "calibration"


# Read published motions of cameras: a 2x3 transform per frame, from pixels of the frame before. Letters: F frames.


_MOTION_COLUMNS: Final = 7
#: The largest zoom from one frame to the next.
_MOST_ZOOM: Final = 4.0
_MOTION: Final = "a camera motion (frame,m00,m01,m02,m10,m11,m12: 7 columns)"


def read_motions(path: Path) -> Floats:
    """Read the motions (F, 2, 3) of frames 0 to F - 1 from a text file.

    Raises McaptrackError, with the line, for anything else.
    """
    values, at = read_numbers(path, lines_of(path), _MOTION, _MOTION_COLUMNS)
    if not len(values):
        raise McaptrackError(f"{path} holds no camera motion")
    frame, motions = values[:, 0], values[:, 1:].reshape(-1, 2, 3)
    refuse(
        at,
        frame != np.arange(len(frame)),
        lambda row: f"frame {frame[row]:g} is not {row}: frames count from 0, without gaps",
    )
    wrong = np.array([not is_motion(motion) for motion in motions])
    refuse(at, wrong, lambda row: "the motion is not finite, or can't be inverted")
    scale = np.array([scale_of(motion) for motion in motions])
    refuse(
        at,
        (scale > _MOST_ZOOM) | (scale < 1 / _MOST_ZOOM),
        lambda row: f"the motion enlarges the picture {scale[row]:.3g} times; no camera does that in a frame",
    )
    return motions


def motion_frames(motions: Floats, index: Ints, t_ns: Ints, size: tuple[int, int]) -> list[Frame]:
    """The motions (F, 2, 3) of a file as frames of pictures ``index`` (P,) at ``t_ns`` (P,), of this width and height.

    The motion of a picture that follows on missing ones is that of all of them together. Pictures beyond the last
    motion are lost.
    """
    kept: list[Floats] = []
    last = -1
    for number in index.tolist():
        motion = IDENTITY
        for at in range(last + 1, min(number + 1, len(motions))):
            motion = compose(motions[at], motion) if at else IDENTITY
        kept.append(motion)
        last = number
    poses = poses_of(np.array(kept), *size)
    frames = []
    for pose, number, t in zip(poses, index.tolist(), t_ns.tolist(), strict=True):
        judged = pose if number < len(motions) else pose._replace(verdict=Verdict.LOST)
        reference = judged._replace(reference=int(index[judged.reference]))
        frames.append(Frame(t, number, pose_to_rows(reference, *size)))
    return frames


class IngestJob:
    """Base class of inputs: the topics of a camera, its labels and its ground plane.

    ``into`` is the log to which channels are added, if it is not a new one; ``encoding`` is that of rows and pictures.
    """

    #: Whether the start time in the log's metadata is replaced.
    drops_clock = False
    #: The proposed camera name if the topics exist already.
    other_camera = "{camera}/labels"

    def __init__(self, source: Path, options: IngestOptions, into: log.Log | None = None) -> None:
        self._close = ExitStack()
        self.source: Path = source
        self.options: IngestOptions = options
        self.into: log.Log | None = into
        self.report: IngestReport = IngestReport()
        self.encoding: Encoding = encoding_for(into) if into else PROTOBUF
        self.prefix: str = "/" + options.camera.strip("/")
        #: The topic of the pictures that labels belong to; "" if there is none.
        self.pictures = ""
        source_options = (options.calibration, options.calibration_name, options.calibration_unit)
        #: The calibration and the homography of the ground plane that were given.
        self.calibration = GivenCalibration.read(*source_options) if options.calibration else None
        self._calibrated: Calibrated | None = None
        self._homography = read_homography(options.ground_plane) if options.ground_plane else None
        if self._homography and self.calibration and self.calibration.has_pose:
            names = ", ".join(map(str, self.calibration.paths))
            raise McaptrackError(f"{options.ground_plane} and {names} are both a ground plane; give one")
        self.labels: dict[Role, BoxTable] = {role: self.read(path, role) for role, path in options.labels.items()}
        self.motions = read_motions(options.motion) if options.motion else None
        share_numbers(self.labels)

    def read(self, path: Path, role: Role | None) -> BoxTable:
        """Read a label file with the format options. Without a role, it is that of tracks if the file has ids."""
        options = self.options
        wanted = options.classes or (WantedClasses("all") if role == "corrections" else ONLY_PEOPLE)
        if is_3d(path, options.label_format, options.columns):
            raise McaptrackError(
                f"{path} holds 3D boxes, and {self.source} does not; add them with "
                f"{call('ingest', path, role=role, into='LOG')}"
            )
        labels = options.read(path, role, wanted, in_parts=True)
        if role is None and isinstance(options.first_frame, Mapping):
            return self.read(path, labels.role)
        if labels.role == "detections" and labels.boxes_px is None:
            raise McaptrackError(f"{labels.path} holds positions, not boxes; detections are boxes")
        return labels

    def add(self, path: Path, labels: BoxTable, is_first: bool = False) -> None:
        """Take the labels of a file. Raises McaptrackError if there are others of their role."""
        role = labels.role
        if role in self.labels:
            raise McaptrackError(
                f"{path} and {self.labels[role].path} are both {role}; give the role of {path} with `role=`"
            )
        self.labels = {role: labels, **self.labels} if is_first else {**self.labels, role: labels}

    @property
    def has_ground_given(self) -> bool:
        """Whether a homography or a calibration was given."""
        return self._homography is not None or self.calibration is not None

    @property
    def _has_plane(self) -> bool:
        """Whether a ground plane follows from what was given."""
        return self._homography is not None or (self.calibration is not None and self.calibration.has_pose)

    @property
    def has_labels(self) -> bool:
        """Whether there are label files."""
        return bool(self.roles)

    @property
    def roles(self) -> Set[Role]:
        """The roles of label files."""
        return self.labels.keys()

    def fit_to_pictures(self, size: Callable[[], tuple[int, int]] | None) -> None:
        """Convert boxes in shares of the picture to pixels, and warn of boxes outside of it.

        ``size`` returns width and height of the pictures; None if there are none. Raises McaptrackError if the size is
        not known, or isn't the given one.
        """
        tables = {role: labels for role, labels in self.labels.items() if labels.boxes_px is not None}
        stated = self.options.size
        if not tables:
            return
        try:
            actual = size() if size else stated
        except McaptrackError:  # pictures that can't be decoded can have labels
            if stated or any(labels.is_normalised for labels in tables.values()):
                raise
            actual = None
        if stated and actual and actual != stated:
            raise McaptrackError(
                f"{self.source}: the pictures are {actual[0]}x{actual[1]}, not {stated[0]}x{stated[1]}; "
                "leave `size=` out"
            )
        for role, labels in tables.items():
            if actual is not None:
                self.labels[role] = fitted(labels, actual)
            elif labels.is_normalised:
                raise McaptrackError(
                    f"{labels.path} has boxes in shares of the picture's size; give it with `size='WIDTHxHEIGHT'`, or "
                    "add the labels to a log with pictures with `into=`"
                )

    def report_assumptions(self) -> None:
        """Report what is assumed about the labels, and what of them is left out."""
        all_labels = self.labels.values()
        warn_of_firsts(all_labels)
        for role, labels in self.labels.items():
            path = labels.path
            self.report_table(role, labels)
            if labels.step > 1:
                text = f"{path} has labels every {labels.step} frames, from {labels.labelled[0]} on"
                self.report.remarks.append(f"{text}; the frames in between are left out")
            kinds, counts = labels.extent.classes
            if len(kinds) > 1:
                text = describe_classes(kinds, counts, labels.classes)
                self.report.remarks.append(f"{path} has several classes; class_id is {text}")

    def report_table(self, role: Role, labels: BoxTable) -> None:
        """Report how a label file was understood, and what of it is left out."""
        self.report.facts[role] = labels.facts.to_json()
        self.report.remarks += labels.remarks
        for text, code in labels.doubts:
            warn(text, code)
        if labels.left_out:
            warn(f"{labels.path} also holds {labels.left_out}; left out of {role}", "left-out")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close.close()

    def opened(self, output: Path, into: log.Log | None, force: bool) -> AbstractContextManager[log.LogWriter]:
        """Open ``output``, which is a new log or the log ``into``, for writing.

        Raises McaptrackError if the log has one of the topics already and ``force`` is false.
        """
        topics_to_replace = self.topics_to_replace(into, force)
        if into is None:
            return log.create(output)
        return log.extend(into, drop=topics_to_replace, drop_metadata=[CLOCK] if self.drops_clock else [])

    def topics_to_replace(self, into: log.Log | None, force: bool) -> set[str]:
        """The topics of a log that are replaced.

        Raises McaptrackError if other software recorded one of them, and, unless ``force`` is true, if there is any.
        """
        topics_to_replace = set(self.topics()) & set(into.channels) if into else set()
        if into and topics_to_replace:
            log.refuse_to_replace_recorded(into, topics_to_replace, self.hint_other_topic(into.channels))
        if into and topics_to_replace and not force:
            raise McaptrackError(
                f"{into.path} has {', '.join(sorted(topics_to_replace))} already; `force=True` replaces them"
            )
        corrected = {topic for topic in map(corrected_plane, topics_to_replace) if into and topic in into.channels}
        for topic in sorted(corrected):
            warn(f"{topic} is dropped: it corrected the ground plane that is replaced", "left-out")
        return topics_to_replace | corrected

    def hint_other_topic(self, topics: Collection[str]) -> str:
        """A hint for topics that exist already: the option that chooses others."""
        ends = [topic.removeprefix(self.prefix) for topic in self.topics() if topic.startswith(self.prefix)]
        name = self.other_camera.format(camera=self.prefix.strip("/"))
        names = (name, *(f"{name}{number}" for number in range(2, len(topics) + 3)))
        free = next(name for name in names if not any(f"/{name}{end}" in topics for end in ends))
        return f"`camera={free!r}` puts these beside them"

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write all channels; ``has_clock``: the log has a start time already."""
        raise NotImplementedError

    def check(self, output: Path) -> None:
        """Compare the written log with the input. Raises McaptrackError if they differ."""

    def topics(self) -> Iterator[str]:
        """The topics that will be written."""
        yield from (f"{self.prefix}/{TOPIC_OF.get(role, role)}" for role in self.labels)
        if self.calibration is not None:
            yield f"{self.prefix}/{CALIBRATION}"
        if self._has_plane:
            yield f"{self.prefix}/{PLANE}"
        if self.motions is not None:
            yield f"{self.prefix}/{MOTION}"

    #: The frame of reference of the pictures, where it isn't the name of the camera.
    frame_id = ""

    def plane(self, width_px: int, height_px: int, is_stated: bool = True) -> GroundPlane | None:
        """The ground plane for pictures of this size; None if none was given. ``is_stated``: they have this size, which
        is otherwise no more than the extent of boxes.
        """
        if self.calibration is not None:
            frame_id, is_rectified = self.frame_id or self.prefix.lstrip("/"), is_rectified_topic(self.pictures)
            of_pictures = (self.prefix, self.pictures, (width_px, height_px), is_stated, frame_id)
            self._calibrated = self.calibration.calibrated(*of_pictures, self.options.point, is_rectified)
            self.report.remarks += self._calibrated.remarks
            if self._calibrated.plane is not None:
                return self._calibrated.plane
        if self._homography is None:
            return None
        try:
            return GroundPlane(self._homography, width_px, height_px, self.options.point)
        except McaptrackError as error:
            raise McaptrackError(f"{self.options.ground_plane}: {error}") from None

    def write_plane(self, writer: log.LogWriter, plane: GroundPlane | None, t_ns: int) -> None:
        """Write the ground plane and the calibration, if they were given, valid from a time on."""
        calibrated, file = self._calibrated, self.options.ground_plane
        if plane is not None and self._has_plane:
            frame = Frame(t_ns, 0, plane_to_rows(plane))
            parameters = {"file": file.name} if file else calibrated.parameters if calibrated else {}
            parameters = parameters | {"point": self.options.point}
            self.write_rows(writer, PLANE, GROUND_PLANE, lambda: iter([frame]), parameters)
        if calibrated is None:
            return
        topic, message = f"{self.prefix}/{CALIBRATION}", (t_ns, 0, calibrated.at(t_ns))
        provenance = Provenance(INGEST, calibrated.parameters, self.pictures, digest=digest(iter([message])))
        record = foxglove.record_in(foxglove.CALIBRATION, self.encoding)
        channel = writer.add_channel(topic, record, self.encoding, provenance.to_metadata())
        for packed in foxglove.messages_in(foxglove.CALIBRATION, [message], self.encoding):
            writer.add_message(channel, *packed)
        self.report.messages[topic] = 1

    def write_labels(self, writer: log.LogWriter, plane: GroundPlane | None, timeline: Timeline) -> None:
        """Write the labels, each frame at the time of its picture."""
        for role, labels in self.labels.items():
            with collected() as warned:
                placed = timeline.place(labels, role, self.report.lost, self.ranges_of(role))
            parameters = {"file": labels.path.name, "format": labels.format} | self.label_parameters(role, labels)
            if placed.ranges is not None:
                parameters |= {"frames": str(placed.ranges), "frames_by": placed.by}
            frames = self.frames(role, plane, placed)
            warnings = [(notice.code, notice.message) for notice in warned if notice.code == "labelled"]
            self.write_rows(
                writer, TOPIC_OF.get(role, role), SCHEMA_OF[role], frames, parameters, labels, warnings=warnings
            )

    def ranges_of(self, role: Role) -> FrameRanges | None:
        """The frames that a user says were labelled: of the ground truth, if there is any."""
        return self.options.frame_ranges if role == "truth" or "truth" not in self.roles else None

    def write_motion(self, writer: log.LogWriter, timeline: Timeline, size: tuple[int, int]) -> None:
        """Write the motion of the camera, if it was given; pictures have this width and height."""
        if self.motions is None or self.options.motion is None:
            return
        path, count = self.options.motion, int(timeline.index[-1]) + 1
        if len(self.motions) != count:
            text = f"{path} has the motion of {len(self.motions)} frames, and {timeline.of} are {count}"
            less = "it is taken as none in the rest" if len(self.motions) < count else "the rest is left out"
            warn(f"{text}; {less}", "left-out")
        frames = motion_frames(self.motions, timeline.index, timeline.t_ns, size)
        self.write_rows(writer, MOTION, CAMERA_MOTION, lambda: iter(frames), {"file": path.name})

    def label_parameters(self, role: Role, labels: BoxTable) -> dict[str, Any]:
        """Additional parameters in the provenance of labels."""
        is_stated = self.options.first_of(role) is not None or (labels.format, labels.first_frame) == ("mot", 0)
        out: dict[str, Any] = {"first_frame": labels.first_frame} if is_stated else {}
        if self.options.columns:
            out["columns"] = ",".join(f"{key}={name}" for key, name in self.options.columns.items())
        if role != "detections" and self.options.classes not in (None, None if labels.in_space else ONLY_PEOPLE):
            out["classes"] = self.options.classes.text
        if self.options.class_map is not None:
            out["class_map"] = str(self.options.class_map)
        if self.options.size and labels.boxes_px is not None:
            out["size"] = "{}x{}".format(*self.options.size)
        return out

    def frames(self, role: Role, plane: GroundPlane | None, placed: Placed) -> Frames:
        """The labels of these frames, including empty frames."""
        return frames_of_labels(self.labels[role].parts, role, plane, placed)

    def write_rows(
        self,
        writer: log.LogWriter,
        suffix: str,
        schema: Schema,
        frames: Frames,
        parameters: Mapping[str, Any],
        labels: BoxTable | None = None,
        frame_id: str = "",
        warnings: Sequence[Sequence[str]] = (),
    ) -> None:
        """Write a channel of the camera; ``parameters`` are those in its provenance, ``labels`` the file that it is of,
        ``frame_id`` the frame of reference of its positions, and ``warnings`` are kept with it.

        Frames are generated several times, for the digest and for the channel, so that they are never all in memory.
        """
        only = only_class(schema, frames())

        def messages() -> Iterator[tuple[int, int, bytes]]:
            without = (frame._replace(rows=without_class(frame.rows)) for frame in frames())
            return encoded(schema, without if only else frames(), PROTOBUF)

        classes = {} if labels is None else labels.classes
        if labels is not None:
            warnings = [
                *((code, text.replace(str(labels.path), labels.path.name)) for text, code in labels.doubts),
                *warnings,
            ]
        names, class_id = {str(number): name for number, name in sorted(classes.items())}, str(only) if only else ""
        plugins = {"label_format": labels.facts.plugin} if labels is not None and labels.facts.plugin else {}
        of_rows = digest(messages(), classes_beside_rows(class_id, names))
        provenance = Provenance(
            INGEST, parameters, self.pictures, digest=of_rows, classes=names, class_id=class_id, frame_id=frame_id,
            plugins=plugins, warnings=warnings,
        )  # fmt: skip
        topic, record = f"{self.prefix}/{suffix}", record_of(schema, self.encoding)
        channel = writer.add_channel(topic, record, self.encoding, provenance.to_metadata())
        count = 0
        for message in messages() if self.encoding == PROTOBUF else encoded(schema, frames(), self.encoding):
            writer.add_message(channel, *message)
            count += 1
        self.report.messages[topic] = count
