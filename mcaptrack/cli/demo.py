"""``mcaptrack demo``: what it prints."""

from __future__ import annotations

import sys
from pathlib import Path
from shlex import quote
from shutil import which
from typing import TYPE_CHECKING, Any, Final

from mcaptrack.cli import common
from mcaptrack.cli.declared import Once
from mcaptrack.cli.group import entries
from mcaptrack.cli.text import show

if TYPE_CHECKING:
    from mcaptrack import DemoResult

_OPEN_IN: Final = "in Foxglove, or in Lichtblick (https://lichtblick-suite.github.io/lichtblick)"


class Demo(Once["DemoResult"]):
    """Run everything on a synthetic scene."""

    def data(self, done: DemoResult) -> dict[str, Any]:
        """Return the scores as values of JSON."""
        return {"scene": self.values["scene"], "seed": self.values["seed"], "results": done.scores.rows()}

    def show(self, done: DemoResult, talk: common.Talk) -> None:
        """Print the scores, the files, and commands to try next."""
        sort, retracked = done.scores.rows()
        show(
            *_side_by_side(sort, retracked, "tracker" if done.truth.suffix == ".csv" else "SORT"),
            "",
            *_over_seeds(self.values["scene"], self.values["seed"]),
            "",
            f"video    {done.video}",
            f"log      {done.log}",
            f"layouts  {'  '.join(str(path) for path in done.layouts)}",
            f"tables   {done.tables}",
            "",
            f"Open the log {_OPEN_IN}: open local file, then import a layout.",
            "See more:",
            *(f"  {line}" for line in _next_commands(done.log)),
        )


def _next_commands(target: Path) -> list[str]:
    """Return commands to try next, as they can be typed in the working folder."""
    command, log = _program(), quote(str(target))
    more = {"view": "", "info": "", "evaluate": "", "report": "", "query": ' "from tracks limit 5"'}
    return [f"{command} {name} {log}{words}" for name, words in more.items() if name in entries()]


def _program() -> str:
    """Return how a shell finds the running program: by its name, otherwise by its path."""
    program = Path(sys.argv[0])
    on_path = which(program.name)
    if program.name.endswith(".py") or not program.is_file():  # python -m mcaptrack
        return f"{_from_here(Path(sys.executable))} -m mcaptrack"
    return program.name if on_path and Path(on_path).samefile(program) else _from_here(program)


def _from_here(path: Path) -> str:
    """Return a path relative to the working folder, quoted for a shell."""
    path = Path.cwd() / path
    return quote(str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path))


def _side_by_side(sort: dict[str, float], retracked: dict[str, float], tracker: str) -> list[str]:
    """Return the scores of SORT, or another tracker, and of re-tracking side by side."""
    meanings = {
        "IDF1": "identity kept (IDF1)",
        "MOTA": "accuracy (MOTA)",
        "IDSW": "identity switches",
        "FP": "false rows (swaying tree, ghosts)",
        "FN": "missed rows (hidden, merged)",
        "Frag": "fragments",
    }
    lines = [f"{'within 1 m, 2.5 Hz':<36}{tracker:>10}{'re-tracked':>14}"]
    for name, meaning in meanings.items():
        values = [
            f"{100 * part[name]:.1f} %" if name in ("IDF1", "MOTA") else str(part[name]) for part in (sort, retracked)
        ]
        lines.append(f"{meaning:<36}{values[0]:>10}{values[1]:>14}")
    return lines


def _over_seeds(scene: str, seed: int) -> list[str]:
    """Return the mean and range of IDF1 over all seeds, for each scene."""
    from mcaptrack.sources.demo import mean_and_range, read_scores

    scores = read_scores()
    lines = [f"This is scene {scene}, seed {seed}: one sample. IDF1 over {len(scores['seeds'])} seeds, mean and range:"]
    for name, values in scores["scenes"].items():
        sort, retracked = (mean_and_range(values[mode]["IDF1"], 100) for mode in ("SORT", "re-tracked"))
        lines.append(f"{name:<16}{sort:>24}{retracked:>24}")
    return lines
