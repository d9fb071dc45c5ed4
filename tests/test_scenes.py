"""Drawings on the ground: scenes that are complete after each seek, in metres, and layouts that show them."""

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
from mcaptrack.foxglove.views import Drawing, ground, layouts
from mcaptrack.foxglove.views.layouts import CameraChannels, make
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.pipeline.write import Made
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import Provenance
from tests.commands import printed
from tests.logs import write_with_views
from tests.worlds import FORECAST, PICTURES, PLANE, ns, tracks_at

M = 1 / 128 + 1e-9
WALK = [Frame(int(t), n, tracks_at({2: (0.1 * n, 1.0), 30: (5.0, 0.2 * n)})) for n, t in enumerate(PICTURES)]


def scenes(topic, schema, frames, times=PICTURES, planes=PLANE) -> list[SceneUpdate]:
    out = []
    for (t_ns, index, payload), wanted in zip(
        Drawing(topic, schema, frames, planes).on_ground(times, "c/ground"), times, strict=True
    ):
        message = SceneUpdate.FromString(payload)
        assert t_ns == wanted == times[index]
        (deletion,) = message.deletions
        assert deletion.type == 1  # all
        for part in (deletion, *message.entities):
            assert part.timestamp.ToNanoseconds() == wanted
        assert {entity.frame_id for entity in message.entities} <= {"c/ground"}
        assert len({entity.id for entity in message.entities}) == len(message.entities)
        out.append(message)
    return out


def test_every_scene_is_whole():
    """A seek delivers only the last message: it has all people and their trails."""
    for number, message in enumerate(scenes("/c/retracks/full", TRACKS, WALK)):
        assert [entity.id for entity in message.entities] == ["2", "30"]
        for entity, wanted in zip(message.entities, [(0.1 * number, 1.0), (5.0, 0.2 * number)], strict=True):
            (body,), (name,) = entity.cylinders, entity.texts
            assert (body.pose.position.x, body.pose.position.y) == pytest.approx(wanted, abs=M)
            assert name.text == entity.id
            assert entity.lifetime.ToNanoseconds() == pytest.approx(1.5e9 / 7, rel=1e-6)
            (red, green, blue, _) = foxglove.colour(int(entity.id))
            assert (body.color.r, body.color.g, body.color.b) == (red, green, blue)
        if number > 8:
            for entity in message.entities:
                (trail,) = entity.lines
                last = trail.points[-1]
                body = entity.cylinders[0].pose.position
                assert (last.x, last.y) == (body.x, body.y)
                assert len(trail.colors) == len(trail.points)
                opacity = [colour.a for colour in trail.colors]
                assert opacity == sorted(opacity)


@pytest.mark.parametrize(("topic", "sign"), [("/c/retracks/full", 1), ("/c/tracks", -1), ("/c/truth", 1)])
def test_labels_of_neighbours_stand_one_above_the_other_and_come_back_slowly(topic, sign):
    """3 and 5 stand 0.5 m apart, 9 elsewhere; after the tenth scene 5 is 3 m away. There are 7 scenes a second."""
    frames = [
        Frame(int(t), n, tracks_at({3: (1.0, 1.0), 5: (1.5 if n < 10 else 4.0, 1.0), 9: (8.0, 1.0)}))
        for n, t in enumerate(PICTURES)
    ]
    found = [
        {entity.id: entity.texts[0].pose.position.z for entity in one.entities} for one in scenes(topic, TRACKS, frames)
    ]
    usual = found[0]["9"]
    assert {one["9"] for one in found} == {one["3"] for one in found} == {usual}
    own = np.array([sign * (one["5"] - usual) for one in found])
    assert own[:13] == pytest.approx(1.2, abs=M)  # until half a second later
    assert (np.diff(own[12:]) <= 0).all()
    assert 0.2 < -np.diff(own[12:]).min() < 0.5
    assert own[17:] == pytest.approx(0, abs=M)


