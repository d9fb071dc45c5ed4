"""Read text files of numbers line by line, within limits; errors name the line.

Letters: N rows, C columns.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special
from mcaptrack.geometry.affine import IDENTITY, compose, scale_of
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.camera_path import Verdict, poses_of
from mcaptrack.schema import Frame
from mcaptrack.schema.camera_motion import is_motion, pose_to_rows

#: Line numbers and lines, without empty lines and comments.
Lines = Iterator[tuple[int, str]]

_MAX_ROWS: Final = 10_000_000
_MAX_LINE: Final = 4096
#: Integers from here on are not exact as float64.
EXACT: Final = 2**53
#: The number of characters of a line that errors show.
_SHOWN: Final = 60


def lines_of(path: Path, most: int = _MAX_LINE, has_comments: bool = False) -> Lines:
    """The lines of a text file, of at most ``most`` characters, without empty lines and, unless they are wanted,
    comments.

    Raises McaptrackError if it can't be read, isn't text, or has longer lines.
    """
    refuse_special(path)
    try:
        with path.open(encoding="utf-8-sig") as stream:
            number = 0
            while line := stream.readline(most + 1):
                number += 1
                if len(line) > most:
                    raise McaptrackError(f"{path}:{number}: a line of more than {most} characters is no row")
                if line.strip() and (has_comments or not line.lstrip().startswith("#")):
                    yield number, line
    except UnicodeDecodeError:
        raise McaptrackError(f"{path} is not text in UTF-8, as labels and homographies are") from None
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror}") from None


def split(line: str) -> list[str]:
    """Split a line at commas, or at blanks if it has no commas."""
    return [part.strip() for part in line.split(",")] if "," in line else line.split()


class NumberTable:
    """Rows of numbers: ``values`` (N, C), and their line numbers ``line`` (N,).

    ``parse`` converts the parts of a line to C numbers, and raises ValueError if they are not a valid row. ``what``
    names the format and its columns. Raises McaptrackError, with the line, for an invalid row and for too many rows.
    """

    def __init__(
        self,
        path: Path,
        lines: Lines,
        what: str,
        columns: int,
        parse: Callable[[list[str]], Sequence[float]],
        split: Callable[[str], list[str]] = split,
    ) -> None:
        self._path = path
        values, numbers = array("d"), array("q")
        for number, line in lines:
            try:
                values.extend(parse(split(line)))
            except ValueError as error:
                why = str(error) if "column" in str(error) else "not all are numbers"
                raise McaptrackError(f"{path}:{number}: not {what}, {why}: {line.strip()[:_SHOWN]}") from None
            numbers.append(number)
            if len(numbers) > _MAX_ROWS:
                raise McaptrackError(
                    f"{path} has more than {_MAX_ROWS} rows; give it in parts, or as detections or tracks of "
                    "MOTChallenge, sorted by frame"
                )
        self.values: Floats = np.frombuffer(values, np.float64).reshape(-1, columns)
        self.line: Ints = np.frombuffer(numbers, np.int64)

    def refuse(self, wrong: Any, describe: Callable[[int], str]) -> None:
        """Raise McaptrackError for the first row where ``wrong`` (N,) is true, with its text by ``describe``."""
        if wrong.any():
            row = int(wrong.argmax())
            raise McaptrackError(f"{self._path}:{self.line[row]}: {describe(row)}")

    def within(self, columns: slice, what: str, most: float) -> Floats:
        """Columns (N, C) of finite numbers with absolute values up to ``most``."""
        values = self.values[:, columns]
        self.refuse(~np.isfinite(values).all(axis=1), lambda _: "a number is not finite")
        largest = np.abs(values).max(axis=1, initial=0)
        self.refuse(largest > most, lambda row: f"{what} can't be {largest[row]:g}; at most {most:g}")
        return values

    def whole(self, column: int, what: str, least: int, most: int = EXACT - 1) -> Ints:
        """A column (N,) of whole numbers."""
        values = self.values[:, column]
        self.refuse(
            ~((values == np.rint(values)) & (values >= least)),
            lambda row: f"{what} has to be a whole number from {least} on, not {values[row]:g}",
        )
        self.refuse(values > most, lambda row: f"{what} can be {most} at most, not {values[row]:.17g}")
        return values.astype(np.int64)


# Read published motions of cameras: a 2x3 transform per frame, from pixels of the frame before. Letters: F frames.


_COLUMNS: Final = 7
#: The largest zoom from one frame to the next.
_MOST_ZOOM: Final = 4.0
_KIND: Final = "a camera motion (frame,m00,m01,m02,m10,m11,m12: 7 columns)"


def read_motions(path: Path) -> Floats:
    """Read the motions (F, 2, 3) of frames 0 to F - 1 from a text file.

    Raises McaptrackError, with the line, for anything else.
    """
    table = NumberTable(path, lines_of(path), _KIND, _COLUMNS, _parse)
    if not len(table.values):
        raise McaptrackError(f"{path} holds no camera motion")
    frame, motions = table.values[:, 0], table.values[:, 1:].reshape(-1, 2, 3)
    table.refuse(
        frame != np.arange(len(frame)),
        lambda row: f"frame {frame[row]:g} is not {row}: frames count from 0, without gaps",
    )
    wrong = np.array([not is_motion(motion) for motion in motions])
    table.refuse(wrong, lambda row: "the motion is not finite, or can't be inverted")
    scale = np.array([scale_of(motion) for motion in motions])
    table.refuse(
        (scale > _MOST_ZOOM) | (scale < 1 / _MOST_ZOOM),
        lambda row: f"the motion enlarges the picture {scale[row]:.3g} times; no camera does that in a frame",
    )
    return motions


def _parse(parts: list[str]) -> list[float]:
    if len(parts) != _COLUMNS:
        raise ValueError(f"{len(parts)} columns")
    return [float(part) for part in parts]


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
