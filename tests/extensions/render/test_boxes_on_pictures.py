"""3D boxes and forecasts on the pictures of calibrated cameras that move, compared with OpenCV's projection."""

from __future__ import annotations

import json
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations

import mcaptrack
from mcaptrack import foxglove, log, notices
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.render.blur.people import outlines
from mcaptrack.foxglove.views import Drawing, MovingCamera
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.pinhole import Lens
from mcaptrack.pipeline.write import Made
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Rows
from mcaptrack.schema.provenance import Provenance
from tests.logs import write_with_views
from tests.worlds import ns

PX = 0.13  # coordinates are multiples of a quarter of a pixel
WIDTH, HEIGHT, FOCAL = 640, 480, 400.0
BENT = (-0.2, 0.05, 0.001, -0.002)
#: Axes of the camera in the world: it looks along the first axis, to the left is the second, up the third.
AHEAD = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], float)
#: The origin of the world, far from that of the map.
FAR = np.array([5000.0, 2000.0, 60.0])
PICTURES = 8
NAMES = {1: "person", 3: "car"}


def eye_at(number: int) -> Floats:
    """The position of the camera: it drives along the first axis, 1.5 m above the ground."""
    return FAR + [0.5 * number, 0.0, 1.5]


def camera(distortion: tuple[float, ...] = ()) -> MovingCamera:
    t_ns = np.array([ns(10 + number / 10) for number in range(PICTURES)])
    rotation = np.repeat(AHEAD[None], PICTURES, axis=0)
    translation = np.array([-AHEAD @ eye_at(number) for number in range(PICTURES)])
    lens = Lens((FOCAL, FOCAL), (WIDTH / 2, HEIGHT / 2), distortion)
    which = np.zeros(PICTURES, np.int64)
    return MovingCamera(t_ns + 7, t_ns + 3, t_ns, rotation, translation, [lens], which, WIDTH, HEIGHT)


def rows(*boxes: tuple[int, int, float, float, float]) -> Rows:
    """Boxes of 4 x 2 x 1.5 m: id, class, and the middle of the bottom relative to the world; each with a heading."""
    at = FAR + np.array([box[2:] for box in boxes])
    count = len(boxes)
    return TRACKS.rows(
        track_id=[box[0] for box in boxes], class_id=np.array([box[1] for box in boxes], np.uint32),
        x_m=at[:, 0], y_m=at[:, 1], z_m=at[:, 2] + 0.75, length_m=[4.0] * count, width_m=[2.0] * count,
        height_m=[1.5] * count, heading_rad=[0.5] * count, observed=np.ones(count, bool), source_id=[-1] * count,
    )  # fmt: skip


def corners(x: float, y: float, z: float) -> Floats:
    """The corners of such a box in the map, in any order."""
    turn = np.array([[np.cos(0.5), -np.sin(0.5), 0], [np.sin(0.5), np.cos(0.5), 0], [0, 0, 1]])
    local = np.array([[a, b, c] for a in (-2, 2) for b in (-1, 1) for c in (0, 1.5)]) @ turn.T
    return np.asarray(local + FAR + [x, y, z])


def by_opencv(points: Floats, number: int, distortion: tuple[float, ...] = ()) -> Floats:
    matrix = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    turn, _ = cv2.Rodrigues(AHEAD)
    shift = -AHEAD @ eye_at(number)
    given = np.array(distortion or (0.0, 0, 0, 0))
    return np.asarray(cv2.projectPoints(points, turn, shift, matrix, given)[0][:, 0])


def drawn(schema, frames: list[Frame], distortion: tuple[float, ...] = (), bodies=(), topic="/lidar/retracks/full"):
    seen = camera(distortion)
    found = list(Drawing(topic, schema, frames, (), classes=NAMES).on_camera(seen, bodies))
    messages = [ImageAnnotations.FromString(payload) for _, _, payload in found]
    assert [t_ns for t_ns, _, _ in found] == seen.t_ns.tolist()
    for message, stamp_ns in zip(messages, seen.stamp_ns.tolist(), strict=True):
        assert {part.timestamp.ToNanoseconds() for part in (message, *message.points, *message.texts)} == {stamp_ns}
        assert message.points
    return messages