def test_interpolated_positions_are_fainter_and_unknown_ones_left_out():
    frames = [Frame(int(t), n, tracks_at({2: (1.0, 1.0)}, observed=n != 3)) for n, t in enumerate(PICTURES[:6])]
    alpha = [m.entities[0].cylinders[0].color.a for m in scenes("/c/tracks", TRACKS, frames)[:6]]
    assert alpha[3] < 0.5 * alpha[2]
    nowhere = tracks_at({2: (np.nan, np.nan), 3: (1.0, 1.0)})
    message = scenes("/c/tracks", TRACKS, [Frame(0, 0, nowhere)])[0]
    assert [entity.id for entity in message.entities] == ["3"]


def test_kinds_of_tracks_differ():
    shapes, heights = set(), []
    for name in ("tracks", "retracks/full", "truth"):
        entity = scenes(f"/c/{name}", TRACKS, WALK)[10].entities[0]
        heights.append(entity.texts[0].pose.position.z)
        shapes.add((entity.cylinders[0].size.x, entity.cylinders[0].size.z, entity.lines[0].type))
    assert len(shapes) == 3
    assert min(np.diff(heights)) > 2.5  # numbers of one person stand one above the other and can all be read
    white = scenes("/c/truth", TRACKS, WALK)[10].entities[0].cylinders[0].color
    assert (white.r, white.g, white.b) == (1, 1, 1)


def test_forecasts_end_in_ellipses_that_hold_half():
    rows = FORECAST.copy()
    turn = np.radians(30)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    spread = rotation @ np.diag([4.0, 1.0]) @ rotation.T
    rows["cov_xx_m2"], rows["cov_xy_m2"], rows["cov_yy_m2"] = spread[0, 0], spread[0, 1], spread[1, 1]
    found = scenes("/c/predictions", PREDICTIONS, [Frame(ns(0.4), 1, rows)])
    assert not found[2].entities  # not made yet
    assert not found[12].entities  # a second old
    (entity,) = found[3].entities
    (disc,), (line,) = entity.cylinders, entity.lines
    assert [(p.x, p.y) for p in line.points] == [(1, 3), (2, 4)]
    assert (disc.pose.position.x, disc.pose.position.y) == (2, 4)
    assert disc.size.x == pytest.approx(2 * np.sqrt(2 * np.log(2) * 4), abs=M)
    assert disc.size.y == pytest.approx(2 * np.sqrt(2 * np.log(2)), abs=M)
    where = disc.pose.orientation
    assert (where.x, where.y) == (0, 0)
    assert 2 * np.arctan2(where.z, where.w) == pytest.approx(turn, abs=1e-3)
    assert where.z**2 + where.w**2 == pytest.approx(1, abs=1e-3)
    unsure = FORECAST.copy()
    unsure["cov_xx_m2"] = np.nan
    (entity,) = scenes("/c/predictions", PREDICTIONS, [Frame(ns(0.4), 1, unsure)])[3].entities
    assert not entity.cylinders
    assert entity.lines


class TestTheOutline:
    def test_of_a_plane_without_a_horizon_is_the_picture(self):
        found = ground.outline(GroundPlane((0.1, 0, -5, 0, -0.1, 7, 0, 0, 1), 100, 80))
        assert {(round(x, 6), round(y, 6)) for x, y in found} == {(-5, 7), (5, 7), (5, -1), (-5, -1)}

    def test_ends_before_the_horizon(self):
        """A camera 4 m up that looks at the horizon, whose row is in the middle of the picture, by similar triangles."""
        focal, width, height, up = 500.0, 640, 480, 4.0
        matrix = (
            up,
            0,
            -up * width / 2,
            0,
            0,
            up * focal,
            0,
            1,
            -height / 2,
        )  # x = up (u - cx) / (v - cy), y = up f / (v - cy)
        plane = GroundPlane(matrix, width, height)
        found = ground.outline(plane)
        assert np.isfinite(found).all()
        nearest, farthest = up * focal / (height / 2), 20 * up * focal / (height / 2)
        assert found[:, 1].min() == pytest.approx(nearest)
        assert found[:, 1].max() == pytest.approx(farthest)
        left_near = up * (0 - width / 2) / (height / 2)
        assert found[:, 0].min() == pytest.approx(20 * left_near)
        assert len(found) == 4

    def test_is_a_scene_that_stays(self):
        later = GroundPlane((0.2, 0, 0, 0, 0.2, 0, 0, 0, 1), 640, 480)
        found = list(ground.outlines([*PLANE, (ns(1.0), later)], 0, "c/ground"))
        assert [t_ns for t_ns, _, _ in found] == [0, ns(1.0)]
        for (_, _, payload), corner in zip(found, (64, 128), strict=True):
            (entity,) = SceneUpdate.FromString(payload).entities
            assert entity.lifetime.ToNanoseconds() == 0
            assert max(point.x for point in entity.lines[0].points) == corner


