"""Positions and forecasts as the metrics take them."""

from __future__ import annotations

import numpy as np

from mcaptrack.evaluation.metrics.displacement import Forecasts, Positions


def positions(people: dict[int, dict[int, tuple[float, float]]]) -> Positions:
    """{id: {step: place}} as arrays."""
    rows = [(step, who, *place) for who, path in people.items() for step, place in path.items()]
    table = np.array(rows, float).reshape(-1, 4)
    return Positions(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:])


def predicted(step: int, who: int, mean: list[tuple[float, float]], variance: float = 1.0) -> tuple:
    return step, who, mean, [variance * np.eye(2)] * len(mean)


def forecasts(*parts: tuple) -> Forecasts:
    steps, who, means, covs = zip(*parts, strict=True)
    return Forecasts(np.array(steps), np.array(who), np.array(means, float), np.array(covs))
