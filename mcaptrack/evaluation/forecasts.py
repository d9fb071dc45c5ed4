"""Errors of forecasts, for each forecast and frame by frame.

Forecasts are compared with the ground truth and, in other columns, with the tracks after re-tracking the whole log. The
two are never mixed: the mean over the rows compared with the ground truth is the score of ``evaluate``.

Letters: N forecasts, P pairs, T future steps, F frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.aligned import MAX_GAP_S, on_ground, resample_frames
from mcaptrack.evaluation.metrics.displacement import (
    RELIABILITY_LEVELS,
    TAU_M2,
    Displacement,
    Forecasts,
    PairedForecasts,
    Positions,
    displacement,
    forecast_errors,
    pair_forecasts,
)
from mcaptrack.geometry.arrays import Bools, Floats, Ints, taken
from mcaptrack.geometry.clocks import NS_PER_S, RegularClock, seconds_to_ns
from mcaptrack.geometry.histories import Holt, SmoothedHistory
from mcaptrack.geometry.mixtures import Tails, squared_radius
from mcaptrack.schema import FORECAST_ERRORS, FORECAST_SCORES, PREDICTIONS, TRACKS, Frame, Rows
from mcaptrack.schema.as_rows import tails_of
from mcaptrack.schema.frame_columns import FrameCollector
from mcaptrack.schema.framing import frame_numbers, frame_times, join_frames, row_ends, spans_of, split_rows
from mcaptrack.transforms import Predict

#: The channels of forecasts, below the camera's prefix, and the tracks from which each is made.
FORECAST_INPUTS: Final[Mapping[str, str]] = {"predictions": "samples", "retracks/predictions": "retracks/online"}
NO_ID: Final = -1
_WITHIN: Final = RELIABILITY_LEVELS.index(0.95)
_AHEAD_S: Final = 1.0
#: The past of a forecast may begin with a gap, and the last observation before it is at most so old, in seconds.
_BEFORE_S: Final = 120.0
_BESIDE_STEPS: Final = 2
#: The columns of a forecast that is compared with a path.
_MEASURES: Final = ("ade_m", "fde_m", "error_1s_m", "within_95")


class _PredictionClock(NamedTuple):
    """The regular clock of predictions, which starts with the first frame of the tracks and ends with the last."""

    regular: RegularClock
    last_ns: int
    step_s: float

    @classmethod
    def of(cls, track_ns: Ints, step_s: float) -> _PredictionClock:
        regular = RegularClock.of(track_ns, int(track_ns[0]), step_s * NS_PER_S)
        return cls(regular, int(track_ns[-1]), step_s)

    def positions(
        self, frames: Sequence[Frame], span: tuple[int, int] | None = None, forecasts: Forecasts | None = None
    ) -> Positions:
        """The positions of tracks with frames at ticks of this clock.

        With a ``span`` of times in ns only those that ``forecasts`` made in it are compared with.
        """
        low, high = 0, len(frames)
        if span and forecasts:
            ahead_s = _BESIDE_STEPS * self.step_s + forecasts.mean_m.shape[1] * self.step_s
            since_ns, until_ns = span[0] - seconds_to_ns(_BEFORE_S), span[1] + seconds_to_ns(ahead_s)
            low, high = np.searchsorted(frame_times(frames), [since_ns, until_ns]).tolist()
        joined = join_frames(TRACKS, frames, low, high)
        ids = joined.rows["track_id"].astype(np.int64)
        return Positions(self.regular.to_step(joined.row_ns), ids, on_ground(joined.rows))

    def resampled(self, ground_truth: Sequence[Frame]) -> tuple[Positions, Ints]:
        """The positions of tracks with other times, resampled to the ticks that their frames cover; and these ticks."""
        ticks = self.regular.ticks(frame_times(ground_truth), seconds_to_ns(MAX_GAP_S))
        ticks = ticks[ticks <= self.last_ns + self.regular.step_ns / 2]
        return self.positions(resample_frames(ground_truth, ticks)), self.regular.to_step(ticks)


class _ForecastArrays(NamedTuple):
    """Forecasts as arrays, ordered by message and id; ``message`` (N,) is the index of each forecast's message."""

    message: Ints
    forecasts: Forecasts
    clock: _PredictionClock


def _clock(frames: Sequence[Frame], tracks: Sequence[Frame]) -> _PredictionClock | None:
    """The clock of forecasts of tracks; None if there are none."""
    first = next((frame.rows[0] for frame in frames if len(frame.rows)), None)
    if first is None or not len(tracks):
        return None
    return _PredictionClock.of(frame_times(tracks), float(first["ahead_s"]) / int(first["step"]))


