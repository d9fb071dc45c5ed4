"""The colours of identities and classes: the same in every panel, and distinct for colour-blind people."""

from __future__ import annotations

import colorsys
import re
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats
from mcaptrack.schema.classes import PEOPLE

__all__ = ["COUNT", "colours"]

Rgba = tuple[float, float, float, float]

# Okabe and Ito's palette for colour-blind people, without black; then the same, lighter and darker.
_HUES: Final = ("E69F00", "56B4E9", "009E73", "F0E442", "0072B2", "D55E00", "CC79A7")
_SHADES: Final = (1.0, 1.35, 0.7)
#: The number of colours; identities beyond it repeat them.
COUNT: Final = len(_HUES) * len(_SHADES)
#: Colours brighter than this get dark text; text on black is at least so bright.
_LIGHT, _DIM = 0.55, 0.45
#: The brightness of red, green and blue.
_BRIGHTNESS: Final = np.array([0.299, 0.587, 0.114])


@cache
def colour(identity: int) -> Rgba:
    """The colour of an identity as RGBA, each part between 0 and 1."""
    base, shade = _HUES[identity % len(_HUES)], _SHADES[identity // len(_HUES) % len(_SHADES)]
    red, green, blue = (int(base[at : at + 2], 16) / 255 for at in (0, 2, 4))
    hue, light, saturation = colorsys.rgb_to_hls(red, green, blue)
    # Multiples of 1/256 take fewer bytes of a compressed log than other numbers.
    red, green, blue = (
        round(part * 256) / 256 for part in colorsys.hls_to_rgb(hue, min(light * shade, 0.85), saturation)
    )
    return red, green, blue, 1.0


def colours(identities: NDArray[np.int64]) -> Floats:
    """The colours of N identities, (N, 3)."""
    return _table()[identities % COUNT]


#: The places of classes in the palette, by words of their names; other classes take the places after these.
_CLASSES: Final[dict[str, int]] = {
    **dict.fromkeys(("car", "vehicle", "automobile"), 0),
    **dict.fromkeys(PEOPLE, 1),
    **dict.fromkeys(("bicycle", "bike", "bicyclist", "cyclist", "motorcycle", "motorcyclist", "motorbike"), 3),
    **dict.fromkeys(("truck", "bus", "van", "trailer", "lorry"), 5),
}
_UNKNOWN: Final = (0.75, 0.75, 0.75)


def class_colour(class_id: int, name: str = "") -> tuple[float, float, float]:
    """The colour of a class: by its name, so that cars have one colour in all logs, else by its number; 0 is grey.

    ``class_id`` is that number. Returns red, green and blue from 0 to 1.
    """
    parts = re.split(r"[\W_]+", name.casefold())
    index = next((_CLASSES[word] for word in parts if word in _CLASSES), None)
    if index is None and not class_id:
        return _UNKNOWN
    red, green, blue, _ = colour(class_id + len(_HUES) if index is None else index)
    return red, green, blue


@cache
def _table() -> Floats:
    return np.array([colour(identity)[:3] for identity in range(COUNT)])


def ink(rgb: Floats) -> Floats:
    """The colour of text on colours (N, 3): black on light ones, white on dark ones, (N, 3)."""
    is_light = rgb @ _BRIGHTNESS > _LIGHT
    return np.where(is_light[:, None], 0.0, 1.0) * np.ones(3)


def legible(rgb: Floats) -> Floats:
    """Colours (N, 3) as text has them on black: dark ones with as much white as they need."""
    bright = rgb @ _BRIGHTNESS
    white = np.clip((_DIM - bright) / np.maximum(1.0 - bright, _DIM), 0.0, 1.0)[:, None]
    return np.asarray(np.rint((rgb + white * (1.0 - rgb)) * 256) / 256, np.float64)