def lines(message: ImageAnnotations) -> Floats:
    """The ends of all lines, (E, 2, 2)."""
    ends = [(p.x, p.y) for part in message.points if part.type == 4 for p in part.points]
    return np.array(ends, float).reshape(-1, 2, 2)


def still(*boxes) -> list[Frame]:
    return [Frame(ns(10 + number / 10), number, rows(*boxes)) for number in range(PICTURES)]


@pytest.mark.parametrize("distortion", [(), BENT], ids=["pinhole", "bent"])
def test_a_box_has_its_edges_where_opencv_projects_its_corners(distortion):
    for number, message in enumerate(drawn(TRACKS, still((7, 3, 14.0, 2.0, 0.0)), distortion)):
        found = lines(message)
        assert len(found) == 12
        wanted = by_opencv(corners(14.0, 2.0, 0.0), number, distortion)
        ends = np.unique(found.reshape(-1, 2), axis=0)
        gaps = np.abs(ends[:, None] - wanted).max(axis=2)
        assert gaps.min(axis=1).max() < PX
        assert gaps.min(axis=0).max() < PX  # all eight corners
        corner_of = gaps.argmin(axis=1)
        degree = np.bincount([corner_of[(ends == end).all(axis=1)][0] for line in found for end in line], minlength=8)
        assert degree.tolist() == [3] * 8
        (name,) = message.texts
        assert name.text == "7"
        shade = message.points[0].outline_colors[0]
        assert (shade.r, shade.g, shade.b) == foxglove.colour(7)[:3]


def test_boxes_move_between_their_times():
    """The rows are half as often as the pictures; the car drives 1 m between two pictures."""
    frames = [Frame(ns(10 + n / 10), n, rows((7, 3, 12.0 + n, 2.0, 0.0))) for n in range(0, PICTURES + 1, 2)]
    for number, message in enumerate(drawn(TRACKS, frames)):
        wanted = by_opencv(corners(12.0 + number, 2.0, 0.0), number)
        ends = lines(message).reshape(-1, 2)
        assert ends.min(axis=0) == pytest.approx(wanted.min(axis=0), abs=PX)
        assert ends.max(axis=0) == pytest.approx(wanted.max(axis=0), abs=PX)


def test_forecasts_stay_on_the_ground_while_the_camera_moves():
    steps = [12.0, 13.0, 14.0]
    names = ("track_id", "step", "ahead_s", "x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2")
    future = [(7, n + 1, 0.4 * (n + 1), FAR[0] + x, FAR[1] + 1.0, 0.04, 0.0, 0.01) for n, x in enumerate(steps)]
    frame = Frame(ns(10), 0, PREDICTIONS.rows(**dict(zip(names, zip(*future, strict=True), strict=True))))
    bodies = still((7, 3, 11.0, 1.0, 0.0))
    for number, message in enumerate(drawn(PREDICTIONS, [frame], bodies=bodies, topic="/lidar/predictions")):
        found = lines(message)
        path = by_opencv(FAR + np.array([(x, 1.0, 0.0) for x in steps]), number)
        assert found[:2, 0] == pytest.approx(path[:-1], abs=PX)
        assert found[:2, 1] == pytest.approx(path[1:], abs=PX)
        ring = found[2:, 0]
        around = FAR + [14.0, 1.0, 0.0] + 1.1774 * np.array([(0.2, 0, 0), (-0.2, 0, 0), (0, 0.1, 0)])
        far, near, left = by_opencv(around, number) - path[-1]
        offsets = ring - path[-1]
        assert offsets[:, 1].min() == pytest.approx(far[1], abs=0.3)
        assert offsets[:, 1].max() == pytest.approx(near[1], abs=0.3)
        assert offsets[:, 0].min() == pytest.approx(left[0], abs=1.0)