def _arrays(
    frames: Sequence[Frame], tracks: Sequence[Frame], name: str, clock: _PredictionClock | None = None
) -> _ForecastArrays | None:
    """Forecasts as arrays; None if there are none. Raises McaptrackError if they differ in their number of steps."""
    rows, message, _, _ = join_frames(PREDICTIONS, frames)
    if not len(rows) or not len(tracks):
        return None
    order = np.lexsort((rows["step"], rows["track_id"], message))
    rows, message = rows[order], message[order]
    horizon = int(rows["step"].max())
    if len(rows) % horizon or not (rows["step"].reshape(-1, horizon) == np.arange(1, horizon + 1)).all():
        raise McaptrackError(f"{name}: not all forecasts have {horizon} steps")
    if clock is None:
        clock = _PredictionClock.of(frame_times(tracks), float(rows["ahead_s"][0]) / int(rows["step"][0]))
    cov = np.stack([rows["cov_xx_m2"], rows["cov_xy_m2"], rows["cov_xy_m2"], rows["cov_yy_m2"]], axis=-1)
    forecasts = Forecasts(
        clock.regular.to_step(frame_times(frames)[message[::horizon]]),
        rows["track_id"][::horizon].astype(np.int64),
        on_ground(rows).reshape(-1, horizon, 2),
        cov.reshape(-1, horizon, 2, 2),
        tails_of(rows, horizon),
    )
    return _ForecastArrays(message[::horizon], forecasts, clock)


_NOTHING: Final = _ForecastArrays(
    np.empty(0, np.int64),
    Forecasts(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 1, 2)), np.empty((0, 1, 2, 2))),
    _PredictionClock.of(np.zeros(1, np.int64), 1.0),
)


def score_forecasts(
    frames: Sequence[Frame], tracks: Sequence[Frame], ground_truth: Sequence[Frame], name: str
) -> Displacement | None:
    """Score the forecasts made for tracks.

    Parameters
    ----------
    frames : sequence of Frame
        Rows of Predictions.
    tracks : sequence of Frame
        Rows of Tracks from which the forecasts were made.
    ground_truth : sequence of Frame
        Rows of Tracks.
    name : str
        The name of the forecasts, for messages.

    Returns
    -------
    Displacement or None
        None if there are no forecasts.

    Raises
    ------
    McaptrackError
        If forecasts differ in their number of steps.
    """
    arrays = _arrays(frames, tracks, name)
    if arrays is None:
        return None
    people, labelled = arrays.clock.resampled(ground_truth)
    return displacement(people, arrays.clock.positions(tracks), arrays.forecasts, labelled=labelled)


class ForecastErrorFrames(NamedTuple):
    """Rows of ForecastErrors and of ForecastScores: one frame of each for every frame of the forecasts."""

    errors: Sequence[Frame]
    scores: Sequence[Frame]


# The spread of forecasts: one mean and one 90th percentile for each frame, which viewers can plot.
#
# Letters: N forecasts, F frames.


#: The probability inside the ellipses, and the percentile of their sizes that is given beside the mean.
LEVEL: Final = 0.95
PERCENTILE: Final = 90.0


def radii_m(cov_m2: Floats, tails: Tails) -> Floats:
    """The longer half axes (N,) in m of the 95 % ellipses of forecasts.

    Parameters
    ----------
    cov_m2 : array (N, 2, 2), m^2
        Covariances of the forecasts.
    tails : Tails
        Shapes (N,) of their distributions.

    Returns
    -------
    array (N,), m
        NaN where a covariance is not known or not positive.

    Examples
    --------
    >>> import numpy as np
    >>> from mcaptrack.geometry.mixtures import normal_tails
    >>> radii_m(np.diag([1.0, 4.0])[None], normal_tails(1)).round(3).tolist()
    [4.895]
    """
    xx, xy, yy = cov_m2[:, 0, 0], cov_m2[:, 0, 1], cov_m2[:, 1, 1]
    half = np.hypot((xx - yy) / 2, xy)
    larger, smaller = (xx + yy) / 2 + half, (xx + yy) / 2 - half
    is_valid = np.isfinite(larger) & (smaller >= -1e-9 * np.abs(larger))
    squared = np.where(is_valid, larger, np.nan) * squared_radius(LEVEL, tails)
    return np.asarray(np.sqrt(squared), np.float64)


