"""What a message is: the name of its type in every spelling, and its definition where a recording has none."""

from __future__ import annotations

import json
import re
import struct
import time
from itertools import cycle, product
from pathlib import Path

import numpy as np
import pytest
import zstandard
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import mcaptrack
from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.schema.names import plain_name
from mcaptrack.sources import foreign
from mcaptrack.sources.calibrations import holds_calibrations, read_calibrations
from mcaptrack.sources.fixed_frame import holds_transforms, named_detections, read_frames
from mcaptrack.sources.foreign import definitions
from mcaptrack.sources.foreign.definitions import MessageType, defined, definitions_of
from mcaptrack.sources.foreign.flatten import flattener, message_type_of
from tests.box_reading import boxes_in
from tests.commands import call
from tests.logs import recorder
from tests.tiers import one_in, thorough
from tests.undefined import T0, message, names_no_definitions, package, store_of

#: How one type is written: ROS 2, ROS 1, IDL, DDS, Python, and with what writers put before it.
SPELLINGS = {
    "ROS 2": "{}/msg/{}", "ROS 1": "{}/{}", "IDL": "{}::msg::{}", "global IDL": "::{}::msg::{}",
    "DDS": "{}::msg::dds_::{}_", "Python": "{}.msg.{}", "slash": "/{}/msg/{}",
}  # fmt: skip


#: What asks for a type, with a type that it reads, and what it gives for a channel of it.
def in_space(opened: log.Log) -> list:
    """The boxes in space of the messages of /t."""
    return [message.boxes for message in boxes_in(opened, "/t")]


ASKS = {
    "raw pictures": ("sensor_msgs/Image", lambda opened: [p.data for _, p in foreign.pictures(opened, "/t")]),
    "compressed pictures": (
        "sensor_msgs/CompressedImage",
        lambda opened: [p.format for _, p in foreign.pictures(opened, "/t")],
    ),
    "pictures of Foxglove": (
        "foxglove_msgs/CompressedImage",
        lambda opened: [p.format for _, p in foreign.pictures(opened, "/t")],
    ),
    "boxes": (
        "vision_msgs/Detection2DArray",
        lambda opened: [f.rows["w_px"].tolist() for f in named_detections(opened, "/t").frames],
    ),
    "boxes in space": (
        "vision_msgs/Detection3DArray",
        in_space,
    ),
    "drawings": ("visualization_msgs/MarkerArray", in_space),
    "transforms": ("tf2_msgs/TFMessage", lambda opened: read_frames(opened).topics),
    "transforms of ROS 1": ("tf/tfMessage", lambda opened: read_frames(opened).topics),
    "calibrations": (
        "sensor_msgs/CameraInfo",
        lambda opened: [c.frame_id for _, c in read_calibrations(opened, "/t", False)],
    ),
}
HOLDS = (
    lambda opened, channel: foreign.holds_pictures(channel),
    lambda opened, channel: foreign.holds_boxes(opened, channel.topic, in_space=False),
    lambda opened, channel: foreign.holds_boxes(opened, channel.topic, in_space=True),
    lambda opened, channel: holds_transforms(channel),
    lambda opened, channel: holds_calibrations(channel),
)
_IDL = {"bool": "boolean", "byte": "octet", "float32": "float", "float64": "double"}


