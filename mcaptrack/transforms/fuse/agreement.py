"""Compare the cameras of a scene by the people that they see together.

Letters: N boxes, G groups, C cameras.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Indices
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import Frame
from mcaptrack.transforms.fuse.fuser import FootFuser, places_of
from mcaptrack.transforms.fuse.grouping import Places, means
from mcaptrack.transforms.fuse.view import SHARES, CameraView

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
    """The number of people that two cameras should see, over all frames, and of those that two do see."""

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
    frames: Iterable[Frame], fuser: FootFuser, offset_ns: Sequence[int] = ()
) -> tuple[tuple[CameraView, ...], tuple[Offset, ...], Shared]:
    """Estimate how often each camera detects people and how often its boxes are false, and its offset.

    Parameters
    ----------
    frames : iterable of Frame
        Sightings, in order of time.
    fuser : FootFuser
        What groups them, with the views of the cameras.
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
    count = len(fuser.views)
    offset_ns = offset_ns or [0] * count
    hits = np.array([view.detects for view in fuser.views]).reshape(count, -1) * _PRIOR
    tries = np.full(hits.shape, _PRIOR)
    false = np.array([view.false_share for view in fuser.views]) * _PRIOR
    boxes = np.full(count, _PRIOR)
    off: list[list[Floats]] = [[] for _ in range(count)]
    late: list[list[Floats]] = [[] for _ in range(count)]
    last: tuple[int, Floats] | None = None
    shared = Shared(0, 0)
    for frame in frames:
        if not len(frame.rows):
            last = None
            continue
        of, centre, seen = fuser.groups(frame.rows)
        places, camera = places_of(frame.rows), frame.rows["camera"].astype(np.int64)
        visible = np.stack([view.visible(centre.xy_m, frame.t_ns) for view in fuser.views], axis=1)
        rate = np.stack([view.rate(part) for view, part in zip(fuser.views, visible.T, strict=True)], axis=1)
        by_two = ((visible >= _VISIBLE) | seen).sum(axis=1) > 1
        shared = Shared(shared.expected + int(by_two.sum()), shared.seen + int((seen.sum(axis=1) > 1).sum()))
        sure = seen.sum(axis=1) > _OTHERS
        speed = _velocities(last, frame.t_ns, centre.xy_m[sure])
        last = frame.t_ns, centre.xy_m[sure]
        for number in range(count):
            others = seen.sum(axis=1) - seen[:, number]
            there = (others >= _OTHERS) & (visible[:, number] > 0)
            at = np.minimum(np.searchsorted(SHARES, visible[there, number], "right"), len(SHARES) - 1)
            tries[number] += np.bincount(at, minlength=len(SHARES))
            hits[number] += np.bincount(at, seen[there, number], len(SHARES))
            is_tested = seen[:, number] & (rate.sum(axis=1) - rate[:, number] >= _EXPECTED)
            boxes[number] += is_tested.sum()
            false[number] += (is_tested & (others == 0)).sum()
            # Where the others alone see the people, compared with the nearest box of this camera.
            mine = np.flatnonzero(camera == number)
            rest = np.flatnonzero((camera != number) & sure[of])
            if not len(mine) or not len(rest):
                continue
            names, inner = np.unique(of[rest], return_inverse=True)
            seen_at = means(Places(places.xy_m[rest], places.cov[rest]), inner, len(names)).xy_m
            which, nearest = _pairs(places.xy_m[mine], seen_at)
            difference = places.xy_m[mine[which]] - seen_at[nearest]
            off[number].append(difference)
            moving = speed[np.searchsorted(np.flatnonzero(sure), names[nearest])]
            pace = (moving**2).sum(axis=1)
            fast = pace > _MOVES_M_PER_S**2  # False where it isn't known
            away_s = (frame.rows["picture_ns"][mine[which][fast]] - offset_ns[number] - frame.t_ns) / NS_PER_S
            late[number].append(away_s - (difference[fast] * moving[fast]).sum(axis=1) / pace[fast])
    views = tuple(
        replace(view, detects=tuple((hits[i] / tries[i]).tolist()), false_share=float(false[i] / boxes[i]))
        for i, view in enumerate(fuser.views)
    )
    return views, tuple(_offset(*pair) for pair in zip(off, late, strict=True)), shared


def _velocities(last: tuple[int, Floats] | None, t_ns: int, now: Floats) -> Floats:
    """The velocity (G, 2) of each place since the last frame; NaN where none was near."""
    out = np.full(now.shape, np.nan)
    if last is None or not len(last[1]) or not len(now) or t_ns <= last[0]:
        return out
    which, nearest = _pairs(now, last[1])
    out[which] = (now[which] - last[1][nearest]) / ((t_ns - last[0]) / NS_PER_S)
    return out


def _pairs(some: Floats, others: Floats) -> tuple[Indices, Indices]:
    """The places in (M, 2) and (N, 2) that are nearest to each other, and near."""
    apart = some[:, None] - others
    distance = np.hypot(apart[..., 0], apart[..., 1])
    nearest = distance.argmin(axis=1)
    is_pair = (distance.min(axis=1) < _NEAR_M) & (distance.argmin(axis=0)[nearest] == np.arange(len(some)))
    return np.flatnonzero(is_pair), nearest[is_pair]


def _offset(off: list[Floats], late: list[Floats]) -> Offset:
    apart = np.concatenate(off) if off else np.empty((0, 2))
    times = np.concatenate(late) if late else np.empty(0)
    x_m, y_m = np.median(apart, axis=0) if len(apart) else (np.nan, np.nan)
    late_s = float(np.median(times)) if len(times) >= LEAST_COMPARED else np.nan
    return Offset(float(x_m), float(y_m), late_s, len(apart))
