"""Decode pictures: to gray for detectors, to BGR for people."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator
from fractions import Fraction
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Image
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import Frame
from mcaptrack.sources.video.codecs import CODECS, largest_size
from mcaptrack.sources.video.container import is_size_error
from mcaptrack.sources.video.limits import check_size, check_still, is_deep, max_pixels, still_size, too_large
from mcaptrack.sources.video.pixels import (
    LIMITED_TO_FULL,
    PixelLayout,
    Samples,
    Span,
    pixel_format,
    raw_bgr,
    raw_gray,
    raw_samples,
    shown,
)
from mcaptrack.sources.video.recognise import UNREAD

#: Still pictures that are read.
_STILLS: Final = ("jpeg", "png", "bmp", "tiff", "webp", "avif")
_FULL_RANGE: Final = 2  # AVCOL_RANGE_JPEG


class EncodedPicture(NamedTuple):
    """A picture in a log: ``format`` is "h264", "jpeg" and so on; with a ``layout`` it is a pixel format, as in "rgb8".

    ``where`` names the picture in errors; by default its number does. ``span`` are the values that become black and
    white where samples have more than 8 bits, and ``pixels`` is the pixel format of a still image, "" for usual ones.
    ``error`` says why a message holds no picture.
    """

    t_ns: int
    index: int  # type: ignore[assignment]  # hides tuple.index, which is not needed here
    format: str
    data: bytes
    layout: PixelLayout | None = None
    where: str = ""
    span: Span | None = None
    pixels: str = ""
    error: str = ""

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
    *,
    is_grey: bool = True,
) -> Iterator[Frame]:
    """Decode pictures to gray, or to BGR.

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
    is_grey : bool
        Gray, which is quicker; otherwise BGR.

    Yields
    ------
    Frame
        ``rows`` is the picture, (height, width) uint8 from 0 to 255, or (height, width, 3): blue, green, red.

    Raises
    ------
    McaptrackError
        For a format that can't be decoded, and for damaged pictures; with ``unreadable`` if no image can be decoded.
    """
    of_frame = _luma if is_grey else _bgr_of_frame()
    decoder: _VideoDecoder | None = None
    is_any_readable = False
    for picture in pictures:
        if picture.format == UNREAD and not picture.layout:
            continue
        if picture.is_video:
            if decoder is None or decoder.name != picture.format:
                yield from decoder.flush() if decoder else ()
                decoder = _VideoDecoder(picture.format, of_frame, wanted, [] if damaged is None else damaged)
            yield from decoder.decode(picture)
        elif wanted is not None and picture.index not in wanted:
            continue
        else:
            try:
                _check_readable(picture)
                pixels = _raw(picture, is_grey) if picture.layout else _still(picture, is_grey)
            except McaptrackError as cause:
                named = picture.name in str(cause)
                error = cause if named else McaptrackError(f"{picture.name}: {cause}")
                if unreadable is None or (len(unreadable) == _MOST_UNREADABLE and not (is_any_readable or decoder)):
                    raise error from None
                unreadable.append(error)
                continue
            is_any_readable = True
            yield Frame(picture.t_ns, picture.index, pixels)
    if decoder:
        yield from decoder.flush()
    elif unreadable and not is_any_readable:
        raise unreadable[0]


#: Decode pictures to BGR, as ``decode_gray`` does to gray.
decode_bgr: Final = partial(decode_gray, is_grey=False)


def _check_readable(picture: EncodedPicture) -> None:
    """Raise McaptrackError if the message of a picture could not be read."""
    if picture.error:
        raise McaptrackError(picture.error)


def _raw(picture: EncodedPicture, is_grey: bool) -> Image:
    assert picture.layout
    width, height, *_ = picture.layout
    if width * height <= len(picture.data):
        check_size(width, height, picture.name)
    return (raw_gray if is_grey else raw_bgr)(picture.format, picture.data, picture.layout, picture.span)


def _still(picture: EncodedPicture, is_grey: bool) -> Image:
    import cv2

    tile = pixel_format(picture.pixels).tile if picture.pixels else ""
    if not tile and not is_deep(picture.data):
        return np.asarray(_decoded_still(picture, cv2.IMREAD_GRAYSCALE if is_grey else cv2.IMREAD_COLOR), np.uint8)
    samples = _decoded_still(picture, cv2.IMREAD_UNCHANGED)
    if samples.ndim == 3 and samples.shape[2] in (3, 4):  # if it was a mosaic, colours were made of it
        return shown(samples, "bgra"[: samples.shape[2]], "", picture.span, is_grey)
    return shown(samples if samples.ndim == 2 else samples[..., 0], "y", tile, picture.span, is_grey)


def _decoded_still(picture: EncodedPicture, how: int) -> Samples:
    import cv2

    size, image = still_size(picture.data), None
    if size is not None:
        check_still(size, picture.name)
        try:
            image = cv2.imdecode(np.frombuffer(picture.data, np.uint8), how)
        except cv2.error:  # the header contradicts the data
            image = None
    if image is None:
        read = "" if picture.format in (*_STILLS, "") else f"; {', '.join(_STILLS)} are read"
        raise McaptrackError(f"{picture.name} can't be decoded as {picture.format or 'an image'}{read}")
    return np.asarray(image)


def wide_samples(picture: EncodedPicture) -> Samples | None:
    """The samples of a picture with more than 8 bits, (H, W, N), without alpha; None for others, and for videos.

    Those of a mosaic are half as wide and high, with the four of each square.
    Raises McaptrackError as ``decode_gray``.
    """
    import cv2

    _check_readable(picture)
    name = picture.format if picture.layout else picture.pixels
    tile = pixel_format(name).tile if name else ""
    if picture.layout:
        if not pixel_format(name, picture.layout).is_wide:
            return None
        samples = raw_samples(name, picture.data, picture.layout)
    elif picture.is_video or not is_deep(picture.data):
        return None
    else:
        samples = _decoded_still(picture, cv2.IMREAD_UNCHANGED)
        samples = samples.reshape(*samples.shape[:2], -1)
    if tile and samples.shape[2] == 1:
        height, width = (size // 2 * 2 for size in samples.shape[:2])
        parts = [samples[y:height:2, x:width:2, 0] for y in (0, 1) for x in (0, 1)]
        return np.stack(parts, axis=-1) if samples.dtype != np.uint8 else None
    samples = samples[..., :3]
    return None if samples.dtype == np.uint8 else samples


class _VideoDecoder:
    def __init__(
        self, name: str, of_frame: Callable[[Any], Image], wanted: Container[int] | None, damaged: list[int]
    ) -> None:
        import av

        self.name, self._of_frame, self._wanted, self._damaged = name, of_frame, wanted, damaged

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
    return rows.copy() if full else np.asarray(cv2.LUT(rows, LIMITED_TO_FULL), np.uint8)
