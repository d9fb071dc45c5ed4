"""The people at the times of pictures: their positions, their trails, and their forecasts.

Letters: S people shown, N others, P points, F instants.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.foxglove import Cuboids
from mcaptrack.foxglove.views.styles import LIKELY
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.clocks import seconds_to_ns
from mcaptrack.geometry.mixtures import squared_radius
from mcaptrack.geometry.plane import GroundPlane, Planes
from mcaptrack.geometry.ragged import group_index, ragged_range, run_starts
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Rows
from mcaptrack.schema.as_rows import tails_of, to_scene
from mcaptrack.schema.classes import class_name
from mcaptrack.schema.framing import frame_times, has_any, join_frames, row_ends, unique_values
from mcaptrack.schema.resampling import interval_ns, resample

#: The duration of trails, and their number of lines.
_TRAIL_S: Final = 2.0
_TRAIL_LINES: Final = 4
_TICK_NS: Final = seconds_to_ns(_TRAIL_S / _TRAIL_LINES)
#: About how many people are computed with at once.
_PART_ROWS: Final = 2**14
#: About how many steps of forecasts are computed with at once.
_PART_STEPS: Final = 2**16
_MAX_GAP_S: Final = 2.0
#: The longest name of a class in a label.
_NAME_LENGTH: Final = 20
#: Forecasts are shown until the next ones are due.
_FORECAST_S: Final = 1.0
#: The largest number of points of the line of a forecast.
_FORECAST_POINTS: Final = 4


class People(NamedTuple):
    """S people at instants: ids, instants, boxes (S, 4) px, feet (S, 2) px, positions (S, 2) m, whether observed,
    labels (the ids, or texts with id and class), classes, and 3D boxes, NaN where there is none.
    """

    number: Ints
    frame: Ints
    box_px: Floats
    foot_px: Floats
    at_m: Floats
    observed: NDArray[np.bool_]
    label: NDArray[Any]
    class_id: Ints
    body: Cuboids

    def has_body(self) -> NDArray[np.bool_]:
        """Which people (S,) have a 3D box."""
        is_complete = np.isfinite(self.body.centre_m).all(axis=1) & np.isfinite(self.body.size_m).all(axis=1)
        return np.asarray(is_complete, np.bool_)


class Trails(NamedTuple):
    """Earlier positions of each of S people, as indices of people (S, P), oldest first.

    Only the last ``points`` (S,) of the P count; the very last is the current position.
    """

    row: Ints
    points: Ints


class ForecastPaths(NamedTuple):
    """N forecasts of equal length: index of the message, id, and the path (N, P, 2) m.

    ``end_m`` (N, 2) is the mean of the last step. ``spread_m2`` (N, 2, 2) are the squared half axes of the ellipse that
    holds it with the probability ``LIKELY``, as a covariance holds standard deviations; NaN if unknown.
    """

    message: Ints
    number: Ints
    path_m: Floats
    end_m: Floats
    spread_m2: Floats


def by_plane(planes: Planes, t_ns: Ints) -> Iterator[tuple[GroundPlane, NDArray[np.bool_]]]:
    """Each plane and the times (N,) at which it holds; the first plane holds from the beginning."""
    since = np.array([start for start, _ in planes[1:]], np.int64)
    which = np.searchsorted(since, t_ns, "right")
    for number in np.unique(which).tolist() if planes else []:
        yield planes[number][1], which == number


class PeopleInParts:
    """The people of a channel of tracks at rising times (F,), for some of the times at once.

    Missing pixels or metres are computed with the plane. ``classes`` are names of classes by number, which labels show
    if the channel has several classes and no 3D boxes. ``path`` is how the camera moves, if boxes are to be compensated
    for it.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        at_ns: Ints,
        planes: Planes,
        classes: Mapping[int, str] = {},
        path: CameraPath | None = None,
    ) -> None:
        self.at_ns, self._planes, self._path = at_ns, planes, path
        self._frames = to_scene(frames, path)
        self._usual_ns = interval_ns(frame_times(frames))
        has_several = len(unique_values(TRACKS, frames, "class_id")) > 1
        is_solid = has_any(TRACKS, frames, lambda rows: np.isfinite(rows["z_m"]))
        self._names = classes if has_several and not is_solid else None
        total = int(row_ends(frames)[-1])
        self._each = max(total / max(len(frames), 1), total / max(len(at_ns), 1))
        self._last: tuple[int, People] | None = None

    def parts(self, batch: int) -> Iterator[tuple[int, int, People]]:
        """Yield parts of the times, each a multiple of ``batch``: first, last, and the people at these times.

        The people at earlier times that trails need are included. ``People.frame`` are
        indices of all times.
        """
        length = max(round(_PART_ROWS / max(self._each, 1e-9) / batch), 1) * batch
        for first in range(0, len(self.at_ns), length):
            last = min(first + length, len(self.at_ns))
            if self._last is None or self._last[0] != first:
                self._last = first, self._between(first, last)
            yield first, last, self._last[1]

    def _between(self, first: int, last: int) -> People:
        # Trails begin at the first position in a tick of their clock.
        since_ns = (int(self.at_ns[first]) - seconds_to_ns(_TRAIL_S)) // _TICK_NS * _TICK_NS
        low = int(np.searchsorted(self.at_ns, since_ns, "left"))
        at_ns = self.at_ns[low:last]
        rows, frame = resample(self._frames, at_ns, seconds_to_ns(_MAX_GAP_S), self._usual_ns)
        people = _people(rows, frame, at_ns, self._planes, self._names, self._path)
        return people._replace(frame=people.frame + low)


