"""``mcaptrack evaluate``: print scores as a table, JSON or CSV."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from math import isnan
from typing import TYPE_CHECKING, Annotated, Any, Final

from mcaptrack.api.declared import Option
from mcaptrack.api.options import FILES, SCORES, PathLike
from mcaptrack.cli import common
from mcaptrack.cli.common import expand
from mcaptrack.cli.declared import Once, Printed
from mcaptrack.cli.text import print_table, printable, say, show, show_left_out
from mcaptrack.errors import McaptrackError, offer

if TYPE_CHECKING:
    from rich.text import Text

    from mcaptrack import Scores
    from mcaptrack.evaluation import EvaluationRow
    from mcaptrack.evaluation.metrics.displacement import Displacement

#: Name of a sequence, topic of tracks and class, None for all classes.
_Key = tuple[str, str, str | None]

_RATES: Final = ("MOTA", "IDF1", "HOTA")
_COLUMNS: Final = (*_RATES, "IDSW", "FP", "FN", "Frag")
#: Columns that a narrow terminal has no room for, the first to go first.
_SPARE: Final = ("Frag", "sAMOTA", "FN", "FP", "HOTA", "AMOTA", "MOTA", "class")
_SPARE_OF_FORECASTS: Final = ("drift m", "ADE m²", "false", "NLL", "in 90 %", "in 50 %", "class", "recall", "in 95 %")
#: Columns of forecasts, and of constant velocity beside them, by the names of the scores; others are for ``--all``.
_ERRORS: Final = {"ADE_m": "ADE m", "FDE_m": "FDE m"}
_OF_CONSTANT_VELOCITY: Final = {"ADE_m": "CV: ADE m", "FDE_m": "CV: FDE m"}
_FORECAST_COLUMNS: Final = {"recall": "recall", "coverage_95": "in 95 %"}
_ALL_FORECAST_COLUMNS: Final = {
    "ADE_squared_m2": "ADE m²",
    "recall": "recall",
    "false_forecasts_per_frame": "false",
    "consistency_m": "drift m",
    "NLL": "NLL",
    "coverage_50": "in 50 %",
    "coverage_90": "in 90 %",
    "coverage_95": "in 95 %",
}


#: Columns of 3D tracks with scores, after the others.
_AVERAGES: Final = ("AMOTA", "sAMOTA")
#: Keys of results that are no single value.
_NESTED: Final = ("displacement", "class_means")


class Evaluate(Once["Scores"]):
    """Score tracks and predictions against ground truth."""

    class More(Printed):
        """Options that the function has no use for."""

        fail_under: Annotated[
            Sequence[str] | None, Option(SCORES, shown=False, help="Exit 4 if a score is lower, as in idf1=0.7.")
        ] = None
        curves: Annotated[
            PathLike | None, Option(FILES, help="Draw the error of predictions over recall as an SVG.")
        ] = None
        csv: Annotated[bool, Option(FILES, help="Print rows for a spreadsheet.")] = False
        all_gates: Annotated[
            bool, Option(SCORES, flag="all", help="Print the scores at all gates, and all columns of forecasts.")
        ] = False

    most_used = ("truth", "against", "topic", "all_gates", "similarity", "gate_m", "fail_under", "output", "force")

    def __init__(self, name: str, values: Mapping[str, Any]) -> None:
        super().__init__(name, values)
        self._limits = dict(_limit(text) for text in values["fail_under"] or ())

    def arguments(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the arguments of the function: patterns become files, text becomes gates."""
        truth = self.values["truth"]
        return super().arguments(names) | {
            "gate_m": _gates(self.values["gate_m"]),
            "tracks": expand(self.values["inputs"], folders=True),
            "truth": expand(truth) if truth else None,
        }

    def data(self, done: Scores) -> dict[str, Any]:
        """Return the scores as values of JSON."""
        labelled = [{"sequence": name, **how._asdict()} for name, how in done.labelled.items()]
        differences = {"against": done.against, "differences": [row._asdict() for row in done.differences]}
        return {"results": done.rows(), "labelled": labelled} | (differences if done.against else {})

    def print_result(self, done: Scores, talk: common.Talk) -> None:
        """Print the scores, or write them to a file, and draw curves."""
        if self.values["curves"] is not None:
            done.draw_curves(self.values["curves"], self.values["force"])
        super().print_result(done, talk)

    def show(self, done: Scores, talk: common.Talk) -> None:
        """Print a verdict and a table, or rows of CSV."""
        if self.values["csv"]:
            _print_csv(done)
        elif done.against:
            _print_differences(done)
        else:
            print_results(done, self.values["all_gates"], self.values["verbose"])

    def code(self, done: Scores) -> int:
        """Return the exit code, and print the scores that are below their limits."""
        missed = done.below(self._limits)
        for line in missed:
            say(line)
        return common.GATE_MISSED if missed else common.DONE


