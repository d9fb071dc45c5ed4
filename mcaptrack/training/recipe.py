"""How a network is trained, as parameters with names; recipes are sets of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from types import MappingProxyType
from typing import Final, Literal, Self

from mcaptrack.errors import McaptrackError
from mcaptrack.training.windows import Corruption

Network = Literal["red", "lstm"]


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """``past`` positions in, ``steps`` of ``step_s`` seconds out; ``least`` past positions make a window.

    ``loss``: "likelihood" is the Gaussian negative log-likelihood plus ``distance_weight`` times the mean distance;
    "displacements" is the sum of squared errors of the displacements, of every batch as it is and turned at random (the
    paper's). ``schedule``: "one-cycle" rises for a tenth of the time and falls to nothing; "step" divides the rate by
    five at epoch ``drop_at``. ``consistency_weight`` is how much forecasts from one step to the next may not differ.
    ``patience`` ends the training after so many epochs without a better validation; the best epoch is ``kept``, or the
    last.
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
        for name, least in (("epochs", 1), ("batch", 1), ("rate", 1e-9), ("patience", 0), ("consistency_weight", 0)):
            if not getattr(self, name) >= least:
                raise McaptrackError(
                    f"{name.replace('_', '-')} has to be at least {least:g}, not {getattr(self, name)}"
                )
        if self.consistency_weight and self.loss == "displacements":
            raise McaptrackError("a consistency weight needs the recipe red; paper compares displacements alone")

    def changed(self, given: Mapping[str, object], corrupted: Mapping[str, object]) -> Self:
        """With other parameters, and others of the corruption; None leaves one as it is. Raises McaptrackError."""
        for name, most in (("noise_m", 10.0), ("gaps", 0.9), ("scale", 1.0)):
            value = corrupted.get(name)
            if isinstance(value, float) and not 0 <= value <= most:
                raise McaptrackError(f"{name.replace('_', '-')} has to be from 0 to {most:g}, not {value:g}")
        corruption = replace(self.corruption, **{k: v for k, v in corrupted.items() if v is not None})  # type: ignore[arg-type]
        return replace(self, corruption=corruption, **{k: v for k, v in given.items() if v is not None})  # type: ignore[arg-type]

    def rate_at(self, step: int, per_epoch: int) -> float:
        """The learning rate of the step-th batch, of which there are ``per_epoch`` in an epoch."""
        if self.schedule == "step":
            return self.rate / (5 if step // per_epoch >= self.drop_at else 1)
        from math import cos, pi

        done = step / max(self.epochs * per_epoch, 1)
        share = done / 0.1 if done < 0.1 else (1 + cos(pi * (done - 0.1) / 0.9)) / 2
        return self.rate * max(share, 1e-3)

    def words(self) -> dict[str, str]:
        """What differs from the default, as text for a card."""
        had = {f.name: getattr(RECIPES["red"], f.name) for f in fields(self)}
        out = {k: v for k, v in asdict(self).items() if k != "corruption" and getattr(self, k) != had[k]}
        out |= {k: v for k, v in asdict(self.corruption).items() if v != getattr(had["corruption"], k)}
        return {key: str(value) for key, value in out.items()}


#: "red" is ours; "paper" is what the program of the paper's authors does: their network, Adam with 1e-4 and a fifth of
#: it after epoch 40 of 50, some 60 windows a batch, every other window, turns and nothing else, the last epoch kept.
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
