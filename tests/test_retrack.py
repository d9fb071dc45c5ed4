"""Re-tracking: the four failures of the paper as small scenes, and the limits of its options."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from mcaptrack.errors import McaptrackError
from mcaptrack.notices import McaptrackWarning
from mcaptrack.schema import DECISIONS, PREDICTIONS, TRACKS, Frame, Rows, framing
from mcaptrack.schema.frame_columns import collect
from mcaptrack.transforms import PROFILES, Retrack
from mcaptrack.transforms.retrack.false_tracks import FEATURES, features, log_odds_in_log, stand_throughout
from mcaptrack.transforms.retrack.methods import join_classes, split_classes
from mcaptrack.transforms.retrack.motion_model import MotionModel, State, Trajectories, smooth
from mcaptrack.transforms.retrack.online_tracker import GrowingHull, PlaceOdds
from mcaptrack.transforms.retrack.passes import PEOPLE, KeptIds, LikelihoodPass, Movers, movers_of, usual_score
from tests.commands import call
from tests.logs import provenance_of
from tests.references.false_tracks import log_odds_in_log as in_log
from tests.references.false_tracks import person_features
from tests.references.offline import Motion
from tests.test_offline_reference import Paths, laid_out, models, scattered, walk_of
from tests.tiers import one_in
from tests.worlds import assert_same_rows, ids, ns, places, walk

PAPER, AUTHORS, DEFAULT = PROFILES["paper"], PROFILES["authors"], PROFILES["default"]


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

    @pytest.mark.parametrize("distance", ["mean", "max"])
    def test_predictions_of_one_step_are_refused_where_two_predictions_of_one_time_are_compared(self, distance):
        frames = walk(lambda n: {7: (0.5 * n, 0.0)}, 12)
        with pytest.raises(McaptrackError, match=r"horizon_s 0\.4 is one step at 2\.5 Hz.*takes 0\.8 s at least"):
            run(replace(PAPER, distance=distance, horizon_s=0.4), frames)
        two = run(replace(PAPER, distance=distance, horizon_s=0.8), frames)[0]
        assert [ids(frame) for frame in two] == [[1]] * 12


class TestFailuresOfThePaper:
    """Section IV-B of the paper: errors of tracking that re-tracking repairs."""

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


@pytest.mark.parametrize(("spread_m", "found_m"), [(0.0, 0.03), (4.0, 0.8)])
def test_the_estimated_noise_has_limits(spread_m, found_m):
    rng = np.random.default_rng(2)
    frames = walk(lambda n: {k: tuple([0.0, 900.0 * k] + rng.normal(0, spread_m, 2)) for k in range(9)}, 250)
    run = LikelihoodPass(DEFAULT, PEOPLE, collect(TRACKS, frames))
    assert run.noise_m == pytest.approx(found_m)


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
    return dict(provenance_of(path, "/camera/retracks").parameters)


def test_a_profile_names_its_method_and_options_of_another_are_refused(walked):
    assert call("retrack", "a.mcap", "--profile", "authors").code == 0
    assert made(walked / "a.mcap")["retracker"] == "consistency"
    result = call("retrack", "a.mcap", "--set", "distance=max")
    assert (result.code, result.err) == (
        1,
        "mcaptrack: --set distance is an option of consistency, not of likelihood\n",
    )
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


@pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)
def test_rows_without_metres_count_as_if_they_were_not_there(profile):
    frames = walk(lambda n: {7: (0.4 * n, 0.0), 8: (0.0, 3.0 - 0.4 * n)}, 30)
    without = [frame._replace(rows=frame.rows[frame.rows["track_id"] != 7 + n % 4]) for n, frame in enumerate(frames)]
    for n, frame in enumerate(frames):
        frame.rows["x_m"][frame.rows["track_id"] == 7 + n % 4] = np.nan
    with pytest.warns(McaptrackWarning, match=r"^16 rows of tracks have no position in metres, and are left out$"):
        parts = run(profile, frames)
    for part, expected in zip(parts, run(profile, without), strict=True):
        for frame, same in zip(part, expected, strict=True):
            assert_same_rows(frame.rows, same.rows)


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
    assert kept.steps.tolist() == steps
    out = [(online.rows["source_id"].tolist(), online.rows["track_id"].tolist()) for online in kept.outputs()[0]]
    assert out == [([4, 9], [1, 2]), ([4, 9], [1, 2]), ([7], [3]), ([7, 9], [3, 2])]
    step, track, source, row = kept.assignments.of(kept.samples, kept.steps)
    assert step.tolist() == [0, 0, 1, 1, 3, 4, 4]
    assert track.tolist() == [2, 1, 1, 2, 3, 2, 3]
    assert source.tolist() == [one for ids in seen for one in ids]
    assert row.tolist() == [*range(7)]


# Which online tracks are written: what the log said so far of how long tracks last, and where they were seen


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


# Which tracks are people, and which follow nobody: by what is known of the whole log


SEEDS = st.integers(0, 2**32 - 1)


def with_companions(rng: np.random.Generator, count: int) -> Paths:
    """Scattered tracks, some with another at a constant offset, with or without the same noise, for some of the time."""
    paths = scattered(rng, count)
    for name, path in list(paths.items()):
        if rng.random() < 0.5:
            offset, noise_m = rng.uniform(-1.2, 1.2, 2), rng.choice([0.0, 0.15])
            kept = {s: at for s, at in path.items() if rng.random() < 0.9} or path
            moved = {s: np.array(at) + offset + rng.normal(0, noise_m, 2) for s, at in kept.items()}
            paths[name + 1] = {s: tuple(at.tolist()) for s, at in moved.items()}
    return paths


def drawn(seed: int, most: int) -> tuple[Paths, Motion, tuple[MotionModel, Trajectories, State]]:
    """Up to so many tracks and more beside them, the reference's model of motion, and all that the package is given."""
    rng = np.random.default_rng(seed)
    model, motion = models(rng)
    paths = with_companions(rng, int(rng.integers(1, most + 1)))
    out = laid_out(paths)
    return paths, motion, (model, out, smooth(model, out))


