"""Check that the camera stands still enough for a motion detector, and warn or refuse if it does not."""

from __future__ import annotations

from collections import Counter
from typing import Final

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.transforms.detect.registration import View

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
