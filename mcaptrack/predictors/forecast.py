"""The interface of predictors: what they are given and what they return. Letters: B batch, L past, T future steps."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats


class Forecast(NamedTuple):
    """Predicted positions of B tracks as Gaussian distributions.

    Attributes
    ----------
    mean : (B, T, 2) of float, in m
        Predicted positions.
    cov : (B, T, 2, 2) of float, in m^2
        Covariance of their errors.
    """

    mean: Floats
    cov: Floats


class Predictor(Protocol):
    """A predictor on a regular clock.

    Attributes
    ----------
    name : str
        Name in messages and tables.
    past : int
        Number of past positions that it uses, the current one included.
    steps : int
        Number of future steps that it predicts.
    step_s : float
        Length of a step in seconds, in the past and in the future.
    weights_sha256 : str or None
        Digest of the learned weights; None if nothing is learned.
    """

    @property
    def name(self) -> str: ...
    @property
    def past(self) -> int: ...
    @property
    def steps(self) -> int: ...
    @property
    def step_s(self) -> float: ...
    @property
    def weights_sha256(self) -> str | None: ...

    def predict(self, xy_m: Floats, valid: NDArray[np.bool_]) -> Forecast:
        """Predict a batch of tracks.

        Parameters
        ----------
        xy_m : (B, L, 2) of float, in m
            Past positions, the current one last; L may be longer or shorter than ``past``. Unknown ones may be NaN.
        valid : (B, L) of bool
            Mask of the known positions; the last one is always known.

        Returns
        -------
        Forecast
            Of ``steps`` steps for each of the B tracks, which don't depend on the others of the batch.
        """
        ...
