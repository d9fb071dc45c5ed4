"""Tracks over a picture of their scene, or on the plain ground if there is none, as coordinates for the templates.

Letters: P points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.evaluation.occupancy import occupancy
from mcaptrack.extensions.report.statistics import rows_by_track
from mcaptrack.foxglove.palette import COUNT as COLOURS
from mcaptrack.foxglove.views.people import ellipse_points, ellipses
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.geometry.ragged import run_ends, run_starts
from mcaptrack.schema import Frame, Rows
from mcaptrack.viewing.charts import round_step
from mcaptrack.viewing.formatting import number
from mcaptrack.viewing.painting import SceneBackground

#: The largest number of points of a map, so that the page stays small.
_MAX_POINTS: Final = 6000
_MARGIN: Final = 14
#: Above this number of tracks, lines are joined by colour and do not name their track.
_MAX_NAMED: Final = 600
#: The largest width and height of a map of the ground, and the room for the labels of its axes.
_GROUND: Final = (460, 520)
_AXIS_PX: Final = 34
#: The time before a forecast from which its track is drawn.
_PAST_S: Final = 4.0
#: The squared size of an ellipse that holds half of a normal distribution, in standard deviations.
_HALF: Final = 2 * np.log(2)
#: The colour of a heat map, red, green and blue.
_HEAT: Final = (224, 84, 0)


class TrackPath(NamedTuple):
    """The path of a track: points (P, 2) in pixels or metres, and the log times in s of the first and the last."""

    track_id: int
    points: Floats
    first_s: float
    last_s: float


def forecast_map(
    forecasts: Rows,
    past: Sequence[Frame],
    future: Sequence[Frame],
    t_ns: int,
    behind: SceneBackground,
    plane: GroundPlane,
) -> dict[str, Any]:
    """The values of a map over a picture: where tracks came from, where they are expected, and where people went.

    ``forecasts`` are those of one time, ``past`` the tracks, ``future`` the ground truth, if there is any.
    """

    def way(points_m: Floats) -> str:
        px = plane.metres_to_pixels(np.asarray(points_m, np.float64)) * behind.scale
        px = px[np.isfinite(px).all(axis=1)]
        return _way(np.clip(px, -behind.width, 2 * behind.width)) if len(px) else ""

    def walked(frames: Sequence[Frame], first_ns: int, last_ns: int) -> dict[int, Floats]:
        rows, at_ns = rows_by_track([frame for frame in frames if first_ns <= frame.t_ns <= last_ns])
        del at_ns
        return {
            int(track): np.stack([own["x_m"], own["y_m"]], axis=-1)
            for track in np.unique(rows["track_id"])
            if np.isfinite((own := rows[rows["track_id"] == track])["x_m"]).all()
        }

    ahead_ns = seconds_to_ns(float(forecasts["ahead_s"].max()))
    before = walked(past, t_ns - seconds_to_ns(_PAST_S), t_ns)
    tracks = []
    for track in np.unique(forecasts["track_id"]).tolist():
        rows = forecasts[forecasts["track_id"] == track]
        rows = rows[np.argsort(rows["step"])]
        mean_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
        last = rows[-1]
        spread = np.array([[[last["cov_xx_m2"], last["cov_xy_m2"]], [last["cov_xy_m2"], last["cov_yy_m2"]]]])
        outline = ellipse_points(mean_m[-1:], *ellipses(_HALF * spread), 32)[0]
        start = before.get(track, np.empty((0, 2)))
        tracks.append(
            {
                "id": track,
                "colour": track % COLOURS,
                "past": way(start),
                "ahead": way(np.concatenate([start[-1:], mean_m])),
                "outline": way(outline) if np.isfinite(outline).all() else "",
            }
        )
    went = walked(future, t_ns, t_ns + ahead_ns)
    return {
        "width": behind.width,
        "height": behind.height,
        "jpeg": behind.jpeg,
        "tracks": tracks,
        "future": "".join(way(points) for points in went.values()),
        "ahead": number(ahead_ns / NS_PER_S, 1, "s"),
    }


def pixel_paths(frames: Sequence[Frame], plane: GroundPlane | None) -> list[TrackPath]:
    """The paths of tracks in the picture: the points of their boxes that touch the ground, in pixels."""
    rows, t_ns = rows_by_track(frames)
    boxes = columns_to_boxes(rows)
    at = boxes[:, :2] + boxes[:, 2:] * [0.5, 0.5 if plane and plane.point == "center" else 1.0]
    unseen = ~np.isfinite(at).all(axis=1)
    if plane is not None and unseen.any():
        at[unseen] = plane.metres_to_pixels(np.stack([rows["x_m"], rows["y_m"]], axis=-1)[unseen])
    return _split(rows, t_ns, at)


def ground_paths(frames: Sequence[Frame]) -> list[TrackPath]:
    """The paths of tracks on the ground, in metres."""
    rows, t_ns = rows_by_track(frames)
    return _split(rows, t_ns, np.stack([rows["x_m"], rows["y_m"]], axis=-1))


def _split(rows: Rows, t_ns: Ints, at: Floats) -> list[TrackPath]:
    has_place = np.isfinite(at).all(axis=1)
    rows, t_ns, at = rows[has_place], t_ns[has_place], at[has_place]
    starts = run_starts(rows["track_id"])
    spans = zip(np.flatnonzero(starts).tolist(), np.flatnonzero(run_ends(starts)).tolist(), strict=True)
    return [
        TrackPath(int(rows["track_id"][a]), at[a : b + 1], t_ns[a] / NS_PER_S, t_ns[b] / NS_PER_S) for a, b in spans
    ]


def simplified(paths: Sequence[Floats], tolerance: float) -> list[Floats]:
    """Paths with fewer points, within ``tolerance`` of the given ones, or more if there are still too many points."""
    while True:
        out = [_simplified(path, tolerance) for path in paths]
        if sum(map(len, out)) <= max(_MAX_POINTS, 2 * len(paths)) or tolerance > 1e4:
            return out
        tolerance *= 1.5


def _simplified(path: Floats, tolerance: float) -> Floats:
    import cv2

    kept = cv2.approxPolyDP(path.astype(np.float32)[:, None], tolerance, False)[:, 0].astype(np.float64)
    # OpenCV takes a line that returns to its start for a closed one, and drops the last point.
    return kept if (kept[-1] == path[-1].astype(np.float32)).all() else np.concatenate([kept, path[-1:]])


def picture_map(paths: Sequence[TrackPath], behind: SceneBackground, start_s: float) -> dict[str, Any]:
    """The values of a map over the picture."""
    low, high = np.array([-0.5, -0.5]) * behind.width, np.array([1.5, 1.5]) * behind.width
    points = [np.clip(path.points * behind.scale, low, high) for path in paths]
    return {"width": behind.width, "height": behind.height, **_lines(paths, simplified(points, 1.0), start_s)}


def ground_map(paths: Sequence[TrackPath], span: tuple[Floats, Floats], start_s: float) -> dict[str, Any]:
    """The values of a map of the ground between two corners in metres; the second axis points up."""
    low, high = span
    size = np.maximum(high - low, 1e-6)
    scale = float(((np.array(_GROUND) - 2 * _MARGIN) / size).min())
    width, height = (size * scale + 2 * _MARGIN).round().astype(int).tolist()
    far = 3 * max(_GROUND)  # what is farther away is outside of the panel all the same
    points = [np.clip((path.points - low) * [scale, -scale] + [_MARGIN, height - _MARGIN], -far, far) for path in paths]
    outside = sum(bool(((at < 0) | (at > [width, height])).any()) for at in points)
    bar_m = round_step(float(size.max()) / 6)
    return {
        "width": width, "height": height, "view_width": _GROUND[0], "left": _MARGIN, "outside": outside,
        "bar_end": f"{_MARGIN + bar_m * scale:.1f}", "bar_label": f"{bar_m:g} m",
        "scale": f"{low[0] - _MARGIN / scale:.6g} {low[1] - (_MARGIN) / scale:.6g} {1 / scale:.6g}",
        **_lines(paths, simplified(points, 0.5), start_s),
    }  # fmt: skip


def heat_map(frames: Sequence[Frame]) -> dict[str, Any] | None:
    """The values of a map of the time that people spent in each cell of the ground; None without positions in metres.

    The picture has one pixel for each cell and is the more opaque, the longer; the square root shows short stays, too.
    """
    import cv2

    rows, t_ns = rows_by_track(frames)
    stays = occupancy(t_ns, rows["track_id"], np.stack([rows["x_m"], rows["y_m"]], axis=-1))
    most = float(stays.person_s.max(initial=0.0))
    if most <= 0:
        return None
    high, wide = stays.person_s.shape
    picture = np.empty((high, wide, 4), np.uint8)
    picture[..., :3] = _HEAT[::-1]
    picture[..., 3] = np.rint(255 * np.sqrt(stays.person_s[::-1] / most)).astype(np.uint8)
    low_m, size_m = np.array(stays.low_m), np.array([wide, high]) * stays.cell_m
    room = np.array([_GROUND[0] - _AXIS_PX, _GROUND[1] - _AXIS_PX])
    scale = float((room / size_m).min())
    width, height = (size_m * scale).round(1).tolist()
    step = round_step(float(size_m.max()) / 6)
    ticks = [
        np.arange(np.ceil(low / step), np.floor((low + size) / step) + 1) * step
        for low, size in zip(low_m, size_m, strict=True)
    ]
    return {
        "png": cv2.imencode(".png", picture)[1].tobytes(),
        "left": _AXIS_PX, "width": width, "height": height, "view_width": _GROUND[0], "view_height": round(height + 34),
        "x_ticks": [(f"{_AXIS_PX + (at - low_m[0]) * scale:.1f}", f"{at:g}") for at in ticks[0].tolist()],
        "y_ticks": [(f"{height - (at - low_m[1]) * scale:.1f}", f"{at:g}") for at in ticks[1].tolist()],
        "most": number(most, 0 if most >= 10 else 1, "s"), "cell": number(stays.cell_m, 2, "m"),
        "total": number(float(stays.person_s.sum()) / 60, 1, "min"),
    }  # fmt: skip


def ground_span(all_points: Sequence[Floats]) -> tuple[Floats, Floats]:
    """The corners of the ground that hold nearly all points."""
    points = np.concatenate([np.zeros((0, 2)), *all_points])
    if not len(points):
        return np.zeros(2), np.ones(2)
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    return low, np.maximum(high, low + 1e-3)


def _lines(paths: Sequence[TrackPath], drawn: Sequence[Floats], start_s: float) -> dict[str, Any]:
    """``halo``: all lines as one, drawn dark below the others, so that any colour is seen on any ground; ``tracks``."""
    ways = [_way(points) for points in drawn]
    tracks = []
    if len(paths) > _MAX_NAMED:
        colours = [path.track_id % COLOURS for path in paths]
        for colour in sorted(set(colours)):
            joined = "".join(way for way, own in zip(ways, colours, strict=True) if own == colour)
            tracks.append({"way": joined, "colour": colour, "title": "", "id": None})
    else:
        for path, way in zip(paths, ways, strict=True):
            seconds = f"{number(path.first_s - start_s, 1)} to {number(path.last_s - start_s, 1, 's')}"
            colour = path.track_id % COLOURS
            tracks.append({"way": way, "colour": colour, "title": f"{path.track_id}: {seconds}", "id": path.track_id})
    return {"halo": "".join(ways), "tracks": tracks}


def _way(points: Floats) -> str:
    """The data of an SVG path through points (P, 2), rounded to whole pixels."""
    at = np.rint(points).astype(int)
    kept = at[np.append(True, (np.diff(at, axis=0) != 0).any(axis=1))]
    steps = np.diff(kept, axis=0, prepend=kept[:1] * 0).tolist()
    return "M" + "l".join(f"{x} {y}" for x, y in steps) + ("h0" if len(steps) == 1 else "")
