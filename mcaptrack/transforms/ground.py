"""The ground tracker: tracks of objects in metres, in a frame that doesn't move.

Letters: N detections, K tracks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice, pairwise
from types import MappingProxyType
from typing import ClassVar, Final, Literal, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Indices, Ints
from mcaptrack.geometry.assignment import max_weight_matching
from mcaptrack.geometry.boxes import bev_iou_of_pairs, wrapped
from mcaptrack.geometry.clocks import JUMP_S, NS_PER_S
from mcaptrack.geometry.neighbours import Pairing
from mcaptrack.geometry.ragged import group_index, ragged_range
from mcaptrack.notices import warn
from mcaptrack.schema import COVARIANCE_M2, DETECTIONS, TRACKS, Frame, Rows, Schema
from mcaptrack.schema.framing import join_frames, split_rows
from mcaptrack.transforms.fixed_lag import FixedLag, Measured, Written
from mcaptrack.transforms.motion_limits import (
    LIMITS_HELP,
    LIMITS_PATTERN,
    ClassNames,
    MotionLimits,
    limits_by_class,
    read_limits,
)
from mcaptrack.transforms.protocol import check_options, context, option, parameters, setting

_ASSOCIATION: Final = "Association"
_DETECTIONS: Final = "Detections"
_LIFE: Final = "Begin and end of tracks"
#: Tracks that are not confirmed end after this many seconds without a detection.
_TENTATIVE_S: Final = 0.6
#: Number of frames that are converted at once.
_BLOCK_FRAMES: Final = 64


# The tracks as arrays: motion, size, heading, class and life of each.
#
# The motion has the state position, velocity and acceleration. Noise is the same along both axes and no axis influences
# the other, so both have one covariance: six numbers for each track. The acceleration fades (Singer 1970); across the
# velocity it is that of an arc, so that a vehicle that turns is predicted on a circle. Classes that don't turn have no
# acceleration, which leaves a filter of constant velocity.
#
# Tracks are columns and numbers are rows. Letters: K tracks, N detections, C classes.


# Rows of detections.
X, Y, Z, LENGTH, WIDTH, HEIGHT, HEADING, VX, VY, SCORE, CLASS, SOURCE = range(12)
DETECTION_ROWS: Final = 12
#: Then xx, xy and yy of the covariances of positions.
_COVARIANCE_ROWS: Final = slice(DETECTION_ROWS, DETECTION_ROWS + 3)
PLACE: Final = slice(X, Y + 1)
#: Position, size and heading.
BOX: Final = slice(X, HEADING + 1)


_SIZE: Final = slice(LENGTH, HEIGHT + 1)

# Rows of tracks: those of detections first (velocities are those of the filter), then the rest.
(
    _AX, _AY, _PP, _PV, _PA, _VV, _VA, _AA, _COS, _SIN, _FACING, _SIZED,
    ID, SCORES, HITS, MISSED_S, LAST_FRAME, IS_CONFIRMED,
    NOISE, GATE_M, MAX_SPEED, _DRIFT, TURNS, SPEED, AGE_S, LAST_SPREAD,
) = range(DETECTION_ROWS, DETECTION_ROWS + 26)  # fmt: skip
#: The box at the last detection, the velocity then, and the position of the first.
LAST: Final = slice(LAST_SPREAD + 1, LAST_SPREAD + 8)
LAST_VELOCITY: Final = slice(LAST.stop, LAST.stop + 2)
FIRST: Final = slice(LAST_VELOCITY.stop, LAST_VELOCITY.stop + 2)
_ROWS: Final = FIRST.stop
_VELOCITY, _ACCELERATION = slice(VX, VY + 1), slice(_AX, _AY + 1)
_COVARIANCE: Final = slice(_PP, _AA + 1)

#: The seconds after which an acceleration has faded to 1 / e.
_FADES_S: Final = 2.0
#: The share of the drift of velocities that is noise; the rest is an acceleration that lasts.
_NOISE_SHARE: Final = 0.1
#: The largest turn rate in rad/s, and the speed in m/s below which an arc means nothing.
_MAX_TURN: Final = 0.9
_ARC_SPEED: Final = 1.5
#: Standard deviation in m/s of a velocity that the detector gave.
_GIVEN_SPEED: Final = 1.0
#: How fast mean sizes, heights and headings follow new detections, at the least.
_SIZE_RATE: Final = 0.05
_HEIGHT_RATE: Final = 0.3
_AXIS_RATE: Final = 0.25
#: The limit of what one detection changes of a size, as a ratio.
_SIZE_LIMIT: Final = 0.1
#: The number of sizes that count in full.
_FIRST_SIZES: Final = 3
#: The speed in m/s from which the direction of motion tells front from back.
_FACING_SPEED: Final = 1.0


def no_tracks() -> Floats:
    """A table without tracks, (rows, 0)."""
    return np.empty((_ROWS, 0))


class GroundTracks:
    """The tracks that are alive: ``table`` (rows, K), and the scores of the classes that each had, ``votes`` (C, K)."""

    def __init__(self) -> None:
        self.table: Floats = no_tracks()
        self.votes: Floats = np.zeros((0, 0))
        self._classes: dict[int, int] = {}

    def __len__(self) -> int:
        return int(self.table.shape[1])

    def keep(self, which: Bools) -> None:
        """Keep some of the tracks."""
        self.table, self.votes = self.table.compress(which, axis=1), self.votes.compress(which, axis=1)

    def predict(self, dt: float) -> None:
        """Predict all tracks by ``dt`` seconds."""
        t = self.table
        if dt <= 0 or not len(self):
            return
        _predict_covariance(t[_COVARIANCE], t[_DRIFT], t[TURNS], dt)
        fade = np.exp(-dt / _FADES_S)
        g, f = _FADES_S * (1 - fade), _FADES_S * (dt - _FADES_S * (1 - fade))
        vx, vy, ax, ay = t[VX], t[VY], t[_AX], t[_AY]
        if t[TURNS].any():
            squared = vx * vx + vy * vy
            turn = (vx * ay - vy * ax) / (squared + _ARC_SPEED**2)
            np.clip(turn, -_MAX_TURN, _MAX_TURN, out=turn)
            # what of the acceleration is no turn
            ax, ay = ax + turn * vy, ay - turn * vx
            angle = turn * (g if dt > 0.5 else dt)  # a turn ends, too
            sin, cos = np.sin(angle), np.cos(angle)
            half = np.sinc(angle / (2 * np.pi)) * dt
            ch, sh = np.cos(angle / 2), np.sin(angle / 2)
            t[X] += half * (ch * vx - sh * vy) + f * ax
            t[Y] += half * (sh * vx + ch * vy) + f * ay
            self._rotate(t, cos, sin)
            t[VX] += g * ax
            t[VY] += g * ay
            t[_ACCELERATION] *= fade
        else:
            t[PLACE] += dt * t[_VELOCITY]
        t[MISSED_S] += dt
        t[AGE_S] += dt

    def allow_speed(self, track: Indices) -> None:
        """Let tracks (N,) with one detection have any velocity that their class can have, not only usual ones."""
        t = self.table
        more, passed_s = t[MAX_SPEED, track] ** 2, t[MISSED_S, track]
        t[_PP, track] += more * passed_s**2
        t[_PV, track] += more * passed_s
        t[_VV, track] += more

    @staticmethod
    def _rotate(t: Floats, cos: Floats, sin: Floats) -> None:
        """Turn velocities, accelerations and headings; the heading is kept as a doubled angle."""
        for a, b in ((VX, VY), (_AX, _AY)):
            t[a], t[b] = cos * t[a] - sin * t[b], sin * t[a] + cos * t[b]
        cos2, sin2 = cos * cos - sin * sin, 2 * sin * cos
        t[_COS], t[_SIN] = cos2 * t[_COS] - sin2 * t[_SIN], sin2 * t[_COS] + cos2 * t[_SIN]

    def update(self, track: Indices, detections: Floats, is_same_class: Bools, frame: int) -> tuple[Floats, Floats]:
        """Correct tracks (N,) with one detection each, (rows, N), at a frame; returns their table before and after."""
        before = self.table.take(track, axis=1)
        t = before.copy()
        _correct(t, detections)
        self._vote(track, detections)
        weight = is_same_class.astype(float)
        _follow_box(t, detections, weight)
        t[SCORE], t[SOURCE] = detections[SCORE], detections[SOURCE]
        score = certainty(detections)
        t[SCORES] += score
        t[HITS] += 1
        t[MISSED_S] = 0
        t[LAST_FRAME] = frame
        t[LAST], t[LAST_VELOCITY], t[LAST_SPREAD] = t[BOX], t[_VELOCITY], t[_VV]
        t[CLASS] = self._winners(track, t[CLASS])
        self.table[:, track] = t
        return before, t

    def initiate(self, first_id: int, detections: Floats, limits: Mapping[int, MotionLimits], frame: int) -> None:
        """Start a track at each of these detections, (rows, N)."""
        count = detections.shape[1]
        t = np.zeros((_ROWS, count))
        t[:DETECTION_ROWS] = detections[:DETECTION_ROWS]
        rows = [limits[int(number)] for number in detections[CLASS].tolist()]
        t[NOISE] = [row.noise_m for row in rows]
        t[GATE_M] = [row.gate_m for row in rows]
        t[MAX_SPEED] = [row.max_speed_m_per_s for row in rows]
        t[_DRIFT] = [row.drift_m_per_s for row in rows]
        t[TURNS] = [row.turns for row in rows]
        t[SPEED] = [row.speed_m_per_s for row in rows]
        is_given = np.isfinite(detections[VX]) & np.isfinite(detections[VY])
        t[_VELOCITY] = np.where(is_given, detections[_VELOCITY], 0.0)
        t[_PP] = t[NOISE] ** 2
        t[_VV] = np.where(is_given, _GIVEN_SPEED, t[SPEED]) ** 2
        t[_AA] = (t[_DRIFT] * (1 - _NOISE_SHARE)) ** 2 * t[TURNS]
        has_heading = np.isfinite(detections[HEADING])
        angle = np.where(has_heading, detections[HEADING], 0.0)
        t[_COS], t[_SIN] = np.cos(2 * angle) * has_heading, np.sin(2 * angle) * has_heading
        t[_FACING] = np.where(has_heading, 1.0, 0.0)
        t[_SIZED] = np.isfinite(detections[LENGTH])
        t[ID] = np.arange(first_id, first_id + count)
        t[SCORES] = certainty(detections)
        t[HITS] = 1
        t[LAST_FRAME] = frame
        t[LAST], t[LAST_VELOCITY], t[LAST_SPREAD], t[FIRST] = t[BOX], t[_VELOCITY], t[_VV], t[PLACE]
        self.table = np.concatenate([self.table, t], axis=1)
        self.votes = np.concatenate([self.votes, np.zeros((len(self.votes), count))], axis=1)
        self._vote(np.arange(len(self) - count, len(self)), detections)

    def continue_tracks(self, which: Indices, lost: Floats) -> None:
        """Let tracks (N,) continue lost ones, (rows, N): they get their ids and sizes."""
        self.table[ID, which] = lost[ID]
        is_larger = lost[_SIZED] > self.table[_SIZED, which]
        self.table[_SIZE, which] = np.where(is_larger, lost[_SIZE], self.table[_SIZE, which])
        self.table[_SIZED, which] += lost[_SIZED]

    def _vote(self, track: Indices, detections: Floats) -> None:
        classes = detections[CLASS].tolist()
        for number in sorted(set(classes) - self._classes.keys()):
            self._classes[number] = len(self._classes)
            self.votes = np.concatenate([self.votes, np.zeros((1, self.votes.shape[1]))])
        which = [self._classes[number] for number in classes]
        self.votes[which, track] += certainty(detections)

    def _winners(self, track: Indices, before: Floats) -> Floats:
        """The class with the highest sum of scores, of each of some tracks (N,) with these classes (N,) before."""
        if len(self._classes) == 1:
            return before
        classes = np.array(list(self._classes))
        return np.asarray(classes[self.votes.take(track, axis=1).argmax(axis=0)], float)


def certainty(detections: Floats) -> Floats:
    """The scores (N,) of detections (rows, N); 0.5 for those without a score."""
    return np.where(np.isnan(detections[SCORE]), 0.5, detections[SCORE])


def variance(table: Floats) -> Floats:
    """The variance of the predicted measurement of each track, per axis, (K,)."""
    return np.asarray(table[_PP] + table[NOISE] ** 2)


def _predict_covariance(cov: Floats, drift: Floats, turns: Floats, dt: float) -> None:
    """Predict covariances (6, K) by ``dt`` seconds, in place."""
    fade = np.exp(-dt / _FADES_S)
    g, f = _FADES_S * (1 - fade), _FADES_S * (dt - _FADES_S * (1 - fade))
    pp, pv, pa, vv, va, aa = cov.copy()
    lasting = drift * (1 - _NOISE_SHARE) * turns
    power = (drift * (1 - (1 - _NOISE_SHARE) * turns)) ** 2
    cov[0] = pp + dt * (2 * pv + dt * (vv + dt * power / 3)) + f * (2 * pa + 2 * dt * va + f * aa)
    cov[1] = pv + dt * (vv + dt * power / 2) + g * pa + (f + dt * g) * va + f * g * aa
    cov[2] = fade * (pa + dt * va + f * aa)
    cov[3] = vv + dt * power + g * (2 * va + g * aa)
    cov[4] = fade * (va + g * aa)
    cov[5] = fade**2 * aa + (1 - fade**2) * lasting**2


def _correct(t: Floats, detections: Floats) -> None:
    """Correct the motion of tracks (rows, N) with the positions of detections, in place."""
    off = detections[PLACE] - t[PLACE]
    pp, pv, pa, vv, va, aa = t[_COVARIANCE].copy()
    s = pp + t[NOISE] ** 2
    kp, kv, ka = pp / s, pv / s, pa / s
    _move(t, kp * off, kv * off, ka * off)
    t[_COVARIANCE] = pp - kp * pp, pv - kp * pv, pa - kp * pa, vv - kv * pv, va - kv * pa, aa - ka * pa


def _move(t: Floats, place: Floats, velocity: Floats, acceleration: Floats) -> None:
    """Correct positions, velocities and accelerations of tracks (rows, N), in place, by (2, N) each."""
    t[PLACE] += place
    t[_VELOCITY] += velocity
    t[_ACCELERATION] += acceleration
    speed = np.hypot(t[VX], t[VY])
    t[_VELOCITY] *= np.minimum(1.0, t[MAX_SPEED] / np.maximum(speed, 1e-9))


def _follow_box(t: Floats, detections: Floats, weight: Floats) -> None:
    """Correct z, size and heading of tracks (rows, N), in place; sizes and headings with ``weight`` 0 don't count."""
    has_height = np.isfinite(detections[Z])
    step = np.where(has_height, _HEIGHT_RATE * (detections[Z] - np.where(np.isnan(t[Z]), detections[Z], t[Z])), 0.0)
    t[Z] = np.where(np.isnan(t[Z]), detections[Z], t[Z] + step)
    # Size: a mean with limited steps, which outliers move little.
    sized = np.isfinite(detections[LENGTH]) * weight
    t[_SIZED] += sized
    rate = np.maximum(_SIZE_RATE, 1 / np.maximum(t[_SIZED], 1))
    before = t[_SIZE]
    is_new = np.isnan(before)
    limit = np.where(is_new | (t[_SIZED] <= _FIRST_SIZES), np.inf, _SIZE_LIMIT * before)
    change = np.clip(np.where(np.isnan(detections[_SIZE]) | is_new, 0.0, detections[_SIZE] - before), -limit, limit)
    t[_SIZE] = np.where(is_new, detections[_SIZE], before + rate * change * weight)
    turned = np.isfinite(detections[HEADING]) * weight
    _follow_heading(t, np.where(turned > 0, detections[HEADING], 0.0), turned)


