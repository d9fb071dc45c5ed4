"""Predictors: recent positions in, distributions of future positions out, in batches of tracks.

Predictors are found by name (see ``mcaptrack.registry``). An entry is a class or a function; it is called with
``steps``, ``step_s`` and its own parameters, and returns a ``forecast.Predictor``. If it has a parameter ``file``, the
name ``NAME:FILE`` gives it. A predictor with other steps than requested, such as a network, is resampled
(``OnClock``), and one of another package is checked (``CheckedPredictor``): whatever it does wrong becomes one line
that names it. To add a built-in predictor: a module with its class and such a function, and a line in
``registry.BUILT_IN``.

Letters: B batch, L past positions, T future steps.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.files import missing
from mcaptrack.geometry.arrays import Bools, Floats
from mcaptrack.notices import warn
from mcaptrack.predictors.forecast import (
    AnyPredictor,
    Forecast,
    PeopleSeen,
    Predictor,
    are_covariances,
    predict_among,
    predict_together,
    uses_people,
)
from mcaptrack.registry import Entry, blamed, failure, find, own, split_file
from mcaptrack.registry.guard import Guard

__all__ = [
    "NAMES",
    "AnyPredictor",
    "Forecast",
    "PeopleSeen",
    "Predictor",
    "PredictorName",
    "are_covariances",
    "entry_of",
    "make",
    "predict_among",
    "predict_together",
    "uses_people",
    "warn_if_weak",
    "weights_sha256",
]

#: A predictor by name: built-in, of an entry point, or ``module:Class``; or a network with other weights, as in
#: ``red:FILE``, ``lstm:FILE``.
PredictorName = str
#: The built-in predictors that need no file.
NAMES: Final = ("blend", "cv", "holt-cv", "kalman", "lstm", "red", "social")
#: Those that are less exact than ``cv`` on most recordings (docs/predictors.md).
WEAK: Final = ("lstm",)


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
                past, is_known = self._past(people.xy_m, people.valid)
                people = people._replace(xy_m=past, valid=is_known)
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
        is_known = valid[:, low] & valid[:, high] & is_inside
        past = (1 - share) * xy_m[:, low] + share * xy_m[:, high]
        # A neighbour with share 0 may be NaN.
        past = np.where(share == 0, xy_m[:, low], past)
        return np.where(is_known[..., None], past, np.nan), is_known

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


_WRONG = (TypeError, ValueError, OverflowError)
#: More steps than anything predicts or looks at; arrays of more do not fit into memory.
_MOST_STEPS: Final = 10_000
#: Beyond the square of any distance on Earth; distances and likelihoods of larger numbers overflow.
_LARGEST: Final = 1e15


@dataclass(frozen=True)
class CheckedPredictor:
    """``inner``, a predictor of another package, which the registry found as ``entry``."""

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
        if not (0 < steps <= _MOST_STEPS and 0 < past <= _MOST_STEPS and 0 < step_s < np.inf):
            raise McaptrackError(
                f"{entry} has steps={steps}, step_s={step_s:g}, past={past}; all have to be above 0, steps and past at "
                f"most {_MOST_STEPS}"
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

    def predict(self, xy_m: Floats, valid: Bools, people: PeopleSeen | None = None) -> Forecast:
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


def make(name: PredictorName, steps: int, step_s: float, **parameters: Any) -> Predictor:
    """Make a predictor for ``steps`` steps of ``step_s`` seconds.

    If a network predicts less far, its predictions are extrapolated at constant velocity, with a warning.

    Parameters
    ----------
    name : str
        Built-in name, name of an entry point, or ``module:Class``; ``NAME:FILE`` for one with a parameter ``file``.
    steps : int
        Number of future steps.
    step_s : float
        Length of a step in seconds, in the past and in the future.
    **parameters
        Other parameters of the predictor.

    Returns
    -------
    Predictor

    Raises
    ------
    McaptrackError
        If there is no such predictor, or if its file can't be read.

    Examples
    --------
    A track at 1 m/s, known for three steps of 0.4 s:

    >>> import numpy as np
    >>> predictor = make("cv", steps=2, step_s=0.4)
    >>> forecast = predictor.predict(np.array([[[0.0, 0.0], [0.4, 0.0], [0.8, 0.0]]]), np.ones((1, 3), bool))
    >>> forecast.mean[0, :, 0].round(3).tolist()
    [1.2, 1.6]
    """
    entry, file = entry_of(name)
    inner = _build(entry, file, steps, step_s, parameters)
    if inner.steps == steps and abs(inner.step_s / step_s - 1) < 1e-6:
        return inner
    ahead_s, own_s = steps * step_s, inner.steps * inner.step_s
    if ahead_s > own_s + inner.step_s / 2:
        warn(
            f"{name} predicts {own_s:.3g} s ahead; beyond it, up to {ahead_s:.3g} s, predictions are a straight line",
            "extrapolated",
        )
    return OnClock(inner, steps, step_s)


def warn_if_weak(name: PredictorName) -> None:
    """Warn that a predictor that comes with mcaptrack is less exact than constant velocity.

    ``name`` is its name in the registry; nothing is said of others.
    """
    if name in WEAK:
        warn(
            f"{name}, the paper's network, predicts less exactly than constant velocity (cv) on most recordings; "
            "blend predicts better",
            "weak-predictor",
        )


def entry_of(name: PredictorName) -> tuple[Entry, Path | None]:
    """The entry of a predictor's name, and the file of ``NAME:FILE``, if there is one.

    Raises McaptrackError if there is no such predictor or file.
    """
    kind, file = split_file("predictor", name)
    if file is None:
        entry = find("predictor", name)
        if _file_of(entry) is inspect.Parameter.empty:
            if ":" in name:
                raise McaptrackError(
                    f"predictor {name} needs a file; only one with an entry point takes one, as in NAME:FILE"
                )
            raise McaptrackError(f"predictor {name} needs a file, as in {name}:FILE")
        return entry, None
    entry = find("predictor", kind)
    if not file or _file_of(entry) is _NO_FILE:
        those = [kind for kind in own("predictor") if _file_of(find("predictor", kind)) is not _NO_FILE]
        text = ", ".join(f"{kind}:FILE" for kind in those)
        raise McaptrackError(f"predictor is one of {', '.join(NAMES)}, or {text}, not {name}")
    if not Path(file).is_file():
        raise McaptrackError(f"predictor {name}: {missing(Path(file))}")
    return entry, Path(file)


def weights_sha256(name: PredictorName) -> str:
    """SHA-256 of the weights of a predictor; "" if it has none. Raises McaptrackError as ``make`` does.

    ``name`` is its name in the registry, with FILE after a colon for weights of a user.
    """
    entry, file = entry_of(name)
    if entry.is_built_in and _file_of(entry) is _NO_FILE:
        return ""
    return _build(entry, file, 1, 1.0, {}).weights_sha256 or ""


#: Result of ``_file_of`` for a predictor without a parameter ``file``.
_NO_FILE: Final = object()


def _file_of(entry: Entry) -> Any:
    """The default of a predictor's parameter ``file``: ``Parameter.empty`` if it has none, ``_NO_FILE`` without it."""
    try:
        parameters = inspect.signature(entry.cls).parameters
    except (TypeError, ValueError):
        return _NO_FILE
    return parameters["file"].default if "file" in parameters else _NO_FILE


def _build(entry: Entry, file: Path | None, steps: int, step_s: float, parameters: Mapping[str, Any]) -> Predictor:
    options = {"file": file} if file else {}
    if entry.is_built_in:
        predictor: Predictor = entry.cls(steps=steps, step_s=step_s, **options, **parameters)
        return predictor
    return CheckedPredictor.of(entry, {"steps": steps, "step_s": step_s, **options, **parameters})
