"""Camera motion from pictures: known transforms are found again, a camera at rest is the identity to the bit."""

from __future__ import annotations

import time
from itertools import pairwise

import cv2
import numpy as np
import pytest

from mcaptrack.geometry.affine import IDENTITY, compose, invert, move_boxes, move_points, shift_px
from mcaptrack.geometry.camera_motion import MotionEstimator
from mcaptrack.geometry.camera_path import CameraPath, CameraPose, Verdict, poses_of

WIDTH, HEIGHT = 480, 360


def scene(seed: int = 0, width: int = 900, height: int = 700) -> np.ndarray:
    """A textured scene: soft noise at several scales, as plazas and streets have."""
    import cv2

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
    import cv2

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
    """The transform from one picture to another, by 3x3 matrices."""
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
        corner_error(one.from_previous, between(*pair)) for one, pair in zip(found[1:], pairwise(poses), strict=True)
    ]
    assert np.median(errors) <= 0.2
    assert np.max(errors) <= 1.0
    # Errors don't add up from picture to picture: the last one is placed as well as a few key pictures allow.
    assert corner_error(found[-1].to_reference, between(poses[-1], poses[0])) <= 1.0
    assert {one.reference for one in found} == {0}


def test_poses_are_the_sum_of_motions():
    of = scene(2)
    found = follow(picture(of, WAYS["all"](k)) for k in range(20))
    for before, now in pairwise(found):
        assert compose(now.to_reference, now.from_previous) == pytest.approx(before.to_reference, abs=1e-9)


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
    masked, bare = follow(pictures, box), follow(pictures)

    def worst(found: list[CameraPose]) -> float:
        return max(corner_error(found[k].from_previous, between(poses[k - 1], poses[k])) for k in range(1, len(poses)))

    assert worst(masked) < 0.5
    assert worst(bare) > 2.0


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


@pytest.mark.parametrize("size", [(8, 8), (1, 300), (33, 1200)])
def test_pictures_of_any_size_are_taken(size):
    rng = np.random.default_rng(0)
    for one in follow([rng.integers(0, 255, size).astype(np.uint8) for _ in range(3)]):
        assert np.isfinite(one.from_previous).all()


def test_large_pictures_are_reduced_further():
    import cv2

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


def test_a_picture_takes_little_time():
    """About as much as finding the corners of all pixels, which is measured in turns."""
    of = scene(11)
    pictures = [picture(of, WAYS["all"](k)) for k in range(20)]
    follow(pictures[:3])
    spent: list[list[float]] = [[], []]
    for _ in range(5):
        for work, times in zip(
            (follow, lambda some: [cv2.cornerMinEigenVal(one, 3) for one in some]), spent, strict=True
        ):
            began = time.process_time()
            work(pictures)
            times.append(time.process_time() - began)
    assert min(spent[0]) < 8 * min(spent[1])


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


def pan(by: float, count: int) -> list[CameraPose]:
    return poses_of(np.array([[[1.0, 0, by], [0, 1, 0]]] * count), WIDTH, HEIGHT)


def test_a_path_gives_the_motion_between_two_times():
    path = CameraPath(10 * np.arange(6), pan(-3.0, 6))
    assert path.between(0, 50)[0].tolist() == [1, 0, -15]
    assert path.between(10, 39)[0].tolist() == [1, 0, -6]
    assert path.between(20, 20) is IDENTITY
    assert path.between(-50, 9) is IDENTITY  # the first picture has none before it
    assert [path.pose_at(t).to_reference[0, 2] for t in (-5, 0, 19, 500)] == [0, 0, 3, 15]
    turn = np.array([[0.0, -1, 0], [1, 0, 0]])
    bent = CameraPath(np.arange(3), poses_of(np.array([turn, [[1, 0, 10], [0, 1, 0]], turn]), WIDTH, HEIGHT))
    assert move_points(bent.between(0, 2), np.array([[1.0, 2.0]])).tolist() == [[-2.0, 11.0]]  # moved, then turned


def test_nothing_leads_over_a_cut():
    poses = pan(-3.0, 6)
    poses[3] = poses[3]._replace(from_previous=IDENTITY, verdict=Verdict.CUT)
    path = CameraPath(10 * np.arange(6), poses)
    assert path.between(20, 30) is None
    assert path.between(0, 50) is None
    assert path.between(30, 50)[0].tolist() == [1, 0, -6]
    assert path.cuts_ns == [30]


def test_a_camera_is_called_by_what_it_does_in_a_fiftieth_of_its_pictures():
    def called(moving: int, shaking: int) -> str:
        names = [Verdict.MOVING] * moving + [Verdict.SHAKING] * shaking + [Verdict.STILL] * (200 - moving - shaking)
        poses = [one._replace(verdict=verdict) for one, verdict in zip(pan(0, 200), names, strict=True)]
        return CameraPath(np.arange(200), poses).verdict.name

    assert [called(*counts) for counts in [(0, 0), (0, 3), (0, 4), (3, 0), (2, 2), (3, 90), (4, 0)]] == [
        *["STILL", "STILL", "SHAKING", "STILL", "SHAKING", "SHAKING", "MOVING"]
    ]
    assert CameraPath(np.empty(0, np.int64), []).verdict is Verdict.STILL
    assert CameraPath(np.empty(0, np.int64), []).pose_at(0) is None
