"""One command for each transform, made from its parameters; and ``run``."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import Field, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, get_type_hints

import typer

from mcaptrack.cli import common
from mcaptrack.cli.command import is_on_command_line, settings_of
from mcaptrack.cli.running import run_on_logs
from mcaptrack.errors import McaptrackError
from mcaptrack.transforms import ALTERNATIVES, PROFILES, TRANSFORMS, Transform
from mcaptrack.transforms.protocol import bare_type

if TYPE_CHECKING:
    from mcaptrack.log import Log
    from mcaptrack.pipeline import Job, Watch

#: What a command says of itself, beyond its transform.
_WORDS: Final = {
    "detect": ("Example: mcaptrack detect log.mcap --method mog2", "{camera}/video", "{camera}/detections"),
    "track": ("Example: mcaptrack track log.mcap --tracker bytetrack", "{camera}/detections", "{camera}/tracks"),
    "sample": ("Example: mcaptrack sample log.mcap --rate-hz 2.5", "{camera}/tracks", "{camera}/samples"),
    "predict": ("Example: mcaptrack predict log.mcap --predictor cv", "{camera}/samples", "{camera}/predictions"),
    "retrack": ("Example: mcaptrack retrack log.mcap --profile authors", "{camera}/samples", "{camera}/retracks"),
}
Topic = Annotated[
    str | None, common.option("--topic", panel=common.FILES, help="Read this channel instead of the default one.")
]
Mode = Literal["both", "offline", "online"]
_OUTPUTS_OF: Final[Mapping[str, tuple[str, ...]]] = {
    "both": ("", "online", "predictions"),
    "offline": ("",),
    "online": ("online", "predictions"),
}


_AFTER: Final = "After the stages"


def add_stages(app: typer.Typer, panel: str) -> None:
    """A command for all transforms, and one for each, below a heading of the help."""
    common.register(app, panel, "run", common.one_line(run_all))
    for name, kind in TRANSFORMS.items():
        common.register(app, panel, name, common.one_line(_stage_command(name, kind)), _help(name, kind))


def _help(name: str, kind: type[Transform]) -> str:
    example, source, target = _WORDS[name]
    first, last = source.format(camera="/camera"), target.format(camera="/camera")
    where = f"From {first} to {last}. Inputs that are missing are made first."
    others = [] if name not in ALTERNATIVES else [k for k in ALTERNATIVES[name].kinds.values() if k is not kind]
    words = [inspect.cleandoc(one.__doc__ or "") for one in (kind, *others)]
    return "\n\n".join([*words, where, example])


def _option(field: Field[Any], annotation: Any, default: Any, whose: str = "") -> inspect.Parameter:
    """An option that is None unless it is given, and whose help shows what happens then.

    ``whose`` names the one of several transforms that it belongs to, if it doesn't belong to all.
    """
    kind, about = bare_type(annotation), field.metadata
    flag = "--" + field.name.replace("_", "-")
    names = f"{flag}/--no-{flag[2:]}" if kind is bool else flag
    shown = "none" if default is None else str(default).lower() if isinstance(default, bool) else f"{default}"
    info = common.option(
        names,
        panel=f"Options of {whose} alone" if whose else about["theme"],
        tuning="|".join(map(re.escape, about["names"])) or False if kind is str else True,
        help=f"{about['help'][:1].upper()}{about['help'][1:]}.",
        least=about["least"],
        most=about["most"],
        show_default=shown,
    )
    return _parameter(field.name, Annotated[kind | None, info], None)


def _options_of(kind: type[Transform]) -> dict[str, Field[Any]]:
    """The parameters of a transform that are options, by name."""
    return {f.name: f for f in fields(kind) if not f.metadata.get("context")}


def _parameter(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _stage_command(name: str, kind: type[Transform]) -> Callable[..., None]:
    """The function behind a stage's command: its signature is made of what the transform declares."""
    several = ALTERNATIVES.get(name)
    kinds = dict(several.kinds) if several else {name: kind}
    defaults = {one: PROFILES["default"] if one == "retrack" else made() for one, made in kinds.items()}
    own = {one: _options_of(made) for one, made in kinds.items()}
    parameters = [_parameter("logs", common.Logs, inspect.Parameter.empty)]
    if several:
        words = common.option("--" + several.option, tuning=True, help=f"The {several.option} to use.")
        default = next(one for one, made in kinds.items() if made is kind)
        parameters.append(_parameter(several.option, Annotated[Literal[tuple(kinds)], words], default))
    if name == "retrack":
        words = common.option(
            "--profile",
            tuning=True,
            help="Values of all parameters: mcaptrack's own (default), the paper's, or those of its authors' program.",
        )
        parameters.append(_parameter("profile", Annotated[Literal[tuple(PROFILES)], words], "default"))
        words = common.option(
            "--mode",
            tuning=True,
            help="Write tracks that use the whole log (offline), the past alone (online), or both.",
        )
        parameters.append(_parameter("mode", Annotated[Mode, words], "both"))
    there: dict[str, list[str]] = {}
    for one, found in own.items():
        for f in found:
            there.setdefault(f, []).append(one)
    for option, those in there.items():
        one = those[0]
        hint, shown = get_type_hints(kinds[one])[option], getattr(defaults[one], option)
        parameters.append(_option(own[one][option], hint, shown, one if len(those) < len(kinds) else ""))
    to = common.option("--to", panel=common.FILES, help="Write to this channel instead of the default one.")
    parameters += [
        _parameter("topic", Topic, None),
        _parameter("to", Annotated[str | None, to], None),
        _parameter("camera", common.Camera, None),
        _parameter("output", common.Output, None),
        _parameter("sidecar", common.Sidecar, None),
        _parameter("force", common.Force, False),
        _parameter("json", common.Json, False),
        _parameter("quiet", common.Quiet, False),
        _parameter("verbose", common.Verbose, False),
        _parameter("config", common.Config, None),
    ]

    def command(**given: Any) -> None:
        one = given[several.option] if several else name
        base: Transform = PROFILES[given["profile"]] if name == "retrack" else kinds[one]()
        wanted = {option: given[option] for option in there if given[option] is not None}
        for option in list(wanted):
            if option not in own[one]:
                flag = "--" + option.replace("_", "-")
                if is_on_command_line(option):
                    raise McaptrackError(f"{flag} is an option of {' and '.join(there[option])}, not of {one}")
                del wanted[option]  # set in a file or in the environment, for when another one is chosen
        transform = replace(base, **wanted)
        keep = _OUTPUTS_OF[given["mode"]] if name == "retrack" else None

        def plan(opened: Log, prefix: str, say: Callable[[str], None]) -> list[Job]:
            from mcaptrack.pipeline import plan_stage

            return plan_stage(opened, prefix, name, transform, given["topic"], given["to"], keep, say, _configured())

        run_on_logs(given, plan)

    command.__name__ = name
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


