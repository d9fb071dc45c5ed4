"""Registration of pictures to the view that a camera shows: a shaking camera shakes about it, a cut begins another."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np

from mcaptrack.geometry.affine import IDENTITY, compose, invert, shift_px
from mcaptrack.geometry.arrays import Floats, Image
from mcaptrack.geometry.camera_motion import MotionEstimator
from mcaptrack.geometry.camera_path import FAR, CameraPose, Verdict

#: How a picture lies to its view: near it (steady); further away than a camera shakes, so that a part of the picture
#: has no background, or on its way from picture to picture (moving); unknown (lost).
View = Literal["steady", "moving", "lost"]

#: A picture without a place in the view is one of a moving camera if more than this share of the diagonal lies between
#: it and the picture before.
_MOVING: Final = 0.002
#: After so many pictures in a row without a place in the view the next one begins another: until then, something large
#: may have passed before the camera.
_PATIENCE: Final = 15


class Registration:
    """Registers the pictures of a camera to views.

    A view begins with the first picture, some pictures after a cut, and where the camera has settled further away than
    it shakes.
    """

    def __init__(self) -> None:
        self.view: View = "steady"
        self._camera = MotionEstimator()
        self._size = (0, 0)
        self._misses = 0
        # The reference of the view, and the transforms from pixels of the view to it, and from the last picture.
        self._reference = (0, 0)
        self._anchor, self._last = IDENTITY, IDENTITY

    def register(self, image: Image) -> tuple[Floats, bool]:
        """The transform (2, 3) from pixels of ``image`` to those of its view, and whether the view begins with it.

        It is the object ``IDENTITY`` where the camera is still. Sets ``view``.
        """
        camera, before, self._size = self._camera, self._size, (image.shape[1], image.shape[0])
        pose, diagonal = camera.step(image), float(np.hypot(*self._size))
        reference, self.view = (pose.reference, camera.breaks), "steady"
        is_known = pose.verdict is not Verdict.LOST and not camera.is_guess and reference == self._reference
        self._misses = 0 if is_known else self._misses + 1
        if self._size != before or self._misses > _PATIENCE or (is_known and self._is_settled(pose, FAR * diagonal)):
            self._reference, self._anchor, self._last, self._misses = reference, pose.to_reference, IDENTITY, 0
            return IDENTITY, True
        if not is_known:
            self.view = "moving" if shift_px(pose.from_previous, *self._size) > _MOVING * diagonal else "lost"
            return self._last, False
        is_there = pose.to_reference is self._anchor
        self._last = IDENTITY if is_there else compose(invert(self._anchor), pose.to_reference)
        self.view = "moving" if shift_px(self._last, *self._size) > FAR * diagonal else "steady"
        return self._last, False

    def _is_settled(self, pose: CameraPose, far_px: float) -> bool:
        """Whether the camera stands elsewhere than in the view."""
        is_there = pose.to_reference is self._camera.stand
        return is_there and shift_px(compose(invert(self._anchor), pose.to_reference), *self._size) > far_px
