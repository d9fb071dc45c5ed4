"""Boxes in pictures of other software are at the times of the pictures that they were found in."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from mcaptrack import log, notices
from mcaptrack.errors import McaptrackError
from mcaptrack.sources.fixed_frame import named_detections
from mcaptrack.sources.foreign.boxes import choosing
from tests.logs import recorder
from tests.worlds import ns

COUNT = 20
#: Pictures are logged so much later than they were taken, and boxes so much later again.
LATE_S, FOUND_S = 0.03, 0.25
START_S = 1_000.0


def stamp(seconds: float) -> dict[str, dict[str, dict[str, int]]]:
    whole, nanos = divmod(ns(seconds), 10**9)
    return {"header": {"stamp": {"sec": whole, "nanosec": nanos}}}


def taken_s(number: int) -> float:
    return START_S + number / 10


def written(path: Path, stamps, pictures=range(COUNT), header="header", data="YQ==") -> Path:
    """A log with pictures of these numbers, and boxes with these stamps, by their numbers."""
    box = {"center": {"position": {"x": 50, "y": 50}}, "size_x": 20, "size_y": 60}
    messages = [
        (ns(taken_s(number) + LATE_S), 0, {"timestamp": stamp(taken_s(number))["header"]["stamp"], "format": "jpeg"})
        for number in pictures
    ]
    for number in range(COUNT):
        about = stamp(stamps(number))["header"] if stamps(number) is not None else {}
        message = {header: about, "detections": [{"bbox": box, "results": []}] * number}
        messages.append((ns(taken_s(number) + LATE_S + FOUND_S), 1, message))
    with recorder(path) as writer:
        ids = []
        for topic, name in (("/cam/image", "foxglove.CompressedImage"), ("/cam/boxes", "vision_msgs/Detection2DArray")):
            schema = writer.register_schema(name, "jsonschema", b"{}")
            ids.append(writer.register_channel(topic, "json", schema))
        for t_ns, which, message in sorted(messages, key=lambda one: one[0]):
            whole = {"data": data, **message} if which == 0 else message
            writer.add_message(ids[which], t_ns, json.dumps(whole).encode(), t_ns)
    return path


def read(path: Path) -> tuple[dict[int, int], list[notices.Notice]]:
    """The time of each message by its number of boxes, and what is warned of."""
    with log.read(path) as opened, notices.collected() as said:
        frames = named_detections(opened, "/cam/boxes").frames
    assert [frame.t_ns for frame in frames] == sorted(frame.t_ns for frame in frames)
    return {len(frame.rows): frame.t_ns for frame in frames}, said


@pytest.mark.parametrize("header", ["header", "image_header"])
def test_boxes_are_at_the_time_of_the_picture_with_their_stamp(tmp_path, header):
    times, said = read(written(tmp_path / "a.mcap", taken_s, header=header))
    assert times == {number: ns(taken_s(number) + LATE_S) for number in range(COUNT)}
    assert said == []


def test_a_picture_that_was_not_recorded_is_as_late_as_the_others(tmp_path):
    times, said = read(written(tmp_path / "a.mcap", taken_s, pictures=[n for n in range(COUNT) if n % 3]))
    assert times == {number: ns(taken_s(number) + LATE_S) for number in range(COUNT)}
    assert said == []


def test_pictures_that_cant_be_read_cost_no_boxes(tmp_path):
    assert read(written(tmp_path / "a.mcap", taken_s, data="?"))[0] == {
        number: ns(taken_s(number) + LATE_S + FOUND_S) for number in range(COUNT)
    }


@pytest.mark.parametrize("pictures", [range(COUNT), ()])
@pytest.mark.parametrize(("stamps", "words"), [(lambda n: None, ""), (lambda n: taken_s(n) + 0.01, "0.27 s after")])
def test_other_boxes_are_at_their_log_times_and_that_is_said(tmp_path, stamps, words, pictures):
    times, said = read(written(tmp_path / "a.mcap", stamps, pictures=pictures))
    assert times == {number: ns(taken_s(number) + LATE_S + FOUND_S) for number in range(COUNT)}
    assert [(notice.code, words in notice.message) for notice in said] == ([("clock", True)] if words else [])


# Boxes against the pictures that they are about


SIZE = (320, 240)


def with_boxes(path: Path, box: dict, pictures: bool, calibrated: bool = False) -> Path:
    """A log with boxes of one kind, and pictures of 320 x 240 or the calibration of a camera with these."""
    png = base64.b64encode(cv2.imencode(".png", np.zeros(SIZE[::-1], np.uint8))[1].tobytes()).decode()
    with recorder(path) as writer:
        boxes, images, lens = (
            writer.add_channel(topic, (name, "jsonschema", b"{}"))
            for topic, name in (
                ("/cam/boxes", "vision_msgs/Detection2DArray"),
                ("/cam/image", "foxglove.CompressedImage"),
                ("/cam/camera_info", "sensor_msgs/CameraInfo"),
            )
        )
        for number in range(COUNT):
            about = stamp(taken_s(number))["header"]
            t_ns = ns(taken_s(number))
            message = {"header": about, "detections": [{"bbox": box, "results": []}]}
            writer.add_message(boxes, t_ns, json.dumps(message).encode(), t_ns)
            if pictures:
                image = {"timestamp": about["stamp"], "format": "png", "data": png}
                writer.add_message(images, t_ns, json.dumps(image).encode(), t_ns)
            if calibrated:
                writer.add_message(lens, t_ns, json.dumps({"width": SIZE[0], "height": SIZE[1]}).encode(), t_ns)
    return path


SHARES = {"center": {"position": {"x": 0.5, "y": 0.5}}, "size_x": 0.1, "size_y": 0.5}


@pytest.mark.parametrize("way", ["pictures", "calibrated", "map"])
def test_boxes_in_shares_are_scaled_by_the_size_of_their_pictures(way, tmp_path):
    path = with_boxes(tmp_path / "a.mcap", SHARES, way == "pictures", way == "calibrated")
    chosen = "picture=320x240" if way == "map" else None
    with log.read(path) as opened, notices.collected() as said, choosing("/cam/boxes", chosen, None):
        found = named_detections(opened, "/cam/boxes")
    assert [list(row)[:4] for row in found.frames[0].rows] == [[144, 60, 32, 120]]
    assert [notice.code for notice in said] == ["units"]
    assert found.facts["scale"] == "shares of 320x240"


def test_boxes_in_shares_of_unknown_pictures_are_refused_with_the_way(tmp_path):
    path = with_boxes(tmp_path / "a.mcap", SHARES, pictures=False)
    with log.read(path) as opened, pytest.raises(McaptrackError, match=r"shares of a picture.*`map='picture="):
        named_detections(opened, "/cam/boxes")


@pytest.mark.parametrize(("scale", "codes"), [(1.0, []), (2.0, ["outside"])])
def test_boxes_of_pictures_of_another_size_are_said(scale, codes, tmp_path):
    box = {"center": {"position": {"x": 250 * scale, "y": 180 * scale}}, "size_x": 40 * scale, "size_y": 90 * scale}
    path = with_boxes(tmp_path / "a.mcap", box, pictures=True)
    with log.read(path) as opened, notices.collected() as said:
        found = named_detections(opened, "/cam/boxes")
    assert [notice.code for notice in said] == codes
    assert found.facts["scale"] == "pixels"
