"""Scores of other software's detectors that are no probabilities, such as logits: what each means, found in the log.

Trackers need to know how likely a detection is real. Nothing in a log says that, but two things tell it apart. Real
objects go on from frame to frame along a steady motion, and most false detections don't; and the scores of both are
distributed in another way: those of false detections fall off from the limit of the detector, those of real ones lie
around a mean. A mixture of both is fitted for each class to both at once. The result rises with the score.

Channels with scores from 0 to 1 are left alone. Letters: N detections, P pairs of them.

References
----------
R. Manmatha, T. Rath, F. Feng, "Modeling Score Distributions for Combining the Outputs of Search Engines", SIGIR 2001;
A. Blum, T. Mitchell, "Combining Labeled and Unlabeled Data with Co-Training", COLT 1998.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.neighbours import touching_pairs
from mcaptrack.geometry.ragged import cross_pairs, ragged_range
from mcaptrack.schema import DETECTIONS, Frame, Rows
from mcaptrack.schema.framing import JoinedFrames, filtered_rows, joined_parts, mapped_rows
from mcaptrack.transforms.motion_limits import ClassNames, limits_by_class

#: Detections that are less likely than this are left out unless the user says otherwise. More than one half, because
#: false detections of one place come again and again, and trackers take them for so many independent ones.
DOUBTFUL: Final = 0.6
#: Scores may be outside of 0 to 1 by rounding.
_ROUNDING: Final = 1e-3
#: With fewer scores outside of 0 to 1, as a share of all, the others are probabilities.
_ODD: Final = 0.01
#: The highest of percentages is above this, and not above 100.
_PERCENT: Final = 90.0
#: With fewer detections or frames nothing can be told from the log; classes with fewer are judged with all others.
_FEW: Final = 30
_FEW_FRAMES: Final = 5
#: Frames with more detections, and further candidates for the next frame, are no evidence.
_MANY: Final = 2000
_NEAREST: Final = 3
#: Frames with a longer gap between them, in usual steps, don't follow one another.
_LONG_STEP: Final = 3.0
#: The part of a detection's own size that its box may move in the picture, and may be off a steady motion.
_REACH: Final = 1.0
_UNSTEADY: Final = 0.5
#: Standard deviations of noise that count. Three positions with noise are off a line by the root of 6 times as much.
_SIGMAS: Final = 2.5
_OF_THREE: Final = 6**0.5
#: In how many of the three runs of three frames that a detection is in, it goes on steadily: what is expected of real
#: and of false ones, 0 to 3 times, and the number of detections that this expectation counts for.
_REAL: Final = np.array([0.02, 0.05, 0.13, 0.80])
_FALSE: Final = np.array([0.40, 0.20, 0.20, 0.20])
_EXPECTED: Final = 60.0
#: False detections go on in this share of these runs at most, in metres and in pictures. Of what seems to be false and
#: goes on more often, a part is real, such as people who are half hidden.
_STEADY_FALSE: Final = (0.5, 0.7)
#: Detections that a mixture is fitted to, of each class, and rounds of that at most.
_FITTED: Final = 20_000
_ROUNDS: Final = 200
#: The least standard deviation of the scores of real detections, and of false ones, as shares of that of all.
_LEAST_SPREAD: Final = 0.15
#: The number of scores at which a map has knots, and the share by which it rises where nothing says that it does.
_KNOTS: Final = 33
_RISE: Final = 0.02


class Curve(NamedTuple):
    """The meaning of the scores of a class: likelihoods (K,) that detections are real, at scores (K,), both rising."""

    score: Floats
    likelihood: Floats

    def least(self, likelihood: float) -> float:
        """The least score that is so likely; infinity if none is."""
        is_reached = self.likelihood >= likelihood
        return float(np.interp(likelihood, self.likelihood, self.score)) if is_reached.any() else np.inf

    def __str__(self) -> str:
        """The knots as the provenance has them: SCORE:LIKELIHOOD with spaces between them."""
        return " ".join(f"{score:.6g}:{likelihood:g}" for score, likelihood in zip(*self, strict=True))


class ScoreMap(NamedTuple):
    """The meaning of the scores of a channel: a curve for each class; ``basis`` says where these come from.

    ``is_fitted`` is false where likelihoods are too uncertain to leave detections out.
    """

    curves: Mapping[int, Curve]
    basis: str
    is_fitted: bool

    def mapped(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Frames of detections with likelihoods instead of scores."""

        def change(joined: JoinedFrames) -> Rows:
            rows = joined.rows.copy()
            rows["score"][~np.isfinite(rows["score"])] = np.nan
            for number, curve in self.curves.items():
                of_class = rows["class_id"] == number
                rows["score"][of_class] = np.interp(rows["score"][of_class], *curve)
            return rows

        return mapped_rows(DETECTIONS, frames, change)


