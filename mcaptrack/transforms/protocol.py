"""The interface of transforms, and their parameters.

A transform is a frozen, keyword-only dataclass. Its fields are its parameters: each has a default, its unit at the end
of its name and a help text. They become the options of its command, and are stored in the provenance of its channels.
Calling it with an iterable of frames gives an iterator of tuples of frames, one frame for each of its outputs.

Further class attributes are optional: ``Traits`` declares all of them, with their defaults.

A transform of another package needs the main output "" only; the others of the built-in transforms of its stage may be
missing, or be further ones, but that a fuser has both. An output that has the name of a built-in one has its schema.
Results that a former transform of a stage made and this one doesn't make are removed, with what was made of them.

All transforms obey these laws; ``mcaptrack.testing.check_transform`` tests them:

* Schema: the rows of every output have the columns of its schema, with valid values.
* Time: the times of an output never decrease.
* Causality: on a prefix of the input, outputs equal those on the whole input, except within ``latency_s`` of the end of
  the prefix.
* Purity: the same input gives the same output, also for two runs at the same time.
* Order: another order of the rows of a frame changes nothing but track ids.
* Empty frames: frames without rows are accepted anywhere.
* Process: the working folder, sys.path, the handling of signals and warnings, NumPy's handling of errors, the recursion
  limit, the locale and the random states are as before (``mcaptrack.registry.guard`` undoes changes, with a warning).
"""

from __future__ import annotations

import inspect
import math
import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from types import MappingProxyType, UnionType
from typing import (
    Any,
    ClassVar,
    Final,
    Literal,
    NamedTuple,
    Protocol,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

from mcaptrack.choices import limits
from mcaptrack.errors import McaptrackError
from mcaptrack.registry import KINDS, Kind
from mcaptrack.schema import Frame, Schema

__all__ = [
    "Colour", "ModelCard", "Suited", "Transform", "bare_type", "check_options", "context", "option", "parameters",
    "setting",
]  # fmt: skip

T = TypeVar("T")


class WithOptions(Protocol):
    """A dataclass of options: a transform, or what several transforms share."""

    __dataclass_fields__: ClassVar[dict[str, Any]]


class Transform(WithOptions, Protocol):
    """A transform of frames: see the module.

    Attributes
    ----------
    reads : Schema
        Schema of the input.
    writes : Mapping[str, Schema]
        Schema of each output by the suffix of its topic; "" is the main output.
    latency_s : Mapping[str, float]
        For each output, how far it depends on later input, in seconds: 0 if it is causal, infinity for the whole log.
        A class attribute, or a property if it depends on parameters; ``latency_of`` gives it.
    """

    # latency_s isn't declared: no declaration lets type checkers take both a class attribute and a property.
    reads: ClassVar[Schema]
    writes: ClassVar[Mapping[str, Schema]]

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]: ...


def latency_of(transform: Transform) -> Mapping[str, float]:
    """For each output of a transform, how far it depends on later input, in seconds: its ``latency_s``."""
    latency_s: Mapping[str, float] = transform.latency_s  # type: ignore[attr-defined]
    return latency_s


class ModelCard(NamedTuple):
    """A description of the network of a transform, for the provenance of its channels: the digest of its file
    (``weights_sha256``), the names of the classes in its rows by ``class_id``, and other facts.

    A transform with a network may have a method ``model_card`` that gives it after a run.
    """

    weights_sha256: str = ""
    classes: Mapping[int, str] = MappingProxyType({})
    facts: Mapping[str, str] = MappingProxyType({})


class Suited(NamedTuple):
    """The entry of another stage, by its name, that suits the output of a transform, for the trait ``suits``.

    ``parameters`` are those that it is made with; where a ground plane is given, those of ``on_ground`` are added.
    """

    name: str
    parameters: Mapping[str, Any] = MappingProxyType({})
    on_ground: Mapping[str, Any] = MappingProxyType({})


#: What a transform gets of pictures: brightness, (height, width), or blue, green and red, (height, width, 3).
Colour = Literal["bgr", "grey"]
#: Where a tracker associates: boxes in pixels, or positions in metres.
Space = Literal["picture", "ground"]