def _follow_heading(t: Floats, measured: Floats, turned: Floats) -> None:
    """Correct headings of tracks (rows, N), in place, by measured ones (N,) with weights (N,)."""
    # The axis as a doubled angle, and apart from it which of its ends is the front.
    rate = _AXIS_RATE * turned
    t[_COS] += rate * (np.cos(2 * measured) - t[_COS])
    t[_SIN] += rate * (np.sin(2 * measured) - t[_SIN])
    axis = np.arctan2(t[_SIN], t[_COS]) / 2
    before_axis = np.where(np.isnan(t[HEADING]), measured, t[HEADING])
    # The axis is known up to half a turn: the one that is nearer to the heading so far.
    axis = axis + np.pi * np.rint((before_axis - axis) / np.pi)
    speed = np.hypot(t[VX], t[VY])
    moves = (t[VX] * np.cos(axis) + t[VY] * np.sin(axis)) * t[TURNS]
    facing = 0.95 * t[_FACING] + turned * np.cos(measured - axis)
    facing += np.where(speed > _FACING_SPEED, 2 * moves / np.maximum(speed, 1e-9), 0.0)
    is_back = facing < 0
    heading = axis + np.pi * is_back
    t[_FACING] = np.abs(facing)
    has_heading = (t[_COS] != 0) | (t[_SIN] != 0)
    t[HEADING] = np.where(has_heading, wrapped(heading), np.nan)


