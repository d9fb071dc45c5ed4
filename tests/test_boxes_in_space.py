"""3D boxes of other software, in every form, in the fixed frame: against numbers by scipy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mcaptrack import log
from mcaptrack.notices import collected
from mcaptrack.schema import Frame
from mcaptrack.sources.fixed_frame import named_detections
from tests.space_logs import WAYS, Robot, write

NUMBERS = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad")


def read(path: Path, frame_id: str = "", topic: str = "/lidar/boxes"):
    with log.read(path) as opened, collected() as warnings:
        found = named_detections(opened, topic, frame_id)
    return found, [notice.message.removeprefix(f"{path}: ") for notice in warnings]


def flat(frames: list[Frame]) -> tuple[np.ndarray, np.ndarray]:
    return np.repeat([frame.t_ns for frame in frames], [len(frame.rows) for frame in frames]), np.concatenate(
        [frame.rows for frame in frames]
    )


@pytest.mark.parametrize("way", WAYS)
def test_the_same_log_gives_the_same_detections_in_every_form(way, tmp_path):
    robot = Robot()
    moving = "protobuf" if way in ("scene updates", "json") else "ros"
    found, said = read(write(tmp_path / "a.mcap", robot, WAYS[way], moving))
    t_ns, rows = flat(found.frames)
    wanted = robot.wanted()
    assert t_ns.tolist() == [row["t_ns"] for row in wanted]
    for name in NUMBERS:
        np.testing.assert_allclose(rows[name], [row[name] for row in wanted], atol=1e-6, err_msg=name)
    np.testing.assert_allclose(rows["score"], [row["score"] for row in wanted], atol=1e-6)
    assert found.frame_id == "map"
    if way == "detections of ros 1":
        assert rows["class_id"].tolist() == [
            1 + ("pedestrian", "car", "truck", "bicycle").index(row["class"]) for row in wanted
        ]
        assert set(rows["source_id"].tolist()) == {-1}
        assert said == []
    else:
        names = {1: "pedestrian"} | found.classes
        assert [names[number] for number in rows["class_id"].tolist()] == [row["class"] for row in wanted]
        assert rows["source_id"].tolist() == [row["id"] for row in wanted]
        assert [words.partition(";")[0] for words in said] == ["classes of /lidar/boxes are names"]
