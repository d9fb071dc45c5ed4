"""Names for array types, one for each kind of element, used in annotations everywhere; and records of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

__all__ = ["Bools", "Floats", "Image", "Indices", "Ints", "joined", "taken"]

#: Measured values: coordinates, scores, seconds.
Floats = NDArray[np.float64]
#: Whole numbers of a fixed width: ids, counts, times in nanoseconds.
Ints = NDArray[np.int64]
#: Places in other arrays, as NumPy's own functions return them.
Indices = NDArray[np.intp]
#: Masks.
Bools = NDArray[np.bool_]
#: Pixels: (height, width) gray, or (height, width, 3) in the order blue, green, red.
Image = NDArray[np.uint8]
#: Raw bytes.
Bytes = NDArray[np.uint8]
#: A named tuple of arrays of one length, or of such tuples.
Record = TypeVar("Record", bound=tuple[Any, ...])


def taken(record: Record, which: Bools | Ints | Indices | slice) -> Record:
    """Some members of all arrays of a record.

    ``which`` is a mask, or are places, along the first axis of each.
    """
    return type(record)(*(taken(part, which) if isinstance(part, tuple) else part[which] for part in record))


def joined(records: Sequence[Record]) -> Record:
    """Several records end to end."""
    columns = zip(*records, strict=True)
    return type(records[0])(*(joined(of) if isinstance(of[0], tuple) else np.concatenate(of) for of in columns))
