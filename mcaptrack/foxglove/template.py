"""Many protobuf messages at once: the constant bytes of a template, and an array of what differs.

A template holds constants, and slots for numbers of fixed width. All messages of a template have the same length, so
they are a NumPy array with tags and constants as padding, like the rows of a channel (``schema.codec``); filling a slot
is one assignment for all messages. Parts of variable length (texts, lists) need a template for each length.

Letters: N messages, F frames.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mcaptrack.geometry.arrays import Bytes, Ints
from mcaptrack.geometry.clocks import NS_PER_S

#: The number of bytes of a slot for whole numbers, 7 bits each: enough for nanoseconds, and seconds to the year 3058.
_VARINT_BYTES: Final = 5


class Slot(NamedTuple):
    """A slot for a float64, with the name of its column in the array."""

    name: str


class TextSlot(NamedTuple):
    """A slot for a text of a fixed number of bytes."""

    name: str
    length: int


class Each(NamedTuple):
    """A field that occurs a number of times; in the array (N, times), with the columns of its content."""

    name: str
    times: int
    content: Mapping[str, Any]


class _Whole(NamedTuple):
    """A slot for a whole number, always written in ``_VARINT_BYTES`` bytes."""

    name: str


#: The timestamp of a message; its columns are filled by ``stamps``.
STAMP: Final = {"seconds": _Whole("seconds"), "nanos": _Whole("nanos")}


def varint(value: int) -> bytes:
    """A whole number as a protobuf varint, 7 bits a byte."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def whole_numbers(values: Ints) -> Bytes:
    """Whole numbers (N,) from 0 on as slots hold them, (N, 5): all bytes but the last have the continuation bit."""
    out = (values[:, None] >> (7 * np.arange(_VARINT_BYTES)) & 0x7F).astype(np.uint8)
    out[:, :-1] |= 0x80
    return out


def stamps(t_ns: Ints) -> tuple[Bytes, Bytes]:
    """Seconds and nanoseconds of times (N,), for ``Template.filled`` and ``STAMP``."""
    seconds, nanos = np.divmod(t_ns, NS_PER_S)
    return whole_numbers(seconds), whole_numbers(nanos)


class _Layout:
    """Bytes with the name, format and offset of each slot in them."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.slots: list[tuple[str, DTypeLike, int]] = []

    def put(self, tag: bytes, data: bytes, slot: tuple[str, DTypeLike] | None = None) -> None:
        self.data += tag
        if slot:
            self.slots.append((*slot, len(self.data)))
        self.data += data

    def nest(self, tag: bytes, other: _Layout) -> None:
        self.data += tag + varint(len(other.data))
        self.slots += [(name, kind, at + len(self.data)) for name, kind, at in other.slots]
        self.data += other.data

    def dtype(self) -> np.dtype[np.void]:
        names, formats, offsets = zip(*self.slots, strict=True) if self.slots else ((), (), ())
        if len(set(names)) < len(names):
            raise ValueError(f"several slots have one name: {', '.join(sorted(names))}")
        return np.dtype(
            {"names": list(names), "formats": list(formats), "offsets": list(offsets), "itemsize": len(self.data)}
        )


class Template:
    """Fields of a message with their tags. ``descriptor`` is that of the message, ``content`` the content of its
    fields.
    """

    def __init__(self, descriptor: Any, content: Mapping[str, Any]) -> None:
        layout = _lay_out(descriptor, content)
        self._data = bytes(layout.data)
        self.dtype = layout.dtype()

    def filled(self, count: int, **columns: Any) -> NDArray[np.void]:
        """``count`` messages with the slots filled from columns; ``a__b`` is the slot b inside of an `Each` named a."""
        out = np.frombuffer(bytearray(self._data) * count, self.dtype)
        for name, values in columns.items():
            target: Any = out
            *outer, last = name.split("__")
            for step in outer:
                target = target[step]
            target[last] = values
        return out


def _lay_out(descriptor: Any, content: Mapping[str, Any]) -> _Layout:
    layout = _Layout()
    unknown = set(content) - set(descriptor.fields_by_name)
    if unknown:
        raise ValueError(f"{descriptor.full_name} has no field {', '.join(sorted(unknown))}")
    for name, values in content.items():
        for value in values if isinstance(values, list) else [values]:
            _put(layout, descriptor.fields_by_name[name], value)
    return layout


def _put(layout: _Layout, field: Any, value: Any) -> None:
    is_double = field.type == field.TYPE_DOUBLE
    wire_type = 1 if is_double else 2 if field.type in (field.TYPE_MESSAGE, field.TYPE_STRING) else 0
    tag = varint(field.number << 3 | wire_type)
    match value:
        case Each(name, times, content):
            member = _Layout()
            member.nest(tag, _lay_out(field.message_type, content))
            layout.put(b"", bytes(member.data) * times, (name, (member.dtype(), (times,))))
        case Slot(name):
            layout.put(tag, bytes(8), (name, "<f8"))
        case TextSlot(name, length):
            layout.put(tag + varint(length), bytes(length), (name, f"S{length}"))
        case _Whole(name):
            layout.put(tag, bytes(_VARINT_BYTES), (name, ("u1", (_VARINT_BYTES,))))
        case Mapping():
            layout.nest(tag, _lay_out(field.message_type, value))
        case str():
            data = value.encode()
            layout.put(tag + varint(len(data)), data)
        case float() if is_double:
            layout.put(tag, struct.pack("<d", value))
        case _:
            layout.put(tag, varint(int(value)))


class MessageParts(NamedTuple):
    """Parts of messages of equal length: their bytes, and the offset ``at`` (F + 1,) of those of each frame."""

    data: memoryview
    at: list[int]


def group(parts: NDArray[np.void], frame: Ints, frames: int) -> MessageParts:
    """The group of parts (N,) that belong to the frames (N,), rising, out of ``frames``."""
    at = np.searchsorted(frame, np.arange(frames + 1)) * parts.dtype.itemsize
    return MessageParts(parts.view(np.uint8).data, at.tolist())


def nested(number: int, content: bytes) -> bytes:
    """A field of a message that holds a message."""
    return varint(number << 3 | 2) + varint(len(content)) + content


def joined(groups: Sequence[MessageParts], frame: int) -> bytes:
    """The bytes of all groups in a frame, group after group."""
    return b"".join([data[at[frame] : at[frame + 1]] for data, at in groups])