@given(seed=SEEDS)
@settings(max_examples=25)
def test_features_equal_the_reference(seed):
    paths, motion, given_all = drawn(seed, 7)
    wanted = person_features(motion, paths)
    for name, row in zip(sorted(paths), features(*given_all), strict=True):
        assert dict(zip(FEATURES, row.tolist(), strict=True)) == pytest.approx(wanted[name], abs=1e-9)


@given(seed=SEEDS)
@settings(max_examples=10)
def test_weights_follow_the_log_to_where_few_tracks_are_doubtful(seed):
    paths, motion, given_all = drawn(seed, 12)
    first, last = min(min(path) for path in paths.values()), max(max(path) for path in paths.values())
    log = first - int(seed % 4), last + int(seed % 3)
    wanted = in_log(motion, paths, log)
    np.testing.assert_allclose(log_odds_in_log(*given_all, log), [wanted[k] for k in sorted(paths)], atol=1e-3)


@pytest.mark.parametrize(
    ("begins", "ends", "wide_m", "missed", "stands"),
    [
        (0, 39, 0.0, 0, True),
        (4, 35, 0.0, 0, False),  # of 39 steps, a tenth is 3.9
        (3, 36, 0.0, 0, True),
        (0, 35, 0.0, 0, False),
        (4, 39, 0.0, 0, False),
        (0, 39, 1.45, 0, True),
        (0, 39, 1.55, 0, False),
        (0, 39, 0.0, 5, True),  # 2 s
        (0, 39, 0.0, 6, False),
    ],
)
def test_who_stands_for_the_whole_log_by_hand(begins, ends, wide_m, missed, stands):
    """In a log of 40 steps; the track is seen at two places by turns, from one corner of its box to the other."""
    side = wide_m / np.sqrt(2)
    steps = [step for step in range(begins, ends + 1) if not 10 < step <= 10 + missed]
    paths = {1: {s: (side, side) if s % 4 > 1 else (0.0, 0.0) for s in steps}}
    out = laid_out(paths)
    smoothed = smooth(MotionModel(1e-3, 1.0, 100.0, 0.0, 0.4), out)  # it follows the positions
    assert stand_throughout(out, smoothed, np.zeros((1, len(FEATURES))), (0, 39), 0.4).tolist() == [stands]


@pytest.mark.parametrize(
    ("begins", "last", "in_step", "stands"),
    [(5, 399, 0.0, True), (6, 399, 0.0, False), (0, 25, 0.0, True), (0, 24, 0.0, False), (0, 399, 1.0, False)],
)
def test_two_seconds_of_a_long_log_ten_of_a_short_one_and_doubles(begins, last, in_step, stands):
    out = laid_out({1: dict.fromkeys(range(begins, last + 1), (0.0, 0.0))})
    smoothed = smooth(MotionModel(0.1, 1.0, 0.1, 0.1, 0.4), out)
    found = np.where(np.array(FEATURES) == "in step", in_step, 0.0)[None]
    assert stand_throughout(out, smoothed, found, (0, last), 0.4).tolist() == [stands]


def frames_of(paths: Paths) -> list[Frame]:
    """Samples of tracks at each step."""

    def rows(step: int) -> Rows:
        here = {name: path[step] for name, path in paths.items() if step in path}
        x, y = np.array(list(here.values())).reshape(-1, 2).T
        count = len(here)
        seen = {"observed": np.ones(count, bool), "source_id": np.full(count, -1)}
        return TRACKS.rows(track_id=list(here), x_m=x, y_m=y, **seen)

    return [Frame(round(step * 4e8), step, rows(step)) for step in range(max(max(path) for path in paths.values()) + 1)]


