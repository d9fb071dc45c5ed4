"""The result of a training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mcaptrack.notices import Notice


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
