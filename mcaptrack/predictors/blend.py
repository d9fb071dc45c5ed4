"""The mean of a network and of constant velocity: it is better than either where one of them is off.

Letters: B batch, L past positions, T future steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

from mcaptrack.geometry.arrays import Bools, Floats
from mcaptrack.predictors.forecast import Forecast
from mcaptrack.predictors.linear import LinearPredictor
from mcaptrack.predictors.red import Red


@dataclass(frozen=True)
class Blend(Red):
    """The mean of what ``red`` and constant velocity predict, with the covariance of ``red``.

    ``red`` is better where positions are noisy, constant velocity where people walk straight on; their mean is no worse
    than constant velocity in either (docs/predictors.md has the figures).

    References
    ----------
    J. M. Bates and C. W. J. Granger, "The combination of forecasts", Operational Research Quarterly, 1969.
    """

    name: ClassVar[str] = "blend"
    network: ClassVar[str] = Red.name

    @cached_property
    def _constant_velocity(self) -> LinearPredictor:
        return LinearPredictor("cv", self.steps, self.step_s)

    def predict(self, xy_m: Floats, valid: Bools) -> Forecast:
        """Positions (B, L', 2), of which ``valid`` (B, L') are known, the last one always -> forecasts."""
        network, straight = super().predict(xy_m, valid), self._constant_velocity.predict(xy_m, valid)
        return network._replace(mean=(network.mean + straight.mean) / 2)