def _people(
    rows: Rows, frame: Ints, at_ns: Ints, planes: Planes, classes: Mapping[int, str] | None, path: CameraPath | None
) -> People:
    """The people of rows (S,) at the times ``frame`` (S,); labels show classes unless their names are None."""
    box = columns_to_boxes(rows)
    box = box if path is None else path.to_pictures(box, at_ns[frame])
    at_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
    foot = box[:, :2] + box[:, 2:] * [0.5, 1.0]
    for plane, held in by_plane(planes, at_ns[frame]):
        if plane.point == "center":
            foot[held] = (box[:, :2] + box[:, 2:] / 2)[held]
        unknown = held & np.isnan(at_m).any(axis=1) & np.isfinite(box).all(axis=1)
        at_m[unknown] = plane.boxes_to_metres(box[unknown])
        unknown = held & np.isnan(foot).any(axis=1) & np.isfinite(at_m).all(axis=1)
        foot[unknown] = plane.metres_to_pixels(at_m[unknown])
    number, class_id = rows["track_id"].astype(np.int64), rows["class_id"].astype(np.int64)
    label, observed = labels_of(number, class_id, classes), np.array(rows["observed"], bool)
    return People(number, frame, box, foot, at_m, observed, label, class_id, bodies_of(rows))


def bodies_of(rows: Rows) -> Cuboids:
    """The 3D boxes of tracks (S,); an unknown heading is drawn along the first axis."""
    centre, size = (
        np.stack([rows[name] for name in names], axis=-1)
        for names in (("x_m", "y_m", "z_m"), ("length_m", "width_m", "height_m"))
    )
    return Cuboids(centre, size, np.nan_to_num(rows["heading_rad"]))


def base_heights(tracks: Sequence[Frame], made_ns: Ints, number: Ints) -> Floats:
    """The heights (N,) of the bottoms of the 3D boxes of tracks at times (N,) in ns; NaN for tracks without any.

    They are those of the row before, or of the first row of a track that begins later.
    """
    joined = join_frames(TRACKS, tracks)
    base = bodies_of(joined.rows).base_m()
    has_height = np.isfinite(base)
    base, t_ns, of = base[has_height], joined.row_ns[has_height], joined.rows["track_id"][has_height].astype(np.int64)
    order = np.lexsort((t_ns, of))
    base, t_ns, of = base[order], t_ns[order], of[order]
    out = np.full(len(number), np.nan)
    for track_id in np.intersect1d(number, of).tolist():
        low, high = np.searchsorted(of, [track_id, track_id + 1])
        wanted = number == track_id
        before = np.searchsorted(t_ns[low:high], made_ns[wanted], "right") - 1
        out[wanted] = base[low + np.maximum(before, 0)]
    return out


