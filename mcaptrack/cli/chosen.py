"""Which transforms the command line, the environment and files choose, and with which parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import Field, dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any, Final, get_type_hints

from mcaptrack.cli.command import is_on_command_line, settings_of
from mcaptrack.cli.settings import found_of, nearest
from mcaptrack.cli.text import refuse_usage
from mcaptrack.errors import McaptrackError
from mcaptrack.transforms import STAGES, Stage, Transform
from mcaptrack.transforms.protocol import bare_type, member_type

_SWITCH: Final = {
    "true": True,
    "yes": True,
    "on": True,
    "1": True,
    "false": False,
    "no": False,
    "off": False,
    "0": False,
}
_KIND_WORDS: Final = {bool: "true or false", int: "a whole number", float: "a number"}


def listed(names: Sequence[str]) -> str:
    """Return names in words: "a, b and c"."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def options_of(kind: type[Transform]) -> dict[str, Field[Any]]:
    """Return the parameters of a transform that are options, by name."""
    return {f.name: f for f in fields(kind) if not f.metadata.get("context")}


def has_flag(field: Field[Any]) -> bool:
    """Return whether a parameter has an option of its own, beside ``--set name=value``."""
    return bool(field.metadata.get("flag", True))


def values_set(command: str, texts: Sequence[str] | None, kinds: Mapping[str, type[Transform]]) -> dict[str, Any]:
    """Return the values of ``--set name=value`` by parameter of the transforms ``kinds``, which have names.

    A text without a value, a parameter that no transform has, or a value that isn't of its type ends the command with
    exit code 2; the line says where the text was set.
    """
    owners = {option: kind for kind in reversed(list(kinds.values())) for option in options_of(kind)}
    in_file = found_of(command).get("set")
    where = f"{in_file[1].where}:" if in_file and not is_on_command_line("set") else "--set"
    values: dict[str, Any] = {}
    for text in texts or ():
        written, equals, value = text.partition("=")
        name = written.strip().lstrip("-").replace("-", "_")
        if not equals or not name:
            refuse_usage(f"{where} needs name=value, as in --set {name or 'name'}=0.5, not {text!r}")
        if name not in owners:
            hint = nearest(name, owners) or f"; there are {listed(sorted(owners))}"
            refuse_usage(f"{where} {text}: there is no parameter {name}{hint}")
        if name in values:
            refuse_usage(f"{where} gives {name} twice")
        try:
            values[name] = _read_value(value.strip(), get_type_hints(owners[name])[name])
        except ValueError as error:
            refuse_usage(f"{where} {text}: {value.strip()!r} is not {error}")
    return values


def _read_value(value: str, hint: Any) -> Any:
    """The value that a text gives a parameter of this type. Raises ValueError that says what it should be."""
    if value.lower() == "none" and bare_type(hint) is not hint:
        return None
    kind, is_tuple = member_type(hint)
    try:
        members = [_read_member(member.strip(), kind) for member in (value.split(",") if is_tuple else [value])]
    except ValueError:
        raise ValueError(_KIND_WORDS[kind]) from None
    return tuple(members) if is_tuple else members[0]


def _read_member(value: str, kind: Any) -> Any:
    if kind is bool:
        if value.lower() not in _SWITCH:
            raise ValueError
        return _SWITCH[value.lower()]
    return kind(value) if kind in (int, float) else value


def is_open(stage: Stage, values: Mapping[str, Any]) -> bool:
    """Return whether the boxes of a log decide which tracker runs, because the user named none."""
    return stage.kind == "tracker" and not values["tracker"]


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
        flags = {name: f"--{name.replace('_', '-')}" if name in options else f"--set {name}" for name in owners}
        typed = {
            name: flags[name]
            for name in wanted
            if name in owners and is_on_command_line(name if name in options else "set")
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
        chosen_plugin = settings.get(stage.kind) if stage.kind else None
        kinds = dict(stage.built_in()) | ({chosen_plugin: stage.find(chosen_plugin).cls} if chosen_plugin else {})
        wanted |= values_set(stage.name, wanted.pop("set", None), kinds)
        if wanted.keys() & {*own, stage.option, "profile"}:
            out[stage.name] = Maker.of(stage, settings, wanted)()
    return out
