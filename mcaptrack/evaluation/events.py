"""What happened to the identities of tracks, and how tracking stands frame by frame: rows of Events and of Counts.

Births, ends and what re-tracking repaired follow from the tracks alone; misses, false tracks and identity switches from
the matches with the truth that the scores count, so that they add up to these.

Letters: F frames of the tracks or of what they are compared with, N rows, R events, P matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.aligned import (
    GATE_M,
    IOU_THRESHOLD,
    Compared,
    Placed,
    Similarity,
    align,
    compare,
    frame_times,
    has,
    join_rows,
    share_times,
    strangers,
    without,
)
from mcaptrack.evaluation.lives import NOBODY, SAME_S, Lives, between_s, event_rows, usual_ns
from mcaptrack.evaluation.metrics.clear import matches, switched
from mcaptrack.evaluation.metrics.matchup import Pairs
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.schema import COUNTS, EVENTS, EventKind, Frame, Rows


@dataclass(frozen=True)
class EventOptions:
    """What makes a person and a track alike; ``similarity`` None is what suits the tracks (``usual_rule``).

    ``gate_m`` is the largest distance for "metres", ``min_iou`` the least overlap for "iou"; None is what is usual.
    """

    similarity: Similarity | None = None
    gate_m: float | None = None
    min_iou: float | None = None

    def rule(self, similarity: Similarity) -> Rule:
        """By this similarity, within the gate that was asked for."""
        gate, usual = (self.min_iou, IOU_THRESHOLD) if similarity == "iou" else (self.gate_m, GATE_M)
        return Rule(similarity, usual if gate is None else gate)


class Rule(NamedTuple):
    """By what and within what a person and a track are alike."""

    similarity: Similarity
    gate: float


class Found(NamedTuple):
    """Events and counts, a frame each for every frame of the tracks and of the truth that they were compared with.

    ``rule`` is None where they were not compared with any; ``notes`` say why, and what else is odd. ``usual_s`` is what
    lies between two frames that were compared.
    """

    events: list[Frame]
    counts: list[Frame]
    rule: Rule | None
    notes: list[str]
    usual_s: float

    def parameters(self, options: EventOptions) -> dict[str, Any]:
        """How they were made, as the provenance says it: what was asked for, and what came of it."""
        return {"asked": asdict(options)} | (self.rule._asdict() if self.rule else {"similarity": None, "gate": None})


class _Truth(NamedTuple):
    """Tracks compared with the truth: matches by person and frame, and what of both sides has none."""

    compared: Compared
    found: Pairs
    t_ns: Ints


def find_events(
    tracks: Sequence[Frame],
    truth: Sequence[Frame] | None,
    options: EventOptions = EventOptions(),
    name: str = "the log",
    tracks_name: str = "the tracks",
) -> Found:
    """The events and counts of one channel of tracks, with the truth as far as it can be compared."""
    notes: list[str] = []
    both, rule = None, None
    if truth is not None:
        try:
            both, rule = _compared(tracks, truth, options, (name, tracks_name), notes)
        except McaptrackError as error:
            notes.append(f"no misses, false tracks and switches of {tracks_name}: {error}")
    index = {frame.t_ns: frame.index for frame in truth or () if both is not None} | {f.t_ns: f.index for f in tracks}
    seen_ns = both.t_ns if both else np.empty(0, np.int64)
    t_ns = np.unique(np.concatenate([frame_times(tracks), seen_ns]))
    rows, bounds = join_rows(tracks)
    row_ns = np.repeat(frame_times(tracks), np.diff(bounds))
    order = np.lexsort((rows["track_id"], row_ns))
    own = Lives(rows[order], row_ns[order], np.unique(frame_times(tracks)))
    parts = [own.births(), own.ends(), own.repairs()]
    if both:
        parts += [_switches(both), _misses(both), _false_tracks(both)]
    events, events_ns = _in_order(parts)
    counts = _counts(t_ns, own, events, events_ns, both)
    numbers = [index.get(at, 0) for at in t_ns.tolist()]
    ends = np.searchsorted(events_ns, t_ns, "right")
    return Found(
        _framed(t_ns, numbers, events, ends),
        _framed(t_ns, numbers, counts, np.arange(1, len(t_ns) + 1)),
        rule,
        notes,
        usual_ns(seen_ns) / NS_PER_S,
    )


def _framed(t_ns: Ints, index: list[int], rows: Rows, ends: Ints) -> list[Frame]:
    starts = np.concatenate([[0], ends[:-1]]) if len(ends) else ends
    spans = zip(t_ns.tolist(), index, starts.tolist(), ends.tolist(), strict=True)
    return [Frame(at, number, rows[low:high]) for at, number, low, high in spans]


def usual_rule(truth: Sequence[Frame], tracks: Sequence[Frame]) -> Rule | None:
    """What suits tracks: overlap at the times at which people drew boxes, and otherwise distance on the ground.

    None if truth and tracks share neither boxes nor positions in metres.
    """
    shared = [one for one in ("iou", "metres") if not without({"truth": truth, "tracks": tracks}, one)]
    at_video_rate = share_times(frame_times(truth), frame_times(tracks))
    first: tuple[Similarity, ...] = ("iou", "metres") if at_video_rate and has(truth, "iou") else ("metres", "iou")
    chosen = next((one for one in first if one in shared), None)
    return EventOptions().rule(chosen) if chosen else None


def _compared(
    tracks: Sequence[Frame], truth: Sequence[Frame], options: EventOptions, names: tuple[str, str], notes: list[str]
) -> tuple[_Truth, Rule]:
    """Raises McaptrackError if they can't be compared."""
    if not any(len(frame.rows) for frame in truth):
        raise McaptrackError("the truth holds nobody")
    usual = usual_rule(truth, tracks)
    similarity = options.similarity or (usual.similarity if usual else None)
    if similarity is None:
        raise McaptrackError(f"{names[1]} and the truth share neither boxes nor positions in metres")
    rule = options.rule(similarity)
    if lacking := without({"the truth": truth, names[1]: tracks}, similarity):
        unit = "boxes" if similarity == "iou" else "positions in metres"
        raise McaptrackError(f"{' and '.join(lacking)} {'have' if len(lacking) > 1 else 'has'} no {unit}")
    at_same = align(*names, truth, tracks)
    compared = compare(*at_same, *rule)
    found = matches(compared.matchup)
    if len(found.who) == 0:
        notes += strangers(*names, *at_same, rule.similarity)
    return _Truth(compared, found, frame_times(at_same[0])), rule


