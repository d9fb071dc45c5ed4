"""Drawings on pictures: ImageAnnotations messages, for many pictures at once.

Two rules of the viewers (Foxglove, Lichtblick) shape these messages: an annotation belongs to a picture if its
timestamp is the picture's to the nanosecond; a picture is shown only if each annotation topic that is switched on has a
message for it. So each frame gets a message, and an empty one holds an invisible point.

Letters: F pictures, N drawn objects, P points of each, Q pairs of points.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.foxglove.messages import ANNOTATIONS, message_class
from mcaptrack.foxglove.palette import ink
from mcaptrack.foxglove.template import (
    STAMP,
    Each,
    MessageParts,
    Slot,
    Template,
    TextSlot,
    group,
    joined,
    nested,
    stamps,
)
from mcaptrack.geometry.arrays import Floats, Ints

#: Coordinates are multiples of a quarter of a pixel: numbers with few digits take few bytes of a compressed log.
PER_PX: Final = 4
#: Types of a PointsAnnotation.
DOTS, LINE_LOOP, LINE_LIST = 1, 2, 4
_POINTS: Final = 2  # the field of ImageAnnotations


# Labels as text, grouped by length, because messages with texts of one length have one length.


def by_length(labels: NDArray[Any]) -> Iterator[tuple[int, Ints, NDArray[Any]]]:
    """Group labels (N,), numbers or texts, by the length of their text: for each length the length in bytes, the
    indices, and the texts as bytes.
    """
    unique, which = np.unique(labels, return_inverse=True)
    texts = np.array([str(label).encode() for label in unique.tolist()] or [b""])
    lengths = np.char.str_len(texts)[which] if len(labels) else np.empty(0, np.int64)
    for length in np.unique(lengths).tolist():
        chosen = np.flatnonzero(lengths == length)
        yield length, chosen, texts[which[chosen]]


class Annotations:
    """The annotations of F pictures with these stamps. Objects name their picture by its index (N,), rising."""

    def __init__(self, stamp_ns: Ints) -> None:
        self._count = len(stamp_ns)
        self._seconds, self._nanos = stamps(stamp_ns)
        self._groups: list[MessageParts] = []
        self._lines: dict[float, list[MessageParts]] = {}
        self._drawn = np.zeros(self._count, bool)
        self._add(np.arange(self._count), _head())

    def loops(
        self, frame: Ints, xy_px: Floats, rgb: Floats, alpha: Floats, thickness: float, fill: float = 0.0
    ) -> None:
        """Draw closed lines through points (N, P, 2) in colours (N, 3); inside with ``fill`` times their opacity."""
        count = xy_px.shape[1]
        more = (
            {} if not fill else {"fill_r": rgb[:, 0], "fill_g": rgb[:, 1], "fill_b": rgb[:, 2], "fill_a": alpha * fill}
        )
        template = _loop(count, thickness, bool(fill))
        self._draw(frame, template, xy_px, r=rgb[:, 0], g=rgb[:, 1], b=rgb[:, 2], a=alpha, **more)

    def pairs(self, frame: Ints, xy_px: Floats, rgb: Floats, alpha: Floats, thickness: float) -> None:
        """Draw lines between pairs of points (N, 2 Q, 2) in colours (N, 3) with opacities (N, Q), or (Q,) for all.

        Lines of one thickness become one annotation of a picture, because a stamp takes more bytes than a line.
        """
        xy = _short(xy_px, PER_PX)
        shades = {f"colours__{name}": rgb[:, place, None] for place, name in enumerate("rgb")}
        template = _some_lines(xy.shape[1])
        parts = template.filled(
            len(frame), points__x=xy[..., 0], points__y=xy[..., 1], colours__a=_short(alpha, 64), **shades
        )
        self._lines.setdefault(thickness, []).append(group(parts, frame, self._count))
        self._drawn[frame] = True

    def labels(self, frame: Ints, xy_px: Floats, labels: NDArray[Any], rgb: Floats, size_px: float) -> None:
        """Write labels (N,), numbers or texts, from positions (N, 2) on, on backgrounds of colours (N, 3)."""
        xy, dark = _short(xy_px, PER_PX), ink(rgb)
        for length, chosen, texts in by_length(labels):
            shades = {
                f"{front}_{name}": values[chosen, place]
                for front, values in (("text", dark), ("ground", rgb))
                for place, name in enumerate("rgb")
            }
            at = {"x": xy[chosen, 0], "y": xy[chosen, 1]}
            self._add(frame[chosen], _text(length, size_px), text=texts, **at, **shades)

    def messages(self) -> Iterator[bytes]:
        """The message of each picture, in order."""
        empty = np.flatnonzero(~self._drawn)
        if len(empty):
            self._add(empty, _nothing())
        every = np.arange(self._count)
        lines = []
        for thickness, groups in self._lines.items():
            head = _lines_head(thickness).filled(self._count, seconds=self._seconds, nanos=self._nanos)
            lines.append((group(head, every, self._count), groups))
        for frame in range(self._count):
            whole = [joined(self._groups, frame)]
            for begin, groups in lines:
                content = joined(groups, frame)
                if content:
                    whole.append(nested(_POINTS, joined([begin], frame) + content))
            yield b"".join(whole)

    def _draw(self, frame: Ints, template: Template, xy_px: Floats, **columns: Any) -> None:
        xy = _short(xy_px, PER_PX)
        self._add(frame, template, points__x=xy[..., 0], points__y=xy[..., 1], **columns)
        self._drawn[frame] = True

    def _add(self, frame: Ints, template: Template, **columns: Any) -> None:
        if len(frame):
            stamp = {"seconds": self._seconds[frame], "nanos": self._nanos[frame]}
            self._groups.append(group(template.filled(len(frame), **stamp, **columns), frame, self._count))


def _short(values: Floats, parts: int) -> Floats:
    """The nearest multiples of a binary fraction."""
    return np.rint(values * parts) / parts


def _template(content: dict[str, Any]) -> Template:
    return Template(message_class(ANNOTATIONS).DESCRIPTOR, content)


def _paint(front: str = "") -> dict[str, Slot]:
    return {name: Slot(front + name) for name in "rgba"}


@cache
def _head() -> Template:
    return _template({"timestamp": STAMP})


@cache
def _nothing() -> Template:
    black = dict.fromkeys("rgba", 0.0)
    dot = {"timestamp": STAMP, "type": DOTS, "points": {"x": 0.0, "y": 0.0}, "outline_color": black, "thickness": 1.0}
    return _template({"points": dot})


def _of_points(content: dict[str, Any]) -> Template:
    return Template(message_class(ANNOTATIONS).DESCRIPTOR.fields_by_name["points"].message_type, content)


@cache
def _lines_head(thickness: float) -> Template:
    white = dict.fromkeys("rgba", 1.0)
    return _of_points({"type": LINE_LIST, "outline_color": white, "thickness": thickness, "timestamp": STAMP})


@cache
def _some_lines(points: int) -> Template:
    ends = Each("points", points, {"x": Slot("x"), "y": Slot("y")})
    return _of_points({"points": ends, "outline_colors": Each("colours", points // 2, _paint())})


@cache
def _loop(points: int, thickness: float, filled: bool) -> Template:
    content = {
        "type": LINE_LOOP,
        "outline_color": _paint(),
        "thickness": thickness,
        **({"fill_color": _paint("fill_")} if filled else {}),
        "timestamp": STAMP,
        "points": Each("points", points, {"x": Slot("x"), "y": Slot("y")}),
    }
    return _template({"points": content})


@cache
def _text(length: int, size_px: float) -> Template:
    front, ground = ({**_paint(name), "a": opacity} for name, opacity in (("text_", 1.0), ("ground_", 0.75)))
    content = {
        "text": TextSlot("text", length),
        "font_size": size_px,
        "text_color": front,
        "background_color": ground,
        "timestamp": STAMP,
        "position": {"x": Slot("x"), "y": Slot("y")},
    }
    return _template({"texts": content})
