"""The training loop: epochs over windows, validation, the best weights, a state to resume from, final scores."""

from __future__ import annotations

import csv
import io
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError, needing
from mcaptrack.evaluation.metrics.displacement import forecast_scores
from mcaptrack.extensions.training.api import TrainResult
from mcaptrack.extensions.training.recipe import Recipe
from mcaptrack.extensions.training.windows import Windows, ar1
from mcaptrack.files import publish_bytes
from mcaptrack.geometry.mixtures import mahalanobis_squared
from mcaptrack.notices import Progress, Say
from mcaptrack.predictors import make, red
from mcaptrack.predictors.forecast import Predictor
from mcaptrack.predictors.lstm import Lstm
from mcaptrack.predictors.weights import Weights, load, save

_LOG: Final = "epochs.csv"
_STATE: Final = "state.safetensors"
_COLUMNS: Final = ("epoch", "loss", "validation_ade_m", "rate", "seconds")
#: Noise of the second set of validation windows; the first has none.
_NOISE_M: Final = 0.2


@dataclass
class _State:
    """The progress of a training."""

    epoch: int = 0
    best_epoch: int = 0
    best_ade_m: float = float("inf")
    seconds: float = 0.0


def train(
    recipe: Recipe,
    training: Windows,
    validation: Windows,
    folder: Path,
    source: dict[str, str],
    device: str = "auto",
    threads: int | None = None,
    resume: bool = False,
    progress: Progress = lambda *_: None,
    say: Say = lambda _: None,
) -> TrainResult:
    """Train a network; write weights, a log of the epochs and a state to resume from into ``folder``.

    Parameters
    ----------
    recipe : Recipe
        Network and hyperparameters.
    training, validation : Windows
        Windows to train and to validate on.
    folder : Path
        The folder to write to.
    source : dict of str to str
        The source of the windows, for the model card.
    device : str
        ``auto``, ``cpu``, ``cuda`` or ``mps``.
    threads : int or None
        Number of threads of torch; its own default if None.
    resume : bool
        Continue from the state in ``folder``.
    progress : callable
        Called with "train", the number of the epoch and the number of epochs.
    say : callable
        Called with messages.

    Returns
    -------
    TrainResult
        Without notes and warnings. The same recipe, windows and device give the same weights, also if the training was
        interrupted and resumed.

    Raises
    ------
    McaptrackError
        If torch or the device is missing, if there are no windows, if the loss diverges, or if the state in the folder
        is of another training.
    """
    torch, where = _torch(), find_device(device)
    if threads is not None:
        torch.set_num_threads(threads)
    for windows, what in ((training, "train on"), (validation, "validate on")):
        if len(windows) == 0:
            raise McaptrackError(f"there are no windows of {recipe.past + recipe.steps} positions to {what}")
    run = _Run(torch, recipe, training, where, folder, source)
    if resume:
        run.resume()
    rows = run.rows
    while run.state.epoch < recipe.epochs:
        began = time.monotonic()
        loss = run.epoch()
        ade_m = run.validate(validation)
        took = time.monotonic() - began
        run.state.seconds += took
        rows.append(dict(zip(_COLUMNS, (run.state.epoch, loss, ade_m, run.rate, took), strict=True)))
        run.save()
        progress("train", run.state.epoch, recipe.epochs)
        if recipe.patience and run.state.epoch - run.state.best_epoch >= recipe.patience:
            say(f"no improvement for {recipe.patience} epochs: stopping after {run.state.epoch}")
            break
    kept = run.state.best_epoch if recipe.kept == "best" else run.state.epoch
    card = {"trained_epochs": str(run.state.epoch), "kept_epoch": str(kept)}
    run.publish(validation, card)
    predictor = f"{recipe.network}:{run.weights}"
    scores = compare(make(predictor, recipe.steps, recipe.step_s), validation, recipe)
    for kind, part in scores.items():
        card[f"scores_{kind}"] = " ".join(f"{name}={value:.3f}" for name, value in part[recipe.network].items())
    run.publish(validation, card)
    return TrainResult(
        weights=run.weights,
        predictor=predictor,
        epochs=run.state.epoch,
        kept_epoch=kept,
        windows=len(training),
        validation_windows=len(validation),
        scores=scores,
        seconds=round(run.state.seconds, 1),
    )


def compare(other: Predictor, windows: Windows, recipe: Recipe) -> dict[str, dict[str, dict[str, float]]]:
    """Scores of a predictor, constant velocity and the Kalman filter on the same windows, with and without noise."""
    predictors = [other, *(make(name, recipe.steps, recipe.step_s) for name in ("cv", "kalman"))]
    return {
        name: {other.name: forecast_scores(*other.predict(part.past, part.known), part.future) for other in predictors}
        for name, part in (("clean", windows), ("noisy", _noisy(windows)))
    }


