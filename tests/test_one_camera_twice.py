"""Pictures that are recorded twice, and depths: one camera is run once."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import cv2
import pytest

import mcaptrack
from tests.logs import recorder
from tests.tiers import one_in
from tests.worlds import small_scene

RAW, COMPRESSED, DEPTH = "/cam/color/image_raw", "/cam/color/image_raw/compressed", "/cam/depth/image_rect"


def written(path: Path, *topics: str) -> Path:
    """A log of the same pictures on these topics: as jpeg on one, as distances on the last."""
    with recorder(path) as writer:
        for topic in topics:
            name = "foxglove.CompressedImage" if topic == COMPRESSED else "foxglove.RawImage"
            channel = writer.add_channel(topic, (name, "jsonschema", b"{}"))
            for number, shot in enumerate(small_scene(1.5).shots()):
                image = cv2.cvtColor(shot.image, cv2.COLOR_BGR2GRAY)
                height, width = image.shape
                data, encoding, step = image.tobytes(), "mono8", width
                if topic == DEPTH:
                    data, encoding, step = (image.astype("<u2") * 20).tobytes(), "16UC1", 2 * width
                if topic == COMPRESSED:
                    data = cv2.imencode(".jpg", shot.image)[1].tobytes()
                t_ns = 10**9 + number * 10**8
                stamp = {"timestamp": {"sec": t_ns // 10**9, "nsec": t_ns % 10**9}, "format": "jpeg"}
                about = {"width": width, "height": height, "encoding": encoding, "step": step}
                content = json.dumps(stamp | about | {"data": base64.b64encode(data).decode()}).encode()
                writer.add_message(channel, t_ns, content, t_ns)
    return path


@pytest.mark.parametrize("more", one_in(2, [[COMPRESSED], []]))
def test_a_camera_that_is_recorded_twice_is_run_once(tmp_path, more):
    topics = (RAW, *more, DEPTH)
    result = mcaptrack.run(written(tmp_path / "a.mcap", *topics), tables=False)
    assert {topic for topic in result.channels if topic.endswith("/detections")} == {"/cam/color/detections"}
    assert len(result.left_out) == len(topics) - 1
    assert ("cam/depth" in result.left_out) is (DEPTH in topics)
    name = next(iter(result.left_out))
    if name == "cam/depth":
        with pytest.raises(mcaptrack.McaptrackError, match=r"has depths in .* \(16UC1\)|has depths \(16UC1\)"):
            mcaptrack.run(tmp_path / "a.mcap", camera=name, tables=False)
        named = mcaptrack.run(tmp_path / "a.mcap", topic=DEPTH, tables=False)
    else:
        named = mcaptrack.run(tmp_path / "a.mcap", camera=name, tables=False)
    assert named.stages[0] == "detect"


def test_the_only_pictures_are_run_whatever_their_names(tmp_path):
    assert (
        "/cam/color/image_raw/detections"
        in mcaptrack.run(written(tmp_path / "a.mcap", COMPRESSED), tables=False).channels
    )


def test_the_pictures_of_the_only_camera_need_no_name(tmp_path):
    with mcaptrack.open(written(tmp_path / "a.mcap", RAW)) as opened:
        assert len(list(opened.frames())) == len(list(opened.frames("image_raw"))) == 15
    with (
        mcaptrack.open(written(tmp_path / "b.mcap", RAW, "/other/image")) as opened,
        pytest.raises(
            mcaptrack.McaptrackError, match=f"no channel video with pictures; it has pictures in {RAW}, /other/image"
        ),
    ):
        opened.frames()
