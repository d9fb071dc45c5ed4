"""Decode pictures: to gray for detectors, to BGR for people."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator
from fractions import Fraction
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Bytes, Image
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import Frame
from mcaptrack.sources.video.codecs import CODECS, largest_size
from mcaptrack.sources.video.container import is_size_error
from mcaptrack.sources.video.limits import check_size, check_still, max_pixels, still_size, too_large

_FULL_RANGE: Final = 2  # AVCOL_RANGE_JPEG
# Video stores luma in 16..235; detectors get 0..255 from every kind of picture.
_LIMITED_TO_FULL: Final = np.clip(np.rint((np.arange(256) - 16) * (255 / 219)), 0, 255).astype(np.uint8)


# Convert uncompressed pictures to gray or BGR.
#
# Letters: H rows, W columns, B bytes a pixel.


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


class EncodedPicture(NamedTuple):
    """A picture in a log: ``format`` is "h264", "jpeg" and so on; with a ``layout`` it is a pixel format, as in "rgb8".

    ``where`` names the picture in errors; by default its number does.
    """

    t_ns: int
    index: int  # type: ignore[assignment]  # hides tuple.index, which is not needed here
    format: str
    data: bytes
    layout: PixelLayout | None = None
    where: str = ""

    @property
    def is_video(self) -> bool:
        """Whether it may depend on earlier pictures."""
        return self.format in CODECS and not self.layout

    @property
    def name(self) -> str:
        """The name of the picture in errors."""
        return self.where or f"frame {self.index}"


#: After so many images that can't be decoded, and none that can, it is taken that none can.
_MOST_UNREADABLE: Final = 20


def decode_gray(
    pictures: Iterable[EncodedPicture],
    wanted: Container[int] | None = None,
    damaged: list[int] | None = None,
    unreadable: list[McaptrackError] | None = None,
) -> Iterator[Frame]:
    """Decode pictures to gray.

    Parameters
    ----------
    pictures : iterable of EncodedPicture
        In decoding order. Pictures before the first one at which decoding can begin are left out, as viewers do.
    wanted : container of int, optional
        Indexes of the pictures to yield; others are decoded only if later ones depend on them.
    damaged : list of int, optional
        Indexes of damaged pictures of videos are added: what can't be decoded there is taken from other pictures.
    unreadable : list of McaptrackError, optional
        The errors of images, each of which stands for itself, that can't be decoded are added, and these left out.

    Yields
    ------
    Frame
        ``rows`` is the picture, (height, width) uint8 from 0 to 255.

    Raises
    ------
    McaptrackError
        For a format that can't be decoded, and for damaged pictures; with ``unreadable`` if no image can be decoded.
    """
    return _decoded(pictures, wanted, damaged, unreadable, is_grey=True)


def decode_bgr(
    pictures: Iterable[EncodedPicture],
    wanted: Container[int] | None = None,
    damaged: list[int] | None = None,
    unreadable: list[McaptrackError] | None = None,
) -> Iterator[Frame]:
    """Decode pictures to BGR: as ``decode_gray``, but ``rows`` is (height, width, 3) uint8 (blue, green, red)."""
    return _decoded(pictures, wanted, damaged, unreadable, is_grey=False)


def _decoded(
    pictures: Iterable[EncodedPicture],
    wanted: Container[int] | None,
    damaged: list[int] | None,
    unreadable: list[McaptrackError] | None,
    is_grey: bool,
) -> Iterator[Frame]:
    of_pixels, of_frame = (raw_gray, _luma) if is_grey else (raw_bgr, _bgr_of_frame())
    decoder: _VideoDecoder | None = None
    is_any_readable = False
    for picture in pictures:
        if picture.is_video:
            decoder = decoder or _VideoDecoder(picture.format, of_frame, wanted, [] if damaged is None else damaged)
            yield from decoder.decode(picture)
        elif wanted is not None and picture.index not in wanted:
            continue
        else:
            try:
                pixels = _raw(picture, of_pixels) if picture.layout else _still(picture, is_grey)
            except McaptrackError as error:
                if unreadable is None or (len(unreadable) == _MOST_UNREADABLE and not is_any_readable):
                    raise
                unreadable.append(error)
                continue
            is_any_readable = True
            yield Frame(picture.t_ns, picture.index, pixels)
    if decoder:
        yield from decoder.flush()
    elif unreadable and not is_any_readable:
        raise unreadable[0]


def _raw(picture: EncodedPicture, of_pixels: Callable[[str, bytes, PixelLayout], Image]) -> Image:
    assert picture.layout
    width, height, *_ = picture.layout
    if width * height <= len(picture.data):
        check_size(width, height, picture.name)
    try:
        return of_pixels(picture.format, picture.data, picture.layout)
    except McaptrackError as error:
        raise McaptrackError(f"{picture.name}: {error}") from None


def _still(picture: EncodedPicture, is_grey: bool) -> Image:
    import cv2

    size, image = still_size(picture.data), None
    if size is not None:
        check_still(size, picture.name)
        try:
            how = cv2.IMREAD_GRAYSCALE if is_grey else cv2.IMREAD_COLOR
            image = cv2.imdecode(np.frombuffer(picture.data, np.uint8), how)
        except cv2.error:  # the header contradicts the data
            image = None
    if image is None:
        raise McaptrackError(f"{picture.name} can't be decoded as {picture.format or 'an image'}")
    return np.asarray(image, np.uint8)


class _VideoDecoder:
    def __init__(
        self, name: str, of_frame: Callable[[Any], Image], wanted: Container[int] | None, damaged: list[int]
    ) -> None:
        import av

        self._of_frame, self._wanted, self._damaged = of_frame, wanted, damaged

        self._codec: Any = av.CodecContext.create(CODECS[name].decoder, "r")
        self._codec.thread_type = "AUTO"
        self._codec.options = {"max_pixels": str(max_pixels())}
        self._base = Fraction(1, NS_PER_S)
        self._count, self._sets, self._has_started, self._last = 0, b"", False, "the video"
        self._pending: dict[int, tuple[int, int]] = {}

    def decode(self, picture: EncodedPicture) -> Iterator[Frame]:
        import av

        head = CODECS[picture.format].read_head(picture.data)
        self._has_started |= head.has_parameter_sets
        if not head.has_picture:
            self._sets += (
                picture.data
            )  # some robots send parameter sets separately; FFmpeg needs them together with a picture
            return
        if not self._has_started:
            return  # a recording may begin anywhere; decoding starts with the first parameter sets
        # Copied to memory of FFmpeg: its threads can't release Python memory while Python waits for them (a deadlock).
        data = self._sets + picture.data
        if picture.format == "h264" and (self._sets or head.has_parameter_sets):  # FFmpeg only reports them as invalid
            check_size(*largest_size(data), picture.name)
        packet = av.Packet(len(data))
        packet.update(data)
        packet.pts = packet.dts = self._count  # not the time: recorded messages may share one
        packet.time_base = self._base
        self._pending[self._count], self._sets = (picture.t_ns, picture.index), b""
        self._count += 1
        self._last = picture.name
        yield from self._frames(packet, picture.name)

    def flush(self) -> Iterator[Frame]:
        yield from self._frames(None, self._last)

    def _frames(self, packet: Any, where: str) -> Iterator[Frame]:
        import av

        try:
            decoded = self._codec.decode(packet)
        except av.error.FFmpegError as error:
            why = error.strerror or error
            if is_size_error(error):
                why = f"{why}; it is damaged, or too large: {too_large()}"
            raise McaptrackError(f"{where} can't be decoded: {why}") from error
        for frame in decoded:
            t_ns, index = self._pending.pop(frame.pts)
            if frame.is_corrupt:
                self._damaged.append(index)
            if self._wanted is None or index in self._wanted:
                yield Frame(t_ns, index, self._of_frame(frame))


def _bgr_of_frame() -> Callable[[Any], Image]:
    """A function that gives decoded pictures in BGR; it prepares the conversion once, which takes as long as one."""
    import av

    reformatter: Any = av.video.reformatter.VideoReformatter()

    def bgr(frame: Any) -> Image:
        return np.asarray(reformatter.reformat(frame, format="bgr24").to_ndarray(), np.uint8)

    return bgr


def _luma(frame: Any) -> Image:
    """A decoded picture in gray; its Y plane if it has one with 8 bits."""
    import cv2

    if not frame.format.name.startswith(("yuv4", "yuvj4", "nv12", "gray")) or frame.format.components[0].bits != 8:
        frame = frame.reformat(format="gray")
    plane = frame.planes[0]
    rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: frame.height, : frame.width]
    full = frame.color_range == _FULL_RANGE or frame.format.name.startswith(("gray", "yuvj"))
    return rows.copy() if full else np.asarray(cv2.LUT(rows, _LIMITED_TO_FULL), np.uint8)
