"""The motion detector on scenes whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.boxes import columns_to_boxes, iou
from mcaptrack.match import assign
from mcaptrack.scene import Scene
from mcaptrack.schema import Frame
from mcaptrack.transforms.detect import Detect
from mcaptrack.transforms.detect.motion import CameraMotion
from tests.worlds import ns, small_scene


def footage(scene: Scene) -> tuple[list[Frame], list[np.ndarray]]:
    """The brightness of a scene's pictures, and the true boxes in each."""
    shots = list(scene.shots())
    frames = [Frame(ns(shot.seconds), n, shot.image.mean(axis=2).astype(np.uint8)) for n, shot in enumerate(shots)]
    return frames, [shot.boxes for shot in shots]


def found(detect: Detect, scene: Scene, from_frame: int = 15) -> tuple[float, float]:
    """Recall and precision at an overlap of 0.5, once the background is known."""
    frames, truth = footage(scene)
    hits = boxes = people = 0
    for (frame,), true in list(zip(detect(frames), truth, strict=True))[from_frame:]:
        seen = columns_to_boxes(frame.rows)
        hits += len(assign(1 - iou(true, seen), 0.5)[0])
        boxes, people = boxes + len(seen), people + len(true)
    return hits / people, hits / max(boxes, 1)


@pytest.mark.parametrize("method", ["knn", "mog2"])
def test_people_who_walk_are_found_and_little_else(method):
    recall, precision = found(Detect(method=method), small_scene())
    assert recall > 0.6
    assert precision > 0.6


def test_a_shaking_camera_is_made_up_for():
    shaken = small_scene(shake_px=2.5, contrast=6.0)
    _, unsteady = found(Detect(stabilise=False), shaken)
    _, steadied = found(Detect(stabilise=True), shaken)
    _, still = found(Detect(), small_scene(contrast=6.0))
    assert steadied > unsteady + 0.2
    assert steadied > still - 0.25


def test_boxes_are_those_of_the_picture_as_it_is_though_the_camera_moved():
    scene = small_scene(shake_px=3.0)
    frames, truth = footage(scene)
    off = []
    for (frame,), true in list(zip(Detect()(frames), truth, strict=True))[15:]:
        seen = columns_to_boxes(frame.rows)
        a, b = assign(1 - iou(true, seen), 0.5)
        off += ((true[a, :2] + true[a, 2:] / 2) - (seen[b, :2] + seen[b, 2:] / 2)).tolist()
    assert np.abs(np.median(off, axis=0)).max() < 1.0
    assert np.std(off, axis=0).max() < 3.0


def test_the_motion_of_the_camera_is_measured():
    still = next(small_scene().shots()).image.mean(axis=2).astype(np.uint8)
    camera = CameraMotion()
    camera.follow(still)
    moved = np.roll(still, (4, -6), axis=(0, 1))
    matrix, _ = camera.follow(moved)
    np.testing.assert_allclose(matrix, [[1, 0, 6], [0, 1, -4]], atol=0.15)
    assert np.array_equal(camera.follow(still)[0], [[1, 0, 0], [0, 1, 0]])


def test_a_camera_that_looks_elsewhere_starts_anew():
    here, there = (next(small_scene(seed=seed).shots()).image.mean(axis=2).astype(np.uint8) for seed in (1, 99))
    there = np.random.default_rng(0).permutation(there.ravel()).reshape(there.shape)
    camera = CameraMotion()
    assert camera.follow(here)[1]
    fresh = [camera.follow(there)[1] for _ in range(20)]
    assert fresh.count(True) == 1


def test_large_pictures_are_halved_and_their_boxes_are_in_full_pixels():
    frames, _ = footage(small_scene(3.0))
    large = [frame._replace(rows=np.kron(frame.rows, np.ones((2, 2), np.uint8))) for frame in frames]
    plain = [columns_to_boxes(f.rows) for (f,) in Detect(stabilise=False)(frames)]
    halved = [columns_to_boxes(f.rows) for (f,) in Detect(stabilise=False, max_pixels=320 * 180)(large)]
    for a, b in zip(plain, halved, strict=True):
        np.testing.assert_array_equal(2 * a, b)


def test_a_lamp_that_goes_on_is_not_a_person():
    frames, _ = footage(small_scene(3.0))
    lit = [
        f._replace(rows=np.clip(f.rows.astype(int) + 80 * (n > 20), 0, 255).astype(np.uint8))
        for n, f in enumerate(frames)
    ]
    for (frame,) in Detect()(lit):
        assert (frame.rows["w_px"] * frame.rows["h_px"] < 0.5 * 320 * 180).all()


def test_frame_difference_sees_what_moves_and_not_what_stands():
    floor = np.full((120, 160), 90, np.uint8)
    frames = []
    for number in range(30):
        image = floor.copy()
        image[20:60, 10 + 4 * number : 22 + 4 * number] = 200  # walks
        image[70:110, 100:112] = 200  # stands
        frames.append(Frame(ns(number / 10), number, image))
    for (frame,) in list(Detect(method="frame-difference", stabilise=False)(frames))[10:25]:
        boxes = columns_to_boxes(frame.rows)
        assert len(boxes) > 0
        assert (boxes[:, 1] + boxes[:, 3] < 66).all()
