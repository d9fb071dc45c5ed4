"""Detectors get brightness or colours of pictures, as they ask for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
import pytest

import mcaptrack
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import DETECTIONS, VIDEO
from mcaptrack.testing import check_transform
from mcaptrack.transforms import STAGES

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
        "from tests.test_colour import Plain\nclass Odd(Plain):\n    colour = 'hsv'\n", encoding="utf-8"
    )
    monkeypatch.chdir(tmp_path)
    with pytest.raises(McaptrackError, match=r"detector odd_detector:Odd.*has colour = 'hsv'; it is 'bgr' or 'grey'"):
        STAGES["detect"].find("odd_detector:Odd")
