"""The ground tracker: tracks of objects in metres, in a frame that doesn't move.

Letters: N detections, K tracks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from types import MappingProxyType
from typing import ClassVar, Final, Literal

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Indices
from mcaptrack.geometry.assignment import max_weight_matching
from mcaptrack.geometry.clocks import JUMP_S, NS_PER_S
from mcaptrack.geometry.neighbours import Pairing
from mcaptrack.geometry.oriented_boxes import bev_iou_of_pairs
from mcaptrack.notices import warn
from mcaptrack.schema import COVARIANCE_M2, DETECTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.framing import join_frames
from mcaptrack.transforms.ground.output import Waiting
from mcaptrack.transforms.ground.state import (
    AGE_S,
    BOX,
    CLASS,
    DETECTION_ROWS,
    FIRST,
    GATE_M,
    HEADING,
    HITS,
    ID,
    IS_CONFIRMED,
    LAST,
    LAST_FRAME,
    LAST_SPREAD,
    LAST_VELOCITY,
    LENGTH,
    MAX_SPEED,
    MISSED_S,
    NOISE,
    SCORE,
    SCORES,
    SPEED,
    TURNS,
    Covariances,
    GroundTracks,
    X,
    Y,
    certainty,
    measured,
    no_tracks,
    own_covariances,
    variance,
)
from mcaptrack.transforms.motion_limits import (
    LIMITS_HELP,
    LIMITS_PATTERN,
    ClassNames,
    MotionLimits,
    limits_by_class,
    read_limits,
)
from mcaptrack.transforms.protocol import check_options, context, option, setting

_ASSOCIATION: Final = "Association"
_DETECTIONS: Final = "Detections"
_LIFE: Final = "Begin and end of tracks"
#: Tracks that are not confirmed end after this many seconds without a detection.
_TENTATIVE_S: Final = 0.6
#: Number of frames that are converted at once.
_BLOCK_FRAMES: Final = 64
#: Columns of detections in the order of the rows of ``state``.
_COLUMNS: Final = (
    "x_m",
    "y_m",
    "z_m",
    "length_m",
    "width_m",
    "height_m",
    "heading_rad",
    "vx_m_per_s",
    "vy_m_per_s",
    "score",
    "class_id",
    "source_id",
)


# Which detection belongs to which track: gates, costs and one assignment for all classes of a frame.
#
# Pairs of different classes are outside the gate, so that one assignment of all is one for each class. Detections
# that are left are compared once more, with lost tracks of other classes: detectors confuse classes now and then.
#
# Letters: K tracks, N detections, P pairs.


Cost = Literal["metres", "iou"]

#: The gate in squared standard deviations, and that between different classes.
_GATE: Final = 16.0
_OTHER_GATE: Final = 9.0
#: How much of the gate in metres counts between different classes.
_OTHER_SHARE: Final = 0.4
#: The gain of a pair without any distance.
_GAIN: Final = 30.0
#: Scores count as probabilities from this one to 1 minus it.
_LEAST_SCORE: Final = 0.02
#: Detections that a track of another class needs before.
_OTHER_HITS: Final = 2


def associate(
    table: Floats,
    detections: Floats,
    cost: Cost,
    min_iou: float,
    across_classes: bool,
    covariances: Covariances | None = None,
) -> tuple[Indices, Indices, Bools]:
    """Tracks and detections that belong together, (P,) each, and whether they have the same class.

    With the ``covariances`` of the tracks, these and those of the detections count instead of usual ones.
    """
    if not table.shape[1] or not detections.shape[1]:
        nothing = np.empty(0, np.intp)
        return nothing, nothing, np.empty(0, bool)
    reach = table[GATE_M] * (1 + table[MISSED_S])
    pairs = Pairing(table[[X, Y]], detections[[X, Y]], reach)
    apart = _Apart(table, detections, covariances, pairs)
    same = pairs.of_first(table[CLASS]) == pairs.of_second(detections[CLASS])
    near = apart.within(_GATE, reach)
    if across_classes:
        same = np.ones_like(same)
    track, row = _assigned(table, detections, apart, near & same, cost, min_iou)
    is_same = np.ones(len(track), bool)
    if across_classes or len(row) == detections.shape[1]:
        return track, row, is_same
    lost, free = table[HITS] >= _OTHER_HITS, np.ones(detections.shape[1], bool)
    lost[track], free[row] = False, False
    if not lost.any() or len({*table[CLASS].tolist(), *detections[CLASS].tolist()}) == 1:
        return track, row, is_same
    other = near & pairs.of_first(lost) & pairs.of_second(free)
    if not other.any():
        return track, row, is_same
    nearer = apart.within(_OTHER_GATE, np.maximum(_OTHER_SHARE * reach, 3 * table[NOISE]))
    more = _assigned(table, detections, apart, other & nearer, cost, min_iou)
    is_same = np.concatenate([is_same, np.zeros(len(more[0]), bool)])
    return np.concatenate([track, more[0]]), np.concatenate([row, more[1]]), is_same


class _Apart:
    """Distances of detections (rows, N) from the predicted positions of tracks (rows, K), for each of their pairs."""

    def __init__(self, table: Floats, detections: Floats, covariances: Covariances | None, pairs: Pairing) -> None:
        self.pairs = pairs
        x = pairs.of_second(detections[X]) - pairs.of_first(table[X])
        y = pairs.of_second(detections[Y]) - pairs.of_first(table[Y])
        self._squared = x * x + y * y
        self._spread = variance(table)
        self._deviations: Floats | None = None
        if covariances is not None:
            place = pairs.of_first(covariances.places())
            noise = pairs.of_first(measured(table[NOISE], detections[:0]).T) + pairs.of_second(
                own_covariances(detections).T
            )
            xx, xy, yy = place + noise
            #: Twice the log-odds that detections are true; their scores are probabilities.
            share = np.clip(certainty(detections), _LEAST_SCORE, 1 - _LEAST_SCORE)
            self._odds = 2 * np.log(share / (1 - share))
            self._area = xx * yy - xy * xy
            self._deviations = (yy * x * x - 2 * xy * x * y + xx * y * y) / self._area

    def within(self, gate: float, reach_m: Floats) -> Bools:
        """Whether pairs are within ``gate`` squared standard deviations, and ``reach_m`` of their track (K,)."""
        if self._deviations is None:
            return np.asarray(self._squared <= self.pairs.of_first(np.minimum(gate * self._spread, reach_m * reach_m)))
        return np.asarray((self._deviations <= gate) & (self._squared <= self.pairs.of_first(reach_m * reach_m)))

    def gain(self, which: Bools, track: Indices, row: Indices) -> Floats:
        """The gain of the chosen pairs (P,): twice the logarithm of their likelihood, but for a constant.

        Where detections have covariances it is twice that of a ratio: to the detection being false.
        """
        if self._deviations is None:
            s = self._spread[track]
            return np.asarray(_GAIN - self._squared[which] / s - 2 * np.log(s))
        return np.asarray(_GAIN - self._deviations[which] - np.log(self._area[which]) + self._odds[row])


def _assigned(
    table: Floats, detections: Floats, apart: _Apart, allowed: Bools, cost: Cost, min_iou: float
) -> tuple[Indices, Indices]:
    """The best assignment of the allowed pairs."""
    track, row = apart.pairs.chosen(allowed)
    if not len(track):
        return track, row
    if cost == "iou":
        gain = bev_iou_of_pairs(table[BOX, track].T, detections[BOX, row].T)
        good = gain >= max(min_iou, 1e-6)
        track, row, gain = track[good], row[good], gain[good]
    else:
        gain = apart.gain(allowed, track, row)
    if not len(track):
        return track, row
    (track, row), _ = max_weight_matching((track, row), np.round(gain, 6), apart.pairs.shape)
    return track, row


@dataclass(frozen=True, kw_only=True)
class GroundTracker:
    """Track detections in metres, such as the 3D boxes of a robot's detector.

    Reads detections with positions in metres, writes tracks with positions, sizes, headings and velocities. Detections
    are assigned on the ground plane, a class at a time, to the positions that Kalman filters predict: at constant
    velocity, and on arcs for vehicles. Limits of their motion come from a table by class.

    Detections of several cameras have covariances, by which they are gated, compared and weighted, and scores that are
    probabilities; from the first such detection on each track has a covariance over both axes.

    Rows are written ``delay_s`` late: a track is written from its first detection on if it is confirmed in that time,
    and gaps that end in it are interpolated.

    Examples
    --------
    A car drives 10 m/s and is missed once; a false box is seen once:

    >>> from mcaptrack.schema import DETECTIONS, Frame
    >>> def row(t):
    ...     x_m = [float(t)] if t != 4 else [500.0]
    ...     return DETECTIONS.rows(x_m=x_m, y_m=[0.0], score=[0.8], class_id=[3])
    >>> frames = [Frame(t * 100_000_000, t, row(t)) for t in range(8)]
    >>> tracks = [frame.rows for (frame,) in GroundTracker(class_names=((3, "car"),))(frames)]
    >>> [rows["track_id"].tolist() for rows in tracks]
    [[1], [1], [1], [1], [1], [1], [1], [1]]
    >>> [bool(rows["observed"][0]) for rows in tracks]
    [True, True, True, True, False, True, True, True]

    References
    ----------
    X. Weng et al., "3D Multi-Object Tracking: A Baseline and New Evaluation Metrics", IROS 2020; Z. Pang et al.,
    "SimpleTrack: Understanding and Rethinking 3D Multi-object Tracking", ECCV Workshops 2022; R. A. Singer,
    "Estimating Optimal Tracking Filter Performance for Manned Maneuvering Targets", IEEE T-AES 1970.
    """

    max_age_s: float = option(
        1.6, "a track ends after this many seconds without a detection", least=0.0, search=(0.2, 4.0), theme=_LIFE
    )
    delay_s: float = setting(
        1.0,
        "rows are written this many seconds late, so that false births are taken back and short gaps are filled; 0 for "
        "results that depend on the past alone",
        least=0.0,
        theme=_LIFE,
    )
    link_s: float = setting(
        8.0,
        "a new track continues a lost one that it fits, up to this many seconds after its last detection; 0 for never",
        least=0.0,
        theme=_LIFE,
    )
    confirm_score: float = setting(
        0.9,
        "a track is confirmed once the scores of its detections add up to this; detections without a score count 0.5",
        least=0.0,
        search=(0.3, 4.0),
        theme=_LIFE,
    )
    birth_score: float = setting(
        0.2,
        "detections with a lower score continue tracks, but start none",
        least=0.0,
        most=1.0,
        search=(0.0, 0.8),
        theme=_LIFE,
    )
    cost: Cost = setting(
        "metres",
        "how detections and tracks are compared: distance of their centres, or overlap of their boxes seen from above",
        theme=_ASSOCIATION,
    )
    min_iou: float = option(
        0.05,
        "with cost iou: least overlap (IoU) of a detection with a track's predicted box",
        least=0.0,
        most=1.0,
        theme=_ASSOCIATION,
    )
    min_score: float | None = option(None, "ignore detections with a lower score", theme=_DETECTIONS)
    class_id: int | None = setting(
        None, "ignore detections of other classes", least=0, most=2**31 - 1, theme=_DETECTIONS
    )
    across_classes: bool = option(
        False,
        "a track may continue with a detection of another class; it then has the class of most of its detections",
        theme=_DETECTIONS,
    )
    class_limits: str = option("", LIMITS_HELP, pattern=LIMITS_PATTERN, theme=_ASSOCIATION)
    class_names: ClassNames = context(tuple, is_recorded=False)

    reads: ClassVar[Schema] = DETECTIONS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": TRACKS})
    #: Trackers associate in the "picture" (pixels) or on the "ground" (metres).
    space: ClassVar[str] = "ground"

    def __post_init__(self) -> None:
        check_options(self)
        read_limits(self.class_limits)

    @property
    def latency_s(self) -> MappingProxyType[str, float]:
        """Rows are final once they are written."""
        return MappingProxyType({"": self.delay_s})

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        run = _Run(self)
        coming = iter(frames)
        while block := list(islice(coming, _BLOCK_FRAMES)):
            for frame, boxes in zip(block, run.detections(block), strict=True):
                run.step(frame, boxes)
            yield from ((frame,) for frame in run.waiting.written())
        run.waiting.release(np.inf)
        yield from ((frame,) for frame in run.waiting.written())
        run.warn()

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why there are no tracks, for a warning."""
        count = sum(len(frame.rows) for frame in given)
        return f"no track of {count} detections is confirmed (confirm_score)"


