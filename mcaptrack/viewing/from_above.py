"""Scenes in metres seen from above, for videos of logs without pictures: messages of scenes become annotations.

North (y) is up. Letters: P points.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.foxglove import ANNOTATIONS
from mcaptrack.foxglove.messages import message_class
from mcaptrack.foxglove.views import styles
from mcaptrack.geometry.arrays import Floats, Image
from mcaptrack.pipeline import RobotPath
from mcaptrack.viewing.painting import BACKGROUND

__all__ = ["ABOVE_PX", "Sight", "drawing", "grid", "ground", "robot", "sight_of", "sights"]

_GRID: Final = (0.2, 0.22, 0.25, 1.0)
_INK: Final = (0.85, 0.87, 0.9, 1.0)
_ROBOT: Final = (*styles.WHITE, styles.ROBOT_ALPHA)
#: Red, green, blue and opacity.
Shade = tuple[float, float, float, float]
#: Types of lines in scenes, and in annotations.
_STRIP, _LOOP, _LIST = 0, 1, 2
_ANNOTATED: Final = {_STRIP: 3, _LOOP: 2, _LIST: 4}
_CORNERS: Final = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
_ROUND: Final = np.array([[np.cos(turn), np.sin(turn), 0.0] for turn in np.arange(24) * np.pi / 12]) / 2
#: The largest number of lines of the grid in a direction.
_MOST_LINES: Final = 10
_STEPS: Final = (1.0, 2.0, 5.0)
#: Text is as high as this part of the width, and never lower than so many pixels.
_TEXT, _LEAST_TEXT_PX = 1 / 60, 11.0
#: The distance of labels from their places, so that they don't hide small objects.
_BESIDE_PX: Final = np.array([8.0, -8.0])


class Sight(NamedTuple):
    """The part of the ground in a picture: its middle in metres, pixels per metre, and width and height in pixels.

    ``x_m`` and ``y_m`` are that middle.
    """

    x_m: float
    y_m: float
    px_per_m: float
    width_px: int
    height_px: int

    def to_pixels(self, points_m: Floats) -> Floats:
        """Points (P, 2 or 3) in metres as pixels (P, 2)."""
        x = self.width_px / 2 + (points_m[:, 0] - self.x_m) * self.px_per_m
        y = self.height_px / 2 - (points_m[:, 1] - self.y_m) * self.px_per_m
        return np.stack([x, y], axis=-1)


def ground(sight: Sight) -> Image:
    """The empty ground, BGR (height, width, 3)."""
    return np.full((sight.height_px, sight.width_px, 3), BACKGROUND, np.uint8)


def grid(sight: Sight) -> Any:
    """Annotations of a grid with round steps, with a bar that shows the step."""
    out = message_class(ANNOTATIONS)()
    across, up = sight.width_px / sight.px_per_m, sight.height_px / sight.px_per_m
    step = _round_step(max(across, up) / _MOST_LINES)
    for axis, (middle, extent, other) in enumerate(((sight.x_m, across, up), (sight.y_m, up, across))):
        first, last = np.ceil((middle - extent / 2) / step), np.floor((middle + extent / 2) / step)
        for place in np.arange(first, last + 1) * step:
            ends = np.array([[place, sight.y_m - other / 2], [place, sight.y_m + other / 2]])
            if axis:
                ends = np.array([[sight.x_m - other / 2, place], [sight.x_m + other / 2, place]])
            _line(out, _ANNOTATED[_STRIP], sight.to_pixels(ends), _GRID)
    low, left = sight.height_px - 14.0, 14.0
    bar = np.array([[left, low], [left + step * sight.px_per_m, low]])
    _line(out, _ANNOTATED[_STRIP], bar, _INK, 3.0)
    _text(out, f"{step:g} m", bar[0] - [0.0, 6.0], _INK, sight)
    return out


def robot(sight: Sight, at_m: Floats, heading_rad: float) -> Any:
    """Annotations of a robot: an arrow ahead at its position (2,); none if it isn't known.

    ``heading_rad`` is its heading, anticlockwise from x.
    """
    out = message_class(ANNOTATIONS)()
    if np.isfinite([*at_m, heading_rad]).all():
        cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
        outline = at_m + styles.ROBOT_M @ np.array([[cosine, sine], [-sine, cosine]])
        _line(out, _ANNOTATED[_LOOP], sight.to_pixels(outline), _ROBOT, fill=_ROBOT)
    return out


def drawing(scene: Any, sight: Sight) -> Any:
    """A SceneUpdate message as an ImageAnnotations message: cubes, cylinders, lines and texts.

    ``sight`` is the part of the ground that the picture shows.
    """
    out = message_class(ANNOTATIONS)()
    for entity in scene.entities:
        for shapes, outline in ((entity.cylinders, _ROUND), (entity.cubes, _CORNERS)):
            for shape in shapes:
                size = np.array([shape.size.x, shape.size.y, 0.0])
                corners = _placed(shape.pose, outline * size)
                rgba = (shape.color.r, shape.color.g, shape.color.b, shape.color.a)
                _line(out, _ANNOTATED[_LOOP], sight.to_pixels(corners), (*rgba[:3], min(1.0, 1.5 * rgba[3])), fill=rgba)
    for entity in scene.entities:
        for line in entity.lines:
            points = np.array([(point.x, point.y, point.z) for point in line.points], float).reshape(-1, 3)
            px = sight.to_pixels(_placed(line.pose, points))
            shades: list[Shade] = [(color.r, color.g, color.b, color.a) for color in line.colors]
            plain = (line.color.r, line.color.g, line.color.b, line.color.a)
            shades = shades[1::2] if line.type == _LIST else shades
            _line(out, _ANNOTATED.get(line.type, _ANNOTATED[_STRIP]), px, plain, line.thickness / 2, shades)
        for text in entity.texts:
            at = sight.to_pixels(_placed(text.pose, np.zeros((1, 3))))[0] + _BESIDE_PX
            _text(out, text.text, at, (text.color.r, text.color.g, text.color.b, 1.0), sight)
    return out


def _placed(pose: Any, points: Floats) -> Floats:
    """Points (P, 3) of a shape in the frame of its scene."""
    x, y, z, w = (getattr(pose.orientation, name) for name in "xyzw")
    norm = x * x + y * y + z * z + w * w
    if x or y or z:
        across = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # points @ across is the cross product
        turned = points @ across
        points = points + 2 / norm * (w * turned + turned @ across)
    return np.asarray(points + np.array([pose.position.x, pose.position.y, pose.position.z]), np.float64)


def _round_step(least: float) -> float:
    """The least round number, 1, 2 or 5 times a power of ten, that is not below a number."""
    power = 10.0 ** np.floor(np.log10(least))
    return float(next((step * power for step in _STEPS if step * power >= least), 10 * power))


def _line(
    out: Any,
    kind: int,
    px: Floats,
    rgba: Shade,
    thickness: float = 1.0,
    shades: list[Shade] | None = None,
    fill: Shade | None = None,
) -> None:
    part = out.points.add(type=kind, thickness=max(1.0, thickness))
    for x, y in px.tolist():
        part.points.add(x=x, y=y)
    _paint(part.outline_color, rgba)
    for shade in shades or ():
        _paint(part.outline_colors.add(), shade)
    if fill is not None:
        _paint(part.fill_color, fill)


def _text(out: Any, content: str, at_px: Floats, rgba: Shade, sight: Sight) -> None:
    text = out.texts.add(text=content, font_size=max(_LEAST_TEXT_PX, sight.width_px * _TEXT))
    text.position.x, text.position.y = at_px.tolist()
    _paint(text.text_color, rgba)
    _paint(text.background_color, (BACKGROUND[2] / 255, BACKGROUND[1] / 255, BACKGROUND[0] / 255, 1.0))


def _paint(colour: Any, rgba: Shade) -> None:
    colour.r, colour.g, colour.b, colour.a = rgba


# Which part of the ground is in a picture.


#: Seen from above: the width of a video in pixels and its height as a share of it, the width in metres around a robot,
#: the least one around places, and the margin around these as a factor.
ABOVE_PX: Final = 960
_HEIGHT: Final = 0.75
_AROUND_M: Final = 80.0
_LEAST_M: Final = 10.0
_MARGIN: Final = 1.2


def sights(scenes: Iterable[Any], width_px: int, path: RobotPath | None, count: int) -> list[Sight]:
    """The part of the ground in each picture: the surroundings of the robot, or all boxes and people of the scenes.

    ``width_px`` is the width of the pictures, ``count`` their number; ``path`` is that of the robot, None without one.
    """
    if path is not None:
        placed = np.flatnonzero(np.isfinite(path.at_m).all(axis=1))
        if len(placed):
            nearest = placed[np.abs(placed[None] - np.arange(count)[:, None]).argmin(axis=1)]
            width, height = size_from_above(width_px)
            return [Sight(x, y, width / _AROUND_M, width, height) for x, y in path.at_m[nearest].tolist()]
    places = [
        (shape.pose.position.x, shape.pose.position.y)
        for scene in scenes
        for entity in scene.entities
        for shape in (*entity.cubes, *entity.cylinders)
    ]
    low, high = np.quantile(np.array(places), [0.01, 0.99], axis=0) if places else np.array([[-5.0, -5.0], [5.0, 5.0]])
    return [sight_of(low, high, np.maximum((high - low) * _MARGIN, _LEAST_M), width_px)] * count


def size_from_above(width_px: int) -> tuple[int, int]:
    """The size of a picture that is seen from above, even numbers."""
    return width_px // 2 * 2, max(2, round(width_px * _HEIGHT) // 2 * 2)


def sight_of(low: Floats, high: Floats, extent: Floats, width_px: int) -> Sight:
    """The part of the ground in a picture that has the middle of two corners (2,), and shows an extent (2,) in m.

    ``low`` and ``high`` are those corners in m, and ``width_px`` is the width of the picture.
    """
    width, height = size_from_above(width_px)
    x, y = ((low + high) / 2).tolist()
    return Sight(x, y, float(min(width / extent[0], height / extent[1])), width, height)
