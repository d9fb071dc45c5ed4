"""Angles in radians."""

from __future__ import annotations

import numpy as np

from mcaptrack.geometry.arrays import Floats


def wrapped(angle: Floats) -> Floats:
    """Angles in radians, from -pi (not included) to pi."""
    return np.asarray(np.pi - (np.pi - angle) % (2 * np.pi))


def headings(ahead: Floats) -> Floats:
    """The angles (N,) of vectors (N, 2 or 3) from the x axis in the x-y plane, from -pi (not included) to pi."""
    angle = np.arctan2(ahead[:, 1], ahead[:, 0])
    return np.asarray(np.where(angle == -np.pi, np.pi, angle))
