"""``mcaptrack train``: train a predictor on tracks or on synthetic walks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from mcaptrack.cli import common
from mcaptrack.cli.text import console, show
from mcaptrack.errors import McaptrackError, command
from mcaptrack.files import refuse_url

if TYPE_CHECKING:
    from mcaptrack.training.loop import Trained
    from mcaptrack.training.recipe import Recipe
    from mcaptrack.training.windows import Windows

_COLUMNS: Final = {
    "ADE_m": "ADE m",
    "FDE_m": "FDE m",
    "ADE_squared_m2": "ADE m²",
    "NLL": "NLL",
    "coverage_50": "in 50 %",
    "coverage_90": "in 90 %",
    "coverage_95": "in 95 %",
}
_TRAINING: Final = "Training"
_WINDOWS: Final = "Training data"
_LICENCE: Final = "that of the data it was trained on"


@common.one_line
def train(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE",
            help="Label files (TrajNet, Stanford Drone, ETH, MOTChallenge), Parquet tables, logs, folders of these, or "
            "`synthetic`.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path,
        common.option(
            "--output",
            "-o",
            panel=common.FILES,
            help="Folder for the weights, the log of epochs and the state.",
            show_default=True,
        ),
    ] = Path("trained"),
    recipe: Annotated[
        Literal["red", "paper"],
        common.option(
            "--recipe",
            panel=_TRAINING,
            tuning=True,
            help="Network and training: mcaptrack's own (red), or the paper's.",
        ),
    ] = "red",
    validate: Annotated[
        list[Path] | None,
        common.option(
            "--validate",
            panel=common.FILES,
            help="Sources to validate on.",
            show_default="a tenth of the windows, whole scenes apart",
        ),
    ] = None,
    epochs: Annotated[
        int | None,
        common.option(
            "--epochs",
            panel=_TRAINING,
            least=1,
            most=1_000_000,
            tuning=True,
            help="Number of passes over the training windows.",
            show_default="20; paper: 50",
        ),
    ] = None,
    batch: Annotated[
        int | None,
        common.option(
            "--batch",
            panel=_TRAINING,
            least=1,
            most=1_000_000,
            tuning=True,
            help="Number of windows per step.",
            show_default="256; paper: 60",
        ),
    ] = None,
    rate: Annotated[
        float | None,
        common.option(
            "--rate",
            panel=_TRAINING,
            least=1e-9,
            most=1,
            tuning=True,
            help="Learning rate.",
            show_default="0.003; paper: 0.0001",
        ),
    ] = None,
    noise_m: Annotated[
        float | None,
        common.option(
            "--noise-m",
            panel=_WINDOWS,
            least=0,
            most=10,
            tuning=True,
            help="Largest noise added to past positions, in metres.",
            show_default="0.4; paper: 0",
        ),
    ] = None,
    gaps: Annotated[
        float | None,
        common.option(
            "--gaps",
            panel=_WINDOWS,
            least=0,
            most=0.9,
            tuning=True,
            help="Share of past positions that are removed.",
            show_default="0.3; paper: 0",
        ),
    ] = None,
    scale: Annotated[
        float | None,
        common.option(
            "--scale",
            panel=_WINDOWS,
            least=0,
            most=1,
            tuning=True,
            help="Largest scaling of positions, as a natural logarithm.",
            show_default="0.15; paper: 0",
        ),
    ] = None,
    consistency_weight: Annotated[
        float,
        common.option(
            "--consistency-weight",
            panel=_TRAINING,
            least=0,
            most=1e6,
            tuning=True,
            help="Weight of the difference between predictions of successive steps in the loss.",
        ),
    ] = 0.0,
    patience: Annotated[
        int,
        common.option(
            "--patience",
            panel=_TRAINING,
            least=0,
            most=1_000_000,
            tuning=True,
            help="Stop after this many epochs without improvement; 0 for never.",
        ),
    ] = 0,
    walks: Annotated[
        int,
        common.option(
            "--walks",
            panel=_WINDOWS,
            least=1000,
            most=100_000_000,
            tuning=True,
            help="Number of walks that `synthetic` makes.",
        ),
    ] = 60_000,
    seed: Annotated[
        int, common.option("--seed", panel=_TRAINING, least=0, most=2**31 - 1, tuning=True, help="Random seed.")
    ] = 1,
    device: Annotated[
        Literal["auto", "cpu", "cuda", "mps"],
        common.option("--device", panel=_TRAINING, tuning=True, help="Device to compute on."),
    ] = "auto",
    threads: Annotated[
        int,
        common.option(
            "--threads",
            panel=_TRAINING,
            least=1,
            most=1024,
            tuning=True,
            help="Threads of the processor to use; more than one rarely helps.",
        ),
    ] = 1,
    resume: Annotated[
        bool, common.option("--resume", panel=common.FILES, help="Continue the training in the folder.")
    ] = False,
    topic: Annotated[
        str | None,
        common.option(
            "--topic",
            panel=common.FILES,
            help="Read this channel of logs and tables.",
            show_default="truth, or the best tracks",
        ),
    ] = None,
    fps: common.LabelFps = None,
    ground_plane: common.GroundPlane = None,
    point: common.Point = "foot",
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Train a predictor on tracks of people, or on synthetic walks.

    Writes the weights (safetensors, with a model card in the header), a log of the epochs and a state to resume from
    into a folder, and compares the predictor with constant velocity on the same windows. Use the weights with
    `mcaptrack predict --predictor red:FOLDER/red.safetensors`. Needs torch: `pip install 'mcaptrack[train]'`.

    Example: mcaptrack train synthetic -o trained
    """
    from mcaptrack.training.recipe import RECIPES

    for source in sources:
        refuse_url(source)
    given = {"epochs": epochs, "batch": batch, "rate": rate, "patience": patience, "seed": seed}
    given |= {"consistency_weight": consistency_weight}
    corrupted = {"noise_m": noise_m, "gaps": gaps, "scale": scale}
    chosen = RECIPES[recipe].changed(given, corrupted)
    if output.exists() and not output.is_dir():
        raise McaptrackError(f"{output} is a file; training needs a folder")
    weights = output / f"{chosen.network}.safetensors"
    state = output / "state.safetensors"
    if resume and not state.exists():
        raise McaptrackError(f"there is no training to resume in {output}")
    if not resume and not force and (weights.exists() or state.exists()):
        raise McaptrackError(f"{output} holds a training; --resume goes on with it, --force replaces it")
    from mcaptrack.training.loop import find_device
    from mcaptrack.training.loop import train as fit

    where = find_device(device)  # before anything takes long
    with common.Talk(quiet, verbose).open() as talk:
        options = _options(fps, ground_plane, point, topic)
        training, validation, card = _windows(chosen, sources, validate or [], walks, options, talk)
        talk.say(f"training on {len(training)} windows, validating on {len(validation)}")
        output.mkdir(parents=True, exist_ok=True)
        trained = fit(chosen, training, validation, output, card, where, threads, resume, talk.progress, talk.say)
    if json:
        common.print_json(_as_json(trained))
        return
    _print(trained, chosen)