def _in_order(parts: Sequence[tuple[Ints, Rows]]) -> tuple[Rows, Ints]:
    """Events of all kinds by time, and their times (R,)."""
    t_ns = np.concatenate([when for when, _ in parts])
    rows = np.concatenate([part for _, part in parts])
    order = np.lexsort((rows["source_id"], rows["truth_id"], rows["track_id"], rows["kind"], t_ns))
    return EVENTS.check(rows[order]), t_ns[order]


def _switches(both: _Truth) -> tuple[Ints, Rows]:
    """One event for every switch that CLEAR counts."""
    at = np.flatnonzero(switched(both.found))
    found, (_, truth, tracks) = both.found, both.compared
    now_ns, before_ns = both.t_ns[found.frame[at]], both.t_ns[found.frame[at - 1]]
    return now_ns, event_rows(
        EventKind.SWITCH,
        truth.rows[found.row[at]],
        truth_id=truth.names[found.who[at]],
        track_id=tracks.names[found.by[at]],
        previous_id=tracks.names[found.by[at - 1]],
        duration_s=between_s(both.t_ns, before_ns, now_ns),
    )


def _misses(both: _Truth) -> tuple[Ints, Rows]:
    """Spells in which a true person has no track; ``previous_id`` is the track they had."""
    found, (_, truth, tracks) = both.found, both.compared
    t_ns, places, spells = _spells(truth, found.row, both.t_ns)
    had = _before(found.who, found.frame, found.by, spells.who, spells.frame, tracks.names)
    return t_ns, event_rows(EventKind.MISS, places, truth_id=places["track_id"], previous_id=had, **spells.columns())


