"""The styles of tracks: tracked, re-tracked and ground truth can be told apart at a glance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from mcaptrack.foxglove import CuboidMarker, PersonMarker
from mcaptrack.geometry.plane import Planes
from mcaptrack.schema import Frame

#: Up to this width of pictures, lines of thickness 1 are 1 px thick and text is 12 px high; on wider ones, more.
_WIDTH_PX: Final = 800


class TrackStyle(NamedTuple):
    """The style of the people of a channel.

    ``name_at`` is the position of the number at a box, different for each style, so that numbers don't overlap.
    ``dash`` is the drawn share of each piece of a trail on pictures; 0 for no trail.
    """

    thickness: float
    is_open: bool
    dash: float
    is_white: bool
    name_at: Literal["above", "below", "beside"]
    marker: PersonMarker
    box: CuboidMarker


#: On the ground the numbers of a person in several channels have different heights, so that all can be read. So have
#: those of 3D boxes, of which re-tracked ones are drawn whole, tracked ones at the bottom and true ones at the top.
RETRACKED: Final = TrackStyle(
    2.5, False, 1.0, False, "above", PersonMarker(0.4, 1.7, 2.2, 4.0), CuboidMarker(0.0, 1.0, 0.5)
)
TRACKED: Final = TrackStyle(
    2.0, True, 0.6, False, "below", PersonMarker(0.6, 0.06, -0.8, 3.0, in_pieces=True), CuboidMarker(0.0, 0.0, -0.8)
)
GROUND_TRUTH: Final = TrackStyle(
    1.0, False, 0.0, True, "beside", PersonMarker(0.12, 4.6, 5.0, 1.5), CuboidMarker(1.0, 1.0, 3.0)
)
#: The opacity of observed and of interpolated positions.
OBSERVED, INTERPOLATED = 1.0, 0.375


def style_of(topic: str, is_retracked: bool = False) -> TrackStyle:
    """The style of a channel of tracks, by its topic and by whether a stage made it that repairs tracks."""
    if topic.endswith("/truth"):
        return GROUND_TRUTH
    return RETRACKED if is_retracked or "/retracks" in topic else TRACKED


def line_unit(frames: Sequence[Frame], planes: Planes) -> float:
    """The thickness in px of a line of thickness 1, by the width of the pictures as far as it is known."""
    width = float(max((plane.width_px for _, plane in planes), default=0))
    if not width:
        for frame in frames:
            if {"x_px", "w_px"} <= set(frame.rows.dtype.names or ()):
                width = float(np.fmax.reduce(frame.rows["x_px"] + frame.rows["w_px"], initial=width))
    return unit_of_width(width)


def unit_of_width(width_px: float) -> float:
    """The thickness in px of a line of thickness 1 on pictures of this width."""
    return float(np.clip(round(width_px / _WIDTH_PX * 4) / 4, 1.0, 5.0))