def labels_of(number: Ints, class_id: Ints, names: Mapping[int, str] | None) -> NDArray[Any]:
    """The labels (S,) of people: ids, and the class unless ``names`` is None."""
    if not len(number) or names is None:
        return number
    pairs, which = np.unique(np.stack([number, class_id]), axis=1, return_inverse=True)
    called = {kind: _shortened(class_name(kind, names), _NAME_LENGTH) for kind in np.unique(class_id).tolist()}
    return np.array([f"{person} {called[of]}" for person, of in pairs.T.tolist()])[which.reshape(-1)]


def _shortened(text: str, length: int) -> str:
    """A text of at most so many characters."""
    return text if len(text) <= length else text[: length - 1] + "\N{HORIZONTAL ELLIPSIS}"


def trails(people: People, has_place: NDArray[np.bool_], at_ns: Ints) -> Trails:
    """The trails of people that have a place by ``has_place`` (S,); trails do not pass unknown places.

    Their points are at the ticks of a slow clock, the same ones in picture after picture: so trails don't move, and a
    compressed log hardly grows by them.
    """
    t_ns = at_ns[people.frame]
    order = np.lexsort((t_ns, people.number))
    order = order[has_place[order]]
    number, t_sorted = people.number[order], t_ns[order]
    tick = t_sorted // _TICK_NS
    is_anchor = run_starts(number, tick)
    anchor = np.flatnonzero(is_anchor)
    before: Ints = np.cumsum(is_anchor) - is_anchor  # the number of earlier anchors
    wanted = before[:, None] - np.arange(_TRAIL_LINES, 0, -1)
    picked = anchor[np.maximum(wanted, 0)] if len(anchor) else np.empty((0, _TRAIL_LINES), np.int64)
    own = (wanted >= 0) & (number[picked] == number[:, None])
    own &= t_sorted[:, None] - t_sorted[picked] <= seconds_to_ns(_TRAIL_S)
    row = np.full((len(people.number), _TRAIL_LINES + 1), -1, np.int64)
    row[order, :-1], row[order, -1] = order[picked], order
    count = np.zeros(len(people.number), np.int64)
    count[order] = own.sum(axis=1) + 1
    return Trails(row, count)


def by_count(count: Ints) -> Iterator[tuple[int, Ints]]:
    """Each number of points that occurs, and the indices of the trails that have it."""
    for points in np.unique(count).tolist():
        yield points, np.flatnonzero(count == points)


def forecasts(frames: Sequence[Frame], first: int = 0, last: int | None = None) -> Iterator[ForecastPaths]:
    """The forecasts in messages ``first`` to before ``last`` of a channel of predictions, for each number of steps."""
    rows, within, _, _ = join_frames(PREDICTIONS, frames, first, last)
    message = within + first
    order = np.lexsort((rows["step"], rows["track_id"], message))
    rows, message = rows[order], message[order]
    number = rows["track_id"].astype(np.int64)
    start = np.flatnonzero(run_starts(message, number))
    steps = np.diff(np.append(start, len(rows)))
    xy = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
    for count, chosen in by_count(steps):
        begin, end = start[chosen], start[chosen] + count - 1
        shown = np.unique(np.linspace(0, count - 1, min(count, _FORECAST_POINTS)).round().astype(np.int64))
        names = ("cov_xx_m2", "cov_xy_m2", "cov_xy_m2", "cov_yy_m2")
        spread = np.stack([rows[name][end] for name in names], axis=-1).reshape(-1, 2, 2)
        spread *= squared_radius(LIKELY, tails_of(rows[end]))[:, None, None]
        yield ForecastPaths(message[begin], number[begin], xy[begin[:, None] + shown], xy[end], spread)


