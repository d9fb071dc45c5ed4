"""The rendered video: the drawings of views, in their places and colours."""

from __future__ import annotations

import json
import os
import tempfile
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation

import mcaptrack
from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.render import video
from mcaptrack.extensions.render.legend import with_legend
from mcaptrack.extensions.render.video import RenderOptions, render
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import write_clip
from mcaptrack.viewing import from_above
from mcaptrack.viewing.from_above import Sight
from mcaptrack.viewing.painting import draw, message_at
from tests.commands import call, done, printed
from tests.logs import recorder
from tests.robot_runs import passing_robot, place, write_passing
from tests.robots import write_log
from tests.test_pictures import COUNT, TOPIC, X264
from tests.tiers import thorough
from tests.worlds import write_clip as drawn_clip

GREY = np.full((100, 200, 3), 100, np.uint8)


def annotations(boxes=(), ids=None, strips=(), thickness=2.0):
    """A message with boxes (left, top, width, height), their numbers, and lines of fading points."""
    message = ImageAnnotations()
    for number, (x, y, w, h) in enumerate(boxes):
        part = message.points.add(type=2, thickness=thickness)
        paint(part.outline_color, foxglove.colour(ids[number] if ids else 0))
        for corner in ((x, y), (x + w, y), (x + w, y + h), (x, y + h)):
            part.points.add(x=corner[0], y=corner[1])
        if ids:
            text = message.texts.add(text=str(ids[number]), font_size=12)
            text.position.x, text.position.y = x, y
            paint(text.background_color, foxglove.colour(ids[number]))
    for points, opacity in strips:
        part = message.points.add(type=3, thickness=thickness)
        for point, alpha in zip(points, opacity, strict=True):
            part.points.add(x=point[0], y=point[1])
            paint(part.outline_colors.add(), (*foxglove.colour(0)[:3], alpha))
    return message


def paint(target, rgba):
    target.r, target.g, target.b, target.a = rgba


def clip(path: Path) -> list[tuple[float, np.ndarray]]:
    with av.open(str(path)) as container:
        return [(float(f.pts * f.time_base), f.to_ndarray(format="bgr24")) for f in container.decode(video=0)]


def test_a_box_is_drawn_on_its_edges_in_the_colour_of_its_identity_and_nowhere_else():
    image = draw(GREY, annotations([[20, 30, 60, 40]], [3]))
    red, green, blue, _ = foxglove.colour(3)
    wanted = np.array([blue, green, red]) * 255
    for x, y in ((50, 70), (80, 50), (20, 55)):
        assert abs(image[y, x] - wanted).max() <= 2
    assert (image[35:65, 45:75] == 100).all()  # inside, right of the id
    assert (image[75:, :] == 100).all()
    assert (image[:, 90:] == 100).all()
    assert not np.array_equal(image[20:30, 20:28], GREY[20:30, 20:28])  # the id, above its corner
    assert (GREY == 100).all()


def test_lines_fade_as_their_points_say():
    image = draw(GREY, annotations(strips=[([(10, 50), (60, 50), (110, 50)], [0.0, 0.2, 0.8])])).astype(float)
    red, green, blue, _ = foxglove.colour(0)
    wanted = np.array([blue, green, red]) * 255
    assert abs(image[50, 35] - (0.2 * wanted + 0.8 * 100)).max() <= 2
    assert abs(image[50, 85] - (0.8 * wanted + 0.2 * 100)).max() <= 2


def test_lines_of_a_list_are_drawn_one_by_one_and_leave_gaps():
    message = ImageAnnotations()
    part = message.points.add(type=4, thickness=2)
    for x in (20, 60, 100, 140):
        part.points.add(x=x, y=50)
    for alpha in (1.0, 0.5):
        paint(part.outline_colors.add(), (1.0, 0.0, 0.0, alpha))
    image = draw(GREY, message)
    assert abs(image[50, 40].astype(int) - [0, 0, 255]).max() <= 2
    assert abs(image[50, 120].astype(int) - [50, 50, 178]).max() <= 3
    assert (image[:, 66:94] == 100).all()


