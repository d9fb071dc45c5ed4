"""3D boxes of other software, in every form, in the fixed frame: against numbers by scipy."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mcaptrack import log
from mcaptrack.contracts import Box3d
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.transform_tree import Poses, PoseSamples, Recorded, TransformTree
from mcaptrack.notices import collected
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.sources import camera_motion, foreign
from mcaptrack.sources.fixed_frame import named_detections, rows_of_boxes
from mcaptrack.sources.foreign import MessageType
from mcaptrack.sources.foreign.fields import Message3d
from tests.box_reading import boxes_of, recorded
from tests.logs import recorder
from tests.ros_messages import Ros
from tests.space_logs import (
    NAMES,
    SEEN,
    START_NS,
    WAYS,
    Robot,
    Seen,
    by_foxglove,
    marker,
    ros,
    scene_update,
    scene_update_json,
    write,
)

NUMBERS = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad")


def read(path: Path, frame_id: str = "", topic: str = "/lidar/boxes"):
    with log.read(path) as opened, collected() as warnings:
        found = named_detections(opened, topic, frame_id)
    return found, [notice.message.removeprefix(f"{path}: ") for notice in warnings]


def flat(frames: list[Frame]) -> tuple[np.ndarray, np.ndarray]:
    t_ns = np.repeat([frame.t_ns for frame in frames], [len(frame.rows) for frame in frames])
    return t_ns, np.concatenate([frame.rows for frame in frames])


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
        assert rows["class_id"].tolist() == [1 + NAMES.index(row["class"]) for row in wanted]
        assert set(rows["source_id"].tolist()) == {-1}
        listed = ", ".join(map(str, sorted(set(rows["class_id"].tolist()))))
        words = "1 counts as people, and others move as objects of unknown class do; `class_map=` names them"
        assert said == [f"classes of /lidar/boxes are numbers without names ({listed}): {words}"]
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
    on_side = Rotation.from_euler("xyz", lying, degrees=True)
    upright = Rotation.from_euler("zyx", [angles[6], angles[7] / 60, angles[8] / 60]) * on_side
    back, at = (robot * sensor).inv(), np.array([START_NS])
    box = Seen(back.apply(centre - base - robot.apply(mount)), (back * upright).as_quat(), np.array([4.0, 2.0, 1.5]))
    found = recorded([(START_NS, boxes_of(_KIND, scene_update(START_NS, [box]).SerializeToString()))])
    ways = (("map", "base", robot, base), ("base", "lidar", sensor, mount))
    links = [
        Recorded(parent, child, True, PoseSamples(at, at, shift[None], turn.as_quat()[None]))
        for parent, child, turn, shift in ways
    ]
    poses = TransformTree(links).lookup("map", "lidar", found.stamp_ns)
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


def test_tracks_in_another_frame_are_as_boxes_brought_there(monkeypatch):
    """Half a turn takes a heading of 0 to pi, not to -pi, and a row without a heading or velocity keeps none."""
    half = np.diag([-1.0, -1.0, 1.0])
    shift = np.array([10.0, 20.0, 5.0])

    def poses_at(opened, topic, target, source, stamps_ns, log_ns):
        count = len(stamps_ns)
        return Poses(np.tile(half, (count, 1, 1)), np.tile(shift, (count, 1)), np.zeros(count, np.int64), {})

    monkeypatch.setattr(camera_motion, "poses_at", poses_at)
    nan = np.nan
    rows = TRACKS.rows(
        track_id=[1, 2, 3], x_m=[1.0, 2.0, 3.0], y_m=[0.0, 1.0, 2.0], z_m=[1.0, 2.0, nan], heading_rad=[0.0, 2.0, nan],
        vx_m_per_s=[1.0, 0.0, nan], vy_m_per_s=[0.0, -2.0, nan], observed=[True] * 3, source_id=[-1] * 3,
    )  # fmt: skip
    (moved,) = camera_motion.in_frame(None, "/truth", [Frame(START_NS, 0, rows)], "map", "city")
    turns = [(0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)) for heading in (0.0, 2.0)]
    boxes = [
        Box3d(START_NS, "city", (row["x_m"], row["y_m"], row["z_m"]), turn, (1.0, 1.0, 1.0), velocity=velocity)
        for row, turn, velocity in zip(rows[:2], turns, [(1.0, 0.0, 0.0), (0.0, -2.0, 0.0)], strict=True)
    ]
    found = recorded([(START_NS, Message3d(START_NS, boxes))])
    wanted = rows_of_boxes(found, np.tile(half, (2, 1, 1)), np.tile(shift, (2, 1)))
    for name in ("x_m", "y_m", "z_m", "heading_rad", "vx_m_per_s", "vy_m_per_s"):
        np.testing.assert_allclose(moved.rows[name][:2], wanted[name], atol=1e-12, err_msg=name)
    assert moved.rows["heading_rad"].tolist()[0] == np.pi == wanted["heading_rad"][0]
    assert np.isnan([moved.rows[name][2] for name in ("z_m", "heading_rad", "vx_m_per_s", "vy_m_per_s")]).all()
    assert (moved.rows["x_m"][2], moved.rows["y_m"][2]) == (7, 18)


_KIND = MessageType("foxglove.SceneUpdate", "protobuf", b"", "protobuf")


# Other messages


def boxes_by(writer: Ros, message) -> Message3d:
    return boxes_of(writer.kind, writer.pack(message))


def test_markers_that_are_no_cubes_are_counted_and_lists_of_cubes_are_boxes():
    writer = ros("visualization_msgs/MarkerArray")
    markers = [
        marker(writer, START_NS, SEEN, kind=6, points=[(1, 0, 0), (0, 2, 0)], space="objects", text="truck 87%"),
        marker(writer, START_NS, SEEN, kind=9, text="car 0.9"),
        marker(writer, START_NS, SEEN, kind=1, action=2),
        marker(writer, START_NS + 4, SEEN, space="lidar/van", text="12: 0.25"),
        marker(writer, START_NS, SEEN, space="", text="no number here"),
        marker(writer, START_NS, SEEN, space="track_17", text="car"),
        marker(writer, START_NS, SEEN, space="5"),
        marker(writer, START_NS, SEEN, space="type_2"),
    ]
    found = boxes_by(writer, writer.new("visualization_msgs/MarkerArray", markers))
    np.testing.assert_allclose(
        [box.centre for box in found.boxes], [[1, 3, 3], [-1, 2, 3], *[[1, 2, 3]] * 5], atol=1e-12
    )
    assert [box.class_name for box in found.boxes] == ["truck", "truck", "van", "no", "car", "", "type_2"]
    np.testing.assert_allclose([box.score for box in found.boxes], [0.87, 0.87, 0.25, np.nan, np.nan, 0.5, 0.5])
    assert [box.source_id for box in found.boxes] == [None, None, *[12] * 5]
    assert found.boxes[2].stamp_ns == START_NS + 4
    assert found.ignored == {"markers that are no solids": 1}
    one = ros("visualization_msgs/Marker")
    assert boxes_by(one, marker(one, START_NS, SEEN)).boxes[0].source_id == 12


def test_texts_beside_cubes_say_what_these_do_not():
    writer = ros("visualization_msgs/MarkerArray")

    def named(number: int, kind: int, space: str, text: str):
        seen = replace(SEEN, number=number)
        return marker(writer, START_NS, seen, kind, space=space, text=text)

    markers = [
        named(1, 1, "boxes", " "), named(1, 9, "labels", "van 0.40 m/s 0.75"),
        named(2, 1, "truck", "0.25"), named(2, 9, "labels", "car 0.5"),
        named(3, 1, "boxes", " "), named(3, 9, "labels", "car"), named(3, 9, "speeds", "bus"),  # which of them?
        named(4, 9, "labels", "car"),
    ]  # fmt: skip
    found = boxes_by(writer, writer.new("visualization_msgs/MarkerArray", markers))
    assert [box.class_name for box in found.boxes] == ["van", "truck", ""]
    np.testing.assert_array_equal([box.score for box in found.boxes], [0.75, 0.25, np.nan])
    assert found.ignored == {"markers that are no solids": 3}


def test_cubes_of_one_entity_have_no_id_and_metadata_has_several_names():
    message = scene_update(START_NS, [SEEN, SEEN])
    message.entities[0].cubes.add().CopyFrom(message.entities[0].cubes[0])
    del message.entities[1].metadata[:]
    message.entities[1].texts.add(text="van 0.25")
    for key, value in (("Track-ID", "77"), ("probability", "50 %"), ("object_class", "bus")):
        other = message.entities.add(frame_id="/roof", id="no number")
        other.cubes.add()
        other.metadata.add(key=key, value=value)
    message.entities.add(id="text alone").texts.add(text="car")
    found = boxes_of(_KIND, message.SerializeToString())
    assert [box.source_id for box in found.boxes] == [None, None, "12", "77", "no number", "no number"]
    assert [box.class_name for box in found.boxes] == ["car", "car", "van", "", "", "bus"]
    np.testing.assert_array_equal([box.score for box in found.boxes], [0.5, 0.5, 0.25, np.nan, 0.5, np.nan])
    assert found.ignored == {"entities without solids": 1}
    arrays = recorded([(START_NS, found)])
    assert arrays.names == ["lidar", "roof"]
    assert arrays.source_id.tolist() == [-1, -1, 12, 77, 78, 78]
    assert arrays.remarks == {
        "entities without solids are left out": 1,
        "boxes have a size of 0: it is unknown": 3,
        "boxes have an orientation of zeros: they count as not turned": 3,
    }


def test_ids_and_values_of_metadata_may_be_numbers_in_json():
    update = json.loads(scene_update_json(START_NS, [SEEN]))
    (entity,) = update["entities"]
    entity["id"], entity["metadata"] = 42, [{"key": "score", "value": 0.25}, {"key": "class", "value": 3}]
    kind = MessageType("foxglove.SceneUpdate", "jsonschema", b"{}", "json")
    (box,) = boxes_of(kind, json.dumps(update).encode()).boxes
    assert (box.source_id, box.score, box.class_name) == ("42", 0.25, "3")
    entity["id"] = [42]
    with pytest.raises(McaptrackError, match="a list where text belongs"):
        boxes_of(kind, json.dumps(update).encode())


def test_numbers_that_can_not_be_are_counted_once():
    nan, inf = float("nan"), float("inf")
    turn, size = (0.0, 0.0, 0.0, 2.0), (4.0, 2.0, 1.0)
    boxes = [
        Box3d(START_NS, "a", (0.0, 0.0, 0.0), turn, size, source_id="b"),
        Box3d(START_NS, "a", (nan, 0.0, 0.0), turn, size),
        Box3d(START_NS, "a", (0.0, inf, 0.0), turn, size),
        Box3d(START_NS, "a", (0.0, 0.0, 1e300), turn, size),
        Box3d(START_NS, "a", (1.0, 0.0, 0.0), turn, (nan, 2.0, 1.0), source_id=-5),
        Box3d(START_NS, "a", (2.0, 0.0, 0.0), turn, (-1.0, 2.0, 1.0), source_id="a"),
        Box3d(START_NS, "a", (3.0, 0.0, 0.0), (nan, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0), source_id="0012"),
        Box3d(START_NS, "a", (4.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), size, source_id=2**40),
    ]
    found = recorded([(START_NS, Message3d(START_NS, boxes))])
    assert found.remarks == {
        "boxes have no position (no finite number) and are left out": 3,
        "boxes have a size that is no finite number: it is unknown": 1,
        "boxes have a negative size: it is unknown": 1,
        "boxes have a size of 0: it is unknown": 1,
        "boxes have an orientation that is no finite number: it is unknown": 1,
        "boxes have an orientation of zeros: they count as not turned": 1,
    }
    rows = rows_of_boxes(found, np.tile(np.eye(3), (5, 1, 1)), np.zeros((5, 3)))
    assert rows["x_m"].tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(rows["length_m"], [4, nan, nan, nan, 4])
    np.testing.assert_array_equal(rows["width_m"], [2, 2, 2, nan, 2])
    np.testing.assert_array_equal(rows["heading_rad"], [0, 0, 0, nan, 0])
    assert rows["source_id"].tolist() == [2**40 + 2, -1, 2**40 + 1, 12, 2**40]


def test_a_box_without_z_stands_where_x_and_y_say():
    nan = float("nan")
    boxes = [Box3d(START_NS, "radar", (3.0, 1.0, z), (0.0, 0.0, 0.0, 1.0), (4.0, 2.0, 1.0)) for z in (0.0, nan)]
    found = recorded([(START_NS, Message3d(START_NS, boxes))])
    assert found.remarks == {"boxes have no z: it is unknown, and 0 in their frame for x and y": 1}
    tilted = Rotation.from_euler("zyx", [0.5, 0.1, -0.2])
    rows = rows_of_boxes(found, np.tile(tilted.as_matrix(), (2, 1, 1)), np.tile([5.0, 6.0, 7.0], (2, 1)))
    x, y, z = tilted.apply([3.0, 1.0, 0.0]) + [5, 6, 7]
    np.testing.assert_allclose(rows["x_m"], [x, x])
    np.testing.assert_allclose(rows["y_m"], [y, y])
    np.testing.assert_allclose(rows["z_m"], [z, nan])


# Times


MS = 1_000_000


def message(*stamps_ms: int | None, is_measured: bool = True) -> Message3d:
    """Boxes with these stamps; None for none. A message without boxes has no stamp."""
    stamps = [0 if one is None else START_NS + one * MS for one in stamps_ms]
    boxes = [Box3d(one, "a", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (1.0, 1.0, 1.0)) for one in stamps]
    return Message3d(stamps[0] if stamps else 0, boxes, is_measured=is_measured)


@pytest.mark.parametrize(
    ("messages", "times", "frames"),
    [
        ({40: message(0), 140: message(100, 100)}, [0, 100], [0, 1, 1]),
        ({40: message(0), 41: message(0), 140: message(100)}, [0, 100], [0, 0, 1]),  # a message for each box
        ({140: message(100), 141: message(0)}, [0, 100], [1, 0]),  # late ones
        ({40: message(0, 10, 20), 140: message(100, 110, 120)}, [10, 110], [0, 0, 0, 1, 1, 1]),  # the middle of a sweep
        ({40: message(0, 90), 140: message(100, 190)}, [0, 90, 100, 190], [0, 1, 2, 3]),
        ({40: message(0), 140: message(), 240: message(200)}, [0, 100, 200], [0, 2]),  # without a stamp: as late as others
        ({40: message(0), 140: message(None), 240: message(200)}, [0, 140, 200], [0, 1, 2]),
        ({40: message(0), 39: message(is_measured=False), 140: message(100), 139: message(is_measured=False)}, [0, 100], [0, 1]),
        ({40: message(0), 140: message(100), 240: message(is_measured=False), 340: message(300)}, [0, 100, 200, 300], [0, 1, 3]),
        ({40: message(-70_000), 140: message(-69_900)}, [40, 140], [0, 1]),  # of another clock
        ({40: message()}, [40], []),
        ({}, [], []),
        # every other message is empty: no sweeps of two
        ({40 + 100 * k: message(*[100 * k] * (k % 2)) for k in range(9)}, [100 * k for k in range(9)], [1, 3, 5, 7]),
        ({40 + 100 * k: message(100 * k, 100 * k + 7) if k % 3 else message() for k in range(9)}, [100 * k for k in range(9)], [1, 1, 2, 2, 4, 4, 5, 5, 7, 7, 8, 8]),
    ],
)  # fmt: skip
def test_messages_are_frames_at_their_stamps(messages, times, frames):
    found = recorded([(START_NS + t_ns * MS, one) for t_ns, one in sorted(messages.items())])
    starts, frame, _ = found.frames()
    assert ((starts - START_NS) / MS).tolist() == times
    log_ms = (found.message_ns[found.message] - START_NS) // MS
    order = np.concatenate([np.flatnonzero(log_ms == t_ns) for t_ns in messages] or [np.empty(0, int)])
    assert frame[order].tolist() == frames


# What messages leave out, or say twice


UNTURNED, SIZE = (0.0, 0.0, 0.0, 1.0), (4.0, 2.0, 1.0)


def box(x: float = 0.0, frame_id: str = "lidar", stamp_ns: int = START_NS, **more) -> Box3d:
    return Box3d(stamp_ns, frame_id, (x, 0.0, 0.0), UNTURNED, SIZE, **more)


@pytest.mark.parametrize(("name", "zero", "other"), [("velocity", (0.0,) * 3, (0.0, 1.0, 0.0)), ("score", 0.0, 0.1)])
def test_velocities_and_scores_of_zero_are_unknown_if_there_are_no_others(name, zero, other):
    boxes = [box(**{name: zero}), box(**{name: zero}), box()]
    found = recorded([(START_NS, Message3d(START_NS, boxes))])
    assert np.isnan(getattr(found, name)).all()
    assert found.remarks == {f"boxes have a {name} of 0, and no box has another: it is unknown": 2}
    found = recorded([(START_NS, Message3d(START_NS, [*boxes, box(**{name: other})]))])
    np.testing.assert_array_equal(getattr(found, name), np.array([zero, zero, np.full_like(zero, np.nan), other]))
    assert not found.remarks


def test_boxes_that_are_recorded_twice_count_once():
    nan, late = float("nan"), START_NS + 10**8
    first = [box(1.0, score=nan), box(2.0, class_name="car"), box(1.0, score=0.5), box(2.0)]
    second = [box(1.0, score=nan, source_id=7), box(3.0), box(2.0)]
    times = (START_NS, START_NS, first), (START_NS + 5, START_NS, second), (late, late, [box(1.0, stamp_ns=late)])
    found = recorded([(log_ns, Message3d(stamp_ns, boxes)) for log_ns, stamp_ns, boxes in times])
    _, frame, _ = found.frames()
    assert np.flatnonzero(found.is_repeated(frame)).tolist() == [4, 6]


def log_of(tmp_path: Path, name, stamped: bool = True) -> Path:
    """A log with boxes in the frames that ``name`` gives for the number of a message, without stamps if so."""
    robot = Robot(shots=4)

    def make(stamp_ns, boxes):
        number = (stamp_ns - robot.shots[0].stamp_ns) // 10**8
        return scene_update(stamp_ns if stamped else 0, boxes, name(number)).SerializeToString()

    return write(tmp_path / "log.mcap", robot, by_foxglove(make))


def test_boxes_without_a_frame_are_in_that_of_the_others(tmp_path):
    whole, _ = read(log_of(tmp_path, lambda _: "lidar"))
    found, warnings = read(log_of(tmp_path, lambda number: "" if number == 0 else "lidar"))
    assert found.frame_id == "map"
    assert [len(frame.rows) for frame in found.frames] == [3, 3, 3, 3]
    np.testing.assert_array_equal(flat(found.frames)[1]["x_m"], flat(whole.frames)[1]["x_m"])
    assert "/lidar/boxes: 3 of 12 boxes name no frame: they count as in lidar, as most others are" in warnings
    found, warnings = read(log_of(tmp_path, lambda _: ""))
    assert found.frame_id == ""
    assert "/lidar/boxes: boxes name no frame: they stay as they are, in a frame without a name" in warnings


def test_boxes_in_another_frame_that_is_not_known_are_said(tmp_path):
    def made(t_ns, boxes):
        update = scene_update(t_ns, boxes)
        update.entities[1].frame_id = "roof"
        return update.SerializeToString()

    found, said = read(write(tmp_path / "a.mcap", Robot(shots=2), by_foxglove(made)))
    assert [len(frame.rows) for frame in found.frames] == [2, 2]
    why = "since the pose of roof in map isn't known: 2 no transform connects roof with map"
    assert f"/lidar/boxes: 2 of 2 messages have boxes in roof that are left out, {why}" in said


def test_boxes_without_a_stamp_are_counted(tmp_path):
    found, warnings = read(log_of(tmp_path, lambda _: "lidar", stamped=False))
    assert len(found.frames) == 4
    words = "have no stamp, or one that is more than 60 s from the log time: their time is the log time"
    assert f"/lidar/boxes: 12 of 12 boxes {words}" in warnings


def test_boxes_without_a_class_and_a_clock_that_is_set_back_are_said(tmp_path):
    robot = Robot(shots=7)

    def made(stamp_ns, boxes):
        update = scene_update(stamp_ns - (2 * 10**8 if stamp_ns >= robot.shots[5].stamp_ns else 0), boxes)
        del update.entities[0].metadata[:]
        return update.SerializeToString()

    found, said = read(write(tmp_path / "a.mcap", robot, by_foxglove(made)))
    assert [len(frame.rows) for frame in found.frames] == [3, 3, 3, 6, 6]
    assert "/lidar/boxes: 7 of 21 boxes have no class, or 0: they move as objects of unknown class do" in said
    words = "times have boxes of several messages, where others have those of one, as if a clock was set back"
    assert f"/lidar/boxes: 2 of 5 {words}: they count as one frame" in said


def test_a_frame_that_moves_is_said(tmp_path):
    found, warnings = read(log_of(tmp_path, lambda _: "lidar"), "base_link")
    assert found.frame_id == "base_link"
    moving = [words for words in warnings if "base_link moves (map -> base_link isn't static)" in words]
    assert len(moving) == 1
    assert not any("moves (" in words for words in read(log_of(tmp_path, lambda _: "lidar"), "map")[1])


def test_boxes_in_a_root_are_told_why_nothing_is_above_it(tmp_path, monkeypatch):
    path = log_of(tmp_path, lambda _: "lidar")
    zeros, once = np.zeros((1, 3)), np.array([START_NS])
    useless = [Recorded("base_link", "lidar", True, PoseSamples(once, once, zeros, np.zeros((1, 4))))]
    monkeypatch.setattr("mcaptrack.sources.fixed_frame.transforms_of", lambda *_: TransformTree(useless))
    found, warnings = read(path)
    assert found.frame_id == "lidar"
    words = "transforms: base_link -> lidar: 1 pose without a rotation or a position are left out"
    assert warnings.count(words) == 1


# Drawings that are no cubes


def wires(centre, turn: Rotation, size) -> list[np.ndarray]:
    """The ends of the twelve edges of a box."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2 * size
    pairs = [(a, b) for a in range(8) for b in range(a) if (np.abs(corners[a] - corners[b]) > 1e-9).sum() == 1]
    return [turn.apply(corners[number]) + centre for pair in pairs for number in pair]