# New tracks of fast objects: second detections that are beyond the gate, because no velocity is known yet.
#
# After one detection an object may be anywhere that it can reach at the highest speed of its class. That is too far
# for the gate of tracks: on a motorway, or at few frames a second, the next detection is several metres away. So
# what is left after the association is looked at once more. A vehicle moves along its length, and its detections
# have one heading and size; of other objects, pairs count that could be no others.
#
# Letters: K tracks, N detections, P pairs.


#: How far a vehicle moves across its heading, as a share of the way, and beyond this many standard deviations of noise.
_ACROSS: Final = 0.15
_NOISE: Final = 4.0
#: How much two headings of an object differ at most, in rad, up to half a turn; and two lengths, as a ratio.
_TURNED_RAD: Final = 0.35
_LENGTHS: Final = 1.6
#: How much longer a way backwards counts than one ahead.
_BACKWARDS: Final = 2.0


def fast_starts(
    table: Floats, detections: Floats, taken: tuple[Indices, Indices], across_classes: bool
) -> tuple[Indices, Indices]:
    """Tracks with one detection (rows, K), and detections (rows, N) of the same objects: numbers of both, (P,) each.

    Those of ``taken``, which are associated already, are no others.
    """
    nothing = np.empty(0, np.intp)
    if len(taken[1]) == detections.shape[1]:
        return nothing, nothing
    is_free, is_left = table[HITS] == 1, np.ones(detections.shape[1], bool)
    is_free[taken[0]] = is_left[taken[1]] = False
    if not is_free.any():
        return nothing, nothing
    first, left = is_free.nonzero()[0], is_left.nonzero()[0]
    old, new = table[:, first], detections[:, left]
    reach = old[MAX_SPEED] * old[MISSED_S] + _NOISE * old[NOISE]
    pairs = Pairing(old[FIRST], new[[X, Y]], reach)
    x = pairs.of_second(new[X]) - pairs.of_first(old[FIRST][0])
    y = pairs.of_second(new[Y]) - pairs.of_first(old[FIRST][1])
    far, noise = np.hypot(x, y), _NOISE * pairs.of_first(old[NOISE])
    can_be = far <= pairs.of_first(old[MAX_SPEED] * old[MISSED_S]) + noise
    if not across_classes:
        can_be &= pairs.of_first(old[CLASS]) == pairs.of_second(new[CLASS])
    if not can_be.any():
        return nothing, nothing
    heading, other_heading = pairs.of_first(old[HEADING]), pairs.of_second(new[HEADING])
    along, across = x * np.cos(heading) + y * np.sin(heading), np.abs(y * np.cos(heading) - x * np.sin(heading))
    cost = np.where(along < 0, _BACKWARDS * far, far)
    has_heading = np.isfinite(heading) & np.isfinite(other_heading) & pairs.of_first(old[TURNS] == 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        turned = np.abs(np.sin(heading - other_heading))
        longer = np.abs(np.log(pairs.of_first(old[LENGTH]) / pairs.of_second(new[LENGTH])))
        is_along = (across <= noise + _ACROSS * far) & (turned <= np.sin(_TURNED_RAD)) & ~(longer > np.log(_LENGTHS))
    can_be &= np.where(has_heading, is_along, _is_only(can_be, pairs))
    i, j = pairs.chosen(can_be)
    if not len(i):
        return nothing, nothing
    gain = cost[can_be].max() + 1 - cost[can_be]
    (i, j), _ = max_weight_matching((i, j), np.round(gain, 6), pairs.shape)
    return first[i], left[j]


def _is_only(can_be: Bools, pairs: Pairing) -> Bools:
    """Mask the pairs of a track and a detection that are both in no other pair."""
    track, row = pairs.chosen(can_be)
    out = can_be.copy()
    out[can_be] = (np.bincount(track)[track] == 1) & (np.bincount(row)[row] == 1)
    return out


# Lost tracks: which of them a new track continues, after an occlusion that lasted longer than tracks coast.
#
# A lost track either stood still and is where it was, or has gone on at its last velocity, less certainly the
# longer and the faster. A new track continues the lost track that makes its first position likely, unless another
# object is more likely to be there. Everything is computed from the past alone.
#
# Letters: K lost tracks, N new tracks.


#: How much velocities change within a second during an occlusion: at rest, as a share of the usual speed, and with
#: speed, as a share of it.
_DRIFT_AT_REST: Final = 0.07
_DRIFT_WITH_SPEED: Final = 0.1
#: A track stood still if it was slower than this share of the usual speed; then it stays with this probability.
_REST: Final = 0.12
_STAYS: Final = 0.8
#: How far an object at rest seems to move, in metres per square root of a second.
_CREEP_M: Final = 0.15
#: The density of new objects: their number in a square with the distance of one second at the usual speed as side.
_NEW: Final = 0.06


class LostTracks:
    """Confirmed tracks that ended at most ``link_s`` seconds after their last detection."""

    def __init__(self, link_s: float) -> None:
        self._link_s = link_s
        self.table: Floats = no_tracks()

    def add(self, table: Floats) -> None:
        """Remember tracks that end, (rows, K)."""
        self.table = np.concatenate([self.table, table], axis=1)

    def wait(self, dt: float) -> None:
        """Let ``dt`` seconds pass."""
        if self.table.shape[1]:
            self.table[MISSED_S] += dt
            self.keep(self.table[MISSED_S] <= self._link_s)

    def keep(self, which: Bools) -> None:
        """Keep some of the tracks."""
        self.table = self.table.compress(which, axis=1)


def continuations(lost: Floats, new: Floats) -> tuple[Indices, Indices]:
    """Lost tracks (rows, K) and new ones (rows, N) that continue them: numbers of both, (P,) each."""
    if not lost.shape[1] or not new.shape[1]:
        nothing = np.empty(0, np.intp)
        return nothing, nothing
    # Farther than twice the way of a second, from where a track was or would be, none of the two densities below is
    # above that of new objects, however long the gap is.
    longest = np.maximum(lost[MISSED_S] - new[AGE_S].min(), 1e-3)
    pairs = Pairing(lost[LAST][:2], new[FIRST], 2 * lost[SPEED] + np.hypot(*lost[LAST_VELOCITY]) * longest)
    gap = pairs.of_first(lost[MISSED_S]) - pairs.of_second(new[AGE_S])
    seconds = np.maximum(gap, 1e-3)
    way = pairs.of_second(new[FIRST]) - pairs.of_first(lost[LAST][:2])
    velocity, usual = pairs.of_first(lost[LAST_VELOCITY]), pairs.of_first(lost[SPEED])
    speed = np.hypot(*velocity)
    noise = 2 * pairs.of_first(lost[NOISE]) ** 2
    drift = _DRIFT_AT_REST * usual + _DRIFT_WITH_SPEED * speed
    goes = noise + pairs.of_first(lost[LAST_SPREAD]) * seconds**2 + drift**2 * seconds**3 / 3
    stays = noise + _CREEP_M**2 * seconds
    off = way - velocity * seconds
    share = np.where(speed < _REST * usual, _STAYS, 0.0)
    density = (1 - share) * np.exp(-(off * off).sum(0) / goes / 2) / goes
    density += share * np.exp(-(way * way).sum(0) / stays / 2) / stays
    gain = np.log(np.maximum(density / (2 * np.pi) * usual**2 / _NEW, 1e-12))
    fits = (gain > 0) & (gap > 0) & (pairs.of_first(lost[CLASS]) == pairs.of_second(new[CLASS]))
    i, j = pairs.chosen(fits)
    if not len(i):
        return i, j
    (i, j), _ = max_weight_matching((i, j), np.round(gain[fits], 6), pairs.shape)
    return i, j


class _Run:
    """The state of one run: its tracks, and the rows that are not written yet."""

    def __init__(self, options: GroundTracker) -> None:
        self._options = options
        self.tracks, self.waiting = GroundTracks(), Waiting()
        self._limits: dict[int, MotionLimits] = {}
        self._lost = LostTracks(options.link_s)
        self._last_ns: int | None = None
        self._frame, self._next_id = 0, 1
        self._left_out = 0

    def step(self, frame: Frame, detections: Floats) -> None:
        """Take one frame with these detections, (rows, N)."""
        options, tracks = self._options, self.tracks
        dt = 0.0 if self._last_ns is None else (frame.t_ns - self._last_ns) / NS_PER_S
        self._last_ns = frame.t_ns
        if len(detections) > DETECTION_ROWS:
            tracks.expect_covariances()
        if dt > max(JUMP_S, options.max_age_s, options.link_s):
            tracks.keep(np.zeros(len(tracks), bool))
        tracks.predict(dt)
        self._lost.wait(dt)
        track, row, is_same = associate(
            tracks.table, detections, options.cost, options.min_iou, options.across_classes, tracks.covariances
        )
        fast, at = fast_starts(tracks.table, detections, (track, row), options.across_classes)
        if len(fast):
            tracks.allow_speed(fast)
            track, row = np.concatenate([track, fast]), np.concatenate([row, at])
            is_same = np.concatenate([is_same, np.ones(len(fast), bool)])
        if len(track):
            before, after = tracks.update(track, detections.take(row, axis=1), is_same, self._frame)
            # One more detection has to be where the velocity says before such a track is confirmed.
            tracks.table[SCORES, fast] = before[SCORES, len(track) - len(fast) :]
            self.waiting.close_gaps(before, after, self._frame, frame.t_ns)
        count = detections.shape[1]
        if len(row) < count:
            starts = ~(detections[SCORE] < options.birth_score)  # a missing score is not lower
            starts[row] = False
            self._initiate(detections[:, starts])
        table = tracks.table
        is_found = table[LAST_FRAME] == self._frame
        is_new = (table[IS_CONFIRMED] == 0) & (table[SCORES] >= options.confirm_score)
        if is_new.any():
            is_found = is_found[self._confirm(is_new)]
            table = tracks.table
        self.waiting.add(frame, table[: ID + 1].compress(is_found, axis=1))
        if not is_found.all():
            age_s = np.where(table[IS_CONFIRMED] == 1, options.max_age_s, min(_TENTATIVE_S, options.max_age_s))
            is_over = table[MISSED_S] > np.maximum(age_s, 1.5 * dt)
            if is_over.any():
                self._lost.add(table.compress(is_over & (table[IS_CONFIRMED] == 1), axis=1))
                tracks.keep(~is_over)
        self._frame += 1
        self.waiting.release(frame.t_ns - options.delay_s * NS_PER_S)

    def _confirm(self, is_new: Bools) -> Bools:
        """Confirm tracks (K,), some of which continue lost ones; returns which tracks are still there."""
        tracks, lost = self.tracks, self._lost
        new, table = is_new.nonzero()[0], tracks.table
        ids = table[ID, new]
        missed = ((table[IS_CONFIRMED] == 1) & (table[LAST_FRAME] < self._frame)).nonzero()[0]
        kept = np.ones(len(tracks), bool)
        if self._options.link_s > 0:
            pool = np.concatenate([lost.table, table[:, missed]], axis=1)
            old, which = continuations(pool, table[:, new])
            tracks.continue_tracks(new[which], pool[:, old])
            count = lost.table.shape[1]
            is_left = np.ones(count, bool)
            is_left[old[old < count]] = False
            lost.keep(is_left)
            kept[missed[old[old >= count] - count]] = False
        table[IS_CONFIRMED, new] = 1
        self.waiting.confirm(ids, table[ID, new])
        if not kept.all():
            tracks.keep(kept)
        return kept

    def _initiate(self, detections: Floats) -> None:
        """Start a track at each of these detections, (rows, N)."""
        count = detections.shape[1]
        if not count:
            return
        if new := {int(number) for number in np.unique(detections[CLASS])} - self._limits.keys():
            self._limits |= limits_by_class(sorted(new), self._options.class_names, self._options.class_limits)
        self.tracks.initiate(self._next_id, detections, self._limits, self._frame)
        self._next_id += count

    def detections(self, frames: Sequence[Frame]) -> Iterator[Floats]:
        """For each frame the detections that are used, in an order of their own: (rows, N)."""
        joined, options = join_frames(DETECTIONS, frames), self._options
        rows = joined.rows
        table = np.stack([rows[name] for name in _COLUMNS], dtype=float)
        xx, xy, yy = covariances = np.stack([rows[name] for name in COVARIANCE_M2])
        is_given = (xx > 0) & (yy > 0) & (xy * xy < xx * yy) & np.isfinite(covariances).all(axis=0)
        has_any = np.bincount(joined.frame, is_given, len(frames)) > 0
        if has_any.any():
            table = np.concatenate([table, np.where(is_given, covariances, np.nan)])
        used = np.isfinite(table[X]) & np.isfinite(table[Y])
        self._left_out += len(rows) - int(used.sum())
        if options.min_score is not None:
            used &= ~(table[SCORE] < options.min_score)
        if options.class_id is not None:
            used &= table[CLASS] == options.class_id
        order = np.lexsort((*table[::-1], joined.frame))
        order = order[used[order]]
        table = table.take(order, axis=1)
        ends = np.append(0, np.cumsum(np.bincount(joined.frame[order], minlength=len(frames)))).tolist()
        for low, high, has_covariances in zip(ends[:-1], ends[1:], has_any.tolist(), strict=True):
            yield table[: None if has_covariances else DETECTION_ROWS, low:high]

    def warn(self) -> None:
        """Warn of detections without a position in metres."""
        if self._left_out:
            warn(f"{self._left_out} detections have no position in metres, and no track", "left-out")
