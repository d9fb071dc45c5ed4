"""Foreground of a picture: a mask of the pixels that differ from the background, or from the pictures before."""

from __future__ import annotations

from collections import deque
from typing import Any, Final, Literal

import numpy as np

from mcaptrack.geometry.arrays import Image
from mcaptrack.geometry.clocks import FrameClock

Method = Literal["knn", "mog2", "frame-difference"]

#: Default thresholds by method, in its own units: squared distance of brightness; variances; brightness.
THRESHOLDS: Final[dict[str, float]] = {"knn": 800.0, "mog2": 50.0, "frame-difference": 9.0}
_FOREGROUND: Final = 255  # OpenCV marks shadows with 127
_BLUR_PX: Final = 5
# Frame differences span this long; three of them, one frame apart, are computed, and the largest counts.
_SPAN_S: Final = 5 / 30
_PAIRS: Final = 3


class BackgroundSubtractor:
    """Background subtraction with OpenCV's KNN or MOG2, which learns over ``history_s``, and faster at first."""

    def __init__(self, method: Method, threshold: float, history_s: float) -> None:
        import cv2

        # Annotated loosely: the stubs of OpenCV 4 and 5 differ.
        make: Any = cv2.createBackgroundSubtractorKNN if method == "knn" else cv2.createBackgroundSubtractorMOG2
        self._model = make(500, threshold, True)
        self._history_s = history_s
        self._count = 0

    def mask(self, image: Image, clock: FrameClock) -> Image:
        """255 where ``image`` (height, width) shows foreground."""
        import cv2

        self._count += 1
        # KNN draws from OpenCV's random number generator; without a seed results would differ from run to run.
        cv2.setRNGSeed(self._count)
        rate = 1 / min(2 * self._count, max(clock.frames(self._history_s), 2))
        found = self._model.apply(image, learningRate=rate)
        return np.where(np.asarray(found) == _FOREGROUND, np.uint8(255), np.uint8(0))


class FrameDifference:
    """The paper's motion detector: the largest of three differences between blurred pictures 1/6 s apart."""

    def __init__(self, threshold: float) -> None:
        self._threshold = threshold
        self._past: deque[Image] = deque()

    def mask(self, image: Image, clock: FrameClock) -> Image:
        """255 where ``image`` (height, width) differs from 1/6 s before; 0 everywhere until then."""
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


def make_foreground_model(
    method: Method, threshold: float | None, history_s: float
) -> BackgroundSubtractor | FrameDifference:
    """The foreground model of a method, with the default threshold of the method if it is None."""
    limit = THRESHOLDS[method] if threshold is None else threshold
    return FrameDifference(limit) if method == "frame-difference" else BackgroundSubtractor(method, limit, history_s)
