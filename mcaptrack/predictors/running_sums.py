"""Sums over the time of a log in which what is older counts less. Letters: R times."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats


def running(before: Floats, kept: Floats, new: NDArray[Any]) -> tuple[Floats, Floats]:
    """The sums (R, ...) at some times, and the last of them.

    At each time ``kept`` (R, ...) of the sum before, which has the shape (...), is left, and ``new`` (R, ...) is added.

    Examples
    --------
    >>> running(np.array([8.0]), np.array([0.5, 0.5]), np.array([[1.0], [0.0]]))[0].tolist()
    [[5.0], [2.5]]
    """
    out = np.empty(new.shape)
    for number, (left, one) in enumerate(zip(kept, new, strict=True)):
        before = left * before + one
        out[number] = before
    return out, out[-1].copy() if len(out) else before
