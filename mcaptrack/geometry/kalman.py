"""SORT's Kalman filter, for many boxes at once.

The filter (Bewley et al. 2016, section 3.2) has the state u, v, s, r and the rates of the first three, where u, v are
the centre of a box in pixels, s its area and r its ratio of width to height, which is assumed constant. The initial
covariance and both noises are diagonal and equal for u and v, so the 7 x 7 filter separates into one for the centre,
one for the area and one for the ratio: 7 numbers of covariance per track instead of 49.

Tracks are columns and numbers are rows, so that a step for all tracks is a few additions of whole rows.

Letters: K tracks, N boxes.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats

#: Rows of a state: u, v, s, r and their rates (that of r is always 0); then, for centre, area and ratio each, the
#: variances, the covariances with the rate, and the variances of the rate (those of the rate of r are always 0).
STATE_ROWS: Final = 17
_PLACE, _RATE, _P, _C, _V = (slice(*ends) for ends in ((0, 4), (4, 8), (8, 11), (11, 14), (14, 17)))
_AREA, _RATIO, _AREA_RATE = 2, 3, 6
_COVARIANCE: Final = slice(_P.start, STATE_ROWS)
#: Areas below this, in square pixels, count as 0.
LEAST_AREA: Final = 1e-9
#: The index into centre, area, ratio of each of u, v, s, r.
_OF: Final = np.array([0, 0, 1, 2])

# Diagonals of R, P0 and Q for (centre, area, ratio) and their rates, as SORT sets them.
R: Final = np.array([[1.0], [10.0], [10.0]])
START: Final = np.array([[0.0, 0, 0, 0, 10, 10, 10, 0, 0, 0, 1e4, 1e4, 0]]).T
NOISE: Final = np.array([[1.0, 1, 1, 0, 0, 0, 0.01, 1e-4, 0]]).T


def measure(boxes: Floats) -> Floats:
    """Boxes (4, N) of left, top, width, height -> measurements u, v, s, r (4, N)."""
    measured = np.empty_like(boxes)
    np.multiply(boxes[2:], 0.5, out=measured[:2])
    measured[:2] += boxes[:2]
    np.multiply(boxes[2], boxes[3], out=measured[2])
    np.divide(boxes[2], boxes[3], out=measured[3])
    return measured


def start(state: Floats, measured: Floats) -> None:
    """Initialise states (17, N) at u, v, s, r (4, N), at rest and with the initial covariance, in place."""
    state[_PLACE] = measured
    state[_RATE.start :] = START


def predict(state: Floats) -> None:
    """Predict states (17, K) by one frame, in place. An area that would become 0 stops shrinking instead."""
    place, p, c = state[_PLACE], state[_P], state[_C]
    place += state[_RATE]
    area = place[_AREA]
    if area.size and area.min() < LEAST_AREA:
        is_zero = area < LEAST_AREA
        area[is_zero] -= state[_AREA_RATE, is_zero]
        state[_AREA_RATE, is_zero] = 0
    p += c
    c += state[_V]
    p += c
    covariance = state[_COVARIANCE]
    covariance += NOISE


def correct(state: Floats, measured: Floats) -> None:
    """Update states (17, K) with measurements u, v, s, r (4, K), in place."""
    place, rate, p, c, v = state[_PLACE], state[_RATE], state[_P], state[_C], state[_V]
    innovation = measured - place
    total = p + R
    gain, gain_rate = p / total, c / total
    place += gain.take(_OF, axis=0) * innovation
    rate += gain_rate.take(_OF, axis=0) * innovation
    v -= gain_rate * c
    c -= gain * c
    p -= gain * p


def move(state: Floats, motion: Floats) -> None:
    """Move states (17, K) by an affine motion (2, 3) of the camera, in place. Boxes stay upright and keep their ratio.

    Lengths grow by the root of the determinant, areas by the determinant; the variance of the centre stays isotropic.
    """
    linear, area = motion[:, :2], abs(float(np.linalg.det(motion[:, :2])))
    state[:2] = linear @ state[:2] + motion[:, 2:]
    state[_RATE][:2] = linear @ state[_RATE][:2]
    state[_AREA] *= area
    state[_AREA_RATE] *= area
    for part in (_P, _C, _V):
        state[part.start] *= area
        state[part.start + 1] *= area**2


def stretch(state: Floats, factor: float) -> None:
    """Convert states (17, K) to frames that last ``factor`` times as long as before, in place."""
    state[_RATE] *= factor
    state[_C] *= factor
    state[_V] *= factor**2


def corners(state: Floats) -> Floats:
    """The boxes of states (17, K): left, top, right, bottom (4, K).

    Areas and ratios are always positive, because a state lies between a positive prior and positive measurements.
    """
    out = np.empty((4, state.shape[1]))
    half = out[2:]
    np.sqrt(state[_AREA] * state[_RATIO], out=half[0])
    np.divide(state[_AREA], half[0], out=half[1])
    half *= 0.5
    np.subtract(state[:2], half, out=out[:2])
    half += state[:2]
    return out
