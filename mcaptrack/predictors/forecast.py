"""What a predictor says, and what a predictor is. Letters: B batch, L past positions, T future steps."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats


class Forecast(NamedTuple):
    """Where B people will be: ``mean`` (B, T, 2) in m, and ``cov`` (B, T, 2, 2) of the error in m^2."""

    mean: Floats
    cov: Floats


class Predictor(Protocol):
    """Forecasts from past positions on a regular clock of ``step_s`` seconds, ``steps`` of them.

    ``past`` is how many positions count. ``weights_sha256`` names learned weights; None where nothing was learned.
    """

    @property
    def name(self) -> str: ...
    @property
    def past(self) -> int: ...
    @property
    def steps(self) -> int: ...
    @property
    def step_s(self) -> float: ...
    @property
    def weights_sha256(self) -> str | None: ...

    def predict(self, xy_m: Floats, valid: NDArray[np.bool_]) -> Forecast:
        """Positions (B, L, 2), of which ``valid`` (B, L) are known and the last one always is -> B forecasts."""
        ...