def leaves(node):
    return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])


def topics_in(layout) -> set[str]:
    found = set()
    for config in layout["configById"].values():
        image = config.get("imageMode", {})
        found |= {image["imageTopic"], *image["annotations"]} if image else set()
        found |= set(config.get("topics", ())) | set(config.get("syncedTopics", ()))
        found |= {path["value"].partition(".rows")[0] for path in config.get("paths", ())}
        found |= {config["topicToRender"]} if "topicToRender" in config else set()
    return found


EYE = layouts.eye_on(np.array([[0.0, 0], [10, 10]]), PLANE, 0)
#: Names of channels of a log, with the kinds of their views behind a colon.
NAMES = [
    "tracks:image",
    "tracks:scene",
    "truth:scene tracks:scene ground_plane/view/scene",
    "detections:image",
    "predictions:scene samples",
    "predictions:scene predictions/scores samples tracks/events/view/log",
    "retracks/predictions:image retracks/predictions/scores retracks/full",
    "tracks:image tracks/counts tracks/events tracks/events/view/log retracks:image",
    "",
]


@pytest.mark.parametrize("text", NAMES)
@pytest.mark.parametrize("pictures", ["/c/video", None])
def test_layouts_name_only_what_there_is(text, pictures):
    parts = [part.partition(":") for part in text.split()]
    names = {name for name, *_ in parts} | {f"{name}/view/{kind}" for name, _, kind in parts if kind}
    if pictures is None:
        names = {name for name in names if not name.endswith("/view/image")}
    made = make(CameraChannels("/c", frozenset(names), pictures, "c/ground", EYE))
    assert bool(made) == any(name.endswith(("/view/image", "/view/scene")) for name in names)
    for content in made.values():
        layout = json.loads(content)
        assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])
        assert topics_in(layout) <= {f"/c/{name}" for name in names} | {pictures}


def test_a_log_line_is_what_the_generated_class_reads():
    message = foxglove.unpack(foxglove.LOG, foxglove.pack_log(5_000_000_001, "WARNING", "tracks", "two swapped"))
    assert (message.level, message.name, message.message) == (3, "tracks", "two swapped")
    assert message.timestamp.ToNanoseconds() == 5_000_000_001


def test_the_eye_looks_where_the_camera_looks():
    for turned, bearing in ((0, 0), (90, -90), (180, 180), (-90, 90)):
        cosine, sine = np.cos(np.radians(turned)), np.sin(np.radians(turned))
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        matrix = turn @ np.array([[0.1, 0, 0], [0, -0.1, 0], [0, 0, 1]])  # up in the picture is ahead
        eye = layouts.eye_on(np.array([[0.0, 0], [4, 2]]), [(0, GroundPlane(tuple(matrix.ravel()), 64, 48))], 0)
        assert np.cos(np.radians(eye.bearing_deg - bearing)) == pytest.approx(1)
        assert (eye.x_m, eye.y_m) == (2, 1)


