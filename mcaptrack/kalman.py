"""Kalman filters for many targets at once.

``BoxFilter`` is the filter of SORT (Bewley et al. 2016, section 3.2): state u, v, s, r and their rates, where u, v are
the centre of a box in pixels, s its area and r its ratio of width to height, which is taken as constant. The initial
covariance and both noises are diagonal and u, v share their numbers, so the 7 x 7 filter falls apart into one for the
centre, one for the area and one for the ratio: 7 numbers of covariance a track instead of 49.

Letters: K tracks.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Diagonals of R, P0 and Q for (centre, area, ratio) and their rates, as SORT sets them.
_R_CENTRE, _R_AREA, _R_RATIO = 1.0, 10.0, 10.0
_P0, _P0_RATE = 10.0, 1e4
_Q, _Q_CENTRE_RATE, _Q_AREA_RATE = 1.0, 0.01, 1e-4


def boxes_to_state(xywh: Floats) -> Floats:
    """Boxes (K, 4) -> centre, area, ratio (K, 4)."""
    x, y, w, h = xywh.T
    return np.stack([x + w / 2, y + h / 2, w * h, w / h], axis=-1)


def state_to_boxes(state: Floats) -> Floats:
    """Centre, area, ratio (K, 4) -> boxes (K, 4)."""
    u, v, s, r = state.T
    w = np.sqrt(s * r)
    h = s / w
    return np.stack([u - w / 2, v - h / 2, w, h], axis=-1)


def _predict(cov: Floats, q: float, q_rate: float) -> Floats:
    """One step for covariances (K, 3) of position, position x rate, rate."""
    p, c, v = cov.T
    return np.stack([p + 2 * c + v + q, c + v, v + q_rate], axis=-1)


def _correct(cov: Floats, r: float) -> tuple[Floats, Floats, Floats]:
    """Gains of position and rate (K,), and the covariances (K, 3) after a measurement with variance ``r``."""
    p, c, v = cov.T
    gain, gain_rate = p / (p + r), c / (p + r)
    return gain, gain_rate, np.stack([p - gain * p, c - gain * c, v - gain_rate * c], axis=-1)


@dataclass
class BoxFilter:
    """SORT's filter for K boxes. Arrays along the first axis are tracks; new tracks are appended, dead ones masked."""

    mean: Floats  # (K, 7): u, v, s, r, du, dv, ds
    centre: Floats  # (K, 3): covariance of u and du, the same for v
    area: Floats  # (K, 3): covariance of s and ds
    ratio: Floats  # (K,): variance of r

    @classmethod
    def born(cls, xywh: Floats) -> Self:
        """Filters that start on boxes (K, 4), at rest and sure of nothing."""
        count = len(xywh)
        start = np.tile([_P0, 0.0, _P0_RATE], (count, 1))
        mean = np.concatenate([boxes_to_state(xywh), np.zeros((count, 3))], axis=1)
        return cls(mean, start, start.copy(), np.full(count, _P0))

    def __getitem__(self, kept: NDArray[np.bool_]) -> BoxFilter:
        return BoxFilter(*(getattr(self, field.name)[kept] for field in fields(self)))

    def __add__(self, other: BoxFilter) -> BoxFilter:
        return BoxFilter(
            *(np.concatenate([getattr(self, field.name), getattr(other, field.name)]) for field in fields(self))
        )

    def predict(self) -> None:
        """One frame on. An area that would vanish stops shrinking instead."""
        mean = self.mean
        mean[:, 6] = np.where(mean[:, 2] + mean[:, 6] <= 0, 0.0, mean[:, 6])
        mean[:, :3] += mean[:, 4:]
        self.centre = _predict(self.centre, _Q, _Q_CENTRE_RATE)
        self.area = _predict(self.area, _Q, _Q_AREA_RATE)
        self.ratio = self.ratio + _Q

    def correct(self, at: NDArray[np.intp], xywh: Floats) -> None:
        """Measurements: box ``xywh[i]`` of track ``at[i]``."""
        mean, seen = self.mean[at], boxes_to_state(xywh)
        gain, gain_rate, self.centre[at] = _correct(self.centre[at], _R_CENTRE)
        off = seen[:, :2] - mean[:, :2]
        mean[:, :2] += gain[:, None] * off
        mean[:, 4:6] += gain_rate[:, None] * off
        gain, gain_rate, self.area[at] = _correct(self.area[at], _R_AREA)
        off_area = seen[:, 2] - mean[:, 2]
        mean[:, 2] += gain * off_area
        mean[:, 6] += gain_rate * off_area
        gain = self.ratio[at] / (self.ratio[at] + _R_RATIO)
        mean[:, 3] += gain * (seen[:, 3] - mean[:, 3])
        self.ratio[at] = (1 - gain) * self.ratio[at]
        self.mean[at] = mean

    @property
    def boxes(self) -> Floats:
        """The K boxes; NaN where a filter has left what a box can be."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return state_to_boxes(self.mean[:, :4])
