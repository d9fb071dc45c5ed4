"""Camera motion from pictures: known transforms are found again, a camera at rest is the identity to the bit."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from mcaptrack import notices
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY, compose, invert, move_boxes, move_points, shift_px
from mcaptrack.geometry.camera_path import CameraPath, CameraPose, MotionEstimator, Verdict, poses_of
from mcaptrack.notices import collected
from mcaptrack.schema import CAMERA_MOTION, Frame
from mcaptrack.schema.as_rows import frames_to_path, pose_to_rows, rows_to_verdict
from mcaptrack.transforms.detect.background import Registration, Steadiness
from mcaptrack.transforms.motion import EstimateMotion
from tests.tiers import thorough
from tests.worlds import ns

WIDTH, HEIGHT = 480, 360


def scene(seed: int = 0, width: int = 900, height: int = 700) -> np.ndarray:
    """A textured scene: soft noise at several scales, as plazas and streets have."""
    rng = np.random.default_rng(seed)
    out = np.zeros((height, width))
    for size in (6, 12, 25, 50):
        coarse = rng.normal(0, 1, (height // size + 2, width // size + 2))
        out += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(120 + 30 * out, 0, 255).astype(np.uint8)


def pose(pan: float = 0, tilt: float = 0, roll_deg: float = 0, zoom: float = 1) -> np.ndarray:
    """From pixels of the scene to pixels of a picture of its middle, (2, 3)."""
    turn = np.deg2rad(roll_deg)
    linear = zoom * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    middle = np.array([450.0 + pan, 350.0 + tilt])
    return np.column_stack([linear, [WIDTH / 2, HEIGHT / 2] - linear @ middle])


def picture(of: np.ndarray, matrix: np.ndarray, noise: int = 0, seed: int = 0) -> np.ndarray:
    out = cv2.warpAffine(of, matrix, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    if noise:
        grain = np.random.default_rng(seed).integers(-noise, noise, out.shape, np.int8, endpoint=True)
        out = np.clip(out + grain.astype(np.int16), 0, 255)
    return np.asarray(out, np.uint8)


def corner_error(found: np.ndarray, true: np.ndarray) -> float:
    corners = np.array([[0.0, 0.0], [WIDTH, 0], [0, HEIGHT], [WIDTH, HEIGHT]])
    return float(np.hypot(*(move_points(found, corners) - move_points(true, corners)).T).mean())


def full(matrix: np.ndarray) -> np.ndarray:
    return np.vstack([matrix, [0, 0, 1]])


def between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return (full(second) @ np.linalg.inv(full(first)))[:2]


def follow(pictures, boxes=None) -> list[CameraPose]:
    camera = MotionEstimator()
    return [camera.step(image, boxes) for image in pictures]


WAYS = {
    "pan": lambda k: pose(pan=2.5 * k, tilt=np.sin(k / 5)),
    "roll": lambda k: pose(roll_deg=8 * np.sin(k / 12)),
    "zoom": lambda k: pose(zoom=1.15 + 0.15 * np.sin(k / 10)),
    "all": lambda k: pose(30 * np.sin(k / 6), 20 * np.cos(k / 5), 3 * np.sin(k / 8), 1 + 0.1 * np.sin(k / 9)),
    "shake": lambda k: pose(*np.random.default_rng(k).uniform(-12, 12, 2), np.random.default_rng(k).normal(0, 0.7)),
}


@pytest.mark.parametrize("way", WAYS)
def test_known_pans_rolls_and_zooms_are_found_again(way):
    of, poses = scene(1), [WAYS[way](k) for k in range(24)]
    found = follow(picture(of, one, noise=3) for one in poses)
    errors = [
        corner_error(now.from_previous, between(*pair)) for now, pair in zip(found[1:], pairwise(poses), strict=True)
    ]
    assert np.median(errors) <= 0.2
    assert np.max(errors) <= 1.0
    # Errors don't add up from picture to picture: the last one is placed as well as a few key pictures allow.
    assert corner_error(found[-1].to_reference, between(poses[-1], poses[0])) <= 1.0
    assert {one.reference for one in found} == {0}


def test_a_camera_at_rest_is_the_identity_to_the_bit():
    """Noise, people who walk, and swaying by less than a third of a pixel change nothing."""
    of, rng, pictures = scene(3), np.random.default_rng(0), []
    for k in range(20):
        image = picture(of, pose(pan=0.1 * np.sin(k)), noise=6, seed=k)
        for person in range(8):
            x, y = int(40 * person + 3 * k), 60 + 30 * person
            image[y : y + 70, x : x + 24] = rng.integers(0, 255, (1, 24)) + np.zeros((70, 1), np.uint8)
        pictures.append(image)
    for one in follow(pictures):
        assert one.verdict is Verdict.STILL
        assert np.array_equal(one.from_previous, IDENTITY)
        assert np.array_equal(one.to_reference, IDENTITY)


def test_what_moves_by_itself_is_masked():
    """A lorry fills most of the picture, with more features than the street; only its box tells which of them moves."""
    street, lorry = scene(4), scene(5)
    poses = [pose(pan=2.0 * k) for k in range(12)]
    pictures = []
    for k, one in enumerate(poses):
        image = picture(street, one) // 4 + 90  # a street of low contrast
        image[30:330, 60:420] = picture(lorry, pose(pan=-3.0 * k))[30:330, 60:420]
        pictures.append(image)
    box = np.array([[58.0, 28.0, 364.0, 304.0]])
    assert worst(follow(pictures, box), poses) < 0.5
    assert worst(follow(pictures), poses) > 2.0


def test_verdicts_follow_the_camera():
    """A camera that stands, pans for a while, and stands again: it is still, moving, and still once it has settled."""
    of = scene(6)
    pans = [0.0] * 10 + [7.0 * k for k in range(1, 22)] + [147.0] * 20
    found = follow(picture(of, pose(pan=pan)) for pan in pans)
    verdicts = [one.verdict for one in found]
    assert set(verdicts[:10]) == {Verdict.STILL}
    diagonal = np.hypot(WIDTH, HEIGHT)
    far = next(k for k, pan in enumerate(pans) if pan > 0.1 * diagonal)
    assert set(verdicts[10:far]) == {Verdict.SHAKING}
    assert set(verdicts[far:32]) == {Verdict.MOVING}
    assert set(verdicts[-4:]) == {Verdict.STILL}
    assert all(np.array_equal(one.from_previous, IDENTITY) for one in found[-4:])
    assert found[-1].to_reference[0, 2] == pytest.approx(147.0, abs=1.0)


def test_cuts_are_found_and_a_view_that_returns_is_recognised():
    one, other = scene(7), scene(8)
    pictures = [picture(one, pose(pan=2.0 * k)) for k in range(10)]
    pictures += [picture(other, pose(pan=-k)) for k in range(10)]
    pictures += [picture(one, pose(pan=20.0 + 2.0 * k)) for k in range(10)]
    found = follow(pictures)
    assert [k for k, this in enumerate(found) if this.verdict is Verdict.CUT] == [10, 20]
    assert [this.reference for this in found] == [0] * 10 + [10] * 10 + [0] * 10
    assert np.array_equal(found[10].from_previous, IDENTITY)
    assert corner_error(found[25].to_reference, between(pose(pan=30.0), pose())) < 1.0


def test_pictures_that_show_nothing_are_lost_and_the_view_is_found_again():
    of, dark = scene(9), np.zeros((HEIGHT, WIDTH), np.uint8)
    found = follow([picture(of, pose())] * 3 + [dark] * 5 + [picture(of, pose(pan=4.0))] * 3)
    assert [one.verdict for one in found[3:8]] == [Verdict.LOST] * 5
    assert found[8].from_previous[0, 2] == pytest.approx(-4.0, abs=0.2)
    assert {one.reference for one in found} == {0}
    for one in follow([dark] * 30):  # never anything to be seen: nothing moves
        assert one.verdict is Verdict.STILL
        assert np.array_equal(one.to_reference, IDENTITY)


def test_a_camera_that_is_blind_for_long_begins_again_unless_it_has_the_same_view():
    dark = np.zeros((HEIGHT, WIDTH), np.uint8)
    for after, is_same in ((9, True), (12, False)):
        found = follow([picture(scene(9), pose())] * 3 + [dark] * 20 + [picture(scene(after), pose())] * 3)
        assert {one.reference for one in found[:18]} == {0}
        assert found[18].reference == 18
        assert [one.reference for one in found[23:]] == [0 if is_same else 23] * 3


def test_pictures_of_any_size_are_taken():
    rng = np.random.default_rng(0)
    for size in ((8, 8), (1, 300), (33, 1200)):
        for one in follow([rng.integers(0, 255, size).astype(np.uint8) for _ in range(3)]):
            assert np.isfinite(one.from_previous).all()


def test_large_pictures_are_reduced_further():
    of, poses = scene(10), [WAYS["all"](k) for k in range(6)]
    large = [cv2.resize(picture(of, one), (4 * WIDTH, 4 * HEIGHT), interpolation=cv2.INTER_CUBIC) for one in poses]
    grow = np.array([[4.0, 0, 1.5], [0, 4.0, 1.5]])  # centres of pixels
    for k, one in enumerate(follow(large)[1:], start=1):
        true = compose(grow, compose(between(poses[k - 1], poses[k]), invert(grow)))
        assert corner_error(one.from_previous, true) < 1.5  # 0.4 px of the small picture


def test_arithmetic_of_transforms():
    rng = np.random.default_rng(0)
    first, second, points = rng.normal(size=(2, 3)), rng.normal(size=(2, 3)), rng.normal(size=(5, 2))
    assert move_points(compose(second, first), points) == pytest.approx(move_points(second, move_points(first, points)))
    assert compose(invert(first), first) == pytest.approx(IDENTITY)
    assert compose(IDENTITY, first) is first
    assert compose(first, IDENTITY) is first
    turned = np.array([[0.0, -2.0, 10.0], [2.0, 0.0, 20.0]])  # a quarter turn, twice as large
    assert move_boxes(turned, np.array([[1.0, 2.0, 4.0, 6.0]])).tolist() == [[10 - 2 * 5 - 4, 20 + 2 * 3 - 6, 8, 12]]
    assert shift_px(np.array([[1.0, 0, 3], [0, 1, 4]]), 10, 10) == 5.0


def test_a_change_of_size_is_a_cut():
    of = scene(1)
    found = follow([picture(of, pose()), picture(of, pose()), picture(of, pose())[:200], picture(of, pose())[:200]])
    assert [one.verdict for one in found] == [Verdict.STILL, Verdict.STILL, Verdict.CUT, Verdict.STILL]
    assert [one.reference for one in found] == [0, 0, 2, 2]


def test_a_camera_that_drives_on_for_long_stays_exact():
    """One picture is enlarged by 2 % against the one before, for long: 1.02 ** 600 is 140 000."""
    zoom = np.array([[1.02, 0.0, -4.8], [0.0, 1.02, -3.6]])
    poses = poses_of(np.array([zoom] * 600), WIDTH, HEIGHT)
    assert {one.verdict for one in poses[12:]} == {Verdict.MOVING}
    for before, now in pairwise(poses):
        if before.reference == now.reference:
            led = compose(now.to_reference, now.from_previous)
            assert corner_error(led, before.to_reference) < 1e-9
    assert len({one.reference for one in poses}) == 5  # every 140 pictures, where 1.02 ** 140 is 16


def panned(by: float, count: int) -> list[CameraPose]:
    return poses_of(np.array([[[1.0, 0, by], [0, 1, 0]]] * count), WIDTH, HEIGHT)


def test_a_path_gives_the_motion_between_two_times():
    path = CameraPath(10 * np.arange(6), panned(-3.0, 6))
    assert path.between(0, 50)[0].tolist() == [1, 0, -15]
    assert path.between(10, 39)[0].tolist() == [1, 0, -6]
    assert path.between(20, 20) is IDENTITY
    assert path.between(-50, 9) is IDENTITY  # the first picture has none before it
    assert [path.pose_at(t).to_reference[0, 2] for t in (-5, 0, 19, 500)] == [0, 0, 3, 15]
    turn = np.array([[0.0, -1, 0], [1, 0, 0]])
    bent = CameraPath(np.arange(3), poses_of(np.array([turn, [[1, 0, 10], [0, 1, 0]], turn]), WIDTH, HEIGHT))
    assert move_points(bent.between(0, 2), np.array([[1.0, 2.0]])).tolist() == [[-2.0, 11.0]]  # moved, then turned


def test_nothing_leads_over_a_cut():
    poses = panned(-3.0, 6)
    poses[3] = poses[3]._replace(from_previous=IDENTITY, verdict=Verdict.CUT)
    path = CameraPath(10 * np.arange(6), poses)
    assert path.between(20, 30) is None
    assert path.between(0, 50) is None
    assert path.between(30, 50)[0].tolist() == [1, 0, -6]
    assert path.cuts_ns == [30]


def test_a_camera_is_called_by_what_it_does_in_a_fiftieth_of_its_pictures():
    def called(moving: int, shaking: int) -> str:
        names = [Verdict.MOVING] * moving + [Verdict.SHAKING] * shaking + [Verdict.STILL] * (200 - moving - shaking)
        poses = [one._replace(verdict=verdict) for one, verdict in zip(panned(0, 200), names, strict=True)]
        return CameraPath(np.arange(200), poses).verdict.name

    counts = {"STILL": [(0, 0), (0, 3), (3, 0)], "SHAKING": [(0, 4), (2, 2), (3, 90)], "MOVING": [(4, 0)]}
    assert {name: [called(*each) for each in some] for name, some in counts.items()} == {
        name: [name] * len(some) for name, some in counts.items()
    }
    assert CameraPath(np.empty(0, np.int64), []).verdict is Verdict.STILL
    assert CameraPath(np.empty(0, np.int64), []).pose_at(0) is None


# Pictures that show more than a scene at rest: texts over it, light, noise, crowds, slow pans


SCENE = scene(21)
PAN = [pose(pan=3.0 * k) for k in range(16)]


def worst(found: list[CameraPose], poses: list[np.ndarray]) -> float:
    return max(corner_error(found[k].from_previous, between(poses[k - 1], poses[k])) for k in range(1, len(poses)))


def verdict(found: list[CameraPose]) -> Verdict:
    return CameraPath(np.arange(len(found)), found).verdict


def with_texts(image: np.ndarray, number: int) -> np.ndarray:
    """A clock in a corner, and a line of news: they stand still while the camera pans."""
    out = image.copy()
    cv2.rectangle(out, (0, 0), (260, 34), 0, -1)
    cv2.putText(out, f"CAM 03  15:04:{number:02d}", (4, 24), 0, 0.9, 255, 2)
    out[320:] = 20
    cv2.putText(out, "NEWS: PEOPLE WALK ON A PLAZA", (4, 346), 0, 0.8, 255, 2)
    return out


def test_texts_over_the_picture_do_not_hide_a_pan():
    pale = [picture(SCENE, one, noise=2, seed=k) // 4 + 60 for k, one in enumerate(PAN)]
    found = follow(with_texts(image, k) for k, image in enumerate(pale))
    assert worst(found, PAN) < 1.5
    assert found[-1].to_reference[0, 2] == pytest.approx(3.0 * 15, abs=1.0)
    still = follow(with_texts(pale[0], k) for k in range(8))
    assert all(one.from_previous is IDENTITY for one in still)


@pytest.mark.parametrize(
    "light",
    [lambda k: 0.5 if k >= 8 else 1.0, lambda k: 1 - 0.045 * k, lambda k: 0.7 if k % 2 else 1.0],
    ids=["step", "ramp", "flicker"],
)
def test_light_that_changes_is_no_motion_and_no_cut(light):
    def seen(poses: list[np.ndarray]) -> list[CameraPose]:
        return follow((picture(SCENE, one, noise=2, seed=k) * light(k)).astype(np.uint8) for k, one in enumerate(poses))

    still = seen([pose()] * 16)
    assert all(one.from_previous is IDENTITY and one.verdict is Verdict.STILL for one in still)
    assert worst(seen(PAN), PAN) < 0.5


def test_noise_in_which_nothing_is_found_is_no_cut():
    rng = np.random.default_rng(0)
    dim = picture(SCENE, pose()) * 0.2 + 40
    found = follow(np.clip(dim + rng.normal(0, 40, dim.shape), 0, 255).astype(np.uint8) for _ in range(20))
    assert Verdict.CUT not in {one.verdict for one in found}
    assert all(one.from_previous is IDENTITY for one in found)


def test_a_camera_above_a_plain_floor_stands_still_while_people_walk():
    """What little there is to find again are people: without the floor itself nearly all pictures would be lost."""
    rng = np.random.default_rng(5)
    floor = cv2.GaussianBlur(rng.integers(70, 180, (240, 320), np.uint8), (0, 0), 6)
    camera = MotionEstimator()
    for number in range(90):
        image = floor.copy()
        for k in range(6):
            x, y = (7 * number * (1 if k % 2 else -1) // 3 + 60 * k) % 400 - 40, 60 + 28 * k
            cv2.ellipse(image, (x, y), (8, 20), 0, 0, 360, 30 + 35 * k, -1)
            cv2.circle(image, (x, y - 26), 6, 220, -1)
        pose = camera.step(np.clip(image + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8))
        assert pose.verdict is Verdict.STILL
        np.testing.assert_array_equal(pose.to_reference, IDENTITY)


@thorough
def test_leaves_that_sway_in_half_of_the_picture_are_no_motion_of_the_camera():
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    share, image = np.clip((0.6 * HEIGHT - y) / 20, 0, 1), picture(SCENE, pose())
    pictures = []
    for k in range(20):
        dx = share * 3 * np.sin(k / 3 + y / 40 + x / 90)
        dy = share * 1.2 * np.cos(k / 2.3 + x / 60)
        pictures.append(cv2.remap(image, x + dx, y + dy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))
    assert all(one.from_previous is IDENTITY and one.verdict is Verdict.STILL for one in follow(pictures))


@pytest.mark.parametrize("speed", [6, 15])
def test_a_train_through_half_of_the_picture_is_no_motion_of_the_camera(speed):
    train, pictures = scene(22), []
    for k in range(24):
        image = picture(SCENE, pose(), noise=2, seed=k)
        end = min(speed * k, WIDTH)
        image[90:265, :end] = np.roll(train[:175], speed * k, axis=1)[:, :end]
        pictures.append(image)
    assert all(one.from_previous is IDENTITY and one.verdict is Verdict.STILL for one in follow(pictures))


def test_a_crowd_before_a_shaking_camera_does_not_make_it_drift():
    """Forty people with more contrast than the place hide half of its features, each time others."""
    rng = np.random.default_rng(6)
    poses = [pose(*rng.normal(0, 1.0, 2)) for _ in range(50)]
    start, speed = rng.uniform((-200, 0), (WIDTH + 200, HEIGHT - 60), (40, 2)), rng.uniform(-7, 7, 40)
    looks, pictures = [scene(100 + n, 24, 64) for n in range(40)], []
    for k, one in enumerate(poses):
        image = picture(SCENE, one) // 3 + 80
        for (x, y), fast, look in zip(start, speed, looks, strict=True):
            left, top = round(x + fast * k), round(y)
            shown = look[: HEIGHT - top, max(-left, 0) : max(WIDTH - left, 0)]
            image[top : top + shown.shape[0], max(left, 0) : max(left, 0) + shown.shape[1]] = shown
        grain = rng.normal(0, 4, image.shape)
        pictures.append(np.clip(image + grain, 0, 255).astype(np.uint8))
    found = follow(pictures)
    off = [corner_error(one.to_reference, between(true, poses[0])) for one, true in zip(found, poses, strict=True)]
    assert np.mean(off[-20:]) < 0.8


def test_a_person_before_a_white_wall_tells_nothing_of_the_camera():
    wall, pictures = np.full((HEIGHT, WIDTH), 210, np.uint8), []
    for k in range(12):
        image = wall.copy()
        image[110:250, 40 + 8 * k : 100 + 8 * k] = picture(SCENE, pose())[:140, :60]
        pictures.append(image)
    assert all(one.from_previous is IDENTITY for one in follow(pictures))


@pytest.mark.parametrize("corner", [(0, 0), (1, 0), (0, 1), (1, 1)])
@pytest.mark.parametrize(("by", "is_elsewhere"), [(1.02, True), (0.98, False)])
def test_the_corner_that_moves_most_tells_whether_the_camera_looks_elsewhere(corner, by, is_elsewhere):
    """One corner moves by a tenth of the diagonal, two by half of that, and the one across stays."""
    along_x, along_y = ((1 if there else -1) * 0.5 for there in corner)
    start = (0.5 if not corner[0] else 0) + (0.5 if not corner[1] else 0)
    px = by * 0.1 * np.hypot(WIDTH, HEIGHT)
    motion = np.array([[1 + px * along_x / WIDTH, px * along_y / HEIGHT, px * start], [0, 1, 0]])
    pose = poses_of(np.array([IDENTITY, invert(motion)]), WIDTH, HEIGHT)[1]
    assert pose.is_elsewhere == is_elsewhere
    assert shift_px(motion, WIDTH, HEIGHT) == pytest.approx(px)
    path = frames_to_path([Frame(0, 0, pose_to_rows(pose, WIDTH, HEIGHT))])
    assert [one.is_elsewhere for _, one in path.poses_between(None, None)] == [is_elsewhere]


def test_a_camera_that_has_turned_once_looks_elsewhere_from_then_on():
    motions = np.array([IDENTITY] * 2000)
    motions[100:110, 0, 2] = -20.0
    found = poses_of(motions, WIDTH, HEIGHT)
    assert np.mean([one.verdict is Verdict.MOVING for one in found]) < 0.02
    assert verdict(found) is Verdict.MOVING
    frames = [Frame(k, k, pose_to_rows(one, WIDTH, HEIGHT)) for k, one in enumerate(found)]
    path = frames_to_path(frames)
    assert path.verdict is Verdict.MOVING
    assert [one.is_elsewhere for _, one in path.poses_between(None, None)] == [one.is_elsewhere for one in found]
    assert rows_to_verdict(CAMERA_MOTION.joined([frame.rows for frame in frames])) is Verdict.MOVING
    assert rows_to_verdict(CAMERA_MOTION.joined([frame.rows for frame in frames[:100]])) is Verdict.STILL


def divided(kind):
    """Pictures of a scene that pans by 3 px a picture, with something else below, or before it for a while."""
    below = scene(33)
    for k in range(34):
        image = picture(SCENE, pose(3.0 * k))
        if kind == "vehicle":
            image[HEIGHT // 2 :] = below[: HEIGHT - HEIGHT // 2, :WIDTH]
        elif kind == "near":
            image[HEIGHT // 2 :] = picture(below, pose(7.0 * k))[HEIGHT // 2 :]
        elif kind == "train" and k < 12:
            image = picture(SCENE, pose())
            image[:175, : 30 * k] = np.roll(below[:175, :WIDTH], 15 * k, axis=1)[:, : 30 * k]
        elif kind == "rolling":  # rows are read one after the other while the camera pans to and fro
            y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
            fast = np.float32(8 * np.cos(k / 4))
            turned = picture(SCENE, pose(32 * np.sin(k / 4)))
            image = cv2.remap(turned, x + fast * (y / HEIGHT - 0.5), y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        yield Frame(k * 40_000_000, k, image)


@pytest.mark.parametrize(("kind", "is_said"), [("vehicle", True), ("near", True), ("train", False), ("rolling", False)])
def test_a_part_that_moves_otherwise_is_said(kind, is_said):
    with collected() as said:
        motion = [frame.rows for (frame,) in EstimateMotion()(divided(kind))]
    assert any("one part moves as a whole" in one.message for one in said) == is_said
    shift = np.array([rows["m02_px"][0] for rows in motion[1:]])
    if kind == "near":
        assert abs(np.median(shift) + 3) < 0.2
    elif kind == "rolling":  # that of one of the rows: the first and the last are 8 px apart at most
        assert np.abs(shift + 32 * np.diff(np.sin(np.arange(34) / 4))).max() < 8


# Motion of the camera: thresholds of warnings and of refusal, and the shares and times in their texts


def said(views: str, changes: tuple[int, ...] = (0,)) -> list[str]:
    """The warnings for these views of the camera, one letter for each picture, ten pictures a second from 7 s on."""
    names = {"s": "steady", "m": "moving", "l": "lost"}
    steadiness = Steadiness()
    for number, letter in enumerate(views):
        steadiness.update(ns(7 + number / 10), names[letter], number in changes)
    with notices.collected() as found:
        steadiness.check()
    return [f"{notice.code}: {notice}" for notice in found]


def codes(*given) -> list[str]:
    return [words.partition(":")[0] for words in said(*given)]


def test_a_camera_that_moves_in_2_percent_of_the_pictures_is_a_warning_and_in_most_an_error():
    def views(count: int, of: int) -> str:
        return "m" * count + "s" * (of - count)

    assert codes(views(1, 100)) == []
    assert codes(views(2, 100)) == ["camera-moves"]
    assert codes(views(50, 100)) == ["camera-moves"]
    with pytest.raises(McaptrackError, match=r"^the camera moves in 51% of the pictures;"):
        said(views(51, 100))
    assert codes(views(14, 20)) == ["camera-moves"]  # fewer than 15 pictures
    with pytest.raises(McaptrackError, match=r"^the camera moves in 75% of the pictures;"):
        said(views(15, 20))


def test_a_lost_or_changed_view_is_a_warning():
    assert codes("l" + 99 * "s") == []
    assert codes("ll" + 98 * "s") == ["view-lost"]
    assert codes(100 * "l") == ["view-lost"]
    assert codes(100 * "s", (0, 50)) == ["view-lost"]
    assert codes(98 * "s" + "mm", (0, 50)) == ["camera-moves"]  # which is the reason of the restart
    assert codes(99 * "s" + "m", (0, 50)) == ["view-lost"]
    assert codes(96 * "s" + "mmll") == ["camera-moves", "view-lost"]
    assert codes("") == []


def test_warnings_give_share_times_and_restarts():
    (words,) = said("ss" + "m" + 10 * "s" + "mm" + 85 * "s")
    assert words.startswith("camera-moves: the camera moves in 3% of the pictures, from 0.2 s to 1.4 s:")
    (words,) = said(20 * "s" + "lll" + 77 * "s")
    assert "in 3% of the pictures, from 2.0 s to 2.2 s: " in words
    (words,) = said(20 * "s" + "lll" + 77 * "s", (0, 30, 60))
    assert "in 3% of the pictures, from 2.0 s to 2.2 s; the background model started again 2 times: " in words
    (words,) = said(100 * "s", (0, 30, 60))  # as where the size of pictures changes
    assert words.startswith("view-lost: the background model started again 2 times, from 3.0 s to 6.0 s: ")


def textured(height: int = 160, width: int = 240, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.kron(rng.integers(40, 200, (height // 8, width // 8)), np.ones((8, 8))).astype(np.uint8)


def shifted(wide: np.ndarray, by: float) -> np.ndarray:
    """A view of 240 x 160 pixels into a wide picture, so many pixels from its left edge."""
    moved = cv2.warpAffine(wide, np.array([[1.0, 0, -by], [0, 1, 0]]), (wide.shape[1], wide.shape[0]))
    return np.ascontiguousarray(moved[:, :240])


@pytest.mark.parametrize(("degrees", "scale", "shift"), [(2.0, 1.0, (0, 0)), (0.0, 1.03, (0, 0)), (1.0, 0.98, (3, -2))])
def test_rotation_scale_and_shift_are_estimated(degrees, scale, shift):
    still, camera = textured(), Registration()
    matrix = cv2.getRotationMatrix2D((120, 80), degrees, scale)
    matrix[:, 2] += shift
    camera.register(still)
    image = cv2.warpAffine(still, matrix, (240, 160), borderMode=cv2.BORDER_REPLICATE)
    found, begins = camera.register(image)
    assert not begins
    corners = np.array([[0.0, 0.0], [240, 0], [0, 160], [240, 160]])
    np.testing.assert_allclose(move_points(found, move_points(matrix, corners)), corners, atol=0.5)


def test_a_view_begins_where_the_camera_has_settled_further_away_than_a_tenth_of_the_diagonal():
    """A tenth of the diagonal of 240 x 160 pixels is 28.8 px; the camera turns slowly, so that each picture fits."""
    wide, camera = textured(width=480), Registration()
    path = [*[0] * 5, *range(1, 50), *[50] * 60, 52]
    seen = [(by, *camera.register(shifted(wide, by)), camera.view) for by in path]
    first, second = (number for number, (_, _, begins, _) in enumerate(seen) if begins)
    assert (first, path.index(50) < second <= path.index(50) + 15) == (0, True)
    views = [(by > 28.8, view) for by, _, _, view in seen[:second] if abs(by - 28.8) > 0.5]
    assert [view for _, view in views] == ["moving" if is_far else "steady" for is_far, _ in views]
    assert all(np.array_equal(found, IDENTITY) for _, found, _, _ in seen[second:-1])
    assert camera.view == "steady"
    assert seen[-1][1][0, 2] == pytest.approx(2, abs=0.3)


@pytest.mark.parametrize("seen", [1, 5])
def test_another_view_begins_after_15_pictures_that_do_not_fit(seen):
    """Whether the camera was seen to stand still before, so that the cut is certain, or not."""
    camera, still = Registration(), textured()
    other = np.random.default_rng(0).integers(0, 255, (160, 240)).astype(np.uint8)
    for picture in [still] * seen + [other] * 10 + [still] + [other] * 15:
        begins = camera.register(picture)[1]
        assert (camera.view == "steady") == (picture is still)
    assert not begins
    assert [camera.register(other)[1] for _ in range(25)] == [True] + [False] * 24
    assert camera.view == "steady"


def test_pictures_without_corners_have_no_motion():
    camera = Registration()
    for _ in range(30):
        np.testing.assert_array_equal(camera.register(np.full((60, 80), 90, np.uint8))[0], IDENTITY)


@pytest.mark.parametrize(("by", "is_moved"), [(0.15, False), (0.6, True)])
def test_a_shift_below_a_third_of_a_pixel_is_no_motion(by, is_moved):
    wide, camera = textured(width=480), Registration()
    camera.register(shifted(wide, 0))
    found, _ = camera.register(shifted(wide, by))
    assert (found[0, 2] != 0) == is_moved
    assert found[0, 2] == pytest.approx(by * is_moved, abs=0.15)


def test_a_picture_without_a_fit_is_moving_or_lost_and_lies_where_the_one_before_it_lay():
    """Moving: all points share one shift since the picture before. Lost: none of them is found again."""
    wide, other, camera = textured(width=480), textured(width=480, seed=4), Registration()
    camera.register(shifted(wide, 0))
    before, _ = camera.register(shifted(wide, 5))
    assert before[0, 2] == pytest.approx(5, abs=0.3)
    assert camera.view == "steady"
    for by, view in ((0, "lost"), (0.2, "lost"), (3, "moving")):  # a five-hundredth of the diagonal is 0.58 px
        found, begins = camera.register(shifted(other, by))
        assert (camera.view, begins) == (view, False)
        np.testing.assert_array_equal(found, before)
    camera.register(shifted(wide, 0))
    assert camera.view == "steady"
