"""How kinds of channels look: who was tracked, who was re-tracked and who is true tell apart at a glance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from mcaptrack.foxglove import Figure
from mcaptrack.geometry.plane import Planes
from mcaptrack.schema import Frame

#: Lines are one of their pixels thick, and words 12 pixels high, on pictures up to so wide; on wider ones more.
_WIDTH_PX: Final = 800


class Look(NamedTuple):
    """How the people of a channel are drawn.

    ``name_at`` is where a box has its number: so that numbers of several channels don't hide each other. ``dash`` is
    how much of a trail's lines is drawn on pictures; 0 for no trail.
    """

    thickness: float
    is_open: bool
    dash: float
    is_white: bool
    name_at: Literal["above", "below", "beside"]
    figure: Figure


#: On the ground numbers of a person in several channels stand so far above one another that all can be read.
RETRACKED: Final = Look(2.5, False, 1.0, False, "above", Figure(0.4, 1.7, 2.2, 4.0))
TRACKED: Final = Look(2.0, True, 0.6, False, "below", Figure(0.6, 0.06, -0.8, 3.0, in_pieces=True))
TRUE: Final = Look(1.0, False, 0.0, True, "beside", Figure(0.12, 4.6, 5.0, 1.5))
#: How opaque what was seen is drawn, and what was filled in.
SEEN, FILLED_IN = 1.0, 0.375


def look_of(topic: str, made_by: str = "") -> Look:
    """The look of a channel of tracks, by its name and by the stage that made it."""
    if topic.endswith("/truth"):
        return TRUE
    return RETRACKED if made_by == "retrack" or "/retracks" in topic else TRACKED


def unit(frames: Sequence[Frame], planes: Planes) -> float:
    """How many pixels thick a line of one is, by the width of the pictures as far as it is known."""
    width = float(max((plane.width_px for _, plane in planes), default=0))
    if not width:
        boxes = [frame.rows for frame in frames if {"x_px", "w_px"} <= set(frame.rows.dtype.names or ())]
        right = np.concatenate([np.zeros(1), *(rows["x_px"] + rows["w_px"] for rows in boxes)])
        width = float(np.nanmax(right))
    return float(np.clip(round(width / _WIDTH_PX * 4) / 4, 1.0, 5.0))
