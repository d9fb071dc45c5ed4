"""The motion detectors on drawn scenes with known boxes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
import pytest

import mcaptrack
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY
from mcaptrack.geometry.assignment import assign
from mcaptrack.geometry.boxes import columns_to_boxes, iou
from mcaptrack.geometry.clocks import FrameClock
from mcaptrack.notices import collected
from mcaptrack.schema import DETECTIONS, VIDEO, Frame
from mcaptrack.sources.demo import SyntheticScene, pairs_scene
from mcaptrack.testing import check_transform
from mcaptrack.transforms import STAGES, KnnDetector, MedianDetector
from mcaptrack.transforms.detect.background import _BackgroundModel, _PersonHeight, clear_border, halve
from tests.tiers import one_in, thorough
from tests.worlds import ns, small_scene


def footage(scene: SyntheticScene) -> tuple[list[Frame], list[np.ndarray]]:
    shots = list(scene.shots())
    frames = [Frame(ns(shot.seconds), n, shot.image.mean(axis=2).astype(np.uint8)) for n, shot in enumerate(shots)]
    return frames, [shot.boxes for shot in shots]


def found(detect: KnnDetector, scene: SyntheticScene, from_frame: int = 15) -> tuple[float, float]:
    """Recall and precision at an overlap of 0.5, once the background is known."""
    frames, truth = footage(scene)
    hits = boxes = people = 0
    for (frame,), true in list(zip(detect(frames), truth, strict=True))[from_frame:]:
        seen = columns_to_boxes(frame.rows)
        hits += len(assign(1 - iou(true, seen), 0.5)[0])
        boxes, people = boxes + len(seen), people + len(true)
    return hits / people, hits / max(boxes, 1)


def test_walking_people_are_detected_with_few_false_positives():
    recall, precision = found(KnnDetector(), small_scene())
    assert recall > 0.6
    assert precision > 0.6


def test_boxes_are_in_pixels_of_the_picture_before_registration():
    scene = small_scene(shake_px=3.0)
    frames, truth = footage(scene)
    off = []
    for (frame,), true in list(zip(KnnDetector()(frames), truth, strict=True))[15:]:
        seen = columns_to_boxes(frame.rows)
        a, b = assign(1 - iou(true, seen), 0.5)
        off += ((true[a, :2] + true[a, 2:] / 2) - (seen[b, :2] + seen[b, 2:] / 2)).tolist()
    assert np.abs(np.median(off, axis=0)).max() < 1.0
    assert np.std(off, axis=0).max() < 3.0


def test_masks_do_not_depend_on_what_else_draws_random_numbers():
    noise = np.random.default_rng(1).integers(0, 256, (30, 40, 60)).astype(np.uint8)

    def masks(seed: int) -> list[np.ndarray]:
        model, clock = _BackgroundModel(800.0, 2.0), FrameClock()
        out = []
        for n, image in enumerate(noise):
            clock.tick(ns(n / 10))
            cv2.setRNGSeed(seed + n)
            out.append(model.mask(image, clock))
        return out

    first, second = masks(1), masks(700)
    assert 0 < np.mean(first) < 255
    assert np.array_equal(first, second)


def blocks(*boxes: tuple[int, int, int, int], height: int = 120, width: int = 160) -> np.ndarray:
    """Bright blocks (left, top, width, height) on a grey floor."""
    image = np.full((height, width), 90, np.uint8)
    for left, top, wide, high in boxes:
        image[top : top + high, left : left + wide] = 220
    return image


STILL = KnnDetector(stabilise=False)


def boxes_of(pictures: list[np.ndarray], detector: KnnDetector = STILL) -> list[list[list[float]]]:
    frames = [Frame(ns(n / 10), n, picture) for n, picture in enumerate(pictures)]
    return [columns_to_boxes(frame.rows).tolist() for (frame,) in detector(frames)]


EMPTY = [blocks()] * 5


def test_boxes_equal_the_drawn_ones_sorted_from_top_to_bottom():
    """Two people walk past each other, each a step further than they are wide; a third appears in the end."""
    drawn = [[(2 + 13 * n, 75, 12, 34), (146 - 11 * n, 20, 10, 30)] for n in range(10)]
    drawn[-1].append((75, 70, 11, 32))
    found = boxes_of([*[blocks()] * 30, *(blocks(*each) for each in drawn)], KnnDetector(stabilise=False))
    assert all(boxes == [] for boxes in found[:30])
    for boxes, each in zip(found[30:], drawn, strict=True):
        assert boxes == [list(map(float, box)) for box in sorted(each, key=lambda box: (box[1], box[0]))]


@pytest.mark.parametrize(("gap", "parts"), [(0, 1), (6, 1), (12, 2)])
def test_regions_above_each_other_are_joined_over_a_fifth_of_a_height(gap, parts):
    """People are 40 px tall; regions up to 8 px apart are joined if they lie above each other, not side by side."""
    people = [[(20 + 3 * n, 60, 12, 40)] for n in range(12)]
    broken = [(60, 20, 12, 20), (60, 40 + gap, 12, 20)]
    beside = [(60, 20, 12, 40), (72 + max(gap, 1), 20, 12, 40)]
    *_, above = boxes_of([*EMPTY, *(blocks(*each) for each in people), blocks(*broken)])
    *_, across = boxes_of([*EMPTY, *(blocks(*each) for each in people), blocks(*beside)])
    assert len(above) == parts
    assert len(across) == 2


def test_regions_below_the_minimum_area_are_left_out():
    """The minimum is 3 % of the squared height of people so far, and at least 20 px."""
    people = [[(20 + 3 * n, 60, 12, 40)] for n in range(12)]
    # Areas of outlines: 35, 42, 56; the minimum is 48.
    for size, seen in (((6, 8), False), ((7, 8), False), ((8, 9), True)):
        *_, boxes = boxes_of([*EMPTY, *(blocks(*each) for each in people), blocks((100, 30, *size))])
        assert len(boxes) == seen
    # Areas of 20 and 25, and of 16; no person was measured yet.
    *_, first = boxes_of([*EMPTY, blocks((100, 30, 5, 6), (20, 30, 6, 6))])
    assert len(first) == 2
    *_, first = boxes_of([*EMPTY, blocks((100, 30, 5, 5), (20, 30, 6, 6))])
    assert first == [[20.0, 30.0, 6.0, 6.0]]


def test_the_height_of_people_is_the_median_height_weighted_by_area():
    """Regions of at least 20 px of area count, if less than half as high as the picture; before ten of them it is 20."""
    height = _PersonHeight()
    small, tall = blocks((10, 10, 10, 10), (40, 10, 10, 10)), blocks((10, 10, 12, 40))
    high, speck = blocks((100, 10, 20, 70)), blocks((100, 10, 5, 5))
    masks = [np.where(picture > 90, np.uint8(255), np.uint8(0)) for picture in (small, tall, high, speck)]
    assert [height.update(masks[k]) for k in (0, 0, 2, 3, 0, 0)] == [20.0] * 6
    assert height.update(masks[0]) == 10.0  # ten regions of 100 px^2
    assert height.update(masks[1]) == 10.0  # 480 against 1000 px^2
    assert height.update(masks[1]) == 10.0  # 960
    assert height.update(masks[1]) == 40.0  # 1440


def test_a_border_as_wide_as_the_farthest_corner_moves_is_cleared():
    """Of a picture of 160x120 pixels, and a pixel more."""
    for motion, border in (
        ([[1, 0, 3.2], [0, 1, -1.5]], 5),
        ([[1, 0, 0.4], [0, 1, -7.0]], 8),
        ([[1.1, 0, 0], [0, 1.1, 0]], 17),
        ([[0.9, 0, 8], [0, 0.9, 6]], 9),
    ):
        cleared = clear_border(np.full((120, 160), 255, np.uint8), np.array(motion, float))
        wanted = np.zeros((120, 160), np.uint8)
        wanted[border : 120 - border, border : 160 - border] = 255
        assert (cleared == wanted).all()
    mask = np.full((4, 6), 255, np.uint8)
    assert clear_border(mask, IDENTITY) is mask


def test_no_detections_where_more_than_half_of_the_picture_differs():
    for share, seen in ((0.45, 1), (0.55, 0)):
        *_, boxes = boxes_of([*EMPTY, blocks((0, 0, round(160 * share), 120))])
        assert len(boxes) == seen


@pytest.mark.parametrize("name", ["knn", "median"])
def test_a_camera_that_turns_slowly_is_refused(name):
    """By less from picture to picture than a camera shakes, but further away in the end."""
    wide = np.kron(np.random.default_rng(4).integers(40, 200, (20, 60, 1)), np.ones((8, 8, 3))).astype(np.uint8)
    frames = [Frame(ns(n / 10), n, np.ascontiguousarray(wide[:, 2 * n : 2 * n + 240])) for n in range(60)]
    if name == "knn":
        frames = [frame._replace(rows=frame.rows[..., 0].copy()) for frame in frames]
    detector = STAGES["detect"].built_in()[name]
    with pytest.raises(McaptrackError, match=r"^the camera moves in 7\d% of the pictures"):
        list(detector()(frames))
    list(detector(stabilise=False)(frames))


@pytest.mark.parametrize(
    ("shape", "max_pixels", "halved"),
    [
        ((8, 8), 64, (8, 8)), ((8, 8), 63, (4, 4)), ((8, 8), 16, (4, 4)), ((8, 8), 15, (2, 2)), ((9, 7), 20, (4, 3)),
        ((4, 100), 10, (2, 50)), ((100, 3), 10, (100, 3)), ((2, 2), 1, (2, 2)),
    ],
)  # fmt: skip
def test_pictures_are_halved_until_they_are_small_enough_or_narrow(shape, max_pixels, halved):
    image, halvings = halve(np.zeros(shape, np.uint8), max_pixels)
    assert image.shape == halved == tuple(side >> halvings for side in shape)


@pytest.mark.parametrize("stabilise", one_in(2, [True, False]))
@pytest.mark.parametrize("name", ["knn", "median"])
def test_pictures_of_another_size_begin_another_view(name, stabilise):
    """The detections after the change are those of the pictures after it alone."""
    detector = STAGES["detect"].built_in()[name](stabilise=stabilise)
    shots = list(small_scene(seconds=4.0).shots())
    wide = [Frame(ns(shot.seconds), n, shot.image) for n, shot in enumerate(shots)]
    if name != "median":
        wide = [frame._replace(rows=frame.rows.mean(axis=2).astype(np.uint8)) for frame in wide]
    narrow = [f._replace(t_ns=f.t_ns + ns(4.0), index=f.index + len(wide), rows=f.rows[:, 40:].copy()) for f in wide]
    with collected() as warnings:
        both = [frame for (frame,) in detector([*wide, *narrow])]
    alone = [frame for (frame,) in detector(wide)], [frame for (frame,) in detector(narrow)]
    assert [len(frame.rows) for frame in both[: len(wide)]] == [len(frame.rows) for frame in alone[0]]
    assert sum(len(frame.rows) for frame in both[len(wide) :]) > 0
    assert "view-lost" in {warning.code for warning in warnings}
    if name == "median":  # the others know the height of people by then, and have seen random numbers
        for late, frame in zip(both[len(wide) :], alone[1], strict=True):
            np.testing.assert_array_equal(columns_to_boxes(late.rows), columns_to_boxes(frame.rows))


@thorough
def test_leaves_that_sway_do_not_pass_for_people_far_away():
    """A tree gives more outlines than three pairs who cross the square; of its height there are no people."""
    scene = replace(pairs_scene(10), fps=5)
    frames = [Frame(200_000_000 * number, number, shot.image) for number, shot in enumerate(scene.shots())]
    bottom = np.concatenate([frame.rows["y_px"] + frame.rows["h_px"] for (frame,) in MedianDetector()(frames)])
    assert (bottom < 100).sum() < 0.15 * len(bottom)


# Detectors get brightness or colours of pictures, as they ask for.


#: Blue, green and red of the pictures, which become BT.601 brightness.
BGR = (200, 90, 30)
GREY = 0.114 * 200 + 0.587 * 90 + 0.299 * 30


@dataclass(frozen=True, kw_only=True)
class Plain:
    """A detector that keeps what it gets, and says nothing of colours."""

    reads: ClassVar = VIDEO
    writes: ClassVar = {"": DETECTIONS}
    latency_s: ClassVar = {"": 0.0}
    seen: ClassVar[list[np.ndarray]] = []

    def __call__(self, frames):
        for frame in frames:
            self.seen.append(frame.rows)
            yield (frame._replace(rows=DETECTIONS.empty()),)


@dataclass(frozen=True, kw_only=True)
class Coloured(Plain):
    colour: ClassVar = "bgr"
    seen: ClassVar[list[np.ndarray]] = []


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures") / "frames"
    folder.mkdir()
    for number in range(3):
        cv2.imwrite(str(folder / f"{number:03}.png"), np.full((48, 64, 3), BGR, np.uint8))
    path = folder.parent / "log.mcap"
    mcaptrack.ingest(folder, output=path, fps=10)
    return path


def test_a_detector_gets_colours_if_it_asks_for_them_and_brightness_otherwise(log, tmp_path):
    for detector, expected in ((Plain(), GREY), (Coloured(), BGR)):
        detector.seen.clear()
        mcaptrack.detect(log, detector=detector, output=tmp_path / f"{type(detector).__name__}.mcap")
        assert [picture.shape for picture in detector.seen] == [(48, 64, 3)[: np.ndim(expected) + 2]] * 3
        assert np.abs(detector.seen[0].astype(float) - expected).max() < 6  # video is lossy


def test_laws_are_checked_with_the_pictures_that_a_detector_asks_for():
    for detector, axes in ((Plain, 2), (Coloured, 3)):
        detector.seen.clear()
        check_transform(detector())
        assert {picture.ndim for picture in detector.seen} == {axes}


def test_an_unknown_kind_of_picture_is_refused(tmp_path, monkeypatch):
    (tmp_path / "odd_detector.py").write_text(
        "from tests.test_detect import Plain\nclass Odd(Plain):\n    colour = 'hsv'\n", encoding="utf-8"
    )
    monkeypatch.chdir(tmp_path)
    with pytest.raises(McaptrackError, match=r"detector odd_detector:Odd.*has colour = 'hsv'; it is 'bgr' or 'grey'"):
        STAGES["detect"].find("odd_detector:Odd")
