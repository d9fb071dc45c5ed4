"""Open video files with PyAV, and hide the differences between its versions. Only this module calls ``av.open``."""

from __future__ import annotations

import errno
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.video.limits import max_pixels, too_large

_COVER: Final = 0x400  # AV_DISPOSITION_ATTACHED_PIC
_NO_TIMESTAMPS: Final = 0x80  # AVFMT_NOTIMESTAMPS
_LAST_WITH_METADATA_ERRORS: Final = 18
_MOST_BOXES: Final = 10_000
_MOST_PACKETS: Final = 1000  # in which a stream of more than one picture has its second


@contextmanager
def reading(path: Path, **demuxer: str) -> Iterator[Any]:
    """Open a video file for reading, with options of its demuxer.

    Raises McaptrackError if it is not a video, or too damaged to read. Metadata that is not UTF-8 contains surrogate
    escapes, with every version of PyAV.
    """
    import av

    major = int(av.__version__.partition(".")[0])
    limits = {"max_pixels": str(max_pixels())}
    options: dict[str, Any] = {"options": limits | demuxer}
    if major <= _LAST_WITH_METADATA_ERRORS:
        options["metadata_errors"] = "surrogateescape"
    if path.stat().st_size == 0:
        raise McaptrackError(f"{path} is empty, and no video")
    try:
        with av.open(_url(path), **options) as opened:
            if not opened.streams and _lacks_index(path):
                raise _no_index(path)
            for stream in opened.streams.video:
                if stream.codec_context is not None:
                    stream.codec_context.options = limits
            yield opened
    except av.error.EOFError:
        raise McaptrackError(f"{path} is a video without frames") from None
    except av.error.FFmpegError as error:
        why = error.strerror or error
        if is_size_error(error):
            why = f"{why}: it is damaged, or its pictures are too large, {too_large()}"
        if _lacks_index(path):
            raise _no_index(path) from error
        raise McaptrackError(
            f"{path} can't be read as a video ({why}); give a complete mp4, mov, mkv, avi or webm file"
        ) from error


def is_size_error(error: Any) -> bool:
    """Whether an FFmpeg error is one of those that its decoders raise for pictures that are too large."""
    return error.errno in (errno.EINVAL, errno.ENOMEM, errno.ERANGE)


@contextmanager
def writing(path: Path, name: str) -> Iterator[Any]:
    """Open a new video file in the container format that FFmpeg calls ``name``."""
    import av

    with av.open(_url(path), "w", format=name) as opened:
        yield opened


def _url(path: Path) -> str:
    """A path as a URL for FFmpeg, which would take ``12:30.mp4`` for a URL with the protocol ``12``."""
    return f"file:{path}"


class ChosenStream(NamedTuple):
    """The video stream that is read of a file: its index among all streams, and what is said of the choice, ""
    where there is none. ``is_doubtful``: another stream moves, too, and no number was given.
    """

    index: int  # type: ignore[assignment]  # hides tuple.index, which is not needed here
    text: str
    is_doubtful: bool


def choose_stream(opened: Any, path: Path, number: int | None) -> ChosenStream:
    """Choose a video stream: that of a number, or the first of more than one picture, or else the first.

    Attached cover pictures are no video. Raises McaptrackError if there is no video, or none of that number.
    """
    streams = [stream for stream in opened.streams.video if not stream.disposition.value & _COVER]
    if not streams:
        kinds = ", ".join(sorted({stream.type for stream in opened.streams if stream.type != "video"}))
        raise McaptrackError(f"{path} holds no video, {f'only {kinds}' if kinds else 'and nothing else'}")
    if number is not None and number >= len(streams):
        numbers = f"0 to {len(streams) - 1}" if len(streams) > 1 else "0 alone"
        raise McaptrackError(f"{path} has no video stream {number} (`stream=`); there is {numbers}")
    if len(streams) == 1:
        return ChosenStream(streams[0].index, "", False)
    moving = _moving(path, [stream.index for stream in streams])
    numbered = list(enumerate(streams))
    kinds = ", ".join(
        f"{at} ({_kind(stream)}{'' if stream.index in moving else ', a still picture'})" for at, stream in numbered
    )
    fitting = [at for at, stream in numbered if stream.index in moving]
    chosen = number if number is not None else fitting[0] if fitting else 0
    others = [at for at in fitting if at != chosen and number is None]
    hint = f"; `stream={others[0]}` takes the other" if others else ""
    text = f"{path} holds {len(streams)} videos, {kinds}; {chosen} is taken{hint}"
    return ChosenStream(streams[chosen].index, text, bool(others))


