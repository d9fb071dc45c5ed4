"""Channels that share a topic: each is listed with its messages, and all are read as one."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import TRACKS, Frame
from tests.logs import recorder
from tests.worlds import tracks_at

#: Definitions that decode alike, and one that doesn't.
ALIKE = ("string data\n", "# said by others\nstring   data  # words\n\n")
OTHER = "string data\nint32 count\n"

#: Topic, which definition, encoding, and the times of the channel's messages.
CHANNELS = st.lists(
    st.tuples(
        st.sampled_from(["/tf", "/talk"]),
        st.sampled_from([*ALIKE, OTHER]),
        st.sampled_from(["ros1", "cdr"]),
        st.lists(st.integers(0, 50), max_size=4),
    ),
    max_size=5,
)


def write(path: Path, channels: list[tuple[str, str, str, list[int]]], chunk_size: int = 2**20) -> None:
    """Channels by the stock writer, their messages in turns; without chunks for a ``chunk_size`` of 0."""
    with recorder(path, chunk_size=chunk_size, use_chunking=chunk_size > 0) as writer:
        turns = []
        for number, (topic, definition, encoding, times) in enumerate(channels):
            schema = writer.register_schema("std_msgs/String", "ros1msg", definition.encode())
            channel = writer.register_channel(topic, encoding, schema, {"callerid": str(number)})
            turns += [(place, channel, t_ns) for place, t_ns in enumerate(times)]
        for place, channel, t_ns in sorted(turns):
            writer.add_message(channel, t_ns, bytes([channel, place]), t_ns)


def stock(path: Path) -> tuple[int, list[tuple[str, int]], list[tuple[str, int, bytes]]]:
    """By the stock reader: all messages that the statistics count, those of each channel, and the messages."""
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        counts = summary.statistics.channel_message_counts
        channels = [(channel.topic, counts.get(channel.id, 0)) for channel in summary.channels.values()]
        messages = [(channel.topic, m.log_time, m.data) for _, channel, m in reader.iter_messages()]
        return summary.statistics.message_count, channels, messages


@settings(max_examples=40)
@given(channels=CHANNELS, chunk_size=st.sampled_from([0, 1, 2**20]))
@example(channels=[("/tf", definition, "ros1", [3, 20]) for definition in ALIKE], chunk_size=0)
def test_each_topic_is_read_whole_or_refused(tmp_path_factory, channels, chunk_size):
    path = tmp_path_factory.mktemp("shared") / "a.mcap"
    write(path, channels, chunk_size)
    total, counts, messages = stock(path)
    with log.read(path) as opened:
        assert sorted((channel.topic, channel.messages) for channel in opened.recorded) == sorted(counts)
        assert sum(channel.messages for channel in opened.channels.values()) == total
        for topic in opened.channels:
            those = [channel for channel in channels if channel[0] == topic and channel[3]]
            if len({(definition in ALIKE, encoding) for _, definition, encoding, _ in those}) > 1:
                with pytest.raises(McaptrackError, match=f"messages of {topic} have different layouts: "):
                    list(opened.messages(topic))
                with pytest.raises(McaptrackError, match="have different layouts"):
                    opened.times(topic)
                continue
            found = [(topic, message.t_ns, message.payload) for message in opened.messages(topic)]
            assert sorted(found) == sorted(message for message in messages if message[0] == topic)
            assert [t_ns for _, t_ns, _ in found] == opened.times(topic).tolist() == sorted(t for _, t, _ in found)
            places = opened.places(topic)
            chunks = [None if chunk < 0 else chunk for chunk in places.chunk_offset.tolist()]
            there = [opened.message_at(*place) for place in zip(chunks, places.offset.tolist(), strict=True)]
            assert [(name, message.t_ns, message.payload) for name, message in there] == found
            part = [(t_ns, payload) for _, t_ns, payload in found if 10 <= t_ns < 30]
            assert [(m.t_ns, m.payload) for m in opened.messages(topic, 10, 30)] == part


def test_rows_of_several_channels_come_by_time(tmp_path):
    frames = [Frame(10 * (number ^ 1), number, tracks_at({number: (float(number), 1.0)})) for number in range(6)]
    with log.create(tmp_path / "a.mcap") as writer:
        for those in (frames[::2], frames[1::2]):
            record = (TRACKS.name, "protobuf", TRACKS.descriptor)
            channel = writer.add_channel("/camera/tracks", record, "protobuf", {}, another=True)
            for frame in those:
                writer.add_message(channel, frame.t_ns, frame.index, TRACKS.codec.encode(frame.rows))
    with log.read(tmp_path / "a.mcap") as opened:
        found = opened.frames("/camera/tracks", TRACKS)
    assert [frame.t_ns for frame in found] == [0, 10, 20, 30, 40, 50]
    in_order = sorted(frames, key=lambda frame: frame.t_ns)
    encode = TRACKS.codec.encode
    assert [encode(frame.rows) for frame in found] == [encode(frame.rows) for frame in in_order]
