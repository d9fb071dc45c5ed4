"""How the camera moves against where it stood: a similarity from each picture to a reference picture."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]

_FEATURES: Final = 200
_FEATURE_DISTANCE_PX: Final = 10
_RANSAC_PX: Final = 1.5
#: A fit is believed if so many features, and this share of them, agree on it.
_MIN_INLIERS: Final = 12
_MIN_SHARE: Final = 0.4
#: Below this the camera stands still: moving the picture would blur more than it would mend.
_STILL_PX: Final = 0.3
#: After so many pictures in a row without a believable fit the camera looks elsewhere.
_PATIENCE: Final = 15

IDENTITY: Final = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


class CameraMotion:
    """Follows corner points of a reference picture by optical flow; people who move are outliers of the fit."""

    def __init__(self) -> None:
        self._reference: Image | None = None
        self._points = np.empty((0, 1, 2), np.float32)
        self._last = IDENTITY
        self._misses = 0

    def follow(self, image: Image) -> tuple[Floats, bool]:
        """The similarity (2, 3) from pixels of ``image`` to those of the reference, and whether that is new."""
        if self._reference is None:
            self._set_reference(image)
            return IDENTITY, True
        found = self._fit(image)
        if found is None:
            self._misses += 1
            if self._misses > _PATIENCE:
                self._set_reference(image)
                return IDENTITY, True
            return self._last, False
        self._misses = 0
        height, width = image.shape
        corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float)
        shift = corners @ found.T - corners[:, :2]
        self._last = found if np.hypot(shift[:, 0], shift[:, 1]).max() >= _STILL_PX else IDENTITY
        return self._last, False

    def _set_reference(self, image: Image) -> None:
        import cv2

        found = cv2.goodFeaturesToTrack(image, _FEATURES, 0.01, _FEATURE_DISTANCE_PX)
        self._points = np.empty((0, 1, 2), np.float32) if found is None else np.asarray(found, np.float32)
        self._reference, self._last, self._misses = image, IDENTITY, 0

    def _fit(self, image: Image) -> Floats | None:
        import cv2

        if len(self._points) < _MIN_INLIERS or self._reference is None:
            return IDENTITY  # a picture without corners shows no motion either
        to_image = cv2.invertAffineTransform(self._last)
        guess = self._points[:, 0] @ to_image[:, :2].T + to_image[:, 2]
        guess = np.ascontiguousarray(guess[:, None], np.float32)
        # Called without a type: the stubs of OpenCV 4 and 5 differ on what may be None.
        flow = cv2.calcOpticalFlowPyrLK(self._reference, image, self._points, guess, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
        moved, ok = np.asarray(flow[0]), np.asarray(flow[1]).ravel() == 1
        if ok.sum() < _MIN_INLIERS:
            return None
        matrix, inliers = cv2.estimateAffinePartial2D(
            moved[ok], self._points[ok], method=cv2.RANSAC, ransacReprojThreshold=_RANSAC_PX
        )
        if matrix is None or inliers.sum() < max(_MIN_INLIERS, _MIN_SHARE * len(self._points)):
            return None
        return np.asarray(matrix, np.float64)
