"""How good forecasts are whose true future is at hand: displacement errors, likelihood, and calibration.

Letters: N forecasts, T future steps.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats

#: The shares of true futures that the ellipses are to hold which are reported.
LEVELS: Final = (0.5, 0.9, 0.95)


def mahalanobis_squared(off_m: Floats, cov_m2: Floats) -> Floats:
    """Squared lengths (...) of ``off_m`` (..., 2) in units of the spread of ``cov_m2`` (..., 2, 2)."""
    xx, xy, yy = cov_m2[..., 0, 0], cov_m2[..., 0, 1], cov_m2[..., 1, 1]
    x, y = off_m[..., 0], off_m[..., 1]
    return np.asarray((yy * x**2 - 2 * xy * x * y + xx * y**2) / (xx * yy - xy**2))


def coverage(off_m: Floats, cov_m2: Floats, level: float) -> float:
    """The share of errors (..., 2) inside the ellipses that are to hold ``level`` of them."""
    return float((mahalanobis_squared(off_m, cov_m2) <= -2 * np.log(1 - level)).mean())


def forecast_scores(mean_m: Floats, cov_m2: Floats, future_m: Floats) -> dict[str, float]:
    """Scores of forecasts ``mean_m`` (N, T, 2), ``cov_m2`` (N, T, 2, 2) by what came, ``future_m`` (N, T, 2).

    ADE_m and FDE_m: mean Euclidean distance over all steps and at the last. ADE_squared_m2: the paper's, without the
    root. NLL: negative log-likelihood of a step, in nats. coverage_P: the share inside the P % ellipses.
    """
    off = mean_m - future_m
    away = np.hypot(off[..., 0], off[..., 1])
    area = cov_m2[..., 0, 0] * cov_m2[..., 1, 1] - cov_m2[..., 0, 1] ** 2
    nll = mahalanobis_squared(off, cov_m2) / 2 + np.log(area) / 2 + np.log(2 * np.pi)
    return {
        "ADE_m": float(away.mean()),
        "FDE_m": float(away[:, -1].mean()),
        "ADE_squared_m2": float((away**2).mean()),
        "NLL": float(nll.mean()),
        **{f"coverage_{100 * level:g}": coverage(off, cov_m2, level) for level in LEVELS},
    }
