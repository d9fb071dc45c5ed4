"""Events in the life of tracks, and counts for each frame: rows of Events and of Counts.

Births, terminations and repairs by re-tracking follow from the tracks alone. Misses, false tracks and identity switches
follow from the same matches with the ground truth that the scores count; their sums are the counts of CLEAR.

Letters: F frames of the tracks or of the ground truth, N rows, R events, P matches.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from mcaptrack.choices import Similarity
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.aligned import (
    GATE_3D_M,
    GATE_M,
    IOU_THRESHOLD,
    RowComparison,
    align,
    are_3d,
    compare_rows,
    explain_no_match,
    has_positions,
    have_same_times,
    refuse_sides_without,
    share_classes,
    sides_without,
)
from mcaptrack.evaluation.metrics import is_switch, matches
from mcaptrack.evaluation.metrics.matchup import RowPairs
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.geometry.ragged import group_index, run_ends, run_starts
from mcaptrack.schema import COUNTS, EVENTS, TRACKS, EventKind, Frame, Rows
from mcaptrack.schema.framing import frame_numbers, frame_times, joined_parts, split_rows
from mcaptrack.schema.resampling import interval_ns


@dataclass(frozen=True)
class EventOptions:
    """Options of matching tracks with people. ``similarity`` None: the default for the tracks (see `default_rule`).

    ``gate_m`` is the largest distance for "metres", ``min_iou`` the least overlap for the others; None: the default.
    """

    similarity: Similarity | None = None
    gate_m: float | None = None
    min_iou: float | None = None

    def rule(self, similarity: Similarity, is_3d: bool = False) -> MatchRule:
        """The rule for a similarity, with the gate of these options, or the default one; 3D boxes have another."""
        usual_m = GATE_3D_M if is_3d else GATE_M
        gate, usual = (self.gate_m, usual_m) if similarity == "metres" else (self.min_iou, IOU_THRESHOLD)
        return MatchRule(similarity, usual if gate is None else gate)


class MatchRule(NamedTuple):
    """A similarity and its gate."""

    similarity: Similarity
    gate: float


class TrackEvents(NamedTuple):
    """Events and counts: one frame of each for every frame of the tracks and of the ground truth.

    ``rule`` is None if there was nothing to compare with; ``notes`` say why, and what else is odd.
    ``frame_interval_s`` is the usual time between two compared frames.
    """

    events: list[Frame]
    counts: list[Frame]
    rule: MatchRule | None
    notes: list[str]
    frame_interval_s: float

    def parameters(self, options: EventOptions) -> dict[str, Any]:
        """Options and rule, as in the provenance."""
        return {"asked": asdict(options)} | (self.rule._asdict() if self.rule else {"similarity": None, "gate": None})


class _Comparison(NamedTuple):
    """Tracks compared with the ground truth: matches by person and frame, and the times of the frames."""

    compared: RowComparison
    matches: RowPairs
    t_ns: Ints


# Events that follow from tracks alone: births, ends, and repairs by re-tracking.
#
# Letters: N rows, R events.


NO_ID: Final = -1
#: Interruptions shorter than this do not split a period.
MAX_PAUSE_S: Final = 1.0


def event_rows(kind: EventKind, places: Rows, **columns: Ints | Floats) -> Rows:
    """Events of one kind, at the positions of the rows of tracks or ground truth in ``places`` (R,)."""
    out = EVENTS.empty(len(places))
    out["kind"] = kind
    for name in ("track_id", "truth_id", "previous_id", "source_id"):
        out[name] = NO_ID
    out["x_m"], out["y_m"] = places["x_m"], places["y_m"]
    out["x_px"], out["y_px"] = places["x_px"] + places["w_px"] / 2, places["y_px"] + places["h_px"] / 2
    out["duration_s"] = np.nan
    for name, values in columns.items():
        out[name] = values
    return out


def unobserved_s(frame_ns: Ints, last_ns: Ints, next_ns: Ints) -> Floats:
    """Seconds from the first frame after ``last_ns`` to ``next_ns`` (R,): 0 for consecutive frames."""
    after = np.minimum(np.searchsorted(frame_ns, last_ns, "right"), max(len(frame_ns) - 1, 0))
    apart: Floats = np.maximum(next_ns - frame_ns[after], 0) / NS_PER_S
    return apart


class TrackLifecycle:
    """The rows of tracks with the time of each, and the times of all frames. Rows are ordered by time and id.

    Of the rows only those matter at which something begins or ends; ``size`` are the numbers of all rows of each track,
    by rising ids.
    """

    def __init__(self, rows: Rows, row_ns: Ints, frame_ns: Ints, size: Ints) -> None:
        self.rows, self.row_ns, self.frame_ns = rows, row_ns, frame_ns
        order = np.lexsort((row_ns, rows["track_id"]))
        ids = rows["track_id"][order]
        starts = run_starts(ids)
        self._first, self._last = order[starts], order[run_ends(starts)]
        self._size = size

    def births(self) -> tuple[Ints, Rows]:
        """The first row of each track."""
        begins = self.rows[self._first]
        return self.row_ns[self._first], event_rows(EventKind.BIRTH, begins, track_id=begins["track_id"])

    def ends(self) -> tuple[Ints, Rows]:
        """The last row of each track that ends before the last frame, with the track's duration and number of rows."""
        until = self.row_ns[self._last]
        kept = until < (self.frame_ns[-1] if len(self.frame_ns) else 0)
        ends, until, since = self.rows[self._last][kept], until[kept], self.row_ns[self._first][kept]
        lasted = (until - since + int(interval_ns(self.frame_ns))) / NS_PER_S
        size = self._size[kept]
        return until, event_rows(EventKind.END, ends, track_id=ends["track_id"], duration_s=lasted, frames=size)

    def repairs(self) -> tuple[Ints, Rows]:
        """Find repairs: a track that continues with another source (joined), a source that continues as another track
        (parted).

        ``source_id`` of a row is the id that its position had before re-tracking.
        """
        has_source = self.rows["source_id"] >= 0
        rows, t_ns = self.rows[has_source], self.row_ns[has_source]
        order = np.lexsort((t_ns, rows["track_id"]))
        rows, t_ns = rows[order], t_ns[order]
        start, end = _runs(rows["track_id"], rows["source_id"], t_ns)
        track, source = rows["track_id"][start], rows["source_id"][start]
        joined = np.zeros(len(start), bool)
        joined[1:] = track[1:] == track[:-1]
        before = np.maximum(np.arange(len(start)) - 1, 0)
        at = start[joined]
        moved = event_rows(
            EventKind.JOINED,
            rows[at],
            track_id=track[joined],
            previous_id=source[before][joined],
            source_id=source[joined],
            duration_s=unobserved_s(self.frame_ns, t_ns[end[before]][joined], t_ns[at]),
        )
        by_source = np.lexsort((t_ns[start], source))
        owner = np.full(len(start), NO_ID)
        same = source[by_source][1:] == source[by_source][:-1]
        owner[by_source[1:][same]] = track[by_source[:-1]][same]
        parted = ~joined & (owner >= 0) & (owner != track)
        split = event_rows(
            EventKind.PARTED,
            rows[start[parted]],
            track_id=track[parted],
            previous_id=owner[parted],
            source_id=source[parted],
        )
        return np.concatenate([t_ns[at], t_ns[start[parted]]]), np.concatenate([moved, split])


