"""The repairs that are least certain: where a person was expected after a gap, and where the joined track appears."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.evaluation.people import PersonScores
from mcaptrack.geometry.clocks import seconds_to_ns
from mcaptrack.schema import EventKind, Frame
from mcaptrack.viewing.report.formatting import number
from mcaptrack.viewing.report.identity_events import ChannelEvents, IdentityEvent
from mcaptrack.viewing.report.statistics import rows_by_track

#: The number of repairs that are shown, and the least distance from the expected place of those.
_MOST: Final = 6
_LEAST_M: Final = 0.5
#: The velocity before a gap is that of the last so many seconds.
_PAST_S: Final = 2.0
#: A track belongs to the person that it matches at most so long before, or after, a repair.
_NEAR_S: Final = 2.0


class Doubt(NamedTuple):
    """A repair: the distance in m from where the person was expected to where the track appears, and in words what the
    ground truth says about it; "" without any.
    """

    event: IdentityEvent
    away_m: float
    verdict: str
    is_right: bool | None

    def text(self) -> str:
        """The repair in words."""
        start = f"{self.event.text[:1].upper()}{self.event.text[1:]}"
        where = f"{start}. It appears {number(self.away_m, 1, 'm')} from where it was expected"
        return f"{where}. {self.verdict}" if self.verdict else f"{where}."


def find_doubts(repairs: ChannelEvents | None, tracks: Sequence[Frame], people: PersonScores | None) -> list[Doubt]:
    """The repairs that are farthest from where the person was expected, the farthest first.

    The person is expected to go on as in the last two seconds before the gap. ``people`` are the scores of these
    ``tracks`` by person, if there is ground truth. Repairs without positions in metres are left out.
    """
    if repairs is None:
        return []
    rows, t_ns = rows_by_track(tracks)
    found = []
    for event in repairs.events:
        if int(event.row["kind"]) != EventKind.JOINED:
            continue
        away_m = _away_m(rows, t_ns, event)
        if away_m is not None and away_m >= _LEAST_M:
            verdict, is_right = _verdict(people, event) if people is not None else ("", None)
            found.append(Doubt(event, away_m, verdict, is_right))
    return sorted(found, key=lambda one: (-one.away_m, one.event.t_ns))[:_MOST]


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
    """Compare a repair with the ground truth: words, and whether it is right; None if that is not known."""
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
