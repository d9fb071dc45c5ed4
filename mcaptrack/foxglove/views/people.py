"""Who is where at the times of the pictures, where they were, and where they are expected.

Letters: S people shown, N others, P points, F instants.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import seconds_to_ns
from mcaptrack.geometry.plane import GroundPlane, Planes
from mcaptrack.schema import PREDICTIONS, Frame
from mcaptrack.schema.resampling import resample

#: How far trails go back, and how many lines they are made of.
_TRAIL_S: Final = 2.0
_TRAIL_LINES: Final = 4
_MAX_GAP_S: Final = 2.0
#: Forecasts are shown until the next ones are due.
_FORECAST_S: Final = 1.0
#: Forecasts are lines through at most so many of their points.
_FORECAST_POINTS: Final = 5
#: The 95 % quantile of the chi-squared distribution with two degrees of freedom: how many (squared) deviations an
#: ellipse has to be wide to hold 95 %.
CHI2_95: Final = 5.991464547107979


class People(NamedTuple):
    """S people at instants: numbers, instants, boxes (S, 4) px, feet (S, 2) px, places (S, 2) m, and whether seen."""

    number: Ints
    frame: Ints
    box_px: Floats
    foot_px: Floats
    at_m: Floats
    seen: NDArray[np.bool_]


class Trails(NamedTuple):
    """Where each of S people was before: rows of their own, (S, P), oldest first.

    Only the last ``points`` (S,) of the P count; the very last is where they are.
    """

    row: Ints
    points: Ints


class Forecasts(NamedTuple):
    """N futures that are equally long: the message that each is from, whose, and the path (N, P, 2) m.

    ``end_m`` (N, 2) and ``spread_m2`` (N, 2, 2) are mean and covariance of the last step, NaN where unknown.
    """

    message: Ints
    number: Ints
    path_m: Floats
    end_m: Floats
    spread_m2: Floats


def by_plane(planes: Planes, t_ns: Ints) -> Iterator[tuple[GroundPlane, NDArray[np.bool_]]]:
    """Each plane with which of the times (N,) it holds at; the first holds from the beginning."""
    since = np.array([start for start, _ in planes[1:]], np.int64)
    which = np.searchsorted(since, t_ns, "right")
    for number in np.unique(which).tolist() if planes else []:
        yield planes[number][1], which == number


def people_at(frames: Sequence[Frame], at_ns: Ints, planes: Planes) -> People:
    """The people of a channel of tracks at rising times; what only pixels or metres tell comes by the plane."""
    rows, frame = resample(frames, at_ns, seconds_to_ns(_MAX_GAP_S))
    box = columns_to_boxes(rows)
    at_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
    foot = box[:, :2] + box[:, 2:] * [0.5, 1.0]
    for plane, held in by_plane(planes, at_ns[frame]):
        if plane.point == "center":
            foot[held] = (box[:, :2] + box[:, 2:] / 2)[held]
        unknown = held & np.isnan(at_m).any(axis=1) & np.isfinite(box).all(axis=1)
        at_m[unknown] = plane.boxes_to_metres(box[unknown])
        unknown = held & np.isnan(foot).any(axis=1) & np.isfinite(at_m).all(axis=1)
        foot[unknown] = plane.metres_to_pixels(at_m[unknown])
    return People(rows["track_id"].astype(np.int64), frame, box, foot, at_m, np.array(rows["observed"], bool))


def trails(people: People, known: NDArray[np.bool_], at_ns: Ints) -> Trails:
    """The trails of those whose place is ``known`` (S,); nobody has one through a place that is not.

    Their points are where somebody was at the ticks of a slow clock: the same ones in picture after picture, so that
    trails stand still and a log that is compressed hardly grows by them.
    """
    t_ns = at_ns[people.frame]
    order = np.lexsort((t_ns, people.number))
    order = order[known[order]]
    number, t_sorted = people.number[order], t_ns[order]
    tick = t_sorted // seconds_to_ns(_TRAIL_S / _TRAIL_LINES)
    is_anchor = np.ones(len(order), bool)
    is_anchor[1:] = (number[1:] != number[:-1]) | (tick[1:] != tick[:-1])
    anchor = np.flatnonzero(is_anchor)
    before = np.cumsum(is_anchor) - is_anchor  # how many anchors lie before each
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
    """Each number of points that there is, and whose trails have it."""
    for points in np.unique(count).tolist():
        yield points, np.flatnonzero(count == points)


def forecasts(frames: Sequence[Frame]) -> Iterator[Forecasts]:
    """The futures in a channel of predictions, for each number of steps that they have."""
    rows = PREDICTIONS.joined([frame.rows for frame in frames])
    message = np.repeat(np.arange(len(frames)), [len(frame.rows) for frame in frames])
    order = np.lexsort((rows["step"], rows["track_id"], message))
    rows, message = rows[order], message[order]
    number = rows["track_id"].astype(np.int64)
    is_first = np.ones(len(rows), bool)
    is_first[1:] = (message[1:] != message[:-1]) | (number[1:] != number[:-1])
    start = np.flatnonzero(is_first)
    steps = np.diff(np.append(start, len(rows)))
    xy = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
    for count, chosen in by_count(steps):
        first, last = start[chosen], start[chosen] + count - 1
        shown = np.unique(np.linspace(0, count - 1, min(count, _FORECAST_POINTS)).round().astype(np.int64))
        names = ("cov_xx_m2", "cov_xy_m2", "cov_xy_m2", "cov_yy_m2")
        spread = np.stack([rows[name][last] for name in names], axis=-1).reshape(-1, 2, 2)
        yield Forecasts(message[first], number[first], xy[first[:, None] + shown], xy[last], spread)


def latest(frames: Sequence[Frame], at_ns: Ints) -> Ints:
    """The number of the message whose forecasts are shown at each time (F,); -1 where none are."""
    made_ns = np.array([frame.t_ns for frame in frames], np.int64)
    number = np.searchsorted(made_ns, at_ns, "right") - 1
    if len(made_ns):
        number[at_ns - made_ns[number] > seconds_to_ns(_FORECAST_S)] = -1
    return number


def shown_at(message: Ints, wanted: Ints) -> tuple[Ints, Ints]:
    """Of things that belong to messages (N,), in rising order: which are shown at F instants, and at which.

    ``wanted`` (F,) is the message that is shown at each instant, -1 for none.
    """
    low, high = np.searchsorted(message, wanted, "left"), np.searchsorted(message, wanted, "right")
    count = np.where(wanted < 0, 0, high - low)
    frame = np.repeat(np.arange(len(wanted)), count)
    return np.arange(len(frame)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(low, count), frame


def pieces(points: Floats, drawn: float = 1.0) -> Floats:
    """The lines between points (N, P, 2) as their ends (N, 2 (P - 1), 2); of each the first part, if not all."""
    start = points[:, :-1]
    end = start + drawn * (points[:, 1:] - start)
    return np.stack([start, end], axis=2).reshape(len(points), -1, 2)


def ellipses(spread_m2: Floats) -> tuple[Floats, Floats]:
    """Half axes (N, 2), the longer first, and turns (N,) of the ellipses that hold 95 % of what covariances say.

    NaN where a covariance (N, 2, 2) is not known or is none.
    """
    known = np.asarray(np.isfinite(spread_m2).all(axis=(1, 2)), np.bool_)
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], spread_m2, np.eye(2)))
    known &= values[:, 0] >= -1e-9 * np.abs(values[:, 1])
    half = np.sqrt(CHI2_95 * np.maximum(values[:, ::-1], 0))
    turn = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
    turn = np.where(turn > np.pi / 2, turn - np.pi, np.where(turn <= -np.pi / 2, turn + np.pi, turn))
    return np.where(known[:, None], half, np.nan), np.where(known, turn, np.nan)


def around(centre_m: Floats, half_m: Floats, turn: Floats, points: int) -> Floats:
    """Points (N, P, 2) on ellipses, evenly from the end of the longer half axis on."""
    angle = 2 * np.pi * np.arange(points) / points
    along, across = np.cos(angle) * half_m[:, :1], np.sin(angle) * half_m[:, 1:]
    cosine, sine = np.cos(turn)[:, None], np.sin(turn)[:, None]
    return centre_m[:, None] + np.stack([along * cosine - across * sine, along * sine + across * cosine], axis=-1)
