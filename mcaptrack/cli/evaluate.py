"""``mcaptrack evaluate``: print scores as a table, JSON or CSV."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final

from mcaptrack.api.declared import Option
from mcaptrack.api.options import FILES, SCORES, PathLike
from mcaptrack.cli import common
from mcaptrack.cli.common import expand
from mcaptrack.cli.declared import Once, Printed
from mcaptrack.cli.text import console, printable, say
from mcaptrack.errors import McaptrackError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from mcaptrack import Scores
    from mcaptrack.evaluation.metrics.displacement import Displacement

#: Name of a sequence, topic of tracks and class, None for all classes.
_Key = tuple[str, str, str | None]

_COLUMNS: Final = ("MOTA", "IDF1", "HOTA", "IDSW", "FP", "FN", "Frag")
_FORECAST_COLUMNS: Final = {
    "ADE_m": "ADE m",
    "FDE_m": "FDE m",
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
#: Similarities that are overlaps, as the table names them.
_OVERLAPS: Final = {"iou": "IoU", "bev-iou": "BEV IoU", "3d-iou": "3D IoU"}
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

    most_used = ("truth", "topic", "similarity", "gate_m", "rules", "fail_under", "csv", "output", "force")

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
        return {"results": done.rows(), "labelled": labelled}

    def print_result(self, done: Scores, talk: common.Talk) -> None:
        """Print the scores, or write them to a file, and draw curves."""
        if self.values["curves"] is not None:
            done.draw_curves(self.values["curves"], self.values["force"])
        with common.printed_to(self.values["output"], self.values["force"]):
            super().print_result(done, talk)

    def show(self, done: Scores, talk: common.Talk) -> None:
        """Print a table, or rows of CSV."""
        (_print_csv if self.values["csv"] else print_results)(done)

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
        return names[name.strip().lower()], float(value)
    except (KeyError, ValueError):
        raise McaptrackError(
            f"--fail-under needs one of {', '.join(names)} and a number, as in idf1=0.7, not {text!r}"
        ) from None


def print_results(scores: Scores) -> None:
    """Print the scores as a table, and those of predictions below it."""
    from rich.table import Table

    out = console()
    table = Table(box=None, pad_edge=False, header_style="bold")
    several = len({result.sequence for result in scores.results}) > 1
    classes = any(result.of_class is not None for result in scores.results)
    for name in (*(("sequence",) if several else ()), "tracks", *(("class",) if classes else ()), "by"):
        table.add_column(name, no_wrap=True)
    columns = (*_COLUMNS, *(_AVERAGES if any(result.averages for result in scores.results) else ()))
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    previous = None
    for result in sorted(scores.results, key=lambda r: (r.sequence == "COMBINED", r.sequence, r.similarity, r.gate)):
        row = result.to_json()
        by = (
            f"{_OVERLAPS[result.similarity]} {result.gate:g}"
            if result.similarity in _OVERLAPS
            else f"{result.gate:g} m"
        )
        if previous not in (None, (result.sequence, by)):
            table.add_row()
        previous = (result.sequence, by)
        cells = [row.get(name, "") for name in columns]
        numbers = [f"{100 * cell:.1f}" if isinstance(cell, float) else str(cell) for cell in cells]
        first = [result.sequence] if several else []
        own = [_class_cell(result.of_class)] if classes else []
        table.add_row(*first, result.tracks, *own, by, *numbers)
        if result.class_means is not None:
            means = [f"{100 * result.class_means[name]:.1f}" if name in result.class_means else "" for name in columns]
            table.add_row(*first, result.tracks, "mean of classes", by, *means)
    out.print(table)
    forecasts: dict[_Key, Displacement] = {}
    for result in scores.results:
        if result.displacement is not None:
            key = (result.sequence, result.tracks, result.of_class)
            forecasts.setdefault(key, result.displacement)
    if forecasts:
        _print_forecasts(out, forecasts, several)
        _print_reliability(out, forecasts, several)


def _print_forecasts(out: Console, forecasts: Mapping[_Key, Displacement], several: bool) -> None:
    """The errors of forecasts."""
    table, first = _table_of_forecasts("forecasts of", forecasts, several)
    for name in _FORECAST_COLUMNS.values():
        table.add_column(name, justify="right", no_wrap=True)
    for key, forecast in forecasts.items():
        values = forecast.summary()
        numbers = ["-" if values[name] is None else f"{values[name]:.3f}" for name in _FORECAST_COLUMNS]
        table.add_row(*first(key), *numbers)
    out.print()
    out.print(table)


def _print_reliability(out: Console, forecasts: Mapping[_Key, Displacement], several: bool) -> None:
    """The share of true positions in the ellipses of each probability; nothing if no forecast has ellipses."""
    held = {key: displacement.reliability() for key, displacement in forecasts.items()}
    levels = [f"in {100 * part['level']:g} %" for part in next((parts for parts in held.values() if parts), [])]
    if not levels:
        return
    table, first = _table_of_forecasts("reliability of", forecasts, several)
    for level in levels:
        table.add_column(level, justify="right", no_wrap=True)
    for key, parts in held.items():
        table.add_row(*first(key), *([f"{part['held']:.3f}" for part in parts] or ["-"] * len(levels)))
    out.print()
    out.print(table)


def _table_of_forecasts(
    name: str, forecasts: Collection[_Key], several: bool
) -> tuple[Table, Callable[[_Key], list[str]]]:
    """An empty table of forecasts with its first columns, and the cells of these for each key."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    has_classes = any(of_class is not None for _, _, of_class in forecasts)
    for column in (*(("sequence",) if several else ()), name, *(("class",) if has_classes else ())):
        table.add_column(column, no_wrap=True)

    def first(key: _Key) -> list[str]:
        sequence, tracks, of_class = key
        return [*([sequence] if several else []), tracks, *([_class_cell(of_class)] if has_classes else [])]

    return table, first


def _class_cell(name: str | None) -> str:
    return "all" if name is None else printable(name)


def _print_csv(scores: Scores) -> None:
    import csv

    rows = [{k: v for k, v in result.to_json().items() if k not in _NESTED} for result in scores.results]
    rows = [{k: printable(v) if isinstance(v, str) else v for k, v in row.items()} for row in rows]
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(sys.stdout, fieldnames=names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