def lifecycle_of(frames: Sequence[Frame]) -> TrackLifecycle:
    """The life of tracks, from the rows at which a track, or a run of one source, begins or ends."""
    ids, size = np.empty(0, np.int64), np.empty(0, np.int64)
    kept, kept_ns = [TRACKS.empty()], [np.empty(0, np.int64)]
    for _, _, joined in joined_parts(TRACKS, frames):
        rows, row_ns = joined.rows, joined.row_ns
        present, count = np.unique(rows["track_id"], return_counts=True)
        ids, which = np.unique(np.concatenate([ids, present]), return_inverse=True)
        size = np.bincount(which, np.concatenate([size, count]), len(ids)).astype(np.int64)
        matters = np.zeros(len(rows), bool)
        for some in (np.arange(len(rows)), np.flatnonzero(rows["source_id"] >= 0)):
            order = some[np.lexsort((row_ns[some], rows["track_id"][some]))]
            starts = run_starts(rows["track_id"][order], rows["source_id"][order])
            matters[order[starts | run_ends(starts)]] = True
        kept.append(rows[matters])
        kept_ns.append(row_ns[matters])
    rows, row_ns = TRACKS.joined(kept), np.concatenate(kept_ns)
    order = np.lexsort((rows["track_id"], row_ns))
    return TrackLifecycle(rows[order], row_ns[order], np.unique(frame_times(frames)), size)


