"""The row codec: protobuf payloads that are NumPy arrays.

All fields of a row have a fixed width, so every row of a schema takes the same number of bytes on the wire and the tag
bytes always stand at the same places. A payload is therefore a structured array with the tags as padding: encoding
fills a template, decoding is a view. What another protobuf writer made of the same schema (default values left out,
fields in another order) has another length or other tags; that is detected and given to the protobuf runtime.

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
    """Rows of one schema <-> payload bytes. ``dtype`` is the layout of a row on the wire, tags included as padding."""

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
        # Which bits of a row are ours to say: all of the tags, and of a bool all but the lowest, since any byte but 0
        # and 1 would be a longer varint or a true that NumPy can't hold.
        fixed = np.full(len(self._template), 0xFF, np.uint8)
        for column, offset in zip(definition.columns, offsets, strict=True):
            fixed[offset : offset + KINDS[column.kind][1]] = 0xFE if column.kind == "bool" else 0
        self._fixed = fixed
        self._data = np.where(fixed == 0xFF, 0, 0xFF).astype(np.uint8)
        self._tags = self._template.tobytes()
        fixed_at = np.flatnonzero(fixed).tolist()
        self._fixed_bytes = [(at, fixed[at], self._template[at] & fixed[at]) for at in fixed_at]

    def encode(self, rows: Rows) -> bytes:
        """One payload of N rows. ``rows`` must have the columns of the schema, in any memory layout."""
        if rows.dtype == self.dtype:
            raw = np.ascontiguousarray(rows).view(np.uint8).reshape(-1, len(self._template))
            return (raw & self._data | self._template).tobytes()
        wire = np.empty(len(rows), self.dtype)
        for name in self.dtype.names or ():
            wire[name] = rows[name]
        return self.encode(wire)

    def decode(self, payload: bytes) -> Rows:
        """The N rows of one payload, read-only; a view of ``payload`` where it is laid out as ours.

        Raises ValueError if the payload is no message of this schema.
        """
        if self._is_ours(payload):
            return np.frombuffer(payload, self.dtype)
        return self._decode_foreign(payload)

    def decode_all(self, payloads: Sequence[bytes]) -> tuple[Rows, NDArray[np.int64]]:
        """Many payloads as one array of rows, and the number of rows in each."""
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
        """Payloads that stand from ``start`` (M,) to ``end`` (M,) in ``raw``, as ``decode_all`` gives them.

        None where one is laid out otherwise than ours.
        """
        size = self.dtype.itemsize
        counts, over = np.divmod(end - start, size)
        if over.any():
            return None
        if not counts.any():
            return np.empty(0, self.dtype), counts
        block = np.lib.stride_tricks.sliding_window_view(raw, size)[ragged_range(start, counts, step=size)]
        # A column at a time: few bytes of a row are fixed.
        if any(((block[:, at] & mask) != tag).any() for at, mask, tag in self._fixed_bytes):
            return None
        return block.view(self.dtype)[:, 0], counts

    def longer(self, rows: Rows, taken: int, length: int) -> Rows:
        """An array of this length that begins with the first ``taken`` rows; what follows is not set."""
        out = np.empty((length, self.dtype.itemsize), np.uint8)
        out[:taken] = self._bytes(rows[:taken])
        return out.view(self.dtype)[:, 0]

    def put(self, rows: Rows, at: int, part: Rows) -> None:
        """Rows of this layout into others; as bytes, since NumPy copies structured arrays field by field."""
        self._bytes(rows)[at : at + len(part)] = self._bytes(part)

    def _bytes(self, rows: Rows) -> NDArray[np.uint8]:
        return np.asarray(rows.view(np.uint8).reshape(-1, self.dtype.itemsize), np.uint8)

    def _is_ours(self, payload: bytes) -> bool:
        """Whether every tag stands where our encoder puts it: then each byte between them is what we say it is."""
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
            raise ValueError(f"{len(payload)} bytes are no {self._definition.name} message: {error}") from None
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
        """The protobuf runtime's class for this schema, in a pool of its own."""
        from google.protobuf.descriptor_pool import DescriptorPool
        from google.protobuf.message_factory import GetMessageClass

        pool = DescriptorPool()
        for file in self._definition.file_descriptor_set().file:
            pool.Add(file)
        message_class: Any = GetMessageClass(pool.FindMessageTypeByName(self._definition.name))
        return message_class  # type: ignore[no-any-return]
