"""Read video files and image folders as encoded pictures with exact times, one for each message.

A stream is passed through without transcoding if every viewer can play it (``passthrough``); otherwise it is decoded
and encoded again, and the reason is reported.
"""

from __future__ import annotations

import struct
from array import array
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from fractions import Fraction
from io import FileIO
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Image, Ints
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.sources.video.codecs import CODECS
from mcaptrack.sources.video.container import (
    choose_stream,
    count_edited,
    count_empty,
    count_indexed,
    ends_s,
    fraction,
    has_sizes,
    has_slots,
    has_times,
    reading,
)
from mcaptrack.sources.video.decode import EncodedPicture, decode_gray
from mcaptrack.sources.video.encode import H264Encoder, StillFormat, VideoOptions, encode_image
from mcaptrack.sources.video.image_folder import Images, find_images, find_seqinfo, measure_span, read_image
from mcaptrack.sources.video.limits import check_h264, check_size
from mcaptrack.sources.video.passthrough import check_stream, packets
from mcaptrack.sources.video.pixels import Span

#: A fixed number of threads, so that damaged streams decode to the same pictures on every machine.
_THREADS: Final = 4
_PLACEHOLDER: Final = 1  # bytes of a packet that stands for no picture in AVI, as encoders with B-frames begin
_ONE_EACH: Final = ("h264", "hevc")  # codecs with a picture in each packet, if it has no fields
_MOST_DAMAGED: Final = 250  # packets at the beginning without a picture, after which a stream is given up
_HDR: Final = {16: "PQ", 18: "HLG"}  # AVCOL_TRC_SMPTE2084, AVCOL_TRC_ARIB_STD_B67


class PictureMessage(NamedTuple):
    """One encoded picture, to be written as a message."""

    t_ns: int
    index: int  # type: ignore[assignment]  # hides tuple.index, which is not needed here
    data: bytes


class DecodedPicture(NamedTuple):
    """One decoded picture: its number, its time in seconds, if it has one, and a frame of FFmpeg or BGR (H, W, 3).

    Pictures that can't be decoded are counted, too.
    """

    index: int  # type: ignore[assignment]  # hides tuple.index, which is not needed here
    seconds: Fraction | None
    picture: Any


# Count the slots for pictures in containers that number pictures instead of storing times: AVI and IVF.
#
# Slots may be empty, where nothing moved or no picture arrived. The container declares its number of slots; if
# there are fewer, the file was cut off.


_RIFF_HEAD, _CHUNK_HEAD, _IVF_FRAME_HEAD = 12, 8, 12
_LISTS: Final = (b"movi", b"rec ")
#: Packets by which the order of decoding is known, and the most pictures that are shown between two and decoded later.
_SEEN_FOR_ORDER, _MOST_BETWEEN = 100, 16


def count_slots(path: Path, stream: int) -> int | None:
    """The number of slots of a stream that the file really holds; None for other containers."""
    with path.open("rb", buffering=0) as file:  # only the heads of chunks are read, far apart
        head = file.read(_RIFF_HEAD)
        if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
            return _avi(file, path.stat().st_size, b"%02d" % stream)
        if head[:4] == b"DKIF":
            return _ivf(file, path.stat().st_size, int.from_bytes(head[6:8], "little"))
    return None


def _avi(file: FileIO, size: int, name: bytes) -> int:
    """Count the chunks "00dc" and "00db" in all lists of all RIFF parts of the file."""
    count, at = 0, 0
    while at + _CHUNK_HEAD <= size:
        file.seek(at)
        head = file.read(_RIFF_HEAD)
        kind, length = head[:4], int.from_bytes(head[4:8], "little")
        if kind == b"RIFF" or (kind == b"LIST" and head[8:12] in _LISTS):
            at += _RIFF_HEAD
            continue
        at += _CHUNK_HEAD + length + length % 2
        count += kind[:2] == name and kind[2:] in (b"dc", b"db") and at - length % 2 <= size
    return count


