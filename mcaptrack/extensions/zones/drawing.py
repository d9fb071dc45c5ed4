"""Zones and lines drawn on pictures and on the ground, with the counts so far.

Letters: F frames, P points of a ring.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.extensions.zones.shapes import Shape, Zone
from mcaptrack.foxglove.annotations import Annotations
from mcaptrack.foxglove.views.ground import Instants
from mcaptrack.foxglove.views.image import PictureTimes, View
from mcaptrack.foxglove.views.people import by_plane
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.plane import Planes
from mcaptrack.schema import ZONE_COUNTS, Frame
from mcaptrack.schema.framing import frame_times, joined_parts

#: Zones are amber, lines are blue; tracks have other colours.
_ZONE, _LINE = (1.0, 0.75, 0.125), (0.375, 0.75, 1.0)
_ALPHA, _FILL = 0.875, 0.125
_TEXT_PX: Final = 12.0
#: The length of the arrow that points forward, as a share of the height of the picture, or of the line.
_ARROW: Final = 0.04
#: The width of a letter, and the distance of lines, in sizes of the text.
_ASPECT, _SPACING = 0.55, 1.25
#: A label is moved down by so many lines at most.
_MOST_DOWN: Final = 12
#: Zones with a point farther than this from the picture are not drawn.
_FAR_PX: Final = 1e4


class ZoneCaptions(NamedTuple):
    """The texts of zones over time: times of frames (F,) in ns, and a text for each zone and frame."""

    t_ns: Ints
    texts: Sequence[Sequence[str]]

    @classmethod
    def of(cls, zones: Sequence[Zone], counts: Sequence[Frame]) -> ZoneCaptions:
        """The texts for frames of ZoneCounts."""
        texts: list[list[str]] = [[] for _ in zones]
        for _, _, joined in joined_parts(ZONE_COUNTS, counts):
            for zone, kept in zip(zones, texts, strict=True):
                rows = joined.rows[joined.rows["zone_id"] == zone.number]
                names = ("forward", "backward") if zone.is_line else ("inside", "tracks")
                pairs = zip(*(rows[name].tolist() for name in names), strict=True)
                texts_of_counts: dict[tuple[int, int], str] = {}
                form = "{}: {} forward, {} back" if zone.is_line else "{}: {} inside, {} so far"
                kept.extend(texts_of_counts.setdefault(pair, form.format(zone.name, *pair)) for pair in pairs)
        return cls(frame_times(counts), texts)

    def at(self, zone: int, t_ns: Ints) -> list[str]:
        """The texts of a zone at times."""
        if not len(self.t_ns):
            return [""] * len(t_ns)
        place = np.maximum(np.searchsorted(self.t_ns, t_ns, "right") - 1, 0)
        return [self.texts[zone][frame] for frame in place.tolist()]


class ZoneShape(NamedTuple):
    """A zone to draw: its shape, and the same on the ground, None if it is not known there.

    ``forward`` is 1 if forward is to the right of a line on the ground, with the second axis upwards, otherwise -1.
    ``height_m`` is that of the ground there.
    """

    zone: Zone
    shape: Shape
    ground: Shape | None
    forward: int
    height_m: float = 0.0

    def rings_px(self, height_px: float) -> list[Floats]:
        """The rings in a picture of this height, of a zone in pixels; of a line the line and its arrow."""
        rings = [ring for part in self.shape.parts for ring in part]
        # In pictures the second axis points down: what is to the right as one sees it is to the left here.
        return [*rings, *_arrow(rings[0], -1, _ARROW * height_px)] if self.zone.is_line else rings

    def rings_m(self) -> list[Floats]:
        """The rings on the ground; of a line the line and its arrow; none if it is not known there."""
        if self.ground is None:
            return []
        rings = [ring for part in self.ground.parts for ring in part]
        return [*rings, *_arrow(rings[0], self.forward, _ARROW * self.ground.length)] if self.zone.is_line else rings


def on_ground(zones: Sequence[ZoneShape], captions: ZoneCaptions, frame_id: str) -> View:
    """Scene messages (time, number, payload) in metres, one for each frame."""
    instants = Instants(captions.t_ns, frame_id)
    for span, scene in instants.batches():
        frame = np.arange(span.stop - span.start)
        for place, zone in enumerate(zones):
            rings = zone.rings_m()
            if not rings:
                continue
            rgb = _LINE if zone.zone.is_line else _ZONE
            label = rings[0].mean(axis=0)
            texts = captions.texts[place][span]
            scene.zone(frame, zone.zone.name, rings, not zone.zone.is_line, label, texts, (*rgb, _ALPHA), zone.height_m)
        yield from instants.numbered(span, scene)


def on_pictures(
    zones: Sequence[ZoneShape],
    captions: ZoneCaptions,
    pictures: PictureTimes,
    planes: Planes,
    path: CameraPath | None,
    height_px: float,
) -> View:
    """Annotation messages (time, number, payload), one for each picture.

    ``planes`` are those of the pictures, ``path`` is how the camera moves; zones in pixels are those of its reference
    picture. ``height_px`` is the height of a picture.
    """
    for span, drawn in pictures.batches():
        t_ns = pictures.t_ns[span]
        taken: list[Floats] = []
        for place, zone in enumerate(zones):
            texts = np.array(captions.at(place, t_ns), object)
            down_px: float | None = None  # the same in all pictures of a batch, so that labels don't jump
            for frame, rings in _seen(zone, t_ns, planes, path, height_px):
                if _is_drawn(rings):
                    size, corner = _label_of(rings[0], height_px)
                    down_px = _free_place(taken, corner, size, texts[frame]) if down_px is None else down_px
                    _draw(drawn, frame, rings, zone, texts, height_px, corner + np.array([0.0, down_px]), size)
        yield from pictures.numbered(span, drawn)


def _seen(
    shape: ZoneShape, t_ns: Ints, planes: Planes, path: CameraPath | None, height_px: float
) -> Iterator[tuple[Ints, list[Floats]]]:
    """The rings of a zone in pictures: groups of pictures in which they are at the same place."""
    if shape.zone.units == "metres":
        for plane, held in by_plane(planes, t_ns):
            yield np.flatnonzero(held), [plane.metres_to_pixels(ring) for ring in shape.rings_m()]
        return
    rings = shape.rings_px(height_px)
    if path is None:
        yield np.arange(len(t_ns)), rings
        return
    for frame, at in enumerate(t_ns):
        points = (np.column_stack([ring, np.zeros_like(ring)]) for ring in rings)
        yield np.array([frame]), [path.to_pictures(some, np.repeat(at, len(some)))[:, :2] for some in points]


def _is_drawn(rings: Sequence[Floats]) -> bool:
    """Whether no part of a zone is behind the camera or far away."""
    points = np.concatenate(rings)
    return bool(np.isfinite(points).all() and (np.abs(points) <= _FAR_PX).all())


def _label_of(ring: Floats, height_px: float) -> tuple[float, Floats]:
    """The size of the label of a zone, and where it begins (2,)."""
    size = _TEXT_PX * max(1.0, height_px / 480)
    within = np.clip(ring, 0.0, [2 * height_px, height_px])
    return size, np.maximum(within.mean(axis=0) - [2.5 * size, 0.0], [2.0, size + 2.0])


def _free_place(taken: list[Floats], corner: Floats, size: float, texts: NDArray[Any]) -> float:
    """The distance in px by which a label is moved down, so that it doesn't cover others.

    ``taken`` has where these begin and their widths, (3,) each; those of this label are added.
    """
    width = _ASPECT * size * max(map(len, texts.tolist()), default=1)
    down, step = 0.0, _SPACING * size

    def is_hidden() -> bool:
        x, y = corner[0], corner[1] + down
        return any(abs(y - b) < step and x < a + wide and a < x + width for a, b, wide in taken)

    while is_hidden() and down < _MOST_DOWN * step:
        down += step
    taken.append(np.array([corner[0], corner[1] + down, width]))
    return down


def _draw(
    drawn: Annotations,
    frame: Ints,
    rings: Sequence[Floats],
    shape: ZoneShape,
    texts: NDArray[Any],
    height_px: float,
    corner: Floats,
    size: float,
) -> None:
    """Draw a zone in some pictures, with a label of this size that begins at ``corner`` (2,)."""
    count = len(frame)
    rgb = np.broadcast_to(_LINE if shape.zone.is_line else _ZONE, (count, 3))
    thickness = max(1.5, height_px / 240)
    alpha = np.full(count, _ALPHA)
    if shape.zone.is_line:
        pairs = np.concatenate([np.repeat(line, 2, axis=0)[1:-1] for line in rings])
        drawn.pairs(
            frame, np.broadcast_to(pairs, (count, *pairs.shape)), rgb, np.full(len(pairs) // 2, _ALPHA), thickness
        )
    fill = _FILL if len(rings) == 1 else 0.0
    for ring in () if shape.zone.is_line else rings:
        drawn.loops(frame, np.broadcast_to(ring, (count, *ring.shape)), rgb, alpha, thickness, fill)
    drawn.labels(frame, np.broadcast_to(corner, (count, 2)), texts[frame], rgb, size)


def _arrow(line: Floats, forward: int, size: float) -> list[Floats]:
    """An arrow from the middle of a line (P, 2) to its right, or to its left if ``forward`` is -1."""
    steps = np.diff(line, axis=0)
    lengths = np.hypot(*steps.T)
    edge = int(np.searchsorted(np.cumsum(lengths), lengths.sum() / 2))
    along = steps[edge] / lengths[edge]
    middle = line[edge] + along * (lengths.sum() / 2 - lengths[:edge].sum())
    ahead = forward * np.array([along[1], -along[0]])
    tip = middle + size * ahead
    wings = [tip - size / 3 * (ahead + side * along) for side in (1, -1)]
    return [np.array([middle, tip]), np.array([wings[0], tip, wings[1]])]