def run_all(
    logs: common.Logs,
    topic: Topic = None,
    camera: common.Camera = None,
    output: common.Output = None,
    sidecar: common.Sidecar = None,
    events: Annotated[
        bool,
        common.option(
            "--events/--no-events",
            panel=_AFTER,
            help="Write events and scores of identities, as `mcaptrack events` does.",
        ),
    ] = True,
    tables: Annotated[
        bool, common.option("--tables/--no-tables", panel=_AFTER, help="Write Parquet tables beside the log.")
    ] = True,
    force: Annotated[
        bool,
        common.option("--force", panel=common.FILES, help="Run everything again, and replace the file that -o names."),
    ] = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Run all stages that are missing or out of date, then events, views and tables.

    From /camera/video (or the detections, tracks or samples that the log has) to /camera/predictions and
    /camera/retracks; then events (see `mcaptrack events`), views, and Parquet tables beside the log. --topic begins
    with the pictures, or the boxes, of that channel. Stages that are up to date are left alone, those that are out of
    date are made again with the parameters they had. --force makes all again, with the parameters that environment and
    config files set now, and otherwise those they had.

    Example: mcaptrack run log.mcap
    """
    given = {"logs": logs, "camera": camera, "output": output, "sidecar": sidecar, "topic": topic, "force": force}
    settings = settings_of("events")
    given |= {"json": json, "quiet": quiet, "verbose": verbose, "tables": tables}
    gates = (settings.get("similarity"), settings.get("gate_m"), settings.get("min_iou"))

    def plan(opened: Log, prefix: str, say: Callable[[str], None]) -> list[Job]:
        from mcaptrack.pipeline import plan_all

        return plan_all(opened, prefix, say, topic, _configured(), force)

    run_on_logs(given, plan, watched(*gates, anew=force) if events else None, is_run=True)


def watched(
    similarity: common.SimilarityName | None, gate_m: float | None, min_iou: float | None, **chosen: Any
) -> Watch:
    """What `mcaptrack events` and `run` are to look for."""
    from mcaptrack.evaluation.events import EventOptions
    from mcaptrack.pipeline import Watch

    return Watch(EventOptions(similarity, gate_m, min_iou), **chosen)


def _configured() -> dict[str, Transform]:
    """The stages as environment and files want them, for a command that makes them on its way; others aren't listed."""
    out: dict[str, Transform] = {}
    for name, default in TRANSFORMS.items():
        settings = settings_of(name)
        several = ALTERNATIVES.get(name)
        kind = several.kinds[settings[several.option]] if several and several.option in settings else default
        base = PROFILES[settings.get("profile", "default")] if name == "retrack" else kind()
        chosen = {option: value for option, value in settings.items() if option in _options_of(kind)}
        if chosen or settings.keys() & {"tracker", "profile"}:
            out[name] = replace(base, **chosen)
    return out
