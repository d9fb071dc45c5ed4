"""What moves in a picture: a mask of the pixels that differ from what was there before."""

from __future__ import annotations

from collections import deque
from typing import Any, Final, Literal

import numpy as np

from mcaptrack.geometry.arrays import Image
from mcaptrack.geometry.clocks import FrameClock

Method = Literal["knn", "mog2", "frame-difference"]

#: What counts as different, by method: squared distance of brightness; squared deviations; brightness.
THRESHOLDS: Final[dict[str, float]] = {"knn": 800.0, "mog2": 50.0, "frame-difference": 9.0}
_FOREGROUND: Final = 255  # 127 is shadow
_BLUR_PX: Final = 5
# Each frame difference spans this long; there are three, one frame apart, and the largest of them counts.
_SPAN_S: Final = 5 / 30
_PAIRS: Final = 3


class Background:
    """A model of the background (OpenCV's KNN or MOG2); it learns over ``history_s``, quickly at first."""

    def __init__(self, method: Method, threshold: float, history_s: float) -> None:
        import cv2

        # Annotated loosely: the stubs of OpenCV 4 and 5 differ.
        make: Any = cv2.createBackgroundSubtractorKNN if method == "knn" else cv2.createBackgroundSubtractorMOG2
        self._model = make(500, threshold, True)
        self._history_s = history_s
        self._seen = 0

    def mask(self, image: Image, clock: FrameClock) -> Image:
        """255 where ``image`` (height, width) shows foreground."""
        import cv2

        self._seen += 1
        # KNN draws random numbers from OpenCV's generator; the same input must give the same boxes.
        cv2.setRNGSeed(self._seen)
        rate = 1 / min(2 * self._seen, max(clock.frames(self._history_s), 2))
        found = self._model.apply(image, learningRate=rate)
        return np.where(np.asarray(found) == _FOREGROUND, np.uint8(255), np.uint8(0))


class FrameDifference:
    """The paper's motion detector: the largest of three differences between blurred pictures a moment apart."""

    def __init__(self, threshold: float) -> None:
        self._threshold = threshold
        self._past: deque[Image] = deque()

    def mask(self, image: Image, clock: FrameClock) -> Image:
        """255 where ``image`` (height, width) differs from a moment before; nothing until there is a moment before."""
        import cv2

        span = clock.frames(_SPAN_S)
        self._past.append(np.asarray(cv2.GaussianBlur(image, (_BLUR_PX, _BLUR_PX), 0), np.uint8))
        while len(self._past) > span + _PAIRS:
            self._past.popleft()
        if len(self._past) < span + _PAIRS:
            return np.zeros_like(image)
        largest = cv2.absdiff(self._past[0], self._past[span])
        for first in range(1, _PAIRS):
            largest = cv2.max(largest, cv2.absdiff(self._past[first], self._past[first + span]))
        return np.where(np.asarray(largest) > self._threshold, np.uint8(255), np.uint8(0))


def model(method: Method, threshold: float | None, history_s: float) -> Background | FrameDifference:
    """The named method, with its own threshold where none is given."""
    limit = THRESHOLDS[method] if threshold is None else threshold
    return FrameDifference(limit) if method == "frame-difference" else Background(method, limit, history_s)
