"""Read folders of images as videos: their order, the numbers in their names, and their pixels.

Letters: P pictures.
"""

from __future__ import annotations

import mmap
import re
from fractions import Fraction
from math import gcd
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.files import read_beginning, refuse_special
from mcaptrack.geometry.clocks import parse_fps
from mcaptrack.sources.video.limits import check_still, still_size

IMAGE_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
_NUMBERED: Final = re.compile(r"(.*?)([0-9]{1,18})(\D*)")
#: Numbers in names count as frame numbers if at least this share of them exists.
_DENSE: Final = 0.5
_SHOWN: Final = 3


class Images(NamedTuple):
    """The images of a folder in order: ``place`` (P,) is their position in the sequence, with gaps for missing ones.

    ``every`` is the step of the numbers in their names: 12 if every twelfth picture was kept with its number.
    """

    paths: list[Path]
    place: list[int]
    every: int
    missing: str


def find_images(folder: Path) -> Images:
    """The images of a folder. Raises McaptrackError if there are none."""
    paths = sorted((p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES), key=natural_order)
    if not paths:
        raise McaptrackError(f"{folder} holds no images ({', '.join(IMAGE_SUFFIXES)})")
    in_order = Images(paths, list(range(len(paths))), 1, "")
    named = [_NUMBERED.fullmatch(path.name) for path in paths]
    if len({(name[1], name[3]) if name else None for name in named}) > 1 or None in named:
        return in_order
    numbers = [int(name[2]) for name in named if name]
    every = gcd(*(number - numbers[0] for number in numbers)) or 1
    place = [(number - numbers[0]) // every for number in numbers]
    if place != sorted(set(place)) or len(place) < _DENSE * (place[-1] + 1):
        return in_order
    gone = sorted(set(range(place[-1] + 1)) - set(place))
    text = ", ".join(str(numbers[0] + every * at) for at in gone[:_SHOWN]) + (", ..." if len(gone) > _SHOWN else "")
    return Images(paths, place, every, f"{len(gone)} of {place[-1] + 1} numbered images ({text})" if gone else "")


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Sort key for natural order: 2.jpg comes before 10.jpg."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", path.name) if part]


def read_image(path: Path) -> NDArray[np.uint8] | None:
    """An image, BGR (height, width, 3), upright; None if it can't be decoded.

    Raises McaptrackError if it is too large, or not a file.
    """
    import cv2

    refuse_special(path)
    if not path.is_file() or path.stat().st_size == 0:
        return None
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        size = still_size(data)
    if size is None:
        return None
    check_still(size, path)
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    return None if image is None else np.asarray(image, np.uint8)


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
