"""Frames of reference and how they move: a tree of transforms over time.

A pose (R, p) of the frame ``source`` in the frame ``target`` maps points of the source to points of the target:
x' = R x + p. Letters: N times or points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Indices, Ints, taken
from mcaptrack.geometry.clocks import NS_PER_S

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

#: The most frames of a loop that are named.
_SHOWN = 8


def plain_frame(name: str) -> str:
    """Return the name of a frame without the leading slash that ROS 1 allowed."""
    return name.removeprefix("/")


# One transform over time: the poses of a frame in its parent, cleaned, and interpolated at any time.
#
# A pose (R, p) maps points of the frame to points of its parent: x' = R x + p. Letters: M recorded poses, N times.


#: Poses are interpolated over at most this time, or ``_GAP_INTERVALS`` usual intervals if those are longer, but never
#: over more than ``_MAX_GAP_S``. A car that brakes at 3 m/s2 is then off by 0.1 m at most.
GAP_S: Final = 0.5
_GAP_INTERVALS: Final = 3
_MAX_GAP_S: Final = 10.0
#: Poses are extrapolated by at most this time, and by at most one usual interval.
EXTRAPOLATED_S: Final = 0.1
#: A step is a jump if it is longer than this, beyond twice the step that the speed around it explains.
_JUMP_M: Final = 0.5
_JUMP_RAD: Final = 0.26
#: Accelerations that explain a step, in m/s2 and rad/s2.
_ACCELERATION: Final = 10.0
_SPIN: Final = 20.0
#: Number of steps on each side from which the usual speed follows.
_AROUND: Final = 2
#: Stamps that go back by less are messages out of order; by more, the clock was set back.
_TIME_TRAVEL_S: Final = 1.0
#: Stamps that are farther from the log time are of another clock.
OTHER_CLOCK_S: Final = 60.0
#: Quaternions with a length that differs from 1 by more are reported; shorter ones are no rotation.
_UNIT: Final = 1e-2
#: A clock was set back if so many poses in a row are that old.
_SET_BACK: Final = 3
#: Poses are the same if their positions differ by less (m), and the product of their quaternions from 1.
_SAME_M: Final = 1e-9
_SAME_TURN: Final = 1e-14


class Reason(IntEnum):
    """Why a pose isn't known."""

    KNOWN = 0
    BEFORE = 1
    AFTER = 2
    GAP = 3
    UNCONNECTED = 4


class PoseSamples(NamedTuple):
    """Poses as they were recorded, in the order of the log.

    ``stamp_ns`` and ``log_ns`` (M,), ``translation`` (M, 3) in metres, ``quaternion`` (M, 4) as x, y, z, w.
    """

    stamp_ns: Ints
    log_ns: Ints
    translation: Floats
    quaternion: Floats

    def is_off_clock(self) -> bool:
        """Whether the stamps are of another clock than the log time, or missing."""
        away = np.median(np.abs(self.log_ns - self.stamp_ns)) if len(self.stamp_ns) else 0
        return bool(away > OTHER_CLOCK_S * NS_PER_S)


