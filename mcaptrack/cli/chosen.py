"""Which transforms the command line, the environment and files choose, and with which parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any, get_type_hints

from mcaptrack.api.options import PLUGIN
from mcaptrack.cli.command import Settable, is_on_command_line, is_option_given, listed, settings_of
from mcaptrack.errors import McaptrackError
from mcaptrack.transforms import STAGES, Stage, Transform
from mcaptrack.transforms.protocol import bare_type, choices, member_type


def options_of(kind: type[Transform]) -> dict[str, Field[Any]]:
    """Return the parameters of a transform that are options, by name."""
    return {f.name: f for f in fields(kind) if not f.metadata.get("context")}


def settable_of(kinds: Mapping[str, type[Transform]]) -> dict[str, Settable]:
    """Return the parameters of transforms that ``--set`` may set, by name; the first that has one says its type."""
    out = {}
    for kind in reversed(list(kinds.values())):
        hints = get_type_hints(kind)
        for name, declared in options_of(kind).items():
            hint = hints[name]
            member, many = member_type(hint)
            out[name] = Settable(member, many, bare_type(hint) is not hint, tuning_of(declared, member))
    return out


def tuning_of(field: Field[Any], member: Any) -> bool | str:
    """Return ``Option.tuning`` of a parameter of a transform, with values of the type ``member``."""
    about = field.metadata
    return PLUGIN if about.get("kind") else about.get("pattern") or bool(choices(member)) or member is not str


def has_flag(field: Field[Any]) -> bool:
    """Return whether a parameter has an option of its own, beside ``--set name=value``."""
    return bool(field.metadata.get("flag", True))


@dataclass(frozen=True)
class Maker:
    """Makes the transform of a stage as the user wants it; other processes can do so, too.

    Attributes
    ----------
    stage : str
        Name of the stage.
    chosen, profile : str
        The names of the transform and of the profile that the user chose, or "".
    wanted : mapping of str to object
        Values of parameters. Those that the transform lacks are ignored, since they may be meant for another one.
    typed : mapping of str to str
        How the parameters among them were typed on the command line: these are refused if the transform lacks them.
    owners : mapping of str to list of str
        The names of the transforms that have a parameter.
    """

    stage: str
    chosen: str
    profile: str
    wanted: Mapping[str, Any]
    typed: Mapping[str, str] = field(default_factory=dict)
    owners: Mapping[str, list[str]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        stage: Stage,
        options: Mapping[str, Any],
        wanted: Mapping[str, Any],
        owners: Mapping[str, list[str]] = MappingProxyType({}),
    ) -> Maker:
        """Return a maker for ``options`` of a command; those of the running one have ``owners``."""
        typed = {
            name: f"--{name.replace('_', '-')}" if is_option_given(name) else f"--set {name}"
            for name in wanted
            if name in owners and is_on_command_line(name)
        }
        chosen = (options.get(stage.kind) if stage.kind else "") or ""
        return cls(stage.name, chosen, options.get("profile") or "", wanted, typed, dict(owners))

    def __call__(self, name: str = "") -> Transform:
        """Make the transform of this name; without one that which the user chose, or the default one.

        Raises McaptrackError if the profile, or a parameter that was typed, is of another transform.
        """
        stage = STAGES[self.stage]
        name, profile = name or self.chosen, stage.profiles.get(self.profile)
        if profile is not None:
            if name not in ("", stage.choice(profile)):
                of = f"{stage.kind} {stage.choice(profile)}"
                raise McaptrackError(f"the profile {self.profile} is of the {of}, not of {name}")
            name = stage.choice(profile)
        cls = stage.with_part(stage.find(name).cls if name else stage.default, self.wanted.get(stage.parameter))
        own, hints = options_of(cls), get_type_hints(cls)
        for option, text in self.typed.items():
            if option not in own:
                named = name or self.wanted.get(stage.option) or stage.choice(stage.default())
                raise McaptrackError(f"{text} is an option of {listed(self.owners[option])}, not of {named}")
        values = {
            option: tuple(value) if member_type(hints[option])[1] else value
            for option, value in self.wanted.items()
            if option in own
        }
        return stage.make(name, **values) if profile is None else replace(profile, **values)


def configured(chosen: Mapping[str, str] = MappingProxyType({})) -> dict[str, Transform]:
    """Return the transforms that environment and files configure, by stage, for a command that runs several stages.

    ``chosen`` has names from the command line by kind.
    """
    out: dict[str, Transform] = {}
    for stage in STAGES.values():
        settings = settings_of(stage.name) | {kind: name for kind, name in chosen.items() if kind == stage.option}
        wanted = {option: value for option, value in settings.items() if value is not None}
        if not wanted:
            continue
        own = {option for kind in stage.built_in().values() for option in options_of(kind)}
        wanted |= wanted.pop("set", {})
        if wanted.keys() & {*own, stage.option, "profile"}:
            out[stage.name] = Maker.of(stage, settings, wanted)()
    return out
