"""``mcaptrack train``: what it prints."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from mcaptrack.cli import common
from mcaptrack.cli.common import expand
from mcaptrack.cli.declared import Once
from mcaptrack.cli.text import console, show
from mcaptrack.errors import command

if TYPE_CHECKING:
    from mcaptrack import TrainResult

_COLUMNS: Final = {
    "ADE_m": "ADE m",
    "FDE_m": "FDE m",
    "ADE_squared_m2": "ADE m²",
    "NLL": "NLL",
    "coverage_50": "in 50 %",
    "coverage_90": "in 90 %",
    "coverage_95": "in 95 %",
}
_KINDS: Final = {"clean": "as they are", "noisy": "with 0.2 m of noise"}


class Train(Once["TrainResult"]):
    """Train a predictor on tracks or on synthetic walks."""

    def arguments(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the arguments of the function: patterns and folders become files."""
        from mcaptrack.extensions.training.sources import SYNTHETIC

        sources, validate = self.values["sources"], self.values["validate"]
        synthetic = [SYNTHETIC] if Path(SYNTHETIC) in sources else []
        paths = expand([source for source in sources if source != Path(SYNTHETIC)])
        more = {"sources": [*synthetic, *paths], "validate": expand(validate) if validate else None}
        return super().arguments(names) | more

    def data(self, done: TrainResult) -> dict[str, Any]:
        """Return the scores and the file as values of JSON."""
        names = ("epochs", "kept_epoch", "windows", "validation_windows", "seconds", "scores")
        return {"weights": str(done.weights)} | {name: getattr(done, name) for name in names}

    def show(self, done: TrainResult, talk: common.Talk) -> None:
        """Print the scores as a table, and how to use the weights."""
        from rich.table import Table

        table = Table(box=None, pad_edge=False, header_style="bold")
        table.add_column("validation windows", no_wrap=True)
        table.add_column("predictor", no_wrap=True)
        for name in _COLUMNS.values():
            table.add_column(name, justify="right", no_wrap=True)
        for kind, scores in done.scores.items():
            for number, (predictor, values) in enumerate(scores.items()):
                numbers = [f"{values[name]:.3f}" for name in _COLUMNS]
                table.add_row(_KINDS[kind] if number == 0 else "", predictor, *numbers)
        console().print(table)
        minutes, seconds = divmod(round(done.seconds), 60)
        show("", f"{done.weights}: epoch {done.kept_epoch} of {done.epochs}, {minutes} min {seconds} s")
        use = command("predict", "LOG", "--predictor", done.predictor)
        show(f"Use it:  {use.strip('`')}")
