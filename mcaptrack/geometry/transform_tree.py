"""Frames of reference and how they move: a tree of transforms over time.

A pose (R, p) of the frame ``source`` in the frame ``target`` maps points of the source to points of the target:
x' = R x + p. Letters: N times or points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.transform_series import PoseSamples, Reason, TransformSeries, clean

#: The most frames of a loop that are named.
_SHOWN = 8

__all__ = ["PoseSamples", "Poses", "Reason", "Recorded", "Remark", "TransformTree", "plain_frame"]


def plain_frame(name: str) -> str:
    """Return the name of a frame without the leading slash that ROS 1 allowed."""
    return name.removeprefix("/")


class Recorded(NamedTuple):
    """The recorded poses of ``child`` in ``parent``; ``is_latched``: they hold until the next, as on /tf_static."""

    parent: str
    child: str
    is_latched: bool
    samples: PoseSamples


class Remark(NamedTuple):
    """A contradiction, gap or jump among transforms, as a clause, and the frames that it concerns."""

    text: str
    frames: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of a frame in another at N times.

    ``rotation`` (N, 3, 3) and ``translation`` (N, 3), in metres, are NaN where the pose isn't known. ``reason`` (N,)
    says why (``Reason``), and ``unknown`` in words, with the number of times.
    """

    rotation: Floats
    translation: Floats
    reason: Ints
    unknown: Mapping[str, int]

    @property
    def is_known(self) -> Bools:
        """Whether each pose is known, (N,)."""
        return np.asarray(self.reason == Reason.KNOWN)

    def apply(self, points: Floats) -> Floats:
        """Return points of the source, one at each time (N, 3), in the target; NaN where the pose isn't known."""
        return turned(self.rotation, points) + self.translation


def turned(rotation: Floats, vectors: Floats) -> Floats:
    """Return vectors (N, 3), each turned by its own rotation (N, 3, 3)."""
    return np.asarray(np.einsum("nij,nj->ni", rotation, vectors))


