"""The own parameters of predictors of other packages: those beside the number and the length of steps."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any, Final, NamedTuple, get_type_hints

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
