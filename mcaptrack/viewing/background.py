"""Pictures of a scene to draw on: without the people who move, or of a moment."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Image
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import encode_image

#: The background is the median of this many pictures, spread over the log: people who move vanish from it.
_PICTURES: Final = 9
_WIDTH_PX: Final = 800
_QUALITY: Final = 72


class SceneBackground(NamedTuple):
    """A picture in JPEG to draw tracks on; ``scale`` converts pixels of the camera to pixels of this picture."""

    jpeg: bytes
    width: int
    height: int
    scale: float


def background_picture(pictures: Pictures, is_still: bool = True) -> SceneBackground | None:
    """The scene without moving people, or the first picture if the camera isn't still; None without pictures.

    Raises McaptrackError for damaged pictures.
    """
    count = len(pictures.t_ns) if is_still else min(len(pictures.t_ns), 1)
    numbers = np.unique(np.linspace(0, count - 1, min(count, _PICTURES)).round().astype(int)).tolist() if count else []
    seen: list[Image] = []
    scale = 1.0
    for frame in pictures.readable(numbers):
        scale = scale if seen else _scale(frame.rows)
        small = _shrunk(frame.rows, scale)
        if not seen or small.shape == seen[0].shape:
            seen.append(small)
    if not seen:
        return None
    still = np.median(np.stack(seen), axis=0)
    # Grey and with less contrast, so that only tracks have colours.
    grey = 0.55 * (still @ [0.114, 0.587, 0.299]) + 70
    image = np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=2)
    return SceneBackground(encode_image(image, "jpeg", _QUALITY), image.shape[1], image.shape[0], scale)


def moment_picture(pictures: Pictures, t_ns: int) -> SceneBackground | None:
    """The picture that is shown at a time; None if it can't be decoded."""
    at = max(int(np.searchsorted(pictures.t_ns, t_ns, "right")) - 1, 0)
    for frame in pictures.readable([at]):
        scale = _scale(frame.rows)
        small = _shrunk(frame.rows, scale)
        return SceneBackground(encode_image(small, "jpeg", _QUALITY), small.shape[1], small.shape[0], scale)
    return None


def _scale(image: Image) -> float:
    """The factor by which a picture is made smaller."""
    return float(min(1.0, _WIDTH_PX / image.shape[1]))


def _shrunk(image: Image, scale: float) -> Image:
    import cv2

    high, wide = image.shape[:2]
    size = (max(1, round(wide * scale)), max(1, round(high * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
