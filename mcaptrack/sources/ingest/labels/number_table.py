"""Read text files of numbers line by line, within limits; errors name the line.

Letters: N rows, C columns.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special
from mcaptrack.geometry.arrays import Floats, Ints

#: Line numbers and lines, without empty lines and comments.
Lines = Iterator[tuple[int, str]]

_MAX_ROWS: Final = 10_000_000
_MAX_LINE: Final = 4096
#: Integers from here on are not exact as float64.
EXACT: Final = 2**53
#: Coordinates, in pixels or metres, and scores can't be larger.
MAX_PLACE: Final = 1e8
MAX_SCORE: Final = 1e9
MAX_FRAME: Final = 2**31 - 1
#: The name of the column of frames in messages.
FRAME: Final = "the frame (a count of pictures, no time)"
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


class CheckedRows:
    """Rows of a file whose faults are reported with the place of the row in the file, by ``at``."""

    at: Callable[[int], str]

    def refuse(self, wrong: Any, describe: Callable[[int], str]) -> None:
        """Raise McaptrackError for the first row where ``wrong`` (N,) is true, with its text by ``describe``."""
        if wrong.any():
            row = int(wrong.argmax())
            raise McaptrackError(f"{self.at(row)}: {describe(row)}")

    def whole(self, values: NDArray[Any], what: str, least: int, most: int = EXACT - 1) -> Ints:
        """Values (N,) as whole numbers."""
        wrong = ~((values == np.rint(values)) & (values >= least) & (values <= most))
        self.refuse(wrong, lambda row: f"{what} has to be a whole number from {least} to {most}, not {values[row]:g}")
        return values.astype(np.int64)

    def check_places(self, places: Floats, what: str = "a coordinate", unit: str = "") -> None:
        """Check that no coordinate (N, C) is too large."""
        largest = np.abs(places).max(axis=1, initial=0)
        text = f"at most {MAX_PLACE:g}{unit}"
        self.refuse(largest > MAX_PLACE, lambda row: f"{what} can't be {largest[row]:g}; {text}")

    def check_boxes(self, boxes: Floats) -> None:
        """Check that boxes (N, 4) of left, top, width, height can be some."""
        self.refuse(~np.isfinite(boxes).all(axis=1), lambda _: "a number of the box is missing or not finite")
        self.check_places(boxes)
        self.refuse(
            (boxes[:, 2:] < 0).any(axis=1),
            lambda row: f"a box can't be {boxes[row, 2]:g} wide and {boxes[row, 3]:g} high",
        )

    def check_scores(self, score: Floats) -> None:
        """Check that no score (N,) is too large."""
        self.refuse(np.abs(score) > MAX_SCORE, lambda row: f"a score can't be {score[row]:g}")


class NumberTable(CheckedRows):
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
        line = self.line  # places don't keep the values in memory
        self.at = lambda row: f"{path}:{line[row]}"
