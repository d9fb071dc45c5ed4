"""The interface of predictors: what they are given and what they return.

Letters: B batch, L past, T future steps, M people.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Floats, Ints


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


class PeopleSeen(NamedTuple):
    """All people who are seen at the times of a batch, the tracks of the batch among them.

    Nothing in it is later than the last position of the past. The order of people has no meaning.

    Attributes
    ----------
    xy_m : (M, L, 2) of float, in m
        Past positions, the current one last, at the same times as those of the batch. Unknown ones may be NaN.
    valid : (M, L) of bool
        Mask of the known positions; the last one is always known.
    moment : (M,) of int
        People with the same number are seen at the same time in the same scene.
    row : (B,) of int
        The row of each track of the batch in the arrays above.
    """

    xy_m: Floats
    valid: Bools
    moment: Ints
    row: Ints

    @classmethod
    def together(cls, xy_m: Floats, valid: Bools) -> PeopleSeen:
        """The tracks of a batch, all seen at the same time."""
        return cls(xy_m, valid, np.zeros(len(valid), np.int64), np.arange(len(valid)))

    @classmethod
    def alone(cls, xy_m: Floats, valid: Bools) -> PeopleSeen:
        """The tracks of a batch, each of them alone."""
        each = np.arange(len(valid))
        return cls(xy_m, valid, each, each)

    def copied(self) -> PeopleSeen:
        """A copy in arrays of its own."""
        return PeopleSeen(self.xy_m.copy(), self.valid.copy(), self.moment.copy(), self.row.copy())


def uses_people(predictor: Any) -> bool:
    """Whether a predictor's ``predict`` takes ``people``: its attribute ``uses_people``, which is optional."""
    return bool(getattr(predictor, "uses_people", False))


class AnyPredictor(Protocol):
    """A predictor on a regular clock, as a class of another package has to be.

    A predictor that looks at other people has the attribute ``uses_people = True``. Its ``predict`` has a third
    parameter, ``people: PeopleSeen | None = None``, without which every track is alone. Others never get it.

    Attributes
    ----------
    past : int
        Number of past positions that it uses, the current one included.
    steps : int
        Number of future steps that it predicts.
    step_s : float
        Length of a step in seconds, in the past and in the future.
    """

    @property
    def past(self) -> int: ...
    @property
    def steps(self) -> int: ...
    @property
    def step_s(self) -> float: ...

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
            Of ``steps`` steps for each of the B tracks, which don't depend on the others of the batch (but on
            ``people``, if the predictor uses them).
        """
        ...


class Predictor(AnyPredictor, Protocol):
    """A predictor that says what it is.

    Attributes
    ----------
    name : str
        Name in messages and tables.
    weights_sha256 : str or None
        Digest of the learned weights; None if nothing is learned.
    """

    @property
    def name(self) -> str: ...
    @property
    def weights_sha256(self) -> str | None: ...


def are_covariances(cov: Floats) -> bool:
    """Whether the matrices ``cov`` (B, T, 2, 2) are symmetric and positive definite, up to the precision of 32 bits."""
    xx, xy, yx, yy = cov[..., 0, 0], cov[..., 0, 1], cov[..., 1, 0], cov[..., 1, 1]
    scale = np.sqrt(np.maximum(xx, 0)) * np.sqrt(np.maximum(yy, 0))  # the product of both may overflow
    is_symmetric = np.abs(xy - yx) <= 1e-4 * scale
    return bool((is_symmetric & (xx > 0) & (yy > 0) & (np.abs(xy + yx) / 2 <= scale)).all())


def predict_among(predictor: AnyPredictor, xy_m: Floats, valid: Bools, people: PeopleSeen | None) -> Forecast:
    """The forecasts of a batch; a predictor that uses other people gets them.

    ``xy_m`` (B, L, 2) are past positions of B tracks in metres, of which ``valid`` (B, L) are known.
    """
    if people is not None and uses_people(predictor):
        return predictor.predict(xy_m, valid, people=people)  # type: ignore[call-arg]
    return predictor.predict(xy_m, valid)


def predict_together(predictor: Predictor, xy_m: Floats, valid: Bools) -> Forecast:
    """The forecasts of tracks that are all seen at the same time, without other people.

    ``predictor`` gets ``xy_m`` (B, L, 2), past positions in metres, of which ``valid`` (B, L) are known.
    """
    return predict_among(predictor, xy_m, valid, PeopleSeen.together(xy_m, valid))