def _ivf(file: FileIO, size: int, first: int) -> int:
    count, at = 0, first
    while at + _IVF_FRAME_HEAD <= size:
        file.seek(at)
        at += _IVF_FRAME_HEAD + int.from_bytes(file.read(4), "little")
        count += at <= size
    return count


def in_slots(pictures: Iterator[DecodedPicture], delay: int, slot_s: Fraction) -> Iterator[DecodedPicture]:
    """Give pictures, in the order in which they are shown, the times of the slots in which they are shown.

    They come with the time of the slot that holds them, slots being in the order of decoding. Picture i is due when the
    decoder gives it out, with the packet of picture i + ``delay``; the first stays from its own slot on. Slots without
    a picture are passed over, wherever they are.
    """
    waiting: deque[DecodedPicture] = deque()
    slots: list[Fraction] = []
    is_first = True
    for picture in pictures:
        waiting.append(picture)
        insort(slots, picture.seconds or Fraction())
        if len(waiting) > (delay and delay + _MOST_BETWEEN):  # all slots up to that of the first are in the list
            seconds = min(slots[delay], slots[0] + delay * slot_s) if is_first else slots[delay]
            yield waiting.popleft()._replace(seconds=seconds)
            del slots[0]
            is_first = False
    slots += [slots[-1] + number * slot_s for number in range(1, delay + 1)] if slots else []
    for picture, seconds in zip(waiting, slots[delay:], strict=True):
        yield picture._replace(seconds=min(seconds, slots[0] + delay * slot_s) if is_first else seconds)
        is_first = False


def _delay(video: Video) -> int:
    """The number of packets after which a decoder gives a picture out, by its first pictures; 0 if all are in order."""
    import av

    order, given_out = list[int](), list[int | None]()
    with reading(video.path) as opened:
        stream = opened.streams[video.stream]
        if not stream.codec_context.has_b_frames:
            return 0
        for number, packet in zip(range(_SEEN_FOR_ORDER), opened.demux(stream), strict=False):
            packet.pts = packet.dts = number
            try:
                frames = packet.decode()
            except av.error.FFmpegError:
                continue
            order += [frame.pts for frame in frames]
            given_out += [frame.dts for frame in frames]
    in_order = sorted(order)
    if order == in_order:
        return 0
    return max(bisect_left(in_order, number) - at for at, number in enumerate(given_out) if number is not None)


# Times of pictures as messages: strictly increasing; and what is odd about those of the container.


#: Pictures are regular if this share of their intervals is within a tenth of the median, or within the tick of a clock
#: of milliseconds. An interval is a gap if at least two pictures would fit between.
_REGULAR, _ALIKE, _TICK_NS, _GAP = 0.9, 0.1, 1_500_000, 2.5
_FEWEST: Final = 10
#: A clock that goes back by more begins again; pictures are never so much out of order.
_RESTART_NS: Final = NS_PER_S


