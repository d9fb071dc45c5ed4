"""Create the transform that made a channel again, from the channel's provenance.

A class that a log names is imported only if it is built in, is an entry point of an installed package, or is named by
the user, too: a log must not be able to run code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, Final, get_type_hints

from mcaptrack.errors import McaptrackError
from mcaptrack.installed import missing_extension
from mcaptrack.notices import warn
from mcaptrack.predictors import entry_of as predictor_entry
from mcaptrack.predictors import weights_sha256
from mcaptrack.registry import Entry, find, is_installed, split_file
from mcaptrack.schema.provenance import Plugin, Provenance
from mcaptrack.transforms import Stage, Transform
from mcaptrack.transforms.protocol import member_type

#: The maximum number of differing parameters in a message.
_NAMED: Final = 3


class MissingPluginError(McaptrackError):
    """A class of another package that made a channel is not installed, or not named by the user.

    ``options`` are the options of ``run`` that name the class; empty if naming it is not enough.
    """

    def __init__(self, message: str, **options: str) -> None:
        super().__init__(message)
        self.options = options


class OlderVersionError(McaptrackError):
    """A channel was made by a version with other parameters than this one."""


def plugins_of(stage: Stage, transform: Transform) -> dict[str, Plugin]:
    """Return the classes of other packages in a transform: "transform" for itself, "predictor" for its predictor."""
    own = stage.entry(type(transform))
    plugins = {} if own.is_built_in else {"transform": _plugin(own)}
    predictor = getattr(transform, "predictor", None)
    if isinstance(predictor, str):
        entry, _ = predictor_entry(predictor)
        if not entry.is_built_in:
            plugins["predictor"] = _plugin(entry)
    return plugins


def rebuild(stage: Stage, provenance: Provenance, named_by_user: Mapping[str, Transform]) -> Transform:
    """Return the transform that made a channel, with the same parameters.

    ``named_by_user`` are transforms by stage; their classes may be used in addition to installed ones.
    Raises OlderVersionError if an older version made it, MissingPluginError if a class of another package is not
    available, and McaptrackError for parameters that no longer exist.
    """
    if provenance.is_of_older_version:
        raise OlderVersionError(f"it was made by an older version ({provenance.version}); `force=True` makes it again")
    parameters = dict(provenance.parameters)
    cls = _class_of(stage, provenance, parameters, named_by_user)
    _check_predictor(provenance, parameters.get("predictor"), named_by_user)
    cls = stage.with_part(cls, parameters.get(stage.parameter))
    types = {f.name: f for f in fields(cls)}
    unknown = sorted(set(parameters) - set(types))
    if unknown:
        name = stage.entry(cls) if "transform" in provenance.plugins else cls.__name__
        raise McaptrackError(f"it was made with {', '.join(unknown)}, which {name} does not have")
    hints = get_type_hints(cls)
    values = {
        name: tuple(value) if isinstance(value, list) and member_type(hints[name])[1] else value
        for name, value in parameters.items()
        if not types[name].metadata.get("context")
    }
    transform: Transform = cls(**values)
    if provenance.weights_sha256:
        _check_weights(stage, transform, provenance.weights_sha256)
    return transform


def _check_predictor(provenance: Provenance, name: object, named_by_user: Mapping[str, Transform]) -> None:
    """Raise MissingPluginError if the predictor of a transform is of another package and may not be imported."""
    plugin = provenance.plugins.get("predictor")
    if plugin is None and isinstance(name, str) and _is_of_a_module(name):
        plugin = Plugin(name, name, "", "")
    if plugin and plugin.name not in {getattr(other, "predictor", None) for other in named_by_user.values()}:
        _installed("predictor", plugin, find)


def _check_weights(stage: Stage, transform: Transform, sha256: str) -> None:
    """Raise McaptrackError if a transform, or its predictor, has other weights than those with this digest."""
    predictor = getattr(transform, "predictor", "")
    if ":" in predictor and weights_sha256(predictor) != sha256:
        raise McaptrackError(f"{predictor} holds other weights than those it was made with")
    if hasattr(transform, "weights_sha256") and transform.weights_sha256() not in (None, sha256):
        raise McaptrackError(f"{stage.choice(transform)} holds other weights than those it was made with")


def _is_of_a_module(predictor: str) -> bool:
    """Return whether a predictor's name has the form ``module:Class`` and not ``NAME:FILE``."""
    return ":" in predictor and split_file("predictor", predictor)[1] is None


