"""The row codec: protobuf payloads as NumPy arrays, without a loop over rows.

All fields of a row have a fixed width, so that every row of a schema has the same number of bytes on the wire, with tag
bytes at fixed offsets. A payload is therefore a structured array with the tags as padding: encoding fills a template,
decoding is a view. Payloads of other protobuf writers (default values omitted, fields in another order) have another
length or other tags; they are detected and decoded by the protobuf runtime.

Columns that were added to a schema later are left out of messages in which they are missing in all rows, or 0, so that
these messages stay as they were. A schema has one layout for each time that it grew.

Letters: N rows, M messages.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Ints
from mcaptrack.geometry.ragged import ragged_range
from mcaptrack.schema.proto import KINDS, Column, Definition

if TYPE_CHECKING:
    from google.protobuf.message import Message

Rows = NDArray[np.void]
Bytes = NDArray[np.uint8]


def varint(value: int) -> bytes:
    """A whole number as a protobuf varint, 7 bits a byte."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


class _Layout:
    """The bytes of a row with some columns: ``head`` bytes, then for each column its tag and its value."""

    def __init__(self, columns: Sequence[Column]) -> None:
        body, at = bytearray(), []
        for column in columns:
            _, width, wire_type, _ = KINDS[column.kind]
            body += varint(column.number << 3 | wire_type)
            at.append(len(body))
            body += bytes(width)
        head = b"\x0a" + varint(len(body))  # field 1 of the message, length-delimited
        offsets = [len(head) + offset for offset in at]
        self.head = len(head)
        self.template = np.frombuffer(head + body, np.uint8)
        self.size = len(self.template)
        self.dtype = np.dtype(
            {
                "names": [column.name for column in columns],
                "formats": [KINDS[column.kind][0] for column in columns],
                "offsets": offsets,
                "itemsize": self.size,
            }
        )
        # The fixed bits of a row: all bits of tags, and all but the lowest bit of a bool, because other bytes than 0
        # and 1 are longer varints, or true values that NumPy can't represent.
        fixed = np.full(self.size, 0xFF, np.uint8)
        for column, offset in zip(columns, offsets, strict=True):
            fixed[offset : offset + KINDS[column.kind][1]] = 0xFE if column.kind == "bool" else 0
        self._fixed = fixed
        self._data = np.where(fixed == 0xFF, 0, 0xFF).astype(np.uint8)
        self._tags = self.template.tobytes()
        fixed_at = np.flatnonzero(fixed).tolist()
        self._fixed_bytes = [(at, fixed[at], self.template[at] & fixed[at]) for at in fixed_at]

    def filled(self, values: Bytes) -> bytes:
        """The bytes of rows, from the values in others (N, size)."""
        return (values & self._data | self.template).tobytes()

    def is_of(self, payload: bytes) -> bool:
        """Whether every tag is where ``filled`` writes it; then all other bytes are values of the columns."""
        if len(payload) % self.size:
            return False
        raw = np.frombuffer(payload, np.uint8).reshape(-1, self.size)
        return (raw & self._fixed).tobytes() == self._tags * len(raw)

    def begins(self, raw: Bytes, start: Ints, length: Ints) -> Bools:
        """Which messages (M,) of ``raw`` have the length and the head of rows of this layout."""
        fits: Bools = (length > 0) & (length % self.size == 0)
        for at in range(self.head):
            fits[fits] &= raw[start[fits] + at] == self.template[at]
        return fits

    def rows_at(self, raw: Bytes, start: Ints, counts: Ints) -> Bytes | None:
        """The bytes (N, size) of rows, ``counts`` of them from each ``start`` on; None if a tag is not in its place."""
        block = np.lib.stride_tricks.sliding_window_view(raw, self.size)[ragged_range(start, counts, step=self.size)]
        # By column, because few bytes of a row are fixed.
        if any(((block[:, at] & mask) != tag).any() for at, mask, tag in self._fixed_bytes):
            return None
        return block


