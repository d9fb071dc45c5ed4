"""Re-tracking by prediction consistency: Algorithm 1 of the paper over one log, step by step.

An observation is a sample with a prediction from its own past; its input id is dropped. A track is a prediction and an
age. Observations are assigned to the tracks with similar predictions; a matched track is smoothed and predicts again;
an unmatched one ages.

Letters: K tracks, N observations, L past positions, T predicted steps.
"""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Floats, Indices, Ints, joined, taken
from mcaptrack.geometry.assignment import assign
from mcaptrack.geometry.histories import Histories, Holt, SmoothedHistory
from mcaptrack.geometry.mixtures import mahalanobis_squared
from mcaptrack.predictors import Forecast, Predictor, make, predict_together
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.as_rows import forecast_to_rows
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.transforms.retrack.motion_model import DEFAULT_NOISE_M
from mcaptrack.transforms.retrack.options import ConsistencyOptions
from mcaptrack.transforms.retrack.passes import Movers, OnlinePass

#: Cost of a pair with priority: lower than any sum of other costs.
_PRIORITY_COST: Final = -100.0


class ActiveTracks(NamedTuple):
    """K active tracks: step of the last match, number of matches in a row (``hits``), input id of the last one.

    ``prediction`` is that made at the last match.
    """

    ids: Ints
    last_step: Ints
    hits: Ints
    source: Ints
    history: SmoothedHistory
    prediction: Forecast


class ConsistencyPass(OnlinePass):
    """Algorithm 1 over one log."""

    def __init__(self, options: ConsistencyOptions, _: Movers, frames: FrameColumns) -> None:
        horizon = max(1, round(options.horizon_s * options.rate_hz))
        if horizon == 1:
            raise McaptrackError(
                f"horizon_s {options.horizon_s:g} is one step at {options.rate_hz:g} Hz; predictions of one time made "
                f"at different steps are compared, which takes {2 / options.rate_hz:g} s at least"
            )
        super().__init__(frames, options.rate_hz, options.bridged_s)
        self._options = options
        self._predictor: Predictor = make(options.predictor, horizon, 1 / options.rate_hz)
        self._holt = Holt(options.alpha, options.beta)
        self._length = max(self._predictor.past, options.min_history, 2)
        self._histories = Histories(self._length)
        none, nothing = np.empty(0, np.int64), np.empty((0, self._length, 2))
        history = SmoothedHistory.of_observations(self._holt, nothing, np.empty((0, self._length), bool))
        forecast = Forecast(np.empty((0, horizon, 2)), np.empty((0, horizon, 2, 2)))
        self._tracks = ActiveTracks(none, none, none, none, history, forecast)
        self.noise_m = DEFAULT_NOISE_M if options.noise_m is None else options.noise_m
        self._online = FrameCollector(TRACKS), FrameCollector(PREDICTIONS)
        self._next_id = 1
        for frame, step, passed in zip(frames, self.steps.tolist(), self.passed.tolist(), strict=True):
            self._step(frame, step, passed)

    def _step(self, frame: Frame, step: int, passed: int) -> None:
        """One step: associate, update, age, start and terminate tracks."""
        sources = frame.rows["track_id"]
        past, valid = self._histories.push(sources, np.stack([frame.rows["x_m"], frame.rows["y_m"]], axis=-1), passed)
        usable = valid[:, -self._options.min_history :].all(axis=1)
        if not self._options.interpolated:
            usable &= frame.rows["observed"]
        row_at = np.flatnonzero(usable)
        past, valid = past[usable], valid[usable]
        valid = np.minimum.accumulate(valid[:, ::-1], axis=1)[:, ::-1]  # the unbroken run up to now
        predictions = predict_together(self._predictor, past, valid)

        track, observation = self._match(step, past[:, -1], predictions, sources[row_at])
        self._update(step, track, past[observation, -1], sources[row_at[observation]])
        self.assignments.add(step, self._tracks.ids[track], sources[row_at[observation]])
        if self._options.trim_ends:
            is_confirmed = self._tracks.hits[track] >= self._options.min_hits
            self.assignments.confirm(step, self._tracks.ids[track[is_confirmed]])
        new = np.setdiff1d(np.arange(len(row_at)), observation)
        raw = Forecast(predictions.mean[new], predictions.cov[new])
        self._start(step, past[new], valid[new], raw, sources[row_at[new]])
        online = self._shown(frame, np.concatenate([row_at[observation], row_at[new]]), track, len(new))
        is_over = (step - self._tracks.last_step) / self._options.rate_hz > self._options.max_age_s + 1e-9
        self._tracks = taken(self._tracks, ~is_over)
        for collector, rows in zip(self._online, online, strict=True):
            collector.append(rows)

    def outputs(self) -> tuple[FrameColumns, FrameColumns]:
        return self._online[0].done(), self._online[1].done()

    def _match(self, step: int, xy_m: Floats, predictions: Forecast, sources: Ints) -> tuple[Indices, Indices]:
        """Data association: pairs of tracks and observations within the gates (line 4 of Algorithm 1)."""
        options, tracks = self._options, self._tracks
        age = step - tracks.last_step
        sigma_m = options.sigma_m if options.covariance == "paper" else None
        distance = prediction_distances(tracks.prediction, age, predictions, options.distance, sigma_m)
        # The last digits of predictions depend on the size of the batch; assignments must not.
        distance = np.round(distance, 6)
        cost = np.where(distance <= options.max_distance, distance, np.inf)
        if options.gate_m is not None:
            cost = np.where(metric_distances(tracks.prediction, age, xy_m) <= options.gate_m, cost, np.inf)
        cost = np.where(distance < options.priority_distance, _PRIORITY_COST, cost)
        cost = cost - options.same_id_bonus * (tracks.source[:, None] == sources[None])
        return assign(cost, np.finfo(float).max)

    def _update(self, step: int, track: Indices, xy_m: Floats, sources: Ints) -> None:
        """Lines 5 to 12: matched tracks are smoothed and predict again; the others age (coasting)."""
        tracks = self._tracks
        history = taken(tracks.history, track).extended(self._holt, xy_m, step - tracks.last_step[track])
        prediction = predict_together(self._predictor, *history.positions())
        for values, new in zip(tracks.history, history, strict=True):
            values[track] = new
        tracks.prediction.mean[track], tracks.prediction.cov[track] = prediction
        is_missed = np.ones(len(tracks.ids), bool)
        is_missed[track] = False
        tracks.hits[:] = np.where(is_missed, 0, tracks.hits + 1)
        tracks.last_step[track], tracks.source[track] = step, sources

    def _start(self, step: int, past: Floats, valid: Bools, raw: Forecast, sources: Ints) -> None:
        """Birth (lines 13 to 15): unmatched observations start tracks, with ``raw`` or smoothed predictions."""
        count = len(past)
        ids = np.arange(self._next_id, self._next_id + count)
        self._next_id += count
        history = SmoothedHistory.of_observations(self._holt, past, valid)
        prediction = raw if self._options.birth == "raw" else predict_together(self._predictor, *history.positions())
        hits = np.zeros(count, np.int64)
        new = ActiveTracks(ids, np.full(count, step), hits, sources.copy(), history, prediction)
        self._tracks = joined([self._tracks, new])
        self.assignments.add(step, ids, sources)
        if self._options.trim_ends:
            self.assignments.confirm(step, ids)
        if self._options.backfill != "none":
            track, back = np.nonzero(valid[:, :-1][:, ::-1][:, : max(self._options.min_history, 4) - 1])
            self.assignments.add(step - 1 - back, ids[track], sources[track])

    def _shown(self, frame: Frame, row_at: Indices, track: Indices, started: int) -> tuple[Frame, Frame]:
        """The tracks of this step with enough matches, where they were observed, and their predictions."""
        total = len(self._tracks.ids)
        at = np.concatenate([track, np.arange(total - started, total)])
        is_shown = self._tracks.hits[at] >= self._options.min_hits
        at, row_at = at[is_shown], row_at[is_shown]
        order = np.argsort(self._tracks.ids[at], kind="stable")
        at, row_at = at[order], row_at[order]
        rows = frame.rows[row_at].copy()
        rows["source_id"] = rows["track_id"]
        rows["track_id"] = self._tracks.ids[at]
        prediction = taken(self._tracks.prediction, at)
        predictions = forecast_to_rows(rows["track_id"], prediction, self._predictor.step_s)
        return Frame(frame.t_ns, frame.index, rows), Frame(frame.t_ns, frame.index, predictions)


