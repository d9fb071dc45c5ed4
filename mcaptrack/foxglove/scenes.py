"""Drawings in metres, on a ground plane or in space: SceneUpdate messages, for many instants at once.

Three rules of the viewers shape these messages: after a seek only the last message of a topic is known, so each message
removes everything and holds everything; an entity disappears after its lifetime, which counts from the log time; a
coordinate frame without a transform hides its entities.

Letters: F instants, N people, P points of each.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.foxglove.annotations import (
    STAMP,
    Each,
    Slot,
    StampedMessages,
    Template,
    TextSlot,
    by_length,
    joined,
    paint,
    shades,
    short,
)
from mcaptrack.foxglove.messages import SCENE, message_class
from mcaptrack.foxglove.palette import legible
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S

#: Coordinates are multiples of 1/64 m.
PER_M: Final = 64
_ALL: Final = 1  # SceneEntityDeletion.ALL
_LINE_STRIP, _LINE_LOOP, _LINE_LIST = 0, 1, 2
_UPRIGHT: Final = {"w": 1.0}
#: The height of ellipses above the ground, and the least height of a drawn box.
_DISC_M: Final = 0.02
_SLAB_M: Final = 0.0625
#: The length of the line that shows the heading of a box, in lengths of the box.
_AHEAD: Final = 0.75


class PersonMarker(NamedTuple):
    """The drawing of a person: a cylinder with its width and height, the height of the number above the ground, and the
    thickness of the trail, which is drawn whole or in pieces.
    """

    width_m: float
    height_m: float
    number_m: float
    thickness_px: float
    in_pieces: bool = False


class CuboidMarker(NamedTuple):
    """The drawing of a 3D box: the shares of its height between which it is drawn, and the height of the number above
    the top (or, if negative, below the bottom) of the box.
    """

    bottom: float
    top: float
    number_m: float


class Cuboids(NamedTuple):
    """3D boxes of N objects: centres (N, 3) m, sizes (N, 3) m as length, width and height, and headings (N,) rad."""

    centre_m: Floats
    size_m: Floats
    heading_rad: Floats

    def base_m(self) -> Floats:
        """The heights (N,) of the bottoms."""
        return np.asarray(self.centre_m[:, 2] - self.size_m[:, 2] / 2, np.float64)


class SceneMessages(StampedMessages):
    """The scenes of F instants in one coordinate frame. Objects name their instant by its index (N,), rising.

    Everything disappears ``lifetime_ns`` after its instant.
    """

    def __init__(self, t_ns: Ints, frame_id: str, lifetime_ns: int) -> None:
        super().__init__(t_ns)
        self._frame_id, self._lifetime_ns = frame_id, lifetime_ns
        self._add(np.arange(self._count), _head())

    def people(
        self, frame: Ints, labels: NDArray[Any], xy_m: Floats, rgb: Floats, alpha: Floats, marker: PersonMarker,
        trail_m: Floats, fade: Floats, apart_m: Floats, sign: str = "",
    ) -> None:  # fmt: skip
        """Draw people at (N, 2) with labels (N,), numbers or texts behind a sign, and a trail through points (N, P, 2),
        oldest first.

        ``apart_m`` (N,) is how much farther from the ground labels stand than usual.

        ``fade`` (P,) is the opacity at each point. A trail in pieces is drawn between the first and the second point,
        the third and the fourth, and so on. Trails with another number of points need another call.
        """
        xy, trail = _short(xy_m), _short(trail_m)
        text_z = marker.number_m + np.sign(marker.number_m) * _short(apart_m)
        for length, chosen, texts in by_length(labels):
            template = _person(self._frame_id, self._lifetime_ns, length, marker, trail.shape[1], len(sign))
            self._add(
                frame[chosen], template, entity_id=texts, label=np.char.add(sign.encode(), texts),
                x=xy[chosen, 0], y=xy[chosen, 1], a=alpha[chosen],
                text_x=xy[chosen, 0], text_y=xy[chosen, 1], text_z=text_z[chosen],
                **shades("", rgb[chosen]), **shades("text_", legible(rgb[chosen])),
                **_line(trail[chosen], rgb[chosen], fade),
            )  # fmt: skip

    def boxes(
        self, frame: Ints, labels: NDArray[Any], boxes: Cuboids, rgb: Floats, alpha: Floats, marker: CuboidMarker,
        trail_m: Floats, fade: Floats, line: PersonMarker, sign: str = "",
    ) -> None:  # fmt: skip
        """Draw boxes of N objects in colours (N, 3), a line that leads ahead from the middle of each top, and labels
        and trails through points (N, P, 3), as ``people`` does.
        """
        base, (length_m, width_m, height_m) = boxes.base_m(), boxes.size_m.T
        size = _short(np.stack([length_m, width_m, np.maximum((marker.top - marker.bottom) * height_m, _SLAB_M)], -1))
        middle = _short(boxes.centre_m)
        middle[:, 2] = _short(base + (marker.top + marker.bottom) / 2 * height_m)
        over = marker.number_m + (height_m if marker.number_m > 0 else 0)
        ahead = np.repeat(np.stack([*boxes.centre_m[:, :2].T, base + height_m], axis=-1)[:, None], 2, axis=1)
        heading = np.stack([np.cos(boxes.heading_rad), np.sin(boxes.heading_rad)], axis=-1)
        ahead[:, 1, :2] += _AHEAD * length_m[:, None] * heading
        trail, ahead = _short(trail_m), _short(ahead)
        for length, chosen, texts in by_length(labels):
            template = _box(self._frame_id, self._lifetime_ns, length, line, trail.shape[1], len(sign))
            place = {name: middle[chosen, axis] for axis, name in enumerate("xyz")}
            above = {"text_x": place["x"], "text_y": place["y"], "text_z": _short((base + over)[chosen])}
            extent = {name: size[chosen, axis] for axis, name in enumerate(("long", "wide", "high"))}
            front = {f"ahead__{name}": ahead[chosen, :, axis] for axis, name in enumerate("xyz")}
            self._add(
                frame[chosen], template, entity_id=texts, label=np.char.add(sign.encode(), texts), a=alpha[chosen],
                **place, **above, **extent,
                **front, **_turned(boxes.heading_rad[chosen]), **shades("", rgb[chosen]),
                **shades("ahead_", rgb[chosen]), **shades("text_", legible(rgb[chosen])),
                **_line(trail[chosen], rgb[chosen], fade),
            )  # fmt: skip

    def forecasts(
        self, frame: Ints, numbers: Ints, path_m: Floats, rgb: Floats, fade: Floats, thickness_px: float,
        ellipses: tuple[Floats, Floats, Floats] | None,
    ) -> None:  # fmt: skip
        """Draw lines through points (N, P, 2) with opacities (P,), and ellipses: centres (N, 2), half axes (N, 2),
        turns (N,). Points and centres may have a height: (N, P, 3), (N, 3).

        A turn is in radians, from the first axis of the plane to the first of the ellipse.
        """
        path = _short(path_m)
        is_high = path.shape[2] > 2
        for length, chosen, texts in by_length(numbers):
            template = _forecast(
                self._frame_id, self._lifetime_ns, length, path.shape[1], thickness_px, bool(ellipses), is_high
            )
            more = {}
            if ellipses:
                at, half, turn = (part[chosen] for part in ellipses)
                size = np.maximum(_short(2 * half), 1 / PER_M)
                more = {"x": _short(at[:, 0]), "y": _short(at[:, 1]), "wide": size[:, 0], "deep": size[:, 1]}
                more |= shades("", rgb[chosen]) | _turned(turn)
                more |= {"z": _short(at[:, 2] + _DISC_M)} if is_high else {}
            line = _line(path[chosen], rgb[chosen], fade)
            self._add(frame[chosen], template, entity_id=texts, **more, **line)

    def outline(self, frame: int, name: str, xy_m: Floats, rgba: tuple[float, float, float, float]) -> None:
        """Draw a closed line through points (P, 2) on the ground."""
        template = _outline(self._frame_id, self._lifetime_ns, name, len(xy_m), rgba)
        xy = _short(xy_m)[None]
        self._add(np.array([frame]), template, points__x=xy[..., 0], points__y=xy[..., 1])

    def zone(
        self, frame: Ints, name: str, rings: Sequence[Floats], is_closed: bool, label_m: Floats, labels: Sequence[str],
        rgba: tuple[float, float, float, float], height_m: float = 0.0,
    ) -> None:  # fmt: skip
        """Draw the rings (P, 2) of a zone, or a line, at each of N instants, with labels (N,) at a point (2,)."""
        height_m = round(height_m * PER_M) / PER_M
        points = tuple(tuple(map(tuple, _short(ring).tolist())) for ring in rings)
        for length, chosen, texts in by_length(np.array(labels, object)):
            template = _zone(self._frame_id, self._lifetime_ns, name, points, is_closed, length, rgba, height_m)
            at = {f"text_{axis}": np.full(len(chosen), _short(label_m)[place]) for place, axis in enumerate("xy")}
            colours = shades("text_", np.broadcast_to(rgba[:3], (len(chosen), 3)))
            self._add(frame[chosen], template, label=texts, **at, **colours)

    def messages(self) -> Iterator[bytes]:
        """The message of each instant, in order."""
        for frame in range(self._count):
            yield joined(self._groups, frame)


def _short(values: Floats, parts: int = PER_M) -> Floats:
    return short(values, parts)


def _turned(heading_rad: Floats) -> dict[str, Floats]:
    """The columns of a rotation about the vertical."""
    return {"turn_z": _short(np.sin(heading_rad / 2), 4096), "turn_w": _short(np.cos(heading_rad / 2), 4096)}


def _line(points_m: Floats, rgb: Floats, fade: Floats) -> dict[str, Floats]:
    """The columns of a line; none for a line of one point."""
    if points_m.shape[1] < 2:
        return {}
    axes = {f"points__{name}": points_m[..., axis] for axis, name in enumerate("xyz"[: points_m.shape[2]])}
    return {**axes, "colours__a": _short(fade), **shades("colours__", rgb[..., None])}


def _template(content: dict[str, Any]) -> Template:
    return Template(message_class(SCENE).DESCRIPTOR, content)


@cache
def _head() -> Template:
    return _template({"deletions": {"timestamp": STAMP, "type": _ALL}})


def _entity(frame_id: str, lifetime_ns: int, name: Any, **content: Any) -> Template:
    seconds, nanos = divmod(lifetime_ns, NS_PER_S)
    lifetime = {"seconds": seconds, "nanos": nanos}
    whole = {"timestamp": STAMP, "frame_id": frame_id, "id": name, "lifetime": lifetime}
    return _template({"entities": {**whole, **content}})


def _lines(count: int, thickness_px: float, in_pieces: bool = False, is_high: bool = False) -> list[dict[str, Any]]:
    if count < 2:
        return []
    points = _each("points", count, "xyz" if is_high else "xy")
    kind = _LINE_LIST if in_pieces else _LINE_STRIP
    return [_one_line(kind, thickness_px, points, {}) | {"colors": Each("colours", count, paint())}]


def _one_line(
    kind: int, thickness_px: float, points: Any, colour: Mapping[str, Any], height_m: float = 0.0
) -> dict[str, Any]:
    return {
        "type": kind,
        "pose": {"position": {"z": height_m} if height_m else {}, "orientation": _UPRIGHT},
        "thickness": thickness_px,
        "scale_invariant": True,
        "points": points,
        "color": colour,
    }


def _each(name: str, count: int, axes: str) -> Each:
    return Each(name, count, {axis: Slot(axis) for axis in axes})


@cache
def _person(frame_id: str, lifetime_ns: int, length: int, marker: PersonMarker, points: int, more: int) -> Template:
    body = {
        "pose": {"position": {"x": Slot("x"), "y": Slot("y"), "z": marker.height_m / 2}, "orientation": _UPRIGHT},
        "size": {"x": marker.width_m, "y": marker.width_m, "z": marker.height_m},
        "bottom_scale": 1.0,
        "top_scale": 1.0,
        "color": paint(),
    }
    name = _label(length + more, Slot("text_z"))
    lines = _lines(points, marker.thickness_px, marker.in_pieces)
    return _entity(frame_id, lifetime_ns, TextSlot("entity_id", length), cylinders=[body], texts=[name], lines=lines)


def _label(length: int, height: float | Slot) -> dict[str, Any]:
    above = {"x": Slot("text_x"), "y": Slot("text_y"), "z": height}
    return {
        "pose": {"position": above, "orientation": _UPRIGHT},
        "billboard": True,
        "font_size": 14.0,
        "scale_invariant": True,
        "color": {**paint("text_"), "a": 1.0},
        "text": TextSlot("label", length),
    }


@cache
def _box(frame_id: str, lifetime_ns: int, length: int, line: PersonMarker, points: int, more: int) -> Template:
    turn = {"z": Slot("turn_z"), "w": Slot("turn_w")}
    body = {
        "pose": {"position": {name: Slot(name) for name in "xyz"}, "orientation": turn},
        "size": {"x": Slot("long"), "y": Slot("wide"), "z": Slot("high")},
        "color": paint(),
    }
    ahead = _one_line(_LINE_STRIP, 2.0, _each("ahead", 2, "xyz"), {**paint("ahead_"), "a": 1.0})
    lines = [ahead, *_lines(points, line.thickness_px, line.in_pieces, is_high=True)]
    name = _label(length + more, Slot("text_z"))
    return _entity(frame_id, lifetime_ns, TextSlot("entity_id", length), cubes=[body], texts=[name], lines=lines)


@cache
def _forecast(
    frame_id: str, lifetime_ns: int, length: int, points: int, thickness_px: float, has_ellipse: bool, is_high: bool
) -> Template:
    disc = {
        "pose": {
            "position": {"x": Slot("x"), "y": Slot("y"), "z": Slot("z") if is_high else _DISC_M},
            "orientation": {"z": Slot("turn_z"), "w": Slot("turn_w")},
        },
        "size": {"x": Slot("wide"), "y": Slot("deep"), "z": 0.01},
        "bottom_scale": 1.0,
        "top_scale": 1.0,
        "color": {**paint(), "a": 0.125},  # many lie over one another
    }
    lines, discs = _lines(points, thickness_px, is_high=is_high), [disc] if has_ellipse else []
    return _entity(frame_id, lifetime_ns, TextSlot("entity_id", length), cylinders=discs, lines=lines)


@cache
def _zone(
    frame_id: str,
    lifetime_ns: int,
    name: str,
    rings: tuple[tuple[tuple[float, float], ...], ...],
    is_closed: bool,
    length: int,
    rgba: tuple[float, float, float, float],
    height_m: float,
) -> Template:
    kind, colour = _LINE_LOOP if is_closed else _LINE_STRIP, dict(zip("rgba", rgba, strict=True))
    lines = [_one_line(kind, 3.0, [{"x": x, "y": y} for x, y in ring], colour, height_m) for ring in rings]
    return _entity(frame_id, lifetime_ns, name, lines=lines, texts=[_label(length, _DISC_M + height_m)])


@cache
def _outline(
    frame_id: str, lifetime_ns: int, name: str, points: int, rgba: tuple[float, float, float, float]
) -> Template:
    line = _one_line(_LINE_LOOP, 2.0, _each("points", points, "xy"), dict(zip("rgba", rgba, strict=True)))
    return _entity(frame_id, lifetime_ns, name, lines=[line])
