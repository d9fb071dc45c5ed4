"""Drawings on the ground: scenes that are complete after each seek, in metres, and layouts that show them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from mcaptrack import foxglove, log
from mcaptrack.foxglove.views import Drawing, ground, layouts
from mcaptrack.foxglove.views.layouts import CameraChannels, make
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from tests.commands import printed
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
