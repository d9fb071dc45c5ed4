"""Pictures of more than 8 bits, mosaics and depths: people are found as in usual pictures, or not looked for."""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
import zstandard

import mcaptrack
from tests.commands import call
from tests.extension_cases import needs
from tests.logs import provenance_of, recorder
from tests.ros_messages import pixels, ros_writer
from tests.tiers import one_in, thorough
from tests.worlds import small_scene

TOPIC = "/cam/image_raw"
Draw = Callable[[np.ndarray], np.ndarray]


def grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def wide(image: np.ndarray) -> np.ndarray:
    return grey(image).astype("<u2")


def mosaic(image: np.ndarray) -> np.ndarray:
    """What a sensor with the pattern RGGB sees."""
    out = np.empty(image.shape[:2], np.uint8)
    for number, letter in enumerate("rggb"):
        part = np.s_[number // 2 :: 2, number % 2 :: 2]
        out[part] = image[(*part, "bgr".index(letter))]
    return out


def with_dead_pixels(values: np.ndarray) -> np.ndarray:
    """Every 997th pixel is always as bright as can be."""
    out = values.copy()
    out.reshape(-1)[::997] = 16383
    return out


class Channel:
    """A channel of pictures in a recording of ROS 2: ``encoding`` of raw pictures, or the format of compressed ones."""

    def __init__(self, draw: Draw, encoding: str, suffix: str = "", frame_id: str = "eye", head: bytes = b"") -> None:
        self.draw, self.encoding, self.suffix, self.frame_id, self.head = draw, encoding, suffix, frame_id, head

    def message(self, image: np.ndarray, t_ns: int):
        values = np.ascontiguousarray(self.draw(image))
        name = "sensor_msgs/CompressedImage" if self.suffix else "sensor_msgs/Image"
        ros = ros_writer(name)
        header = ros.header(t_ns)
        header.frame_id = self.frame_id
        if self.suffix in ("zlib", "zstd"):
            pack = zlib.compress if self.suffix == "zlib" else zstandard.ZstdCompressor().compress
            (height, width), encoding = values.shape[:2], self.encoding.encode()
            head = struct.pack("<IIBII", height, width, 0, values.strides[0], len(encoding)) + encoding
            values_in = (header, "zstd", pixels(head + pack(values.tobytes())))
        elif self.suffix:
            data = self.head + cv2.imencode(self.suffix, values)[1].tobytes()
            values_in = (header, self.encoding, pixels(data))
        else:
            size = (*values.shape[:2], self.encoding, 0, values.strides[0])
            values_in = (header, *size, pixels(values.tobytes()))
        return ros.kind, ros.pack(ros.new(name, *values_in))


def written(path: Path, channels: Mapping[str, Channel], seconds: float = 4.0) -> Path:
    ids: dict[str, int] = {}
    with recorder(path) as writer:
        for number, shot in enumerate(small_scene(seconds).shots()):
            for topic, channel in channels.items():
                t_ns = 10**18 + number * 10**8
                kind, content = channel.message(shot.image, t_ns)
                if topic not in ids:
                    ids[topic] = writer.add_channel(topic, (kind.name, "ros2msg", kind.schema), "cdr")
                writer.add_message(ids[topic], t_ns, content, t_ns)
    return path


USUAL = Channel(lambda image: image, "bgr8")
SAME = {
    "all 16 bits": (Channel(lambda image: wide(image) * 257, "mono16"), "4.36"),
    "12 of 16 bits": (Channel(lambda image: wide(image) * 16, "mono16"), "27"),
    "thermal of 14 bits": (Channel(lambda image: 7000 + wide(image) * 3, "16UC1"), "70.. to 75"),
    "dead pixels": (Channel(lambda image: with_dead_pixels(7000 + wide(image) * 3), "16UC1"), "70.. to 75"),
    "big numbers with signs": (Channel(lambda image: grey(image).astype("<i4") * 9 - 70_000, "32SC1"), "to -6"),
    "floats from 0 to 1": (Channel(lambda image: (grey(image) / 255).astype("<f4"), "32FC1"), "to 0.6"),
    "floats from 0 to 255": (Channel(lambda image: grey(image).astype("<f4"), "32FC1"), "to 1[67]"),
    "colours of 12 bits": (Channel(lambda image: image[..., ::-1].astype("<u2") * 16, "rgb16"), "to 27"),
    "a mosaic": (Channel(mosaic, "bayer_rggb8"), ""),
    "a mosaic of 12 bits": (Channel(lambda image: mosaic(image).astype("<u2") * 16, "bayer_rggb16"), "to 2[67]"),
    "a mosaic in png": (Channel(mosaic, "bayer_rggb8; png compressed ", ".png"), ""),
    "a mosaic in jpeg": (Channel(mosaic, "bayer_rggb8; jpeg compressed ", ".jpg"), ""),
    "a mosaic of 16 bits in png": (
        Channel(lambda image: mosaic(image).astype(np.uint16) * 16, "bayer_rggb16; png compressed ", ".png"),
        "to 2[67]",
    ),
    "png of 16 bits": (Channel(lambda image: wide(image) * 16, "mono16; png compressed mono16", ".png"), "to 27"),
    "tiff of floats": (Channel(lambda image: (grey(image) / 255).astype(np.float32), "tiff", ".tiff"), "to 0.6"),
    "raw in zstd, of its first versions": (Channel(lambda image: image, "bgr8", "zlib"), ""),
    "raw in zstd": (Channel(lambda image: image, "bgr8", "zstd"), ""),
}


@pytest.fixture(scope="module")
def boxes(tmp_path_factory) -> int:
    """The number of boxes in usual pictures."""
    path = written(tmp_path_factory.mktemp("usual") / "a.mcap", {TOPIC: USUAL})
    return mcaptrack.detect(path).rows["/cam/detections"]


@pytest.mark.parametrize(("channel", "span"), one_in(6, SAME.values()), ids=SAME)
def test_the_same_people_are_found_and_the_range_is_said_and_kept(tmp_path, boxes, channel, span):
    path = written(tmp_path / "a.mcap", {TOPIC: channel})
    result = mcaptrack.detect(path)
    assert boxes > 50
    assert abs(result.rows["/cam/detections"] - boxes) <= 0.03 * boxes
    notices = [notice.message for notice in result.warnings if notice.code == "pictures"]
    assert len(notices) == bool(span)
    if span:
        assert re.search(f"{TOPIC}: values from .*{span}.* are shown as black to white", notices[0])
    how = provenance_of(path, "/cam/detections")
    assert [text for code, text in how.warnings if code == "pictures"] == notices


def test_mosaics_in_still_images_have_colours(tmp_path):
    def tinted(image: np.ndarray) -> np.ndarray:
        out = np.full_like(image, 120)
        out[:, :160] = (40, 120, 200)
        return out

    for name in ("a mosaic in png", "a mosaic in jpeg", "a mosaic of 16 bits in png"):
        kind = SAME[name][0]
        channel = Channel(lambda image, kind=kind: kind.draw(tinted(image)), kind.encoding, kind.suffix)
        with mcaptrack.open(written(tmp_path / "a.mcap", {TOPIC: channel}, 0.5)) as opened:
            colours = next(opened.frames()).rows[20:-20, 20:140].reshape(-1, 3).mean(axis=0)
        wanted = np.array((40, 120, 200) if "16" not in name else (0, 127.5, 255))  # by the range that was measured
        assert np.abs(colours - wanted).max() < 4, name


def test_one_bright_picture_and_values_that_stand_for_none_do_not_set_the_range(tmp_path):
    shades = iter(range(10**6))

    def draw(image: np.ndarray) -> np.ndarray:
        values = 7000 + wide(image) * 3
        values[:20] = 0  # the border of a rectified picture
        values[20:25] = 65535
        if next(shades) == 7:
            values[100:101] = 14_000
        return values

    path = written(tmp_path / "a.mcap", {TOPIC: Channel(draw, "mono16")}, 3.0)
    (text,) = [notice.message for notice in mcaptrack.detect(path).warnings if notice.code == "pictures"]
    low, high = map(float, re.findall(r"values from (\S+) to (\S+),", text)[0])
    assert 6999 < low < 7100
    assert 7400 < high < 7600


DEPTHS = {
    "mm": (Channel(lambda image: wide(image) * 20, "16UC1"), "/cam/depth/image_rect_raw"),
    "m": (Channel(lambda image: (grey(image) / 20).astype("<f4"), "32FC1"), "/cam/aligned_depth_to_color/image_raw"),
    "mono16": (Channel(lambda image: wide(image) * 20, "mono16"), "/zed/depth/depth_registered"),
    "by its frame": (Channel(lambda image: wide(image) * 20, "16UC1", "", "cam_depth_optical_frame"), "/cam/tof/image"),
    "png": (
        Channel(lambda image: wide(image) * 20, "16UC1; png compressed ", ".png"),
        "/cam/depth/image_raw/compressed",
    ),
    "compressedDepth": (
        Channel(lambda image: wide(image) * 20, "16UC1; compressedDepth png", ".png", "eye", bytes(12)),
        "/cam/aligned/image_raw/compressedDepth",
    ),
}


@pytest.mark.parametrize(("depth", "topic"), one_in(6, DEPTHS.values()), ids=DEPTHS)
def test_people_are_not_looked_for_in_depths(tmp_path, depth, topic):
    alone = written(tmp_path / "alone.mcap", {topic: depth}, 2.0)
    for name in ("run", "detect"):
        done = call(name, alone)
        assert done.code == 1
        assert f"{topic} has depths (" in done.err
        assert "in which people are not detected; --topic looks for them there all the same" in done.err
    assert mcaptrack.detect(alone, topic=topic, to="/found").stages == ("detect",)
    both = written(tmp_path / "both.mcap", {"/cam/color/image_raw": USUAL, topic: depth}, 2.0)
    result = mcaptrack.run(both, tables=False)
    assert {name for name in result.channels if name.endswith("/detections")} == {"/cam/color/detections"}
    assert [f"has depths in {topic} (" in why for why in result.left_out.values()] == [True]
    with mcaptrack.open(both) as opened:
        assert next(opened.frames()).rows.shape == (180, 320, 3)  # the only camera


FORMS = {
    "compressed and ffmpeg": ("/cam/image_raw/compressed", "/cam/image_raw/zstd"),
    "raw and rectified": ("/cam/image_raw", "/cam/image_rect_color"),
    "both compressed": ("/cam/image_raw/compressed", "/cam/image_rect_color/compressed"),
    "rectified and its compressed form": ("/cam/image_rect", "/cam/image_rect/compressed"),
    "other names": ("/cam/left", "/cam/left/compressed"),
    "all": ("/cam/image_raw", "/cam/image_raw/compressed", "/cam/image_color", "/cam/image_mono/compressed"),
}


@pytest.mark.parametrize("form", one_in(3, FORMS))
def test_forms_of_the_same_pictures_are_one_camera(tmp_path, form):
    topics = FORMS[form]
    kinds = {"compressed": Channel(lambda image: image, "jpeg", ".jpg"), "zstd": SAME["raw in zstd"][0]}
    channels = {topic: kinds.get(topic.rpartition("/")[2], USUAL) for topic in topics[::-1]}
    result = mcaptrack.run(written(tmp_path / "a.mcap", channels, 2.0), tables=False)
    made = [name for name in result.channels if name.endswith("/detections")]
    assert len(made) == 1
    assert provenance_of(tmp_path / "a.mcap", made[0]).input == topics[0]


@needs("fuse")
@thorough
def test_the_eyes_of_a_stereo_camera_are_two_cameras(tmp_path):
    path = written(tmp_path / "a.mcap", {"/stereo/left/image_raw": USUAL, "/stereo/right/image_raw": USUAL}, 2.0)
    assert set(mcaptrack.run(path, tables=False, fuse=False).cameras) == {"stereo/left", "stereo/right"}


def test_pictures_that_are_not_read_are_named(tmp_path):
    path = tmp_path / "a.mcap"
    with recorder(path) as writer:
        channel = writer.add_channel(
            "/cam/image_raw/theora", ("theora_image_transport/msg/Packet", "ros2msg", b"uint8[] data"), "cdr"
        )
        writer.add_message(channel, 5, b"\0\1\0\0", 5)
    done = call("run", path)
    assert done.code == 1
    assert "/cam/image_raw/theora is Theora video, which is not read" in done.err


def test_a_camera_whose_pictures_can_not_be_read_is_left_out_with_exit_code_3(tmp_path):
    broken = Channel(lambda image: image, "jpeg", ".png", head=b"no picture")
    path = written(tmp_path / "a.mcap", {"/a/image_raw": USUAL, "/b/image_raw/compressed": broken}, 2.0)
    done = call("run", path, "--no-tables", "--json")
    assert done.code == 3
    said = [text["message"] for text in json.loads(done.out)["warnings"] if text["code"] == "no-pictures"]
    assert ["the camera b/image_raw is left out: it has pictures that can't be read" in text for text in said] == [True]