class Clock:
    """Times of pictures in ns: from the container, exact in its time base, or evenly spaced by ``fps``."""

    def __init__(self, where: Path, start_ns: int, fps: Fraction | None) -> None:
        self.fps = fps
        self._where, self._start_ns = where, start_ns
        self._first: Fraction | None = None
        self._times = array("q")
        self._moved, self._first_moved = 0, 0
        #: What is added to the times of the container since its clock began again, and what was added before that.
        self._shift_ns, self._before_ns = 0, 0
        self._restarts: list[int] = []

    def time(self, index: int, seconds: Fraction | None) -> int:
        """The time of picture ``index``, which is ``seconds`` in the container."""
        if self.fps:
            seconds = index / self.fps
        elif seconds is None:
            raise McaptrackError(
                f"{self._where}: picture {index} has no time in its container; space them evenly with `fps=`"
            )
        else:
            self._first = seconds if self._first is None else self._first
            seconds -= self._first
        t_ns = self._continued(index, self._start_ns + round(seconds * NS_PER_S))
        if not 0 <= t_ns < LAST_NS:
            raise McaptrackError(
                f"{self._where}: picture {index} is {float(seconds):g} s after the first; times reach to the year 2262"
            )
        if self._times and t_ns <= self._times[-1]:
            self._first_moved = self._first_moved if self._moved else index
            self._moved += 1
            t_ns = self._times[-1] + 1
        self._times.append(t_ns)
        return t_ns

    def _continued(self, index: int, t_ns: int) -> int:
        """The time of picture ``index`` that is ``t_ns`` by the clock of the container, which may have begun again."""
        last = self._times[-1] if self._times else t_ns
        if t_ns + self._shift_ns < last - _RESTART_NS:
            steps = np.diff(np.frombuffer(self._times, np.int64)[-_SEEN_FOR_ORDER:])
            self._before_ns = self._shift_ns
            self._shift_ns = last + (int(np.median(steps)) if len(steps) else NS_PER_S) - t_ns
            self._restarts.append(index)
        elif 0 < t_ns + self._before_ns - last < _RESTART_NS < t_ns + self._shift_ns - last:
            self._shift_ns = self._before_ns  # only some pictures had other times
        return t_ns + self._shift_ns

    def warn(self) -> None:
        """Warn about times that had to be moved, and about gaps in regular ones."""
        if self._restarts:
            often = "once" if len(self._restarts) == 1 else f"{len(self._restarts)} times"
            warn(
                f"{self._where}: the clock goes back {often}, first before picture {self._restarts[0]}, as where files "
                "were joined; what follows is put one interval after what came before (`fps=` spaces all evenly)",
                "clock",
            )
        if self._moved:
            warn(
                f"{self._where}: {self._moved} of {len(self._times)} pictures are not later than the one before, "
                f"number {self._first_moved} first; they are put 1 ns after it (`fps=` spaces all evenly)",
                "clock",
            )
        if self.fps or len(self._times) < _FEWEST:
            return
        times: Ints = np.frombuffer(self._times, np.int64)
        steps = times[1:] - times[:-1]
        usual = float(np.median(steps))
        is_usual = np.abs(steps - usual) <= max(_ALIKE * usual, _TICK_NS)
        gaps = np.flatnonzero(steps >= _GAP * usual)
        if len(gaps) and is_usual.mean() >= _REGULAR:
            missing = int((np.rint(steps[gaps] / usual) - 1).sum())
            places = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
            at_s, longest_s = (times[gaps[0]] - times[0]) / NS_PER_S, steps[gaps].max() / NS_PER_S
            warn(
                f"{self._where} has {places} between pictures that otherwise come every {usual / 1e6:.4g} ms, the "
                f"first after {at_s:.2f} s, the longest of {longest_s:.2f} s: about {missing} pictures were not "
                "recorded, or are lost",
                "clock",
            )


# Turn and mirror pictures as their video says, and fit them into its size.


FULL_RANGE: Final = 2  # AVCOL_RANGE_JPEG
_LIMITED_RANGE: Final = 1  # AVCOL_RANGE_MPEG
_MATRIX: Final = struct.Struct("=9i")
#: Matrices are axis-aligned if the other entries are at most this share of the largest: the tangent of one degree.
_STRAIGHT: Final = 0.0175


