"""The styles of tracks and forecasts: one declaration for pictures, scenes, layouts, plots and legends.

Letters: N objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from mcaptrack.foxglove import CuboidMarker, PersonMarker, colours
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.plane import Planes
from mcaptrack.schema import Frame

#: The opacity of observed and of interpolated positions.
OBSERVED, INTERPOLATED = 1.0, 0.375
#: The probability that a person is in the ellipse of a forecast. Ellipses of 95 % cover half of a picture after 4.8 s,
#: and all of the ground before a robot.
LIKELY: Final = 0.5
#: Lines of forecasts, and those around their ellipses, in units of thickness; the opacity of ellipses.
FORECAST_LINE, ELLIPSE_LINE, ELLIPSE_ALPHA, ELLIPSE_FILL = 1.5, 1.0, 0.5, 0.15
#: The number of points of an ellipse in pictures.
ELLIPSE_POINTS: Final = 10
WHITE: Final[tuple[float, float, float]] = (1.0, 1.0, 1.0)
GREY: Final[tuple[float, float, float]] = (0.75, 0.75, 0.75)
#: The outline of a robot seen from above, in its own frame in m: an arrow ahead.
ROBOT_M: Final = np.array([[2.0, 0.0], [-2.0, 1.0], [-1.2, 0.0], [-2.0, -1.0]])
ROBOT_ALPHA: Final[float] = 0.9


class TrackStyle(NamedTuple):
    """The style of tracks of one kind: tracker's, re-tracked and true ones can be told apart at a glance.

    Attributes
    ----------
    title : str
        How they are called.
    names : tuple of str
        Their channels below the name of a camera; the first that exists is shown.
    sign : str
        What stands before ids where several kinds are drawn at one place: in scenes.
    curve : str
        The colour of their plots, which is seen on white and on black.
    thickness : float
        Of the lines of boxes, in units.
    dashes : int
        The number of dashes of each side of a box; 0 for whole lines.
    trail : float
        The drawn share of each piece of a trail on pictures; 0 for no trail.
    is_white : bool
        All are white, otherwise each id has its colour.
    name_at : {"above", "below", "beside"}
        Where the id stands at a box, different for each kind, so that ids don't overlap.
    marker : PersonMarker
        The drawing in scenes.
    box : CuboidMarker
        The drawing of 3D boxes in scenes.
    """

    title: str
    names: tuple[str, ...]
    sign: str
    curve: str
    thickness: float
    dashes: int
    trail: float
    is_white: bool
    name_at: Literal["above", "below", "beside"]
    marker: PersonMarker
    box: CuboidMarker

    def colours(self, number: Ints) -> Floats:
        """The colours (N, 3) of objects with these ids (N,)."""
        return np.broadcast_to(WHITE, (len(number), 3)) if self.is_white else colours(number)


#: On the ground the ids of a person in several channels have different heights, so that all can be read. So have those
#: of 3D boxes, of which re-tracked ones are drawn whole, tracked ones at the bottom and true ones at the top.
TRACKED: Final = TrackStyle(
    "tracker", ("tracks",), "T", "#e69f00", 1.5, 3, 0.6, False, "below",
    PersonMarker(0.6, 0.06, -0.8, 3.0, in_pieces=True), CuboidMarker(0.0, 0.0, -0.8),
)  # fmt: skip
RETRACKED: Final = TrackStyle(
    "re-tracked", ("retracks/full", "retracks"), "", "#56b4e9", 2.5, 0, 1.0, False, "above",
    PersonMarker(0.4, 1.7, 2.2, 4.0), CuboidMarker(0.0, 1.0, 0.5),
)  # fmt: skip
GROUND_TRUTH: Final = TrackStyle(
    "ground truth", ("truth",), "G", "#999999", 2.0, 0, 0.0, True, "beside",
    PersonMarker(0.12, 4.6, 5.0, 1.5), CuboidMarker(1.0, 1.0, 3.0),
)  # fmt: skip
KINDS: Final = (TRACKED, RETRACKED, GROUND_TRUTH)
#: Channels below the name of a camera that are shown by themselves: the first that exists.
BEST: Final = (*RETRACKED.names, *TRACKED.names, "detections")


def style_of(topic: str, is_retracked: bool = False) -> TrackStyle:
    """The style of a channel of tracks, by its topic and by whether a stage made it that repairs tracks."""
    if topic.endswith("/truth"):
        return GROUND_TRUTH
    return RETRACKED if is_retracked or "/retracks" in topic else TRACKED


def opacity(observed: Bools) -> Floats:
    """The opacities (N,) of positions that are observed, or interpolated."""
    return np.where(observed, OBSERVED, INTERPOLATED)


def fade(count: int, longest: int, weakest: float = 0.125) -> Floats:
    """The opacities of the last ``count`` of ``longest`` lines of a trail; the last is the strongest."""
    return np.linspace(weakest, 0.875, longest)[longest - count :]


def fade_ahead(count: int) -> Floats:
    """The opacities of the lines, or points, of a forecast: fainter into the future."""
    return fade(count, count, weakest=0.25)[::-1]


#: Up to this width of pictures, lines of thickness 1 are 1 px thick; on wider ones, more.
_WIDTH_PX: Final = 800
#: Text is as high as this part of the width of a picture, so that it is read in a panel of a viewer, and never lower
#: than so many pixels.
_TEXT: Final = 1 / 36
LEAST_TEXT_PX: Final = 12.0


class Scale(NamedTuple):
    """The thickness of lines of thickness 1, and the size of text, in px."""

    line_px: float
    text_px: float

    @classmethod
    def of_width(cls, width_px: float) -> Scale:
        """The scale for pictures of this width; 0 if it isn't known."""
        line_px = float(np.clip(round(width_px / _WIDTH_PX * 4) / 4, 1.0, 5.0))
        return cls(line_px, max(LEAST_TEXT_PX, float(round(width_px * _TEXT))))

    @classmethod
    def of(cls, frames: Sequence[Frame], planes: Planes) -> Scale:
        """The scale for pictures of these planes, or of boxes in them, as far as their width is known."""
        width = float(max((plane.width_px for _, plane in planes), default=0))
        if not width:
            for frame in frames:
                if {"x_px", "w_px"} <= set(frame.rows.dtype.names or ()):
                    width = float(np.fmax.reduce(frame.rows["x_px"] + frame.rows["w_px"], initial=width))
        return cls.of_width(width)
