"""``mcaptrack tune``: find the parameters of a stage that score best, and write them to mcaptrack.toml."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from mcaptrack.cli import common, labels
from mcaptrack.cli.chosen import has_flag, options_of
from mcaptrack.cli.command import warn_unused
from mcaptrack.cli.common import expand
from mcaptrack.cli.config import NAME, read_toml, write_settings
from mcaptrack.cli.stages import chooser
from mcaptrack.cli.text import console, show, stdout_to_stderr
from mcaptrack.errors import McaptrackError
from mcaptrack.location import sibling
from mcaptrack.schema import DETECTIONS
from mcaptrack.transforms import STAGES

if TYPE_CHECKING:
    from mcaptrack import TuneResult

_SEARCH: Final = "Search"
_SHOWN: Final = ("IDF1", "MOTA", "HOTA", "IDSW", "FP", "FN")


@common.one_line
def tune(
    inputs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG|DETECTIONS", help="Logs, or files of detections.", show_default=False),
    ],
    truth: Annotated[
        list[Path] | None,
        common.option(
            "--truth",
            panel=labels.LABELS,
            help="Ground truth for files of detections: one file for each, matched by name or in order.",
            show_default=False,
        ),
    ] = None,
    stage: Annotated[
        Literal["track", "sample", "retrack"],
        common.option("--stage", panel=_SEARCH, tuning=True, help="The stage to tune."),
    ] = "track",
    tracker: Annotated[str, chooser("tracker", intro="The {kind} to tune", panel=_SEARCH)] = "sort",
    metric: Annotated[
        Literal["IDF1", "MOTA", "HOTA", "IDP", "IDR", "DetA", "AssA"],
        common.option("--metric", panel=labels.SCORES, tuning=True, help="Score to maximise.", case_sensitive=False),
    ] = "IDF1",
    trials: Annotated[
        int,
        common.option(
            "--trials",
            panel=_SEARCH,
            least=1,
            most=1_000_000,
            tuning=True,
            help="Number of settings to try, the defaults first.",
        ),
    ] = 100,
    search: Annotated[
        list[str] | None,
        common.option(
            "--search",
            panel=_SEARCH,
            tuning=r"[A-Za-z0-9_-]+(=[0-9.eE+-]+:[0-9.eE+-]+)?",
            help="Parameters to search, with a range as in min-iou=0.1:0.5, or without.",
            show_default="all that the stage declares",
        ),
    ] = None,
    seed: Annotated[
        int, common.option("--seed", panel=_SEARCH, least=0, most=2**31 - 1, tuning=True, help="Random seed.")
    ] = 0,
    study: Annotated[
        Path | None,
        common.option(
            "--study",
            panel=common.FILES,
            help="Keep trials in this file; go on with those in it.",
            show_default="beside -o",
        ),
    ] = None,
    similarity: Annotated[labels.SimilarityName | None, labels.similarity("iou; metres after track")] = None,
    gate_m: Annotated[float, labels.gate_m()] = 1.0,
    min_iou: Annotated[float, labels.min_iou()] = 0.5,
    fps: labels.LabelFps = None,
    ground_plane: labels.GroundPlane = None,
    point: labels.Point = "foot",
    topic: Annotated[
        str | None, common.option("--topic", panel=common.FILES, help="Read this channel instead of the default one.")
    ] = None,
    camera: common.Camera = None,
    output: Annotated[
        Path,
        common.option("--output", "-o", panel=common.FILES, help="Write the settings to this file.", show_default=True),
    ] = Path(NAME),
    force: Annotated[bool, common.option("--force", panel=common.FILES, help="Forget earlier trials.")] = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Find the settings of a stage that score best against ground truth.

    Reads detections and ground truth from logs, or from files with --truth. Writes the best settings to mcaptrack.toml,
    which every command reads; other settings in it stay. A search that was interrupted continues where it stopped. With
    Optuna installed trials learn from each other, otherwise they are random. Score the settings on other recordings
    before you trust them.

    Example: mcaptrack tune log.mcap --tracker ocsort --metric hota --trials 200
    """
    import mcaptrack

    ranges = dict(map(_range, search or ()))
    is_tracker = STAGES[stage].reads is DETECTIONS
    which = tracker.replace(":", ".") if is_tracker else stage
    with common.Talk(quiet, verbose).open() as talk:
        read_toml(output)  # a file that can't be edited is refused before the search
        with stdout_to_stderr():
            done = mcaptrack.tune(
                expand(inputs),
                truth=expand(truth) if truth else None,
                stage=stage,
                tracker=tracker if is_tracker else None,
                metric=metric,
                trials=trials,
                search=ranges,
                seed=seed,
                study=study or sibling(output, f".{which}.trials.jsonl"),
                similarity=similarity,
                gate_m=gate_m,
                min_iou=min_iou,
                fps=fps,
                ground_plane=ground_plane,
                point=point,
                topic=topic,
                camera=camera,
                force=force,
                progress=talk.progress,
            )
        if truth:
            warn_unused("files of detections are of no camera", "camera", "topic")
            if ground_plane is None:
                warn_unused("there is no ground plane", "point")
        else:
            warn_unused("it is about label files; logs have theirs inside", "ground_plane", "point", "fps")
        if not is_tracker:
            warn_unused(f"{stage} has no trackers", "tracker")
        by_overlap = done.similarity == "iou"
        warn_unused(*(("overlap is compared", "gate_m") if by_overlap else ("distance is compared", "min_iou")))
        score, before = done.scores[metric], done.default_scores[metric]
        if done.best == 0:
            talk.say(f"nothing that was tried beats the defaults ({metric} {before:.4f}); {output} stays")
        else:
            kinds = STAGES[stage].built_in().values()
            flagless = {name for kind in kinds for name, field in options_of(kind).items() if not has_flag(field)}
            named: dict[str, Any] = {
                name.replace("_", "-"): value for name, value in done.settings.items() if name not in flagless
            }
            if set_ := [f"{name}={value}" for name, value in done.settings.items() if name in flagless]:
                named["set"] = set_
            write_settings(output, stage, named)
            talk.say(f"{output}: {metric} {before:.4f} with the defaults, {score:.4f} now")
    if json:
        row = {"stage": stage, "metric": metric, "settings": done.settings, "trials": done.trials, "best": done.best}
        common.print_json({"results": [row | {"scores": done.scores, "default_scores": done.default_scores}]})
    else:
        _print(done)


def _range(text: str) -> tuple[str, tuple[float, float] | None]:
    """Return a parameter to search and its range, from text such as min-iou=0.1:0.5, or min-iou for None."""
    name, equals, span = text.partition("=")
    name = name.strip().lstrip("-")
    if not equals:
        return name.replace("-", "_"), None
    try:
        low, high = (float(part) for part in span.split(":"))
    except ValueError:
        raise McaptrackError(f"--search needs a range like {name}=0.1:0.5, not {text}") from None
    return name.replace("-", "_"), (low, high)


def _print(done: TuneResult) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("")
    for name in _SHOWN:
        table.add_column(name, justify="right")
    for name_of_scores, scores in (("defaults", done.default_scores), ("best", done.scores)):
        values = [scores[name] for name in _SHOWN]
        table.add_row(name_of_scores, *(f"{100 * v:.1f}" if isinstance(v, float) else str(v) for v in values))
    console().print(table)
    show("", *(f"{name.replace('_', '-')} = {value}" for name, value in done.settings.items()))