def _runs(track: Ints, source: Ints, t_ns: Ints) -> tuple[Ints, Ints]:
    """First and last rows of the runs of one track with one source; rows are ordered by track and time.

    Runs shorter than ``MAX_PAUSE_S`` between two runs of the same source are skipped.
    """
    starts = np.flatnonzero(run_starts(track, source))
    lasts = np.append(starts[1:], len(track)) - 1 if len(starts) else starts
    track, source, at = track[starts], source[starts], t_ns[starts]
    brief = np.zeros(len(starts), bool)
    is_between = (track[2:] == track[:-2]) & (source[2:] == source[:-2])
    brief[1:-1] = is_between & (at[2:] - at[1:-1] < seconds_to_ns(MAX_PAUSE_S))
    starts, lasts = starts[~brief], lasts[~brief]
    first = run_starts(track[~brief], source[~brief])
    return starts[first], lasts[run_ends(first)]


def find_events(
    tracks: Sequence[Frame],
    ground_truth: Sequence[Frame] | None,
    options: EventOptions = EventOptions(),
    name: str = "the log",
    tracks_name: str = "the tracks",
    classes: tuple[Mapping[int, str], Mapping[int, str]] = ({}, {}),
) -> TrackEvents:
    """Find the events of a channel of tracks and count its rows frame by frame.

    Parameters
    ----------
    tracks : sequence of Frame
        Rows of Tracks. Their ``source_id`` names tracks from before re-tracking, if any.
    ground_truth : sequence of Frame, optional
        Rows of Tracks. If it can't be compared, a note says why and there are no misses, false tracks and switches.
    options : EventOptions
    name, tracks_name : str
        Names for messages.
    classes : tuple of mapping of int to str
        Names of the classes of the ground truth and of the tracks, by number. Only tracks and people (objects) of one
        class are matched.

    Returns
    -------
    TrackEvents
    """
    notes: list[str] = []
    comparison, rule = None, None
    if ground_truth is not None:
        try:
            comparison, rule = _compared(tracks, ground_truth, options, (name, tracks_name), notes, classes)
        except McaptrackError as error:
            notes.append(f"no misses, false tracks and switches of {tracks_name}: {error}")
    compared = ground_truth or () if comparison else ()
    index: dict[int, int] = {}
    for frames in (compared, tracks):
        index |= zip(frame_times(frames).tolist(), frame_numbers(frames).tolist(), strict=True)
    compared_ns = comparison.t_ns if comparison else np.empty(0, np.int64)
    t_ns = np.unique(np.concatenate([frame_times(tracks), compared_ns]))
    lifecycle = lifecycle_of(tracks)
    parts = [lifecycle.births(), lifecycle.ends(), lifecycle.repairs()]
    if comparison:
        parts += [_switches(comparison)]
        parts += [_unmatched(comparison, kind) for kind in (EventKind.MISS, EventKind.FALSE_TRACK)]
    events, events_ns = _in_order(parts)
    counts = _counts(t_ns, tracks, events, events_ns, comparison)
    numbers = [index.get(at, 0) for at in t_ns.tolist()]
    ends = np.searchsorted(events_ns, t_ns, "right")
    return TrackEvents(
        split_rows(t_ns, numbers, events, ends),
        split_rows(t_ns, numbers, counts, np.arange(1, len(t_ns) + 1)),
        rule,
        notes,
        int(interval_ns(compared_ns)) / NS_PER_S,
    )


