"""Train a predictor on tracks, or on synthetic walks."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Final, Literal

from mcaptrack import __version__
from mcaptrack.api import labels
from mcaptrack.api.common import Notes, as_path, paths_of
from mcaptrack.api.declared import Argument, Option, declared
from mcaptrack.api.options import FILES, Force, GroundPlane, PathLike, Reports, Topic, no_progress
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.training.recipe import RECIPES, Recipe
from mcaptrack.extensions.training.sources import SYNTHETIC, SourceOptions, read_scenes, split, synthetic, windows_of
from mcaptrack.extensions.training.windows import Windows
from mcaptrack.notices import Notice, collected


@dataclass(frozen=True)
class TrainResult:
    """A trained predictor.

    Attributes
    ----------
    weights : pathlib.Path
        The file of weights, with a model card in its header.
    predictor : str
        The name that ``predict`` and ``run`` take: "red:" or "lstm:" and the file.
    epochs, kept_epoch : int
        Number of epochs, and the one that the weights are of.
    windows, validation_windows : int
        Number of windows to train and to validate on.
    scores : dict of str to dict of str to dict of str to float
        Scores on the validation windows: as they are ("clean") and with 0.2 m of noise ("noisy"), by predictor.
    seconds : float
        How long the epochs took.
    notes : tuple of str
        What was done, such as why the training stopped early.
    warnings : tuple of mcaptrack.Notice
        What was assumed, left out or looks odd.

    """

    weights: Path
    predictor: str
    epochs: int
    kept_epoch: int
    windows: int
    validation_windows: int
    scores: Mapping[str, Mapping[str, Mapping[str, float]]]
    seconds: float
    notes: tuple[str, ...] = ()
    warnings: tuple[Notice, ...] = ()


Device = Literal["auto", "cpu", "cuda", "mps"]
RecipeName = Literal["red", "paper"]
#: Headings in the help.
_TRAINING: Final = "Training"
_WINDOWS: Final = "Training data"
#: The licence of weights that were trained on files.
_LICENCE: Final = "that of the data it was trained on"
_VALIDATION_SHARE: Final = 0.1


@declared(
    most_used=("recipe", "epochs", "device", "validate", "topic", "output", "force"),
    settable=(
        *("batch", "rate", "noise_m", "gaps", "scale", "consistency_weight", "patience", "threads", "seed"),
        *("classes", "fps"),
    ),
    python_only=("label_format", "ground_plane"),
    heading="Improve and repair",
    printed_by="mcaptrack.extensions.training.command:Train",
)
def train(
    sources: Annotated[
        PathLike | Sequence[PathLike],
        Argument(
            "sources",
            "SOURCE",
            "Label files (TrajNet, Stanford Drone, ETH, MOTChallenge), Parquet tables, logs, folders of these, or "
            "`synthetic`.",
        ),
    ],
    output: Annotated[PathLike, Option(FILES, short="o", shown=True)] = "trained",
    *,
    recipe: Annotated[RecipeName, Option(_TRAINING, tuning=True)] = "red",
    validate: Annotated[PathLike | Sequence[PathLike] | None, Option(FILES)] = None,
    epochs: Annotated[int | None, Option(_TRAINING, 1, 1_000_000, tuning=True)] = None,
    batch: Annotated[int | None, Option(_TRAINING, 1, 1_000_000, tuning=True)] = None,
    rate: Annotated[float | None, Option(_TRAINING, 1e-9, 1, tuning=True)] = None,
    noise_m: Annotated[float | None, Option(_WINDOWS, 0, 10, tuning=True)] = None,
    gaps: Annotated[float | None, Option(_WINDOWS, 0, 0.9, tuning=True)] = None,
    scale: Annotated[float | None, Option(_WINDOWS, 0, 1, tuning=True)] = None,
    consistency_weight: Annotated[float, Option(_TRAINING, 0, 1e6, tuning=True)] = 0.0,
    patience: Annotated[int, Option(_TRAINING, 0, 1_000_000, tuning=True)] = 0,
    walks: Annotated[int, Option(_WINDOWS, 1000, 100_000_000, tuning=True)] = 60_000,
    seed: Annotated[int, Option(_TRAINING, 0, 2**31 - 1, tuning=True)] = 1,
    device: Annotated[Device, Option(_TRAINING, tuning=True)] = "auto",
    threads: Annotated[int, Option(_TRAINING, 1, 1024, tuning=True)] = 1,
    resume: Annotated[bool, Option(FILES)] = False,
    topic: Topic = None,
    label_format: labels.Format = "auto",
    classes: labels.Classes = None,
    fps: labels.LabelFps = None,
    ground_plane: GroundPlane = None,
    force: Force = False,
    progress: Reports = no_progress,
) -> TrainResult:
    """Train a predictor on tracks of people, or on synthetic walks.

    Writes the weights (safetensors, with a model card in the header), a log of the epochs and a state to resume from
    into a folder, and compares the predictor with constant velocity on the same windows. Use the weights with
    `mcaptrack predict --predictor red:FOLDER/red.safetensors`. Needs torch: `pip install 'mcaptrack[train]'`.

    Parameters
    ----------
    sources : path or sequence of paths
        Label files, Parquet tables, logs, folders of these, or "synthetic".
    output : path, default "trained"
        Folder for the weights, the log of epochs and the state.
    recipe : {"red", "paper"}, default "red"
        Network and training: mcaptrack's own (red), or the paper's.

        The paper is Yu and Zhou, IROS 2021.
    validate : path or sequence of paths, optional
        Sources to validate on; by default a tenth of the windows, whole scenes apart.
    epochs : int, optional
        Number of passes over the training windows; by default 20; paper: 50.
    batch : int, optional
        Number of windows per step; by default 256; paper: 60.
    rate : float, optional
        Learning rate; by default 0.003; paper: 0.0001.
    noise_m : float, optional
        Largest noise added to past positions, in metres; by default 0.4; paper: 0.
    gaps : float, optional
        Share of past positions that are removed; by default 0.3; paper: 0.
    scale : float, optional
        Largest scaling of positions, as a natural logarithm; by default 0.15; paper: 0.
    consistency_weight : float, default 0
        Weight of the difference between predictions of successive steps in the loss.
    patience : int, default 0
        Stop after this many epochs without improvement; 0 for never.
    walks : int, default 60000
        Number of walks that `synthetic` makes.
    seed : int, default 1
        Random seed.
    device : {"auto", "cpu", "cuda", "mps"}, default "auto"
        Device to compute on.

        "auto" is the fastest one available.
    threads : int, default 1
        Threads of the processor to use; more than one rarely helps.
    resume : bool, default False
        Continue the training in the folder.
    topic : str, optional
        Read this channel of logs and tables; by default truth, or the best tracks.
    force : bool, default False
        Replace the training in the folder.

    Returns
    -------
    TrainResult
        The weights and their scores beside those of constant velocity and of a Kalman filter.

    Raises
    ------
    McaptrackError
        If torch or the device is missing, if a source cannot be read or has no windows, or if the folder holds a
        training.

    Examples
    --------
    On the command line:

        mcaptrack train synthetic -o trained

    >>> import mcaptrack
    >>> result = mcaptrack.train("synthetic", "network", walks=1000, epochs=1, device="cpu")
    >>> mcaptrack.predict("log.mcap", predictor=result.predictor, output="predictions.mcap").stages
    ('predict',)

    """
    hyperparameters = {"epochs": epochs, "batch": batch, "rate": rate, "patience": patience, "seed": seed}
    hyperparameters["consistency_weight"] = consistency_weight
    chosen = RECIPES[recipe].changed(hyperparameters, {"noise_m": noise_m, "gaps": gaps, "scale": scale})
    folder, notes = as_path(output), Notes()
    _refuse_folder(folder, chosen, resume=resume, force=force)
    from mcaptrack.extensions.training.loop import find_device
    from mcaptrack.extensions.training.loop import train as fit

    where = find_device(device)  # before anything takes long
    how = labels.label_options(label_format=label_format, classes=classes, fps=fps, ground_plane=ground_plane)
    options = SourceOptions(how, topic)
    with collected() as warnings:
        training, card = _windows(chosen, sources, walks, options, notes)
        if validate:
            validation = windows_of(read_scenes(paths_of(validate), options, chosen.step_s), chosen)
        else:
            training, validation = split(training, _VALIDATION_SHARE, chosen.seed)
        notes.say(f"training on {len(training)} windows, validating on {len(validation)}")
        folder.mkdir(parents=True, exist_ok=True)
        trained = fit(chosen, training, validation, folder, card, where, threads, resume, progress, notes.say)
    return replace(trained, notes=tuple(notes), warnings=tuple(dict.fromkeys(warnings)))


def _refuse_folder(folder: Path, recipe: Recipe, *, resume: bool, force: bool) -> None:
    """Raise McaptrackError if the folder can't take the training, or has none to resume."""
    if folder.exists() and not folder.is_dir():
        raise McaptrackError(f"{folder} is a file; training needs a folder")
    state = folder / "state.safetensors"
    if resume and not state.exists():
        raise McaptrackError(f"there is no training to resume in {folder}")
    if not resume and not force and (state.exists() or (folder / f"{recipe.network}.safetensors").exists()):
        raise McaptrackError(f"{folder} holds a training; `resume=True` goes on with it, `force=True` replaces it")


