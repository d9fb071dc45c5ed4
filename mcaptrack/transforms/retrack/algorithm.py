"""Algorithm 1 of the paper over one log, step by step.

An observation is a sample with the forecast from its own past; its identity is dropped. A track is a forecast and an
age. Observations go to the tracks whose forecasts agree with theirs; a matched track is smoothed and foretells again;
an unmatched one ages.

Letters: K tracks, N observations, L past positions, T future steps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.assignment import assign
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.histories import Histories, Holt
from mcaptrack.predictors import Forecast, Predictor, make
from mcaptrack.schema import Frame, Rows
from mcaptrack.schema.predictions import forecast_to_rows
from mcaptrack.transforms.retrack.distance import jumps, to_forecasts, to_positions
from mcaptrack.transforms.retrack.motion import USUAL_NOISE_M
from mcaptrack.transforms.retrack.state import Motion, Tracks
from mcaptrack.transforms.retrack.whole import Claims

if TYPE_CHECKING:
    from mcaptrack.transforms.retrack import Retrack


#: What a certain pair costs: less than any number of others could make up for.
_CERTAIN_COST: Final = -100.0


class Forecasting:
    """Algorithm 1 over one log."""

    def __init__(self, options: Retrack) -> None:
        horizon = max(1, round(options.horizon_s * options.rate_hz))
        self._options = options
        self._predictor: Predictor = make(options.predictor, horizon, 1 / options.rate_hz)
        self._holt = Holt(options.alpha, options.beta)
        self._length = max(self._predictor.past, options.min_history, 2)
        self._histories = Histories(self._length)
        self._tracks = Tracks.none(self._length, horizon)
        self.claims = Claims()
        self.samples: list[Rows] = []
        self._outputs: list[tuple[Frame, Frame]] = []
        self.noise_m = USUAL_NOISE_M if options.noise_m is None else options.noise_m
        self._next_id = 1
        self._last_ns: int | None = None
        self.steps: list[int] = []

    def tick(self, frame: Frame) -> None:
        """One step: match, update, age, start, remove."""
        passed = 1
        if self._last_ns is not None:
            passed = max(1, round((frame.t_ns - self._last_ns) * self._options.rate_hz / NS_PER_S))
        self._last_ns = frame.t_ns
        step = self.steps[-1] + passed if self.steps else 0
        self.steps.append(step)
        self.samples.append(frame.rows)

        sources = frame.rows["track_id"]
        past, valid = self._histories.push(sources, np.stack([frame.rows["x_m"], frame.rows["y_m"]], axis=-1), passed)
        usable = valid[:, -self._options.min_history :].all(axis=1)
        if not self._options.filled:
            usable &= frame.rows["observed"]
        row_at = np.flatnonzero(usable)
        past, valid = past[usable], valid[usable]
        valid = np.minimum.accumulate(valid[:, ::-1], axis=1)[:, ::-1]  # the unbroken run up to now
        seen = self._predictor.predict(past, valid)

        track, observation = self._match(step, past[:, -1], seen, sources[row_at])
        self._update(step, track, past[observation, -1], sources[row_at[observation]])
        self.claims.add(step, self._tracks.ids[track], sources[row_at[observation]])
        if self._options.confirm:
            self.claims.confirm(step, self._tracks.ids[track[self._tracks.hits[track] >= self._options.min_hits]])
        new = np.setdiff1d(np.arange(len(row_at)), observation)
        self._start(step, past[new], valid[new], Forecast(seen.mean[new], seen.cov[new]), sources[row_at[new]])
        online = self._online(frame, step, np.concatenate([row_at[observation], row_at[new]]), track, len(new))
        too_old = (step - self._tracks.seen_step) / self._options.rate_hz > self._options.max_age_s + 1e-9
        self._tracks = self._tracks[~too_old]
        self._outputs.append(online)

    def outputs(self) -> list[tuple[Frame, Frame]]:
        """What was known at each step: online tracks and their forecasts."""
        return self._outputs

    def _match(
        self, step: int, xy_m: Floats, seen: Forecast, sources: Ints
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Pairs of tracks and observations (line 4 of Algorithm 1)."""
        options, tracks = self._options, self._tracks
        age = step - tracks.seen_step
        sigma_m = options.sigma_m if options.covariance == "paper" else None
        kind = options.distance
        if kind == "now" or kind == "likelihood":  # noqa: PLR1714 - so that mypy knows the others
            distance = to_positions(tracks.forecast, age, xy_m, self.noise_m, sigma_m)
        else:
            distance = to_forecasts(tracks.forecast, age, seen, kind, sigma_m)
        # Forecasts differ in the last digits with the size of the batch; who goes with whom must not.
        distance = np.round(distance, 6)
        cost = np.where(distance <= options.max_distance, distance, np.inf)
        if options.max_jump_m is not None:
            cost = np.where(jumps(tracks.forecast, age, xy_m) <= options.max_jump_m, cost, np.inf)
        cost = np.where(distance < options.certain_distance, _CERTAIN_COST, cost)
        cost = cost - options.same_source * (tracks.source[:, None] == sources[None])
        return assign(cost, np.finfo(float).max)

    def _update(self, step: int, track: NDArray[np.intp], xy_m: Floats, sources: Ints) -> None:
        """Lines 5 to 12: matched tracks are smoothed and foretell again; the others age."""
        tracks = self._tracks
        motion = tracks[track].motion
        motion.see(self._holt, xy_m, step - tracks.seen_step[track])
        forecast = self._predictor.predict(*motion.past())
        for name, value in vars(motion).items():
            getattr(tracks.motion, name)[track] = value
        tracks.forecast.mean[track], tracks.forecast.cov[track] = forecast
        missed = np.ones(len(tracks.ids), bool)
        missed[track] = False
        tracks.hits = np.where(missed, 0, tracks.hits + 1)
        tracks.seen_step[track], tracks.source[track] = step, sources

    def _start(self, step: int, past: Floats, valid: NDArray[np.bool_], seen: Forecast, sources: Ints) -> None:
        """Lines 13 to 15: what nobody matched starts a track, with the forecast it came with."""
        count = len(past)
        ids = np.arange(self._next_id, self._next_id + count)
        self._next_id += count
        raw = self._options.birth == "raw"
        motion = Motion.along(self._holt, past, valid)
        forecast = seen if raw else self._predictor.predict(*motion.past())
        hits = np.zeros(count, np.int64)
        self._tracks = self._tracks + Tracks(ids, np.full(count, step), hits, sources.copy(), motion, forecast)
        self.claims.add(step, ids, sources)
        if self._options.confirm:
            self.claims.confirm(step, ids)
        if self._options.backfill != "none":
            who, back = np.nonzero(valid[:, :-1][:, ::-1][:, : max(self._options.min_history, 4) - 1])
            self.claims.add(step - 1 - back, ids[who], sources[who])

    def _online(
        self, frame: Frame, step: int, row_at: NDArray[np.intp], track: NDArray[np.intp], born: int
    ) -> tuple[Frame, Frame]:
        """The tracks seen now that have been hit often enough, where they were seen, and their forecasts."""
        total = len(self._tracks.ids)
        at = np.concatenate([track, np.arange(total - born, total)])
        shown = self._tracks.hits[at] >= self._options.min_hits
        at, row_at = at[shown], row_at[shown]
        order = np.argsort(self._tracks.ids[at], kind="stable")
        at, row_at = at[order], row_at[order]
        rows = frame.rows[row_at].copy()
        rows["source_id"] = rows["track_id"]
        rows["track_id"] = self._tracks.ids[at]
        forecast = Forecast(self._tracks.forecast.mean[at], self._tracks.forecast.cov[at])
        predictions = forecast_to_rows(rows["track_id"], forecast, self._predictor.step_s)
        return Frame(frame.t_ns, frame.index, rows), Frame(frame.t_ns, frame.index, predictions)