def _false_tracks(both: _Truth) -> tuple[Ints, Rows]:
    """Spells in which a track is nobody; ``previous_id`` is the person that it was."""
    found, (_, truth, tracks) = both.found, both.compared
    t_ns, places, spells = _spells(tracks, found.column, both.t_ns)
    order = np.lexsort((found.frame, found.by))
    had = _before(found.by[order], found.frame[order], found.who[order], spells.who, spells.frame, truth.names)
    return t_ns, event_rows(
        EventKind.FALSE_TRACK, places, track_id=places["track_id"], previous_id=had, **spells.columns()
    )


def _before(mine: Ints, frame: Ints, other: Ints, who: Ints, at: Ints, names: Ints) -> Ints:
    """The name of whom each of ``who`` (R,) was matched with last before the frame ``at``; -1 for nobody.

    Matches are ``mine`` with ``other`` (P,), ordered by ``mine`` and ``frame``.
    """
    out = np.full(len(who), NOBODY)
    if len(mine):
        width = int(max(frame.max(), at.max(initial=0))) + 1
        place = np.searchsorted(mine * width + frame, who * width + at) - 1
        known = (place >= 0) & (mine[place] == who)
        out[known] = names[other[place[known]]]
    return out


class _Spells(NamedTuple):
    """Spells of one id without a match: dense number, first frame, frames without a match, seconds (R,)."""

    who: Ints
    frame: Ints
    frames: Ints
    duration_s: Floats

    def columns(self) -> dict[str, Ints | Floats]:
        return {"frames": self.frames, "duration_s": self.duration_s}


def _spells(side: Placed, matched: Ints, frame_ns: Ints) -> tuple[Ints, Rows, _Spells]:
    """Spells in which the same id has no match, with time and row of the beginning.

    Matches that last less than a moment don't end a spell.
    """
    alone = np.ones(len(side.rows), bool)
    alone[matched] = False
    at = np.repeat(np.arange(len(frame_ns)), np.diff(side.ends))[alone]
    rows, who = side.rows[alone], side.who[alone]
    order = np.lexsort((at, who))
    rows, who, at = rows[order], who[order], at[order]
    t_ns, usual = frame_ns[at], usual_ns(frame_ns)
    pause = max(seconds_to_ns(SAME_S), round(1.5 * usual))
    begins = np.append(True, (who[1:] != who[:-1]) | (np.diff(t_ns) > pause))[: len(who)]
    start = np.flatnonzero(begins)
    end = np.append(start[1:], len(who)) if len(start) else start
    lasts = (t_ns[end - 1] - t_ns[start] + usual) / NS_PER_S
    return t_ns[start], rows[start], _Spells(who[start], at[start], end - start, lasts)


def _counts(t_ns: Ints, own: Lives, events: Rows, events_ns: Ints, both: _Truth | None) -> Rows:
    """A row for each of the times (F,)."""
    total = len(t_ns)
    out = COUNTS.empty(total)
    for name in ("people", "matches", "misses", "false_tracks", "switches", "mota"):
        out[name] = np.nan
    at = np.searchsorted(t_ns, own.row_ns)
    out["tracked"] = np.bincount(at, minlength=total)
    out["observed"] = np.bincount(at[own.rows["observed"]], minlength=total)

    def so_far(*kinds: EventKind) -> Ints:
        chosen = np.isin(events["kind"], kinds)
        return np.searchsorted(events_ns[chosen], t_ns, "right")

    out["born"], out["ended"] = so_far(EventKind.BIRTH), so_far(EventKind.END)
    out["repaired"] = so_far(EventKind.JOINED, EventKind.PARTED)
    if both is None:
        return out
    matchup, looked_at = both.compared.matchup, np.searchsorted(t_ns, both.t_ns)
    hits = np.bincount(both.found.frame, minlength=len(both.t_ns))
    false, people = matchup.track_counts - hits, matchup.truth_counts
    switches = so_far(EventKind.SWITCH)[looked_at]
    of_all = np.cumsum(people)
    out["people"][looked_at], out["matches"][looked_at] = people, hits
    out["misses"][looked_at], out["false_tracks"][looked_at] = people - hits, false
    out["switches"][looked_at] = switches
    right = np.cumsum(hits) - np.cumsum(false) - switches
    out["mota"][looked_at] = np.where(of_all > 0, right / np.maximum(of_all, 1), np.nan)
    return COUNTS.check(out)