def _noisy(windows: Windows) -> Windows:
    """The same windows with noise in their past positions."""
    noise = _NOISE_M * ar1(np.random.default_rng(0), *windows.known.shape)
    return Windows(windows.past + noise, windows.known, windows.future, windows.scene)


def _torch() -> Any:
    with needing("training", "torch", "train"):
        import torch
    return torch


def find_device(name: str) -> str:
    """The device of that name, or for "auto" the fastest one available.

    Raises McaptrackError if it or torch is missing.
    """
    torch, available = _torch(), ["cpu"]
    if torch.cuda.is_available():
        available.insert(0, "cuda")
    if torch.backends.mps.is_available():
        available.insert(0, "mps")
    if name == "auto":
        return available[0]
    if name not in available:
        raise McaptrackError(f"there is no device {name}; there is {', '.join(available)}")
    return name


class _Run:
    """One training: network, optimiser, and their files."""

    def __init__(
        self, torch: Any, recipe: Recipe, training: Windows, device: str, folder: Path, source: dict[str, str]
    ) -> None:
        from mcaptrack.extensions.training.network import LstmNetwork, RedNetwork

        torch.manual_seed(recipe.seed)
        is_red = recipe.network == "red"
        self.network: Any = RedNetwork(recipe.steps, recipe.step_s) if is_red else LstmNetwork(recipe.steps)
        self.network.to(device)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=recipe.rate)
        self.state = _State()
        self.rows: list[dict[str, Any]] = []
        self.weights = folder / f"{recipe.network}.safetensors"
        self.card = {
            "network": recipe.network,
            "past": str(recipe.past),
            "steps": str(recipe.steps),
            "step_s": str(recipe.step_s),
            "recipe": json.dumps(recipe.changes(), sort_keys=True),
            **source,
        }
        self.rate = recipe.rate
        self._torch, self._recipe, self._device, self._folder = torch, recipe, device, folder
        self._training = training
        self._best: dict[str, Any] = {}

    def epoch(self) -> float:
        """One pass over newly augmented windows; returns the mean loss per window."""
        recipe = self._recipe
        rng = np.random.default_rng([recipe.seed, self.state.epoch])
        inputs = self._prepare(recipe.corruption(self._training, rng))
        later = None
        if recipe.consistency_weight:
            inputs, later = self._consecutive(rng)
        count = len(inputs["future"])
        batches = max(1, round(count / recipe.batch))
        order = self._torch.tensor(rng.permutation(count), device=self._device)
        total = 0.0
        for number, at in enumerate(self._torch.tensor_split(order, batches)):
            self.rate = recipe.rate_at(self.state.epoch * batches + number, batches)
            for group in self.optimiser.param_groups:
                group["lr"] = self.rate
            batch = {name: part[at] for name, part in inputs.items()}
            if recipe.loss == "displacements":
                loss = self.network.loss(batch, 2 * np.pi * rng.normal())
                total += loss.item()
            else:
                loss, mean = self.network.loss(batch, recipe.distance_weight)
                if later is not None:
                    more, then = self.network.loss({k: part[at] for k, part in later.items()}, recipe.distance_weight)
                    apart = self._torch.sqrt(((mean[:, 1:] - then[:, :-1]) ** 2).sum(-1) + 1e-6).mean()
                    loss = (loss + more) / 2 + recipe.consistency_weight * apart
                total += loss.item() * len(at)
            if not np.isfinite(total):
                raise McaptrackError(f"the loss is {total} in epoch {self.state.epoch + 1}; try a lower `rate=`")
            self.optimiser.zero_grad()
            loss.backward()
            if recipe.loss == "likelihood":
                self._torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
            self.optimiser.step()
        self.state.epoch += 1
        return total / count

    def _prepare(self, windows: Windows) -> dict[str, Any]:
        return {name: part.to(self._device) for name, part in self.network.prepare(windows).items()}

    def _consecutive(self, rng: np.random.Generator) -> tuple[dict[str, Any], dict[str, Any]]:
        """The same windows twice, the second time a step later, with the same noise at the same positions."""
        windows, recipe = self._training, self._recipe
        path = np.concatenate([windows.past, windows.future[:, :1]], axis=1)
        is_known = np.concatenate([windows.known, np.ones((len(windows), 1), bool)], axis=1)
        later = recipe.corruption(Windows(path, is_known, windows.future, windows.scene), rng)
        # The position a step later is the first of the future, which is not corrupted.
        length = windows.past.shape[1]
        now = Windows(later.past[:, :length], later.known[:, :length].copy(), later.future, windows.scene)
        now.known[:, -1] = True
        # The last step, a step later, is unknown: extrapolate it.
        end = 2 * later.future[:, -1:] - later.future[:, -2:-1]
        ahead = np.concatenate([later.future[:, 1:], end], axis=1)
        then = Windows(later.past[:, 1:], later.known[:, 1:], ahead, windows.scene)
        return self._prepare(now), self._prepare(then)

    def validate(self, validation: Windows) -> float:
        """Keep the weights if they are the best so far, or if the last are kept; returns their error in m."""
        tensors = {name: np.array(part) for name, part in self.network.tensors().items()}
        predictor = self._predictor(tensors)
        parts = (validation, _noisy(validation))
        off = [predictor.predict(part.past, part.known).mean - part.future for part in parts]
        ade_m = float(np.mean([np.hypot(offsets[..., 0], offsets[..., 1]).mean() for offsets in off]))
        if ade_m < self.state.best_ade_m:
            self.state.best_epoch, self.state.best_ade_m = self.state.epoch, ade_m
        if self._recipe.kept == "last" or self.state.best_epoch == self.state.epoch:
            self._best = tensors
        return ade_m

    def publish(self, validation: Windows, card: dict[str, str]) -> None:
        """Calibrate the kept weights and write them with their card.

        The covariance of every step is scaled so that its 95 % ellipse covers 95 % of the validation windows, those
        with and without noise together.
        """
        both = Windows.join([validation, _noisy(validation)])
        forecast = self._predictor(self._best).predict(both.past, both.known)
        away = mahalanobis_squared(forecast.mean - both.future, forecast.cov)
        ratio = np.quantile(away, 0.95, axis=0) / (-2 * np.log(0.05))
        calibrated = dict(self._best)
        if self._recipe.network == "lstm":
            calibrated["spread"] = calibrated["spread"] * ratio
        else:
            bias = calibrated["head.bias"].copy()
            bias[red.WIDTH :: red.OUTPUTS] += np.log(ratio) / 2
            calibrated["head.bias"] = bias
        save(self.weights, calibrated, self.card | card)

    def _predictor(self, tensors: dict[str, Any]) -> Predictor:
        """The predictor with these weights, without a file."""
        weights = Weights(self.weights, {k: np.asarray(v, np.float64) for k, v in tensors.items()}, self.card, "")
        return red.Red.of(weights) if self._recipe.network == "red" else Lstm.of(weights)

    def save(self) -> None:
        """Write the state that ``resume`` reads, and the log of the epochs."""
        tensors = {f"network.{name}": part for name, part in self.network.tensors().items()}
        tensors |= {f"best.{name}": part for name, part in self._best.items()}
        for number, parameter in enumerate(self.network.parameters()):
            for name, value in self.optimiser.state[parameter].items():
                tensors[f"optimiser.{number}.{name}"] = np.atleast_1d(value.detach().cpu().numpy())
        card = {"training": self._fingerprint(), "state": json.dumps(asdict(self.state)), "rows": json.dumps(self.rows)}
        save(self._folder / _STATE, tensors, card)
        text = io.StringIO()
        writer = csv.DictWriter(text, fieldnames=_COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        publish_bytes(self._folder / _LOG, text.getvalue().encode())

    def resume(self) -> None:
        """Continue from the state in the folder. Raises McaptrackError if it is of another training."""
        stored = load(self._folder / _STATE)
        if stored.card.get("training") != self._fingerprint():
            raise McaptrackError(
                f"{stored.path} is of a training with another recipe or other data; leave `resume=True` out"
            )
        torch = self._torch
        self.state, self.rows = _State(**json.loads(stored.card["state"])), json.loads(stored.card["rows"])
        parts: dict[str, dict[str, Any]] = {"network": {}, "best": {}, "optimiser": {}}
        for name, value in stored.tensors.items():
            group, _, rest = name.partition(".")
            parts[group][rest] = value.astype(np.float32)
        had = self.network.state_dict()
        self.network.load_state_dict({name: torch.tensor(parts["network"][name]) for name in had})
        self._best = parts["best"]
        for number, parameter in enumerate(self.network.parameters()):
            self.optimiser.state[parameter] = {
                name: torch.tensor(parts["optimiser"][f"{number}.{name}"], device=self._device).reshape(
                    () if name == "step" else parameter.shape
                )
                for name in ("step", "exp_avg", "exp_avg_sq")
            }

    def _fingerprint(self) -> str:
        """The key of a training, equal when it is resumed: recipe (but for its length), windows, device."""
        import hashlib

        total = hashlib.sha256(self._training.past.tobytes() + self._training.future.tobytes()).hexdigest()
        recipe = asdict(self._recipe)
        return json.dumps(
            [{k: v for k, v in recipe.items() if k not in ("patience", "epochs")}, total, self._device], sort_keys=True
        )