@given(
    st.lists(st.floats(-50, 50), min_size=3, max_size=3),
    st.lists(st.floats(0.3, 4), min_size=3, max_size=3),
    st.floats(-3, 3),
    st.integers(0, 9),
)
def test_boxes_of_lines_are_boxes(centre, size, yaw, seed):
    """The longer side on the ground is the length; which end is the front, lines don't say."""
    points = wires(np.array(centre), Rotation.from_euler("z", yaw), np.array(size))
    order = np.random.default_rng(seed).permutation(12)
    shuffled = [points[2 * edge + end] for edge in order for end in (0, 1)]
    writer = ros("visualization_msgs/MarkerArray")
    lines = marker(writer, START_NS, Seen(np.zeros(3), np.array([0, 0, 0, 1.0]), np.ones(3)), 5, points=shuffled)
    (box,) = boxes_by(writer, writer.new("visualization_msgs/MarkerArray", [lines])).boxes
    np.testing.assert_allclose(box.centre, centre, atol=1e-6)
    np.testing.assert_allclose(box.size, [*sorted(size[:2], reverse=True), size[2]], atol=1e-6)
    ahead = Rotation.from_quat(box.orientation).apply([1, 0, 0])
    along = Rotation.from_euler("z", yaw).apply([1, 0, 0] if size[0] >= size[1] else [0, 1, 0])
    assert abs(size[0] - size[1]) < 1e-6 or abs(ahead @ along) > 1 - 1e-6
    cut = marker(writer, START_NS, SEEN, 5, points=shuffled[:-2])
    assert not boxes_by(writer, writer.new("visualization_msgs/MarkerArray", [cut])).boxes


