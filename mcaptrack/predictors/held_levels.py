"""Corrects mixtures by what their ellipses have held in a log.

The level of an error is the probability of the smallest ellipse that holds it. Levels are uniform if ellipses hold what
they say. Where they aren't, ellipses are made those of the level that did hold half of the errors, and nine tenths.
This is calibrated regression (Kuleshov et al., 2018), for forecasts that are made one after another.

Letters: T future steps, R times, M errors, B bins of levels.

References
----------
V. Kuleshov, N. Fenner, S. Ermon, "Accurate uncertainties for deep learning using calibrated regression", ICML 2018.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.mixtures import Tails, half_radius

#: Bins of levels.
LEVELS: Final = 40
#: The levels by which the narrow and the wide part are corrected.
_MIDDLE, _OUTER = 0.5, 0.9
#: So many independent errors of all steps together count as much as that levels are uniform, and as many of one step as
#: much as those of all.
_UNIFORM, _ALL_STEPS = 20.0, 40.0
#: Levels of which half of the errors, or nine tenths, are smaller, lie between these.
_LOWEST, _HIGHEST = 0.02, 0.995
#: The correction isn't for what the fit of the mixture has still to learn: limits of the factors of the covariance.
_LEAST_NARROW, _MOST_NARROW, _MOST_WIDE = 0.6, 2.0, 1.5


def level_counts(cell: Ints, half_squared: Floats, tails: Tails, cells: int) -> Floats:
    """The numbers (cells, B) of errors (M,) at each level: ``cell`` says where each counts, ``tails`` its mixture."""
    weight, narrow, wide = tails
    level = 1 - (1 - weight) * np.exp(-half_squared / narrow) - weight * np.exp(-half_squared / wide)
    column = np.minimum((level * LEVELS).astype(np.int64), LEVELS - 1)
    return np.bincount(cell * LEVELS + column, minlength=cells * LEVELS).reshape(cells, LEVELS).astype(np.float64)


def correct(tails: Tails, counts: Floats) -> Tails:
    """Mixtures (R, T) that hold what they say, after ``counts`` (R, T, B) of independent errors at each level.

    The narrow part is scaled so that half of the errors are in the 50 % ellipse. The wide part, of rare errors, is
    only made larger.
    """
    share = _shares(counts)
    below = np.concatenate([np.zeros((*share.shape[:-1], 1)), np.cumsum(share, axis=-1)], axis=-1)
    level = np.array([_MIDDLE, _OUTER])[:, None, None]
    at = np.minimum((below <= level[..., None]).sum(axis=-1) - 1, LEVELS - 1)  # (2, R, T)
    inside = level - np.take_along_axis(below[None], at[..., None], -1)[..., 0]
    held = (at + inside / np.take_along_axis(share[None], at[..., None], -1)[..., 0]) / LEVELS
    held = np.clip(held, _LOWEST, _HIGHEST)
    now, wanted = half_radius(np.stack([held, np.broadcast_to(level, held.shape)]), tails)
    middle, outer = now / wanted
    narrow = tails.narrow_scale * np.clip(middle, _LEAST_NARROW, _MOST_NARROW)
    wide = tails.wide_scale * np.clip(np.maximum(middle, outer), 1.0, _MOST_WIDE)
    return Tails(tails.wide_weight, narrow, np.maximum(wide, narrow))


def _shares(counts: Floats) -> Floats:
    """The expected shares of errors in each bin of levels, (R, T, B)."""
    of_all = counts.mean(axis=1, keepdims=True)
    shared = (of_all + _UNIFORM / LEVELS) / (of_all.sum(axis=2, keepdims=True) + _UNIFORM)
    own: Floats = (counts + _ALL_STEPS * shared) / (counts.sum(axis=2, keepdims=True) + _ALL_STEPS)
    return own
