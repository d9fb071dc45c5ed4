"""A strip below the pictures of a video that says what is drawn on them, with samples in the same styles."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Final

import numpy as np

from mcaptrack.foxglove import ANNOTATIONS, Annotations, message_class
from mcaptrack.foxglove.views import styles
from mcaptrack.foxglove.views.people import ellipse_points, segments
from mcaptrack.foxglove.views.styles import TrackStyle
from mcaptrack.geometry.arrays import Image
from mcaptrack.registry import names as names_of
from mcaptrack.schema import DETECTIONS
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import STAGES
from mcaptrack.viewing.painting import draw, put_text, text_size

__all__ = ["BACKGROUND", "INK", "tracker_name", "with_legend"]

#: The colours of the strip and of its text: blue, green, red.
BACKGROUND, INK = (32, 28, 26), (235, 230, 225)
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


#: How trackers are called; channels of earlier versions that name none were made by the first.
_TRACKERS: Final = {"sort": "SORT", "bytetrack": "ByteTrack", "ocsort": "OC-SORT"}
_FIRST_TRACKER: Final = next(iter(_TRACKERS))


def tracker_name(provenance: Provenance | None) -> str:
    """Return the name of the tracker of a channel, by how it was made."""
    stage = STAGES.get(provenance.transform) if provenance else None
    if provenance is None or stage is None or stage.reads is not DETECTIONS:
        return "tracks as given"
    return _TRACKERS.get(str(provenance.parameters.get(stage.option, _FIRST_TRACKER)), "tracker")
