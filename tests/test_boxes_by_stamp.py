"""Boxes in pictures of other software are at the times of the pictures that they were found in."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.writer import Writer

from mcaptrack import log, notices
from mcaptrack.sources.fixed_frame import named_detections
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
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        ids = []
        for topic, name in (("/cam/image", "foxglove.CompressedImage"), ("/cam/boxes", "vision_msgs/Detection2DArray")):
            schema = writer.register_schema(name, "jsonschema", b"{}")
            ids.append(writer.register_channel(topic, "json", schema))
        for t_ns, which, message in sorted(messages, key=lambda one: one[0]):
            whole = {"data": data, **message} if which == 0 else message
            writer.add_message(ids[which], t_ns, json.dumps(whole).encode(), t_ns)
        writer.finish()
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


@pytest.mark.parametrize(("stamps", "words"), [(lambda n: None, ""), (lambda n: taken_s(n) + 0.01, "0.27 s after")])
def test_other_boxes_are_at_their_log_times_and_that_is_said(tmp_path, stamps, words):
    times, said = read(written(tmp_path / "a.mcap", stamps))
    assert times == {number: ns(taken_s(number) + LATE_S + FOUND_S) for number in range(COUNT)}
    assert [(notice.code, words in notice.message) for notice in said] == ([("clock", True)] if words else [])
