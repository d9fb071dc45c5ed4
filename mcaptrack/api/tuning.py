"""Find the options of a stage that score best against ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Final, Literal

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api.common import Notes, detail, optional_path, paths_of
from mcaptrack.api.declared import checked
from mcaptrack.api.ingesting import parse_fps
from mcaptrack.api.options import PathLike, Progress, no_progress
from mcaptrack.api.running import Option, transform_of
from mcaptrack.choices import Point
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import EvaluateOptions, ground_truth_of_log
from mcaptrack.evaluation import tuning as searching
from mcaptrack.evaluation.aligned import Similarity
from mcaptrack.evaluation.tuning import Metric, Range, Task, Trial, declared_ranges, uses_optuna
from mcaptrack.notices import Notice, collected
from mcaptrack.registry import blamed
from mcaptrack.schema import DETECTIONS
from mcaptrack.tables.compared import detections_and_ground_truth, pair_files
from mcaptrack.transforms import STAGES, Transform

TunedStage = Literal["track", "sample", "retrack"]
#: Parameters to search: their names; or ranges by name, None for the range that the stage declares.
Search = Sequence[str] | Mapping[str, tuple[float, float] | None]

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
    settings: Mapping[str, Option | Transform]
    scores: Mapping[str, float]
    default_scores: Mapping[str, float]
    trials: int
    best: int
    notes: tuple[str, ...]
    warnings: tuple[Notice, ...]


@checked(trials=(1, 1_000_000), seed=(0, 2**31 - 1), gate_m=(0.001, 1e6), min_iou=(0.001, 1))
def tune(
    inputs: PathLike | Sequence[PathLike],
    *,
    truth: PathLike | Sequence[PathLike] | None = None,
    stage: TunedStage = "track",
    tracker: str | Transform | None = None,
    metric: Metric = "IDF1",
    trials: int = 100,
    search: Search | None = None,
    seed: int = 0,
    study: PathLike | None = None,
    similarity: Similarity | None = None,
    gate_m: float = 1.0,
    min_iou: float = 0.5,
    fps: float | str | Fraction | None = None,
    ground_plane: PathLike | None = None,
    point: Point = "foot",
    topic: str | None = None,
    camera: str | None = None,
    force: bool = False,
    progress: Progress = no_progress,
) -> TuneResult:
    """Find the options of a stage that score best against ground truth.

    Nothing is written but ``study``. Trials learn from each other if Optuna is installed, otherwise they are random.
    Score the settings on other recordings before you trust them.

    Parameters
    ----------
    inputs : path or sequence of paths
        Logs, which hold their ground truth; or, with ``truth``, files of detections.
    truth : path or sequence of paths, optional
        Ground truth for files of detections: one file for each, matched by name or in order.
    stage : {"track", "sample", "retrack"}, default "track"
        The stage to tune.
    tracker : str or Transform, optional
        The tracker to tune, by default "sort"; a transform keeps its other options. Only for the stage "track".
    metric : {"IDF1", "MOTA", "HOTA", "IDP", "IDR", "DetA", "AssA"}, default "IDF1"
        The score to maximise.
    trials : int, default 100
        Number of settings to try, the defaults first, and those in ``study`` included.
    search : sequence of str, or mapping of str to (float, float) or None, optional
        Parameters to search, with ranges or without. By default all that the stage declares.
    seed : int, default 0
        Random seed.
    study : path, optional
        Keep trials in this file, and continue with those in it.
    similarity : {"iou", "metres", "bev-iou", "3d-iou"}, optional
        Match by overlap of boxes or by distance on the ground; by default by overlap for the stage "track", otherwise
        by distance.
    gate_m : float, default 1
        Largest distance of a match in metres.
    min_iou : float, default 0.5
        Least overlap (IoU) of a match.
    fps : float, str or Fraction, optional
        For files: frames per second.
    ground_plane : path, optional
        For files: 3x3 homography from pixels to metres on the ground.
    point : {"foot", "center"}, default "foot"
        For files: which point of a box touches the ground.
    topic : str, optional
        Read this channel instead of the usual one.
    camera : str, optional
        Name of the camera, if a log has several.
    force : bool, default False
        Forget the trials in ``study``.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

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
    >>> import mcaptrack
    >>> result = mcaptrack.tune("log.mcap", search={"min_iou": (0.1, 0.5)}, trials=2)
    >>> result.scores["IDF1"] >= result.default_scores["IDF1"]
    True
    >>> mcaptrack.track("log.mcap", output="tuned.mcap", **result.settings).stages
    ('track',)

    """
    has_tracker = STAGES[stage].reads is DETECTIONS
    if tracker is not None and not has_tracker:
        raise McaptrackError(f"the stage {stage} has no tracker; leave `tracker=` out")
    base = transform_of(stage, tracker, {})
    is_own = STAGES[stage].is_built_in(type(base))
    entry = None if is_own else STAGES[stage].entry(type(base))
    with blamed(entry, "could not be made with the ends of `search=`") if entry else nullcontext():
        ranges = _ranges(type(base), search)
    chosen: Similarity = similarity or ("iou" if has_tracker else "metres")
    scoring = EvaluateOptions(similarities=(chosen,), gates_m=(gate_m,), min_iou=min_iou)
    notes, trials_file = Notes(), optional_path(study)
    with collected() as warnings:
        if truth is None:
            tasks = _tasks_of_logs(paths_of(inputs), camera, topic, stage, base)
        elif not has_tracker:
            raise McaptrackError(f"files of detections are for `stage='track'`; to tune {stage} give logs")
        else:
            pairs, note_on_pairs = pair_files(paths_of(inputs), paths_of(truth))
            if note_on_pairs:
                notes.say(note_on_pairs)
            tasks = _tasks_of_files(pairs, parse_fps(fps), optional_path(ground_plane), point)
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
            base,
            tasks,
            ranges,
            scoring,
            metric=metric,
            trials=trials,
            seed=seed,
            study=trials_file,
            on_trial=tell,
            entry=entry,
        )
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


def _ranges(kind: type[Transform], search: Search | None) -> dict[str, Range]:
    """Return the ranges to search: those that are asked for, or all that are declared."""
    declared = declared_ranges(kind)
    if not search:
        return declared
    asked = search if isinstance(search, Mapping) else dict.fromkeys([search] if isinstance(search, str) else search)
    out = {}
    for name, span in asked.items():
        if name not in declared:
            text = ", ".join(declared) or "none"
            raise McaptrackError(f"`search=` has {name}, which can't be searched; there are {text}")
        out[name] = declared[name]
        if span is not None:
            low, high = span
            if not low <= high:
                raise McaptrackError(f"`search=` needs a range from low to high for {name}, not {low:g} to {high:g}")
            whole = declared[name].whole
            for end in span:
                kind(**{name: int(end) if whole else end})  # both ends have to be allowed
            out[name] = Range(low, high, whole)
    return out


def _tasks_of_files(
    pairs: Sequence[tuple[str, Path, Path]], fps: Fraction | None, ground_plane: Path | None, point: Point
) -> list[Task]:
    tasks = []
    for name, path, labels in pairs:
        detected = detections_and_ground_truth(path, labels, fps, ground_plane, point)
        tasks.append(Task(name, detected.detections, detected.ground_truth, {"ground_planes": detected.planes}))
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
