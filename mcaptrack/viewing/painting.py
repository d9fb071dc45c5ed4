"""Annotation messages painted on pictures, and as lines of one colour; and pictures of a scene to draw on, without the
people who move, or of a moment.

Letters: P points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Image, Ints
from mcaptrack.notices import warn
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import encode_image

__all__ = [
    "BACKGROUND",
    "CLOSED",
    "SceneBackground",
    "background_picture",
    "draw",
    "message_at",
    "moment_picture",
    "put_text",
    "scaled",
    "strokes",
    "text_size",
    "without_repeated",
]

#: The colour of what is drawn on where there is no picture: blue, green, red.
BACKGROUND: Final = (32, 28, 26)
#: The size of text that OpenCV draws at a scale of 1, and the least one in a video.
_TEXT_PX: Final = 24.0
_LEAST_TEXT_PX: Final = 9.0
#: The number of binary places of pixel coordinates.
_SHIFT: Final = 4
#: Kinds of lines, and those of messages.
CLOSED, OPEN, PAIRS = 0, 1, 2
_KINDS: Final = {2: CLOSED, 3: OPEN, 4: PAIRS}


class Stroke(NamedTuple):
    """A line of one colour: ``kind`` is closed, open or pairs of points (P, 2); ``fill`` is the colour inside of it.

    Colours are those of messages; the opacity of a fill that isn't there is 0.
    """

    kind: int
    thickness: float
    colour: Any
    fill: Any
    points: Floats


def strokes(annotations: Any) -> Iterator[Stroke]:
    """The lines of an ImageAnnotations message: those with several colours as pairs of points of each.

    ``annotations`` is that message.
    """
    for part in annotations.points:
        kind = _KINDS.get(part.type)
        points = np.array([(point.x, point.y) for point in part.points], np.float64).reshape(-1, 2)
        if kind is None or not len(points) or not np.isfinite(points).all():
            continue
        shades, pairs = list(part.outline_colors), None
        if kind == PAIRS:
            points = points[: len(points) // 2 * 2]
            pairs = points.reshape(-1, 2, 2)
        elif kind == OPEN and len(shades) == len(points):
            pairs, shades = np.stack([points[:-1], points[1:]], axis=1), shades[1:]
        if pairs is None or len(shades) != len(pairs):
            yield Stroke(kind, part.thickness, part.outline_color, part.fill_color, points)
            continue
        of_colour: dict[tuple[float, ...], list[int]] = {}
        for number, shade in enumerate(shades):
            of_colour.setdefault((shade.r, shade.g, shade.b, shade.a), []).append(number)
        for numbers in of_colour.values():
            yield Stroke(PAIRS, part.thickness, shades[numbers[0]], part.fill_color, pairs[numbers].reshape(-1, 2))


def draw(image: Image, annotations: Any, scale: float = 1.0) -> Image:
    """Draw an ImageAnnotations message on a picture, BGR (height, width, 3), that has ``scale`` times its size.

    ``annotations`` is that message.
    """
    import cv2

    paint, cover = np.zeros_like(image), np.zeros(image.shape[:2], np.uint8)
    lines = list(strokes(annotations))
    pixels = [np.rint(line.points * (scale * 2**_SHIFT)).clip(-(2**24), 2**24).astype(np.int32) for line in lines]
    for line, at in zip(lines, pixels, strict=True):
        if line.kind == CLOSED and line.fill.a > 0:
            image = _filled(image, at, line.fill)
    for line, at in zip(lines, pixels, strict=True):
        if line.colour.a > 0:
            thickness = max(1, round(line.thickness * max(scale, 0.5)))
            drawn = list(at.reshape(-1, 2, 2)) if line.kind == PAIRS else [at]
            is_closed = line.kind == CLOSED
            # The colour is drawn a little wider than its mask, so that soft edges have it, too.
            cv2.polylines(paint, drawn, is_closed, _bgr(line.colour), thickness + 2, cv2.LINE_8, _SHIFT)
            cv2.polylines(cover, drawn, is_closed, round(255 * line.colour.a), thickness, cv2.LINE_AA, _SHIFT)
    share = cover[..., None].astype(np.float32) / 255
    image = np.rint(image * (1 - share) + paint * share).astype(np.uint8)
    for text in annotations.texts:
        _write(image, text, scale)
    return image


def _bgr(rgba: Any) -> tuple[int, int, int]:
    return round(255 * rgba.b), round(255 * rgba.g), round(255 * rgba.r)


def _filled(image: Image, line: NDArray[np.int32], rgba: Any) -> Image:
    """Paint the inside of a closed line over what was painted before, with the line's opacity."""
    import cv2

    cover = np.zeros(image.shape[:2], np.uint8)
    cv2.fillPoly(cover, [line], round(255 * rgba.a), cv2.LINE_AA, _SHIFT)
    rows, columns = (np.flatnonzero(cover.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return image
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    share = cover[part][..., None].astype(np.float32) / 255
    image = image.copy()
    image[part] = np.rint(image[part] * (1 - share) + np.array(_bgr(rgba), np.float32) * share).astype(np.uint8)
    return image


def _write(image: Image, text: Any, scale: float) -> None:
    size_px = max(text.font_size * scale, _LEAST_TEXT_PX)
    width, height, below = text_size(text.text, size_px)
    x, y = round(text.position.x * scale), round(text.position.y * scale)
    y = max(y, height + below)
    image[max(0, y - height - below) : max(0, y + 1), max(0, x) : max(0, x + width + 3)] = _bgr(text.background_color)
    put_text(image, text.text, (x + 1, y - below + 1), size_px, _bgr(text.text_color))


def text_size(text: str, size_px: float) -> tuple[int, int, int]:
    """Width, height and depth below the line in px of a text of this size."""
    import cv2

    size = size_px / _TEXT_PX
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, _thickness(size))
    return width, height, below


def put_text(image: Image, text: str, at: tuple[int, int], size_px: float, bgr: tuple[int, int, int]) -> None:
    """Write a text of this size from its lower left corner on.

    It is drawn on ``image``, from the pixel ``at`` (x, y), in the colour ``bgr``: blue, green, red.
    """
    import cv2

    size = size_px / _TEXT_PX
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, bgr, _thickness(size), cv2.LINE_AA)


