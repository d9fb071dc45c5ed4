"""Logs: what is written can be read, by others too; what stood stays; what is damaged is said."""

from __future__ import annotations

import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.log import records
from mcaptrack.schema import TRACKS
from tests.logs import (
    MESSAGES,
    SCHEMA,
    SOME,
    STOCK_OPTIONS,
    our_messages,
    recorder,
    stock_messages,
    write_log,
    write_stock,
)


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


@pytest.mark.parametrize("options", STOCK_OPTIONS.values(), ids=STOCK_OPTIONS)
def test_a_channel_without_messages_is_empty_also_where_no_statistics_count_it(tmp_path, options):
    path = tmp_path / "theirs.mcap"
    with recorder(path, **options) as writer:
        schema = writer.register_schema("text", "jsonschema", b"{}")
        some, _ = (writer.register_channel(topic, "json", schema) for topic in ("some", "none"))
        writer.add_message(some, 1, b"{}", 1)
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


def test_a_log_that_was_replaced_meanwhile_is_not_extended(tmp_path):
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    with log.read(path) as stale:
        with log.read(path) as opened, log.extend(opened) as writer:
            writer.add_channel("new", SCHEMA, "json", {})
        with pytest.raises(McaptrackError, match="was replaced while it was being read"), log.extend(stale):
            pass
    assert "new" in our_messages(path)


def test_a_channel_of_another_kind_is_refused(tmp_path):
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    with log.read(path) as opened, pytest.raises(McaptrackError, match=r"a holds test\.Thing, not mcaptrack\.Tracks"):
        opened.frames("a", TRACKS)


def test_hostile_chunks_are_refused_before_they_cost_anything(tmp_path):
    path = tmp_path / "a.mcap"
    header = records.pack(1, records.text(""), records.text("x"))
    footer = records.pack(2, bytes(20))
    bomb, endless = zstandard.compress(bytes(200 << 20)), b"\x05" + (2**50).to_bytes(8, "little")
    for compression, data, size, words in (
        ("zstd", bomb, 1000, "a chunk of 1001 bytes that says 1000"),
        ("", b"abc", 2**40, "a chunk of 3 bytes that says 1099511627776"),
        ("zstd", b"abc", 2**63, "a chunk of 9223372036854775808 bytes, of at most 256 MiB that are opened"),
        ("", endless, 9, "a record of 1125899906842624 bytes where 0 are left"),
    ):
        chunk = records.pack_chunk((1, 1, size, 0), compression, data)
        path.write_bytes(records.MAGIC + header + chunk + records.pack(15, bytes(4)) + footer + records.MAGIC)
        with pytest.raises(McaptrackError, match=words):
            our_messages(path)


@pytest.mark.parametrize("options", STOCK_OPTIONS.values(), ids=STOCK_OPTIONS)
@given(messages=MESSAGES, span=st.tuples(st.integers(0, 2**62), st.integers(0, 2**62)))
@settings(max_examples=8)
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
    raw[chunk.chunk_start_offset + 70 : chunk.chunk_start_offset + 80] = bytes(10)
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


def test_a_channel_that_is_not_there_is_named_beside_those_that_are(tmp_path):
    write_log(tmp_path / "a.mcap", SOME)
    with log.read(tmp_path / "a.mcap") as opened:
        for look in (opened.channel, opened.times, opened.places, opened.messages, opened.fingerprint):
            with pytest.raises(McaptrackError, match=r"a\.mcap has no channel /none; it has a, b, c"):
                list(look("/none"))
