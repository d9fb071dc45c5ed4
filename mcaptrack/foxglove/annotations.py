"""Drawings on pictures: ImageAnnotations messages, for many pictures at once.

Two rules of the viewers (Foxglove, Lichtblick) shape these messages: an annotation belongs to a picture if its
timestamp is the picture's to the nanosecond; a picture is shown only if each annotation topic that is switched on has a
message for it. So each frame gets a message, and an empty one holds an invisible point.

Letters: F pictures, N drawn objects, P points of each, Q pairs of points.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mcaptrack.foxglove.messages import ANNOTATIONS, message_class
from mcaptrack.foxglove.palette import ink
from mcaptrack.geometry.arrays import Bytes, Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema.codec import varint

#: Coordinates are multiples of a quarter of a pixel: numbers with few digits take few bytes of a compressed log.
PER_PX: Final = 4
#: Types of a PointsAnnotation.
DOTS, LINE_LOOP, LINE_LIST = 1, 2, 4
_POINTS: Final = 2  # the field of ImageAnnotations


# Labels as text, grouped by length, because messages with texts of one length have one length.


def by_length(labels: NDArray[Any]) -> Iterator[tuple[int, Ints, NDArray[Any]]]:
    """Group labels (N,), numbers or texts, by the length of their text: for each length the length in bytes, the
    indices, and the texts as bytes.
    """
    unique, which = np.unique(labels, return_inverse=True)
    texts = np.array([str(label).encode() for label in unique.tolist()] or [b""])
    lengths = np.char.str_len(texts)[which] if len(labels) else np.empty(0, np.int64)
    for length in np.unique(lengths).tolist():
        chosen = np.flatnonzero(lengths == length)
        yield length, chosen, texts[which[chosen]]


# Many protobuf messages at once: the constant bytes of a template, and an array of what differs.
#
# A template holds constants, and slots for numbers of fixed width. All messages of a template have the same length,
# so they are a NumPy array with tags and constants as padding, like the rows of a channel (``schema.codec``);
# filling a slot is one assignment for all messages. Parts of variable length (texts, lists) need a template for
# each length.
#
# Letters: N messages, F frames.


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


class StampedMessages:
    """F messages with these stamps, composed of the templates that are added."""

    def __init__(self, t_ns: Ints) -> None:
        self._count = len(t_ns)
        self._seconds, self._nanos = stamps(t_ns)
        self._groups: list[MessageParts] = []

    def _add(self, frame: Ints, template: Template, **columns: Any) -> None:
        """Add parts (N,) to the messages ``frame`` (N,), rising."""
        if len(frame):
            stamp = {"seconds": self._seconds[frame], "nanos": self._nanos[frame]}
            self._groups.append(group(template.filled(len(frame), **stamp, **columns), frame, self._count))


def short(values: Floats, parts: int) -> Floats:
    """The nearest multiples of a binary fraction."""
    return np.rint(values * parts) / parts


def paint(front: str = "") -> dict[str, Slot]:
    """The slots of a colour; their names begin with ``front``."""
    return {name: Slot(front + name) for name in "rgba"}


def shades(front: str, rgb: Floats) -> dict[str, Floats]:
    """The columns of colours (N, 3) for such slots."""
    return {front + name: rgb[:, place] for place, name in enumerate("rgb")}


class Annotations(StampedMessages):
    """The annotations of F pictures with these stamps. Objects name their picture by its index (N,), rising."""

    def __init__(self, stamp_ns: Ints) -> None:
        super().__init__(stamp_ns)
        self._lines: dict[float, list[MessageParts]] = {}
        self._drawn = np.zeros(self._count, bool)
        self._add(np.arange(self._count), _head())

    def loops(
        self, frame: Ints, xy_px: Floats, rgb: Floats, alpha: Floats, thickness: float, fill: float = 0.0,
        dashes: int = 0,
    ) -> None:  # fmt: skip
        """Draw closed lines through points (N, P, 2) in colours (N, 3); inside with ``fill`` times their opacity.

        With ``dashes`` each side is so many dashes, of which two are at its ends.
        """
        more = shades("fill_", rgb) | {"fill_a": alpha * fill} if fill else {}
        xy = short(_dashed(xy_px, dashes) if dashes else xy_px, PER_PX)
        template = _loop(xy.shape[1], thickness, bool(fill), LINE_LIST if dashes else LINE_LOOP)
        self._add(frame, template, points__x=xy[..., 0], points__y=xy[..., 1], a=alpha, **shades("", rgb), **more)
        self._drawn[frame] = True

    def pairs(self, frame: Ints, xy_px: Floats, rgb: Floats, alpha: Floats, thickness: float) -> None:
        """Draw lines between pairs of points (N, 2 Q, 2) in colours (N, 3) with opacities (N, Q), or (Q,) for all.

        Lines of one thickness become one annotation of a picture, because a stamp takes more bytes than a line.
        """
        xy = short(xy_px, PER_PX)
        template = _some_lines(xy.shape[1])
        parts = template.filled(
            len(frame),
            points__x=xy[..., 0],
            points__y=xy[..., 1],
            colours__a=short(alpha, 64),
            **shades("colours__", rgb[..., None]),
        )
        self._lines.setdefault(thickness, []).append(group(parts, frame, self._count))
        self._drawn[frame] = True

    def labels(self, frame: Ints, xy_px: Floats, labels: NDArray[Any], rgb: Floats, size_px: float) -> None:
        """Write labels (N,), numbers or texts, from positions (N, 2) on, on backgrounds of colours (N, 3)."""
        xy, dark = short(xy_px, PER_PX), ink(rgb)
        for length, chosen, texts in by_length(labels):
            more = shades("text_", dark[chosen]) | shades("ground_", rgb[chosen])
            more |= {"x": xy[chosen, 0], "y": xy[chosen, 1]}
            self._add(frame[chosen], _text(length, size_px), text=texts, **more)

    def messages(self) -> Iterator[bytes]:
        """The message of each picture, in order."""
        empty = np.flatnonzero(~self._drawn)
        if len(empty):
            self._add(empty, _nothing())
        every = np.arange(self._count)
        lines = []
        for thickness, groups in self._lines.items():
            head = _lines_head(thickness).filled(self._count, seconds=self._seconds, nanos=self._nanos)
            lines.append((group(head, every, self._count), groups))
        for frame in range(self._count):
            whole = [joined(self._groups, frame)]
            for begin, groups in lines:
                content = joined(groups, frame)
                if content:
                    whole.append(nested(_POINTS, joined([begin], frame) + content))
            yield b"".join(whole)


def _dashed(xy_px: Floats, dashes: int) -> Floats:
    """The ends (N, 2 P dashes, 2) of the dashes of closed lines through points (N, P, 2)."""
    share = np.arange(2 * dashes) / (2 * dashes - 1)
    sides = np.roll(xy_px, -1, axis=1) - xy_px
    return (xy_px[:, :, None] + share[:, None] * sides[:, :, None]).reshape(len(xy_px), 2 * dashes * xy_px.shape[1], 2)


def _template(content: dict[str, Any]) -> Template:
    return Template(message_class(ANNOTATIONS).DESCRIPTOR, content)


@cache
def _head() -> Template:
    return _template({"timestamp": STAMP})


@cache
def _nothing() -> Template:
    black = dict.fromkeys("rgba", 0.0)
    dot = {"timestamp": STAMP, "type": DOTS, "points": {"x": 0.0, "y": 0.0}, "outline_color": black, "thickness": 1.0}
    return _template({"points": dot})


def _of_points(content: dict[str, Any]) -> Template:
    return Template(message_class(ANNOTATIONS).DESCRIPTOR.fields_by_name["points"].message_type, content)


@cache
def _lines_head(thickness: float) -> Template:
    white = dict.fromkeys("rgba", 1.0)
    return _of_points({"type": LINE_LIST, "outline_color": white, "thickness": thickness, "timestamp": STAMP})


@cache
def _some_lines(points: int) -> Template:
    ends = Each("points", points, {"x": Slot("x"), "y": Slot("y")})
    return _of_points({"points": ends, "outline_colors": Each("colours", points // 2, paint())})


@cache
def _loop(points: int, thickness: float, filled: bool, kind: int) -> Template:
    content = {
        "type": kind,
        "outline_color": paint(),
        "thickness": thickness,
        **({"fill_color": paint("fill_")} if filled else {}),
        "timestamp": STAMP,
        "points": Each("points", points, {"x": Slot("x"), "y": Slot("y")}),
    }
    return _template({"points": content})


@cache
def _text(length: int, size_px: float) -> Template:
    front, ground = ({**paint(name), "a": opacity} for name, opacity in (("text_", 1.0), ("ground_", 0.75)))
    content = {
        "text": TextSlot("text", length),
        "font_size": size_px,
        "text_color": front,
        "background_color": ground,
        "timestamp": STAMP,
        "position": {"x": Slot("x"), "y": Slot("y")},
    }
    return _template({"texts": content})