class Orientation(NamedTuple):
    """The orientation of pictures: transposed, then mirrored from left to right, then from top to bottom.

    ``description`` says it, "" for pictures shown as they are stored. ``oblique`` is an angle in degrees by which
    they should be turned and aren't, because it is none of quarter turns.
    """

    is_transposed: bool = False
    flips_x: bool = False
    flips_y: bool = False
    description: str = ""
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
    matrix = bytes(frame.side_data.get("DISPLAYMATRIX") or b"")
    if len(matrix) != _MATRIX.size:
        return Orientation()
    a, b, _, c, d, *_ = _MATRIX.unpack(matrix)
    turned = f"turned by {frame.rotation} degrees"
    largest = max(map(abs, (a, b, c, d)))
    if max(abs(b), abs(c)) <= _STRAIGHT * largest and a and d:
        flips = a < 0, d < 0
        names = {(True, True): turned, (True, False): "mirrored", (False, True): "mirrored from top to bottom"}
        return Orientation(False, *flips, names.get(flips, ""))
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
        and not orientation.description
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


@dataclass
class Video:
    """A video file or image folder, open for reading; made by ``open_video``.

    ``format`` is the format of its messages ("h264", "vp9", "jpeg" and so on), ``width_px`` and ``height_px`` their
    size. ``frames`` is the number of frames that the container declares, 0 if it doesn't. ``start_ns`` is the recording
    time, if the container has it, and ``ends_s`` when it says that its pictures end. ``images`` are those of a folder;
    ``every`` is the step of the numbers in their names, and ``span`` has their values that become black and white, if
    these have more than 8 bits. ``why_transcode`` is empty for streams that are passed through, and for stills. While
    pictures are read, ``lost`` collects what could not be read, and ``notes`` what else is worth reporting.
    """

    path: Path
    options: VideoOptions
    format: str
    width_px: int
    height_px: int
    fps: Fraction | None
    frames: int
    start_ns: int | None
    why_transcode: str
    sets: tuple[bytes, ...] = ()
    images: Images | None = None
    stream: int = 0
    lost: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    has_slots: bool = False
    ends_s: Fraction | None = None
    orientation: Orientation = Orientation()  # immutable
    span: Span | None = None

    @property
    def every(self) -> int:
        """The step of the picture numbers: 12 for images of which every twelfth was kept with its number."""
        return self.images.every if self.images else 1

    def pictures(self, start_ns: int = 0) -> Iterator[PictureMessage]:
        """All pictures in order, the first of them at ``start_ns``; afterwards warnings about their times."""
        is_counted = self.images and not self.images.stamps_ns
        clock = Clock(self.path, start_ns, self.options.fps or (self.fps if is_counted else None))
        if self.options.is_still:
            yield from _encode_stills(self, clock)
        elif self.why_transcode:
            yield from _transcode(self, clock)
        else:
            yield from _remux(self, clock)
        clock.warn()

    def note_missing(self, read: int, hidden: int = 0, last_s: Fraction | None = None) -> None:
        """Compare the number of pictures read with the declared number, of which ``hidden`` are not shown."""
        if self.has_slots and self.fps and last_s is not None:
            hidden += round(last_s * self.fps) + 1 - read  # empty slots
        if self.frames and read + hidden < self.frames:
            edited = 0 if self.images else count_edited(self.path, self.stream)
            if edited:
                self.notes.append(f"{self.path}: an edit list hides {edited} of its {self.frames} frames")
            if read + hidden + edited >= self.frames:
                return
            slots = None if self.images else count_slots(self.path, self.stream)
            if slots is not None and slots >= self.frames:
                return  # the file is complete: the others are empty slots, or reported as lost
            self.lost.append(f"{self.path} claims {self.frames} frames; {read} could be read")
        elif not self.frames and self.ends_s and last_s is not None and self.fps:
            missing_s = self.ends_s - last_s
            if missing_s > max(Fraction(1, 2), 3 / self.fps):
                self.lost.append(f"{self.path} lacks the last {float(missing_s):.2f} s that it says it has")


