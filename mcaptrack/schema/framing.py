"""Frames as flat arrays of rows, and back. Letters: F frames, N rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mcaptrack.geometry.arrays import Bools, Ints
from mcaptrack.geometry.ragged import group_index
from mcaptrack.schema import Frame, Rows, Schema
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns

__all__ = [
    "JoinedFrames", "filtered_rows", "frame_numbers", "frame_times", "has_any", "join_frames", "joined_parts",
    "nearest_times", "row_ends", "split_rows", "thinned",
]  # fmt: skip

#: The number of rows that are computed with at once where a channel may have more than fit into memory.
PART_ROWS: Final = 2**16


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
    if isinstance(frames, FrameColumns):
        return frames.t_ns
    return np.fromiter((frame.t_ns for frame in frames), np.int64, len(frames))


def frame_numbers(frames: Sequence[Frame]) -> Ints:
    """The numbers of frames (F,)."""
    if isinstance(frames, FrameColumns):
        return frames.numbers
    return np.fromiter((frame.index for frame in frames), np.int64, len(frames))


def nearest_times(t_ns: Ints, at_ns: Ints) -> Ints:
    """The index of the time in rising ``t_ns`` that is nearest to each of ``at_ns``; the earlier one of two."""
    after = np.clip(np.searchsorted(t_ns, at_ns), 1, max(len(t_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(t_ns) - 1)
    out: Ints = np.where(at_ns - t_ns[before] <= t_ns[after] - at_ns, before, after)
    return out


def row_ends(frames: Sequence[Frame]) -> Ints:
    """The ends of the rows of frames laid end to end, (F + 1,): those of frame f are ``[f]`` to ``[f + 1]``."""
    if isinstance(frames, FrameColumns):
        return frames.ends
    return np.cumsum([0, *(len(frame.rows) for frame in frames)])


def join_frames(schema: Schema, frames: Sequence[Frame], first: int = 0, last: int | None = None) -> JoinedFrames:
    """Lay the rows of frames end to end.

    Parameters
    ----------
    schema : Schema
        Of the rows.
    frames : sequence of Frame
    first, last : int, optional
        Only the frames from ``first`` to before ``last``.

    Returns
    -------
    JoinedFrames
    """
    last = len(frames) if last is None else last
    if isinstance(frames, FrameColumns):
        ends = frames.ends[first : last + 1] - frames.ends[first]
        rows = frames.rows(first, last)
        return JoinedFrames(rows, group_index(np.diff(ends)), frames.t_ns[first:last], ends)
    some = frames if (first, last) == (0, len(frames)) else frames[first:last]
    counts = [len(frame.rows) for frame in some]
    rows = schema.joined([frame.rows for frame in some])
    return JoinedFrames(rows, group_index(counts), frame_times(some), np.cumsum([0, *counts]))


def spans_of(ends: Ints, most: int | None = None) -> Iterator[tuple[int, int]]:
    """First and last of consecutive frames with about ``most`` rows together, or ``PART_ROWS``.

    ``ends`` are as in ``row_ends``.
    """
    low, count, rows = 0, len(ends) - 1, PART_ROWS if most is None else most
    while low < count:
        high = int(np.searchsorted(ends, ends[low] + rows, "right")) - 1
        high = min(max(high, low + 1), low + max(rows, 1), count)
        yield low, high
        low = high


def joined_parts(schema: Schema, frames: Sequence[Frame]) -> Iterator[tuple[int, int, JoinedFrames]]:
    """Frames as ``join_frames`` lays them end to end, some at a time.

    Parameters
    ----------
    schema : Schema
    frames : sequence of Frame

    Yields
    ------
    tuple of int, int and JoinedFrames
        First and last of the frames, and their rows.
    """
    for low, high in spans_of(row_ends(frames)):
        yield low, high, join_frames(schema, frames, low, high)


def mapped_rows(schema: Schema, frames: Sequence[Frame], change: Callable[[JoinedFrames], Rows]) -> FrameColumns:
    """Frames with other values in their rows: ``change`` gives as many rows as it gets, some at a time."""
    out, numbers = FrameCollector(schema), frame_numbers(frames)
    for low, high, joined in joined_parts(schema, frames):
        out.extend(joined.t_ns, numbers[low:high], joined.ends, change(joined))
    return out.done()


def filtered_rows(schema: Schema, frames: Sequence[Frame], keep: Callable[[JoinedFrames], Bools]) -> FrameColumns:
    """Frames with some of their rows: ``keep`` gives a mask (N,) of the rows that it gets, some at a time.

    ``schema`` is that of the rows.
    """
    out, numbers = FrameCollector(schema), frame_numbers(frames)
    for low, high, joined in joined_parts(schema, frames):
        kept = keep(joined)
        ends = np.concatenate([[0], kept.cumsum()])[joined.ends]
        out.extend(joined.t_ns, numbers[low:high], ends, joined.rows[kept])
    return out.done()


def has_any(schema: Schema, frames: Sequence[Frame], holds: Callable[[Rows], NDArray[Any]]) -> bool:
    """Whether any row of frames is one for which ``holds`` gives true; it gets rows (N,) and returns a mask (N,).

    ``schema`` is that of the rows.
    """
    return any(bool(holds(joined.rows).any()) for _, _, joined in joined_parts(schema, frames))


def unique_values(schema: Schema, frames: Sequence[Frame], column: str) -> NDArray[Any]:
    """The different values of a column of all rows, rising."""
    values = np.empty(0, schema.dtype[column])
    for _, _, joined in joined_parts(schema, frames):
        values = np.unique(np.concatenate([values, joined.rows[column]]))
    return values


def thinned(frames: Sequence[Frame], rows: int) -> Sequence[Frame]:
    """Every second, third ... frame, as few as needed to have at most about so many rows; all if these are few."""
    every = -(-int(row_ends(frames)[-1]) // rows)
    return frames if every <= 1 else frames[::every]


def rows_at(schema: Schema, rows: Rows, at: Ints, times: Ints) -> Iterator[Rows]:
    """The rows (N,) of a schema at each of ``times``, rising; those at ``at`` (N,), rising, which are some of these."""
    ends = np.append(0, np.searchsorted(at, times, "right")).tolist()
    rows = schema.check(rows)
    return (rows[low:high] for low, high in pairwise(ends))


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
