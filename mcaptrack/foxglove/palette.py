"""The colours of identities: the same in every panel, and distinct for colour-blind people."""

from __future__ import annotations

import colorsys
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats

Rgba = tuple[float, float, float, float]

# Okabe and Ito's palette for colour-blind people, without black; then the same, lighter and darker.
_HUES: Final = ("E69F00", "56B4E9", "009E73", "F0E442", "0072B2", "D55E00", "CC79A7")
_SHADES: Final = (1.0, 1.35, 0.7)
#: The number of colours; identities beyond it repeat them.
COUNT: Final = len(_HUES) * len(_SHADES)
#: Colours brighter than this get dark text.
_LIGHT: Final = 0.55


@cache
def colour(identity: int, alpha: float = 1.0) -> Rgba:
    """The colour of an identity as RGBA, each part between 0 and 1."""
    base, shade = _HUES[identity % len(_HUES)], _SHADES[identity // len(_HUES) % len(_SHADES)]
    red, green, blue = (int(base[at : at + 2], 16) / 255 for at in (0, 2, 4))
    hue, light, saturation = colorsys.rgb_to_hls(red, green, blue)
    # Multiples of 1/256 take fewer bytes of a compressed log than other numbers.
    red, green, blue = (
        round(part * 256) / 256 for part in colorsys.hls_to_rgb(hue, min(light * shade, 0.85), saturation)
    )
    return red, green, blue, alpha


def colours(identities: NDArray[np.int64]) -> Floats:
    """The colours of N identities, (N, 3)."""
    return _table()[identities % COUNT]


@cache
def _table() -> Floats:
    return np.array([colour(identity)[:3] for identity in range(COUNT)])


def ink(rgb: Floats) -> Floats:
    """The colour of text on colours (N, 3): black on light ones, white on dark ones, (N, 3)."""
    is_light = rgb @ [0.299, 0.587, 0.114] > _LIGHT
    return np.where(is_light[:, None], 0.0, 1.0) * np.ones(3)