def forecasts_in_parts(
    frames: Sequence[Frame], wanted: Ints, batch: int, is_whole: bool = False
) -> Iterator[tuple[int, int, list[ForecastPaths]]]:
    """Parts of F instants, as long as ``batch`` or a multiple: their first and last, and the forecasts shown at them.

    ``wanted`` (F,) is the message that is shown at each instant, -1 for none. With ``is_whole`` there is one part.
    """
    each = int(row_ends(frames)[-1]) / max(len(wanted), 1)
    length = max(round(_PART_STEPS / max(each, 1e-9) / batch), 1) * batch
    length = max(len(wanted), 1) if is_whole else length
    for first in range(0, len(wanted), length):
        last = min(first + length, len(wanted))
        shown = wanted[first:last][wanted[first:last] >= 0]
        span = (int(shown.min()), int(shown.max()) + 1) if len(shown) else (0, 0)
        span = (0, len(frames)) if is_whole else span
        yield first, last, list(forecasts(frames, *span))


def latest(frames: Sequence[Frame], at_ns: Ints) -> Ints:
    """The index of the message with the forecasts shown at each time (F,); -1 for none."""
    made_ns = frame_times(frames)
    number = np.searchsorted(made_ns, at_ns, "right") - 1
    if len(made_ns):
        number[at_ns - made_ns[number] > seconds_to_ns(_FORECAST_S)] = -1
    return number


def shown_at(message: Ints, wanted: Ints) -> tuple[Ints, Ints]:
    """Of objects that belong to messages (N,), rising: the indices of those shown at F instants, and their instants.

    ``wanted`` (F,) is the message that is shown at each instant, -1 for none.
    """
    low, high = np.searchsorted(message, wanted, "left"), np.searchsorted(message, wanted, "right")
    count = np.where(wanted < 0, 0, high - low)
    return ragged_range(low, count), group_index(count)


def segments(points: Floats, drawn: float = 1.0) -> Floats:
    """The lines between points (N, P, D) as pairs of ends (N, 2 (P - 1), D); the first share ``drawn`` of each."""
    start = points[:, :-1]
    end = start + drawn * (points[:, 1:] - start)
    return np.stack([start, end], axis=2).reshape(len(points), -1, points.shape[2])


def ellipses(spread_m2: Floats) -> tuple[Floats, Floats]:
    """Half axes (N, 2), the longer first, and turns (N,) of ellipses, by their squares (N, 2, 2).

    NaN where these are not known or not positive.
    """
    is_positive = np.asarray(np.isfinite(spread_m2).all(axis=(1, 2)), np.bool_)
    values, vectors = np.linalg.eigh(np.where(is_positive[:, None, None], spread_m2, np.eye(2)))
    is_positive &= values[:, 0] >= -1e-9 * np.abs(values[:, 1])
    half = np.sqrt(np.maximum(values[:, ::-1], 0))
    turn = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
    turn = np.where(turn > np.pi / 2, turn - np.pi, np.where(turn <= -np.pi / 2, turn + np.pi, turn))
    return np.where(is_positive[:, None], half, np.nan), np.where(is_positive, turn, np.nan)


def ellipse_points(centre_m: Floats, half_m: Floats, turn: Floats, points: int) -> Floats:
    """Points (N, P, 2) on ellipses, evenly from the end of the longer half axis on."""
    angle = 2 * np.pi * np.arange(points) / points
    along, across = np.cos(angle) * half_m[:, :1], np.sin(angle) * half_m[:, 1:]
    cosine, sine = np.cos(turn)[:, None], np.sin(turn)[:, None]
    return centre_m[:, None] + np.stack([along * cosine - across * sine, along * sine + across * cosine], axis=-1)
