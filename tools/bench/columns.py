"""Messages of robots as tables, beside other readers of the same files, in one call, by CPU time.

python tools/bench/columns.py [--messages 20000] [--folder DIR]

For each type: CPU from the file to an Arrow table here; and how many times as long take mcap-ros2-support and the
protobuf runtime to give objects, rosbags to deserialize the payloads alone, and roboto-mcap-codec (Rust, if it is
installed) to give Arrow. The last line is ``export --all`` of all of them against reading the chunks and writing the
same tables by pyarrow alone.
"""

from __future__ import annotations

import argparse
import heapq
import importlib
import importlib.util
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from mcap.reader import McapReader, make_reader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
from mcap_protobuf.schema import build_file_descriptor_set
from mcap_ros2.decoder import DecoderFactory as Ros2Factory
from rosbags.typesys import Stores, get_typestore

import mcaptrack
from mcaptrack import log
from mcaptrack.log.chunks import chunk_record, open_chunk

STORE = get_typestore(Stores.LATEST)
RANDOM = np.random.default_rng(1)
#: Stands for each number of a message that is drawn; no number that is drawn has its bytes.
_DRAWN = 1.2345678806304932
#: Lists of messages have so many elements at most; those beside longer lists of numbers, as fields of a cloud, few.
_MOST = 30
#: Types, messages for each of ``--messages``, and elements of their lists.
TYPES = {
    "sensor_msgs/msg/Imu": (5.0, 1),
    "sensor_msgs/msg/JointState": (2.0, 12),
    "nav_msgs/msg/Odometry": (2.0, 1),
    "tf2_msgs/msg/TFMessage": (0.25, 20),
    "visualization_msgs/msg/MarkerArray": (0.1, 30),
    "diagnostic_msgs/msg/DiagnosticArray": (0.25, 8),
    "sensor_msgs/msg/PointCloud2": (0.01, 500_000),
}
PROTOBUF = {"FrameTransforms": (0.25, 20), "LocationFix": (2.0, 1)}


def value(form: Any, size: int) -> Any:
    """A random value of a type of a store."""
    node, what = int(form[0]), form[1]
    if node == 1:
        return (
            "name"
            if what[0] == "string"
            else bool(size % 2)
            if what[0] == "bool"
            else _DRAWN
            if "float" in what[0]
            else 1
        )
    if node == 2:
        return STORE.types[what](**{name: value(of, size) for name, of in STORE.fielddefs[what][1]})
    member, count = what
    length = count if node == 3 else size
    if int(member[0]) == 1 and member[1][0] != "string":
        kind = member[1][0].replace("byte", "uint8")
        return np.full(length, _DRAWN, kind) if "float" in kind else RANDOM.integers(0, 100, length).astype(kind)
    return [value(member, min(size, 4)) for _ in range(length if length <= _MOST else 4)]


def drawn(kinds: list[bytes], count: int) -> Iterator[bytes]:
    """So many messages, each with numbers of its own: as sensors give them, in single precision."""
    forms = []
    for kind in kinds:
        for number in ("<f8", "<f4"):
            mark, places = np.array(_DRAWN, number).tobytes(), []
            while (at := kind.find(mark, places[-1] + 1 if places else 0)) >= 0:
                places.append(at)
            forms.append((kind, number, np.add.outer(places, np.arange(len(mark))).astype(np.int64)))
    for step in range(count):
        message = np.frombuffer(kinds[step % len(kinds)], np.uint8).copy()
        for _, number, places in forms[2 * (step % len(kinds)) :][:2]:
            numbers = RANDOM.standard_normal(len(places), np.float32).astype(number)
            message[places] = numbers.view(np.uint8).reshape(places.shape)
        yield message.tobytes()


def ros_messages(name: str, count: int, size: int) -> Iterator[bytes]:
    kinds = [bytes(STORE.serialize_cdr(value((2, name), size + step % 3), name)) for step in range(20)]
    return drawn(kinds, count)


def protobuf_messages(kind: Any, count: int, size: int) -> Iterator[bytes]:
    def message() -> bytes:
        out = kind()
        for inner in [out.transforms.add() for _ in range(size)] if hasattr(out, "transforms") else [out]:
            inner.timestamp.seconds = 1_700_000_000
            for field in inner.DESCRIPTOR.fields:
                if field.type == field.TYPE_STRING:
                    setattr(inner, field.name, "frame")
                elif field.name in ("translation", "rotation"):
                    for axis in getattr(inner, field.name).DESCRIPTOR.fields_by_name:
                        setattr(getattr(inner, field.name), axis, _DRAWN)
                elif field.type == field.TYPE_DOUBLE and not field.is_repeated:
                    setattr(inner, field.name, _DRAWN)
        return bytes(out.SerializeToString())

    return drawn([message()], count)


def write(path: Path, name: str, encoding: tuple[str, str], definition: bytes, payloads: Iterator[bytes]) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2")
        channel = writer.register_channel("/t", encoding[0], writer.register_schema(name, encoding[1], definition))
        for number, payload in enumerate(payloads):
            writer.add_message(channel, 10**18 + number * 10**6, payload, 10**18 + number * 10**6, number)
        writer.finish()