# Rows that wait: a row is written once it is known whether its track is one, and gaps are closed meanwhile.
#
# Letters: K tracks, N rows, F frames that wait.


_OBSERVED, _ID = DETECTION_ROWS, DETECTION_ROWS + 1
_OUTPUT_ROWS = DETECTION_ROWS + 2


class _Gaps(NamedTuple):
    """Tracks (K,) that are detected again at a frame: their table before and after, (rows, K); the first frame of each
    gap, (K,), and the frame and the time at which they are detected.
    """

    before: Floats
    after: Floats
    first: Floats
    frame: int
    now_ns: int


class Waiting:
    """Frames and their rows that are not written yet. Frames are numbered from 0.

    ``add``, ``close_gaps`` and ``confirm`` tell what happens at one frame, ``release`` ends it; ``written`` gives
    frames for many of them at once.
    """

    def __init__(self) -> None:
        # The frames that are not written yet, the rows of tracks that were detected in each, and those in gaps.
        self._frames: list[Frame] = []
        self._rows: list[Floats] = []
        self._late, self._late_in = np.empty((_OUTPUT_ROWS, 0)), np.empty(0, np.int64)
        self._gaps: list[_Gaps] = []
        # The number of frames that were written and released so far; when each of those between was released, which is
        # counted in calls of ``release``.
        self._written = self._released = 0
        self._released_at: list[int] = []
        self._calls = 0
        # By id: what a track is written as, and since when it is confirmed.
        self._written_as, self._since = np.zeros(256, np.int64), np.zeros(256, np.int64)

    def confirm(self, ids: Floats, written_as: Floats) -> None:
        """Tracks of these ids (K,) are confirmed: their rows are written under other ids (K,), also those before."""
        if len(ids):
            while ids.max() >= len(self._written_as):
                self._written_as = np.concatenate([self._written_as, np.zeros_like(self._written_as)])
                self._since = np.concatenate([self._since, np.zeros_like(self._since)])
            self._written_as[ids.astype(np.int64)] = written_as
            self._since[ids.astype(np.int64)] = self._calls

    def add(self, frame: Frame, tracks: Floats) -> None:
        """Add a frame with the rows of the tracks that were detected in it, as of their table (rows, K)."""
        rows = np.empty((_OUTPUT_ROWS, tracks.shape[1]))
        rows[:DETECTION_ROWS] = tracks[:DETECTION_ROWS]
        rows[_OBSERVED], rows[_ID] = 1.0, tracks[ID]
        self._frames.append(frame)
        self._rows.append(rows)

    def close_gaps(self, before: Floats, after: Floats, frame: int, now_ns: int) -> None:
        """Interpolate tracks that are detected again, (rows, K) before and after: rows for the frames before ``frame``.

        ``now_ns`` is the time of this frame. Frames that were released already get none.
        """
        first = np.maximum(before[LAST_FRAME] + 1, self._released)
        (missed,) = (first < frame).nonzero()
        if len(missed):
            both = before.take(missed, axis=1), after.take(missed, axis=1)
            self._gaps.append(_Gaps(*both, first[missed], frame, now_ns))

    def release(self, until_ns: float) -> None:
        """Let frames up to a time be written, with the rows of the tracks that are confirmed by now."""
        while len(self._released_at) < len(self._frames):
            if self._frames[len(self._released_at)].t_ns > until_ns:
                break
            self._released_at.append(self._calls)
            self._released += 1
        self._calls += 1

    def written(self) -> list[Frame]:
        """The frames that were released since the last call: frames of Tracks, rows ordered by id within each."""
        if self._gaps:
            self._interpolate()
        count = len(self._released_at)
        frames, self._frames = self._frames[:count], self._frames[count:]
        own, self._rows = self._rows[:count], self._rows[count:]
        waits = self._late_in >= self._released
        rows = np.concatenate([self._late.compress(~waits, axis=1), *own], axis=1)
        number = np.append(self._late_in[~waits] - self._written, group_index([part.shape[1] for part in own]))
        self._late, self._late_in = self._late.compress(waits, axis=1), self._late_in[waits]
        ids = rows[_ID].astype(np.int64)
        written_id = np.minimum(ids, len(self._written_as) - 1)
        is_in_time = (ids == written_id) & (self._since[written_id] <= np.array(self._released_at, np.int64)[number])
        rows[_ID] = np.where(is_in_time, self._written_as[written_id], 0)
        self._written, self._released_at = self._released, []
        kept = rows[_ID] > 0
        return _to_frames(frames, rows.compress(kept, axis=1), number[kept])

    def _interpolate(self) -> None:
        """Make the rows in gaps."""
        before, after, first = (
            np.concatenate(parts, axis=-1) for parts in zip(*(gaps[:3] for gaps in self._gaps), strict=True)
        )
        times = np.array([gaps[3:] for gaps in self._gaps], np.int64)
        frame, now_ns = times.T.repeat([len(gaps.first) for gaps in self._gaps], axis=1)
        self._gaps = []
        count = frame - first.astype(np.int64)
        track, number = group_index(count), ragged_range(first, count)
        before, after = before.take(track, axis=1), after.take(track, axis=1)
        t_ns = np.array([frame.t_ns for frame in self._frames], np.int64)[number - self._written]
        ahead_s = (now_ns[track] - t_ns) / NS_PER_S
        share = 1 - ahead_s / np.maximum(before[MISSED_S], 1e-9)
        rows = np.empty((_OUTPUT_ROWS, len(track)))
        rows[:DETECTION_ROWS] = after[:DETECTION_ROWS]
        start, end = before[LAST], after[BOX]
        step = end - start
        step[HEADING] = wrapped(step[HEADING])
        rows[BOX] = start + share * step
        rows[HEADING] = wrapped(rows[HEADING])
        rows[[VX, VY]] = before[[VX, VY]] * (1 - share) + after[[VX, VY]] * share
        rows[SCORE], rows[SOURCE] = np.nan, -1.0
        rows[_OBSERVED], rows[_ID] = 0.0, after[ID]
        self._late = np.concatenate([self._late, rows], axis=1)
        self._late_in = np.append(self._late_in, number)


