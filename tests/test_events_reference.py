"""Misses, false tracks and switches against a second, slow way to find them, on random tracks."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.evaluation.aligned import make_matchup
from mcaptrack.evaluation.events import find_events
from mcaptrack.evaluation.metrics.clear import matches
from mcaptrack.schema import EventKind, Frame
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
        truth.append(Frame(ns(now), number, tracks_at(people)))
        tracks.append(Frame(ns(now), number, tracks_at(found)))
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
    found = [
        (frame.t_ns, *(row[name].item() for name in columns))
        for frame in find_events(tracks, truth).events
        for row in frame.rows
        if row["kind"] in kinds
    ]
    assert [event[:-1] for event in sorted(found)] == [event[:-1] for event in sorted(wanted)]
    np.testing.assert_allclose([e[-1] for e in sorted(found)], [e[-1] for e in sorted(wanted)], atol=1e-9)
