"""Compare the cameras of a scene by the people that they see together.

Letters: F frames, N boxes, G groups, C cameras.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Indices, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import group_index, table_of
from mcaptrack.transforms.fuse.view import SHARES, CameraView, Joined, Places, Views, means, places_of

#: A place that so many other cameras see is taken for true; others are false if so many should see them.
_OTHERS, _EXPECTED = 2, 1.5
#: People are expected to be seen if so much of them is visible.
_VISIBLE: Final = 0.5
#: Counts that stand for what is known before anything is counted.
_PRIOR: Final = 5.0
#: Boxes that are nearer than this to a place of other cameras are compared with it.
_NEAR_M: Final = 1.5
#: Offsets in time are estimated from people who are faster than this.
_MOVES_M_PER_S: Final = 0.5
#: Fewer comparisons say nothing about a camera.
LEAST_COMPARED: Final = 50


#: Cameras that see so few of the people that two of them should see are no cameras of one place.
_STRANGERS: Final = 0.25


class Shared(NamedTuple):
    """Over all frames: how many people two cameras should both see, and how many both do see."""

    expected: int
    seen: int

    @property
    def are_strangers(self) -> bool:
        """Whether the cameras seldom see the same people, where they should."""
        return self.expected >= LEAST_COMPARED and self.seen < _STRANGERS * self.expected

    def __str__(self) -> str:
        return (
            f"of {self.expected} people that two cameras should see, two see {self.seen}; the ground planes may be of "
            "different places, each in metres of its own"
        )


class Offset(NamedTuple):
    """The median distance of the feet of a camera from where the others see them.

    ``x_m`` and ``y_m`` are where they stand too far, ``late_s`` is how much later than the others the camera's boxes
    are, NaN if all stand; ``compared`` is the number of boxes.
    """

    x_m: float
    y_m: float
    late_s: float
    compared: int

    @property
    def distance_m(self) -> float:
        """The distance in metres."""
        return float(np.hypot(self.x_m, self.y_m))


def compare(
    blocks: Iterable[Joined], views: Views, offset_ns: Sequence[int] = ()
) -> tuple[tuple[CameraView, ...], tuple[Offset, ...], Shared]:
    """Estimate how often each camera detects people and how often its boxes are false, and its offset.

    Parameters
    ----------
    blocks : iterable of Joined
        Sightings with their groups, in order of time (``FootFuser.joined``).
    views : sequence of CameraView
        The cameras.
    offset_ns : sequence of int
        What was taken off the times of each camera already, in ns; nothing by default.

    Returns
    -------
    views : tuple of CameraView
        The cameras, with the estimates.
    offsets : tuple of Offset
        The offset of each.
    shared : Shared
        How many people two cameras should see, and do see.
    """
    count = len(views)
    offset_ns = offset_ns or [0] * count
    hits = np.array([view.detects for view in views]).reshape(count, -1) * _PRIOR
    tries = np.full(hits.shape, _PRIOR)
    false = np.array([view.false_share for view in views]) * _PRIOR
    boxes = np.full(count, _PRIOR)
    off: list[list[Floats]] = [[] for _ in range(count)]
    late: list[list[Floats]] = [[] for _ in range(count)]
    last: tuple[int, Floats] | None = None
    shared = Shared(0, 0)
    for block in blocks:
        seen, visible, by = block.seen, block.visible, block.seen.sum(axis=1)
        rate = np.stack([view.rate(part) for view, part in zip(views, visible.T, strict=True)], axis=1)
        by_two = ((visible >= _VISIBLE) | seen).sum(axis=1) > 1
        shared = Shared(shared.expected + int(by_two.sum()), shared.seen + int((by > 1).sum()))
        sure = np.flatnonzero(by > _OTHERS)
        sizes = np.bincount(block.frame[sure], minlength=len(block.frames))
        speed, last = _velocities(last, block, block.centre.xy_m[sure], sizes)
        for number in range(count):
            others = by - seen[:, number]
            is_seen = (others >= _OTHERS) & (visible[:, number] > 0)
            at = np.minimum(np.searchsorted(SHARES, visible[is_seen, number], "right"), len(SHARES) - 1)
            tries[number] += np.bincount(at, minlength=len(SHARES))
            hits[number] += np.bincount(at, seen[is_seen, number], len(SHARES))
            is_tested = seen[:, number] & (rate.sum(axis=1) - rate[:, number] >= _EXPECTED)
            boxes[number] += is_tested.sum()
            false[number] += (is_tested & (others == 0)).sum()
        if not len(sure):
            continue
        place = np.full(len(seen), -1)
        place[sure] = np.arange(len(sure))
        where, camera, frame = places_of(block.rows), block.rows["camera"], group_index(block.counts)
        for number in range(count):
            # Where the others alone see the people, compared with the nearest box of this camera.
            mine = np.flatnonzero(camera == number)
            rest = np.flatnonzero((camera != number) & (place[block.of] >= 0))
            seen_at = means(Places(where.xy_m[rest], where.cov[rest]), place[block.of[rest]], len(sure)).xy_m
            counts = np.bincount(frame[mine], minlength=len(block.frames))
            which, nearest = _pairs(where.xy_m[mine], counts, seen_at, sizes)
            difference = where.xy_m[mine[which]] - seen_at[nearest]
            off[number].append(difference)
            moving = speed[nearest]
            pace = (moving**2).sum(axis=1)
            fast = pace > _MOVES_M_PER_S**2  # False where it isn't known
            box = mine[which[fast]]
            times = np.array([each.t_ns for each in block.frames])[frame[box]]
            away_s = (block.rows["picture_ns"][box] - offset_ns[number] - times) / NS_PER_S
            late[number].append(away_s - (difference[fast] * moving[fast]).sum(axis=1) / pace[fast])
    compared = tuple(
        replace(view, detects=tuple((hits[i] / tries[i]).tolist()), false_share=float(false[i] / boxes[i]))
        for i, view in enumerate(views)
    )
    return compared, tuple(_offset(*pair) for pair in zip(off, late, strict=True)), shared


def _velocities(
    last: tuple[int, Floats] | None, block: Joined, xy_m: Floats, sizes: Ints
) -> tuple[Floats, tuple[int, Floats] | None]:
    """The velocity (G, 2) of each place, of ``sizes`` (F,) in each frame, since the frame before; NaN where none is.

    ``last`` is the time of the frame before the block, with the places there; the same of its last frame is returned.
    """
    out = np.full(xy_m.shape, np.nan)
    before = np.empty((0, 2)) if last is None else last[1]
    times = np.array([block.frames[0].t_ns if last is None else last[0], *(frame.t_ns for frame in block.frames)])
    which, nearest = _pairs(xy_m, sizes, np.concatenate([before, xy_m]), np.append(len(before), sizes[:-1]))
    step_s = (np.diff(times) / NS_PER_S)[group_index(sizes)[which]]
    rises = step_s > 0
    which, nearest = which[rises], nearest[rises]
    out[which] = (xy_m[which] - np.concatenate([before, xy_m])[nearest]) / step_s[rises, None]
    end = block.frames[-1]
    return out, (end.t_ns, xy_m[len(xy_m) - sizes[-1] :]) if len(end.rows) else None


def _pairs(some: Floats, counts: Ints, others: Floats, sizes: Ints) -> tuple[Indices, Indices]:
    """The places in (M, 2) and (N, 2) of one frame that are nearest to each other, and near.

    Each of F frames has ``counts`` (F,) and ``sizes`` (F,) of them.
    """
    rows, columns = table_of(counts), table_of(sizes)
    if not rows.size or not columns.size:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    apart = some[rows][:, :, None] - others[columns][:, None]
    distance = np.hypot(apart[..., 0], apart[..., 1])
    distance[(rows < 0)[:, :, None] | (columns < 0)[:, None]] = np.inf
    nearest = distance.argmin(axis=2)
    back = np.take_along_axis(distance.argmin(axis=1), nearest, axis=1)
    is_pair = (distance.min(axis=2) < _NEAR_M) & (back == np.arange(rows.shape[1]))
    return rows[is_pair], np.take_along_axis(columns, nearest, axis=1)[is_pair]


def _offset(off: list[Floats], late: list[Floats]) -> Offset:
    apart = np.concatenate(off) if off else np.empty((0, 2))
    times = np.concatenate(late) if late else np.empty(0)
    x_m, y_m = np.median(apart, axis=0) if len(apart) else (np.nan, np.nan)
    late_s = float(np.median(times)) if len(times) >= LEAST_COMPARED else np.nan
    return Offset(float(x_m), float(y_m), late_s, len(apart))
