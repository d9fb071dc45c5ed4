"""One command for each transform, made from its parameters; and ``run``."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, get_type_hints

import typer

from mcaptrack.cli import common
from mcaptrack.cli.config import NAME, settings_of
from mcaptrack.errors import McaptrackError
from mcaptrack.transforms import ALTERNATIVES, PROFILES, TRANSFORMS, Transform
from mcaptrack.transforms.protocol import bare_type

if TYPE_CHECKING:
    from mcaptrack.pipeline import Watch

#: What a command says of itself, beyond its transform.
_WORDS: Final = {
    "detect": ("Example: mcaptrack detect log.mcap --method mog2", "{camera}/video", "{camera}/detections"),
    "track": ("Example: mcaptrack track log.mcap --tracker bytetrack", "{camera}/detections", "{camera}/tracks"),
    "sample": ("Example: mcaptrack sample log.mcap --rate-hz 2.5", "{camera}/tracks", "{camera}/samples"),
    "predict": ("Example: mcaptrack predict log.mcap --predictor cv", "{camera}/samples", "{camera}/predictions"),
    "retrack": ("Example: mcaptrack retrack log.mcap --profile authors", "{camera}/samples", "{camera}/retracks"),
}
Topic = Annotated[str | None, common.option("--topic", shared=True, help="Read this channel instead of the usual one.")]
Mode = Literal["both", "offline", "online"]
_OUTPUTS_OF: Final[Mapping[str, tuple[str, ...]]] = {
    "both": ("", "online", "predictions"),
    "offline": ("",),
    "online": ("online", "predictions"),
}


def add_stages(app: typer.Typer) -> None:
    """A command for every transform, and one for all of them."""
    for name, kind in TRANSFORMS.items():
        common.register(app, name, common.one_line(_stage_command(name, kind)), _help(name, kind))
    common.register(app, "run", common.one_line(run_all))


def _help(name: str, kind: type[Transform]) -> str:
    example, source, target = _WORDS[name]
    where = (
        f"From {source.format(camera='/camera')} to {target.format(camera='/camera')}. A missing input is made first."
    )
    others = [] if name not in ALTERNATIVES else [k for k in ALTERNATIVES[name].kinds.values() if k is not kind]
    words = [inspect.cleandoc(one.__doc__ or "") for one in (kind, *others)]
    return "\n\n".join([*words, where, example])


def _option(name: str, annotation: Any, default: Any, words: str, whose: str = "") -> inspect.Parameter:
    """An option that is None unless it is given, and whose help shows what happens then.

    ``whose`` names the one of several transforms that it belongs to, if it doesn't belong to all.
    """
    flag = "--" + name.replace("_", "-")
    names = f"{flag}/--no-{flag[2:]}" if bare_type(annotation) is bool else flag
    shown = "none" if default is None else str(default).lower() if isinstance(default, bool) else f"{default}"
    panel: dict[str, Any] = {"rich_help_panel": f"Options of {whose} alone"} if whose else {}
    info = common.option(names, help=words[:1].upper() + words[1:] + ".", show_default=shown, **panel)
    return _parameter(name, Annotated[bare_type(annotation) | None, info], None)


def _options_of(kind: type[Transform]) -> dict[str, Any]:
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
        words = common.option("--" + several.option, help=f"Which {several.option}.")
        default = next(one for one, made in kinds.items() if made is kind)
        parameters.append(_parameter(several.option, Annotated[Literal[tuple(kinds)], words], default))
    if name == "retrack":
        words = common.option("--profile", help="Whose reading: ours, the paper's, or its authors' program's.")
        parameters.append(_parameter("profile", Annotated[Literal[tuple(PROFILES)], words], "default"))
        words = common.option("--mode", help="With all the log knows (offline), from the past alone (online), or both.")
        parameters.append(_parameter("mode", Annotated[Mode, words], "both"))
    there: dict[str, list[str]] = {}
    for one, found in own.items():
        for f in found:
            there.setdefault(f, []).append(one)
    for option, those in there.items():
        one = those[0]
        help_text = own[one][option].metadata["help"]
        hint, shown = get_type_hints(kinds[one])[option], getattr(defaults[one], option)
        parameters.append(_option(option, hint, shown, help_text, one if len(those) < len(kinds) else ""))
    to = common.option("--to", shared=True, help="Write this channel instead of the usual one.")
    parameters += [
        _parameter("topic", Topic, None),
        _parameter("to", Annotated[str | None, to], None),
        _parameter("camera", common.Camera, None),
        _parameter("output", common.Output, None),
        _parameter("sidecar", common.Sidecar, False),
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
                if settings_of(name).get(option) == wanted[option]:  # the file has it, for another one
                    del wanted[option]
                    continue
                flag = "--" + option.replace("_", "-")
                raise McaptrackError(f"{flag} is an option of {' and '.join(there[option])}, not of {one}")
        transform = replace(base, **wanted)
        keep = _OUTPUTS_OF[given["mode"]] if name == "retrack" else None
        run_on_logs(given, lambda plan: plan.stage(name, transform, given["topic"], given["to"], keep))

    command.__name__ = name
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


def run_all(
    logs: common.Logs,
    topic: Topic = None,
    camera: common.Camera = None,
    output: common.Output = None,
    sidecar: common.Sidecar = False,
    events: Annotated[bool, common.option("--events/--no-events", help="Tell what happened to identities.")] = True,
    tables: Annotated[bool, common.option("--tables/--no-tables", help="Write Parquet tables beside the log.")] = True,
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Run all stages that are missing or out of date, then events, views and tables.

    From /camera/video (or whatever of detections, tracks and samples there is) to /camera/predictions and
    /camera/retracks, what happened to identities (see `mcaptrack events`), and Parquet tables beside the log. With
    --topic from the pictures, or the boxes, of that channel.

    Example: mcaptrack run log.mcap
    """
    given = {"logs": logs, "camera": camera, "output": output, "sidecar": sidecar, "topic": topic, "force": force}
    settings = settings_of("events")
    given |= {"json": json, "quiet": quiet, "verbose": verbose}
    run_on_logs(
        given,
        lambda plan: plan.all(topic),
        tables,
        watched(settings.get("similarity"), settings.get("gate")) if events else None,
    )