def _options(fps: str | None, ground_plane: Path | None, point: Literal["center", "foot"], topic: str | None) -> Any:
    from mcaptrack.api.ingesting import parse_fps
    from mcaptrack.training.sources import SourceOptions

    return SourceOptions(fps=parse_fps(fps), ground_plane=ground_plane, point=point, topic=topic)


def _windows(
    recipe: Recipe, sources: list[str], validate: list[Path], walks: int, options: Any, talk: common.Talk
) -> tuple[Windows, Windows, dict[str, str]]:
    """Windows to train and to validate on, and what the card says of them."""
    from mcaptrack import __version__
    from mcaptrack.training.sources import SYNTHETIC, read_scenes, split, synthetic, windows_of
    from mcaptrack.training.windows import Windows

    parts, words = [], []
    if SYNTHETIC in sources:
        talk.say(f"simulating {walks} walks ...")
        parts.append(synthetic(recipe, walks, recipe.seed))
        words.append(f"{walks} synthetic walks of mcaptrack {__version__}, seed {recipe.seed}")
    paths = common.expand([Path(source) for source in sources if source != SYNTHETIC])
    if paths:
        scenes = read_scenes(paths, options, recipe.step_s)
        first = 0 if not parts else int(parts[0].scene.max()) + 1
        found = windows_of(scenes, recipe)
        parts.append(Windows(found.past, found.known, found.future, found.scene + first))
        words.append(f"{len(scenes)} scenes: {', '.join(scene.name for scene in scenes)[:500]}")
    windows = Windows.join(parts)
    if validate:
        training = windows
        validation = windows_of(read_scenes(common.expand(validate), options, recipe.step_s), recipe)
    else:
        training, validation = split(windows, 0.1, recipe.seed)
    licence = "Apache-2.0" if not paths else _LICENCE
    return training, validation, {"data": "; ".join(words), "licence": licence, "made_by": f"mcaptrack {__version__}"}


def _as_json(trained: Trained) -> dict[str, Any]:
    return {
        "weights": str(trained.weights),
        "epochs": trained.epochs,
        "kept_epoch": trained.kept_epoch,
        "windows": trained.windows,
        "validation_windows": trained.validation_windows,
        "seconds": trained.seconds,
        "scores": trained.scores,
    }


def _print(trained: Trained, recipe: Recipe) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("validation windows", no_wrap=True)
    table.add_column("predictor", no_wrap=True)
    for name in _COLUMNS.values():
        table.add_column(name, justify="right", no_wrap=True)
    words = {"clean": "as they are", "noisy": "with 0.2 m of noise"}
    for kind, scores in trained.scores.items():
        for number, (predictor, values) in enumerate(scores.items()):
            numbers = [f"{values[name]:.3f}" for name in _COLUMNS]
            table.add_row(words[kind] if number == 0 else "", predictor, *numbers)
    console().print(table)
    minutes, seconds = divmod(round(trained.seconds), 60)
    show("", f"{trained.weights}: epoch {trained.kept_epoch} of {trained.epochs}, {minutes} min {seconds} s")
    use = command("predict", "LOG", "--predictor", f"{recipe.network}:{trained.weights}")
    show(f"Use it:  {use.strip('`')}")
