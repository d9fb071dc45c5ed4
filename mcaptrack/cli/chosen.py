"""Which transforms the command line, the environment and files choose, and with which parameters."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import Field, dataclass, fields, replace
from types import MappingProxyType
from typing import Any, Final, get_type_hints

from mcaptrack.cli.command import is_on_command_line, settings_of
from mcaptrack.cli.flags import RUNNING
from mcaptrack.cli.settings import found_of
from mcaptrack.cli.text import refuse_usage, say
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import DETECTIONS
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
        if not equals:
            refuse_usage(f"{where} needs name=value, as in --set {name}=0.5, not {text!r}")
        if name not in owners:
            alike = difflib.get_close_matches(name, owners, 1)
            hint = f"; did you mean {alike[0]}?" if alike else f"; there are {listed(sorted(owners))}"
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
    is_tracker = stage.reads is DETECTIONS
    return is_tracker and values["tracker"] == stage.entry(stage.default).name and not is_on_command_line("tracker")


def make_transform(
    stage: Stage,
    options: Mapping[str, Any],
    wanted: Mapping[str, Any],
    owners: Mapping[str, list[str]] = MappingProxyType({}),
    typed: Collection[str] = (),
) -> Transform:
    """Return the chosen transform with those of the wanted parameters that it has.

    ``owners`` has the names of the transforms that have an option. One of the options that were ``typed`` on the
    command line is refused if the chosen transform lacks it; one from a file or the environment is ignored, since it
    may be meant for another transform.
    """
    name = _chosen(stage, options, wanted)
    cls = stage.with_part(stage.find(name).cls if name else stage.default, wanted.get(stage.parameter))
    own = options_of(cls)
    for option in wanted:
        if option in owners and option not in own and option in typed:
            fields_there = [
                options_of(kind)[option] for kind in stage.built_in().values() if option in options_of(kind)
            ]
            is_flag = all(map(has_flag, fields_there))
            flag = f"--{option.replace('_', '-')}" if is_flag else f"--set {option}"
            chosen = name or wanted.get(stage.option) or stage.choice(stage.default())
            raise McaptrackError(f"{flag} is an option of {listed(owners[option])}, not of {chosen}")
    hints = get_type_hints(cls)
    values = {
        option: tuple(value) if member_type(hints[option])[1] else value
        for option, value in wanted.items()
        if option in own
    }
    if stage.profiles and (profile := options.get("profile")):
        return replace(stage.profiles[profile], **values)
    return stage.make(name, **values)


@dataclass(frozen=True)
class Maker:
    """Makes the transform of a stage by name, as ``make_transform`` does; other processes can do so, too.

    Attributes
    ----------
    stage : str
        Name of the stage.
    given, wanted, owners, typed
        The arguments of ``make_transform``; ``given`` has the profile, and the choice of the user.
    """

    stage: str
    given: Mapping[str, Any]
    wanted: Mapping[str, Any]
    owners: Mapping[str, list[str]]
    typed: tuple[str, ...]

    @classmethod
    def of(
        cls, stage: Stage, options: Mapping[str, Any], wanted: Mapping[str, Any], owners: Mapping[str, list[str]]
    ) -> Maker:
        """Return a maker for the running command."""
        chosen = {name: options[name] for name in (stage.kind, "profile") if name and name in options}
        typed = [name for name in wanted if is_on_command_line(name if name in options else "set")]
        return cls(stage.name, chosen, wanted, owners, tuple(typed))

    def __call__(self, name: str) -> Transform:
        """Make the transform of this name; for "" the one that the user chose, or the default one."""
        stage, context = STAGES[self.stage], RUNNING.get()
        options = {**self.given, "quiet": context is None or context.params.get("quiet")}
        if name and stage.kind:
            options[stage.kind] = name
        return make_transform(stage, options, self.wanted, self.owners, self.typed)


def _chosen(stage: Stage, options: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """Return the name of the chosen transform: from its option, the profile, or an option that implies it; else "".

    Raises McaptrackError if the profile is of another transform.
    """
    name = (options.get(stage.kind) if stage.kind else "") or ""
    if stage.profiles and (profile := options.get("profile")):
        meant = stage.choice(stage.profiles[profile])
        if name not in ("", meant):
            raise McaptrackError(f"the profile {profile} is of the {stage.kind} {meant}, not of {name}")
        return meant
    for option, implied in stage.implied.items():
        if not name and option in wanted:
            if not options.get("quiet"):
                say(f"{option} belongs to --{stage.kind} {implied}, which is used; the next release requires that")
            return implied
    return name


def configured(chosen: Mapping[str, str] = MappingProxyType({})) -> dict[str, Transform]:
    """Return the transforms that environment and files configure, by stage, for a command that runs several stages.

    ``chosen`` has names from the command line by kind.
    """
    out: dict[str, Transform] = {}
    for stage in STAGES.values():
        settings = settings_of(stage.name)
        own = {option for kind in stage.built_in().values() for option in options_of(kind)}
        settings |= {kind: name for kind, name in chosen.items() if kind == stage.option}
        wanted = {option: value for option, value in settings.items() if value is not None}
        chosen_plugin = settings.get(stage.kind) if stage.kind else None
        kinds = dict(stage.built_in()) | ({chosen_plugin: stage.find(chosen_plugin).cls} if chosen_plugin else {})
        wanted |= values_set(stage.name, wanted.pop("set", None), kinds)
        if wanted.keys() & {*own, stage.option, "profile"}:
            out[stage.name] = make_transform(stage, settings, wanted)
    return out
