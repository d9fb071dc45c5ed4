"""Offline re-tracking: motion model, links, encounters and false tracks, each against a law or by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.geometry.assignment import assign_by_gain, assign_pairs_by_gain
from mcaptrack.transforms import PROFILES
from mcaptrack.transforms.retrack.identity_swaps import _continuity, find_swaps
from mcaptrack.transforms.retrack.likelihood import LikelihoodPass
from mcaptrack.transforms.retrack.linking import Gaps, TrackEnds, link_tracks, misfits
from mcaptrack.transforms.retrack.motion_model import (
    MotionModel,
    State,
    to_trajectories,
)
from tests.worlds import places, walk

STEP_S = 0.4
MODEL = MotionModel(noise_m=0.1, speed_m_per_s=1.5, drift_m_per_s=0.15, drift_ratio=0.0, step_s=STEP_S)
DEFAULT = PROFILES["default"]


def test_what_tracks_keep_of_their_input_ids_is_counted_by_hand():
    """An id is compared with the last one that each of the two tracks had before; -1 is none."""
    rng = np.random.default_rng(2)
    a, b = (np.where(rng.random((40, 9)) < 0.3, -1, rng.integers(0, 3, (40, 9))) for _ in range(2))
    wanted = np.zeros(a.shape)
    for row in range(len(a)):
        last_a = last_b = -1
        for at, (one, other) in enumerate(zip(a[row], b[row], strict=True)):
            for now, own, others in ((one, last_a, last_b), (other, last_b, last_a)):
                if now != -1:
                    wanted[row, at] += int(now == own) - int(now == others)
            last_a, last_b = (one if one != -1 else last_a), (other if other != -1 else last_b)
    assert _continuity(a, b).tolist() == wanted.tolist()


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_the_assignment_is_optimal(seed):
    """Compare with all assignments of up to four rows to up to four columns."""
    from itertools import permutations

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


class TestLinks:
    def follows(self, *people: tuple[int, np.ndarray]) -> list[int]:
        step = np.concatenate([start + np.arange(len(xy)) for start, xy in people])
        track = np.repeat(np.arange(len(people)), [len(xy) for _, xy in people])
        _, _, paths = to_trajectories(step, track, np.concatenate([xy for _, xy in people]))
        return link_tracks(TrackEnds.of(MODEL, paths), 14.0, 0.5).tolist()

    def walking(self, x: float, y: float, steps: int = 12, speed: float = 0.5) -> np.ndarray:
        return np.stack([x + speed * np.arange(steps), np.full(steps, y)], axis=-1)

    def test_a_person_who_walks_on_behind_a_wall_is_linked(self):
        assert self.follows((0, self.walking(0, 0)), (22, self.walking(11, 0))) == [1, -1]

    def test_a_person_who_stands_behind_a_wall_is_linked(self):
        assert self.follows((0, self.walking(0, 0, speed=0)), (25, self.walking(0.1, 0, speed=0))) == [1, -1]

    def test_a_person_who_would_have_to_turn_round_is_not_linked(self):
        assert self.follows((0, self.walking(0, 0)), (16, self.walking(-6, 0, speed=-0.5))) == [-1, -1]

    def test_no_link_is_longer_than_the_option_allows(self):
        assert self.follows((0, self.walking(0, 0)), (60, self.walking(30, 0))) == [-1, -1]

    def test_links_maximize_the_total_over_all_tracks(self):
        """The nearest beginning for one end is the only possible one for the other."""
        people = [
            (0, self.walking(0, 0)),
            (0, self.walking(0, 1.2)),
            (18, self.walking(9, 0)),
            (18, self.walking(9, 1.2)),
        ]
        assert self.follows(*people) == [2, 3, -1, -1]


class TestEncounters:
    def apart(self, exchanged: slice, noise: float, seed: int = 0) -> np.ndarray:
        """Two pass each other 0.8 m apart; their track ids are swapped over some steps."""
        steps = np.arange(40)
        off = np.stack([6 - 0.3 * steps, np.full(40, 0.8)], axis=-1) + np.random.default_rng(seed).normal(
            0, noise, (40, 2)
        )
        off[exchanged] *= -1
        return off[None]

    @pytest.mark.parametrize("since", [5, 18, 22, 30])
    def test_a_swap_is_found_at_its_exact_step(self, since):
        course, gain = find_swaps(
            replace(MODEL, noise_m=0.05), self.apart(slice(since, None), 0.05), np.full((1, 40), 5.0)
        )
        assert np.flatnonzero(course[0]).tolist() == list(range(since, 40))
        assert gain[0] > 3

    def test_a_swap_and_its_reversal_are_found(self):
        course, _ = find_swaps(replace(MODEL, noise_m=0.05), self.apart(slice(8, 15), 0.05), np.full((1, 40), 5.0))
        assert np.flatnonzero(course[0]).tolist() == list(range(8, 15))

    def test_without_a_swap_none_is_found(self):
        for seed in range(20):
            course, gain = find_swaps(
                replace(MODEL, noise_m=0.1), self.apart(slice(0, 0), 0.1, seed), np.full((1, 40), 5.0)
            )
            assert not course.any()
            assert gain[0] <= 0


class TestOffline:
    def offline(self, path, ticks=60, profile=DEFAULT):
        return [result[0] for result in profile(walk(path, ticks))]

    def test_a_track_continues_after_an_occlusion_of_six_seconds(self):
        frames = self.offline(lambda n: {1 if n < 20 else 2: (0.5 * n, 0.0)} if not 20 <= n < 35 else {})
        assert {who for frame in frames for who in places(frame)} == {1}
        assert [len(frame.rows) for frame in frames] == [1] * 60
        assert not any(frame.rows["observed"].any() for frame in frames[20:35])

    def test_identity_switches_of_the_input_are_repaired_where_two_people_pass(self):
        """The input ids are swapped as two pass 0.5 m from each other, occluded for a moment."""

        def crowd(n):
            a, b = (0.4 * n, 0.0), (24 - 0.4 * n, 0.5)
            if 29 <= n <= 31:
                return {}
            return {1: a, 2: b} if n < 30 else {1: b, 2: a}

        frames = self.offline(crowd)
        ends = [{who: xy[0] for who, xy in places(frames[n]).items()} for n in (0, 59)]
        assert sorted(ends[0]) == sorted(ends[1])
        for who in ends[0]:
            assert abs(ends[0][who] - ends[1][who]) > 20

    @pytest.mark.parametrize("name", [1, 2, 3])
    def test_two_people_keep_their_ids_when_merged_for_two_seconds(self, name):
        """The merged detection lies between them, under any id, which one of them keeps afterwards."""

        def crowd(n):
            side = 0.15 * (22 - n)
            a, b = (0.5 * n, side), (0.5 * n, -side)
            if abs(side) >= 0.45:
                return {1: a, 2: b} if n < 22 else {name: a, 7: b}
            return {name: (0.5 * n, 0.0)}

        for profile in (DEFAULT, replace(DEFAULT, resolve_swaps=False)):
            offline, online, *_ = (list(part) for part in zip(*profile(walk(crowd, 45)), strict=True))
            for frames in (offline, online):
                before, after = ({who: xy[1] > 0 for who, xy in places(frames[n]).items()} for n in (10, 40))
                assert len(before) == 2
                assert {who: not side for who, side in before.items()} == after
                assert len(frames[22].rows) == 2  # both are alive while merged

    def test_smoothing_reduces_noise(self):
        noise = np.random.default_rng(1).normal(0, 0.2, (60, 2))
        frames = self.offline(lambda n: {1: (0.5 * n + noise[n, 0], noise[n, 1])})
        off = np.array([np.subtract(places(f)[1], (0.5 * n, 0.0)) for n, f in enumerate(frames)])
        raw = np.sqrt((noise**2).sum(axis=1).mean())
        assert np.sqrt((off**2).sum(axis=1).mean()) < 0.7 * raw

    def test_the_noise_is_estimated(self):
        for noise_m in (0.05, 0.35):
            rng = np.random.default_rng(2)
            frames = walk(
                lambda n, rng=rng, noise_m=noise_m: {
                    k: (0.5 * n + rng.normal(0, noise_m), 10.0 * k + rng.normal(0, noise_m)) for k in range(8)
                },
                120,
            )
            run = LikelihoodPass(DEFAULT)
            for frame in frames:
                run.step(frame)
            run.finish()
            assert run.noise_m == pytest.approx(noise_m, rel=0.25)

    @pytest.mark.parametrize(("spread_m", "found_m"), [(0.0, 0.03), (4.0, 0.8)])
    def test_the_estimated_noise_has_limits(self, spread_m, found_m):
        rng = np.random.default_rng(2)
        run = LikelihoodPass(DEFAULT)
        for frame in walk(lambda n: {k: tuple([0.0, 900.0 * k] + rng.normal(0, spread_m, 2)) for k in range(9)}, 250):
            run.step(frame)
        run.finish()
        assert run.noise_m == pytest.approx(found_m)

    def test_three_identity_switches_in_a_row_are_undone(self):
        """1 crosses 2, 2 crosses 3, 3 crosses 4, each time occluded for a moment, and the input id 1 goes to the other.

        The same track is in all three encounters, so they are decided one after another.
        """
        crossings = [(20, 1, 2), (45, 2, 3), (70, 3, 4)]

        def where(tick: int) -> dict[int, tuple[float, float]]:
            x = {1: 0.4 * tick, 2: 16 - 0.4 * tick, 3: 0.4 * tick - 20, 4: 36 - 0.4 * tick}
            return {who: (x[who], 0.5 * who) for who in x}

        def crowd(tick: int):
            people, name = where(tick), {who: who for who in range(1, 5)}
            for when, one, other in crossings:
                if abs(tick - when) <= 1:
                    del people[one], people[other]
                if tick > when:
                    name[one], name[other] = name[other], name[one]
            return {name[who]: at for who, at in people.items()}

        frames = self.offline(crowd, 95, replace(DEFAULT, same_id_bonus=60.0, link_s=0.0))
        first, last = places(frames[5]), places(frames[90])
        assert len(first) == 4
        for one, at in first.items():
            person = min(where(5), key=lambda who: np.hypot(*np.subtract(where(5)[who], at)))
            assert last[one] == pytest.approx(where(90)[person], abs=0.2)

    @given(seed=st.integers(0, 2**32 - 1), cut=st.integers(5, 55))
    @settings(max_examples=2)
    def test_predictions_do_not_depend_on_the_future(self, seed, cut):
        """Truncate or replace the rest of the log: online tracks and predictions up to there stay the same to the bit."""
        rng = np.random.default_rng(seed)
        start, speed = rng.uniform(-8, 8, (6, 2)), rng.normal(0, 0.4, (6, 2))
        noise, there = rng.normal(0, 0.15, (60, 6, 2)), rng.random((60, 6)) > 0.25

        def crowd(n):
            return {k: tuple(start[k] + speed[k] * n + noise[n, k]) for k in range(6) if there[n, k]}

        frames = walk(crowd, 60)
        other = frames[:cut] + walk(lambda n: {k + 90: (n - 30.0, 3.0 * k) for k in range(4)}, 60)[cut:]
        for profile in (DEFAULT, replace(DEFAULT, coast_s=3.0), PROFILES["authors"]):
            runs = [
                [(online, forecasts) for _, online, forecasts, *_ in profile(f)][:cut]
                for f in (frames, frames[:cut], other)
            ]
            for whole, *others in zip(*runs, strict=True):
                for part in others:
                    for a, b in zip(whole, part, strict=True):
                        for name in a.rows.dtype.names:
                            assert a.rows[name].tobytes() == b.rows[name].tobytes()


def test_the_misfit_of_a_continuation_by_hand():
    """After 2 s at a mean velocity of 2 m/s it is 4 m ahead of the end; a track at rest stays where it was."""
    before, after = (np.zeros((3, 4)) for _ in range(2))
    before[:, 2:], after[:, :2] = (1.0, 0.0), [(5.0, 1.0), (0.5, 0.0), (4.0, 3.0)]
    after[:, 2:] = (3.0, 0.0)
    cov = np.zeros((3, 3))
    found = misfits(Gaps(State(before, cov), State(after, cov), np.array([2.0, 2.0, 2.0])))
    np.testing.assert_allclose(found, [np.sqrt(2), 0.5, 3.0])
