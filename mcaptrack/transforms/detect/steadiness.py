"""Whether the camera stood still enough for a motion detector, and what is said if it did not."""

from __future__ import annotations

from collections import Counter
from typing import Final

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.transforms.detect.motion import View

#: A camera that moves in more pictures than this share doesn't stand; one that moves in fewer than the other does.
_MOST_MOVING: Final = 0.5
_LEAST_ODD: Final = 0.02
#: In fewer pictures than this nothing is certain.
_LEAST_PICTURES: Final = 15


class Steadiness:
    """Counts what is known of the camera, picture by picture."""

    def __init__(self) -> None:
        self._views: Counter[View] = Counter()
        self._changes = -1  # the first picture is no change
        self._start_ns: int | None = None
        self._span_ns: dict[bool, tuple[int, int]] = {}

    def see(self, t_ns: int, view: View, is_new: bool) -> None:
        """A picture, and whether the background begins anew with it."""
        self._start_ns = t_ns if self._start_ns is None else self._start_ns
        self._views[view] += 1
        self._changes += is_new
        if view != "steady":
            is_lost = view == "lost"
            self._span_ns[is_lost] = (self._span_ns.get(is_lost, (t_ns, t_ns))[0], t_ns)

    def judge(self) -> None:
        """Warn where the camera moved or its view was lost. Raises McaptrackError if it moves most of the time."""
        pictures = max(self._views.total(), 1)
        moving = (self._views["moving"] + self._views["far"]) / pictures
        lost = self._views["lost"] / pictures
        if moving > _MOST_MOVING and moving * pictures >= _LEAST_PICTURES:
            raise McaptrackError(
                f"the camera moves in {moving:.0%} of the pictures; what moves before it can't be told from the rest. "
                "Bring boxes of a detector that looks at single pictures, or switch stabilise off to insist"
            )
        if moving >= _LEAST_ODD:
            warn(
                f"the camera moves in {moving:.0%} of the pictures, {self._when(False)}: what was found there is "
                "incomplete, and may be wrong",
                "camera-moves",
            )
        if lost >= _LEAST_ODD or (self._changes > 0 and moving < _LEAST_ODD):
            changes = f"; the background began anew {self._changes} times" if self._changes > 0 else ""
            warn(
                f"the view is not to be recognised in {lost:.0%} of the pictures, {self._when(True)}{changes}: cuts, "
                "light that changes, or something large before the camera; what was found there may be wrong",
                "view-lost",
            )

    def _when(self, is_lost: bool) -> str:
        first, last = ((t_ns - (self._start_ns or 0)) / NS_PER_S for t_ns in self._span_ns.get(is_lost, (0, 0)))
        return f"from {first:.1f} s to {last:.1f} s"
