"""Chunks, message indexes and heads of messages, just inside and outside of what they declare; damage that is moved."""

from __future__ import annotations

import heapq
import struct
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from mcap.writer import CompressionType

from mcaptrack import log
from mcaptrack.log import chunks, messages, records
from mcaptrack.log.byte_source import ByteSource, OpenFile
from mcaptrack.log.chunks import checksum_at, message_heads_at, open_chunk, read_index_entries
from mcaptrack.log.index import ChunkList
from mcaptrack.log.messages import Messages
from mcaptrack.log.records import Damaged, chunk_index, pack, pack_chunk, pack_message_index, record_at
from tests.logs import stock_messages, write_stock

SOME = [(topic, 10 * n, n, topic.encode() * (n + 1)) for n in range(20) for topic in "ab"]
CONTENT = bytes(range(250)) * 40
STREAMED = zstandard.ZstdCompressor().compressobj()
COMPRESSED = {
    "": [CONTENT],
    # The second one doesn't declare its size.
    "zstd": [zstandard.compress(CONTENT), STREAMED.compress(CONTENT) + STREAMED.flush()],
    "lz4": [lz4.frame.compress(CONTENT)],
}
recovering = sys.modules["mcaptrack.log.recover"]
ALL = [(name, data) for name, several in COMPRESSED.items() for data in several]


def opened(compression: str, data: bytes, size: int, crc: int = 0) -> bytes:
    buffer = memoryview(pack_chunk((0, 0, size, crc), compression, data))
    content = open_chunk(buffer, record_at(buffer, 0))
    return bytes(content[0 : len(content)])


@pytest.mark.parametrize(("compression", "data"), ALL)
def test_a_chunk_has_the_size_and_the_checksum_that_it_declares(compression, data):
    crc, size = zlib.crc32(CONTENT), len(CONTENT)
    assert opened(compression, data, size) == opened(compression, data, size, crc) == CONTENT
    with pytest.raises(Damaged, match="byte 0: the checksum of a chunk is wrong"):
        opened(compression, data, size, crc ^ 1)
    for wrong in (size - 1, size + 1, 0):
        with pytest.raises(Damaged, match=rf"a chunk of \d+ bytes that says {wrong}|can't be decompressed"):
            opened(compression, data, wrong, crc)
    if compression:
        for cut in (data[:-1], data[:-20], b""):
            with pytest.raises(Damaged):
                opened(compression, cut, size)


def test_the_largest_chunk_that_is_opened(monkeypatch):
    monkeypatch.setenv("MCAPTRACK_MAX_CHUNK_MIB", "1")
    whole = bytes(2**20 + 1)
    assert len(opened("zstd", zstandard.compress(whole[1:]), 2**20)) == 2**20
    with pytest.raises(Damaged, match="byte 0: a chunk of 1048577 bytes, of at most 1 MiB that are opened"):
        opened("zstd", zstandard.compress(whole), 2**20 + 1)
    assert len(opened("", whole, 2**20 + 1)) == 2**20 + 1  # nothing is made larger
    with pytest.raises(Damaged, match="is compressed with 'snappy', which is not known here"):
        opened("snappy", b"", 0)


def test_a_chunk_is_identified_by_its_checksum_or_that_of_its_bytes():
    buffer = b"beside" + pack_chunk((1, 2, 3, 77), "", b"abc") + pack_chunk((1, 2, 3, 0), "zstd", b"xyz")
    second = buffer.rindex(bytes([Opcode.CHUNK, 8 + 8 + 8 + 4 + 4 + 4 + 8 + 3]))
    assert checksum_at(memoryview(buffer), 6) == 77
    assert checksum_at(memoryview(buffer), second) == zlib.crc32(b"xyz")
    for at in (0, 7):
        with pytest.raises(Damaged):
            checksum_at(memoryview(pack(Opcode.METADATA, bytes(40)) + buffer), at)


def entries(*pairs: tuple[int, int]) -> bytes:
    return np.array(pairs, "<u8").tobytes()


def test_entries_of_a_message_index():
    def read(data: bytes, channel: int = 3) -> list:
        buffer = memoryview(b"???" + pack_message_index(3, data))
        return read_index_entries(buffer, 3, channel).tolist()

    most = 2**63 - 1
    assert read(entries((9, 0), (2**64 - 1, most), (9, 40))) == [[9, 0], [2**64 - 1, most], [9, 40]]
    assert read(b"") == []
    for data, channel, said in (
        (entries((9, 0)), 4, "byte 3: there is no message index of channel 4 where the chunk index says"),
        (entries((9, 0)) + b"?", 3, "byte 3: a message index of 17 bytes"),
        (entries((9, 0), (9, most + 1)), 3, "byte 3: a message index points beyond any chunk"),
        (entries((9, 5), (8, 6), (7, 5)), 3, "byte 3: a message index lists a message twice"),
    ):
        with pytest.raises(Damaged, match=said):
            read(data, channel)