def _to_frames(frames: Sequence[Frame], table: Floats, number: Ints) -> list[Frame]:
    """Frames of Tracks, of rows (rows, N) and the index of the frame of each (N,)."""
    table = table.take(np.lexsort((table[_ID], number)), axis=1)
    out = TRACKS.empty(table.shape[1])
    for row, name in enumerate((*_COLUMNS, "observed", "track_id")):
        out[name] = table[row]
    ends = np.cumsum(np.bincount(number, minlength=len(frames)))
    return split_rows([f.t_ns for f in frames], [f.index for f in frames], out, ends)


def _written(done: Sequence[Written]) -> list[Frame]:
    """The frames of Tracks of frames that are decided."""
    if not done:
        return []
    number = group_index([len(part.track_id) for part in done])
    observed = np.concatenate([part.observed for part in done])
    table = np.concatenate([part.rows for part in done], axis=1)
    table[SCORE], table[SOURCE] = np.where(observed, table[SCORE], np.nan), np.where(observed, table[SOURCE], -1.0)
    ids = np.concatenate([part.track_id for part in done])
    return _to_frames([part.frame for part in done], np.concatenate([table, observed[None], ids[None]]), number)


#: Columns of detections in the order of their rows.
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
#: Detections that a track of another class needs before.
_OTHER_HITS: Final = 2


