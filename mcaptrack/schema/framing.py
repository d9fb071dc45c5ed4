"""Frames as flat arrays of rows, and back. Letters: F frames, N rows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.ragged import group_index
from mcaptrack.schema import Frame, Rows, Schema


class JoinedFrames(NamedTuple):
    """The rows of frames end to end (N,); ``frame`` (N,) is the index of each row's frame, ``t_ns`` (F,) their times.

    The rows of frame f are ``ends[f]`` to ``ends[f + 1]``.
    """

    rows: Rows
    frame: Ints
    t_ns: Ints
    ends: Ints

    @property
    def row_ns(self) -> Ints:
        """The time of each row (N,)."""
        return self.t_ns[self.frame]


def frame_times(frames: Sequence[Frame]) -> Ints:
    """The times of frames (F,)."""
    return np.fromiter((frame.t_ns for frame in frames), np.int64, len(frames))


def join_frames(schema: Schema, frames: Sequence[Frame]) -> JoinedFrames:
    """Lay the rows of frames end to end.

    Parameters
    ----------
    schema : Schema
        Of the rows.
    frames : sequence of Frame

    Returns
    -------
    JoinedFrames
    """
    counts = [len(frame.rows) for frame in frames]
    rows = schema.joined([frame.rows for frame in frames])
    return JoinedFrames(rows, group_index(counts), frame_times(frames), np.cumsum([0, *counts]))


def split_rows(t_ns: Iterable[int], index: Iterable[int], rows: Rows, ends: ArrayLike) -> list[Frame]:
    """Cut rows into frames, each from the end of the one before to its own.

    Parameters
    ----------
    t_ns, index : F ints each
        Times and numbers of the frames.
    rows : (N,) structured array
    ends : (F,) of int
        For each frame the index of the row after its last one, rising.

    Returns
    -------
    list of Frame
    """
    last = np.asarray(ends, np.int64).tolist()
    spans = zip(t_ns, index, [0, *last][:-1], last, strict=True)
    return [Frame(int(at), int(number), rows[low:high]) for at, number, low, high in spans]