def message(channel: int, t_ns: int, data: bytes, grown: int = 0) -> bytes:
    size = records.MESSAGE_HEAD.size + len(data) + grown
    return bytes([Opcode.MESSAGE]) + size.to_bytes(8, "little") + records.MESSAGE_HEAD.pack(channel, 5, t_ns, 6) + data


@pytest.mark.parametrize("count", [1, 16, 17, 40])
def test_heads_of_messages_are_where_the_index_says(count):
    """Few heads are read one by one, many at once."""
    parts = [message(2, 100 + n, b"x" * (n % 4)) for n in range(count)]
    offset = np.cumsum([0, *map(len, parts)])[:-1]
    t_ns = np.arange(100, 100 + count).astype(np.uint64)
    content = memoryview(b"".join(parts))
    found = message_heads_at(content, 2, t_ns, offset)
    assert (found.end - found.start).tolist() == [n % 4 for n in range(count)]
    assert (found.start - offset).tolist() == [9 + 22] * count
    assert set(found.head["sequence"].tolist()) == {5}

    def refused(said: str, parts=parts, t_ns=t_ns, offset=offset, channel=2) -> None:
        with pytest.raises(Damaged, match=said):
            message_heads_at(memoryview(b"".join(parts)), channel, t_ns, offset)

    last, room = offset[-1], len(content) - 31
    nothing = f"there is no message of channel 2 at {99 + count} ns where the index says"
    refused("there is no message of channel 3 at 100 ns", channel=3)
    refused(nothing, parts=[*parts[:-1], message(9, 99 + count, b"abc")])
    refused(nothing, parts=[*parts[:-1], message(2, 7, b"abc")])
    refused(nothing, parts=[*parts[:-1], message(2, 99 + count, b"abc", grown=1)])
    refused(nothing, parts=[*parts[:-1], message(2, 99 + count, b"", grown=-1) + b"abc"])
    refused(nothing, parts=[*parts[:-1], b"\x06" + message(2, 99 + count, b"abc")[1:]])
    message_heads_at(memoryview(b"".join([*parts[:-1], message(2, 99 + count, b"abc", grown=-3)])), 2, t_ns, offset)
    for at in (-1, room + 1, len(content) + 50):
        refused(
            f"an index places a message at byte {at} of a chunk of {len(content)} bytes",
            offset=np.append(offset[:-1], at),
        )
    assert room >= last
    none = message_heads_at(content, 2, t_ns[:0], offset[:0])
    assert [len(part) for part in none] == [0, 0, 0]


HEADER = pack(Opcode.HEADER, records.text(""), records.text(""))
END = pack(Opcode.DATA_END, bytes(4))
SCHEMA = pack(Opcode.SCHEMA, (1).to_bytes(2, "little"), *[records.text("name")] * 2, records.raw(b"{}"))


def channel(number: int) -> bytes:
    topic = records.text(f"/{number}")
    fields = [number.to_bytes(2, "little"), (1).to_bytes(2, "little"), topic, records.text("json")]
    return pack(Opcode.CHANNEL, *fields, records.text_map({}))


def test_a_chunk_that_is_larger_than_its_index_says_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    write_stock(path, SOME, compression=CompressionType.NONE, chunk_size=10_000)
    monkeypatch.setattr(chunks, "_MAX_PLAIN_BYTES", 50)
    with log.read(path) as one:
        number = next(n for n, channel in one.index.channels.items() if channel.topic == "b")
        source = ByteSource.of(OpenFile.at(path))
        (batch,) = messages.MessageBatches(source, one.index, [number], (None, None))
        content, offset = Messages(source, one.index)._open(batch)
        heads = message_heads_at(content, number, batch.t_ns, offset)
        payloads = [bytes(content[a:b]) for a, b in zip(heads.start.tolist(), heads.end.tolist(), strict=True)]
        assert payloads == [data for topic, *_, data in SOME if topic == "b"]
        with pytest.raises(
            Damaged, match=f"byte {batch.chunk.chunk_start_offset}: a chunk is larger than its index says"
        ):
            Messages(source, one.index)._open(batch._replace(is_direct=False))


def test_progress_of_a_check_is_told_at_each_block(tmp_path, monkeypatch):
    data = records.MAGIC + HEADER + SCHEMA * 5 + END + pack(Opcode.FOOTER, bytes(20)) + records.MAGIC
    (tmp_path / "a.mcap").write_bytes(data)
    first = 8 + len(HEADER)
    monkeypatch.setattr(records, "BLOCK", first)
    assert len(SCHEMA) == 33
    told = []
    log.check(tmp_path / "a.mcap", lambda *step: told.append(step))
    assert told == [
        ("check", at, len(data)) for at in (first, first + 33, first + 66, first + 99, first + 132, first + 165)
    ]
    told.clear()
    monkeypatch.setattr(records, "BLOCK", 66)
    log.check(tmp_path / "a.mcap", lambda *step: told.append(step))
    assert [at for _, at, _ in told] == [first + 66, first + 132]


