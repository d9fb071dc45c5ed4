"""Identity switches and repairs: when they happened, and what the pictures showed before and after.

Letters: R events.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.evaluation.event_text import describe, nouns_of
from mcaptrack.evaluation.events import MatchRule
from mcaptrack.evaluation.people import PersonScores
from mcaptrack.extensions.report.statistics import frame_interval_s, rows_by_track
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.schema import EVENT_KINDS, DecisionKind, EventKind, Frame, Rows
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import encode_image
from mcaptrack.viewing.formatting import number, percent

#: The side of thumbnails, which are squares, and the part of the picture they show, in heights of a person.
SIDE_PX: Final = 168
_ROOM: Final = 2.4
_LEAST_PX: Final = 40
_QUALITY: Final = 74
#: The number of bars of a timeline.
BARS: Final = 72


class MarkedBox(NamedTuple):
    """A box (x, y, w, h) in pixels of a thumbnail, the id that gives its colour, and the id printed beside it."""

    xywh: tuple[float, float, float, float]
    identity: int
    label: int


class Thumbnail(NamedTuple):
    """A part of a picture in JPEG, its time in the log, and the box marked in it."""

    jpeg: bytes
    at_s: float
    box: MarkedBox | None


@dataclass
class IdentityEvent:
    """An event of an identity; ``weight_s`` is the shorter duration of the states before and after it."""

    t_ns: int
    row: Any
    weight_s: float
    text: str
    before: Thumbnail | None = None
    after: Thumbnail | None = None


@dataclass
class ChannelEvents:
    """The events of one channel of tracks, within ``span_s``.

    ``events`` are of the ``kinds``: identity switches if there is ground truth, otherwise repairs.
    """

    topic: str
    events: list[IdentityEvent]
    kinds: tuple[EventKind, ...]
    counts: dict[str, int]
    births: list[int]
    ends: list[int]
    rule: MatchRule | None
    span_s: float

    def to_json(self) -> dict[str, Any]:
        """The events as JSON, for the report's data."""
        return {
            "topic": self.topic,
            "similarity": self.rule[0] if self.rule else None,
            "gate": self.rule[1] if self.rule else None,
            "counts": self.counts,
            "births": self.births,
            "ends": self.ends,
            "bin_s": self.span_s / BARS,
            "moments": [
                {
                    "t_ns": event.t_ns,
                    "kind": EVENT_KINDS[EventKind(int(event.row["kind"]))],
                    **{name: int(event.row[name]) for name in ("truth_id", "previous_id", "track_id", "source_id")},
                    **{name: float(event.row[name]) for name in ("x_m", "y_m", "x_px", "y_px", "duration_s")},
                }
                for event in self.events
            ],
        }


def summarize_events(
    topic: str,
    events: Sequence[Frame],
    rule: MatchRule | None,
    tracks: Sequence[Frame],
    ground_truth: Sequence[Frame] | None,
    span_ns: tuple[int, int],
    classes: tuple[Mapping[int, str], Mapping[int, str]] = ({}, {}),
) -> ChannelEvents:
    """Collect the events of a channel of tracks. ``classes`` are names of those of the ground truth and of tracks."""
    start_ns, end_ns = span_ns
    nouns = nouns_of(ground_truth or (), tracks, classes)
    all_rows = [(frame.t_ns, row) for frame in events for row in frame.rows]
    t_ns = np.array([at for at, _ in all_rows], np.int64)
    kind = np.array([int(row["kind"]) for _, row in all_rows], np.int64)
    kinds = (EventKind.SWITCH,) if rule else (EventKind.JOINED, EventKind.PARTED)
    interval = frame_interval_s(tracks)
    chosen = [
        IdentityEvent(at, row, 0.0, describe(row, f"at {(at - start_ns) / NS_PER_S:.1f} s", interval, nouns))
        for at, row in all_rows
        if int(row["kind"]) in kinds
    ]
    _set_weights(chosen, ground_truth if rule and ground_truth else tracks, "truth_id" if rule else "track_id")
    span_s = max(end_ns - start_ns, 1) / NS_PER_S
    edges = start_ns + np.linspace(0, max(end_ns - start_ns, 1), BARS + 1)
    births, ends = (np.histogram(t_ns[kind == k], edges)[0].tolist() for k in (EventKind.BIRTH, EventKind.END))
    counts = {name: int((kind == k).sum()) for k, name in EVENT_KINDS.items()}
    return ChannelEvents(topic, chosen, kinds, counts, births, ends, rule, span_s)


