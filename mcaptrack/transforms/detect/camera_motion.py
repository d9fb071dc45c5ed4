"""Camera motion: a similarity transform from each picture to a reference picture."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.affine import IDENTITY, move_points, shift_px
from mcaptrack.geometry.arrays import Floats, Image

Points = NDArray[np.float32]

_FEATURES: Final = 200
_FEATURE_DISTANCE_PX: Final = 10
_RANSAC_PX: Final = 1.5
#: A fit needs so many inliers, and this share of all features.
_MIN_INLIERS: Final = 12
_MIN_INLIER_RATIO: Final = 0.4
#: Below this shift the camera stands still: resampling the picture would blur more than it corrects.
_STILL_PX: Final = 0.3
#: After so many pictures in a row without a fit the next one becomes the reference.
_MAX_MISSES: Final = 15

#: A shift from the reference of more than this share of the picture's diagonal is more than shaking: up to a quarter of
#: the picture has no background model then.
_FAR: Final = 0.1

#: The same from one picture to the next: beyond it the camera is moving. In a crowd the fit drifts by less than this.
_MOVING: Final = 0.002

#: The view at a picture: near the reference (steady); too far from it (far); the camera is moving (moving); no fit
#: (lost).
View = Literal["steady", "far", "moving", "lost"]


class CameraMotion:
    """Registers pictures by optical flow of corner points; moving people are outliers of the fit."""

    def __init__(self) -> None:
        self.view: View = "steady"
        self._before: Image | None = None
        self._reference: Image | None = None
        self._points = np.empty((0, 1, 2), np.float32)
        self._last = IDENTITY
        self._misses = 0

    def estimate(self, image: Image) -> tuple[Floats, bool]:
        """The similarity (2, 3) from pixels of ``image`` to those of the reference, and whether the reference is new.

        Sets ``view``.
        """
        before, self._before = self._before, image
        if self._reference is None or before is None or before.shape != image.shape:
            self._set_reference(image)
            return IDENTITY, True
        import cv2

        to_image = np.asarray(cv2.invertAffineTransform(self._last), np.float64)
        found = _fit(self._reference, image, self._points, move_points(to_image, self._points[:, 0].astype(np.float64)))
        if found is None:
            self.view = "moving" if _moves(before, image) else "lost"
            self._misses += 1
            if self._misses > _MAX_MISSES:
                self._set_reference(image)
                return IDENTITY, True
            return self._last, False
        self._misses = 0
        off_px = shift_px(found, *image.shape[::-1])
        self._last = found if off_px >= _STILL_PX else IDENTITY
        self.view = "far" if off_px > _FAR * np.hypot(*image.shape) else "steady"
        return self._last, False

    def _set_reference(self, image: Image) -> None:
        self._points = _corners(image)
        self._reference, self._last, self._misses = image, IDENTITY, 0


def _corners(image: Image) -> Points:
    """Corner points (N, 1, 2), to be tracked by optical flow."""
    import cv2

    found = cv2.goodFeaturesToTrack(image, _FEATURES, 0.01, _FEATURE_DISTANCE_PX)
    return np.empty((0, 1, 2), np.float32) if found is None else np.asarray(found, np.float32)


def _fit(first: Image, second: Image, points: Points, guess: Floats) -> Floats | None:
    """The similarity (2, 3) from pixels of the second picture to those of the first; None if too few points agree.

    Optical flow finds ``points`` (N, 1, 2) of the first picture in the second, starting at ``guess`` (N, 2).
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
    if matrix is None or inliers.sum() < max(_MIN_INLIERS, _MIN_INLIER_RATIO * len(points)):
        return None
    return np.asarray(matrix, np.float64)


def _moves(before: Image, image: Image) -> bool:
    """Whether the camera moved since the picture before: most points share one shift.

    They don't where an object covers the view, where the light changes, and at a cut.
    """
    points = _corners(before)
    found = _fit(before, image, points, points[:, 0].astype(np.float64)) if len(points) else None
    return found is not None and shift_px(found, *image.shape[::-1]) > _MOVING * np.hypot(*image.shape)
