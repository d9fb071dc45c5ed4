"""The spread of forecasts: one mean and one 90th percentile for each frame, which viewers can plot.

Letters: N forecasts, F frames.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.mixtures import Tails, squared_radius

#: The probability inside the ellipses, and the percentile of their sizes that is given beside the mean.
LEVEL: Final = 0.95
PERCENTILE: Final = 90.0


def radii_m(cov_m2: Floats, tails: Tails) -> Floats:
    """The longer half axes (N,) in m of the 95 % ellipses of forecasts.

    Parameters
    ----------
    cov_m2 : array (N, 2, 2), m^2
        Covariances of the forecasts.
    tails : Tails
        Shapes (N,) of their distributions.

    Returns
    -------
    array (N,), m
        NaN where a covariance is not known or not positive.

    Examples
    --------
    >>> import numpy as np
    >>> from mcaptrack.geometry.mixtures import normal_tails
    >>> radii_m(np.diag([1.0, 4.0])[None], normal_tails(1)).round(3).tolist()
    [4.895]
    """
    xx, xy, yy = cov_m2[:, 0, 0], cov_m2[:, 0, 1], cov_m2[:, 1, 1]
    half = np.hypot((xx - yy) / 2, xy)
    larger, smaller = (xx + yy) / 2 + half, (xx + yy) / 2 - half
    known = np.isfinite(larger) & (smaller >= -1e-9 * np.abs(larger))
    squared = np.where(known, larger, np.nan) * squared_radius(LEVEL, tails)
    return np.asarray(np.sqrt(squared), np.float64)


def by_frame(values: Floats, frame: Ints, frames: int) -> tuple[Floats, Floats]:
    """The mean and the 90th percentile (F,) of values (N,) in each frame, NaN where none is known.

    ``frame`` (N,) is the index of each value's frame. Percentiles are interpolated linearly between values.

    Examples
    --------
    >>> import numpy as np
    >>> mean, most = by_frame(np.array([1.0, 3.0, np.nan]), np.array([0, 0, 1]), 2)
    >>> mean.tolist(), most.round(2).tolist()
    ([2.0, nan], [2.8, nan])
    """
    known = np.isfinite(values)
    values, frame = values[known], frame[known]
    count = np.bincount(frame, minlength=frames)
    if not len(values):
        return np.full(frames, np.nan), np.full(frames, np.nan)
    ordered = values[np.lexsort((values, frame))]
    # Places within a frame, so that the rounding of a frame doesn't depend on those before it.
    place = np.maximum(PERCENTILE / 100 * (count - 1), 0.0)
    low = np.floor(place).astype(np.int64)
    share = place - low
    first = np.minimum(np.cumsum(count) - count + low, len(ordered) - 1)
    second = np.minimum(first + 1, len(ordered) - 1)
    most = ordered[first] + share * (ordered[second] - ordered[first])
    total = np.bincount(frame, values, minlength=frames)
    some = count > 0
    return np.where(some, total / np.maximum(count, 1), np.nan), np.where(some, most, np.nan)
