"""Positions of people in metres, with a label every 0.4 s: TrajNet (``frame id x y``), and the matrices of observations
of ETH (``frame id x z y vx vz vy``).
"""

from __future__ import annotations

from fractions import Fraction
from typing import ClassVar, Final

import numpy as np

from mcaptrack.schema.classes import PERSON
from mcaptrack.sources.ingest.labels.delimited import is_table
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import read_numbers

#: The label interval of files that are annotated at the sampling rate of prediction benchmarks.
INTERVAL_S: Final = Fraction(2, 5)


class _Positions(Format):
    """Rows of numbers: a frame, a track, and others, two of which are a position."""

    in_parts = True
    columns: ClassVar[int]
    place: ClassVar[slice]

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a file."""
        values, at = read_numbers(file.path, file.lines(), f"{self.title} ({self.row.strip('`')})", self.columns)
        facts = LabelFacts(file.path, first_frame=0, interval_s=INTERVAL_S, named_by="format")
        facts.clock_of = f"{self.name}, a label every 0.4 s"
        return BoxTable(
            facts=facts, at=at, frame=values[:, 0], id=values[:, 1], xy_m=values[:, self.place],
            score=np.full(len(values), np.nan), class_id=np.full(len(values), PERSON),
        )  # fmt: skip


class Trajnet(_Positions):
    """Rows of TrajNet, separated by commas or blanks."""

    title, row, columns, place = "TrajNet", "`frame id x y`", 4, slice(2, 4)

    def recognises(self, file: LabelFile) -> bool:
        """Whether the first row has 4 columns, and no names of columns."""
        return len(file.cells) == self.columns and not is_table(file)


class Obsmat(_Positions):
    """Rows of an ETH obsmat, separated by blanks."""

    title, row = "ETH obsmat", "`frame id x z y vx vz vy`"
    columns, place = 8, slice(2, 5, 2)

    def recognises(self, file: LabelFile) -> bool:
        """Whether the first row has 8 columns without commas."""
        return len(file.cells) == self.columns and "," not in file.row and not is_table(file)
