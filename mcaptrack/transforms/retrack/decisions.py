"""The decisions of offline re-tracking as rows: how likely each is right, and what would be the case otherwise.

Joins are judged once all tracks are decided, whatever step made them: association, a link over a gap, or a swap that
was resolved. Tracks are people or false with the odds of the test of false tracks. Probabilities are logistic
regressions, fitted on synthetic scenes (see ``weights``), where of the decisions with a probability of 0.9 about 90 %
are right.

Letters: C assignments, K tracks, J joins, D decisions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.ragged import run_ends, run_starts
from mcaptrack.schema import DECISIONS, DecisionKind, Rows
from mcaptrack.transforms.retrack.appearance import Appearance
from mcaptrack.transforms.retrack.false_tracks import probability
from mcaptrack.transforms.retrack.joins import FEATURES, Joins, Tracked, find_joins, with_appearance
from mcaptrack.transforms.retrack.motion_model import MotionModel
from mcaptrack.transforms.retrack.samples import LogSamples
from mcaptrack.transforms.retrack.weights import weights_of

_JOINS_WEIGHTS, _JOINS_FITTED = weights_of("joins", FEATURES)
_JOINS_BIAS: Final = float(_JOINS_FITTED["bias"])
#: The log odds that a track is a person, from those of the test of false tracks: that one weighs rows, not tracks.
_PERSON_WEIGHTS, _PERSON_FITTED = weights_of("decided", ("log odds",))
_PERSON_BIAS: Final = float(_PERSON_FITTED["bias"])
_NO_ID: Final = -1


class Decided(NamedTuple):
    """All tracks of a log as they were decided, those that were left out included.

    ``sample`` (C,) is the sample of each assignment. ``log_odds`` (K,) that tracks are people, of the test of false
    tracks, and which were ``kept`` (K,), are ordered by id. ``appearance`` is that of the assignments, None where it
    isn't used.
    """

    tracked: Tracked
    sample: Ints
    log_odds: Floats
    kept: Bools
    appearance: Appearance | None = None


def decision_rows(
    decided: Decided, model: MotionModel, samples: LogSamples, steps: Sequence[int], step_s: float
) -> Iterator[Rows]:
    """The decisions at each of ``steps``: rows of Decisions, ordered by kind and track."""
    parts = _joined(decided, find_kept_joins(decided, model, step_s), step_s), _persons(decided, step_s)
    at, rows = np.concatenate([one for one, _ in parts]), DECISIONS.joined([rows for _, rows in parts])
    places = samples.take(decided.sample[at])
    rows["x_m"], rows["y_m"] = places["x_m"], places["y_m"]
    rows["x_px"], rows["y_px"] = places["x_px"] + places["w_px"] / 2, places["y_px"] + places["h_px"] / 2
    step = decided.tracked.step[at]
    order = np.lexsort((rows["source_id"], rows["track_id"], rows["kind"], step))
    ends = np.append(0, np.searchsorted(step[order], steps, "right")).tolist()
    rows = DECISIONS.check(rows.take(order))
    yield from (rows[low:high] for low, high in pairwise(ends))


def find_kept_joins(decided: Decided, model: MotionModel, step_s: float) -> Joins:
    """The joins of the tracks that were kept."""
    joins = find_joins(decided.tracked, model, step_s)
    number = np.cumsum(run_starts(decided.tracked.track)) - 1
    kept = decided.kept[number[joins.after]]
    return Joins(*(values[kept] for values in joins))


def join_probability(features: Floats) -> Floats:
    """The probability (J,) that joins with these features (J, F) are right."""
    return probability(features @ _JOINS_WEIGHTS + _JOINS_BIAS)


def person_probability(log_odds: Floats) -> Floats:
    """The probability (K,) that tracks with these log odds, of the test of false tracks, are people."""
    return probability(log_odds * _PERSON_WEIGHTS[0] + _PERSON_BIAS)


def _joined(decided: Decided, joins: Joins, step_s: float) -> tuple[Ints, Rows]:
    """The assignment of each join (J,), and its row."""
    step, track, source = decided.tracked[:3]
    rows = DECISIONS.empty(len(joins.after))
    rows["kind"], rows["track_id"] = DecisionKind.JOINED, track[joins.after]
    rows["previous_id"], rows["source_id"] = source[joins.before], source[joins.after]
    by_motion = join_probability(joins.features)
    rows["probability"] = with_appearance(by_motion, joins, decided.tracked, decided.appearance, step_s)
    rows["alternative_id"] = np.where(joins.alternative >= 0, source[joins.alternative], _NO_ID)
    rows["duration_s"] = (step[joins.after] - step[joins.before]) * step_s
    return joins.after, rows


def _persons(decided: Decided, step_s: float) -> tuple[Ints, Rows]:
    """The first assignment of each track (K,), and the row that says whether it is a person."""
    step, track, source = decided.tracked[:3]
    starts = run_starts(track)
    first, last = np.flatnonzero(starts), np.flatnonzero(run_ends(starts))
    rows = DECISIONS.empty(len(first))
    rows["kind"] = np.where(decided.kept, DecisionKind.KEPT, DecisionKind.LEFT_OUT)
    rows["track_id"] = np.where(decided.kept, track[first], _NO_ID)
    rows["previous_id"] = rows["alternative_id"] = _NO_ID
    rows["source_id"] = _usual(track, source)
    is_person = person_probability(decided.log_odds)
    rows["probability"] = np.where(decided.kept, is_person, 1 - is_person)
    rows["duration_s"] = (step[last] - step[first]) * step_s
    rows["frames"] = last - first + 1
    return first, rows


def _usual(track: Ints, source: Ints) -> Ints:
    """The input id of most samples of each track (K,), of several the lowest. Assignments (C,) are by track."""
    order = np.lexsort((source, track))
    starts = np.flatnonzero(run_starts(track[order], source[order]))
    count = np.diff(np.append(starts, len(order)))
    of, ids = track[order][starts], source[order][starts]
    best = np.lexsort((ids, -count, of))
    return np.asarray(ids[best[run_starts(of[best])]])
