"""Misses, false tracks and switches against a second, slow way to find them, on random tracks."""

from __future__ import annotations

from itertools import chain, groupby, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.evaluation.aligned import make_matchup
from mcaptrack.evaluation.events import find_events
from mcaptrack.evaluation.metrics import matches
from mcaptrack.schema import EventKind, Frame, framing
from tests.worlds import ns, tracks_at


def random_world(rng: np.random.Generator) -> tuple[list[Frame], list[Frame]]:
    """People who come and go, and tracks of them: missed now and then for longer, ids that break, and ghosts."""
    start, speed = rng.uniform(-5, 5, (4, 2)), rng.normal(0, 0.1, (4, 2))
    since, until = rng.integers(0, 15, 4), rng.integers(25, 60, 4)
    names, lost, truth, tracks, now = [10, 20, 30, 40], np.zeros(4), [], [], 0.0
    slower = rng.choice([1.0, 9.0])  # ten frames a second, or about one
    for number in range(50):
        now += slower * rng.choice([0.1, 0.1, 0.1, 0.1, 0.2, 0.7])
        people, found = {}, {}
        for who in range(4):
            here = start[who] + number * speed[who]
            if not since[who] <= number < until[who]:
                continue
            people[who + 1] = tuple(here)
            if rng.random() < 0.1:
                lost[who] = number + rng.integers(1, 15)
            if rng.random() < 0.08:
                names[who] += 1
            if lost[who] <= number:
                found[names[who]] = tuple(here + rng.normal(0, 0.35, 2))
        if rng.random() < 0.3:
            found[int(rng.integers(90, 93))] = tuple(rng.uniform(-20, 20, 2))
        for frames, places in ((truth, people), (tracks, found)):  # in any order
            frames.append(
                Frame(ns(now), number, tracks_at({who: places[who] for who in rng.permutation(list(places))}))
            )
    return truth, tracks


Event = tuple[int, int, int, int, int, int, float]


def spells(kind: EventKind, here: dict, matched: dict, times: list[int], usual: int) -> list[Event]:
    """Times without a match of each id; ``here`` maps ids to frames in which they are, ``matched`` to others by frame."""
    pause, out = max(1_000_000_000, round(1.5 * usual)), []
    for who, frames in here.items():
        alone = [frame for frame in frames if frame not in matched.get(who, {})]
        while alone:
            end = 1
            while end < len(alone) and times[alone[end]] - times[alone[end - 1]] <= pause:
                end += 1
            spell, alone = alone[:end], alone[end:]
            before = [frame for frame in matched.get(who, {}) if frame < spell[0]]
            had = matched[who][max(before)] if before else -1
            lasts = (times[spell[-1]] - times[spell[0]] + usual) / 1e9
            ids = (-1, who) if kind is EventKind.MISS else (who, -1)
            out.append((times[spell[0]], kind, *ids, had, len(spell), lasts))
    return out


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_misses_false_tracks_and_switches_equal_the_reference(seed):
    truth, tracks = random_world(np.random.default_rng(seed))
    times = [frame.t_ns for frame in truth]
    usual = int(np.median(np.diff(times)))
    compared = make_matchup(truth, tracks, "metres", 1.0)
    pairs = matches(compared)  # compared with other evaluators elsewhere
    people, names = (sorted({w for f in side for w in f.rows["track_id"].tolist()}) for side in (truth, tracks))
    by_person: dict[int, dict[int, int]] = {}
    by_track: dict[int, dict[int, int]] = {}
    for frame, who, by in zip(pairs.frame.tolist(), pairs.person.tolist(), pairs.track.tolist(), strict=True):
        by_person.setdefault(people[who], {})[frame] = names[by]
        by_track.setdefault(names[by], {})[frame] = people[who]
    wanted: list[Event] = []
    for who, found in by_person.items():
        frames = sorted(found)
        for last, frame in pairwise(frames):
            if found[last] != found[frame]:
                unseen = (times[frame] - times[last + 1]) / 1e9
                wanted.append((times[frame], EventKind.SWITCH, found[frame], who, found[last], 0, unseen))
    here = [{}, {}]
    for side, frames in zip(here, (truth, tracks), strict=True):
        for number, frame in enumerate(frames):
            for who in frame.rows["track_id"].tolist():
                side.setdefault(who, []).append(number)
    wanted += spells(EventKind.MISS, here[0], by_person, times, usual)
    wanted += spells(EventKind.FALSE_TRACK, here[1], by_track, times, usual)
    kinds = (EventKind.SWITCH, EventKind.MISS, EventKind.FALSE_TRACK)
    columns = ("kind", "track_id", "truth_id", "previous_id", "frames", "duration_s")
    made = find_events(tracks, truth)
    found = [
        (frame.t_ns, *(row[name].item() for name in columns))
        for frame in made.events
        for row in frame.rows
        if row["kind"] in kinds
    ]
    right = people_so_far = 0
    counts = made.counts
    assert [(frame.t_ns, frame.index) for frame in counts] == [(frame.t_ns, frame.index) for frame in truth]
    for number, frame in enumerate(counts):
        (row,) = frame.rows
        there, here, hits = len(truth[number].rows), len(tracks[number].rows), int((pairs.frame == number).sum())
        switches = sum(event[1] == EventKind.SWITCH and event[0] <= frame.t_ns for event in wanted)
        right, people_so_far = right + 2 * hits - here, people_so_far + there
        names = ("people", "matches", "misses", "false_tracks", "switches", "tracked")
        assert [row[name] for name in names] == [there, hits, there - hits, here - hits, switches, here]
        mota = (right - switches) / people_so_far if people_so_far else np.nan
        assert row["mota"] == pytest.approx(mota, nan_ok=True)
    assert [event[:-1] for event in sorted(found)] == [event[:-1] for event in sorted(wanted)]
    np.testing.assert_allclose([e[-1] for e in sorted(found)], [e[-1] for e in sorted(wanted)], atol=1e-9)


