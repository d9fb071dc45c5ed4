"""Fingerprints of logs and channels, made of index records and checksums instead of messages."""

from __future__ import annotations

import hashlib

import numpy as np

from mcaptrack.geometry.arrays import Ints
from mcaptrack.log import records
from mcaptrack.log.chunks import chunk_record
from mcaptrack.log.index import Index
from mcaptrack.log.records import BLOCK, Bytes, record_at


class Checksums:
    """The checksums of chunks by their number, as far as they are known, (C,); digests of those without a checksum."""

    def __init__(self) -> None:
        self._numbers: Ints = np.empty(0, np.int64)
        self._digests: dict[int, str] = {}

    def of(self, buffer: Bytes, index: Index, row: int) -> int | str:
        """The checksum of a chunk, which is read once."""
        if not len(self._numbers):
            self._numbers = np.full(len(index.chunks), -1)
        found = int(self._numbers[row])
        if found > 0:
            return found
        if found < 0:
            chunk = index.chunks[row]
            head = records.read_chunk(buffer, chunk_record(buffer, chunk))
            self._numbers[row] = head.uncompressed_crc
            if head.uncompressed_crc:
                return head.uncompressed_crc
            whole = hashlib.sha256()
            _take(whole, buffer, head.start, head.end)
            self._digests[row] = whole.hexdigest()
        return self._digests[row]


def fingerprint(buffer: Bytes, index: Index, channel_id: int | None = None, checksums: Checksums | None = None) -> str:
    """SHA-256 of a channel, or of the whole log: of schemas, channels, and the times and checksum of each chunk.

    Chunks and attachments without checksum, and messages outside of chunks, are hashed themselves. ``checksums`` keeps
    those of chunks for further calls with the same ``buffer`` and ``index``.
    """
    checksums = checksums or Checksums()
    total = hashlib.sha256()

    def say(*words: object) -> None:
        total.update(repr(words).encode())

    for number in sorted(index.channels) if channel_id is None else [channel_id]:
        channel = index.channels[number]
        schema = index.schemas.get(channel.schema_id)
        described = (schema.name, schema.encoding, hashlib.sha256(schema.data).hexdigest()) if schema else ()
        kept = sorted(channel.metadata.items())
        say(channel.topic, channel.message_encoding, kept, described, index.counts.get(number, 0))
    rows = range(len(index.chunks)) if channel_id is None else index.chunks.rows_with([channel_id]).tolist()
    for row in rows:
        chunk = index.chunks[row]
        # Offsets of chunks matter for the whole log, because they locate its messages, but not for one channel.
        place = (chunk.offset, *sorted(chunk.message_index_offsets)) if channel_id is None else ()
        say(place, chunk.start_ns, chunk.end_ns, chunk.uncompressed_size, checksums.of(buffer, index, row))
    for number in sorted(index.loose) if channel_id is None else [channel_id]:
        for offset in index.loose[number][:, 1].tolist() if number in index.loose else []:
            record = record_at(buffer, offset)
            _take(total, buffer, record.start, record.end)
    if channel_id is None:
        for listed in index.metadata:
            record = record_at(buffer, listed.offset)
            _take(total, buffer, record.start, record.end)
        for listed in index.attachments:
            record = record_at(buffer, listed.offset)
            checksum = bytes(buffer[record.end - 4 : record.end])
            say(listed.name, listed.offset, record.end - record.start, checksum)
            if checksum == bytes(4):
                _take(total, buffer, record.start, record.end)
    return total.hexdigest()


def _take(total: hashlib._Hash, buffer: Bytes, start: int, end: int) -> None:
    for at in range(start, end, BLOCK):
        total.update(buffer[at : min(at + BLOCK, end)])
