"""Compare trackers without ground truth: differences of their IDF1 against offline re-tracking of the same log.

Re-tracking is wrong, too: it misses people that its tracker missed, and shares errors with it. So levels say nothing.
Differences are called better or worse where they were right on drawn scenes (``tools/without_truth.py``): where they
are large, also without the rows that the reference lacks, and have the same sign with other people.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Final, Literal, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.aligned import GATE_3D_M, GATE_M, align, are_3d, compare_rows, has_positions
from mcaptrack.evaluation.events import MatchRule
from mcaptrack.evaluation.people import LEAST_PEOPLE, PersonScores, intervals, person_scores
from mcaptrack.geometry.arrays import Bools
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.classes import class_names
from mcaptrack.sources.cameras import camera_at, lineage, provenance_of
from mcaptrack.transforms import STAGES

#: The least difference of IDF1 that is called better or worse, as a share.
LEAST: Final = 0.05
#: Positions and boxes of copied rows: the largest distance in metres, and the least overlap.
_SAME: Final = (MatchRule("metres", 1e-3), MatchRule("iou", 0.999))
#: A copy of the reference has this share of the rows that only re-tracking has; with fewer of these, of all rows.
_COPIED_FILLED: Final = 0.1
_LEAST_FILLED: Final = 10
_COPIED: Final = 0.99
#: A copy that was moved has rows at this share of those. Of its rows, and of those of the tracks that it has, hardly
#: any match none of the other side, while trackers begin and end tracks at times of their own.
_MOVED_FILLED: Final = 0.3
_MOVED_ALONE: Final = 0.002
#: Tracks with ids of the source of the reference: this share of their rows has the usual source of its track. Those of
#: independent trackers had 0.97 at most on drawn scenes, and copies with faults of their own 0.984 at least.
_OF_SOURCE: Final = 0.98


class Difference(NamedTuple):
    """The difference of one channel of tracks from another, by a reference that is no ground truth.

    Attributes
    ----------
    before, after : str
        The topics of the two.
    verdict : {"better", "worse", "undecided"}
        What ``after`` is.
    idf1, low, high : float
        By how much its IDF1 against the reference is higher, as a share, and between what it is in 95 % of draws of
        other people; NaN for too few people.
    why : str
        The reason for "undecided"; "" for others.
    """

    before: str
    after: str
    verdict: Literal["better", "worse", "undecided"]
    idf1: float
    low: float
    high: float
    why: str = ""


class Candidates(NamedTuple):
    """The scores of channels of a log against the reference, by topic, and those that are related to it: how."""

    scores: Mapping[str, PersonScores]
    related: Mapping[str, str]


def candidates_of_log(opened: log.Log, prefix: str, against: str, topics: Sequence[str]) -> Candidates:
    """Score channels of a log against the reference ``against``; by default all channels of tracks that have metres.

    Raises McaptrackError if offline re-tracking did not make the reference, and where metres are missing or guessed.
    """
    reference = opened.find(against, prefix)
    path, how = opened.path, provenance_of(opened, reference)
    opened.channel(reference)
    stage = STAGES.get(how.transform) if how is not None else None
    is_offline = stage is not None and stage.repairs_tracks and not reference.endswith("/online")
    if how is None or not is_offline or how.parameters.get("retracker", "likelihood") != "likelihood":
        raise McaptrackError(
            f"{path}: {reference} can't be a reference, because offline re-tracking did not make it; "
            "/camera/retracks/full is one"
        )
    planes = [plane for _, plane in how.parameters.get("ground_planes") or ()]
    frames = opened.frames(reference, TRACKS)
    if not has_positions(frames, "metres") or (planes and all(plane.get("assumed") for plane in planes)):
        raise McaptrackError(
            f"{path}: {reference} has no measured positions in metres, and without them differences are wrong too "
            "often; give a ground plane, or boxes in space"
        )
    truth = camera_at(opened, prefix).truth
    chosen = [opened.find(topic, prefix) for topic in topics] or [
        topic
        for topic in sorted(camera_at(opened, prefix).topics)
        if opened.holds(topic, TRACKS) and topic not in (reference, truth)
    ]
    rule = MatchRule("metres", GATE_3D_M if are_3d(frames, frames) else GATE_M)
    names = class_names(opened.channel(reference).metadata)
    scores, related = {}, {}
    for topic in dict.fromkeys(chosen):
        metadata, tracks = opened.channel(topic).metadata, opened.frames(topic, TRACKS)
        scored = person_scores(frames, tracks, rule, (path.stem, topic), (names, class_names(metadata)))
        if scored is None:
            raise McaptrackError(f"{path}: {topic} can't be compared with {reference}: it has no positions in metres "
                                 "at the same times")  # fmt: skip
        scores[topic] = scored
        if relation := _relation(opened, topic, reference) or copied(frames, tracks, rule):
            related[topic] = relation
    return Candidates(scores, related)


def _relation(opened: log.Log, topic: str, reference: str) -> str:
    """The tracks that a channel and the reference both come from, as a reason; "" if there are none."""
    own, other = (
        [name for name, _ in lineage(opened, end) if opened.holds(name, TRACKS)] for end in (topic, reference)
    )
    shared = next((name for name in own if name in other), "")
    if shared in ("", topic, reference):
        return {"": "", topic: "the reference was made from it", reference: "it was made from the reference"}[shared]
    return f"it was made from {shared}, as the reference was"


def copied(reference: Sequence[Frame], tracks: Sequence[Frame], rule: MatchRule) -> str:
    """Whether tracks repeat the reference, or the tracks that it was made from, as a reason; "" if they don't.

    The first have rows that re-tracking has filled in, which no other tracker has there. The second change their ids
    where its source does, and not where people do.
    """
    reference, tracks = align("", "", reference, tracks)
    sources = [_select(frame, frame.rows["source_id"] >= 0, "source_id") for frame in reference]
    if _purity(sources, tracks, rule) >= _OF_SOURCE > _purity(sources, reference, rule):
        return "it has ids of the tracks that the reference was made from"
    filled = [_select(frame, frame.rows["source_id"] < 0) for frame in reference]
    count = sum(len(frame.rows) for frame in filled)
    if count < _LEAST_FILLED:
        return "it repeats the reference" if repeats(reference, tracks) else ""
    same = compare_rows(filled, tracks, *_SAME[0]).matchup.pairs
    if len(same.frame) >= _COPIED_FILLED * count:
        return "it has rows of the reference"
    moved, all_rows = person_scores(filled, tracks, rule), person_scores(reference, tracks, rule)
    if moved is None or all_rows is None or moved.matched.sum() < _MOVED_FILLED * count:
        return ""
    of_tracks, matched = all_rows.rows, all_rows.matched
    has_track = 2 * matched > of_tracks
    missing = (of_tracks - matched)[has_track].sum()
    own = all_rows.false_rows + matched.sum()
    alone = max(all_rows.false_rows / max(own, 1), missing / max(of_tracks[has_track].sum(), 1))
    return "it has the rows of the reference, moved" if alone <= _MOVED_ALONE else ""


def _select(frame: Frame, is_kept: Bools, ids: str = "track_id") -> Frame:
    """Some rows of a frame, with the ids in this column."""
    rows = frame.rows[is_kept]
    rows["track_id"] = rows[ids]
    return frame._replace(rows=rows)


def _purity(sources: Sequence[Frame], tracks: Sequence[Frame], rule: MatchRule) -> float:
    """The share of the rows of tracks that match a source that match the usual source of their track; 0 without."""
    scored = person_scores(sources, tracks, rule)
    if scored is None or not len(scored.track):
        return 0.0
    pairs, counts = np.unique(np.stack([scored.track, scored.person]), axis=1, return_counts=True)
    _, of = np.unique(pairs[0], return_inverse=True)
    usual = np.zeros(of.max() + 1, np.int64)
    np.maximum.at(usual, of, counts)
    return float(usual.sum() / counts.sum())


def repeats(ground_truth: Sequence[Frame], tracks: Sequence[Frame]) -> bool:
    """Whether two channels are the same tracks, row by row, but for their ids."""
    for rule in _SAME:
        scored = person_scores(ground_truth, tracks, rule)
        rows = 0 if scored is None else int(scored.rows.sum() + scored.matched.sum()) + scored.false_rows
        if scored is not None and rows and 2 * int(scored.hits.sum()) >= _COPIED * rows:
            return True
    return False


def differences(logs: Sequence[Candidates]) -> list[Difference]:
    """Compare each two channels, over all logs together. Raises McaptrackError if there are no two."""
    names = [name for name in logs[0].scores if all(name in candidates.scores for candidates in logs)]
    if len(names) < 2:
        raise McaptrackError(
            f"there are no two channels of tracks to compare ({', '.join(names) or 'none'}); name two or more that all "
            "logs have with `topic=`, or bring in another tracker's as `log.write` does"
        )
    return [compare(before, after, logs) for before, after in combinations(names, 2)]


def compare(before: str, after: str, logs: Sequence[Candidates]) -> Difference:
    """Compare two channels, over all logs together."""
    related = {name: how for candidates in logs for name, how in candidates.related.items()}
    sides = [[candidates.scores[name] for candidates in logs] for name in (before, after)]
    by_people = intervals(*sides)
    nan = float("nan")
    if by_people is None:
        return Difference(before, after, "undecided", nan, nan, nan, "they have rows at different times")
    value, low, high = change = by_people.idf1_change
    # A row that the reference doesn't have is a false one, or of a person that it misses.
    forgiving = _idf1_of_matched(sides[1]) - _idf1_of_matched(sides[0])
    sign = 1 if value > 0 else -1
    winner = after if sign > 0 else before
    reasons = {
        f"fewer than {LEAST_PEOPLE} people": not change.is_known,
        f"the difference is under {100 * LEAST:g} points": abs(value) < LEAST,
        "with other people it may be none": change.sign != sign,
        "it depends on rows that the reference doesn't have": sign * forgiving < LEAST,
        f"{winner}: {related.get(winner, '')}, which favours it": winner in related,
    }
    why = next((reason for reason, holds in reasons.items() if holds), "")
    verdict: Literal["better", "worse", "undecided"] = "undecided" if why else "better" if sign > 0 else "worse"
    return Difference(before, after, verdict, value, low, high, why)


def _idf1_of_matched(side: Sequence[PersonScores]) -> float:
    """IDF1 without the rows that match no person."""
    rows = sum(int(scores.rows.sum() + scores.matched.sum()) for scores in side)
    return 2 * sum(int(scores.hits.sum()) for scores in side) / max(rows, 1)
