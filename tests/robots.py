"""Logs of robots: pictures with boxes of a detector, stamps and delays."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from tests.logs import recorder
from tests.ros_messages import pixels, ros_writer, vision
from tests.worlds import ns, small_scene

START_NS = 1_700_000_000_000_000_000


LATE_NS = 41_234_567  # what a message takes from the camera to the log


def stamp_of(number: int) -> int:
    return START_NS + ns(number / 10) + 17 * number


def write_log(path: Path, *topics: str, boxes: str | None = None) -> list:
    """A log as a robot writes it: a scene on these topics, boxes of what is truly there. Returns the scene's shots."""
    ros = ros_writer("sensor_msgs/CompressedImage")
    shots = list(small_scene(5.0).shots())
    with recorder(path, "ros2") as writer:
        schema = writer.register_schema(ros.kind.name, "ros2msg", ros.kind.schema)
        channels = [writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": ""}) for topic in topics]
        if boxes:
            kind = vision("v4", [])[0]
            found = writer.add_channel(boxes, (kind.name, "ros2msg", kind.schema), "cdr")
        for number, shot in enumerate(shots):
            t_ns = stamp_of(number) + LATE_NS
            data = cv2.imencode(".jpg", shot.image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
            message = ros.new("sensor_msgs/CompressedImage", ros.header(stamp_of(number)), "jpeg", pixels(data))
            for channel in channels:
                writer.add_message(channel, t_ns, ros.pack(message), stamp_of(number), number + 1000)
            if boxes:
                payload = vision(
                    "v4", [(x + w / 2, y + h / 2, w, h, 0.0, [("person", 0.9)]) for x, y, w, h in shot.boxes.tolist()]
                )[1]
                writer.add_message(found, t_ns + 5, payload, t_ns)
    return shots


PICTURES, FPS = 24, 10


ROBOT_NS = 1_700_000_000_000_000_000


def robot_log(path: Path, *topics: str, boxes: bool = False) -> Path:
    """Pictures as a robot logs them: late by another time each."""
    ros = ros_writer("sensor_msgs/CompressedImage")
    data = pixels(cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))[1].tobytes())
    with recorder(path) as writer:
        schema = writer.register_schema(ros.kind.name, "ros2msg", ros.kind.schema)
        channels = [writer.register_channel(topic, "cdr", schema) for topic in topics]
        for k in range(PICTURES):
            stamp = ROBOT_NS + ns(k / FPS)
            payload = ros.pack(ros.new("sensor_msgs/CompressedImage", ros.header(stamp), "jpeg", data))
            for channel in channels:
                writer.add_message(channel, stamp + 1_000_000 * (k % 7), payload, stamp, 500 + 3 * k)
    return path


def lines(path: Path, *numbers: int) -> Path:
    path.write_text("".join(f"{number},7,1,1,2,2\n" for number in numbers))
    return path
