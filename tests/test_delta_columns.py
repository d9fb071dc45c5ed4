"""Columns of Delta tables: names, types, which type holds which, and rows as a table has them; expected by hand."""

from __future__ import annotations

from datetime import UTC, datetime
from decimal import Decimal

import pyarrow as pa
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.tables.delta.columns import columns_of, converted, holds, joined, refuse_other_types, type_of

I8, I32, I64, U8 = pa.int8(), pa.int32(), pa.int64(), pa.uint8()
F32, F64, TEXT, RAW = pa.float32(), pa.float64(), pa.string(), pa.binary()
NS, US = pa.timestamp("ns", "UTC"), pa.timestamp("us", "UTC")


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        (U8, pa.int16()),
        (pa.uint16(), I32),
        (pa.uint32(), I64),
        (pa.uint64(), pa.decimal128(20, 0)),
        (pa.float16(), F32),
        (pa.large_string(), TEXT),
        (pa.large_binary(), RAW),
        (F64, F64),
        (pa.bool_(), pa.bool_()),
        (NS, US),
        (pa.timestamp("s"), pa.timestamp("us")),
        (pa.dictionary(I8, pa.large_string()), TEXT),
        (pa.list_(pa.null()), pa.list_(pa.field("element", TEXT))),
        (pa.large_list(pa.list_(NS)), pa.list_(pa.field("element", pa.list_(pa.field("element", US))))),
    ],
)
def test_types(given, wanted):
    assert type_of(given) == wanted
    assert type_of(wanted) == wanted


#: Types, each of which holds those before it in its line; and pairs that don't fit in either direction.
CHAINS = [[I8, pa.int16(), I32, I64, F32], [I8, I64, F64], [F32, F64, TEXT], [I64, TEXT], [pa.decimal128(9, 0), F64]]
STRANGERS = [(pa.bool_(), I8), (RAW, TEXT), (pa.list_(I8), TEXT), (US, I64), (pa.list_(I8), I8), (US, F64)]


def test_which_type_holds_which():
    for chain in CHAINS:
        for at, narrow in enumerate(chain):
            assert holds(narrow, narrow)
            for wide in chain[at + 1 :]:
                assert (holds(wide, narrow), holds(narrow, wide)) == (True, False), (wide, narrow)
                assert holds(pa.list_(wide), pa.list_(narrow))
                assert not holds(pa.list_(narrow), pa.list_(wide))
    for one, other in STRANGERS:
        assert not holds(one, other), (one, other)
        assert not holds(other, one) or pa.types.is_string(other), (one, other)
    assert holds(TEXT, pa.bool_())
    assert not holds(TEXT, pa.list_(TEXT))
    assert not holds(TEXT, RAW)


def test_names_differ_without_regard_to_case_and_words_stay():
    words = {b"description": b"width of the box", b"unit": b"px"}
    fields = [
        pa.field("w px", I64, metadata=words), pa.field("W_PX", I64, metadata={b"unit": b"m", b"more": b"x"}),
        pa.field("none", pa.null()), pa.field("w;px", F64), pa.field("Recording", TEXT), pa.field("NONE", U8),
        pa.field("a,;{}()=b\n\t", I8, metadata={b"description": b""}),
    ]  # fmt: skip
    made = columns_of(pa.schema(fields))
    assert made.names == ["recording", "w_px", "W_PX_2", "w_px_3", "Recording_2", "NONE_2", "a_______b__"]
    assert [str(kind) for kind in made.types] == ["string", "int64", "int64", "double", "string", "int16", "int8"]
    assert made.field("w_px").metadata == {b"comment": b"width of the box", b"unit": b"px"}
    assert made.field("W_PX_2").metadata == {b"unit": b"m"}
    assert not made.field("a_______b__").metadata
    assert made.field("recording").metadata[b"comment"]


def schema(**kinds: pa.DataType) -> pa.Schema:
    return pa.schema(kinds)


def test_columns_of_a_table_come_first_and_keep_their_types():
    known = schema(a=F64, b=TEXT)
    assert joined(known, [schema(c=I8, b=I64, a=I8)]) == schema(a=F64, b=TEXT, c=I8)
    assert joined(known, []) == known
    # A table that is new has the widest of the types that come.
    assert joined(None, [schema(a=I8, b=F64), schema(b=F32, a=I64, c=RAW)]) == schema(a=I64, b=F64, c=RAW)
    with pytest.raises(McaptrackError, match="its column a is double, and int64 there"):
        joined(schema(a=I64), [schema(a=F64)])
    with pytest.raises(McaptrackError, match="its column a is binary, and int64 there"):
        joined(None, [schema(a=I64), schema(a=RAW)])


def test_other_types_are_refused():
    refuse_other_types(schema(a=I64, b=TEXT), schema(b=TEXT, c=I8))
    with pytest.raises(McaptrackError, match="its column b is int8, and string there"):
        refuse_other_types(schema(b=TEXT, a=I64), schema(a=I64, b=I8))
    with pytest.raises(McaptrackError, match="its column a is int8, and int64 there"):
        refuse_other_types(schema(a=I64, b=TEXT), schema(a=I8))


def test_rows_get_the_columns_of_the_table():
    batch = pa.record_batch(
        {
            "none": pa.nulls(2),
            "n": pa.array([1, 2**32 - 1], pa.uint32()),
            "more": pa.array([7, 2**64 - 1], pa.uint64()),
            "word": pa.array(["x", "y"]).dictionary_encode(),
            "t": pa.array([1_500_000_999, None], NS),
        }
    )
    own = columns_of(batch.schema)
    table = pa.schema(
        [("t", US), ("word", TEXT), ("old", F32), ("recording", TEXT), ("more", pa.decimal128(20, 0)), ("n", F64)]
    )
    made = converted(batch, "night", own, table)
    assert made.schema == table
    assert made.to_pylist() == [
        {"t": datetime(1970, 1, 1, 0, 0, 1, 500_000, UTC), "word": "x", "old": None, "recording": "night",
         "more": Decimal(7), "n": 1.0},
        {"t": None, "word": "y", "old": None, "recording": "night", "more": Decimal(2**64 - 1), "n": 2.0**32 - 1},
    ]  # fmt: skip