# Distances between tracks and observations, by comparing their predictions (Eq. 1 and 2 of the paper).
#
# Letters: K tracks, N observations, T predicted steps.


def paper_covariance(first: Ints, steps: int, sigma_m: float) -> Floats:
    """The paper's covariance, (u - t) sigma^2 per axis, for ``steps`` steps u from t + ``first``; (K, steps, 2, 2)."""
    ahead = first[:, None] + np.arange(steps)
    return ahead[:, :, None, None] * (sigma_m**2 * np.eye(2))


def prediction_distances(
    tracks: Forecast, age: Ints, observations: Forecast, kind: Literal["mean", "max"], sigma_m: float | None
) -> Floats:
    """Distances (K, N) between predictions of tracks, made ``age`` (K,) steps ago, and of observations, made now.

    Eq. 2 averages over the steps that both predict ("mean"); the authors' program takes the largest ("max").
    ``sigma_m`` uses the paper's covariance, None that of the predictions. Infinite where no steps overlap.
    """
    horizon = observations.mean.shape[1]
    steps = max(horizon - int(age.min(initial=horizon)), 0)
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
    squared = mahalanobis_squared(off, track_cov[:, None] + observation_cov[None])  # Eq. 1
    distance = np.sqrt(np.maximum(squared, 0.0))
    counted = np.broadcast_to(overlaps[:, None], distance.shape)
    if kind == "mean":
        total = np.where(counted, distance, 0.0).sum(axis=-1)
        count = counted.sum(axis=-1)
        return np.where(count > 0, total / np.maximum(count, 1), np.inf)
    return np.where(counted.any(axis=-1), np.where(counted, distance, -np.inf).max(axis=-1, initial=-np.inf), np.inf)


def metric_distances(tracks: Forecast, age: Ints, xy_m: Floats) -> Floats:
    """Distances (K, N) in metres between where tracks are expected now and positions (N, 2); NaN beyond the horizon."""
    horizon = tracks.mean.shape[1]
    now = tracks.mean[np.arange(len(age)), np.minimum(age, horizon) - 1]
    off = np.where((age <= horizon)[:, None], now, np.nan)[:, None] - xy_m[None]
    return np.asarray(np.hypot(off[..., 0], off[..., 1]))