class RowCodec:
    """Rows of one schema <-> payload bytes. ``dtype`` is the layout of a row on the wire, with tags as padding."""

    def __init__(self, definition: Definition) -> None:
        self._definition = definition
        columns = definition.columns
        grew = [at for at in range(1, len(columns)) if columns[at].group != columns[at - 1].group]
        self._layouts = [_Layout(columns[:count]) for count in (*grew, len(columns))]  # the shortest first
        self._later = [columns[count:] for count in grew]
        self.dtype = self._layouts[-1].dtype
        blank = self._layouts[-1].template.copy()
        for column in columns:
            blank.view(self.dtype)[column.name] = column.missing
        self._blank: Bytes = blank

    def encode(self, rows: Rows) -> bytes:
        """Encode N rows as one payload. ``rows`` must have the columns of the schema, in any memory layout."""
        return b"".join(self.encode_each(rows, np.array([0, len(rows)])))

    def encode_each(self, rows: Rows, ends: Ints) -> Iterator[bytes]:
        """Encode rows as several payloads, one up to each of ``ends`` (M + 1,) after the first, which is 0.

        A payload has the columns up to the last group of which any row of it has a value.
        """
        if rows.dtype != self.dtype:
            wire = np.empty(len(rows), self.dtype)
            for name in self.dtype.names or ():
                wire[name] = rows[name]
            rows = wire
        whole = self._layouts[-1]
        raw = np.ascontiguousarray(rows).view(np.uint8).reshape(-1, whole.size)
        counts = np.diff(ends)
        chosen = np.full(len(counts), len(self._later))
        for number, later in reversed([*enumerate(self._later)]):
            states = np.zeros(len(rows), bool)
            for column in later:
                states |= ~_are_missing(column, rows)
            chosen[np.diff(np.concatenate([[0], np.cumsum(states)])[ends]) == 0] = number
        payloads = {}
        for number in np.unique(chosen[counts > 0]).tolist():
            layout = self._layouts[number]
            values = raw
            if layout is not whole:
                values = np.empty((len(raw), layout.size), np.uint8)
                values[:, layout.head :] = raw[:, whole.head : whole.head + layout.size - layout.head]
            payloads[number] = layout.filled(values), layout.size
        for number, low, high in zip(chosen.tolist(), ends[:-1].tolist(), ends[1:].tolist(), strict=True):
            payload, size = payloads[number] if high > low else (b"", 0)
            yield payload[low * size : high * size]

    def decode(self, payload: bytes) -> Rows:
        """Decode one payload to N read-only rows; a view of ``payload`` if it has this codec's layout.

        Raises ValueError if the payload is not a message of this schema.
        """
        layout = self._layout_of(payload)
        return self._decode_foreign(payload) if layout is None else self._from(layout, payload)

    def decode_all(self, payloads: Sequence[bytes]) -> tuple[Rows, NDArray[np.int64]]:
        """Decode many payloads to one array of rows, and the number of rows in each."""
        joined = b"".join(payloads)
        layout = self._layout_of(joined)
        if layout is not None and all(len(payload) % layout.size == 0 for payload in payloads):
            counts = np.fromiter((len(payload) // layout.size for payload in payloads), np.int64, len(payloads))
            return self._from(layout, joined), counts
        parts = [self.decode(payload) for payload in payloads]
        rows = np.concatenate(parts) if parts else np.empty(0, self.dtype)
        return rows, np.array([len(part) for part in parts], np.int64)

    def decode_at(
        self, raw: NDArray[np.uint8], start: NDArray[np.int64], end: NDArray[np.int64]
    ) -> tuple[Rows, NDArray[np.int64]] | None:
        """Decode the payloads from ``start`` (M,) to ``end`` (M,) in ``raw``, as ``decode_all`` does.

        None if one has another layout than this codec's.
        """
        length = end - start
        counts, parts = np.zeros(len(length), np.int64), []
        for layout in self._layouts:
            mine = layout.begins(raw, start, length)
            if mine.any():
                counts[mine] = length[mine] // layout.size
                block = layout.rows_at(raw, start[mine], counts[mine])
                if block is None:
                    return None
                parts.append((mine, self._widened(layout, block)))
        if ((length > 0) & (counts == 0)).any():
            return None
        if len(parts) == 1:
            return parts[0][1], counts
        out, first = np.empty((int(counts.sum()), self.dtype.itemsize), np.uint8), np.cumsum(counts) - counts
        for mine, rows in parts:
            out[ragged_range(first[mine], counts[mine])] = self._bytes(rows)
        return out.view(self.dtype)[:, 0], counts

    def blank(self, count: int) -> Rows:
        """``count`` rows in which all optional columns are missing; the others are 0."""
        return np.tile(self._blank, (count, 1)).view(self.dtype)[:, 0]

    def longer(self, rows: Rows, taken: int, length: int) -> Rows:
        """An array of ``length`` rows that begins with the first ``taken`` rows; the others are not initialised."""
        out = np.empty((length, self.dtype.itemsize), np.uint8)
        out[:taken] = self._bytes(rows[:taken])
        return out.view(self.dtype)[:, 0]

    def put(self, rows: Rows, at: int, part: Rows) -> None:
        """Copy rows into others of this layout; as bytes, because NumPy copies structured arrays field by field."""
        self._bytes(rows)[at : at + len(part)] = self._bytes(part)

    def _bytes(self, rows: Rows) -> Bytes:
        return np.asarray(rows.view(np.uint8).reshape(-1, self.dtype.itemsize), np.uint8)

    def _layout_of(self, payload: bytes) -> _Layout | None:
        """The layout of this codec that a payload has; None if another writer made it."""
        return next((layout for layout in reversed(self._layouts) if layout.is_of(payload)), None)

    def _from(self, layout: _Layout, payload: bytes) -> Rows:
        """The read-only rows of a payload of a layout."""
        rows = self._widened(layout, np.frombuffer(payload, np.uint8).reshape(-1, layout.size))
        rows.flags.writeable = False
        return rows

    def _widened(self, layout: _Layout, block: Bytes) -> Rows:
        """Rows with all columns, from the bytes (N, size) of rows of a layout; later columns are missing."""
        whole = self._layouts[-1]
        if layout is not whole:
            short, block = block, np.tile(self._blank, (len(block), 1))
            block[:, whole.head : whole.head + layout.size - layout.head] = short[:, layout.head :]
        rows: Rows = block.view(self.dtype)[:, 0]
        return rows

    def _decode_foreign(self, payload: bytes) -> Rows:
        from google.protobuf.message import DecodeError

        message = self.message_class()
        try:
            message.ParseFromString(payload)
        except DecodeError as error:
            raise ValueError(f"{len(payload)} bytes are not a {self._definition.name} message: {error}") from None
        messages: Iterable[Message] = message.rows  # type: ignore[attr-defined]  # a class made at run time
        rows = np.zeros(len(list(messages)), self.dtype)
        for column in self._definition.columns:
            if column.optional:
                rows[column.name] = [
                    getattr(r, column.name) if r.HasField(column.name) else column.missing for r in messages
                ]
            else:
                rows[column.name] = [getattr(r, column.name) for r in messages]
        rows.flags.writeable = False
        return rows

    @cached_property
    def message_class(self) -> type[Message]:
        """The class of the protobuf runtime for this schema, in a separate descriptor pool."""
        from google.protobuf.descriptor_pool import DescriptorPool
        from google.protobuf.message_factory import GetMessageClass

        pool = DescriptorPool()
        for file in self._definition.file_descriptor_set().file:
            pool.Add(file)
        message_class: Any = GetMessageClass(pool.FindMessageTypeByName(self._definition.name))
        return message_class  # type: ignore[no-any-return]


def _are_missing(column: Column, rows: Rows) -> Bools:
    """Whether a column is missing in each row, or 0 if it can't be."""
    values = rows[column.name]
    return np.isnan(values) if column.is_nullable else np.asarray(values == column.missing)