@dataclass(frozen=True, eq=False)
class TransformSeries:
    """The poses of ``child`` in ``parent``: at increasing times ``t_ns`` (M,), at least one.

    If ``is_static``, each pose holds until the next one, and the first and the last for ever; else there are at least
    two. ``messages`` is the number of recorded poses.
    """

    parent: str
    child: str
    is_static: bool
    messages: int
    t_ns: Ints
    translation: Floats
    quaternion: Floats

    def __str__(self) -> str:
        return f"{self.parent} -> {self.child}"

    @cached_property
    def interval_s(self) -> float:
        """The usual time between two poses; NaN if there is one pose."""
        return float(np.median(np.diff(self.t_ns))) / NS_PER_S if len(self.t_ns) > 1 else float("nan")

    @cached_property
    def rotation(self) -> Rotation:
        """The rotations, (M,)."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(self.quaternion)

    @cached_property
    def _steps(self) -> tuple[Floats, Floats]:
        """The lengths of the steps between poses, (M - 1,) each: in metres, and in radians."""
        moved = np.linalg.norm(np.diff(self.translation, axis=0), axis=1)
        return moved, (self.rotation[:-1].inv() * self.rotation[1:]).magnitude()

    @cached_property
    def gaps(self) -> Indices:
        """The steps that take too long to interpolate."""
        if self.is_static:
            return np.empty(0, np.intp)
        longest = min(max(GAP_S, _GAP_INTERVALS * self.interval_s), _MAX_GAP_S)
        return np.flatnonzero(np.diff(self.t_ns) > longest * NS_PER_S)

    @cached_property
    def jumps(self) -> Indices:
        """The steps far beyond the speed before and after, as when a localisation is reset. Gaps aren't among them."""
        if self.is_static:
            return np.empty(0, np.intp)
        step_s = np.maximum(np.diff(self.t_ns) / NS_PER_S, self.interval_s)
        is_jump = np.zeros(len(step_s), bool)
        for step, least, push in zip(self._steps, (_JUMP_M, _JUMP_RAD), (_ACCELERATION, _SPIN), strict=True):
            usual = _usual_speed(step / step_s) * step_s
            is_jump |= step > 2 * usual + least + push / 2 * step_s**2
        is_jump[self.gaps] = False
        return np.flatnonzero(is_jump)

    def step_sizes(self, which: Indices) -> tuple[Floats, Floats]:
        """Return how far steps go, in metres and radians."""
        return self._steps[0][which], self._steps[1][which]

    def at(self, t_ns: Ints) -> tuple[Rotation, Floats, Ints]:
        """Return the poses at times (N,): rotations, translations (N, 3), and for each a ``Reason``.

        Between two poses, translations are interpolated linearly and rotations on the shortest arc. Beyond the first
        and last pose, and into gaps and jumps from either side, the motion is continued for at most one usual interval
        and ``EXTRAPOLATED_S``. Poses are arbitrary where the reason isn't KNOWN.
        """
        reason = np.zeros(len(t_ns), np.int64)
        last = len(self.t_ns) - 1
        index = np.clip(np.searchsorted(self.t_ns, t_ns, side="right") - 1, 0, max(last - 1, 0))
        if self.is_static:
            index = np.clip(np.searchsorted(self.t_ns, t_ns, side="right") - 1, 0, last)
            return self.rotation[index], self.translation[index], reason
        is_broken = np.zeros(last, bool)
        is_broken[self.gaps] = is_broken[self.jumps] = True
        is_second = 2 * (t_ns - self.t_ns[index]) > self.t_ns[index + 1] - self.t_ns[index]
        near = index + is_second  # the recorded pose that is nearest
        beyond_ns = np.abs(t_ns - self.t_ns[near])
        is_before, is_after = t_ns < self.t_ns[0], t_ns > self.t_ns[-1]
        is_outside = is_before | is_after | is_broken[index]
        is_far = is_outside & (beyond_ns > min(self.interval_s, EXTRAPOLATED_S) * NS_PER_S)
        reason[is_far] = Reason.GAP
        reason[is_far & is_before] = Reason.BEFORE
        reason[is_far & is_after] = Reason.AFTER
        # Into a break, the step on the other side of the nearest pose is continued, if that is none itself.
        step = np.clip(np.where(is_broken[index], np.where(is_second, index + 1, index - 1), index), 0, last - 1)
        length_ns = self.t_ns[step + 1] - self.t_ns[step]
        share = np.clip((t_ns - self.t_ns[step]) / length_ns, -1.0, 2.0)
        share = np.where(is_broken[step], near - step, share)
        before, after = self.rotation[step], self.rotation[step + 1]
        from scipy.spatial.transform import Rotation

        turned = Rotation.from_rotvec(share[:, None] * (before.inv() * after).as_rotvec())
        moved = self.translation[step] + share[:, None] * (self.translation[step + 1] - self.translation[step])
        return before * turned, moved, reason


