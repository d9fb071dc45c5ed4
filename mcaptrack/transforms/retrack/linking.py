"""Links: how well the motion before a gap and the motion after it fit together, and the best set of such links.

People walk on as they walked, or stay where they stood. Since links are scored pair by pair, the best set of them is
one assignment of ends to beginnings. Online tracking links as it goes; offline these are terms of the hypotheses.

Letters: K tracks, E candidate links, F features.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints, taken
from mcaptrack.geometry.assignment import max_weight_matching
from mcaptrack.geometry.ragged import batches, find_rows, group_index, ragged_range
from mcaptrack.transforms.retrack.motion_model import MotionModel, State
from mcaptrack.transforms.retrack.weights import Logistic, columns, probability

#: A track that continues another begins no farther from its end than this, and so much more for each second between.
_REACH_M, _MAX_SPEED_M_PER_S = 1.0, 2.5
#: Weight of each feature as a log odds ratio; and the log odds without any, in logs where a share of ``_PRIOR`` of the
#: best links is right. Links with log odds below ``MIN_LOG_ODDS`` are not considered.
_LINKS: Final = Logistic.of("links")
FEATURES: Final = _LINKS.names
_PRIOR, MIN_LOG_ODDS = (float(_LINKS.numbers[name]) for name in ("usual", "least"))
#: Gaps are of classes with these bounds in seconds; the mean probability of the best links of each, where as many are
#: right as usual; and with how many links more this is taken to be so in a log.
_GAPS_S: Final = (0.9, 1.7, 3.3, 6.5, 13.0)
_BY_GAP: Final = np.array(_LINKS.numbers["usual by gap"])
_GAP_LINKS: Final = 5.0
#: Added to distances and speeds before taking logarithms: differences below these mean nothing.
_NEAR_M, _SPEED_M_PER_S = 0.3, 0.15
#: Odds that are enough for a link, as a share of those of the least confidence: pieces of a person that stay apart cost
#: more than wrong ones that go together. (Chosen on synthetic crowds.)
ENOUGH: Final = 1 / 3
#: The number of pairs that are examined at once.
_BATCH: Final = 1_000_000


class Gaps(NamedTuple):
    """Gaps (E,): the states before them, filtered forward, those after them, filtered backward, and their seconds."""

    before: State
    after: State
    seconds: Floats


class TrackEnds(NamedTuple):
    """The first and last steps of tracks (K,), and their states there: filtered backward, and forward."""

    model: MotionModel
    begins: Ints
    ends: Ints
    begun: State
    ended: State

    def gaps(self, i: Ints, j: Ints) -> Gaps:
        """The gaps (E,) from the ends of tracks ``i`` to the beginnings of tracks ``j``."""
        seconds = np.asarray((self.begins[j] - self.ends[i]) * self.model.step_s, np.float64)
        return Gaps(taken(self.ended, i), taken(self.begun, j), seconds)


def chains(continued_by: Ints, begins: Ints) -> Ints:
    """The first of the chain that each track (K,) is part of; ``continued_by`` (K,) is the next of it, or -1."""
    root = np.arange(len(continued_by))
    order = np.argsort(begins, kind="stable")  # a continuation begins later
    for earlier in order[continued_by[order] >= 0].tolist():
        root[continued_by[earlier]] = root[earlier]
    return root


def best_links(ends: Ints, begins: Ints, gain: Floats, count: int) -> Ints:
    """Which links (E,) between ends and beginnings of so many tracks have the largest sum of gains, by ends."""
    gain = np.round(gain, 6)
    good = np.flatnonzero(gain > 0)
    pairs, _ = max_weight_matching((ends[good], begins[good]), gain[good], (count, count))
    links = find_rows((ends, begins), pairs)
    return np.asarray(links[np.argsort(ends[links], kind="stable")])


def log_odds(model: MotionModel, gaps: Gaps) -> Floats:
    """The log odds that links over gaps (E,) are right, where as many are as usual."""
    return _LINKS.log_odds(columns(FEATURES, motion_terms(model, gaps)))


def pairs_in_reach(ends: TrackEnds, max_gap_s: float) -> Iterator[tuple[Ints, Ints, Gaps]]:
    """Pairs (E,) of a track and a later one within reach of its end, some at a time, with the gaps between."""
    order = np.argsort(ends.begins, kind="stable")
    begins = ends.begins[order]
    low = np.searchsorted(begins, ends.ends + 1)
    count = np.searchsorted(begins, ends.ends + round(max_gap_s / ends.model.step_s), "right") - low
    for part in batches(count, _BATCH):
        i = part.start + group_index(count[part])
        j: Ints = order[ragged_range(low[part], count[part])]
        gaps = ends.gaps(i, j)
        near = np.flatnonzero(are_in_reach(gaps))
        yield i[near], j[near], taken(gaps, near)


def are_in_reach(gaps: Gaps) -> Bools:
    """Whether people may get from the one side to the other within the gaps (E,)."""
    return np.asarray(
        _length(gaps.before.mean[:, :2] - gaps.after.mean[:, :2]) <= _REACH_M + _MAX_SPEED_M_PER_S * gaps.seconds
    )


def prior_shift(log_odds: Floats) -> float:
    """The shift of the log odds of links (E,), because another share of them is right in this log than usual."""
    shift = 0.0
    for _ in range(100):
        right = probability(log_odds + shift).sum()
        share = (right + 0.3) / (len(log_odds) + 3)  # in most logs few are
        before, shift = shift, float(np.log(share / (1 - share)) - np.log(_PRIOR / (1 - _PRIOR)))
        if abs(shift - before) < 1e-4:
            break
    return shift


def gap_classes(gap_s: Floats) -> Ints:
    """The class of each gap (E,) by its length, from 0 on."""
    return np.searchsorted(_GAPS_S, gap_s)


def prior_shifts(log_odds: Floats, gap_s: Floats) -> Floats:
    """The shifts of the log odds of links over gaps of each class (see ``gap_classes``), from the best links (E,).

    How long people are missed differs from log to log, too, so gaps of about the same length are shifted together: few
    of them as all links are.
    """
    count = len(_BY_GAP)
    gap = gap_classes(gap_s)
    usual = np.log(_BY_GAP / (1 - _BY_GAP))
    expected = probability(usual + prior_shift(log_odds))
    links = np.bincount(gap, minlength=count) + _GAP_LINKS
    shifts = np.zeros(count)
    for _ in range(50):
        right = np.bincount(gap, probability(log_odds + shifts[gap]), minlength=count)
        share = (right + _GAP_LINKS * expected) / links
        shifts = np.log(share / (1 - share)) - usual
    return shifts


def motion_terms(model: MotionModel, gaps: Gaps) -> dict[str, Floats]:
    """The terms (E,) of how well the motion before gaps fits that after them, by name.

    "miss" is the distance from one side to where the other, extrapolated at its own velocity, expects it (the smaller
    of the two), "misfit" that with the mean of both velocities, "stay" that from one side to the other, "noise" the
    variance of the misfit per axis.
    """
    before, after, gap_s = gaps
    span = gap_s[:, None]
    way = after.mean[:, :2] - before.mean[:, :2]
    left, came = before.mean[:, 2:], after.mean[:, 2:]
    fastest = np.maximum(_length(left), _length(came))
    variance = before.cov[:, 0] + after.cov[:, 0] + gap_s**2 / 4 * (before.cov[:, 2] + after.cov[:, 2])
    variance += (model.drift_m_per_s + model.drift_ratio * fastest) ** 2 * gap_s**3 / 12
    misfit, stay = _length(way - (left + came) / 2 * span), _length(way)
    nearest, speed = np.log(np.minimum(misfit, stay) + _NEAR_M), np.log(fastest + _SPEED_M_PER_S)
    return {
        "miss": np.log(np.minimum(_length(way - left * span), _length(way - came * span)) + _NEAR_M),
        "misfit to noise": np.log1p(misfit**2 / variance / 2),
        "misfit": np.log(misfit + 0.2),
        "misfit or stay": nearest,
        "misfit or stay by gap": nearest * np.log(gap_s + 0.4),
        "turn": np.log(_length(came - left) + _SPEED_M_PER_S),
        "stay and speed": np.log(stay + _NEAR_M) * speed,
        "misfit and speed": np.log(misfit + _NEAR_M) * speed,
        "speed": speed,
        "noise": np.log(variance),
        "gap": gap_s,
    }


def _length(vector: Floats) -> Floats:
    return np.asarray(np.hypot(vector[:, 0], vector[:, 1]))
