"""Small logs, written by ours and by the stock library, and how each command reads one."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from mcaptrack import log
from mcaptrack.log.messages import Payloads
from mcaptrack.pipeline.views import make_views
from mcaptrack.pipeline.write import Made, RunState, write
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import CLOCK, Provenance
from mcaptrack.tables import TablePieces, messages
from tests.extension_cases import of_extensions
from tests.worlds import boxes_at, ns, tracks_at

SCHEMA = ("test.Thing", "jsonschema", b"{}")


MESSAGES = st.lists(
    st.tuples(st.sampled_from("abc"), st.integers(0, 2**62), st.integers(0, 2**32 - 1), st.binary(max_size=50)),
    max_size=30,
)


def stock_messages(path: Path) -> list[tuple[str, int, int, bytes]]:
    """What the stock reader finds, with all checksums checked."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [(c.topic, m.log_time, m.sequence, m.data) for _, c, m in reader.iter_messages()]


def our_messages(path: Path) -> dict[str, list[tuple[int, int, bytes]]]:
    with log.read(path) as opened:
        return {topic: [(m.t_ns, m.sequence, m.payload) for m in opened.messages(topic)] for topic in opened.channels}


def write_with_views(opened: log.Log, prefix: str, made: dict[str, Made]) -> dict[str, bytes]:
    """Write channels into a log with their views; returns the layouts."""
    state = RunState(opened, prefix, made)
    drawn = make_views(state, ())
    assert drawn is not None
    write(state, None, drawn)
    return dict(drawn.layouts)


def provenance_of(path: Path | str, topic: str) -> Provenance:
    with log.read(Path(path)) as opened:
        made = Provenance.from_metadata(opened.channel(topic).metadata)
    assert made is not None
    return made


class Recorder(Writer):
    """The stock writer, which adds a channel together with its schema."""

    def add_channel(self, topic: str, schema: tuple[str, str, bytes], encoding: str = "json", **metadata: str) -> int:
        return self.register_channel(topic, encoding, self.register_schema(*schema), metadata)


@contextmanager
def recorder(path: Path, profile: str = "", library: str = "other-software", **options: Any) -> Iterator[Recorder]:
    with path.open("wb") as stream:
        writer = Recorder(stream, **options)
        writer.start(profile, library)
        yield writer
        writer.finish()


def write_log(path: Path, messages, kind: str = "rows") -> None:
    with log.create(path) as writer:
        numbers = {topic: writer.add_channel(topic, SCHEMA, "json", {"about": topic}, kind) for topic in "abc"}
        for topic, t_ns, sequence, payload in messages:
            writer.add_message(numbers[topic], t_ns, sequence, payload)


