"""The row schemas, the codec and the gate."""

from __future__ import annotations

import hashlib
import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from grpc_tools import protoc
from hypothesis import given
from hypothesis import strategies as st

from mcaptrack.schema import DETECTIONS, EVENTS, SCHEMAS, TRACKS
from mcaptrack.schema.as_rows import is_motion
from mcaptrack.schema.codec import RowCodec
from mcaptrack.schema.proto import KINDS, parse
from mcaptrack.schema.provenance import Plugin, Provenance, digest
from tests.strategies import columns

ALL = st.sampled_from(sorted(SCHEMAS.values(), key=lambda schema: schema.name))
FOLDER = Path(__file__).parent.parent / "schemas"


def same(a: np.ndarray, b: np.ndarray) -> bool:
    """Equal to the bit, NaN included."""
    return a.dtype.names == b.dtype.names and all(a[n].tobytes() == b[n].tobytes() for n in a.dtype.names)


@pytest.mark.parametrize("schema", SCHEMAS.values(), ids=str)
def test_descriptors_are_what_protoc_makes_of_the_files(schema, tmp_path):
    file, out = FOLDER / f"{schema.name.rpartition('.')[2]}.proto", tmp_path / "out"
    assert protoc.main(["", f"-I{FOLDER}", f"--descriptor_set_out={out}", str(file)]) == 0
    compiled = FileDescriptorSet.FromString(out.read_bytes())
    ours = FileDescriptorSet.FromString(schema.descriptor)
    compiled.file[0].name = ours.file[0].name  # the folder it lies in is no matter
    for files in (ours, compiled):  # nor whether the names in JSON are spelt out
        message = files.file[0].message_type[0]
        for field in [*message.field, *message.nested_type[0].field]:
            field.ClearField("json_name")
    assert ours == compiled


@given(st.data())
def test_rows_survive_the_wire_to_the_bit(data):
    schema = data.draw(ALL)
    rows = schema.rows(**data.draw(columns(schema)))
    assert same(schema.codec.decode(schema.codec.encode(rows)), rows)


@given(st.data())
def test_we_read_what_the_protobuf_runtime_writes(data):
    schema = data.draw(ALL)
    rows = schema.rows(**data.draw(columns(schema)))
    message = schema.codec.message_class()
    for row in rows:
        added = message.rows.add()
        for column in schema.columns:
            value = row[column.name].item()
            if not (column.optional and (np.isnan(value) or (value == -1 and isinstance(value, int)))):
                setattr(added, column.name, value)  # a default value that is not optional is left out on the wire
    read = schema.codec.decode(message.SerializeToString())
    for column in schema.columns:
        np.testing.assert_array_equal(read[column.name], rows[column.name])


@given(st.data())
def test_a_channel_is_its_messages_laid_end_to_end(data):
    schema = data.draw(ALL)
    parts = [schema.rows(**data.draw(columns(schema))) for _ in range(data.draw(st.integers(0, 4)))]
    payloads = [schema.codec.encode(part) for part in parts]
    ends = np.cumsum([0, *(len(part) for part in parts)])
    assert [*schema.codec.encode_each(np.concatenate([schema.empty(), *parts]), ends)] == payloads
    rows, counts = schema.codec.decode_all(payloads)
    assert counts.tolist() == [len(part) for part in parts]
    assert same(rows, np.concatenate([schema.empty(), *parts]))
    between = b"--".join([b"", *payloads, b""])  # as in a chunk, with other records between them
    end = np.cumsum([2 + len(payload) for payload in payloads], dtype=np.int64)
    start = end - np.array([len(payload) for payload in payloads], np.int64)
    decoded = schema.codec.decode_at(np.frombuffer(between, np.uint8), start, end)
    assert decoded is not None
    assert same(decoded[0], rows)
    assert decoded[1].tolist() == counts.tolist()


def test_a_writer_that_leaves_defaults_out_is_read_between_others():
    ours = TRACKS.rows(track_id=[5], x_m=[1.5], y_m=[2.5], observed=[True], source_id=[7])
    message = TRACKS.codec.message_class()
    message.rows.add(x_m=3.0)
    rows, counts = TRACKS.codec.decode_all([TRACKS.codec.encode(ours), message.SerializeToString(), b""])
    assert counts.tolist() == [1, 1, 0]
    assert rows["x_m"].tolist() == [1.5, 3.0]
    assert rows["track_id"].tolist() == [5, 0]
    assert np.isnan(rows["y_m"][1])
    for payload in (TRACKS.codec.encode(ours), message.SerializeToString()):
        with pytest.raises(ValueError, match="read-only"):
            TRACKS.codec.decode(payload)["x_m"] = 1.0


