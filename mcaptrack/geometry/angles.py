"""Angles in radians."""

from __future__ import annotations

import numpy as np

from mcaptrack.geometry.arrays import Floats


def wrapped(angle: Floats) -> Floats:
    """Angles in radians, from -pi (not included) to pi."""
    return np.asarray(np.pi - (np.pi - angle) % (2 * np.pi))
