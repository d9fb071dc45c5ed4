"""Read folders of images as videos: their order, the numbers in their names, and their pixels.

Letters: P pictures.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Sequence
from fractions import Fraction
from itertools import combinations
from math import gcd
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.files import read_beginning, refuse_special, visible
from mcaptrack.geometry.arrays import Image
from mcaptrack.geometry.clocks import parse_fps
from mcaptrack.notices import warn
from mcaptrack.sources.video.limits import check_still, still_size
from mcaptrack.sources.video.pixels import Span, measured, measured_span, scaled

IMAGE_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
#: Pictures of other kinds, which are not read; a folder that holds some is not all read.
_OTHERS: Final = (
    ".heic", ".heif", ".avif", ".gif", ".ppm", ".pgm", ".pnm", ".jp2", ".j2k", ".jxl", ".exr", ".hdr", ".dng",
    ".dpx", ".tga",
)  # fmt: skip
_RUNS: Final = re.compile(r"([0-9]+)")
#: What stands before the number of a camera, or of a video, in the name of a picture.
_CAMERA: Final = re.compile(
    r"(?:.*[^a-z])?(?:c|ch|channel|cam|camera|kamera|view|lens|sensor|stream|device|video|clip|seq|sequence|scene)[_-]?"
)
_MOST_CAMERAS: Final = 64
_CAMERA_DIGITS, _ONE_RUN = 3, 3  # digits of such a number; parts of a name that has a number only
#: Numbers in names count as frame numbers if at least this share of them exists.
_DENSE: Final = 0.5
_SHOWN: Final = 3
#: A time in a name, from 2001 on: seconds since 1970, with 3, 6 or 9 more digits or a fraction of them.
_STAMP: Final = re.compile(r"(?:.*\D)?([1-9][0-9]{9})((?:[0-9]{3}){0,3}|[._-][0-9]{1,9})(?:[^0-9.]\D*)?")
_UNITS: Final = {0: "seconds", 3: "milliseconds", 6: "microseconds", 9: "nanoseconds"}


class Images(NamedTuple):
    """The images of a folder in order: ``place`` (P,) is their position in the sequence, with gaps for missing ones.

    ``every`` is the step of the numbers in their names: 12 if every twelfth picture was kept with its number.
    ``missing`` and ``notes`` say what is not there, and what was assumed or passed over. ``stamps_ns`` are the times in
    their names, if these have some and nothing else says when they were taken.
    """

    paths: list[Path]
    place: list[int]
    every: int
    missing: str
    notes: tuple[str, ...] = ()
    stamps_ns: tuple[int, ...] = ()


class _Name(NamedTuple):
    """The name of an image: ``series`` is what all pictures of one camera share, ``numbers`` are the others in it."""

    series: str
    numbers: tuple[int, ...]


def find_images(folder: Path, has_rate: bool = True) -> Images:
    """The images of a folder; without ``has_rate`` they have the times in their names.

    Raises McaptrackError if there are none, or those of several cameras.
    """
    files = sorted(folder.iterdir(), key=natural_order)
    named = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES]
    paths = [path for path in named if not path.name.startswith(".")]
    if not paths:
        raise McaptrackError(f"{folder} holds no images ({', '.join(IMAGE_SUFFIXES)}){instead_of_images(files)}")
    notes = []
    if hidden := [path.name for path in named if path.name.startswith(".")]:
        notes.append(f"{folder}: {len(hidden)} hidden files are passed over ({_some(hidden)})")
    if others := [path.name for path in files if path.suffix.lower() in _OTHERS]:
        warn(f"{folder}: {len(others)} images of kinds that are not read are left out ({_some(others)})", "left-out")
    names = [_name_of(path) for path in paths]
    _refuse_several(folder, paths, names)
    text = f"{folder}: the names of its images don't count pictures; they follow one another in the order of names"
    in_order = Images(paths, list(range(len(paths))), 1, "", (*notes, *([text] if len(paths) > 1 else [])))
    stamps_ns, unit = ((), "") if has_rate else _stamps_ns(paths)
    if stamps_ns:
        text = f"{folder}: the names of its images are read as times, {unit} since 1970, as {paths[0].name}"
        return in_order._replace(notes=(*notes, text), stamps_ns=stamps_ns)
    if len({(name.series, name.numbers[:-1]) for name in names}) > 1 or not names[0].numbers:
        return in_order
    numbers = [name.numbers[-1] for name in names]
    every = gcd(*(number - numbers[0] for number in numbers)) or 1
    place = [(number - numbers[0]) // every for number in numbers]
    if place != sorted(set(place)) or len(place) < _DENSE * (place[-1] + 1):
        return in_order
    gone = [str(numbers[0] + every * at) for at in sorted(set(range(place[-1] + 1)) - set(place))]
    missing = f"{len(gone)} of {place[-1] + 1} numbered images ({_some(gone)})" if gone else ""
    return Images(paths, place, every, missing, tuple(notes))


def _stamps_ns(paths: Sequence[Path]) -> tuple[tuple[int, ...], str]:
    """The times in the names of images, and their unit; none if not all names have one, in one unit and in order."""
    found = [match.groups() for path in paths if (match := _STAMP.fullmatch(path.stem))]
    units = {_UNITS[len(rest)] if rest.isdecimal() or not rest else _UNITS[0] for _, rest in found}
    stamps_ns = [int(seconds + re.sub(r"\D", "", rest).ljust(9, "0")) for seconds, rest in found]
    is_clock = len(found) == len(paths) > 1 and len(units) == 1 and stamps_ns == sorted(set(stamps_ns))
    return (tuple(stamps_ns), *units) if is_clock else ((), "")  # type: ignore[return-value]


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")


def instead_of_images(files: Sequence[Path]) -> str:
    """A hint for a folder without images: what to give instead."""
    if folders := [path.name for path in files if path.is_dir() and _has_images(path)]:
        return f"; its folders do: give one, such as {folders[0]}"
    if others := [path.name for path in files if path.suffix.lower() in _OTHERS]:
        return f"; convert those it holds, such as {others[0]}, to JPEG or PNG"
    if others := [path.name for path in visible(files) if not path.is_dir()]:
        return f"; give files it holds by name, such as {others[0]}"
    return ""


def _has_images(folder: Path) -> bool:
    try:
        return any(path.suffix.lower() in IMAGE_SUFFIXES for path in visible(folder.iterdir()))
    except OSError:
        return False


def _name_of(path: Path) -> _Name:
    texts = _RUNS.split(path.stem.lower())
    series, numbers = texts[0], []
    for before, digits, after in zip(texts[::2], texts[1::2], texts[2::2], strict=False):
        is_camera = len(texts) > _ONE_RUN and len(digits) <= _CAMERA_DIGITS and _CAMERA.fullmatch(before)
        series += (digits if is_camera else "*") + after
        numbers += [] if is_camera else [int(digits)]
    return _Name(series, tuple(numbers))


def _refuse_several(folder: Path, paths: Sequence[Path], names: Sequence[_Name]) -> None:
    """Raise McaptrackError if images of several cameras lie in one folder, or several images of one number."""
    series: dict[str, dict[tuple[int, ...], Path]] = {}
    for path, name in zip(paths, names, strict=True):
        other = series.setdefault(name.series, {}).setdefault(name.numbers, path)
        if other != path and name.numbers:
            raise McaptrackError(f"{folder} holds two images of one number, {other.name} and {path.name}; keep one")
    several = {text: numbers for text, numbers in series.items() if len(numbers) > 1}
    if len(several) > _MOST_CAMERAS:
        return  # names without a system, such as digests
    for (text, numbers), (other_text, others) in combinations(several.items(), 2):
        is_like = _RUNS.sub("*", text) == _RUNS.sub("*", other_text)  # only the number of the camera is another one
        overlaps = max(min(numbers), min(others)) <= min(max(numbers), max(others))
        shared = numbers.keys() & others.keys()
        if (is_like and overlaps) or len(shared) >= _DENSE * min(len(numbers), len(others)):
            raise McaptrackError(
                f"{folder} holds {len(several)} series of images of the same numbers, such as {text} "
                f"({len(numbers)} images) and {other_text} ({len(others)}), and a video is of one camera; give each a "
                "folder of its own"
            )


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Sort key for natural order: 2.jpg comes before 10.jpg, and b.JPG before C.jpg."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in _RUNS.split(path.name.lower()) if part]


def read_image(path: Path, span: Span | None = None) -> Image | None:
    """An image, BGR (height, width, 3), upright; None if it can't be decoded.

    Values of more than 8 bits are scaled by ``span``. Raises McaptrackError if it is too large, or not a file.
    """
    values = _read_values(path)
    return values if values is None or values.dtype == np.uint8 else scaled(values, span)


def measure_span(paths: Sequence[Path]) -> Span | None:
    """The values that become black and white in images of more than 8 bits; None for others."""
    images = (_read_values(paths[at]) for at in measured(len(paths)))
    return measured_span(image for image in images if image is not None)


def _read_values(path: Path) -> NDArray[Any] | None:
    """An image as it is stored, in three channels."""
    import cv2

    refuse_special(path)
    if not path.is_file() or path.stat().st_size == 0:
        return None
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        size = still_size(data)
    if size is None:
        return None
    check_still(size, path)
    content = np.fromfile(path, np.uint8)  # OpenCV ends the process for names that are not UTF-8
    image = cv2.imdecode(content, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if image is None:  # floats in one channel
        image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    if image is not None and image.ndim == 2:
        image = cv2.merge([image] * 3)
    return image


# The seqinfo.ini of a MOTChallenge sequence: its frame rate, and how many frames it has.


SEQINFO: Final = "seqinfo.ini"
_MAX_BYTES: Final = 65536
_FPS: Final = re.compile(r"^\s*frameRate\s*=(.*)$", re.MULTILINE)
_FRAMES: Final = re.compile(r"^\s*seqLength\s*=\s*([0-9]{1,9})\s*$", re.MULTILINE)


class SeqInfo(NamedTuple):
    """Frame rate and number of frames in a seqinfo.ini; None for a missing value."""

    path: Path
    fps: Fraction | None
    frames: int | None


def find_seqinfo(folder: Path) -> SeqInfo | None:
    """The seqinfo.ini in a folder or in the one above; None if there is none. Raises McaptrackError for a bad one."""
    for path in (folder / SEQINFO, folder.parent / SEQINFO):
        if path.is_file():
            return _read(path)
    return None


def _read(path: Path) -> SeqInfo:
    text = read_beginning(path, _MAX_BYTES).decode("utf-8", "replace")
    fps, frames = _FPS.search(text), _FRAMES.search(text)
    try:
        return SeqInfo(path, parse_fps(fps[1]) if fps else None, int(frames[1]) if frames else None)
    except ValueError as error:
        raise McaptrackError(f"{path}: frameRate is no number of frames a second ({error})") from None