@pytest.mark.parametrize("schema", SCHEMAS.values(), ids=str)
def test_a_bool_written_as_another_number_is_read_as_the_byte_1(schema):
    """NumPy takes every byte but 0 for true, but only 1 is the opposite of false: ~ of a byte 2 is true as well."""
    flags = [column.name for column in schema.columns if column.kind == "bool"]
    two = schema.empty(2)
    for name in (column.name for column in schema.columns if column.since):
        two[name] = 1  # so that the message has all columns
    payload = bytearray(schema.codec.encode(two))
    for name in flags:
        payload[schema.dtype.fields[name][1]] = 2  # in the first of two rows
    raw = np.frombuffer(bytes(payload), np.uint8)
    read = [schema.codec.decode(bytes(payload)), schema.codec.decode_all([bytes(payload)])[0]]
    for name in flags:
        assert schema.codec.decode_at(raw, np.array([0]), np.array([len(raw)])) is None
        for rows in read:
            assert np.ascontiguousarray(rows[name]).view(np.uint8).tolist() == [1, 0]
            assert (~rows[name]).tolist() == [False, True]


@pytest.mark.parametrize("schema", SCHEMAS.values(), ids=str)
def test_the_gate_lets_whole_numbers_in_up_to_the_ends_of_their_range(schema):
    for column in schema.columns:
        if schema.dtype[column.name].kind not in "iu":
            continue
        bits, signed = 8 * schema.dtype[column.name].itemsize, schema.dtype[column.name].kind == "i"
        low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
        others = {c.name: np.zeros(1, schema.dtype[c.name]) for c in schema.columns if c is not column}
        for value in (low, high):
            assert schema.rows(**others, **{column.name: np.array([value])})[column.name].tolist() == [value]
        for value in (low - 1, high + 1):
            words = f"{schema.name}.{column.name} holds {low} to {high}, not {value}"
            if -(2**63) <= value < 2**64:  # further numbers are no whole numbers to NumPy
                with pytest.raises(ValueError, match=re.escape(words)):
                    schema.rows(**others, **{column.name: np.array([value])})
                two = {name: np.repeat(values, 2) for name, values in others.items()}
                for among in ([value, 1], [1, value]):
                    with pytest.raises(ValueError, match=re.escape(words)):
                        schema.rows(**two, **{column.name: np.array(among, np.array([value]).dtype)})
            else:
                with pytest.raises(ValueError, match="needs whole numbers"):
                    schema.rows(**others, **{column.name: np.array([value])})


@given(st.integers(1, 40), st.data())
def test_wide_rows_and_high_field_numbers_are_written_as_by_the_protobuf_runtime(count, data):
    """Lengths and tags above 127 take two bytes."""
    numbers = sorted(data.draw(st.sets(st.integers(1, 5000), min_size=count, max_size=count)))
    kinds = data.draw(st.lists(st.sampled_from(sorted(KINDS)), min_size=count, max_size=count))
    text = "".join(f"{kind} c{number} = {number};\n" for kind, number in zip(kinds, numbers, strict=True))
    codec = RowCodec(
        parse(f"package p;\nmessage A {{\nmessage Row {{\n{text}}}\nrepeated Row rows = 1;\n}}", "a.proto")
    )
    rows = np.zeros(2, codec.dtype)
    for number in numbers:
        rows[f"c{number}"] = [1, number % 2]
    message = codec.message_class()
    message.ParseFromString(codec.encode(rows))
    for number in numbers:
        assert [getattr(row, f"c{number}") for row in message.rows] == [1, number % 2]
    read = codec.decode(codec.encode(rows))
    assert all(read[name].tolist() == rows[name].tolist() for name in read.dtype.names)


def test_messages_without_later_columns_are_those_of_the_first_version_to_the_byte():
    """Tag and value of each column by hand; the length of a row below 128 is one byte."""

    def row(*fields: tuple[str, int, float]) -> bytes:
        tags = {"d": 1, "q": 1, "f": 5, "I": 5, "?": 0}
        body = b"".join(bytes([n << 3 | tags[kind]]) + struct.pack(f"<{kind}", value) for kind, n, value in fields)
        return bytes([0x0A, len(body)]) + body

    box = {"x_px": [1.5], "y_px": [2.0], "w_px": [3.0], "h_px": [4.0], "score": [0.5], "class_id": [7]}
    by_hand = [("d", 1, 1.5), ("d", 2, 2.0), ("d", 3, 3.0), ("d", 4, 4.0), ("f", 5, 0.5), ("I", 6, 7)]
    encode = DETECTIONS.codec.encode
    assert encode(DETECTIONS.rows(**box)) == row(*by_hand)
    assert encode(DETECTIONS.rows(**box, people=[3])) == row(*by_hand, ("I", 7, 3))
    nothing = -DETECTIONS.rows(**box)["x_m"]  # a NaN of another sign is missing, too
    assert encode(DETECTIONS.rows(**box, x_m=nothing, y_m=nothing, source_id=[-1])) == row(*by_hand)
    assert len(encode(DETECTIONS.rows(**box, source_id=[0]))) > len(row(*by_hand)) + 80
    tracks = TRACKS.rows(track_id=[9], x_m=[1.5], y_m=[2.0], observed=[True], source_id=[-1])
    boxless = [("d", n, float("nan")) for n in (2, 3, 4, 5)]
    assert TRACKS.codec.encode(tracks) == row(
        ("q", 1, 9), *boxless, ("d", 6, 1.5), ("d", 7, 2.0), ("f", 8, float("nan")), ("?", 9, True), ("q", 10, -1)
    )


