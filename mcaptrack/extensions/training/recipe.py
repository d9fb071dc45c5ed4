"""Hyperparameters of training, and named sets of them (recipes)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from types import MappingProxyType
from typing import Final, Literal, Self

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.training.windows import Corruption

Network = Literal["red", "lstm"]


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Hyperparameters of a training.

    Attributes
    ----------
    network : {"red", "lstm"}
        The network.
    past, steps : int
        Number of past positions and of predicted steps.
    step_s : float
        Length of a step in seconds.
    least : int
        Number of past positions that a window needs.
    stride : int
        Every how many steps a window is cut.
    epochs, batch : int
        Passes over the windows, and windows per optimiser step.
    rate : float
        Learning rate, for the one-cycle schedule its maximum.
    schedule : {"one-cycle", "step"}
        "one-cycle" rises for a tenth of the time and falls to 0; "step" divides the rate by five at ``drop_at``.
    drop_at : int
        Epoch of that step.
    loss : {"likelihood", "displacements"}
        "likelihood" is the Gaussian negative log-likelihood plus ``distance_weight`` times the mean distance;
        "displacements" is the sum of squared errors of displacements, of every batch and of a randomly rotated copy
        (the paper's).
    distance_weight : float
        See ``loss``.
    consistency_weight : float
        Weight of the distance between forecasts of the same time from consecutive steps.
    corruption : Corruption
        Augmentation of the windows.
    patience : int
        Stop after so many epochs without improvement; 0 for never.
    kept : {"best", "last"}
        The weights to keep: those of the best or of the last epoch.
    seed : int
        Random seed.
    """

    network: Network = "red"
    past: int = 8
    least: int = 2
    steps: int = 12
    step_s: float = 0.4
    stride: int = 1
    epochs: int = 20
    batch: int = 256
    rate: float = 3e-3
    schedule: Literal["one-cycle", "step"] = "one-cycle"
    drop_at: int = 40
    loss: Literal["likelihood", "displacements"] = "likelihood"
    distance_weight: float = 10.0
    consistency_weight: float = 0.0
    corruption: Corruption = field(default_factory=lambda: Corruption(noise_m=0.4, gaps=0.3, least=1, scale=0.15))
    patience: int = 0
    kept: Literal["best", "last"] = "best"
    seed: int = 1

    def __post_init__(self) -> None:
        if self.consistency_weight and self.loss == "displacements":
            raise McaptrackError("a consistency weight needs the recipe red; paper compares displacements only")

    def changed(self, values: Mapping[str, object], corrupted: Mapping[str, object]) -> Self:
        """The recipe with other hyperparameters and augmentation; None keeps a value."""
        corruption = replace(self.corruption, **{k: v for k, v in corrupted.items() if v is not None})  # type: ignore[arg-type]
        return replace(self, corruption=corruption, **{k: v for k, v in values.items() if v is not None})  # type: ignore[arg-type]

    def rate_at(self, step: int, per_epoch: int) -> float:
        """The learning rate of the batch number ``step``, with ``per_epoch`` batches in an epoch."""
        if self.schedule == "step":
            return self.rate / (5 if step // per_epoch >= self.drop_at else 1)
        from math import cos, pi

        done = step / max(self.epochs * per_epoch, 1)
        share = done / 0.1 if done < 0.1 else (1 + cos(pi * (done - 0.1) / 0.9)) / 2
        return self.rate * max(share, 1e-3)

    def changes(self) -> dict[str, str]:
        """The values that differ from the recipe "red", as text for the model card."""
        had = {f.name: getattr(RECIPES["red"], f.name) for f in fields(self)}
        out = {k: v for k, v in asdict(self).items() if k != "corruption" and getattr(self, k) != had[k]}
        out |= {k: v for k, v in asdict(self.corruption).items() if v != getattr(had["corruption"], k)}
        return {key: str(value) for key, value in out.items()}


#: "red" is this project's recipe; "paper" is that of the authors' program: their network, Adam with 1e-4 and a fifth of
#: it after epoch 40 of 50, about 60 windows per batch, every other window, random rotations only, the last epoch kept.
RECIPES: Final[Mapping[str, Recipe]] = MappingProxyType(
    {
        "red": Recipe(),
        "paper": Recipe(
            network="lstm",
            past=4,
            least=4,
            stride=2,
            epochs=50,
            batch=60,
            rate=1e-4,
            schedule="step",
            loss="displacements",
            corruption=Corruption(turn=False, mirror=False),
            kept="last",
        ),
    }
)
