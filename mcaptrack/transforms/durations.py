"""How long tracks last."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import TRACKS, Frame


def longest_track_s(frames: Sequence[Frame]) -> float:
    """The duration of the longest track of some frames, in seconds. They have at least one row."""
    rows = TRACKS.joined([frame.rows for frame in frames])
    t_ns = np.repeat(np.array([frame.t_ns for frame in frames], np.int64), [len(frame.rows) for frame in frames])
    order = np.lexsort((t_ns, rows["track_id"]))
    ids, t_ns = rows["track_id"][order], t_ns[order]
    first = np.flatnonzero(np.append(True, ids[1:] != ids[:-1]))
    last = np.append(first[1:], len(ids)) - 1
    return float((t_ns[last] - t_ns[first]).max()) / NS_PER_S