def open_video(path: Path, options: VideoOptions = VideoOptions()) -> Video:  # noqa: B008  # frozen
    """Open a video file or image folder. Raises McaptrackError if it holds no pictures that can be decoded."""
    if path.is_dir():
        return _open_folder(path, options)
    with reading(path) as opened:
        chosen = choose_stream(opened, path, options.stream)
        stream = opened.streams[chosen.index]
        context = stream.codec_context
        if context is None:
            raise McaptrackError(f"{path} holds video in an unknown codec; convert it to H.264 first")
        check_size(context.width, context.height, path)
        first = _first_picture(opened, stream)
        if first is None:
            hides = count_edited(path, chosen.index)
            why = f"without frames{f': its edit list hides all {hides} of them' if hides else ''}"
            raise McaptrackError(f"{path} is a video {why}")
        if not (has_times(opened) or options.fps):
            raise McaptrackError(f"{path} has no times of its own; give the frames per second with `fps=`")
        orientation = orientation_of(first)
        video = Video(
            path,
            options,
            options.image_format if options.is_still else "h264",
            first.height if orientation.is_transposed else first.width,
            first.width if orientation.is_transposed else first.height,
            fraction(stream.average_rate),
            stream.frames,
            _creation_ns(opened.metadata.get("creation_time") or stream.metadata.get("creation_time")),
            f"it is {orientation.description}" if orientation.description else "",
            stream=stream.index,
            has_slots=has_slots(opened),
            ends_s=ends_s(opened, stream),
            orientation=orientation,
        )
        if chosen.is_doubtful:
            warn(chosen.text, "left-out")
        elif chosen.text:
            video.notes.append(chosen.text)
        video.notes += _remarks(path, stream, first, orientation)
        if first.interlaced_frame:
            video.why_transcode = video.why_transcode or "it is interlaced"
    if options.is_still:
        video.why_transcode = ""
    elif not video.why_transcode:
        check = check_stream(path, chosen.index, options)
        video.why_transcode, video.sets = check.why_not, check.sets
        if check.missing:
            places = "1 place" if len(check.missing) == 1 else f"{len(check.missing)} places"
            video.lost.append(
                f"{path}: pictures are missing at {places}, before picture {check.missing[0]} first; those up "
                "to the next key picture may be damaged"
            )
        video.format = "h264" if check.why_not else check.format
    _make_even(video)
    return video


def _first_picture(opened: Any, stream: Any) -> Any:
    """The first picture that can be decoded, None if there is none. Raises FFmpegError if none of the first can be."""
    import av

    why = None
    for tried, packet in enumerate(opened.demux(stream)):
        try:
            for picture in packet.decode():
                return picture
        except av.error.FFmpegError as error:
            why = why or error
            if tried >= _MOST_DAMAGED:
                break
    if why is not None:
        raise why
    return None


def _make_even(video: Video) -> None:
    """Round the size of transcoded pictures up to even numbers, which H.264 needs."""
    if video.why_transcode:
        check_h264(video.width_px, video.height_px, video.path)
        video.width_px += video.width_px % 2
        video.height_px += video.height_px % 2


def _remarks(path: Path, stream: Any, first: Any, orientation: Orientation) -> Iterator[str]:
    """Remarks on pictures that are stored in another way than most."""
    if orientation.oblique:
        yield f"{path} should be turned by {orientation.oblique:.1f} degrees; only quarter turns are done"
    aspect = fraction(stream.sample_aspect_ratio)
    if aspect and aspect != 1:
        yield f"{path} has pixels that are {float(aspect):.4g} times as wide as high; pictures stay as they are stored"
    bits = max(component.bits for component in first.format.components)
    if bits > 8 and first.format.name.startswith("gray"):
        share = first.to_ndarray(format="gray16le").max() / np.iinfo(np.uint16).max
        yield (
            f"{path} has grey values of {bits} bits, of which the highest 8 are kept; its first picture reaches "
            f"{share:.0%} of white (those of a folder of PNG images are scaled)"
        )
    if first.color_trc in _HDR:
        yield f"{path} is HDR ({_HDR[first.color_trc]}); its brightness stays as stored, which may not suit detectors"