def recovered(folder: Path, *body: bytes) -> tuple[list[str], list[int], bytes]:
    path, saved = folder / "a.mcap", folder / "saved.mcap"
    path.write_bytes(records.MAGIC + b"".join([HEADER, *body, END, pack(Opcode.FOOTER, bytes(20))]) + records.MAGIC)
    report = log.recover(path, saved)
    assert log.check(saved).is_sound
    times = [m[1] for m in stock_messages(saved)]
    assert report.messages == len(times)
    return report.lost, times, saved.read_bytes()


@pytest.mark.parametrize("step", [16, 64, 64 * 2**10])
@pytest.mark.parametrize(
    ("hole", "behind", "saved"),
    [
        ((5, 8), 8, [*range(5), *range(8, 20)]),
        ((5, 17), 17, [*range(5), 17, 18, 19]),
        ((5, 18), 18, [*range(5), 18, 19]),  # two messages, and the end behind them
        ((5, 19), 19, [*range(5), 19]),
        ((0, 1), 1, list(range(1, 20))),
    ],
)
def test_reading_goes_on_where_messages_follow_one_another(tmp_path, monkeypatch, step, hole, behind, saved):
    """A hole in a log without chunks, looked through in steps."""
    monkeypatch.setattr(recovering, "_FIRST_STEP", step)
    about = [SCHEMA, channel(2), channel(3)]
    messages = [message(2 + n % 2, n, bytes([n]) * n) for n in range(20)]
    at = np.cumsum([8 + len(HEADER) + sum(map(len, about)), *map(len, messages)]).tolist()
    first, last = hole
    # What looks like a message in it is of no channel that is known, or alone.
    noise = [b"\xff" * len(one) for one in messages[first:last]]
    noise[0] = (b"\xff" * 3 + message(9, 7, b"") + b"\xff" * 400)[: len(noise[0])]
    lost, times, whole = recovered(tmp_path, *about, *messages[:first], *noise, *messages[last:])
    assert lost == [f"byte {at[first]} to {at[behind]}: no record can be read here"]
    assert times == saved
    # Each channel is described in the data once, and in the summary.
    assert [whole.count(channel(number)) for number in (2, 3)] == [2, 2]


def test_records_of_applications_are_kept_and_unknown_ones_are_not(tmp_path):
    about = [SCHEMA, channel(2), message(2, 1, b"x")]
    lost, times, whole = recovered(tmp_path, *about, pack(0x80, b"private"), pack(0xFF, b"secret"), message(2, 2, b"y"))
    assert (lost, times, b"private" in whole, b"secret" in whole) == ([], [1, 2], True, True)
    lost, times, whole = recovered(tmp_path, *about, pack(0x7F, b"unknown"), *[message(2, n, b"y") for n in (2, 3, 4)])
    assert (len(lost), times, b"unknown" in whole) == (1, [1, 2, 3, 4], False)


@pytest.mark.parametrize(
    ("behind", "covered", "lost"),
    [
        (b"", 0, 0),
        (bytes(40), 40, 0),  # padding
        (b"\x00" * 3, 3, 0),
        (bytes(40), 0, 1),  # no record can be read there
        ("metadata", "metadata", 0),  # a record that stands behind the chunk is read
        ("metadata", 5, 0),
    ],
)
def test_a_chunk_whose_record_is_longer_than_it_hides_nothing(tmp_path, behind, covered, lost):
    note = pack(Opcode.METADATA, records.text("about"), records.text_map({"robot": "r2"}))
    chunks = []
    for t_ns in (5, 9):
        content = b"".join([SCHEMA, channel(2), message(2, t_ns, b"{}")])
        chunks.append(pack_chunk((t_ns, t_ns, len(content), zlib.crc32(content)), "", content))
    between = note if behind == "metadata" else behind
    size = len(chunks[0]) - 9 + (len(between) if covered == "metadata" else covered)
    first = chunks[0][:1] + size.to_bytes(8, "little") + chunks[0][9:]
    found_lost, times, _ = recovered(tmp_path, first, between, chunks[1])
    assert (len(found_lost), times) == (lost, [5, 9])
    with (tmp_path / "saved.mcap").open("rb") as stream:
        found = [(one.name, one.metadata) for one in make_reader(stream).iter_metadata()]
    assert found == ([("about", {"robot": "r2"})] if behind == "metadata" else [])


# Index entries of chunks as columns: they are as in a list of records


