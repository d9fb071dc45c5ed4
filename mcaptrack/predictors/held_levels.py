"""Corrects mixtures by what their ellipses have held in a log.

The level of an error is the probability of the smallest ellipse that holds it. Levels are uniform if ellipses hold what
they say. Where they aren't, ellipses are made those of the level that did hold half of the errors, and nine tenths.
This is calibrated regression (Kuleshov et al., 2018), for forecasts that are made one after another.

Letters: T future steps, M errors.

References
----------
V. Kuleshov, N. Fenner, S. Ermon, "Accurate uncertainties for deep learning using calibrated regression", ICML 2018.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.mixtures import Tails, half_radius, mass_within

#: Bins of levels.
_BINS: Final = 40
#: The levels by which the narrow and the wide part are corrected.
_MIDDLE, _OUTER = 0.5, 0.9
#: So many independent errors of all steps together count as much as that levels are uniform, and as many of one step as
#: much as those of all.
_UNIFORM, _ALL_STEPS = 20.0, 40.0
#: Levels of which half of the errors, or nine tenths, are smaller, lie between these.
_LOWEST, _HIGHEST = 0.02, 0.995
#: The correction isn't for what the fit of the mixture has still to learn: limits of the factors of the covariance.
_LEAST_NARROW, _MOST_NARROW, _MOST_WIDE = 0.6, 2.0, 1.5


class HeldLevels:
    """The levels of the errors of forecasts of ``steps`` steps in a log so far."""

    def __init__(self, steps: int) -> None:
        self._counts = np.zeros((steps, _BINS))

    def add(self, step: Ints, half_squared: Floats, tails: Tails) -> None:
        """Count errors of steps (M,), the first of which is 0, of which ``tails`` (M,) were the distributions."""
        level = mass_within(2 * half_squared, tails)
        column = np.minimum((level * _BINS).astype(np.int64), _BINS - 1)
        flat = np.bincount(step * _BINS + column, minlength=self._counts.size)
        self._counts += flat.reshape(self._counts.shape)

    def forget(self, kept: Floats) -> None:
        """Let the errors of each step count only a share, (T,), of what they did."""
        self._counts *= kept[:, None]

    def correct(self, tails: Tails, independent: float) -> Tails:
        """Mixtures (T,) that hold what they say, if a share ``independent`` of the errors counts.

        The narrow part is scaled so that half of the errors are in the 50 % ellipse. The wide part, of rare errors, is
        only made larger.
        """
        share = self._shares(independent)
        below = np.concatenate([np.zeros((len(share), 1)), np.cumsum(share, axis=1)], axis=1)
        level = np.array([[_MIDDLE], [_OUTER]])
        at = np.minimum((below <= level[..., None]).sum(axis=2) - 1, _BINS - 1)
        step = np.arange(len(share))
        held = np.clip((at + (level - below[step, at]) / share[step, at]) / _BINS, _LOWEST, _HIGHEST)
        now, wanted = half_radius(np.stack([held, np.broadcast_to(level, held.shape)]), tails)
        middle, outer = now / wanted
        narrow = tails.narrow_scale * np.clip(middle, _LEAST_NARROW, _MOST_NARROW)
        wide = tails.wide_scale * np.clip(np.maximum(middle, outer), 1.0, _MOST_WIDE)
        return Tails(tails.wide_weight, narrow, np.maximum(wide, narrow))

    def _shares(self, independent: float) -> Floats:
        """The expected shares of errors in each bin of levels, (T, bins)."""
        counts = independent * self._counts
        of_all = counts.mean(axis=0)
        shared = (of_all + _UNIFORM / _BINS) / (of_all.sum() + _UNIFORM)
        own: Floats = (counts + _ALL_STEPS * shared) / (counts.sum(axis=1, keepdims=True) + _ALL_STEPS)
        return own
