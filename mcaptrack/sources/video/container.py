"""Video files as PyAV opens them, and what its versions give differently. Only this module calls ``av.open``."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.video.limits import max_pixels, too_large

_COVER: Final = 0x400  # AV_DISPOSITION_ATTACHED_PIC
_NO_TIMESTAMPS: Final = 0x80  # AVFMT_NOTIMESTAMPS
_LAST_WITH_METADATA_ERRORS: Final = 18


@contextmanager
def reading(path: Path) -> Iterator[Any]:
    """An open video file. Raises McaptrackError if it is none, or is damaged beyond reading.

    Metadata that is not UTF-8 comes with surrogates in every version of PyAV.
    """
    import av

    major = int(av.__version__.partition(".")[0])
    options: dict[str, Any] = {"options": {"max_pixels": str(max_pixels())}}
    if major <= _LAST_WITH_METADATA_ERRORS:
        options["metadata_errors"] = "surrogateescape"
    try:
        with av.open(_url(path), **options) as opened:
            for stream in opened.streams.video:
                if stream.codec_context is not None:
                    stream.codec_context.options = options["options"]
            yield opened
    except av.error.EOFError:
        raise McaptrackError(f"{path} is a video without frames") from None
    except av.error.FFmpegError as error:
        why = error.strerror or error
        if is_size_error(error):
            why = f"{why}: it is damaged, or its pictures are too large, {too_large()}"
        raise McaptrackError(
            f"{path} can't be read as a video ({why}); give an mp4, mov, mkv, avi or webm file that is whole"
        ) from error


def is_size_error(error: Any) -> bool:
    """Whether an error of FFmpeg's is one of those that its decoders give for pictures that are too large."""
    return error.errno in (errno.EINVAL, errno.ENOMEM, errno.ERANGE)


@contextmanager
def writing(path: Path, name: str) -> Iterator[Any]:
    """A new video file of the format that FFmpeg calls ``name``."""
    import av

    with av.open(_url(path), "w", format=name) as opened:
        yield opened


def _url(path: Path) -> str:
    """A path as FFmpeg takes it: without the prefix it reads ``12:30.mp4`` as a file of the protocol ``12``."""
    return f"file:{path}"


def videos(opened: Any) -> list[Any]:
    """The streams of pictures in a container, without cover pictures."""
    return [stream for stream in opened.streams.video if not stream.disposition.value & _COVER]


def fraction(ratio: Any) -> Fraction | None:
    """A ratio of FFmpeg's; None for one that is not known, which PyAV gives as None or as 0/1, by its version."""
    return Fraction(ratio.numerator, ratio.denominator) if ratio else None


def has_slots(opened: Any) -> bool:
    """Whether a container has no times but slots for pictures, in the order of decoding; some may be empty."""
    return "avi" in opened.format.name.split(",")


def has_times(opened: Any) -> bool:
    """Whether pictures have times at all; what FFmpeg gives for raw streams it makes up."""
    return not opened.format.flags & _NO_TIMESTAMPS


def indexed(opened: Any) -> int:
    """How many pictures the parts of a fragmented MP4 list that were read so far; 0 if it is none."""
    return len(_mp4_entries(opened))


def empty(opened: Any) -> int:
    """How many pictures an MP4 lists that have no bytes: nothing was recorded there."""
    return sum(entry.size == 0 for entry in _mp4_entries(opened))


def _mp4_entries(opened: Any) -> Any:
    """The list of pictures of an MP4; of other formats nothing."""
    stream = videos(opened)[0]
    return stream.index_entries if "mp4" in opened.format.name.split(",") else ()
