"""Mixtures of a narrow and a wide normal distribution in the plane, with a common mean.

Errors of forecasts have heavier tails than a normal distribution: most people walk on, some turn or stop. Both parts
have the same shape, ``narrow_scale`` and ``wide_scale`` times one covariance matrix, so that the regions of highest
density are ellipses. All of a mixture then follows from the squared Mahalanobis distance under that matrix, which
for a normal distribution is exponential with mean 2.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats

#: Halvings of the interval in which a quantile lies: to the precision of 64-bit numbers.
_HALVINGS: Final = 60
#: Steps of Halley's method for quantiles: exact to a millionth if the wide scale is ten thousand times the narrow one.
_HALLEY_STEPS: Final = 8


class Tails(NamedTuple):
    """The shape of mixtures: (1 - wide_weight) N(mean, narrow_scale cov) + wide_weight N(mean, wide_scale cov).

    Attributes
    ----------
    wide_weight : (...) of float
        Probability of the wide part. NaN for a normal distribution.
    narrow_scale, wide_scale : (...) of float
        The covariances of the two parts, as multiples of the given one.
    """

    wide_weight: Floats
    narrow_scale: Floats
    wide_scale: Floats

    def of_normals(self) -> Tails:
        """The same mixtures, with normal distributions written as mixtures of two equal parts."""
        with np.errstate(invalid="ignore"):
            is_known = (self.wide_weight >= 0) & (self.narrow_scale > 0) & (self.wide_scale > 0)
        is_normal = ~(is_known & np.isfinite(self.narrow_scale) & np.isfinite(self.wide_scale))
        weight = np.where(is_normal, 0.0, self.wide_weight)
        return Tails(weight, np.where(is_normal, 1.0, self.narrow_scale), np.where(is_normal, 1.0, self.wide_scale))


def normal_tails(shape: int | tuple[int, ...]) -> Tails:
    """Normal distributions."""
    return Tails(*(np.full(shape, np.nan) for _ in range(3)))


def mahalanobis_squared(off_m: Floats, cov_m2: Floats) -> Floats:
    """Squared Mahalanobis distances of errors from zero.

    Parameters
    ----------
    off_m : array (..., 2), m
        Errors.
    cov_m2 : array (..., 2, 2), m^2
        Their covariances.

    Returns
    -------
    array (...)
        Squared distances in units of the standard deviation.

    Examples
    --------
    >>> import numpy as np
    >>> mahalanobis_squared(np.array([2.0, 0.0]), np.diag([4.0, 1.0])).item()
    1.0
    """
    xx, xy, yy = cov_m2[..., 0, 0], cov_m2[..., 0, 1], cov_m2[..., 1, 1]
    x, y = off_m[..., 0], off_m[..., 1]
    return np.asarray((yy * x**2 - 2 * xy * x * y + xx * y**2) / (xx * yy - xy**2))


def mass_within(squared: Floats, tails: Tails) -> Floats:
    """The probability of a squared Mahalanobis distance up to ``squared`` (...).

    Examples
    --------
    >>> import numpy as np
    >>> mass_within(np.array([0.0, 2 * np.log(2)]), normal_tails(2)).round(6).tolist()
    [0.0, 0.5]
    """
    weight, narrow, wide = tails.of_normals()
    half = np.asarray(squared) / 2
    return np.asarray(-(1 - weight) * np.expm1(-half / narrow) - weight * np.expm1(-half / wide))


def squared_radius(level: float, tails: Tails) -> Floats:
    """The squared Mahalanobis distance (...) within which the probability is ``level``, between 0 and 1.

    Examples
    --------
    >>> squared_radius(0.95, normal_tails(1)).round(4).tolist()
    [5.9915]
    """
    mixture = tails.of_normals()
    normal = -2 * np.log1p(-level)
    low = normal * np.minimum(mixture.narrow_scale, mixture.wide_scale)
    high = normal * np.maximum(mixture.narrow_scale, mixture.wide_scale)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        is_short = mass_within(middle, mixture) < level
        low, high = np.where(is_short, middle, low), np.where(is_short, high, middle)
    return np.asarray((low + high) / 2)


def half_radius(level: Floats, tails: Tails) -> Floats:
    """Half of ``squared_radius`` (...) in fewer operations, for mixtures with a narrow scale below the wide one.

    Both parts have weights above 0. By Halley's method on the logarithm of the probability beyond, which is convex.

    Examples
    --------
    >>> one = Tails(np.array([0.2]), np.array([0.5]), np.array([4.0]))
    >>> 2 * half_radius(np.array([0.95]), one).round(6) == squared_radius(0.95, one).round(6)
    array([ True])
    """
    weight, narrow, wide = tails
    wanted = np.log1p(-level)
    # one part alone has less beyond: no further out than the radius
    half = np.maximum(np.maximum(narrow * (np.log1p(-weight) - wanted), wide * (np.log(weight) - wanted)), 0.0)
    for _ in range(_HALLEY_STEPS):
        of_narrow, two = (1 - weight) * np.exp(-half / narrow), weight * np.exp(-half / wide)
        beyond = of_narrow + two
        off, slope = np.log(beyond) - wanted, (of_narrow / narrow + two / wide) / beyond
        bend = (of_narrow / narrow**2 + two / wide**2) / beyond - slope**2
        half = half + 2 * off * slope / (2 * slope**2 - off * bend)
    return np.asarray(half)


def log_density(squared: Floats, log_area: Floats, tails: Tails) -> Floats:
    """Logarithm of the density (...) in the plane at squared Mahalanobis distances.

    ``log_area`` is half the logarithm of the determinant of the covariance.
    """
    weight, narrow, wide = tails.of_normals()
    half = np.asarray(squared) / 2
    with np.errstate(divide="ignore", invalid="ignore"):  # a weight of 0, an unknown covariance
        parts = np.log1p(-weight) - half / narrow - np.log(narrow), np.log(weight) - half / wide - np.log(wide)
        return np.asarray(np.logaddexp(*parts) - log_area - np.log(2 * np.pi))