def by_frame(values: Floats, frame: Ints, frames: int) -> tuple[Floats, Floats]:
    """The mean and the 90th percentile (F,) of values (N,) in each frame, NaN where none is known.

    ``frame`` (N,) is the index of each value's frame. Percentiles are interpolated linearly between values.

    Examples
    --------
    >>> import numpy as np
    >>> mean, most = by_frame(np.array([1.0, 3.0, np.nan]), np.array([0, 0, 1]), 2)
    >>> mean.tolist(), most.round(2).tolist()
    ([2.0, nan], [2.8, nan])
    """
    is_known = np.isfinite(values)
    values, frame = values[is_known], frame[is_known]
    count = np.bincount(frame, minlength=frames)
    if not len(values):
        return np.full(frames, np.nan), np.full(frames, np.nan)
    ordered = values[np.lexsort((values, frame))]
    # Places within a frame, so that the rounding of a frame doesn't depend on those before it.
    place = np.maximum(PERCENTILE / 100 * (count - 1), 0.0)
    low = np.floor(place).astype(np.int64)
    share = place - low
    first = np.minimum(np.cumsum(count) - count + low, len(ordered) - 1)
    second = np.minimum(first + 1, len(ordered) - 1)
    most = ordered[first] + share * (ordered[second] - ordered[first])
    total = np.bincount(frame, values, minlength=frames)
    some = count > 0
    return np.where(some, total / np.maximum(count, 1), np.nan), np.where(some, most, np.nan)


def find_forecast_errors(
    frames: Sequence[Frame],
    tracks: Sequence[Frame],
    ground_truth: Sequence[Frame] | None,
    later: Sequence[Frame],
    name: str = "the forecasts",
) -> ForecastErrorFrames:
    """Compute the errors of forecasts made for tracks.

    Parameters
    ----------
    frames : sequence of Frame
        Rows of Predictions.
    tracks : sequence of Frame
        Rows of Tracks from which the forecasts were made.
    ground_truth : sequence of Frame, optional
        Rows of Tracks at any times.
    later : sequence of Frame
        Rows of Tracks at the times of ``tracks``, as they are after the whole log is known.
    name : str
        The name of the forecasts, for messages.

    Returns
    -------
    ForecastErrorFrames

    Raises
    ------
    McaptrackError
        If forecasts differ in their number of steps.
    """
    parts = list(spans_of(row_ends(frames)))
    whole = _arrays(frames, tracks, name) if len(parts) == 1 else None
    clock = _clock(frames, tracks) if len(frames) else None
    people, labelled = (clock or _NOTHING.clock).resampled(ground_truth or ())
    scores, errors = FORECAST_SCORES.empty(len(frames)), FrameCollector(FORECAST_ERRORS)
    times, numbers, has_truth = frame_times(frames), frame_numbers(frames), bool(np.isfinite(people.xy_m).any())
    for low, high in parts:
        part: Sequence[Frame] = frames if len(parts) == 1 else frames[low:high]
        arrays = (whole if len(parts) == 1 else clock and _arrays(part, tracks, name, clock)) or _NOTHING
        rows = FORECAST_ERRORS.empty(len(arrays.message))
        rows["track_id"], rows["truth_id"], rows["later_id"] = arrays.forecasts.id, NO_ID, NO_ID
        of_part = scores[low:high]
        of_part["forecasts"] = np.bincount(arrays.message, minlength=high - low)
        radii_m = _radii_m(arrays.forecasts)
        of_part["spread_mean_m"], of_part["spread_90_m"] = by_frame(radii_m, arrays.message, high - low)
        span = (int(times[low]), int(times[high - 1])) if len(parts) > 1 else None
        paths, offline = (arrays.clock.positions(some, span, arrays.forecasts) for some in (tracks, later))
        if has_truth:
            false = _compare(
                arrays, pair_forecasts(people, paths, arrays.forecasts, labelled=labelled), rows, "truth_id", ""
            )
            of_part["false_forecasts"] = np.bincount(arrays.message[false], minlength=high - low)
            of_part["scored"] = _mean(arrays.message, rows, of_part, "")
        _compare(arrays, pair_forecasts(offline, paths, arrays.forecasts), rows, "later_id", "later_")
        of_part["later_scored"] = _mean(arrays.message, rows, of_part, "later_")
        ends = np.searchsorted(arrays.message, np.arange(high - low + 1), "left")
        errors.extend(times[low:high], numbers[low:high], ends, FORECAST_ERRORS.check(rows))
    if has_truth:
        for so_far, measure in (("ade_so_far_m", "ade_m"), ("fde_so_far_m", "fde_m")):
            scores[so_far] = _so_far(scores["scored"], scores[measure])
    return ForecastErrorFrames(
        errors.done(), split_rows(times, numbers, FORECAST_SCORES.check(scores), np.arange(1, len(frames) + 1))
    )


def _radii_m(forecasts: Forecasts) -> Floats:
    """The longer half axes (N,) of the 95 % ellipses at the last step."""
    shapes = forecasts.shapes(np.arange(len(forecasts.id)))
    return radii_m(forecasts.cov_m2[:, -1], Tails(*(part[:, -1] for part in shapes)))


