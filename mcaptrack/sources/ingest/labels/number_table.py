"""Text files of numbers, line by line, with bounds on everything: what is wrong is said with its line.

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
from mcaptrack.geometry.arrays import Floats, Ints

#: A line that isn't empty and no remark, with its number.
Lines = Iterator[tuple[int, str]]

_MAX_ROWS: Final = 10_000_000
_MAX_LINE: Final = 4096
#: Whole numbers from here on aren't exact where the text is read as floating point.
_EXACT: Final = 2**53
#: How much of a line an error shows.
_SHOWN: Final = 60


def lines_of(path: Path) -> Lines:
    """The lines of a text file. Raises McaptrackError if it can't be read, isn't text or has too long lines."""
    refuse_special(path)
    try:
        with path.open(encoding="utf-8-sig") as stream:
            number = 0
            while line := stream.readline(_MAX_LINE + 1):
                number += 1
                if len(line) > _MAX_LINE:
                    raise McaptrackError(f"{path}:{number}: a line of more than {_MAX_LINE} characters is no row")
                if line.strip() and not line.lstrip().startswith("#"):
                    yield number, line
    except UnicodeDecodeError:
        raise McaptrackError(f"{path} is not a text file, as labels and homographies are") from None
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror}") from None


def split(line: str) -> list[str]:
    """The parts of a line, comma or blank separated."""
    return [part.strip() for part in line.split(",")] if "," in line else line.split()


class Table:
    """Rows of numbers: ``values`` (N, C), and the ``line`` (N,) that each stands in.

    ``parse`` makes the C numbers of the parts of a line, and raises ValueError if they aren't those of a row. ``what``
    names the format and its columns. Raises McaptrackError, with the line, for what is no row and for too many rows.
    """

    def __init__(
        self, path: Path, lines: Lines, what: str, columns: int, parse: Callable[[list[str]], Sequence[float]]
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
                raise McaptrackError(f"{path} has more than {_MAX_ROWS} rows; give it in parts")
        self.values: Floats = np.frombuffer(values, np.float64).reshape(-1, columns)
        self.line: Ints = np.frombuffer(numbers, np.int64)

    def refuse(self, wrong: Any, words: Callable[[int], str]) -> None:
        """Raise McaptrackError for the first row of which ``wrong`` (N,) is true, with what ``words`` say of it."""
        if wrong.any():
            row = int(wrong.argmax())
            raise McaptrackError(f"{self._path}:{self.line[row]}: {words(row)}")

    def within(self, columns: slice, what: str, most: float) -> Floats:
        """Columns (N, C) of finite numbers up to ``most``, in both directions."""
        values = self.values[:, columns]
        self.refuse(~np.isfinite(values).all(axis=1), lambda _: "a number is not finite")
        largest = np.abs(values).max(axis=1, initial=0)
        self.refuse(largest > most, lambda row: f"{what} can't be {largest[row]:g}; at most {most:g}")
        return values

    def whole(self, column: int, what: str, least: int, most: int = _EXACT - 1) -> Ints:
        """A column (N,) of whole numbers."""
        values = self.values[:, column]
        self.refuse(
            ~((values == np.rint(values)) & (values >= least)),
            lambda row: f"{what} has to be a whole number from {least} on, not {values[row]:g}",
        )
        self.refuse(values > most, lambda row: f"{what} can be {most} at most, not {values[row]:.17g}")
        return values.astype(np.int64)