def associate(
    table: Floats,
    detections: Floats,
    cost: Cost,
    min_iou: float,
    across_classes: bool,
) -> tuple[Indices, Indices, Bools]:
    """Tracks and detections that belong together, (P,) each, and whether they have the same class."""
    if not table.shape[1] or not detections.shape[1]:
        nothing = np.empty(0, np.intp)
        return nothing, nothing, np.empty(0, bool)
    reach = table[GATE_M] * (1 + table[MISSED_S])
    pairs = Pairing(table[[X, Y]], detections[[X, Y]], reach)
    apart = _Apart(table, detections, pairs)
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

    def __init__(self, table: Floats, detections: Floats, pairs: Pairing) -> None:
        self.pairs = pairs
        x = pairs.of_second(detections[X]) - pairs.of_first(table[X])
        y = pairs.of_second(detections[Y]) - pairs.of_first(table[Y])
        self._squared = x * x + y * y
        self._spread = variance(table)

    def within(self, gate: float, reach_m: Floats) -> Bools:
        """Whether pairs are within ``gate`` squared standard deviations, and ``reach_m`` of their track (K,)."""
        return np.asarray(self._squared <= self.pairs.of_first(np.minimum(gate * self._spread, reach_m * reach_m)))

    def gain(self, which: Bools, track: Indices) -> Floats:
        """The gain of the chosen pairs (P,): twice the logarithm of their likelihood, but for a constant."""
        s = self._spread[track]
        return np.asarray(_GAIN - self._squared[which] / s - 2 * np.log(s))


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
        gain = apart.gain(allowed, track)
    if not len(track):
        return track, row
    (track, row), _ = max_weight_matching((track, row), np.round(gain, 6), apart.pairs.shape)
    return track, row