@pytest.mark.parametrize("kind", [2, 3, 7])
def test_markers_that_are_round_have_a_size_and_no_heading(kind):
    writer = ros("visualization_msgs/MarkerArray")
    points = [(0, 0, 0)] if kind == 7 else ()
    lines = marker(writer, START_NS, SEEN, 5, points=wires(SEEN.centre, Rotation.identity(), SEEN.size))
    drawn = [marker(writer, START_NS, SEEN, kind, points=points, space="people"), lines]
    found = boxes_by(writer, writer.new("visualization_msgs/MarkerArray", drawn))
    (box,) = found.boxes  # lines count only where there is nothing else
    assert (box.centre, box.size, box.class_name) == ((1, 2, 3), (4, 2, 1.5), "people")
    assert not box.has_heading
    assert found.ignored == {"markers that are no solids": 1}


@pytest.mark.parametrize("kind", ["spheres", "cylinders", "lines"])
def test_entities_may_be_drawn_by_other_solids(kind):
    message = scene_update(START_NS, [replace(SEEN, turn=np.array([0, 0, 0, 1.0]))])
    (entity,) = message.entities
    cube = entity.cubes.pop()
    if kind == "lines":
        line = entity.lines.add(type=2)
        for x, y, z in wires(SEEN.centre, Rotation.identity(), SEEN.size):
            line.points.add(x=x, y=y, z=z)
    else:
        solid = getattr(entity, kind).add()
        solid.pose.CopyFrom(cube.pose)
        solid.size.CopyFrom(cube.size)
    (box,) = boxes_of(_KIND, message.SerializeToString()).boxes
    np.testing.assert_allclose([*box.centre, *box.size], [1, 2, 3, 4, 2, 1.5], atol=1e-9)
    assert (box.class_name, box.source_id, box.has_heading) == ("car", "12", kind == "lines")


@pytest.mark.parametrize(
    ("topic", "space", "is_read"), [("/goal", "", 0), ("/goal", "person", 1), ("/people/now", "", 1)]
)
def test_what_is_round_is_a_thing_where_a_name_says_so(topic, space, is_read, tmp_path):
    writer = ros("visualization_msgs/MarkerArray")
    ball = writer.new("visualization_msgs/MarkerArray", [marker(writer, START_NS, SEEN, 2, space=space)])
    path = tmp_path / "a.mcap"
    with recorder(path) as out:
        schema = out.register_schema(writer.kind.name, writer.kind.schema_encoding, writer.kind.schema)
        out.add_message(out.register_channel(topic, "cdr", schema), START_NS, writer.pack(ball), START_NS)
    with log.read(path) as opened:
        assert foreign.holds_boxes(opened, topic) == bool(is_read)
        assert list(foreign.uncertain_boxes(opened)) == [topic] * (not is_read)
    found, _ = read(path, topic=topic)
    assert found.frames[0].rows["class_id"].tolist() == [1 if is_read else 0]
