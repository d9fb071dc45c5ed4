"""Re-tracking: the four failures of the paper as small scenes, and the limits of its options."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import DECISIONS, PREDICTIONS, TRACKS, Frame, framing
from mcaptrack.schema.frame_columns import collect
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import PROFILES, Retrack
from mcaptrack.transforms.retrack.assignments import PEOPLE, Movers, join_classes, movers_of, split_classes, usual_score
from mcaptrack.transforms.retrack.methods import KeptIds
from mcaptrack.transforms.retrack.online_tracker import GrowingHull
from tests.commands import call
from tests.tiers import one_in
from tests.worlds import assert_same_rows, ids, ns, places, tracks_at, walk

PAPER, AUTHORS, DEFAULT = PROFILES["paper"], PROFILES["authors"], PROFILES["default"]
every_profile = pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)


def run(profile, frames):
    """Frames of offline tracks, online tracks and predictions."""
    return [list(part) for part in zip(*profile(frames), strict=True)]


def paths(frames) -> dict[int, dict[int, tuple[float, float]]]:
    """The positions of each id by tick."""
    out: dict[int, dict[int, tuple[float, float]]] = {}
    for tick, frame in enumerate(frames):
        for who, place in places(frame).items():
            out.setdefault(who, {})[tick] = place
    return out


def along(path: dict[int, tuple[float, float]], truth: dict[int, tuple[float, float]]) -> bool:
    """Whether a path has the ticks of another and is within 2 cm of it."""
    return path.keys() == truth.keys() and all(np.hypot(*np.subtract(path[t], truth[t])) < 0.02 for t in truth)


class TestHorizon:
    """Horizons of prediction, on people who walk along the first axis."""

    @pytest.mark.parametrize(
        ("profile", "horizon_s", "steps"),
        [(DEFAULT, 0.1, 1), *((profile, 1.01, 3) for profile in PROFILES.values())],
        ids=["one", *PROFILES],
    )
    def test_there_is_one_step_at_least_and_as_many_as_fit_best(self, profile, horizon_s, steps):
        """At 2.5 steps a second."""
        frames = walk(lambda n: {7: (0.5 * n, 0.0)}, 12)
        _, _, predictions, *_ = run(replace(profile, horizon_s=horizon_s, predictor="cv"), frames)
        assert predictions[-1].rows["step"].tolist() == list(range(1, steps + 1))
        assert predictions[-1].rows["ahead_s"].max() == pytest.approx(0.4 * steps)

    @pytest.mark.parametrize("distance", ["mean", "max", "first"])
    def test_predictions_of_one_step_are_refused_where_two_predictions_of_one_time_are_compared(self, distance):
        frames = walk(lambda n: {7: (0.5 * n, 0.0)}, 12)
        with pytest.raises(McaptrackError, match=r"horizon_s 0\.4 is one step at 2\.5 Hz.*takes 0\.8 s at least"):
            run(replace(PAPER, distance=distance, horizon_s=0.4), frames)
        two = run(replace(PAPER, distance=distance, horizon_s=0.8), frames)[0]
        assert [ids(frame) for frame in two] == [[1]] * 12
        one = run(replace(PAPER, distance="now", horizon_s=0.4), frames)[0]
        assert [ids(frame) for frame in one] == [[1]] * 12


class TestFailuresOfThePaper:
    """Section IV-B of the paper: errors of tracking that re-tracking repairs."""

    @every_profile
    def test_missed_target(self, profile):
        """Merged into another detection for a second, then under a new id: one track, with the gap interpolated."""

        def crowd(n):
            people = {1: (0.5 * n, 0.0)}
            if n < 10:
                people[2] = (0.5 * n, 3.0 - 0.25 * n)
            elif n >= 13:
                people[3] = (0.5 * n, 3.0 - 0.25 * n)
            return people

        offline, *_ = run(profile, walk(crowd, 30))
        truth = {tick: (0.5 * tick, 3.0 - 0.25 * tick) for tick in range(30)}
        assert any(along(path, truth) for path in paths(offline).values())
        assert len(paths(offline)) == 2

    @pytest.mark.parametrize("profile", [AUTHORS, DEFAULT], ids=["authors", "default"])
    def test_identity_switch_at_meet_and_separate(self, profile):
        """Two cross; their merged detection has the id of the first, and afterwards the ids are swapped."""

        def crowd(n):
            a, b = (0.6 * n, 0.45 * n), (0.6 * n, 10.8 - 0.45 * n)
            if n < 11:
                return {1: a, 2: b}
            if n < 14:
                return {1: (0.6 * n, 5.4)}
            return {1: b, 3: a}  # the tracker gives the first id to the wrong person

        offline, *_ = run(profile, walk(crowd, 30))
        straight = 0
        for path in paths(offline).values():
            ticks = sorted(path)
            if ticks[0] < 8 and ticks[-1] > 22:
                rise = (path[5][1] - path[0][1], path[29][1] - path[24][1])
                straight += (rise[0] > 0) == (rise[1] > 0)
        assert straight == 2

    @pytest.mark.parametrize("profile", one_in(3, PROFILES.values()), ids=PROFILES)
    def test_spurious_track(self, profile):
        """A gust in a tree: for 2.4 s false detections jump about under one id. At most half remain; by likelihood none."""
        kept = 0
        for seed in range(20):
            leaps = np.random.default_rng(seed).uniform(-2.5, 2.5, (60, 2))

            def crowd(n, leaps=leaps):
                tree = {9: (float(leaps[n, 0]), 30 + float(leaps[n, 1]))} if 10 <= n < 16 else {}
                return {1: (0.4 * n, 0.0)} | tree

            offline, *_ = run(profile, walk(crowd, 40))
            found = paths(offline).values()
            kept += sum(len(path) for path in found if next(iter(path.values()))[1] > 15)
            walker = {tick: (0.4 * tick, 0.0) for tick in range(40)}
            assert any(along(path, walker) for path in found)
        assert kept <= (0 if profile == DEFAULT else 0.5 * 20 * 6)

    def test_noisy_track(self):
        """A shaking camera: predictions from the re-tracked path jump less from step to step than those from the raw one."""
        rng = np.random.default_rng(4)
        noise = rng.normal(0, 0.25, (60, 2))
        frames = walk(lambda n: {1: (0.5 * n + noise[n, 0], noise[n, 1])}, 60)

        def drift(profile) -> float:
            _, _, predictions, *_ = run(profile, frames)
            futures = [np.stack([f.rows["x_m"], f.rows["y_m"]], -1) for f in predictions if len(f.rows) == 12]
            steps = [np.hypot(*(a[1:] - b[:-1]).T).mean() for a, b in pairwise(futures)]
            return float(np.mean(steps))

        raw = replace(PAPER, alpha=1.0, beta=0.0)
        assert drift(PAPER) < 0.8 * drift(raw)
        assert drift(DEFAULT) < 0.8 * drift(raw)


def test_a_log_without_people_gives_frames_without_rows():
    offline, online, predictions, *_ = run(DEFAULT, walk(lambda n: {}, 5))
    assert [len(f.rows) for f in (*offline, *online, *predictions)] == [0] * 15
    assert len(tracks_at({})) == 0


# The two methods of re-tracking as entries of the registry


@pytest.fixture
def walked(tmp_path, monkeypatch):
    """The working folder, with a log of one track."""
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"{frame},1,{10 + frame},20,10,30,1,-1,-1,-1\n" for frame in range(1, 41))
    (tmp_path / "t.txt").write_text(rows)
    assert call("ingest", "t.txt", "--as", "tracks", "--fps", "10", "-o", "a.mcap").code == 0
    return tmp_path


def made(path) -> dict[str, object]:
    with log.read(path) as opened:
        said = Provenance.from_metadata(opened.channel("/camera/retracks").metadata)
    assert said is not None
    return dict(said.parameters)


def test_a_profile_names_its_method_and_distance_implies_it(walked):
    assert call("retrack", "a.mcap", "--profile", "authors").code == 0
    assert made(walked / "a.mcap")["retracker"] == "consistency"
    result = call("retrack", "a.mcap", "--set", "distance=now")
    assert result.code == 0
    assert "--retracker consistency" in result.err
    assert (made(walked / "a.mcap")["retracker"], made(walked / "a.mcap")["distance"]) == ("consistency", "now")
    result = call("retrack", "a.mcap", "--profile", "authors", "--retracker", "likelihood")
    assert (result.code, result.err) == (
        1,
        "mcaptrack: the profile authors is of the retracker consistency, not of likelihood\n",
    )
    result = call("retrack", "a.mcap", "--profile", "paper", "--set", "coast_s=1")
    assert (result.code, result.err) == (1, "mcaptrack: --set coast_s is an option of likelihood, not of consistency\n")


# Re-tracking of each class by itself: what is split comes together again, and ids of classes never meet


def rows_of(ids: list[int], classes: list[int], **columns: object) -> np.ndarray:
    count = len(ids)
    known = {"x_m": np.arange(count) + 0.5, "y_m": np.array(ids) * 2.0, "observed": [True] * count}
    return TRACKS.rows(track_id=ids, class_id=classes, source_id=[-1] * count, **(known | columns))


def random_frames(seed: int) -> list[Frame]:
    """Tracks of which some change their class, in any order."""
    rng = np.random.default_rng(seed)
    out = []
    for n in range(12):
        ids = rng.permutation([3, 5, 8, 11, 20])[: rng.integers(0, 6)] if n else np.empty(0, int)
        kinds = [int(rng.integers(1, 4)) if rng.random() < 0.3 else one % 3 + 1 for one in ids.tolist()]
        out.append(Frame(ns(n / 2.5), n + 7, rows_of(ids.tolist(), kinds)))
    return out


@pytest.mark.parametrize("part_rows", [1 << 16, 4])
@pytest.mark.parametrize("seed", range(5))
def test_frames_of_each_class_hold_its_tracks_whole(seed, part_rows, monkeypatch):
    monkeypatch.setattr(framing, "PART_ROWS", part_rows)
    frames = random_frames(seed)
    first: dict[int, int] = {}
    begun: dict[int, tuple[int, int]] = {}  # where each class begins, with its lowest id there
    for n, frame in enumerate(frames):
        for one, kind in zip(frame.rows["track_id"].tolist(), frame.rows["class_id"].tolist(), strict=True):
            first.setdefault(one, kind)
            began, lowest = begun.get(first[one], (n, one))
            begun[first[one]] = (began, min(lowest, one) if began == n else lowest)
    parts = split_classes(collect(TRACKS, frames))
    assert len(parts) == len(begun)
    for kind, part in zip(sorted(begun, key=lambda kind: begun[kind]), parts, strict=True):
        assert [(frame.t_ns, frame.index) for frame in part] == [(frame.t_ns, frame.index) for frame in frames]
        for own, frame in zip(part, frames, strict=True):
            is_own = [first[one] == kind for one in frame.rows["track_id"].tolist()]
            assert_same_rows(own.rows, frame.rows[np.array(is_own, bool)])


def test_one_class_is_not_split():
    frames = collect(TRACKS, [Frame(0, 0, rows_of([1, 2], [3, 3]))])
    assert split_classes(frames) == [frames]


def test_decisions_about_tracks_that_were_left_out_have_no_id_in_any_class():
    def run(ids: list[int]):
        rows = DECISIONS.empty(len(ids))
        rows["track_id"] = ids
        return [collect(DECISIONS, [Frame(0, 0, rows)])]

    ((found,),) = join_classes([run([1, -1, 3]), run([2, -1])])
    assert found.rows["track_id"].tolist() == [1, -1, 3, 5, -1]


@pytest.mark.parametrize("part_rows", [1 << 16, 1])
def test_ids_of_a_class_follow_those_of_the_class_before(part_rows, monkeypatch):
    monkeypatch.setattr(framing, "PART_ROWS", part_rows)

    def predicted(some: list[int]):
        steps = PREDICTIONS.empty(len(some))
        steps["track_id"] = some
        return steps

    def run(ids: list[list[int]]):
        tracks = [Frame(n, n, rows_of(some, [1] * len(some))) for n, some in enumerate(ids)]
        return collect(TRACKS, tracks), collect(PREDICTIONS, [Frame(n, n, predicted(one)) for n, one in enumerate(ids)])

    runs = [run([[1, 4], [2]]), run([[], []]), run([[3], [1, 2]]), run([[1], []])]
    found = list(join_classes(runs))
    assert [tuple(frame.rows["track_id"].tolist() for frame in frames) for frames in found] == [
        ([1, 4, 7, 8], [1, 4, 7, 8]),
        ([2, 5, 6], [2, 5, 6]),
    ]
    assert [(frames[0].t_ns, frames[1].index) for frames in found] == [(0, 0), (1, 1)]


@pytest.mark.parametrize(
    ("scores", "observed", "usual"),
    [
        ([0.2, 0.4, 0.9], [True] * 3, 0.4),
        ([0.2, 0.4, 0.9], [True, True, False], 0.3),
        ([np.nan, 0.5], [True, True], 0.5),
        ([np.nan], [True], 1.0),
        ([0.5], [False], 1.0),
        ([0.0, 0.0], [True, True], 1e-6),
    ],
)
def test_the_usual_score_is_the_median_of_what_was_observed(scores, observed, usual):
    rows = rows_of([*range(len(scores))], [1] * len(scores), score=scores, observed=observed)
    assert usual_score([Frame(0, 0, rows[:1]), Frame(1, 1, rows[1:])]) == pytest.approx(usual)


@pytest.mark.parametrize(
    ("kind", "moves", "step", "movers"),
    [
        (1, False, 1, Movers(1.0, False, 0.7, None)),  # a person in pictures
        (1, True, 1, Movers(1.0, False, 0.7, None)),  # in metres, but at no higher rate than samples
        (1, True, 4, Movers(1.0, True, 0.7, 0.8)),
        (2, True, 1, Movers(4.0, True, 0.7, 3.0)),  # a car
        (2, False, 4, Movers(4.0, False, 0.7, None)),
        (3, True, 4, Movers(1.0, True, 0.7, 2.0)),  # of no row of the table
    ],
)
def test_each_class_has_its_unit_and_its_kind(kind, moves, step, movers):
    speeds = {"vx_m_per_s": [1.0], "vy_m_per_s": [0.0]} if moves else {}
    frames = [Frame(ns(n / 2.5), n * step, rows_of([1], [kind], **speeds)) for n in range(3)]
    empty = Frame(0, 0, frames[0].rows[:0])
    names = ((1, "pedestrian"), (2, "car"), (3, "blob"))
    assert movers_of([empty, *frames], names, 0.7) == movers
    assert movers_of([empty], names, 0.7) == PEOPLE == Movers(1.0, False, 1.0, None)
    assert movers_of([], names, 0.7) == PEOPLE


@pytest.mark.parametrize("part_rows", [1 << 16, 1])
def test_tracks_in_metres_keep_what_they_are_under_numbers_of_their_own(part_rows, monkeypatch):
    """Samples at 2.5 Hz, one missing, with ids in any order; steps follow the clock."""
    monkeypatch.setattr(framing, "PART_ROWS", part_rows)
    steps, seen = [0, 1, 3, 4], ([9, 4], [4, 9], [7], [9, 7])
    frames = [Frame(ns(n / 2.5) + 3, n, rows_of(ids, [1] * len(ids))) for n, ids in zip(steps, seen, strict=True)]
    kept = KeptIds(Retrack(predictor="cv", noise_m=0.5), Movers(unit_m=2.0), collect(TRACKS, frames))
    assert kept.noise_m == 0.25
    assert kept.steps == steps
    out = [(online.rows["source_id"].tolist(), online.rows["track_id"].tolist()) for online in kept.outputs()[0]]
    assert out == [([4, 9], [1, 2]), ([4, 9], [1, 2]), ([7], [3]), ([7, 9], [3, 2])]
    step, track, source, row = kept.assignments.of(kept.samples, kept.steps)
    assert step.tolist() == [0, 0, 1, 1, 3, 4, 4]
    assert track.tolist() == [1, 2, 1, 2, 3, 3, 2]
    assert source.tolist() == [4, 9, 4, 9, 7, 7, 9]
    assert row.tolist() == [*range(7)]
    assert kept.samples.column("track_id").tolist() == source.tolist()


# Which online tracks are written: what the log said so far of how long tracks last, and where they were seen


#: Positions of people by their input ids, at each tick.
People = Callable[[int], Mapping[int, tuple[float, float]]]
NS_PER_TICK = 400_000_000


def online(path: People, ticks: int, **options: object) -> list[dict[int, tuple[float, float]]]:
    """The places of online tracks at each tick."""
    return [places(result[1]) for result in replace(PROFILES["default"], **options)(walk(path, ticks))]


def written(found: list[dict[int, tuple[float, float]]], along: Callable[[float, float], bool]) -> list[int]:
    """The ticks at which a track is written at one of the places that ``along`` names."""
    return [tick for tick, here in enumerate(found) if any(along(*place) for place in here.values())]


def flickers(ticks: range, lasting: int) -> People:
    """Every third tick there is another false detection, far from all others, for so many ticks."""

    def path(n: int) -> dict[int, tuple[float, float]]:
        first = [tick for tick in ticks if tick % 3 == 0 and tick <= n < tick + lasting]
        return {1000 + tick: (100.0 * (tick + 1), -500.0) for tick in first}

    return path


def walker(name: int, ticks: range, y_m: float, speed: float = 0.4) -> People:
    return lambda n: {name: (speed * n, y_m)} if n in ticks else {}


def together(*paths: People) -> People:
    return lambda n: {name: place for path in paths for name, place in path(n).items()}


@pytest.mark.parametrize(("lasting", "first"), [(1, 41), (2, 42), (3, 43), (30, 40)])
def test_a_new_track_waits_where_most_tracks_of_the_log_were_soon_over(lasting, first):
    """One that was observed more often than those is taken for a person; it is confirmed by its fourth observation."""
    found = online(together(flickers(range(30), lasting), walker(1, range(40, 60), 0.0)), 60)
    assert written(found, lambda x, y: y > -1)[0] == first


def test_what_a_gap_of_the_log_ends_was_not_short():
    """Ten people are there for two ticks before each gap, which ends their tracks."""
    frames = walk(lambda n: {100 * n + k: (10.0 * k, 0.0) for k in range(10)} if n < 8 else {1: (50.0, 50.0)}, 9)
    times = [(n + 50 * (n // 2)) * NS_PER_TICK for n in range(9)]
    named = [frame.rows.copy() for frame in frames]
    for n, rows in enumerate(named[:8]):
        rows["track_id"] = 100 * (n // 2) + np.arange(10)
    apart = [Frame(t, n, rows) for n, (t, rows) in enumerate(zip(times, named, strict=True))]
    assert [len(result[1].rows) for result in PROFILES["default"](apart)] == [10] * 8 + [1]


def crossing(last: int, ticks: int) -> list[int]:
    """The ticks at which the last one is written of some who walk through a square of 20 m, one after another.

    Four stand at its corners. All leave it at its right side, but the last one, who is seen until tick ``last``.
    """

    def path(n: int) -> dict[int, tuple[float, float]]:
        out = {corner: (20.0 * (corner % 2), 20.0 * (corner // 2)) for corner in range(4)}
        number, tick = divmod(n, 40)
        if tick <= (20 if number < 3 else last):
            out[10 + number] = (1.0 * tick, 10.0)
        return out

    found = online(path, 160)
    return [n - 120 for n in written(found, lambda x, y: abs(y - 10) < 2) if n >= 120][:ticks]


@pytest.mark.parametrize(("last", "shown"), [(12, 3), (20, 0)])
def test_lost_tracks_are_written_inside_of_the_area_that_was_seen_and_not_outside(last, shown):
    """One is lost in the middle; the other at the edge, where those before have left."""
    assert crossing(last, 40) == list(range(last + 1 + shown))


def test_until_the_first_have_left_lost_tracks_are_written_outside():
    found = online(lambda n: {7: (0.5 * n, 0.0)} if n < 20 else {}, 40)
    assert written(found, lambda x, y: True) == list(range(23))


def test_long_ages_and_confirmation_take_no_memory():
    """Every step counted by itself would take tables of a gigabyte."""
    options = {"max_age_s": 1e6, "confirm_s": 1e5, "coast_s": 1e6}
    assert len(online(walker(1, range(20), 0.0), 20, **options)[-1]) == 1


def test_who_comes_back_from_outside_is_written_there():
    """One walks round a square, twice as large each time, and is missed for a tick at each third step."""

    def path(n: int) -> dict[int, tuple[float, float]]:
        if n > 8 and n % 3 == 0:
            return {}
        angle = n / 8
        return {7: (0.15 * n * np.cos(angle), 0.15 * n * np.sin(angle))}

    found = online(path, 90)
    missed = [n for n in range(60, 90) if n % 3 == 0]
    assert all(len(found[n]) == 1 for n in missed)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_a_growing_hull_is_the_hull_of_all_points(seed):
    """Compared with Qhull; points inside are those that don't change its area."""
    rng = np.random.default_rng(seed)
    hull, seen = GrowingHull(), np.empty((0, 2))
    for count in rng.integers(1, 6, 8):
        new = np.round(rng.normal(0, 3, (count, 2)), int(rng.integers(0, 3)))
        hull.add(new.T)
        seen = np.concatenate([seen, new])
        if np.linalg.matrix_rank(seen - seen[0]) < 2:
            assert not hull.holds(seen.T).any()
            continue
        wanted = ConvexHull(seen)
        x, y = hull.vertices.T
        assert (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2 == pytest.approx(wanted.volume)
        assert hull.holds(seen.T).all()
        others = rng.normal(0, 4, (10, 2))
        larger = [ConvexHull([*seen, other]).volume > wanted.volume + 1e-5 for other in others]
        assert hull.holds(others.T).tolist() == [not one for one in larger]


def test_a_hull_leaves_out_what_is_no_place():
    hull = GrowingHull()
    hull.add(np.array([[0.0, 1.0, 0.0, np.nan], [0.0, 0.0, 1.0, 5.0]]))
    assert len(hull.vertices) == 3
    assert hull.holds(np.array([[0.2, np.nan], [0.2, 0.2]])).tolist() == [True, False]
