"""One camera of a scene: where its boxes stand, and which places it sees. Letters: N boxes, G places."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, ClassVar, Final, NamedTuple, Self

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.neighbours import squared_sigmas
from mcaptrack.geometry.plane import GroundPlane, Planes, plane_at, runs_of_planes
from mcaptrack.geometry.ragged import group_index, ragged_range, table_of
from mcaptrack.schema import BOX_PX, COVARIANCE_M2, SIGHTINGS, Frame, Rows

#: Heights of boxes are modelled by those of so many frames, if there are so many boxes.
_MOST_FRAMES: Final = 3000
_LEAST_BOXES: Final = 20
#: Steps of the robust fit of heights, and the relative error above which boxes count less.
_STEPS, _ERROR = 8, 0.05
#: Ends of the shares of a person that are visible, for which the rate of detections is counted apart.
SHARES: Final = (0.25, 0.5, 0.75, 1.01)


# Boxes of several cameras joined to groups, many frames at once: for few boxes, calls take longer than computing.
#
# Letters: F frames, N boxes, G groups, C cameras.


#: The size of tables with a row for each frame and a column for each of its boxes: frames are joined in such blocks.
_BLOCK: Final = 8192


# Group the boxes of several cameras that are the same object, on the ground. Letters: N boxes, G groups, P pairs.


#: Pairs are looked for within a little more than their largest distance, which is compared exactly afterwards: this
#: share of the numbers that are compared.
_MARGIN: Final = 1e-12


class Places(NamedTuple):
    """Places on the ground: positions (N, 2) in m, and covariances (N, 3) in m^2: xx, xy, yy."""

    xy_m: Floats
    cov: Floats

    def information(self) -> tuple[Floats, Floats]:
        """The inverse covariances (N, 3), and these times the positions (N, 2)."""
        xx, xy, yy = self.cov.T
        inverse = np.stack([yy, -xy, xx], axis=-1) / (xx * yy - xy * xy)[:, None]
        a, b, c = inverse.T
        x, y = self.xy_m.T
        return inverse, np.stack([a * x + b * y, b * x + c * y], axis=-1)


def group(camera: Ints, places: Places, gate: float, farthest_m: float, part: Ints | None = None) -> Ints:
    """Join boxes that fit together, until as few groups are left as there can be; returns the group of each box (N,).

    Pairs are joined in order of their distance, if the groups that they are in by then still fit: no camera is twice in
    a group, and the means of the two are within the gate. A box that fits no other is a group of its own. Then a
    group is dissolved if all its boxes fit others (``_dissolved``). Groups are numbered by their first boxes.

    Parameters
    ----------
    camera : (N,) int
        The camera of each box.
    places : Places
        Where they stand.
    gate : float
        Largest squared Mahalanobis distance of two groups.
    farthest_m : float
        Largest distance of two boxes in metres.
    part : (N,) int, optional
        Boxes of different parts, as of different frames, are never joined.
    """
    count = len(camera)
    part = np.zeros(count, np.int64) if part is None else part
    first, second = pairs_along_x(places.xy_m, part, farthest_m)
    x, y = (places.xy_m[first] - places.xy_m[second]).T
    may = (camera[first] != camera[second]) & (x * x + y * y <= farthest_m**2)
    first, second, x, y = first[may], second[may], x[may], y[may]
    distance = squared_sigmas(x, y, *(places.cov[first] + places.cov[second]).T)
    fits = np.flatnonzero(distance <= gate)
    order = fits[np.lexsort((second[fits], first[fits], distance[fits]))]
    # Numbers of Python, because a step concerns two groups and NumPy takes longer for so few.
    owner, members = list(range(count)), [[box] for box in range(count)]
    seen = [1 << number for number in camera.tolist()]
    sums = list(zip(*(column.tolist() for part_ in places.information() for column in part_.T), strict=True))
    at = _mean(*np.array(sums, float).reshape(-1, 5).T)
    x_, y_, xx_, xy_, yy_ = (column.tolist() for column in at)
    for box, other in zip(first[order].tolist(), second[order].tolist(), strict=True):
        i, j = owner[box], owner[other]
        if i == j or seen[i] & seen[j]:
            continue
        dx, dy = x_[i] - x_[j], y_[i] - y_[j]
        xx, xy, yy = xx_[i] + xx_[j], xy_[i] + xy_[j], yy_[i] + yy_[j]
        if (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy) > gate:
            continue
        low, high = (i, j) if i < j else (j, i)
        seen[low] |= seen[high]
        (a, b, c, u, v), (d, e, f, w, z) = sums[low], sums[high]
        sums[low] = joint = (a + d, b + e, c + f, u + w, v + z)
        x_[low], y_[low], xx_[low], xy_[low], yy_[low] = _mean(*joint)
        for member in members[high]:
            owner[member] = low
        members[low] += members[high]
    of = np.unique(owner, return_inverse=True)[1].astype(np.int64)
    return _dissolved(camera, places, of, gate, farthest_m, part)


def pairs_along_x(xy_m: Floats, part: Ints, farthest_m: float) -> tuple[Ints, Ints]:
    """Pairs (P,) of places of one part that are at most so far apart along the first axis, the lower number first."""
    order = np.lexsort((xy_m[:, 0], part))
    x, part = xy_m[order, 0], part[order]
    low, high = float(x.min(initial=0.0)), float(x.max(initial=0.0))
    # Parts follow one another along the axis.
    along = x - low + part * (high - low + 2 * farthest_m + 1.0)
    reach = farthest_m + _MARGIN * float(along.max(initial=0.0))
    after = np.arange(1, len(x) + 1)
    count = np.searchsorted(along, along + reach, "right") - after
    near, other = group_index(count), ragged_range(after, count)
    same = part[near] == part[other]
    near, other = order[near[same]], order[other[same]]
    return np.minimum(near, other), np.maximum(near, other)


def _dissolved(camera: Ints, places: Places, of: Ints, gate: float, farthest_m: float, part: Ints) -> Ints:
    """Give the boxes of a group to others near it, where all of them fit there; returns the group of each box (N,).

    Where people stand close together, boxes of two of them may have been joined to a third person. Then the two lack
    these boxes. The group with the fewest boxes goes first. A box takes a place in another group if this has none of
    its camera, or if the one that it has fits another group.
    """
    count = int(of.max(initial=-1)) + 1
    centre = means(places, of, count)
    part_of = np.zeros(count, np.int64)
    part_of[of] = part
    mine, other = pairs_along_x(centre.xy_m, part_of, 2 * farthest_m)
    x, y = (centre.xy_m[mine] - centre.xy_m[other]).T
    near = x * x + y * y <= (2 * farthest_m) ** 2
    mine, other = np.concatenate([mine[near], other[near]]), np.concatenate([other[near], mine[near]])
    if not len(mine):
        return of
    # Each box with each group near its own one.
    size = np.bincount(of, minlength=count)
    by_group = np.argsort(of, kind="stable")
    begins = np.cumsum(size) - size
    box, to = by_group[ragged_range(begins[mine], size[mine])], np.repeat(other, size[mine])
    apart = places.xy_m[box] - centre.xy_m[to]
    away = squared_sigmas(*apart.T, *(places.cov[box] + centre.cov[to]).T)
    fits = (away <= gate) & ((apart**2).sum(axis=1) <= farthest_m**2)
    box, to, away = box[fits], to[fits], away[fits]
    order = np.lexsort((to, away, box))
    choices: dict[int, list[tuple[float, int]]] = {}
    for number, group_, value in zip(box[order].tolist(), to[order].tolist(), away[order].tolist(), strict=True):
        choices.setdefault(number, []).append((value, group_))
    # A group can go only if each of its boxes fits another one.
    may_go = np.bincount(of[np.unique(box)], minlength=count) == size
    tried = np.flatnonzero(may_go)
    owner, cameras = of.tolist(), camera.tolist()
    slots = [dict[int, int]() for _ in range(count)]
    for number, (group_, of_camera) in enumerate(zip(owner, cameras, strict=True)):
        slots[group_][of_camera] = number
    for group_ in tried[np.argsort(size[tried], kind="stable")].tolist():
        moves = _moves(group_, slots, cameras, choices)
        if moves is None:
            continue
        for number, _ in moves:
            slots[owner[number]].pop(cameras[number])
        for number, new in moves:
            slots[new][cameras[number]] = number
            owner[number] = new
    return np.unique(owner, return_inverse=True)[1].astype(np.int64)


def _moves(
    group_: int, slots: list[dict[int, int]], cameras: list[int], choices: dict[int, list[tuple[float, int]]]
) -> list[tuple[int, int]] | None:
    """The boxes that move if a group is dissolved, each with its new group; None if one has no place."""
    moves: list[tuple[int, int]] = []
    for of_camera, slot in slots[group_].items():
        best: tuple[float, list[tuple[int, int]]] | None = None
        for away, to in choices.get(slot, ()):
            if not slots[to] or (best and away >= best[0]):
                continue
            other = slots[to].get(of_camera)
            if other is None:
                best = away, [(slot, to)]
                continue
            for further, next_ in choices.get(other, ()):
                if next_ != group_ and slots[next_] and of_camera not in slots[next_]:
                    if not best or away + further < best[0]:
                        best = away + further, [(slot, to), (other, next_)]
                    break
        if best is None:
            return None
        moves += best[1]
    return moves


def _mean(a: Any, b: Any, c: Any, u: Any, v: Any) -> tuple[Any, ...]:
    """The mean of a group and its covariance, x, y, xx, xy, yy, by its information: xx, xy, yy, and that times x, y.

    Each is a number, or an array for as many groups.
    """
    det = a * c - b * b
    return (c * u - b * v) / det, (a * v - b * u) / det, c / det, -b / det, a / det


def means(places: Places, of: Ints, count: int) -> Places:
    """The mean of each group (G,), each box weighted by its certainty."""
    inverse, weighted = places.information()
    a, b, c = (np.bincount(of, part, count) for part in inverse.T)
    u, v = (np.bincount(of, part, count) for part in weighted.T)
    x, y, xx, xy, yy = _mean(a, b, c, u, v)
    return Places(np.stack([x, y], axis=-1), np.stack([xx, xy, yy], axis=-1))


class Joined(NamedTuple):
    """Frames of sightings, and the groups that their boxes are joined to.

    ``rows`` (N,) are those of all frames, ordered by frame, camera and box; ``counts`` (F,) the number of each frame.
    ``of`` (N,) is the group of each box. Groups are ordered by frame, ``frame`` (G,), then by class; ``centre`` has
    their places, ``seen`` (G, C) the cameras that see them, and ``visible`` (G, C) the share of a person there that is
    visible to each camera with a view.
    """

    frames: Sequence[Frame]
    rows: Rows
    counts: Ints
    of: Ints
    frame: Ints
    centre: Places
    seen: Bools
    visible: Floats


def places_of(rows: Rows) -> Places:
    """The places of sightings (N,)."""
    xy_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
    return Places(xy_m, np.stack([rows[name] for name in COVARIANCE_M2], axis=-1))


def joined(frames: Iterable[Frame], views: Views, max_sigma: float, max_distance_m: float) -> Iterator[Joined]:
    """Join the boxes of each frame, of those that are at most so far apart (see ``FootFuser``); block by block."""
    for block in _blocks(frames):
        counts = np.array([len(frame.rows) for frame in block], np.int64)
        rows, number = SIGHTINGS.joined([frame.rows for frame in block]), group_index(counts)
        order = np.lexsort((rows["box_row"], rows["camera"], number))
        rows = rows[order]
        # Objects of different frames or classes are never joined.
        classes, kind = np.unique(rows["class_id"], return_inverse=True)
        part = number * max(len(classes), 1) + kind
        places, camera = places_of(rows), rows["camera"].astype(np.int64)
        of = group(camera, places, max_sigma**2, max_distance_m, part)
        count = int(of.max(initial=-1)) + 1
        part_of = np.empty(count, np.int64)
        part_of[of] = part
        by_part = np.argsort(part_of, kind="stable")
        place = np.empty(count, np.int64)
        place[by_part] = np.arange(count)
        of, frame = place[of], part_of[by_part] // max(len(classes), 1)
        centre = means(places, of, count)
        seen = np.zeros((count, max(len(views), int(camera.max(initial=0)) + 1)), bool)
        seen[of, camera] = True
        visible = np.empty((count, len(views)))
        sizes, times = np.bincount(frame, minlength=len(block)), [each.t_ns for each in block]
        for column, view in enumerate(views):
            visible[:, column] = _visible(view, centre.xy_m, sizes, times)
        yield Joined(block, rows, counts, of, frame, centre, seen, visible)


def _blocks(frames: Iterable[Frame]) -> Iterator[list[Frame]]:
    """Frames in blocks, none of which has a much larger frame than others."""
    block: list[Frame] = []
    most = 0
    for frame in frames:
        most = max(most, len(frame.rows), 1)
        if block and (len(block) + 1) * most > _BLOCK:
            yield block
            block, most = [], max(len(frame.rows), 1)
        block.append(frame)
    if block:
        yield block


def _visible(view: CameraView, xy_m: Floats, sizes: Ints, times: Sequence[int]) -> Floats:
    """The share of a person at each place (G, 2) that a camera sees; places are of frames with ``sizes`` (F,)."""
    if len(view.planes) < 2:
        return view.visible(xy_m, times[0], sizes)
    ends = np.cumsum(sizes)
    out = np.empty(len(xy_m))
    for low, high in runs_of_planes(view.planes, times):
        part = slice(int(ends[low] - sizes[low]), int(ends[high - 1]))
        out[part] = view.visible(xy_m[part], times[low], sizes[low:high])
    return out


@dataclass(frozen=True, kw_only=True)
class CameraView:
    """A camera: its ground planes, how high people are in its pictures, and how well it detects them.

    Attributes
    ----------
    name : str
        Its name in the log.
    planes : Planes
        Its ground planes, all in the same metres.
    heights : tuple of 3 floats or None
        The height in px of a box that touches the ground at (x, y) px is ``h0 x + h1 y + h2``; None if it isn't known.
    detects : tuple of floats
        The rate at which it detects people who are visible up to ``SHARES``, for each of these shares.
    false_share : float
        The share of its boxes that are false.
    """

    name: str
    planes: Planes
    heights: tuple[float, float, float] | None = None
    detects: tuple[float, ...] = (0.1, 0.4, 0.7, 0.85)
    false_share: float = 0.15

    #: The usual width of a standing person, as a share of the height.
    width: ClassVar[float] = 0.4

    def with_heights_in(self, frames: Iterable[Frame]) -> Self:
        """The camera with heights as in the boxes of the first frames of its detections."""
        boxes = [columns_to_boxes(frame.rows) for frame in islice(frames, _MOST_FRAMES)]
        joined = np.concatenate([np.empty((0, len(BOX_PX))), *boxes])
        return self.with_heights(joined[np.isfinite(joined).all(axis=1)])

    def with_heights(self, xywh: Floats) -> Self:
        """The same camera with heights as in these boxes (N, 4)."""
        if len(xywh) < _LEAST_BOXES or not self.planes:
            return self
        foot = np.column_stack([self.planes[0][1].feet(xywh), np.ones(len(xywh))])
        weight = np.ones(len(xywh))
        for _ in range(_STEPS):
            root = np.sqrt(weight)
            fit = np.linalg.lstsq(foot * root[:, None], xywh[:, 3] * root, rcond=None)[0]
            error = np.abs(xywh[:, 3] - foot @ fit) / np.maximum(xywh[:, 3], 1.0)
            weight = 1 / np.maximum(error, _ERROR)
        return replace(self, heights=(float(fit[0]), float(fit[1]), float(fit[2])))

    def places(self, xywh: Floats, t_ns: int, noise: float, noise_m: float | Floats) -> Places:
        """Where boxes (N, 4) stand, NaN beyond the horizon.

        ``noise`` is the noise of their lower edges as a share of their heights, ``noise_m`` that of the plane in m, of
        all boxes or of each (N,).
        """
        plane = plane_at(self.planes, t_ns)
        if plane is None or not len(xywh):
            return Places(np.full((len(xywh), 2), np.nan), np.full((len(xywh), 3), np.nan))
        foot = plane.feet(xywh)
        steps = [[0.0, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]]
        at, right, left, below, above = plane.pixels_to_metres(np.concatenate([foot + step for step in steps])).reshape(
            5, -1, 2
        )
        (ux, uy), (vx, vy) = ((step * (noise * xywh[:, 3:])).T for step in (right - left, below - above))
        more = noise_m**2
        cov = np.stack([ux**2 + vx**2 + more, ux * uy + vx * vy, uy**2 + vy**2 + more], axis=-1)
        is_placed = np.isfinite(np.concatenate([at, cov], axis=1)).all(axis=1, keepdims=True)
        return Places(np.where(is_placed, at, np.nan), np.where(is_placed, cov, np.nan))

    def visible(self, xy_m: Floats, t_ns: int, counts: Sequence[int] | Ints | None = None) -> Floats:
        """The share (G,) of a person at each place that is in the picture and not hidden by people at the others.

        With ``counts`` (F,) the places are those of so many in each of F frames, with the ground plane at ``t_ns``.
        """
        plane = plane_at(self.planes, t_ns)
        if plane is None:
            return np.zeros(len(xy_m))
        foot = plane.metres_to_pixels(xy_m)
        x, y = foot.T
        height = self.heights_at(plane, foot)
        is_there: Bools = np.asarray(np.isfinite(x) & (height > 1))
        half = self.width / 2 * height
        left, right, top = x - half, x + half, y - height
        inside = _overlap(left, right, 0, plane.width_px) * _overlap(top, y, 0, plane.height_px)
        area = np.maximum(2 * half * height, 1e-9)
        seen = np.where(is_there, np.nan_to_num(inside) / area, 0.0)
        if self.heights is None or not len(xy_m):
            return np.minimum(seen, 1.0)
        # How much of each (rows) is covered by each that stands nearer (columns), frame by frame.
        table = table_of([len(xy_m)] if counts is None else counts)
        here = is_there[table] & (table >= 0)
        left, right, top, bottom, area = np.where(is_there, np.stack([left, right, top, y, area]), 1.0)[:, table]
        covered = np.minimum(right[:, :, None], right[:, None]) - np.maximum(left[:, :, None], left[:, None])
        np.maximum(covered, 0, out=covered)
        high = np.minimum(bottom[:, :, None], bottom[:, None]) - np.maximum(top[:, :, None], top[:, None])
        covered *= np.maximum(high, 0, out=high)
        covered /= area[:, :, None]
        is_nearer = (bottom[:, None] > bottom[:, :, None]) & here[:, None] & here[:, :, None]
        hidden = np.where(is_nearer, covered, 0.0)
        out: Floats = np.minimum(seen, 1.0) * np.prod(1 - np.clip(hidden, 0, 1, out=hidden), axis=2)[table >= 0]
        return out

    def heights_at(self, plane: GroundPlane, foot: Floats) -> Floats:
        """The heights (G,) in px of boxes that touch the ground at these points (G, 2)."""
        if self.heights is None:
            return np.full(len(foot), 2.0)
        return foot @ self.heights[:2] + self.heights[2]

    def rate(self, visible: Floats) -> Floats:
        """The rate at which people are detected who are visible to this share (G,); 0 where nothing is."""
        at = np.minimum(np.searchsorted(SHARES, visible, "right"), len(SHARES) - 1)
        out: Floats = np.where(visible > 0, np.asarray(self.detects)[at], 0.0)
        return out


def _overlap(low: Floats, high: Floats, begin: float, end: float) -> Floats:
    out: Floats = np.maximum(np.minimum(high, end) - np.maximum(low, begin), 0)
    return out


#: The cameras of a scene.
Views = Sequence[CameraView]