def _open_folder(path: Path, options: VideoOptions) -> Video:
    info = find_seqinfo(path)
    fps, start_ns = info.fps if info else None, None
    images = find_images(path, has_rate=bool(options.fps or fps))
    span = measure_span(images.paths)
    read = ((at, read_image(path, span)) for at, path in enumerate(images.paths))
    at, first = next(((at, image) for at, image in read if image is not None), (0, None))
    if first is None:
        raise McaptrackError(f"{images.paths[0]} can't be read as an image, nor can any other in {path}")
    height, width = first.shape[:2]
    name = options.image_format if options.is_still else "h264"
    why = "" if options.is_still else "it is a folder of images"
    if stamps_ns := images.stamps_ns:
        fps, start_ns = Fraction(NS_PER_S, int(np.median(np.diff(stamps_ns)))), stamps_ns[at]
    video = Video(
        path, options, name, width, height, fps, len(images.paths), start_ns, why, images=images,
        notes=list(images.notes), span=span,
    )  # fmt: skip
    if span:
        low, high = (f"{value:.4g}" for value in span)
        video.notes.append(f"{path}: values from {low} to {high}, as measured in it, are shown as black to white")
    if images.missing:
        warn(f"{path}: {images.missing} are missing; their times stay empty", "clock")
    if info and info.frames and info.frames != images.place[-1] + 1:
        warn(f"{info.path} counts {info.frames} frames, and {path} has images of {images.place[-1] + 1}", "clock")
    _make_even(video)
    return video


def _creation_ns(text: str | None) -> int | None:
    """The recording time (UTC) in the metadata of the container; None if it is missing or invalid."""
    try:
        moment = datetime.fromisoformat(text) if text else None
    except ValueError:
        return None
    if moment is None:
        return None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    t_ns = round(moment.timestamp() * 1e6) * 1000
    return t_ns if 0 <= t_ns < LAST_NS else None


def _remux(video: Video, clock: Clock) -> Iterator[PictureMessage]:
    codec = CODECS[video.format]
    index, seconds = 0, None
    group: list[EncodedPicture] = []  # since the last key picture, where only decoding shows whether the last is whole
    with reading(video.path) as opened:
        for packet in packets(opened, video.stream, video.format):
            if packet.is_damaged:  # only the last packet can be damaged
                video.lost.append(f"{video.path} is cut off or damaged after {index} frames; the rest is left out")
                continue
            data = packet.data
            head = codec.read_head(data)
            if video.sets and head.is_key and not head.has_parameter_sets:
                data = codec.with_parameter_sets(data, video.sets)
            if not has_sizes(opened):
                group = [] if head.is_key else group
                group.append(EncodedPicture(0, index, video.format, data))
            seconds = packet.seconds
            yield PictureMessage(clock.time(index, seconds), index, data)
            index += 1
        video.frames = video.frames or count_indexed(opened, video.stream)
        hidden = count_empty(opened, video.stream)
    if _is_cut(group):
        video.lost.append(f"{video.path} is cut off or damaged in its last picture, which is kept as far as it decodes")
    video.note_missing(index, hidden, seconds)


def _is_cut(group: list[EncodedPicture]) -> bool:
    """Whether the last of these pictures is damaged."""
    damaged: list[int] = []
    try:
        for _ in decode_gray(group, wanted=(), damaged=damaged):
            pass
    except McaptrackError:
        return True
    return bool(damaged) and damaged[-1] == group[-1].index


def _transcode(video: Video, clock: Clock) -> Iterator[PictureMessage]:
    options, encoder = video.options, None
    for index, seconds, picture in _decoded_pictures(video):
        t_ns = clock.time(index, seconds)
        fitted = _fitted(video, picture)
        if encoder is None:
            fps = clock.fps or video.fps or Fraction(30)
            encoder = H264Encoder(video.width_px, video.height_px, fps, options.crf, options.key_every_s, like=fitted)
        data = encoder.encode(fitted, t_ns)
        del picture, fitted  # released before the next picture is read, to save memory
        yield PictureMessage(t_ns, index, data)


