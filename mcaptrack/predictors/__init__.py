"""Predictors: recent positions in, distributions of future positions out, one batch at a time.

To add one: a class with ``predict`` (see ``forecast.Predictor``) and a name in ``make``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from mcaptrack.errors import McaptrackError
from mcaptrack.notices import warn
from mcaptrack.predictors.forecast import Forecast, Predictor
from mcaptrack.predictors.linear import LinearPredictor
from mcaptrack.predictors.own_clock import OnClock

__all__ = ["NAMES", "Forecast", "Predictor", "PredictorName", "check", "make", "weights_sha256"]

#: A predictor by name: one of NAMES, or a network with other weights, as in ``red:FILE``, ``lstm:FILE``, ``onnx:FILE``.
PredictorName = str
NAMES: Final = ("cv", "holt-cv", "kalman", "lstm", "red")
_WITH_FILE: Final = ("lstm", "red", "onnx")


def make(name: PredictorName, steps: int, step_s: float) -> Predictor:
    """The predictor of that name for ``steps`` steps of ``step_s`` seconds.

    A network that predicts less far than that is continued in a straight line, with a warning. Raises McaptrackError if
    there is none of that name, or if its file can't be read.
    """
    kind, file = check(name)
    if kind not in _WITH_FILE:
        return LinearPredictor(kind, steps, step_s)
    inner = _network(kind, file)
    ahead_s, own_s = steps * step_s, inner.steps * inner.step_s
    if ahead_s > own_s + inner.step_s / 2:
        warn(
            f"{name} predicts {own_s:.3g} s ahead; what is asked for beyond, up to {ahead_s:.3g} s, is a straight line",
            "extrapolated",
        )
    same = inner.steps == steps and abs(inner.step_s / step_s - 1) < 1e-6
    return inner if same else OnClock(inner, steps, step_s)


def check(name: PredictorName) -> tuple[str, Path | None]:
    """The kind of predictor that a name means, and its file. Raises McaptrackError if there can't be such a one."""
    kind, colon, file = name.partition(":")
    if (colon and (kind not in _WITH_FILE or not file)) or (not colon and kind not in NAMES):
        files = ", ".join(f"{known}:FILE" for known in _WITH_FILE)
        raise McaptrackError(f"predictor is one of {', '.join(NAMES)}, or {files}, not {name}")
    if file and not Path(file).is_file():
        raise McaptrackError(f"predictor {name}: there is no file {file}")
    return kind, Path(file) if file else None


def weights_sha256(name: PredictorName) -> str:
    """The digest of the weights of that predictor; "" where nothing was learned. Raises McaptrackError as ``make``."""
    kind, file = check(name)
    return (_network(kind, file).weights_sha256 or "") if kind in _WITH_FILE else ""


def _network(kind: str, file: Path | None) -> Predictor:
    """A network with the weights of a file, or with those that come with mcaptrack. Heavy imports stay in here."""
    if kind == "onnx":
        from mcaptrack.predictors.onnx import Onnx

        return Onnx.of(file or Path())
    from mcaptrack.predictors.lstm import Lstm
    from mcaptrack.predictors.red import Red
    from mcaptrack.predictors.weights import SHIPPED, load

    weights = load(file or SHIPPED / f"{kind}.safetensors")
    return Red.of(weights) if kind == "red" else Lstm.of(weights)
