"""Messages of ROS 2 (CDR) and ROS 1 as Arrow columns, without a loop over messages.

A message type is compiled once to a tree of fields. All messages of a batch (of a chunk, say) are then read at once,
field by field: a cursor holds the position of each of them, is aligned and moved on by whole columns, and the bytes at
the positions are the column. As long as all messages have the same size and their strings the same length, a cursor is
a start and a step, and a column is a strided view; otherwise positions are a vector, and bytes are gathered.

The elements of a list become the rows of another cursor. Their positions follow from the counts if all have the same
size. Otherwise (messages with strings or lists in them) the first elements of all messages are skipped together, then
the second ones, and so on; where few messages have that many, element by element.

Alignment (XCDR1) is relative to the end of the 4-byte head of a message, wherever that stands; ROS 1 has neither heads
nor alignment. Messages are read in place: to copy them to multiples of 8 first costs as much as it saves.

Nothing is read, nor room made for it, before it is certain to be within its message: other messages raise Malformed.

Letters: N rows, M messages, B bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from mcaptrack.geometry.ragged import gather_bytes

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Path = tuple[str, ...]

#: Fewer rows than this are skipped one by one.
FEW: Final = 12
MAX_DEPTH: Final = 32
_MAX_TYPES: Final = 4096
_MAX_BYTES: Final = 2**31 - 1
_NS_PER_S: Final = 10**9
#: Numbers of CDR are aligned to at most so many bytes behind the head of a message.
_GRID: Final = 8
#: Writers may fill up the end of a message.
_PADDING: Final = 3
#: The fields of times and durations, in ROS 2 and ROS 1.
_TIMES: Final = ({"sec", "nanosec"}, {"sec", "nsec"}, {"secs", "nsecs"})
#: What IDL needs where a message of ROS has no fields.
_PLACEHOLDER: Final = "structure_needs_at_least_one_member"
_NUMBERS: Final = {
    **{f"{kind}{8 * size}": f"{kind[0]}{size}" for kind in ("int", "uint") for size in (1, 2, 4, 8)},
    "float32": "f4",
    "float64": "f8",
    "bool": "?",
    "byte": "u1",
    "char": "u1",
    "octet": "u1",
}
#: The kinds of nodes in the definitions of ``rosbags.typesys``.
_NAME, _ARRAY, _SEQUENCE = 2, 3, 4


class Malformed(ValueError):
    """Bytes are not a message of their type; ``message`` is its number in the batch."""

    def __init__(self, text: str, message: int) -> None:
        super().__init__(text)
        self.message = message


class _Outside(ValueError):
    """The same, where only the end of the message is known, which tells the number."""

    def __init__(self, text: str, end: int) -> None:
        super().__init__(text)
        self.end = end


class Unsupported(ValueError):
    """Messages of a type can't be read as columns."""


def as_times(t_ns: pa.Array) -> pa.Array:
    """Nanoseconds since 1970 (N,) as times in UTC."""
    return t_ns.cast(pa.timestamp("ns", tz="UTC"))


# Positions


def windows(data: Bytes, kind: Any) -> NDArray[Any]:
    """The value of a type at each byte of ``data``, as a view."""
    kind = np.dtype(kind)
    return np.ndarray((max(len(data) - kind.itemsize + 1, 0),), kind, data, 0, (1,))


def ends_of(counts: Ints) -> Ints:
    """0 and the running sums of counts (N + 1,)."""
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(counts, dtype=np.int64)])


def _are_equal(values: Ints) -> bool:
    return bool(values.min() == values.max()) if len(values) else True