class ScoreRange(NamedTuple):
    """The least and the highest score of a channel, and the share of scores that are outside of 0 to 1."""

    low: float
    high: float
    outside: float


def score_range(frames: Sequence[Frame]) -> ScoreRange | None:
    """The range of the scores of detections; None if these are from 0 to 1, or there are none."""
    low, high, count, outside = np.inf, -np.inf, 0, 0
    for _, _, joined in joined_parts(DETECTIONS, frames):
        score = joined.rows["score"][np.isfinite(joined.rows["score"])]
        low, high = float(score.min(initial=low)), float(score.max(initial=high))
        count, outside = count + len(score), outside + int(((score < -_ROUNDING) | (score > 1 + _ROUNDING)).sum())
    return ScoreRange(low, high, outside / count) if outside else None


def without_doubtful(frames: Sequence[Frame]) -> Sequence[Frame]:
    """Frames without the detections that are less likely than ``DOUBTFUL``."""
    return filtered_rows(DETECTIONS, frames, lambda joined: ~(joined.rows["score"] < DOUBTFUL))


def score_map(frames: Sequence[Frame], span: ScoreRange, class_names: ClassNames, class_limits: str = "") -> ScoreMap:
    """Find the meaning of the scores of a channel, which are in the range ``span``."""
    low, high, outside = span
    table = _Detections.of(frames, class_names, class_limits)
    numbers = np.unique(table.class_id).tolist()
    if low == high:
        unknown = Curve(np.array([low]), np.array([np.nan]))
        return ScoreMap(dict.fromkeys(numbers, unknown), "all are the same, so that they say nothing", False)
    if outside < _ODD:
        as_they_are = Curve(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
        return ScoreMap(dict.fromkeys(numbers, as_they_are), f"{outside:.2%} outside of 0 to 1 count as 0 or 1", False)
    if low >= 0 and _PERCENT < high <= 100 + _ROUNDING:
        share = Curve(np.array([0.0, 100.0]), np.array([0.0, 1.0]))
        return ScoreMap(dict.fromkeys(numbers, share), "taken as percentages", False)
    if len(table.score) < _FEW or len(frames) < _FEW_FRAMES:
        ends = np.linspace(low, high, _KNOTS)
        guess = Curve(ends, _logistic(ends) if low < 0 else ends / high)
        kind = "logits" if low < 0 else "shares of the highest"
        return ScoreMap(dict.fromkeys(numbers, guess), f"taken as {kind}: there are too few to learn more", False)
    steady, false = table.steady(), _STEADY_FALSE[0 if table.in_metres else 1]
    every = np.ones(len(table.score), bool)
    counts = {number: table.class_id == number for number in numbers}
    chosen = {number: of_class if of_class.sum() >= _FEW else every for number, of_class in counts.items()}
    curves = {number: _curve(table.score[which], steady[which], false) for number, which in chosen.items()}
    return ScoreMap(curves, "mapped to likelihoods by how steadily boxes of each class and score go on", True)


class _Detections(NamedTuple):
    """Detections with scores (N,): the time of each of F frames, and by detection its frame, class, place (N, 2), how
    far it can be in the next frame, and how far off a steady motion, in the same unit.
    """

    t_ns: Ints
    frame: Ints
    class_id: Ints
    score: Floats
    place: Floats
    reach: Floats
    unsteady: Floats
    in_metres: bool

    @classmethod
    def of(cls, frames: Sequence[Frame], class_names: ClassNames, class_limits: str) -> _Detections:
        """Take the detections of frames: in metres if most have positions, or else in pixels."""
        parts, times = [], []
        for low, _, joined in joined_parts(DETECTIONS, frames):
            times.append(joined.t_ns)
            rows, has_score = joined.rows, np.isfinite(joined.rows["score"])
            names = ("score", "class_id", "x_m", "y_m", "x_px", "y_px", "w_px", "h_px")
            columns = [joined.frame + low, *(rows[name] for name in names)]
            parts.append(np.stack([column[has_score] for column in columns]).astype(float))
        frame, score, class_id, x_m, y_m, x, y, w, h = np.concatenate(parts, axis=1)
        t_ns, numbers = np.concatenate(times), class_id.astype(np.int64)
        step_s = _steps_s(t_ns)[frame.astype(np.int64)]
        in_metres = bool(np.isfinite(x_m + y_m).mean() >= 0.5)
        if in_metres:
            of = limits_by_class(np.unique(numbers).tolist(), class_names, class_limits)
            speed, noise, drift = (
                np.array([getattr(of[number], name) for number in numbers.tolist()])
                for name in ("max_speed_m_per_s", "noise_m", "drift_m_per_s")
            )
            place, reach = np.stack([x_m, y_m], axis=1), speed * step_s + 2 * _SIGMAS * noise
            unsteady = _SIGMAS * _OF_THREE * noise + drift * step_s**2
        else:
            size = np.sqrt(np.maximum(w * h, 1e-9))
            place, reach, unsteady = np.stack([x + w / 2, y + h / 2], axis=1), _REACH * size, _UNSTEADY * size
        return cls(t_ns, frame.astype(np.int64), numbers, score, place, reach, unsteady, in_metres)

    def steady(self) -> Ints:
        """Count how often each detection goes on steadily, 0 to 3 (N,): with those of the frames before and after, of
        the two frames before, and of the two after.
        """
        step_s = _steps_s(self.t_ns)
        gap = np.diff(self.t_ns, append=self.t_ns[-1:]) / NS_PER_S > _LONG_STEP * step_s
        order = np.arange(len(self.t_ns)) + np.append(0, np.cumsum(gap)[:-1])  # frames after a gap don't follow
        group = order[self.frame] * (self.class_id.max() + 1) + self.class_id
        crowded = np.bincount(self.frame, minlength=len(self.t_ns)) > _MANY
        place = np.where(crowded[self.frame][:, None], np.nan, self.place)
        around = np.concatenate([place - self.reach[:, None], place + self.reach[:, None]], axis=1)
        first, second = touching_pairs(
            around, np.concatenate([place, place], axis=1), group, group - (self.class_id.max() + 1)
        )
        way = (place[second] - place[first]) / step_s[self.frame[first]][:, None]
        first, second, way = _nearest(first, second, way)
        by_second = np.argsort(second, kind="stable")
        count = len(self.score)
        middle, before, after = cross_pairs(np.bincount(second, minlength=count), np.bincount(first, minlength=count))
        before = by_second[before]
        off = np.hypot(*(way[after] - way[before]).T) * step_s[self.frame[middle]]
        fits = off <= self.unsteady[middle]
        out = np.zeros((3, count), np.int64)
        out[0, middle[fits]] = out[1, first[before[fits]]] = out[2, second[after[fits]]] = 1
        # Fewer are possible at the ends of a log.
        to_end = np.minimum(self.frame, len(self.t_ns) - 1 - self.frame)
        possible = np.where(to_end >= 2, 3, to_end + 1)
        return np.asarray(np.rint(3 * out.sum(axis=0) / possible), np.int64)


def _steps_s(t_ns: Ints) -> Floats:
    """The seconds from each frame to the next (F,), at most a few usual ones."""
    step = np.diff(t_ns) / NS_PER_S
    usual = float(np.median(step[step > 0])) if (step > 0).any() else 1.0
    return np.append(np.clip(step, 0.1 * usual, _LONG_STEP * usual), usual)


def _nearest(first: Ints, second: Ints, way: Floats) -> tuple[Ints, Ints, Floats]:
    """The pairs of which the second is one of the nearest to the first."""
    order = np.lexsort((np.hypot(*way.T), first))
    starts = np.flatnonzero(np.diff(first[order], prepend=-1))
    rank = ragged_range(0, np.diff(starts, append=len(order)))
    order = np.sort(order[rank < _NEAREST])
    return first[order], second[order], way[order]


def _curve(score: Floats, steady: Ints, steady_false: float) -> Curve:
    """Find the meaning of the scores (N,) of detections, by how often these go on steadily (N,).

    False ones do so in the share ``steady_false`` at most.
    """
    from scipy.optimize import isotonic_regression

    order = np.argsort(score, kind="stable")[:: -(-len(score) // _FITTED)]
    score, steady = score[order], steady[order]
    _, is_real, by_score = max((_fitted(steady, *kind) for kind in _kinds(score)), key=lambda fit: fit[0])
    lowest = int(by_score[: max(1, len(score) // 2)].argmin())
    rising = np.maximum.accumulate(np.concatenate([np.full(lowest, by_score[lowest]), by_score[lowest:]]))
    likelihood = (rising + isotonic_regression(is_real).x) / 2
    goes_on = [float(np.average(steady / 3, weights=weight + 1e-9)) for weight in (is_real, 1 - is_real)]
    share = np.clip((goes_on[1] - steady_false) / max(goes_on[0] - steady_false, 0.1), 0, 1)
    likelihood = share + (1 - share) * likelihood
    knot = np.unique(np.quantile(score, np.linspace(0, 1, _KNOTS), method="nearest"))
    values = np.interp(knot, score, likelihood)
    values = (1 - _RISE) * values + _RISE * np.linspace(0, 1, len(knot))
    return Curve(knot, np.round(values, 4))


def _kinds(score: Floats) -> list[tuple[Floats, float, bool]]:
    """Scales on which scores (N,), rising, may be distributed as expected: on each of them the scores, the logarithm of
    the derivative of all, and whether false detections are spread around a mean of their own.
    """
    scales = [(score, 0.0)]
    if score[0] > 0:
        top = score[-1] + max(score[-1] - score[-2], score[-1] / (2 * len(score)))
        logs, left = np.log(score), np.log(top - score)
        scales += [(logs, -logs.sum()), (logs - left, (np.log(top) - logs - left).sum())]
    return [(*scale, has_mean) for scale in scales for has_mean in (False, True)]


def _fitted(steady: Ints, u: Floats, slope: float, has_mean: bool) -> tuple[float, Floats, Floats]:
    """Fit a mixture of real and false detections to scores ``u`` (N,), rising, and to how often they go on steadily.

    Returns the logarithm of its likelihood, and for each detection how likely it is real: by both, and by its score.
    """
    count, u = len(u), u - u[0]
    spread = max(float(u.std()), 1e-9)
    is_real = np.clip(np.arange(count) / count / 2 + steady / 6, 0.02, 0.98)
    for _ in range(_ROUNDS):
        real, false = is_real.sum(), count - is_real.sum()
        false_mean = ((1 - is_real) * u).sum() / false
        mean = max((is_real * u).sum() / real, false_mean)
        sigma = max(np.sqrt((is_real * (u - mean) ** 2).sum() / real), _LEAST_SPREAD * spread)
        false_sigma = max(np.sqrt(((1 - is_real) * (u - false_mean) ** 2).sum() / false), _LEAST_SPREAD * spread)
        scale = max(false_mean, _LEAST_SPREAD * spread / 3)
        log_real = np.log((real + 2) / (count + 4)) + _log_normal(u, mean, sigma)
        log_false = np.log((false + 2) / (count + 4))
        log_false += _log_normal(u, false_mean, false_sigma) if has_mean else -u / scale - np.log(scale)
        both_real = log_real + _log_share(steady, is_real, _REAL)
        both_false = log_false + _log_share(steady, 1 - is_real, _FALSE)
        before, is_real = is_real, _logistic(both_real - both_false)
        if np.abs(is_real - before).max() < 1e-3:
            break
    fit = float(np.logaddexp(both_real, both_false).sum()) + slope - has_mean
    return fit, is_real, _logistic(log_real - log_false)


def _log_normal(x: Floats, mean: float, sigma: float) -> Floats:
    return np.asarray(-0.5 * ((x - mean) / sigma) ** 2 - np.log(sigma * np.sqrt(2 * np.pi)))


def _log_share(steady: Ints, weight: Floats, expected: Floats) -> Floats:
    """The logarithm of the weighted share of detections that go on steadily as often as each (N,)."""
    counts = np.bincount(steady, weight, 4) + _EXPECTED * expected
    return np.asarray(np.log(counts / counts.sum())[steady])


def _logistic(x: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-np.clip(x, -50, 50))))
