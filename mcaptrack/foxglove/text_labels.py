"""Labels as text, grouped by length, because messages with texts of one length have one length."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Ints


def by_length(labels: NDArray[Any]) -> Iterator[tuple[int, Ints, NDArray[Any]]]:
    """Group labels (N,), numbers or texts, by the length of their text: for each length the length in bytes, the
    indices, and the texts as bytes.
    """
    known, which = np.unique(labels, return_inverse=True)
    words = np.array([str(label).encode() for label in known.tolist()] or [b""])
    lengths = np.char.str_len(words)[which] if len(labels) else np.empty(0, np.int64)
    for length in np.unique(lengths).tolist():
        chosen = np.flatnonzero(lengths == length)
        yield length, chosen, words[which[chosen]]