def test_what_is_inside_of_a_filled_line_shows_through_and_lines_of_others_stay():
    message = annotations([[20, 20, 60, 60], [40, 40, 100, 50]])
    for part in message.points:
        paint(part.fill_color, (0.0, 0.0, 1.0, 0.25))
    image = draw(GREY, message).astype(int)
    once, twice = 100 * 0.75 + 255 * 0.25, (100 * 0.75 + 255 * 0.25) * 0.75 + 255 * 0.25
    assert abs(image[30, 30, 0] - once) <= 1
    assert abs(image[60, 60, 0] - twice) <= 1
    outline = np.array(foxglove.colour(0)[2::-1]) * 255
    assert abs(image[60, 80] - outline).max() <= 2  # of the first, inside the second
    assert (image[5, :] == 100).all()


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_clip_keeps_the_times_and_colours_of_its_pictures(tmp_path, suffix):
    times = [5_000_000_000, 5_100_000_000, 5_300_000_000, 5_400_000_000]
    shades = [(200, 30, 30), (30, 200, 30), (30, 30, 200), (120, 120, 120)]
    images = [np.full((64, 96, 3), shade, np.uint8) for shade in shades]
    path = tmp_path / f"a{suffix}"
    assert write_clip(path, zip(times, images, strict=True), Fraction(10)) == 4
    found = clip(path)
    assert [t for t, _ in found] == pytest.approx([0, 0.1, 0.3, 0.4], abs=0.011)
    for (_, image), shade in zip(found, shades, strict=True):
        assert abs(image.astype(int).mean(axis=(0, 1)) - shade).max() < 8


def test_a_log_becomes_a_video_of_its_pictures(finished, tmp_path):
    out, _ = printed("render", finished, "-o", tmp_path / "all.mp4", "--json")
    (result,) = json.loads(out)["results"]
    assert result["views"] == ["/camera/retracks/full/view/image", "/camera/retracks/predictions/view/image"]
    found = clip(tmp_path / "all.mp4")
    assert len(found) == result["pictures"]
    words = ("--topic", "/camera/truth", "--width", 160, "--gif", "--end-s", 1.05, "--force", "-o", tmp_path / "a.gif")
    printed("render", finished, *words)
    small = clip(tmp_path / "a.gif")
    assert [t for t, _ in small] == pytest.approx(np.arange(len(small)) / 10, abs=0.06)
    assert 9 <= len(small) <= 11
    assert small[0][1].shape[1] == 160


MISTAKES = {
    "another suffix": (["-o", "a.avi"], "a video is rendered to .mp4 or .gif, not to .avi"),
    "no such view": (["--topic", "/camera/none"], "has no channel /camera/none/view/image"),
    "no such second": (["--start-s", "5000"], "has no picture between 5000 s and the end; the pictures are from 0 to "),
    "a width of nothing": (["--width", "0"], "--width has to be from 16 to 16384, not 0"),
}


@pytest.mark.parametrize("words", MISTAKES.values(), ids=MISTAKES)
def test_mistakes_are_said_in_a_line(finished, tmp_path, words):
    code, out, err = call(
        "render", finished, *(["-o", "b.mp4"] if "-o" not in words[0] else []), *words[0], folder=tmp_path
    )
    assert (code, out) == (1, "")
    assert words[1] in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_log_without_views_says_what_makes_them(footage, tmp_path):
    path = tmp_path / "a.mcap"
    printed("ingest", footage.video, "-o", path)
    code, _, err = call("render", path)
    assert (code, "has no views of /camera yet; `mcaptrack run" in err) == (1, True)
    printed("ingest", footage.ground_truth, "--as", "truth", "--fps", 10, "-o", tmp_path / "labels.mcap")
    code, _, err = call("render", tmp_path / "labels.mcap")
    assert (code, "has no pictures of /camera to draw on" in err) == (1, True)


def scene_of(*cubes) -> SceneUpdate:
    """Cubes of (centre, quaternion, size, colour)."""
    scene = SceneUpdate()
    for number, (centre, turn, size, colour) in enumerate(cubes):
        cube = scene.entities.add(id=str(number), frame_id="map").cubes.add()
        for axis, value in zip("xyz", centre, strict=True):
            setattr(cube.pose.position, axis, value)
        for axis, value in zip("xyzw", turn, strict=True):
            setattr(cube.pose.orientation, axis, value)
        for axis, value in zip("xyz", size, strict=True):
            setattr(cube.size, axis, value)
        paint(cube.color, colour)
    return scene


