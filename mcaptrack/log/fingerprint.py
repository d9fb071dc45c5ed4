"""Fingerprints of logs and channels, made of index records and checksums instead of messages."""

from __future__ import annotations

import hashlib

from mcaptrack.log import records
from mcaptrack.log.chunks import chunk_record
from mcaptrack.log.index import Index
from mcaptrack.log.records import BLOCK, Bytes, ChunkIndexRecord, record_at


def fingerprint(
    buffer: Bytes, index: Index, channel_id: int | None = None, checksums: dict[int, int | str] | None = None
) -> str:
    """SHA-256 of a channel, or of the whole log: of schemas, channels, and the times and checksum of each chunk.

    Chunks and attachments without checksum, and messages outside of chunks, are hashed themselves. ``checksums`` caches
    those of chunks by offset, for further calls with the same ``buffer``.
    """
    checksums = {} if checksums is None else checksums
    total = hashlib.sha256()

    def say(*words: object) -> None:
        total.update(repr(words).encode())

    for number in sorted(index.channels) if channel_id is None else [channel_id]:
        channel = index.channels[number]
        schema = index.schemas.get(channel.schema_id)
        described = (schema.name, schema.encoding, hashlib.sha256(schema.data).hexdigest()) if schema else ()
        kept = sorted(channel.metadata.items())
        say(channel.topic, channel.message_encoding, kept, described, index.counts.get(number, 0))
    for chunk in index.chunks if channel_id is None else index.chunks.with_channels([channel_id]):
        # Offsets of chunks matter for the whole log, because they locate its messages, but not for one channel.
        place = (chunk.offset, *sorted(chunk.message_index_offsets)) if channel_id is None else ()
        if chunk.offset not in checksums:
            checksums[chunk.offset] = _checksum(buffer, chunk)
        say(place, chunk.start_ns, chunk.end_ns, chunk.uncompressed_size, checksums[chunk.offset])
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


def _checksum(buffer: Bytes, chunk: ChunkIndexRecord) -> int | str:
    head = records.read_chunk(buffer, chunk_record(buffer, chunk))
    if head.uncompressed_crc:
        return head.uncompressed_crc
    whole = hashlib.sha256()
    _take(whole, buffer, head.start, head.end)
    return whole.hexdigest()


def _take(total: hashlib._Hash, buffer: Bytes, start: int, end: int) -> None:
    for at in range(start, end, BLOCK):
        total.update(buffer[at : min(at + BLOCK, end)])