def _fitted(video: Video, picture: Any) -> Any:
    fitted, is_scaled = fit(picture, video.orientation, video.width_px, video.height_px)
    if is_scaled:
        _note_sizes(video, f"all are scaled to {video.width_px} x {video.height_px}")
    return fitted


def _note_sizes(video: Video, what_is_done: str) -> None:
    text = f"{video.path}: pictures change their size on the way; {what_is_done}"
    if text not in video.notes:
        video.notes.append(text)


def _encode_stills(video: Video, clock: Clock) -> Iterator[PictureMessage]:
    name: StillFormat = "jpeg" if video.format == "jpeg" else "png"
    for index, seconds, picture in _decoded_pictures(video):
        image = video.orientation.of(picture)
        if image.shape[:2] != (video.height_px, video.width_px):
            _note_sizes(video, "each is kept in its own, which trackers don't expect")
        data = encode_image(image, name, video.options.jpeg_quality)
        del picture, image
        yield PictureMessage(clock.time(index, seconds), index, data)


def _decoded_pictures(video: Video) -> Iterator[DecodedPicture]:
    """All decoded pictures; those that can't be read are added to ``lost``."""
    if video.images is None:
        slot_s = 1 / video.fps if video.has_slots and video.fps else None
        yield from in_slots(_decoded(video), _delay(video), slot_s) if slot_s else _decoded(video)
        return
    stamps_ns = video.images.stamps_ns or [None] * len(video.images.paths)
    for path, place, t_ns in zip(video.images.paths, video.images.place, stamps_ns, strict=True):
        image = read_image(path, video.span)
        if image is None:
            video.lost.append(f"{path} can't be read as an image; it is left out")
        else:
            yield DecodedPicture(place, None if t_ns is None else Fraction(t_ns, NS_PER_S), image)
            del image


def _decoded(video: Video) -> Iterator[DecodedPicture]:
    import av

    packets_given, read, failed, damaged, hidden, cut_off, last_s = 0, 0, 0, 0, 0, 0, None
    why, has_fields = "", False
    with reading(video.path) as opened:
        stream = opened.streams[video.stream]
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = _THREADS
        base = fraction(stream.time_base) or Fraction(1)
        packets = opened.demux(stream)
        while True:
            try:
                packet = next(packets, None)
                if packet is None:
                    break
                hidden += packet.is_discard
                cut_off += packet.is_corrupt
                if video.has_slots and 0 < packet.size <= _PLACEHOLDER:
                    continue
                packets_given += packet.size > 0 and not packet.is_discard
                if video.has_slots:
                    packet.pts = packet.dts  # comes back with its picture
                frames = packet.decode()
            except av.error.FFmpegError as error:
                why = why or f" ({error.strerror or error})"
                failed += 1
                continue
            for frame in frames:
                seconds = None if frame.pts is None else frame.pts * base
                last_s = seconds if last_s is None or seconds is None else max(last_s, seconds)
                damaged += frame.is_corrupt
                has_fields |= frame.interlaced_frame
                yield DecodedPicture(read + failed, seconds, frame)
                read += 1
        video.frames = video.frames or count_indexed(opened, video.stream)
        hidden += count_empty(opened, video.stream)
        if stream.codec_context.name in _ONE_EACH and not has_fields:
            failed = max(failed, packets_given - read)  # FFmpeg passes over some without an error
    if failed:
        video.lost.append(f"{video.path}: {failed} of {packets_given} packets can't be decoded{why}")
    if cut_off:
        video.lost.append(f"{video.path}: {cut_off} packets are cut off or damaged")
    if damaged:
        video.lost.append(f"{video.path}: {damaged} of {read} frames are damaged; they are kept as far as they decode")
    video.note_missing(read, hidden + failed, last_s)
