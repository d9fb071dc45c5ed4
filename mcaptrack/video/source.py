"""Video files and image folders -> encoded pictures with exact times, one a message.

A stream is passed on without re-encoding where every viewer can play it as it stands (H.264 without B-frames, closed
short groups of pictures, 8-bit 4:2:0, upright); otherwise it is decoded and encoded again, and the reason is said.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.clock import NS_PER_S
from mcaptrack.errors import McaptrackError
from mcaptrack.video import h264
from mcaptrack.video.encode import H264Encoder, ImageFormat, encode_image

Image = NDArray[np.uint8]

IMAGE_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
#: Viewers jump to the last key picture; further apart than this, jumping gets slow.
_MAX_GOP_S: Final = 2.0
_MAX_PIXELS: Final = 2**27


class EncodedPicture(NamedTuple):
    """One picture as a message carries it."""

    t_ns: int
    index: int  # type: ignore[assignment]  # hides tuple.index, which nobody wants here
    data: bytes


@dataclass
class Video:
    """A video file or image folder that can be read; made by ``open_video``.

    ``frames`` is what the container claims, 0 if nothing. ``start_ns`` is when the recording began, if it says.
    ``why_transcode`` is empty where the H.264 stream can be passed on. ``lost`` collects, while pictures are read, what
    could not be.
    """

    path: Path
    width_px: int
    height_px: int
    fps: Fraction | None
    frames: int
    start_ns: int | None
    why_transcode: str
    images: list[Path] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)

    def pictures(self, image_format: ImageFormat, fps: Fraction | None, start_ns: int) -> Iterator[EncodedPicture]:
        """All pictures in order. ``fps`` spaces them evenly instead of by the times of the container."""
        clock = _Clock(self, fps, start_ns)
        if image_format == "h264" and not self.why_transcode:
            yield from _remux(self, clock)
        elif image_format == "h264":
            yield from _transcode(self, clock)
        else:
            for index, (pts, image) in enumerate(_images(self)):
                yield EncodedPicture(clock.time(index, pts), index, encode_image(image, image_format))

    def note_missing(self, read: int) -> None:
        """Compare what was read with what the container claims."""
        if self.frames and read < self.frames:
            self.lost.append(f"{self.path} claims {self.frames} frames; {read} could be read")


class _Clock:
    """Times of pictures: from the container, exact in its time base; or evenly spaced."""

    def __init__(self, video: Video, fps: Fraction | None, start_ns: int) -> None:
        # AVI has no times: what FFmpeg reports there is the order of decoding.
        self._fps = fps or (video.fps if video.images or video.path.suffix.lower() == ".avi" else None)
        self._start_ns = start_ns
        self._first: Fraction | None = None
        self._last = -1

    def time(self, index: int, pts: Fraction | None) -> int:
        if self._fps:
            seconds = index / self._fps
        elif pts is None:
            raise McaptrackError(f"picture {index} has no time in its container; space them evenly with --fps")
        else:
            self._first = pts if self._first is None else self._first
            seconds = pts - self._first
        t_ns = self._start_ns + round(seconds * NS_PER_S)
        self._last = max(t_ns, self._last + 1)  # two pictures never share a time
        return self._last


@contextmanager
def _container(path: Path) -> Iterator[Any]:
    import av

    try:
        with av.open(str(path)) as container:
            yield container
    except av.error.FFmpegError as error:
        raise McaptrackError(
            f"{path} can't be read as a video ({error.strerror or error}); "
            "give an mp4, mov, mkv, avi or webm file that is whole"
        ) from error


def _fraction(ratio: Any) -> Fraction | None:
    return Fraction(ratio.numerator, ratio.denominator) if ratio else None


def open_video(path: Path) -> Video:
    """Look at a video file or image folder. Raises McaptrackError unless it holds pictures that can be decoded."""
    if path.is_dir():
        return _open_folder(path)
    with _container(path) as container:
        if not container.streams.video:
            kinds = sorted({stream.type for stream in container.streams}) or ["no streams"]
            raise McaptrackError(f"{path} holds no video, only {', '.join(kinds)}")
        stream = container.streams.video[0]
        context = stream.codec_context
        if context is None:
            raise McaptrackError(f"{path} holds video in a codec that is not known here; convert it to H.264 first")
        if context.width * context.height > _MAX_PIXELS:
            raise McaptrackError(
                f"{path} has pictures of {context.width} x {context.height}; at most {_MAX_PIXELS} pixels"
            )
        first = next(container.decode(stream), None)
        if first is None:
            raise McaptrackError(f"{path} is a video without frames")
        upright = (first.height, first.width) if first.rotation % 180 else (first.width, first.height)
        video = Video(
            path,
            upright[0] + upright[0] % 2,
            upright[1] + upright[1] % 2,
            _fraction(stream.average_rate),
            stream.frames,
            _creation_ns(container.metadata.get("creation_time") or stream.metadata.get("creation_time")),
            f"it is turned by {first.rotation} degrees" if first.rotation else "",
        )
    video.why_transcode = video.why_transcode or _why_transcode(path)
    return video


def _open_folder(path: Path) -> Video:
    import cv2

    images = sorted((p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES), key=_natural)
    if not images:
        raise McaptrackError(f"{path} holds no images ({', '.join(IMAGE_SUFFIXES)})")
    first = cv2.imread(str(images[0]), cv2.IMREAD_COLOR)
    if first is None:
        raise McaptrackError(f"{images[0]} can't be read as an image")
    height, width = first.shape[:2]
    fps = seqinfo_fps(path)
    return Video(
        path, width + width % 2, height + height % 2, fps, len(images), None, "it is a folder of images", images
    )


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key by which 2.jpg comes before 10.jpg."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name) if part]


def seqinfo_fps(folder: Path) -> Fraction | None:
    """The frame rate that a MOTChallenge sequence states in the seqinfo.ini in ``folder`` or above it."""
    for info in (folder / "seqinfo.ini", folder.parent / "seqinfo.ini"):
        found = (
            re.search(r"^frameRate\s*=\s*([\d.]+)", info.read_text(encoding="utf-8"), re.M) if info.is_file() else None
        )
        if found:
            return Fraction(found.group(1))
    return None


def _creation_ns(text: str | None) -> int | None:
    try:
        return round(datetime.fromisoformat(text).timestamp() * 1e6) * 1000 if text else None
    except ValueError:
        return None


def _why_transcode(path: Path) -> str:
    """Why the stream can't be passed on as it is, from one pass over its packets; "" if it can."""
    from av.bitstream import BitStreamFilterContext

    with _container(path) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        if context.name != "h264":
            return f"it is {context.name}, not h264"
        if context.pix_fmt not in ("yuv420p", "yuvj420p"):
            return f"its pixels are {context.pix_fmt}, not 8-bit 4:2:0"
        if context.has_b_frames:
            return "it has B-frames"
        to_annex_b = BitStreamFilterContext("h264_mp4toannexb", stream)
        base, no_times = _fraction(stream.time_base) or Fraction(1), path.suffix.lower() == ".avi"
        last_pts, key_at, count = None, None, 0
        for packet in container.demux(stream):
            if packet.size == 0:
                continue
            if packet.is_discard:
                return "an edit list hides some of its frames"
            if packet.pts is None and not no_times:
                return "some of its frames have no time"
            if last_pts is not None and packet.pts is not None and packet.pts <= last_pts:
                return "its frames are not in the order of their times"
            last_pts = packet.pts
            seconds = Fraction(count) / (_fraction(stream.average_rate) or 30) if no_times else packet.pts * base
            is_key = packet.is_keyframe
            units = to_annex_b.filter(packet)  # takes the packet's contents with it
            if len(units) != 1:
                return "its packets are not one picture each"
            picture = h264.inspect(bytes(units[0]))
            if picture.has_b_slice:
                return "it has B-frames"
            if is_key and not (picture.has_idr and picture.has_parameter_sets):
                return "not every key frame can be decoded on its own (open groups of pictures)"
            if count == 0 and not is_key:
                return "it does not begin with a key frame"
            key_at = seconds if is_key else key_at
            if key_at is not None and seconds - key_at > _MAX_GOP_S:
                return f"its key frames are more than {_MAX_GOP_S:g} s apart"
            count += 1
    return ""