def _thickness(size: float) -> int:
    """The thickness of the lines of letters of a scale."""
    return max(1, round(size / 2))


def scaled(image: Image, width_px: int | None) -> Image:
    """The picture in the given width, and of even size, as video needs it."""
    import cv2

    height, width = image.shape[:2]
    wide = width_px or width
    size = (max(2, wide // 2 * 2), max(2, round(height * wide / width) // 2 * 2))
    if size == (width, height):
        return image
    if width_px is None:
        return np.ascontiguousarray(image[: size[1], : size[0]])
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


# Which messages and pictures.


def message_at(
    coming: Iterator[tuple[int, bytes]], read: Callable[[bytes], Any], held_ns: int = 0
) -> Callable[[int], Any]:
    """A function that reads the message at a time, for rising times, or the last one that is at most so much older.

    None if there is none.

    ``coming`` are messages with their times in ns, rising; ``read`` decodes a payload; ``held_ns`` is how much older
    one may be.
    """
    last: tuple[int, bytes] | None = None
    waiting = next(coming, None)

    def at(t_ns: int) -> Any:
        nonlocal last, waiting
        while waiting is not None and waiting[0] <= t_ns:
            last, waiting = waiting, next(coming, None)
        return read(last[1]) if last is not None and last[0] >= t_ns - held_ns else None

    return at


def without_repeated(times: Ints, numbers: Ints, what: str) -> Ints:
    """Leave out pictures, or scenes, that have the time of another, with a warning.

    ``numbers`` (N,) are places of pictures in ``times`` (F,), in ns, and ``what`` calls them in the warning. Returns
    those that are kept.
    """
    _, first_of = np.unique(times[numbers], return_index=True)
    if len(first_of) < len(numbers):
        warn(f"{len(numbers) - len(first_of)} {what} have the time of another and are left out", "left-out")
    return np.asarray(numbers[first_of], np.int64)


#: The background is the median of this many pictures, spread over the log: people who move vanish from it.
_PICTURES: Final = 9
_WIDTH_PX: Final = 800
_QUALITY: Final = 72


class SceneBackground(NamedTuple):
    """A picture in JPEG to draw tracks on, of ``width`` x ``height`` pixels.

    ``scale`` converts pixels of the camera to pixels of this picture.
    """

    jpeg: bytes
    width: int
    height: int
    scale: float


def background_picture(pictures: Pictures, is_still: bool = True) -> SceneBackground | None:
    """The scene without moving people, or the first picture if the camera isn't still; None without pictures.

    Raises McaptrackError for damaged pictures.
    """
    count = len(pictures.t_ns) if is_still else min(len(pictures.t_ns), 1)
    numbers = np.unique(np.linspace(0, count - 1, min(count, _PICTURES)).round().astype(int)).tolist() if count else []
    seen: list[Image] = []
    scale = 1.0
    for frame in pictures.readable(numbers):
        scale = scale if seen else _scale(frame.rows)
        small = _shrunk(frame.rows, scale)
        if not seen or small.shape == seen[0].shape:
            seen.append(small)
    if not seen:
        return None
    still = np.median(np.stack(seen), axis=0)
    # Grey and with less contrast, so that only tracks have colours.
    grey = 0.55 * (still @ [0.114, 0.587, 0.299]) + 70
    image = np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=2)
    return SceneBackground(encode_image(image, "jpeg", _QUALITY), image.shape[1], image.shape[0], scale)


def moment_picture(pictures: Pictures, t_ns: int) -> SceneBackground | None:
    """The picture that is shown at a time; None if it can't be decoded."""
    at = max(int(np.searchsorted(pictures.t_ns, t_ns, "right")) - 1, 0)
    for frame in pictures.readable([at]):
        scale = _scale(frame.rows)
        small = _shrunk(frame.rows, scale)
        return SceneBackground(encode_image(small, "jpeg", _QUALITY), small.shape[1], small.shape[0], scale)
    return None


def _scale(image: Image) -> float:
    """The factor by which a picture is made smaller."""
    return float(min(1.0, _WIDTH_PX / image.shape[1]))


def _shrunk(image: Image, scale: float) -> Image:
    import cv2

    high, wide = image.shape[:2]
    size = (max(1, round(wide * scale)), max(1, round(high * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