def _gates(text: str) -> tuple[float, ...]:
    try:
        gates = tuple(float(part) for part in text.split(","))
    except ValueError:
        gates = ()
    if not gates or not all(0 < gate < float("inf") for gate in gates):
        raise McaptrackError(f"--gate-m needs distances in metres like 0.5,1,2, not {text!r}")
    return gates


def _limit(text: str) -> tuple[str, float]:
    from mcaptrack.api.scoring import LIMITS

    names = {name.lower(): name for name in LIMITS}
    name, _, value = text.partition("=")
    try:
        limit = float(value)
        if not limit <= 1:
            raise ValueError(value)
        return names[name.strip().lower()], limit
    except (KeyError, ValueError):
        raise McaptrackError(
            f"--fail-under needs a score and a share, 1 at most, as in idf1=0.7, not {text!r}; "
            f"{offer(name, names, 'there are')}"
        ) from None


def print_results(scores: Scores, all_gates: bool, verbose: bool) -> None:
    """Print the verdict, the scores as a table, and those of predictions below it."""
    from mcaptrack.evaluation import COMBINED, gate_text, main_results, matched_by, verdict

    show(*verdict(scores.results), "")
    results = sorted(scores.results, key=lambda r: (r.sequence == COMBINED, r.sequence, r.similarity, r.gate))
    main = main_results(results)
    _print_scores(results if all_gates else main)
    others = dict.fromkeys(gate for result in results if (gate := gate_text(result)) != gate_text(main[0]))
    if others and not all_gates:
        show(f"matched {matched_by(main[0])}; --all has the scores of {', '.join(others)}, too")
    forecasts: dict[_Key, Displacement] = {}
    for result in results:
        if result.displacement is not None:
            forecasts.setdefault((result.sequence, result.tracks, result.of_class), result.displacement)
    if forecasts:
        show("")
        _print_forecasts(forecasts, _ALL_FORECAST_COLUMNS if all_gates or verbose else _FORECAST_COLUMNS)
    if verbose:
        _print_reliability(forecasts)


def _print_differences(scores: Scores) -> None:
    """Which tracker is better, by differences of IDF1 in points."""
    show(f"no ground truth: differences by {scores.against}, in points of IDF1", "")
    numbers = ("IDF1", "from", "to")
    rows: list[list[str | Text]] = []
    for row in scores.differences:
        points = ["-" if isnan(value) else f"{100 * value:+.1f}" for value in (row.idf1, row.low, row.high)]
        rows.append([row.after, row.verdict, f"than {row.before}", *points, row.why])
    show_left_out(print_table(["tracks", "", "", *numbers, "why undecided"], rows, numbers, ["from", "to"]))


def _print_scores(results: Sequence[EvaluationRow]) -> None:
    """The scores of tracks; the best rates of those with the same rows of ground truth are bold."""
    from mcaptrack.evaluation import gate_text

    keys = [(result.sequence, result.tracks, result.of_class) for result in results]
    names, first = _first_columns("tracks", keys)
    several_gates = len({(result.similarity, result.gate) for result in results}) > 1
    columns = (*_COLUMNS, *(_AVERAGES if any(result.averages for result in results) else ()))
    compared: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for result in results:
        compared.setdefault(_compared(result), []).append(result.to_json())
    rows: list[list[str | Text]] = []
    previous = None
    for key, result in zip(keys, results, strict=True):
        by = gate_text(result)
        if previous not in (None, (result.sequence, by)):
            rows.append([])
        previous = (result.sequence, by)
        gate, own = ([by] if several_gates else []), result.to_json()
        rivals = compared[_compared(result)]
        rows.append([*first(key), *gate, *(_cell(name, own.get(name, ""), rivals) for name in columns)])
        if (means := result.class_means) is not None:
            cells = [f"{100 * means[name]:.1f}" if name in means else "" for name in columns]
            rows.append([*first((*key[:2], "mean of classes")), *gate, *cells])
    names += ["by"] if several_gates else []
    left_out = print_table([*names, *columns], rows, columns, _present(_SPARE, [*names, *columns]))
    show_left_out(left_out)