@dataclass(frozen=True, kw_only=True)
@parameters
class GroundTracker:
    """Track detections in metres, such as the 3D boxes of a robot's detector.

    Reads detections with positions in metres, writes tracks with positions, sizes, headings and velocities. Detections
    are assigned on the ground plane, a class at a time, to the positions that Kalman filters predict: at constant
    velocity, and on arcs for vehicles. Limits of their motion come from a table by class.

    Detections of several cameras have covariances, and scores that are probabilities. If the first ones have, which
    detection continues which is decided by what comes in ``delay_s``, too (see ``fixed_lag``): by a filter forwards and
    one backwards in time, with these covariances. Tracks then bridge gaps up to ``link_s``.

    Rows are written ``delay_s`` late: a track is written from its first detection on if it is confirmed in that time,
    and gaps that end in it are interpolated.

    Parameters
    ----------
    max_age_s : float
        A track ends after this many seconds without a detection.
    delay_s : float
        Rows are written this many seconds late, so that false births are taken back and short gaps are filled;
        0 for results that depend on the past alone.
    link_s : float
        A new track continues a lost one that it fits, up to this many seconds after its last detection; 0 for
        never.
    confirm_score : float
        A track is confirmed once the scores of its detections add up to this; detections without a score count
        0.5.
    birth_score : float
        Detections with a lower score continue tracks, but start none.
    cost : str
        How detections and tracks are compared: distance of their centres, or overlap of their boxes seen from
        above.
    min_iou : float
        With cost iou: least overlap (IoU) of a detection with a track's predicted box.
    min_score : float or None
        Ignore detections with a lower score.
    class_id : int or None
        Ignore detections of other classes.
    across_classes : bool
        A track may continue with a detection of another class; it then has the class of most of its detections.

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

    max_age_s: float = option(1.6, least=0.0, search=(0.2, 4.0), theme=_LIFE)
    delay_s: float = setting(1.0, least=0.0, theme=_LIFE)
    link_s: float = setting(8.0, least=0.0, theme=_LIFE)
    confirm_score: float = setting(0.9, least=0.0, search=(0.3, 4.0), theme=_LIFE)
    birth_score: float = setting(0.2, least=0.0, most=1.0, search=(0.0, 0.8), theme=_LIFE)
    cost: Cost = setting("metres", theme=_ASSOCIATION)
    min_iou: float = option(0.05, least=0.0, most=1.0, theme=_ASSOCIATION)
    min_score: float | None = option(None, theme=_DETECTIONS)
    class_id: int | None = setting(None, least=0, most=2**31 - 1, theme=_DETECTIONS)
    across_classes: bool = setting(False, theme=_DETECTIONS)
    class_limits: str = setting("", LIMITS_HELP, pattern=LIMITS_PATTERN, theme=_ASSOCIATION)
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
        coming, ahead = iter(frames), list[Frame]()
        for frame in coming:  # the first detections say whether there are covariances
            ahead.append(frame)
            if np.isfinite(frame.rows["x_m"]).any():
                break
        blocks = _blocks(chain(ahead, coming))
        if ahead and _has_covariance(ahead[-1].rows).any():
            yield from ((frame,) for frame in run.looking_ahead(blocks))
            run.warn()
            return
        for block in blocks:
            for frame, boxes in zip(block, run.detections(block), strict=True):
                run.step(frame, boxes[:DETECTION_ROWS])
            yield from ((frame,) for frame in run.waiting.written())
        run.waiting.release(np.inf)
        yield from ((frame,) for frame in run.waiting.written())
        run.warn()

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why there are no tracks, for a warning."""
        count = sum(len(frame.rows) for frame in given)
        return f"no track of {count} detections is confirmed (confirm_score)"


