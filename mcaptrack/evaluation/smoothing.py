"""Predictions from smoothed tracks: the ablation "SORT + smoothing" of the paper.

Identities and positions stay as the tracker gave them. Only the displacements of each track's past are smoothed by
Eq. 3 before the same predictor predicts, so that the difference is the effect of smoothing alone.

Letters: N tracks of a frame, L past positions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.histories import Holt
from mcaptrack.schema import Frame
from mcaptrack.transforms import Predict
from mcaptrack.transforms.retrack.active_tracks import SmoothedHistory

#: alpha = beta of Eq. 3, as in the paper.
SMOOTHING: Final = 0.5


@dataclass
class SmoothedHistories:
    """The smoothed pasts of all tracks that the frame before had: after a gap a past begins again."""

    length: int

    def __post_init__(self) -> None:
        self._holt = Holt(SMOOTHING, SMOOTHING)
        self._ids: Ints = np.empty(0, np.int64)
        self._history = self._begin(np.empty((0, 2)))

    def push(self, ids: Ints, xy_m: Floats, steps: int = 1) -> tuple[Floats, Bools]:
        """Add the positions (N, 2) of the tracks of the next frame; returns pasts (N, L, 2) and what is known (N, L).

        Positions are rebuilt backwards from the current one, which stays as it was measured.
        """
        history = self._begin(xy_m)
        _, now, before = np.intersect1d(ids, self._ids, return_indices=True)
        if steps == 1 and len(now):
            kept = SmoothedHistory(*(getattr(self._history, one.name)[before] for one in fields(SmoothedHistory)))
            kept.append(self._holt, xy_m[now], np.ones(len(now), np.int64))
            for one in fields(SmoothedHistory):
                getattr(history, one.name)[now] = getattr(kept, one.name)
        self._ids, self._history = ids.astype(np.int64), history
        past, known = history.positions()
        return np.where(known[..., None], past, np.nan), known

    def _begin(self, xy_m: Floats) -> SmoothedHistory:
        """Pasts of one position each."""
        count = len(xy_m)
        known = np.arange(self.length) == self.length - 1
        past = np.tile(xy_m[:, None].astype(float), (1, self.length, 1))
        return SmoothedHistory.of_observations(self._holt, past, np.tile(known, (count, 1)))


def smoothed_predictions(samples: Sequence[Frame], predict: Predict) -> Iterator[Frame]:
    """Predictions as ``predict`` makes them of samples, but from smoothed pasts.

    Parameters
    ----------
    samples : sequence of Frame
        Rows of Tracks at the prediction rate.
    predict : Predict
        The predictor and its options.

    Yields
    ------
    Frame
        Rows of Predictions, one frame for each of ``samples``.
    """
    forecaster = predict.forecaster(SmoothedHistories)
    for frame in samples:
        yield frame._replace(rows=forecaster.predict(frame))
