"""Tables as text, and fields of recorded messages as columns, at their limits."""

from __future__ import annotations

import csv
import io
import json
import math

import numpy as np
import pyarrow as pa
import pytest

from mcaptrack.tables import text
from mcaptrack.tables.build import Pointers
from mcaptrack.tables.messages import messages_table


@pytest.mark.parametrize("count", [0, 1, 3, 4, 5, 8, 9])
def test_a_table_is_written_in_pieces_that_lack_nothing(count, monkeypatch):
    monkeypatch.setattr(text, "_PIECE", 4)
    values = {"n": list(range(count)), "word": [f'"{n}", é' for n in range(count)], "x": [n / 4 for n in range(count)]}
    table = pa.table(values)
    pieces = list(text.csv(table))
    assert len(pieces) == max(1, math.ceil(count / 4))
    head, *rows = csv.reader(io.StringIO(b"".join(pieces).decode()))
    assert head == ["n", "word", "x"]
    assert [(int(n), word, float(x)) for n, word, x in rows] == list(zip(*values.values(), strict=True))
    assert [json.loads(line) for line in text.json_lines(table)] == table.to_pylist()


def column(*values: object) -> pa.ChunkedArray:
    """The column that a field with these values becomes."""
    places = Pointers("a.mcap", *(np.arange(len(values)) for _ in range(5)))
    pieces, _ = messages_table("/t", "s", places, [{("a",): value} for value in values], blobs=True)
    return pa.concat_tables(pieces).column("a")


@pytest.mark.parametrize(
    ("values", "kind", "wanted"),
    [
        ([True, False], "bool", [True, False]),
        ([1, None], "int64", [1, None]),
        ([-(2**63), 2**63 - 1], "int64", None),
        ([0, 2**63], "uint64", None),
        ([2**64 - 1], "uint64", None),
        ([-1, 2**63], "string", ["-1", str(2**63)]),
        ([2**64], "string", [str(2**64)]),
        ([-(2**63) - 1], "string", [str(-(2**63) - 1)]),
        ([1, 0.5], "double", [1.0, 0.5]),
        ([2**53, -(2**53), 0.5], "double", None),
        ([2**53 + 1, 0.5], "string", [str(2**53 + 1), "0.5"]),
        ([-(2**53) - 1, 0.5], "string", [str(-(2**53) - 1), "0.5"]),
        ([True, 1], "string", ["true", "1"]),
        (["é", "b"], "string", None),
        (["é", 1], "string", ['"é"', "1"]),
        ([b"\x01\xff"], "binary", None),
        ([b"\x01\xff", 1], "string", ['"01ff"', "1"]),
        ([[1, 2], [], None], "list<item: int64>", [[1, 2], [], None]),
        ([[1], [0.5]], "list<item: double>", [[1.0], [0.5]]),
        ([[1], ["a"]], "string", ["[1]", '["a"]']),
        ([[1], 2], "string", ["[1]", "2"]),
        ([["\ud800é"]], "list<item: string>", [["?é"]]),
        ([None, None], "double", None),
    ],
)
def test_a_field_becomes_the_narrowest_column_that_holds_all_its_values(values, kind, wanted):
    found = column(*values)
    assert str(found.type).replace("element", "item") == kind
    assert found.to_pylist() == (values if wanted is None else wanted)


def test_fields_of_bytes_are_left_out_unless_they_are_wanted():
    places = Pointers("a.mcap", *(np.arange(3) for _ in range(5)))
    rows = [{("a", "b"): b"x", ("T",): 1}, {("a", "b"): None, ("c_ns",): 5}, {("c_ns",): 7}]
    for blobs in (False, True):
        pieces, left_out = messages_table("/t", "", places, rows, blobs=blobs)
        table = pa.concat_tables(pieces)
        assert left_out == ([] if blobs else ["a.b"])
        assert table.column_names[-2 - blobs :] == [*["a_b"][: int(blobs)], "T_2", "c_ns"]  # t is the time
        assert table.column("T_2").to_pylist() == [1, None, None]
        assert table.column("c_ns").to_pylist() == [None, 5, 7]
        words = table.schema.field("c_ns").metadata
        assert words == {b"unit": b"ns", b"description": b"field c_ns of the message", b"path": b"c_ns"}
