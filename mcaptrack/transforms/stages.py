"""The stages of the pipeline: what each reads and writes, and the places of its transforms, imported when used.

To add a stage: its transform, and a ``Stage`` in ``STAGES``. To add a transform to a stage with a kind: a line in
``mcaptrack.registry.BUILT_IN``. Options, help, provenance and the tests of the laws follow from these.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from pkgutil import resolve_name
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

from mcaptrack.errors import McaptrackError, offer
from mcaptrack.registry import Entry, Kind, blamed, entry_of, find, names, others, own, split_file
from mcaptrack.schema import (
    APPEARANCE,
    CAMERA_MOTION,
    DECISIONS,
    DETECTIONS,
    PREDICTIONS,
    SCHEMAS,
    TRACKS,
    VIDEO,
    WORLDS,
    Schema,
)
from mcaptrack.transforms.protocol import Transform, check_options, option_problem, trait_problem

#: Steps before and after a transform (``mcaptrack.pipeline.steps``).
StepBefore = Literal["memory", "planes", "scale", "corrections", "scene", "log-before", "scores"]
StepAfter = Literal["one-class", "log-before", "video-rate", "pictures", "seen"]
#: Suffix of the topic of tracks at the video's rate (the step "video-rate").
FULL: Final = "/full"
#: Last parts of topics that outputs can't have, beside names of finishers: these are made of the results of stages.
RESERVED: Final = frozenset({"full", "view", "counts", "errors", "scores"})
#: The field for the file that a name may end with, as in ``NAME:FILE``.
_FILE: Final = "file"


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A stage of the pipeline.

    Attributes
    ----------
    name : str
        Name of the stage and of its command.
    reads : Schema
        The schema of its input.
    writes : Mapping[str, Schema]
        The schemas of its outputs, by the last part of their topics; "" for the main one.
    input_topic, output_topic : str
        Topics below the name of a camera, as in ``tracks``: what it reads, and its main output.
    rows : str
        The noun for its rows, in the plural.
    kind : Kind or None
        The kind of its transforms in the registry, which is also the name of the option that chooses one; None if there
        is one transform only.
    parameter : Kind or ""
        The parameter of its transform that names an entry of the registry, such as its predictor; ``run`` has an option
        of the same name.
    variant_place : str
        Module and name of a function that returns the transform with the options of the entry that ``parameter``
        names; "" without one.
    on_demand : bool
        Whether it runs only if another stage is better with its output.
    before, after : tuple of str
        Steps that are done with its input before its transform, and with its outputs after it, in order: names of
        ``mcaptrack.pipeline.steps``. "scale" converts boxes to metres, so that a scale is estimated if no ground plane
        is given; "scores" maps those outside of 0 to 1 to likelihoods; "video-rate" also writes tracks at the video's
        rate, below ``FULL``.
    also_reads : Mapping[str, tuple[str, Schema]]
        Channels that its transform takes beside its input where the log has them: topic below the name of a camera, and
        schema, by the name of the field, which is made with ``context(tuple, is_recorded=False)`` and gets frames.
    repairs_tracks : bool
        Whether its tracks are repaired ones, which are scored and drawn as such.
    profiles_place : str
        Module and name of a mapping of transforms by the name of the profile that they are; "" without profiles.
    modes : Mapping[str, tuple[str, ...]]
        Outputs to write, by the name of the mode; empty for all.
    beside : tuple[str, ...]
        Outputs that are made wherever the main one is, also again in logs that lack them.
    package : tuple[str, str]
        Name and version of the installed package that has the stage; ("", "") for those of mcaptrack.
    """

    name: str
    reads: Schema
    writes: Mapping[str, Schema]
    input_topic: str
    output_topic: str
    rows: str
    kind: Kind | None = None
    parameter: Kind | Literal[""] = ""
    variant_place: str = ""
    on_demand: bool = False
    before: tuple[StepBefore, ...] = ()
    after: tuple[StepAfter, ...] = ()
    also_reads: Mapping[str, tuple[str, Schema]] = field(default_factory=dict)
    repairs_tracks: bool = False
    profiles_place: str = ""
    modes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    beside: tuple[str, ...] = ()
    package: tuple[str, str] = ("", "")

    @cached_property
    def default(self) -> type[Transform]:
        """Its default transform."""
        entry = find(self.kind, next(iter(own(self.kind)))) if self.kind else find("stage", self.name)
        cls: type[Transform] = entry.cls
        return cls

    @cached_property
    def profiles(self) -> Mapping[str, Transform]:
        """Values of all parameters by the name of the profile."""
        profiles: Mapping[str, Transform] = resolve_name(self.profiles_place) if self.profiles_place else {}
        return profiles

    def outputs(self, target: str) -> tuple[str, ...]:
        """The topics that the stage writes if its main output is ``target``."""
        topics = tuple(f"{target}/{suffix}".rstrip("/") for suffix in self.writes)
        return (*topics, target + FULL) if "video-rate" in self.after else topics

    def built_in(self) -> dict[str, type[Transform]]:
        """Its built-in transforms by name, the default first."""
        if self.kind is None:
            return {self.name: self.default}
        return {name: find(self.kind, name).cls for name in own(self.kind)}

    def find(self, name: str, distribution: str = "") -> Entry:
        """Find a transform of this stage by name (see ``mcaptrack.registry``).

        ``distribution`` is the package to take if several have an entry point of this name.

        Raises McaptrackError if there is none, or if it can't be a transform of this stage.
        """
        if self.kind is None:
            raise McaptrackError(f"{self.name} has one transform only, which can't be replaced by {name}")
        own, file = self.split(name)
        entry = find(self.kind, own, distribution)
        if not entry.is_built_in:
            self.check(entry)
        if file is not None and _FILE not in {f.name for f in fields(entry.cls)}:
            raise McaptrackError(f"{entry} takes no file, so {name} names nothing")
        return entry

    def split(self, name: str) -> tuple[str, str | None]:
        """The name of a transform, and the file that it ends with (``registry.split_file``)."""
        return split_file(self.kind, name) if self.kind else (name, None)

    def entry(self, cls: type[Transform]) -> Entry:
        """The entry of a class of transforms of this stage."""
        if self.kind is None and _base(cls) is self.default:
            return replace(find("stage", self.name), cls=cls)
        return entry_of(self.kind or self.name, cls)

    def choose(self, name: str) -> type[Transform]:
        """The transform that a value of ``option`` chooses. Raises McaptrackError if there is none."""
        return self.find(name).cls if self.kind else self.with_part(self.default, name)

    def with_part(self, cls: type[Transform], name: object) -> type[Transform]:
        """A transform of this stage with the options of the entry that ``parameter`` names, if it has own ones."""
        if not self.variant_place or cls is not self.default or not isinstance(name, str):
            return cls
        variant: type[Transform] = resolve_name(self.variant_place)(name)
        return variant

    @property
    def option(self) -> Kind | Literal[""]:
        """The option that chooses a transform or a part of it; "" if there is no choice."""
        return self.kind or self.parameter

    def choice(self, transform: Transform) -> str:
        """The value of ``option`` that a transform has; "" if there is no choice."""
        if self.parameter:
            return str(getattr(transform, self.parameter))
        file = getattr(transform, _FILE, "")
        return self.entry(type(transform)).name + (f":{file}" if file else "") if self.kind else ""

    def make(self, chosen: str = "", /, **parameters: Any) -> Transform:
        """Make a transform of this stage.

        Parameters
        ----------
        chosen : str
            The name of the detector, tracker and so on (see ``mcaptrack.registry``), as NAME:FILE where it takes a
            file; the default if it is "".
        **parameters
            Values of its fields.

        Returns
        -------
        Transform

        Raises
        ------
        McaptrackError
            If there is none of that name, or if it does not take the parameters.

        Examples
        --------
        >>> STAGES["track"].make("bytetrack", max_age_s=2.0).max_age_s
        2.0
        """
        entry = self.find(chosen) if chosen else self.entry(self.default)
        cls = self.with_part(entry.cls, parameters.get(self.parameter))
        names = [f.name for f in fields(cls) if f.init]
        refuse_unknown(str(entry if self.kind else self.name), parameters, names)
        if (file := self.split(chosen)[1]) is not None and parameters.setdefault(_FILE, file) != file:
            raise McaptrackError(f"{chosen} and `{_FILE}={parameters[_FILE]}` are two files; give one")
        with blamed(entry, "could not be made"):
            transform: Transform = cls(**parameters)
            check_options(transform)
        if entry.is_built_in and (weights := getattr(transform, "weights", None)):
            weights()  # refuses a file of a network that isn't there, before a plan is made and said
        return transform

    def check(self, entry: Entry) -> None:
        """Raise McaptrackError if a class of another package can't be a transform of this stage."""
        cls, wanted, (reads, outputs) = entry.cls, self, _interface(entry)
        if reads is not wanted.reads:
            is_schema = getattr(reads, "name", "")
            raise McaptrackError(
                f"{entry} reads {is_schema or 'no schema (the class attribute reads)'}; a {entry.kind} reads "
                f"{wanted.reads.name}"
            )
        main = outputs.get("")
        if main is not wanted.writes[""]:
            raise McaptrackError(
                f"{entry} writes {getattr(main, 'name', '') or 'nothing (the class attribute writes)'}; a {entry.kind} "
                f"writes {wanted.writes[''].name} as its main output, as in writes = {{'': ...}}"
            )
        for suffix, schema in outputs.items():
            if schema not in SCHEMAS.values():
                raise _unusual_output(entry, suffix, schema)
            if schema is not wanted.writes.get(suffix, schema):
                raise McaptrackError(
                    f"{entry} has an output {suffix!r} of {schema.name}; that of a {entry.kind} has "
                    f"{wanted.writes[suffix].name}"
                )
        if any(field.name == self.kind for field in fields(cls)):
            raise McaptrackError(f"{entry}: a parameter can't have the name of the option `{self.kind}=`")


