"""Contracts of label formats, readers of messages, recording formats and exporters of packages, and what they give.

Each is a class that is made without arguments; finishers and sections of the report are functions. Detectors, trackers
and so on are in ``mcaptrack.transforms.protocol``, predictors in ``mcaptrack.predictors.forecast``; a command is a
function that ``mcaptrack.api.declared`` declares.

Letters: N boxes, F frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from mcaptrack.errors import McaptrackError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from mcaptrack.api.reading import LogReader

__all__ = [
    "UNKNOWN_VECTOR", "Box", "Box3d", "Exporter", "Finished", "LabelBoxes", "LabelFormat", "MessageReader",
    "Quaternion", "ReadingNotes", "RecordedChannel", "RecordedMessage", "RecordingFormat", "RecordingReader",
    "ReportSection", "SectionTable", "Vector",
]  # fmt: skip

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def is_in_space(entry: object, made: object) -> bool:
    """Whether a format or reader gives boxes in space, in metres, by its class attribute ``in_space``.

    Raises McaptrackError, with the entry, if that is neither True nor False.
    """
    in_space = getattr(made, "in_space", False)
    if not isinstance(in_space, bool):
        raise McaptrackError(f"{entry} has in_space = {in_space!r:.40}; it is True or False")
    return in_space


#: A velocity or size that isn't stated.
UNKNOWN_VECTOR: Vector = (nan, nan, nan)


@dataclass(frozen=True, kw_only=True)
class LabelBoxes:
    """The boxes of a label file, in any order.

    Attributes
    ----------
    boxes : array_like of shape (N, 4) or (N, 7)
        In a picture left, top, width and height in pixels. In space x, y, z (of the centre), length, width and
        height in metres, and heading in radians; what isn't known of any box is NaN.
    frame : array_like of int, shape (N,), optional
        The number of the picture of each box; or ``t_s``.
    t_s : array_like of float, shape (N,), optional
        The time of each box in seconds: since 1970, or since the recording began.
    track_id : array_like of shape (N,), optional
        Numbers from 0 on, or texts; -1 or "" for a box without a track.
    class_name : sequence of str, length N, optional
        "" for a box without a class. Without names all boxes in pictures are taken as people.
    score : array_like of float, shape (N,), optional
        From 0 to 1; NaN for a box without a score.
    labelled : array_like of shape (F,), optional
        The frames, or times, that the file describes, also those without boxes. By default those that have boxes.
    first_frame : int, default 0
        The number of the first picture.
    frame_id : str, default ""
        The frame of reference of boxes in space.
    """

    boxes: ArrayLike
    frame: ArrayLike | None = None
    t_s: ArrayLike | None = None
    track_id: ArrayLike | None = None
    class_name: Sequence[str] | None = None
    score: ArrayLike | None = None
    labelled: ArrayLike | None = None
    first_frame: int = 0
    frame_id: str = ""


class LabelFormat(Protocol):
    """A format of label files.

    May be left out: the class attribute ``in_space`` is True if its boxes are in metres, and not in pictures; a method
    ``recognises(path)`` says whether a file is of this format. It is asked only about files of no built-in format.
    """

    def read(self, path: Path) -> LabelBoxes:
        """Read a file, or a folder. Raise McaptrackError or ValueError, with the place, if it isn't of this format."""
        ...


class Box(NamedTuple):
    """A box in a picture, in pixels; ``score`` is from 0 to 1.

    ``x_px`` and ``y_px`` are the left upper corner, ``w_px`` and ``h_px`` width and height. A score that isn't known is
    NaN, a ``class_name`` "".
    """

    x_px: float
    y_px: float
    w_px: float
    h_px: float
    score: float = nan
    class_name: str = ""


class Box3d(NamedTuple):
    """A box in a frame: its centre, size along its own axes in metres, and orientation (x, y, z, w).

    ``stamp_ns`` is 0 and ``frame_id`` "" where the message states none. ``source_id`` is a number or a text, None where
    there is none. ``velocity`` is along the axes of the frame in m/s. ``has_heading`` is false where the message says
    that the orientation is not known.

    ``score`` is from 0 to 1, NaN where it isn't known; ``class_name`` is "" then.
    """

    stamp_ns: int
    frame_id: str
    centre: Vector
    orientation: Quaternion
    size: Vector
    class_name: str = ""
    score: float = nan
    source_id: int | str | None = None
    velocity: Vector = UNKNOWN_VECTOR
    has_heading: bool = True


class MessageReader(Protocol):
    """A reader of the messages of one type. Its entry point has the name of the type: ``my_msgs/Things``.

    The class attribute ``in_space`` may be left out: it is True if boxes are ``Box3d``, and not ``Box``.
    """

    def read(self, message: Any) -> Sequence[Box] | Sequence[Box3d]:
        """Return the boxes of a message, which has its fields as attributes; keep nothing for the next message."""
        ...


