"""Whether a part of the picture moves as a whole, otherwise than the scene: one motion can't be right for both then.

Such a part is the inside of a vehicle that the camera looks out of, or a place much nearer than the rest.

Transforms are affine, (2, 3), see ``affine``.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.affine import IDENTITY, compose, invert, move_boxes, move_points
from mcaptrack.geometry.arrays import Floats, Image
from mcaptrack.geometry.camera_motion import features, reduced
from mcaptrack.geometry.camera_path import CameraPose, Verdict

#: One picture of so many is compared with that so many before it.
_EVERY, _APART = 10, 3
#: Of the features, so large a share moves otherwise than the scene, and so large a share as one, over this share of
#: the picture.
_OTHERS, _AS_ONE, _MIN_AREA = 0.3, 0.25, 0.1
_MIN_FEATURES: Final = 24
# In pixels of the reduced picture: from here on features move otherwise, and up to here alike.
_OTHERWISE_PX, _ALIKE_PX = 1.0, 0.75
# Flow is searched in windows of this size, on so many reduced copies of the picture.
_WINDOW_PX, _LEVELS = 11, 4


class SecondMotion:
    """Looks for such a part in some of the pictures of a camera.

    Attributes
    ----------
    examined, divided : int
        How many pictures were looked at, and in how many of them a part moves otherwise.

    """

    def __init__(self) -> None:
        self.examined = self.divided = 0
        self._count = 0
        self._before: Image | None = None
        self._boxes: Floats | None = None
        self._motion = IDENTITY

    def step(self, image: Image, pose: CameraPose, boxes: Floats | None = None) -> None:
        """Take the next picture (height, width) in gray, with the pose that was estimated.

        ``boxes`` (N, 4) are left, top, width and height, in pixels, of what may move by itself.
        """
        at, self._count = self._count % _EVERY, self._count + 1
        if at == 0:
            self._before, self._boxes, self._motion = image, boxes, IDENTITY
            return
        if self._before is None:
            return
        if pose.verdict > Verdict.MOVING or self._before.shape != image.shape:
            self._before = None
            return
        self._motion = compose(pose.from_previous, self._motion)
        if at == _APART:
            self.examined += 1
            self.divided += _is_divided(self._before, image, self._motion, self._boxes)
            self._before = None


def _is_divided(before: Image, now: Image, motion: Floats, boxes: Floats | None) -> bool:
    """Whether a part of two pictures moves as a whole, otherwise than ``motion`` (2, 3)."""
    import cv2

    (first, to_small), (second, _) = reduced(before), reduced(now)
    points, _ = features(first.image, None if boxes is None else move_boxes(to_small, boxes))
    if len(points) < _MIN_FEATURES:
        return False
    # Called without a type: the stubs of OpenCV 4 and 5 differ on what may be None.
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        first.image, second.image, points, points.copy(), winSize=(_WINDOW_PX,) * 2, maxLevel=_LEVELS
    )
    known = np.asarray(found).ravel() == 1
    then, there = points[known, 0], np.asarray(moved, np.float32)[known, 0]
    if len(then) < _MIN_FEATURES:
        return False
    small = compose(to_small, compose(motion, invert(to_small)))
    off = np.hypot(*(move_points(small, then.astype(float)) - there).T)
    others = off > _OTHERWISE_PX
    if np.count_nonzero(others) < _OTHERS * len(then):
        return False
    _, agree = cv2.estimateAffinePartial2D(
        then[others], there[others], method=cv2.RANSAC, ransacReprojThreshold=_ALIKE_PX, maxIters=200, refineIters=0
    )
    as_one = np.asarray(agree, np.bool_).ravel()
    if np.count_nonzero(as_one) < _AS_ONE * len(then):
        return False
    return bool(np.ptp(there[others][as_one], axis=0).prod() >= _MIN_AREA * first.image.size)
