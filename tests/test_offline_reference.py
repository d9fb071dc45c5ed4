"""Links, encounters and smoothing, each against a second, slow implementation, on synthetic paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations, permutations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.evaluation.aligned import make_matchup
from mcaptrack.evaluation.metrics import score, summary
from mcaptrack.geometry import assignment
from mcaptrack.geometry.assignment import assign_by_gain, assign_pairs_by_gain
from mcaptrack.schema import Frame
from mcaptrack.transforms import PROFILES, Sample
from mcaptrack.transforms.retrack import linking, motion_model
from mcaptrack.transforms.retrack.false_tracks import FEATURES, features
from mcaptrack.transforms.retrack.hypotheses import Hypotheses
from mcaptrack.transforms.retrack.identity_swaps import compatible, find_encounters, find_swaps, resolve_swaps
from mcaptrack.transforms.retrack.linking import TrackEnds, pairs_in_reach
from mcaptrack.transforms.retrack.motion_model import (
    MotionModel,
    State,
    Tracks,
    filtered,
    smooth,
    smooth_in_log,
    to_trajectories,
)
from tests.bounded import held
from tests.references.false_tracks import person_features
from tests.references.hypotheses import Claim, Scene, gains_of, swept
from tests.references.offline import (
    DRIFTS,
    Motion,
    Path,
    course_of,
    encounters,
    exchanged,
    smoothed_in_log,
    usual_by_gap,
)
from tests.references.online import OnlineTracker
from tests.tiers import one_in, thorough
from tests.worlds import walk
from tools.corruptions import Corruption, corrupt, crowds
from tools.reproduce import on_clock

SEEDS = st.integers(0, 2**32 - 1)
Paths = dict[int, dict[int, tuple[float, float]]]


def models(rng: np.random.Generator) -> tuple[MotionModel, Motion]:
    """The same model of motion for both implementations."""
    numbers = (rng.uniform(0.03, 0.4), rng.uniform(0.5, 2.0), rng.uniform(0.05, 0.3), rng.choice([0.0, 0.1]))
    return MotionModel(*numbers, 0.4), Motion(*numbers, 0.4)


def walk_of(rng: np.random.Generator, start: np.ndarray, speed: np.ndarray, steps: int, noise_m: float) -> np.ndarray:
    return start + np.outer(np.arange(steps), speed) * 0.4 + rng.normal(0, noise_m, (steps, 2))


def with_gaps(rng: np.random.Generator, first: int, places: np.ndarray, share: float = 0.15) -> dict:
    """A path from its first to its last position, some of them missing in between."""
    kept = {0, len(places) - 1, *np.flatnonzero(rng.random(len(places)) > share).tolist()}
    return {first + k: tuple(places[k].tolist()) for k in sorted(kept)}


def tracks_of(step, track, source, xy=None) -> Tracks:
    """Samples that are assigned to tracks; nothing is seen of them."""
    places = np.zeros((len(step), 2)) if xy is None else xy
    return Tracks(step, track, source, np.arange(len(step)), places, np.full(len(step), -1), track)


def laid_out(paths: Paths):
    """The same paths as trajectories of the package."""
    assigned = [(step, name, *place) for name, path in paths.items() for step, place in path.items()]
    step, name, x, y = (np.array(column) for column in zip(*assigned, strict=True))
    return to_trajectories(step, name, np.stack([x, y], axis=-1))[2]


def scattered(rng: np.random.Generator, count: int) -> Paths:
    """Walking and standing people, their paths broken into pieces, some tracks parallel to others."""
    out: Paths = {}
    while len(out) < count:
        start, speed = rng.uniform(-6, 6, 2), rng.normal(0, rng.choice([0.0, 0.7]), 2)
        places = walk_of(rng, start, speed, 60, 0.1)
        first = int(rng.integers(0, 30))
        low = 0
        while low < 40 and len(out) < count:
            long = int(rng.integers(1, 25))
            out[int(len(out) * 3 + 7)] = with_gaps(rng, first + low, places[low : low + long])
            low += long + int(rng.integers(0, 20))
        if rng.random() < 0.4 and len(out) < count:
            beside = places[5:12] + rng.normal(0, 0.5, 2)
            out[int(len(out) * 3 + 7)] = with_gaps(rng, first + 5, beside)
    return out


@given(seed=SEEDS)
@settings(max_examples=10)
def test_filtered_and_smoothed_states_equal_the_reference(seed):
    rng = np.random.default_rng(seed)
    model, motion = models(rng)
    paths = scattered(rng, 4)
    out = laid_out(paths)
    found = *filtered(model, out), smooth(model, out)
    wanted = (motion.filtered, motion.backwards, motion.smoothed)
    for states, other in zip(found, wanted, strict=True):
        theirs = [state for path in paths.values() for state in dict(sorted(other(path).items())).values()]
        np.testing.assert_allclose(states.mean, [s.mean.T.ravel() for s in theirs], atol=1e-9)
        np.testing.assert_allclose(states.cov, [s.cov[[0, 0, 1], [0, 1, 1]] for s in theirs], atol=1e-9)


@given(seed=SEEDS, is_noise_known=st.booleans())
@settings(max_examples=10)
def test_smoothing_that_follows_the_log_equals_the_reference(seed, is_noise_known):
    rng = np.random.default_rng(seed)
    model, motion = models(rng)
    paths = scattered(rng, int(rng.integers(1, 5)))
    out = laid_out(paths)
    wanted = smoothed_in_log(motion, paths, is_noise_known)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(motion_model, "_ROWS_AT_ONCE", int(rng.choice([5, 2**15])))
        found = smooth_in_log(model, out, is_noise_known, 1.0)
    theirs = [state.mean[:, 0] for name in sorted(paths) for _, state in sorted(wanted[name].items())]
    np.testing.assert_allclose(found, theirs, atol=1e-6)


@given(seed=SEEDS)
@settings(max_examples=8)
def test_who_is_who_equals_the_reference(seed):
    """Tracks that were of other online tracks for a while, and change their input ids now and then."""
    rng = np.random.default_rng(seed)
    model, motion = models(rng)
    paths = scattered(rng, int(rng.integers(2, 12)))
    claims = [
        Claim(step, name, name % 5 + 7 * (step // 9 % 2), step // 12 + name % 3, at)
        for name, path in paths.items()
        for step, at in path.items()
    ]
    step, track, online, source = np.array([(c.step, c.track, c.online, c.source) for c in claims]).T
    tracks = tracks_of(step, track, source, np.array([claim.at for claim in claims]))._replace(online=online)
    most_s, least = float(rng.choice([0.0, 1.2, 6.0, 20.0])), float(rng.choice([0.1, 0.5, 0.9]))
    hypotheses = Hypotheses.of(model, tracks, most_s)
    scored = hypotheses.scored()
    gains = gains_of(Scene(motion, claims), most_s, least)
    assert [*zip(hypotheses.before.tolist(), hypotheses.after.tolist(), strict=True)] == sorted(gains)
    np.testing.assert_allclose(scored.gain(least), [gains[pair] for pair in sorted(gains)], rtol=1e-6, atol=1e-6)
    assert scored.best(least).tolist() == swept(motion, claims, most_s, least)


@given(seed=SEEDS)
@settings(max_examples=25)
@thorough
def test_links_are_the_same_without_a_table_of_all_pairs_and_in_batches_of_any_size(seed):
    rng = np.random.default_rng(seed)
    model, _ = models(rng)
    placed = [(step, name, *at) for name, path in scattered(rng, 14).items() for step, at in path.items()]
    step, name, *xy = map(np.array, zip(*placed, strict=True))
    tracks = tracks_of(step, name, name, np.stack(xy, axis=-1))
    whole = Hypotheses.of(model, tracks, 20.0).scored().best(0.1)
    for module, constant, value in ((assignment, "LARGE_TABLE", 1), (linking, "_BATCH", int(rng.integers(1, 9)))):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, constant, value)
            assert Hypotheses.of(model, tracks, 20.0).scored().best(0.1).tolist() == whole.tolist()


@given(seed=SEEDS)
@settings(max_examples=25)
def test_shifts_by_the_length_of_gaps_equal_the_reference(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 40))
    odds, gap_s = rng.normal(rng.normal(0, 2), 2, count), rng.choice(np.arange(0.4, 20, 0.4), count)
    found = linking.prior_shifts(odds, gap_s)
    made = {k: (float(odds[k]), False, float(gap_s[k])) for k in range(count)}
    wanted = usual_by_gap(made)
    np.testing.assert_allclose(found, wanted, atol=1e-3)


def test_links_of_thousands_of_broken_tracks_take_memory_for_the_candidates_alone():
    """A chain of tracks that hang together: a table of all has 9 million cells, of which 9000 are candidates."""
    count = 3000
    rows = np.repeat(np.arange(count), 3)
    pairs = rows, np.minimum(rows + np.tile([0, 1, 2], count), count - 1)
    gain = np.random.default_rng(0).uniform(0.1, 5, len(rows))
    linking.best_links(*pairs, gain, count)
    _, most = held(lambda: linking.best_links(*pairs, gain, count))
    assert most < 2_000_000


@given(seed=SEEDS)
@settings(max_examples=25)
def test_swaps_equal_the_reference(seed):
    """Relative positions of two people, with random swaps."""
    rng = np.random.default_rng(seed)
    model, motion = models(rng)
    count, steps = int(rng.integers(1, 4)), int(rng.integers(1, 40))
    apart = np.empty((count, steps, 2))
    for one in range(count):
        apart[one] = walk_of(rng, rng.normal(0, 1.5, 2), rng.normal(0, 0.5, 2), steps, motion.noise_m)
        apart[one, rng.integers(0, steps) :] *= rng.choice([-1, 1])
        apart[one, rng.random(steps) < 0.2] = np.nan
    course, gain = find_swaps(model, apart)
    for one in range(count):
        seen = [None if np.isnan(at[0]) else at for at in apart[one]]
        each = [course_of(seen, motion, drift) for drift in DRIFTS]
        wanted, more, _ = max(each, key=lambda found: found[2])
        assert course[one].tolist() == wanted
        np.testing.assert_allclose(gain[one], more, atol=1e-9)


@given(seed=SEEDS)
@settings(max_examples=25)
def test_decisions_at_encounters_equal_the_reference(seed):
    """Pairs of people that cross, some with swapped identities."""
    rng = np.random.default_rng(seed)
    model, motion = models(rng)
    paths = {}
    for pair in range(int(rng.integers(1, 4))):
        speed, steps = rng.uniform(0.3, 1.0), int(rng.integers(30, 60))
        start = np.array([-speed * 0.4 * steps / 2, 2.0 * pair])
        one = walk_of(rng, start, np.array([speed, 0]), steps, model.noise_m)
        two = walk_of(rng, [-start[0], start[1] + rng.uniform(0.2, 1.5)], np.array([-speed, 0]), steps, model.noise_m)
        when = steps // 2 + int(rng.integers(-2, 3))
        a, b = 2 * pair + 3, 2 * pair + 4
        if rng.random() < 0.7:
            one[when:], two[when:] = two[when:].copy(), one[when:].copy()
        first = rng.integers(0, 6, 2).tolist()
        paths[a], paths[b] = with_gaps(rng, first[0], one), with_gaps(rng, first[0], two[: steps - first[1]])
    out = laid_out(paths)
    owner, decided = resolve_swaps(model, out)
    wanted, count = exchanged(motion, paths)
    assert decided == count
    names = sorted(paths)
    for k, name in enumerate(names):
        rows = slice(out.first[k], out.first[k + 1])
        found = dict(zip(out.step[rows].tolist(), (names[o] for o in owner[rows].tolist()), strict=True))
        assert {step: found[step] for step in paths[name]} == wanted[name]


@given(seed=SEEDS)
@settings(max_examples=40)
def test_the_assignment_is_optimal(seed):
    """Compare with all assignments of up to four rows to up to four columns."""
    rng = np.random.default_rng(seed)
    gain = rng.normal(0, 1, rng.integers(1, 5, 2))
    rows, columns = assign_by_gain(gain)
    assert len(set(columns.tolist())) == len(columns)
    wide = np.maximum(gain if gain.shape[0] <= gain.shape[1] else gain.T, 0)
    best = max(sum(wide[k, c] for k, c in enumerate(order)) for order in permutations(range(wide.shape[1]), len(wide)))
    assert gain[rows, columns].sum() == pytest.approx(best)
    assert (gain[rows, columns] > 0).all()
    candidates = np.nonzero(gain > 0)
    pairs, gained = assign_pairs_by_gain(candidates, gain[candidates], gain.shape)
    assert gained.sum() == pytest.approx(best)
    assert gained.tolist() == pytest.approx(gain[pairs].tolist())
    assert (gained > 0).all()


# Encounters that are changed at once: no two of them need the same track at the same time


ENCOUNTERS = st.lists(
    st.tuples(
        st.lists(st.integers(0, 5), min_size=2, max_size=2, unique=True),
        st.integers(0, 20),
        st.integers(0, 8),
        st.floats(1, 20),
    ),
    min_size=1,
    max_size=9,
)


def chosen(met: list) -> list[int]:
    pairs, low, lasts, gain = zip(*met, strict=True)
    low = np.array(low)
    return compatible(np.array(pairs), low, low + np.array(lasts), np.array(gain)).tolist()


def are_rivals(one: tuple, other: tuple) -> bool:
    """Whether two encounters need one track at one step, step by step."""
    steps = [set(range(low, low + lasts + 1)) for _, low, lasts, _ in (one, other)]
    return bool(set(one[0]) & set(other[0])) and bool(steps[0] & steps[1])


def allowed(met: list, some: tuple[int, ...] | list[int]) -> bool:
    return not any(are_rivals(met[a], met[b]) for a, b in combinations(some, 2))


@given(met=ENCOUNTERS)
@settings(max_examples=60)
def test_an_encounter_is_changed_unless_a_better_one_needs_its_track(met):
    found = chosen(met)
    assert allowed(met, found)
    for other in set(range(len(met))) - set(found):
        assert any(are_rivals(met[other], met[k]) and met[k][3] >= met[other][3] for k in found)


# Decisions of re-tracking flip at the same distance as in the slow reference


NUMBERS = (0.2, 1.75, 0.12, 0.08)
MODEL, MOTION = MotionModel(*NUMBERS, 0.4), Motion(*NUMBERS, 0.4)
FEW = replace(
    PROFILES["default"],
    predictor="cv",
    noise_m=0.2,
    link_s=0.0,
    resolve_swaps=False,
    smooth=False,
    track_confidence=0.0,
    adapt_online=False,
)


def edge(decides: Callable[[float], bool], low: float, high: float) -> float:
    """Bisect for the value at which a decision flips that holds at ``low`` and not at ``high``."""
    assert decides(low)
    assert not decides(high)
    for _ in range(12):
        middle = (low + high) / 2
        low, high = (middle, high) if decides(middle) else (low, middle)
    return (low + high) / 2


def compare(ours: Callable[[float], bool], reference: Callable[[float], bool], low: float, high: float) -> None:
    assert edge(ours, low, high) == pytest.approx(edge(reference, low, high), abs=(high - low) / 2**11)


def by_reference(frames: list[Frame]):
    """Offline tracks, online tracks and forecasts of the slow reference, which predicts nothing here."""
    samples = [[dict(zip(row.dtype.names, row.tolist(), strict=True)) for row in frame.rows] for frame in frames]
    tracker = OnlineTracker(FEW, lambda points: (np.zeros((1, 2)), np.zeros((1, 2, 2))), 1)
    return tracker.run(samples, [frame.t_ns for frame in frames])


def jump(to_m: float, name: int, gap: int, beside_m: float | None) -> list[Frame]:
    """Person 7 stands at 0 m and, after a gap, at ``to_m`` under the id ``name``; 9 stood far away before.

    Another person appears ``beside_m`` away from 7 after the gap.
    """

    def path(tick: int):
        if tick < 12:
            return {7: (0.0, 0.0)} | ({9: (90.0, 0.0)} if tick < 4 else {})
        if tick < 12 + gap:
            return {}
        return {name: (to_m, 0.0)} | ({8: (to_m, beside_m)} if beside_m is not None else {})

    return walk(path, 15 + gap)


#: The id after the gap, the ticks of the gap, and how far beside somebody else is.
JUMPS = {
    "same id": (7, 0, None), "known id": (9, 0, None), "new id": (99, 0, None), "new id after a gap": (99, 1, None),
    "same id after a gap": (7, 2, None), "in a crowd": (7, 0, 1.65), "beside a crowd": (7, 0, 1.75),
    "known id in a crowd": (9, 2, 1.0),
}  # fmt: skip


@pytest.mark.parametrize(("name", "gap", "beside_m"), one_in(4, JUMPS.values()), ids=JUMPS)
def test_the_longest_jump_that_a_track_follows(name, gap, beside_m):
    def sources(rows) -> list[tuple[int, int]]:
        return [(int(row["track_id"]), int(row["source_id"])) for row in rows]

    def ours(to_m: float) -> bool:
        *_, (offline, *_) = FEW(jump(to_m, name, gap, beside_m))
        return (1, name) in sources(offline.rows)

    def reference(to_m: float) -> bool:
        offline, _, _ = by_reference(jump(to_m, name, gap, beside_m))
        return (1, name) in sources(offline[-1])

    compare(ours, reference, 0.0, 20.0)


def line(first: int, steps: int, start: tuple[float, float], speed: tuple[float, float]) -> Path:
    return {first + k: (start[0] + speed[0] * k * 0.4, start[1] + speed[1] * k * 0.4) for k in range(steps)}


def feature(name: str, paths: dict[int, Path]) -> tuple[float, float]:
    """A feature of the second of two tracks: of the package, and of the reference."""
    out = laid_out(paths)
    smoothed = smooth(MODEL, out)
    return float(features(MODEL, out, smoothed)[1, FEATURES.index(name)]), person_features(MOTION, paths)[2][name]


def test_the_distance_within_which_a_track_is_beside_a_longer_one():
    def share(beside_m: float) -> tuple[float, float]:
        paths = {1: line(0, 40, (0.0, 0.0), (1.0, 0.0)), 2: line(12, 10, (4.8, beside_m), (1.0, 0.0))}
        return feature("beside", paths)

    assert share(1.79) == pytest.approx((1.0, 1.0))
    assert share(1.81) == (0.0, 0.0)


@pytest.mark.parametrize(("count", "wanted"), [(4, 1.0), (3, 0.0)])
def test_the_samples_that_a_track_needs_to_be_beside_another(count, wanted):
    paths = {1: line(0, 40, (0.0, 0.0), (1.0, 0.0)), 2: line(12, count, (4.8, 0.5), (1.0, 0.0))}
    assert feature("beside", paths) == (wanted, wanted)


def crossing(beside_m: float, gap: int) -> dict[int, Path]:
    """Two people cross, and their track ids are swapped where they meet, in a gap of the tracks."""
    one, two = line(0, 51, (-10.0, 0.0), (1.0, 0.0)), line(0, 51, (10.0, beside_m), (-1.0, 0.0))
    when = 25
    unseen = range(when - gap, when)
    return {
        3: {s: (one if s < when else two)[s] for s in one if s not in unseen},
        5: {s: (two if s < when else one)[s] for s in one if s not in unseen},
    }


def ours_exchanged(paths: dict[int, Path]) -> bool:
    return resolve_swaps(MODEL, laid_out(paths))[1] > 0


@pytest.mark.parametrize("gap", [0, 4])
def test_the_least_distance_at_which_swapped_ids_are_noticed(gap):
    """Two stand beside each other, and their ids are swapped: the nearer they are, the smaller the evidence."""

    def beside(near: float):
        paths = crossing(0.0, gap)
        side = 1.5 - near
        for track, low, high in ((3, 0.0, side), (5, side, 0.0)):
            paths[track] = {step: (low if step < 25 else high, 0.0) for step in paths[track]}
        return paths

    compare(lambda near: ours_exchanged(beside(near)), lambda near: exchanged(MOTION, beside(near))[1] > 0, 0.0, 1.49)


def test_people_more_than_2_m_apart_have_no_encounter():
    for beside_m, met in ((1.99, True), (2.01, False)):
        paths = crossing(beside_m, 0)
        assert (exchanged(MOTION, paths)[1] > 0) == met
        assert ours_exchanged(paths) == met


def test_encounters_begin_and_end_as_in_the_reference():
    """Two walk abreast and come near each other twice, with any number of steps between."""
    for between in range(15, 26):
        one = {s: (0.4 * s, 0.0) for s in range(5, 90)}
        two = {
            s: (0.4 * s, 1.0 if s in range(20, 24) or s in range(23 + between, 26 + between) else 3.0)
            for s in range(80)
        }
        paths = {4: one, 9: two, 12: {s: (0.4 * s, -1.0) for s in range(28, 33)}}
        out = laid_out(paths)
        found = zip(*(column.tolist() for column in find_encounters(out)), strict=True)
        names = sorted(paths)
        assert [(names[i], names[j], *steps) for i, j, *steps in found] == encounters(paths)


def abreast(apart_m: float, aside_m: float, until: int, since: int = 15) -> list[Frame]:
    """Two walk so far apart; from tick 15 on one is missed, and from ``since`` on the other is so far aside, towards her."""

    def path(tick: int):
        if tick >= 15:
            return {1: (0.4 * tick, aside_m if tick >= since else 0.0)}
        return {1: (0.4 * tick, 0.0), 2: (0.4 * tick, apart_m)}

    return walk(path, until)


@pytest.mark.parametrize(
    ("apart_m", "aside_m", "is_merged"), [(0.5, 0.15, False), (0.5, 0.25, False), (1.2, 0.6, True)]
)
def test_a_missed_detection_beside_a_person_is_no_merged_one(apart_m, aside_m, is_merged):
    """The noise of positions is 0.2 m, so that 0.25 m aside, half way, says nothing, and 0.6 m does."""
    shown = [len(frame.rows) for _, frame, *_ in FEW(abreast(apart_m, aside_m, 21))]
    assert shown[15:] == ([2] * 6 if is_merged else [2] * 3 + [1] * 3)


def test_how_far_aside_a_detection_is_that_of_two():
    """As in the reference, a step after the last detection of one, of whom less is known then."""
    apart_m, since = 1.5, 16
    last = since + 3  # longer than tracks coast

    def ours(aside_m: float) -> bool:
        *_, (_, online, *_) = FEW(abreast(apart_m, aside_m, last + 1, since))
        return len(online.rows) == 1

    def reference(aside_m: float) -> bool:
        _, online, _ = by_reference(abreast(apart_m, aside_m, last + 1, since))
        return len(online[-1]) == 1

    compare(ours, reference, 0.0, apart_m / 2)


def test_a_swap_at_the_last_step_of_both_is_undone():
    """Two stand 1.5 m apart, and only their last positions are swapped."""
    paths = {
        track: {step: (left if step < 39 else 1.5 - left, 0.0) for step in range(40)}
        for track, left in ((3, 0.0), (5, 1.5))
    }
    owner, changed = resolve_swaps(MODEL, laid_out(paths))
    assert changed == 1
    assert owner.tolist() == [0] * 39 + [1] + [1] * 39 + [0]


@pytest.mark.parametrize(
    ("gap", "aside_m", "is_candidate"),
    [(-1, 0, False), (0, 0, False), (1, 0, True), (50, 0, True), (51, 0, False), (2, 2.99, True), (2, 3.01, False)],
)
def test_a_link_leads_forward_in_time_and_no_farther_than_its_limits(gap, aside_m, is_candidate):
    """Up to 20 s, which are 50 steps, and 1 m and 2.5 m for each second, which is 3 m in two steps."""
    states = State(np.array([[0, 0, 0, 0], [0, aside_m, 0, 0]], float), np.ones((2, 3)))
    ends = TrackEnds(MODEL, np.array([0, 14 + gap]), np.array([14, 28 + gap]), states, states)
    pairs = [
        (i, j, gaps.seconds)
        for first, second, gaps in pairs_in_reach(ends, 20.0)
        for i, j in zip(first, second, strict=True)
    ]
    assert pairs == [(0, 1, pytest.approx([0.4 * gap]))] * is_candidate


# The law of smoothing: nothing ends further from the truth than it came in, at any speed, whatever the noise.


#: Noise of positions per axis in m, and how long it lasts in s.
NOISES = ((0.1, 0.0), (0.25, 0.0), (0.15, 1.5), (0.3, 1.5))


def drawn(speed: float, noise_m: float, noise_s: float, seed: int) -> tuple[list[Frame], list[Frame]]:
    """A crowd that walks ``speed`` times as fast in a place as many times as large, and the samples of its tracks."""
    rows = crowds(1, 150, seed)[0].copy()
    rows[:, 2:] *= speed
    how = Corruption(noise_m, noise_s, seen_s=4.0, hidden_s=(0.4, 2.0), swap=0.0, flicker=0.0, new_id=0.3)
    clock = np.arange(int(rows[:, 0].max()) + 1)
    truth = on_clock(rows, clock)
    made = on_clock(corrupt(rows, how, np.random.default_rng(seed)), clock)
    return truth, [frame for (frame,) in Sample(start_ns=truth[0].t_ns)(made)]


def errors_m(truth: list[Frame], samples: list[Frame], offline: list[Frame]) -> tuple[float, float]:
    """The root mean square errors of samples and of the same rows offline, from the person nearest to the sample."""
    before, after = [], []
    for people, inputs, outputs in zip(truth, samples, offline, strict=True):
        true_m, seen_m, found_m = (
            np.stack([frame.rows["x_m"], frame.rows["y_m"]], axis=-1) for frame in (people, inputs, outputs)
        )
        sources = inputs.rows["track_id"].tolist()
        for place, (source, observed) in enumerate(outputs.rows[["source_id", "observed"]].tolist()):
            if observed:
                off = true_m - seen_m[sources.index(source)]
                nearest = np.hypot(*off.T).argmin()
                before.append(off[nearest])
                after.append(true_m[nearest] - found_m[place])
    return tuple(float(np.sqrt((np.array(off) ** 2).mean())) for off in (before, after))


@pytest.mark.parametrize(("speed", "noise"), one_in(14, product((1.0, 3.0, 1.4, 8.0, 5.0, 0.3, 2.0), NOISES)))
def test_nothing_ends_further_from_the_truth_than_it_came_in(speed: float, noise: tuple[float, float]):
    truth, samples = drawn(speed, *noise, seed=301)
    offline = [frame for frame, *_ in PROFILES["default"](samples)]
    before, after = errors_m(truth, samples, offline)
    assert after < (1.02 if noise[1] else 0.97) * before
    before, after = (
        summary(score(make_matchup(truth, frames, "metres", 0.5), "motmetrics"))["MOTA"]
        for frames in (samples, offline)
    )
    assert after >= before
