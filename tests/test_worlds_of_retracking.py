"""Plausible worlds of re-tracking: the same ones again, what they hold, and that they are the decision without noise."""

from __future__ import annotations

import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from mcaptrack import log
from mcaptrack.evaluation.world_tracks import WorldTracks, lacks_intervals, tracks_in_worlds
from mcaptrack.notices import collected
from mcaptrack.schema import WORLDS, Frame
from mcaptrack.transforms import Retrack
from mcaptrack.transforms.retrack import decisions, offline
from tests.commands import done
from tests.tiers import thorough
from tests.worlds import assert_same_rows, crossing_tracks, noisy_tracks

QUICK = [Phase.explicit, Phase.generate]
SEEDS = st.integers(0, 2**32 - 1)


def scene(seed: int) -> list[Frame]:
    """Walkers with faults of trackers, or two pairs of people who cross."""
    rng = np.random.default_rng(seed)
    return crossing_tracks(rng) if rng.random() < 0.4 else noisy_tracks(rng, people=6, ticks=60, hidden=0.03)


def outputs_of(frames: list[Frame], **options: object) -> dict[str, list[Frame]]:
    made = Retrack(**options)
    return dict(zip(made.writes, map(list, zip(*made(frames), strict=True)), strict=True))


def rows_of(frames: list[Frame]) -> list[tuple]:
    """All rows with their times."""
    return [(frame.t_ns, *row) for frame in frames for row in frame.rows.tolist()]


@given(seed=SEEDS)
@settings(max_examples=2, phases=QUICK)
def test_worlds_are_the_same_again_fewer_are_the_first_ones_and_change_no_other_output(seed):
    frames = scene(seed)
    five, again = outputs_of(frames, worlds=5), outputs_of(frames, worlds=5)
    two, none = outputs_of(frames, worlds=2), outputs_of(frames)
    assert rows_of(five["worlds"]) == rows_of(again["worlds"])
    assert rows_of(two["worlds"]) == [row for row in rows_of(five["worlds"]) if row[1] <= 2]
    assert "worlds" not in none
    for name, wanted in none.items():
        for found, frame in zip(five[name], wanted, strict=True):
            assert_same_rows(found.rows, frame.rows)


@given(seed=SEEDS)
@settings(max_examples=4, phases=QUICK)
def test_each_sample_has_one_track_in_each_world_and_no_track_is_at_two_places_at_once(seed):
    """The tracklets of a track follow each other, and those of an input id have no more samples than it has."""
    frames = scene(seed)
    made = outputs_of(frames, worlds=4)["worlds"]
    begins, rows = [frame.t_ns for frame in made for _ in frame.rows], [row for frame in made for row in frame.rows]
    spans: dict[tuple[int, int], list[tuple[int, int]]] = {}
    count: dict[tuple[int, int], int] = {}
    for t_ns, row in zip(begins, rows, strict=True):
        world, source, track = (int(row[name]) for name in ("world", "source_id", "track_id"))
        assert (track < 0) == (not row["kept"])
        span = t_ns, t_ns + round(float(row["duration_s"]) * 1e9)
        count[world, source] = count.get((world, source), 0) + int(row["frames"])
        if row["kept"]:
            spans.setdefault((world, track), []).append(span)
    for own in spans.values():
        own.sort()
        assert all(end < begin for (_, end), (begin, _) in pairwise(own))
    samples = np.concatenate([frame.rows["track_id"] for frame in frames]).tolist()
    for (_, source), number in count.items():
        assert number == count[1, source] <= samples.count(source)
    assert count