# In a log


def recorded(path: Path, calibrated: bool = True, scene: Floats | None = None) -> Path:
    """Pictures of a camera on a robot that drives, late by 20 ms, and another camera without calibration."""
    jpeg = cv2.imencode(".jpg", np.zeros((HEIGHT, WIDTH), np.uint8) if scene is None else scene)[1].tobytes()
    with log.create(path) as writer:

        def channel(topic: str, schema: str) -> int:
            return writer.add_channel(topic, foxglove.schema_record(schema), "protobuf", {})

        tf = channel("/tf", foxglove.TRANSFORM)
        front, back = (channel(f"/{name}/image", foxglove.IMAGE) for name in ("front", "back"))
        if calibrated:
            lens = channel("/front/info", "foxglove.CameraCalibration")
            k = [FOCAL, 0, WIDTH / 2, 0, FOCAL, HEIGHT / 2, 0, 0, 1]
            size = {"width": WIDTH, "height": HEIGHT}
            one = CameraCalibration(frame_id="front_optical", distortion_model="plumb_bob", K=k, D=[], **size)
            writer.add_message(lens, ns(10), 0, one.SerializeToString())
        for number in range(PICTURES):
            t_ns = ns(10 + number / 10)
            for parent, child, at, turn in (
                ("map", "base", eye_at(number), (0, 0, 0, 1)),
                ("base", "front_optical", np.zeros(3), (-0.5, 0.5, -0.5, 0.5)),
            ):
                moved = FrameTransform(parent_frame_id=parent, child_frame_id=child)
                moved.timestamp.FromNanoseconds(t_ns)
                moved.translation.x, moved.translation.y, moved.translation.z = at.tolist()
                moved.rotation.x, moved.rotation.y, moved.rotation.z, moved.rotation.w = turn
                writer.add_message(tf, t_ns, number, moved.SerializeToString())
            for pictures, frame_id in ((front, "front_optical"), (back, "back_optical")):
                picture = CompressedImage(frame_id=frame_id, format="jpeg", data=jpeg)
                picture.timestamp.FromNanoseconds(t_ns)
                writer.add_message(pictures, t_ns + ns(0.02), number, picture.SerializeToString())
    return path


def with_tracks(path: Path, frames: list[Frame] | None = None) -> tuple[dict[str, bytes], list[str]]:
    frames = frames or [Frame(ns(10 + n / 10), n, rows((7, 3, 14.0 + n, 2.0, 0.0))) for n in range(PICTURES)]
    made = {"/lidar/retracks": Made.of(TRACKS, frames, Provenance("retrack", {}, frame_id="map"))}
    with log.read(path) as opened, notices.listening(lambda _: None), notices.collected() as warned:
        layouts = write_with_views(opened, "/lidar", made)
    return layouts, [one.message for one in warned]


def test_tracks_are_drawn_on_each_calibrated_camera_of_a_log(tmp_path):
    path = recorded(tmp_path / "drive.mcap")
    layouts, said = with_tracks(path)
    assert [("/back/image" in one, "calibration" in one) for one in said] == [(True, True)]
    with log.read(path) as opened:
        views = [topic for topic in opened.channels if "/view/image" in topic]
        assert views == ["/lidar/retracks/view/image/front/image"]
        found = list(opened.messages(views[0]))
    assert [message.t_ns for message in found] == [ns(10.02 + n / 10) for n in range(PICTURES)]
    for number, one in enumerate(found):
        message = ImageAnnotations.FromString(one.payload)
        assert message.timestamp.ToNanoseconds() == ns(10 + number / 10)
        ends = lines(message).reshape(-1, 2)
        wanted = by_opencv(corners(14.0 + number, 2.0, 0.0), number)
        assert ends.min(axis=0) == pytest.approx(wanted.min(axis=0), abs=PX)
        assert ends.max(axis=0) == pytest.approx(wanted.max(axis=0), abs=PX)
    panels = json.loads(layouts["tracking"])["configById"]
    mode = panels["Image!camera0"]["imageMode"]
    assert (mode["imageTopic"], mode["annotations"]) == ("/front/image", {views[0]: {"visible": True}})


