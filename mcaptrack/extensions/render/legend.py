"""A strip below the pictures of a video that says what is drawn on them, in the same styles; and labels kept apart."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, Final

import numpy as np

from mcaptrack.foxglove import ANNOTATIONS, Annotations, message_class
from mcaptrack.foxglove.views import styles
from mcaptrack.foxglove.views.people import ellipse_points, segments
from mcaptrack.foxglove.views.styles import TrackStyle
from mcaptrack.geometry.arrays import Image
from mcaptrack.registry import names as names_of
from mcaptrack.viewing.painting import BACKGROUND, draw, put_text, text_size

#: The colour of text: blue, green, red.
INK = (235, 230, 225)
#: Narrower videos have no legend: it couldn't be read.
_LEAST_PX: Final = 240
#: The height of text as a part of the width of the strip; the other sizes in heights of text.
_TEXT: Final = 1 / 45
_HIGH, _GAP, _SAMPLE = 2.0, 0.6, 1.6
_FORECAST, _UNSEEN = f"forecast, ellipse of {100 * styles.LIKELY:.0f} %", "not seen"
#: The id with the colour of samples, and the picture that they are on.
_ID, _FIRST = np.array([1]), np.zeros(1, np.int64)


def with_legend(image: Image, views: Sequence[str]) -> Image:
    """A picture above the strip for these topics of views, which has an even height; without one if it says nothing."""
    strip = _legend(tuple(views), image.shape[1])
    return image if strip is None else np.concatenate([image, strip])


@cache
def _legend(views: tuple[str, ...], width_px: int) -> Image | None:
    samples = _samples(views)
    if not samples or width_px < _LEAST_PX:
        return None

    def wide(text: str) -> float:
        return text_size(text, line)[0] + (_SAMPLE + 2 * _GAP) * line

    line = width_px * _TEXT
    line *= min(1.0, width_px / sum(map(wide, samples)))
    strip = np.full((round(_HIGH * line / 2) * 2, width_px, 3), BACKGROUND, np.uint8)
    drawn, left = Annotations(_FIRST), _GAP * line
    for text, style in samples.items():
        _draw_sample(drawn, text, style, left, line)
        at = round(left + (_SAMPLE + _GAP / 2) * line), round((_HIGH + 0.6) / 2 * line)
        put_text(strip, text, at, line, INK)
        left += wide(text)
    (message,) = drawn.messages()
    return draw(strip, message_class(ANNOTATIONS).FromString(message))


def _samples(views: Sequence[str]) -> dict[str, TrackStyle]:
    """The styles of what is drawn in views, by its text."""
    names = [view.partition("/view/")[0] for view in views]
    others = ("predictions", "detections", "boxes", *names_of("finisher"))
    tracks = [name for name in names if name.rpartition("/")[2] not in others]
    kinds = {style.title: style for style in map(styles.style_of, tracks)}
    out = dict(kinds)
    if kinds:
        out[_UNSEEN] = next(iter(kinds.values()))
    if any(name.endswith("/predictions") for name in names):
        out[_FORECAST] = styles.RETRACKED
    return out


def _draw_sample(drawn: Annotations, text: str, style: TrackStyle, left: float, line: float) -> None:
    """Draw a sample of a style, so many pixels from the left, in a strip with lines of text of this height."""
    unit, rgb, middle = line / styles.LEAST_TEXT_PX, style.colours(_ID), _HIGH / 2 * line
    if text == _FORECAST:
        x = left + line * np.linspace(0, 1, 4)
        path = segments(np.stack([x, np.full(4, middle)], axis=-1)[None])
        drawn.pairs(_FIRST, path, rgb, styles.fade_ahead(3), styles.FORECAST_LINE * unit)
        half = line * np.array([[0.6, 0.4]])
        ring = ellipse_points(np.array([[left + line, middle]]), half, np.zeros(1), styles.ELLIPSE_POINTS)
        alpha = np.full(1, styles.ELLIPSE_ALPHA)
        drawn.loops(_FIRST, ring, rgb, alpha, styles.ELLIPSE_LINE * unit, styles.ELLIPSE_FILL)
        return
    around = np.array([[0, -1], [1, -1], [1, 1], [0, 1]]) * line * np.array([_SAMPLE * 0.9, 0.6])
    alpha = styles.opacity(np.array([text != _UNSEEN]))
    drawn.loops(_FIRST, np.add(around, [left, middle])[None], rgb, alpha, style.thickness * unit, dashes=style.dashes)


#: Labels that moved away come back by this part of a line a picture, and move by so many lines at most.
_BACK: Final = 0.1
_MOST_SHIFT: Final = 5.0
#: Labels may overlap by less than this.
_APART_PX: Final = 1e-3


class LabelPlaces:
    """Keeps labels of drawings apart, picture after picture: those that come later move up, and come back slowly.

    Labels that would have to move by more than some lines stay where they are.
    """

    def __init__(self) -> None:
        self._shifts: dict[str, float] = {}
        self._taken: list[tuple[float, float, float, float]] = []
        self._now: dict[str, float] = {}

    def next_picture(self) -> None:
        """Begin another picture."""
        self._shifts, self._now, self._taken = self._now, {}, []

    def spread(self, drawn: Any) -> Any:
        """Move the texts of annotations away from each other and from those before in this picture; returns them."""
        for text in drawn.texts:
            width, above, below = text_size(text.text, text.font_size)
            wide, high = width + 2.0, above + below + 1.0
            x, y = text.position.x, text.position.y
            back_px = _BACK * high
            shift = max(0.0, self._shifts.get(text.text, 0.0) - back_px)
            for _ in range(len(self._taken)):
                low = y - shift
                hit = [
                    top
                    for left, top, right, bottom in self._taken
                    if left < x + wide and x < right and top < low - _APART_PX and low - high < bottom - _APART_PX
                ]
                if not hit:
                    break
                shift = y - min(hit)
            shift = shift if shift <= _MOST_SHIFT * high else 0.0
            self._now[text.text] = shift
            self._taken.append((x, y - shift - high, x + wide, y - shift))
            text.position.y = y - shift
        return drawn
