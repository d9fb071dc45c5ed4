"""ROS bags of both versions, written by the rosbags library, for tests."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import cv2
import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

T0 = 1_700_000_000_123_456_789


ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)


STRING1 = "std_msgs/msg/String"


def bag1(path: Path, messages: int = 60, size: int = 40_000, compression: str | None = None) -> list:
    """A bag of several chunks with two publishers of one topic, and one who says nothing; returns what is in it."""
    noise = np.random.default_rng(7)
    writer = Writer1(path)
    writer.chunk_threshold = 200_000
    if compression:
        writer.set_compression(Writer1.CompressionFormat[compression])
    out = []
    with writer:
        left = writer.add_connection("/talk", STRING1, typestore=ROS1, callerid="/left", latching=1)
        right = writer.add_connection("/talk", STRING1, typestore=ROS1, callerid="/right", latching=0)
        writer.add_connection("/silent", "sensor_msgs/msg/Image", typestore=ROS1)
        for number in range(messages):
            payload = noise.integers(0, 200, size, np.uint8).tobytes()
            t_ns = T0 + 1_000_000 * (number ^ 1)  # neighbours change places: a bag is in no strict order
            writer.write((left, right)[number % 3 == 0], t_ns, payload)
            out.append(("/talk", t_ns, t_ns, payload))
    return out


QOS = [
    Qos(
        QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, QosTime(1, 2),
        QosTime(3, 4), QosLiveliness.AUTOMATIC, QosTime(5, 6), False,
    )
]  # fmt: skip


def bag2(
    folder: Path, storage: str = "SQLITE3", compression: str | None = None, version: int = 9, start: int = 0
) -> list:
    """A rosbag2 folder; returns what is in it."""
    writer = Writer2(folder, version=version, storage_plugin=StoragePlugin[storage])
    if compression:
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    out = []
    with writer:
        talk = writer.add_connection("/talk", STRING1, typestore=ROS2, offered_qos_profiles=QOS)
        image = writer.add_connection("/image", "sensor_msgs/msg/CompressedImage", typestore=ROS2)
        writer.add_connection("/silent", "geometry_msgs/msg/Twist", typestore=ROS2)
        for number in range(start, start + 40):
            words = ROS2.types[STRING1](data=f"number {number} " * 50)
            payload = bytes(ROS2.serialize_cdr(words, STRING1))
            writer.write((talk, image)[number % 4 == 0], T0 + number, payload)
            out.append((("/talk", "/image")[number % 4 == 0], T0 + number, T0 + number, payload))
    return out


def database(path: Path, version: int, messages: list[tuple[int, int, bytes]], topics: list[tuple]) -> None:
    """A database as rosbag2 laid it out in that version of its schema, by hand."""
    columns = "id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL"
    columns += ", offered_qos_profiles TEXT NOT NULL" * (version >= 2)
    columns += ", type_description_hash TEXT NOT NULL" * (version >= 4)
    with sqlite3.connect(path) as db:
        db.execute(f"CREATE TABLE topics({columns})")
        db.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        if version >= 3:
            db.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)")
            db.execute("INSERT INTO schema VALUES (?, 'humble')", (version,))
        for topic in topics:
            db.execute(f"INSERT INTO topics VALUES ({', '.join('?' * len(topic))})", topic)
        db.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", messages)
    db.close()


def picture(number: int) -> bytes:
    """A JPEG of 64 x 48 pixels on which a bright box moves."""
    image = np.full((48, 64), 40, np.uint8)
    image[20:36, 2 + number : 12 + number] = 220
    return cv2.imencode(".jpg", image)[1].tobytes()


def camera_bag(path: Path, *topics: str, frames: int = 30) -> list[int]:
    """A ROS 1 bag with pictures; returns their times."""
    kind, header, time = (
        ROS1.types[f"{name}"]
        for name in ("sensor_msgs/msg/CompressedImage", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    with Writer1(path) as writer:
        known = [writer.add_connection(topic, kind.__msgtype__, typestore=ROS1) for topic in topics]
        for number in range(frames):
            for connection in known:
                stamp = time(sec=1000 + number // 10, nanosec=number % 10 * 100_000_000)
                data = np.frombuffer(picture(number), np.uint8)
                message = kind(header=header(seq=number, stamp=stamp, frame_id="cam"), format="jpeg", data=data)
                payload = ROS1.serialize_ros1(message, kind.__msgtype__)
                writer.write(connection, T0 + number * 100_000_000, bytes(payload))
    return [T0 + number * 100_000_000 for number in range(frames)]


MOT = "".join(f"{frame},7,{1 + frame},20,10,16,1,-1,-1,-1\n" for frame in range(1, 21))


#: The pictures of ``record``.
FRAMES = 24


def record(folder: Path) -> Path:
    """A rosbag2 folder whose only file is an MCAP file with pictures; returns that file."""
    kind, header, time = (
        ROS2.types[name]
        for name in ("sensor_msgs/msg/CompressedImage", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    with Writer2(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/robot/front/image", kind.__msgtype__, typestore=ROS2)
        for number in range(FRAMES):
            stamp = time(sec=1000 + number // 10, nanosec=number % 10 * 100_000_000)
            data = np.frombuffer(picture(number), np.uint8)
            message = kind(header=header(stamp=stamp, frame_id="cam"), format="jpeg", data=data)
            payload = bytes(ROS2.serialize_cdr(message, kind.__msgtype__))
            writer.write(connection, T0 + number * 100_000_000, payload)
    return folder / f"{folder.name}.mcap"