def cpu(work: Callable[[], object], times: int = 3) -> float:
    """The least CPU time of some runs, in seconds."""
    best = float("inf")
    for _ in range(times):
        started = time.process_time()
        work()
        best = min(best, time.process_time() - started)
    return best


def ours(path: Path) -> Any:
    with mcaptrack.open(path) as opened:
        return opened.table("/t")


def objects(path: Path) -> int:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[Ros2Factory(), ProtobufFactory()])
        return sum(1 for _ in reader.iter_decoded_messages())


def rosbags(path: Path, name: str) -> None:
    with log.read(path) as opened:
        for message in opened.messages("/t"):
            STORE.deserialize_cdr(message.payload, name)


def roboto(path: Path) -> int:
    codec = importlib.import_module("mcap_codec")
    with path.open("rb") as stream:

        def read(offset: int, size: int) -> bytes:
            stream.seek(offset)
            return stream.read(size)

        topic, times = codec.TopicName("/t"), codec.TimestampSource("message_log_time")
        with codec.open_mcap_file(read, path.stat().st_size, channel=topic, timestamp=times) as cursor:
            return sum(batch.num_rows for batch in cursor)


def compare(path: Path, name: str) -> None:
    table = ours(path)
    here = cpu(lambda: ours(path))
    peers: dict[str, Callable[[], object]] = {"objects": lambda: objects(path)}
    if not name.startswith("foxglove"):
        peers["rosbags"] = lambda: rosbags(path, name)
    if importlib.util.find_spec("mcap_codec") and not name.startswith("foxglove"):
        peers["roboto"] = lambda: roboto(path)
    ratios = "  ".join(f"{peer} {cpu(work, 1) / here:6.1f}" for peer, work in peers.items())
    print(f"{name:38} {table.num_rows:7} rows {here:6.3f} s   {ratios}")


def compare_export(paths: list[Path], folder: Path) -> None:
    """All channels of a recording as Parquet, against its chunks and the same tables by pyarrow alone.

    Their messages stand between each other, as a robot records them.
    """
    robot, streams = folder / "robot.mcap", []
    with robot.open("wb") as stream, ExitStack() as sources:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2")

        def messages(reader: McapReader, channel: int) -> Iterator[tuple[int, int, int, bytes]]:
            step_ns = 10**11 // reader.get_summary().statistics.message_count
            for number, (_, _, message) in enumerate(reader.iter_messages()):
                yield 10**18 + number * step_ns, channel, number, message.data

        for number, path in enumerate(paths):
            reader = make_reader(sources.enter_context(path.open("rb")))
            (schema,) = reader.get_summary().schemas.values()
            schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
            encoding = "protobuf" if schema.encoding == "protobuf" else "cdr"
            streams.append(messages(reader, writer.register_channel(f"/t{number}", encoding, schema_id)))
        for t_ns, channel, sequence, data in heapq.merge(*streams):
            writer.add_message(channel, t_ns, data, t_ns, sequence)
        writer.finish()
    with mcaptrack.open(robot) as opened:
        tables = {topic: opened.table(topic) for topic in opened.topics}

    def alone() -> None:
        with log.read(robot) as opened:
            for chunk in opened.index.chunks:
                open_chunk(opened.snapshot.source, chunk_record(opened.snapshot.source, chunk))
        for table in tables.values():
            pq.write_table(table, folder / "alone.parquet", compression="zstd")

    def export() -> None:
        mcaptrack.export(robot, folder / "tables", all_topics=True, force=True)

    ratio = cpu(export, 2) / cpu(alone, 2)
    size = robot.stat().st_size / 1e6
    print(f"export --all of {size:.0f} MB: {ratio:.2f} times as long as its chunks and Parquet alone")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=20_000)
    parser.add_argument("--folder", type=Path)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=chosen.folder) as name:
        folder, paths = Path(name), []
        for kind, (share, size) in TYPES.items():
            paths.append(folder / f"{kind.replace('/', '_')}.mcap")
            definition = STORE.generate_msgdef(kind, ros_version=2)[0].encode()
            messages = ros_messages(kind, int(chosen.messages * share), size)
            write(paths[-1], kind, ("cdr", "ros2msg"), definition, messages)
            compare(paths[-1], kind)
        for kind, (share, size) in PROTOBUF.items():
            message = getattr(importlib.import_module(f"foxglove_schemas_protobuf.{kind}_pb2"), kind)
            paths.append(folder / f"{kind}.mcap")
            definition = build_file_descriptor_set(message).SerializeToString()
            payloads = protobuf_messages(message, int(chosen.messages * share), size)
            write(paths[-1], f"foxglove.{kind}", ("protobuf", "protobuf"), definition, payloads)
            compare(paths[-1], f"foxglove.{kind}")
        compare_export(paths, folder)


if __name__ == "__main__":
    main()
