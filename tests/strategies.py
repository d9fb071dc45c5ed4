"""Hypothesis strategies for rows."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mcaptrack.schema import Schema
from mcaptrack.schema.proto import KINDS


def columns(schema: Schema, max_rows: int = 5, times: bool = True) -> st.SearchStrategy[dict[str, np.ndarray]]:
    """Columns that pass the gate: any value that fits, and NaN where a number may be missing."""

    def column(count: int, kind: str, optional: bool) -> st.SearchStrategy[np.ndarray]:
        dtype = np.dtype(KINDS[kind][0])
        if dtype.kind == "f":
            elements = st.floats(width=8 * dtype.itemsize, allow_nan=False)
            elements = elements | st.just(float("nan")) if optional else elements
            return hnp.arrays(dtype, count, elements=elements)
        elements = hnp.from_dtype(dtype) | st.just(-1) if optional else None
        return hnp.arrays(dtype, count, elements=elements)

    def build(count: int) -> st.SearchStrategy[dict[str, np.ndarray]]:
        return st.fixed_dictionaries({c.name: column(count, c.kind, c.optional) for c in schema.columns}).map(
            lambda drawn: _with_alternatives(schema, drawn)
        )

    return st.integers(0, max_rows).flatmap(build)


def _with_alternatives(schema: Schema, drawn: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Make groups of columns whole or missing, and give rows that have none the first one."""
    found = np.zeros(len(next(iter(drawn.values()))), bool)
    for first, *others in reversed(schema.alternatives):
        missing = np.isnan(drawn[first]) & (found | (first != schema.alternatives[0][0]))
        for name in (first, *others):
            there = np.where(np.isnan(drawn[name]), 0.0, drawn[name])
            drawn[name] = np.where(missing, np.nan, there)
        found |= ~missing
    return drawn
