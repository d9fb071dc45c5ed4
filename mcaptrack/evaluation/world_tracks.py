"""Tracks in worlds of re-tracking: what was detected, by the identities of each world, and what no detector saw; and
medians and intervals of 90 % of numbers that differ between worlds.

A track that begins or ends in the middle of the seen area was not seen there first or last: either another track goes
on as this one, or the person was there unseen. Which it is can't be told from the log, so that each world draws the
share of the one and of the other. Where people are unseen before they are tracked, others are never tracked: worlds add
so many. How long people are unseen is told by the gaps of tracks that went on.

Letters: W worlds, K tracklets, N samples, F frames, R rows, T tracks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mcaptrack import notices
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import find_rows, ragged_range, run_ends, run_starts
from mcaptrack.schema import Rows

__all__ = ["WorldInterval", "WorldTracks", "lacks_intervals", "smoothed_places", "tracks_in_worlds"]

#: Durations in rows are rounded by less than this.
_ROUNDED_NS: Final = 1000
#: An end is in the middle if it is farther from the border of the seen area than this, and than its way of so long.
_BORDER_M, _BORDER_S, _BORDER_FRAMES = 0.5, 1.0, 2
#: The motion at an end is that of so many samples.
_SAMPLES: Final = 3
#: Another track may go on after so many seconds, no farther away than by this speed and distance.
_GOES_ON_S, _GOES_ON_M_PER_S, _GOES_ON_M = 30.0, 2.0, 1.5
#: There are so many hidden people to one who was tracked, times the square of the share (at most so large) of those
#: who are first seen in the middle. (Chosen on drawn scenes.)
_HIDDEN, _MOST_LATE = 3.3, 0.3
#: Worlds are drawn with this seed and their number.
_SEED: Final = 2012


class WorldTracks(NamedTuple):
    """The rows (R,) of a world, ordered by track and frame, from samples.

    What a row has are the values of the sample ``before``, and ``share`` of the way from there to ``after``: 0 at a
    sample, from 0 to 1 in a gap, below 0 where a track begins earlier or ends later than it was seen.
    ``observed`` are samples. ``late`` and ``lost`` are the shares of tracks that begin, and that end, in the middle of
    the seen area and don't go on from another one, or as one.
    """

    track: Ints
    frame: Ints
    before: Ints
    after: Ints
    share: Floats
    observed: Bools
    late: float
    lost: float

    @property
    def people(self) -> int:
        """The number of tracks."""
        return len(np.unique(self.track))

    def values(self, samples: Floats) -> Floats:
        """The values of samples (N, ...) in each row (R, ...)."""
        share = self.share.reshape(-1, *[1] * (samples.ndim - 1))
        start = samples[self.before]
        return np.asarray(np.where(share == 0, start, start + share * (samples[self.after] - start)))


def smoothed_places(source: Ints, t_ns: Ints, xy_m: Floats, smoothed: Rows, smoothed_ns: Ints) -> Floats:
    """Places (N, 2) of samples, those that re-tracking gave them in its rows ``smoothed``; others stay at ``xy_m``.

    Samples are of the tracks ``source`` (N,) at ``t_ns`` (N,), and rows at ``smoothed_ns``.
    """
    at, xy_m = find_rows((smoothed["source_id"], smoothed_ns), (source, t_ns)), xy_m.copy()
    xy_m[at >= 0] = np.stack([smoothed[name][at[at >= 0]] for name in ("x_m", "y_m")], axis=1)
    return xy_m


def tracks_in_worlds(
    source: Ints,
    class_id: Ints,
    frame: Ints,
    xy_m: Floats,
    t_ns: Ints,
    worlds: Rows | Mapping[str, NDArray[Any]],
    begin_ns: Ints,
) -> Iterator[WorldTracks]:
    """The tracks of each world.

    Parameters
    ----------
    source, class_id, frame : (N,) of int
        The input id, the class and the frame of each sample.
    xy_m : (N, 2) of float
    t_ns : (F,) of int
        The times of frames.
    worlds : Rows, or a mapping with their columns
        Rows of Worlds; ``begin_ns`` are their times.
    """
    track, own = _tracklets(source, frame, t_ns, worlds, begin_ns)
    seen = _Seen.of(xy_m, (track >= 0).mean(axis=0)[own] >= 0.5)
    for world, names in enumerate(track):
        name = names[own]
        kept = np.flatnonzero(name >= 0)
        kept = kept[np.lexsort((frame[kept], name[kept]))]
        yield _World(name[kept], frame[kept], kept, xy_m[kept], class_id[kept], t_ns, seen, world).tracks()


def _tracklets(
    source: Ints, frame: Ints, t_ns: Ints, rows: Rows | Mapping[str, NDArray[Any]], begin_ns: Ints
) -> tuple[Ints, Ints]:
    """The track of each tracklet in each world (W, K + 1), -1 for none, and the tracklet of each sample (N,)."""
    frames = len(t_ns) + 1
    begin = np.searchsorted(t_ns, begin_ns)
    (of_source, first), which = np.unique(np.stack([rows["source_id"], begin]), axis=1, return_inverse=True)
    numbers, world = np.unique(rows["world"], return_inverse=True)
    track = np.full((len(numbers), len(of_source) + 1), -1)
    track[world, which.ravel()] = np.where(rows["kept"], rows["track_id"], -1)
    end = np.zeros(len(of_source), np.int64)
    until_ns = begin_ns + (rows["duration_s"] * NS_PER_S).astype(np.int64) + _ROUNDED_NS
    end[which.ravel()] = np.searchsorted(t_ns, until_ns, "right")
    sources = np.unique(of_source)
    begins = np.searchsorted(sources, of_source) * frames + first
    own = np.searchsorted(begins, np.searchsorted(sources, source) * frames + frame, "right") - 1
    while (ended := (own >= 0) & (of_source[own] == source) & (frame >= end[own])).any():
        own[ended] -= 1  # the tracklet before goes on beside the one that has ended
    is_own = (own >= 0) & (of_source[own] == source)
    return track, np.where(is_own, own, len(of_source))


class _Seen(NamedTuple):
    """The seen area: a convex polygon as half planes (E, 3), and how deep each sample is inside (N,), in metres."""

    planes: Floats
    depth: Floats

    @classmethod
    def of(cls, xy_m: Floats, usual: Bools) -> _Seen:
        """Around the ``usual`` samples; without an extent all is at its border."""
        from scipy.spatial import ConvexHull, QhullError

        planes = np.array([[0.0, 0.0, 0.0]])
        around = xy_m[usual & np.isfinite(xy_m).all(axis=1)]
        if len(around) > 2:
            with suppress(QhullError):
                planes = ConvexHull(around).equations
        return cls(planes, cls.inside(planes, xy_m))

    @staticmethod
    def inside(planes: Floats, xy_m: Floats) -> Floats:
        """The distance of places (N, 2) from the border, below 0 outside."""
        out = np.full(len(xy_m), np.inf)
        for x, y, offset in planes:
            out = np.minimum(out, -(x * xy_m[:, 0] + y * xy_m[:, 1] + offset))
        return out


#: The track, the frame, the samples before and after, and the share of rows.
_Rows = tuple[Ints, Ints, Ints, Ints, Floats]


class _World:
    """A world: its samples (N,) ordered by track and frame, and what is drawn about the ends of its tracks (T,)."""

    def __init__(
        self,
        track: Ints,
        frame: Ints,
        sample: Ints,
        xy_m: Floats,
        class_id: Ints,
        t_ns: Ints,
        seen: _Seen,
        world: int,
    ) -> None:
        self.frame, self.sample, self.xy_m, self.planes = frame, sample, xy_m, seen.planes
        self.s = (t_ns - t_ns[:1]) / NS_PER_S
        self.rng = np.random.default_rng([_SEED, world])
        starts = run_starts(track)
        self.first, self.last = np.flatnonzero(starts), np.flatnonzero(run_ends(starts))
        self.of, self.names = np.cumsum(starts) - 1, track[starts]
        self.depth, self.class_id = seen.depth[sample], class_id
        self.begins, self.before_begin = self._in_the_middle(self.first, 1)
        self.ends, self.after_end = self._in_the_middle(self.last, -1)

    def _in_the_middle(self, end: Ints, way: int) -> tuple[Bools, Ints]:
        """Which ends (T,) of tracks are in the middle of what was seen, and the sample that tells the motion there."""
        inner = np.clip(end + way * _SAMPLES, self.first, self.last)
        seconds = np.abs(self.s[self.frame[inner]] - self.s[self.frame[end]])
        moved_m = np.hypot(*(self.xy_m[inner] - self.xy_m[end]).T)
        speed = np.divide(moved_m, seconds, out=np.zeros(len(end)), where=seconds > 0)
        frames = np.minimum(self.frame[end], len(self.s) - 1 - self.frame[end])
        return (self.depth[end] > _BORDER_M + _BORDER_S * speed) & (frames > _BORDER_FRAMES), inner

    def tracks(self) -> WorldTracks:
        """Draw which tracks go on as others, how long people were unseen, and who was not seen at all."""
        go_on = float(self.rng.random()) ** 0.5  # most do; the other explanation stays likely
        goes_on, root = self._joined(self.rng.random(len(self.names)) < go_on)
        begins, ends = self.begins & (root == np.arange(len(root))), self.ends & ~goes_on
        rows = np.arange(len(self.frame))
        parts = [
            (root[self.of], self.frame, rows, rows, np.zeros(len(rows))),
            self._unseen(begins, self.first, self.before_begin, -1, root),
            self._unseen(ends, self.last, self.after_end, 1, root),
            self._never_seen(int(begins.sum()), len(np.unique(root))),
        ]
        track, frame, before, after, share = (np.concatenate(values) for values in zip(*parts, strict=True))
        order = np.lexsort((frame, track))
        track, frame, before, after, share = (values[order] for values in (track, frame, before, after, share))
        others = self.names.max(initial=0) + 1 + np.arange(track.max(initial=0) + 1)
        names = np.append(self.names, others)  # of those who were never tracked others than all tracks have
        late, lost = (float(those.mean()) if len(those) else 0.0 for those in (begins, ends))
        return WorldTracks(*self._filled(names[track], frame, before, after, share, order < len(rows)), late, lost)

    def _joined(self, wanted: Bools) -> tuple[Bools, Ints]:
        """Which tracks (T,) go on as another one, and the first track of each (T,)."""
        count, root = len(self.names), np.arange(len(self.names))
        goes_on = np.zeros(count, bool)
        enders, beginners = np.flatnonzero(self.ends), np.flatnonzero(self.begins & wanted)
        end_s, begin_s = self.s[self.frame[self.last[enders]]], self.s[self.frame[self.first[beginners]]]
        order = np.argsort(end_s, kind="stable")
        enders, end_s = enders[order], end_s[order]
        low, high = np.searchsorted(end_s, begin_s - _GOES_ON_S), np.searchsorted(end_s, begin_s)
        before, after = enders[ragged_range(low, high - low)], np.repeat(beginners, high - low)
        gap_s = np.repeat(begin_s, high - low) - self.s[self.frame[self.last[before]]]
        apart_m = np.hypot(*(self.xy_m[self.first[after]] - self.xy_m[self.last[before]]).T)
        near = apart_m < _GOES_ON_M + _GOES_ON_M_PER_S * gap_s
        near &= self.class_id[self.first[after]] == self.class_id[self.first[before]]
        before, after, gap_s, apart_m = before[near], after[near], gap_s[near], apart_m[near]
        cost = apart_m / (1 + gap_s / 2) + np.log(gap_s) + self.rng.gumbel(size=len(gap_s)) / 2
        order = np.argsort(cost, kind="stable")
        before, after = before[order], after[order]
        while len(before):  # the best of all, and of those that are left
            chosen = np.intersect1d(np.unique(before, return_index=True)[1], np.unique(after, return_index=True)[1])
            root[after[chosen]] = before[chosen]
            goes_on[before[chosen]] = True
            left = ~np.isin(before, before[chosen]) & ~np.isin(after, after[chosen])
            before, after = before[left], after[left]
        while (root != root[root]).any():
            root = root[root]
        return goes_on, root

    def _unseen(self, are: Bools, end: Ints, inner: Ints, way: int, root: Ints) -> _Rows:
        """The rows before or after some ends of tracks: one is anywhere within a gap as tracks have that go on."""
        which = np.flatnonzero(are)
        gaps = np.diff(self.frame)[np.diff(self.of) == 0] - 1
        gaps = gaps[gaps > 0]
        if not len(gaps):
            which = which[:0]
        steps = self.rng.choice(gaps, len(which)) if len(which) else which
        at, to = end[which], inner[which]
        room = self.frame[at] if way < 0 else len(self.s) - 1 - self.frame[at]
        steps = np.minimum(np.round(steps * self.rng.random(len(which))).astype(np.int64), room)
        rows, step = np.repeat(np.arange(len(which)), steps), ragged_range(np.ones(len(steps), np.int64), steps)
        at, to, track = at[rows], to[rows], root[which][rows]
        frame = self.frame[at] + way * step
        from_s, to_s = self.s[self.frame[at]], self.s[self.frame[to]]
        share = np.divide(self.s[frame] - from_s, to_s - from_s, out=np.zeros(len(at)), where=to_s != from_s)
        places = self.xy_m[at] + share[:, None] * (self.xy_m[to] - self.xy_m[at])
        inside = _Seen.inside(self.planes, places) > 0
        return track[inside], frame[inside], at[inside], to[inside], share[inside]

    def _never_seen(self, late: int, people: int) -> _Rows:
        """The rows of people who were never tracked, by how many were tracked ``late``: as tracks, at other times.

        With tracks chosen by the places of ends and gaps, or by how near others are, intervals are not narrower.
        """
        share = min(late / max(people, 1), _MOST_LATE)
        more = int(self.rng.poisson(_HIDDEN * share**2 * people))
        like = self.rng.integers(0, max(len(self.names), 1), more)
        at = ragged_range(self.first[like], sizes := self.last[like] - self.first[like] + 1)
        room = len(self.s) - 1 - self.frame[self.last[like]] + self.frame[self.first[like]]
        shift = np.floor(self.rng.random(more) * (room + 1)).astype(np.int64) - self.frame[self.first[like]]
        track = np.repeat(len(self.names) + np.arange(more), sizes)
        return track, self.frame[at] + np.repeat(shift, sizes), at, at, np.zeros(len(at))

    def _filled(
        self, track: Ints, frame: Ints, before: Ints, after: Ints, share: Floats, observed: Bools
    ) -> tuple[Ints, Ints, Ints, Ints, Floats, Bools]:
        """With rows on a straight line in the frames between those of a track."""
        gap = np.flatnonzero((track[1:] == track[:-1]) & (np.diff(frame) > 1))
        steps = frame[gap + 1] - frame[gap] - 1
        here = np.repeat(gap, steps)
        between = ragged_range(frame[gap] + 1, steps)
        times = self.s[frame[here]], self.s[between], self.s[frame[here + 1]]
        part = np.ones(len(here)) * (times[1] - times[0]) / (times[2] - times[0])
        track, frame = np.append(track, track[here]), np.append(frame, between)
        before, after = np.append(before, before[here]), np.append(after, before[here + 1])
        share, observed = np.append(share, part), np.append(observed, np.zeros(len(here), bool))
        order = np.lexsort((frame, track))
        sides = self.sample[before[order]], self.sample[after[order]]
        return track[order], frame[order], *sides, share[order], observed[order]


#: Intervals of counts, and of other numbers, are wider than 90 % of the worlds by this share of the median on both
#: sides, for what worlds get wrong alike. (Chosen on drawn scenes, as are the values below.)
WIDER, WIDER_MEAN = 0.06, 0.1
#: There are no intervals for fewer people; where larger shares of tracks begin, and end, in the middle of the seen area
#: even if all go on that can; and where some worlds have so many times more people than others.
_FEW, _LATE, _LOST, _APART = 15, 0.1, 0.4, 3.0


class WorldInterval(NamedTuple):
    """The ``median`` of a number in all worlds, and an interval of 90 % from ``low`` to ``high``; None for none."""

    median: float | None
    low: float | None
    high: float | None

    @classmethod
    def of(cls, values: ArrayLike, is_count: bool = False, has_none: bool = False) -> WorldInterval:
        """Find the interval of the ``values`` of all worlds (W,), NaN for none; that of a count has whole ends.

        With ``has_none`` there is the median alone.
        """
        some = np.asarray(values, float)
        some = some[~np.isnan(some)]
        if not len(some):
            return cls(None, None, None)
        low, middle, high = np.quantile(some, (0.05, 0.5, 0.95)).tolist()
        if has_none:
            return cls(middle, None, None)
        wider = (WIDER if is_count else WIDER_MEAN) * abs(middle)
        low, high = low - wider, high + wider
        low = low if some.min() < 0 else max(low, 0.0)
        return cls(middle, float(np.floor(low)), float(np.ceil(high))) if is_count else cls(middle, low, high)

    def to_json(self) -> dict[str, float | None]:
        """As values of JSON."""
        return {"median": self.median, "from": self.low, "to": self.high}

    def words(self, digits: int = 0, unit: str = "") -> str:
        """As text: the median, of counts also a half, and the interval in brackets; none for none."""
        if self.median is None:
            return ""
        middle = f"{self.median:.{digits}f}" if digits else f"{self.median:.12g}"
        return middle + ("" if self.low is None else f" ({self.low:.{digits}f} to {self.high:.{digits}f})") + unit


def lacks_intervals(worlds: Sequence[tuple[int, float, float]]) -> bool:
    """Whether the log can't tell how sure numbers are; then it is said why.

    Of each world there are the number of its people, and the shares of tracks that are ``late`` and ``lost`` (see
    ``WorldTracks``).
    """
    people, late, lost = np.array(worlds, float).T
    low, middle, high = np.quantile(people, (0.05, 0.5, 0.95)).tolist()
    least_late, least_lost = np.quantile([late, lost], 0.05, axis=1).tolist()
    if middle < _FEW:
        why = f"there are only {middle:g} people; how often they are missed can't be told from fewer than {_FEW}"
    elif high > _APART * low:
        why = f"there are {low:g} to {high:g} people, by which tracks are taken for some"
    elif least_late > _LATE or least_lost > _LOST:
        share, verbs = (least_late, "begin") if least_late > _LATE else (least_lost, "end")
        why = (
            f"{share:.0%} of the tracks {verbs} in the middle of the seen area, away from others that may be the same "
            "person; many people may never be tracked"
        )
    else:
        return False
    notices.warn(f"numbers have no intervals: {why}", "not-compared")
    return True
