"""The built-in predictors by name: each makes a predictor for ``steps`` steps of ``step_s`` seconds.

A network has steps of its own, and may take a ``file`` of weights.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mcaptrack.predictors.linear import LinearPredictor

if TYPE_CHECKING:
    from mcaptrack.predictors.blend import Blend
    from mcaptrack.predictors.lstm import Lstm
    from mcaptrack.predictors.red import Red
    from mcaptrack.predictors.social import Social


def cv(steps: int, step_s: float) -> LinearPredictor:
    """Constant velocity."""
    return LinearPredictor("cv", steps, step_s)


def holt_cv(steps: int, step_s: float) -> LinearPredictor:
    """Constant velocity after Holt's double exponential smoothing."""
    return LinearPredictor("holt-cv", steps, step_s)


def kalman(steps: int, step_s: float) -> LinearPredictor:
    """A Kalman filter with a constant-velocity model."""
    return LinearPredictor("kalman", steps, step_s)


def red(steps: int, step_s: float, file: Path | None = None) -> Red:
    """A recurrent encoder with a dense head, with the weights of a file or those that come with mcaptrack."""
    from mcaptrack.predictors.red import Red
    from mcaptrack.predictors.weights import SHIPPED, load

    return Red.of(load(file or SHIPPED / "red.safetensors"))


def blend(steps: int, step_s: float, file: Path | None = None) -> Blend:
    """The mean of ``red`` and ``cv``, with the weights of a file or those that come with mcaptrack."""
    from mcaptrack.predictors.blend import Blend
    from mcaptrack.predictors.weights import SHIPPED, load

    return Blend.of(load(file or SHIPPED / "red.safetensors"))


def social(steps: int, step_s: float, file: Path | None = None) -> Social:
    """``red`` corrected by what other people do, with the weights of a file or those that come with mcaptrack."""
    from mcaptrack.predictors.social import Social
    from mcaptrack.predictors.weights import SHIPPED, load

    return Social.of(load(file or SHIPPED / "social.safetensors"))


def lstm(steps: int, step_s: float, file: Path | None = None) -> Lstm:
    """An LSTM encoder and decoder, with the weights of a file or those that come with mcaptrack."""
    from mcaptrack.predictors.lstm import Lstm
    from mcaptrack.predictors.weights import SHIPPED, load

    return Lstm.of(load(file or SHIPPED / "lstm.safetensors"))
