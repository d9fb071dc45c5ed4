"""Annotation messages as lines and texts in JSON, for a page that draws them over pictures.

A line is [kind, thickness, colour, fill, [x, y, x, y, ...]]. Its kind is closed, open or pairs of points; colour and
fill are numbers in the list of colours, the fill of a line that has none is -1. A text is [x, y, size, colour,
background, text], at its lower left corner. All is in pixels of the picture.
"""

from __future__ import annotations

from itertools import pairwise
from math import isfinite
from typing import Any, Final

CLOSED, OPEN, PAIRS = 0, 1, 2
_LINE_LOOP, _LINE_STRIP, _LINE_LIST = 2, 3, 4
#: The decimal places of coordinates.
_DIGITS: Final = 2

Line = list[Any]
Text = list[Any]


class Strokes:
    """Converts annotations to lines and texts; ``colours`` are those that occurred so far, as CSS writes them."""

    def __init__(self) -> None:
        self._number: dict[str, int] = {}

    @property
    def colours(self) -> list[str]:
        """The colours, by number."""
        return list(self._number)

    def of(self, annotations: Any) -> list[list[Any]]:
        """Return the lines and the texts of an ImageAnnotations message; what can't be seen is left out."""
        lines: list[Line] = []
        for part in annotations.points:
            points = [(round(point.x, _DIGITS), round(point.y, _DIGITS)) for point in part.points]
            if not all(isfinite(x) and isfinite(y) for x, y in points):
                continue
            shades = part.outline_colors
            if part.type == _LINE_LOOP:
                fill = self._colour(part.fill_color)
                self._add(lines, CLOSED, part.thickness, self._colour(part.outline_color), points, fill)
            elif part.type == _LINE_LIST and 2 * len(shades) == len(points):
                self._pairs(lines, part.thickness, shades, zip(points[::2], points[1::2], strict=True))
            elif part.type == _LINE_STRIP and points and len(shades) == len(points):
                self._pairs(lines, part.thickness, shades[1:], pairwise(points))
            elif part.type in (_LINE_STRIP, _LINE_LIST):
                kind = OPEN if part.type == _LINE_STRIP else PAIRS
                self._add(lines, kind, part.thickness, self._colour(part.outline_color), points)
        texts: list[Text] = [
            [
                round(text.position.x, _DIGITS),
                round(text.position.y, _DIGITS),
                round(text.font_size, _DIGITS),
                self._colour(text.text_color),
                self._colour(text.background_color),
                text.text,
            ]
            for text in annotations.texts
            if isfinite(text.position.x) and isfinite(text.position.y)
        ]
        return [lines, texts]

    def _pairs(self, lines: list[Line], thickness: float, shades: Any, pairs: Any) -> None:
        """Add pairs of points that have colours of their own: one line for each colour."""
        by_colour: dict[int, list[tuple[float, float]]] = {}
        for shade, pair in zip(shades, pairs, strict=True):
            by_colour.setdefault(self._colour(shade), []).extend(pair)
        for colour, points in by_colour.items():
            self._add(lines, PAIRS, thickness, colour, points)

    @staticmethod
    def _add(
        lines: list[Line], kind: int, thickness: float, colour: int, points: list[tuple[float, float]], fill: int = -1
    ) -> None:
        if points and max(colour, fill) >= 0:
            lines.append([kind, round(thickness, 2), colour, fill, [value for point in points for value in point]])

    def _colour(self, rgba: Any) -> int:
        """Return the number of a colour; -1 if it can't be seen."""
        parts = [round(255 * min(1.0, max(0.0, part))) for part in (rgba.r, rgba.g, rgba.b, rgba.a)]
        if not parts[3]:
            return -1
        return self._number.setdefault("#" + bytes(parts).hex(), len(self._number))
