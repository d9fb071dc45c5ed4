"""Predictions of tracks, frame by frame; shared by the transforms that predict."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Floats, Ints, taken
from mcaptrack.geometry.clocks import steps_passed
from mcaptrack.geometry.histories import Histories
from mcaptrack.geometry.mixtures import Tails, normal_tails
from mcaptrack.geometry.ragged import run_starts
from mcaptrack.predictors import Forecast, PeopleSeen, Predictor, make, predict_among, predict_together, uses_people
from mcaptrack.predictors.linear import LinearPredictor
from mcaptrack.predictors.position_noise import PAST
from mcaptrack.predictors.tail_calibration import TailCalibration, calibrated_vehicles
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Rows
from mcaptrack.schema.as_rows import forecast_to_rows
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import JoinedFrames, join_frames, spans_of
from mcaptrack.transforms.motion_limits import ClassNames, limits_by_class, units_m

#: The help of the option by which ellipses follow the log.
ADAPT_HELP: Final = "let ellipses follow the log: they grow or shrink by the errors of earlier predictions in it"
#: The number of tracks that are predicted at once: what is computed for them takes some kilobytes each.
_PART_ROWS: Final = 2048
#: Vehicles that stand mostly stay: their speed over this many steps, in units of length per second, up to which they
#: count as standing; the probability that they stay; and how far they seem to move then, in units per second.
_RECENT: Final = 7
_REST_PER_S: Final = 0.15
_STAYS: Final = 0.95
_CREEP_PER_S: Final = 0.03


class PastPositions(Protocol):
    """The pasts of tracks, as ``Histories`` keeps them."""

    def push(self, ids: Ints, xy_m: Floats, steps: int) -> tuple[Floats, Bools]:
        """Add the next positions; returns the past of each track, and which positions of it are known."""
        ...


class _Predicted(NamedTuple):
    """Forecasts of tracks (N,) as the predictor made them; which tracks have a velocity, and what their class says."""

    forecast: Forecast
    has_velocity: Bools
    unit_m: Floats
    noise_m: Floats
    kinds: NDArray[np.str_]

    @property
    def is_vehicle(self) -> Bools:
        """Which tracks were measured in metres, and are of a class that moves otherwise than people."""
        return np.asarray(self.has_velocity & (self.unit_m != 1))


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
    adapt : bool
        Whether ellipses follow the log.
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
        adapt: bool = True,
        **options: Any,
    ) -> None:
        self._name, self._rate_hz, self._min_history = predictor, rate_hz, min_history
        self._class_names, self._class_limits = class_names, class_limits
        self._predictor = make(predictor, max(1, round(horizon_s * rate_hz)), 1 / rate_hz, **options)
        self._calibration = TailCalibration.of(predictor, self._predictor, adapt)
        self._step = 0
        self._histories = histories(max(self._predictor.past, min_history))
        self._observed, self._observed_at = Histories(PAST), 0  # without interpolated positions; their last step
        self._last_ns: int | None = None

    def predict(self, frame: Frame) -> Rows:
        """Rows of Predictions for the tracks of a frame."""
        passed = self._passed(frame.t_ns)
        self._step += passed
        ids = frame.rows["track_id"]
        xy_m = np.stack([frame.rows["x_m"], frame.rows["y_m"]], axis=-1)
        past, is_known = self._histories.push(ids, xy_m, passed)
        # An interpolated position depends on later ones: a prediction from it would not be causal.
        ready = is_known[:, -self._min_history :].all(axis=1) & frame.rows["observed"]
        people = self._people(frame.rows, past, is_known, ready) if uses_people(self._predictor) else None
        forecasts = self._predicted(frame.rows[ready], past[ready], is_known[ready], people)
        tails = None
        if self._calibration is not None and not forecasts.has_velocity.any():
            count = len(forecasts.has_velocity)
            step, is_coasting = np.full(count, self._step), np.zeros(count, bool)
            observed_m, since = np.where(frame.rows["observed"][:, None], xy_m, np.nan), self._step - self._observed_at
            (observed, _), self._observed_at = self._observed.push(ids, observed_m, since), self._step
            inputs = forecasts.forecast, past[ready], is_coasting, observed[ready]
            forecast, tails = self._calibration(step, ids[ready], *inputs)
        elif forecasts.is_vehicle.any():
            forecast, tails = self._of_vehicles(forecasts, frame.rows[ready], past[ready])
        else:
            forecast = forecasts.forecast
        return forecast_to_rows(ids[ready], forecast, self._predictor.step_s, tails)

    def predict_all(self, frames: FrameColumns) -> FrameColumns:
        """Predict all frames of tracks, as ``predict`` does one of them.

        Many frames are predicted at a time if all rows have velocities, no id is twice in a frame, and the predictor is
        linear: the last digits of others depend on the size of a batch.
        """
        out = FrameCollector(PREDICTIONS)
        histories = self._histories if isinstance(self._predictor, LinearPredictor) else None
        for low, high in spans_of(frames.ends, _PART_ROWS):
            joined = join_frames(TRACKS, frames, low, high)
            has_velocities = bool(np.isfinite(joined.rows["vx_m_per_s"]).all())
            if isinstance(histories, Histories) and has_velocities and not _are_twice(joined):
                rows, ends = self._together(joined, histories)
            else:
                parts = [self.predict(frame) for frame in frames[low:high]]
                rows, ends = PREDICTIONS.joined(parts), np.cumsum([0, *map(len, parts)])
            out.extend(joined.t_ns, frames.numbers[low:high], ends, rows)
        return out.done()

    def warn(self) -> None:
        """Warn if ellipses became much larger than they began; to be called at the end."""
        if self._calibration is not None:
            self._calibration.warn(self._name)

    def _together(self, joined: JoinedFrames, histories: Histories) -> tuple[Rows, Ints]:
        """The predictions of some frames of tracks that have velocities, and where those of each frame end."""
        passed = np.array([self._passed(t_ns) for t_ns in joined.t_ns.tolist()], np.int64)
        self._step += int(passed.sum())
        ids, place = joined.rows["track_id"], np.stack([joined.rows["x_m"], joined.rows["y_m"]], axis=-1)
        past, is_known = histories.push_all(passed, joined.ends, ids, place)
        is_ready = is_known[:, -self._min_history :].all(axis=1) & joined.rows["observed"]
        ready = is_ready.nonzero()[0]
        rows, past = joined.rows.take(ready), past[ready]
        forecasts = self._predicted(rows, past, is_known[ready], None)
        forecast, tails = forecasts.forecast, None
        # As frame by frame: those of frames without a vehicle stay as they are, to the last digit.
        count = len(joined.t_ns)
        has_vehicle = np.bincount(joined.frame[ready], forecasts.is_vehicle, count)[joined.frame[ready]] > 0
        if has_vehicle.all():
            forecast, tails = self._of_vehicles(forecasts, rows, past)
        elif has_vehicle.any():
            here = has_vehicle.nonzero()[0]
            part, shapes = self._of_vehicles(taken(forecasts, here), rows.take(here), past[here])
            forecast.mean[here], forecast.cov[here] = part
            if shapes is not None:
                tails = normal_tails(forecast.mean.shape[:2])
                for whole, values in zip(tails, shapes, strict=True):
                    whole[here] = values
        ends = np.append(0, np.cumsum(np.bincount(joined.frame[ready], minlength=count))) * self._predictor.steps
        return forecast_to_rows(ids[ready], forecast, self._predictor.step_s, tails), ends

    def _passed(self, t_ns: int) -> int:
        """The number of steps from the frame before to this one, at least 1."""
        last_ns, self._last_ns = self._last_ns, t_ns
        return 1 if last_ns is None else steps_passed(t_ns - last_ns, self._rate_hz)

    def _predicted(self, rows: Rows, past: Floats, is_known: Bools, people: PeopleSeen | None) -> _Predicted:
        """The forecasts of tracks (N,) as the predictor makes them, in metres."""
        classes, of = np.unique(rows["class_id"], return_inverse=True)
        numbers = classes.tolist()
        unit_m = np.array(units_m(numbers, self._class_names, self._class_limits))[of]
        scale = unit_m[:, None, None]
        mean, cov = predict_among(self._predictor, past / scale, is_known, people)
        has_velocity = np.isfinite(rows["vx_m_per_s"])
        limits = limits_by_class(numbers, self._class_names, self._class_limits)
        noise_m = np.array([limits[number].noise_m for number in numbers])[of]
        kinds = np.array([limits[number].name for number in numbers])[of]
        return _Predicted(Forecast(mean * scale, cov * scale[..., None] ** 2), has_velocity, unit_m, noise_m, kinds)

    def _of_vehicles(self, forecasts: _Predicted, rows: Rows, past: Floats) -> tuple[Forecast, Tails | None]:
        """The forecasts of tracks (N,) in metres, of which vehicles may stay where they are, and are mixtures."""
        step_s = self._predictor.step_s
        stay = forecasts.is_vehicle * _standing(past, forecasts.unit_m, step_s)
        forecast = _with_rest(forecasts.forecast, past[:, -1], stay, forecasts.noise_m, forecasts.unit_m, step_s)
        speed = np.hypot(*(rows[name].astype(float) for name in ("vx_m_per_s", "vy_m_per_s")))
        return calibrated_vehicles(self._name, forecast, step_s, forecasts.kinds.tolist(), speed)

    def _people(self, rows: Rows, past: Floats, is_known: Bools, ready: Bools) -> PeopleSeen:
        """The people who are observed in a frame, for the tracks of it that are ``ready`` (N,).

        Positions are in the unit of the class, and only objects with the same unit are seen together.
        """
        seen = np.flatnonzero(rows["observed"] & is_known[:, -1])  # interpolated positions depend on later ones
        classes, of = np.unique(rows["class_id"][seen], return_inverse=True)
        unit_m = np.array(units_m(classes.tolist(), self._class_names, self._class_limits))[of]
        _, moment = np.unique(unit_m, return_inverse=True)
        row = np.searchsorted(seen, np.flatnonzero(ready))
        return PeopleSeen(past[seen] / unit_m[:, None, None], is_known[seen], moment, row)


def _are_twice(joined: JoinedFrames) -> bool:
    """Whether an id is twice in a frame."""
    order = np.lexsort((joined.rows["track_id"], joined.frame))
    return not run_starts(joined.rows["track_id"][order], joined.frame[order]).all()


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


# Predictions of online tracks, made for many tracks at once and calibrated step by step.
#
# Letters: R rows of online tracks, L past positions.


#: The number of tracks in a product of matrices: of larger ones threads would only wait for each other.
_BLOCK: Final = 32


class Unpredicted(NamedTuple):
    """Tracks without predictions yet: ids, past positions (R, L, 2), which are known, whether tracks coast, steps."""

    ids: Ints
    past: Floats
    known: Bools
    coasts: Bools
    step: Ints


class OnlineForecasts:
    """Predictions of the tracks of some frames at a time."""

    def __init__(self, predictor: str, horizon_s: float, rate_hz: float, adapt: bool, unit_m: float) -> None:
        self._name, self._unit_m = predictor, unit_m
        self._predictor: Predictor = make(predictor, max(1, round(horizon_s * rate_hz)), 1 / rate_hz)
        self._calibration = TailCalibration.of(predictor, self._predictor, adapt)
        self._out = FrameCollector(PREDICTIONS)

    @property
    def past(self) -> int:
        """The number of past positions that predictions are made from."""
        return self._predictor.past

    def add(self, t_ns: Ints, numbers: Ints, ends: Ints, tracks: Unpredicted) -> None:
        """Predict the tracks of frames, ``ends[f]`` to ``ends[f + 1]`` of frame f."""
        mean, cov = self._forecast(tracks.past / self._unit_m, tracks.known, tracks.step)
        forecast, tails = Forecast(mean * self._unit_m, cov * self._unit_m**2), None
        if self._calibration is not None:  # by the predictions of the steps before
            forecast, tails = self._calibration(tracks.step, tracks.ids, forecast, tracks.past, tracks.coasts)
        rows = forecast_to_rows(tracks.ids, forecast, self._predictor.step_s, tails)
        self._out.extend(t_ns, numbers, ends * self._predictor.steps, rows)

    def done(self) -> FrameColumns:
        """The predictions; nothing can be added any more."""
        if self._calibration is not None:
            self._calibration.warn(f"{self._name} from online tracks")
        return self._out.done()

    def _forecast(self, past: Floats, is_known: Bools, steps: Ints) -> Forecast:
        """The forecasts of tracks, step by step if the predictor looks at others.

        The last digits of a product of matrices depend on their size: all blocks have the same, the last one by
        repeating its last track, so that forecasts don't depend on later tracks.
        """
        count = len(steps)
        if uses_people(self._predictor):
            bounds = pairwise([*np.flatnonzero(run_starts(steps)), count])
            parts = [predict_together(self._predictor, past[low:high], is_known[low:high]) for low, high in bounds]
        else:
            blocks = np.minimum(np.arange(count + -count % _BLOCK), count - 1).reshape(-1, _BLOCK)
            parts = [self._predictor.predict(past[rows], is_known[rows]) for rows in blocks]
        nothing = Forecast(np.empty((0, self._predictor.steps, 2)), np.empty((0, self._predictor.steps, 2, 2)))
        return Forecast(*(np.concatenate(part)[:count] for part in zip(nothing, *parts, strict=True)))
