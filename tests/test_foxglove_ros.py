"""Messages of viewers as ROS 2 messages, against rosbags, which reads them by their definition alone."""

from __future__ import annotations

import importlib
import random
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mcaptrack import foxglove
from mcaptrack.errors import McaptrackError
from mcaptrack.foxglove import ANNOTATIONS, IMAGE, LOG, SCENE, TRANSFORM, VIDEO
from mcaptrack.foxglove.ros import Batches

ros = importlib.import_module("mcaptrack.foxglove.ros")
EVERY = pytest.mark.parametrize("name", [ANNOTATIONS, IMAGE, LOG, SCENE, TRANSFORM, VIDEO])


def fill(message: Any, draw: random.Random) -> Any:
    """Give each field of a message a random value, or none."""
    for field in message.DESCRIPTOR.fields:
        repeated = hasattr(getattr(message, field.name), "append")
        if draw.random() < 0.2:
            continue
        if field.message_type:
            if repeated:
                for _ in range(draw.randint(0, 3)):
                    fill(getattr(message, field.name).add(), draw)
            elif field.message_type.full_name.startswith("google."):
                time = getattr(message, field.name)
                time.seconds, time.nanos = draw.randrange(2**31), draw.randrange(10**9)
            else:
                fill(getattr(message, field.name), draw)
            continue
        values = {
            "float": lambda: draw.gauss(0, 100),
            "str": lambda: "".join(draw.choices("abc é\n", k=draw.randint(0, 9))),
            "bytes": lambda: draw.randbytes(draw.randint(0, 9)),
            "bool": lambda: draw.random() < 0.5,
            "int": lambda: draw.randrange(2**32),
        }
        if field.enum_type:
            setattr(message, field.name, draw.choice(field.enum_type.values).number)
        elif repeated:
            getattr(message, field.name).extend(draw.randrange(2**32) for _ in range(draw.randint(0, 4)))
        else:
            setattr(message, field.name, values[type(getattr(message, field.name)).__name__]())
    return message


def compare(ros: Any, message: Any) -> int:
    """Compare a ROS message with one of protobuf, field by field; returns the number of values."""
    values = 0
    for field in message.DESCRIPTOR.fields:
        of_ros, value = getattr(ros, field.name), getattr(message, field.name)
        if field.message_type and hasattr(value, "add"):
            assert len(of_ros) == len(value), field.name
            values += sum(compare(*pair) for pair in zip(of_ros, value, strict=True))
        elif field.message_type and field.message_type.full_name.startswith("google."):
            assert (of_ros.sec, of_ros.nanosec) == (value.seconds, value.nanos)
        elif field.message_type:
            values += compare(of_ros, value)
        else:
            theirs = bytes(of_ros) if isinstance(value, bytes) else of_ros
            same = list(theirs) == list(value) if isinstance(of_ros, np.ndarray) else theirs == value
            assert same, (field.name, of_ros, value)
            values += 1
    return values


@EVERY
def test_messages_are_the_same_for_rosbags(name):
    draw, store = random.Random(name), get_typestore(Stores.EMPTY)
    ros, encoding, text = foxglove.record_in(name, "cdr")
    assert (ros, encoding) == (name.replace(".", "_msgs/msg/"), "ros2msg")
    store.register(get_types_from_msg(text.decode(), ros))
    sent = [fill(foxglove.message_class(name)(), draw) for _ in range(40)]
    payloads = foxglove.messages_in(name, ((n, 2 * n, one.SerializeToString()) for n, one in enumerate(sent)), "cdr")
    values = 0
    for n, (message, (t_ns, number, payload)) in enumerate(zip(sent, payloads, strict=True)):
        assert (t_ns, number) == (n, 2 * n)
        read = store.deserialize_cdr(payload, ros)
        values += compare(read, message)
        assert bytes(store.serialize_cdr(read, ros)) == payload
    assert values > 80


@EVERY
def test_definitions_have_the_types_that_ros_has(name):
    """As ROS 2 Humble defines them; rosbags compares the two, and refuses others."""
    ros, _, text = foxglove.record_in(name, "cdr")
    types = get_types_from_msg(text.decode(), ros)
    humble = get_typestore(Stores.ROS2_HUMBLE)
    known = {one: humble.types[one] for one in types if one in humble.types}
    assert known
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    for one, theirs in known.items():
        ours = store.types[one].__dataclass_fields__
        assert {f: field.type for f, field in ours.items()} == {
            f: field.type for f, field in theirs.__dataclass_fields__.items()
        }


