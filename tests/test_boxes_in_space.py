"""3D boxes of other software, in every form, in the fixed frame: against numbers by scipy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mcaptrack import log
from mcaptrack.geometry.transform_tree import Recorded, Samples, TransformTree
from mcaptrack.notices import collected
from mcaptrack.schema import Frame
from mcaptrack.sources.fixed_frame import named_detections, rows_of_boxes
from mcaptrack.sources.foreign import MessageType
from mcaptrack.sources.foreign.boxes_3d import boxes_3d_decoder
from mcaptrack.sources.foreign.boxes_3d.recorded import recorded
from tests.space_logs import START_NS, WAYS, Robot, Seen, scene_update, write

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


@given(
    st.lists(st.floats(-3, 3), min_size=9, max_size=9),
    st.lists(st.floats(-100, 100), min_size=9, max_size=9),
    st.sampled_from([(0, 0, 0), (90, 0, 0), (0, 90, 0), (0, 0, 90), (90, 0, 90)]),
)
def test_any_pose_of_sensor_and_box_gives_the_numbers_of_scipy(angles, shifts, lying):
    """The box stands on any of its sides; the one that is most upright has its height."""
    sensor, robot = (Rotation.from_euler("zyx", angles[n : n + 3]) for n in (0, 3))
    base, mount, centre = (np.array(shifts[n : n + 3]) for n in (0, 3, 6))
    upright = Rotation.from_euler("zyx", [angles[6], angles[7] / 60, angles[8] / 60]) * Rotation.from_euler(
        "xyz", lying, degrees=True
    )
    world = robot * sensor
    box = Seen(
        world.inv().apply(centre - base - robot.apply(mount)),
        (world.inv() * upright).as_quat(),
        np.array([4.0, 2.0, 1.5]),
    )
    found = recorded([(START_NS, boxes_3d_decoder(_KIND)(scene_update(START_NS, [box]).SerializeToString()))])
    tree = TransformTree(
        [
            Recorded(
                parent,
                child,
                True,
                Samples(np.array([START_NS]), np.array([START_NS]), shift[None], turn.as_quat()[None]),
            )
            for parent, child, turn, shift in (("map", "base", robot, base), ("base", "lidar", sensor, mount))
        ]
    )
    poses = tree.lookup("map", "lidar", found.stamp_ns)
    with collected() as warnings:
        (row,) = rows_of_boxes(found, poses.rotation, poses.translation)
    axes = upright.as_matrix()
    up = int(np.abs(axes[2]).argmax())
    along, across = [axis for axis in range(3) if axis != up]
    np.testing.assert_allclose([row["x_m"], row["y_m"], row["z_m"]], centre, atol=1e-6)
    assert [row["length_m"], row["width_m"], row["height_m"]] == [box.size[along], box.size[across], box.size[up]]
    off = row["heading_rad"] - np.arctan2(axes[1, along], axes[0, along])
    assert np.cos(off) > 1 - 1e-12
    assert -np.pi < row["heading_rad"] <= np.pi
    assert len(warnings) == (up != 2)


_KIND = MessageType("foxglove.SceneUpdate", "protobuf", b"", "protobuf")
