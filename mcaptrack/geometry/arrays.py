"""Names for array types, one for each kind of element, used in annotations everywhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