def tracked(paths: Paths) -> dict[int, int]:
    """How many rows the tracks of each input id have after re-tracking."""
    count: dict[int, int] = {}
    for found, *_ in PROFILES["default"](frames_of(paths)):
        for name in found.rows["source_id"].tolist():
            count[name] = count.get(name, 0) + 1
    return count


def walkers(rng: np.random.Generator, count: int, steps: int = 60) -> Paths:
    """People who walk on lanes that are 4 m apart."""
    places = [walk_of(rng, np.array([0.0, 4.0 * k]), np.array([1.2, 0.0]), steps, 0.1) for k in range(count)]
    return {k + 1: dict(enumerate(map(tuple, place.tolist()))) for k, place in enumerate(places)}


@pytest.mark.parametrize("seed", range(3))
def test_a_double_that_shares_the_errors_of_a_person_is_left_out_and_a_companion_is_not(seed):
    rng = np.random.default_rng(seed)
    paths = walkers(rng, 6)
    part = range(10, 60)
    paths[11] = {s: (paths[1][s][0] + 0.3, paths[1][s][1] + 0.7) for s in part}
    companion = walk_of(rng, np.array([0.3, 4.7]), np.array([1.2, 0.0]), 60, 0.1)
    paths[12] = {s: tuple(companion[s].tolist()) for s in part}
    found = tracked(paths)
    assert 11 not in found
    assert found[12] == len(part)


@pytest.mark.parametrize("seed", range(3))
def test_who_stands_for_the_whole_of_a_short_log_is_left_in_though_seen_now_and_then(seed):
    """Three stand among people who walk, in 16 s; flicker wanders for a second or two at other places."""
    rng = np.random.default_rng(seed)
    paths = walkers(rng, 4, 40)
    for name in (11, 12, 13):
        place = rng.normal(0, 0.2, (40, 2)) + [3.0 * (name - 10), -5.0]
        seen = {0, 39, *np.flatnonzero(rng.random(40) < 0.75).tolist()}
        paths[name] = {s: tuple(place[s].tolist()) for s in sorted(seen)}
    for name in range(20, 28):
        begins, lasts = int(rng.integers(0, 34)), int(rng.integers(2, 6))
        place = rng.uniform(-30, 60, 2) + np.cumsum(rng.normal(0, 0.3, (lasts, 2)), axis=0) - [0, 100]
        paths[name] = {begins + k: tuple(place[k].tolist()) for k in range(lasts)}
    found = tracked(paths)
    assert {11, 12, 13} < set(found)
    assert not {*range(20, 28)} & set(found)


# Where lost tracks come back: the odds at places, by hand, and what is written by them online


Positions = dict[int, tuple[float, float]]


def test_the_ratio_of_odds_by_hand():
    """Six of ten went well, so the share is 7 of 12 (one more of each); at the first place all four did."""
    odds = PlaceOdds()
    assert odds.ratio((0.0, 0.0)) == 1.0
    for place, good, bad in (((0.0, 0.0), 4, 0), ((50.0, 0.0), 2, 4)):
        for is_good in [True] * good + [False] * bad:
            odds.add(place, is_good)
    share = 7 / 12
    assert odds.ratio((0.0, 0.0)) == pytest.approx((4 / share + 8) / 8)
    assert odds.ratio((1.9, 0.0)) == odds.ratio((0.0, 0.0))
    assert odds.ratio((2.1, 0.0)) == 1.0
    assert odds.ratio((50.0, 0.0)) == pytest.approx((2 / share + 8) / (4 / (1 - share) + 8))


def test_only_the_last_2000_count():
    odds = PlaceOdds()
    for _ in range(500):
        odds.add((0.0, 0.0), False)
    for _ in range(1000):
        odds.add((9.0, 9.0), True)
        odds.add((9.0, 9.0), False)
    assert odds.ratio((0.0, 0.0)) == 1.0


@pytest.mark.parametrize("place", [0, 1], ids=["they return", "they are gone"])
def test_lost_tracks_are_written_where_others_came_back(place):
    """Each 20 steps one is missed for a step after five, and goes on for six more, and another one is gone after five."""

    def path(n: int) -> Positions:
        k, age = divmod(n, 20)
        out: Positions = {200 + c: (60.0 * (c % 2) - 20, 60.0 * (c // 2) - 20) for c in range(4)}
        if age != 5 and age < 12:
            out[2 * k] = (0.1 * age, 0.0)
        if age < 5:
            out[2 * k + 1] = (20.0 + 0.1 * age, 20.0)
        return out

    found = [places(result[1]) for result in PROFILES["default"](walk(path, 206))]
    near = [any(abs(x - 20 * place) < 1 and abs(y - 20 * place) < 1 for x, y in here.values()) for here in found]
    assert near[200:] == [True] * 5 + [place == 0]


def test_places_far_away_are_places_too():
    frames = walk(lambda n: {1: (1e12, 0.0), 3: (0.1 * (n % 3), 1.0)}, 12)
    assert [len(result[1].rows) for result in PROFILES["default"](frames)] == [2] * 12