def watched(similarity: Any, gate: Any, **chosen: Any) -> Watch:
    """What `mcaptrack events` and `run` are to look for.

    Raises McaptrackError for what can't be a similarity or a gate: in a file may stand anything.
    """
    from mcaptrack.evaluation.events import EventOptions
    from mcaptrack.pipeline import Watch

    if similarity not in (None, "iou", "metres"):
        raise McaptrackError(f"--similarity is iou or metres, not {similarity!r}")
    most = 1 if similarity == "iou" else 1e6
    if gate is not None and not (isinstance(gate, float | int) and 0 < gate <= most):
        raise McaptrackError(f"--gate is a share of overlap up to 1, or a distance in metres, not {gate!r}")
    if gate is not None and similarity is None:
        raise McaptrackError("--gate needs --similarity: it is a share of overlap for iou, a distance for metres")
    return Watch(EventOptions(similarity, gate), **chosen)


def _configured() -> dict[str, Transform]:
    """The stages as mcaptrack.toml wants them, for those that a command makes on its way; others aren't listed."""
    out: dict[str, Transform] = {}
    for name, default in TRANSFORMS.items():
        settings = settings_of(name)
        several = ALTERNATIVES.get(name)
        wanted = settings.get(several.option) if several else None
        if several and wanted is not None and wanted not in several.kinds:
            raise McaptrackError(f"{NAME}: {several.option} is one of {', '.join(several.kinds)}, not {wanted!r}")
        kind = several.kinds[wanted] if several and wanted else default
        base = PROFILES[settings["profile"]] if name == "retrack" and settings.get("profile") in PROFILES else kind()
        chosen = {option: value for option, value in settings.items() if option in _options_of(kind)}
        if chosen or settings.keys() & {"tracker", "profile"}:
            out[name] = replace(base, **chosen)
    return out


