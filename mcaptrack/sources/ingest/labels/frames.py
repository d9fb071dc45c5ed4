"""Which frames a label file is about: from which number it counts them, and which of them were labelled.

Only what a file states is known. Where it states neither, its numbers follow those of the files beside it, and frames
before its first and after its last label are taken as not labelled if they are more than a tenth of all; both is said.

Letters: P pictures, F frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Ints
from mcaptrack.notices import warn
from mcaptrack.sources.ingest.labels.table import MAX_FRAME, BoxTable
from mcaptrack.sources.ingest.labels.text import is_count
from mcaptrack.sources.video import find_seqinfo

#: Labels cover all frames if they cover this share of them.
_COVERED: Final = 0.9
#: Formats in which some programs count frames from 0 and others from 1.
_EITHER: Final = ("mot", "csv")
#: The number of frames of a log, at most: more than three days at 30 frames a second. Numbers have so many digits.
MAX_FRAMES: Final = 10_000_000
_DIGITS: Final = 10
#: The number of the first frame, at most.
_LAST_FIRST: Final = 10**12


@dataclass(frozen=True)
class FrameRanges:
    """Frames by their numbers: from the first of each range up to its end, which isn't in it; None is open."""

    ranges: tuple[tuple[int | None, int | None], ...]

    def hold(self, number: Ints) -> Bools:
        """Mask the numbers (P,) that are in one of the ranges."""
        out = np.zeros(len(number), bool)
        for first, end in self.ranges:
            out |= (number >= (0 if first is None else first)) & (number < (MAX_FRAME + 1 if end is None else end))
        return out

    def __str__(self) -> str:
        """The ranges as ``--frames`` takes them."""
        return ",".join(":".join("" if end is None else str(end) for end in ends) for ends in self.ranges)


class Frames(NamedTuple):
    """The meaning of ``--frames``: a number of frames, or those that were labelled; None: it doesn't say."""

    number: int | None = None
    ranges: FrameRanges | None = None

    @classmethod
    def parse(cls, value: int | str | None) -> Self:
        """Read a number of frames, or ranges: 100:110, 100:, :50 or 0:10,50:60. Raises McaptrackError."""
        text = "" if value is None else str(value).replace(" ", "")
        if value is None:
            return cls()
        if is_count(text, _DIGITS) and 0 < int(text) <= MAX_FRAMES:
            return cls(number=int(text))
        parts = [part.split(":") for part in text.split(",")]
        if all(len(ends) == 2 and all(not end or is_count(end, _DIGITS) for end in ends) for ends in parts):
            ranges = [(int(first) if first else None, int(end) if end else None) for first, end in parts]
            if all(end is None or (first or 0) < end for first, end in ranges):
                return cls(ranges=FrameRanges(tuple(ranges)))
        raise McaptrackError(
            f"`frames=` is a number of frames from 1 to {MAX_FRAMES}, or ranges like 100:110 (frames 100 to 109), 100: "
            f"or 0:10,50:60, not {value!r:.40}"
        )


def parse_first_frames(value: int | str | Mapping[str, int] | None) -> int | dict[str, int] | None:
    """Read the number of the first picture: of all files, or by their roles as in "tracks=0,truth=1".

    Raises McaptrackError.
    """
    if value is None:
        return None
    entries = value if isinstance(value, Mapping) else dict(part.partition("=")[::2] for part in str(value).split(","))
    entries = {name.strip(): str(number).strip() for name, number in entries.items()}
    if [*entries.values()] == [""]:  # a number alone
        entries = {"": next(iter(entries))}
    roles = ("", "detections", "tracks", "truth", "corrections")
    if all(name in roles and is_count(number, 13) and int(number) <= _LAST_FIRST for name, number in entries.items()):
        numbers = {name: int(number) for name, number in entries.items()}
        return numbers.get("", numbers)
    raise McaptrackError(
        f"`first_frame=` is a whole number from 0 to {_LAST_FIRST}, or one for each kind of file as in "
        f"tracks=0,truth=1, not {value!r:.40}"
    )


class Numbered(NamedTuple):
    """Labels with numbers of frames: what they are called in messages, their format, the number of the first picture,
    and the numbers of the first and of the last labelled one.
    """

    name: str
    format: str
    first: int
    least: int
    last: int

    @classmethod
    def of(cls, labels: BoxTable) -> Self:
        """The numbers of a label file."""
        least, last = int(labels.labelled[0]), int(labels.labelled[-1])
        return cls(str(labels.path), labels.format, labels.first_frame, least, last)

    def has_numbers_of(self, labels: BoxTable) -> bool:
        """Whether these are of the same frames as those of a file, by their numbers."""
        return (self.least, self.last) == (int(labels.labelled[0]), int(labels.labelled[-1]))

    def is_like(self, labels: BoxTable) -> bool:
        """Whether a file may be expected to count frames from the same number."""
        return self.format == labels.format or {self.format, labels.format} <= set(_EITHER)


def _counts(labels: BoxTable) -> bool:
    """Whether a file has frames by number."""
    return labels.times_s is None and not labels.facts.is_timed and len(labels.labelled) > 0


