"""Camera motion where pictures show more than a scene at rest: texts over it, light, noise, crowds, slow pans."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mcaptrack.geometry.affine import IDENTITY, invert, shift_px
from mcaptrack.geometry.camera_motion import MotionEstimator
from mcaptrack.geometry.camera_path import CameraPath, CameraPose, Verdict, poses_of
from mcaptrack.notices import collected
from mcaptrack.schema import CAMERA_MOTION, Frame
from mcaptrack.schema.camera_motion import frames_to_path, pose_to_rows, rows_to_verdict
from mcaptrack.transforms.motion import EstimateMotion
from tests.test_camera_motion import HEIGHT, WIDTH, between, corner_error, follow, picture, pose, scene

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


def test_a_flash_is_no_cut():
    pictures = [picture(SCENE, one, noise=2, seed=k) for k, one in enumerate(PAN)]
    pictures[8] = np.clip(pictures[8] * 1.5 + 90.0, 0, 255).astype(np.uint8)
    found = follow(pictures)
    assert Verdict.CUT not in {one.verdict for one in found}
    assert corner_error(found[-1].to_reference, between(PAN[-1], PAN[0])) < 0.5


def test_noise_in_which_nothing_is_found_is_no_cut():
    rng = np.random.default_rng(0)
    dim = picture(SCENE, pose()) * 0.2 + 40
    found = follow(np.clip(dim + rng.normal(0, 40, dim.shape), 0, 255).astype(np.uint8) for _ in range(20))
    assert Verdict.CUT not in {one.verdict for one in found}
    assert all(one.from_previous is IDENTITY for one in found)


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


def test_large_shakes_are_followed_at_little_cost():
    """Up to 60 px to each side at random; the pictures before are hardly ever searched in full."""
    rng = np.random.default_rng(3)
    poses = [pose(*rng.uniform(-60, 60, 2), rng.normal(0, 0.7)) for _ in range(24)]
    camera = MotionEstimator()
    fits = []
    fit = camera._fit
    camera._fit = lambda *given: fits.append(given) or fit(*given)  # type: ignore[method-assign]
    found = [camera.step(picture(SCENE, one, noise=2, seed=k)) for k, one in enumerate(poses)]
    assert worst(found, poses) < 1.0
    assert len(fits) <= 1.3 * len(poses)


@pytest.mark.parametrize("step", [0.2, 0.4])
def test_a_slow_pan_moves_the_camera(step):
    """Less than a picture's shake from one to the next, but far away in the end."""
    found = poses_of(np.array([[[1.0, 0, -step], [0, 1, 0]]] * 600), WIDTH, HEIGHT)
    assert verdict(found) is Verdict.MOVING
    assert verdict(found[: round(50 / step)]) is Verdict.SHAKING  # a tenth of the diagonal is 60 px


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


@pytest.mark.parametrize(
    ("kind", "is_said"),
    [("vehicle", True), ("near", True), ("train", False), ("rolling", False)],
)
def test_a_part_that_moves_otherwise_is_said(kind, is_said):
    with collected() as said:
        motion = [frame.rows for (frame,) in EstimateMotion()(divided(kind))]
    assert any("one part moves as a whole" in one.message for one in said) == is_said
    shift = np.array([rows["m02_px"][0] for rows in motion[1:]])
    if kind == "near":
        assert abs(np.median(shift) + 3) < 0.2
    elif kind == "rolling":  # that of one of the rows: the first and the last are 8 px apart at most
        assert np.abs(shift + 32 * np.diff(np.sin(np.arange(34) / 4))).max() < 8
