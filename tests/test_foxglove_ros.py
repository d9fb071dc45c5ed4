"""Messages of viewers as ROS 2 messages, against rosbags, which reads them by their definition alone."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mcaptrack import foxglove
from mcaptrack.errors import McaptrackError
from mcaptrack.foxglove import ANNOTATIONS, IMAGE, LOG, SCENE, TRANSFORM, VIDEO

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
    ours = ((n, 2 * n, message.SerializeToString()) for n, message in enumerate(sent))
    values = 0
    for n, (t_ns, number, payload) in enumerate(foxglove.messages_in(name, ours, "cdr")):
        assert (t_ns, number) == (n, 2 * n)
        read = store.deserialize_cdr(payload, ros)
        values += compare(read, sent[n])
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