def refuse_unknown(owner: str, names: Iterable[str], parameters: Sequence[str]) -> None:
    """Raise McaptrackError for the name of a parameter that a transform, ``owner``, doesn't have."""
    for name in names:
        if name not in parameters:
            raise McaptrackError(f"{owner} has no parameter {name}; {offer(name, parameters, 'there are')}")


def _interface(entry: Entry) -> tuple[object, dict[Any, Any]]:
    """The schemas that a class of another package has. Raises McaptrackError if it can't be a transform."""
    cls = entry.cls
    if not inspect.isclass(cls) or not is_dataclass(cls):
        raise McaptrackError(
            f"{entry} is no dataclass; the fields of a transform are its parameters: write "
            "@dataclass(frozen=True, kw_only=True) above the class"
        )
    if "__call__" not in dir(cls):
        raise McaptrackError(f"{entry} can't be called with frames; it needs a method __call__")
    if problem := trait_problem(cls):
        raise McaptrackError(f"{entry} {problem}")
    latency_s = inspect.getattr_static(cls, "latency_s", {})
    if not (isinstance(latency_s, Mapping) or hasattr(latency_s, "__get__")):  # a property has it
        raise McaptrackError(
            f"{entry} has latency_s = {latency_s!r:.40}; it maps outputs to seconds, as in {{'': 0.0}}"
        )
    if problem := option_problem(cls):
        raise McaptrackError(f"{entry}: {problem}")
    writes = getattr(cls, "writes", None)
    outputs = dict(writes) if isinstance(writes, Mapping) else {}
    for suffix, schema in outputs.items():
        if not isinstance(suffix, str) or not (not suffix or suffix.isidentifier()):
            raise _unusual_output(entry, suffix, schema)
        if suffix in RESERVED or suffix in names("finisher"):
            raise McaptrackError(f"{entry} has an output {suffix!r}, which is a name of what is made of results")
    return getattr(cls, "reads", None), outputs


