"""Predict future positions of tracks at a fixed rate, with a predictor of the registry."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, make_dataclass
from functools import cache
from types import MappingProxyType
from typing import Any, ClassVar, Final, NamedTuple, get_type_hints

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.histories import Histories
from mcaptrack.predictors import PredictorName, entry_of, warn_if_weak
from mcaptrack.registry import Entry
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Schema
from mcaptrack.transforms.forecasts import ADAPT_HELP, Forecaster, PastPositions
from mcaptrack.transforms.motion_limits import LIMITS_HELP, LIMITS_PATTERN, ClassNames, read_limits
from mcaptrack.transforms.protocol import check_options, context, is_option_type, option, parameters, setting

# The own parameters of predictors of other packages: those beside the number and the length of steps.


#: Parameters that a predictor gets from the caller, and attributes of ``forecast.Predictor``: they are no options.
_INTERFACE: Final = frozenset({"steps", "step_s", "file", "past", "name", "weights_sha256", "uses_people"})
_NAMED: Final = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


class OwnOption(NamedTuple):
    """A parameter: its name, type and default, and what a field made with ``option()`` declares."""

    name: str
    annotation: Any
    default: Any
    metadata: Mapping[str, Any]


def own_options(predictor: Callable[..., Any]) -> list[OwnOption]:
    """The own parameters of a predictor's class or function that have a default.

    The type of a parameter without an annotation is that of its default.
    """
    is_class = isinstance(predictor, type)
    declared: dict[str, Field[Any]] = {f.name: f for f in fields(predictor)} if is_dataclass(predictor) else {}
    try:
        parameters = inspect.signature(predictor).parameters.values()
        hints = get_type_hints(predictor.__init__ if is_class and not declared else predictor)
    except Exception:  # annotations are code of another package
        return []
    out = []
    for parameter in parameters:
        name, default = parameter.name, parameter.default
        field = declared.get(name)
        if field is not None and field.default_factory is not MISSING:
            default = field.default_factory()
        if name in _INTERFACE or default is inspect.Parameter.empty or parameter.kind not in _NAMED:
            continue
        annotation = hints.get(name, type(default))
        if default is None:
            annotation = annotation | None
        out.append(OwnOption(name, annotation, default, field.metadata if field else {}))
    return out


@dataclass(frozen=True, kw_only=True)
@parameters
class Predict:
    """Predict where tracked people go.

    Reads samples, writes predictions: one row per track and future step, for tracks with enough past positions.

    Parameters
    ----------
    predictor : str
        Predictor: blend, the mean of red and cv; red, cv, holt-cv, kalman; social, which looks at other people; or
        lstm, which is less exact than cv; with other weights red:FILE and so on; one of an extension or an
        installed package; or module:Class.
    horizon_s : float
        How far ahead to predict, in seconds.
    min_history : int
        Number of positions, the current one included, that a prediction needs.

    Examples
    --------
    A person walks 1 m/s; the prediction at 2.5 samples per second continues at that speed:

    >>> from mcaptrack.schema import TRACKS, Frame
    >>> def row(x_m):
    ...     return TRACKS.rows(track_id=[1], x_m=[x_m], y_m=[0.0], observed=[True], source_id=[-1])
    >>> frames = [Frame(t * 400_000_000, t, row(0.4 * t)) for t in range(5)]
    >>> *_, (last,) = Predict(predictor="cv", horizon_s=1.2)(frames)
    >>> last.rows["x_m"].round(3).tolist()
    [2.0, 2.4, 2.8]
    """

    predictor: PredictorName = option("blend", kind="predictor")
    horizon_s: float = option(4.8, least=0.1, most=60.0)
    min_history: int = setting(4, least=1, most=100)
    adapt: bool = setting(True, ADAPT_HELP)
    class_limits: str = setting("", LIMITS_HELP, pattern=LIMITS_PATTERN)
    rate_hz: float = context(lambda: 2.5)
    class_names: ClassNames = context(tuple, is_recorded=False)

    reads: ClassVar[Schema] = TRACKS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": PREDICTIONS})
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": 0.0})

    #: The parameters that are those of the predictor (see ``predict_with``).
    own_options: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        check_options(self)
        read_limits(self.class_limits)
        entry, _ = entry_of(self.predictor)
        if self.own_options and predict_with(self.predictor) is not type(self):
            raise McaptrackError(f"{', '.join(self.own_options)} are no parameters of {entry}")

    def forecaster(self, histories: Callable[[int], PastPositions] = Histories) -> Forecaster:
        """The predictor with its options; ``histories`` keeps the past positions."""
        warn_if_weak(self.predictor)
        own = {name: getattr(self, name) for name in self.own_options}
        classes = self.class_names, self.class_limits
        rates = self.predictor, self.horizon_s, self.min_history, self.rate_hz
        return Forecaster(*rates, *classes, histories, self.adapt, **own)

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        forecaster = self.forecaster()
        for frame in frames:
            yield (frame._replace(rows=forecaster.predict(frame)),)
        forecaster.warn()

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why there are no predictions, for a warning."""
        needed_s = (self.min_history - 1) / self.rate_hz
        return f"no track has the {needed_s:.3g} s without a gap that a prediction needs (min_history)"


def predict_with(predictor: PredictorName) -> type[Predict]:
    """The transform for a predictor: ``Predict`` with the predictor's own parameters as fields, if it has any.

    Only predictors of other packages have own parameters. Those of a type that options can't have keep their defaults.
    Raises McaptrackError if there is no such predictor, or if a parameter has the name of one of ``Predict``.
    """
    entry, _ = entry_of(predictor)
    return Predict if entry.is_built_in else _with_own_options(entry)


@cache
def _with_own_options(entry: Entry) -> type[Predict]:
    own = [option for option in own_options(entry.cls) if is_option_type(option.annotation)]
    if not own:
        return Predict
    if taken := {option.name for option in own} & {option.name for option in fields(Predict)}:
        raise McaptrackError(f"{entry} can't have a parameter {', '.join(sorted(taken))}: that is one of predict")
    variant: type[Predict] = make_dataclass(
        f"{Predict.__name__} with {entry.name}",
        [(option.name, option.annotation, field(default=option.default, metadata=option.metadata)) for option in own],
        bases=(Predict,),
        namespace={
            "own_options": tuple(option.name for option in own),
            "variant_of": Predict,
            "__doc__": Predict.__doc__,
        },
        frozen=True,
        kw_only=True,
    )
    return variant