def test_a_video_of_3d_boxes_is_on_the_pictures_of_a_calibrated_camera_or_from_above(tmp_path):
    path = recorded(tmp_path / "drive.mcap")
    with_tracks(path)
    result = mcaptrack.render(path, tmp_path / "a.mp4", camera="lidar")
    assert (result.pictures, result.views) == (PICTURES, ("/lidar/retracks/view/image/front/image",))
    with log.read(path) as opened:
        first = ImageAnnotations.FromString(next(opened.messages(result.views[0])).payload)
    with av.open(str(tmp_path / "a.mp4")) as container:
        picture = next(container.decode(video=0)).to_ndarray(format="bgr24")
    x, y = lines(first).reshape(-1, 2).mean(axis=0)
    assert picture.shape[0] > HEIGHT  # a legend below
    assert picture.shape[1:] == (WIDTH, 3)
    assert picture[int(y) - 40 : int(y) + 40, int(x) - 40 : int(x) + 40].max() > 100
    assert picture[:40, :40].max() < 30
    for topic in ("/lidar/retracks", "/lidar/retracks/view/image/front/image"):
        assert mcaptrack.render(path, tmp_path / "b.mp4", topic=topic, camera="lidar", force=True).views == result.views
    above = mcaptrack.render(path, tmp_path / "c.mp4", topic="/lidar/retracks/view/scene", camera="lidar", end_s=0.1)
    assert (above.pictures, above.views) == (2, ("/lidar/retracks/view/scene",))
    with log.read(path) as opened, log.extend(opened, tmp_path / "two.mcap") as writer:
        other = opened.channel(result.views[0])
        writer.add_channel(
            "/lidar/retracks/view/image/rear/image",
            foxglove.schema_record(foxglove.ANNOTATIONS),
            "protobuf",
            other.metadata,
        )
    two = mcaptrack.render(tmp_path / "two.mcap", tmp_path / "d.mp4", camera="lidar", end_s=0.1)
    assert (two.views, [one.code for one in two.warnings]) == (result.views, ["chosen-camera"])


# People who are hidden


def test_people_in_3d_boxes_are_hidden_where_a_calibrated_camera_sees_them(tmp_path):
    """The person is found in the first and in the last picture but one only, the car in all."""
    noise = np.random.default_rng(4).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
    path = recorded(tmp_path / "drive.mcap", scene=noise)
    car = (3, 3, 16.0, -5.0, 0.0)
    seen = {n: (7, 1, 14.0 + n, 2.0, 0.0) for n in (0, PICTURES - 2)}
    with_tracks(path, [Frame(ns(10 + n / 10), n, rows(car, *filter(None, [seen.get(n)]))) for n in range(PICTURES)])
    done = mcaptrack.render(path, tmp_path / "out.mcap", blur="people")
    assert done.blurred == ("/front/image",)
    said = [one.message for one in done.warnings if one.code == "not-blurred"]
    assert any("/lidar/retracks can't be placed in /back/image: no calibration" in one for one in said)
    assert any("/back/image" in one and "kept as recorded and may show people" in one for one in said)
    with log.read(tmp_path / "out.mcap") as opened:
        assert json.loads(opened.channel("/front/image").metadata["mcaptrack.blurred"])["boxes"] == ["/lidar/retracks"]
        shown = [CompressedImage.FromString(one.payload).data for one in opened.messages("/front/image")]
    for number, jpeg in enumerate(shown):
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).astype(float)
        detail = np.abs(np.diff(image, axis=0))
        for hidden, (x, y) in ((True, (14.0 + number, 2.0)), (False, (16.0, -5.0))):
            px = by_opencv(corners(x, y, 0.0), number)
            (left, top), (right, bottom) = px.min(axis=0).astype(int), px.max(axis=0).astype(int)
            part = detail[max(top, 0) : bottom, max(left, 0) : right]
            assert (part.mean() < 25) == hidden, (number, part.mean())
    printed = mcaptrack.render(path, tmp_path / "out.mp4", blur="people")
    assert (printed.pictures, printed.blurred) == (PICTURES, ("/front/image",))


