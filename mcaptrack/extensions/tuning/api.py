"""Find the options of a stage that score best against ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api import labels
from mcaptrack.api.common import Notes, detail, optional_path, paths_of
from mcaptrack.api.declared import Argument, Option, declared
from mcaptrack.api.options import (
    FILES,
    LABELS,
    SCORES,
    Camera,
    Force,
    GroundPlane,
    MinIou,
    PathLike,
    Reports,
    Topic,
    chooser,
    gate_m,
    no_progress,
    similarity,
)
from mcaptrack.api.running import transform_of
from mcaptrack.choices import Similarity
from mcaptrack.errors import McaptrackError, offer
from mcaptrack.evaluation import EvaluateOptions, ground_truth_of_log
from mcaptrack.extensions.tuning import search as searching
from mcaptrack.extensions.tuning.search import Metric, Range, Task, Trial, declared_ranges, uses_optuna
from mcaptrack.notices import Notice, collected
from mcaptrack.registry import Entry, blamed
from mcaptrack.sources.ingest import IngestOptions
from mcaptrack.tables.compared import detections_and_ground_truth, pair_files
from mcaptrack.transforms import STAGES, Transform

TunedStage = Literal["track", "sample", "retrack"]
#: Parameters to search: their names; or ranges by name, None for the range that the stage declares.
Search = Sequence[str] | Mapping[str, tuple[float, float] | None]

_SEARCH: Final = "Search"  # a heading in the help
_BY_CHANCE: Final = "random numbers; with `pip install mcaptrack[tune]` they learn from each other"


@dataclass(frozen=True)
class TuneResult:
    """The result of a search of parameters.

    Attributes
    ----------
    stage : str
        The stage that was tuned.
    metric : str
        The score that was maximised.
    similarity : {"iou", "metres", "bev-iou", "3d-iou"}
        How ground truth and tracks were matched.
    settings : dict of str to float, int, str or Transform
        The best parameters, with the tracker they belong to; the function of the stage takes them as they are:
        ``mcaptrack.track("log.mcap", **result.settings)``.
    scores, default_scores : dict of str to float
        Scores over all sequences together, with the best parameters and with the defaults.
    trials : int
        Number of trials, those of the study included.
    best : int
        Number of the best trial; 0 is the defaults.
    notes : tuple of str
        How files were paired, and what was searched.
    warnings : tuple of mcaptrack.Notice
        What was assumed, left out or looks odd.

    """

    stage: TunedStage
    metric: Metric
    similarity: Similarity
    settings: Mapping[str, Any]  # any other type would not be taken as ``**settings``
    scores: Mapping[str, float]
    default_scores: Mapping[str, float]
    trials: int
    best: int
    notes: tuple[str, ...]
    warnings: tuple[Notice, ...]


@declared(
    most_used=("truth", "stage", "tracker", "metric", "trials", "search", "topic", "output", "force"),
    settable=("seed", "gate_m", "min_iou", "classes", "fps"),
    python_only=("label_format", "ground_plane"),
    heading="Improve and repair",
    printed_by="mcaptrack.extensions.tuning.command:Tune",
)
def tune(
    inputs: Annotated[
        PathLike | Sequence[PathLike], Argument("inputs", "LOG|DETECTIONS", "Logs, or files of detections.")
    ],
    *,
    truth: Annotated[PathLike | Sequence[PathLike] | None, Option(LABELS, shown=False)] = None,
    stage: Annotated[TunedStage, Option(_SEARCH, tuning=True)] = "track",
    tracker: Annotated[str | Transform | None, chooser("tracker", "The {kind} to tune", _SEARCH, "sort")] = None,
    metric: Annotated[Metric, Option(SCORES, tuning=True)] = "IDF1",
    trials: Annotated[int, Option(_SEARCH, 1, 1_000_000, tuning=True)] = 100,
    search: Annotated[Search | None, Option(_SEARCH, tuning=r"[A-Za-z0-9_-]+(=[0-9.eE+-]+:[0-9.eE+-]+)?")] = None,
    seed: Annotated[int, Option(_SEARCH, 0, 2**31 - 1, tuning=True)] = 0,
    study: Annotated[PathLike | None, Option(FILES, shown="beside the file of settings")] = None,
    similarity: Annotated[Similarity | None, similarity("iou; metres after track")] = None,
    gate_m: Annotated[float, gate_m()] = 1.0,
    min_iou: MinIou = 0.5,
    label_format: labels.Format = "auto",
    classes: labels.Classes = None,
    fps: labels.LabelFps = None,
    ground_plane: GroundPlane = None,
    topic: Topic = None,
    camera: Camera = None,
    force: Force = False,
    progress: Reports = no_progress,
) -> TuneResult:
    """Find the settings of a stage that score best.

    Reads detections and ground truth from logs, or from files with ``truth``. The command writes the best settings to
    mcaptrack.toml, which every command reads; other settings in it stay. A search that was interrupted continues where
    it stopped. With Optuna installed trials learn from each other, otherwise they are random. Score the settings on
    other recordings before you trust them.

    Parameters
    ----------
    inputs : path or sequence of paths
        Logs, which hold their ground truth; or, with ``truth``, files of detections.
    truth : path or sequence of paths, optional
        Ground truth for files of detections: one file for each, matched by name or in order.
    stage : {"track", "sample", "retrack"}, default "track"
        The stage to tune.
    metric : {"IDF1", "MOTA", "HOTA", "IDP", "IDR", "DetA", "AssA"}, default "IDF1"
        Score to maximise.
    trials : int, default 100
        Number of settings to try, the defaults first.

        Those in ``study`` are included.
    search : sequence of str, or mapping of str to (float, float) or None, optional
        Parameters to search, with a range as in min-iou=0.1:0.5, or without; by default all that the stage declares.

        In Python ranges are pairs: ``{"min_iou": (0.1, 0.5)}``.
    seed : int, default 0
        Random seed.
    study : path, optional
        Keep trials in this file; go on with those in it.
    force : bool, default False
        Forget earlier trials.

    Returns
    -------
    TuneResult
        The best settings and their scores.

    Raises
    ------
    McaptrackError
        If there is no ground truth, if a parameter or its range does not exist, or if ``study`` is of another search.

    Examples
    --------
    On the command line:

        mcaptrack tune log.mcap --tracker ocsort --metric hota --trials 200

    >>> import mcaptrack
    >>> result = mcaptrack.tune("log.mcap", search={"min_iou": (0.1, 0.5)}, trials=2)
    >>> result.scores["IDF1"] >= result.default_scores["IDF1"]
    True
    >>> mcaptrack.track("log.mcap", output="tuned.mcap", **result.settings).stages
    ('track',)

    """
    has_tracker = STAGES[stage].kind == "tracker"
    if tracker is not None and not has_tracker:
        raise McaptrackError(f"the stage {stage} has no tracker; leave `tracker=` out")
    base = transform_of(stage, tracker, {})
    entry = STAGES[stage].entry(type(base))
    ranges = _ranges(type(base), search, entry)
    chosen: Similarity = similarity or ("iou" if has_tracker else "metres")
    scoring = EvaluateOptions(similarities=(chosen,), gates_m=(gate_m,), min_iou=min_iou)
    how = labels.label_options(label_format=label_format, classes=classes, fps=fps, ground_plane=ground_plane)
    notes, trials_file = Notes(), optional_path(study)
    with collected() as warnings:
        if truth is None:
            tasks = _tasks_of_logs(paths_of(inputs), camera, topic, stage, base)
            labels.warn_of_unused(how, "it is about label files; logs have theirs inside")
        elif not has_tracker:
            raise McaptrackError(f"files of detections are for `stage='track'`; to tune {stage} give logs")
        else:
            tasks = _tasks_of_files(paths_of(inputs), paths_of(truth), how, notes)
        if force and trials_file is not None:
            trials_file.unlink(missing_ok=True)
        proposals = "Optuna" if uses_optuna() else _BY_CHANCE
        notes.say(f"{stage}: {len(ranges)} parameters, {len(tasks)} sequences, trials by {proposals}")

        def tell(trial: Trial, best: Trial, total: int) -> None:
            progress("tune", trial.number + 1, total)
            if trial is best:
                values = " ".join(f"{name}={value}" for name, value in trial.parameters.items())
                detail(f"trial {trial.number}: {metric} {trial.scores[metric]:.4f} {values}".rstrip())

        first, best = searching.tune(
            base, tasks, ranges, scoring, entry, metric=metric, trials=trials, seed=seed, study=trials_file,
            on_trial=tell,
        )  # fmt: skip
    settings = ({"tracker": tracker or "sort"} if has_tracker else {}) | dict(best.parameters)
    return TuneResult(
        stage=stage,
        metric=metric,
        similarity=chosen,
        settings=settings,
        scores=dict(best.scores),
        default_scores=dict(first.scores),
        trials=trials,
        best=best.number,
        notes=tuple(notes),
        warnings=tuple(dict.fromkeys(warnings)),
    )


def _ranges(kind: type[Transform], search: Search | None, entry: Entry) -> dict[str, Range]:
    """Return the ranges to search: those that are asked for, or all that are declared; ``entry`` as in ``tune``."""
    declared = declared_ranges(kind)
    if not (search and declared):
        return declared
    asked = search if isinstance(search, Mapping) else dict.fromkeys([search] if isinstance(search, str) else search)
    out = {}
    for name, span in asked.items():
        if name not in declared:
            every = offer(name, declared, "there are")
            raise McaptrackError(f"`search=` has {name}, which can't be searched; {every}")
        out[name] = declared[name]
        if span is not None:
            low, high = span
            if not low <= high:
                raise McaptrackError(f"`search=` needs a range from low to high for {name}, not {low:g} to {high:g}")
            whole = declared[name].whole
            with blamed(entry, "could not be made with the ends of `search=`"):
                for end in span:
                    kind(**{name: int(end) if whole else end})  # both ends have to be allowed
            out[name] = Range(low, high, whole)
    return out


def _tasks_of_files(inputs: Sequence[Path], truths: Sequence[Path], how: IngestOptions, notes: Notes) -> list[Task]:
    pairs, note_on_pairs = pair_files(inputs, truths)
    if note_on_pairs:
        notes.say(note_on_pairs)
    tasks = []
    for name, path, truth in pairs:
        detections, ground_truth, planes = detections_and_ground_truth(path, truth, how)
        tasks.append(Task(name, detections, ground_truth, {"ground_planes": planes}))
    return tasks


def _tasks_of_logs(
    paths: Sequence[Path], camera: str | None, topic: str | None, stage: str, base: Transform
) -> list[Task]:
    tasks = []
    for path in paths:
        with logs.read(path) as opened:
            prefix = pipeline.find_camera(opened, camera, topic)
            truth = ground_truth_of_log(opened, prefix)
            frames, context = pipeline.input_of(opened, prefix, stage, base, topic)
            tasks.append(Task(path.stem, frames, truth, context))
    return tasks