def _moving(path: Path, streams: Sequence[int]) -> set[int]:
    """Those of these streams that have more than one picture, by the first packets of a file."""
    import av

    pictures: Counter[int] = Counter()
    with reading(path) as opened:
        packets = opened.demux([opened.streams[index] for index in streams])
        for _ in range(_MOST_PACKETS):
            try:
                packet = next(packets, None)
            except av.error.FFmpegError:  # what can be read decides
                break
            if packet is None or min(pictures[index] for index in streams) > 1:
                break
            pictures[packet.stream_index] += packet.size > 0
    return {index for index in streams if pictures[index] > 1}


def _kind(stream: Any) -> str:
    """Codec and size of a video stream."""
    context = stream.codec_context
    return f"{context.name}, {context.width}x{context.height}" if context else "an unknown codec"


def fraction(ratio: Any) -> Fraction | None:
    """A ratio of FFmpeg as a Fraction; None if it is unknown, which PyAV returns as None or 0/1, depending on its
    version.
    """
    return Fraction(ratio.numerator, ratio.denominator) if ratio else None


def has_slots(opened: Any) -> bool:
    """Whether a container has numbered slots for pictures instead of timestamps (AVI); slots may be empty."""
    return "avi" in opened.format.name.split(",")


def is_transport(opened: Any) -> bool:
    """Whether a container is an MPEG transport stream: its packets are numbered."""
    return "mpegts" in opened.format.name.split(",")


def has_sizes(opened: Any) -> bool:
    """Whether a container says how many bytes a picture has, so that one that is cut off is known."""
    return has_times(opened) and not is_transport(opened)


def has_times(opened: Any) -> bool:
    """Whether pictures have timestamps; those that FFmpeg returns for raw streams are invented."""
    return not opened.format.flags & _NO_TIMESTAMPS


def count_indexed(opened: Any, index: int) -> int:
    """The number of pictures in the fragments of a fragmented MP4 that were read so far; 0 for other files."""
    return len(_mp4_entries(opened, index))


def count_empty(opened: Any, index: int) -> int:
    """The number of MP4 samples without data: nothing was recorded there."""
    return sum(entry.size == 0 for entry in _mp4_entries(opened, index))


def count_edited(path: Path, index: int) -> int:
    """The number of samples that the edit list of an MP4 leaves out."""
    with reading(path) as edited, reading(path, ignore_editlist="1") as whole:
        return max(0, len(_mp4_entries(whole, index)) - len(_mp4_entries(edited, index)))


def ends_s(opened: Any, stream: Any) -> Fraction | None:
    """When a video stream ends on the clock of its pictures, as the container declares; None if it only declares the
    duration of all streams.
    """
    declared = re.fullmatch(r"(\d+):(\d\d):(\d\d(?:\.\d+)?)", stream.metadata.get("DURATION", ""))
    if declared:
        return int(declared[1]) * 3600 + int(declared[2]) * 60 + Fraction(declared[3])
    if not opened.duration or len(opened.streams) > 1:
        return None
    counts_from_0 = "matroska" in opened.format.name
    return Fraction(opened.duration + (0 if counts_from_0 else opened.start_time or 0), 1_000_000)


def _no_index(path: Path) -> McaptrackError:
    return McaptrackError(
        f"{path} can't be read as a video: its pictures have no index (moov), or a part of one, as if it was cut off; "
        "copy it again, or repair it with the camera, or with a program that takes the index from another of its "
        "recordings"
    )


def _lacks_index(path: Path) -> bool:
    """Whether an MP4 has pictures (mdat) but no whole index (moov), by its boxes (ISO 14496-12, 4.2)."""
    kinds, at, end = set[bytes](), 0, path.stat().st_size
    with path.open("rb") as file:
        for _ in range(_MOST_BOXES):
            file.seek(at)
            head = file.read(16)
            size = int.from_bytes(head[8:16] if head[:4] == b"\0\0\0\1" else head[:4])
            if head[4:8] != b"moov" or at + size <= end:
                kinds.add(head[4:8])
            if size < 8 or at + size >= end:
                break
            at += size
    return {b"ftyp", b"mdat"} <= kinds and not {b"moov", b"moof"} & kinds


def _mp4_entries(opened: Any, index: int) -> Any:
    """The samples of a stream of an MP4; empty for other formats."""
    stream = opened.streams[index]
    return stream.index_entries if "mp4" in opened.format.name.split(",") else ()
