"""The most that the noise of positions can be, as far as the tracks of the input show it.

Online tracking estimates noise from how far observations are from where tracks expect them. Where many are given to the
wrong track, as in crowds in which people are merged into one detection now and then, these distances say little about
noise; a larger estimate lets more of them be wrong, and it would grow without end. Tracks of the input don't depend on
what is decided here: noise bends them, and so does the motion of people, so that there is hardly more noise than bends.

Letters: R steps, N observations of all of them, L past positions.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.predictors.position_noise import PAST, PositionNoise
from mcaptrack.transforms.retrack.recent_positions import RecentPositions

#: How many times as large noise may be as bends of the input say: trackers smooth their tracks.
_FACTOR: Final = 1.5
#: Noise may be so large in any case: smooth tracks may be off for long. In metres.
_LEAST_M: Final = 0.3


class InputNoise:
    """Limits the noise of positions, step by step, from the input up to each; steps have ``step_s`` seconds."""

    def __init__(self, step_s: float) -> None:
        self._noise = PositionNoise(step_s)
        self._recent = RecentPositions(PAST)

    def most_m(self, passed: Ints, steps: Ints, place: Ints, source: Ints, xy: Floats) -> list[float]:
        """The largest noise that there may be at each of ``steps`` (R,), infinite as long as little is known.

        ``passed`` (R,) are the steps since the one before. ``source`` (N,) are the input ids of observations at ``xy``
        (N, 2), and ``place`` (N,) says of which step they are.
        """
        step = steps[place]
        self._recent.add(int(steps[0]), source, step, xy)
        past, _ = self._recent.before(source, step, xy)
        bends_m2 = self._noise.bends_m2(passed, place, past)
        most = np.maximum(_FACTOR * np.sqrt(np.fmax.reduce(bends_m2, axis=1)), _LEAST_M)
        out: list[float] = np.where(np.isnan(most), np.inf, most).tolist()
        return out
