"""Turn and mirror pictures as their video says, and fit them into its size."""

from __future__ import annotations

import struct
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Image

FULL_RANGE: Final = 2  # AVCOL_RANGE_JPEG
_LIMITED_RANGE: Final = 1  # AVCOL_RANGE_MPEG
_MATRIX: Final = struct.Struct("=9i")
#: Matrices are axis-aligned if the other entries are at most this share of the largest: the tangent of one degree.
_STRAIGHT: Final = 0.0175


class Orientation(NamedTuple):
    """The orientation of pictures: transposed, then mirrored from left to right, then from top to bottom.

    ``words`` say it, "" for pictures that are shown as they are stored. ``oblique`` is an angle in degrees by which
    they should be turned and aren't, because it is none of quarter turns.
    """

    is_transposed: bool = False
    flips_x: bool = False
    flips_y: bool = False
    words: str = ""
    oblique: float = 0.0

    def of(self, picture: Any) -> Image:
        """A frame of FFmpeg in BGR, (H, W, 3) uint8, upright; arrays are returned as they are."""
        if isinstance(picture, np.ndarray):
            return picture
        image: Image = picture.to_ndarray(format="bgr24")
        image = image.transpose(1, 0, 2) if self.is_transposed else image
        return image[:: -1 if self.flips_y else 1, :: -1 if self.flips_x else 1]


def orientation_of(frame: Any) -> Orientation:
    """Read the display matrix of a frame of FFmpeg: x' = a x + c y, y' = b x + d y (ISO 14496-12, 8.3.2)."""
    # By name, because iterating gives the data themselves up to PyAV 18, and their types from 19 on.
    found = bytes(frame.side_data.get("DISPLAYMATRIX") or b"")
    if len(found) != _MATRIX.size:
        return Orientation()
    a, b, _, c, d, *_ = _MATRIX.unpack(found)
    turned = f"turned by {frame.rotation} degrees"
    largest = max(map(abs, (a, b, c, d)))
    if max(abs(b), abs(c)) <= _STRAIGHT * largest and a and d:
        flips = a < 0, d < 0
        words = {(True, True): turned, (True, False): "mirrored", (False, True): "mirrored from top to bottom"}
        return Orientation(False, *flips, words.get(flips, ""))
    if max(abs(a), abs(d)) <= _STRAIGHT * largest and b and c:
        flips = c < 0, b < 0
        return Orientation(True, *flips, "turned and mirrored" if flips[0] == flips[1] else turned)
    return Orientation(oblique=float(np.degrees(np.arctan2(b, a))))


def fit(picture: Any, orientation: Orientation, width: int, height: int) -> tuple[Any, bool]:
    """A picture in an (even) size, in a format that the encoder takes, and whether it had to be scaled.

    A missing last row or column repeats the one before it.
    """
    if (
        not isinstance(picture, np.ndarray)
        and not orientation.words
        and (picture.width, picture.height) == (width, height)
    ):
        if picture.format.name == "yuv420p" and picture.color_range != FULL_RANGE:
            return picture, False
        if picture.format.name.startswith(("yuv4", "yuvj4")):
            is_full = picture.format.name.startswith("yuvj") or picture.color_range == FULL_RANGE
            ranges = {"src_color_range": FULL_RANGE if is_full else _LIMITED_RANGE, "dst_color_range": _LIMITED_RANGE}
            return picture.reformat(format="yuv420p", **ranges), False
    image = orientation.of(picture)
    right, below = width - image.shape[1], height - image.shape[0]
    if 0 <= right <= 1 and 0 <= below <= 1:
        return (np.pad(image, ((0, below), (0, right), (0, 0)), mode="edge") if right or below else image), False
    import cv2

    return cv2.resize(np.ascontiguousarray(image), (width, height), interpolation=cv2.INTER_AREA), True
