"""Fuse the boxes of several cameras on the ground. Letters: N boxes, G groups."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from types import MappingProxyType
from typing import Any, ClassVar, Final, NamedTuple, Self

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Indices, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.neighbours import squared_sigmas
from mcaptrack.geometry.plane import Planes, plane_at, runs_of_planes
from mcaptrack.geometry.ragged import group_index, ragged_range, table_of
from mcaptrack.schema import BOX_PX, COVARIANCE_M2, DETECTIONS, SIGHTINGS, Frame, Rows, Schema
from mcaptrack.schema.framing import split_rows
from mcaptrack.transforms.protocol import Suited, context, option, parameters, setting

# One camera of a scene: where its boxes stand, and which places it sees. Letters: N boxes, G places.


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
        moves = _moves(group_, slots, choices)
        if moves is None:
            continue
        for number, _ in moves:
            slots[owner[number]].pop(cameras[number])
        for number, new in moves:
            slots[new][cameras[number]] = number
            owner[number] = new
    return np.unique(owner, return_inverse=True)[1].astype(np.int64)


def _moves(
    group_: int, slots: list[dict[int, int]], choices: dict[int, list[tuple[float, int]]]
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
        height = self.heights_at(foot)
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

    def heights_at(self, foot: Floats) -> Floats:
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


# Evidence of the frame before: people stand near a place for longer than one frame, most false boxes do not.
#
# Letters: F frames, G groups, P pairs.


#: How often a person was detected in the frame before, and how often something was detected near a false box.
_STAYS, _NEAR_BY_CHANCE = 0.85, 0.3
#: How far people walk, in metres per second; and how far at most they seem to be from where they were.
_PACE_M_PER_S, _FARTHEST_M = 1.0, 2.5
#: A frame longer ago than this is ignored.
_MOST_S: Final = 1.0
#: Groups that are less probable than this are no people of the frame before.
_LEAST_PROBABLE: Final = 0.02


class LastFrame(NamedTuple):
    """The places of a frame (G,), and how probable a person is at each; ``is_known`` is False without any boxes."""

    t_ns: int
    places: Places
    certainty: Floats
    is_known: bool


def persistence(
    block: Joined, certainty: Floats, before: LastFrame | None, max_sigma: float
) -> tuple[Floats, LastFrame]:
    """The change of the log-odds of each group of a block (G,), and the last frame, for the block that follows.

    A person at one place is expected at one place of the frame before, and the other way round: each group is paired
    with one of the frame before at most, near and probable ones first. Nothing is added to a frame if the one before
    has no boxes at all, or is too long ago.

    Parameters
    ----------
    block : Joined
    certainty : (G,)
        The probability of a person at each place, by its own frame.
    before : LastFrame or None
        The frame before the block.
    max_sigma : float
        Places are paired if they are at most so many standard deviations apart.
    """
    count, sizes = len(certainty), np.bincount(block.frame, minlength=len(block.frames))
    ends = np.cumsum(sizes)
    times = np.array([frame.t_ns for frame in block.frames], np.int64)
    last = slice(int(ends[-1] - sizes[-1]), int(ends[-1]))
    after = LastFrame(
        int(times[-1]), Places(block.centre.xy_m[last], block.centre.cov[last]), certainty[last], bool(block.counts[-1])
    )
    begun = before or LastFrame(int(times[0]), Places(np.empty((0, 2)), np.empty((0, 3))), np.empty(0), is_known=False)
    # Groups of the frame before the block come first; frames are numbered from it.
    extra = len(begun.certainty)
    xy_m = np.concatenate([begun.places.xy_m, block.centre.xy_m])
    cov = np.concatenate([begun.places.cov, block.centre.cov])
    probable = np.concatenate([begun.certainty, certainty])
    frame = np.concatenate([np.zeros(extra, np.int64), block.frame + 1])
    step_s = np.diff(times, prepend=begun.t_ns) / NS_PER_S
    counts = np.append([begun.is_known], block.counts > 0)[:-1] & (step_s > 0) & (step_s <= _MOST_S)
    # Each group is looked for with those of its own frame, and again with those of the next one.
    likely = np.flatnonzero(probable >= _LEAST_PROBABLE)
    first, second = pairs_along_x(
        np.tile(xy_m[likely], (2, 1)), np.append(frame[likely], frame[likely] + 1), _FARTHEST_M
    )
    is_now, was = first < len(likely), second >= len(likely)
    now, then = likely[first[is_now & was]], likely[second[is_now & was] - len(likely)]
    of = frame[now] - 1
    x, y = (xy_m[now] - xy_m[then]).T
    walked = np.array([1.0, 0.0, 1.0]) * ((_PACE_M_PER_S * step_s[of]) ** 2)[:, None]
    apart = squared_sigmas(x, y, *(cov[now] + cov[then] + walked).T)
    fits = (apart <= max_sigma**2) & (x * x + y * y <= _FARTHEST_M**2)
    now, then, apart = now[fits], then[fits], apart[fits]
    order = np.lexsort((then, now, apart - 2 * np.log(probable[now]) - 2 * np.log(probable[then])))
    stays = np.zeros(extra + count)
    taken, continued = set[int](), set[int]()
    for new, other in zip(now[order].tolist(), then[order].tolist(), strict=True):
        if new not in taken and other not in continued:
            taken.add(new)
            continued.add(other)
            stays[new] = probable[other]
    stays = stays[extra:]
    odds = np.log(stays * (_STAYS / _NEAR_BY_CHANCE) + (1 - stays) * ((1 - _STAYS) / (1 - _NEAR_BY_CHANCE)))
    return np.where(counts[block.frame], odds, 0.0), after


#: How often a box of another object, or a false one, fits a group by chance.
_CHANCE: Final = 0.1
_LEAST, _MOST = 0.02, 0.98
#: Limits of people's motion for a tracker of the result (see ``motion_limits``).
_WALKS: Final = "person=:0.4::1.2"
_TRACKED: Final = MappingProxyType({"birth_score": 0.8, "confirm_score": 2.0, "delay_s": 4.0, "class_limits": _WALKS})


@dataclass(frozen=True, kw_only=True)
@parameters
class FootFuser:
    """Fuse boxes of several cameras that stand at the same place on the ground.

    Reads sightings: the boxes of all cameras at one time, with the positions and covariances of their feet on one
    ground plane. Writes detections of the scene: positions in metres, each the mean of the boxes that are joined,
    weighted by their certainty. No camera is twice in one. Their score is the probability that a person is there: a
    camera that should see the place, and has no box there, counts against it, as far as the place is in its picture and
    not hidden by others. With several cameras, a detection near it in the frame before counts for it, and none against.

    Parameters
    ----------
    max_sigma : float
        Boxes are joined if their feet are at most so many standard deviations apart.
    max_distance_m : float
        Boxes are joined if their feet are at most so many metres apart.
    min_score : float
        Leave out places where a person is less probable, as the other cameras show.
    noise : float
        Noise of the lower edges of boxes, as a share of their heights.
    noise_m : float
        Noise of the ground planes in metres.

    Examples
    --------
    Two cameras see one person, each along its own axis; a box of the first stands alone:

    >>> from mcaptrack.schema import SIGHTINGS, Frame
    >>> rows = SIGHTINGS.rows(
    ...     camera=[0, 1, 0], picture_ns=[0, 0, 0], box_row=[0, 0, 1], x_m=[1.3, 1.0, 9.0], y_m=[2.0, 2.2, 2.0],
    ...     cov_xx_m2=[0.09, 0.01, 0.09], cov_xy_m2=[0, 0, 0], cov_yy_m2=[0.01, 0.04, 0.01], class_id=[1, 1, 1])
    >>> [(fused, members)] = FootFuser(min_score=0.0)([Frame(0, 0, rows)])
    >>> fused.rows["x_m"].round(2).tolist(), fused.rows["seen_by"].tolist(), members.rows["detection"].tolist()
    ([1.03, 9.0], [2, 1], [0, 1, 0])
    """

    max_sigma: float = setting(3.0, least=0.0, most=100.0)
    max_distance_m: float = setting(1.2, least=0.0)
    min_score: float = option(0.5, least=0.0, most=1.0)
    noise: float = setting(0.04, least=0.001, most=1.0)
    noise_m: float = setting(0.1, least=0.001, most=100.0)
    views: Views = context(tuple)

    reads: ClassVar[Schema] = SIGHTINGS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": DETECTIONS, "sightings": SIGHTINGS})

    #: Scores are probabilities, so that few tracks need begin by mistake; people who stand are seen all the time; and
    #: positions are exact enough to expect steady walks.
    suits: ClassVar[Mapping[str, Suited]] = MappingProxyType({"tracker": Suited("ground", _TRACKED)})

    @property
    def latency_s(self) -> Mapping[str, float]:
        """Each frame is fused by itself and the one before."""
        return MappingProxyType({"": 0.0, "sightings": 0.0})

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        yield from self.fused(self.joined(frames))

    def joined(self, frames: Iterable[Frame]) -> Iterator[Joined]:
        """Join the boxes of sightings, block by block; how well the cameras detect people has no influence."""
        return joined(frames, self.views, self.max_sigma, self.max_distance_m)

    def fused(self, blocks: Iterable[Joined]) -> Iterator[tuple[Frame, ...]]:
        """The detections of each frame of blocks, and its sightings with the number of their detections."""
        before: LastFrame | None = None
        for block in blocks:
            expected, odds = self._evidence(block)
            if len(self.views) > 1:  # there is nothing that could confirm the boxes of one camera alone
                more, before = persistence(block, _probability(odds), before, self.max_sigma)
                odds += more
            yield from self._detections(block, expected, _probability(odds))

    def _detections(self, block: Joined, expected: Ints, certainty: Floats) -> Iterator[tuple[Frame, ...]]:
        """Detections and sightings of a block, with how many cameras should see each group, and its score (G,)."""
        centre, seen, of = block.centre, block.seen, block.of
        kept = np.flatnonzero(certainty >= self.min_score)
        x, y = centre.xy_m[kept].T
        kept = kept[np.lexsort((y, x, block.frame[kept]))]  # whatever the order of the cameras
        sizes = np.bincount(block.frame[kept], minlength=len(block.frames))
        number = np.full(len(seen), -1, np.int64)
        number[kept] = ragged_range(0, sizes)
        classes = np.zeros(len(seen), np.int64)
        classes[of] = block.rows["class_id"]
        rows = DETECTIONS.rows(
            x_m=centre.xy_m[kept, 0],
            y_m=centre.xy_m[kept, 1],
            cov_xx_m2=centre.cov[kept, 0],
            cov_xy_m2=centre.cov[kept, 1],
            cov_yy_m2=centre.cov[kept, 2],
            score=certainty[kept],
            class_id=classes[kept],
            seen_by=seen[kept].sum(axis=1),
            expected_by=expected[kept],
        )
        members = block.rows.copy()
        members["detection"] = number[of]
        when, index = [frame.t_ns for frame in block.frames], [frame.index for frame in block.frames]
        yield from zip(
            split_rows(when, index, rows, np.cumsum(sizes)),
            split_rows(when, index, members, np.cumsum(block.counts)),
            strict=True,
        )

    def _evidence(self, block: Joined) -> tuple[Ints, Floats]:
        """The number of cameras that should see each place (G,), and the log-odds (G,) that a person is there."""
        seen = block.seen
        rate = np.full(seen.shape, np.nan)
        false = np.full(seen.shape[1], 0.5)
        for number, view in enumerate(self.views):
            rate[:, number] = view.rate(block.visible[:, number])
            false[number] = view.false_share
        expected = np.where(np.isnan(rate), seen, seen | (rate >= 0.5)).sum(axis=1)
        is_known = ~np.isnan(rate)
        rate = np.clip(rate, _LEAST, _MOST)
        # The first box is true or false as the boxes of its camera are; each further one agrees by more than chance.
        share = np.where(seen, np.clip(false, _LEAST, _MOST), 1.0).min(axis=1)
        odds = np.log((1 - share) / share)
        agrees = np.log(np.maximum(np.where(is_known, rate, 0.5), 0.3) / _CHANCE)
        lacks = np.log((1 - rate) / (1 - _CHANCE))
        odds += np.where(seen, agrees, np.where(is_known, np.minimum(lacks, 0.0), 0.0)).sum(axis=1)
        odds -= np.where(seen, agrees, np.inf).min(axis=1)  # the first one
        return expected, odds


def _probability(odds: Floats) -> Floats:
    out: Floats = 1 / (1 + np.exp(-odds))
    return out


# Compare the cameras of a scene by the people that they see together.
#
# Letters: F frames, N boxes, G groups, C cameras.


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