def _usual_speed(speed: Floats) -> Floats:
    """Return the median of the speeds before and after each step, (M,)."""
    padded = np.pad(speed, _AROUND, constant_values=np.nan)
    shifts = [shift for shift in range(2 * _AROUND + 1) if shift != _AROUND]
    around = np.stack([padded[shift : shift + len(speed)] for shift in shifts])
    around[:, np.isnan(around).all(axis=0)] = np.inf  # a single step can't be compared
    return np.asarray(np.nanmedian(around, axis=0))


def clean(
    parent: str, child: str, samples: PoseSamples, is_latched: bool, on_log_time: bool = False
) -> tuple[TransformSeries | None, list[str]]:
    """Return the series of recorded poses, and findings, each a clause about it; None if no pose is left.

    ``is_latched``: the poses hold from when they were published, as on /tf_static. With ``on_log_time``, the log time
    takes the place of stamps.
    """
    findings: list[str] = []
    messages = len(samples.stamp_ns)
    length = np.linalg.norm(samples.quaternion, axis=1)
    with np.errstate(invalid="ignore"):
        is_pose = np.isfinite(samples.translation).all(axis=1) & np.isfinite(length) & (length > _UNIT)
    if not is_pose.all():
        findings.append(f"{_count(int((~is_pose).sum()), 'pose')} without a rotation or a position are left out")
        samples, length = taken(samples, np.flatnonzero(is_pose)), length[is_pose]
    if not len(length):
        return None, findings
    if (count := int((np.abs(length - 1) > _UNIT).sum())) > 0:
        findings.append(f"{_count(count, 'quaternion')} of another length than 1 are normalised")
    samples = samples._replace(quaternion=samples.quaternion / length[:, None])
    if not is_latched and samples.stamp_ns.any() and not samples.stamp_ns.all() and not on_log_time:
        findings.append(f"{_count(int((samples.stamp_ns == 0).sum()), 'pose')} without a stamp are left out")
        samples = taken(samples, np.flatnonzero(samples.stamp_ns))
    if on_log_time or not samples.stamp_ns.any():
        if not on_log_time and not is_latched:
            findings.append("its stamps are 0, so that the log time is taken")
        samples = samples._replace(stamp_ns=samples.log_ns)
    if is_latched or _is_constant(samples):
        series, more = _static(parent, child, samples, messages)
        if not is_latched and messages == 1:
            more.append("it has one message, which is taken for all times")
    else:
        series, more = _dynamic(parent, child, samples, messages)
    return series, findings + more


def _is_constant(samples: PoseSamples) -> bool:
    """Return whether all poses are the same: a frame that never moves, even if it is published again and again."""
    moved = np.abs(samples.translation - samples.translation[0]).max()
    alike = np.abs(samples.quaternion @ samples.quaternion[0]).min()
    return bool(moved <= _SAME_M and 1 - alike <= _SAME_TURN)


def _static(parent: str, child: str, samples: PoseSamples, messages: int) -> tuple[TransformSeries, list[str]]:
    has_stamps = samples.stamp_ns.all() and (np.diff(samples.stamp_ns) >= 0).all()
    since = samples.stamp_ns if has_stamps else samples.log_ns
    is_new = np.append(True, _differs(samples))
    kept = taken(samples, np.flatnonzero(is_new))
    series = TransformSeries(parent, child, True, messages, since[is_new], kept.translation, kept.quaternion)
    many = f"it is static, but changes {_count(len(kept.stamp_ns) - 1, 'time')}; each pose is taken until the next"
    return series, [many] if len(kept.stamp_ns) > 1 else []


