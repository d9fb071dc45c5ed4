"""Registration of pictures to the view that a camera shows: a shaking camera shakes about it, a cut begins another."""

from __future__ import annotations

from collections import Counter
from typing import Final, Literal

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY, compose, invert, shift_px
from mcaptrack.geometry.arrays import Floats, Image
from mcaptrack.geometry.camera_path import FAR, CameraPose, MotionEstimator, Verdict
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import warn

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


# Check that the camera stands still enough for a motion detector, and warn or refuse if it does not.


#: A camera that moves in a larger share of the pictures than this is refused, in at least so many pictures.
_MAX_MOVING: Final = 0.5
_MIN_MOVING_PICTURES: Final = 15
#: From this share of the pictures on, a moving camera or a lost view is a warning.
_WARN_FROM: Final = 0.02


class Steadiness:
    """Counts the views of the camera, picture by picture."""

    def __init__(self) -> None:
        self._views: Counter[View] = Counter()
        self._restarts = -1  # the first picture starts the model
        self._start_ns: int | None = None
        self._span_ns: dict[bool, tuple[int, int]] = {}

    def update(self, t_ns: int, view: View, is_new: bool) -> None:
        """Take the view at a picture, and whether the background model starts again with it."""
        self._start_ns = t_ns if self._start_ns is None else self._start_ns
        self._views[view] += 1
        self._restarts += is_new
        if view != "steady":
            is_lost = view == "lost"
            self._span_ns[is_lost] = (self._span_ns.get(is_lost, (t_ns, t_ns))[0], t_ns)

    def check(self) -> None:
        """Warn if the camera moved or its view was lost. Raises McaptrackError if it moved in most pictures."""
        pictures = max(self._views.total(), 1)
        moving = self._views["moving"] / pictures
        lost = self._views["lost"] / pictures
        if moving > _MAX_MOVING and moving * pictures >= _MIN_MOVING_PICTURES:
            raise McaptrackError(
                f"the camera moves in {moving:.0%} of the pictures; a motion detector can't separate people from the "
                "background then. Use a detector that works on single pictures, or switch stabilise off to run anyway"
            )
        if moving >= _WARN_FROM:
            warn(
                f"the camera moves in {moving:.0%} of the pictures, {self._when(False)}: detections there "
                "are incomplete and may be wrong",
                "camera-moves",
            )
        if lost >= _WARN_FROM or (self._restarts > 0 and moving < _WARN_FROM):
            restarts = f"; the background model started again {self._restarts} times" if self._restarts > 0 else ""
            warn(
                f"the view of the camera was lost in {lost:.0%} of the pictures, {self._when(True)}{restarts}: cuts, "
                "changes of light, or a large object before the camera; detections there may be wrong",
                "view-lost",
            )

    def _when(self, is_lost: bool) -> str:
        first, last = ((t_ns - (self._start_ns or 0)) / NS_PER_S for t_ns in self._span_ns.get(is_lost, (0, 0)))
        return f"from {first:.1f} s to {last:.1f} s"
