"""A topic may be given by its end: "tracks" for /camera/tracks, in all that takes a topic."""

from __future__ import annotations

import inspect
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.log import find_topic
from mcaptrack.schema import TRACKS, Frame
from tests.extension_cases import of_extensions
from tests.logs import recorder
from tests.tiers import one_in
from tests.worlds import tracks_at


def _results(path: Path) -> dict[str, tuple[int, ...]]:
    with log.read(path) as opened:
        return {name: tuple(opened.times(name).tolist()) for name in opened.channels}


def _of_copy(work: Callable[[Path, str, Path], object]) -> Callable[[Path, str, Path], Any]:
    def done(path: Path, topic: str, folder: Path) -> Any:
        work(path, topic, folder / "copy.mcap")
        return _results(folder / "copy.mcap")

    return done


def _reads(read: Callable[[mcaptrack.Recording, str], Any]) -> Callable[[Path, str, Path], Any]:
    def done(path: Path, topic: str, _: Path) -> Any:
        with mcaptrack.open(path) as recording:
            return read(recording, topic)

    return done


def _times(frames: Iterator[Any]) -> list[int]:
    return [frame[0] for frame in frames]


#: What takes a topic, the topic to try, and what comes of it, which is the same for the topic and its end.
FUNCTIONS: Mapping[str, tuple[str, Callable[[Path, str, Path], Any]]] = {
    "detect": ("video", _of_copy(lambda p, t, o: mcaptrack.detect(p, topic=t, output=o))),
    "motion": ("video", _of_copy(lambda p, t, o: mcaptrack.motion(p, topic=t, output=o))),
    "track": ("detections", _of_copy(lambda p, t, o: mcaptrack.track(p, topic=t, output=o))),
    "sample": ("tracks", _of_copy(lambda p, t, o: mcaptrack.sample(p, topic=t, output=o))),
    "predict": ("samples", _of_copy(lambda p, t, o: mcaptrack.predict(p, topic=t, output=o))),
    "retrack": ("samples", _of_copy(lambda p, t, o: mcaptrack.retrack(p, topic=t, output=o))),
    "stage": ("detections", _of_copy(lambda p, t, o: mcaptrack.stage("track", p, topic=t, output=o))),
    "run": ("detections", _of_copy(lambda p, t, o: mcaptrack.run(p, topic=t, output=o, force=True))),
    "events": ("tracks", _of_copy(lambda p, t, o: mcaptrack.events(p, topic=t, output=o))),
    "drop": ("decisions", _of_copy(lambda p, t, o: mcaptrack.drop(p, t, output=o))),
    "cut": ("tracks", lambda p, t, o: mcaptrack.cut(p, o / "copy.mcap", topic=t).messages),
    "export": ("tracks", lambda p, t, f: dict(mcaptrack.export(p, f / "a.txt", form="mot", topic=t).rows)),
    "evaluate": ("tracks", lambda p, t, _: repr(mcaptrack.evaluate(p, topic=t).rows)),
} | of_extensions("TOPICS")
METHODS: Mapping[str, tuple[str, Callable[[Path, str, Path], Any]]] = {
    "table": ("tracks", _reads(lambda r, t: r.table("tracks", t).num_rows)),
    "array": ("tracks", _reads(lambda r, t: len(r.array("tracks", t)))),
    "frames": ("tracks", _reads(lambda r, t: _times(r.frames(t)))),
    "messages": ("tracks", _reads(lambda r, t: [m.log_time for _, _, m, _ in r.messages(t)])),
    "supervision": ("tracks", _reads(lambda r, t: _times(r.supervision(t)))),
} | of_extensions("TOPICS_OF_RECORDINGS")
#: A topic that these make, and that need not be there; and what an extension shows.
MAKES = {"write", "show"}


def _taking(where: object) -> set[str]:
    public = {name: thing for name, thing in inspect.getmembers(where) if not name.startswith("_")}
    functions = {name: thing for name, thing in public.items() if inspect.isfunction(thing)}
    return {name for name, thing in functions.items() if {"topic", "topics"} & set(inspect.signature(thing).parameters)}


def test_all_that_takes_a_topic_is_tried():
    assert _taking(mcaptrack) == set(FUNCTIONS)
    assert _taking(mcaptrack.Recording) == set(METHODS) | MAKES


@pytest.mark.parametrize(
    ("end", "work"), one_in(3, [*FUNCTIONS.values(), *METHODS.values()]), ids=[*FUNCTIONS, *METHODS]
)
def test_the_end_of_a_topic_is_the_topic(template, tmp_path, end, work):
    if work is METHODS["supervision"][1]:
        pytest.importorskip("supervision")
    with log.read(template) as opened:
        (whole,) = [name for name in opened.channels if name.endswith(f"/{end}")]
    out = []
    for topic in (whole, end):
        folder = tmp_path / str(len(out))
        folder.mkdir()
        path = Path(shutil.copy(template, folder / "log.mcap"))
        out.append(work(path, topic, folder))
    assert out[0] == out[1]
    assert out[0]


@pytest.mark.parametrize(("end", "work"), [*FUNCTIONS.values(), *METHODS.values()], ids=[*FUNCTIONS, *METHODS])
def test_a_topic_of_a_camera_that_is_not_there_is_refused(template, tmp_path, end, work):
    path = Path(shutil.copy(template, tmp_path / "log.mcap"))
    with pytest.raises(McaptrackError, match=f"/cmaera/{end}"):
        work(path, f"/cmaera/{end}", tmp_path)
    assert path.read_bytes() == template.read_bytes()
    assert not (tmp_path / "copy.mcap").exists()


def test_a_name_that_several_channels_end_with_is_refused_with_them():
    topics = ["/left/tracks", "/right/tracks", "/right/video", "odd"]
    assert find_topic("/left/tracks", topics, Path("a")) == find_topic("left/tracks", topics, Path("a"))
    assert find_topic("video", topics, Path("a")) == "/right/video"
    assert find_topic("odd", topics, Path("a")) == "odd"
    assert find_topic("tracks", topics, Path("a"), "/right") == "/right/tracks"
    assert find_topic("racks", topics, Path("a")) == "racks"
    assert find_topic("samples", topics, Path("a"), "/right") == "/right/samples"
    for nothing in ("", "/"):
        assert find_topic(nothing, topics, Path("a")) == nothing
    with pytest.raises(McaptrackError, match="a has 2 channels tracks: /left/tracks, /right/tracks; name one whole"):
        find_topic("tracks", topics, Path("a"))


def test_the_name_below_the_camera_is_taken_where_there_are_several(template, tmp_path):
    path = Path(shutil.copy(template, tmp_path / "log.mcap"))
    with mcaptrack.open(path) as recording:
        recording.write("/right/tracks", recording.array("tracks", "/camera/tracks")[:0])
        with pytest.raises(McaptrackError, match="has 2 channels tracks: /camera/tracks, /right/tracks"):
            recording.frames("tracks")
        assert list(recording.frames("camera/tracks"))
    assert np.isfinite(len(mcaptrack.events(path, topic="tracks", camera="camera", output=tmp_path / "b.mcap").events))


# Channels that share a topic: each is listed with its messages, and all are read as one.


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
