"""Predictors: recent positions in, distributions of future positions out, one batch at a time.

To add one: a class with ``predict`` (see ``forecast.Predictor``) and a name in ``make``.
"""

from __future__ import annotations

from typing import Literal

from mcaptrack.predictors.forecast import Forecast, Predictor
from mcaptrack.predictors.linear import LinearPredictor

__all__ = ["Forecast", "Predictor", "PredictorName", "make"]

PredictorName = Literal["cv", "holt-cv", "kalman"]


def make(name: PredictorName, steps: int, step_s: float) -> Predictor:
    """The predictor of that name for ``steps`` steps of ``step_s`` seconds."""
    return LinearPredictor(name, steps, step_s)
