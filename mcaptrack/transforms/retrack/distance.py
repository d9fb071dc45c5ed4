"""How far apart a track and an observation are, by what is foretold of both.

Letters: K tracks, N observations, T future steps, J steps of overlap.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.predictors import Forecast

Distance = Literal["mean", "max", "first", "now", "likelihood"]
Covariance = Literal["paper", "predictor"]


def mahalanobis(off: Floats, cov: Floats) -> Floats:
    """Eq. 1: the lengths of ``off`` (..., 2) in units of the standard deviations of ``cov`` (..., 2, 2)."""
    xx, xy, yy = cov[..., 0, 0], cov[..., 0, 1], cov[..., 1, 1]
    x, y = off[..., 0], off[..., 1]
    squared = (yy * x**2 - 2 * xy * x * y + xx * y**2) / (xx * yy - xy**2)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def paper_covariance(first: Ints, steps: int, sigma_m: float) -> Floats:
    """The paper's belief: (u - t) sigma^2 on both axes, for ``steps`` steps u from t + ``first``; (K, steps, 2, 2)."""
    ahead = first[:, None] + np.arange(steps)
    return ahead[:, :, None, None] * (sigma_m**2 * np.eye(2))


def to_forecasts(
    tracks: Forecast, age: Ints, seen: Forecast, kind: Literal["mean", "max", "first"], sigma_m: float | None
) -> Floats:
    """Distances (K, N) between forecasts of tracks, made ``age`` (K,) steps ago, and of observations, made now.

    Eq. 2 averages over the steps that both foretell ("mean"); the authors' program takes the largest ("max"); "first"
    is the first of them alone. ``sigma_m`` uses the paper's covariance, None the forecasts' own. Infinite where
    nothing overlaps.
    """
    horizon = seen.mean.shape[1]
    steps = 1 if kind == "first" else max(horizon - int(age.min(initial=horizon)), 0)
    at = age[:, None] + np.arange(steps)  # step of the track's forecast that belongs to each step of overlap
    overlaps = at < horizon
    at = np.minimum(at, horizon - 1)
    row = np.arange(len(age))[:, None]
    if sigma_m is None:
        track_cov, seen_cov = tracks.cov[row, at], seen.cov[:, :steps]
    else:
        track_cov = paper_covariance(age + 1, steps, sigma_m)
        seen_cov = paper_covariance(np.ones(len(seen.mean), np.int64), steps, sigma_m)
    off = tracks.mean[row, at][:, None] - seen.mean[None, :, :steps]
    distance = mahalanobis(off, track_cov[:, None] + seen_cov[None])
    counted = np.broadcast_to(overlaps[:, None], distance.shape)
    if kind == "mean":
        total = np.where(counted, distance, 0.0).sum(axis=-1)
        count = counted.sum(axis=-1)
        return np.where(count > 0, total / np.maximum(count, 1), np.inf)
    return np.where(counted.any(axis=-1), np.where(counted, distance, -np.inf).max(axis=-1, initial=-np.inf), np.inf)


def _expected(tracks: Forecast, age: Ints) -> Floats:
    """Where K tracks are expected ``age`` (K,) steps after their last forecast: (K, 2), NaN where that has run out."""
    horizon = tracks.mean.shape[1]
    now = tracks.mean[np.arange(len(age)), np.minimum(age, horizon) - 1]
    return np.where((age <= horizon)[:, None], now, np.nan)


def jumps(tracks: Forecast, age: Ints, xy_m: Floats) -> Floats:
    """Distances (K, N) in metres between where tracks are expected now and positions (N, 2)."""
    off = _expected(tracks, age)[:, None] - xy_m[None]
    return np.asarray(np.hypot(off[..., 0], off[..., 1]))


def to_positions(tracks: Forecast, age: Ints, xy_m: Floats, noise_m: float, sigma_m: float | None) -> Floats:
    """Distances (K, N) between where tracks, ``age`` steps after their last forecast, are expected now and positions.

    Positions (N, 2) are seen with ``noise_m`` on each axis. Infinite for tracks whose forecast has run out.
    """
    now = np.minimum(age, tracks.mean.shape[1]) - 1
    cov = tracks.cov[np.arange(len(age)), now] if sigma_m is None else paper_covariance(age, 1, sigma_m)[:, 0]
    distance = mahalanobis(_expected(tracks, age)[:, None] - xy_m[None], (cov + noise_m**2 * np.eye(2))[:, None])
    return np.where(np.isnan(distance), np.inf, distance)