def test_cubes_from_above_have_the_corners_of_scipy_with_north_up():
    sight = Sight(100.0, 50.0, 8.0, 640, 480)
    turn = Rotation.from_euler("zyx", [0.7, 0.2, -0.1])
    scene = scene_of(((103.0, 54.0, 9.0), turn.as_quat() * 2, (4.0, 2.0, 1.5), (0.0, 1.0, 0.0, 1.0)))
    (part,) = from_above.drawing(scene, sight).points
    wanted = turn.apply([[x, y, 0.0] for x, y in ((-2, -1), (2, -1), (2, 1), (-2, 1))]) + [103.0, 54.0, 9.0]
    found = np.array([(point.x, point.y) for point in part.points])
    np.testing.assert_allclose(found[:, 0], 320 + 8 * (wanted[:, 0] - 100), atol=1e-9)
    np.testing.assert_allclose(found[:, 1], 240 - 8 * (wanted[:, 1] - 50), atol=1e-9)
    image = draw(from_above.ground(sight), from_above.drawing(scene, sight))
    x, y = 320 + 8 * 3, 240 - 8 * 4
    assert image[y, x].tolist() == [0, 255, 0]
    assert image[y + 2 * (240 - y), x].tolist() == image[0, 0].tolist()  # not mirrored


@pytest.mark.parametrize(("px_per_m", "step"), [(96.0, 1), (40.0, 5), (12.0, 10), (0.9, 200)])
def test_the_grid_has_round_steps_at_their_multiples(px_per_m, step):
    sight = Sight(103.0, 57.0, px_per_m, 960, 720)
    found = from_above.grid(sight)
    assert [text.text for text in found.texts] == [f"{step} m"]
    *lines, bar = (np.array([(point.x, point.y) for point in part.points]) for part in found.points)
    assert bar[1, 0] - bar[0, 0] == pytest.approx(step * px_per_m)
    east = [(ends[0, 0] - 480) / px_per_m + 103.0 for ends in lines if ends[0, 0] == ends[1, 0]]
    north = [57.0 - (ends[0, 1] - 360) / px_per_m for ends in lines if ends[0, 1] == ends[1, 1]]
    assert len(east) + len(north) == len(lines) > 2
    np.testing.assert_allclose(np.array(east + north) / step, np.rint(np.array(east + north) / step), atol=1e-9)
    np.testing.assert_allclose(np.diff(east), step)


def test_a_legend_says_what_is_drawn_where_it_can_be_read():
    picture = np.full((90, 480, 3), 100, np.uint8)

    def strip(*names: str) -> np.ndarray:
        image = with_legend(picture, [f"/c/{name}/view/image" for name in names])
        assert (image[:90] == picture).all()
        assert len(image) % 2 == 0
        return image[90:].astype(int)

    whole, dashed, more = strip("retracks/full"), strip("tracks"), strip("retracks/full", "retracks/predictions")
    blue, green, red = (np.array(foxglove.colour(1)[2::-1]) * 255).tolist()
    painted = [(np.abs(image[:, :40] - [blue, green, red]).max(axis=2) < 30).sum() for image in (whole, dashed)]
    assert painted[0] > 1.3 * painted[1] > 0
    ends = [np.flatnonzero((image > 60).any(axis=(0, 2))).max() for image in (whole, more)]
    assert ends[1] > ends[0] + 50
    assert not len(strip("tracks/events"))  # a finisher has this name
    assert with_legend(picture[:, :200], ["/c/tracks/view/image"]).shape == (90, 200, 3)


def test_scenes_are_shown_until_the_next_is_due_and_drawings_only_on_their_picture():
    for held, shown in ((0, [None, "a", None, None, "b", None]), (5, [None, "a", "a", None, "b", "b"])):
        at = message_at(iter([(10, b"a"), (30, b"b")]), bytes.decode, held)
        assert [at(t_ns) for t_ns in (9, 10, 15, 16, 30, 35)] == shown


def test_nothing_is_left_of_a_clip_that_fails(tmp_path):
    def broken():
        yield 0, np.zeros((64, 64, 3), np.uint8)
        raise McaptrackError("half way")

    for suffix in (".mp4", ".gif"):
        with pytest.raises(McaptrackError, match="half way"):
            write_clip(tmp_path / f"a{suffix}", broken(), Fraction(10))
    assert not list(tmp_path.iterdir())


