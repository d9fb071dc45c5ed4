"""Evidence of the frame before: people stand near a place for longer than one frame, most false boxes do not.

Letters: F frames, G groups, P pairs.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.neighbours import squared_sigmas
from mcaptrack.transforms.fuse.grouping import Places, pairs_along_x
from mcaptrack.transforms.fuse.joined import Joined

#: How often a person was detected in the frame before, and how often something was detected near a false box.
_STAYS, _CHANCE = 0.85, 0.3
#: How far people walk, in metres per second; and how far at most they seem to be from where they were.
_PACE_M_PER_S, _FARTHEST_M = 1.0, 2.5
#: A frame that is longer ago says nothing.
_MOST_S: Final = 1.0
#: Groups that are less probable than this are no people of the frame before.
_LEAST: Final = 0.02


class LastFrame(NamedTuple):
    """The places of a frame (G,), and how probable a person is at each; ``is_known`` is False without any boxes."""

    t_ns: int
    places: Places
    certainty: Floats
    is_known: bool


def persistence(
    block: Joined, certainty: Floats, before: LastFrame | None, max_sigma: float
) -> tuple[Floats, LastFrame]:
    """The change of the log-odds of each group of a block (G,), and the last frame, for the block that follows.

    A person at one place is expected at one place of the frame before, and the other way round: each group is paired
    with one of the frame before at most, near and probable ones first. Nothing is added to a frame if the one before
    has no boxes at all, or is too long ago.

    Parameters
    ----------
    block : Joined
    certainty : (G,)
        The probability of a person at each place, by its own frame.
    before : LastFrame or None
        The frame before the block.
    max_sigma : float
        Places are paired if they are at most so many standard deviations apart.
    """
    count, sizes = len(certainty), np.bincount(block.frame, minlength=len(block.frames))
    ends = np.cumsum(sizes)
    times = np.array([one.t_ns for one in block.frames], np.int64)
    last = slice(int(ends[-1] - sizes[-1]), int(ends[-1]))
    after = LastFrame(
        int(times[-1]),
        Places(block.centre.xy_m[last], block.centre.cov[last]),
        certainty[last],
        bool(block.counts[-1]),
    )
    begun = before or LastFrame(int(times[0]), Places(np.empty((0, 2)), np.empty((0, 3))), np.empty(0), is_known=False)
    # Groups of the frame before the block come first; frames are numbered from it.
    extra = len(begun.certainty)
    xy_m = np.concatenate([begun.places.xy_m, block.centre.xy_m])
    cov = np.concatenate([begun.places.cov, block.centre.cov])
    probable = np.concatenate([begun.certainty, certainty])
    frame = np.concatenate([np.zeros(extra, np.int64), block.frame + 1])
    step_s = np.diff(times, prepend=begun.t_ns) / NS_PER_S
    counts = np.append([begun.is_known], block.counts > 0)[:-1] & (step_s > 0) & (step_s <= _MOST_S)
    # Each group is looked for with those of its own frame, and again with those of the next one.
    likely = np.flatnonzero(probable >= _LEAST)
    first, second = pairs_along_x(
        np.tile(xy_m[likely], (2, 1)), np.append(frame[likely], frame[likely] + 1), _FARTHEST_M
    )
    is_now, was = first < len(likely), second >= len(likely)
    now, then = likely[first[is_now & was]], likely[second[is_now & was] - len(likely)]
    of = frame[now] - 1
    x, y = (xy_m[now] - xy_m[then]).T
    walked = np.array([1.0, 0.0, 1.0]) * ((_PACE_M_PER_S * step_s[of]) ** 2)[:, None]
    apart = squared_sigmas(x, y, *(cov[now] + cov[then] + walked).T)
    fits = (apart <= max_sigma**2) & (x * x + y * y <= _FARTHEST_M**2)
    now, then, apart = now[fits], then[fits], apart[fits]
    order = np.lexsort((then, now, apart - 2 * np.log(probable[now]) - 2 * np.log(probable[then])))
    stays = np.zeros(extra + count)
    taken, given = set[int](), set[int]()
    for one, other in zip(now[order].tolist(), then[order].tolist(), strict=True):
        if one not in taken and other not in given:
            taken.add(one)
            given.add(other)
            stays[one] = probable[other]
    stays = stays[extra:]
    odds = np.log(stays * (_STAYS / _CHANCE) + (1 - stays) * ((1 - _STAYS) / (1 - _CHANCE)))
    return np.where(counts[block.frame], odds, 0.0), after
