"""The pictures of a log and what is drawn on them, made small enough for a notebook.

Without pictures it is the ground, seen from above. Times are seconds since the start of the log, as in reports and
events.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from math import ceil
from typing import Any, Final

import numpy as np

from mcaptrack import log, notices, pipeline
from mcaptrack.errors import McaptrackError
from mcaptrack.foxglove.views import SCENE_SUFFIX
from mcaptrack.geometry.arrays import Image, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import encode_image
from mcaptrack.viewing import from_above
from mcaptrack.viewing.from_above import Sight
from mcaptrack.viewing.notebook.drawings import find_drawings
from mcaptrack.viewing.notebook.strokes import Strokes
from mcaptrack.viewing.rendering import draw, scaled, sights

#: The largest width of a player and of a still in pixels, unless it is given.
PLAYER_PX: Final = 640
_STILL_PX: Final = 960
_QUALITY: Final = 65
_STILL_QUALITY: Final = 88
#: The largest number of pictures of a player, unless it is given which.
_MOST: Final = 1500
#: The number of pictures that are encoded to estimate the size of all, and the size in bytes of what a view draws.
_TRIED: Final = 5
_DRAWN_BYTES: Final = 500
#: The growth of bytes that are written as text (base64).
_AS_TEXT: Final = 4 / 3

Progress = Callable[[str, int, int], None]


@dataclass
class Clip:
    """N pictures: their times, numbers in the channel, sizes in pixels (width, height) and, unless they are seen from
    above, JPEG files, which may be smaller.

    ``drawn`` has for each picture the lines and texts of each of ``layers``, in pixels of that size. Layers are topics
    of views; the ground that is seen from above is "".
    """

    layers: tuple[str, ...]
    t_ns: list[int] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    sizes: list[tuple[int, int]] = field(default_factory=list)
    jpegs: list[bytes] = field(default_factory=list)
    drawn: list[list[list[Any]]] = field(default_factory=list)
    strokes: Strokes = field(default_factory=Strokes)

    def half(self) -> Clip:
        """Every second picture."""
        parts = self.t_ns[::2], self.numbers[::2], self.sizes[::2], self.jpegs[::2], self.drawn[::2]
        return Clip(self.layers, *parts, self.strokes)


class PictureSource:
    """The pictures of a log, or its scenes seen from above, with the views that are drawn on them.

    ``t_ns`` are their rising times (N,); ``noun`` is "pictures" or "scenes". Raises McaptrackError if there are none.
    """

    def __init__(self, opened: log.Log, prefix: str, topics: Sequence[str]) -> None:
        shown = find_drawings(opened, prefix, topics)
        self._opened, self._prefix, self._views = opened, prefix, shown.views
        self.views = tuple(view.topic for view in shown.views)
        self._pictures = Pictures(opened, shown.pictures) if shown.pictures else None
        self.topic = shown.pictures or self.views[0]
        self.is_above = not shown.pictures
        self.noun = "scenes" if self.is_above else "pictures"
        self.t_ns: Ints = shown.t_ns
        if not len(self.t_ns):
            raise McaptrackError(f"{opened.path}: {self.topic} has no {self.noun}")

    def seconds(self, t_ns: int) -> float:
        """Return a log time as seconds since the start of the log."""
        return (t_ns - self._opened.start_ns) / NS_PER_S

    def number_at(self, at_s: float) -> int:
        """Return the number of the picture that is shown at a time: the last one that is not later.

        Raises McaptrackError for a time before the first picture, or after the last one.
        """
        at_ns = self._opened.start_ns + seconds_to_ns(at_s)
        rest = np.diff(self.t_ns)
        usual = int(np.median(rest)) if len(rest) else NS_PER_S
        # Times are written with three decimals, so that the first picture is that of its time as it is printed.
        number = int(np.searchsorted(self.t_ns, at_ns + NS_PER_S // 1000, "right")) - 1
        if number < 0 or at_ns > int(self.t_ns[-1]) + usual:
            raise McaptrackError(f"{self._opened.path} has no {self.noun[:-1]} at {at_s:g} s; {self._there()}")
        return number

    def numbers(self, start_s: float, end_s: float | None) -> Ints:
        """Return the numbers of the pictures of a period (M,). Raises McaptrackError if there are none."""
        first = self._opened.start_ns + seconds_to_ns(start_s)
        last = int(self.t_ns[-1]) if end_s is None else self._opened.start_ns + seconds_to_ns(end_s)
        numbers = np.flatnonzero((self.t_ns >= first) & (self.t_ns <= last))
        if not len(numbers):
            end = "the end" if end_s is None else f"{end_s:g} s"
            raise McaptrackError(
                f"{self._opened.path} has no {self.noun} between {start_s:g} s and {end}; {self._there()}"
            )
        _, first_of = np.unique(self.t_ns[numbers], return_index=True)
        if len(first_of) < len(numbers):
            left = len(numbers) - len(first_of)
            notices.warn(f"{left} {self.noun} have the time of another and are left out", "left-out")
        return np.asarray(numbers[first_of], np.int64)

    def step(self, numbers: Ints, most_bytes: float, width_px: int | None) -> int:
        """Return the step between pictures with which about as many as fit into ``most_bytes`` are taken."""
        each = float(_DRAWN_BYTES * (1 + len(self.views)))
        if self._pictures is not None:
            tried = numbers[np.unique(np.linspace(0, len(numbers) - 1, _TRIED).astype(int))]
            small = (self._small(frame.rows, width_px) for frame in self._pictures.frames(tried.tolist()))
            sizes = [len(encode_image(one, "jpeg", _QUALITY)) for one in small]
            each += _AS_TEXT * float(np.mean(sizes)) if sizes else 0.0
        return max(1, ceil(len(numbers) / max(1.0, min(_MOST, most_bytes / each))))

    def take(self, numbers: Ints, width_px: int | None, progress: Progress) -> Clip:
        """Return pictures with these rising numbers (M,). A video's pictures before the first key picture are missing.

        Raises McaptrackError for pictures and views that are damaged.
        """
        out = Clip(self.views if self._pictures is not None else ("", *self.views))
        for done, (number, size, image, drawings) in enumerate(self._drawn_on(numbers, width_px or PLAYER_PX), 1):
            out.t_ns.append(int(self.t_ns[number]))
            out.numbers.append(number)
            out.sizes.append(size)
            if self._pictures is not None:
                out.jpegs.append(encode_image(self._small(image, width_px), "jpeg", _QUALITY))
            out.drawn.append([out.strokes.of(one) if one is not None else [[], []] for one in drawings])
            progress("show", done, len(numbers))
        if not out.t_ns:
            raise McaptrackError(f"{self._opened.path}: no picture of {self.topic} in this period can be decoded")
        return out

    def still(self, number: int, width_px: int | None) -> Image:
        """Return a picture with its drawings, BGR (height, width, 3)."""
        for _, size, image, drawings in self._drawn_on(np.array([number]), width_px or _STILL_PX):
            width = width_px or min(_STILL_PX, size[0])
            out = scaled(image, width) if self._pictures is not None else image
            for one in drawings:
                out = draw(out, one, out.shape[1] / size[0]) if one is not None else out
            return out
        where = f"{self._opened.path}: {self.topic} at {self.seconds(int(self.t_ns[number])):.3f} s"
        raise McaptrackError(f"{where} can't be decoded: the video has no key picture before it")

    def _drawn_on(self, numbers: Ints, above_px: int) -> Iterator[tuple[int, tuple[int, int], Image, list[Any]]]:
        """Yield number, size, picture, and the annotations of each layer, None where a view has none."""
        chosen = self.t_ns[numbers]
        span = int(chosen[0]), int(chosen[-1]) + 1
        views = [(view.payload_at(self.t_ns, span), view.read) for view in self._views]

        def at(t_ns: int) -> Iterator[Any]:
            for payload_at, read in views:
                payload = payload_at(t_ns)
                yield None if payload is None else read(payload)

        if self._pictures is not None:
            for frame in self._pictures.frames(numbers.tolist()):
                image = np.asarray(frame.rows, np.uint8)
                yield frame.index, (image.shape[1], image.shape[0]), image, list(at(frame.t_ns))
            return
        for number, sight, ground in self._ground(numbers, span, above_px):
            scenes = at(int(self.t_ns[number]))
            drawings = [None if scene is None else from_above.drawing(scene, sight) for scene in scenes]
            yield number, (sight.width_px, sight.height_px), from_above.ground(sight), [ground, *drawings]

    def _ground(self, numbers: Ints, span: tuple[int, int], width_px: int) -> Iterator[tuple[int, Sight, Any]]:
        """Yield number, the part of the ground that is in view, and annotations of its grid and of the robot."""
        first = self.views[0]
        is_view = first.endswith(SCENE_SUFFIX)  # rows that are drawn now are seen without the robot
        path = pipeline.robot_path(self._opened, self._prefix, first, self.t_ns[numbers]) if is_view else None
        scenes = (self._views[0].read(payload) for payload in self._views[0].payloads(self.t_ns, span))
        seen = sights(scenes, width_px, path, len(numbers))
        for place, (number, sight) in enumerate(zip(numbers.tolist(), seen, strict=True)):
            ground = from_above.grid(sight)
            if path is not None:
                ground.MergeFrom(from_above.robot(sight, path.at_m[place], float(path.heading_rad[place])))
            yield number, sight, ground

    def _small(self, image: Any, width_px: int | None) -> Image:
        """A picture in the width of the player."""
        width = width_px or min(PLAYER_PX, image.shape[1])
        return scaled(np.asarray(image, np.uint8), width)

    def _there(self) -> str:
        first, last = self.seconds(int(self.t_ns[0])), self.seconds(int(self.t_ns[-1]))
        return f"its {self.noun} are from {first:.3f} to {last:.3f} s"


def still_jpeg(image: Image) -> bytes:
    """Return a still as a JPEG file."""
    return encode_image(image, "jpeg", _STILL_QUALITY)
