"""``mcaptrack demo``: run everything on a synthetic scene."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from shlex import quote
from shutil import which
from typing import Annotated, Final, Literal

from mcaptrack.cli import common
from mcaptrack.cli.text import show

_LICHTBLICK: Final = "lichtblick-suite.github.io/lichtblick"


@common.one_line
def demo(
    output: Annotated[
        Path, common.option("--output", "-o", panel=common.FILES, help="Folder for all files.", show_default=True)
    ] = Path("mcaptrack-demo"),
    scene: Annotated[
        Literal["square", "walkers", "crowd", "side-by-side", "standing", "three-cameras"],
        common.option(
            "--scene",
            help="Scene to draw: people who cross, meet and part on a square; 10 walkers or a crowd of 20 on random "
            "routes; three pairs side by side; people who stand still for a while; 8 walkers seen by three cameras.",
        ),
    ] = "square",
    seed: Annotated[
        int,
        common.option("--seed", least=0, most=2**31 - 1, help="Random seed of the noise, the shaking and the routes."),
    ] = 2,
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Draw a scene with known ground truth, run everything on it, and compare SORT with re-tracking.

    The scene has what makes tracking fail: people who cross, meet and part, occlusion behind a kiosk, a tree that
    sways, a camera that shakes a little. Writes a video, a log, tables and layouts. Scores of one seed are a random
    sample, so the mean and the range over ten seeds of each scene are printed, too.

    Example: mcaptrack demo --scene crowd --seed 7 -o crowd
    """
    import mcaptrack

    with common.Talk(quiet, verbose).open() as talk:
        result = mcaptrack.demo(output, scene=scene, seed=seed, force=force, progress=talk.progress)
    sort, retracked = result.scores.rows()
    if json:
        common.print_json({"scene": scene, "seed": seed, "results": [sort, retracked]})
        return
    show(
        *_side_by_side(sort, retracked, "tracker" if result.truth.suffix == ".csv" else "SORT"),
        "",
        *_over_seeds(scene, seed),
        "",
        f"video    {result.video}",
        f"log      {result.log}",
        f"layouts  {'  '.join(str(path) for path in result.layouts)}",
        f"tables   {result.tables}",
        "",
        f"Open the log in Foxglove, or in Lichtblick (https://{_LICHTBLICK}): open local file, then import a layout.",
        "See more:",
        *(f"  {line}" for line in _next_commands(result.log)),
    )


def _next_commands(target: Path) -> list[str]:
    """Return commands to try next, as they can be typed in the working folder."""
    command, log = _program(), quote(str(target))
    lines = [f"{command} {name} {log}" for name in ("info", "evaluate", "report")]
    if find_spec("duckdb") is None:
        lines.append(f"{_from_here(Path(sys.executable))} -m pip install duckdb")
    return [*lines, f'{command} query {log} "from tracks limit 5"']


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
