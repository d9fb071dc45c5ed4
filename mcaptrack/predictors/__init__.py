"""Predictors: recent positions in, distributions of future positions out, one batch at a time.

A predictor is found by name (see ``mcaptrack.registry``): what is found is called with ``steps`` and ``step_s``, and
with what other parameters it declares, and gives a ``forecast.Predictor``. One that takes a ``file`` is also found as
``NAME:FILE``. A predictor whose steps are not those that were asked for, as a network's may be, is resampled
(``own_clock.OnClock``). To add a built-in one: a function in ``built_in``, and a line in ``registry.BUILT_IN``.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.notices import warn
from mcaptrack.predictors.checked import CheckedPredictor
from mcaptrack.predictors.forecast import Forecast, Predictor
from mcaptrack.predictors.own_clock import OnClock
from mcaptrack.registry import BUILT_IN, Entry, find, is_installed

__all__ = ["NAMES", "Forecast", "Predictor", "PredictorName", "entry_of", "make", "weights_sha256"]

#: A predictor by name: built-in, of an entry point, or ``module:Class``; or a network with other weights, as in
#: ``red:FILE``, ``lstm:FILE``, ``onnx:FILE``.
PredictorName = str
#: The built-in predictors that need no file.
NAMES: Final = ("cv", "holt-cv", "kalman", "lstm", "red")


def make(name: PredictorName, steps: int, step_s: float, **parameters: Any) -> Predictor:
    """Make a predictor for ``steps`` steps of ``step_s`` seconds.

    A network that predicts less far than that is continued in a straight line, with a warning.

    Parameters
    ----------
    name : str
        A built-in name, one of an entry point, or ``module:Class``; ``NAME:FILE`` where it takes a file.
    steps : int
        How many future steps.
    step_s : float
        How long a step is, in seconds; the past has the same steps.
    **parameters
        Other parameters of the predictor.

    Returns
    -------
    Predictor

    Raises
    ------
    McaptrackError
        If there is none of that name, or if its file can't be read.

    """
    entry, file = entry_of(name)
    inner = _made(entry, file, steps, step_s, parameters)
    if inner.steps == steps and abs(inner.step_s / step_s - 1) < 1e-6:
        return inner
    ahead_s, own_s = steps * step_s, inner.steps * inner.step_s
    if ahead_s > own_s + inner.step_s / 2:
        warn(
            f"{name} predicts {own_s:.3g} s ahead; what is asked for beyond, up to {ahead_s:.3g} s, is a straight line",
            "extrapolated",
        )
    return OnClock(inner, steps, step_s)


def entry_of(name: PredictorName) -> tuple[Entry, Path | None]:
    """What the registry has of a predictor's name, and the file that the name ends with, if it does.

    Raises McaptrackError if there is no such predictor or file.
    """
    kind, colon, file = name.partition(":")
    if not colon or not is_installed("predictor", kind):
        entry = find("predictor", name)
        if _file_of(entry) is inspect.Parameter.empty:
            raise McaptrackError(f"predictor {name} needs a file, as in {name}:FILE")
        return entry, None
    entry = find("predictor", kind)
    if not file or _file_of(entry) is _NO_FILE:
        those = [one for one in BUILT_IN["predictor"] if _file_of(find("predictor", one)) is not _NO_FILE]
        words = ", ".join(f"{one}:FILE" for one in those)
        raise McaptrackError(f"predictor is one of {', '.join(NAMES)}, or {words}, not {name}")
    if not Path(file).is_file():
        raise McaptrackError(f"predictor {name}: there is no file {file}")
    return entry, Path(file)


def weights_sha256(name: PredictorName) -> str:
    """The digest of the weights of that predictor; "" where nothing was learned. Raises McaptrackError as ``make``."""
    entry, file = entry_of(name)
    if entry.is_built_in and _file_of(entry) is _NO_FILE:
        return ""
    return _made(entry, file, 1, 1.0, {}).weights_sha256 or ""


#: What ``_file_of`` gives for a predictor that takes no file.
_NO_FILE: Final = object()


def _file_of(entry: Entry) -> Any:
    """The default of a predictor's parameter ``file``: empty if it is required, ``_NO_FILE`` if there is none."""
    try:
        parameters = inspect.signature(entry.cls).parameters
    except (TypeError, ValueError):
        return _NO_FILE
    return parameters["file"].default if "file" in parameters else _NO_FILE


def _made(entry: Entry, file: Path | None, steps: int, step_s: float, parameters: Mapping[str, Any]) -> Predictor:
    given = {"file": file} if file else {}
    if entry.is_built_in:
        made: Predictor = entry.cls(steps=steps, step_s=step_s, **given, **parameters)
        return made
    return CheckedPredictor.of(entry, {"steps": steps, "step_s": step_s, **given, **parameters})
