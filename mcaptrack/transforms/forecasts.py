"""Predictions of tracks, frame by frame; shared by the transforms that predict."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Protocol

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.histories import Histories
from mcaptrack.predictors import Forecast, PeopleSeen, make, predict_among, uses_people
from mcaptrack.predictors.tails import TailCalibration
from mcaptrack.predictors.vehicle_tails import calibrated
from mcaptrack.schema import Frame, Rows
from mcaptrack.schema.predictions import forecast_to_rows
from mcaptrack.transforms.motion_limits import ClassNames, limits_by_class, units_m

#: Vehicles that stand mostly stay: their speed over this many steps, in units of length per second, up to which they
#: count as standing; the probability that they stay; and how far they seem to move then, in units per second.
_RECENT: Final = 7
_REST_PER_S: Final = 0.15
_STAYS: Final = 0.95
_CREEP_PER_S: Final = 0.03


class PastPositions(Protocol):
    """The pasts of tracks, as ``Histories`` keeps them."""

    def push(self, ids: Ints, xy_m: Floats, steps: int = 1) -> tuple[Floats, Bools]:
        """Add the next positions; returns the past of each track, and which positions of it are known."""
        ...


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
    histories : callable
        Called with the number of past positions that are needed; keeps them.
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
        histories: Callable[[int], PastPositions] = Histories,
        **options: Any,
    ) -> None:
        self._name, self._rate_hz, self._min_history = predictor, rate_hz, min_history
        self._class_names, self._class_limits = class_names, class_limits
        self._predictor = make(predictor, max(1, round(horizon_s * rate_hz)), 1 / rate_hz, **options)
        self._calibration = TailCalibration.of(predictor, self._predictor)
        self._step = 0
        self._histories = histories(max(self._predictor.past, min_history))
        self._last_ns: int | None = None

    def predict(self, frame: Frame) -> Rows:
        """Rows of Predictions for the tracks of a frame."""
        passed = 1
        if self._last_ns is not None:
            passed = max(1, round((frame.t_ns - self._last_ns) * self._rate_hz / NS_PER_S))
        self._last_ns = frame.t_ns
        self._step += passed
        ids = frame.rows["track_id"]
        past, known = self._histories.push(ids, np.stack([frame.rows["x_m"], frame.rows["y_m"]], axis=-1), passed)
        # An interpolated position depends on later ones: a prediction from it would not be causal.
        ready = known[:, -self._min_history :].all(axis=1) & frame.rows["observed"]
        classes, of = np.unique(frame.rows["class_id"][ready], return_inverse=True)
        numbers = classes.tolist()
        unit_m = np.array(units_m(numbers, self._class_names, self._class_limits))[of]
        scale = unit_m[:, None, None]
        people = self._people(frame.rows, past, known, ready) if uses_people(self._predictor) else None
        mean, cov = predict_among(self._predictor, past[ready] / scale, known[ready], people)
        forecast = Forecast(mean * scale, cov * scale[..., None] ** 2)
        tails = None
        has_velocity = np.isfinite(frame.rows["vx_m_per_s"][ready])
        is_measured = has_velocity & (unit_m != 1)
        if self._calibration is not None and not has_velocity.any():
            is_coasting = np.zeros(len(has_velocity), bool)
            forecast, tails = self._calibration(self._step, ids[ready], forecast, past[ready], is_coasting)
        elif is_measured.any():
            limits = limits_by_class(numbers, self._class_names, self._class_limits)
            noise_m = np.array([limits[one].noise_m for one in numbers])[of]
            stay = is_measured * _standing(past[ready], unit_m, self._predictor.step_s)
            forecast = _with_rest(forecast, past[ready][:, -1], stay, noise_m, unit_m, self._predictor.step_s)
            speed = np.hypot(*(frame.rows[name][ready].astype(float) for name in ("vx_m_per_s", "vy_m_per_s")))
            kinds = [limits[numbers[one]].name for one in of.tolist()]
            forecast, tails = calibrated(self._name, forecast, self._predictor.step_s, kinds, speed)
        return forecast_to_rows(ids[ready], forecast, self._predictor.step_s, tails)

    def _people(self, rows: Rows, past: Floats, known: Bools, ready: Bools) -> PeopleSeen:
        """The people who are observed in a frame, for the tracks of it that are ``ready`` (N,).

        Positions are in the unit of the class, and only objects with the same unit are seen together.
        """
        there = np.flatnonzero(rows["observed"] & known[:, -1])  # interpolated positions depend on later ones
        classes, of = np.unique(rows["class_id"][there], return_inverse=True)
        unit_m = np.array(units_m(classes.tolist(), self._class_names, self._class_limits))[of]
        _, moment = np.unique(unit_m, return_inverse=True)
        row = np.searchsorted(there, np.flatnonzero(ready))
        return PeopleSeen(past[there] / unit_m[:, None, None], known[there], moment, row)


def _standing(past: Floats, unit_m: Floats, step_s: float) -> Floats:
    """The probability that objects at ``past`` (N, L, 2), known at the end, stand and stay where they are, (N,)."""
    recent = past[:, -_RECENT - 1 :]
    first = np.isfinite(recent[:, :, 0]).argmax(axis=1)
    steps = np.maximum(recent.shape[1] - 1 - first, 1)
    way = recent[:, -1] - recent[np.arange(len(recent)), first]
    speed = np.hypot(way[:, 0], way[:, 1]) / (steps * step_s * unit_m)
    return np.asarray(_STAYS * np.exp(-((speed / _REST_PER_S) ** 2)) * (steps > 1))


def _with_rest(
    forecast: Forecast, now: Floats, stay: Floats, noise_m: Floats, unit_m: Floats, step_s: float
) -> Forecast:
    """Forecasts of objects at ``now`` (N, 2) that stay there with a probability (N,): mean and covariance of both."""
    ahead_s = step_s * np.arange(1, forecast.mean.shape[1] + 1)
    rest = noise_m[:, None] ** 2 + (_CREEP_PER_S * unit_m[:, None] * ahead_s) ** 2
    p, q = stay[:, None, None, None], 1 - stay[:, None, None, None]
    off = forecast.mean - now[:, None]
    cov = p * rest[:, :, None, None] * np.eye(2) + q * forecast.cov
    cov += p * q * off[..., :, None] * off[..., None, :]
    return Forecast(now[:, None] + q[..., 0] * off, cov)
