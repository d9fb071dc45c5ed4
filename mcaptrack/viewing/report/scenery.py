"""Tracks over the picture of their scene, or on the plain ground where there is none.

Letters: P points.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.foxglove.colours import COUNT as COLOURS
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import Frame, Rows
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import encode_image
from mcaptrack.viewing.report.charts import round_step
from mcaptrack.viewing.report.markup import Markup, data_uri, number, tag
from mcaptrack.viewing.report.measures import by_track

#: The picture is made of so many, from the beginning to the end, so that those who walk vanish from it.
_PICTURES: Final = 9
_WIDTH_PX: Final = 800
_QUALITY: Final = 72
#: A panel shows no more points than this, so that the page stays small.
_MOST_POINTS: Final = 6000
_MARGIN: Final = 14
#: Where there are more lines than this, they don't say whose they are.
_MOST_NAMED: Final = 600
#: The ground is shown no wider and no higher than this.
_GROUND: Final = (460, 520)


class Backdrop(NamedTuple):
    """What tracks are drawn on: a picture in JPEG, or nothing; ``scale`` brings its pixels to this size."""

    jpeg: bytes
    width: int
    height: int
    scale: float


def backdrop(pictures: Pictures) -> Backdrop | None:
    """The scene without those who move; None without pictures. Raises McaptrackError for damaged ones."""
    import cv2

    count = len(pictures.t_ns)
    numbers = np.unique(np.linspace(0, count - 1, min(count, _PICTURES)).round().astype(int)).tolist() if count else []
    seen: list[NDArray[np.uint8]] = []
    scale = 1.0
    for frame in pictures.frames(numbers):
        high, wide = frame.rows.shape[:2]
        scale = min(1.0, _WIDTH_PX / wide) if not seen else scale
        size = (max(1, round(wide * scale)), max(1, round(high * scale)))
        small = np.asarray(cv2.resize(frame.rows, size, interpolation=cv2.INTER_AREA), np.uint8)
        if not seen or small.shape == seen[0].shape:
            seen.append(small)
    if not seen:
        return None
    still = np.median(np.stack(seen), axis=0)
    # Without colour and with less contrast: what is coloured are the tracks.
    grey = 0.55 * (still @ [0.114, 0.587, 0.299]) + 70
    image = np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=2)
    return Backdrop(encode_image(image, "jpeg", _QUALITY), image.shape[1], image.shape[0], scale)


def pixel_paths(frames: Sequence[Frame], plane: GroundPlane | None) -> list[tuple[int, Floats, tuple[float, float]]]:
    """Where people stand in the picture: id, points (P, 2) in pixels, and from when to when in seconds of the log."""

    def feet(rows: Rows) -> Floats:
        boxes = columns_to_boxes(rows)
        at = boxes[:, :2] + boxes[:, 2:] * [0.5, 0.5 if plane and plane.point == "center" else 1.0]
        unseen = ~np.isfinite(at).all(axis=1)
        if plane is not None and unseen.any():
            at[unseen] = plane.metres_to_pixels(np.stack([rows["x_m"], rows["y_m"]], axis=-1)[unseen])
        return at

    rows, t_ns = by_track(frames)
    return _split(rows, t_ns, feet(rows))


def ground_paths(frames: Sequence[Frame]) -> list[tuple[int, Floats, tuple[float, float]]]:
    """The same on the ground, in metres."""
    rows, t_ns = by_track(frames)
    return _split(rows, t_ns, np.stack([rows["x_m"], rows["y_m"]], axis=-1))


def _split(rows: Rows, t_ns: NDArray[np.int64], at: Floats) -> list[tuple[int, Floats, tuple[float, float]]]:
    known = np.isfinite(at).all(axis=1)
    rows, t_ns, at = rows[known], t_ns[known], at[known]
    bounds = [0, *(np.flatnonzero(np.diff(rows["track_id"])) + 1).tolist(), len(rows)] if len(rows) else []
    spans = itertools.pairwise(bounds)
    return [(int(rows["track_id"][a]), at[a:b], (t_ns[a] / NS_PER_S, t_ns[b - 1] / NS_PER_S)) for a, b in spans]


def simplified(paths: Sequence[Floats], tolerance: float) -> list[Floats]:
    """Lines with fewer points that stay within ``tolerance``, or more where there would still be too many points."""
    while True:
        out = [_simplified(path, tolerance) for path in paths]
        if sum(map(len, out)) <= max(_MOST_POINTS, 2 * len(paths)) or tolerance > 1e4:
            return out
        tolerance *= 1.5


def _simplified(path: Floats, tolerance: float) -> Floats:
    import cv2

    kept = cv2.approxPolyDP(path.astype(np.float32)[:, None], tolerance, False)[:, 0].astype(np.float64)
    # A line that comes back to where it began is taken for one that is closed.
    return kept if (kept[-1] == path[-1].astype(np.float32)).all() else np.concatenate([kept, path[-1:]])


def scene_panel(
    title: str,
    paths: Sequence[tuple[int, Floats, tuple[float, float]]],
    behind: Backdrop,
    start_s: float,
    shared: str,
    holds_picture: bool,
) -> Markup:
    """Tracks over the picture. The first panel of a log holds the picture, others of the same ``shared`` id use it."""
    box = f"0 0 {behind.width} {behind.height}"
    picture = tag("use", href=f"#{shared}")
    if holds_picture:
        uri = data_uri(behind.jpeg)
        picture = tag("image", href=uri, width=behind.width, height=behind.height, id=shared)
    low, high = np.array([-0.5, -0.5]) * behind.width, np.array([1.5, 1.5]) * behind.width
    points = [np.clip(path * behind.scale, low, high) for _, path, _ in paths]
    lines = _lines(paths, simplified(points, 1.0), start_s)
    return tag("svg", tag("title", title), picture, *lines, viewBox=box, role="img", class_="scene")


def ground_panel(
    title: str,
    paths: Sequence[tuple[int, Floats, tuple[float, float]]],
    span: tuple[Floats, Floats],
    start_s: float,
) -> Markup:
    """Tracks on the ground from ``span``'s lower to its upper corner in metres, the second axis up."""
    low, high = span
    size = np.maximum(high - low, 1e-6)
    scale = float(((np.array(_GROUND) - 2 * _MARGIN) / size).min())
    width, height = (size * scale + 2 * _MARGIN).round().astype(int).tolist()
    points = [(path - low) * [scale, -scale] + [_MARGIN, height - _MARGIN] for _, path, _ in paths]
    bar_m = round_step(float(size.max()) / 6)
    bar = tag("line", x1=_MARGIN, x2=f"{_MARGIN + bar_m * scale:.1f}", y1=height + 8, y2=height + 8, class_="axis")
    label = tag("text", f"{bar_m:g} m", x=f"{_MARGIN + bar_m * scale + 6:.1f}", y=height + 12)
    frame = tag("rect", x=0, y=0, width=width, height=height, class_="ground")
    lines = _lines(
        paths,
        simplified(points, 0.5),
        start_s,
    )
    box = f"0 0 {_GROUND[0]} {height + 18}"
    return tag("svg", tag("title", title), frame, *lines, bar, label, viewBox=box, role="img", class_="chart")


