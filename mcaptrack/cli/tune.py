"""``mcaptrack tune``: the parameters of a stage that score best against the truth, as a mcaptrack.toml."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from mcaptrack.cli import common
from mcaptrack.cli.command import warn_unused
from mcaptrack.cli.config import NAME, read_toml, write_settings
from mcaptrack.cli.settings import old_names
from mcaptrack.cli.stages import chooser
from mcaptrack.cli.text import console, show
from mcaptrack.errors import McaptrackError
from mcaptrack.transforms import STAGES, Transform

if TYPE_CHECKING:
    from mcaptrack.evaluation.tuning import Range, Task, Trial

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
            panel=common.LABELS,
            help="Ground truth for files of detections: one file for each, matched by name or in order.",
            show_default=False,
        ),
    ] = None,
    stage: Annotated[
        Literal["track", "sample", "retrack"],
        common.option("--stage", panel=_SEARCH, tuning=True, help="The stage to tune."),
    ] = "track",
    tracker: Annotated[str, chooser("tracker", words="The {kind} to tune", panel=_SEARCH)] = "sort",
    metric: Annotated[
        Literal["IDF1", "MOTA", "HOTA", "IDP", "IDR", "DetA", "AssA"],
        common.option("--metric", panel=common.SCORES, tuning=True, help="Score to maximise.", case_sensitive=False),
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
    similarity: Annotated[common.SimilarityName | None, common.similarity("iou; metres after track")] = None,
    gate_m: Annotated[float, common.gate_m()] = 1.0,
    min_iou: Annotated[float, common.min_iou(was="--match-iou")] = 0.5,
    fps: common.LabelFps = None,
    ground_plane: common.GroundPlane = None,
    point: common.Point = "foot",
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
    from mcaptrack.evaluation import EvaluateOptions
    from mcaptrack.evaluation.tuning import tune as run
    from mcaptrack.evaluation.tuning import uses_optuna

    has_trackers = STAGES[stage].kind == "tracker"
    kind = STAGES[stage].find(tracker).cls if has_trackers else STAGES[stage].default
    chosen = similarity or ("iou" if stage == "track" else "metres")
    scoring = EvaluateOptions(similarities=(chosen,), gates_m=(gate_m,), min_iou=min_iou)
    ranges = _ranges(kind, search or [])
    which = tracker.replace(":", ".") if has_trackers else stage
    trials_file = study or output.with_name(f"{output.stem}.{which}.trials.jsonl")
    with common.Talk(quiet, verbose).open() as talk:
        read_toml(output)  # a file that can't be edited is refused before the search
        if truth:
            given = {"fps": fps, "ground_plane": ground_plane, "point": point}
            tasks = _tasks_of_files(common.expand(inputs), common.expand(truth), stage, given, talk)
            warn_unused("files of detections are of no camera", "camera", "topic")
            if ground_plane is None:
                warn_unused("there is no ground plane", "point")
        else:
            tasks = _tasks_of_logs(common.expand(inputs), camera, topic, stage, kind)
            warn_unused("it is about label files; logs have theirs inside", "ground_plane", "point", "fps")
        if not has_trackers:
            warn_unused(f"{stage} has no trackers", "tracker")
        warn_unused(*(("overlap is compared", "gate_m") if chosen == "iou" else ("distance is compared", "min_iou")))
        if force:
            trials_file.unlink(missing_ok=True)
        how = "Optuna" if uses_optuna() else "chance; with `pip install mcaptrack[tune]` they learn from each other"
        talk.say(f"{stage}: {len(ranges)} parameters, {len(tasks)} sequences, trials by {how}")

        def told(trial: Trial, best: Trial, total: int) -> None:
            talk.progress("tune", trial.number + 1, total)
            if trial is best:
                talk.detail(f"trial {trial.number}: {metric} {trial.scores[metric]:.4f} {_words(trial.parameters)}")

        first, best = run(
            kind(), tasks, ranges, scoring, metric=metric, trials=trials, seed=seed, study=trials_file, on_trial=told
        )
        settings = ({"tracker": tracker} if has_trackers else {}) | dict(best.parameters)
        if best is first:
            talk.say(f"nothing that was tried beats the defaults ({metric} {first.scores[metric]:.4f}); {output} stays")
        else:
            named = {name.replace("_", "-"): value for name, value in settings.items()}
            write_settings(output, stage, named, old_names(stage))
            talk.say(f"{output}: {metric} {first.scores[metric]:.4f} with the defaults, {best.scores[metric]:.4f} now")
    if json:
        row = {"stage": stage, "metric": metric, "settings": settings, "trials": trials, "best": best.number}
        common.print_json({"results": [row | {"scores": dict(best.scores), "default_scores": dict(first.scores)}]})
    else:
        _print(first, best, settings)


def _ranges(kind: type[Transform], wanted: Sequence[str]) -> dict[str, Range]:
    """The ranges to search in: those that are asked for, or all that are declared."""
    from mcaptrack.evaluation.tuning import Range, declared_ranges

    declared = declared_ranges(kind)
    if not wanted:
        return declared
    out = {}
    for text in wanted:
        name, _, span = text.partition("=")
        name = name.strip().lstrip("-").replace("-", "_")
        if name not in declared:
            known = ", ".join(one.replace("_", "-") for one in declared) or "none"
            raise McaptrackError(f"--search {text}: no parameter that can be searched; there are {known}")
        out[name] = declared[name]
        if span:
            try:
                low, high = (float(part) for part in span.split(":"))
            except ValueError:
                low, high = 1.0, 0.0
            if not low <= high:
                raise McaptrackError(f"--search needs a range like {name.replace('_', '-')}=0.1:0.5, not {text}")
            kind(**{name: int(low) if declared[name].whole else low})  # both ends have to be allowed
            kind(**{name: int(high) if declared[name].whole else high})
            out[name] = Range(low, high, declared[name].whole)
    return out


def _tasks_of_files(
    paths: Sequence[Path], truths: Sequence[Path], stage: str, given: dict[str, Any], talk: common.Talk
) -> list[Task]:
    from mcaptrack.api.ingesting import parse_fps
    from mcaptrack.evaluation.tuning import Task
    from mcaptrack.tables.compared import detections_and_ground_truth, pair_files

    if stage != "track":
        raise McaptrackError(f"files of detections are for --stage track; to tune {stage} give logs")
    pairs, words = pair_files(paths, truths)
    if words:
        talk.say(words)
    tasks = []
    for name, path, labels in pairs:
        found = detections_and_ground_truth(
            path, labels, parse_fps(given["fps"]), given["ground_plane"], given["point"]
        )
        tasks.append(Task(name, found.detections, found.ground_truth, {"ground_planes": found.planes}))
    return tasks


def _tasks_of_logs(
    paths: Sequence[Path], camera: str | None, topic: str | None, stage: str, kind: type[Transform]
) -> list[Task]:
    from mcaptrack import log, pipeline
    from mcaptrack.evaluation import ground_truth_of_log
    from mcaptrack.evaluation.tuning import Task

    tasks = []
    for path in paths:
        with log.read(path) as opened:
            prefix = pipeline.find_camera(opened, camera, topic)
            truth = ground_truth_of_log(opened, prefix)
            frames, context = pipeline.input_of(opened, prefix, stage, kind(), topic)
            tasks.append(Task(path.stem, frames, truth, context))
    return tasks


def _words(parameters: Any) -> str:
    return " ".join(f"{name.replace('_', '-')}={value}" for name, value in parameters.items())


def _print(first: Trial, best: Trial, settings: dict[str, Any]) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("")
    for name in _SHOWN:
        table.add_column(name, justify="right")
    for words, trial in (("defaults", first), ("best", best)):
        values = [trial.scores[name] for name in _SHOWN]
        table.add_row(words, *(f"{100 * v:.1f}" if isinstance(v, float) else str(v) for v in values))
    console().print(table)
    show("", *(f"{name.replace('_', '-')} = {value}" for name, value in settings.items()))
