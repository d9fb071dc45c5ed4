"""Cutting and merging logs: the messages are those that the stock reader finds, and what holds at the start stays."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType

import mcaptrack
from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError
from mcaptrack.pipeline.cutting import CUT, cut
from mcaptrack.sources.pictures import Pictures
from tests.commands import call, done
from tests.logs import FORTY, MESSAGES, STOCK_OPTIONS, recorder, stock_messages, write_log, write_stock
from tests.worlds import SVT, X265, write_clip

SPANS = st.tuples(*[st.none() | st.integers(1, 2**62)] * 2)


def cut_ns(paths: list[Path], output: Path, span=(None, None), topics="abc"):
    opened = [log.read(path) for path in paths]
    try:
        return cut(opened, output, set(topics), span)
    finally:
        for each in opened:
            each.__exit__()


def within(messages, span, topics="abc"):
    start, end = span
    return sorted(
        message
        for message in messages
        if message[0] in topics and (start is None or message[1] >= start) and (end is None or message[1] < end)
    )


def errors(path: Path) -> list[str]:
    return [finding.words for finding in log.check(path).findings if finding.level == "error"]


def about(path: Path) -> tuple[list[tuple[str, bytes]], list[tuple[str, dict[str, str]]]]:
    with path.open("rb") as stream:
        reader = make_reader(stream)
        attachments = [(it.name, it.data) for it in reader.iter_attachments()]
        return attachments, [(it.name, it.metadata) for it in reader.iter_metadata()]


# The messages.


@pytest.mark.parametrize("options", STOCK_OPTIONS)
@given(messages=MESSAGES, span=SPANS, topics=st.sets(st.sampled_from("abc"), min_size=1))
@settings(max_examples=8)
def test_a_cut_has_the_messages_of_its_time_and_topics(tmp_path_factory, options, messages, span, topics):
    path = tmp_path_factory.mktemp("cut") / "a.mcap"
    write_stock(path, messages, **STOCK_OPTIONS[options])
    cut_ns([path], out := path.with_name("b.mcap"), span, topics)
    assert sorted(stock_messages(out)) == within(messages, span, topics)
    assert errors(out) == []
    with log.read(out) as opened, log.read(path) as whole:
        assert {*opened.channels} == topics & whole.channels.keys()


@given(messages=MESSAGES, at=st.integers(1, 2**62), kind=st.sampled_from(["rows", "media"]))
def test_parts_of_a_log_make_the_whole(tmp_path_factory, messages, at, kind):
    path = tmp_path_factory.mktemp("parts") / "a.mcap"
    write_log(path, messages, kind)
    early, late, out = (path.with_name(name) for name in ("early.mcap", "late.mcap", "all.mcap"))
    cut_ns([path], early, (None, at))
    cut_ns([path], late, (at, None))
    cut_ns([late, early], out)
    assert sorted(stock_messages(out)) == sorted(stock_messages(path))
    assert errors(out) == []


@pytest.mark.parametrize("options", STOCK_OPTIONS)
def test_merged_logs_have_the_messages_of_both(tmp_path, options):
    later = [(topic, t_ns + 205, number, data + b"!") for topic, t_ns, number, data in FORTY]
    write_stock(tmp_path / "a.mcap", FORTY, **STOCK_OPTIONS[options])
    write_log(tmp_path / "b.mcap", later)
    with pytest.warns(mcaptrack.McaptrackWarning, match="from the same time in several logs"):
        cut_ns([tmp_path / "a.mcap", tmp_path / "b.mcap"], out := tmp_path / "c.mcap")
    assert stock_messages(out) == sorted([*FORTY, *later], key=lambda message: message[1])
    assert errors(out) == []
    assert about(out) == ([("notes.txt", b"hello")], [("about", {"robot": "r2"})])
    with log.read(out) as opened:
        assert len(opened.recorded) == 3


def test_whole_chunks_stay_the_same_to_the_byte(tmp_path):
    write_stock(tmp_path / "a.mcap", FORTY, compression=CompressionType.LZ4, chunk_size=200)
    cut_ns([tmp_path / "a.mcap"], tmp_path / "b.mcap", (100, 300))
    chunks = []
    for name in "ab":
        with log.read(tmp_path / f"{name}.mcap") as opened:
            places = [(it.chunk_start_offset, it.chunk_length) for it in opened.index.chunks]
            chunks.append([bytes(opened.snapshot.source[at : at + size]) for at, size in places])
    assert len(chunks[1]) > 4
    assert len({*chunks[1]} - {*chunks[0]}) <= 2  # those at the ends


def test_topics_with_other_schemas_stay_apart(tmp_path):
    write_stock(tmp_path / "a.mcap", FORTY)
    with log.create(tmp_path / "b.mcap") as writer:
        number = writer.add_channel("a", ("another", "jsonschema", b"{}"), "json", {})
        writer.add_message(number, 1000, 1, b"{}")
    cut_ns([tmp_path / "a.mcap", tmp_path / "b.mcap"], out := tmp_path / "c.mcap")
    with out.open("rb") as stream:
        schemas = {(c.topic, s.name) for s, c, _ in make_reader(stream).iter_messages()}
    assert {("a", "test.Thing"), ("a", "another")} <= schemas


# What holds at the start.

QOS = "- history: 3\n  depth: {depth}\n  durability: {durability}\n"
CHANNELS = {
    "/map": ("nav_msgs/msg/OccupancyGrid", {}, 1),
    "/robot_description": ("std_msgs/msg/String", {"offered_qos_profiles": QOS.format(depth=1, durability=1)}, 1),
    "/goals": ("std_msgs/msg/Int8", {"offered_qos_profiles": QOS.format(depth=3, durability="transient_local")}, 3),
    "/old": ("std_msgs/Int8", {"latching": "1"}, 1),
    "/camera_info": ("sensor_msgs/msg/CameraInfo", {"offered_qos_profiles": QOS.format(depth=9, durability=2)}, 1),
    "/calibration": ("foxglove.CameraCalibration", {}, 1),
    "/all": ("std_msgs/msg/Int8", {"offered_qos_profiles": "- history: keep_all\n  durability: volatile"}, 0),
    "/imu": ("sensor_msgs/msg/Imu", {"offered_qos_profiles": QOS.format(depth=5, durability=2)}, 0),
}


@given(
    times=st.lists(st.tuples(st.sampled_from([*CHANNELS]), st.integers(1, 60)), max_size=60), start=st.integers(1, 60)
)
@settings(max_examples=50)
def test_what_holds_at_the_start_is_what_late_subscribers_get(tmp_path_factory, times, start):
    path = tmp_path_factory.mktemp("held") / "a.mcap"
    messages = [(topic, t_ns, number, bytes([number])) for number, (topic, t_ns) in enumerate(times)]
    with recorder(path, chunk_size=100) as writer:
        ids = {
            topic: writer.register_channel(topic, "json", writer.register_schema(name, "jsonschema", b"{}"), metadata)
            for topic, (name, metadata, _) in CHANNELS.items()
        }
        for topic, t_ns, number, data in messages:
            writer.add_message(ids[topic], t_ns, data, t_ns, number)
    cut_ns([path], out := path.with_name("b.mcap"), (start, None), CHANNELS)
    before = sorted((m for m in messages if m[1] < start), key=lambda m: m[1])
    held = {
        topic: [m[3] for m in before if m[0] == topic][-count:] if count else []
        for topic, (*_, count) in CHANNELS.items()
    }
    cut_out = stock_messages(out)
    assert {topic: [m[3] for m in cut_out if m[0] == topic and m[1] < start] for topic in CHANNELS} == held
    assert {m[1] for m in cut_out if m[1] < start} <= {start - 1}
    assert sorted(m for m in cut_out if m[1] >= start) == within(messages, (start, None), CHANNELS)


def frame_transform(t_ns: int, child: str, x: float) -> bytes:
    message = foxglove.message_class("foxglove.FrameTransform")(parent_frame_id="map", child_frame_id=child)
    message.translation.x = x
    return foxglove.messages.pack_stamped(message, t_ns)


def test_the_last_transform_of_each_frame_holds(tmp_path):
    told = [(1, "arm", 1.0), (2, "arm", 2.0), (3, "base", 3.0), (4, "base", 4.0), (9, "arm", 9.0)]
    with log.create(tmp_path / "a.mcap") as writer:
        number = writer.add_channel("/tf", foxglove.schema_record("foxglove.FrameTransform"), "protobuf", {})
        for t_ns, child, x in told:
            writer.add_message(number, t_ns, 0, frame_transform(t_ns, child, x))
    cut_ns([tmp_path / "a.mcap"], out := tmp_path / "b.mcap", (5, None), ["/tf"])
    assert [m[1:] for m in stock_messages(out)] == [
        (4, 0, frame_transform(2, "arm", 2.0)), (4, 0, frame_transform(4, "base", 4.0)), (9, 0, frame_transform(9, "arm", 9.0)),
    ]  # fmt: skip


def test_a_scene_that_has_ended_does_not_come_back(tmp_path):
    kind = foxglove.message_class(foxglove.SCENE)
    lasting, brief = kind(), kind()
    lasting.entities.add(id="wall")
    brief.entities.add(id="walker").lifetime.nanos = 5
    with log.create(tmp_path / "a.mcap") as writer:
        for topic, scene in (("/walls", lasting), ("/walkers", brief)):
            number = writer.add_channel(topic, foxglove.schema_record(foxglove.SCENE), "protobuf", {})
            writer.add_message(number, 1, 0, scene.SerializeToString())
            writer.add_message(number, 90, 0, b"")
    cut_ns([tmp_path / "a.mcap"], tmp_path / "b.mcap", (50, None), ["/walls", "/walkers"])
    assert [(m[0], m[1]) for m in stock_messages(tmp_path / "b.mcap")] == [
        ("/walls", 49),
        ("/walls", 90),
        ("/walkers", 90),
    ]


CLIPS = {
    "h264": ("a.mp4", {"options": {"bf": "0", "g": "10"}}),
    "h265": ("a.mp4", {"codec": "libx265", "options": X265}),
    "vp9": ("a.webm", {"codec": "libvpx-vp9", "options": {"g": "10"}}),
    "av1": ("a.mp4", {"codec": "libsvtav1", "options": SVT, "size": (96, 80)}),
    "jpeg": ("a.mp4", {}),
}


@pytest.mark.parametrize("codec", CLIPS)
def test_the_first_second_of_video_is_seen(tmp_path, codec):
    name, clip = CLIPS[codec]
    write_clip(tmp_path / name, frames=30, **clip)
    done(
        "ingest",
        tmp_path / name,
        "--image-format",
        "auto" if codec in ("vp9", "av1") else codec,
        "-o",
        tmp_path / "whole.mcap",
    )
    mcaptrack.cut(tmp_path / "whole.mcap", tmp_path / "cut.mcap", start_s=1.55, end_s=2.5)
    seen = []
    for path in ("whole.mcap", "cut.mcap"):
        with log.read(tmp_path / path) as opened:
            pictures = Pictures(opened, "/camera/video")
            times = [t_ns for t_ns in pictures.t_ns.tolist() if 1.55e9 <= t_ns < 2.5e9]
            seen.append([(frame.t_ns, frame.rows.tobytes()) for frame in pictures.at(times)])
            early = [t_ns for t_ns in pictures.t_ns.tolist() if t_ns < 1.55e9]
    assert seen[0] == seen[1]
    assert len(seen[0]) == 9
    assert len(early) <= (10 if codec != "jpeg" else 0)


# Results.


def stale(path: Path) -> set[str]:
    return {channel.topic for channel in mcaptrack.info(path).channels if channel.stale}


def described(path: Path) -> dict[str, dict[str, str]]:
    with log.read(path) as opened:
        return {topic: dict(channel.metadata) for topic, channel in opened.channels.items()}


def test_results_stay_up_to_date_and_are_told_from_those_of_the_whole(finished, tmp_path):
    out = tmp_path / "cut.mcap"
    done("cut", finished, "-o", out, "--start-s", "1", "--end-s", "3")
    assert stale(finished) == stale(out) == set()
    assert mcaptrack.check(out).is_sound
    assert done("run", out, "-q", "--json").out.count('"stages": []')
    with log.read(finished) as whole, log.read(out) as part:
        for topic, channel in part.channels.items():
            if "mcaptrack.digest" in channel.metadata:
                assert channel.metadata["mcaptrack.digest"] != whole.channels[topic].metadata["mcaptrack.digest"]
    done("cut", out, "-o", tmp_path / "again.mcap", "--start-s", "1", "--end-s", "1.5")
    assert stale(tmp_path / "again.mcap") == set()


def test_what_is_out_of_date_stays_so(finished, tmp_path):
    with log.read(finished) as opened, log.extend(opened, tmp_path / "old.mcap", drop=["/camera/detections"]) as writer:
        channel = opened.channel("/camera/detections")
        schema = opened.index.schemas[opened.index.channels[channel.id].schema_id]
        metadata = channel.metadata | {"mcaptrack.digest": "another"}
        number = writer.add_channel(channel.topic, (schema.name, schema.encoding, schema.data), "protobuf", metadata)
        for message in opened.messages(channel.topic):
            writer.add_message(number, message.t_ns, message.sequence, message.payload)
    was = stale(tmp_path / "old.mcap")
    done("cut", tmp_path / "old.mcap", "-o", tmp_path / "cut.mcap", "--start-s", "1")
    assert stale(tmp_path / "cut.mcap") == was != set()


def test_parts_of_results_make_the_whole(finished, tmp_path):
    for name, span in {
        "a": ["--end-s", "1.2"],
        "b": ["--start-s", "1.2", "--end-s", "2"],
        "c": ["--start-s", "2"],
    }.items():
        done("cut", finished, "-o", tmp_path / f"{name}.mcap", *span)
    assert mcaptrack.cut([tmp_path / f"{name}.mcap" for name in "cab"], tmp_path / "all.mcap").warnings == ()
    assert sorted(stock_messages(tmp_path / "all.mcap")) == sorted(stock_messages(finished))
    assert described(tmp_path / "all.mcap") == described(finished)
    assert [sorted(listed, key=str) for listed in about(tmp_path / "all.mcap")] == [
        sorted(listed, key=str) for listed in about(finished)
    ]
    with log.read(tmp_path / "b.mcap") as opened:
        assert {*(opened.metadata(CUT) or {})} == {"start_ns", "end_ns"}


def test_of_parts_that_overlap_results_are_taken_once(finished, tmp_path):
    for name, span in {"a": ["--end-s", "2"], "b": ["--start-s", "1"]}.items():
        done("cut", finished, "-o", tmp_path / f"{name}.mcap", *span)
    for names in (["a", "b"], ["b", "a", "b"]):
        merged = mcaptrack.cut([tmp_path / f"{name}.mcap" for name in names], tmp_path / "all.mcap", force=True)
        results = {topic for topic, metadata in described(finished).items() if "mcaptrack.digest" in metadata}
        assert {"/camera/tracks", "/camera/retracks"} <= results <= {*merged.topics}
        messages = [stock_messages(path) for path in (finished, tmp_path / "all.mcap")]
        whole, joined = (sorted(message for message in each if message[0] in results) for each in messages)
        assert whole == joined
        assert described(tmp_path / "all.mcap") == described(finished)


def test_results_of_several_logs_are_left_out(finished, tmp_path):
    done("track", finished, "-o", tmp_path / "tracked.mcap", "--tracker", "bytetrack", "--min-hits-s", "0.9", "-q")
    done("run", tmp_path / "tracked.mcap", "-o", other := tmp_path / "other.mcap", "--no-tables", "-q")
    merged = mcaptrack.cut([finished, other], tmp_path / "all.mcap")
    assert "/camera/tracks" not in merged.topics
    assert {"/camera/video", "/camera/truth", "/camera/detections"} <= {*merged.topics}
    assert [notice.code for notice in merged.warnings].count("left-out") == 1
    assert mcaptrack.check(tmp_path / "all.mcap").is_sound


def test_chosen_results_bring_what_says_that_they_are_up_to_date(finished, tmp_path):
    result = mcaptrack.cut(finished, tmp_path / "a.mcap", topic=["tracks", "/camera/*/view/log"], exclude="*retracks*")
    assert {*result.topics} == {"/camera/tracks", "/camera/tracks/events/view/log", "/camera/ground_plane"} | (
        {"/camera/truth"} & {*result.topics}
    )
    assert stale(tmp_path / "a.mcap") == set()


def test_results_beside_a_log_come_into_the_cut(finished, tmp_path):
    done("cut", finished, "-o", tmp_path / "a.mcap", "--topic", "/camera/video", "--topic", "ground_plane")
    done("detect", tmp_path / "a.mcap", "--sidecar", "-q")
    done("cut", tmp_path / "a.mcap", "-o", tmp_path / "b.mcap", "--end-s", "2")
    assert {"/camera/video", "/camera/detections"} <= mcaptrack.info(tmp_path / "b.mcap").to_json().keys() | {
        channel.topic for channel in mcaptrack.info(tmp_path / "b.mcap").channels
    }
    assert stale(tmp_path / "b.mcap") == set()


def test_around_an_event(finished, tmp_path):
    from mcaptrack.viewing.links import find_moments

    with log.read(finished) as opened:
        events = find_moments(opened)
        start_ns = opened.start_ns
    if not events:
        pytest.skip("nothing happens in the log")
    result = mcaptrack.cut(finished, tmp_path / "a.mcap", around=1, margin_s=0.5)
    at_s = Fraction(events[0].t_ns - start_ns, 10**9)
    assert result.start_s <= at_s - Fraction(1, 2) + Fraction(1, 10**6)
    assert result.end_s == pytest.approx(float(at_s) + 0.5)
    with pytest.raises(McaptrackError, match=f"the events 1 to {len(events)}, not event 99"):
        mcaptrack.cut(finished, tmp_path / "b.mcap", around=99)


# Faults.


def test_a_damaged_chunk_is_left_out_and_named(tmp_path):
    path = tmp_path / "a.mcap"
    write_stock(path, FORTY, chunk_size=200)
    with log.read(path) as opened:
        chunk = opened.index.chunks[3]
        at = chunk.chunk_start_offset + chunk.chunk_length - 9
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)
    code, out, _ = call("cut", path, "-o", tmp_path / "b.mcap", "--json")
    assert code == 3
    assert "its messages of a, b, c from" in out
    lost = {m for m in [tuple(m) for m in FORTY] if chunk.message_start_time <= m[1] <= chunk.message_end_time}
    assert sorted(stock_messages(tmp_path / "b.mcap")) == sorted({*map(tuple, FORTY)} - lost)


REFUSED = {
    "later than the log": (["--start-s", "9"], "lasts 0.000 s; there is nothing from 9 s on"),
    "empty": (["--end-s", "0"], "--end-s 0 isn't after --start-s 0"),
    "backwards": (["--start-s", "2", "--end-s", "1"], "--end-s 1 isn't after --start-s 2"),
    "no such topic": (["--topic", "/d"], "has no channel /d; it has a, b, c"),
    "nothing left": (["--exclude", "*"], "all channels are excluded"),
    "two moments": (["--around", "1", "--end-s", "1"], "leave one out"),
    "no events": (["--around", "1"], "no identity switches and repairs, not event 1"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_can_not_be_cut_is_refused_in_a_line(tmp_path, case):
    write_stock(path := tmp_path / "a.mcap", FORTY)
    words, text = REFUSED[case]
    code, _, err = call("cut", path, "-o", tmp_path / "b.mcap", *words)
    assert code == 1
    assert text in err
    assert err.count("\n") == 1
    assert not (tmp_path / "b.mcap").exists()


def test_no_log_is_lost(tmp_path):
    write_stock(path := tmp_path / "a.mcap", FORTY)
    before = path.read_bytes()
    for words, text in {
        ("-o", path): "both input and output",
        ("-o", path, "--force"): "both input and output",
    }.items():
        assert text in call("cut", path, *words).err
    (tmp_path / "b.mcap").write_bytes(b"old")
    assert "b.mcap exists" in call("cut", path, "-o", tmp_path / "b.mcap").err
    assert (path.read_bytes(), (tmp_path / "b.mcap").read_bytes()) == (before, b"old")
    assert "needs a name" in call("cut", path, tmp_path / "b.mcap").err


def test_of_a_log_in_a_store_little_more_than_that_time_is_read(store, tmp_path):
    messages = [("abc"[n % 3], n * 10**7, n, bytes([n]) * 50_000) for n in range(200)]
    write_stock(path := tmp_path / "a.mcap", messages, compression=CompressionType.NONE, chunk_size=200_000)
    url = store.put("a.mcap", path)
    with store.counted() as asked:
        done("cut", url, "-o", tmp_path / "b.mcap", "--start-s", "1", "--end-s", "1.1")
    assert sorted(stock_messages(tmp_path / "b.mcap")) == within(messages, (10**9, 11 * 10**8))
    assert sum(request.bytes for request in asked) < path.stat().st_size / 5
