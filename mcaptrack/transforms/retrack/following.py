"""Re-tracking by likelihood over one log: who is shown at the time, and what is foretold of them.

Letters: R rows that are shown, L past positions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.predictors import Forecast, Predictor, make
from mcaptrack.schema import PREDICTIONS, Frame, Rows
from mcaptrack.schema.predictions import forecast_to_rows
from mcaptrack.transforms.retrack.follow import Evidence, Follower, Seen
from mcaptrack.transforms.retrack.motion import USUAL_NOISE_M, Walker
from mcaptrack.transforms.retrack.whole import Claims, moved

if TYPE_CHECKING:
    from mcaptrack.transforms.retrack import Retrack


#: Forecasts that are made at once: more take memory, fewer take time.
_BATCH: Final = 4096
#: A position or a velocity that is known exactly has a covariance that can't be inverted; so much (m, m/s) is little.
_LEAST: Final = 1e-3


class Following:
    """Follows people through a log, and remembers what was known when."""

    def __init__(self, options: Retrack) -> None:
        rate, self._options = options.rate_hz, options
        self._sure = round(options.sure_s * rate) + 1
        self._follower = Follower(
            walker=walker(options, USUAL_NOISE_M if options.noise_m is None else options.noise_m),
            evidence=Evidence(
                alone=options.same_source,
                crowded=options.same_source / 3,
                share_m=options.share_m,
                share_s=options.share_s,
            ),
            step_s=1 / rate,
            max_age=max(1, round(options.max_age_s * rate)),
            sure_hits=self._sure,
            young_age=min(self._sure, max(1, round(options.max_age_s * rate))),
            learning=options.noise_m is None,
        )
        self.claims = Claims()
        self.samples: list[Rows] = []
        self.steps: list[int] = []
        self._frames: list[Frame] = []
        self._seen: list[Seen] = []
        self._observed: list[Ints] = []

    @property
    def noise_m(self) -> float:
        """The noise of seen positions, as it was found to be."""
        return self._follower.walker.noise_m

    def tick(self, frame: Frame) -> None:
        """One step."""
        passed = 1
        if self._frames:
            passed = max(1, round((frame.t_ns - self._frames[-1].t_ns) * self._options.rate_hz / NS_PER_S))
        step = self.steps[-1] + passed if self.steps else 0
        rows = frame.rows
        observed = np.flatnonzero(rows["observed"]) if not self._options.filled else np.arange(len(rows))
        observed = observed[np.argsort(rows["track_id"][observed], kind="stable")]
        xy_m = np.stack([rows["x_m"][observed], rows["y_m"][observed]], axis=-1)
        source = rows["track_id"][observed]
        seen = self._follower.step(xy_m, source, passed)
        has = seen.row >= 0
        self.claims.add(step, seen.ids[has], source[seen.row[has]])
        self._frames.append(frame)
        self.samples.append(rows)
        self.steps.append(step)
        self._seen.append(seen)
        self._observed.append(observed)

    def outputs(self) -> list[tuple[Frame, Frame]]:
        """What was known at each step: online tracks and their forecasts. Each is made from what was seen by then."""
        options = self._options
        if not self._frames:
            return []
        rate = options.rate_hz
        many = [len(seen.ids) for seen in self._seen]
        tick = np.repeat(np.arange(len(many)), many)
        ids, row, mean, hits, missed = (np.concatenate([seen[k] for seen in self._seen]) for k in range(5))
        offset = np.concatenate([[0], np.cumsum([len(rows) for rows in self.samples])])
        at = np.concatenate(
            [
                np.where(s.row >= 0, o[s.row] if len(o) else -1, -1)
                for s, o in zip(self._seen, self._observed, strict=True)
            ]
        )
        key = np.where(row >= 0, offset[tick] + at, -1)
        order = np.lexsort((tick, ids))
        # the sample that each track had last, by then
        last = np.maximum.accumulate(np.where(key[order] >= 0, np.arange(len(order)), -1))
        last_key = np.empty_like(key)
        last_key[order] = key[order][last]
        coasting = (row < 0) & (hits * 2 >= self._sure * 3) & (missed <= round(options.coast_s * rate))
        shown = np.flatnonzero((((row >= 0) & (hits >= self._sure)) | coasting) & np.isfinite(mean[:, 0]))
        shown = shown[np.lexsort((ids[shown], tick[shown]))]

        samples = np.concatenate(self.samples)
        rows = samples[last_key[shown]].copy()
        rows["source_id"] = np.where(row[shown] >= 0, rows["track_id"], -1)
        rows["track_id"] = ids[shown]
        ahead = row[shown] < 0
        rows["observed"] &= ~ahead
        t_ns = np.array([frame.t_ns for frame in self._frames], np.int64)
        rows[ahead] = moved(rows[ahead], mean[shown[ahead], :2], options.ground_planes, t_ns[tick[shown[ahead]]])
        steps = np.array(self.steps, np.int64)
        past, known = self._past(ids[shown], steps[tick[shown]], np.stack([rows["x_m"], rows["y_m"]], axis=-1), samples)
        forecasts = self._foretell(past, known)
        predictions = (
            forecast_to_rows(rows["track_id"], forecasts, self._predictor.step_s) if len(rows) else PREDICTIONS.empty()
        )
        horizon = self._predictor.steps
        bounds = np.searchsorted(tick[shown], np.arange(len(many) + 1)).tolist()
        return [
            (
                Frame(frame.t_ns, frame.index, rows[low:high]),
                Frame(frame.t_ns, frame.index, predictions[low * horizon : high * horizon]),
            )
            for frame, low, high in zip(self._frames, bounds[:-1], bounds[1:], strict=True)
        ]

    @property
    def _predictor(self) -> Predictor:
        options = self._options
        return make(options.predictor, max(1, round(options.horizon_s * options.rate_hz)), 1 / options.rate_hz)

    def _past(self, ids: Ints, steps: Ints, now_m: Floats, samples: Rows) -> tuple[Floats, NDArray[np.bool_]]:
        """Where R tracks were in the last L steps, (R, L, 2), as seen by then; and what of it is known."""
        length = self._predictor.past
        step, track, _, key = self.claims.on(samples, self.steps, [len(rows) for rows in self.samples])
        width = self.steps[-1] + 2
        have = track * width + step
        order = np.argsort(have)
        have, key = have[order], key[order]
        past = np.full((len(ids), length, 2), np.nan)
        for back in range(1, length):
            want = ids * width + steps - back
            place = np.minimum(np.searchsorted(have, want), len(have) - 1)
            found = (have[place] == want) & (steps >= back)
            rows = samples[key[place[found]]]
            past[found, length - 1 - back] = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
        past[:, -1] = now_m
        return past, np.isfinite(past[..., 0])

    def _foretell(self, past: Floats, known: NDArray[np.bool_]) -> Forecast:
        predictor = self._predictor
        parts = [predictor.predict(past[k : k + _BATCH], known[k : k + _BATCH]) for k in range(0, len(past), _BATCH)]
        if not parts:
            return Forecast(np.empty((0, predictor.steps, 2)), np.empty((0, predictor.steps, 2, 2)))
        return Forecast(*(np.concatenate(members) for members in zip(*parts, strict=True)))


def walker(options: Retrack, noise_m: float) -> Walker:
    """How people move, with this noise."""
    noise_m, speed_m_per_s = max(noise_m, _LEAST), max(options.speed_m_per_s, _LEAST)
    return Walker(noise_m, speed_m_per_s, options.drift, options.drift_share)
