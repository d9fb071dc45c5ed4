"""Numbers as text, grouped by length, because messages with texts of one length have one length."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Ints


def by_length(numbers: Ints) -> Iterator[tuple[int, Ints, NDArray[Any]]]:
    """Group numbers (N,) by the length of their text: for each length the length, the indices, and the texts as
    bytes.
    """
    known, which = np.unique(numbers, return_inverse=True)
    words = np.array([str(number).encode() for number in known.tolist()] or [b""])
    lengths = np.char.str_len(words)[which] if len(numbers) else np.empty(0, np.int64)
    for length in np.unique(lengths).tolist():
        chosen = np.flatnonzero(lengths == length)
        yield length, chosen, words[which[chosen]]
