"""Samples -> re-tracked tracks: re-tracking by prediction (Yu and Zhou, IROS 2021, Algorithm 1).

An observation is a sample with the forecast from its own past; its identity is dropped. A track is a forecast and an
age. Observations go to the tracks whose forecasts agree with theirs; a matched track is smoothed and foretells again;
an unmatched one ages. Three readings are offered by name, see ``PROFILES``.

Letters: K tracks, N observations, L past positions, T future steps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.clock import NS_PER_S
from mcaptrack.history import Histories, Holt
from mcaptrack.match import assign
from mcaptrack.predictors import Forecast, Predictor, PredictorName, make
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Rows, Schema
from mcaptrack.schema.predictions import forecast_to_rows
from mcaptrack.transforms.protocol import check_options, context, option
from mcaptrack.transforms.retrack.distance import Covariance, Distance, jumps, to_forecasts, to_positions
from mcaptrack.transforms.retrack.state import Motion, Tracks
from mcaptrack.transforms.retrack.whole import Claims, whole_tracks

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: What a certain pair costs: less than any number of others could make up for.
_CERTAIN_COST: Final = -100.0


@dataclass(frozen=True, kw_only=True)
class Retrack:
    """Repair tracks by what is foretold of them (re-tracking by prediction).

    Reads samples; writes the repaired tracks of the whole log, the same as they were known at the time (online), and
    the forecasts of these.
    """

    predictor: PredictorName = option("kalman", "what predicts: cv, holt-cv or kalman")
    horizon_s: float = option(4.8, "how far ahead", least=0.1, most=60.0)
    distance: Distance = option(
        "now",
        "what is compared: the mean, max or first of the foretold steps, or the expected and the seen position now",
    )
    covariance: Covariance = option("predictor", "whose uncertainty: the predictor's, or the paper's (u - t) sigma^2")
    sigma_m: float = option(1.0, "the paper's sigma", least=1e-6)
    noise_m: float = option(0.5, "noise of a seen position, for distance now", least=0.0)
    max_distance: float = option(
        2.5, "a track and an observation further apart than this (d_min) are not matched", least=0.0
    )
    certain_distance: float = option(
        0.0, "a pair nearer than this is matched before all others; 0 for never", least=0.0
    )
    max_jump_m: float | None = option(
        3.0, "a track is not matched further than this from where it is expected now", least=0.0
    )
    same_source: float = option(
        1.0,
        "how much nearer a pair counts if the input gives it the id that the track had last; the paper drops ids",
        least=0.0,
    )
    max_age_s: float = option(4.8, "a track is dropped after so long without an observation (t_max)", least=0.0)
    alpha: float = option(1.0, "smoothing of displacements, Eq. 3; 1 for none", least=0.0, most=1.0)
    beta: float = option(0.0, "smoothing of their trend, Eq. 3", least=0.0, most=1.0)
    birth: Literal["raw", "smoothed"] = option("raw", "what a new track foretells from: its past as seen, or smoothed")
    min_history: int = option(2, "past positions (with the present one) that an observation needs", least=1)
    min_hits: int = option(1, "a track is shown online from so many matches in a row", least=0)
    min_track_s: float = option(2.0, "a track that lasts less than this is left out (probation)", least=0.0)
    backfill: Literal["none", "unclaimed", "all"] = option(
        "unclaimed", "whether a new track gets the past of its first observation, and also what other tracks hold"
    )
    filled: bool = option(False, "take samples inside holes of the input for observations too")
    rate_hz: float = context(lambda: 2.5)

    reads: ClassVar[Schema] = TRACKS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType(
        {"": TRACKS, "online": TRACKS, "predictions": PREDICTIONS}
    )
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": float("inf"), "online": 0.0, "predictions": 0.0})

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        run = _Run(self)
        ticks = [run.tick(frame) for frame in frames]
        rows, step = run.whole()
        first, last = (np.searchsorted(step, run.steps, side) for side in ("left", "right"))
        for (online, predictions), low, high in zip(ticks, first.tolist(), last.tolist(), strict=True):
            yield Frame(online.t_ns, online.index, rows[low:high]), online, predictions


class _Run:
    """Algorithm 1 over one log."""

    def __init__(self, options: Retrack) -> None:
        horizon = max(1, round(options.horizon_s * options.rate_hz))
        self._options = options
        self._predictor: Predictor = make(options.predictor, horizon, 1 / options.rate_hz)
        self._holt = Holt(options.alpha, options.beta)
        self._length = max(self._predictor.past, options.min_history, 2)
        self._histories = Histories(self._length)
        self._tracks = Tracks.none(self._length, horizon)
        self._claims = Claims()
        self._samples: list[Rows] = []
        self._next_id = 1
        self._last_ns: int | None = None
        self.steps: list[int] = []

    def tick(self, frame: Frame) -> tuple[Frame, Frame]:
        """One step: match, update, age, start, remove. Returns what is known now: online tracks and their forecasts."""
        passed = 1
        if self._last_ns is not None:
            passed = max(1, round((frame.t_ns - self._last_ns) * self._options.rate_hz / NS_PER_S))
        self._last_ns = frame.t_ns
        step = self.steps[-1] + passed if self.steps else 0
        self.steps.append(step)
        self._samples.append(frame.rows)

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
        self._claims.add(step, self._tracks.ids[track], sources[row_at[observation]])
        new = np.setdiff1d(np.arange(len(row_at)), observation)
        self._start(step, past[new], valid[new], Forecast(seen.mean[new], seen.cov[new]), sources[row_at[new]])
        online = self._online(frame, step, np.concatenate([row_at[observation], row_at[new]]), track, len(new))
        too_old = (step - self._tracks.seen_step) / self._options.rate_hz > self._options.max_age_s + 1e-9
        self._tracks = self._tracks[~too_old]
        return online

    def _match(
        self, step: int, xy_m: Floats, seen: Forecast, sources: Ints
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Pairs of tracks and observations (line 4 of Algorithm 1)."""
        options, tracks = self._options, self._tracks
        if len(tracks.ids) == 0 or len(xy_m) == 0:
            return np.empty(0, np.intp), np.empty(0, np.intp)
        age = step - tracks.seen_step
        sigma_m = options.sigma_m if options.covariance == "paper" else None
        if options.distance == "now":
            distance = to_positions(tracks.forecast, age, xy_m, options.noise_m, sigma_m)
        else:
            distance = to_forecasts(tracks.forecast, age, seen, options.distance, sigma_m)
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
        self._claims.add(step, ids, sources)
        if self._options.backfill != "none":
            who, back = np.nonzero(valid[:, :-1][:, ::-1][:, : max(self._options.min_history, 4) - 1])
            self._claims.add(step - 1 - back, ids[who], sources[who])

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

    def whole(self) -> tuple[Rows, Ints]:
        """The tracks of the whole log: rows ordered by step and id, and the step of each."""
        options = self._options
        samples = np.concatenate(self._samples) if self._samples else TRACKS.empty()
        sample_step = np.repeat(np.array(self.steps, np.int64), [len(part) for part in self._samples])
        min_rows = round(options.min_track_s * options.rate_hz) + 1
        return whole_tracks(self._claims, samples, sample_step, min_rows, options.backfill == "all")


_PAPER: Final = Retrack(
    predictor="cv",
    distance="mean",
    covariance="paper",
    max_distance=3.0,
    max_jump_m=None,
    same_source=0.0,
    max_age_s=3.2,
    alpha=0.5,
    beta=0.5,
    min_history=4,
    min_hits=2,
    filled=True,
)

#: Readings by name. "paper" is Algorithm 1 and Eq. 1 to 3 to the letter; where the paper gives no number (sigma, d_min,
#: t_max, the probation) the authors' stands. "authors" is what their program does: the largest distance instead of the
#: mean, certain pairs first, birth from the smoothed past. "default" is ours.
PROFILES: Final = MappingProxyType(
    {
        "default": Retrack(),
        "paper": _PAPER,
        "authors": replace(_PAPER, distance="max", certain_distance=0.15, birth="smoothed", backfill="all"),
    }
)
