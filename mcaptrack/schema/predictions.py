"""Predictions <-> rows of their channel. Letters: N tracks at one time, T future steps, R rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.mixtures import Tails
from mcaptrack.predictors import Forecast
from mcaptrack.schema import PREDICTIONS, Rows


def forecast_to_rows(ids: NDArray[np.int64], forecast: Forecast, step_s: float, tails: Tails | None = None) -> Rows:
    """Predictions of N tracks as N x T rows; ``tails`` (N, T) if they are mixtures."""
    count, steps = forecast.mean.shape[:2]
    step = np.tile(np.arange(1, steps + 1), count)
    mean, cov = forecast.mean.reshape(-1, 2), forecast.cov.reshape(-1, 2, 2)
    mixtures = {} if tails is None else {name: part.reshape(-1) for name, part in tails._asdict().items()}
    return PREDICTIONS.rows(
        track_id=np.repeat(ids, steps),
        step=step,
        ahead_s=step * step_s,
        x_m=mean[:, 0],
        y_m=mean[:, 1],
        cov_xx_m2=cov[:, 0, 0],
        cov_xy_m2=cov[:, 0, 1],
        cov_yy_m2=cov[:, 1, 1],
        **mixtures,
    )


def tails_of(rows: Rows, *shape: int) -> Tails:
    """The shapes of the distributions of R rows, reshaped to (-1, *shape) if a shape is given."""
    parts = (np.asarray(rows[name], np.float64) for name in Tails._fields)
    return Tails(*(part.reshape(-1, *shape) if shape else part for part in parts))