class Cursor:
    """Positions in ``data`` (N,): ``base + offset``. All ``base`` are multiples of ``grid`` behind their ``origin``,
    (N,) or one for all, and ``step`` apart if it is not 0; ``end`` (N,) are the ends of the messages.
    """

    __slots__ = ("base", "data", "end", "grid", "offset", "origin", "room", "step")

    def __init__(self, data: Bytes, base: Ints, end: Ints, grid: int, step: int = 0, origin: Ints | int = 0) -> None:
        self.data, self.end, self.origin, self.offset = data, end, origin, 0
        self._set(base, grid, step)

    def _set(self, base: Ints, grid: int, step: int = 0) -> None:
        self.base, self.grid, self.step, self.offset = base, grid, step if len(base) else 0, 0
        self.room = int((self.end - base).min()) if len(base) else _MAX_BYTES

    @property
    def at(self) -> Ints:
        """The positions (N,)."""
        return self.base + self.offset

    def rows(self, mask: NDArray[np.bool_]) -> Cursor:
        """The cursor of some of the rows."""
        origin = self.origin if isinstance(self.origin, int) else self.origin[mask]
        out = Cursor(self.data, self.base[mask], self.end[mask], self.grid, origin=origin)
        out.offset = self.offset
        return out

    def align(self, to: int, where: NDArray[np.bool_] | None = None) -> None:
        """Move to multiples of ``to``, 1, 2, 4 or 8; only the rows ``where``, if that is not None."""
        if to <= self.grid and (where is None or not self.offset % to):
            self.offset += -self.offset % to
            return
        pad = (self.origin - self.at) & (to - 1)
        self._set(self.at + (pad if where is None else pad * where), to if where is None else 1)

    def move(self, sizes: Ints) -> None:
        """Move each row by a number of bytes."""
        if _are_equal(sizes):
            self.offset += int(sizes[0]) if len(sizes) else 0
        else:
            self._set(self.at + sizes, 1)

    def need(self, sizes: Ints | int, what: str = "fields") -> None:
        """Raise Malformed unless each message has so many bytes more."""
        if (int(sizes.max(initial=0)) if isinstance(sizes, np.ndarray) else sizes) > self.room - self.offset:
            bad = np.flatnonzero(sizes > self.end - self.at)
            if len(bad):
                raise _Outside(f"its {what} are longer than itself", int(self.end[bad[0]]))

    def take(self, kind: np.dtype[Any], align: int) -> NDArray[Any]:
        """The number at each position (N,), behind which the cursor moves."""
        self.align(align)
        self.need(kind.itemsize)
        if self.step:
            view = np.ndarray((len(self.base),), kind, self.data, int(self.base[0]) + self.offset, (self.step,))
            out = np.ascontiguousarray(view)
        else:
            out = windows(self.data, kind)[self.at]
        self.offset += kind.itemsize
        return out

    def joined(self, sizes: Ints, to: Ints | None = None) -> Bytes:
        """So many bytes at each position, end to end, or at ``to`` (N + 1,), of which the last is the end of all."""
        ends = ends_of(sizes) if to is None else to
        if int(ends[-1]) > _MAX_BYTES:
            raise Unsupported("more than 2 GiB of a field in a batch")
        out = np.empty(int(ends[-1]), np.uint8)
        if self.step and len(sizes) and _are_equal(sizes) and len(out) == len(sizes) * int(sizes[0]):
            begin, shape = int(self.base[0]) + self.offset, (len(sizes), int(sizes[0]))
            out.reshape(shape)[:] = np.ndarray(shape, np.uint8, self.data, begin, (self.step, 1))
        else:
            gather_bytes(self.data, self.at, sizes, ends[:-1], out)
        return out


# Types


class _Type:
    """A type of a field. ``align``: that of its first number; ``size``: its bytes if these are always as many behind
    an aligned position, or -1; ``least``: the fewest bytes.
    """

    align: int
    size: int = -1
    least: int

    def read(self, cursor: Cursor) -> pa.Array:
        """The column (N,) of the values at the cursor, which moves behind them."""
        raise NotImplementedError

    def skip(self, cursor: Cursor) -> None:
        """Move the cursor behind the values."""
        cursor.align(self.align)
        cursor.need(self.size)
        cursor.offset += self.size

    def walk(self, data: memoryview, at: int, end: int, origin: int) -> int:
        """The position behind the value of one row at ``at``, which is aligned to ``origin``."""
        return at + (origin - at) % self.align + self.size