def default_rule(ground_truth: Sequence[Frame], tracks: Sequence[Frame]) -> MatchRule | None:
    """The default rule: overlap if tracks have the times of labelled boxes, otherwise distance on the ground.

    None if ground truth and tracks share neither boxes nor positions in metres.
    """
    shared = [kind for kind in ("iou", "metres") if not sides_without({"truth": ground_truth, "tracks": tracks}, kind)]
    at_video_rate = have_same_times(frame_times(ground_truth), frame_times(tracks))
    first: tuple[Similarity, ...] = (
        ("iou", "metres") if at_video_rate and has_positions(ground_truth, "iou") else ("metres", "iou")
    )
    chosen = next((kind for kind in first if kind in shared), None)
    return EventOptions().rule(chosen, are_3d(ground_truth, tracks)) if chosen else None


def _compared(
    tracks: Sequence[Frame],
    ground_truth: Sequence[Frame],
    options: EventOptions,
    names: tuple[str, str],
    notes: list[str],
    classes: tuple[Mapping[int, str], Mapping[int, str]],
) -> tuple[_Comparison, MatchRule]:
    """Match tracks with the ground truth. Raises McaptrackError if they can't be compared."""
    if not any(len(frame.rows) for frame in ground_truth):
        raise McaptrackError("the ground truth is empty")
    interval = default_rule(ground_truth, tracks)
    similarity = options.similarity or (interval.similarity if interval else None)
    if similarity is None:
        raise McaptrackError(f"{names[1]} and the ground truth share neither boxes nor positions in metres")
    rule = options.rule(similarity, are_3d(ground_truth, tracks))
    refuse_sides_without("", {"the ground truth": ground_truth, names[1]: tracks}, similarity)
    at_same = align(*names, ground_truth, tracks)
    shared = share_classes(*names, *at_same, *classes)
    notes += shared.notes
    compared = compare_rows(shared.ground_truth, shared.tracks, *rule, by_class=bool(shared.names))
    pairs = matches(compared.matchup)
    if len(pairs.person) == 0:
        notes += explain_no_match(*names, *at_same, rule.similarity)
    return _Comparison(compared, pairs, frame_times(at_same[0])), rule


def _in_order(parts: Sequence[tuple[Ints, Rows]]) -> tuple[Rows, Ints]:
    """Events of all kinds ordered by time, and their times (R,)."""
    t_ns = np.concatenate([when for when, _ in parts])
    rows = np.concatenate([part for _, part in parts])
    order = np.lexsort((rows["source_id"], rows["truth_id"], rows["track_id"], rows["kind"], t_ns))
    return EVENTS.check(rows[order]), t_ns[order]


def _switches(comparison: _Comparison) -> tuple[Ints, Rows]:
    """One event for each switch that CLEAR counts."""
    at = np.flatnonzero(is_switch(comparison.matches))
    pairs, (_, ground_truth, tracks) = comparison.matches, comparison.compared
    now_ns, before_ns = comparison.t_ns[pairs.frame[at]], comparison.t_ns[pairs.frame[at - 1]]
    return now_ns, event_rows(
        EventKind.SWITCH,
        ground_truth.rows[pairs.row[at]],
        truth_id=ground_truth.ids[pairs.person[at]],
        track_id=tracks.ids[pairs.track[at]],
        previous_id=tracks.ids[pairs.track[at - 1]],
        duration_s=unobserved_s(comparison.t_ns, before_ns, now_ns),
    )