class TestAFinishedLog:
    def test_has_a_scene_for_every_picture(self, finished):
        with log.read(finished) as opened:
            pictures = opened.times("/camera/video").tolist()
            views = {topic for topic in opened.channels if topic.endswith("/view/scene")}
            names = ("tracks", "truth", "predictions", "retracks/full", "retracks/predictions", "ground_plane")
            assert views == {f"/camera/{name}/view/scene" for name in names}
            for topic in views - {"/camera/ground_plane/view/scene"}:
                assert opened.times(topic).tolist() == pictures
                for message in opened.messages(topic):
                    scene = SceneUpdate.FromString(message.payload)
                    stamps = {part.timestamp.ToNanoseconds() for part in (*scene.deletions, *scene.entities)}
                    assert stamps == {message.t_ns}
            (frame,) = opened.messages("/camera/view/tf")
            transform = FrameTransform.FromString(frame.payload)
            assert (frame.t_ns, transform.timestamp.ToNanoseconds()) == (pictures[0], pictures[0])
            assert transform.child_frame_id == "camera/ground"
            assert transform.parent_frame_id != transform.child_frame_id
            assert transform.rotation.w == 1

    def test_has_three_layouts_of_what_is_in_it(self, finished):
        with log.read(finished) as opened:
            there = set(opened.channels)
            for end in (".layout.json", ".comparing.layout.json", ".predictions.layout.json"):
                attached = opened.attachment("mcaptrack" + end)
                assert attached == finished.with_suffix(end).read_bytes()
                layout = json.loads(attached)
                assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])
                assert topics_in(layout) <= there
                kinds = {name.partition("!")[0] for name in layout["configById"]}
                assert {"Image", "3D", "Plot"} <= kinds


def test_a_stage_that_is_run_again_replaces_its_views(finished, tmp_path):
    """In place and more than once: what is read of a log is read before its end is written anew."""
    path = tmp_path / "walk.mcap"
    path.write_bytes(finished.read_bytes())
    for stage in ("retrack", "track", "run"):
        printed(stage, path)
    printed("check", path)
    with log.read(path) as opened, log.read(finished) as before:
        assert set(opened.channels) == set(before.channels)
        for topic in before.channels:
            assert [m.payload for m in opened.messages(topic)] == [m.payload for m in before.messages(topic)], topic


# 3D boxes in scenes: where they are, which way they head, whose colours they have, and in which coordinate frame


#: Far from the origin of the map, and high above it, as on maps of cities.
EAST, NORTH, GROUND = 5214.0, 2393.5, 68.75
CLASS_NAMES = {1: "pedestrian", 2: "bicycle", 3: "car", 9: "wheelbarrow"}
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


def drawn_scenes(topic: str = "/lidar/retracks/full", frames: list[Frame] | None = None) -> list[SceneUpdate]:
    frames = traffic() if frames is None else frames
    t_ns = np.array([frame.t_ns for frame in frames])
    drawing = Drawing(topic, TRACKS, frames, (), classes=CLASS_NAMES)
    return [SceneUpdate.FromString(payload) for _, _, payload in drawing.on_ground(t_ns, "map")]


def by_id(scene: SceneUpdate):
    return {int(entity.id.split()[0]): entity for entity in scene.entities}


def test_cubes_are_where_the_rows_say():
    for tick, scene in enumerate(drawn_scenes()):
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
    found = by_id(drawn_scenes()[25])
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
    for track, entity in by_id(drawn_scenes()[0]).items():
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
        entity = by_id(drawn_scenes(f"/lidar/{name}")[10])[CAR]
        middle, high = entity.cubes[0].pose.position.z - GROUND, entity.cubes[0].size.z
        spans[name] = (middle - high / 2, middle + high / 2)
        numbers.append(entity.texts[0].pose.position.z)
    assert spans["retracks/full"] == pytest.approx((0, 1.5), abs=M)
    assert max(map(abs, spans["tracks"])) < 0.1
    assert np.abs(np.array(spans["truth"]) - 1.5).max() < 0.1
    assert min(np.diff(sorted(numbers))) > 1.5


def test_boxes_that_are_not_observed_are_fainter():
    seen, unseen = (
        by_id(drawn_scenes(frames=traffic(observed))[3])[CAR].cubes[0].color.a for observed in (True, False)
    )
    assert unseen < 0.5 * seen < 0.5


def test_rows_without_a_box_are_drawn_as_people():
    frames = traffic()
    frames[0].rows["height_m"][1] = np.nan
    found = by_id(drawn_scenes(frames=frames)[0])
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
        names = {str(number): name for number, name in CLASS_NAMES.items()}
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