def write_stock(path: Path, messages, **options) -> None:
    """A log that other software recorded, with an attachment and metadata."""
    with recorder(path, "ros2", **options) as writer:
        schema = writer.register_schema(*SCHEMA)
        numbers = {topic: writer.register_channel(topic, "json", schema, {"about": topic}) for topic in "abc"}
        for count, (topic, t_ns, sequence, payload) in enumerate(messages):
            writer.add_message(numbers[topic], t_ns, payload, publish_time=t_ns // 2, sequence=sequence)
            if count == 1:
                writer.add_attachment(1, 2, "notes.txt", "text/plain", b"hello")
                writer.add_metadata("about", {"robot": "r2"})


STOCK_OPTIONS = {
    "zstd": {}, "lz4": {"compression": CompressionType.LZ4},
    "plain": {"compression": CompressionType.NONE, "chunk_size": 64}, "no chunks": {"use_chunking": False},
    "no repeated channels": {"repeat_channels": False, "repeat_schemas": False, "chunk_size": 64},
    "no statistics": {"use_statistics": False}, "no message index": {"index_types": IndexType.CHUNK},
}  # fmt: skip


SOME = [("a", 10, 1, b"x"), ("b", 30, 2, b"yy"), ("a", 20, 3, b"zzz" * 30), ("c", 5, 4, b""), ("b", 40, 5, b"w" * 200)]


#: Forty messages of three channels, each of which could be told from all others.
FORTY = [("abc"[n % 3], n * 10, n, bytes([n]) * 40) for n in range(40)]


IMU = {
    "header": {"stamp": {"sec": 1, "nanosec": 5}, "frame_id": "imu"},
    "gyro": {"x": 0.5, "y": -0.0},
    "cov": [1.5, 2.0],
}


def add_rows(writer, topic, schema, frames, transform="track", source="/camera/detections", made=None):
    """Add a channel with rows; ``made`` says how in place of the transform and its source."""
    made = (made or Provenance(transform, {"max_age_s": 1.4}, source)).to_metadata()
    number = writer.add_channel(topic, (schema.name, "protobuf", schema.descriptor), "protobuf", made, group=topic)
    for frame in frames:
        writer.add_message(number, frame.t_ns, frame.index, schema.codec.encode(frame.rows))


def write_channels(path: Path, channels, clock: str = "") -> Path:
    """A log of channels by topic, each with its schema, its provenance (or None) and its frames, in chunks of its own."""
    with log.create(path) as writer:
        for topic, (schema, made, frames) in channels.items():
            record, metadata = (schema.name, "protobuf", schema.descriptor), made.to_metadata() if made else {}
            number = writer.add_channel(topic, record, "protobuf", metadata, group=topic)
            for frame in frames:
                writer.add_message(number, frame.t_ns, frame.index, schema.codec.encode(frame.rows))
        if clock:
            writer.add_metadata(CLOCK, {"start_ns": clock})
    return path


def some_log(path, **more):
    """Two people who walk, detected and tracked, and an IMU that others recorded."""
    people = [{4: (n * 0.5, 2.5), 9: (1.0, n * 0.25)} for n in range(3)]
    walk = [Frame(ns(n), n, tracks_at(who)) for n, who in enumerate(people)]
    with log.create(path) as writer:
        imu = writer.add_channel("/imu", ("robot/Imu", "jsonschema", b"{}"), "json", {}, group="imu")
        for n in range(4):
            writer.add_message(imu, ns(n) + 7, n, json.dumps(IMU | {"n": n}).encode())
        boxes = [Frame(ns(n), n, boxes_at([(5, 5), (9, 9)][: 2 - n])) for n in range(3)]
        add_rows(writer, "/camera/detections", DETECTIONS, boxes, "detect", "/camera/video")
        add_rows(writer, "/camera/tracks", TRACKS, [*walk, Frame(ns(3), 3, TRACKS.empty())])
        add_rows(writer, "/camera/truth", TRACKS, walk, "ingest", "")
        for topic, (schema, frames) in more.items():
            add_rows(writer, topic, schema, frames)
    return path


#: How each command is run so that it only reads the log, and writes to another folder.
READING: dict[str, Callable[[Path, Path], list[object]]] = {
    "check": lambda log, out: [log],
    "cut": lambda log, out: [log, "-o", out / "cut.mcap"],
    "drop": lambda log, out: [log, "/camera/truth", "-o", out / "dropped.mcap"],
    "evaluate": lambda log, out: [log],
    "export": lambda log, out: [log, "-o", out / "tables"],
    "info": lambda log, out: [log],
    "ingest": lambda log, out: [log, "-o", out / "ingested.mcap"],
    "recover": lambda log, out: [log, "-o", out / "recovered.mcap"],
    "view": lambda log, out: [log, "--layout", "no such layout"],
    **{
        name: lambda log, out: [log, "-o", out / "other.mcap"]
        for name in ("detect", "motion", "track", "sample", "predict", "retrack", "run", "events")
    },
} | {name: words for name, words in of_extensions("READING").items() if words}


def on_a_log(command: str, log: Path, out: Path) -> list[object]:
    """The words of a command that reads a log, and writes into it if it can."""
    words = READING[command](log, out)
    return words[:-2] if words[-1] == out / "other.mcap" else words


def flat_table(rows: Sequence[Mapping[str, object]], blobs: bool) -> tuple[TablePieces, list[str]]:
    """The table of messages with these fields."""
    numbers = np.arange(len(rows))
    starts = 8 * numbers
    data = Payloads(numbers, numbers.astype("<i8").view(np.uint8), starts, starts + 8, numbers, numbers)

    def flatten(payload: bytes) -> dict[tuple[str, ...], object]:
        return {(name,): value for name, value in rows[int.from_bytes(payload, "little")].items()}

    source = messages.MessageSource("/a", "A", "a.mcap", 0, len(rows), "a.mcap: /a", lambda _: iter([data]), flatten)
    table = messages.inferred_table(source, lambda _: True, blobs)
    return table.pieces, [name for (name,) in table.left_out]


def plain(path: Path, profile: str, library: str = "robot") -> Path:
    """A log with one channel of JSON."""
    with recorder(path, profile, library) as writer:
        writer.add_message(writer.register_channel("/a", "json", 0), 1, b"{}", 1)
    return path
