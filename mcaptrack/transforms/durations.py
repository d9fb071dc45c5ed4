"""Durations of tracks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import run_ends, run_starts
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.framing import join_frames


def longest_track_s(frames: Sequence[Frame]) -> float:
    """The duration of the longest track in seconds; the frames have at least one row."""
    joined = join_frames(TRACKS, frames)
    order = np.lexsort((joined.row_ns, joined.rows["track_id"]))
    t_ns, starts = joined.row_ns[order], run_starts(joined.rows["track_id"][order])
    return float((t_ns[run_ends(starts)] - t_ns[starts]).max()) / NS_PER_S
