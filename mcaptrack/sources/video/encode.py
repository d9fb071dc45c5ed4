"""Encode pictures as H.264, JPEG or PNG, and write video files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from mcaptrack.choices import ImageFormat
from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish
from mcaptrack.geometry.arrays import Image
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.sources.video.container import writing

StillFormat = Literal["jpeg", "png"]

_MP4_BASE: Final = Fraction(1, 90_000)
_GIF_BASE: Final = Fraction(1, 100)

_BT601: Final = 6  # AVCOL_SPC_SMPTE170M
_STILLS: Final = ("jpeg", "png")
_JPEG_QUALITY: Final = 90
_CRF: Final = 23
_KEY_EVERY_S: Final = 1.0
#: Viewers seek by decoding from the last key picture; a longer distance makes seeking slow.
_KEY_WITHIN_S: Final = 2.0
#: The ranges of JPEG quality and of x264's constant rate factor (0 is lossless, which browsers don't play).
_QUALITIES: Final = {"jpeg": (1, 100), "h264": (1, 51)}
_INTERVALS_S: Final = (0.01, 60.0)
# No B-frames; key pictures with parameter sets; always four slices, so that the output doesn't depend on the number of
# cores.
_X264: Final = {
    "preset": "veryfast",
    "tune": "zerolatency",
    "crf": str(_CRF),
    "bf": "0",
    "x264-params": "scenecut=0:threads=4:sliced-threads=1",
}
_IN_MESSAGES: Final = {"x264-params": _X264["x264-params"] + ":repeat-headers=1:annexb=1", "forced-idr": "1"}


@dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """Options of storing the pictures of a video in a log.

    Parameters
    ----------
    image_format : str
        "auto" passes H.264, VP9 and AV1 through unchanged if viewers can play them, "h265" also H.265, "h264" only
        H.264; other streams are transcoded to H.264. "jpeg" and "png" store every picture by itself.
    quality : int, optional
        For JPEG from 1 to 100 (best). For H.264 the constant rate factor from 1 (best) to 51; then every stream is
        transcoded.
    keyframe_interval_s : float, optional
        Maximum time between key pictures: of streams that are passed through (default 2) and transcoded (default 1).
    fps : Fraction, optional
        Frame rate that replaces the timestamps of the container.
    stream : int, optional
        Number of the video stream in a file with several, from 0; by default the first of more than one picture.

    Raises
    ------
    McaptrackError
        For values out of range, and for options that contradict each other.
    """

    image_format: ImageFormat = "auto"
    quality: int | None = None
    keyframe_interval_s: float | None = None
    fps: Fraction | None = None
    stream: int | None = None

    def __post_init__(self) -> None:
        name = self.image_format
        low, high = _QUALITIES.get(name, _QUALITIES["h264"])
        if self.quality is not None and name == "png":
            raise McaptrackError("`quality=` is for H.264 and JPEG; PNG keeps pictures exactly as they are")
        if self.quality is not None and not low <= self.quality <= high:
            scale = "JPEG's" if name == "jpeg" else "H.264's constant rate factor"
            best = high if name == "jpeg" else low
            raise McaptrackError(
                f"`quality=` is {scale}, a number from {low} to {high} ({best} is best), not {self.quality}"
            )
        if self.keyframe_interval_s is not None:
            if self.is_still:
                raise McaptrackError(f"`keyframe_interval_s=` is for video; as {name}, every picture stands alone")
            if not _INTERVALS_S[0] <= self.keyframe_interval_s <= _INTERVALS_S[1]:
                raise McaptrackError(
                    f"`keyframe_interval_s=` is a number from {_INTERVALS_S[0]:g} to {_INTERVALS_S[1]:g}, "
                    f"not {self.keyframe_interval_s:g}"
                )

    @property
    def is_still(self) -> bool:
        """Whether every picture is stored by itself."""
        return self.image_format in _STILLS

    @property
    def jpeg_quality(self) -> int:
        """JPEG quality from 1 to 100."""
        return _JPEG_QUALITY if self.quality is None else self.quality

    @property
    def crf(self) -> int:
        """x264's constant rate factor."""
        return _CRF if self.quality is None else self.quality

    @property
    def key_every_s(self) -> float:
        """Seconds between key pictures of transcoded streams."""
        return self.keyframe_interval_s or _KEY_EVERY_S

    @property
    def key_within_s(self) -> float:
        """Maximum seconds between key pictures of streams that are passed through."""
        return self.keyframe_interval_s or _KEY_WITHIN_S


