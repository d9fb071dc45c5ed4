"""The appearance of tracks as rows: the mean histograms of the pictures in which they are seen clearly.

Letters: S descriptors, T frames, K tracks.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.colour_histograms import BINS, mean_shares
from mcaptrack.schema import APPEARANCE, BodyPart, Rows
from mcaptrack.transforms.retrack.appearance import Descriptors


def appearance_rows(descriptors: Descriptors, track: Ints, times_ns: Ints) -> Iterator[Rows]:
    """The rows of Appearance at each of ``times_ns`` (T,), ordered by track and part of the body.

    ``track`` (S,) is the track that each descriptor is of, or -1. The rows of a track stand at the last of its
    descriptors that count, which is at one of the times; a track without any has none.
    """
    used = np.flatnonzero(descriptors.is_clear & (track >= 0))
    ids, group = np.unique(track[used], return_inverse=True)
    t_ns = descriptors.t_ns[used]
    first, last = np.full(len(ids), np.iinfo(np.int64).max), np.zeros(len(ids), np.int64)
    np.minimum.at(first, group, t_ns)
    np.maximum.at(last, group, t_ns)
    rows = APPEARANCE.empty(len(ids) * len(BodyPart))
    of_parts = {
        "track_id": ids,
        "pictures": np.bincount(group, minlength=len(ids)),
        "duration_s": (last - first) / NS_PER_S,
    }
    for name, values in of_parts.items():
        rows[name] = np.repeat(values, len(BodyPart))
    rows["body_part"] = np.tile(list(BodyPart), len(ids))
    shares = mean_shares(descriptors.values[used], group, len(ids)).reshape(len(rows), len(BINS))
    for name, column in zip(BINS, shares.T, strict=True):
        rows[name] = column
    at = np.repeat(last, len(BodyPart))
    order = np.argsort(at, kind="stable")
    ends = np.append(0, np.searchsorted(at[order], times_ns, "right")).tolist()
    rows = APPEARANCE.check(rows.take(order))
    yield from (rows[low:high] for low, high in pairwise(ends))