def test_without_calibrations_people_in_3d_boxes_are_a_mistake_that_says_why(tmp_path):
    path = recorded(tmp_path / "drive.mcap", calibrated=False)
    with_tracks(path, [Frame(ns(10), 0, rows((7, 1, 14.0, 2.0, 0.0)))])
    with pytest.raises(McaptrackError, match=r"no boxes of people in them to hide .*can't be placed in /front/image"):
        mcaptrack.render(path, tmp_path / "out.mcap", blur="people")


@pytest.mark.parametrize("distortion", [(), BENT], ids=["pinhole", "bent"])
def test_whatever_the_camera_sees_of_a_3d_box_is_inside_its_outline(distortion):
    """Points of boxes before, beside and partly behind the camera."""
    rng = np.random.default_rng(6)
    seen = camera(distortion)
    count = 60
    places = np.column_stack([rng.uniform(-1, 12, count), rng.uniform(-5, 5, count), rng.uniform(-1, 2, count)])
    states = np.column_stack([FAR + places, rng.uniform(0.3, 4, (count, 3)), rng.uniform(-3, 3, count)])
    picture = rng.integers(0, PICTURES, count)
    found = outlines(states, picture, seen)
    inside = 0
    for state, number, box in zip(states, picture.tolist(), found, strict=True):
        local = rng.uniform(-0.5, 0.5, (300, 3)) * state[3:6]
        turn = np.array([[np.cos(state[6]), -np.sin(state[6])], [np.sin(state[6]), np.cos(state[6])]])
        points = state[:3] + np.column_stack([local[:, :2] @ turn.T, local[:, 2]])
        points = points[(points @ AHEAD.T + seen.translation[number])[:, 2] > 0.2]
        px = by_opencv(points, number, distortion) if len(points) else np.empty((0, 2))
        straight = by_opencv(points, number) if len(points) else px
        # Far outside, polynomials of lenses fold back into the picture.
        px = px[(np.abs(straight - [WIDTH / 2, HEIGHT / 2]) < WIDTH).all(axis=1)]
        px = px[((px > 0) & (px < [WIDTH, HEIGHT])).all(axis=1)]
        inside += len(px)
        if len(px):
            assert (px >= box[:2] - 0.5).all()
            assert (px <= box[:2] + box[2:] + 0.5).all()
    assert inside > 2000
    assert np.isnan(found).any()
    ahead = outlines(np.array([[*(FAR + [14, 2, 0.75]), 4, 2, 1.5, 0.5]]), np.array([3]), seen)[0]
    wanted = by_opencv(corners(14.0, 2.0, 0.0), 3, distortion)
    assert ahead == pytest.approx([*wanted.min(axis=0), *np.ptp(wanted, axis=0)], abs=0.1)
    # From 1 m behind the camera to 3 m ahead, half a metre to its right: only what is ahead counts.
    eye = eye_at(3)
    beside = outlines(np.array([[*(eye + [1.0, -1.0, 0.0]), 4, 1, 1.5, 0.0]]), np.array([3]), seen)[0]
    farthest = np.array([eye + [3.0, -0.5, up] for up in (-0.75, 0.0, 0.75)])
    wanted = by_opencv(farthest, 3, distortion)
    assert beside[0] == pytest.approx(wanted[:, 0].min(), abs=2)
    assert beside[0] + beside[2] > WIDTH
