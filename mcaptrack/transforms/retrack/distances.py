"""Distances between tracks and observations, by comparing their predictions (Eq. 1 and 2 of the paper).

Letters: K tracks, N observations, T predicted steps.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.mixtures import mahalanobis_squared
from mcaptrack.predictors import Forecast

Distance = Literal["mean", "max", "first", "now"]
Covariance = Literal["paper", "predictor"]


def mahalanobis(off: Floats, cov: Floats) -> Floats:
    """Eq. 1: the lengths of ``off`` (..., 2) in standard deviations of ``cov`` (..., 2, 2)."""
    return np.asarray(np.sqrt(np.maximum(mahalanobis_squared(off, cov), 0.0)))


def paper_covariance(first: Ints, steps: int, sigma_m: float) -> Floats:
    """The paper's covariance, (u - t) sigma^2 per axis, for ``steps`` steps u from t + ``first``; (K, steps, 2, 2)."""
    ahead = first[:, None] + np.arange(steps)
    return ahead[:, :, None, None] * (sigma_m**2 * np.eye(2))


def prediction_distances(
    tracks: Forecast, age: Ints, observations: Forecast, kind: Literal["mean", "max", "first"], sigma_m: float | None
) -> Floats:
    """Distances (K, N) between predictions of tracks, made ``age`` (K,) steps ago, and of observations, made now.

    Eq. 2 averages over the steps that both predict ("mean"); the authors' program takes the largest ("max"); "first"
    takes the first of them alone. ``sigma_m`` uses the paper's covariance, None that of the predictions. Infinite where
    no steps overlap.
    """
    horizon = observations.mean.shape[1]
    steps = 1 if kind == "first" else max(horizon - int(age.min(initial=horizon)), 0)
    at = age[:, None] + np.arange(steps)  # step of the track's prediction that belongs to each overlapping step
    overlaps = at < horizon
    at = np.minimum(at, horizon - 1)
    row = np.arange(len(age))[:, None]
    if sigma_m is None:
        track_cov, observation_cov = tracks.cov[row, at], observations.cov[:, :steps]
    else:
        track_cov = paper_covariance(age + 1, steps, sigma_m)
        observation_cov = paper_covariance(np.ones(len(observations.mean), np.int64), steps, sigma_m)
    off = tracks.mean[row, at][:, None] - observations.mean[None, :, :steps]
    distance = mahalanobis(off, track_cov[:, None] + observation_cov[None])
    counted = np.broadcast_to(overlaps[:, None], distance.shape)
    if kind == "mean":
        total = np.where(counted, distance, 0.0).sum(axis=-1)
        count = counted.sum(axis=-1)
        return np.where(count > 0, total / np.maximum(count, 1), np.inf)
    return np.where(counted.any(axis=-1), np.where(counted, distance, -np.inf).max(axis=-1, initial=-np.inf), np.inf)


def expected_positions(tracks: Forecast, age: Ints) -> Floats:
    """The expected positions (K, 2) of tracks ``age`` (K,) steps after their prediction; NaN beyond its horizon."""
    horizon = tracks.mean.shape[1]
    now = tracks.mean[np.arange(len(age)), np.minimum(age, horizon) - 1]
    return np.where((age <= horizon)[:, None], now, np.nan)


def metric_distances(tracks: Forecast, age: Ints, xy_m: Floats) -> Floats:
    """Distances (K, N) in metres between where tracks are expected now and positions (N, 2)."""
    off = expected_positions(tracks, age)[:, None] - xy_m[None]
    return np.asarray(np.hypot(off[..., 0], off[..., 1]))


def position_distances(tracks: Forecast, age: Ints, xy_m: Floats, noise_m: float, sigma_m: float | None) -> Floats:
    """Mahalanobis distances (K, N) between where tracks are expected now and measured positions.

    Positions (N, 2) are measured with ``noise_m`` on each axis. Infinite for tracks beyond the horizon of their
    prediction.
    """
    now = np.minimum(age, tracks.mean.shape[1]) - 1
    cov = tracks.cov[np.arange(len(age)), now] if sigma_m is None else paper_covariance(age, 1, sigma_m)[:, 0]
    off = expected_positions(tracks, age)[:, None] - xy_m[None]
    distance = mahalanobis(off, (cov + noise_m**2 * np.eye(2))[:, None])
    return np.where(np.isnan(distance), np.inf, distance)
