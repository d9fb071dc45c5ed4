"""Cases for ``test_effects``: a scene in words, a number read off the output, and what it is for some values.

The numbers are counted by hand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from mcaptrack.schema import Frame
from tests.worlds import ids, walk

Outputs = list[list[Frame]]


@dataclass(frozen=True)
class Case:
    """``scene`` is what happens; ``number`` is read off the outputs; ``wanted`` maps values of the option to it.

    Where ``wanted`` maps to words ("least", "more", "most"), only the order of the numbers counts.
    """

    scene: str
    transform: Any
    frames: list[Frame]
    number: Callable[[Outputs], Any]
    wanted: dict[Any, Any]


def people(outputs: Outputs) -> int:
    """How many identities there are in the main output."""
    return len({who for frame in outputs[0] for who in ids(frame)})


def rows(outputs: Outputs) -> int:
    return sum(len(frame.rows) for frame in outputs[0])


def forecasts(outputs: Outputs) -> list[Frame]:
    return next(part for part in outputs if "ahead_s" in part[0].rows.dtype.names)


def last_forecast(outputs: Outputs) -> Frame:
    return next(frame for frame in reversed(forecasts(outputs)) if len(frame.rows))


def forecast_steps(outputs: Outputs) -> int:
    return int(last_forecast(outputs).rows["step"].max())


def spread_of_last(outputs: Outputs) -> float:
    """The variance along the first axis of the last predicted position, in square metres."""
    return float(last_forecast(outputs).rows["cov_xx_m2"][-1])


def change_of_forecasts(outputs: Outputs) -> float:
    """How far the forecasts of the same moment, made a step apart, are from each other on average, in metres."""
    futures = [np.stack([f.rows["x_m"], f.rows["y_m"]], axis=-1) for f in forecasts(outputs) if len(f.rows) == 12]
    return float(np.mean([np.hypot(*(a[1:] - b[:-1]).T).mean() for a, b in pairwise(futures)]))


def noise(ticks: int, spread_m: float, seed: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, spread_m, (ticks, 2))


def line(speed: float, until: int, ticks: int) -> list[Frame]:
    """One walks along the first axis, ``speed`` metres a tick, and is gone from tick ``until`` on."""
    return walk(lambda n: {7: (speed * n, 0.0)} if n < until else {}, ticks)


def shaky(ticks: int = 60, spread_m: float = 0.25) -> list[Frame]:
    """One walks along the first axis and is seen with noise."""
    off = noise(ticks, spread_m)
    return walk(lambda n: {1: (0.5 * n + off[n, 0], off[n, 1])}, ticks)