def as_idl(types: dict, is_dds: bool) -> str:
    """Definitions in IDL, as ROS 2 has them or as DDS does: with a module more, and an underscore after each name."""
    done: list[str] = []
    end = "_" if is_dds else ""

    def written(kind) -> tuple[str, str]:
        node, inner = kind
        if node == Nodetype.NAME:
            place, name = inner.rsplit("/", 1)
            return "::".join([*place.split("/"), *(["dds_"] if is_dds else []), name + end]), ""
        if node == Nodetype.BASE:
            return _IDL.get(inner[0], inner[0]), ""
        member = written(inner[0])[0]
        return (member, f"[{inner[1]}]") if node == Nodetype.ARRAY else (f"sequence<{member}>", "")

    def add(name: str, out: list[str]) -> None:
        if name in done:
            return
        done.append(name)
        lines = []
        for field, kind in types[name][1]:
            inner = kind
            while inner[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                inner = inner[1][0]
            if inner[0] == Nodetype.NAME:
                add(inner[1], out)
            word, size = written(kind)
            lines.append(f"{word} {field}{end}{size};")
        pieces = name.split("/")
        modules = [*pieces[:-1], *(["dds_"] if is_dds else [])]
        out.append(
            "".join(f"module {module} {{ " for module in modules)
            + f"struct {pieces[-1]}{end} {{ {' '.join(lines)} }};"
            + " };" * len(modules)
        )

    out: list[str] = ["// made by a tool\n#include <other.idl>\n"]
    add(next(iter(types)), out)
    return "\n".join(out)


def write(path: Path, name: str, encoding: str, definition: str, payloads: list[bytes], word: str = "cdr") -> Path:
    with recorder(path, "ros2") as writer:
        channel = writer.add_channel("/t", (name, encoding, definition.encode()), word)
        for number, payload in enumerate(payloads):
            writer.add_message(channel, T0 + number * 100_000_000, payload, T0)
    return path


def answers(path: Path, asked) -> tuple:
    with log.read(path) as opened:
        channel = opened.channel("/t")
        kinds = [holds(opened, channel) for holds in HOLDS]
        return kinds, asked(opened)


def rows(path: Path) -> list:
    """The values of all fields of all messages, in order, whatever the fields are called."""
    with log.read(path) as opened:
        read = flattener(message_type_of(opened, "/t"))
        return [re.sub(r"'\w+': |[{}]", "", repr([*read(found.payload).values()])) for found in opened.messages("/t")]


@pytest.mark.parametrize("kind", one_in(4, ASKS))
def test_a_type_is_the_same_in_every_spelling(tmp_path, kind):
    """For everything that asks for a type, and for every way in which its definition is written."""
    name, asked = ASKS[kind]
    types, payloads = message(name)
    text = names_no_definitions(types)
    wanted = answers(write(tmp_path / "a.mcap", name, "ros2msg", text, payloads), asked)
    assert any(wanted[0])
    assert wanted[1]
    read = rows(tmp_path / "a.mcap")
    written = [
        ("ros2msg", text),
        ("ros2msg", text.replace("\n", "\r\n").replace("=" * 80, "=" * 79)),
        ("ros2idl", as_idl(types, False)),
        ("omgidl", as_idl(types, False)),
        ("omgidl", as_idl(types, True)),
        ("ros2msg", as_idl(types, False)),  # of a writer that says what it isn't
    ]
    spelt = [spelling.format(*name.split("/")) for spelling in SPELLINGS.values()]
    assert {plain_name(one) for one in spelt} == {plain_name(name)}
    for one, (encoding, definition) in [
        *zip(spelt, cycle(written), strict=False),
        *((spelt[4], way) for way in written),
    ]:
        path = write(tmp_path / "b.mcap", one, encoding, definition, payloads)
        assert answers(path, asked) == wanted, (one, encoding)
        assert rows(path) == read, (one, encoding)


@pytest.mark.parametrize(
    ("name", "plain"),
    {
        "mcaptrack.Tracks": "mcaptrack.Tracks", "my.robot.v1.Pose": "my.robot.v1.Pose", "robot.Pose": "robot.Pose",
        "": "", "Pose": "Pose", "a b/msg/c": "a b/msg/c", "x/srv/Y_Request": "x/srv/Y_Request",
        ".foxglove.RawImage": "foxglove.RawImage", "foxglove::RawImage": "foxglove.RawImage",
        "foxglove/RawImage": "foxglove.RawImage",
    }.items(),
)  # fmt: skip
def test_names_that_are_none_of_ros_stay(name, plain):
    assert plain_name(name) == plain


def test_what_idl_alone_has_is_read(tmp_path):
    """Enumerations are whole numbers of 32 bits, or of as many as they say; a schema may call its type otherwise."""
    idl = """
        module robot_msgs { module msg {
          /* how it moves { } enum Gait { */
          @verbatim (language="comment", text="as enum Gait { A };")
          struct Unused { long x; // }
          };
          enum Gait { STANDS, WALKS @default_literal };
          @bit_bound(8) enum Mood { GOOD, BAD };
          typedef double Row[3];
          const long SIZE = 2;
          struct State { Gait gait; Mood mood; string<20> name; Row row; sequence<octet, 4> data; Gait gaits[SIZE]; };
        }; };
    """
    body = b"\1\0\0\0" + b"\1\0\0\0" + b"\3\0\0\0ab\0" + b"\0" + np.array([1.0, 2, 3], "<f8").tobytes()
    assert len(body) % 8 == 0
    body += b"\2\0\0\0\7\x08" + b"\0\0" + b"\0\0\0\0\1\0\0\0"
    for name in ("robot_msgs::msg::State", "other_msgs/msg/State", "State_"):
        path = write(tmp_path / "a.mcap", name, "omgidl", idl.replace(" @default_literal", ""), [b"\0\1\0\0" + body])
        with mcaptrack.open(path) as recording:
            (found,) = (each.decoded for each in recording.messages("/t"))
        assert (found.gait, found.mood, found.name, found.row.tolist()) == (1, 1, "ab", [1, 2, 3])
        assert (found.data.tolist(), found.gaits.tolist()) == ([7, 8], [0, 1])


@pytest.mark.parametrize(
    ("idl", "why"),
    {
        "module a { module msg { union U switch (long) { case 1: long x; }; struct B { U u; }; }; };": "union",
        "module a { module msg { struct B { @optional long x; }; }; };": "@optional",
        "module a { module msg { @mutable struct B { long x; }; }; };": "@mutable",
        "module a { module msg { struct C { long x; }; struct D { long x; }; }; };": "it defines a/msg/C, a/msg/D",
        "module a { module msg { struct B { other::msg::C c; }; }; };": "other/msg/C is not defined",
    }.items(),
)
def test_what_is_not_read_of_idl_is_named(tmp_path, idl, why):
    path = write(tmp_path / "a.mcap", "a/msg/B", "omgidl", idl, [b"\0\1\0\0" + bytes(8)])
    with mcaptrack.open(path) as recording, pytest.raises(McaptrackError, match=why) as error:
        list(recording.messages("/t"))
    assert "\n" not in str(error.value)


# Recordings without definitions


DISTRIBUTIONS = [store for store in Stores if store.value.startswith("ros2_")]


@pytest.mark.parametrize(
    ("distribution", "name"),
    one_in(9, product(DISTRIBUTIONS, ["visualization_msgs/MarkerArray", "vision_msgs/Detection2DArray"])),
)
def test_the_definition_is_taken_that_the_messages_fit(tmp_path, name, distribution):
    """As the distribution has it that wrote them, whatever the newest one has: each field has the value it had."""
    types, payloads = message(name, distribution)
    ros2 = "{}/msg/{}".format(*name.split("/"))
    bare = write(tmp_path / "c.mcap", ros2, "ros2msg", "", payloads)
    with collected() as warnings:
        mcaptrack.ingest(bare, tmp_path / "a.mcap")
    assert not warnings
    whole = write(tmp_path / "b.mcap", ros2, "ros2msg", names_no_definitions(types), payloads)
    assert rows(tmp_path / "a.mcap") == rows(whole)
    with collected() as warnings:
        assert rows(bare) == rows(whole)
    assert [warning.code for warning in warnings] == ["definitions"]
    assert "does not say what" in warnings[0].message
    assert "which fits its messages" in warnings[0].message


@thorough
def test_of_definitions_that_fit_alike_that_of_the_distribution_is_taken():
    """Messages without any boxes fit each definition: the guess is said, with the others."""
    empty = b"\0\1\0\0" + bytes(4)
    kind = MessageType("visualization_msgs/msg/MarkerArray", "", b"", "cdr")
    newest, foxy = defined(kind, [empty] * 3), defined(kind, [empty] * 3, "foxy")
    assert "texture_resource" in newest.kind.schema.decode()
    assert "texture_resource" not in foxy.kind.schema.decode()
    assert foxy.doubts.startswith(
        "its definition is a guess, that of ROS 2 Foxy to Galactic: its messages also fit that of "
    )
    types, payloads = message("visualization_msgs/MarkerArray", Stores.ROS2_HUMBLE)
    sure = defined(kind, [empty] * 30 + payloads, "foxy")
    assert sure.doubts == ""
    assert "texture_resource" in sure.kind.schema.decode()
    _, old = message("visualization_msgs/MarkerArray", Stores.ROS2_FOXY)
    mixed = defined(kind, payloads * 3 + old)
    assert f"it fits {3 * len(payloads)} of {4 * len(payloads)} messages" in mixed.doubts
    assert types["visualization_msgs/msg/MarkerArray"]


def test_a_folder_of_definitions_comes_before_those_of_ros(tmp_path):
    folder, name, payloads = package(tmp_path)
    bare = write(tmp_path / "a.mcap", name, "ros2msg", "", payloads)
    with collected() as warnings, log.read(bare) as opened, pytest.raises(McaptrackError, match="can't be read"):
        named_detections(opened, "/t")
    assert "its definition is not known, and that of ROS 2" in warnings[0].message
    assert "`definitions=`" in warnings[0].message
    flat = tmp_path / "flat"
    flat.mkdir()
    for path in folder.rglob("*.msg"):
        (flat / path.name).write_bytes(path.read_bytes())
    as_files = tmp_path / "idl"
    as_files.mkdir()
    types = get_types_from_msg((flat / "Detection2DArray.msg").read_text(), "vision_msgs/msg/Detection2DArray")
    store = get_typestore(Stores.ROS2_HUMBLE)
    known, _ = message("vision_msgs/Detection2DArray", Stores.ROS2_HUMBLE)
    (as_files / "Detection2DArray.idl").write_text(as_idl(types | store.fielddefs | known | types, False))
    for place in (folder, folder / "vision_msgs", flat, as_files):
        with collected() as warnings, definitions_of(place), log.read(bare) as opened:
            frames = named_detections(opened, "/t").frames
        assert [frame.rows["w_px"].tolist() for frame in frames] == [[20.0]] * len(payloads)
        (warning,) = [warning for warning in warnings if warning.code == "definitions"]
        assert warning.message.endswith(f"its definition is that in {place}, which fits its messages")


def test_the_option_is_one_of_every_command_that_reads_messages(tmp_path):
    folder, name, payloads = package(tmp_path)
    bare = write(tmp_path / "bare.mcap", name, "ros2msg", "", payloads)
    outcome = call("ingest", bare, "-o", tmp_path / "a.mcap", "--definitions", folder)
    assert outcome.code == 0, outcome
    with log.read(tmp_path / "a.mcap") as opened:
        assert len(named_detections(opened, "/t").frames) == len(payloads)
    for line in (["run"], ["export"]):
        outcome = call(*line, bare, "--topic", "/t", "--definitions", folder, "-o", tmp_path / f"{line[0]}.mcap")
        assert outcome.code == 0, outcome
        assert "which fits its messages" in outcome.err
    (tmp_path / "empty").mkdir()
    for wrong, why in (
        (tmp_path / "none", ": no folder, and not one of "),
        (tmp_path / "empty", ", which has no .msg"),
    ):
        outcome = call("run", bare, "--definitions", wrong)
        assert outcome.code == 1
        assert f"--definitions names {wrong}{why}" in outcome.err


WRONG = {
    "a type that nothing defines": (
        b"std_msgs/Header header\nlost_msgs/Thing thing\n",
        "lost_msgs/msg/Thing is not defined",
    ),
    "itself": (b"vision_msgs/Detection2DArray again\n", "maximum recursion depth exceeded"),
    "no definition": (b"\xff\xfe\0", "can't be read as a definition"),
    "too long": (b"uint8 x\n" * 200_000, "at most 1048576 are read"),
    "a union": (
        b"module a { module msg { union U switch (long) { case 1: long x; }; }; };",
        "union of IDL is not read",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_definition_of_the_user_that_is_none_is_refused(tmp_path, name):
    text, why = WRONG[name]
    (tmp_path / "defs").mkdir()
    (tmp_path / "defs" / "Detection2DArray.msg").write_bytes(text)
    _, payloads = message("vision_msgs/Detection2DArray")
    bare = write(tmp_path / "bare.mcap", "vision_msgs/msg/Detection2DArray", "ros2msg", "", payloads)
    outcome = call("run", bare, "--topic", "/t", "--definitions", tmp_path / "defs")
    assert (outcome.code, outcome.err.count("\n")) == (1, 1), outcome
    assert why in outcome.err


def test_a_distribution_is_named():
    """Messages without any boxes fit all, and are of the one that the user says."""
    kind = MessageType("visualization_msgs/msg/MarkerArray", "", b"", "cdr")
    with definitions_of("Foxy"):
        found = defined(kind, [b"\0\1\0\0" + bytes(4)] * 3)
    assert (found.origin, found.doubts) == ("that of ROS 2 Foxy, which fits its messages", "")
    _, payloads = message("visualization_msgs/MarkerArray", Stores.ROS2_HUMBLE)
    with definitions_of("foxy"):
        found = defined(kind, payloads)
    assert found.doubts.startswith("its definition is not known, and that of ROS 2 Foxy doesn't fit its messages")


def test_a_log_without_definitions_has_them_after_it_is_ingested(tmp_path):
    """All else stays as it was; a log that has its definitions is copied chunk by chunk."""
    types, payloads = message("vision_msgs/Detection2DArray", Stores.ROS2_FOXY)
    bare = write(tmp_path / "bare.mcap", "vision_msgs/msg/Detection2DArray", "ros2msg", "", payloads)
    with collected() as warnings:
        mcaptrack.ingest(bare, tmp_path / "a.mcap")
    with collected() as later, log.read(tmp_path / "a.mcap") as opened:
        assert [found.payload for found in opened.messages("/t")] == payloads
        assert len(named_detections(opened, "/t").frames) == len(payloads)
        (schema,), (channel,) = opened.index.schemas.values(), opened.channels.values()
    assert warnings + [each for each in later if each.code == "definitions"] == []
    assert b"is_tracking" in schema.data
    said = "that of ROS 2 Dashing to Foxy, which fits its messages"
    assert channel.metadata == {"mcaptrack.definition": said}
    assert types


def test_messages_that_are_compressed_one_by_one_are_read_as_others_are(tmp_path):
    """As rosbag2 writes them with `compression_mode: message`, where nothing but the messages says so."""
    types, payloads = message("vision_msgs/Detection2DArray")
    text = names_no_definitions(types)
    whole = write(tmp_path / "whole.mcap", "vision_msgs/msg/Detection2DArray", "ros2msg", text, payloads)
    packed = [zstandard.compress(payload) for payload in payloads]
    path = write(tmp_path / "packed.mcap", "vision_msgs/msg/Detection2DArray", "ros2msg", text, packed)
    asked = ASKS["boxes"][1]
    assert answers(path, asked) == answers(whole, asked)
    assert rows(path) == rows(whole)
    mcaptrack.ingest(path, tmp_path / "made.mcap")
    with log.read(tmp_path / "made.mcap") as opened:
        assert [found.payload for found in opened.messages("/t")] == payloads
    with pytest.raises(McaptrackError, match="are compressed one by one"):
        mcaptrack.track(path, topic="/t", sidecar=False, progress=lambda *_: pytest.fail("it computes before"))
    write(tmp_path / "cut.mcap", "vision_msgs/msg/Detection2DArray", "ros2msg", text, [packed[0][:-4]])
    with log.read(tmp_path / "cut.mcap") as opened, pytest.raises(McaptrackError, match="at 1700000000000000000 ns"):
        asked(opened)


def test_a_type_with_a_name_in_other_letters_is_the_same(tmp_path):
    types, payloads = message("vision_msgs/Detection2DArray", Stores.ROS2_FOXY)
    bare = write(tmp_path / "bare.mcap", "vision_msgs::msg::dds_::Detection2DArray_", "", "", payloads)
    mcaptrack.ingest(bare, tmp_path / "a.mcap")
    with log.read(tmp_path / "a.mcap") as opened:
        assert len(named_detections(opened, "/t").frames) == len(payloads)
    assert types


@pytest.mark.parametrize(
    ("number", "name"), [(3, "PL_CDR"), (7, "XCDR2"), (9, "delimited XCDR2"), (11, "PL_CDR of XCDR2")]
)
def test_other_encodings_of_dds_are_named(tmp_path, number, name):
    types, payloads = message("vision_msgs/Detection2DArray")
    other = bytes([0, number]) + payloads[0][2:]
    path = write(
        tmp_path / "a.mcap", "vision_msgs/msg/Detection2DArray", "ros2msg", names_no_definitions(types), [other]
    )
    with (
        log.read(path) as opened,
        pytest.raises(McaptrackError, match=f"its bytes are {name}; CDR of version 1 is read"),
    ):
        named_detections(opened, "/t")


def test_messages_of_either_byte_order_are_read(tmp_path):
    """Also where the definition has to be found by them."""
    types, _ = message("vision_msgs/Detection2DArray")
    store = store_of(Stores.ROS2_HUMBLE)
    name = "vision_msgs/msg/Detection2DArray"
    first = store.deserialize_cdr(message("vision_msgs/Detection2DArray")[1][0], name)
    both = [bytes(store.serialize_cdr(first, name, little_endian=little)) for little in (True, False)]
    assert both[0] != both[1]
    for text in ("", names_no_definitions(types)):
        one, other = rows(write(tmp_path / "a.mcap", name, "ros2msg", text, both))
        assert one == other


@pytest.mark.parametrize("spelling", SPELLINGS.values(), ids=SPELLINGS)
def test_names_are_the_same_in_every_encoding(tmp_path, spelling):
    """JSON of bridges, ROS 1, and protobuf: also where its name begins with a dot, as descriptors write it."""
    asked = ASKS["compressed pictures"][1]
    head = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "eye"}
    data = json.dumps({"header": head, "format": "png", "data": [1, 2]}).encode()
    name = spelling.format("sensor_msgs", "CompressedImage")
    assert answers(write(tmp_path / "a.mcap", name, "jsonschema", "{}", [data], "json"), asked)[1] == ["png"]
    text = "std_msgs/Header header\nstring format\nuint8[] data\n" + "=" * 80 + "\nMSG: std_msgs/Header\n"
    text += "uint32 seq\ntime stamp\nstring frame_id\n"
    ros1 = struct.pack("<4I3sI3sI2s", 7, 1, 2, 3, b"eye", 3, b"png", 2, b"ab")
    assert answers(write(tmp_path / "b.mcap", name, "ros1msg", text, [ros1], "ros1"), asked)[1] == ["png"]
    proto = foxglove.message_class(foxglove.IMAGE)(format="png", data=b"ab").SerializeToString()
    for of_foxglove in (foxglove.IMAGE, f".{foxglove.IMAGE}", spelling.format("foxglove_msgs", "CompressedImage")):
        path = tmp_path / "c.mcap"
        with recorder(path) as writer:
            schema = writer.register_schema(of_foxglove, "protobuf", foxglove.schema_record(foxglove.IMAGE)[2])
            writer.add_message(writer.register_channel("/t", "protobuf", schema), T0, proto, T0)
        with log.read(path) as opened:
            assert asked(opened) == ["png"]


@pytest.mark.parametrize(
    "text",
    [
        "# " * 300_000 + "x",
        "\n" * 600_000 + "x",
        "/*" * 300_000,
        '"\\' * 300_000,
        "module a {" + "enum E {" * 100_000,
        "=" * 900_000,
    ],
    ids=["comments", "lines", "open comments", "open texts", "open enumerations", "a rule"],
)
def test_a_hostile_definition_takes_one_pass(text):
    """A pass takes milliseconds, and one for each character would take hours."""
    before = time.process_time()
    definitions._IDL.match(text)
    for pattern in (definitions._IDL_TEXT, definitions._IDL_ENUM, definitions._SEPARATOR):
        pattern.sub("", text)
    assert time.process_time() - before < 20