def test_bytes_that_are_no_message_are_refused():
    with pytest.raises(ValueError, match=r"5 bytes are not a mcaptrack\.Tracks message"):
        TRACKS.codec.decode(b"\x0a\xff\xff\xff\xff")


NAN = float("nan")
BOX = {"x_px": [1.0], "y_px": [1.0], "w_px": [1.0], "h_px": [1.0], "class_id": [1]}
NO_BOX = dict.fromkeys(("x_px", "y_px", "w_px", "h_px"))
LACKS_ALL = "needs x_px, y_px, w_px, h_px or x_m, y_m; all of these are missing"
#: What the gate says of a box with other columns, or without those that are None.
REFUSED = [
    ({"class_id": None}, " needs the column class_id"),
    ({"colour": [1]}, " has no column colour"),
    ({"x_px": [1.0, 2.0]}, " needs columns of one length"),
    ({"class_id": [1.0]}, ".class_id needs whole numbers"),
    ({"class_id": [-1]}, ".class_id holds 0 to 4294967295, not -1"),
    ({"x_px": ["a"]}, ".x_px needs numbers"),
    ({"y_px": [NAN]}, " has only a part of x_px, y_px, w_px, h_px in 1 rows, first in row 0"),
    (
        NO_BOX | {"y_m": [1.0, NAN, 2.0], "x_m": [1.0, 1.0, NAN], "class_id": [1, 1, 1]},
        " has only a part of x_m, y_m in 2 rows, first in row 1",
    ),
    (
        NO_BOX | {"x_m": [1.0, NAN], "y_m": [2.0, NAN], "z_m": [3.0, 3.0], "class_id": [1, 1]},
        f" {LACKS_ALL} in 1 rows, first in row 1",
    ),
    (NO_BOX, f" {LACKS_ALL}"),
]


def test_the_gate_names_column_and_schema():
    for changed, words in REFUSED:
        with pytest.raises(ValueError, match=f"^mcaptrack.Detections{words}"):
            DETECTIONS.rows(**{name: values for name, values in (BOX | changed).items() if values is not None})
    with pytest.raises(ValueError, match=r"mcaptrack\.Tracks\.observed needs true or false, not int64"):
        TRACKS.rows(track_id=[1], observed=[1], source_id=[1])
    rows = EVENTS.empty(1)
    with pytest.raises(ValueError, match=r"mcaptrack\.Tracks has the columns track_id, .*the rows have kind"):
        TRACKS.check(rows)
    assert EVENTS.check(rows) is rows


#: Texts that are no row schemas, and the line that says it.
WRONG_LINES = {
    "message A {\n message Row {\n string name = 1;\n }\n repeated Row rows = 1;\n}": 3,
    "import 'x';": 1,
    "package a;\npackage b;": 2,
    "package a": 1,
    "message A {\n}\nmessage B {": 3,
    "message A {\nmessage Cow {": 2,
    "message A {\nmessage Row {\nmessage Row {": 3,
    "message a {": 1,
    "message A {\nrepeated Row rows = 1;": 2,
    "message A {\nmessage Row {\nrepeated Row rows = 1;": 3,
    "message A {\nmessage Row {\n}\nrepeated Row rows = 2;": 4,
    "message A {\nfloat a = 1;": 2,
    "message A {\nmessage Row {\nfloat a = 1": 3,
    "message A {\nmessage Row {\nfloat A = 1;": 3,
    "message A {\nmessage Row {\nint32 a = 1;": 3,
    "}": 1,
}
INCOMPLETE = (
    "message A {\n message Row {\n double a = 1;\n }\n}",
    "package p;\nmessage A {\n message Row {\n double a = 2;\n double b = 1;\n }\n repeated Row rows = 1;\n}",
    "package p;\nmessage A {\nmessage Row {\ndouble a = 1;\n}\nrepeated Row rows = 1;",
    "message A {\nmessage Row {\ndouble a = 1;\n}\nrepeated Row rows = 1;\n}",
    "package p;\nmessage A {\nmessage Row {\ndouble a = 1;\nbool b = 1;\n}\nrepeated Row rows = 1;\n}",
    "",
)