def _remux(video: Video, clock: _Clock) -> Iterator[EncodedPicture]:
    from av.bitstream import BitStreamFilterContext

    with _container(video.path) as container:
        stream = container.streams.video[0]
        to_annex_b = BitStreamFilterContext("h264_mp4toannexb", stream)
        base, index = _fraction(stream.time_base) or Fraction(1), 0
        for packet in container.demux(stream):
            if packet.size == 0:
                continue
            pts = None if packet.pts is None else packet.pts * base
            (unit,) = to_annex_b.filter(packet)
            yield EncodedPicture(clock.time(index, pts), index, bytes(unit))
            index += 1
    video.note_missing(index)


def _transcode(video: Video, clock: _Clock) -> Iterator[EncodedPicture]:
    encoder = H264Encoder(video.width_px, video.height_px, clock._fps or video.fps or Fraction(30))
    for index, (pts, image) in enumerate(_images(video)):
        yield EncodedPicture(clock.time(index, pts), index, encoder.encode(image))


def _images(video: Video) -> Iterator[tuple[Fraction | None, Image]]:
    """Decoded pictures, BGR (height, width, 3), upright and of even size, with their times in seconds."""
    read, corrupt = 0, 0
    for pts, image, damaged in _folder_images(video) if video.images else _decoded(video):
        corrupt += damaged
        read += 1
        yield pts, _fit(image, video.width_px, video.height_px)
    if corrupt:
        video.lost.append(f"{video.path}: {corrupt} of {read} frames are damaged; they are kept as far as they decode")
    video.note_missing(read)


def _folder_images(video: Video) -> Iterator[tuple[None, Image, bool]]:
    import cv2

    for path in video.images:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            video.lost.append(f"{path} can't be read as an image; it is left out")
            continue
        yield None, np.asarray(image, np.uint8), False


def _decoded(video: Video) -> Iterator[tuple[Fraction | None, Image, bool]]:
    import av

    with _container(video.path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        base = _fraction(stream.time_base) or Fraction(1)
        packets = container.demux(stream)
        while True:
            try:
                packet = next(packets, None)
                if packet is None:
                    return
                frames = packet.decode()
            except av.error.FFmpegError as error:
                video.lost.append(f"{video.path}: a packet can't be decoded ({error.strerror or error})")
                continue
            for frame in frames:
                pts = None if frame.pts is None else frame.pts * base
                image = np.rot90(frame.to_ndarray(format="bgr24"), frame.rotation // 90)
                yield pts, image, bool(frame.is_corrupt)


def _fit(image: Image, width: int, height: int) -> Image:
    """Pad the right and lower edge to the (even) size of the video; pictures of another size are refused."""
    right, below = width - image.shape[1], height - image.shape[0]
    if not (0 <= right <= 1 and 0 <= below <= 1):
        raise McaptrackError(
            f"pictures change their size from {width} x {height} to {image.shape[1]} x {image.shape[0]}"
        )
    return np.pad(image, ((0, below), (0, right), (0, 0)), mode="edge") if right or below else image
