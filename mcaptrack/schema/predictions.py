"""Predictions -> rows of their channel. Letters: N tracks at one time, T future steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mcaptrack.predictors import Forecast
from mcaptrack.schema import PREDICTIONS, Rows


def forecast_to_rows(ids: NDArray[np.int64], forecast: Forecast, step_s: float) -> Rows:
    """Predictions of N tracks as N x T rows."""
    count, steps = forecast.mean.shape[:2]
    step = np.tile(np.arange(1, steps + 1), count)
    mean, cov = forecast.mean.reshape(-1, 2), forecast.cov.reshape(-1, 2, 2)
    return PREDICTIONS.rows(
        track_id=np.repeat(ids, steps),
        step=step,
        ahead_s=step * step_s,
        x_m=mean[:, 0],
        y_m=mean[:, 1],
        cov_xx_m2=cov[:, 0, 0],
        cov_xy_m2=cov[:, 0, 1],
        cov_yy_m2=cov[:, 1, 1],
    )