@thorough
def test_a_log_with_pictures_that_cannot_be_decoded_is_processed_and_drawn_without_them(tmp_path):
    whole, path, output = tmp_path / "whole.mcap", tmp_path / "eye.mcap", tmp_path / "eye.mp4"
    write_log(whole, "/eye/image")
    with whole.open("rb") as source, recorder(path, "ros2") as writer:
        for number, (schema, channel, message) in enumerate(make_reader(source).iter_messages()):
            if number == 0:
                channel_id = writer.add_channel(
                    channel.topic, (schema.name, schema.encoding, schema.data), channel.message_encoding
                )
            data = message.data[:60] + b"\x55" * (len(message.data) - 60) if number in (7, 20) else message.data
            writer.add_message(channel_id, message.log_time, data, message.publish_time)
    left_out = "2 of 50 pictures"
    assert f"{left_out} can't be decoded and are left out, the first: " in call("run", str(path), "--no-tables").err
    with log.read(path) as opened:
        assert opened.channel("/eye/detections").messages == 48
    assert f"{left_out} of /eye/image can't be decoded and are left out" in call("render", str(path)).err
    assert len(clip(output)) == 48
    heat_map = call("render", str(path), "--heatmap", "-o", str(tmp_path / "heat.png"))
    assert (heat_map.code, " pictures of /eye/image can't be decoded" in heat_map.err) == (0, True)


def test_a_video_of_which_no_picture_can_be_decoded_is_named(template, tmp_path):
    path = tmp_path / "late.mcap"
    with log.read(template) as opened, log.create(path) as writer:
        schema = foxglove.record_in(foxglove.VIDEO, "protobuf")
        number = writer.add_channel("/eye", schema, "protobuf", {})
        for message in [*opened.messages("/camera/video")][1:4]:  # without its first picture, on which others depend
            writer.add_message(number, message.t_ns, message.sequence, message.payload)
    with (
        log.read(path) as opened,
        pytest.raises(McaptrackError, match="no picture of /eye in this time can be decoded"),
    ):
        render(opened, "/eye", (), tmp_path / "a.gif", RenderOptions())
    assert list(tmp_path.iterdir()) == [path]


@thorough
def test_the_video_of_a_log_in_a_store_is_written_here(store, template):
    done("render", store.put("night/a.mcap", template))
    assert (os.listdir(), store.names()) == (["a.mp4"], ["night/a.mcap"])


def test_views_that_a_log_lacks_are_drawn_and_the_log_stays_as_it_is(template, tmp_path, monkeypatch):
    path = tmp_path / ("a" * 250 + ".mcap")
    mcaptrack.drop(template, "*/view/*", output=path)
    content = path.read_bytes()
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    mcaptrack.render(path, tmp_path / "a.gif", width=64, end_s=0.2)
    assert (path.read_bytes(), [*(tmp_path / "temporary").iterdir()]) == (content, [])


# A late part of a video: as many pictures are decoded as it takes


def test_a_late_part_is_rendered_without_decoding_what_is_before_it(tmp_path, monkeypatch):
    drawn_clip(tmp_path / "a.mkv", frames=COUNT, options=X264)
    ingest(tmp_path / "a.mkv", tmp_path / "a.mcap", IngestOptions())
    used = []

    class Counted(Pictures):
        def __init__(self, *given):
            super().__init__(*given)
            used.append(self)

    monkeypatch.setattr(video, "Pictures", Counted)
    with log.read(tmp_path / "a.mcap") as opened:
        options = RenderOptions(start_s=4.4, end_s=4.95)
        assert render(opened, TOPIC, (), tmp_path / "late.mp4", options) == 6
        assert used[-1].decoded == 10  # 40 to 49: the key picture, and four that are not shown
        assert render(opened, TOPIC, (), tmp_path / "all.mp4", RenderOptions()) == COUNT
        assert used[-1].decoded == COUNT
        thin = RenderOptions(max_fps=1.0)
        assert render(opened, TOPIC, (), tmp_path / "thin.mp4", thin) == 6
        assert used[-1].decoded == 6
    with av.open(str(tmp_path / "late.mp4")) as late, av.open(str(tmp_path / "all.mp4")) as whole:
        wanted = [frame.to_ndarray(format="gray") for frame in whole.decode(video=0)][44:50]
        found = [frame.to_ndarray(format="gray") for frame in late.decode(video=0)]
    assert len(found) == 6
    for one, other in zip(found, wanted, strict=True):
        assert np.abs(one.astype(int) - other).mean() < 2


