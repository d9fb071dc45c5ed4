"""3D boxes in scenes: where they are, which way they head, whose colours they have, and in which coordinate frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from mcaptrack import foxglove, log
from mcaptrack.foxglove import class_colour
from mcaptrack.foxglove.palette import legible
from mcaptrack.foxglove.views import Drawing
from mcaptrack.geometry.arrays import Floats
from mcaptrack.pipeline.write import Made
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import Provenance
from tests.logs import write_with_views
from tests.worlds import ns, tracks_at

M = 1 / 128 + 1e-9
#: Far from the origin of the map, and high above it, as on maps of cities.
EAST, NORTH, GROUND = 5214.0, 2393.5, 68.75
NAMES = {1: "pedestrian", 2: "bicycle", 3: "car", 9: "wheelbarrow"}
CAR, WALKER, OTHER_CAR, BARROW = 7, 12, 131, 4
CLASS = {CAR: 3, WALKER: 1, OTHER_CAR: 3, BARROW: 9}
SIZE = {CAR: (4.5, 1.75, 1.5), WALKER: (0.75, 0.5, 1.75), OTHER_CAR: (5.0, 2.0, 2.0), BARROW: (1.5, 0.5, 1.0)}
SPEED = {CAR: 10.0, WALKER: 1.5, OTHER_CAR: -20.0, BARROW: 0.0}
HEADING = {CAR: np.radians(30), WALKER: np.radians(-90), OTHER_CAR: np.pi, BARROW: np.nan}
TICKS = 30


def place(track: int, seconds: float) -> Floats:
    """The middle of the bottom of a box; each track has a lane, along the first axis."""
    return np.array([EAST + SPEED[track] * seconds, NORTH + 4.0 * list(CLASS).index(track), GROUND])


def traffic(observed: bool = True) -> list[Frame]:
    frames = []
    for tick in range(TICKS):
        at = np.array([place(track, tick / 10) for track in CLASS])
        size = np.array(list(SIZE.values()))
        rows = TRACKS.rows(
            track_id=list(CLASS), x_m=at[:, 0], y_m=at[:, 1], z_m=at[:, 2] + size[:, 2] / 2,
            length_m=size[:, 0], width_m=size[:, 1], height_m=size[:, 2], heading_rad=list(HEADING.values()),
            observed=np.full(len(at), observed), source_id=np.full(len(at), -1),
            class_id=np.array(list(CLASS.values()), np.uint32),
        )  # fmt: skip
        frames.append(Frame(ns(1000 + tick / 10), tick, rows))
    return frames


def forecasts(steps: int = 5) -> list[Frame]:
    """Where the car and a track that no row has will be, every 0.4 s."""
    frames = []
    for tick in range(0, TICKS, 4):
        rows = [
            (track, step, 0.4 * step, *place(CAR, tick / 10 + 0.4 * step)[:2], 0.25, 0.0, 1.0)
            for track in (CAR, 999)
            for step in range(1, steps + 1)
        ]
        names = ("track_id", "step", "ahead_s", "x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2")
        columns = dict(zip(names, zip(*rows, strict=True), strict=True))
        frames.append(Frame(ns(1000 + tick / 10), tick, PREDICTIONS.rows(**columns)))
    return frames


def scenes(topic: str = "/lidar/retracks/full", frames: list[Frame] | None = None) -> list[SceneUpdate]:
    frames = traffic() if frames is None else frames
    t_ns = np.array([frame.t_ns for frame in frames])
    drawing = Drawing(topic, TRACKS, frames, (), classes=NAMES)
    return [SceneUpdate.FromString(payload) for _, _, payload in drawing.on_ground(t_ns, "map")]


def by_id(scene: SceneUpdate):
    return {int(entity.id.split()[0]): entity for entity in scene.entities}


def test_cubes_are_where_the_rows_say():
    for tick, scene in enumerate(scenes()):
        found = by_id(scene)
        assert set(found) == set(CLASS)
        for track, entity in found.items():
            (cube,), (name,), at = entity.cubes, entity.texts, cube_at(entity)
            assert not entity.cylinders
            assert entity.frame_id == "map"
            x, y, z = place(track, tick / 10)
            assert at == pytest.approx((x, y, z + SIZE[track][2] / 2), abs=M)
            assert (cube.size.x, cube.size.y, cube.size.z) == pytest.approx(SIZE[track], abs=M)
            assert (cube.pose.orientation.x, cube.pose.orientation.y) == (0, 0)
            turn = 2 * np.arctan2(cube.pose.orientation.z, cube.pose.orientation.w)
            assert np.exp(1j * turn) == pytest.approx(np.exp(1j * np.nan_to_num(HEADING[track])), abs=2e-3)
            assert name.text == str(track)
            assert name.pose.position.z > z + SIZE[track][2]


def cube_at(entity) -> tuple[float, float, float]:
    at = entity.cubes[0].pose.position
    return at.x, at.y, at.z


def test_a_line_leads_ahead_and_a_trail_behind():
    found = by_id(scenes()[25])
    for track, entity in found.items():
        ahead, trail = entity.lines
        x, y, z = place(track, 2.5)
        long = SIZE[track][0]
        first, last = ((p.x, p.y, p.z) for p in ahead.points)
        top = z + SIZE[track][2]
        assert first == pytest.approx((x, y, top), abs=M)
        turn = np.nan_to_num(HEADING[track])
        front = (x + 0.75 * long * np.cos(turn), y + 0.75 * long * np.sin(turn), top)
        assert last == pytest.approx(front, abs=M)
        points = np.array([(p.x, p.y, p.z) for p in trail.points])
        assert points[-1] == pytest.approx((x, y, z), abs=M)
        assert points[:, 2] == pytest.approx(z, abs=M)
        assert points[:, 1] == pytest.approx(y, abs=M)
        assert np.sign(points[-1, 0] - points[0, 0]) == np.sign(SPEED[track])


def test_each_track_has_its_colour_and_labels_are_read_on_black():
    for track, entity in by_id(scenes()[0]).items():
        shade, text = (tuple(getattr(part.color, one) for one in "rgb") for part in (entity.cubes[0], entity.texts[0]))
        assert shade == foxglove.colour(track)[:3]
        assert np.dot(text, [0.299, 0.587, 0.114]) >= 0.44
    for number in range(21):
        shade = np.array([foxglove.colour(number)[:3]])
        assert (np.dot(shade, [0.299, 0.587, 0.114]) > 0.45) == (legible(shade) == shade).all()


def test_names_decide_about_colours_and_numbers_about_unknown():
    assert class_colour(3, "car") == class_colour(8, "LARGE_VEHICLE") == class_colour(1, "Car")
    assert class_colour(1, "person") == class_colour(5, "pedestrian") != class_colour(3, "car")
    assert class_colour(5, "scar") != class_colour(5, "car")
    assert class_colour(9, "wheelbarrow") != class_colour(10, "wheelbarrow")
    assert class_colour(0) == class_colour(0, "something") != class_colour(1)


def test_kinds_of_tracks_differ_and_can_all_be_read():
    """Re-tracked boxes are whole, tracked ones are at the bottom, true ones at the top; numbers are apart."""
    spans, numbers = {}, []
    for name in ("tracks", "retracks/full", "truth"):
        entity = by_id(scenes(f"/lidar/{name}")[10])[CAR]
        middle, high = entity.cubes[0].pose.position.z - GROUND, entity.cubes[0].size.z
        spans[name] = (middle - high / 2, middle + high / 2)
        numbers.append(entity.texts[0].pose.position.z)
    assert spans["retracks/full"] == pytest.approx((0, 1.5), abs=M)
    assert max(map(abs, spans["tracks"])) < 0.1
    assert np.abs(np.array(spans["truth"]) - 1.5).max() < 0.1
    assert min(np.diff(sorted(numbers))) > 1.5


def test_boxes_that_are_not_observed_are_fainter():
    seen, unseen = (by_id(scenes(frames=traffic(observed))[3])[CAR].cubes[0].color.a for observed in (True, False))
    assert unseen < 0.5 * seen < 0.5


def test_rows_without_a_box_are_drawn_as_people():
    frames = traffic()
    frames[0].rows["height_m"][1] = np.nan
    found = by_id(scenes(frames=frames)[0])
    assert [len(found[WALKER].cubes), len(found[WALKER].cylinders)] == [0, 1]
    assert [len(found[CAR].cubes), len(found[CAR].cylinders)] == [1, 0]


def drawn_forecasts(bodies) -> list[SceneUpdate]:
    frames = forecasts()
    t_ns = np.array([frame.t_ns for frame in frames])
    drawing = Drawing("/lidar/predictions", PREDICTIONS, frames, ())
    return [SceneUpdate.FromString(payload) for _, _, payload in drawing.on_ground(t_ns, "map", bodies)]


def test_forecasts_are_at_the_bottom_of_their_boxes():
    """Also those of tracks without any box; without 3D boxes they are on the ground plane, at 0."""
    bodies = traffic()
    for frame in bodies[9:]:
        frame.rows["z_m"] += 2.0  # a ramp
    for tick, scene in enumerate(drawn_forecasts(bodies)):
        up = GROUND + 2.0 * (4 * tick >= 9)
        for entity in scene.entities:
            (line,), (disc,) = entity.lines, entity.cylinders
            end = place(CAR, 0.4 * tick + 2.0)[:2]
            (height,) = {point.z for point in line.points}
            assert height == up if entity.id == str(CAR) else GROUND <= height <= GROUND + 2
            assert (line.points[-1].x, line.points[-1].y) == pytest.approx(end, abs=M)
            at = disc.pose.position
            assert disc.color.a < 0.2  # many lie over one another
            assert (at.x, at.y, at.z) == pytest.approx((*end, height + 0.02), abs=M)
            assert (disc.size.x, disc.size.y) == pytest.approx(
                2 * np.sqrt(2 * np.log(2) * np.array([1.0, 0.25])), abs=M
            )
    assert {point.z for point in drawn_forecasts(())[3].entities[0].lines[0].points} == {0}


# In a log


def recorded(path: Path, transforms: bool = True) -> Path:
    """Boxes in the frame of a robot that drives on a map, as its software draws them."""
    with log.create(path) as writer:
        if transforms:
            number = writer.add_channel("/tf", foxglove.schema_record(foxglove.TRANSFORM), "protobuf", {})
            for tick in range(TICKS):
                for parent, child, x in (("map", "odom", 9.0), ("odom", "base", tick), ("base", "lidar", 1.0)):
                    message = FrameTransform(parent_frame_id=parent, child_frame_id=child)
                    message.timestamp.FromNanoseconds(ns(1000 + tick / 10))
                    message.translation.x, message.rotation.w = float(x), 1.0
                    writer.add_message(number, ns(1000 + tick / 10), tick, message.SerializeToString())
        number = writer.add_channel("/lidar/boxes", foxglove.schema_record(foxglove.SCENE), "protobuf", {})
        for tick in range(TICKS):
            message = SceneUpdate()
            cubes = message.entities.add(frame_id="lidar", id="0").cubes
            cube = cubes.add()
            cube.size.x = cube.size.y = cube.size.z = cube.pose.orientation.w = 1.0
            writer.add_message(number, ns(1000 + tick / 10), tick, message.SerializeToString())
    return path


def with_tracks(path: Path, frame_id: str = "map") -> dict[str, bytes]:
    """Write tracks and forecasts of 3D boxes into a log; returns the layouts."""

    def how(stage: str, source: str) -> Provenance:
        names = {str(number): name for number, name in NAMES.items()}
        return Provenance(stage, {}, source, classes=names, frame_id=frame_id)

    made = {
        "/lidar/tracks": Made.of(TRACKS, traffic(), how("track", "/lidar/boxes")),
        "/lidar/retracks": Made.of(TRACKS, traffic()[::4], how("retrack", "/lidar/tracks")),
        "/lidar/retracks/online": Made.of(TRACKS, traffic()[::4], how("retrack", "/lidar/tracks")),
        "/lidar/retracks/full": Made.of(TRACKS, traffic(), how("retrack", "/lidar/tracks")),
        "/lidar/retracks/predictions": Made.of(PREDICTIONS, forecasts(), how("retrack", "/lidar/tracks")),
    }
    with log.read(path) as opened:
        return write_with_views(opened, "/lidar", made)


def frames_drawn(path: Path) -> set[str]:
    with log.read(path) as opened:
        topics = [topic for topic in opened.channels if topic.endswith("/view/scene")]
        assert len(topics) == (4 if "/tf" in opened.channels else 3)
        topics = [topic for topic in topics if topic != "/lidar/robot/view/scene"]
        parsed = [SceneUpdate.FromString(m.payload) for topic in topics for m in opened.messages(topic)]
        for topic in topics:  # viewers count the lifetime from the log time
            for message in opened.messages(topic):
                stamps = {one.timestamp.ToNanoseconds() for one in SceneUpdate.FromString(message.payload).entities}
                assert stamps == {message.t_ns}
        heights = {line.points[0].z for scene in parsed for entity in scene.entities for line in entity.lines}
        assert min(heights) == GROUND
    return {entity.frame_id for scene in parsed for entity in scene.entities}


def transforms_added(path: Path) -> list[FrameTransform]:
    with log.read(path) as opened:
        there = "/lidar/view/tf" in opened.channels
        return [FrameTransform.FromString(m.payload) for m in opened.messages("/lidar/view/tf")] if there else []


def test_scenes_are_in_the_fixed_frame_that_the_log_has(tmp_path):
    path = recorded(tmp_path / "drive.mcap")
    with_tracks(path)
    assert frames_drawn(path) == {"map"}
    assert transforms_added(path) == []
    with log.read(path) as opened:
        (message,) = opened.messages("/lidar/robot/view/scene")
        (robot,) = SceneUpdate.FromString(message.payload).entities
    assert (robot.frame_id, robot.frame_locked, robot.lifetime.ToNanoseconds()) == ("base", True, 0)
    assert max(point.x for point in robot.triangles[0].points) > 1  # it points ahead


def test_a_frame_that_no_transform_names_gets_one(tmp_path):
    path = recorded(tmp_path / "drive.mcap", transforms=False)
    with_tracks(path, "lidar")
    assert frames_drawn(path) == {"lidar"}
    (added,) = transforms_added(path)
    assert added.child_frame_id == "lidar"
    assert added.parent_frame_id != "lidar"
    assert added.timestamp.ToNanoseconds() == ns(1000)


def test_layouts_follow_the_robot_beside_the_boxes_that_it_recorded(tmp_path):
    path = recorded(tmp_path / "drive.mcap")
    for content in with_tracks(path).values():
        panels = json.loads(content)["configById"]
        solid = {name: panel for name, panel in panels.items() if name.startswith("3D!")}
        for panel in solid.values():
            # The lidar is fixed to the base, and odometry stands still: it is the base that moves.
            assert (panel["followTf"], panel["followMode"]) == ("base", "follow-pose")
            assert panel["cameraState"]["targetOffset"] == [0, 0, 0]
            grid = panel["layers"]["grid"]
            assert (grid["frameId"], grid["position"][2]) == ("map", pytest.approx(GROUND, abs=0.06))
            low, high = (np.array(grid["position"][:2]) + side * grid["size"] / 2 for side in (-1, 1))
            ends = np.array([place(track, at)[:2] for track in CLASS for at in (0, 2.9)])
            assert ((low < ends) & (ends < high)).all()
    tracking = json.loads(with_tracks(path)["tracking"])["configById"]
    on = {
        name: {topic for topic, how in panel["topics"].items() if how["visible"]}
        for name, panel in tracking.items()
        if name.startswith("3D!")
    }
    assert on == {
        "3D!ground": {f"/lidar/{name}/view/scene" for name in ("retracks/full", "retracks/predictions", "robot")},
        "3D!recorded": {"/lidar/boxes", "/lidar/robot/view/scene"},
    }


def test_without_transforms_layouts_show_the_whole_scene(tmp_path):
    path = recorded(tmp_path / "drive.mcap", transforms=False)
    panel = json.loads(with_tracks(path, "lidar")["tracking"])["configById"]["3D!ground"]
    assert panel["followTf"] == "lidar"
    x, y, z = panel["cameraState"]["targetOffset"]
    assert abs(x - EAST) < 100
    assert abs(y - NORTH) < 20
    assert z == pytest.approx(GROUND, abs=0.06)


def test_people_on_the_ground_plane_keep_their_frame(tmp_path):
    path = recorded(tmp_path / "drive.mcap")
    frames = [Frame(ns(1000 + n), n, tracks_at({1: (1.0, 2.0)})) for n in range(3)]
    with log.read(path) as opened:
        made = {"/camera/tracks": Made.of(TRACKS, frames, Provenance("track", {}))}
        write_with_views(opened, "/camera", made)
    with log.read(path) as opened:
        (added,) = (FrameTransform.FromString(m.payload) for m in opened.messages("/camera/view/tf"))
        assert added.child_frame_id == "camera/ground"
        scene = SceneUpdate.FromString(next(iter(opened.messages("/camera/tracks/view/scene"))).payload)
        assert {entity.frame_id for entity in scene.entities} == {"camera/ground"}