def _unusual_output(entry: Entry, suffix: object, schema: object) -> McaptrackError:
    return McaptrackError(
        f"{entry} has writes with {suffix!r}: {schema!r}; it maps ends of topics to schemas of rows, as in "
        "writes = {'': TRACKS, 'debug': DETECTIONS}"
    )


def _base(cls: type[Transform]) -> type[Transform]:
    """The class itself, or the one that it is a variant of (``Stage.variant``)."""
    base: type[Transform] = vars(cls).get("variant_of", cls)
    return base


_STAGES: Final = (
    Stage(
        name="detect",
        kind="detector",
        reads=VIDEO,
        writes={"": DETECTIONS},
        input_topic="video",
        output_topic="detections",
        rows="boxes",
    ),
    Stage(
        name="motion",
        reads=VIDEO,
        writes={"": CAMERA_MOTION},
        input_topic="video",
        output_topic="motion",
        rows="camera motion",
        on_demand=True,
    ),
    Stage(
        name="track",
        kind="tracker",
        reads=DETECTIONS,
        writes={"": TRACKS},
        input_topic="detections",
        output_topic="tracks",
        rows="tracks",
        before=("scale", "memory", "log-before", "scores"),
        after=("one-class", "log-before", "seen"),
    ),
    Stage(
        name="sample",
        reads=TRACKS,
        writes={"": TRACKS},
        input_topic="tracks",
        output_topic="samples",
        rows="samples",
        before=("scale", "corrections", "scene", "log-before"),
        after=("log-before", "pictures", "seen"),
    ),
    Stage(
        name="predict",
        reads=TRACKS,
        writes={"": PREDICTIONS},
        input_topic="samples",
        output_topic="predictions",
        rows="forecasts",
        parameter="predictor",
        variant_place="mcaptrack.transforms.predict:predict_with",
        before=("scene", "log-before"),
        after=("log-before",),
    ),
    Stage(
        name="retrack",
        kind="retracker",
        reads=TRACKS,
        writes={
            "": TRACKS,
            "online": TRACKS,
            "predictions": PREDICTIONS,
            "decisions": DECISIONS,
            "appearance": APPEARANCE,
            "worlds": WORLDS,
        },
        input_topic="samples",
        output_topic="retracks",
        rows="re-tracked tracks",
        before=("planes", "scene", "log-before"),
        after=("log-before", "video-rate", "pictures", "seen"),
        repairs_tracks=True,
        profiles_place="mcaptrack.transforms.retrack:PROFILES",
        modes=MappingProxyType(
            {
                "both": (),
                "offline": ("", "decisions", "appearance", "worlds"),
                "online": ("online", "predictions"),
            }
        ),
        beside=("decisions", "appearance", "worlds"),
    ),
)