class _Number(_Type):
    def __init__(self, kind: str, order: str, is_aligned: bool) -> None:
        self.is_flag = kind == "?"
        self.kind = np.dtype("u1" if self.is_flag else order + kind)
        self.size = self.least = self.kind.itemsize
        self.align = self.size if is_aligned else 1
        self.is_byte = self.size == 1 and not self.is_flag

    def read(self, cursor: Cursor) -> pa.Array:
        return self.column(cursor.take(self.kind, self.align))

    def column(self, values: NDArray[Any]) -> pa.Array:
        """Numbers in any byte order as Arrow."""
        return pa.array(values != 0 if self.is_flag else values.astype(self.kind.newbyteorder("="), copy=False))


class _Counted(_Type):
    """A type that begins with a count of bytes or elements."""

    least = 4

    def __init__(self, order: str, is_aligned: bool) -> None:
        self.count_kind, self.count = np.dtype(order + "u4"), struct.Struct(order + "I").unpack_from
        self.align = 4 if is_aligned else 1


class _Text(_Counted):
    def __init__(self, order: str, is_aligned: bool) -> None:
        super().__init__(order, is_aligned)
        self.has_nul = is_aligned

    def _sizes(self, cursor: Cursor) -> Ints:
        sizes: Ints = cursor.take(self.count_kind, self.align).astype(np.int64)
        cursor.need(sizes, "strings")
        return sizes

    def read(self, cursor: Cursor) -> pa.Array:
        sizes = self._sizes(cursor)
        inner = np.maximum(sizes - 1, 0) if self.has_nul else sizes
        buffers = [None, pa.py_buffer(ends_of(inner).astype(np.int32)), pa.py_buffer(cursor.joined(inner))]
        column = pa.Array.from_buffers(pa.binary(), len(sizes), buffers)
        if self.has_nul:
            last = cursor.at[sizes > 0] + sizes[sizes > 0] - 1
            if cursor.data[last].any():
                bad = cursor.end[sizes > 0][np.flatnonzero(cursor.data[last])[0]]
                raise _Outside("a string of it does not end with a zero", int(bad))
        cursor.move(sizes)
        try:
            return column.cast(pa.string())  # checks that it is UTF-8
        except pa.ArrowInvalid:
            bad_row = next(row for row, text in enumerate(column.to_pylist()) if not is_utf8(text))
            raise _Outside("a string of it is not UTF-8", int(cursor.end[bad_row])) from None

    def skip(self, cursor: Cursor) -> None:
        cursor.move(self._sizes(cursor))

    def walk(self, data: memoryview, at: int, end: int, origin: int) -> int:
        at += (origin - at) % self.align
        at = at + 4 + self.count(data, at)[0] if at + 4 <= end else end + 1
        if at > end:
            raise _Outside("its strings are longer than itself", end)
        return at


def is_utf8(text: bytes) -> bool:
    """Whether bytes are text in UTF-8."""
    try:
        text.decode()
    except UnicodeDecodeError:
        return False
    return True


