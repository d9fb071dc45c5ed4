"""Where findings point to, what exactly is lost, what a fingerprint covers, and how large chunks grow."""

from __future__ import annotations

import io
import struct
import sys
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import IndexType

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.log import records
from mcaptrack.log.byte_source import ByteSource, OpenFile
from mcaptrack.log.index import Index, read_index
from mcaptrack.log.writer import LogWriter
from mcaptrack.schema.provenance import Provenance
from tests.commands import done
from tests.extension_cases import of_extensions
from tests.logs import FORTY, SCHEMA, SOME, STOCK_OPTIONS, our_messages, recorder, write_stock

MIB = 2**20


def summary_of(path: Path):
    with path.open("rb") as stream:
        return make_reader(stream).get_summary()


@pytest.mark.parametrize(
    ("counts", "first"), [((2, 2), 0), ((0, 2), 1), ((2, 0), 0), ((0, 0), 0), ((0, 1, 1), 1)], ids=str
)
def test_the_channel_of_a_topic_is_the_first_that_has_messages(tmp_path, counts, first):
    path = tmp_path / "a.mcap"
    with log.create(path) as writer:
        for number, count in enumerate(counts):
            channel = writer.add_channel("t", SCHEMA, "json", {"number": str(number)}, another=True)
            for t_ns in range(count):
                writer.add_message(channel, t_ns, 0, b"{}")
    with log.read(path) as opened:
        assert opened.channel("t").metadata == {"number": str(first)}
        assert opened.channel("t").messages == sum(counts)


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}, {"index_types": IndexType.NONE}], ids=str)
def test_a_schema_goes_with_the_last_channel_that_has_it(tmp_path, options):
    """One that no channel ever had stays."""
    path = tmp_path / "a.mcap"

    def write() -> None:
        with recorder(path, **options) as writer:
            schemas = {name: writer.register_schema(name, "jsonschema", b"{}") for name in ("own", "shared", "unused")}
            numbers = {
                topic: writer.register_channel(topic, "json", schemas[schema])
                for topic, schema in (("a", "own"), ("b", "shared"), ("c", "shared"))
            }
            for topic, number in numbers.items():
                writer.add_message(number, 1, topic.encode(), 1)

    for dropped, left in (
        (["a"], {"shared", "unused"}),
        (["b"], {"own", "shared", "unused"}),
        (["b", "c"], {"own", "unused"}),
        (["a", "b", "c"], {"unused"}),
    ):
        write()
        with log.read(path) as opened, log.extend(opened, drop=dropped):
            pass
        with path.open("rb") as stream:
            described = {record.name for record in StreamReader(stream).records if hasattr(record, "encoding")}
        assert described == left, dropped
        assert {schema.name for schema in summary_of(path).schemas.values()} == left, dropped


def prints(path: Path) -> tuple[str, str]:
    with log.read(path) as opened:
        return opened.fingerprint(), opened.fingerprint("a")


def test_a_fingerprint_is_another_when_anything_has_changed(tmp_path):
    """The one of a channel only when something of the channel has."""
    path = tmp_path / "a.mcap"

    def write(channel="x", other="x", metadata="x", attachment=b"x", payload=b"x", **options) -> tuple[str, str]:
        with recorder(path, **options) as writer:
            schema = writer.register_schema(*SCHEMA)
            numbers = [writer.register_channel(t, "json", schema, {"m": m}) for t, m in (("a", channel), ("b", other))]
            for number in numbers:
                writer.add_message(number, 1, payload if number == numbers[0] else b"x", 1)
            writer.add_metadata("about", {"what": metadata})
            writer.add_attachment(1, 2, "notes", "text/plain", attachment)
        return prints(path)

    for options in ({"chunk_size": 1}, {"chunk_size": 1, "enable_crcs": False}, {"use_chunking": False}):
        whole, of_channel = write(**options)
        assert write(**options) == (whole, of_channel)
        seen = {whole}
        for change in ({"metadata": "y"}, {"attachment": b"y"}, {"channel": "y"}, {"payload": b"y"}, {"other": "y"}):
            other, own = write(**change, **options)
            seen.add(other)
            if change.keys() != {"other"}:  # the stock writer describes both channels in one chunk
                assert (own != of_channel) == bool(change.keys() & {"channel", "payload"}), (change, options)
        assert len(seen) == 6, options