class H264Encoder:
    """Encodes pictures as H.264 in Annex B format, one access unit for each picture, without B-frames.

    Key pictures are at most ``key_every_s`` apart, by the times of the pictures or, without times, by ``fps``. The
    colour space is that of ``like``, a frame of FFmpeg; arrays are converted by ITU-R BT.601.
    """

    def __init__(
        self,
        width_px: int,
        height_px: int,
        fps: Fraction,
        crf: int = _CRF,
        key_every_s: float = _KEY_EVERY_S,
        like: Any = None,
    ) -> None:
        import av

        codec: Any = av.CodecContext.create("libx264", "w")
        codec.width, codec.height, codec.pix_fmt = width_px, height_px, "yuv420p"
        codec.time_base, codec.framerate = 1 / fps, fps
        if isinstance(like, av.VideoFrame):
            codec.colorspace = like.colorspace
            codec.color_primaries, codec.color_trc = like.color_primaries, like.color_trc
        else:
            codec.colorspace = _BT601
        group = max(1, round(fps * Fraction(key_every_s)))
        codec.options = _X264 | _IN_MESSAGES | {"g": str(group), "crf": str(crf)}
        self._codec = codec
        self._index = 0
        self._key_every_ns, self._key_ns = round(key_every_s * NS_PER_S), 0

    def encode(self, image: Image | Any, t_ns: int | None = None) -> bytes:
        """Encode one picture: BGR (height, width, 3) uint8, or a frame of FFmpeg with exactly this size."""
        import av
        from av.video.frame import PictureType

        is_image = isinstance(image, np.ndarray)
        frame: Any = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24") if is_image else image
        if t_ns is not None and t_ns - self._key_ns >= self._key_every_ns:
            frame.pict_type = PictureType.I
        else:
            frame.pict_type = PictureType.NONE
        frame.pts, frame.time_base = self._index, self._codec.time_base
        self._index += 1
        try:
            packets = self._codec.encode(frame)
        except av.error.FFmpegError as error:
            raise _encoder_error(frame, error) from error
        if t_ns is not None and any(packet.is_keyframe for packet in packets):
            self._key_ns = t_ns
        return b"".join(bytes(packet) for packet in packets)


def _encoder_error(frame: Any, error: Exception) -> McaptrackError:
    """The error for a picture that the encoder rejects; libx264 takes at most 16384 rows and columns."""
    why = getattr(error, "strerror", None) or error
    return McaptrackError(
        f"pictures of {frame.width} x {frame.height} can't be encoded as H.264 ({why}); jpeg and png can be larger"
    )


def encode_image(image: Image, image_format: StillFormat, quality: int = _JPEG_QUALITY) -> bytes:
    """Encode one picture, BGR (height, width, 3) uint8, as JPEG with a ``quality`` from 1 to 100, or as PNG."""
    import cv2

    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if image_format == "jpeg" else []
    ok, data = cv2.imencode(f".{image_format}", image, options)
    if not ok:
        raise McaptrackError(f"a picture of {image.shape[1]} x {image.shape[0]} can't be encoded as {image_format}")
    return data.tobytes()


def write_mp4(path: Path, images: Iterable[Image], fps: int) -> int:
    """Write pictures, BGR of one even size, to an H.264 file, published when complete. Returns their number."""
    step = Fraction(NS_PER_S, fps)
    return write_clip(path, ((round(number * step), image) for number, image in enumerate(images)), Fraction(fps))


def write_clip(path: Path, images: Iterable[tuple[int, Image]], fps: Fraction) -> int:
    """Write pictures, BGR of one even size, with times in nanoseconds, to an H.264 file or (suffix .gif) a GIF.

    The file is published when it is complete. ``fps`` is the approximate frame rate. Returns the number of pictures.
    """
    import av

    is_gif = path.suffix.lower() == ".gif"
    count, start = 0, 0
    with publish(path) as part, writing(part, "gif" if is_gif else "mp4") as container:
        stream: Any = None
        palette = _Palette() if is_gif else None

        def put(frame: Any) -> None:
            try:
                packets = stream.encode(frame)
            except av.error.FFmpegError as error:
                raise (_encoder_error(frame, error) if frame else error) from error
            for packet in packets:
                container.mux(packet)

        for t_ns, image in images:
            if stream is None:
                options = {} if is_gif else _X264 | {"g": str(max(1, round(fps)))}
                stream = container.add_stream("gif" if is_gif else "libx264", rate=fps, options=options)
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = "pal8" if is_gif else "yuv420p"
                stream.codec_context.time_base = _GIF_BASE if is_gif else _MP4_BASE
                start = t_ns
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24")
            frame.time_base = stream.codec_context.time_base
            frame.pts = round(Fraction(t_ns - start, NS_PER_S) / frame.time_base)
            if palette:
                palette.push(frame)
            else:
                put(frame)
            count += 1
        for frame in palette.frames() if palette else ():
            put(frame)
        if stream is not None:
            put(None)
    return count


class _Palette:
    """Reduces pictures to the 256 colours that suit all of them best, for a GIF."""

    def __init__(self) -> None:
        self._graph: Any = None

    def push(self, frame: Any) -> None:
        import av

        if self._graph is None:
            graph = self._graph = av.filter.Graph()
            size, form = {"width": frame.width, "height": frame.height}, av.VideoFormat("bgr24")
            source: Any = graph.add_buffer(**size, format=form, time_base=_GIF_BASE)
            split, colours = graph.add("split"), graph.add("palettegen", "stats_mode=full")
            use = graph.add("paletteuse", "dither=bayer:bayer_scale=4:diff_mode=rectangle")
            sink = graph.add("buffersink")
            source.link_to(split)
            split.link_to(use, 0, 0)
            split.link_to(colours, 1, 0)
            colours.link_to(use, 0, 1)
            use.link_to(sink)
            graph.configure()
        self._graph.push(frame)

    def frames(self) -> Iterator[Any]:
        import av

        if self._graph is None:
            return
        self._graph.push(None)
        while True:
            try:
                yield self._graph.pull()
            except (av.error.EOFError, av.error.BlockingIOError):
                return
