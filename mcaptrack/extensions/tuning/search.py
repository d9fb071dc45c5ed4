"""Search the parameters of a transform that score best against ground truth.

A search draws parameters within the ranges that the transform declares, runs the transform on each sequence, scores the
result, and appends each trial to a file at once; started again with the same file, it continues. Optuna proposes the
trials if it is installed, otherwise they are random.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, Literal, get_type_hints

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import Candidate, EvaluateOptions, EvaluationInput, evaluate
from mcaptrack.files import writing
from mcaptrack.registry import Entry, blamed
from mcaptrack.schema import Frame
from mcaptrack.transforms import Transform
from mcaptrack.transforms.guarded import guarded
from mcaptrack.transforms.protocol import bare_type

Metric = Literal["IDF1", "MOTA", "HOTA", "IDP", "IDR", "DetA", "AssA"]

#: Parameters are rounded to this many digits, so that the file has exactly the values that were tried.
_DIGITS: Final = 3
_VERSION: Final = 1


@dataclass(frozen=True)
class Range:
    """The range of a parameter, both ends included; only ints if ``whole``."""

    low: float
    high: float
    whole: bool

    def draw(self, rng: np.random.Generator) -> float | int:
        """A value of the range, uniformly distributed."""
        if self.whole:
            return int(rng.integers(round(self.low), round(self.high) + 1))
        return round(float(rng.uniform(self.low, self.high)), _DIGITS)


@dataclass(frozen=True)
class Task:
    """One sequence of a search: the input of the transform, the ground truth, and the transform's context."""

    name: str
    frames: Sequence[Frame]
    ground_truth: Sequence[Frame]
    context: Mapping[str, Any]


@dataclass(frozen=True)
class Trial:
    """Parameters and their scores over all sequences. Trial 0 has the default parameters."""

    number: int
    parameters: Mapping[str, Any]
    scores: Mapping[str, float]


def declared_ranges(kind: type[Transform]) -> dict[str, Range]:
    """The ranges that a transform declares for a search, by parameter."""
    hints = get_type_hints(kind)
    return {
        parameter.name: Range(low, high, bare_type(hints[parameter.name]) is int)
        for parameter in fields(kind)
        if parameter.metadata.get("search")
        for low, high in [parameter.metadata["search"]]
    }


def tune(
    base: Transform,
    tasks: Sequence[Task],
    ranges: Mapping[str, Range],
    scoring: EvaluateOptions,
    entry: Entry,
    *,
    metric: Metric = "IDF1",
    trials: int = 100,
    seed: int = 0,
    study: Path | None = None,
    on_trial: Callable[[Trial, Trial, int], None] = lambda *_: None,
) -> tuple[Trial, Trial]:
    """Search parameters, and return the first trial (``base`` unchanged) and the best; the earliest of equals.

    Parameters
    ----------
    base : Transform
    tasks : sequence of Task
    ranges : mapping of str to Range
        The parameters to search.
    scoring : EvaluateOptions
    entry : Entry
        The entry of ``base``. Outputs of another package are checked, and errors name it.
    metric : str
        The score to maximise.
    trials : int
        The number of trials, including those in ``study``.
    seed : int
        Random seed.
    study : Path, optional
        A file of earlier trials, to which new ones are appended.
    on_trial : callable
        Called with each new trial, the best so far and the number of trials.

    Raises
    ------
    McaptrackError
        If there are no ranges, if ``study`` belongs to another search, or if a transform of another package fails.
    """
    if not ranges:
        raise McaptrackError(
            f"{entry} declares no ranges to search in; a field of the class has one with option(0.3, search=(0.1, 0.9))"
        )
    searched = _Study(study, _about(base, tasks, ranges, scoring))
    done = searched.trials
    propose = _proposer(ranges, metric, seed, done)
    while len(done) < trials:
        number = len(done)
        parameters = {} if number == 0 else propose.ask(number)
        with blamed(entry, f"could not be made with {parameters}"):
            transform = replace(base, **parameters)
        trial = Trial(number, parameters, trial_scores(transform, tasks, scoring, entry))
        propose.tell(trial)
        searched.add(trial)
        on_trial(trial, _best(done, metric), trials)
    return done[0], _best(done, metric)


def _best(trials: Sequence[Trial], metric: str) -> Trial:
    return max(trials, key=lambda trial: trial.scores[metric])


def trial_scores(
    transform: Transform, tasks: Sequence[Task], scoring: EvaluateOptions, entry: Entry
) -> dict[str, float]:
    """The scores of a transform's main output, over all sequences together; ``entry`` as in ``tune``."""

    def sequences() -> Iterator[EvaluationInput]:
        for task in tasks:
            names = {f.name for f in fields(transform)}
            told = replace(transform, **{name: value for name, value in task.context.items() if name in names})
            results = guarded(entry, told, task.frames)
            main = list(told.writes).index("")
            out = [result[main] for result in results]
            yield EvaluationInput(task.name, task.ground_truth, [Candidate("tracks", None, out)])

    row = [result for result in evaluate(sequences(), scoring).results if result.of_class is None][-1].to_json()
    return {name: value for name, value in row.items() if isinstance(value, int | float) and name != "gate"}


