"""Logs: what is written can be read, by others too; what stood stays; what is damaged is said."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from pathlib import Path

import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.log import records
from mcaptrack.schema import TRACKS, Frame
from tests.logs import MESSAGES, SCHEMA, SOME, STOCK_OPTIONS, our_messages, stock_messages, write_log, write_stock
from tests.worlds import tracks_at


@given(messages=MESSAGES, kind=st.sampled_from(["rows", "media"]))
def test_what_is_written_is_read_back_by_us_and_by_the_stock_reader(tmp_path_factory, messages, kind):
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    write_log(path, messages, kind)
    ours = our_messages(path)
    for topic in "abc":
        wanted = sorted((m[1:] for m in messages if m[0] == topic), key=lambda m: m[0])
        assert ours[topic] == wanted
    assert sorted(stock_messages(path)) == sorted(messages)


@pytest.mark.parametrize("options", STOCK_OPTIONS.values(), ids=STOCK_OPTIONS)
def test_a_log_of_other_software_keeps_everything_when_channels_are_added(tmp_path, options):
    path = tmp_path / "theirs.mcap"
    write_stock(path, SOME, **options)
    before = our_messages(path)
    assert {topic: len(found) for topic, found in before.items()} == {"a": 2, "b": 2, "c": 1}
    publish = {}
    with log.read(path) as opened:
        publish = {m.payload: m.publish_ns for m in opened.messages("b")}
        with log.extend(opened) as writer:
            number = writer.add_channel("new", SCHEMA, "json", {})
            writer.add_message(number, 15, 1, b"added")
    after = our_messages(path)
    assert after.pop("new") == [(15, 1, b"added")]
    assert after == before
    assert publish == {b"yy": 15, b"w" * 200: 20}
    assert sorted(stock_messages(path)) == sorted([*SOME, ("new", 15, 1, b"added")])
    with path.open("rb") as stream:
        found = list(StreamReader(stream, validate_crcs=True).records)
    kinds = [type(record).__name__ for record in found]
    assert kinds.count("Attachment") == kinds.count("Metadata") == 1
    header = found[0]
    assert (header.profile, header.library) == ("ros2", "other-software")


@pytest.mark.parametrize("options", STOCK_OPTIONS.values(), ids=STOCK_OPTIONS)
def test_a_channel_that_is_dropped_takes_nothing_with_it(tmp_path, options):
    path = tmp_path / "theirs.mcap"
    write_stock(path, SOME, **options)
    with log.read(path) as opened, log.extend(opened, drop=["b"], drop_attachments=["notes.txt"]):
        pass
    assert sorted(stock_messages(path)) == sorted(m for m in SOME if m[0] != "b")
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert sorted(channel.topic for channel in summary.channels.values()) == ["a", "c"]
    assert summary.statistics.message_count == 3
    assert not summary.attachment_indexes
    assert len(summary.metadata_indexes) == 1


def test_chunks_that_stand_are_copied_to_the_byte(tmp_path):
    path = tmp_path / "a.mcap"
    write_stock(path, SOME)
    before = path.read_bytes()
    with log.read(path) as opened:
        (chunk,) = opened.index.chunks
        old = before[chunk.offset : chunk.offset + chunk.length]
        with log.extend(opened) as writer:
            writer.add_channel("new", SCHEMA, "json", {})
    assert old in path.read_bytes()


def test_results_are_replaced_without_opening_what_they_stand_beside(tmp_path):
    path = tmp_path / "a.mcap"
    write_stock(path, SOME)
    size = []
    for round_number in range(4):
        with log.read(path) as opened, log.extend(opened, drop=["result"]) as writer:
            number = writer.add_channel("result", SCHEMA, "json", {})
            writer.add_message(number, round_number, 0, b"the same every time")
        size.append(path.stat().st_size)
        assert our_messages(path)["result"] == [(round_number, 0, b"the same every time")]
    assert max(size) - min(size) < 16


@pytest.mark.parametrize("options", STOCK_OPTIONS.values(), ids=STOCK_OPTIONS)
def test_a_channel_without_messages_is_empty_also_where_no_statistics_count_it(tmp_path, options):
    path = tmp_path / "theirs.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        schema = writer.register_schema("text", "jsonschema", b"{}")
        some, _ = (writer.register_channel(topic, "json", schema) for topic in ("some", "none"))
        writer.add_message(some, 1, b"{}", 1)
        writer.finish()
    with log.read(path) as opened:
        assert opened.channel("none").messages == 0
        assert list(opened.messages("none")) == []
        assert len(list(opened.messages("some"))) == 1


def test_a_topic_can_be_taken_once(tmp_path):
    with pytest.raises(McaptrackError, match="there is a channel a already"), log.create(tmp_path / "a.mcap") as writer:
        writer.add_channel("a", SCHEMA, "json", {})
        writer.add_channel("a", SCHEMA, "json", {})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("t_ns", [-1, 2**64])
def test_times_that_no_log_can_hold_are_refused(tmp_path, t_ns):
    with (
        pytest.raises(McaptrackError, match="is not a time that a log can store"),
        log.create(tmp_path / "a.mcap") as writer,
    ):
        writer.add_message(writer.add_channel("a", SCHEMA, "json", {}), t_ns, 0, b"")


def test_a_failure_leaves_the_old_log_and_nothing_else(tmp_path):
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    before = path.read_bytes()
    with pytest.raises(KeyboardInterrupt), log.read(path) as opened, log.extend(opened) as writer:
        number = writer.add_channel("new", SCHEMA, "json", {})
        for count in range(1000):
            writer.add_message(number, count, 0, b"x" * 5000)
        raise KeyboardInterrupt
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_process_left_is_swept_away(tmp_path):
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    code = (
        "import os, signal, sys; from pathlib import Path; from mcaptrack import log\n"
        "with log.read(Path(sys.argv[1])) as o, log.extend(o) as w:\n"
        "    n = w.add_channel('new', ('s', '', b''), 'json', {}); w.add_message(n, 1, 1, b'x' * 2_000_000)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    before = path.read_bytes()
    subprocess.run([sys.executable, "-c", code, path], check=False)
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 2
    with log.read(path) as opened, log.extend(opened) as writer:
        writer.add_channel("new", SCHEMA, "json", {})
    assert list(tmp_path.iterdir()) == [path]


def test_a_second_writer_is_turned_away(tmp_path):
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    with log.read(path) as first, log.read(path) as second, log.extend(first) as writer:
        writer.add_channel("new", SCHEMA, "json", {})
        with pytest.raises(McaptrackError, match="is being written to by another process"), log.extend(second):
            pass


def test_a_log_that_was_replaced_meanwhile_is_not_extended(tmp_path):
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    with log.read(path) as stale:
        with log.read(path) as opened, log.extend(opened) as writer:
            writer.add_channel("new", SCHEMA, "json", {})
        with pytest.raises(McaptrackError, match="was replaced while it was being read"), log.extend(stale):
            pass
    assert "new" in our_messages(path)


def test_a_copy_leaves_the_log_alone(tmp_path):
    path, copy = tmp_path / "a.mcap", tmp_path / "b.mcap"
    write_log(path, SOME)
    before = path.read_bytes()
    with log.read(path) as opened, log.extend(opened, copy, drop=["a"]):
        pass
    assert path.read_bytes() == before
    assert sorted(our_messages(copy)) == ["b", "c"]


def test_the_full_disk_is_said(tmp_path):
    code = (
        "import resource, sys; from pathlib import Path; from mcaptrack import errors, log\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "try:\n"
        "    with log.read(Path(sys.argv[1])) as o, log.extend(o) as w:\n"
        "        n = w.add_channel('new', ('s', '', b''), 'json', {}, 'media')\n"
        "        for t in range(500): w.add_message(n, t, 0, bytes(20_000))\n"
        "except errors.McaptrackError as error: print(error)\n"
    )
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    before = path.read_bytes()
    done = subprocess.run([sys.executable, "-c", code, path], check=True, capture_output=True, text=True)
    assert f"{path} can't be written: File too large" in done.stdout
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_frames_come_back_with_times_and_empty_ones_too(tmp_path):
    path = tmp_path / "a.mcap"
    frames = [
        Frame(10, 0, tracks_at({1: (1, 2), 2: (3, 4)})),
        Frame(20, 1, TRACKS.empty()),
        Frame(30, 2, tracks_at({1: (5, 6)})),
    ]
    with log.create(path) as writer:
        number = writer.add_channel("/t", (TRACKS.name, "protobuf", TRACKS.descriptor), "protobuf", {})
        for frame in reversed(frames):  # written in any order, read in that of their times
            writer.add_message(number, frame.t_ns, frame.index, TRACKS.codec.encode(frame.rows))
    with log.read(path) as opened:
        read = opened.frames("/t", TRACKS)
        assert opened.times("/t").tolist() == [10, 20, 30]
    assert [(f.t_ns, f.index, TRACKS.codec.encode(f.rows)) for f in read] == [
        (f.t_ns, f.index, TRACKS.codec.encode(f.rows)) for f in frames
    ]
    with path.open("rb") as stream:
        decoded = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert [(m.log_time, [row.x_m for row in d.rows]) for _, _, m, d in decoded] == [(10, [1, 3]), (20, []), (30, [5])]


def test_a_channel_of_another_kind_is_refused(tmp_path):
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    with log.read(path) as opened, pytest.raises(McaptrackError, match=r"a holds test\.Thing, not mcaptrack\.Tracks"):
        opened.frames("a", TRACKS)


def _damage(path: Path) -> dict[str, bytes]:
    whole = path.read_bytes()
    end = len(whole)
    return {
        "empty": b"",
        "text": b"hello, I am no log\n" * 10,
        "magic only": records.MAGIC,
        "cut in half": whole[: end // 2],
        "one byte short": whole[:-1],
        "no footer": whole[: -8 - 29] + whole[-8:],
        "summary beyond the file": whole[: -8 - 20] + struct.pack("<QQI", 2**60, 0, 0) + whole[-8:],
    }


@pytest.mark.parametrize("kind", sorted(_damage(Path(__file__))))
def test_damage_is_said_in_a_line(tmp_path, kind):
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    path.write_bytes(_damage(path)[kind])
    try:
        assert our_messages(path)  # the summary can be done without
    except McaptrackError as error:
        assert str(path) in str(error)
        assert "\n" not in str(error)


@given(at=st.integers(0, 10_000), bit=st.integers(0, 7))
@settings(max_examples=150)
def test_a_flipped_bit_is_never_a_wrong_message(tmp_path_factory, at, bit):
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    messages = [("abc"[n % 3], n * 10, n, bytes([n]) * 40) for n in range(40)]
    write_log(path, messages)
    raw = bytearray(path.read_bytes())
    raw[at % len(raw)] ^= 1 << bit
    path.write_bytes(raw)
    try:
        found = our_messages(path)
    except McaptrackError:
        return
    true = {(topic, t_ns, payload) for topic, t_ns, _, payload in messages}
    read = {(topic, t_ns, payload) for topic, members in found.items() for t_ns, _, payload in members}
    assert read <= true


def _chunk_with(compression: str, data: bytes, size: int, crc: int = 0) -> bytes:
    return records.pack_chunk((1, 1, size, crc), compression, data)


@pytest.mark.parametrize(
    ("chunk", "words"),
    [
        (_chunk_with("zstd", zstandard.compress(bytes(200 << 20)), 1000), "a chunk of 1001 bytes that says 1000"),
        (_chunk_with("", b"abc", 2**40), "a chunk of 3 bytes that says 1099511627776"),
        (
            _chunk_with("zstd", b"abc", 2**63),
            "a chunk of 9223372036854775808 bytes, of at most 256 MiB that are opened",
        ),
        (_chunk_with("br", b"abc", 3), "compressed with 'br', which is not known here"),
        (_chunk_with("zstd", b"no zstd at all", 10), "a chunk can't be decompressed"),
        (_chunk_with("lz4", b"no lz4 at all", 10), "a chunk can't be decompressed"),
        (_chunk_with("", b"abc", 3, zlib.crc32(b"abd")), "the checksum of a chunk is wrong"),
        (
            _chunk_with("", b"\x05" + (2**50).to_bytes(8, "little"), 9),
            "a record of 1125899906842624 bytes where 0 are left",
        ),
    ],
)
def test_hostile_chunks_are_refused_before_they_cost_anything(tmp_path, chunk, words):
    path = tmp_path / "a.mcap"
    header = records.pack(1, records.text(""), records.text("x"))
    footer = records.pack(2, bytes(20))
    path.write_bytes(records.MAGIC + header + chunk + records.pack(15, bytes(4)) + footer + records.MAGIC)
    with pytest.raises(McaptrackError, match=words):
        our_messages(path)


def test_what_counts_as_too_large_a_chunk_can_be_said(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    write_stock(path, [("a", 1, 1, bytes(3 * 2**20))], chunk_size=2**20)
    monkeypatch.setenv("MCAPTRACK_MAX_CHUNK_MIB", "2")
    with pytest.raises(McaptrackError, match=r"of at most 2 MiB that are opened .* MCAPTRACK_MAX_CHUNK_MIB"):
        our_messages(path)
    monkeypatch.setenv("MCAPTRACK_MAX_CHUNK_MIB", "4")
    assert len(our_messages(path)["a"]) == 1


@pytest.mark.parametrize("options", STOCK_OPTIONS.values(), ids=STOCK_OPTIONS)
@given(messages=MESSAGES, span=st.tuples(st.integers(0, 2**62), st.integers(0, 2**62)))
@settings(max_examples=20)
def test_a_span_of_time_over_several_channels_is_what_the_stock_reader_gives(tmp_path_factory, options, messages, span):
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    write_stock(path, messages, **options)
    start_ns, end_ns = sorted(span)
    with log.read(path) as opened:
        found = [
            (t, m.t_ns, m.sequence, m.payload)
            for t in sorted({"a", "c"} & opened.channels.keys())
            for m in opened.messages(t, start_ns, end_ns)
        ]
    wanted = [m for m in messages if m[0] in "ac" and start_ns <= m[1] < end_ns]
    assert sorted(found) == sorted(wanted)
    assert found == sorted(found, key=lambda m: m[:2])


def test_chunks_outside_of_the_span_are_not_touched(tmp_path):
    path = tmp_path / "a.mcap"
    write_stock(path, [("a", t, t, bytes([t]) * 300) for t in range(100)], chunk_size=1000)
    with log.read(path) as opened:
        chunk = opened.index.chunks[-1]
    raw = bytearray(path.read_bytes())
    raw[chunk.offset + 70 : chunk.offset + 80] = bytes(10)
    path.write_bytes(raw)
    with log.read(path) as opened:
        assert [m.t_ns for m in opened.messages("a", 10, 20)] == list(range(10, 20))
        with pytest.raises(McaptrackError, match=r"is damaged: byte .*`mcaptrack\.recover\(.*\)` saves what is intact"):
            list(opened.messages("a", 10))


def test_chunks_that_all_overlap_are_not_all_open(tmp_path, monkeypatch):
    from mcaptrack.log import messages as reading

    path = tmp_path / "a.mcap"
    times = [(t * 37) % 400 for t in range(400)]
    write_stock(path, [("a", t, t, bytes([t % 256]) * 100) for t in times], chunk_size=1000)
    opened_chunks = []
    opening = reading.open_chunk_with_checksum
    monkeypatch.setattr(
        reading, "open_chunk_with_checksum", lambda *where: opened_chunks.append(where) or opening(*where)
    )
    with log.read(path) as opened:
        chunks = len(opened.index.chunks)
        assert [m.t_ns for m in opened.messages("a")] == sorted(times)
        assert len(opened_chunks) == chunks > 30
        monkeypatch.setattr(reading, "OPEN_BYTES", 4000)
        assert [(m.t_ns, m.payload[0]) for m in opened.messages("a")] == [(t, t % 256) for t in sorted(times)]
        assert len(opened_chunks) > 3 * chunks  # closed and opened again


def test_the_same_messages_give_the_same_bytes(tmp_path):
    write_log(tmp_path / "a.mcap", SOME)
    write_log(tmp_path / "b.mcap", SOME)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_the_stock_library_is_happy_with_an_empty_log(tmp_path):
    with log.create(tmp_path / "a.mcap"):
        pass
    assert stock_messages(tmp_path / "a.mcap") == []
    with log.read(tmp_path / "a.mcap") as opened:
        assert opened.channels == {}


def test_a_channel_that_is_not_there_is_named_beside_those_that_are(tmp_path):
    write_log(tmp_path / "a.mcap", SOME)
    with log.read(tmp_path / "a.mcap") as opened:
        for look in (opened.channel, opened.times, opened.places, opened.messages, opened.fingerprint):
            with pytest.raises(McaptrackError, match=r"a\.mcap has no channel /none; it has a, b, c"):
                list(look("/none"))