def ground_span(all_paths: Sequence[Floats]) -> tuple[Floats, Floats]:
    """The corners of the ground on which nearly all points lie."""
    points = np.concatenate([np.zeros((0, 2)), *all_paths])
    if not len(points):
        return np.zeros(2), np.ones(2)
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    return low, np.maximum(high, low + 1e-3)


def _lines(
    paths: Sequence[tuple[int, Floats, tuple[float, float]]], drawn: Sequence[Floats], start_s: float
) -> list[Markup]:
    """All lines dark first, so that light and dark colours are seen on any ground; then each in its colour."""
    under, over = [], []
    by_colour: dict[int, list[str]] = {}
    for (who, _, (first, last)), points in zip(paths, drawn, strict=True):
        at = np.rint(points).astype(int)
        kept = at[np.append(True, (np.diff(at, axis=0) != 0).any(axis=1))]
        steps = np.diff(kept, axis=0, prepend=kept[:1] * 0).tolist()
        way = "M" + "l".join(f"{x} {y}" for x, y in steps) + ("h0" if len(steps) == 1 else "")
        seconds = f"{number(first - start_s, 1)} to {number(last - start_s, 1, 's')}"
        under.append(way)
        by_colour.setdefault(who % COLOURS, []).append(way)
        over.append(tag("path", tag("title", f"{who}: {seconds}"), d=way, class_=f"c{who % COLOURS}"))
    if len(over) > _MOST_NAMED:
        over = [tag("path", d="".join(ways), class_=f"c{k}") for k, ways in sorted(by_colour.items())]
    return [tag("path", d="".join(under), class_="halo"), tag("g", *over, class_="paths")]
