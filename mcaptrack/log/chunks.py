"""Chunks and their messages: decompressed within limits, checked, and parsed without a loop over messages.

Letters: M messages.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from mcaptrack import environment
from mcaptrack.geometry.arrays import Ints
from mcaptrack.log import records
from mcaptrack.log.byte_source import ByteSource
from mcaptrack.log.records import Bytes, ChunkHead, Damaged, Record, crc_of, walk

Times = NDArray[np.uint64]
Entries = NDArray[np.uint64]

#: A chunk that declares a larger size is not decompressed, unless the environment variable allows it.
MAX_CHUNK_MIB: Final = 256
ENVIRONMENT: Final = "MCAPTRACK_MAX_CHUNK_MIB"
#: A larger uncompressed chunk is not read into memory as a whole.
_MAX_PLAIN_BYTES: Final = 64 * 2**20
#: Up to this many message heads are read one by one.
_FEW: Final = 16
#: The last time that can be computed with, in nanoseconds: the largest int64, in the year 2262.
MAX_NS: Final = 2**63 - 1
#: The last time that a log can store: the largest uint64.
LOG_MAX_NS: Final = 2**64 - 1
#: A message record up to its payload.
HEAD: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("size", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("t_ns", "<u8"),
        ("publish_ns", "<u8"),
    ]
)


class MessageHeads(NamedTuple):
    """M messages: their record heads (M,) of ``HEAD``, and where payloads start and end."""

    head: NDArray[np.void]
    start: Ints
    end: Ints


def message_head(buffer: Bytes, record: Record) -> tuple[int, int, int, int]:
    """Channel, sequence, log time and publish time of a message record.

    ``record`` is that of the message in ``buffer``. Times are in ns. Raises Damaged if it is too short.
    """
    if record.end - record.body < records.MESSAGE_HEAD.size:
        raise Damaged(f"a message of {record.end - record.body} bytes", record.start)
    head: tuple[int, int, int, int] = records.MESSAGE_HEAD.unpack(
        buffer[record.body : record.body + records.MESSAGE_HEAD.size]
    )
    return head


def chunk_record(buffer: Bytes, chunk: ChunkIndex) -> Record:
    """The record of an indexed chunk."""
    return _chunk_at(buffer, chunk.chunk_start_offset)


def _chunk_at(buffer: Bytes, offset: int) -> Record:
    record = records.record_at(buffer, offset)
    if record.opcode != Opcode.CHUNK:
        raise Damaged("there is no chunk where the index says", offset)
    return record


def open_chunk(buffer: Bytes, record: Record) -> Bytes:
    """The records inside a chunk, decompressed and verified. The declared size limits the memory used.

    A large uncompressed chunk stays in the file; its records are read on demand.

    ``record`` is that of the chunk in ``buffer``. Raises Damaged if it can't be decompressed, or isn't what it
    declares.
    """
    head = records.read_chunk(buffer, record)
    return _opened(head, _data(buffer, head), record.start)


def open_chunk_with_checksum(buffer: Bytes, record: Record) -> tuple[Bytes, int]:
    """The same, and the checksum of the chunk as it was read (see ``checksum_at``)."""
    head = records.read_chunk(buffer, record)
    data = _data(buffer, head)
    return _opened(head, data, record.start), head.uncompressed_crc or crc_of(data, 0, len(data))


def _data(buffer: Bytes, head: ChunkHead) -> Bytes:
    if isinstance(buffer, ByteSource) and is_left_in_file(head.compression, head.end - head.start):
        return buffer.part(head.start, head.end)
    return buffer[head.start : head.end]


def _opened(head: ChunkHead, data: Bytes, where: int) -> Bytes:
    if head.compression and head.uncompressed_size > _max_chunk_mib() * 2**20:
        raise Damaged(
            f"a chunk of {head.uncompressed_size} bytes, of at most {_max_chunk_mib()} MiB that are "
            f"opened (the variable {ENVIRONMENT} sets another limit)",
            where,
        )
    content = _decompress(data, head.compression, head.uncompressed_size, where)
    if len(content) != head.uncompressed_size:
        raise Damaged(f"a chunk of {len(content)} bytes that says {head.uncompressed_size}", where)
    if head.uncompressed_crc and crc_of(content, 0, len(content)) != head.uncompressed_crc:
        raise Damaged("the checksum of a chunk is wrong", where)
    return content


def is_left_in_file(compression: str, size: int) -> bool:
    """Whether a chunk is opened without reading all of it into memory."""
    return not compression and size > _MAX_PLAIN_BYTES


def checksum_at(buffer: Bytes, offset: int) -> int:
    """The checksum that identifies the chunk at ``offset``: the stored one, or else that of its bytes."""
    head = records.read_chunk(buffer, _chunk_at(buffer, offset))
    return head.uncompressed_crc or crc_of(buffer, head.start, head.end)


def _max_chunk_mib() -> int:
    return environment.whole_number(ENVIRONMENT, MAX_CHUNK_MIB)


def _decompress(data: Bytes, compression: str, size: int, where: int) -> Bytes:
    """The decompressed data of a chunk of ``size`` bytes; at most one byte more if it would be longer."""
    if compression == "":
        return data
    try:
        if compression == "zstd":
            return memoryview(_zstd(data[0 : len(data)], size))
        if compression == "lz4":
            return memoryview(_lz4(data[0 : len(data)], size))
    except RuntimeError as error:
        raise Damaged(f"a chunk can't be decompressed ({error})", where) from None
    raise Damaged(f"a chunk is compressed with {compression!r}, which is not known here", where)


def _zstd(data: memoryview, size: int) -> bytes:
    import zstandard

    try:
        if (
            zstandard.frame_content_size(data) > size
        ):  # -1 if the frame doesn't declare its size; then the output limit applies
            return bytes(size + 1)
        return zstandard.ZstdDecompressor(max_window_size=2**27).decompress(data, max_output_size=max(size, 1))
    except zstandard.ZstdError as error:
        raise RuntimeError(str(error)) from None


def _lz4(data: memoryview, size: int) -> bytes:
    import lz4.frame

    frame = lz4.frame.LZ4FrameDecompressor()
    content: bytes = frame.decompress(data, max_length=size + 1)
    if len(content) <= size and not frame.eof:
        raise RuntimeError("it is cut off")
    return content


def read_index_entries(buffer: Bytes, at: int, channel_id: int) -> Entries:
    """The entries of the message index at offset ``at``: log time and offset inside the chunk, (M, 2)."""
    record = records.record_at(buffer, at)
    channel, listed = records.read_message_entries(buffer, record)
    if channel != channel_id:
        raise Damaged(f"there is no message index of channel {channel_id} where the chunk index says", at)
    if len(listed) % 16:
        raise Damaged(f"a message index of {len(listed)} bytes", at)
    entries = np.frombuffer(listed, "<u8").reshape(-1, 2)
    if len(entries) and entries[:, 1].max() > MAX_NS:
        raise Damaged("a message index points beyond any chunk", at)
    is_in_order = bool((entries[1:, 1] > entries[:-1, 1]).all())
    if not is_in_order and len(np.unique(entries[:, 1])) != len(entries):
        raise Damaged("a message index lists a message twice", at)
    return entries


def scan_entries(content: Bytes) -> dict[int, Entries]:
    """The entries that the message indexes of a chunk must have: for each channel log time and offset, (M, 2)."""
    entries_of: dict[int, list[tuple[int, int]]] = {}
    for record in walk(content, 0, len(content)):
        if record.opcode == Opcode.MESSAGE:
            channel, _, t_ns, _ = message_head(content, record)
            entries_of.setdefault(channel, []).append((t_ns, record.start))
    return {channel: np.array(entries, "<u8") for channel, entries in entries_of.items()}


def records_between(content: Bytes, start: Ints, end: Ints) -> Iterator[Record]:
    """The records of a chunk beside messages that start and end there, (M,)."""
    low, high = np.append(0, np.sort(end)), np.append(np.sort(start), len(content))
    for first, last in zip(low[low < high].tolist(), high[low < high].tolist(), strict=True):
        yield from walk(content, first, last)


def contents_of(listed: ChunkIndex, channels: Mapping[int, ChannelRecord]) -> str:
    """The topics and the times of the messages of a chunk, as text."""
    topics = sorted({channels[number].topic for number in listed.message_index_offsets if number in channels})
    span = f"{listed.message_start_time / 1e9:.3f} to {listed.message_end_time / 1e9:.3f} s"
    return f"messages of {', '.join(topics) or 'no topic'} from {span}"


def message_heads_at(content: Bytes, channel_id: int | NDArray[np.uint16], t_ns: Times, offset: Ints) -> MessageHeads:
    """The heads of indexed messages: of one channel, or each of its own, (M,).

    Raises Damaged if there is no such message at one of the offsets.
    """
    room = len(content) - HEAD.itemsize
    outside = offset[(offset < 0) | (offset > room)]
    if len(outside):
        raise Damaged(f"an index places a message at byte {outside[0]} of a chunk of {len(content)} bytes")
    if not len(offset):
        head = np.empty(0, HEAD)
    elif isinstance(content, memoryview) and len(offset) > _FEW:
        raw = np.frombuffer(content, np.uint8)
        head = np.lib.stride_tricks.sliding_window_view(raw, HEAD.itemsize)[offset].view(HEAD)[:, 0]
    else:
        head = np.frombuffer(b"".join(content[at : at + HEAD.itemsize] for at in offset.tolist()), HEAD)
    wrong = (head["opcode"] != Opcode.MESSAGE) | (head["channel"] != channel_id) | (head["t_ns"] != t_ns)
    wrong |= head["size"] < records.MESSAGE_HEAD.size
    start = offset + HEAD.itemsize
    # A size beyond the chunk is rejected here, before it is used in a sum that could overflow.
    wrong |= head["size"] > (len(content) - start + records.MESSAGE_HEAD.size).astype(np.uint64)
    if wrong.any():
        first = int(wrong.argmax())
        channel = int(np.broadcast_to(channel_id, len(t_ns))[first])
        raise Damaged(f"there is no message of channel {channel} at {int(t_ns[first])} ns where the index says")
    return MessageHeads(head, start, start + head["size"].astype(np.int64) - records.MESSAGE_HEAD.size)
