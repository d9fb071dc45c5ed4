"""Formats of uncompressed pixels: which samples a picture holds, in which order, and how they become gray or BGR.

A format is a line in a table, with the letters of its samples in the order of memory. Reading and writing follow from
them: for messages with uncompressed pictures, and for still images that hold more than 8-bit colours.

Letters: H rows, W columns, N samples a pixel.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.geometry.arrays import Bools, Bytes

#: Samples of any type.
Samples = NDArray[Any]
#: The values that become black and white.
Span = tuple[float, float]

# Video stores luma in 16..235; detectors get 0..255 from every kind of picture.
LIMITED_TO_FULL: Final = np.clip(np.rint((np.arange(256) - 16) * (255 / 219)), 0, 255).astype(np.uint8)
#: Pictures in which the range of values is measured, samples of each, and the shares of the darkest and the brightest
#: that are cut off.
_MEASURED, _SAMPLES, _CUT_OFF = 24, 100_000, 0.0002
#: BGR and 1 to Y, U and V of limited range (ITU-R BT.601), the inverse of what OpenCV reads.
_TO_YUV: Final = np.array(
    [
        [0.114 * 219 / 255, 0.587 * 219 / 255, 0.299 * 219 / 255, 16],
        [0.5 * 224 / 255, -0.5 * 0.587 / 0.886 * 224 / 255, -0.5 * 0.299 / 0.886 * 224 / 255, 128],
        [-0.5 * 0.114 / 0.701 * 224 / 255, -0.5 * 0.587 / 0.701 * 224 / 255, 0.5 * 224 / 255, 128],
    ]
)


class PixelLayout(NamedTuple):
    """The memory layout of an uncompressed picture.

    ``step`` is the distance of rows in bytes, 0 for contiguous rows; ``is_bigendian`` applies to samples of several
    bytes.
    """

    width_px: int
    height_px: int
    step: int = 0
    is_bigendian: bool = False


class PixelFormat(NamedTuple):
    """Which samples a picture holds.

    ``planes`` are the letters of the samples that repeat along a row, for each plane: r, g, b, a, or y for luma and
    gray, u and v for differences of colour, m for a mosaic. ``sample`` is their type. In planes after the first one
    sample is for ``across`` times ``down`` pixels. ``tile`` has the colours of a Bayer mosaic in its first two rows.
    """

    planes: tuple[str, ...]
    sample: str = "u1"
    across: int = 1
    down: int = 1
    tile: str = ""

    @property
    def is_wide(self) -> bool:
        """Whether samples have more than 8 bits, so that the values that become black and white must be known."""
        return self.sample != "u1"

    @property
    def is_yuv(self) -> bool:
        """Whether colours are luma and differences."""
        return any("u" in letters for letters in self.planes)

    def views(self, data: Bytes | bytes, layout: PixelLayout) -> dict[str, Samples]:
        """The samples of each letter (rows, columns), as views of ``data``.

        Raises McaptrackError if they don't fit into it. Where a message with several planes states a distance of rows
        that it doesn't keep, rows are contiguous.
        """
        steps = (layout.step, 0) if len(self.planes) > 1 else (layout.step,)
        for step in steps:
            views = self._views(data, layout, step)
            if views is not None:
                return views
        raise McaptrackError(
            f"{len(data)} bytes don't hold {layout.width_px} x {layout.height_px} pixels ({' '.join(self.planes)}, "
            f"{np.dtype(self.sample).itemsize} bytes a sample) with {layout.step} bytes a row"
        )

    def _views(self, data: Bytes | bytes, layout: PixelLayout, step: int) -> dict[str, Samples] | None:
        width, height, kind = layout.width_px, layout.height_px, np.dtype(self.sample)
        kind, size = kind.newbyteorder(">" if layout.is_bigendian else "<"), kind.itemsize
        if width <= 0 or height <= 0 or step < 0:
            return None
        start, out, luma_step = 0, dict[str, Samples](), step
        for number, letters in enumerate(self.planes):
            across, down = (self.across, self.down) if number else (1, 1)
            a_group = max(map(letters.count, letters))  # pixels: two of yuyv
            columns, rows = -(-width // across), -(-height // down)
            least = columns * len(letters) * size // a_group  # some cameras leave out the last v of an odd width
            row = -(-columns // a_group) * len(letters) * size
            if number == 0:
                luma_step = step = step or row
            else:
                step = max(row, -(-luma_step * len(letters) // across))
            row = min(row, step)
            if row < least or start + (rows - 1) * step + row > len(data):
                return None
            for letter in dict.fromkeys(letters):
                at, every = letters.index(letter), len(letters) // letters.count(letter)
                count = min(len(range(at, row // size, every)), -(-columns * letters.count(letter) // a_group))
                strides = (step, every * size)
                out[letter] = np.ndarray((rows, count), kind, data, start + at * size, strides)
            start += rows * step
        return out


def _table() -> dict[str, PixelFormat]:
    """The formats by the names of ROS, Foxglove, V4L2, GenICam, OpenCV and FFmpeg, in lower case."""
    table = {
        name: PixelFormat((letters,), sample)
        for letters, names, wide_names in (
            ("y", "mono8 y8 y800 grey gray gray8 l8", "mono16 mono10 mono12 mono14 y10 y12 y14 y16 gray16le"),
            ("rgb", "rgb8 rgb rgb24 rgb3 rgb888", "rgb16 rgb48le"),
            ("bgr", "bgr8 bgr bgr24 bgr3 bgr888", "bgr16 bgr48le"),
            ("rgba", "rgba8 rgba rgb0 rgbx", "rgba16 rgba64le"),
            ("bgra", "bgra8 bgra bgr0 bgrx", "bgra16 bgra64le"),
        )
        for sample, listed in (("u1", names), ("u2", wide_names))
        for name in listed.split()
    }
    bits = {"8u": "u1", "8s": "i1", "16u": "u2", "16s": "i2", "32s": "i4", "32f": "f4", "64f": "f8"}
    for name, sample in bits.items():
        table |= {f"{name}c{len(letters)}": PixelFormat((letters,), sample) for letters in ("y", "bgr", "bgra")}
    for letters, names in {
        "uyvy": "yuv422 uyvy uyvy422 y422",  # yuv422 is so in ROS
        "yuyv": "yuv422_yuy2 yuyv yuyv422 yuy2",
        "yvyu": "yvyu yvyu422",
        "vyuy": "vyuy",
        "yuv": "yuv24 yuv3 yuv444_packed",
    }.items():
        table |= {name: PixelFormat((letters,)) for name in names.split()}
    for planes, across, down, names in (
        ("y uv", 2, 2, "nv12"),
        ("y vu", 2, 2, "nv21"),
        ("y uv", 2, 1, "nv16"),
        ("y vu", 2, 1, "nv61"),
        ("y uv", 1, 1, "nv24"),
        ("y vu", 1, 1, "nv42"),
        ("y u v", 2, 2, "i420 iyuv yu12 yuv420 yuv420p"),
        ("y v u", 2, 2, "yv12 yvu420"),
        ("y u v", 2, 1, "i422 yuv422p 422p"),
        ("y u v", 1, 1, "i444 yuv444 yuv444p 444p"),
    ):
        table |= {name: PixelFormat(tuple(planes.split()), "u1", across, down) for name in names.split()}
    # The name has the colours of the first two rows; GenICam's has those of the first.
    for tile, short, fourcc in (
        ("rggb", "rg", "rggb"),
        ("bggr", "bg", "ba81"),
        ("gbrg", "gb", "gbrg"),
        ("grbg", "gr", "grbg"),
    ):
        mosaic = PixelFormat(("m",), "u1", tile=tile)
        table |= dict.fromkeys((f"bayer_{tile}8", f"bayer{short}8", f"s{tile}8", fourcc), mosaic)
        for depth in (10, 12, 14, 16):
            wide_names = (f"bayer_{tile}{depth}", f"bayer{short}{depth}", f"s{tile}{depth}")
            table |= dict.fromkeys(wide_names, mosaic._replace(sample="u2"))
    return table


#: The formats that are read, by name.
PIXEL_FORMATS: Final[Mapping[str, PixelFormat]] = _table()
#: Some of their names, for messages.
_USUAL: Final = ("mono8", "mono16", "rgb8", "bgr8", "8UC1", "16UC1", "32FC1", "yuyv", "uyvy", "nv12", "bayer_rggb8")
_PREFIX: Final = re.compile(r"^(yuv|type|cv)_(?=[a-z0-9]+$)")


def pixel_format(name: str, layout: PixelLayout | None = None) -> PixelFormat:
    """The format of this name. Raises McaptrackError for others, with names that are read.

    The three planes of "yuv444" are one if rows have three bytes a pixel.
    """
    plain = name.strip().lower()
    form = PIXEL_FORMATS.get(plain) or PIXEL_FORMATS.get(_PREFIX.sub("", plain))
    if form is None:
        raise McaptrackError(
            f"pixels of the encoding {name[:40]!r} are not read; {list_names(_USUAL, len(_USUAL))} and "
            f"{len(PIXEL_FORMATS) - len(_USUAL)} others are"
        )
    is_packed = layout is not None and form.planes == ("y", "u", "v") and layout.step >= 3 * layout.width_px > 0
    return PIXEL_FORMATS["yuv24"] if is_packed and form.across == 1 else form


def is_mosaic(name: str) -> bool:
    """Whether this is the name of a format with the colours of a Bayer filter."""
    form = PIXEL_FORMATS.get(name)
    return form is not None and bool(form.tile)


def raw_samples(encoding: str, data: bytes, layout: PixelLayout) -> Samples:
    """The samples of the first plane without padding, (H, W, N), as a view of ``data``. Raises as ``raw_gray``."""
    form = pixel_format(encoding, layout)
    letters, views = form.planes[0], form.views(data, layout)
    first = views[letters[0]]
    shape, strides = (*first.shape, len(letters)), (*first.strides, first.itemsize)
    return np.lib.stride_tricks.as_strided(first, shape, strides, writeable=False)


def raw_gray(encoding: str, data: bytes, layout: PixelLayout, span: Span | None = None) -> Bytes:
    """A picture in gray (H, W) uint8; samples of more than 8 bits are scaled by ``span``.

    Raises McaptrackError for an unknown encoding, and if ``data`` is too short for the size.
    """
    return _raw(encoding, data, layout, span, is_grey=True)


def raw_bgr(encoding: str, data: bytes, layout: PixelLayout, span: Span | None = None) -> Bytes:
    """A picture in BGR (H, W, 3) uint8, as ``raw_gray``."""
    return _raw(encoding, data, layout, span, is_grey=False)


def _raw(encoding: str, data: bytes, layout: PixelLayout, span: Span | None, is_grey: bool) -> Bytes:
    form = pixel_format(encoding, layout)
    if not form.is_yuv:
        samples = raw_samples(encoding, data, layout)
        return shown(samples if samples.shape[2] > 1 else samples[..., 0], form.planes[0], form.tile, span, is_grey)
    views = form.views(data, layout)
    if is_grey:
        return np.asarray(LIMITED_TO_FULL[views["y"]], np.uint8)
    return _bgr_of_yuv(form, views, layout)


def _bgr_of_yuv(form: PixelFormat, views: Mapping[str, Samples], layout: PixelLayout) -> Bytes:
    """Convert by OpenCV, which reads limited range (ITU-R BT.601) as cameras and FFmpeg write it.

    All formats are brought to YUYV: pairs of pixels that share a colour, or pairs of the same pixel.
    """
    import cv2

    width, height, luma = layout.width_px, layout.height_px, views["y"]
    shares = form.across == 2 or len(form.planes[0]) == 4
    pairs = np.empty((height, -(-width // 2) if shares else width, 4), np.uint8)
    first, second = (luma[:, 0::2], luma[:, min(1, width - 1) :: 2]) if shares else (luma, luma)
    u, v = (np.repeat(views[letter], form.down, axis=0)[:height] for letter in "uv")
    for place, values in enumerate((first, u, second, v)):
        pairs[:, : values.shape[1], place] = values
        pairs[:, values.shape[1] :, place] = values[:, -1:]  # the last pixel of an odd width
    bgr = cv2.cvtColor(pairs.reshape(height, -1, 2), cv2.COLOR_YUV2BGR_YUYV)
    return np.ascontiguousarray(bgr[:, :width] if shares else bgr[:, ::2])


def shown(samples: Samples, letters: str, tile: str, span: Span | None, is_grey: bool) -> Bytes:
    """Samples (H, W) or (H, W, N) in gray or BGR; ``letters`` name the N samples, and ``tile`` those of a mosaic.

    Raises McaptrackError for a mosaic that is too small.
    """
    import cv2

    pixels = np.ascontiguousarray(samples if samples.dtype == np.uint8 else scaled(samples, span))
    before, after = (f"Bayer{tile.upper()}" if tile else letters.upper()), "GRAY" if is_grey else "BGR"
    before = "GRAY" if before == "Y" else before
    if before == after:
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{before}2{after}")), np.uint8)
    except cv2.error:
        raise McaptrackError(f"{pixels.shape[1]} x {pixels.shape[0]} pixels are no {tile} mosaic") from None


def scaled(samples: Samples, span: Span | None) -> Bytes:
    """Samples in 0 to 255, by the values that become black and white: by default the range of whole numbers, 0 to 1."""
    kind = samples.dtype
    low, high = span or _default_span(kind)
    values: Samples = samples.astype(np.float32 if kind.itemsize <= 4 else np.float64)
    shares: Samples = np.nan_to_num(values, posinf=high, neginf=low, nan=low) if kind.kind == "f" else values
    shares -= low
    shares *= 255 / max(high - low, 1e-30)
    np.clip(shares, 0, 255, out=shares)
    return np.asarray(np.rint(shares), np.uint8)


def _default_span(kind: np.dtype[Any]) -> Span:
    return 0.0, float(np.iinfo(kind).max) if kind.kind in "iu" else 1.0


# The range of values of pictures with more than 8 bits.


def measured(count: int) -> list[int]:
    """The numbers of the pictures, all over ``count`` of them, in which the range of values is measured."""
    return [int(at) for at in np.unique(np.linspace(0, count - 1, min(_MEASURED, count)).astype(int))]


def measured_span(parts: Iterable[Samples]) -> Span | None:
    """The values that become black and white: nearly the least and the greatest; None if all are the same, or have
    8 bits.

    Single pixels that differ from all neighbours don't count, nor do values that stand for none: 0, the greatest whole
    number, and what is not finite.
    """
    import cv2

    pooled = [np.zeros(0, np.float32)]
    for samples in parts:
        kind = samples.dtype
        if kind == np.uint8:
            return None
        for channel in np.moveaxis(samples, -1, 0) if samples.size else ():
            values = cv2.medianBlur(np.ascontiguousarray(channel.astype(np.float32)), 3).ravel()
            is_value = np.isfinite(values) & (values != 0)
            if kind.kind in "iu":
                is_value &= values != np.float32(np.iinfo(kind).max)
            every = -(-len(values) // _SAMPLES)
            pooled.append(values[::every][is_value[::every]])
    values = np.concatenate(pooled)
    if not len(values):
        return None
    low, high = np.quantile(values, [_CUT_OFF, 1 - _CUT_OFF]).tolist()
    return (low, high) if high > low else None


# Replace a part of a picture.


def raw_with(
    encoding: str, data: bytes, layout: PixelLayout, image: Bytes, mask: Bools, span: Span | None = None
) -> bytes:
    """An uncompressed picture with other pixels where ``mask`` (H, W) says so: those of ``image`` (H, W, 3), BGR.

    All other bytes stay as they are; where neighbours share a colour (4:2:2, 4:2:0), all of them change. Raises
    McaptrackError as ``raw_bgr`` does.
    """
    import cv2

    form, out = pixel_format(encoding, layout), np.frombuffer(data, np.uint8).copy()
    height, width = layout.height_px, layout.width_px
    views = form.views(out, layout)
    if form.is_yuv:
        values = dict(zip("yuv", cv2.split(cv2.transform(image, _TO_YUV)), strict=True))
        across, down = (2 if len(form.planes[0]) == 4 else form.across), form.down
        rows, columns = np.arange(height) // down, np.arange(width) // across
        block = np.zeros((rows[-1] + 1, columns[-1] + 1), bool)
        at = np.nonzero(mask)
        block[rows[at[0]], columns[at[1]]] = True
        mask = block[rows][:, columns]
        for letter, view in views.items():
            own, part = (values[letter], mask) if letter == "y" else (values[letter][::down, ::across], block)
            part = part[:, : view.shape[1]]
            view[part] = own[:, : view.shape[1]][part]
        return out.tobytes()
    gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    for letter, view in views.items():
        own = image[..., "bgr".index(letter)] if letter in "bgr" else gray
        if letter == "m":
            of = np.tile(["bgr".index(colour) for colour in form.tile], (1, 1)).reshape(2, 2)
            of = np.tile(of, (-(-height // 2), -(-width // 2)))[:height, :width]
            own = np.take_along_axis(image, of[..., None], axis=2)[..., 0]
        if letter != "a":
            view[mask] = _unscaled(own[mask], view.dtype, span) if form.is_wide else own[mask]
    return out.tobytes()


def _unscaled(values: Bytes, kind: np.dtype[Any], span: Span | None) -> Samples:
    """The inverse of ``scaled``."""
    low, high = span or _default_span(kind)
    out = low + values.astype(np.float64) * ((high - low) / 255)
    return (np.rint(out) if kind.kind in "iu" else out).astype(kind)