def _compare(
    arrays: _ForecastArrays, pairs: PairedForecasts, rows: Rows, id_column: str, front: str
) -> NDArray[np.bool_]:
    """Fill in id and errors of the forecasts that are paired; returns which of the others are false (N,)."""
    near = pairs.d_obs_m2 < TAU_M2
    at = pairs.forecast[near]
    rows[id_column][at] = pairs.person[near]
    off, cov = pairs.offset_m[near], arrays.forecasts.cov_m2[at]
    errors = forecast_errors(off, cov, arrays.forecasts.shapes(at))
    soon_m = _at_s(off, arrays.clock.step_s, _AHEAD_S)
    measured = (errors.ade_m, errors.fde_m, soon_m, errors.covered[:, _WITHIN])
    for measure, values in zip(_MEASURES, measured, strict=True):
        rows[front + measure][at] = values
    return np.asarray(pairs.is_judged & (rows[id_column] == NO_ID), np.bool_)


def _at_s(off_m: Floats, step_s: float, ahead_s: float) -> Floats:
    """The distances (P,) at a time ahead, interpolated linearly between steps; NaN outside of them."""
    place = round(ahead_s / step_s - 1, 6)
    if not 0 <= place <= off_m.shape[1] - 1:
        return np.full(len(off_m), np.nan)
    low = min(int(place), max(off_m.shape[1] - 2, 0))
    high, share = min(low + 1, off_m.shape[1] - 1), place - low
    off = off_m[:, low] + share * (off_m[:, high] - off_m[:, low])
    return np.asarray(np.hypot(off[:, 0], off[:, 1]))


def _mean(message: Ints, rows: Rows, scores: Rows, front: str) -> Ints:
    """Fill in the means of each frame over the known values; returns the number of these (F,)."""
    is_known = np.isfinite(rows[front + "ade_m"])
    count = np.bincount(message[is_known], minlength=len(scores))
    for measure in ("ade_m", "fde_m", "within_95"):
        total = np.bincount(message[is_known], rows[front + measure][is_known], minlength=len(scores))
        scores[front + measure] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return count


def _so_far(count: Floats, mean: Floats) -> Floats:
    """The running mean up to each frame (F,), from the means and counts of the frames."""
    of_all = np.cumsum(count)
    total = np.cumsum(np.where(count > 0, count * np.nan_to_num(mean), 0.0))
    return np.where(of_all > 0, total / np.maximum(of_all, 1), np.nan)


# Predictions from smoothed tracks: the ablation "SORT + smoothing" of the paper.
#
# Identities and positions stay as the tracker gave them. Only the displacements of each track's past are smoothed
# by Eq. 3 before the same predictor predicts, so that the difference is the effect of smoothing alone.
#
# Letters: N tracks of a frame, L past positions.


#: alpha = beta of Eq. 3, as in the paper.
SMOOTHING: Final = 0.5


@dataclass
class SmoothedHistories:
    """The smoothed pasts of the tracks in the last frame; a track that returns after a gap begins a new past."""

    length: int

    def __post_init__(self) -> None:
        self._holt = Holt(SMOOTHING, SMOOTHING)
        self._ids: Ints = np.empty(0, np.int64)
        self._history = self._begin(np.empty((0, 2)))

    def push(self, ids: Ints, xy_m: Floats, steps: int) -> tuple[Floats, Bools]:
        """Add the positions (N, 2) of the tracks of the next frame; returns pasts (N, L, 2) and what is known (N, L).

        Positions are rebuilt backwards from the current one, which stays as it was measured.
        """
        history = self._begin(xy_m)
        _, now, before = np.intersect1d(ids, self._ids, return_indices=True)
        if steps == 1 and len(now):
            kept = taken(self._history, before).extended(self._holt, xy_m[now], np.ones(len(now), np.int64))
            for values, kept_values in zip(history, kept, strict=True):
                values[now] = kept_values
        self._ids, self._history = ids.astype(np.int64), history
        past, is_known = history.positions()
        return np.where(is_known[..., None], past, np.nan), is_known

    def _begin(self, xy_m: Floats) -> SmoothedHistory:
        """Pasts of one position each."""
        count = len(xy_m)
        is_known = np.arange(self.length) == self.length - 1
        past = np.tile(xy_m[:, None].astype(float), (1, self.length, 1))
        return SmoothedHistory.of_observations(self._holt, past, np.tile(is_known, (count, 1)))


def smoothed_predictions(samples: Sequence[Frame], predict: Predict) -> Iterator[Frame]:
    """Predictions as ``predict`` makes them of samples, but from smoothed pasts.

    Parameters
    ----------
    samples : sequence of Frame
        Rows of Tracks at the prediction rate.
    predict : Predict
        The predictor and its options.

    Yields
    ------
    Frame
        Rows of Predictions, one frame for each of ``samples``.
    """
    forecaster = predict.forecaster(SmoothedHistories)
    for frame in samples:
        yield frame._replace(rows=forecaster.predict(frame))