NUMBERS = st.integers(0, 2**64 - 1)
CHANNELS = st.dictionaries(st.one_of(st.integers(0, 3), st.just(2**16 - 1)), NUMBERS, max_size=3)
PLACES = st.one_of(st.integers(0, 9), NUMBERS)
ENTRIES = st.builds(
    ChunkIndex, message_start_time=NUMBERS, message_end_time=NUMBERS, chunk_start_offset=PLACES, chunk_length=PLACES,
    message_index_offsets=CHANNELS, message_index_length=NUMBERS,
    compression=st.sampled_from(["", "zstd", "lz4", "other"]), compressed_size=NUMBERS, uncompressed_size=NUMBERS,
)  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(plain=st.lists(ENTRIES, max_size=7), wanted=st.sets(st.integers(0, 4)))
def test_columns_hold_what_a_list_of_records_holds(plain, wanted):
    made = ChunkList(plain)
    assert (list(made), len(made), made[1:], made[::-1]) == (plain, len(plain), plain[1:], plain[::-1])
    assert [made[number] for number in range(-len(plain), len(plain))] == plain + plain
    assert list(made.with_channels(wanted)) == [one for one in plain if wanted & set(one.message_index_offsets)]
    assert made.channels == {channel for one in plain for channel in one.message_index_offsets}
    assert made.offsets.tolist() == [one.chunk_start_offset for one in plain]
    assert made.are_all_indexed == all(one.message_index_offsets for one in plain)
    assert made.listed == sum(one.message_index_length - 15 * len(one.message_index_offsets) for one in plain)
    full = [one for one in plain if one.message_index_offsets]
    spans = (min(one.message_start_time for one in full), max(one.message_end_time for one in full)) if full else None
    assert made.times() == spans
    ends = [0, *(one.chunk_start_offset + one.chunk_length for one in plain)]
    starts = [*(one.chunk_start_offset for one in plain), 30]
    assert made.are_apart(0, 30) == all(end <= start for end, start in zip(ends, starts, strict=True))
    made.sort_by_offset()
    ordered = sorted(plain, key=lambda one: one.chunk_start_offset)
    assert list(made) == ordered
    for end in (0, 5, 2**64):
        part, kept = made.before(end), [one for one in ordered if one.chunk_start_offset < end]
        part.append(plain[0] if plain else chunk_index((0, 0), (0, 0), {1: 2}, 0, ("new", 0, 0)))
        assert list(part)[:-1] == kept
    assert list(made) == ordered  # what is added to a part isn't added here
    for one in ordered:
        assert made.at(one.chunk_start_offset) == next(
            other for other in ordered if other.chunk_start_offset == one.chunk_start_offset
        )
        assert (made.at(one.chunk_start_offset + 1) is None) == all(
            other.chunk_start_offset != one.chunk_start_offset + 1 for other in ordered
        )


@settings(max_examples=60, deadline=None)
@given(one=st.lists(ENTRIES, max_size=3), other=st.lists(ENTRIES, max_size=3), change=st.integers(0, 8))
def test_columns_are_equal_if_the_lists_are(one, other, change):
    assert ChunkList(one) == ChunkList(one)
    assert (ChunkList(one) == ChunkList(other)) == (one == other)
    for number, entry in enumerate(one):
        name, value = list(vars(entry).items())[change]
        new = {7: 8} if isinstance(value, dict) else "x" if isinstance(value, str) else value ^ 1
        changed = replace(entry, **{name: new})
        assert ChunkList([*one[:number], changed, *one[number + 1 :]]) != ChunkList(one)


def test_chunks_that_stay_open_for_other_channels_are_counted_once_each(tmp_path, monkeypatch):
    """Their number doesn't matter for the time that the next takes, and their size is limited."""
    from mcaptrack.log import messages

    path = tmp_path / "a.mcap"
    with log.create(path) as writer:
        ids = [writer.add_channel(topic, ("", "", b""), "raw", {}) for topic in ("/a", "/b")]
        for number in range(60):
            heads = [struct.pack("<BQHIQQ", 5, 122, one, number, number, number) + bytes(100) for one in ids]
            writer.write_kept_records(
                "media", [(one, number, memoryview(h)) for one, h in zip(ids, heads, strict=True)]
            )
    monkeypatch.setattr(messages, "_KEPT_BYTES", 2000)
    with log.read(path) as opened:
        together = heapq.merge(*map(opened.messages, ["/a", "/b"]), key=lambda m: m.t_ns)
        assert [m.t_ns for m in together] == [n for n in range(60) for _ in range(2)]
        reading = opened.snapshot.messages
        assert reading._opened_bytes == sum(map(len, reading._opened.values())) <= 2000
        list(opened.messages("/b"))
        assert reading._opened_bytes == sum(map(len, reading._opened.values())) <= 2000
