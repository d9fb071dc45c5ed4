"""Convert uncompressed pictures to gray or BGR.

Letters: H rows, W columns, B bytes a pixel.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Bytes


class PixelLayout(NamedTuple):
    """The memory layout of an uncompressed picture.

    ``step`` is the distance of rows in bytes, 0 for contiguous rows; ``is_bigendian`` applies to pixels of two and four
    bytes.
    """

    width_px: int
    height_px: int
    step: int = 0
    is_bigendian: bool = False


#: Encoding -> bytes of a pixel and OpenCV's conversion to gray; "" if the picture is gray already.
_COLOURS: Final = {
    "mono8": (1, ""),
    "8uc1": (1, ""),
    "rgb8": (3, "COLOR_RGB2GRAY"),
    "bgr8": (3, "COLOR_BGR2GRAY"),
    "8uc3": (3, "COLOR_BGR2GRAY"),
    "rgba8": (4, "COLOR_RGBA2GRAY"),
    "bgra8": (4, "COLOR_BGRA2GRAY"),
    "8uc4": (4, "COLOR_BGRA2GRAY"),
    # ROS names the pixels of the first two rows.
    "bayer_rggb8": (1, "COLOR_BayerRGGB2GRAY"),
    "bayer_bggr8": (1, "COLOR_BayerBGGR2GRAY"),
    "bayer_gbrg8": (1, "COLOR_BayerGBRG2GRAY"),
    "bayer_grbg8": (1, "COLOR_BayerGRBG2GRAY"),
}
#: Packed YUV: the index of the luma byte in each pair of bytes.
_LUMA_AT: Final = {"uyvy": 1, "yuv422": 1, "yuyv": 0, "yuv422_yuy2": 0}
_PLANAR: Final = ("nv12", "nv21")
_WIDE: Final = {"mono16": "u2", "16uc1": "u2", "32fc1": "f4"}
#: The encodings that are read.
RAW_ENCODINGS: Final = (*_COLOURS, *_LUMA_AT, *_PLANAR, *_WIDE)


def raw_gray(encoding: str, data: bytes, layout: PixelLayout) -> Bytes:
    """A picture in gray (H, W) uint8: the upper 8 bits of 16-bit pixels, and floats from 0 to 1 scaled to 0 to 255.

    Raises McaptrackError for an unknown encoding, and if ``data`` is too short for the size.
    """
    if encoding in _COLOURS:
        size, conversion = _COLOURS[encoding]
        return _converted(encoding, data, layout, size, conversion)
    if encoding in _LUMA_AT:
        return np.ascontiguousarray(_rows(data, layout, 2)[:, _LUMA_AT[encoding] :: 2])
    if encoding in _PLANAR:
        luma_rows = layout.height_px
        both = layout._replace(height_px=luma_rows + (luma_rows + 1) // 2)
        return _rows(data, both, 1)[:luma_rows].copy()
    if encoding in _WIDE:
        kind = np.dtype(_WIDE[encoding]).newbyteorder(">" if layout.is_bigendian else "<")
        values = _rows(data, layout, kind.itemsize).view(kind)
        if kind.kind == "u":
            return np.asarray(values >> 8, np.uint8)
        shares = np.nan_to_num(np.asarray(values, np.float32)).clip(0, 1)
        return np.asarray(np.rint(shares * 255), np.uint8)
    raise McaptrackError(f"pixels of the encoding {encoding[:40]!r} are not read; {', '.join(RAW_ENCODINGS)} are")


def raw_bgr(encoding: str, data: bytes, layout: PixelLayout) -> Bytes:
    """A picture in BGR (H, W, 3) uint8; in gray for gray pictures and for rare encodings."""
    import cv2

    size, conversion = _COLOURS.get(encoding, (0, ""))
    if not conversion:
        return np.asarray(cv2.cvtColor(raw_gray(encoding, data, layout), cv2.COLOR_GRAY2BGR), np.uint8)
    return _converted(encoding, data, layout, size, conversion.replace("2GRAY", "2BGR").replace("COLOR_BGR2BGR", ""))


def _converted(encoding: str, data: bytes, layout: PixelLayout, size: int, conversion: str) -> Bytes:
    """Apply a colour conversion of OpenCV, "" for none."""
    import cv2

    rows = _rows(data, layout, size)
    image: Any = rows if size == 1 else rows.reshape(*rows.shape[:1], -1, size)
    if not conversion:
        return np.asarray(image, np.uint8)
    try:
        return np.asarray(cv2.cvtColor(image, getattr(cv2, conversion)), np.uint8)
    except cv2.error:
        raise McaptrackError(f"{layout.width_px} x {layout.height_px} pixels are no {encoding} picture") from None


def _rows(data: bytes, layout: PixelLayout, size: int) -> Bytes:
    """The bytes of the pixels, (H, W * B), without row padding. Never takes more memory than ``data``."""
    width, height = layout.width_px, layout.height_px
    row = width * size
    step = layout.step or row
    if width <= 0 or height <= 0 or step < row or (height - 1) * step + row > len(data):
        raise McaptrackError(
            f"{len(data)} bytes don't hold {width} x {height} pixels of {size} bytes with {layout.step} bytes a row"
        )
    return np.ascontiguousarray(np.ndarray((height, row), np.uint8, data, 0, (step, 1)))


def raw_with(encoding: str, data: bytes, layout: PixelLayout, image: Bytes, mask: Bools) -> bytes:
    """An uncompressed picture with other pixels where ``mask`` (H, W) says so: those of ``image`` (H, W, 3), BGR.

    All other bytes stay as they are; where neighbours share a colour (packed YUV, NV12), it changes for both. Raises
    McaptrackError as ``raw_bgr`` does.
    """
    import cv2

    out = np.frombuffer(data, np.uint8).copy()
    height, width = layout.height_px, layout.width_px
    gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    if encoding in _COLOURS:
        size, conversion = _COLOURS[encoding]
        pixels = _places(out, layout, size).reshape(height, width, size)
        if "Bayer" in conversion:
            # The name has the colours of the first two rows; BGR has them in the opposite order.
            channel = np.array(["bgr".index(letter) for letter in encoding[6:10]]).reshape(2, 2)
            of = np.tile(channel, (-(-height // 2), -(-width // 2)))[:height, :width]
            pixels[mask, 0] = np.take_along_axis(image, of[..., None], axis=2)[mask][:, 0]
        elif size == 1:
            pixels[mask, 0] = gray[mask]
        else:
            pixels[mask, :3] = image[mask][:, ::-1] if encoding.startswith("rgb") else image[mask]
        return out.tobytes()
    if encoding in _WIDE:
        kind = np.dtype(_WIDE[encoding]).newbyteorder(">" if layout.is_bigendian else "<")
        pixels = _places(out, layout, kind.itemsize)
        values = gray.astype(kind) * (257 if kind.kind == "u" else 1 / 255)
        flat = values.astype(kind).view(np.uint8).reshape(height, width, kind.itemsize)
        pixels.reshape(height, width, kind.itemsize)[mask] = flat[mask]
        return out.tobytes()
    if encoding not in (*_LUMA_AT, *_PLANAR):
        raise McaptrackError(f"pixels of the encoding {encoding[:40]!r} are not read; {', '.join(RAW_ENCODINGS)} are")
    colour = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2YCrCb), np.uint8)
    luma = np.asarray(np.rint(16 + colour[..., 0] * (219 / 255)), np.uint8)
    # Neighbours share their colours: all of them get other pixels if one does.
    across, down = np.arange(width) // 2 * 2, np.arange(height) // 2 * 2
    shared = mask | mask[:, np.minimum(across + 1, width - 1)] | mask[:, across]
    if encoding in _LUMA_AT:
        at = _LUMA_AT[encoding]
        pixels = _places(out, layout, 2).reshape(height, width, 2)
        pixels[..., at][shared] = luma[shared]
        pixels[..., 1 - at][shared] = np.where(np.arange(width) % 2 == 0, colour[..., 2], colour[..., 1])[shared]
        return out.tobytes()
    shared = shared | shared[np.minimum(down + 1, height - 1)] | shared[down]
    planes = _places(out, layout._replace(height_px=height + (height + 1) // 2), 1)
    planes[:height][shared] = luma[shared]
    rest, block = planes[height:], shared[::2, ::2]
    for place, number in enumerate((2, 1) if encoding == "nv12" else (1, 2)):
        chroma = rest[:, place::2]
        both = block[:, : chroma.shape[1]]
        chroma[both] = colour[::2, ::2, number][:, : chroma.shape[1]][both]
    return out.tobytes()


def _places(data: Bytes, layout: PixelLayout, size: int) -> Bytes:
    """The bytes of the pixels in ``data``, (H, W * B), to write to."""
    row = layout.width_px * size
    return np.ndarray((layout.height_px, row), np.uint8, data, 0, (layout.step or row, 1))
