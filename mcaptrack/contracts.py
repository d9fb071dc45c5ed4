"""Contracts of label formats, readers of messages and exporters of other packages, and the types that they give.

Each is a class that is made without arguments; finishers and sections of the report are functions. Detectors, trackers
and so on are in ``mcaptrack.transforms.protocol``, predictors in ``mcaptrack.predictors.forecast``; a command is a
function that ``mcaptrack.api.declared`` declares.

Letters: N boxes, F frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from mcaptrack.errors import McaptrackError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from mcaptrack.api.reading import LogReader

__all__ = [
    "UNKNOWN_VECTOR", "Box", "Box3d", "Exporter", "Finished", "LabelBoxes", "LabelFormat", "MessageReader",
    "Quaternion", "ReportSection", "SectionTable", "Vector",
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
    """A box in a picture, in pixels; ``score`` is from 0 to 1."""

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


class Exporter(Protocol):
    """A format of ``export``.

    Class attributes may be left out: ``end`` is the end of the names of files, as in ".speeds.csv"; ``is_folder`` is
    True if it writes a folder.
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
    """

    caption: str
    columns: Sequence[str]
    groups: Sequence[tuple[str, Sequence[tuple[str, str, str, Sequence[str]]]]]


class ReportSection(NamedTuple):
    """A section of the report on a log, by a function that is called with the open log, the prefix of the camera, and
    the names of tracks by their role; it returns None if there is nothing to say.

    ``short`` is its link at the top. ``figures`` are made by ``figure`` of ``mcaptrack.viewing.charts``. ``data``
    stands in the JSON below the name of the section.
    """

    short: str
    title: str
    tables: Sequence[SectionTable] = ()
    figures: Sequence[Mapping[str, Any]] = ()
    note: str = ""
    data: Any = None
