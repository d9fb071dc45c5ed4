"""Motion of the camera: thresholds of warnings and of refusal, and the shares and times in their texts."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack import notices
from mcaptrack.errors import McaptrackError
from mcaptrack.transforms.detect.background import Registration, Steadiness
from tests.worlds import ns


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
    import cv2

    moved = cv2.warpAffine(wide, np.array([[1.0, 0, -by], [0, 1, 0]]), (wide.shape[1], wide.shape[0]))
    return np.ascontiguousarray(moved[:, :240])


def test_a_shift_of_more_than_a_tenth_of_the_diagonal_is_motion():
    """A tenth of the diagonal of 240 x 160 pixels is 28.8 px; the camera turns slowly, so that each picture fits."""
    wide, camera, views = textured(width=480), Registration(), {}
    for by in range(33):
        camera.register(shifted(wide, by))
        views[by] = camera.view
    assert {by: view for by, view in views.items() if abs(by - 28.8) > 0.5} == {
        by: "moving" if by > 28.8 else "steady" for by in views if abs(by - 28.8) > 0.5
    }


@pytest.mark.parametrize(("by", "is_moved"), [(0.15, False), (0.6, True)])
def test_a_shift_below_a_third_of_a_pixel_is_no_motion(by, is_moved):
    wide, camera = textured(width=480), Registration()
    camera.register(shifted(wide, 0))
    found, _ = camera.register(shifted(wide, by))
    assert (found[0, 2] != 0) == is_moved
    assert found[0, 2] == pytest.approx(by * is_moved, abs=0.15)


def test_a_picture_without_a_fit_lies_where_the_one_before_it_lay():
    wide, other, camera = textured(width=480), textured(width=480, seed=4), Registration()
    camera.register(shifted(wide, 0))
    before, _ = camera.register(shifted(wide, 5))
    found, begins = camera.register(shifted(other, 5))
    assert (camera.view, begins) == ("lost", False)
    assert before[0, 2] == pytest.approx(5, abs=0.3)
    np.testing.assert_array_equal(found, before)


def test_a_camera_that_has_come_to_stand_elsewhere_shakes_about_that_place():
    wide, camera = textured(width=480), Registration()
    path = [*np.arange(0, 50, 2.0), *[50.0] * 60]
    begins = [camera.register(shifted(wide, by))[1] for by in path]
    assert begins[0]
    assert begins[1:].count(True) == 1
    found, _ = camera.register(shifted(wide, 52))
    assert camera.view == "steady"
    assert found[0, 2] == pytest.approx(2, abs=0.3)


def test_a_picture_without_a_fit_is_moving_or_lost():
    """Moving: all points share one shift since the picture before. Lost: none of them is found again."""
    wide, other = textured(width=480), textured(width=480, seed=4)
    camera = Registration()
    camera.register(shifted(wide, 0))
    assert camera.view == "steady"
    camera.register(shifted(other, 0))
    assert camera.view == "lost"
    camera.register(shifted(other, 0.2))  # a five-hundredth of the diagonal is 0.58 px
    assert camera.view == "lost"
    camera.register(shifted(other, 3))
    assert camera.view == "moving"
    camera.register(shifted(wide, 0))
    assert camera.view == "steady"
