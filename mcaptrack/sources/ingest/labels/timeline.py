"""Assign labelled frames to pictures and their times, in one way for all inputs.

Label files number pictures, from 0 or 1 depending on the format. Frame ``first_frame`` of a file is picture 0 of the
camera, the next frame is picture 1, and so on: for pictures that are ingested together with the labels, for pictures of
an existing log, and for missing pictures, with times by a frame rate.

Letters: P pictures, F labelled frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Final, NamedTuple, Self

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.sources.ingest.labels.formats import Labels

#: The largest frame number: more than three days at 30 frames a second.
MAX_FRAMES: Final = 10_000_000
#: Limits for unlabelled frames of a file without pictures: in total, and for each labelled frame.
_EMPTY_FRAMES: Final = 100_000
_EMPTY_A_LABELLED: Final = 100
#: Pictures match a frame rate if none deviates by more than this share of a frame.
_OFF_FRAMES: Final = Fraction(1, 2)


class Placed(NamedTuple):
    """The labelled frames of a file (F,): their numbers in the file, picture indexes from 0, and times in ns."""

    number: Ints
    index: Ints  # type: ignore[assignment]  # hides tuple.index, which is not needed here
    t_ns: Ints


@dataclass(frozen=True)
class Timeline:
    """The pictures of a camera: ``index`` (P,), counted from 0, and ``t_ns`` (P,), both strictly increasing.

    ``of`` describes them in messages. ``is_complete`` is false if pictures are known to be lost. ``every`` is the step
    of the numbers in their names: 12 for images of which every twelfth was kept with its number.
    """

    index: Ints
    t_ns: Ints
    of: str
    is_complete: bool = True
    every: int = 1

    @classmethod
    def spaced(cls, count: int, fps: Fraction, start_ns: int, of: str) -> Self:
        """``count`` pictures at a frame rate, the first at ``start_ns``.

        Raises McaptrackError if they end after 2262, the limit of int64 nanoseconds.
        """
        index = np.arange(count)
        last_ns = start_ns + round(Fraction(max(count - 1, 0)) / fps * NS_PER_S)
        if last_ns > LAST_NS:
            raise McaptrackError(
                f"{of}: {count} frames at {float(fps):g} a second end {float(count / fps) / 86400:.3g} days after the "
                "start; times reach to the year 2262"
            )
        return cls(index, start_ns + _times(index, fps), of)

    def fits(self, fps: Fraction) -> bool:
        """Whether the pictures match a frame rate, within half a frame."""
        wanted = self.t_ns[0] + _times(self.index - self.index[0], fps)
        return bool((np.abs(self.t_ns - wanted) <= float(_OFF_FRAMES / fps * NS_PER_S)).all())

    @property
    def fps(self) -> float:
        """Frame rate by the median interval; 0 if there are less than two pictures."""
        gaps = np.diff(self.t_ns) / np.diff(self.index)
        return NS_PER_S / float(np.median(gaps)) if len(gaps) else 0.0

    def place(self, path: Path, labels: Labels, lost: list[str]) -> Placed:
        """Assign the labelled frames of a file to pictures, including frames without labels in between.

        Raises McaptrackError if there are labels before the first or after the last picture. If pictures are known to
        be lost, such labels are reported in ``lost`` instead.
        """
        every = self._every(path, labels)
        at = (labels.frame - labels.first_frame) // every
        end = int(self.index[-1]) + 1
        if at[0] < 0:
            raise McaptrackError(
                f"{path}: its first label is of frame {labels.frame[0]}, and frame {labels.first_frame} is assumed to "
                "be the first picture; give the right number with `first_frame=`"
            )
        beyond = int((at >= end).sum())
        if beyond and (self.is_complete or beyond == len(at)):
            raise McaptrackError(self._beyond(path, labels, beyond, every * (end - 1) + labels.first_frame))
        if beyond:
            lost.append(f"{path}: {beyond} labels are of frames after the last picture that could be read, {end - 1}")
        missing = ~np.isin(at[at < end], self.index)
        if missing.any():
            lost.append(f"{path}: {int(missing.sum())} labels are of frames with missing pictures")
        step = labels.step // every or 1
        known = self.index % step == (int(labels.labelled[0]) - labels.first_frame) // every % step
        return Placed(every * self.index[known] + labels.first_frame, self.index[known], self.t_ns[known])

    def _every(self, path: Path, labels: Labels) -> int:
        """The step of frame numbers in a label file, which may use the numbers in the names of images."""
        if self.every == 1 or ((labels.labelled - labels.first_frame) % self.every).any():
            return 1
        if int(labels.labelled[-1]) > labels.first_frame:
            warn(f"{path} counts frames as the names of {self.of} do, every {self.every}", "clock")
        return self.every

    def _beyond(self, path: Path, labels: Labels, beyond: int, end: int) -> str:
        """The error for labels after frame ``end`` of the file, the last picture."""
        first, last = int(labels.frame[0]), int(labels.frame[-1])
        some = "all" if beyond == len(labels.frame) else beyond
        words = (
            f"{path}: {some} labels are of frames after the last picture: {self.of} end with frame "
            f"{end}, the labels with frame {last}"
        )
        if last - first <= end - labels.first_frame and first != labels.first_frame:
            return f"{words}; if frame {first} of the file is the first picture, say so with `first_frame={first}`"
        return f"{words}; give the labels of these pictures, or the part of the file that is of them"


def _times(index: Ints, fps: Fraction) -> Ints:
    """The times of pictures (P,) at a frame rate in nanoseconds, rounded half to even."""
    most = int(np.abs(index).max(initial=1)) * fps.denominator * NS_PER_S
    if most >= 2**62 or fps.numerator >= 2**62:
        return np.array([round(Fraction(int(number)) / fps * NS_PER_S) for number in index], np.int64)
    whole, rest = np.divmod(index * (fps.denominator * NS_PER_S), fps.numerator)
    rounded: Ints = whole + ((2 * rest > fps.numerator) | ((2 * rest == fps.numerator) & (whole % 2 == 1)))
    return rounded


def count_frames(path: Path, labels: Labels) -> int:
    """The number of frames up to the last one that a file labels.

    Raises McaptrackError if nearly all of them would be empty, which means that the numbers are wrong.
    """
    last = max(int(labels.labelled[-1]), int(labels.frame[-1]))
    count = last - labels.first_frame + 1
    most = max(_EMPTY_FRAMES, _EMPTY_A_LABELLED * len(labels.labelled) * labels.step)
    if count > min(most, MAX_FRAMES):
        first = f"give the number of the first picture with `first_frame={labels.labelled[0]}`"
        mend = f"`frames={count}` takes it so" if count <= MAX_FRAMES else f"at most {MAX_FRAMES} are read"
        raise McaptrackError(
            f"{path}: frame {last} would be the last of {count} frames, of which {len(labels.labelled)} are labelled; "
            f"{mend}, or {first}"
        )
    return count