class TransformTree:
    """Frames, each with the poses over time in its parent: several trees, if there are several roots.

    Parameters
    ----------
    recorded : sequence of Recorded
        All poses of a log. What contradicts other poses is left out, and said in ``remarks``: of several parents of a
        frame those with fewer messages, and the transform that closes a loop.
    on_log_time : bool
        Whether the times of poses are those of the log instead of their stamps.

    """

    def __init__(self, recorded: Sequence[Recorded], *, on_log_time: bool = False) -> None:
        self._recorded = recorded
        self._remarks: list[Remark] = []
        self.series: dict[str, TransformSeries] = {}
        self._latched = {(plain_frame(edge.parent), plain_frame(edge.child)) for edge in recorded if edge.is_latched}
        is_off = [not edge.is_latched and edge.samples.is_off_clock() for edge in recorded]
        is_timed = any(not edge.is_latched and not off for edge, off in zip(recorded, is_off, strict=True))
        by_child: dict[str, list[TransformSeries]] = {}
        for edge, off in zip(recorded, is_off, strict=True):
            parent, child = plain_frame(edge.parent), plain_frame(edge.child)
            if not parent or not child or parent == child:
                about = "itself" if parent and child else "a frame without a name"
                self._remark(
                    f"{_count(len(edge.samples.stamp_ns))} of {child or parent!r} in {about} are left out", child
                )
                continue
            is_moved = off and is_timed and bool(edge.samples.stamp_ns.any())
            series, clauses = clean(parent, child, edge.samples, edge.is_latched, on_log_time or is_moved)
            if is_moved and not on_log_time:
                clauses.insert(0, "its stamps are of another clock than the others', so that the log time is taken")
            for clause in clauses:
                self._remark(f"{parent} -> {child}: {clause}", child)
            if series is not None:
                by_child.setdefault(child, []).append(series)
        for child, several in sorted(by_child.items()):
            self.series[child] = self._chosen(child, several)
        self._break_loops()

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """Contradictions, gaps and jumps among the transforms."""
        return tuple(self._remarks)

    @cached_property
    def on_log_time(self) -> TransformTree:
        """A tree of the same transforms that uses log times instead of stamps."""
        return TransformTree(self._recorded, on_log_time=True)

    @cached_property
    def span_ns(self) -> tuple[int, int] | None:
        """The first and last time of the frames that move; None if none does."""
        moving = [series for series in self.series.values() if not series.is_static]
        if not moving:
            return None
        return min(int(series.t_ns[0]) for series in moving), max(int(series.t_ns[-1]) for series in moving)

    def frames(self) -> list[str]:
        """Return the names of all frames."""
        return sorted(self.series.keys() | {series.parent for series in self.series.values()})

    @cached_property
    def _children(self) -> Mapping[str, list[str]]:
        """The frames below each frame."""
        children: dict[str, list[str]] = {}
        for child, series in sorted(self.series.items()):
            children.setdefault(series.parent, []).append(child)
        return children

    def roots(self) -> list[str]:
        """Return the frames without a parent, those with the most frames below first."""
        below: dict[str, int] = {}
        for root in self._children.keys() - self.series.keys():
            waiting = [root]
            while waiting:
                children = self._children.get(waiting.pop(), [])
                waiting += children
                below[root] = below.get(root, 0) + len(children)
        return sorted(below, key=lambda root: (-below[root], root))

    def children_of(self, frame: str) -> list[str]:
        """Return the frames that have this one as parent."""
        return list(self._children.get(plain_frame(frame), ()))

    def root_of(self, frame: str) -> str:
        """Return the root above a frame: the frame itself if it has no parent, or if there is no such frame."""
        return self.chain_of(frame)[-1]

    def chain_of(self, frame: str) -> list[str]:
        """Return a frame, its parent, the parent of that, and so on, up to a root."""
        chain = [plain_frame(frame)]
        while chain[-1] in self.series:
            chain.append(self.series[chain[-1]].parent)
        return chain

    def between(self, target: str, source: str) -> list[TransformSeries] | None:
        """Return the transforms on the way from one frame to another; None if they aren't connected."""
        parts = self._parts(target, source)
        return None if parts is None else [*parts[0], *parts[1]]

    def remarks_between(self, target: str, source: str) -> list[Remark]:
        """Return the remarks on the transforms between two frames, and on why a root between them is one."""
        way = self.between(target, source)
        frames = {*self.chain_of(target), *self.chain_of(source)}
        if way is not None:
            frames = {series.child for series in way} | ({plain_frame(target)} - self.series.keys())
        return [remark for remark in self._remarks if not frames.isdisjoint(remark.frames)]

    def lookup(self, target: str, source: str, stamps_ns: Ints) -> Poses:
        """Return the poses of ``source`` in ``target`` at times (N,) in nanoseconds.

        They are interpolated; see ``TransformSeries.at`` for where they are known.
        """
        from scipy.spatial.transform import Rotation

        stamps_ns = np.asarray(stamps_ns, np.int64)
        number, counts = len(stamps_ns), {}
        reason = np.zeros(number, np.int64)
        parts = self._parts(target, source)
        if parts is None or not number:
            reason[:] = Reason.UNCONNECTED
            nothing = {f"no transform connects {plain_frame(source)} with {plain_frame(target)}": number}
            empty = np.full((number, 3, 3), np.nan)
            return Poses(empty, empty[:, 0].copy(), reason, nothing if number else {})
        ends = []
        for way in parts:
            turn, shift = Rotation.identity(number), np.zeros((number, 3))
            for series in way:
                rotation, translation, why = series.at(stamps_ns)
                turn, shift = rotation * turn, rotation.apply(shift) + translation
                is_new = (reason == Reason.KNOWN) & (why != Reason.KNOWN)
                for code in np.unique(why[is_new]).tolist():
                    counts[f"{_WHERE[code]} {series}"] = int((why[is_new] == code).sum())
                reason[is_new] = why[is_new]
            ends.append((turn, shift))
        (turn, shift), (base, origin) = ends
        back = base.inv()
        matrix, moved = (back * turn).as_matrix(), back.apply(shift - origin)
        is_unknown = reason != Reason.KNOWN
        matrix[is_unknown], moved[is_unknown] = np.nan, np.nan
        return Poses(matrix, moved, reason, counts)

    def _parts(self, target: str, source: str) -> tuple[list[TransformSeries], list[TransformSeries]] | None:
        """Return the transforms from the source, and from the target, up to the first frame above both."""
        up, down = self.chain_of(source), self.chain_of(target)
        shared = next((frame for frame in up if frame in down), None)
        if shared is None:
            return None
        ways = (up[: up.index(shared)], down[: down.index(shared)])
        return [self.series[frame] for frame in ways[0]], [self.series[frame] for frame in ways[1]]

    def _chosen(self, child: str, several: list[TransformSeries]) -> TransformSeries:
        """Choose among several transforms of a frame: a moving one, then the one with the most messages."""
        best = min(several, key=lambda series: (series.is_static, -series.messages, series.parent))
        others = {series.parent: series.messages for series in several if series.parent != best.parent}
        if others:
            named = " and ".join(f"{parent} ({_count(count)})" for parent, count in sorted(others.items()))
            taken = f"{best.parent} ({_count(best.messages)})"
            self._remark(f"{child} has several parents: {taken} is taken, and {named} left out", child)
        elif len(several) > 1:
            self._remark(f"{best} is both static and not: the one that moves is taken", child)
        return best

    def _break_loops(self) -> None:
        """Leave out the transform with the fewest messages of each loop; of those on /tf_static one is enough."""
        done: set[str] = set()
        for first in sorted(self.series):
            way: list[str] = []
            frame = first
            while frame in self.series and frame not in done:
                done.add(frame)
                way.append(frame)
                frame = self.series[frame].parent
            if frame in way:
                loop = way[way.index(frame) :]
                weakest = min(loop, key=self._strength)
                names = [*reversed([*loop, loop[0]])]
                hidden = max(len(names) - _SHOWN, 0)
                text = " -> ".join(names[:_SHOWN]) + (f" (and {hidden:,} more)" if hidden else "")
                self._remark(f"the frames {text} form a loop: {self.series[weakest]} is left out", *loop)
                del self.series[weakest]

    def _strength(self, child: str) -> tuple[bool, int, str]:
        series = self.series[child]
        return (series.parent, child) in self._latched, series.messages, child

    def _remark(self, text: str, *frames: str) -> None:
        self._remarks.append(Remark(text, frames))


_WHERE: Mapping[int, str] = {
    Reason.BEFORE: "before the first transform",
    Reason.AFTER: "after the last transform",
    Reason.GAP: "in a gap or jump of",
}


def _count(messages: int) -> str:
    return f"{messages:,} message{'' if messages == 1 else 's'}"