def _cell(name: str, value: float | str, rivals: Sequence[Mapping[str, Any]]) -> str | Text:
    """A score as text, bold if it is the best of several that differ."""
    from rich.text import Text

    text = f"{100 * value:.1f}" if isinstance(value, float) else str(value)
    values = [rival[name] for rival in rivals] if name in _RATES else []
    is_best = bool(values) and min(values) < max(values) == value
    return Text(text, "bold") if is_best else text


def _compared(result: EvaluationRow) -> tuple[Any, ...]:
    """The key of results with comparable scores: they have the same rows of ground truth."""
    rows = result.score.counts["TP"] + result.score.counts["FN"]
    return result.sequence, result.of_class, result.similarity, result.gate, rows


def _print_forecasts(forecasts: Mapping[_Key, Displacement], more: Mapping[str, str]) -> None:
    """The errors of forecasts, beside those of constant velocity for the same tracks; the smaller ones are bold."""
    from rich.text import Text

    names, first = _first_columns("forecasts of", forecasts)
    numbers = [*_ERRORS.values(), *_OF_CONSTANT_VELOCITY.values(), *more.values()]
    rows: list[list[str | Text]] = []
    for key, forecast in forecasts.items():
        own, straight = forecast.summary(), forecast.constant_velocity()
        pairs = [(own[name], straight[name]) for name in _ERRORS]
        both = [
            Text(_length(mine), "bold" if mine is not None and other is not None and mine < other else "")
            for side in (pairs, [pair[::-1] for pair in pairs])
            for mine, other in side
        ]
        rows.append([*first(key), *both, *(_length(own[name]) for name in more)])
    show_left_out(print_table([*names, *numbers], rows, numbers, _present(_SPARE_OF_FORECASTS, [*names, *numbers])))


def _length(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _print_reliability(forecasts: Mapping[_Key, Displacement]) -> None:
    """The share of true positions in the ellipses of each probability; nothing if no forecast has ellipses."""
    held = {key: displacement.reliability() for key, displacement in forecasts.items()}
    levels = [f"{100 * part['level']:g} %" for part in next((parts for parts in held.values() if parts), [])]
    if not levels:
        return
    names, first = _first_columns("true positions in", forecasts)
    rows = [
        [*first(key), *([f"{part['held']:.2f}" for part in parts] or ["-"] * len(levels))]
        for key, parts in held.items()
    ]
    show("")
    show_left_out(print_table([*names, *levels], rows, levels, [*levels[:-3], *_present(("class",), names)]))


def _first_columns(name: str, keys: Collection[_Key]) -> tuple[list[str], Callable[[_Key], list[str]]]:
    """The names of the first columns of a table of ``keys``, and a function that returns their cells for a key."""
    has_sequences = len({sequence for sequence, _, _ in keys}) > 1
    has_classes = any(of_class is not None for _, _, of_class in keys)

    def first(key: _Key) -> list[str]:
        sequence, tracks, of_class = key
        of_class = "all" if of_class is None else of_class
        return [*([sequence] if has_sequences else []), tracks, *([of_class] if has_classes else [])]

    return [*(["sequence"] if has_sequences else []), name, *(["class"] if has_classes else [])], first


def _present(spare: Sequence[str], names: Collection[str]) -> list[str]:
    return [name for name in spare if name in names]


def _print_csv(scores: Scores) -> None:
    import csv

    rows = [{k: v for k, v in result.to_json().items() if k not in _NESTED} for result in scores.results]
    rows += [row._asdict() for row in scores.differences]
    rows = [{k: printable(v) if isinstance(v, str) else v for k, v in row.items()} for row in rows]
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(sys.stdout, fieldnames=names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