def test_in_protobuf_nothing_changes():
    payload = foxglove.pack_log(5, "INFO", "a", "b")
    assert list(foxglove.messages_in(LOG, [(1, 2, payload)], "protobuf")) == [(1, 2, payload)]
    assert foxglove.record_in(LOG, "protobuf") == foxglove.schema_record(LOG)


def test_times_that_ros_does_not_have_are_refused():
    last = 2**31 * 10**9 - 1
    assert len(list(foxglove.messages_in(LOG, [(1, 2, foxglove.pack_log(last, "INFO", "a", "b"))], "cdr"))) == 1
    with pytest.raises(McaptrackError, match="ROS has times from 1970 to 2038 only"):
        list(foxglove.messages_in(LOG, [(1, 2, foxglove.pack_log(last + 1, "INFO", "a", "b"))], "cdr"))


def alike(name: str) -> list[Any]:
    """Messages that consist of parts of the same few forms, with other numbers and letters."""
    draw = random.Random(name)
    made = foxglove.message_class(name)
    forms = [made.FromString(fill(made(), random.Random(k)).SerializeToString()) for k in range(6)]
    out = []
    for _ in range(30):
        message = made()
        for form in draw.choices(forms, k=5):
            message.MergeFrom(form)
        for part in (*getattr(message, "entities", ()), *getattr(message, "points", ())):
            time = next(getattr(part, field) for field in ("timestamp",) if hasattr(part, field))
            time.seconds, time.nanos = (2 ** draw.randrange(14, 28) for _ in range(2))
            for cube in getattr(part, "cubes", ()):
                cube.size.x, cube.pose.position.y = draw.gauss(0, 9), draw.gauss(0, 9)
        out.append(message)
    return out


@pytest.mark.parametrize("name", [SCENE, ANNOTATIONS])
def test_parts_of_one_form_are_converted_at_once_as_they_are_one_by_one(name):
    made = foxglove.message_class(name)
    batches = Batches(ros._field_types(made.DESCRIPTOR), ros._check_seconds)
    messages = [one for one in alike(name) if not has_large_numbers(one)]
    wanted = []
    for message in messages:
        out = bytearray()
        ros._append(message, out)
        wanted.append(bytes(out))
    payloads = [message.SerializeToString() for message in messages]
    assert len(messages) > 5
    assert batches.convert(payloads) == wanted
    assert batches.convert(payloads[::-1]) == wanted[::-1]
    empty = bytearray()
    ros._append(made(), empty)
    assert batches.convert([b""]) == [bytes(empty)]


def has_large_numbers(message: Any) -> bool:
    """Whether a message has whole numbers that aren't part of a form."""
    return any(list(large(one)) for _, parts in message.ListFields() if hasattr(parts, "add") for one in parts)


def large(message: Any) -> Any:
    for field, value in message.ListFields():
        if field.message_type and not field.message_type.full_name.startswith("google."):
            for one in value if hasattr(value, "add") else [value]:
                yield from large(one)
        elif field.type in (field.TYPE_UINT32, field.TYPE_INT32) and not hasattr(value, "append") and value > 127:
            yield field.name


def test_messages_that_are_written_in_another_way_are_converted_field_by_field():
    scene = foxglove.message_class(SCENE)()
    scene.entities.add(id="a").cubes.add().size.x = 2.0
    payload = scene.SerializeToString()
    assert payload[0] == 0x12
    twice = payload + payload  # in order, and two fields of a message in one part: the last one counts
    odd = payload[:1] + bytes([payload[1] + 3]) + payload[2:] + b"\x1a\x01b"  # the id of the entity again
    store = get_typestore(Stores.EMPTY)
    name, _, text = foxglove.record_in(SCENE, "cdr")
    store.register(get_types_from_msg(text.decode(), name))
    sent = [(0, 0, payload), (1, 1, twice), (2, 2, odd)]
    found = [store.deserialize_cdr(one, name) for *_, one in foxglove.messages_in(SCENE, sent, "cdr")]
    assert [[entity.id for entity in one.entities] for one in found] == [["a"], ["a", "a"], ["b"]]
    assert [one.entities[0].cubes[0].size.x for one in found] == [2.0, 2.0, 2.0]
