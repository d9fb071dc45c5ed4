"""How the camera moves against where it stood: a similarity from each picture to a reference picture."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Image

Points = NDArray[np.float32]

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

#: A camera that looks further from where it looked first than this share of the picture's diagonal does more than
#: shake: a quarter of the picture lies outside of what is known of the background.
_FAR: Final = 0.1

#: The same from one picture to the next: from so much on it is on its way; in a crowd the rest seems to creep.
_MOVING: Final = 0.002

#: What is known of the camera at a picture: it looks where it looked; too far off; it is on its way; or nothing.
View = Literal["steady", "far", "moving", "lost"]

IDENTITY: Final = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


class CameraMotion:
    """Follows corner points of a reference picture by optical flow; people who move are outliers of the fit."""

    def __init__(self) -> None:
        self.view: View = "steady"
        self._before: Image | None = None
        self._reference: Image | None = None
        self._points = np.empty((0, 1, 2), np.float32)
        self._last = IDENTITY
        self._misses = 0

    def follow(self, image: Image) -> tuple[Floats, bool]:
        """The similarity (2, 3) from pixels of ``image`` to those of the reference, and whether that is new.

        Afterwards ``view`` says what is known of the camera.
        """
        before, self._before = self._before, image
        if self._reference is None or before is None:
            self._set_reference(image)
            return IDENTITY, True
        import cv2

        to_image = np.asarray(cv2.invertAffineTransform(self._last), np.float64)
        found = _fit(self._reference, image, self._points, self._points[:, 0] @ to_image[:, :2].T + to_image[:, 2])
        if found is None:
            self.view = "moving" if _moves(before, image) else "lost"
            self._misses += 1
            if self._misses > _PATIENCE:
                self._set_reference(image)
                return IDENTITY, True
            return self._last, False
        self._misses = 0
        shift_px = _shift(found, image)
        self._last = found if shift_px >= _STILL_PX else IDENTITY
        self.view = "far" if shift_px > _FAR * np.hypot(*image.shape) else "steady"
        return self._last, False

    def _set_reference(self, image: Image) -> None:
        self._points = _corners(image)
        self._reference, self._last, self._misses = image, IDENTITY, 0


def _corners(image: Image) -> Points:
    """Points (N, 1, 2) that can be found again."""
    import cv2

    found = cv2.goodFeaturesToTrack(image, _FEATURES, 0.01, _FEATURE_DISTANCE_PX)
    return np.empty((0, 1, 2), np.float32) if found is None else np.asarray(found, np.float32)


def _fit(first: Image, second: Image, points: Points, guess: Floats) -> Floats | None:
    """The similarity (2, 3) from pixels of the second picture to those of the first; None if there is none to believe.

    It follows from where ``points`` (N, 1, 2) of the first went, which is near ``guess`` (N, 2).
    """
    import cv2

    if len(points) < _MIN_INLIERS:
        return IDENTITY  # a picture without corners shows no motion either
    near = np.ascontiguousarray(guess[:, None], np.float32)
    # Called without a type: the stubs of OpenCV 4 and 5 differ on what may be None.
    flow = cv2.calcOpticalFlowPyrLK(first, second, points, near, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
    moved, ok = np.asarray(flow[0]), np.asarray(flow[1]).ravel() == 1
    if ok.sum() < _MIN_INLIERS:
        return None
    matrix, inliers = cv2.estimateAffinePartial2D(
        moved[ok], points[ok], method=cv2.RANSAC, ransacReprojThreshold=_RANSAC_PX
    )
    if matrix is None or inliers.sum() < max(_MIN_INLIERS, _MIN_SHARE * len(points)):
        return None
    return np.asarray(matrix, np.float64)


def _moves(before: Image, image: Image) -> bool:
    """Whether most of a picture moved as one since the picture before.

    Not so where something covers the view, where the light changes, and at a cut.
    """
    points = _corners(before)
    found = _fit(before, image, points, points[:, 0].astype(np.float64)) if len(points) else None
    return found is not None and _shift(found, image) > _MOVING * np.hypot(*image.shape)


def _shift(matrix: Floats, image: Image) -> float:
    """How far a similarity moves the corners of a picture at most, in pixels."""
    height, width = image.shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float)
    shift = corners @ matrix.T - corners[:, :2]
    return float(np.hypot(shift[:, 0], shift[:, 1]).max())