def _set_weights(events: Sequence[IdentityEvent], frames: Sequence[Frame], column: str) -> None:
    """Set the weight of events: the shorter of the times for which the state before and the state after it lasted."""
    rows, t_ns = rows_by_track(frames)
    ids = rows["track_id"]
    by_id: dict[int, list[IdentityEvent]] = {}
    for event in events:
        by_id.setdefault(int(event.row[column]), []).append(event)
    for track_id, members in by_id.items():
        low, high = np.searchsorted(ids, [track_id, track_id + 1])
        if low == high:
            continue
        bounds = [int(t_ns[low]), *(event.t_ns for event in members), int(t_ns[high - 1])]
        for k, event in enumerate(members, 1):
            unseen_s = float(np.nan_to_num(event.row["duration_s"]))
            before_s = (bounds[k] - bounds[k - 1]) / NS_PER_S - unseen_s
            event.weight_s = max(min(before_s, (bounds[k + 1] - bounds[k]) / NS_PER_S), 0.0)


def most_important(channels: Sequence[ChannelEvents], most: int) -> list[list[IdentityEvent]]:
    """The events of each channel with the largest weights, ordered by time.

    They are ``most`` together, with as many of each channel as possible.
    """
    ranked = [sorted(channel.events, key=lambda m: (-m.weight_s, m.t_ns)) for channel in channels]
    shares = [0] * len(ranked)
    while sum(shares) < most and any(share < len(part) for share, part in zip(shares, ranked, strict=True)):
        open_ones = [k for k, part in enumerate(ranked) if shares[k] < len(part)]
        shares[min(open_ones, key=lambda k: shares[k])] += 1
    return [sorted(part[:share], key=lambda m: m.t_ns) for part, share in zip(ranked, shares, strict=True)]


def add_thumbnails(events: Sequence[IdentityEvent], tracks: Sequence[Frame], pictures: Pictures, start_ns: int) -> None:
    """Add thumbnails: the last picture before the event, and the picture of the event.

    Events without a position in the picture get none. Raises McaptrackError for damaged pictures.
    """
    rows, t_ns = rows_by_track(tracks)
    wanted: dict[int, list[tuple[IdentityEvent, bool, Any, Floats]]] = {}
    for event in events:
        event_row = event.row
        is_join = int(event_row["kind"]) == EventKind.JOINED
        # Seconds are rounded: a microsecond earlier is still after the previous frame.
        unseen_ns = seconds_to_ns(float(np.nan_to_num(event_row["duration_s"]))) + 1000
        old = _row_at(rows, t_ns, int(event_row["track_id" if is_join else "previous_id"]), event.t_ns - unseen_ns)
        new = _row_at(rows, t_ns, int(event_row["track_id"]), event.t_ns)
        region = _region([place[1] for place in (old, new) if place], event_row)
        if region is None or not len(pictures.t_ns):
            continue
        usual_ns = seconds_to_ns(frame_interval_s(tracks))
        before_ns = old[0] if old else event.t_ns - usual_ns
        for at_ns, place, is_after in ((before_ns, old, False), (event.t_ns, new, True)):
            number = max(int(np.searchsorted(pictures.t_ns, at_ns, "right")) - 1, 0)
            wanted.setdefault(number, []).append((event, is_after, place[1] if place else None, region))
    for frame in pictures.readable(wanted):
        image = np.asarray(frame.rows, np.uint8)
        for event, is_after, row, region in wanted[frame.index]:
            thumbnail = _crop(image, region, (frame.t_ns - start_ns) / NS_PER_S, row, _label(event.row, is_after))
            if is_after:
                event.after = thumbnail
            else:
                event.before = thumbnail


def _label(event_row: Any, is_after: bool) -> int:
    """The id printed at the box: that of the tracker where re-tracking joined tracks, otherwise that of the track."""
    if not is_after:
        return int(event_row["previous_id"])
    return int(event_row["source_id" if int(event_row["kind"]) == EventKind.JOINED else "track_id"])


def _row_at(rows: Rows, t_ns: Ints, track_id: int, until_ns: int) -> tuple[int, Any] | None:
    """Time and row of a track's last row up to a time; rows are ordered by track and time."""
    low, high = np.searchsorted(rows["track_id"], [track_id, track_id + 1])
    at = int(low + np.searchsorted(t_ns[low:high], until_ns, "right")) - 1
    return (int(t_ns[at]), rows[at]) if at >= low else None