@dataclass(frozen=True, kw_only=True)
class Traits:
    """Facts about a transform beside its interface: class attributes of these names, all optional.

    One that depends on parameters is a property. ``traits_of`` gives those of a transform.

    Attributes
    ----------
    colour : {"grey", "bgr"}
        What a transform that reads pictures gets: brightness, (height, width), or blue, green and red, (height, width,
        3).
    passes : {1, 2}
        How often it reads its frames; with 2 they can be iterated twice, each time from the beginning.
    suits : mapping of str to str or Suited
        The tracker that suits a detector, as in ``{"tracker": "bytetrack"}``; ``run`` takes it unless another is
        chosen. A ``Suited`` gives parameters of it, too.
    space : {"picture", "ground"}
        Whether a tracker takes boxes in pixels or positions in metres.
    needs_still_camera : bool
        Whether a detector finds what moves: then ``run`` doesn't estimate the motion of the camera for trackers.
    keeps_unseen : bool
        Whether rows that are not observed and lie outside of the picture stay in the log.
    leaves_unchanged : bool
        Whether a re-tracker passes its input on as it is, but that tracks may be cut, or continue others; then all
        boxes stay at the rate of the video.
    """

    colour: Colour = "grey"
    passes: Literal[1, 2] = 1
    suits: Mapping[str, str | Suited] = field(default_factory=lambda: MappingProxyType({}))
    space: Space = "picture"
    needs_still_camera: bool = False
    keeps_unseen: bool = False
    leaves_unchanged: bool = False

    def suited(self, kind: str) -> Suited | None:
        """The entry of a kind (see ``mcaptrack.registry``) that suits the output; None if it names none."""
        suited = self.suits.get(kind)
        return Suited(suited) if isinstance(suited, str) else suited


def traits_of(transform: Any) -> Traits:
    """The traits of a transform, or of its class (without those that depend on parameters)."""
    traits = {trait.name: getattr(transform, trait.name) for trait in fields(Traits) if hasattr(transform, trait.name)}
    return Traits(**{name: value for name, value in traits.items() if not isinstance(value, property)})


def trait_problem(cls: type[Any]) -> str:
    """Describe the first class attribute that can't be the trait of its name; "" if all can."""
    traits, hints = traits_of(cls), get_type_hints(Traits)
    for trait in fields(Traits):
        value, names = getattr(traits, trait.name), get_args(hints[trait.name])
        if trait.name == "suits":
            if not isinstance(value, Mapping) or not all(
                kind in KINDS and isinstance(suited, str | Suited) for kind, suited in value.items()
            ):
                return f"has suits = {value!r}; it maps kinds to names, as in suits = {{'tracker': 'bytetrack'}}"
        elif hints[trait.name] is bool and not isinstance(value, bool):
            return f"has {trait.name} = {value!r}; it is True or False"
        elif hints[trait.name] is not bool and value not in names:
            return f"has {trait.name} = {value!r}; it is {' or '.join(map(repr, names))}"
    return ""


#: The default upper end of parameters with a lower one: days in seconds, hundreds of kilometres in metres.
LARGEST: Final = 1e6


def option(
    default: Any,
    help: str = "",  # noqa: A002
    *,
    least: float = -math.inf,
    most: float | None = None,
    search: tuple[float, float] | None = None,
    kind: Kind | None = None,
    theme: str = "",
    pattern: str = "",
    flag: bool = True,
) -> Any:
    """Declare a parameter of a transform, as a field of its dataclass.

    Parameters
    ----------
    default
        Its default value.
    help : str
        What it means, in lower case and without a full stop; ``parameters`` takes it from the docstring instead.
    least, most : float
        The range of a number. With ``least`` alone, ``most`` is ``LARGEST``, so that times in nanoseconds and counts of
        steps fit 64 bits.
    search : tuple of float or None
        The range that ``mcaptrack tune`` searches; None if the parameter is not tuned.
    kind : str or None
        The value is a name of this kind in ``mcaptrack.registry``.
    theme : str
        Heading in the help of the command, shared by related parameters.
    pattern : str
        Regular expression of a text that a settings file in the working folder may set; "" for none.
    flag : bool
        Whether the command has an option of its own for it. Without one it is set by ``--set name=value``: this
        is for values that follow from an experiment, as in a paper, and not from the task of a user.

    Returns
    -------
    dataclasses.Field

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True, kw_only=True)
    ... class Example:
    ...     max_age_s: float = option(1.4, "a track ends after this many seconds without a detection", least=0.0)
    >>> Example().max_age_s
    1.4
    """
    if most is None:
        most = math.inf if least == -math.inf else LARGEST
    about = {"help": help, "least": least, "most": most, "search": search, "kind": kind, "theme": theme}
    about |= {"pattern": pattern, "flag": flag}
    return field(default=default, metadata=about)


def setting(default: Any, help: str = "", **about: Any) -> Any:  # noqa: A002
    """Declare a parameter as ``option`` does that only ``--set`` sets: the command has no option of its own for it.

    ``default``, ``help`` and ``about`` are parameters of ``option``.
    """
    return option(default, help, flag=False, **about)


def parameters(cls: type[T]) -> type[T]:
    """Take the help of parameters from the section Parameters of the docstring, as commands are declared; objects check
    their values. This is for a class that becomes a dataclass.
    """
    _, *sections = re.split(r"^(\w+)\n-+\n", inspect.cleandoc(cls.__doc__ or ""), flags=re.M)
    text = dict(zip(sections[::2], sections[1::2], strict=True)).get("Parameters", "")
    for name, lines in re.findall(r"^(\w+) : .+\n((?: +.+\n?)+)", text, flags=re.M):
        meaning = " ".join(lines.split()).removesuffix(".")
        if not meaning[1:2].isupper():  # an abbreviation
            meaning = meaning[:1].lower() + meaning[1:]
        declared = vars(cls)[name]
        setattr(cls, name, field(default=declared.default, metadata={**declared.metadata, "help": meaning}))
    if not hasattr(cls, "__post_init__"):
        cls.__post_init__ = check_options  # type: ignore[attr-defined]
    return cls