class _List(_Counted):
    """A sequence, or an array of ``fixed`` elements; bytes become binary, others lists."""

    def __init__(self, of: _Type, fixed: int | None, order: str, is_aligned: bool) -> None:
        super().__init__(order, is_aligned)
        self.of, self.fixed = of, fixed
        self.is_bytes = isinstance(of, _Number) and of.is_byte
        self.is_blob = self.is_bytes and fixed is None
        self.stride = of.size + -of.size % of.align if of.size >= 0 else 0 if fixed == 0 else -1
        if fixed is not None:
            self.align, self.least = of.align, fixed * of.least
            self.size = self._bytes(fixed) if self.stride >= 0 or not fixed else -1

    def _bytes(self, counts: Any) -> Any:
        """The bytes of so many elements of the same size: no padding follows the last."""
        return counts * self.stride - (counts > 0) * (self.stride - self.of.size)

    def _counts(self, cursor: Cursor) -> Ints:
        if self.fixed is not None:
            cursor.need(self.least, "arrays")
            return np.full(len(cursor.base), self.fixed, np.int64)
        counts: Ints = cursor.take(self.count_kind, self.align).astype(np.int64)
        cursor.need(counts * self.of.least, "lists")
        if not self.of.least and int(counts.sum()) > len(cursor.data):  # empty messages of ROS 1
            raise _Outside("a list of it is longer than all messages", int(cursor.end[np.argmax(counts)]))
        return counts

    def read(self, cursor: Cursor) -> pa.Array:
        counts = self._counts(cursor)
        ends = ends_of(counts)
        limits = pa.array(ends.astype(np.int32))
        if self.stride < 0:
            origin = cursor.origin if isinstance(cursor.origin, int) else np.repeat(cursor.origin, counts)
            start, end = self._starts(cursor, counts), np.repeat(cursor.end, counts)
            inner = Cursor(cursor.data, start, end, self.of.align, origin=origin)
            return pa.ListArray.from_arrays(limits, self.of.read(inner))
        sizes = self._aligned(cursor, counts)
        data = cursor.joined(sizes, ends * self.stride)
        cursor.move(sizes)
        if self.is_bytes:
            buffers = [None, limits.buffers()[1], pa.py_buffer(data)]
            return pa.Array.from_buffers(pa.binary(), len(counts), buffers)
        if isinstance(self.of, _Number):
            return pa.ListArray.from_arrays(limits, self.of.column(data.view(self.of.kind)))
        start = np.arange(ends[-1]) * self.stride
        inner = Cursor(data, start, start + self.stride, self.of.align, self.stride)
        return pa.ListArray.from_arrays(limits, self.of.read(inner))

    def _aligned(self, cursor: Cursor, counts: Ints) -> Ints:
        """Move to the first elements, which have the same size; returns the bytes of all."""
        has_any = counts > 0
        cursor.align(self.of.align, None if has_any.all() else has_any)
        sizes: Ints = self._bytes(counts)
        cursor.need(sizes, "lists")
        return sizes

    def _starts(self, cursor: Cursor, counts: Ints) -> Ints:
        """Move behind elements of different sizes; returns their positions (N,)."""
        first, most = ends_of(counts), int(counts.max(initial=0))
        starts, behind = np.empty(int(first[-1]), np.int64), cursor.at
        row, number = np.flatnonzero(counts), 0
        rest = cursor.rows(counts > 0)
        while len(row) >= FEW and number < most:
            rest.align(self.of.align)
            starts[first[row] + number] = rest.at
            self.of.skip(rest)
            number += 1
            more = counts[row] > number
            if not more.all():
                behind[row[~more]] = rest.at[~more]
                row, rest = row[more], rest.rows(more)
        view, align = cursor.data.data, self.of.align
        columns = (row, rest.at, rest.end, np.broadcast_to(rest.origin, len(row)))
        for index, begin, end, origin in zip(*(values.tolist() for values in columns), strict=True):
            at = begin
            for place in range(int(first[index]) + number, int(first[index + 1])):
                at += (origin - at) % align
                starts[place] = at
                at = self.of.walk(view, at, end, origin)
            behind[index] = at
        cursor.move(behind - cursor.at)
        return starts

    def skip(self, cursor: Cursor) -> None:
        counts = self._counts(cursor)
        if self.stride < 0:
            self._starts(cursor, counts)
        else:
            cursor.move(self._aligned(cursor, counts))

    def walk(self, data: memoryview, at: int, end: int, origin: int) -> int:
        count = self.fixed
        if count is None:
            at += (origin - at) % self.align
            count = self.count(data, at)[0] if at + 4 <= end else _MAX_BYTES
            at += 4
        if count * self.of.least > end - at:
            raise _Outside("its lists are longer than itself", end)
        if self.stride >= 0:
            return int(at + (origin - at) % self.of.align + self._bytes(count)) if count else at
        for _ in range(count):
            at = self.of.walk(data, at + (origin - at) % self.of.align, end, origin)
        return at