@pytest.mark.parametrize(("kind", "limit"), [("rows", MIB), ("views", MIB), ("media", 4 * MIB)])
def test_a_chunk_is_closed_when_it_is_full(tmp_path, kind, limit):
    path = tmp_path / "a.mcap"
    size = limit // 4
    with log.create(path) as writer:
        number = writer.add_channel("a", SCHEMA, "json", {}, kind)
        for t_ns in range(13):
            writer.add_message(number, t_ns, t_ns, bytes(size))
    sizes = [chunk.uncompressed_size for chunk in summary_of(path).chunk_indexes]
    assert all(limit <= found < limit + size + 1000 for found in sizes[:-1])
    assert len(sizes) == 4


def test_messages_outside_of_chunks_come_into_chunks_that_are_closed_when_full(tmp_path):
    path = tmp_path / "a.mcap"
    write_stock(path, [("a", t_ns, t_ns, bytes(MIB // 4)) for t_ns in range(13)], use_chunking=False)
    with log.read(path) as opened, log.extend(opened):
        pass
    assert len(summary_of(path).chunk_indexes) == 4
    assert max(chunk.uncompressed_size for chunk in summary_of(path).chunk_indexes) < 1.3 * MIB


@pytest.fixture
def chunked(tmp_path) -> Path:
    path = tmp_path / "a.mcap"
    write_stock(path, FORTY, chunk_size=600, enable_data_crcs=True)
    return path


def flip(path: Path, at: int) -> None:
    raw = bytearray(path.read_bytes())
    raw[at] ^= 0xFF
    path.write_bytes(raw)


def places(path: Path) -> dict[str, tuple[int, int]]:
    """A byte to damage, as the stock reader's summary has the places, and the byte that a finding has to name."""
    summary, size = summary_of(path), len(path.read_bytes())
    chunk = summary.chunk_indexes[1]
    index_at = min(chunk.message_index_offsets.values())
    attachment, metadata = summary.attachment_indexes[0], summary.metadata_indexes[0]
    with path.open("rb") as stream:
        start = next(r.summary_start for r in StreamReader(stream).records if type(r).__name__ == "Footer")
    return {
        "bad-chunk": (chunk.chunk_start_offset + chunk.chunk_length - 5, chunk.chunk_start_offset),
        "wrong-index": (index_at + 9 + 2 + 4 + 8, index_at),
        "attachment-checksum": (attachment.offset + attachment.length - 6, attachment.offset),
        "bad-metadata": (metadata.offset + 9 + 3, metadata.offset),
        "summary-checksum": (start + 15, start),
        "data-checksum": (start - 13 + 9, start - 13),
        "cut-off": (size - 1, size),
        "magic": (0, 0),
    }


def test_a_finding_names_the_byte_where_the_record_begins(chunked):
    whole = chunked.read_bytes()
    for kind, (at, where) in places(chunked).items():
        chunked.write_bytes(whole)
        flip(chunked, at)
        found = {finding.kind: finding for finding in log.check(chunked).findings}
        assert (found[kind].where, found[kind].times) == (where, 1), kind


def test_what_is_lost_is_listed_once_and_nothing_else(chunked, tmp_path):
    saved = tmp_path / "saved.mcap"
    whole = chunked.read_bytes()
    chunk = summary_of(chunked).chunk_indexes[1]
    start, end = chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length
    held = [n for n in range(40) if chunk.message_start_time <= 10 * n <= chunk.message_end_time]
    flip(chunked, end - 5)
    lost = log.recover(chunked, saved).lost
    assert len(lost) == 1 + len({"abc"[n % 3] for n in held})
    assert lost[0].startswith(f"byte {start} to ")
    assert "it held messages of a, b, c" in lost[0]
    for topic, words in zip("abc", lost[1:], strict=True):
        count = sum("abc"[n % 3] == topic for n in range(40))
        gone = sum("abc"[n % 3] == topic for n in held)
        assert words == f"{topic}: {count - gone} of {count} messages are recovered"
    chunked.write_bytes(whole[:end])
    lost = log.recover(chunked, saved).lost
    assert lost == [f"byte {end}: the file is cut off; anything that followed is lost"]
    attachment = summary_of_bytes(tmp_path, whole).attachment_indexes[0]
    chunked.write_bytes(whole)
    flip(chunked, attachment.offset + attachment.length - 6)
    lost = log.recover(chunked, saved).lost
    assert len(lost) == 1
    assert lost[0].startswith(f"byte {attachment.offset} to {attachment.offset + attachment.length}: ")


def summary_of_bytes(folder: Path, whole: bytes):
    path = folder / "whole.mcap"
    path.write_bytes(whole)
    return summary_of(path)


@pytest.mark.parametrize("compression", ["", "zstd", "lz4", "zst4", "another", "ü"])
def test_chunks_and_their_indexes_are_read_as_they_were_written_or_not_at_all(compression):
    index = records.chunk_index((1, 2**64 - 1), (3, 4), {5: 6, 2**16 - 1: 7}, 8, (compression, 9, 10))
    whole = memoryview(records.pack_chunk_index(index))
    assert records.read_chunk_index(whole, records.record_at(whole, 0)) == index
    chunk = memoryview(records.pack_chunk((1, 2**64 - 1, 3, 4), compression, b"data"))
    start = len(chunk) - 4
    head = records.ChunkHead(1, 2**64 - 1, 3, 4, compression, start, start + 4)
    assert records.read_chunk(chunk, records.record_at(chunk, 0)) == head
    for data, read in ((whole, records.read_chunk_index), (chunk, records.read_chunk)):
        for end in range(9, len(data)):
            with pytest.raises(records.Damaged):
                read(data, records.Record(data[0], 0, 9, end))


@pytest.fixture
def shallow() -> Iterator[int]:
    """How deep calls may be: less than usual, so that fewer channels suffice to show that none are nested."""
    usual = sys.getrecursionlimit()
    sys.setrecursionlimit(300)
    yield 300
    sys.setrecursionlimit(usual)


def test_channels_that_were_made_from_each_other_may_be_many(tmp_path, shallow):
    """A line of them, in the order in which they were made, and those that lead in a circle."""
    path = tmp_path / "a.mcap"
    count = shallow + 50
    inputs = {f"/c{n:04}": f"/c{n - 1:04}" for n in range(count)} | {"/round/a": "/round/b", "/round/b": "/round/a"}
    with log.create(path) as writer:
        for topic, source in reversed(inputs.items()):
            made = Provenance("sample", {}, source)
            writer.add_channel(topic, SCHEMA, "json", made.to_metadata())
    assert f"/c{count - 1:04}" in done("info", path).out
    for topics_of in of_extensions("TOPICS_IN_ORDER").values():
        assert topics_of(path, tmp_path) == [*(f"/c{n:04}" for n in range(count)), "/round/a", "/round/b"]


def test_indexes_that_list_another_number_of_messages_than_was_counted_are_noticed(tmp_path):
    path = tmp_path / "a.mcap"
    write_stock(path, FORTY)  # 14 messages of a, 13 of b and 13 of c
    whole = bytearray(path.read_bytes())
    for number, count in ((2, 14), (3, 12)):
        at = whole.rindex(struct.pack("<HQ", number, 13))
        whole[at : at + 10] = struct.pack("<HQ", number, count)
    footer = len(whole) - 8 - 20
    start = int.from_bytes(whole[footer : footer + 8], "little")
    whole[footer + 16 : footer + 20] = zlib.crc32(whole[start : footer + 16]).to_bytes(4, "little")
    path.write_bytes(whole)
    with log.read(path) as opened:
        assert len(list(opened.messages("a"))) == 14
        for topic, number, count in (("b", 2, 14), ("c", 3, 12)):
            with pytest.raises(
                McaptrackError, match=f"its indexes list 13 messages of channel {number}, and there are {count}"
            ):
                list(opened.messages(topic))
            for span in ((0, None), (None, 1000), (0, 1000)):
                assert len(list(opened.messages(topic, *span))) == 13


def test_a_new_channel_gets_the_next_number_and_then_the_lowest_that_is_free():
    def added(taken: Iterable[int]) -> int:
        channels = {number: Channel(number, f"/{number}", "json", {}, 0) for number in taken}
        return LogWriter(io.BytesIO(), index=Index(channels=channels)).add_channel("new", ("", "", b""), "json", {})

    last = 2**16 - 1
    for taken, number in (
        ((), 1), ((1,), 2), ((1, 3), 4), ((2, 3), 4), ((last - 1,), last), ((last,), 1), ((1, 2, last), 3),
        (range(2, last + 1), 1),
    ):  # fmt: skip
        assert added(taken) == number
    with pytest.raises(McaptrackError, match=r"^there are 65535 channels already; a log holds no more$"):
        added(range(1, last + 1))


@pytest.mark.parametrize("options", STOCK_OPTIONS.values(), ids=STOCK_OPTIONS)
def test_a_log_without_a_summary_has_the_times_and_counts_of_its_messages(options, tmp_path):
    write_stock(tmp_path / "a.mcap", SOME, **options)
    data = (tmp_path / "a.mcap").read_bytes()
    (start,) = struct.unpack_from("<Q", data, len(data) - 28)  # the footer: summary, offsets of it, checksum, magic
    start = start or len(data) - 37
    footer = b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0) + data[-8:]
    (tmp_path / "b.mcap").write_bytes(data[:start] + footer)
    source = ByteSource.of(OpenFile.at(tmp_path / "b.mcap"))
    index = read_index(source)
    assert (index.start_ns, index.end_ns) == (5, 40)
    assert {index.channels[number].topic: count for number, count in index.counts.items()} == {"a": 2, "b": 2, "c": 1}
    assert [(one.message_start_time, one.message_end_time) for one in index.chunks] == [
        (min(times), max(times))
        for times in ([one.log_time for one in some] for some in chunks_of(tmp_path / "a.mcap"))
    ]


def chunks_of(path: Path) -> list[list]:
    """The messages of each chunk, as the stock reader has them."""
    with path.open("rb") as stream:
        chunks = [one for one in StreamReader(stream, emit_chunks=True).records if type(one).__name__ == "Chunk"]
    return [[one for one in breakup_chunk(chunk) if type(one).__name__ == "Message"] for chunk in chunks]


def test_chunks_of_messages_that_stood_outside_describe_their_channels(tmp_path):
    """Readers without an index find the channel of each message before it, in the same chunk."""
    write_stock(tmp_path / "a.mcap", FORTY, use_chunking=False)
    with log.read(tmp_path / "a.mcap") as opened, log.extend(opened) as writer:
        writer.add_message(writer.add_channel("new", SCHEMA, "json", {}), 5, 1, b"new")
    count = 0
    with (tmp_path / "a.mcap").open("rb") as stream:
        chunks = [one for one in StreamReader(stream, emit_chunks=True).records if type(one).__name__ == "Chunk"]
    for chunk in chunks:
        known: list[int] = []
        for one in breakup_chunk(chunk):
            if type(one).__name__ == "Channel":
                known.append(one.id)
            elif type(one).__name__ == "Message":
                assert one.channel_id in known
                count += 1
        assert len(known) == len(set(known))
    assert count == 41


def test_messages_far_apart_in_a_log_without_chunks_are_read(tmp_path):
    """One by one, where more than 16 KiB of others are between them."""
    some = [(topic, 10 * n, n, bytes([n]) * (n if topic == "a" else 40_000)) for n in range(6) for topic in "ab"]
    write_stock(tmp_path / "a.mcap", some, use_chunking=False)
    found = our_messages(tmp_path / "a.mcap")
    for topic in "ab":
        assert found[topic] == [(t_ns, sequence, data) for name, t_ns, sequence, data in some if name == topic]


def test_records_one_after_the_other_are_read_once():
    """A file is read in blocks; a record that is cut off by the end of a block is read again."""

    class Read(bytes):
        taken = 0

        def __getitem__(self, which):
            Read.taken += len(range(*which.indices(len(self))))
            return memoryview(bytes.__getitem__(self, which))

    data = Read(records.pack(Opcode.METADATA, bytes(91)) * 3000)
    found = list(records.walk(data, 0, len(data)))
    assert [record.start for record in found] == list(range(0, len(data), 100))
    assert Read.taken < 1.02 * len(data)
