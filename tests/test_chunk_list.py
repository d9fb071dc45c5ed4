"""Index entries of chunks as columns: they are as in a list of records, and take a tenth of its memory."""

from __future__ import annotations

import heapq
import io
import struct
import zlib
from typing import ClassVar

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from mcaptrack import log
from mcaptrack.log.index import ChunkList
from mcaptrack.log.messages import Checksums, fingerprint
from mcaptrack.log.records import ChunkIndexRecord
from mcaptrack.log.writer import LogWriter
from tests.memory import held
from tests.tiers import thorough

NUMBERS = st.integers(0, 2**64 - 1)
CHANNELS = st.dictionaries(st.one_of(st.integers(0, 3), st.just(2**16 - 1)), NUMBERS, max_size=3)
#: How many chunks the log has, and the most that is read ahead of a file.
CHUNKS, AHEAD = 1500, 300_000
ENTRIES = st.builds(
    ChunkIndexRecord, NUMBERS, NUMBERS, st.one_of(st.integers(0, 9), NUMBERS), st.one_of(st.integers(0, 9), NUMBERS),
    CHANNELS, NUMBERS, st.sampled_from(["", "zstd", "lz4", "other"]), NUMBERS, NUMBERS,
)  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(plain=st.lists(ENTRIES, max_size=7), wanted=st.sets(st.integers(0, 4)))
def test_columns_hold_what_a_list_of_records_holds(plain, wanted):
    made = ChunkList(plain)
    assert (list(made), len(made), made[1:], made[::-1]) == (plain, len(plain), plain[1:], plain[::-1])
    assert [made[number] for number in range(-len(plain), len(plain))] == plain + plain
    assert list(made.with_channels(wanted)) == [one for one in plain if wanted & set(one.message_index_offsets)]
    assert made.channels == {channel for one in plain for channel in one.message_index_offsets}
    assert made.offsets.tolist() == [one.offset for one in plain]
    assert made.are_all_indexed == all(one.message_index_offsets for one in plain)
    assert made.listed == sum(one.message_index_length - 15 * len(one.message_index_offsets) for one in plain)
    full = [one for one in plain if one.message_index_offsets]
    spans = (min(one.start_ns for one in full), max(one.end_ns for one in full)) if full else None
    assert made.times() == spans
    ends = [0, *(one.offset + one.length for one in plain)]
    starts = [*(one.offset for one in plain), 30]
    assert made.are_apart(0, 30) == all(end <= start for end, start in zip(ends, starts, strict=True))
    made.sort_by_offset()
    ordered = sorted(plain, key=lambda one: one.offset)
    assert list(made) == ordered
    for end in (0, 5, 2**64):
        part, kept = made.before(end), [one for one in ordered if one.offset < end]
        part.append(plain[0] if plain else ChunkIndexRecord(0, 0, 0, 0, {1: 2}, 0, "new", 0, 0))
        assert list(part)[:-1] == kept
    assert list(made) == ordered  # what is added to a part isn't added here
    for one in ordered:
        assert made.at(one.offset) == next(other for other in ordered if other.offset == one.offset)
        assert (made.at(one.offset + 1) is None) == all(other.offset != one.offset + 1 for other in ordered)


@settings(max_examples=60, deadline=None)
@given(one=st.lists(ENTRIES, max_size=3), other=st.lists(ENTRIES, max_size=3), change=st.integers(0, 8))
def test_columns_are_equal_if_the_lists_are(one, other, change):
    assert ChunkList(one) == ChunkList(one)
    assert (ChunkList(one) == ChunkList(other)) == (one == other)
    for number, entry in enumerate(one):
        value = entry[change]
        new = {7: 8} if isinstance(value, dict) else "x" if isinstance(value, str) else value ^ 1
        changed = entry._replace(**{entry._fields[change]: new})
        assert ChunkList([*one[:number], changed, *one[number + 1 :]]) != ChunkList(one)


@pytest.fixture(scope="module")
def many_chunks(tmp_path_factory):
    """A log with a chunk for each of many messages."""
    path = tmp_path_factory.mktemp("chunks") / "a.mcap"
    with log.create(path) as writer:
        channel = writer.add_channel("/a", ("", "", b""), "raw", {})
        writer.write_description(channel)
        for number in range(CHUNKS):
            head = struct.pack("<BQHIQQ", 5, 23, channel, number, number, number)
            writer.write_kept_records("media", [(channel, number, memoryview(head + b"x"))])
    return path


@thorough
def test_a_log_of_many_chunks_takes_few_bytes_a_chunk(many_chunks):
    """80 for its entry, and 8 for its checksum; objects take a kilobyte. Of a message 16 are held, and its time."""

    def opened() -> log.Log:
        return log.read(many_chunks)

    opened()
    alive, most = held(opened)
    assert alive < 110 * CHUNKS
    assert most < AHEAD + 250 * CHUNKS  # the summary itself has 100
    with opened() as reading:
        reading.times("/a")
        assert held(lambda: reading.times("/a"))[1] < AHEAD + 120 * CHUNKS
        alive, most = held(lambda: sum(len(message.payload) for message in reading.messages("/a")))
        assert most < AHEAD + 120 * CHUNKS
        assert alive < AHEAD + 20 * CHUNKS


def test_fingerprints_keep_eight_bytes_a_chunk(many_chunks):
    """A checksum each; a dictionary of them takes 150."""
    content = memoryview(many_chunks.read_bytes())
    with log.read(many_chunks) as opened:
        index, whole = opened.index, opened.fingerprint()

    def kept() -> Checksums:
        checksums = Checksums()
        assert fingerprint(content, index, None, checksums) == fingerprint(content, index, None, checksums) == whole
        return checksums

    assert 8 * CHUNKS <= held(kept)[0] < 20 * CHUNKS


def test_the_summary_is_written_in_parts(many_chunks):
    """Of hundreds of thousands of chunks it takes tens of megabytes, which were in memory four times."""

    class Sink:
        sizes: ClassVar[list[int]] = []
        data = bytearray()

        def write(self, data: bytes) -> None:
            self.sizes.append(len(data))
            self.data += data

    sink = Sink()
    writer = LogWriter(sink)
    writer.header()
    with log.read(many_chunks) as opened:
        for number, channel in opened.index.channels.items():
            writer.channels[number] = channel
        for chunk in opened.index.chunks:
            source = opened.snapshot.source
            indexes = {number: bytes(16) for number in chunk.message_index_offsets}
            writer.copy_chunk(bytes(source[chunk.offset : chunk.offset + chunk.length]), chunk, indexes)
        start = len(sink.sizes)
        assert writer.finish() == CHUNKS
    assert max(sink.sizes[start:]) < 70_000 < sum(sink.sizes[start:])
    with io.BytesIO(bytes(sink.data)) as stream:
        found = make_reader(stream).get_summary()
    assert len(found.chunk_indexes) == CHUNKS
    (crc,) = struct.unpack_from("<I", sink.data, len(sink.data) - 12)
    (summary_start,) = struct.unpack_from("<Q", sink.data, len(sink.data) - 28)
    assert crc == zlib.crc32(sink.data[summary_start:-12])


def test_chunks_that_stay_open_for_other_channels_are_counted_once_each(many_chunks, tmp_path, monkeypatch):
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
