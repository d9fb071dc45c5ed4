"""A predictor with steps of its own, resampled to another clock.

Letters: B batch, L past positions, T future steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats
from mcaptrack.predictors.forecast import Forecast, PeopleSeen, Predictor, predict_among, uses_people


@dataclass(frozen=True)
class OnClock:
    """``inner``, resampled to ``steps`` steps of ``step_s`` seconds.

    The past is interpolated between positions that are known on both sides; forecasts are interpolated between the
    inner steps. Beyond the last of these the forecast is extrapolated, and its covariance grows quadratically.
    """

    inner: Predictor
    steps: int
    step_s: float

    @property
    def name(self) -> str:
        return self.inner.name

    @property
    def weights_sha256(self) -> str | None:
        return self.inner.weights_sha256

    @property
    def uses_people(self) -> bool:
        return uses_people(self.inner)

    @cached_property
    def past(self) -> int:
        return int(np.ceil((self.inner.past - 1) * self.inner.step_s / self.step_s - 1e-6)) + 1

    def predict(self, xy_m: Floats, valid: Bools, people: PeopleSeen | None = None) -> Forecast:
        """Positions (B, L', 2), of which ``valid`` (B, L') are known, the last one always -> forecasts."""
        if abs(self.step_s / self.inner.step_s - 1) > 1e-6:
            xy_m, valid = self._past(xy_m, valid)
            if people is not None:
                past, known = self._past(people.xy_m, people.valid)
                people = people._replace(xy_m=past, valid=known)
        return self._future(predict_among(self.inner, xy_m, valid, people), xy_m[:, -1])

    def _past(self, xy_m: Floats, valid: Bools) -> tuple[Floats, Bools]:
        """Past positions and which are known, at the times of the inner clock."""
        length = xy_m.shape[1]
        back = np.arange(self.inner.past)[::-1] * (self.inner.step_s / self.step_s)
        at = length - 1 - back
        at = np.where(np.abs(at - np.rint(at)) < 1e-6, np.rint(at), at)
        low, high = np.floor(at).astype(int), np.ceil(at).astype(int)
        is_inside = low >= 0
        low, high = np.maximum(low, 0), np.maximum(high, 0)
        share = (at - low)[:, None]
        known = valid[:, low] & valid[:, high] & is_inside
        past = (1 - share) * xy_m[:, low] + share * xy_m[:, high]
        # A neighbour with share 0 may be NaN.
        past = np.where(share == 0, xy_m[:, low], past)
        return np.where(known[..., None], past, np.nan), known

    def _future(self, forecast: Forecast, now: Floats) -> Forecast:
        """The forecast at the wanted times. At 0 its standard deviation is half of that at the first inner step."""
        mean = np.concatenate([now[:, None], forecast.mean], axis=1)
        cov = np.concatenate([forecast.cov[:, :1] / 4, forecast.cov], axis=1)
        last = mean.shape[1] - 1
        at = np.arange(1, self.steps + 1) * (self.step_s / self.inner.step_s)
        low = np.clip(np.round(at, 6).astype(int), 0, last - 1)
        share = at - low  # more than 1 beyond the last step
        within = np.minimum(share, 1.0)[:, None, None]
        at_times = (1 - share[:, None]) * mean[:, low] + share[:, None] * mean[:, low + 1]
        spread = (1 - within) * cov[:, low] + within * cov[:, low + 1]
        return Forecast(at_times, spread * (np.maximum(at / last, 1.0) ** 2)[:, None, None])
