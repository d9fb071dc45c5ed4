"""The decisions of re-tracking that are least certain: by their probabilities, where the log has these (decisions), and
otherwise by how far a joined track appears from where the person was expected.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.evaluation.people import PersonScores
from mcaptrack.geometry.clocks import seconds_to_ns
from mcaptrack.schema import DecisionKind, EventKind, Frame
from mcaptrack.viewing.report.formatting import number, percent
from mcaptrack.viewing.report.identity_events import ChannelEvents, IdentityEvent
from mcaptrack.viewing.report.statistics import rows_by_track

#: The number of repairs that are shown, and the least distance from the expected place of those.
_MOST: Final = 6
_LEAST_M: Final = 0.5
#: Decisions that are right with at least this probability are not shown.
_UNSURE: Final = 0.8
#: The velocity before a gap is that of the last so many seconds.
_PAST_S: Final = 2.0
#: A track belongs to the person that it matches at most so long before, or after, a repair.
_NEAR_S: Final = 2.0


class Doubt(NamedTuple):
    """A repair: the distance in m from where the person was expected to where the track appears, and in words what the
    ground truth says about it; "" without any. How likely it is right, if that is known, and the tracker's track that
    would go on otherwise; -1 for none.
    """

    event: IdentityEvent
    away_m: float
    verdict: str
    is_right: bool | None
    probability: float | None = None
    alternative_id: int = -1

    def text(self) -> str:
        """The repair in words."""
        start = f"{self.event.text[:1].upper()}{self.event.text[1:]}"
        if self.probability is None:
            where = f"{start}. It appears {number(self.away_m, 1, 'm')} from where it was expected"
        else:
            before, after = int(self.event.row["previous_id"]), self.alternative_id
            other = f"{before} goes on as {after}" if after >= 0 else f"{before} ended, and another came"
            if after == before:  # the join left an input track that went on
                other = f"{before} goes on as it did"
            where = f"{start}. Right with {percent(self.probability, 0)}; otherwise {other}"
        return f"{where}. {self.verdict}" if self.verdict else f"{where}."


class DoubtfulTrack(NamedTuple):
    """A track of which it is not certain that it follows a person: rows of decisions, kept or left out."""

    t_ns: int
    row: Any

    def text(self, noun: str) -> str:
        """The decision in words; ``noun`` is that of what is tracked."""
        row, likely = self.row, percent(float(self.row["probability"]), 0)
        long = f"{number(float(row['duration_s']), 1, 's')} long"
        if int(row["kind"]) == DecisionKind.KEPT:
            return f"track {row['track_id']} is kept: a {noun} with {likely}, {long}"
        return f"the tracker's {row['source_id']} is left out: no {noun} with {likely}, {long}"


def find_doubts(
    repairs: ChannelEvents | None,
    tracks: Sequence[Frame],
    people: PersonScores | None,
    decisions: Sequence[Frame] = (),
) -> list[Doubt]:
    """The repairs that are least likely, the least likely first; those below ``_UNSURE``.

    ``decisions`` are rows of Decisions of these ``tracks``. Without any, the repairs that are farthest from where the
    person was expected, going on as in the last two seconds before the gap. ``people`` are the scores of ``tracks`` by
    person, if there is ground truth. Repairs without positions in metres are left out.
    """
    if repairs is None:
        return []
    rows, t_ns = rows_by_track(tracks)
    joins = {
        (frame.t_ns, int(row["track_id"]), int(row["source_id"])): row
        for frame in decisions
        for row in frame.rows[frame.rows["kind"] == DecisionKind.JOINED]
    }
    doubts = []
    for event in repairs.events:
        if int(event.row["kind"]) != EventKind.JOINED:
            continue
        decided = joins.get((event.t_ns, int(event.row["track_id"]), int(event.row["source_id"])))
        if joins and (decided is None or decided["probability"] >= _UNSURE):
            continue
        away_m = _away_m(rows, t_ns, event)
        if away_m is None or (decided is None and away_m < _LEAST_M):
            continue
        doubt = Doubt(event, away_m, *(_verdict(people, event) if people is not None else ("", None)))
        if decided is not None:
            likely = float(decided["probability"])
            doubt = doubt._replace(probability=likely, alternative_id=int(decided["alternative_id"]))
        doubts.append(doubt)
    return sorted(doubts, key=lambda doubt: (doubt.probability or 0.0, -doubt.away_m, doubt.event.t_ns))[:_MOST]


def find_doubtful_tracks(decisions: Sequence[Frame]) -> list[DoubtfulTrack]:
    """The tracks that were kept or left out with a probability below ``_UNSURE``, the least likely first."""
    doubtful = [
        DoubtfulTrack(frame.t_ns, row)
        for frame in decisions
        for row in frame.rows[(frame.rows["kind"] != DecisionKind.JOINED) & (frame.rows["probability"] < _UNSURE)]
    ]
    return sorted(doubtful, key=lambda track: (float(track.row["probability"]), track.t_ns))[:_MOST]


def _away_m(rows: Any, t_ns: Any, event: IdentityEvent) -> float | None:
    """The distance from the expected place; None if positions are not known."""
    track = int(event.row["track_id"])
    low, high = np.searchsorted(rows["track_id"], [track, track + 1])
    own, own_ns = rows[low:high], t_ns[low:high]
    seen = own["observed"] & np.isfinite(own["x_m"]) & np.isfinite(own["y_m"])
    past = np.flatnonzero(seen & (own_ns < event.t_ns) & (own["source_id"] == int(event.row["previous_id"])))
    ahead = np.flatnonzero(seen & (own_ns >= event.t_ns))
    if not len(past) or not len(ahead):
        return None
    place = np.stack([own["x_m"], own["y_m"]], axis=-1)
    last, first = past[-1], ahead[0]
    past = past[own_ns[past] >= own_ns[last] - seconds_to_ns(_PAST_S)]
    span_ns = int(own_ns[last] - own_ns[past[0]])
    velocity = (place[last] - place[past[0]]) / span_ns if span_ns else np.zeros(2)
    expected = place[last] + velocity * int(own_ns[first] - own_ns[last])
    return float(np.hypot(*(place[first] - expected)))


def _verdict(people: PersonScores, event: IdentityEvent) -> tuple[str, bool | None]:
    """Compare a repair with the ground truth: return a text, and whether it is right (None if not known)."""
    own = people.track == int(event.row["track_id"])
    when, who = people.t_ns[own], people.person[own]
    order = np.argsort(when, kind="stable")
    when, who = when[order], who[order]
    unseen_s = float(np.nan_to_num(event.row["duration_s"]))
    at = int(np.searchsorted(when, event.t_ns))
    near_ns = seconds_to_ns(_NEAR_S)
    has_past = at > 0 and when[at - 1] >= event.t_ns - seconds_to_ns(unseen_s) - near_ns
    has_future = at < len(when) and when[at] <= event.t_ns + near_ns
    if not has_past or not has_future:
        return "The ground truth doesn't say to which person it belongs.", None
    before, after = int(who[at - 1]), int(who[at])
    if before == after:
        return f"The ground truth agrees: both are person {before}.", True
    return f"The ground truth disagrees: person {before} before, person {after} after.", False