def _dynamic(parent: str, child: str, samples: PoseSamples, messages: int) -> tuple[TransformSeries, list[str]]:
    samples, findings = _one_pass(samples)
    order = np.argsort(samples.stamp_ns, kind="stable")
    samples = taken(samples, order)
    is_last = np.append(np.diff(samples.stamp_ns) > 0, True)
    if (differing := int((_differs(samples) & ~is_last[:-1]).sum())) > 0:
        findings.append(f"{_count(differing, 'stamp')} have several poses, of which the last is taken")
    kept = taken(samples, np.flatnonzero(is_last))

    def series_of(poses: PoseSamples) -> TransformSeries:
        is_static = len(poses.stamp_ns) == 1
        return TransformSeries(parent, child, is_static, messages, poses.stamp_ns, poses.translation, poses.quaternion)

    series = series_of(kept)
    if len(single := _single_outliers(series)):
        findings.append(f"{_count(len(single), 'pose')} far from those before and after are left out")
        series = series_of(taken(kept, np.delete(np.arange(len(kept.stamp_ns)), single)))
    if len(series.gaps):
        longest = float(np.diff(series.t_ns)[series.gaps].max()) / NS_PER_S
        text = f"{_count(len(series.gaps), 'gap')}, the longest of {longest:.3g} s"
        findings.append(f"it has {text}; no pose is known there")
    if len(series.jumps):
        metres, turn = series.step_sizes(series.jumps)
        most = int(metres.argmax() if metres.max() > _JUMP_M else turn.argmax())
        size = f"{metres[most]:.2g} m" if metres[most] > _JUMP_M else f"{np.degrees(turn[most]):.0f} degrees"
        at_s = series.t_ns[series.jumps[most] + 1] / NS_PER_S
        findings.append(f"it jumps {_count(len(series.jumps), 'time')}, farthest by {size} at {at_s:.3f} s")
    return series, findings


def _single_outliers(series: TransformSeries) -> Indices:
    """Return the single poses that a frame jumps to, and from which it jumps back."""
    jumps = series.jumps
    jumped = jumps[:-1][np.diff(jumps) == 1] + 1
    before, after = series.translation[jumped - 1], series.translation[jumped + 1]
    moved, turned = series.step_sizes(jumped)
    apart = np.linalg.norm(after - before, axis=1)
    between = (series.rotation[jumped - 1].inv() * series.rotation[jumped + 1]).magnitude() if len(jumped) else turned
    is_back = (apart <= moved / 2 + _SAME_M) & (between <= turned / 2 + _JUMP_RAD)
    back: Indices = jumped[is_back]
    return back[np.diff(back, prepend=-2) > 1]


def _one_pass(samples: PoseSamples) -> tuple[PoseSamples, list[str]]:
    """Leave out poses recorded again after a clock was set back: the longest pass over a time is kept."""
    stamps = samples.stamp_ns
    starts, newest, back = [0], int(stamps[0]), 0
    for number, stamp in enumerate(stamps.tolist()):
        back = back + 1 if newest - stamp > _TIME_TRAVEL_S * NS_PER_S else 0
        if back == _SET_BACK:  # a clock that was set back stays there, unlike a late message
            starts.append(number + 1 - back)
            newest, back = stamp, 0
        newest = max(newest, stamp) if not back else newest
    if len(starts) == 1:
        return samples, []
    ends = [*starts[1:], len(stamps)]
    is_kept = np.zeros(len(stamps), bool)
    spans: list[tuple[int, int]] = []
    for start, end in sorted(zip(starts, ends, strict=True), key=lambda span: span[0] - span[1]):
        part = stamps[start:end]
        is_new = np.ones(len(part), bool)
        for first, last in spans:
            is_new &= (part < first) | (part > last)
        is_kept[start:end] = is_new
        spans.append((int(part.min()), int(part.max())))
    back_s = max(int(stamps[:start].max()) - int(stamps[start]) for start in starts[1:]) / NS_PER_S
    told = f"its clock goes back {_count(len(starts) - 1, 'time')}, by up to {back_s:.3g} s"
    left_out = _count(int((~is_kept).sum()), "pose")
    return taken(samples, np.flatnonzero(is_kept)), [f"{told}; {left_out} of times that it had before are left out"]


def _differs(samples: PoseSamples) -> Bools:
    """Return whether each pose but the first differs from the one before, (M - 1,)."""
    moved = np.abs(np.diff(samples.translation, axis=0)).max(axis=1, initial=0.0)
    alike = np.abs((samples.quaternion[1:] * samples.quaternion[:-1]).sum(axis=1))
    return np.asarray((moved > _SAME_M) | (1 - alike > _SAME_TURN))


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


def _count(number: int, what: str = "message") -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"