class Stages(Mapping[str, Stage]):
    """All stages by name: iteration gives those of mcaptrack, in the order in which they run.

    Those of installed packages are found by name only, because this imports them: they are run if they are named, and
    again where a log has what they made.
    """

    def __init__(self, built_in: Sequence[Stage]) -> None:
        self._built_in = {stage.name: stage for stage in built_in}
        self._of_packages: dict[type[Transform], Stage] = {}

    def __getitem__(self, name: str) -> Stage:
        if name in self._built_in:
            return self._built_in[name]
        if name not in self:
            raise KeyError(name)
        entry = find("stage", name)
        if entry.cls not in self._of_packages:
            self._of_packages[entry.cls] = declared_stage(entry)
        return self._of_packages[entry.cls]

    def __contains__(self, name: object) -> bool:
        return name in self._built_in or name in others("stage")

    def __iter__(self) -> Iterator[str]:
        return iter(self._built_in)

    def __len__(self) -> int:
        return len(self._built_in)


def declared_stage(entry: Entry) -> Stage:
    """The stage of an installed package, which a class of transforms declares. Raises McaptrackError if it can't."""
    cls, (reads, outputs) = entry.cls, _interface(entry)
    declared = {name: getattr(cls, name) for name in _DECLARED if hasattr(cls, name)}
    if not isinstance(reads, Schema) or not isinstance(outputs.get(""), Schema):
        raise McaptrackError(f"{entry} needs the schemas that it reads and writes, as in writes = {{'': TRACKS}}")
    topics = {name: declared.pop(name, None) for name in ("input_topic", "output_topic")}
    for name, topic in topics.items():
        if not isinstance(topic, str) or not all(topic.split("/")) or not topic.isprintable():
            raise McaptrackError(
                f"{entry} has {name} = {topic!r}; it is a topic below the name of a camera, as in 'tracks'"
            )
    for name, steps in (("before", get_args(StepBefore)), ("after", get_args(StepAfter))):
        if unknown := sorted({*map(str, declared.get(name, ()))} - {*steps}):
            raise McaptrackError(f"{entry} has {name} = {', '.join(unknown)}; there are {', '.join(steps)}")
    parameters = {parameter.name for parameter in fields(cls)}
    if lacking := sorted({*map(str, declared.get("also_reads", ()))} - parameters):
        raise McaptrackError(
            f"{entry} has also_reads = {', '.join(lacking)} without a field of that name, as in "
            f"{lacking[0]}: tuple = context(tuple, is_recorded=False)"
        )
    rows = str(declared.pop("rows", "rows"))
    package = (entry.distribution, entry.version)
    return Stage(name=entry.name, reads=reads, writes=outputs, rows=rows, package=package, **topics, **declared)


#: What a class of another package declares of its stage.
_DECLARED: Final = ("input_topic", "output_topic", "rows", "before", "after", "also_reads")
#: All stages by name (see ``Stages``).
STAGES: Final = Stages(_STAGES)