# Videos of a robot's log: from above, with all objects in their places


SHOTS = 20


@pytest.fixture(scope="module")
def passed(tmp_path_factory) -> Path:
    """A log of a robot after ``run``."""
    path, _ = write_passing(tmp_path_factory.mktemp("robot"), shots=SHOTS)
    mcaptrack.run(path, sidecar=False, tables=False)
    return path


def test_a_video_from_above_follows_the_robot_and_has_all_objects_in_their_places(passed, tmp_path):
    result = mcaptrack.render(passed, tmp_path / "a.mp4", start_s=1.15, end_s=1.35)
    assert result.views == ("/lidar/retracks/full/view/scene", "/lidar/retracks/predictions/view/scene")
    with log.read(passed) as opened:
        t_ns = opened.times(result.views[0])[12:14]
    with av.open(str(tmp_path / "a.mp4")) as container:
        frames = [frame.to_ndarray(format="bgr24").astype(int) for frame in container.decode(video=0)]
    assert len(frames) == len(t_ns) == result.pictures
    robot = passing_robot(SHOTS)
    start_ns = robot.shots[0].stamp_ns
    image, at_ns = frames[0], int(t_ns[0])
    base = [np.interp(at_ns, robot.stamps.astype(float), robot.place[:, axis]) for axis in (0, 1)]
    assert image.shape[0] > 720  # a legend below
    assert image.shape[1:] == (960, 3)
    assert image[360, 480].min() > 180  # the robot is in the middle, in white
    x, y = (place(3, at_ns, start_ns)[:2] - base) * 12 * [1, -1] + [480, 360]
    near = image[round(y) + 3 : round(y) + 6, round(x) - 12 : round(x) - 2].reshape(-1, 3)  # beside the label
    with mcaptrack.open(passed) as opened:
        rows = opened.array("tracks", "/lidar/retracks/full")
    now = rows[rows["t_ns"] == at_ns]
    nearest = np.hypot(now["x_m"] - place(3, at_ns, start_ns)[0], now["y_m"] - place(3, at_ns, start_ns)[1]).argmin()
    wanted = np.array(foxglove.colour(int(now["track_id"][nearest]))[2::-1]) * 255
    paint = near - [32, 28, 26]
    share = (paint * (wanted - [32, 28, 26])).sum(axis=1) / np.sum((wanted - [32, 28, 26]) ** 2)
    assert np.median(share) == pytest.approx(0.625, abs=0.12)
    away = image[round(720 - y), round(960 - x)]
    assert np.abs(away - [32, 28, 26]).max() < 40


def test_without_a_robot_all_places_are_in_the_video(tmp_path):
    rows = [f"{n * 100_000_000},{k},{100 + 300 * k + n},{50 - 20 * k},0.5,4,2,1.5,0" for n in range(16) for k in (1, 2)]
    (tmp_path / "truth.csv").write_text("\n".join(["t_ns,id,x_m,y_m,z_m,length_m,width_m,height_m,heading_rad", *rows]))
    path = tmp_path / "a.mcap"
    mcaptrack.ingest(tmp_path / "truth.csv", output=path, role="tracks", frame="map")
    mcaptrack.run(path, tables=False, events=False)
    result = mcaptrack.render(path, tmp_path / "a.gif", topic="/camera/tracks", width=320)
    assert (result.pictures, result.views) == (16, ("/camera/tracks/view/scene",))
    with av.open(str(tmp_path / "a.gif")) as container:
        image = next(container.decode(video=0)).to_ndarray(format="bgr24").astype(int)
    bright = np.argwhere(image[:240].max(axis=2) > 120)[:, 1]
    assert image.shape[0] > 240  # a legend below
    assert image.shape[1:] == (320, 3)
    assert (bright < 60).any()
    assert (bright > 260).any()