def _class_of(
    stage: Stage, provenance: Provenance, parameters: dict[str, Any], named_by_user: Mapping[str, Transform]
) -> type[Transform]:
    """Return the class of the transform; removes the parameter that names it from ``parameters``."""
    name = str(parameters.pop(stage.kind, "")) if stage.kind else ""
    plugin = provenance.plugins.get("transform")
    if plugin is None:
        if not name:
            return stage.default
        entry = stage.find(name) if stage.kind and is_installed(stage.kind, name) else None
        if entry is None or not entry.is_built_in:
            missing = missing_extension(name, stage.kind or "")
            why = f"; {missing}" if missing else ", which this version does not have"
            raise McaptrackError(f"{stage.kind} {name} made it{why}")
        made_by: type[Transform] = entry.cls
        return made_by
    users = named_by_user.get(stage.name)
    if users is not None and stage.entry(type(users)).implementation == plugin.implementation:
        _compare_versions(stage.entry(type(users)), plugin)
        return type(users)
    if stage.kind is None and any(stage.package):
        own: type[Transform] = _installed("stage", plugin, find).cls
        return own
    if stage.kind is None:
        raise MissingPluginError(
            f"{_name_with_package(stage.name, plugin)} made it; run it again from Python, with that class"
        )
    cls: type[Transform] = _installed(
        stage.kind,
        plugin,
        lambda _, name: stage.find(name, plugin.distribution),  # of two packages the one that made it
    ).cls
    return cls


def _installed(kind: Any, plugin: Plugin, find: Callable[[Any, str], Entry]) -> Entry:
    """Return the registry's entry for a plug-in. Raises MissingPluginError if it may not or can't be imported.

    ``find`` finds an entry by its kind and name.
    """
    named = _name_with_package(kind, plugin)
    if ":" in plugin.name:
        if plugin.name.startswith("__main__:") or "<locals>" in plugin.name:  # of a script, a notebook or a function
            raise MissingPluginError(
                f"{named} made it, which can't be imported; run it again from Python with that class, or replace it "
                f"with another `{kind}=`"
            )
        why = "a class without an entry point is imported only if you name it"
        raise MissingPluginError(f"{named} made it, and {why}", **{kind: plugin.name})
    if not is_installed(kind, plugin.name):
        package = f"{plugin.distribution} {plugin.version}".strip() or "the package that has it"
        raise MissingPluginError(
            f"{named} made it, which is not installed; install {package}, or replace it with another `{kind}=`"
        )
    try:
        entry = find(kind, plugin.name)
    except McaptrackError as error:
        raise MissingPluginError(f"{named} made it; {error}. Or replace it with another `{kind}=`") from None
    if entry.distribution != plugin.distribution:
        raise MissingPluginError(
            f"{named} made it; the {kind} of that name is now that of {entry.distribution or 'mcaptrack'}. Install "
            f"{plugin.distribution}, or replace it with another `{kind}=`"
        )
    _compare_versions(entry, plugin)
    return entry


def _compare_versions(entry: Entry, plugin: Plugin) -> None:
    if entry.version != plugin.version:
        warn(
            f"{entry.kind} {entry.name} is {entry.distribution} {entry.version} now; results in the log were made "
            f"with {plugin.version or 'another version'}",
            "other-version",
        )


def _name_with_package(kind: str, plugin: Plugin) -> str:
    package = f"{plugin.distribution} {plugin.version}".strip()
    return f"{kind} {plugin.name}" + (f" ({package})" if package else "")


def _plugin(entry: Entry) -> Plugin:
    return Plugin(entry.name, entry.implementation, entry.distribution, entry.version)


def differing(before: Transform, wanted: Transform) -> str:
    """Return the differing parameters of two transforms as text; "" if there are none."""
    if type(before) is not type(wanted):
        return f"{type(wanted).__name__}, not {type(before).__name__}"
    names = [f.name for f in fields(before) if not f.metadata.get("context")]
    pairs = [(name, getattr(before, name), getattr(wanted, name)) for name in names]
    changes = [f"{name} {now or repr(now)}, not {then or repr(then)}" for name, then, now in pairs if then != now]
    return "; ".join(changes[:_NAMED]) + (f"; and {len(changes) - _NAMED} more" if len(changes) > _NAMED else "")
