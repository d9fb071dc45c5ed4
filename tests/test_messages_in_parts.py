"""Tables of single channels are made in parts: the same as of all messages at once, and without holding them."""

from __future__ import annotations

import json
from unittest.mock import patch

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.tables import build, files, messages
from tests.logs import flat_table
from tests.memory import held

NUMBERS = st.integers(-(2**64), 2**65) | st.sampled_from([0, 1, 2**53, 2**53 + 1, 2**63, -(2**63), 2**64 - 1])
PLAIN = st.booleans() | NUMBERS | st.floats(allow_nan=False) | st.sampled_from(["", "a", "1"])
LISTS = st.lists(st.integers(-3, 2**63), max_size=3) | st.lists(st.floats(0, 1), max_size=2) | st.just([])
FIELDS = {
    "flag": st.booleans(),
    "whole": st.integers(0, 9),
    "large": NUMBERS,
    "number": st.integers(-5, 2**54) | st.floats(0, 1),
    "text": st.text(max_size=3),
    "list": LISTS,
    "mixed": PLAIN | LISTS,
    "parts": st.lists(
        st.fixed_dictionaries({}, optional={"a": st.integers(0, 9), "b": st.text(max_size=2)}), max_size=3
    ),
    "blob": st.binary(max_size=3) | st.none(),
}
MESSAGES = st.lists(st.fixed_dictionaries({}, optional=FIELDS), max_size=12)


def equals(value: object, stored: object) -> bool:
    """Whether a stored value is the value: a struct has all fields, and what no type holds is JSON."""
    if isinstance(value, dict) and isinstance(stored, dict):
        return all(equals(value.get(name), stored[name]) for name in stored) and value.keys() <= stored.keys()
    if isinstance(value, list) and isinstance(stored, list):
        return len(value) == len(stored) and all(map(equals, value, stored))
    if isinstance(stored, str) and stored != value:
        return bool(json.loads(stored) == (value.hex() if isinstance(value, bytes) else value))
    return bool(value == stored)


@settings(max_examples=40)
@given(MESSAGES, st.booleans(), st.integers(1, 5), st.integers(1, 300), st.integers(1, 6))
def test_parts_give_the_table_of_all_messages(rows, blobs, count, piece, piece_rows):
    whole, left_out = flat_table(rows, blobs)
    expected = whole.table()
    with (
        patch.object(messages, "_PART_MESSAGES", count),
        patch.object(messages, "PIECE_BYTES", piece),
        patch.object(build, "PIECE_ROWS", piece_rows),
    ):
        pieces, without = flat_table(rows, blobs)
        table = pa.concat_tables(list(pieces))
    assert (table.schema, without) == (expected.schema, left_out)
    assert table.equals(expected) or table.to_pylist() == expected.to_pylist()  # infinities in lists
    assert table.column("message_offset").to_pylist() == list(range(len(rows)))
    for name in table.column_names[7:]:
        for row, stored in zip(rows, table.column(name).to_pylist(), strict=True):
            assert equals(row.get(name), stored), name


def test_a_channel_of_pictures_is_exported_without_holding_them(tmp_path):
    """Pictures of 40 kB: with their bytes and without, the log may be of any length."""
    random = np.random.default_rng(1)
    pictures = [random.bytes(40_000) for _ in range(8)]

    def export(count: int, blobs: bool) -> tuple[int, int]:
        rows = [{"format": "raw", "data": pictures[n % 8]} for n in range(count)]

        def work() -> None:
            made, _ = flat_table(rows, blobs)
            files.write(tmp_path / "a.parquet", made, {}, force=True)

        before, pool = pa.default_memory_pool(), pa.proxy_memory_pool(pa.default_memory_pool())
        pa.set_memory_pool(pool)
        try:
            _, most = held(work)
        finally:
            pa.set_memory_pool(before)
        file = pq.ParquetFile(tmp_path / "a.parquet")
        assert file.metadata.num_rows == count
        if blobs:
            assert file.read_row_group(file.num_row_groups - 1)["data"].to_pylist()[-1] == pictures[(count - 1) % 8]
        return most, pool.max_memory()

    with (
        patch.object(messages, "_PART_MESSAGES", 4),
        patch.object(messages, "PIECE_BYTES", 2**18),
        patch.object(files, "_BYTES_READ", 2**18),
    ):
        for blobs in (False, True):
            few, many = export(40, blobs), export(140, blobs)
            assert sum(many) - sum(few) < 0.2 * 100 * 40_000