class _Struct(_Type):
    """A message. Times, which have seconds and nanoseconds, become timestamps; durations whole numbers of ns."""

    def __init__(self, name: str, fields: Sequence[tuple[str, _Type, bool]]) -> None:
        self.fields = fields
        types = [of for _, of, _ in fields]
        self.is_time = {field for field, _, _ in fields} in _TIMES and all(isinstance(of, _Number) for of in types)
        self.is_duration = self.is_time and name.endswith("Duration")
        self.align = types[0].align if types else 1
        self.least = sum(of.least for of in types)
        if all(of.size >= 0 and of.align <= self.align for of in types):
            self.size = 0
            for of in types:
                self.size += -self.size % of.align + of.size

    def _wanted(self, cursor: Cursor) -> Iterator[tuple[str, _Type]]:
        """The fields that are wanted, for the caller to read one after the other; the others are skipped."""
        for name, of, is_wanted in self.fields:
            if is_wanted:
                yield name, of
            else:
                of.skip(cursor)

    def columns(self, cursor: Cursor, path: Path = ()) -> Iterator[tuple[Path, pa.Array]]:
        """The columns of all fields that are wanted, by their path."""
        for name, of in self._wanted(cursor):
            if isinstance(of, _Struct) and not of.is_time:
                yield from of.columns(cursor, (*path, name))
            else:
                yield (*path, _titled(name, of)), of.read(cursor)

    def read(self, cursor: Cursor) -> pa.Array:
        if self.is_time:
            seconds, parts = (of.read(cursor).to_numpy().astype(np.int64) for _, of, _ in self.fields)
            t_ns = pa.array(seconds * _NS_PER_S + parts)
            return t_ns if self.is_duration else as_times(t_ns)
        columns = [(of.read(cursor), _titled(name, of)) for name, of in self._wanted(cursor)]
        if not columns:
            return pa.Array.from_buffers(pa.struct([]), len(cursor.base), [None])
        return pa.StructArray.from_arrays(*zip(*columns, strict=True))

    def skip(self, cursor: Cursor) -> None:
        if self.size >= 0:
            super().skip(cursor)
            return
        for _, of, _ in self.fields:
            of.skip(cursor)

    def walk(self, data: memoryview, at: int, end: int, origin: int) -> int:
        if self.size >= 0:
            return super().walk(data, at, end, origin)
        for _, of, _ in self.fields:
            at = of.walk(data, at, end, origin)
        return at


def _titled(name: str, of: _Type) -> str:
    return f"{name}_ns" if isinstance(of, _Struct) and of.is_duration else name


# Messages