def test_what_has_no_fixed_width_is_no_row_schema():
    cases = {
        text: rf"^x.proto:{line}: not a row schema \(fixed-width fields in message Row\): "
        for text, line in WRONG_LINES.items()
    }
    words = "^x.proto: a row schema needs a package, 'repeated Row rows = 1;' and rising field numbers$"
    cases |= dict.fromkeys(INCOMPLETE, words)
    text = "message A {\n message Row {\n optional bool b = 1;\n }\n repeated Row rows = 1;\n}"
    cases[text] = "only double, float, sfixed32, sfixed64 can be optional, not bool b"
    for text, words in cases.items():
        with pytest.raises(ValueError, match=words):
            parse(text, "x.proto")


def test_a_row_schema_is_read_as_it_stands():
    text = """syntax = "proto3";
// What it holds, in
//two lines.
package p.q;

message Some {
  message Row {  // no text of a column
    // neither is this
    fixed64 id_ns = 2;//at once
    optional float area_m2 = 5;   // of it

    bool ok = 7;
  }
  // nor this
  repeated Row rows = 1;
}
"""
    found = parse(text, "x.proto")
    assert (found.name, found.doc) == ("p.q.Some", "What it holds, in two lines.")
    assert [(one.name, one.kind, one.number, one.optional, one.doc, one.unit) for one in found.columns] == [
        ("id_ns", "fixed64", 2, False, "at once", "ns"),
        ("area_m2", "float", 5, True, "of it", "m^2"),
        ("ok", "bool", 7, False, "", ""),
    ]


# Provenance


def test_provenance_comes_back_from_its_metadata():
    plugins = {"transform": Plugin("own", "own:It", "pkg", "1")}
    first = ("track", {"b": 1.5, "a": None}, "/in", "d1", "d2", "w", {"/t": "d3"}, plugins, {"1": "person"}, "1", "map")
    whole = Provenance(*first, {"layout": "x"}, [["lost", "words"]], "0.0.9", {"1": "door"})
    assert Provenance.from_metadata(whole.to_metadata()) == whole
    least = Provenance("sample", {})
    assert Provenance.from_metadata(least.to_metadata() | {"other": "1", "mcaptrack.later": "2"}) == replace(
        least, warnings=[]
    )
    assert least.to_metadata().keys() == {"mcaptrack.transform", "mcaptrack.version", "mcaptrack.parameters"}
    assert Provenance.from_metadata({"mcaptrack.input": "/in", "transform": "track"}) is None


@pytest.mark.parametrize(
    ("name", "text", "wanted"),
    [
        ("warnings", '[["a", "b"], ["a"], ["a", 1], "ab", ["a", "b", "c"]]', [["a", "b"]]),
        ("warnings", '{"a": "b"}', []),
        ("classes", '{"1": "person", "2": 2}', {"1": "person"}),
        ("model", '{"a": "b", "c": null}', {"a": "b"}),
        ("references", "[" * 100_000, {}),
        ("parameters", "[1]", {}),
    ],
)
def test_what_others_wrote_as_provenance_is_read_as_far_as_it_can_be(name, text, wanted):
    made = Provenance.from_metadata({"mcaptrack.transform": "track", f"mcaptrack.{name}": text})
    assert getattr(made, name) == wanted


def test_a_digest_is_of_times_numbers_and_payloads():
    messages = [(1, 2, b"ab"), (3, 4, b"")]
    text = b"".join(struct.pack("<QQQ", t, n, len(data)) + data for t, n, data in messages)
    assert digest(messages) == hashlib.sha256(text).hexdigest()


def test_a_motion_of_a_camera_is_finite_and_can_be_inverted():
    for numbers, is_one in (
        ((1, 0, 5, 0, 1, -5), True),
        ((2e-12, 0, 0, 0, 1, 0), True),
        ((5e-13, 0, 0, 0, 1, 0), False),
        ((0, -2e-12, 0, 1, 0, 0), True),
        ((1, 2, 0, 2, 4, 0), False),
        ((1, 0, np.nan, 0, 1, 0), False),
        ((1, 0, 0, 0, 1, np.inf), False),
    ):
        assert is_motion(np.array(numbers, float).reshape(2, 3)) is is_one


@pytest.mark.parametrize("schema", SCHEMAS.values(), ids=str)
def test_no_row_may_lack_a_required_number(schema):
    names = [c.name for c in schema.columns if not c.optional and schema.dtype[c.name].kind == "f"]
    for name in names:
        given = {c.name: np.zeros(3, schema.dtype[c.name]) for c in schema.columns}
        given[name] = np.array([1.0, np.nan, 2.0])
        with pytest.raises(
            ValueError, match=f"{name} is required and missing in 1 rows, first in row 1|only a part of"
        ):
            schema.rows(**given)