@given(seed=SEEDS)
@settings(max_examples=4, phases=QUICK)
def test_without_noise_a_world_is_what_was_decided(seed):
    frames = scene(seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(decisions, "NOISE", 0.0)
        patch.setattr(decisions, "PERSON_NOISE", 0.0)
        made = outputs_of(frames, worlds=1)
    decided = {
        (frame.t_ns, int(row["source_id"])): int(row["track_id"])
        for frame in made[""]
        for row in frame.rows
        if row["source_id"] >= 0
    }
    found = {}
    for frame in made["worlds"]:
        for row in frame.rows:
            found[frame.t_ns, int(row["source_id"])] = int(row["track_id"])
    assert found
    for at, track in found.items():
        assert decided.get(at, -1) == track


@thorough
def test_links_hold_in_as_many_worlds_as_are_likely():
    """One end that may go on as one beginning: the noise of a gain g makes the link hold where g + noise > 0."""
    frames = scene(7)
    args = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(offline, "draw_worlds", lambda *given: args.append(given) or decisions.draw_worlds(*given))
        outputs_of(frames, worlds=1)
    (_, decided, *_), *_ = args
    hypotheses = decided.hypotheses
    tracklets = hypotheses.tracklets
    pair = hypotheses._replace(
        tracklets=tracklets._replace(
            of=np.array([0, 1]), first=np.array([0, 1]), last=np.array([0, 1]), begins=np.array([0, 20]),
            ends=np.array([10, 30]), samples=np.array([9, 9]), source=np.array([1, 2]), online=np.array([1, 2]),
        ),
        before=np.array([0]), after=np.array([1]),
    )  # fmt: skip
    count = 4000
    random = np.random.default_rng(5)
    for gain in (0.5, 1.0, 2.0):
        drawn = np.stack(list(decisions.draw_links(count, pair, np.array([gain]))))
        share = (drawn[:, 0] == drawn[:, 1]).mean()
        noise = decisions.NOISE * (random.gumbel(size=(4, 200_000)) * [[1], [1], [-1], [-1]]).sum(axis=0) / 2
        assert share == pytest.approx((gain + noise > 0).mean(), abs=0.03)


def test_people_are_kept_in_as_many_worlds_as_is_likely():
    for probability in (0.2, 0.5, 0.8, 0.95):
        odds = np.log(probability / (1 - probability))
        kept = np.array([decisions.draw_people(world, np.array([odds]))[0] > 0 for world in range(4000)])
        assert kept.mean() == pytest.approx(probability, abs=0.03)


def test_tracks_that_people_have_corrected_are_one_in_each_world():
    frames = scene(11)
    fixed = tuple(np.unique(np.concatenate([frame.rows["track_id"] for frame in frames]))[:3].tolist())
    rows = [row for frame in outputs_of(frames, worlds=8, fixed_ids=fixed)["worlds"] for row in frame.rows]
    for world in range(1, 9):
        of = [
            {int(row["track_id"]) for row in rows if row["world"] == world and row["source_id"] == name}
            for name in fixed
        ]
        assert [len(tracks) for tracks in of] == [1] * len(fixed)
        assert len(set.union(*of)) == len(fixed)


def test_where_tracks_are_linked_in_the_picture_there_are_no_worlds_and_it_says_so():
    with collected() as warnings:
        made = outputs_of(scene(3), worlds=2, poor_scale=True)
    assert sum(len(frame.rows) for frame in made["worlds"]) == 0
    assert [warning.code for warning in warnings] == ["option-not-used"]


def test_retracking_without_the_option_removes_worlds(template, tmp_path):
    there = Path(shutil.copyfile(template, tmp_path / "log.mcap"))
    done("retrack", there, "--worlds", "7", "-q")
    done("retrack", there, "-q")
    with log.Log(there) as opened:
        assert "/camera/retracks/worlds" not in opened.channels


def walkers(is_seen: np.ndarray) -> list[WorldTracks]:
    """Worlds of 20 people who walk 24 m along lanes of their own, at 1 m/s; ``is_seen`` (61,) is when they are."""
    step = np.tile(np.arange(61), 20)
    lane, seen = np.repeat(np.arange(20), 61), np.tile(is_seen, 20)
    xy_m, t_ns = np.stack([0.4 * step, 4.0 * lane], axis=1), np.arange(100) * 400_000_000
    frame, part = step + lane, np.tile(np.cumsum(np.diff(is_seen, prepend=False)), 20)
    source = lane * 10 + part
    rows = WORLDS.empty(50 * len(names := np.unique(source[seen])))
    begins, ends = (np.array([some(frame[seen & (source == name)]) for name in names]) for some in (np.min, np.max))
    rows["world"], rows["kept"] = np.repeat(np.arange(1, 51), len(names)), True
    track = names - 2 * (names % 10 == 3)
    for column, values in (("source_id", names), ("track_id", track), ("duration_s", (ends - begins) * 0.4)):
        rows[column] = np.tile(values, 50)
    of = (source[seen], np.ones(seen.sum(), np.int64), frame[seen], xy_m[seen])
    return list(tracks_in_worlds(*of, t_ns, rows, np.tile(t_ns[begins], 50)))


def test_who_is_seen_from_border_to_border_is_one_person_in_each_world_and_nothing_is_added():
    for world in walkers(np.ones(61, bool)):
        assert (world.people, world.late, world.observed.all()) == (20, 0, True)


def test_tracks_that_end_and_begin_in_the_middle_are_one_person_or_two_who_were_longer_there_and_others_were_unseen():
    is_seen = np.ones(61, bool)
    is_seen[20:40], is_seen[5:7] = False, False
    made = walkers(is_seen)
    people = [world.people for world in made]
    assert min(people) < 25 < 45 < max(people)
    late = [world.late for world in made]
    assert min(late) < 0.1 < 0.3 < max(late) <= 0.5  # half of the tracks, less those that go on from others
    tracked = np.array([22 + 40 * share for share in late])  # two lanes are the border of the seen area
    hidden = 3.3 * np.minimum(1 - 22 / tracked, 0.3) ** 2 * tracked
    assert sum(people) - tracked.sum() == pytest.approx(hidden.sum(), rel=0.15)
    steps = [np.diff(world.share[world.share < 0], prepend=0) for world in made]  # away from the end, or back to it
    assert sum((way < 0).any() and (way > 0).any() for way in steps) > 25


@pytest.mark.parametrize(
    ("people", "late", "lost", "why"),
    [
        ([14] * 5, 0.0, 0.0, "only 14 people"),
        ([15, 99] * 5, 0.0, 0.0, "15 to 99"),
        ([20] * 5, 0.12, 0.0, "12% of the tracks begin"),
        ([20] * 5, 0.0, 0.42, "42% of the tracks end"),
        ([20] * 5, 0.09, 0.39, None),
    ],
)
def test_where_a_log_can_not_tell_there_are_no_intervals_and_it_says_why(people, late, lost, why):
    with collected() as warnings:
        assert lacks_intervals([(count, late, lost) for count in people]) == (why is not None)
    assert [warning.message.count(why) for warning in warnings] == ([1] if why else [])