class RosColumns:
    """Reads messages of one type.

    Parameters
    ----------
    definitions : mapping of str to (constants, fields)
        The types by name, as ``rosbags.typesys`` parses them (``Typestore.fielddefs``), from ros2msg, ros1msg or IDL.
    name : str
        The message type, as sensor_msgs/msg/Imu.
    encoding : {"cdr", "ros1"}
    wanted : callable, optional
        Whether a field, by its path, is wanted; others are skipped.
    blobs : bool, default True
        Whether fields of any number of bytes, as pictures are, are wanted, too.

    Attributes
    ----------
    left_out : dict of Path
        The fields of bytes that were not wanted.

    Raises
    ------
    Unsupported
        If the type has fields that aren't read as columns.
    """

    def __init__(
        self,
        definitions: Mapping[str, Any],
        name: str,
        encoding: str = "cdr",
        wanted: Callable[[Path], bool] = lambda _: True,
        blobs: bool = True,
    ) -> None:
        self.is_cdr, self.left_out = encoding == "cdr", dict[Path, None]()
        self._definitions, self._wanted, self._blobs, self._types = definitions, wanted, blobs, 0
        self._by_order = {order: self._struct(name, order, ()) for order in ("<>" if self.is_cdr else "<")}

    def _struct(self, name: str, order: str, path: Path) -> _Struct:
        self._types += 1
        if len(path) > MAX_DEPTH or self._types > _MAX_TYPES:
            raise Unsupported(f"{name} is more than {MAX_DEPTH} messages deep, or has more than {_MAX_TYPES}")
        if name not in self._definitions:
            raise Unsupported(f"there is no definition of {name}")
        fields = []
        for field, of in self._definitions[name][1]:
            if self.is_cdr or field != _PLACEHOLDER:
                inside = (*path, field)
                kind = self._type(of, order, inside)
                is_wanted = self._wanted(inside) and field != _PLACEHOLDER
                if is_wanted and not self._blobs and isinstance(kind, _List) and kind.is_blob:
                    self.left_out[inside], is_wanted = None, False
                fields.append((field, kind, is_wanted))
        return _Struct(name, fields)

    def _type(self, of: Any, order: str, path: Path) -> _Type:
        node, what = int(of[0]), of[1]
        if node == _NAME:
            return self._struct(what, order, path)
        if node in (_ARRAY, _SEQUENCE):
            member, count = what
            fixed = count if node == _ARRAY else None  # lists beyond their bound are read, as strings are
            return _List(self._type(member, order, path), fixed, order, self.is_cdr)
        if what[0] == "string":
            return _Text(order, self.is_cdr)
        if what[0] not in _NUMBERS:
            raise Unsupported(f"the field {'.'.join(path)} is a {what[0]}, which is not read")
        return _Number(_NUMBERS[what[0]], order, self.is_cdr)

    def read(self, data: Bytes, start: Ints, end: Ints) -> dict[Path, pa.Array]:
        """The columns of the messages (M,) that stand in ``data`` from ``start`` to before ``end``, by path.

        Raises Malformed if one of them is not of this type.
        """
        start, end = start.astype(np.int64), end.astype(np.int64)
        if not self.is_cdr:
            return self._read(data, start, end, "<")
        if (end - start < 4).any():
            raise Malformed("it has no head", int(np.argmax(end - start < 4)))
        order = data[start + 1].astype(np.int64) | data[start].astype(np.int64) << 8
        if (order > 1).any():  # parameter lists, and the encodings of XCDR2
            raise Unsupported(f"messages in the encapsulation {order.max():04x} are not read")
        body = start + 4
        if _are_equal(order):
            return self._read(data, body, end, "<" if not len(order) or order[0] else ">")
        rows, parts = [np.flatnonzero(order == number) for number in (0, 1)], []
        for which, kind in zip(rows, "><", strict=True):
            try:
                parts.append(self._read(data, body[which], end[which], kind))
            except Malformed as error:
                raise Malformed(str(error), int(which[error.message])) from None
        back = pa.array(np.argsort(np.concatenate(rows)))
        return {path: pa.concat_arrays([part[path] for part in parts]).take(back) for path in parts[0]}

    def _read(self, data: Bytes, start: Ints, end: Ints, order: str) -> dict[Path, pa.Array]:
        """The columns of messages of one byte order."""
        shift = start % _GRID if self.is_cdr else np.empty(0, np.int64)
        origin = shift if not _are_equal(shift) else int(shift[0]) if len(shift) else 0
        cursor = Cursor(data, start, end, _GRID, _step(start), origin)
        try:
            out = dict(self._by_order[order].columns(cursor))
            left = cursor.end - cursor.at
            bad = np.flatnonzero((left < 0) | (left > (_PADDING if self.is_cdr else 0)))
            if len(bad):
                raise _Outside(f"{left[bad[0]]} bytes of it are left over", int(cursor.end[bad[0]]))
        except _Outside as error:
            raise Malformed(str(error), int(np.argmax(end == error.end))) from None
        return out


def _step(at: Ints) -> int:
    """The distance between positions if it is always the same, otherwise 0."""
    steps = np.diff(at)
    return int(steps[0]) if len(steps) and steps[0] > 0 and _are_equal(steps) else 0
