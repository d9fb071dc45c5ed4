"""Messages of protobuf as Arrow columns, without a loop over messages, as ``columns.cdr`` does for ROS.

All messages are scanned together: the first fields of all, then the second ones, and so on (few messages one by one).
The fields that they hold - message, field number, wire type, place and size - are then taken field by field; embedded
messages are the rows of the next scan, since they say how long they are.

Letters: N rows, F fields in them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
import pyarrow as pa
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from numpy.typing import NDArray

from mcaptrack.columns.cdr import (
    FEW,
    MAX_DEPTH,
    Bytes,
    Cursor,
    Ints,
    Malformed,
    Path,
    Unsupported,
    as_times,
    ends_of,
    is_utf8,
    windows,
)

_MORE: Final = np.uint64(0x8080808080808080)
_FIXED: Final = {
    FieldDescriptor.TYPE_DOUBLE: "<f8", FieldDescriptor.TYPE_FLOAT: "<f4",
    FieldDescriptor.TYPE_FIXED64: "<u8", FieldDescriptor.TYPE_FIXED32: "<u4",
    FieldDescriptor.TYPE_SFIXED64: "<i8", FieldDescriptor.TYPE_SFIXED32: "<i4",
}  # fmt: skip
_VARINTS: Final = {
    FieldDescriptor.TYPE_INT64: "i8", FieldDescriptor.TYPE_UINT64: "u8", FieldDescriptor.TYPE_INT32: "i4",
    FieldDescriptor.TYPE_UINT32: "u4", FieldDescriptor.TYPE_BOOL: "?", FieldDescriptor.TYPE_ENUM: "i4",
    FieldDescriptor.TYPE_SINT32: "i4", FieldDescriptor.TYPE_SINT64: "i8",
}  # fmt: skip
_ZIGZAG: Final = (FieldDescriptor.TYPE_SINT32, FieldDescriptor.TYPE_SINT64)
_SIZED: Final = (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES)
_TIME, _DURATION = "google.protobuf.Timestamp", "google.protobuf.Duration"
_NS_PER_S: Final = 10**9
#: Times that are so far from 1970 have no nanoseconds in 64 bits: they are null.
_FAR_S: Final = 2**63 // _NS_PER_S - 4
#: Wire types: a varint, 8 bytes, as many bytes as its varint says, fields up to a mark, 4 bytes.
_VARINT, _WIDE, _SIZED_BYTES, _GROUP, _NARROW = 0, 1, 2, 3, 5
#: The bytes of a tag or a length.
_SHORT: Final = 5
#: Fields have smaller numbers.
_NUMBERS: Final = 2**29
#: Bytes behind a message that a varint at its end may be read beyond.
_PADDING: Final = 16


def _varints(data: Bytes, at: Ints) -> tuple[NDArray[np.uint64], Ints]:
    """The varints at positions, and their sizes; 11 for those that do not end. 10 bytes must follow ``at`` in data."""
    first = data[at]
    if not (first >= 0x80).any():
        return first.astype(np.uint64), np.ones(len(at), np.int64)
    octets = windows(data, "<u8")[at]
    stops = ~octets & _MORE
    low = stops & (~stops + np.uint64(1))  # the bit that ends a varint; 0 if it is longer than 8 bytes
    size = np.where(low > 0, np.bitwise_count(low - np.uint64(1)).astype(np.int64) // 8 + 1, 11)
    value = octets & np.where(low > 0, (low - np.uint64(1)) | low, ~np.uint64(0)) & ~_MORE
    for shift, mask in ((1, 0x7F007F007F007F00), (2, 0x3FFF00003FFF0000), (4, 0x0FFFFFFF00000000)):
        high = value & np.uint64(mask)
        value = (value ^ high) | (high >> np.uint64(shift))
    long = np.flatnonzero(low == 0)
    if len(long):
        eighth, ninth = data[at[long] + 8].astype(np.uint64), data[at[long] + 9].astype(np.uint64)
        size[long] = np.where(eighth < 0x80, 9, np.where(ninth < 0x80, 10, 11))
        value[long] |= (eighth & np.uint64(0x7F)) << np.uint64(56)
        value[long] |= np.where(eighth < 0x80, np.uint64(0), ninth << np.uint64(63))
    return value, size


def _is_time(field: FieldDescriptor) -> bool:
    return field.message_type is not None and field.message_type.full_name in (_TIME, _DURATION)


def _is_embedded(field: FieldDescriptor) -> bool:
    """Whether a field is a single message, which is no time."""
    return field.message_type is not None and not field.is_repeated and not _is_time(field)


def _titled(field: FieldDescriptor) -> str:
    is_duration = field.message_type is not None and field.message_type.full_name == _DURATION
    return f"{field.name}_ns" if is_duration and not field.is_repeated else field.name


class _Fields:
    """The fields in rows (F,): row, number, wire type, position and size of the value; those of a row in its order."""

    def __init__(self, data: Bytes, start: Ints, end: Ints, message: Ints) -> None:
        self.data, self.message, self.count = data, message, len(start)
        parts: list[tuple[Ints, ...]] = []
        row, at = np.arange(len(start)), start.copy()
        row, at = row[at < end], at[at < end]
        while len(row) >= FEW:
            parts.append(self._next(row, at, end[row]))
            at = parts[-1][3] + parts[-1][4]
            more = at < end[row]
            row, at = row[more], at[more]
        if len(row):
            parts.append(self._singly(row, at, end[row]))
        joined = [np.concatenate(values) for values in zip(*parts, strict=True)] or [np.empty(0, np.int64)] * 5
        self.row, self.number, self.wire, self.at, self.size = joined

    def of(self, number: int) -> Ints:
        """The places of the fields with a number, in order of rows."""
        which = np.flatnonzero(self.number == number)
        row = self.row[which]
        return which if (row[1:] >= row[:-1]).all() else which[np.argsort(row, kind="stable")]

    def _singly(self, row: Ints, at: Ints, end: Ints) -> tuple[Ints, ...]:
        """All fields of a few rows."""
        out: list[tuple[int, int, int, int, int]] = []
        data = self.data.data

        def varint(at: int) -> tuple[int, int]:
            value = shift = 0
            while data[at] >= 0x80 and shift < 63:
                value |= (data[at] & 0x7F) << shift
                at, shift = at + 1, shift + 7
            return value | data[at] << shift, at + 1

        def short(at: int) -> tuple[int, int]:
            value, behind = varint(at)
            return value if behind - at <= _SHORT else -1, behind

        for index, begin, last in zip(row.tolist(), at.tolist(), end.tolist(), strict=True):
            here = begin
            while here < last:
                (tag, here), size = short(here), -1
                if tag & 7 == _SIZED_BYTES and here < last:
                    size, here = short(here)
                elif tag & 7 == _GROUP:
                    raise Unsupported("groups are not read")
                elif here < last:
                    size = {_VARINT: varint(here)[1] - here, _WIDE: 8, _NARROW: 4}.get(tag & 7, -1)
                if not 0 <= size <= last - here or not 0 < tag >> 3 < _NUMBERS:
                    raise Malformed("a field of it can't be", int(self.message[index]))
                out.append((index, tag >> 3, tag & 7, here, size))
                here += size
        return tuple(np.array(out, np.int64).reshape(-1, 5).T)

    def _next(self, row: Ints, at: Ints, end: Ints) -> tuple[Ints, ...]:
        """The next field of many rows."""
        tag, tag_size = _varints(self.data, at)
        at, wire = at + tag_size, (tag & np.uint64(7)).astype(np.int64)
        is_sized = wire == _SIZED_BYTES
        has_varint = is_sized | (wire == _VARINT)
        length, size = _varints(self.data, np.where(has_varint, np.minimum(at, end), len(self.data) - _PADDING))
        at = at + np.where(is_sized, size, 0)
        wide, narrow = np.full_like(at, 8), np.full_like(at, 4)
        sizes = [np.where(size > _SHORT, -1, length.astype(np.int64)), size, wide, narrow]
        size = np.select([is_sized, wire == _VARINT, wire == _WIDE, wire == _NARROW], sizes, -1)
        number = (tag >> np.uint64(3)).astype(np.int64)
        if (wire == _GROUP).any():
            raise Unsupported("groups are not read")
        bad = (tag_size > _SHORT) | (size < 0) | (number < 1) | (number >= _NUMBERS) | (size > end - at)
        if bad.any():
            raise Malformed("a field of it can't be", int(self.message[row[np.argmax(bad)]]))
        return row, number, wire, at, size


class ProtobufColumns:
    """Reads messages of one type.

    Parameters
    ----------
    message : Descriptor
        Of the type.
    wanted, blobs, left_out
        As of ``cdr.RosColumns``.

    Raises
    ------
    Unsupported
        If messages of the type are in messages of the same type.
    """

    def __init__(
        self, message: Descriptor, wanted: Callable[[Path], bool] = lambda _: True, blobs: bool = True
    ) -> None:
        self._message, self._wanted, self._blobs, self.left_out = message, wanted, blobs, dict[Path, None]()
        self._fields = dict[Path, list[FieldDescriptor]]()
        self._choose(message, (), ())

    def _choose(self, of: Descriptor, path: Path, around: tuple[str, ...]) -> None:
        """The fields that are wanted of a message, and of those in it."""
        if of.full_name in around or len(path) > MAX_DEPTH:
            raise Unsupported(f"{of.full_name} is in itself, or messages are more than {MAX_DEPTH} deep")
        self._fields[path] = []
        for field in of.fields:
            inside = (*path, field.name)
            if not self._wanted(inside):
                continue
            if field.type == field.TYPE_GROUP:
                raise Unsupported("groups are not read")
            if field.type == field.TYPE_BYTES and not self._blobs:
                self.left_out[inside] = None
                continue
            self._fields[path].append(field)
            if field.message_type is not None and not _is_time(field):
                self._choose(field.message_type, inside, (*around, of.full_name))

    def read(self, data: Bytes, start: Ints, end: Ints) -> dict[Path, pa.Array]:
        """As ``cdr.RosColumns.read``; fields that are not set are null, or 0 where the schema says nothing else."""
        padded = np.concatenate([data, np.zeros(_PADDING, np.uint8)])
        rows = _Fields(padded, start.astype(np.int64), end.astype(np.int64), np.arange(len(start)))
        return dict(self._columns((), rows, None))

    def _columns(self, path: Path, rows: _Fields, take: Any) -> Iterator[tuple[Path, pa.Array]]:
        """The columns of a message; ``take`` are the places of its rows among those of the message around it."""
        for field in self._fields[path]:
            inside = (*path, field.name)
            if not _is_embedded(field):
                column = self._column(field, rows, inside)
                yield (*path, _titled(field)), column if take is None else column.take(take)
                continue
            inner, places = self._embedded(field, rows)
            yield from self._columns(inside, inner, places if take is None else places.take(take))

    def _embedded(self, field: FieldDescriptor, rows: _Fields) -> tuple[_Fields, pa.Array]:
        """The rows of a message in another one, and for each outer row its place among them, or null."""
        which = rows.of(field.number)
        which = which[rows.wire[which] == _SIZED_BYTES]
        if len(which) and (np.diff(rows.row[which]) == 0).any():
            raise Unsupported("parts of a message are to be merged")
        place = np.zeros(rows.count, np.int64)
        place[rows.row[which]] = np.arange(len(which))
        missing = np.ones(rows.count, bool)
        missing[rows.row[which]] = False
        at = rows.at[which]
        inner = _Fields(rows.data, at, at + rows.size[which], rows.message[rows.row[which]])
        return inner, pa.array(place, mask=missing)

    def _column(self, field: FieldDescriptor, rows: _Fields, path: Path) -> pa.Array:
        """The column of a field with values, or with a list of anything."""
        which = rows.of(field.number)
        if field.is_repeated:
            row, values = self._values(field, rows, which, path)
            ends = ends_of(np.bincount(row, minlength=rows.count))
            return pa.ListArray.from_arrays(pa.array(ends.astype(np.int32)), values)
        place = np.full(rows.count, -1)
        place[rows.row[which]] = which  # the last one counts
        is_set = place >= 0
        _, values = self._values(field, rows, place[is_set], path)
        if is_set.all():
            return values
        places = np.cumsum(is_set) - 1
        if not field.has_presence:  # the value of fields that are not set stands at the end
            default = field.enum_type.values_by_number[0].name if field.enum_type else field.default_value
            values = pa.concat_arrays([values, pa.array([default], values.type)])
            return values.take(pa.array(np.where(is_set, places, len(values) - 1)))
        return values.take(pa.array(places, mask=~is_set))

    def _values(self, field: FieldDescriptor, rows: _Fields, which: Ints, path: Path) -> tuple[Ints, pa.Array]:
        """The rows of values, and the values, of some of the fields."""
        row, wire, at, size = rows.row[which], rows.wire[which], rows.at[which], rows.size[which]
        if field.type in _SIZED or field.message_type:
            if (wire != _SIZED_BYTES).any():
                raise Unsupported("a field is of another type")
            if field.message_type:
                inner = _Fields(rows.data, at, at + size, rows.message[row])
                return row, self._structs(field.message_type, inner, path)
            return row, self._texts(field, rows, row, at, size)
        form = _FIXED.get(field.type, "")
        odd = wire != ({8: _WIDE, 4: _NARROW}[np.dtype(form).itemsize] if form else _VARINT)
        if (odd & (wire != _SIZED_BYTES) if field.is_repeated else odd).any():
            raise Unsupported("a field is of another type")
        body = Cursor(rows.data, at, at + size, 1).joined(size)  # packed or not, values stand behind each other
        ends = ends_of(size)
        if form:
            width = np.dtype(form).itemsize
            if (size % width).any():
                raise Malformed("packed numbers end within a number", int(rows.message[row[np.argmax(size % width)]]))
            return np.repeat(row, size // width), pa.array(body.view(form))
        last = np.flatnonzero(body < 0x80)
        first = np.concatenate([np.zeros(1, np.int64), last[:-1] + 1])[: len(last)]
        is_open = np.zeros(len(size), bool)
        is_open[size > 0] = body[ends[1:][size > 0] - 1] >= 0x80
        owner = np.searchsorted(ends, first, "right") - 1
        is_open[owner[last - first > 9]] = True
        if is_open.any():
            raise Malformed("packed numbers end within a number", int(rows.message[row[np.argmax(is_open)]]))
        value, _ = _varints(np.concatenate([body, np.zeros(_PADDING, np.uint8)]), first)
        return row[owner], self._numbers(field, value)

    def _texts(self, field: FieldDescriptor, rows: _Fields, row: Ints, at: Ints, size: Ints) -> pa.Array:
        """Strings, or bytes."""
        body = Cursor(rows.data, at, at + size, 1).joined(size)
        buffers = [None, pa.py_buffer(ends_of(size).astype(np.int32)), pa.py_buffer(body)]
        column = pa.Array.from_buffers(pa.binary(), len(size), buffers)
        try:
            return column.cast(pa.string()) if field.type == field.TYPE_STRING else column
        except pa.ArrowInvalid:
            bad = next(index for index, text in enumerate(column.to_pylist()) if not is_utf8(text))
            raise Malformed("a string of it is not UTF-8", int(rows.message[row[bad]])) from None

    def _numbers(self, field: FieldDescriptor, value: NDArray[np.uint64]) -> pa.Array:
        """Numbers of varints; enumerations by name."""
        if field.type in _ZIGZAG:
            value = (value >> np.uint64(1)) ^ (~(value & np.uint64(1)) + np.uint64(1))
        kind = _VARINTS[field.type]
        if kind == "?":
            return pa.array(value != 0)
        numbers = value.view(kind) if kind[1] == "8" else value.astype(np.uint32).view(kind)
        if field.enum_type is None:
            return pa.array(numbers)
        occurring, place = np.unique(numbers, return_inverse=True)
        names = field.enum_type.values_by_number
        texts = [names[number].name if number in names else str(number) for number in occurring.tolist()]
        return pa.array(texts, pa.string()).take(pa.array(place))

    def _structs(self, of: Descriptor, rows: _Fields, path: Path) -> pa.Array:
        """Messages in a list, or times."""
        if of.full_name in (_TIME, _DURATION):
            seconds, parts = (self._column(field, rows, path).to_numpy().astype(np.int64) for field in of.fields)
            is_far = np.abs(seconds) >= _FAR_S
            t_ns = pa.array(np.where(is_far, 0, seconds) * _NS_PER_S + parts, mask=is_far)
            return as_times(t_ns) if of.full_name == _TIME else t_ns
        columns = dict(self._nested(rows, path))
        if not columns:
            return pa.Array.from_buffers(pa.struct([]), rows.count, [None])
        return pa.StructArray.from_arrays(list(columns.values()), list(columns))

    def _nested(self, rows: _Fields, path: Path) -> Iterator[tuple[str, pa.Array]]:
        for field in self._fields[path]:
            inside = (*path, field.name)
            if _is_embedded(field):
                inner, places = self._embedded(field, rows)
                assert field.message_type is not None
                yield field.name, self._structs(field.message_type, inner, inside).take(places)
            else:
                yield _titled(field), self._column(field, rows, inside)
