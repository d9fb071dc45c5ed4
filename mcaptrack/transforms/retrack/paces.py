"""The paces of two people before and after they meet, as evidence of which is which.

While people give way to each other their paths are hard to predict, and what they do is soon forgotten by a filter. But
who came fast mostly goes on fast, and who stood stands.

Letters: C encounters, N rows of trajectories.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.transforms.retrack.motion_model import Trajectories

#: A pace is that of so many seconds before or after an encounter at most, and at least. (Chosen on synthetic scenes.)
_MOST_S, _LEAST_S = 8.0, 1.2
#: How much a pace changes over an encounter, in m/s, and the most that paces count as a log likelihood: less than that
#: both keep their input ids, because people who meet also stop.
_CHANGE_M_PER_S: Final = 0.4
_MOST: Final = 3.0


def swapped_by_pace(
    trajectories: Trajectories, pair: Ints, meet: Ints, part_ways: Ints, step_s: float, noise_m: float
) -> Floats:
    """The log likelihood ratio (C,) that two tracks are swapped after an encounter, by their paces before and after it.

    ``pair`` (2, C) are the tracks, which are near each other from the steps ``meet`` (C,) to ``part_ways`` (C,). It is
    0 where one of the four paces isn't known.
    """
    span = round(_MOST_S / step_s)
    came, came_s = _paces(trajectories, pair, meet - span, meet, step_s)
    left, left_s = _paces(trajectories, pair, part_ways, part_ways + span, step_s)
    known = (np.minimum(came_s, left_s) >= _LEAST_S - 1e-9).all(axis=0)
    came_s, left_s = np.maximum(came_s, _LEAST_S), np.maximum(left_s, _LEAST_S)
    # the mean of both people: the variance of a pace, of two positions, is 2 noise^2 / time^2
    variance = _CHANGE_M_PER_S**2 + (noise_m**2 * (1 / came_s**2 + 1 / left_s**2)).sum(axis=0)
    ratio = -(came[0] - came[1]) * (left[0] - left[1]) / variance
    return np.where(known, np.clip(ratio, -_MOST, _MOST), 0.0)


def _paces(trajectories: Trajectories, track: Ints, since: Ints, until: Ints, step_s: float) -> tuple[Floats, Floats]:
    """The mean speeds of tracks (2, C) between their first and last position in these steps (C,), and the seconds
    between these; 0 where there are no two.
    """
    seen = np.flatnonzero(np.isfinite(trajectories.xy_m[:, 0]))
    first, end = trajectories.first[track], trajectories.first[track + 1]
    begin = first - trajectories.step[first]
    low = np.searchsorted(seen, np.maximum(begin + since, first))
    high = np.searchsorted(seen, np.minimum(begin + until + 1, end)) - 1
    is_known = high > low
    one, other = (seen[np.where(is_known, at, 0)] for at in (low, high))
    seconds = (other - one) * step_s
    way = trajectories.xy_m[other] - trajectories.xy_m[one]
    return np.hypot(way[..., 0], way[..., 1]) / np.where(is_known, seconds, 1.0), np.asarray(seconds, np.float64)
