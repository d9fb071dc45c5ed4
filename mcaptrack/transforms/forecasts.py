"""Predictions of tracks, frame by frame; shared by the transforms that predict."""

from __future__ import annotations

from typing import Any

import numpy as np

from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.histories import Histories
from mcaptrack.predictors import Forecast, make
from mcaptrack.schema import Frame, Rows
from mcaptrack.schema.predictions import forecast_to_rows
from mcaptrack.transforms.motion_limits import ClassNames, units_m


class Forecaster:
    """Keeps the past positions of tracks, and predicts the tracks that have enough of them.

    Parameters
    ----------
    predictor : str
        Name of the predictor (see ``mcaptrack.predictors``).
    horizon_s : float
        How far ahead to predict, in seconds.
    min_history : int
        Number of observed positions that a prediction needs, the current one included.
    rate_hz : float
        Rate of the frames.
    class_names : ClassNames
        Names of classes, by which the unit of their positions is chosen: predictors know the speeds of people.
    class_limits : str
        Limits of the motion of classes instead of those of the table, as the option of transforms.
    **options
        Own parameters of the predictor.
    """

    def __init__(
        self,
        predictor: str,
        horizon_s: float,
        min_history: int,
        rate_hz: float,
        class_names: ClassNames = (),
        class_limits: str = "",
        **options: Any,
    ) -> None:
        self._rate_hz, self._min_history = rate_hz, min_history
        self._class_names, self._class_limits = class_names, class_limits
        self._predictor = make(predictor, max(1, round(horizon_s * rate_hz)), 1 / rate_hz, **options)
        self._histories = Histories(max(self._predictor.past, min_history))
        self._last_ns: int | None = None

    def predict(self, frame: Frame) -> Rows:
        """Rows of Predictions for the tracks of a frame."""
        passed = 1
        if self._last_ns is not None:
            passed = max(1, round((frame.t_ns - self._last_ns) * self._rate_hz / NS_PER_S))
        self._last_ns = frame.t_ns
        ids = frame.rows["track_id"]
        past, known = self._histories.push(ids, np.stack([frame.rows["x_m"], frame.rows["y_m"]], axis=-1), passed)
        # An interpolated position depends on later ones: a prediction from it would not be causal.
        ready = known[:, -self._min_history :].all(axis=1) & frame.rows["observed"]
        classes, of = np.unique(frame.rows["class_id"][ready], return_inverse=True)
        unit_m = np.array(units_m(classes.tolist(), self._class_names, self._class_limits))[of][:, None, None]
        mean, cov = self._predictor.predict(past[ready] / unit_m, known[ready])
        forecast = Forecast(mean * unit_m, cov * unit_m[..., None] ** 2)
        return forecast_to_rows(ids[ready], forecast, self._predictor.step_s)