def share_numbers(tables: Mapping[Role, BoxTable], log: Sequence[Numbered] = ()) -> None:
    """Let files that don't tell their first number count frames as the files and labels of the log beside them do.

    A file without a frame 0 counts from 0 if labels beside it do: a tracker may have seen nothing there. It counts from
    1 if it has as many frames as those, or is ground truth that begins with 1, as data sets do.
    """
    counting = {role: labels for role, labels in tables.items() if _counts(labels)}
    others = [*log, *map(Numbered.of, counting.values())]
    for role, labels in counting.items():
        if not labels.facts.is_first_assumed:
            continue
        first, last = int(labels.labelled[0]), int(labels.labelled[-1])
        beside = [entry for entry in others if entry.name != str(labels.path)]
        zero = next((entry for entry in beside if entry.first == entry.least == 0 and entry.is_like(labels)), None)
        if zero is not None and not (first == 1 and (last == zero.last + 1 or (role == "truth" and last != zero.last))):
            _count_from(labels, zero)
        elif labels.first_frame > 1 and beside:  # images with numbers that begin later
            _count_from(labels, next((entry for entry in beside if entry.has_numbers_of(labels)), beside[0]))


def _count_from(labels: BoxTable, like: Numbered) -> None:
    """Set the first number of a file to that of other labels, if these are of its kind, and otherwise to 0."""
    is_like = like.is_like(labels) or like.has_numbers_of(labels)
    labels.facts.first_frame = like.first if is_like else 0
    labels.findings = [finding for finding in labels.findings if finding.code != "clock"]
    text = f": frames begin with {labels.labelled[0]}, and are taken to count from {labels.first_frame}"
    text += f", as those of {like.name} do" if is_like else ""
    labels.find(f"{text}; `first_frame=` sets the number of the first picture", "clock")


def warn_of_firsts(tables: Iterable[BoxTable]) -> None:
    """Warn of files that count frames from different numbers."""
    counting = filter(_counts, tables)
    firsts = {labels.first_frame: f"frame {labels.first_frame} of {labels.path}" for labels in counting}
    if len(firsts) > 1:
        text = f"{' and '.join(firsts.values())} are assumed to be the same picture"
        warn(f"{text}; `first_frame=` sets the number", "clock")


class Described(NamedTuple):
    """The pictures that a file describes, as a mask (P,); the ranges of frames that were labelled, None if it is all of
    them; and how these are known.
    """

    pictures: Bools
    ranges: FrameRanges | None = None
    by: str = ""


def described(labels: BoxTable, role: Role, number: Ints, at: Ints, ranges: FrameRanges | None, of: str) -> Described:
    """Which pictures a file describes, whether or not there are boxes in them; warns of what is assumed.

    Parameters
    ----------
    labels : BoxTable
    role : str
        Of detections and tracks all frames count, also before the first box and after the last one.
    number : int array (P,)
        The numbers of the pictures in the file, rising.
    at : int array (F,)
        The numbers that have labels, or that the file states to be labelled, rising.
    ranges : FrameRanges, optional
        What ``--frames`` says.
    of : str
        What the pictures are, for messages.

    Returns
    -------
    Described

    Raises
    ------
    McaptrackError
        If none of the frames that ``--frames`` names is labelled.
    """
    first, last, step = int(at[0]), int(at[-1]), labels.step_of(at)
    is_labelled: Bools = np.isin(number, at) if labels.facts.states_labelled else (number - first) % step == 0
    if ranges is not None:
        is_labelled &= ranges.hold(number)
        if not ranges.hold(at).any():
            raise McaptrackError(
                f"{labels.path}: none of the frames {ranges} is labelled; it has labels of frames {first} to {last}"
            )
        frames, counts = labels.extent.frames
        if labels.times_s is None and (outside := int(counts[~ranges.hold(frames)].sum())):
            warn(f"{labels.path}: {outside} labels are of frames outside of {ranges}; they are left out", "left-out")
        return Described(is_labelled, ranges, "frames")
    beyond = (number < first) | (number > last)
    span = FrameRanges(((first, last + 1),)) if beyond.any() else None
    if role == "corrections":  # frames beyond those that were looked at stay as they are
        return Described(is_labelled & ~beyond)
    if labels.facts.states_labelled:
        return Described(is_labelled, span, "file" if span else "")
    before, after = max(first - int(number[0]), 0) // step, max(int(number[-1]) - last, 0) // step
    covered = (last - first) // step + 1
    if role != "truth" or covered >= _COVERED * (before + covered + after) or _is_of_sequence(labels):
        return Described(is_labelled)
    warn(
        f"{labels.path} has labels from frame {first} to {last}, which are less than {_COVERED:.0%} of {of}: the "
        f"others are taken as not labelled, and count in no score; `frames='{span}'` names those that are labelled",
        "labelled",
    )
    return Described(is_labelled & ~beyond, span, "labels")


def _is_of_sequence(labels: BoxTable) -> bool:
    """Whether labels are of a whole sequence: a seqinfo.ini beside them counts its frames."""
    info = find_seqinfo(labels.path.parent)
    return info is not None and info.frames is not None
