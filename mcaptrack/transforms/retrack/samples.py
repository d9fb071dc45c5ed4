"""The samples that are re-tracked: the columns that are computed with in memory, whole rows in a temporary file.

A person who is seen for an hour has 9,000 samples at 2.5 Hz. What re-tracking may hold for each of them, from the first
step to the last, are numbers: the columns below (33 bytes), assignments, the states of its filters, and what is seen of
it (74 bytes, see ``appearance``). Rows of tracks (153 bytes) and of predictions (840 bytes for each sample) are made
part by part, and kept as ``FrameColumns``, most of which is not in memory. Letters: N samples, F frames.
"""

from __future__ import annotations

from array import array
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Ints
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import joined_parts

#: The columns of samples that are held in memory.
HELD: Final = ("track_id", "class_id", "x_m", "y_m", "score", "observed")


class LogSamples:
    """The samples of one log: ``add`` each frame, then read them."""

    def __init__(self) -> None:
        self._collector = FrameCollector(TRACKS)
        self._held = {name: bytearray() for name in HELD}
        self._counts = array("q")

    def add(self, frame: Frame) -> None:
        """Add the samples of a frame."""
        for name, held in self._held.items():
            held.extend(frame.rows[name].tobytes())
        self._counts.append(len(frame.rows))
        self._collector.append(frame)

    def extend(self, t_ns: Ints, numbers: Ints, ends: Ints, rows: Rows) -> None:
        """Add the samples of F frames at once; the arguments are those of ``FrameCollector.extend``."""
        for name, held in self._held.items():
            held.extend(rows[name].tobytes())
        self._counts.extend(np.diff(ends).tolist())
        self._collector.extend(t_ns, numbers, ends, rows)

    def __len__(self) -> int:
        return len(self._held["observed"])

    @property
    def counts(self) -> Ints:
        """The number of samples of each frame, (F,)."""
        return np.array(self._counts, np.int64)

    def column(self, name: str) -> NDArray[Any]:
        """A column of all samples, (N,). One that isn't ``HELD`` is read from the file."""
        if name in self._held:
            return np.frombuffer(bytes(self._held[name]), TRACKS.dtype[name])
        parts = [part.rows[name].copy() for _, _, part in joined_parts(TRACKS, self._frames)]
        return np.concatenate([np.empty(0, TRACKS.dtype[name]), *parts])

    @cached_property
    def _frames(self) -> FrameColumns:
        return self._collector.done()

    def take(self, places: Ints) -> Rows:
        """The rows of samples, as many as there are ``places``; nothing can be added any more."""
        return self._frames.take(places)
