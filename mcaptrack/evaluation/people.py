"""Scores of each true person, and how sure differences between tracks are: intervals by resampling people.

The sums over people are the counts of the scores: switches are IDSW, identity hits IDTP.

Letters: G people, P matches.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.aligned import align, compare_rows, share_classes, sides_without
from mcaptrack.evaluation.events import MatchRule
from mcaptrack.evaluation.metrics import best_tracks, is_switch, matches
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.assignment import LARGE_TABLE
from mcaptrack.schema import Frame
from mcaptrack.schema.framing import frame_times

#: The number of times that people are drawn again, the seed, and the share of draws inside of an interval.
_DRAWS: Final = 2000
_SEED: Final = 1
_SHARE: Final = 0.95
#: Intervals from fewer people would promise too much.
LEAST_PEOPLE: Final = 5


class PersonScores(NamedTuple):
    """Tracks compared with each true person.

    Attributes
    ----------
    ids : (G,) of int
        The people.
    rows, matched, hits, switches : (G,) of int
        For each person: rows of the ground truth; of these, rows matched by CLEAR, and rows matched under the best
        assignment of one track to each person (IDTP); identity switches (IDSW).
    false_rows : int
        Rows of tracks that match no person.
    t_ns, person, track : (P,) of int
        The matches by CLEAR, by person and time: log times, ids of people and of tracks.
    frame_ns : (F,) of int
        The times that were compared.
    """

    ids: Ints
    rows: Ints
    matched: Ints
    hits: Ints
    switches: Ints
    false_rows: int
    t_ns: Ints
    person: Ints
    track: Ints
    frame_ns: Ints

    def idf1(self) -> float:
        """IDF1 of all people together."""
        total = self.rows.sum() + self.matched.sum() + self.false_rows
        return float(2 * self.hits.sum() / max(total, 1))


def person_scores(
    ground_truth: Sequence[Frame],
    tracks: Sequence[Frame],
    rule: MatchRule,
    names: tuple[str, str] = ("the log", "the tracks"),
    classes: tuple[Mapping[int, str], Mapping[int, str]] = ({}, {}),
) -> PersonScores | None:
    """Compare tracks with each true person.

    Parameters
    ----------
    ground_truth, tracks : sequence of Frame
        Rows of Tracks.
    rule : MatchRule
        The similarity and its gate.
    names : tuple of str
        Names of the sequence and of the tracks, for messages.
    classes : tuple of mapping of int to str
        Names of the classes of the ground truth and of the tracks, by number.

    Returns
    -------
    PersonScores or None
        None if they can't be compared by this rule.
    """
    try:
        at_same = align(*names, ground_truth, tracks)
    except McaptrackError:
        return None
    shared = share_classes(*names, *at_same, *classes)
    if sides_without({"truth": shared.ground_truth, "tracks": shared.tracks}, rule.similarity):
        return None
    matchup, people, objects = compare_rows(shared.ground_truth, shared.tracks, *rule, by_class=bool(shared.names))
    pairs = matches(matchup)
    count = len(people.ids)
    tracked, frames = best_tracks(matchup, LARGE_TABLE)
    hits = np.zeros(count, np.int64)
    hits[tracked] = frames.astype(np.int64)
    frame_ns = frame_times(shared.ground_truth)
    matched = np.bincount(pairs.person, minlength=count)
    return PersonScores(
        people.ids,
        np.bincount(matchup.all_ground_truth, minlength=count),
        matched,
        hits,
        np.bincount(pairs.person[is_switch(pairs)], minlength=count),
        int(matchup.track_rows - matched.sum()),
        frame_ns[pairs.frame],
        people.ids[pairs.person],
        objects.ids[pairs.track],
        frame_ns,
    )


class Interval(NamedTuple):
    """A value, and the interval that holds it in 95 % of the draws of other people; NaN for too few people."""

    value: float
    low: float
    high: float

    @property
    def is_known(self) -> bool:
        """Whether there were enough people."""
        return bool(np.isfinite(self.low))

    @property
    def sign(self) -> int:
        """1 if the whole interval is above 0, -1 if it is below, otherwise 0."""
        return 0 if not self.is_known else int(self.low > 0) - int(self.high < 0)


class Intervals(NamedTuple):
    """Intervals of scores before and after, and of their differences, by resampling ``people`` people.

    ``idf1`` are shares; ``switches`` are numbers for each person.
    """

    people: int
    idf1: tuple[Interval, Interval]
    idf1_change: Interval
    switches_change: Interval


def intervals(before: Sequence[PersonScores], after: Sequence[PersonScores]) -> Intervals | None:
    """Estimate how much scores would differ with other people: a bootstrap over the people of all sequences.

    Each draw takes as many people as there are, with replacement, the same ones before and after. Rows of tracks that
    match no person belong to no person; their number grows with the rows of the people drawn.

    Parameters
    ----------
    before, after : sequence of PersonScores
        Two kinds of tracks of the same sequences, in the same order.

    Returns
    -------
    Intervals or None
        None if the two were not compared with the same people.
    """
    if len(before) != len(after) or not before:
        return None
    if any(not np.array_equal(a.ids, b.ids) for a, b in zip(before, after, strict=True)):
        return None
    people = sum(len(scores.ids) for scores in before)
    if people < LEAST_PEOPLE:
        drawn = np.empty((0, people), np.int64)
    else:
        drawn = np.random.default_rng(_SEED).integers(0, people, (_DRAWS, people))
    sides = [_draws(side, drawn) for side in (before, after)]
    (idf1_a, switches_a), (idf1_b, switches_b) = sides
    return Intervals(
        people, (_interval(idf1_a), _interval(idf1_b)), _interval(idf1_b - idf1_a), _interval(switches_b - switches_a)
    )


def _draws(side: Sequence[PersonScores], drawn: Ints) -> tuple[Floats, Floats]:
    """IDF1 and switches for each person: of all people, and of each draw (1 + draws,)."""
    rows, matched, hits, switches = (
        np.concatenate([getattr(scores, name) for scores in side]).astype(np.float64)
        for name in ("rows", "matched", "hits", "switches")
    )
    false_rows = float(sum(scores.false_rows for scores in side))
    everyone = np.arange(len(rows))[None]
    out = []
    for which in (everyone, drawn):
        total = rows[which].sum(axis=1)
        false = false_rows * total / max(rows.sum(), 1.0)
        idf1 = 2 * hits[which].sum(axis=1) / np.maximum(total + matched[which].sum(axis=1) + false, 1.0)
        out.append(np.stack([idf1, switches[which].mean(axis=1) if len(rows) else total]))
    idf1, per_person = np.concatenate(out, axis=1)
    return idf1, per_person


def _interval(values: Floats) -> Interval:
    """The interval of the draws ``values[1:]``, around the value of all people ``values[0]``."""
    if len(values) == 1:
        return Interval(float(values[0]), float("nan"), float("nan"))
    tail = 50 * (1 - _SHARE)
    low, high = np.percentile(values[1:], [tail, 100 - tail]).tolist()
    return Interval(float(values[0]), low, high)
