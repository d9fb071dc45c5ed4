"""Chunks and the messages in them: opened within bounds, checked, and read without a loop over messages.

Letters: M messages.
"""

from __future__ import annotations

import mmap
import zlib
from typing import Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mcaptrack import environment
from mcaptrack.log import records
from mcaptrack.log.records import ChunkIndexRecord, Damaged, Record, walk

Ints = NDArray[np.int64]
Entries = NDArray[np.uint64]

#: A chunk that says it is larger is not decompressed, unless the environment allows it.
MAX_CHUNK_MIB: Final = 256
ENVIRONMENT: Final = "MCAPTRACK_MAX_CHUNK_MIB"
#: The last time that a log can hold, in nanoseconds: a signed number of 64 bits, in the year 2262.
MAX_NS: Final = 2**63 - 1
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


class Heads(NamedTuple):
    """M messages of one channel in a chunk: their record heads (M,) of ``HEAD``, and where payloads start and end."""

    content: memoryview
    head: NDArray[np.void]
    start: Ints
    end: Ints


def message_head(buffer: memoryview, record: Record) -> tuple[int, int, int, int]:
    """Channel, sequence, log time and publish time of a message record."""
    if record.end - record.body < records.MESSAGE_HEAD.size:
        raise Damaged(f"a message of {record.end - record.body} bytes", record.start)
    head: tuple[int, int, int, int] = records.MESSAGE_HEAD.unpack_from(buffer, record.body)
    return head


def chunk_record(buffer: memoryview, chunk: ChunkIndexRecord) -> Record:
    """The chunk that an index points to."""
    record = records.record_at(buffer, chunk.offset)
    if record.opcode != Opcode.CHUNK:
        raise Damaged("no chunk where one belongs", chunk.offset)
    return record


def open_chunk(buffer: memoryview, record: Record) -> memoryview:
    """The records inside a chunk, decompressed and checked. Memory is bounded by what the chunk says of itself."""
    head = records.read_chunk(buffer, record)
    if head.compression and head.uncompressed_size > _most_mib() * 2**20:
        raise Damaged(
            f"a chunk of {head.uncompressed_size} bytes, of at most {_most_mib()} MiB that are "
            f"opened (the variable {ENVIRONMENT} sets another limit)",
            record.start,
        )
    data = buffer[head.start : head.end]
    content = _decompress(data, head.compression, head.uncompressed_size, record.start)
    if len(content) != head.uncompressed_size:
        raise Damaged(f"a chunk of {len(content)} bytes that says {head.uncompressed_size}", record.start)
    if head.uncompressed_crc and zlib.crc32(content) != head.uncompressed_crc:
        raise Damaged("the checksum of a chunk is wrong", record.start)
    return content


def _most_mib() -> int:
    return environment.whole_number(ENVIRONMENT, MAX_CHUNK_MIB)


def _decompress(data: memoryview, compression: str, size: int, where: int) -> memoryview:
    """The data of a chunk that is ``size`` bytes long, or one byte more where it would be longer."""
    if compression == "":
        return data
    try:
        if compression == "zstd":
            return memoryview(_zstd(data, size))
        if compression == "lz4":
            return memoryview(_lz4(data, size))
    except RuntimeError as error:
        raise Damaged(f"a chunk can't be decompressed ({error})", where) from None
    raise Damaged(f"a chunk is compressed with {compression!r}, which is not known here", where)


def _zstd(data: memoryview, size: int) -> bytes:
    import zstandard

    try:
        if zstandard.frame_content_size(data) > size:  # -1 where the data don't say; then the limit holds
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


def forget(buffer: memoryview, start: int, end: int) -> None:
    """Let go of the memory that reading a part of a mapped file took; the bytes stay readable."""
    mapped = buffer.obj
    first = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE
    if isinstance(mapped, mmap.mmap) and end - first >= mmap.PAGESIZE:
        mapped.madvise(mmap.MADV_DONTNEED, first, end - first)


def crc_of(buffer: memoryview, start: int, end: int, crc: int = 0) -> int:
    """The checksum of a part of a file, going on from that of what stands before; the memory is let go of again."""
    for at in range(start, end, records.BLOCK):
        until = min(at + records.BLOCK, end)
        crc = zlib.crc32(buffer[at:until], crc)
        forget(buffer, at, until)
    return crc


def listed_entries(buffer: memoryview, at: int, channel_id: int) -> Entries:
    """What the message index at ``at`` lists of a channel: log time and offset inside the chunk, (M, 2)."""
    record = records.record_at(buffer, at)
    channel, listed = records.read_message_entries(buffer, record)
    if channel != channel_id:
        raise Damaged(f"no message index of channel {channel_id} where one belongs", at)
    if len(listed) % 16:
        raise Damaged(f"a message index of {len(listed)} bytes", at)
    entries = np.frombuffer(listed, "<u8").reshape(-1, 2)
    if len(entries) and entries[:, 1].max() > MAX_NS:
        raise Damaged("a message index that points beyond any chunk", at)
    if len(np.unique(entries[:, 1])) != len(entries):
        raise Damaged("a message index that lists a message twice", at)
    return entries


def check_times(entries: Entries) -> None:
    """Raises Damaged if a message is later than any time that is worked with."""
    if len(entries) and entries[:, 0].max() > MAX_NS:
        raise Damaged("a message has a time beyond the year 2262")


def chunk_entries(content: memoryview) -> dict[int, Entries]:
    """What the message indexes of a chunk have to say: for each channel log time and offset of its messages, (M, 2)."""
    found: dict[int, list[tuple[int, int]]] = {}
    for record in walk(content, 0, len(content)):
        if record.opcode == Opcode.MESSAGE:
            channel, _, t_ns, _ = message_head(content, record)
            found.setdefault(channel, []).append((t_ns, record.start))
    return {channel: np.array(entries, "<u8") for channel, entries in found.items()}


def heads_at(content: memoryview, channel_id: int, t_ns: Ints, offset: Ints) -> Heads:
    """The messages that an index says stand at these offsets, at these times. Raises Damaged where one does not."""
    room = len(content) - HEAD.itemsize
    outside = offset[(offset < 0) | (offset > room)]
    if len(outside):
        raise Damaged(f"a message is said to stand at byte {outside[0]} of a chunk of {len(content)}")
    raw = np.frombuffer(content, np.uint8)
    if len(offset):
        head = np.lib.stride_tricks.sliding_window_view(raw, HEAD.itemsize)[offset].view(HEAD)[:, 0]
    else:
        head = np.empty(0, HEAD)
    wrong = (head["opcode"] != Opcode.MESSAGE) | (head["channel"] != channel_id) | (head["t_ns"] != t_ns)
    wrong |= head["size"] < records.MESSAGE_HEAD.size
    start = offset + HEAD.itemsize
    # A size beyond the chunk is found out here, before it is added to anything.
    wrong |= head["size"] > (len(content) - start + records.MESSAGE_HEAD.size).astype(np.uint64)
    if wrong.any():
        time = int(t_ns[wrong.argmax()])
        raise Damaged(f"no message of channel {channel_id} at {time} ns where the index says one is")
    return Heads(content, head, start, start + head["size"].astype(np.int64) - records.MESSAGE_HEAD.size)