@dataclass(frozen=True, eq=False)
class RecordedChannel:
    """A topic of a recording, which becomes a channel.

    Attributes
    ----------
    topic : str
    schema : tuple of (str, str, bytes)
        Name, encoding and data of the schema record; empty for messages without one.
    encoding : str
        The encoding of its messages, as the MCAP registry names it: "cdr", "ros1", "protobuf", "json", ...
    metadata : mapping of str to str
    """

    topic: str
    schema: tuple[str, str, bytes] = ("", "", b"")
    encoding: str = ""
    metadata: Mapping[str, str] = field(default_factory=dict)


class RecordedMessage(NamedTuple):
    """A message of a recording; times in nanoseconds since 1970.

    By default it was published at ``t_ns``, and ``sequence`` counts the messages of its channel.
    """

    channel: RecordedChannel
    t_ns: int
    payload: bytes
    publish_ns: int | None = None
    sequence: int | None = None


@dataclass
class ReadingNotes:
    """Remarks about a recording (``notes``), and the parts that can't be read (``lost``)."""

    notes: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


class RecordingReader:
    """A recording, open for reading: the base class of what recording formats open.

    Attributes
    ----------
    channels : sequence of RecordedChannel
        All channels, including those without messages.
    profile : str
        That of the MCAP registry, such as "ros2".
    declared_counts : mapping of RecordedChannel to int, optional
        The numbers of messages that the recording states. Fewer are an error, unless something was lost.
    findings : ReadingNotes
        What is found before any message is read.
    closing : contextlib.ExitStack
        Closes its files.
    as_log : Log, optional
        The recording as a log, if it is a single MCAP file.
    """

    channels: Sequence[RecordedChannel] = ()
    profile: str = ""
    declared_counts: Mapping[RecordedChannel, int] | None = None
    as_log: Any = None

    def __init__(self) -> None:
        self.findings: ReadingNotes = ReadingNotes()
        self.closing: ExitStack = ExitStack()

    def close(self) -> None:
        """Close its files."""
        self.closing.close()

    def messages(self, report: ReadingNotes) -> Iterator[RecordedMessage]:
        """All messages in the order of the recording, from the beginning in every call."""
        raise NotImplementedError

    def extras(self, writer: Any, has_clock: bool, is_copied: bool) -> None:
        """Write attachments and metadata by a ``LogWriter``; if ``is_copied``, those that ``as_log`` doesn't hold."""


class RecordingFormat(Protocol):
    """A format of recordings that are no MCAP files.

    A method ``listing(path)`` may be left out: it gives the file beside an MCAP file that lists it as a part of a
    recording, or None. A format that has it has ``update(path)``, too, which is called when that MCAP file has changed.
    """

    def recognises(self, path: Path) -> str:
        """Say what a file or folder is, as in "a ROS 1 bag", by its first bytes or its files; "" for others."""
        ...

    def open(self, path: Path) -> RecordingReader:
        """Open a recording. Raise McaptrackError or ValueError if it can't be read."""
        ...


class Exporter(Protocol):
    """A format of ``export``.

    Class attributes may be left out: ``end`` is the end of the names of files, as in ".speeds.csv"; ``is_folder`` is
    True if it writes a folder, and ``marker`` names a file that each of its folders has: by it, or else by ``end``,
    folders are known that may be replaced.
    """

    def write(self, recording: LogReader, path: Path) -> Mapping[str, int]:
        """Write ``path``, which gets its name when it is complete, from a log that is open for reading.

        Return the number of rows of each table, or channel, that was written. A method with a parameter ``topic`` gets
        the channel that the user has chosen, or None; one with ``progress`` a function to call with "export", and the
        steps that are done and all.
        """
        ...


class Finished(NamedTuple):
    """The report of a finisher on a log, after a run.

    ``value`` is the attribute of ``RunResult`` that has the finisher's name, by topic; ``data`` is the same as values
    of JSON, and ``text`` in a line.
    """

    value: Mapping[str, Any]
    data: Any
    text: str


class SectionTable(NamedTuple):
    """A table of a section: groups of rows, each with a heading and (role, name, topic, cells) of channels of tracks.

    ``columns`` are the heads of the cells. The role gives the colour: "tracks", "samples", "online", "offline" or
    "truth".

    ``caption`` is a sentence above it.
    """

    caption: str
    columns: Sequence[str]
    groups: Sequence[tuple[str, Sequence[tuple[str, str, str, Sequence[str]]]]]


class ReportSection(NamedTuple):
    """A section of the report on a log, by a function that is called with the open log, the prefix of the camera, and
    the names of tracks by their role; it returns None if there is nothing to say.

    ``short`` is its link at the top. ``figures`` are made by ``figure`` of ``mcaptrack.viewing.charts``. ``data``
    stands in the JSON below the name of the section.

    ``title`` is its heading, ``tables`` come before the figures, and ``note`` is a sentence below them.
    """

    short: str
    title: str
    tables: Sequence[SectionTable] = ()
    figures: Sequence[Mapping[str, Any]] = ()
    note: str = ""
    data: Any = None