def _about(
    base: Transform, tasks: Sequence[Task], ranges: Mapping[str, Range], scoring: EvaluateOptions
) -> dict[str, Any]:
    """The identity of a study; trials of another study can't be continued."""
    digest = hashlib.sha256()
    for task in tasks:
        for part in (task.frames, task.ground_truth):
            digest.update(task.name.encode())
            for frame in part:
                digest.update(frame.t_ns.to_bytes(8, "little", signed=True) + frame.rows.tobytes())
    fixed = {f.name: getattr(base, f.name) for f in fields(base) if not f.metadata.get("context")}
    return {
        "version": _VERSION,
        "transform": type(base).__name__,
        "parameters": fixed,
        "ranges": {name: [part.low, part.high] for name, part in ranges.items()},
        "similarities": list(scoring.similarities),
        "gates_m": list(scoring.gates_m),
        "min_iou": scoring.min_iou,
        "rules": scoring.rules,
        "input": digest.hexdigest(),
    }


class _Study:
    """The trials of a search and their file: a line that identifies the search, then a line for each trial."""

    def __init__(self, path: Path | None, about: Mapping[str, Any]) -> None:
        self.trials: list[Trial] = []
        self._path = path
        if path is None:
            return
        head = json.dumps(about, sort_keys=True)
        try:
            if path.exists() and path.stat().st_size:
                self._read(path, json.loads(head))
            else:
                path.write_text(head + "\n", encoding="utf-8")
        except OSError as error:
            raise McaptrackError(f"{path} can't be used for a study: {error.strerror}") from None

    def _read(self, path: Path, about: Mapping[str, Any]) -> None:
        raw = path.read_bytes()
        whole = raw[: raw.rfind(b"\n") + 1]  # the last line may be incomplete if a run was ended while it wrote
        try:
            head, *lines = (json.loads(line) for line in whole.decode("utf-8").splitlines())
            self.trials = [Trial(line["number"], line["parameters"], line["scores"]) for line in lines]
        except (ValueError, KeyError, TypeError):
            raise McaptrackError(f"{path} is no study: a file of trials that tune wrote") from None
        differs = sorted(name for name in about if head.get(name) != about[name]) if isinstance(head, dict) else ["all"]
        if differs:
            raise McaptrackError(
                f"{path} is a study of another search ({', '.join(differs)} differ); give another file"
            )
        if len(whole) < len(raw):
            path.write_bytes(whole)

    def add(self, trial: Trial) -> None:
        self.trials.append(trial)
        if self._path is not None:
            line = {"number": trial.number, "parameters": trial.parameters, "scores": trial.scores}
            with writing(self._path), self._path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(line) + "\n")


class _Random:
    """Proposes random values; trial n of a seed is always the same."""

    def __init__(self, ranges: Mapping[str, Range], seed: int) -> None:
        self._ranges, self._seed = ranges, seed

    def ask(self, number: int) -> dict[str, Any]:
        rng = np.random.default_rng([self._seed, number])
        return {name: part.draw(rng) for name, part in self._ranges.items()}

    def tell(self, trial: Trial) -> None:
        """Random proposals do not depend on trials."""


class _Optuna:
    """Proposes with Optuna's tree-structured Parzen estimator."""

    def __init__(self, ranges: Mapping[str, Range], metric: str, seed: int, done: Sequence[Trial]) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        distributions = optuna.distributions
        self._optuna, self._metric = optuna, metric
        self._space: dict[str, Any] = {
            name: distributions.IntDistribution(round(part.low), round(part.high))
            if part.whole
            else distributions.FloatDistribution(part.low, part.high)
            for name, part in ranges.items()
        }
        sampler = optuna.samplers.TPESampler(seed=seed + len(done), n_startup_trials=min(10, 2 * len(ranges)))
        self._study = optuna.create_study(direction="maximize", sampler=sampler)
        for trial in done:
            self.tell(trial)

    def ask(self, number: int) -> dict[str, Any]:
        asked = self._study.ask(self._space).params
        return {name: value if isinstance(value, int) else round(value, _DIGITS) for name, value in asked.items()}

    def tell(self, trial: Trial) -> None:
        value = trial.scores[self._metric]
        if set(trial.parameters) == set(self._space) and math.isfinite(value):
            self._study.add_trial(
                self._optuna.trial.create_trial(params=dict(trial.parameters), distributions=self._space, value=value)
            )


def _proposer(ranges: Mapping[str, Range], metric: str, seed: int, done: Sequence[Trial]) -> _Random | _Optuna:
    try:
        return _Optuna(ranges, metric, seed, done)
    except ImportError:
        return _Random(ranges, seed)


def uses_optuna() -> bool:
    """Whether Optuna is installed."""
    from importlib.util import find_spec

    return find_spec("optuna") is not None