def repaired_world(rng: np.random.Generator) -> list[Frame]:
    """Tracks that come and go, of sources that change now and then, for a moment or for longer; some rows have none."""
    frames, now, source = [], 0.0, {one: int(rng.integers(0, 4)) for one in (3, 5, 8, 11)}
    until = dict.fromkeys(source, 0)
    for number in range(40):
        now += float(rng.choice([0.25, 0.25, 0.25, 0.5, 1.25]))
        rows = []
        for one in rng.permutation(list(source)).tolist():
            if rng.random() < 0.1:
                until[one] = number + int(rng.integers(1, 12))
            if until[one] > number:
                continue
            if rng.random() < 0.2:
                source[one] = int(rng.integers(0, 4))
            rows.append((one, -1 if rng.random() < 0.15 else source[one]))
        ids = [one for one, _ in rows]
        made = tracks_at({one: (number / 7, one / 3) for one in ids})
        made["source_id"] = [from_ for _, from_ in rows]
        made["observed"] = rng.random(len(rows)) < 0.8
        frames.append(Frame(ns(now) + 9, number, made))
    return frames


def lives(frames: list[Frame]) -> list[Event]:
    """Births, ends and repairs, track by track."""
    times = [frame.t_ns for frame in frames]
    usual = int(np.median(np.diff(times)))
    rows: dict[int, list[tuple[int, int]]] = {}
    for frame in frames:
        for row in frame.rows:
            rows.setdefault(int(row["track_id"]), []).append((frame.t_ns, int(row["source_id"])))
    out: list[Event] = []
    runs: list[tuple[int, int, int, int]] = []  # time, track, source and last time of each run
    joined = set()
    for track, own in sorted(rows.items()):
        out.append((own[0][0], EventKind.BIRTH, track, -1, -1, 0, np.nan))
        if own[-1][0] < times[-1]:
            lasted = (own[-1][0] - own[0][0] + usual) / 1e9
            out.append((own[-1][0], EventKind.END, track, -1, -1, len(own), lasted))
        known = [row for row in own if row[1] >= 0]
        parts = [list(group) for _, group in groupby(known, key=lambda row: row[1])]
        brief = [
            0 < k < len(parts) - 1
            and parts[k - 1][0][1] == parts[k + 1][0][1]
            and parts[k + 1][0][0] - parts[k][0][0] < 1_000_000_000
            for k in range(len(parts))
        ]
        parts = [part for part, is_brief in zip(parts, brief, strict=True) if not is_brief]
        parts = [[*chain(*group)] for _, group in groupby(parts, key=lambda part: part[0][1])]
        for before, part in pairwise(parts):
            after = next(t for t in times if t > before[-1][0])
            unseen = max(part[0][0] - after, 0) / 1e9
            out.append((part[0][0], EventKind.JOINED, track, before[0][1], part[0][1], 0, unseen))
            joined.add((part[0][0], track))
        runs += [(part[0][0], track, part[0][1], part[-1][0]) for part in parts]
    for t_ns, track, source, _ in runs:
        before = [run for run in runs if run[2] == source and run[:2] < (t_ns, track)]
        if before and max(before)[1] != track and (t_ns, track) not in joined:
            out.append((t_ns, EventKind.PARTED, track, max(before)[1], source, 0, np.nan))
    return sorted(out, key=lambda event: event[:-1])


@pytest.mark.parametrize("part_rows", [1 << 16, 11])
@pytest.mark.parametrize("seed", range(6))
def test_births_ends_and_repairs_equal_the_reference(seed, part_rows, monkeypatch):
    monkeypatch.setattr(framing, "PART_ROWS", part_rows)
    frames = repaired_world(np.random.default_rng(seed))
    columns = ("kind", "track_id", "previous_id", "source_id", "frames", "duration_s")
    found = sorted(
        (
            (frame.t_ns, *(row[name].item() for name in columns))
            for frame in find_events(frames, None).events
            for row in frame.rows
        ),
        key=lambda event: event[:-1],
    )
    wanted = lives(frames)
    assert {event[1] for event in wanted} == {EventKind.BIRTH, EventKind.END, EventKind.JOINED, EventKind.PARTED}
    assert [event[:-1] for event in found] == [event[:-1] for event in wanted]
    np.testing.assert_allclose([e[-1] for e in found], [e[-1] for e in wanted], atol=1e-9)
    for frame, counts in zip(frames, find_events(frames, None).counts, strict=True):
        (row,) = counts.rows
        past = [event[1] for event in wanted if event[0] <= frame.t_ns]
        repaired = past.count(EventKind.JOINED) + past.count(EventKind.PARTED)
        names, ends = ("born", "ended", "repaired"), (past.count(EventKind.BIRTH), past.count(EventKind.END), repaired)
        assert (counts.t_ns, tuple(row[name] for name in names)) == (frame.t_ns, ends)
        assert (row["tracked"], row["observed"]) == (len(frame.rows), frame.rows["observed"].sum())
        assert np.isnan([row["people"], row["matches"], row["mota"]]).all()
    for frame in find_events(frames, None).events:
        assert all(row["x_m"] == pytest.approx(frame.index / 7) for row in frame.rows)
        assert all(row["y_m"] == pytest.approx(row["track_id"] / 3) for row in frame.rows)