def _blocks(frames: Iterator[Frame]) -> Iterator[list[Frame]]:
    while block := list(islice(frames, _BLOCK_FRAMES)):
        yield block


def _has_covariance(rows: Rows) -> Bools:
    """Whether detections (N,) have a covariance."""
    xx, xy, yy = covariances = np.stack([rows[name] for name in COVARIANCE_M2])
    return np.asarray((xx > 0) & (yy > 0) & (xy * xy < xx * yy) & np.isfinite(covariances).all(axis=0))


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
        if dt > max(JUMP_S, options.max_age_s, options.link_s):
            tracks.keep(np.zeros(len(tracks), bool))
        tracks.predict(dt)
        self._lost.wait(dt)
        track, row, is_same = associate(tracks.table, detections, options.cost, options.min_iou, options.across_classes)
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
        self._learn(detections)
        self.tracks.initiate(self._next_id, detections, self._limits, self._frame)
        self._next_id += count

    def _learn(self, detections: Floats) -> None:
        """Look up the limits of new classes."""
        if new := {int(number) for number in np.unique(detections[CLASS])} - self._limits.keys():
            self._limits |= limits_by_class(sorted(new), self._options.class_names, self._options.class_limits)

    def detections(self, frames: Sequence[Frame]) -> Iterator[Floats]:
        """For each frame the detections that are used, in an order of their own: (rows, N), with covariances."""
        joined, options = join_frames(DETECTIONS, frames), self._options
        rows = joined.rows
        table = np.stack([rows[name] for name in _COLUMNS], dtype=float)
        covariances = np.stack([rows[name] for name in COVARIANCE_M2])
        table = np.concatenate([table, np.where(_has_covariance(rows), covariances, 0.0)])
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
        yield from (table[:, low:high] for low, high in pairwise(ends))

    def looking_ahead(self, blocks: Iterable[Sequence[Frame]]) -> Iterator[Frame]:
        """The tracks of detections with covariances."""
        options = self._options
        gap_s = max(options.max_age_s, options.link_s)
        scores = options.confirm_score, options.birth_score
        rows = DETECTION_ROWS, PLACE, _VELOCITY
        window = FixedLag(options.delay_s, gap_s, *scores, options.across_classes, self._limits, rows)
        for block in blocks:
            done: list[Written] = []
            for frame, boxes in zip(block, self.detections(block), strict=True):
                self._learn(boxes)
                done += window.add(frame, self._seen(boxes))
            yield from _written(done)
        yield from _written(window.finish())

    def _seen(self, boxes: Floats) -> Measured:
        noise_m = np.array([self._limits[int(number)].noise_m for number in boxes[CLASS].tolist()])
        xx, xy, yy = boxes[_COVARIANCE_ROWS]
        noise = np.stack([xx + noise_m**2, xy, xy, yy + noise_m**2], axis=-1).reshape(-1, 2, 2)
        rows = boxes[:DETECTION_ROWS]
        return Measured(rows.T, rows[PLACE].T, noise, certainty(boxes), rows[CLASS].astype(np.int64))

    def warn(self) -> None:
        """Warn of detections without a position in metres."""
        if self._left_out:
            warn(f"{self._left_out} detections have no position in metres, and no track", "left-out")
