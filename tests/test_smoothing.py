"""The law of smoothing: nothing ends further from the truth than it came in, at any speed, whatever the noise."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from mcaptrack.evaluation.aligned import make_matchup
from mcaptrack.evaluation.metrics import score, summary
from mcaptrack.schema import Frame
from mcaptrack.transforms import PROFILES, Sample
from tests.tiers import one_in
from tools.corruptions import Corruption, corrupt, crowds
from tools.reproduce import on_clock

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