def _unmatched(comparison: _Comparison, kind: Literal[EventKind.MISS, EventKind.FALSE_TRACK]) -> tuple[Ints, Rows]:
    """Periods in which a person has no track, or a track matches no person; ``previous_id`` is that of the last match.

    Matches shorter than ``MAX_PAUSE_S`` do not end a period.
    """
    pairs, frame_ns, (_, ground_truth, tracks) = comparison.matches, comparison.t_ns, comparison.compared
    side, other, name = ground_truth, tracks, "truth_id"
    mine, theirs, matched = pairs.person, pairs.track, pairs.row
    if kind is EventKind.FALSE_TRACK:
        side, other, name = tracks, ground_truth, "track_id"
        mine, theirs, matched = pairs.track, pairs.person, pairs.column
    unmatched = np.ones(len(side.rows), bool)
    unmatched[matched] = False
    at = group_index(np.diff(side.ends))[unmatched]
    rows, slot = side.rows[unmatched], side.track[unmatched]
    order = np.lexsort((at, slot))
    rows, slot, at = rows[order], slot[order], at[order]
    t_ns, interval = frame_ns[at], int(interval_ns(frame_ns))
    pause = max(seconds_to_ns(MAX_PAUSE_S), round(1.5 * interval))
    start = np.flatnonzero(run_starts(slot, times=t_ns, max_gap=pause))
    end = np.append(start[1:], len(slot)) if len(start) else start
    lasts = (t_ns[end - 1] - t_ns[start] + interval) / NS_PER_S
    previous = np.full(len(start), NO_ID)
    if len(mine):
        by_mine = np.lexsort((pairs.frame, mine))
        width = int(max(pairs.frame.max(), at.max(initial=0))) + 1
        before = np.searchsorted((mine * width + pairs.frame)[by_mine], slot[start] * width + at[start]) - 1
        match = by_mine[before]
        has_match = (before >= 0) & (mine[match] == slot[start])
        previous[has_match] = other.ids[theirs[match[has_match]]]
    periods = {name: rows["track_id"][start], "previous_id": previous, "frames": end - start, "duration_s": lasts}
    return t_ns[start], event_rows(kind, rows[start], **periods)


def _counts(t_ns: Ints, tracks: Sequence[Frame], events: Rows, events_ns: Ints, comparison: _Comparison | None) -> Rows:
    """A row of Counts for each of the times (F,)."""
    total = len(t_ns)
    out = COUNTS.empty(total)
    for name in ("people", "matches", "misses", "false_tracks", "switches", "mota"):
        out[name] = np.nan
    for _, _, joined in joined_parts(TRACKS, tracks):
        at = np.searchsorted(t_ns, joined.row_ns)
        for name, of in (("tracked", at), ("observed", at[joined.rows["observed"]])):
            some, count = np.unique(of, return_counts=True)
            out[name][some] += count.astype(out[name].dtype)

    def so_far(*kinds: EventKind) -> Ints:
        chosen = np.isin(events["kind"], kinds)
        return np.searchsorted(events_ns[chosen], t_ns, "right")

    out["born"], out["ended"] = so_far(EventKind.BIRTH), so_far(EventKind.END)
    out["repaired"] = so_far(EventKind.JOINED, EventKind.PARTED)
    if comparison is None:
        return out
    matchup, looked_at = comparison.compared.matchup, np.searchsorted(t_ns, comparison.t_ns)
    hits = np.bincount(comparison.matches.frame, minlength=len(comparison.t_ns))
    false, people = matchup.track_counts - hits, matchup.ground_truth_counts
    switches = so_far(EventKind.SWITCH)[looked_at]
    of_all = np.cumsum(people)
    out["people"][looked_at], out["matches"][looked_at] = people, hits
    out["misses"][looked_at], out["false_tracks"][looked_at] = people - hits, false
    out["switches"][looked_at] = switches
    right = np.cumsum(hits) - np.cumsum(false) - switches
    out["mota"][looked_at] = np.where(of_all > 0, right / np.maximum(of_all, 1), np.nan)
    return COUNTS.check(out)
