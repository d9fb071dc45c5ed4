"""Hypothesis strategies for rows."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mcaptrack.schema import Schema
from mcaptrack.schema.proto import KINDS


def columns(schema: Schema, max_rows: int = 8, times: bool = True) -> st.SearchStrategy[dict[str, np.ndarray]]:
    """Columns that pass the gate: any value that fits, and NaN where a number may be missing."""

    def column(count: int, kind: str, optional: bool) -> st.SearchStrategy[np.ndarray]:
        dtype = np.dtype(KINDS[kind][0])
        if dtype.kind == "f":
            elements = st.floats(width=8 * dtype.itemsize, allow_nan=False)
            elements = elements | st.just(float("nan")) if optional else elements
            return hnp.arrays(dtype, count, elements=elements)
        return hnp.arrays(dtype, count)

    def build(count: int) -> st.SearchStrategy[dict[str, np.ndarray]]:
        return st.fixed_dictionaries({c.name: column(count, c.kind, c.optional) for c in schema.columns})

    return st.integers(0, max_rows).flatmap(build)
