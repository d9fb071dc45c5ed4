"""The row codec: protobuf payloads as NumPy arrays, without a loop over rows.

All fields of a row have a fixed width, so that every row of a schema has the same number of bytes on the wire, with tag
bytes at fixed offsets. A payload is therefore a structured array with the tags as padding: encoding fills a template,
decoding is a view. Payloads of other protobuf writers (default values omitted, fields in another order) have another
length or other tags; they are detected and decoded by the protobuf runtime.

Letters: N rows, M messages.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.ragged import ragged_range
from mcaptrack.schema.proto import KINDS, Definition

if TYPE_CHECKING:
    from google.protobuf.message import Message

Rows = NDArray[np.void]


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


class RowCodec:
    """Rows of one schema <-> payload bytes. ``dtype`` is the layout of a row on the wire, with tags as padding."""

    def __init__(self, definition: Definition) -> None:
        self._definition = definition
        body, at = bytearray(), []
        for column in definition.columns:
            _, width, wire_type, _ = KINDS[column.kind]
            body += _varint(column.number << 3 | wire_type)
            at.append(len(body))
            body += bytes(width)
        head = b"\x0a" + _varint(len(body))  # field 1 of the message, length-delimited
        offsets = [len(head) + offset for offset in at]
        self._template = np.frombuffer(head + body, np.uint8)
        self.dtype = np.dtype(
            {
                "names": [column.name for column in definition.columns],
                "formats": [KINDS[column.kind][0] for column in definition.columns],
                "offsets": offsets,
                "itemsize": len(self._template),
            }
        )
        # The fixed bits of a row: all bits of tags, and all but the lowest bit of a bool, because other bytes than 0
        # and 1 are longer varints, or true values that NumPy can't represent.
        fixed = np.full(len(self._template), 0xFF, np.uint8)
        for column, offset in zip(definition.columns, offsets, strict=True):
            fixed[offset : offset + KINDS[column.kind][1]] = 0xFE if column.kind == "bool" else 0
        self._fixed = fixed
        self._data = np.where(fixed == 0xFF, 0, 0xFF).astype(np.uint8)
        self._tags = self._template.tobytes()
        fixed_at = np.flatnonzero(fixed).tolist()
        self._fixed_bytes = [(at, fixed[at], self._template[at] & fixed[at]) for at in fixed_at]

    def encode(self, rows: Rows) -> bytes:
        """Encode N rows as one payload. ``rows`` must have the columns of the schema, in any memory layout."""
        if rows.dtype == self.dtype:
            raw = np.ascontiguousarray(rows).view(np.uint8).reshape(-1, len(self._template))
            return (raw & self._data | self._template).tobytes()
        wire = np.empty(len(rows), self.dtype)
        for name in self.dtype.names or ():
            wire[name] = rows[name]
        return self.encode(wire)

    def decode(self, payload: bytes) -> Rows:
        """Decode one payload to N read-only rows; a view of ``payload`` if it has this codec's layout.

        Raises ValueError if the payload is not a message of this schema.
        """
        if self._is_ours(payload):
            return np.frombuffer(payload, self.dtype)
        return self._decode_foreign(payload)

    def decode_all(self, payloads: Sequence[bytes]) -> tuple[Rows, NDArray[np.int64]]:
        """Decode many payloads to one array of rows, and the number of rows in each."""
        joined = b"".join(payloads)
        size = self.dtype.itemsize
        if self._is_ours(joined) and all(len(payload) % size == 0 for payload in payloads):
            counts = np.fromiter((len(payload) // size for payload in payloads), np.int64, len(payloads))
            return np.frombuffer(joined, self.dtype), counts
        parts = [self.decode(payload) for payload in payloads]
        rows = np.concatenate(parts) if parts else np.empty(0, self.dtype)
        return rows, np.array([len(part) for part in parts], np.int64)

    def decode_at(
        self, raw: NDArray[np.uint8], start: NDArray[np.int64], end: NDArray[np.int64]
    ) -> tuple[Rows, NDArray[np.int64]] | None:
        """Decode the payloads from ``start`` (M,) to ``end`` (M,) in ``raw``, as ``decode_all`` does.

        None if one has another layout than this codec's.
        """
        size = self.dtype.itemsize
        counts, over = np.divmod(end - start, size)
        if over.any():
            return None
        if not counts.any():
            return np.empty(0, self.dtype), counts
        block = np.lib.stride_tricks.sliding_window_view(raw, size)[ragged_range(start, counts, step=size)]
        # By column, because few bytes of a row are fixed.
        if any(((block[:, at] & mask) != tag).any() for at, mask, tag in self._fixed_bytes):
            return None
        return block.view(self.dtype)[:, 0], counts

    def longer(self, rows: Rows, taken: int, length: int) -> Rows:
        """An array of ``length`` rows that begins with the first ``taken`` rows; the others are not initialised."""
        out = np.empty((length, self.dtype.itemsize), np.uint8)
        out[:taken] = self._bytes(rows[:taken])
        return out.view(self.dtype)[:, 0]

    def put(self, rows: Rows, at: int, part: Rows) -> None:
        """Copy rows into others of this layout; as bytes, because NumPy copies structured arrays field by field."""
        self._bytes(rows)[at : at + len(part)] = self._bytes(part)

    def _bytes(self, rows: Rows) -> NDArray[np.uint8]:
        return np.asarray(rows.view(np.uint8).reshape(-1, self.dtype.itemsize), np.uint8)

    def _is_ours(self, payload: bytes) -> bool:
        """Whether every tag is where ``encode`` writes it; then all other bytes are values of the columns."""
        size = len(self._template)
        if len(payload) % size:
            return False
        raw = np.frombuffer(payload, np.uint8).reshape(-1, size)
        return (raw & self._fixed).tobytes() == self._tags * len(raw)

    def _decode_foreign(self, payload: bytes) -> Rows:
        from google.protobuf.message import DecodeError

        message = self.message_class()
        try:
            message.ParseFromString(payload)
        except DecodeError as error:
            raise ValueError(f"{len(payload)} bytes are not a {self._definition.name} message: {error}") from None
        found: Iterable[Message] = message.rows  # type: ignore[attr-defined]  # a class made at run time
        rows = np.zeros(len(list(found)), self.dtype)
        for column in self._definition.columns:
            if column.optional:
                rows[column.name] = [getattr(r, column.name) if r.HasField(column.name) else np.nan for r in found]
            else:
                rows[column.name] = [getattr(r, column.name) for r in found]
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