def _region(rows: Sequence[Any], event_row: Any) -> Floats | None:
    """The square (x, y, side) around an event, in pixels; None if its position is not known."""
    boxes = np.array([[row["x_px"], row["y_px"], row["w_px"], row["h_px"]] for row in rows], float).reshape(-1, 4)
    boxes = boxes[np.isfinite(boxes).all(axis=1)]
    place = np.array([event_row["x_px"], event_row["y_px"]], float)
    corners = np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]])
    if np.isfinite(place).all():
        corners = np.concatenate([corners, place[None]])
    if not len(corners):
        return None
    low, high = corners.min(axis=0), corners.max(axis=0)
    person = float(boxes[:, 3].max()) if len(boxes) else _LEAST_PX / _ROOM
    side = max(_ROOM * person, float((high - low).max()) * 1.2, _LEAST_PX)
    return np.array([*((low + high - side) / 2), side])


def _crop(image: NDArray[np.uint8], region: Floats, at_s: float, row: Any, label: int) -> Thumbnail | None:
    """The square of a picture, moved inside at its border; None if it lies outside."""
    import cv2

    height, width = image.shape[:2]
    side = int(min(region[2], width, height))
    x, y = (int(np.clip(at, 0, most - side)) for at, most in zip(region[:2], (width, height), strict=True))
    piece = image[y : y + side, x : x + side]
    if side < 2:
        return None
    smooth = cv2.INTER_AREA if side > SIDE_PX else cv2.INTER_CUBIC
    small = np.asarray(cv2.resize(piece, (SIDE_PX, SIDE_PX), interpolation=smooth), np.uint8)
    box = None
    if row is not None and np.isfinite([row["x_px"], row["y_px"], row["w_px"], row["h_px"]]).all():
        scale = SIDE_PX / side
        left, top = (float(row["x_px"]) - x) * scale, (float(row["y_px"]) - y) * scale
        xywh = (left, top, float(row["w_px"]) * scale, float(row["h_px"]) * scale)
        box = MarkedBox(xywh, int(row["track_id"]), label)
    return Thumbnail(encode_image(small, "jpeg", _QUALITY), at_s, box)


# The decisions of re-tracking that are least certain: by their probabilities, where the log has these (decisions),
# and otherwise by how far a joined track appears from where the person was expected.


#: The number of repairs that are shown, and the least distance from the expected place of those.
_MOST: Final = 6
_LEAST_M: Final = 0.5
#: Decisions that are right with at least this probability are not shown.
_UNSURE: Final = 0.8
#: From this probability on, an estimate says that a decision is right.
_EVEN: Final = 0.5
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
            text = f"{start}. It appears {number(self.away_m, 1, 'm')} from where it was expected."
            return f"{text} {self.verdict}".rstrip()
        before, after = int(self.event.row["previous_id"]), self.alternative_id
        other = f"{before} goes on as {after}" if after >= 0 else f"{before} ended, and another came"
        if after == before:  # the join left an input track that went on
            other = f"{before} goes on as it did"
        text = f"{start}. Its estimated probability is {percent(self.probability, 0)}; otherwise {other}."
        is_surprise = self.is_right is not None and self.is_right != (self.probability >= _EVEN)
        verdict = f"All the same, t{self.verdict[1:]}" if is_surprise else self.verdict
        return f"{text} {verdict}".rstrip()


class DoubtfulTrack(NamedTuple):
    """A track of which it is not certain that it follows a person: rows of decisions, kept or left out."""

    t_ns: int
    row: Any

    def text(self, noun: str) -> str:
        """The decision in words; ``noun`` is that of what is tracked, with its article."""
        row = self.row
        is_kept = int(row["kind"]) == DecisionKind.KEPT
        track = f"track {row['track_id']}" if is_kept else f"the tracker's {row['source_id']}"
        chance = float(row["probability"]) if is_kept else 1 - float(row["probability"])
        seen = f"seen for {number(float(row['duration_s']), 1, 's')}" if row["duration_s"] > 0 else "seen once"
        done = f"{track} is {'kept' if is_kept else 'left out'}, {seen}"
        but = ": the" if is_kept == (chance >= _EVEN) else ", although the"
        return f"{done}{but} probability of being {noun} is {percent(chance, 0)}"


def find_doubts(
    repairs: ChannelEvents,
    tracks: Sequence[Frame],
    people: PersonScores | None,
    decisions: Sequence[Frame] = (),
) -> list[Doubt]:
    """The repairs that are least likely, the least likely first; those below ``_UNSURE``.

    ``decisions`` are rows of Decisions of these ``tracks``. Without any, the repairs that are farthest from where the
    person was expected, going on as in the last two seconds before the gap. ``people`` are the scores of ``tracks`` by
    person, if there is ground truth. Repairs without positions in metres are left out.
    """
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
