"""The rows of a channel in the order of its table, some at a time: a channel may have more than fit into memory.

Rows of tracks are stored track by track. They are divided into groups of whole tracks, each of which fits into memory
and is put in order by itself; a large channel is divided by way of a temporary file.

Letters: N rows, G groups.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Ints
from mcaptrack.schema import Rows, Schema
from mcaptrack.schema.frame_columns import FrameColumns
from mcaptrack.schema.framing import joined_parts
from mcaptrack.schema.spill import SpillFile, Stored

#: Rows of a group, unless one track has more; and how many groups there are at most, each of which has a buffer.
GROUP_ROWS: Final = 2**15
_MOST_GROUPS: Final = 256
#: Bytes of a group that are collected before they go into the file.
_BUFFER_BYTES: Final = 2**16
_BITS: Final = 16


class OrderedRows(NamedTuple):
    """Rows (N,) of a channel: themselves, the place of each among all of the channel, and the number of its frame."""

    rows: Rows
    place: Ints
    frame: Ints


def ordered_rows(schema: Schema, frames: FrameColumns, by_track: bool) -> Iterator[OrderedRows]:
    """All rows of a channel, some at a time: by time, or by track and then by time.

    Parameters
    ----------
    schema : Schema
        Of the rows; with ``by_track`` it has a column ``track_id``.
    frames : FrameColumns
    by_track : bool
        Whether the rows of each track are together; then no track is in two parts.

    Yields
    ------
    OrderedRows
    """
    if not by_track:
        for low, _, joined in joined_parts(schema, frames):
            first = int(frames.ends[low])
            yield OrderedRows(joined.rows, np.arange(first, first + len(joined.rows)), joined.frame + low)
    elif frames.ends[-1] <= GROUP_ROWS:
        yield _by_track(frames, frames.rows(), np.arange(frames.ends[-1]))
    else:
        yield from _divided(schema, frames)


def _by_track(frames: FrameColumns, rows: Rows, place: Ints) -> OrderedRows:
    """Put rows (N,) at places among all rows, which rise, in the order of their tracks."""
    order = stable_order(rows["track_id"])
    place = place[order]
    return OrderedRows(rows[order], place, np.searchsorted(frames.ends, place, "right") - 1)


def _divided(schema: Schema, frames: FrameColumns) -> Iterator[OrderedRows]:
    """All rows in groups of whole tracks."""
    last_of_group = _groups(schema, frames)
    layout = np.dtype([("place", np.int64), ("row", np.uint8, (schema.dtype.itemsize,))])
    waiting: list[list[NDArray[np.void]]] = [[] for _ in last_of_group]
    stored: list[list[Stored]] = [[] for _ in last_of_group]
    file = SpillFile()

    def put(group: int) -> None:
        stored[group].append(file.put(np.concatenate(waiting[group]).tobytes()))
        waiting[group].clear()

    for low, _, joined in joined_parts(schema, frames):
        group = np.searchsorted(last_of_group, joined.rows["track_id"])
        order = np.argsort(group, kind="stable")
        members = np.empty(len(order), layout)
        members["place"] = frames.ends[low] + order
        members["row"] = joined.rows.view(np.uint8).reshape(len(order), -1)[order]
        found, starts = np.unique(group[order], return_index=True)
        for one, some in zip(found.tolist(), np.split(members, starts[1:]), strict=True):
            waiting[one].append(some.copy())  # a part of ``members`` would keep all of it
            if sum(part.nbytes for part in waiting[one]) >= _BUFFER_BYTES:
                put(one)
    for one in range(len(last_of_group)):
        if waiting[one]:
            put(one)
        members = np.frombuffer(b"".join(file.get(piece) for piece in stored[one]), layout)
        rows = np.ascontiguousarray(members["row"]).view(schema.dtype)[:, 0]
        yield _by_track(frames, rows, members["place"])


def _groups(schema: Schema, frames: FrameColumns) -> Ints:
    """The last track of each group, (G,), rising."""
    ids, counts = np.empty(0, np.int64), np.empty(0, np.int64)
    for _, _, joined in joined_parts(schema, frames):
        some, here = np.unique(joined.rows["track_id"].astype(np.int64), return_counts=True)
        ids, which = np.unique(np.concatenate([ids, some]), return_inverse=True)
        counts = np.bincount(which, np.concatenate([counts, here]), len(ids)).astype(np.int64)
    group = (np.cumsum(counts) - 1) // max(GROUP_ROWS, int(counts.sum()) // _MOST_GROUPS)
    return np.asarray(ids[np.append(np.flatnonzero(np.diff(group)), len(ids) - 1)], np.int64)


def stable_order(values: NDArray[np.integer]) -> Ints:
    """A stable argsort of whole numbers, 16 bits at a time, for which NumPy uses radix sort."""
    if len(values) == 0:
        return np.empty(0, np.int64)
    low, high = int(values.min()), int(values.max())
    order = np.arange(len(values))
    rest = values.astype(np.uint64) - np.uint64(low % 2**64)
    for shift in range(0, max((high - low).bit_length(), 1), _BITS):
        digit = (rest >> np.uint64(shift)).astype(np.uint16)
        order = order[np.argsort(digit[order], kind="stable")]
    return order