def _windows(
    recipe: Recipe, sources: PathLike | Sequence[PathLike], walks: int, options: SourceOptions, notes: Notes
) -> tuple[Windows, dict[str, str]]:
    """Return the windows of all sources, and what the model card says of them."""
    given_sources = [sources] if isinstance(sources, str | os.PathLike) else list(sources)
    paths = paths_of([source for source in given_sources if source != SYNTHETIC])
    parts, descriptions = [], []
    if len(paths) < len(given_sources):
        notes.say(f"simulating {walks} walks ...")
        parts.append(synthetic(recipe, walks, recipe.seed))
        descriptions.append(f"{walks} synthetic walks of mcaptrack {__version__}, seed {recipe.seed}")
    if paths:
        scenes = read_scenes(paths, options, recipe.step_s)
        first = 0 if not parts else int(parts[0].scene.max()) + 1
        windows = windows_of(scenes, recipe)
        parts.append(Windows(windows.past, windows.known, windows.future, windows.scene + first))
        descriptions.append(f"{len(scenes)} scenes: {', '.join(scene.name for scene in scenes)[:500]}")
    licence = _LICENCE if paths else "Apache-2.0"
    card = {"data": "; ".join(descriptions), "licence": licence, "made_by": f"mcaptrack {__version__}"}
    return Windows.join(parts), card
