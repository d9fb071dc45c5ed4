"""Plausible worlds of re-tracking: the same ones again, what they hold, and that they are the decision without noise."""

from __future__ import annotations

import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.intervals import WIDER, lacks_intervals
from mcaptrack.evaluation.world_tracks import WorldTracks, tracks_in_worlds
from mcaptrack.notices import collected
from mcaptrack.schema import TRACKS, WORLDS, Frame
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


def kept_samples(path: Path) -> list[dict[tuple[int, float], int]]:
    """The track of each sample that a world keeps, by its time and place, from the rows of worlds and samples."""
    with log.Log(path) as opened:
        parts = [(frame.t_ns, row) for frame in opened.frames("/camera/retracks/worlds", WORLDS) for row in frame.rows]
        samples = [(f.t_ns, row) for f in opened.frames("/camera/samples", TRACKS) for row in f.rows if row["observed"]]
        smooth = {
            (frame.t_ns, row["source_id"]): row["x_m"]
            for frame in opened.frames("/camera/retracks", TRACKS)
            for row in frame.rows
        }
    out: list[dict[tuple[int, float], int]] = [{} for _ in range(9)]
    for begin_ns, part in parts:  # in order of time: of two with a sample the later one
        end_ns = begin_ns + part["duration_s"] * 1e9 + 1000
        for t_ns, row in samples:
            if row["track_id"] == part["source_id"] and begin_ns <= t_ns <= end_ns:
                at = t_ns, float(smooth.get((t_ns, row["track_id"]), row["x_m"]))
                out[part["world"] - 1][at] = int(part["track_id"])
    return [{at: track for at, track in world.items() if track >= 0} for world in out]


def test_worlds_have_the_samples_that_they_keep_and_join_whole_tracks_of_them(with_worlds):
    joined = 0
    for world, wanted in enumerate(kept_samples(with_worlds), start=1):
        query = f"select t_ns, x_m, track_id from world_tracks where world = {world} and observed"
        found = {(row["t_ns"], row["x_m"]): row["track_id"] for row in mcaptrack.query(with_worlds, query).to_pylist()}
        assert found.keys() == wanted.keys()
        names = {(wanted[at], track) for at, track in found.items()}
        assert len(names) == len({track for track, _ in names})
        joined += len(names) - len({track for _, track in names})
    assert joined > 0


def test_a_number_has_its_median_and_an_interval_around_those_of_the_worlds(with_worlds):
    query = "select count(distinct track_id) as n, avg(x_m) as x from tracks where observed and x_m > 0"
    (row,) = mcaptrack.query(with_worlds, query, worlds=True).to_pylist()
    (again,) = mcaptrack.query(with_worlds, query, worlds=True).to_pylist()
    grouped = query.replace("tracks", "world_tracks") + " group by world"
    many = mcaptrack.query(with_worlds, grouped).column("n").to_pylist()
    low, middle, high = np.percentile(many, [5, 50, 95])
    assert len(set(many)) > 1
    assert (row, row["n"], row["worlds"]) == (again, middle, 9)
    assert max(low - WIDER * middle, 0) - 1 < row["n_from"] <= low <= high <= row["n_to"] < high + WIDER * middle + 1
    assert row["x_from"] < row["x"] < row["x_to"]


def test_unseen_rows_of_a_track_that_was_seen_are_straight_and_no_track_is_at_two_places_at_once(with_worlds):
    rows = mcaptrack.query(with_worlds, "from world_tracks order by world, track_id, t_ns").to_pylist()
    seen = {(row["world"], row["track_id"]) for row in rows if row["observed"]}
    for one, row, other in zip(rows, rows[1:], rows[2:], strict=False):
        ends = (one, row, other)
        if len({(end["world"], end["track_id"]) for end in ends}) == 1:
            assert one["t_ns"] < row["t_ns"]
            if not row["observed"] and (row["world"], row["track_id"]) in seen:
                times, places = [end["t_ns"] for end in ends], [end["x_m"] for end in ends]
                assert row["x_m"] == pytest.approx(np.interp(times[1], times[::2], places[::2]))
    assert any(not row["observed"] for row in rows)


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


def test_numbers_of_pairs_have_no_interval(with_worlds):
    for pairs in (
        "tracks a join tracks b using (t_ns)",
        "tracks a, tracks b",
        "tracks as a left join tracks b using (t_ns)",
    ):
        with collected() as warnings:
            (row,) = mcaptrack.query(with_worlds, f"select count(*) as n from {pairs}", worlds=True).to_pylist()
        assert (row["n_from"], row["n_to"], row["n"] > 0) == (None, None, True)
        assert ["no interval" in warning.message for warning in warnings] == [True]


def test_rows_are_told_apart_by_texts_and_counts_of_missing_rows_are_none(with_worlds):
    query = "select track_id::text as track, count(*) as n from tracks group by all"
    rows = mcaptrack.query(with_worlds, query, worlds=True).to_pylist()
    per_world = mcaptrack.query(
        with_worlds, "select world, track_id, count(*) as n from world_tracks group by all"
    ).to_pylist()
    for row in rows:
        many = [found["n"] for found in per_world if str(found["track_id"]) == row["track"]]
        assert (row["worlds"], row["n"]) == (len(many), np.median(many + [0] * (9 - len(many))))
        assert 0 <= row["n_from"] <= row["n"] <= row["n_to"]


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("select count(*) from zone_visits", "not zone_visits"),
        ("select 1 as n", "nothing else"),
        ("select count(*) from tracks where topic = '/camera/samples'", "not /camera/samples"),
        ("create table a as from tracks; select count(*) from a", "one SELECT"),
        ("select track_id from tracks", "same texts"),
    ],
)
def test_what_worlds_do_not_change_is_refused(with_worlds, query, message):
    with pytest.raises(McaptrackError, match=message):
        mcaptrack.query(with_worlds, query, worlds=True)


def test_logs_without_worlds_are_refused(template):
    with pytest.raises(McaptrackError, match="has no worlds"):
        mcaptrack.query(template, "select count(*) as n from tracks", worlds=True)
