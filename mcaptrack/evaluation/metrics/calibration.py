"""Scores of forecasts when the true future is known: displacement errors, likelihood, and calibration.

Letters: N forecasts, T future steps.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.mixtures import Tails, log_density, mahalanobis_squared, mass_within, normal_tails

#: The probabilities of the ellipses for which reliability is reported.
RELIABILITY_LEVELS: Final = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
#: Those of them that tables have columns for.
LEVELS: Final = (0.5, 0.9, 0.95)


def ellipse_levels(off_m: Floats, cov_m2: Floats, tails: Tails) -> Floats:
    """The probabilities of the smallest ellipses that hold errors: uniform from 0 to 1 if forecasts are calibrated.

    Parameters
    ----------
    off_m : array (..., 2), m
        Errors.
    cov_m2 : array (..., 2, 2), m^2
        Covariances of the forecasts.
    tails : Tails (...)
        Shapes of their distributions.

    Returns
    -------
    array (...)
        NaN where the covariance is not known.

    Examples
    --------
    >>> import numpy as np
    >>> cov_m2 = np.tile(np.eye(2), (2, 1, 1))
    >>> ellipse_levels(np.array([[0.0, 0.0], [3.0, 0.0]]), cov_m2, normal_tails(2)).round(3).tolist()
    [0.0, 0.989]
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = mahalanobis_squared(off_m, cov_m2)
    return np.where(np.isfinite(squared), mass_within(squared, tails), np.nan)


def negative_log_likelihood(off_m: Floats, cov_m2: Floats, tails: Tails) -> Floats:
    """The negative log-likelihood of errors, in nats; of errors in metres, so that smaller ellipses can be below 0.

    Parameters
    ----------
    off_m : array (..., 2), m
        Errors.
    cov_m2 : array (..., 2, 2), m^2
        Covariances of the forecasts.
    tails : Tails (...)
        Shapes of their distributions.

    Returns
    -------
    array (...)
        NaN where the covariance is not known.

    Examples
    --------
    >>> import numpy as np
    >>> negative_log_likelihood(np.zeros((1, 2)), np.eye(2)[None], normal_tails(1)).round(3).tolist()
    [1.838]
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = mahalanobis_squared(off_m, cov_m2)
        log_area = np.log(cov_m2[..., 0, 0] * cov_m2[..., 1, 1] - cov_m2[..., 0, 1] ** 2) / 2
    return np.where(np.isfinite(squared), -log_density(squared, log_area, tails), np.nan)


def coverage(off_m: Floats, cov_m2: Floats, level: float, tails: Tails | None = None) -> float:
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
    tails : Tails (...), optional
        Shapes of the distributions; normal distributions if left out.

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
    shapes = normal_tails(off_m.shape[:-1]) if tails is None else tails
    return float((ellipse_levels(off_m, cov_m2, shapes) <= level).mean())


def forecast_scores(mean_m: Floats, cov_m2: Floats, future_m: Floats, tails: Tails | None = None) -> dict[str, float]:
    """Compare forecasts with the true future.

    Parameters
    ----------
    mean_m : array (N, T, 2), m
        Predicted positions.
    cov_m2 : array (N, T, 2, 2), m^2
        Their covariances.
    future_m : array (N, T, 2), m
        True positions.
    tails : Tails (N, T), optional
        Shapes of the distributions; normal distributions if left out.

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
    shapes = normal_tails(away.shape) if tails is None else tails
    return {
        "ADE_m": float(away.mean()),
        "FDE_m": float(away[:, -1].mean()),
        "ADE_squared_m2": float((away**2).mean()),
        "NLL": float(negative_log_likelihood(off, cov_m2, shapes).mean()),
        **{f"coverage_{100 * level:g}": coverage(off, cov_m2, level, shapes) for level in LEVELS},
    }
