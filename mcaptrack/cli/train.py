"""``mcaptrack train``: train a predictor on tracks or on synthetic walks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from mcaptrack.cli import common, labels
from mcaptrack.cli.common import expand
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
_TRAINING: Final = "Training"
_WINDOWS: Final = "Training data"


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
    fps: labels.LabelFps = None,
    ground_plane: labels.GroundPlane = None,
    point: labels.Point = "foot",
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
    import mcaptrack
    from mcaptrack.files import refuse_url
    from mcaptrack.training.sources import SYNTHETIC

    for source in sources:
        refuse_url(source)
    paths = expand([Path(source) for source in sources if source != SYNTHETIC])
    with common.Talk(quiet, verbose).open() as talk:
        trained = mcaptrack.train(
            [*([SYNTHETIC] if SYNTHETIC in sources else []), *paths],
            output,
            recipe=recipe,
            validate=expand(validate) if validate else None,
            epochs=epochs,
            batch=batch,
            rate=rate,
            noise_m=noise_m,
            gaps=gaps,
            scale=scale,
            consistency_weight=consistency_weight,
            patience=patience,
            walks=walks,
            seed=seed,
            device=device,
            threads=threads,
            resume=resume,
            topic=topic,
            fps=fps,
            ground_plane=ground_plane,
            point=point,
            force=force,
            progress=talk.progress,
        )
    if json:
        common.print_json(_as_json(trained))
    else:
        _print(trained)


def _as_json(trained: TrainResult) -> dict[str, Any]:
    return {
        "weights": str(trained.weights),
        "epochs": trained.epochs,
        "kept_epoch": trained.kept_epoch,
        "windows": trained.windows,
        "validation_windows": trained.validation_windows,
        "seconds": trained.seconds,
        "scores": trained.scores,
    }


def _print(trained: TrainResult) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("validation windows", no_wrap=True)
    table.add_column("predictor", no_wrap=True)
    for name in _COLUMNS.values():
        table.add_column(name, justify="right", no_wrap=True)
    meaning = {"clean": "as they are", "noisy": "with 0.2 m of noise"}
    for kind, scores in trained.scores.items():
        for number, (predictor, values) in enumerate(scores.items()):
            numbers = [f"{values[name]:.3f}" for name in _COLUMNS]
            table.add_row(meaning[kind] if number == 0 else "", predictor, *numbers)
    console().print(table)
    minutes, seconds = divmod(round(trained.seconds), 60)
    show("", f"{trained.weights}: epoch {trained.kept_epoch} of {trained.epochs}, {minutes} min {seconds} s")
    use = command("predict", "LOG", "--predictor", trained.predictor)
    show(f"Use it:  {use.strip('`')}")
