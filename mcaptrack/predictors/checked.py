"""A predictor of another package: whatever it does wrong becomes one line that names it.

Letters: B batch, L past positions, T future steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.predictors.forecast import Forecast, PeopleSeen, are_covariances, uses_people
from mcaptrack.registry import Entry, blamed, failure
from mcaptrack.registry.guard import Guard

Floats = NDArray[np.float64]
_WRONG = (TypeError, ValueError, OverflowError)
#: More steps than anything predicts or looks at; arrays of more do not fit into memory.
_MOST: Final = 10_000
#: Beyond the square of any distance on Earth; distances and likelihoods of larger numbers overflow.
_LARGEST: Final = 1e15


@dataclass(frozen=True)
class CheckedPredictor:
    """``inner``, which the registry found as ``entry``."""

    entry: Entry
    inner: Any
    steps: int
    step_s: float
    past: int
    guard: Guard

    @classmethod
    def of(cls, entry: Entry, parameters: Mapping[str, Any]) -> Self:
        """Make the predictor. Raises McaptrackError if that fails, or if what comes of it is no predictor."""
        guard = Guard(str(entry))
        with blamed(entry, f"could not be made with {', '.join(parameters)}", guard):
            inner = entry.cls(**parameters)
        if not callable(getattr(inner, "predict", None)):
            raise McaptrackError(f"{entry} has no method predict, so it is no predictor")
        try:
            steps, step_s, past = int(inner.steps), float(inner.step_s), int(inner.past)
        except (AttributeError, *_WRONG) as error:
            raise failure(entry, "needs the numbers steps, step_s and past", error) from error
        if not (0 < steps <= _MOST and 0 < past <= _MOST and 0 < step_s < np.inf):
            raise McaptrackError(
                f"{entry} has steps={steps}, step_s={step_s:g}, past={past}; all have to be above 0, steps and past at "
                f"most {_MOST}"
            )
        return cls(entry, inner, steps, step_s, past, guard)

    @property
    def name(self) -> str:
        return self.entry.name

    @property
    def weights_sha256(self) -> str | None:
        with blamed(self.entry, "could not say its weights_sha256", self.guard):
            digest = getattr(self.inner, "weights_sha256", None)
            return None if digest is None else str(digest)

    @property
    def uses_people(self) -> bool:
        with blamed(self.entry, "could not say whether it uses_people", self.guard):
            return uses_people(self.inner)

    def predict(self, xy_m: Floats, valid: NDArray[np.bool_], people: PeopleSeen | None = None) -> Forecast:
        """Positions (B, L', 2) of which ``valid`` (B, L') are known, the last one always -> forecasts."""
        batch = len(valid)
        if batch == 0:
            return Forecast(np.empty((0, self.steps, 2)), np.empty((0, self.steps, 2, 2)))
        with blamed(self.entry, f"failed on {batch} {'track' if batch == 1 else 'tracks'}", self.guard):
            among = {} if people is None else {"people": people.copied()}
            forecast = self.inner.predict(xy_m.copy(), valid.copy(), **among)
        if not isinstance(forecast, tuple | list) or len(forecast) != 2:
            raise McaptrackError(
                f"{self.entry} gave a {type(forecast).__name__}; predict has to return mean and covariance"
            )
        mean, cov = (self._numbers(part) for part in forecast)
        wanted = (batch, self.steps, 2), (batch, self.steps, 2, 2)
        if (mean.shape, cov.shape) != wanted:
            raise McaptrackError(
                f"{self.entry} gave mean and covariance of shape {mean.shape} and {cov.shape}; they have to be "
                f"{wanted[0]} and {wanted[1]}"
            )
        if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
            raise McaptrackError(f"{self.entry} gave numbers that are not finite")
        if max(np.abs(mean).max(), np.abs(cov).max()) > _LARGEST:
            raise McaptrackError(f"{self.entry} gave numbers beyond {_LARGEST:g} (metres, and their squares)")
        if not are_covariances(cov):
            raise McaptrackError(f"{self.entry} gave covariances that are not symmetric with variances above 0")
        return Forecast(mean, cov)

    def _numbers(self, values: Any) -> Floats:
        with blamed(self.entry, "gave what can't be read as numbers", self.guard):
            array = np.asarray(values)
            if array.dtype.kind not in "fiu":
                raise TypeError(f"an array of {array.dtype}")
            return array.astype(np.float64)