def context(factory: Callable[[], Any], *, is_recorded: bool = True) -> Any:
    """Declare a parameter that the log gives, not the user: the ground planes, or the time of the first frame.

    Parameters
    ----------
    factory : callable
        Returns its default value.
    is_recorded : bool, default True
        Whether the provenance holds its value. What is too large for that is a channel of the log, of which the
        provenance holds the digest.

    Returns
    -------
    dataclasses.Field
    """
    return field(default_factory=factory, metadata={"context": True, "is_recorded": is_recorded})


def choices(annotation: Any) -> tuple[str, ...]:
    """The names that a parameter with this annotation accepts; () unless it is a Literal."""
    return tuple(str(name) for name in get_args(annotation)) if get_origin(annotation) is Literal else ()


#: Types of parameters, and the types of values that each accepts.
_KINDS: Final[Mapping[type, tuple[type, ...]]] = {float: (int, float), int: (int,), bool: (bool,), str: (str,)}


def bare_type(annotation: Any) -> Any:
    """The type in the annotation of a parameter without ``| None``."""
    parts = [part for part in get_args(annotation) if part is not type(None)]
    return parts[0] if get_origin(annotation) in (UnionType, typing.Union) and len(parts) == 1 else annotation


def member_type(annotation: Any) -> tuple[Any, bool]:
    """The type of a parameter, or of the members of one that is a tuple of any length; and whether it is a tuple."""
    kind = bare_type(annotation)
    if get_origin(kind) is tuple and get_args(kind)[1:] == (Ellipsis,):
        return get_args(kind)[0], True
    return kind, False


def is_option_type(annotation: Any) -> bool:
    """Whether an option can have this type."""
    kind, _ = member_type(annotation)
    return kind in _KINDS or (bool(choices(kind)) and all(isinstance(choice, str) for choice in get_args(kind)))


@cache
def option_problem(cls: type[Any]) -> str:
    """The reason why the fields of a class can't be options; "" if they can."""
    try:
        hints = get_type_hints(cls)
    except Exception as error:  # annotations are code
        return f"the types of its fields can't be read: {type(error).__name__}: {error}"
    for parameter in fields(cls):
        if not (parameter.metadata.get("context") or is_option_type(hints[parameter.name])):
            return (
                f"{cls.__name__}.{parameter.name} has the type {_type_name(hints[parameter.name])}; a parameter is a "
                "float, an int, a bool, a str, a Literal of names, a tuple of any length of one of these, or one of "
                "them or None"
            )
        if not parameter.init:
            return f"{cls.__name__}.{parameter.name} can't be given (init=False); make it a property"
        if parameter.default is MISSING and parameter.default_factory is MISSING:
            return f"{cls.__name__}.{parameter.name} has no default; every parameter needs one"
    return ""


def _type_name(annotation: Any) -> str:
    return annotation.__name__ if isinstance(annotation, type) and not get_args(annotation) else str(annotation)


def check_options(transform: WithOptions) -> None:
    """Check the values of all parameters of a transform. To be called in ``__post_init__``.

    Raises
    ------
    McaptrackError
        If a value is out of range or of the wrong type, or if a field has a type that options can't have.
    """
    if problem := option_problem(type(transform)):
        raise McaptrackError(problem)
    hints = get_type_hints(type(transform))
    for parameter in fields(transform):
        if parameter.metadata.get("context"):
            continue
        value, name = getattr(transform, parameter.name), parameter.name
        kind, is_tuple = member_type(hints[name])
        if value is None and bare_type(hints[name]) is not hints[name]:
            continue
        if is_tuple and not isinstance(value, tuple):
            raise McaptrackError(f"{name} needs a tuple, not {value!r}")
        for item in value if is_tuple else (value,):
            _check_value(name, item, kind, parameter.metadata)


def _check_value(name: str, value: Any, kind: Any, about: Mapping[str, Any]) -> None:
    if names := choices(kind):
        if value not in names:
            raise McaptrackError(f"{name} is one of {', '.join(names)}, not {value}")
        return
    if not isinstance(value, _KINDS[kind]) or (isinstance(value, bool) and kind is not bool):
        raise McaptrackError(f"{name} needs {kind.__name__}, not {value!r}")
    if value in (math.inf, -math.inf):
        raise McaptrackError(f"{name} has to be finite, which {value} is not; None may stand for no limit")
    least, most = about.get("least", -math.inf), about.get("most", math.inf)
    if kind in (int, float) and not least <= value <= most:
        raise McaptrackError(f"{name} has to be {limits(least, most) or 'a number'}, not {value}")
