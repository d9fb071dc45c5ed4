"""Tables of single channels are made in parts: the same as of all messages at once, and without holding them."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.tables import build, files, messages
from mcaptrack.tables.build import TablePieces
from tests.memory import held
from tests.references.message_types import column

NUMBERS = st.integers(-(2**64), 2**65) | st.sampled_from([0, 1, 2**53, 2**53 + 1, 2**63, -(2**63), 2**64 - 1])
PLAIN = st.booleans() | NUMBERS | st.floats(allow_nan=False) | st.sampled_from(["", "a", "\ud800", "1"])
LISTS = st.lists(st.integers(-3, 2**63), max_size=3) | st.lists(st.floats(0, 1), max_size=2) | st.just([])
FIELDS = {
    "flag": st.booleans(),
    "whole": st.integers(0, 9),
    "large": NUMBERS,
    "number": st.integers(-5, 2**54) | st.floats(0, 1),
    "text": st.text(max_size=3),
    "list": LISTS,
    "mixed": PLAIN | LISTS,
    "blob": st.binary(max_size=3) | st.none(),
}
MESSAGES = st.lists(st.fixed_dictionaries({}, optional=FIELDS), max_size=12)


def table_of(rows: list[dict[str, object]], blobs: bool) -> tuple[TablePieces, list[str]]:
    """The table of messages with these fields."""
    numbers = np.arange(len(rows))
    places = build.Pointers("a.mcap", numbers, numbers, numbers, numbers, numbers)
    flat = ({(name,): value for name, value in row.items()} for row in rows)
    return messages.messages_table("/a", "A", places, flat, blobs)


@settings(max_examples=40)
@given(MESSAGES, st.booleans(), st.integers(1, 5), st.integers(1, 40), st.integers(1, 300), st.integers(1, 6))
def test_parts_give_the_table_of_all_messages(rows, blobs, count, size, piece, piece_rows):
    names = list(dict.fromkeys(name for row in rows for name in row))
    values = {name: [row.get(name) for row in rows] for name in names}
    left_out = [name for name in names if not blobs and any(isinstance(one, bytes) for one in values[name])]
    with (
        patch.object(messages, "_PART_MESSAGES", count),
        patch.object(messages, "_PART_BYTES", size),
        patch.object(messages, "_PIECE_BYTES", piece),
        patch.object(build, "PIECE_ROWS", piece_rows),
    ):
        made, without = table_of(rows, blobs)
        found = pa.concat_tables(list(made))
    assert without == left_out
    assert found.column("message_offset").to_pylist() == list(range(len(rows)))
    assert found.column_names[7:] == [name for name in names if name not in left_out]
    for name in found.column_names[7:]:
        kind, wanted = column(values[name])
        assert (str(found.schema.field(name).type).replace("item:", "element:"), found.column(name).to_pylist()) == (
            kind,
            wanted,
        )


def test_a_channel_of_pictures_is_exported_without_holding_them(tmp_path):
    """Pictures of 40 kB: with their bytes and without, the log may be of any length."""
    random = np.random.default_rng(1)
    pictures = [random.bytes(40_000) for _ in range(8)]

    def export(count: int, blobs: bool) -> tuple[int, int]:
        rows = [{"format": "raw", "data": pictures[n % 8]} for n in range(count)]

        def work() -> None:
            made, _ = table_of(rows, blobs)
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
        patch.object(messages, "_PART_BYTES", 2**17),
        patch.object(messages, "_PIECE_BYTES", 2**18),
        patch.object(files, "_BYTES_READ", 2**18),
    ):
        for blobs in (False, True):
            few, many = export(40, blobs), export(140, blobs)
            assert sum(many) - sum(few) < 0.2 * 100 * 40_000
