"""Pictures -> H.264, JPEG, PNG; and a video file of pictures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.atomic import publish
from mcaptrack.clock import NS_PER_S
from mcaptrack.errors import McaptrackError

ImageFormat = Literal["h264", "jpeg", "png"]
Image = NDArray[np.uint8]

_MP4_BASE: Final = Fraction(1, 90_000)
_GIF_BASE: Final = Fraction(1, 100)

_JPEG_QUALITY: Final = 90
# No B-frames, a key picture every second with its parameter sets, four slices whatever the machine's cores: the same
# input gives the same bytes everywhere.
_X264: Final = {
    "preset": "veryfast",
    "tune": "zerolatency",
    "crf": "23",
    "bf": "0",
    "x264-params": "scenecut=0:threads=4:sliced-threads=1",
}
_IN_MESSAGES: Final = {"x264-params": _X264["x264-params"] + ":repeat-headers=1:annexb=1"}


class H264Encoder:
    """Pictures -> H.264 in Annex B form, one access unit a picture, without B-frames."""

    def __init__(self, width_px: int, height_px: int, fps: Fraction) -> None:
        import av

        codec: Any = av.CodecContext.create("libx264", "w")
        codec.width, codec.height, codec.pix_fmt = width_px, height_px, "yuv420p"
        codec.time_base, codec.framerate = 1 / fps, fps
        codec.options = _X264 | _IN_MESSAGES | {"g": str(max(1, round(fps)))}
        self._codec = codec
        self._index = 0

    def encode(self, image: Image) -> bytes:
        """One picture, BGR (height, width, 3)."""
        import av

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24")
        frame.pts = self._index
        self._index += 1
        packets = self._codec.encode(frame)
        return b"".join(bytes(packet) for packet in packets)


def encode_image(image: Image, image_format: ImageFormat) -> bytes:
    """One picture, BGR, as JPEG or PNG."""
    import cv2

    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if image_format == "jpeg" else []
    ok, data = cv2.imencode(f".{image_format}", image, options)
    if not ok:
        raise McaptrackError(f"a picture of {image.shape[1]} x {image.shape[0]} can't be encoded as {image_format}")
    return data.tobytes()


def write_mp4(path: Path, images: Iterable[Image], fps: int) -> int:
    """Write pictures, BGR of one even size, as an H.264 file, there once it is complete. Returns how many."""
    step = Fraction(NS_PER_S, fps)
    return write_clip(path, ((round(number * step), image) for number, image in enumerate(images)), Fraction(fps))


def write_clip(path: Path, images: Iterable[tuple[int, Image]], fps: Fraction) -> int:
    """Write pictures, BGR of one even size, with their times in nanoseconds, as an H.264 file or, by its suffix, a GIF.

    It is there once it is complete. ``fps`` is about how many there are in a second. Returns how many they were.
    """
    import av

    is_gif = path.suffix.lower() == ".gif"
    count, start = 0, 0
    with publish(path) as part, av.open(str(part), "w", format="gif" if is_gif else "mp4") as container:
        stream: Any = None
        palette = _Palette() if is_gif else None

        def put(frame: Any) -> None:
            for packet in stream.encode(frame):
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
    """Pictures -> the same in the 256 colours that suit all of them best, as a GIF needs them."""

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