class _Plan:
    """What to do on one log, once it is open."""

    def __init__(self, opened: Any, prefix: str, say: Callable[[str], None]) -> None:
        self._opened, self._prefix, self._say = opened, prefix, say

    def stage(
        self, name: str, transform: Transform, topic: str | None, to: str | None, keep: tuple[str, ...] | None
    ) -> Any:
        from mcaptrack import pipeline

        return pipeline.plan_stage(
            self._opened, self._prefix, name, transform, topic, to, keep, self._say, _configured()
        )

    def all(self, topic: str | None) -> Any:
        from mcaptrack import pipeline

        return pipeline.plan_all(self._opened, self._prefix, self._say, topic, _configured())


def run_on_logs(
    given: Mapping[str, Any], make_plan: Callable[[_Plan], Any], tables: bool = False, watch: Watch | None = None
) -> None:
    """Plan and run on every log, and say and print what came of it."""
    from mcaptrack import notices

    paths = common.expand(given["logs"])
    common.only_one_output(paths, given["output"])
    if given["output"] and given["sidecar"]:
        raise McaptrackError("--sidecar and -o are two places for the same results; give one of them")
    results = []
    with common.Talk(given["quiet"], given["verbose"]).open() as talk:
        for path in paths:
            with notices.about(given["output"] or path):
                results.append(_run_on_log(path, given, make_plan, tables, watch, talk))
    if given["json"]:
        common.print_json({"results": results})


def _run_on_log(
    path: Path,
    given: Mapping[str, Any],
    make_plan: Callable[[_Plan], Any],
    tables: bool,
    watch: Watch | None,
    talk: common.Talk,
) -> dict[str, Any]:
    """Plan and run on one log; what came of it, for programs."""
    from mcaptrack import log, pipeline
    from mcaptrack.atomic import is_same_file, publish_bytes, refuse_overwrite
    from mcaptrack.export import default_folder, export

    output: Path | None = given["output"]
    target = output or path
    if output is not None:
        if is_same_file(output, path):
            raise McaptrackError(f"{path} is both input and output; leave -o out to add to it in place")
        refuse_overwrite(output, given["force"])
    with log.read(path, sidecar=given["sidecar"] or None) as opened:
        if output is None:
            opened.lock()  # a second writer is turned away before it computes anything
        camera = given["camera"] or (pipeline.camera_of(opened, watch.topics) if watch else None)
        prefix = pipeline.find_camera(opened, camera, given["topic"])
        jobs = make_plan(_Plan(opened, prefix, talk.say))
        report = pipeline.run(opened, prefix, jobs, output, talk.progress, watch)
    for name, content in report.layouts.items():
        publish_bytes(pipeline.layout_path(target, name), content)
    for topic, count in report.frames.items():
        talk.detail(f"{target}: {topic} {count} frames")
    for topic, kinds in report.events.items():
        words = ", ".join(f"{kind} {count}" for kind, count in kinds.items() if count) or "nothing happened"
        (talk.say if watch and watch.again else talk.detail)(f"{topic}: {words}")
    for topic in report.stale:
        talk.warn(
            f"{topic} was made from what has just been replaced; `mcaptrack run {target}` brings it up to date",
            "out-of-date",
        )
    written = {}
    if tables:
        with log.read(target) as opened:
            folder = default_folder(target)
            exported = export(opened, folder, talk.progress)
        written = exported.rows
        for words in exported.notes:
            talk.warn(words, "left-out")
        talk.detail(f"{folder}: {', '.join(f'{name} {rows}' for name, rows in written.items())}")
    done = ", ".join(report.stages) or "nothing to do, everything is up to date"
    talk.say(f"{target}: {done}")
    data = {"stages": report.stages, "frames": report.frames, "events": report.events, "tables": written}
    return {"log": str(target)} | data
