"""How far off forecasts were: what their scores are made of, each by itself and frame by frame.

Forecasts are held against the truth, and against what was made of the tracks with all that was known in the end. The
two are never mixed: the mean over the rows held against the truth is the score that ``evaluate`` gives.

Letters: N forecasts, P pairs, T future steps, F frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.aligned import MAX_HOLE_S, frame_times, on_ground, resampled
from mcaptrack.evaluation.metrics.calibration import LEVELS
from mcaptrack.evaluation.metrics.displacement import (
    TAU_M2,
    Displacement,
    Forecasts,
    Paired,
    Path,
    displacement,
    errors,
    pair,
)
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.schema import FORECAST_ERRORS, FORECAST_SCORES, PREDICTIONS, TRACKS, Frame, Rows, Schema
from mcaptrack.schema.resampling import looked_at

#: The channels of forecasts, below the camera's prefix, and the tracks that each is made from.
MADE_FROM: Final[Mapping[str, str]] = {"predictions": "samples", "retracks/predictions": "retracks/online"}
_NOBODY: Final = -1
_WITHIN: Final = LEVELS.index(0.95)
_AHEAD_S: Final = 1.0
#: What is said of a forecast that is held against a path.
_MEASURES: Final = ("ade_m", "fde_m", "error_1s_m", "within_95")


class _Clock(NamedTuple):
    """The clock of prediction, which begins with the tracks."""

    start_ns: int
    last_ns: int
    step_s: float

    def to_step(self, t_ns: Ints) -> Ints:
        return np.rint((t_ns - self.start_ns) / (self.step_s * NS_PER_S)).astype(np.int64)

    def positions(self, frames: Sequence[Frame]) -> Path:
        """The places of tracks whose frames are ticks of this clock."""
        rows = TRACKS.joined([frame.rows for frame in frames])
        t_ns = np.repeat(frame_times(frames), [len(frame.rows) for frame in frames])
        return Path(self.to_step(t_ns), rows["track_id"].astype(np.int64), on_ground(rows))

    def brought(self, truth: Sequence[Frame]) -> Path:
        """The places of tracks of another clock at the ticks of this one, where somebody looked."""
        last = int(self.to_step(np.array([self.last_ns]))[0])
        ticks = self.start_ns + np.rint(np.arange(last + 1) * (self.step_s * NS_PER_S)).astype(np.int64)
        return self.positions(resampled(truth, ticks[looked_at(frame_times(truth), ticks, seconds_to_ns(MAX_HOLE_S))]))


class _Made(NamedTuple):
    """Forecasts as arrays, ordered by message and id: ``message`` (N,) is the number of the message of each."""

    message: Ints
    forecasts: Forecasts
    clock: _Clock


def _arrays(frames: Sequence[Frame], tracks: Sequence[Frame], name: str) -> _Made | None:
    """None if there are no forecasts at all. Raises McaptrackError if they are not all of the same steps."""
    rows = PREDICTIONS.joined([frame.rows for frame in frames])
    if not len(rows) or not len(tracks):
        return None
    message = np.repeat(np.arange(len(frames)), [len(frame.rows) for frame in frames])
    order = np.lexsort((rows["step"], rows["track_id"], message))
    rows, message = rows[order], message[order]
    horizon = int(rows["step"].max())
    if len(rows) % horizon or not (rows["step"].reshape(-1, horizon) == np.arange(1, horizon + 1)).all():
        raise McaptrackError(f"{name}: not all forecasts have {horizon} steps")
    track_ns = frame_times(tracks)
    step_s = float(rows["ahead_s"][0]) / int(rows["step"][0])
    clock = _Clock(int(track_ns.min()), int(track_ns.max()), step_s)
    cov = np.stack([rows["cov_xx_m2"], rows["cov_xy_m2"], rows["cov_xy_m2"], rows["cov_yy_m2"]], axis=-1)
    forecasts = Forecasts(
        clock.to_step(frame_times(frames)[message[::horizon]]),
        rows["track_id"][::horizon].astype(np.int64),
        on_ground(rows).reshape(-1, horizon, 2),
        cov.reshape(-1, horizon, 2, 2),
    )
    return _Made(message[::horizon], forecasts, clock)


_NOTHING: Final = _Made(
    np.empty(0, np.int64),
    Forecasts(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 1, 2)), np.empty((0, 1, 2, 2))),
    _Clock(0, 0, 1.0),
)


def score_forecasts(
    frames: Sequence[Frame], tracks: Sequence[Frame], truth: Sequence[Frame], name: str
) -> Displacement | None:
    """The scores of forecasts made for tracks; None if there are none at all.

    Raises McaptrackError, with ``name``, if they are not all of the same steps.
    """
    made = _arrays(frames, tracks, name)
    if made is None:
        return None
    return displacement(made.clock.brought(truth), made.clock.positions(tracks), made.forecasts)


class ForecastsFound(NamedTuple):
    """Rows of ForecastErrors and of ForecastScores, a frame each for every frame of the forecasts."""

    errors: list[Frame]
    scores: list[Frame]


def find_forecast_errors(
    frames: Sequence[Frame],
    tracks: Sequence[Frame],
    truth: Sequence[Frame] | None,
    later: Sequence[Frame],
    name: str = "the forecasts",
) -> ForecastsFound:
    """How far off forecasts were that were made for tracks: from the truth, if any, and from tracks of the same clock.

    ``later`` are the tracks as they became when more was known. Raises as ``score_forecasts`` does.
    """
    made = _arrays(frames, tracks, name) or _NOTHING
    rows, scores = _unknown(FORECAST_ERRORS, len(made.message)), _unknown(FORECAST_SCORES, len(frames))
    rows["track_id"], rows["truth_id"], rows["later_id"] = made.forecasts.id, _NOBODY, _NOBODY
    scores["forecasts"] = np.bincount(made.message, minlength=len(frames))
    paths = made.clock.positions(tracks)
    people = made.clock.brought(truth or ())
    if np.isfinite(people.xy_m).any():
        false = _hold(made, pair(people, paths, made.forecasts), rows, "truth_id", "")
        scores["false_forecasts"] = np.bincount(made.message[false], minlength=len(frames))
        scores["scored"] = _mean(made.message, rows, scores, "")
        for so_far, measure in (("ade_so_far_m", "ade_m"), ("fde_so_far_m", "fde_m")):
            scores[so_far] = _so_far(scores["scored"], scores[measure])
    _hold(made, pair(made.clock.positions(later), paths, made.forecasts), rows, "later_id", "later_")
    scores["later_scored"] = _mean(made.message, rows, scores, "later_")
    ends = np.searchsorted(made.message, np.arange(len(frames)), "right")
    return ForecastsFound(
        _framed(frames, FORECAST_ERRORS.check(rows), ends),
        _framed(frames, FORECAST_SCORES.check(scores), np.arange(1, len(frames) + 1)),
    )


def _unknown(schema: Schema, count: int) -> Rows:
    """Rows of which nothing is known yet."""
    rows = schema.empty(count)
    for column in schema.columns:
        if column.optional:
            rows[column.name] = np.nan
    return rows


def _framed(frames: Sequence[Frame], rows: Rows, ends: Ints) -> list[Frame]:
    starts = [0, *ends.tolist()][:-1]
    spans = zip(frames, starts, ends.tolist(), strict=True)
    return [Frame(frame.t_ns, frame.index, rows[low:high]) for frame, low, high in spans]


def _hold(made: _Made, found: Paired, rows: Rows, who: str, front: str) -> NDArray[np.bool_]:
    """Fill in whom forecasts belong to, and how far off they were; returns which (N,) belong to nobody."""
    near = found.d_obs_m2 < TAU_M2
    at = found.forecast[near]
    rows[who][at] = found.person[near]
    off, cov = found.off_m[near], made.forecasts.cov_m2[at]
    ade_m, fde_m, _, covered, _ = errors(off, cov)
    soon_m = _at_s(off, made.clock.step_s, _AHEAD_S)
    for measure, values in zip(_MEASURES, (ade_m, fde_m, soon_m, covered[:, _WITHIN]), strict=True):
        rows[front + measure][at] = values
    return np.asarray(found.is_judged & (rows[who] == _NOBODY), np.bool_)


def _at_s(off_m: Floats, step_s: float, ahead_s: float) -> Floats:
    """How far off (P,) paths are so many seconds ahead, on the straight line between the steps around; NaN outside."""
    place = round(ahead_s / step_s - 1, 6)
    if not 0 <= place <= off_m.shape[1] - 1:
        return np.full(len(off_m), np.nan)
    low = min(int(place), max(off_m.shape[1] - 2, 0))
    high, share = min(low + 1, off_m.shape[1] - 1), place - low
    off = off_m[:, low] + share * (off_m[:, high] - off_m[:, low])
    return np.asarray(np.hypot(off[:, 0], off[:, 1]))


def _mean(message: Ints, rows: Rows, scores: Rows, front: str) -> Ints:
    """Fill in the means of each frame over what is known; returns of how many (F,)."""
    known = np.isfinite(rows[front + "ade_m"])
    count = np.bincount(message[known], minlength=len(scores))
    for measure in ("ade_m", "fde_m", "within_95"):
        total = np.bincount(message[known], rows[front + measure][known], minlength=len(scores))
        scores[front + measure] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return count


def _so_far(count: Floats, mean: Floats) -> Floats:
    """The mean over all up to each frame (F,), of the means of frames over so many."""
    of_all = np.cumsum(count)
    total = np.cumsum(np.where(count > 0, count * np.nan_to_num(mean), 0.0))
    return np.where(of_all > 0, total / np.maximum(of_all, 1), np.nan)
