"""Scores of forecasts when the true future is known: displacement errors, likelihood, and calibration.

Letters: N forecasts, T future steps.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats

#: The probabilities of the ellipses for which calibration is reported.
LEVELS: Final = (0.5, 0.9, 0.95)


def mahalanobis_squared(off_m: Floats, cov_m2: Floats) -> Floats:
    """Squared Mahalanobis distances of errors from zero.

    Parameters
    ----------
    off_m : array (..., 2), m
        Errors.
    cov_m2 : array (..., 2, 2), m^2
        Their covariances.

    Returns
    -------
    array (...)
        Squared distances in units of the standard deviation.

    Examples
    --------
    >>> import numpy as np
    >>> mahalanobis_squared(np.array([2.0, 0.0]), np.diag([4.0, 1.0])).item()
    1.0
    """
    xx, xy, yy = cov_m2[..., 0, 0], cov_m2[..., 0, 1], cov_m2[..., 1, 1]
    x, y = off_m[..., 0], off_m[..., 1]
    return np.asarray((yy * x**2 - 2 * xy * x * y + xx * y**2) / (xx * yy - xy**2))


def coverage(off_m: Floats, cov_m2: Floats, level: float) -> float:
    """The share of errors that lie inside the ellipses of a probability. Calibrated forecasts have a share of
    ``level``.

    Parameters
    ----------
    off_m : array (..., 2), m
        Errors.
    cov_m2 : array (..., 2, 2), m^2
        Covariances of the forecasts.
    level : float
        Probability of the ellipses, between 0 and 1.

    Returns
    -------
    float
        Between 0 and 1.

    Examples
    --------
    >>> import numpy as np
    >>> coverage(np.array([[0.1, 0.0], [9.0, 0.0]]), np.tile(np.eye(2), (2, 1, 1)), 0.95)
    0.5
    """
    return float((mahalanobis_squared(off_m, cov_m2) <= -2 * np.log(1 - level)).mean())


def forecast_scores(mean_m: Floats, cov_m2: Floats, future_m: Floats) -> dict[str, float]:
    """Compare forecasts with the true future.

    Parameters
    ----------
    mean_m : array (N, T, 2), m
        Predicted positions.
    cov_m2 : array (N, T, 2, 2), m^2
        Their covariances.
    future_m : array (N, T, 2), m
        True positions.

    Returns
    -------
    dict
        ADE_m and FDE_m: mean Euclidean distance over all steps [1]_ and at the last step [2]_. ADE_squared_m2: mean
        squared distance, as in [3]_. NLL: mean negative log-likelihood of a step, in nats. coverage_P: share of the
        true positions inside the P % ellipses.

    References
    ----------
    .. [1] S. Pellegrini, A. Ess, K. Schindler, L. Van Gool: You'll Never Walk Alone: Modeling Social Behavior for
       Multi-Target Tracking. ICCV 2009.
    .. [2] A. Alahi, K. Goel, V. Ramanathan, A. Robicquet, L. Fei-Fei, S. Savarese: Social LSTM: Human Trajectory
       Prediction in Crowded Spaces. CVPR 2016.
    .. [3] S. Yu, H. Zhou: Re-tracking by prediction. IROS 2021.

    Examples
    --------
    >>> import numpy as np
    >>> future_m = np.zeros((1, 2, 2))
    >>> mean_m = np.array([[[3.0, 4.0], [6.0, 8.0]]])
    >>> found = forecast_scores(mean_m, np.tile(np.eye(2), (1, 2, 1, 1)), future_m)
    >>> found["ADE_m"], found["FDE_m"], found["coverage_95"]
    (7.5, 10.0, 0.0)
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
