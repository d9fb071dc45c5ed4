"""Links, encounters and smoothing, each against a second, slow implementation, on synthetic paths."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.transforms.retrack import linking, offline
from mcaptrack.transforms.retrack.assignments import Tracks
from mcaptrack.transforms.retrack.identity_swaps import find_swaps, resolve_swaps
from mcaptrack.transforms.retrack.linking import Cuts, CutTracks, TrackEnds, find_candidates, link_pieces, link_tracks
from mcaptrack.transforms.retrack.motion_model import MotionModel, smooth, to_trajectories
from tests.memory import held
from tests.references import cut_links
from tests.references.offline import DRIFTS, Motion, course_of, exchanged, links

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
    return Tracks(step, track, source, np.arange(len(step)), places, np.full(len(step), -1))


def laid_out(paths: Paths, noise_m: float):
    """The same paths as trajectories of the package, and the row of each position."""
    assigned = [(step, name, *place) for name, path in paths.items() for step, place in path.items()]
    step, name, x, y = (np.array(column) for column in zip(*assigned, strict=True))
    _, at, out = to_trajectories(step, name, np.stack([x, y], axis=-1))
    return out, at


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
    out, _ = laid_out(paths, model.noise_m)
    found = smooth(model, out)
    wanted = (motion.filtered, motion.backwards, motion.smoothed)
    for states, other in zip(found, wanted, strict=True):
        theirs = [state for path in paths.values() for state in dict(sorted(other(path).items())).values()]
        np.testing.assert_allclose(states.mean, [s.mean.T.ravel() for s in theirs], atol=1e-9)
        np.testing.assert_allclose(states.cov, [s.cov[[0, 0, 1], [0, 1, 1]] for s in theirs], atol=1e-9)


@given(seed=SEEDS)
@settings(max_examples=25)
def test_links_equal_the_reference(seed):
    rng = np.random.default_rng(seed)
    model, motion = models(rng)
    paths = scattered(rng, int(rng.integers(1, 10)))
    most_s, least = float(rng.choice([1.2, 6.0, 20.0])), float(rng.choice([0.1, 0.5, 0.9]))
    out, _ = laid_out(paths, model.noise_m)
    found = link_tracks(TrackEnds.of(model, out), most_s, least)
    names = sorted(paths)
    assert {names[i]: names[j] for i, j in enumerate(found.tolist()) if j >= 0} == links(motion, paths, most_s, least)


@given(seed=SEEDS)
@settings(max_examples=6)
def test_links_of_tracks_that_were_cut_equal_the_reference(seed):
    """Some tracks were one with another one before, and two or three share an input id."""
    rng = np.random.default_rng(seed)
    model, motion = models(rng)
    paths = scattered(rng, int(rng.integers(2, 14)))
    names = sorted(paths)
    pairs = [(a, b) for a in names for b in names if max(paths[a]) < min(paths[b])]
    cuts: dict[int, tuple[int, float]] = {}
    for number in rng.permutation(len(pairs)).tolist():
        before, after = pairs[number]
        if before not in cuts and after not in {one for one, _ in cuts.values()} and rng.random() < 0.4:
            cuts[before] = after, float(rng.choice([0.0, rng.random() * 0.7]))
    given_cuts = [(before, after, likely) for before, (after, likely) in cuts.items()]
    ids = {name: {step: int(rng.integers(3)) + 5 * (step // 12) for step in path} for name, path in paths.items()}
    most_s, least = float(rng.choice([1.2, 6.0, 20.0])), float(rng.choice([0.1, 0.5, 0.9]))
    out, _ = laid_out(paths, model.noise_m)
    rows = [(step, name, ids[name][step]) for name, path in paths.items() for step in path]
    step, track, source = np.array(rows)[rng.permutation(len(rows))].T
    sides = np.array(given_cuts).reshape(-1, 3)
    pieces = CutTracks.of(tracks_of(step, track, source), Cuts(*sides[:, :2].astype(int).T, sides[:, 2]))
    found = link_pieces(TrackEnds.of(model, out), most_s, least, pieces)
    wanted = cut_links.links(motion, paths, ids, most_s, least, given_cuts)
    assert {names[i]: names[j] for i, j in enumerate(found.tolist()) if j >= 0} == wanted


def cut_at(paths: Paths, ids: dict[int, int], cuts: list[tuple[int, int, float]]):
    """What the links of such tracks are decided by; each has one input id."""
    model = MotionModel(0.1, 1.0, 0.1, 0.0, 0.4)
    out, _ = laid_out(paths, 0.1)
    step, track = np.array([(step, name) for name, path in paths.items() for step in path]).T
    sides = np.array(cuts).reshape(-1, 3)
    source = np.array([ids.get(name, name) for name in track.tolist()])
    pieces = CutTracks.of(tracks_of(step, track, source), Cuts(*sides[:, :2].astype(int).T, sides[:, 2]))
    return TrackEnds.of(model, out), pieces


def straight(first: int, aside_m: float) -> dict[int, tuple[float, float]]:
    return {step: (0.4 * step, aside_m) for step in range(first, first + 15)}


def test_many_cuts_do_not_make_other_gaps_look_crossed():
    """A track ends, and 4 s later another begins aside of where it would be; 30 others were cut in between, far away."""
    others = {10 + k: straight(15 * (k % 2), 500.0 * (1 + k // 2)) for k in range(60)}
    cuts = [(10 + k, 11 + k, 0.65) for k in range(0, 60, 2)]

    def are_linked(aside_m: float, beside: Paths, given_cuts: list) -> bool:
        ends, pieces = cut_at({1: straight(0, 0.0), 2: straight(25, aside_m)} | beside, {}, given_cuts)
        found = link_pieces(ends, 20.0, 0.5, pieces)
        assert (found[2::2] == np.arange(3, len(found), 2)).all()
        return found[0] == 1

    places = np.linspace(0.0, 4.0, 40).tolist()
    alone = [are_linked(aside_m, {}, []) for aside_m in places]
    assert {True, False} == set(alone)
    assert [are_linked(aside_m, others, cuts) for aside_m in places] == alone


@pytest.mark.parametrize(
    ("since", "source", "may_be"), [(28, 5, True), (28, 6, False), (29, 5, False)], ids=["5.6 s", "another id", "6 s"]
)
def test_pieces_with_one_input_id_may_be_linked_within_6_s_however_they_move(since, source, may_be):
    """Cut at step 14, a track goes on as another piece, and its input id is seen again later, 12 m aside."""
    paths = {1: straight(0, 0.0), 2: straight(15, 0.5), 3: straight(since, -12.0)}
    ends, pieces = cut_at(paths, {1: 5, 3: source}, [(1, 2, 0.1)])
    found = find_candidates(ends, 20.0, pieces)
    pairs = set(zip(found.ends.tolist(), found.begins.tolist(), strict=True))
    assert (0, 1) in pairs
    assert ((0, 2) in pairs) == may_be


@given(seed=SEEDS)
@settings(max_examples=25)
def test_links_are_the_same_without_a_table_of_all_pairs_and_in_batches_of_any_size(seed):
    rng = np.random.default_rng(seed)
    model, _ = models(rng)
    out, _ = laid_out(scattered(rng, 14), model.noise_m)
    whole = link_tracks(TrackEnds.of(model, out), 20.0, 0.1)
    for name, value in (("_TABLE_CELLS", 1), ("_BATCH", int(rng.integers(1, 9)))):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(linking, name, value)
            assert link_tracks(TrackEnds.of(model, out), 20.0, 0.1).tolist() == whole.tolist()


@given(seed=SEEDS)
@settings(max_examples=25)
def test_shifts_by_the_length_of_gaps_equal_the_reference(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 40))
    odds, gap_s = rng.normal(rng.normal(0, 2), 2, count), rng.choice(np.arange(0.4, 20, 0.4), count)
    made = {(k, k): (float(odds[k]), False, float(gap_s[k])) for k in range(count)}
    found = linking.prior_shifts(odds, gap_s)
    np.testing.assert_allclose(found, cut_links.usual_by_gap(made), atol=1e-3)


def test_links_of_thousands_of_broken_tracks_take_memory_for_the_candidates_alone():
    """A chain of tracks that hang together: a table of all has 9 million cells, of which 9000 are candidates."""
    count = 3000
    rows = np.repeat(np.arange(count), 3)
    pairs = rows, np.minimum(rows + np.tile([0, 1, 2], count), count - 1)
    gain = np.random.default_rng(0).uniform(0.1, 5, len(rows))
    linking._assigned(pairs, gain, (count, count))
    _, most = held(lambda: linking._assigned(pairs, gain, (count, count)))
    assert most < 2_000_000


@given(seed=SEEDS)
@settings(max_examples=25)
def test_swaps_equal_the_reference(seed):
    """Relative positions of two people, with random swaps and random costs of a swap."""
    rng = np.random.default_rng(seed)
    model, motion = models(rng)
    count, steps = int(rng.integers(1, 4)), int(rng.integers(1, 40))
    apart, cost = np.empty((count, steps, 2)), rng.uniform(0, 9, (count, steps))
    for one in range(count):
        apart[one] = walk_of(rng, rng.normal(0, 1.5, 2), rng.normal(0, 0.5, 2), steps, motion.noise_m)
        apart[one, rng.integers(0, steps) :] *= rng.choice([-1, 1])
        apart[one, rng.random(steps) < 0.2] = np.nan
    course, gain = find_swaps(model, apart, cost)
    for one in range(count):
        seen = [None if np.isnan(at[0]) else at for at in apart[one]]
        each = [course_of(seen, cost[one].tolist(), motion, drift) for drift in DRIFTS]
        wanted, more, _ = max(each, key=lambda found: found[2])
        assert course[one].tolist() == wanted
        np.testing.assert_allclose(gain[one], more, atol=1e-9)


@given(seed=SEEDS)
@settings(max_examples=25)
def test_decisions_at_encounters_equal_the_reference(seed):
    """Pairs of people that cross, some with swapped identities, with input ids that follow the swap or not."""
    rng = np.random.default_rng(seed)
    model, motion = models(rng)
    paths, ids = {}, {}
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
        named = rng.choice(4)
        for name, other in ((a, b), (b, a)):
            said = {0: other, 1: 40 + name, 2: name, 3: name}[int(named)]
            ids[name] = {step: name if step < first[0] + when else said for step in paths[name]}
    out, at = laid_out(paths, model.noise_m)
    source = np.array([ids[name][step] for name, path in paths.items() for step in path])
    owner, decided = resolve_swaps(model, out, at, source)
    wanted, count = exchanged(motion, paths, ids)
    assert decided == count
    names = sorted(paths)
    for k, name in enumerate(names):
        rows = slice(out.first[k], out.first[k + 1])
        found = dict(zip(out.step[rows].tolist(), (names[o] for o in owner[rows].tolist()), strict=True))
        assert {step: found[step] for step in paths[name]} == wanted[name]


@given(seed=SEEDS)
@settings(max_examples=10)
def test_encounters_of_tracks_that_did_not_change_need_no_second_look(seed):
    """Rounds over all encounters decide the same as rounds over those of the tracks that the last one changed."""
    rng = np.random.default_rng(seed)
    model, _ = models(rng)
    steps, people = 60, 5
    paths = [walk_of(rng, rng.uniform(-2, 2, 2), rng.normal(0, 0.3, 2), steps, model.noise_m) for _ in range(people)]
    for _ in range(4):
        (a, b), when = rng.choice(people, 2, replace=False), int(rng.integers(5, 55))
        paths[a][when:], paths[b][when:] = paths[b][when:].copy(), paths[a][when:].copy()
    step, first = np.tile(np.arange(steps), people), np.repeat(np.arange(people), steps)
    xy = np.concatenate(paths)
    track = first
    for _ in range(offline._ROUNDS):
        ids, row, out = to_trajectories(step, track, xy)
        owner, _ = resolve_swaps(model, out, row, first)
        track = ids[owner[row]]
    assert offline._without_swaps(model, tracks_of(step, first, first, xy), None).track.tolist() == track.tolist()
