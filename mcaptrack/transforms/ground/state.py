"""The tracks of the ground tracker as arrays: motion, size, heading, class and life of each.

The motion has the state position, velocity and acceleration. Noise is the same along both axes and no axis influences
the other, so both have one covariance: six numbers for each track. The acceleration fades (Singer 1970); across the
velocity it is that of an arc, so that a vehicle that turns is predicted on a circle. Classes that don't turn have no
acceleration, which leaves a filter of constant velocity.

Tracks are columns and numbers are rows. Letters: K tracks, N detections, C classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from mcaptrack.geometry.angles import wrapped
from mcaptrack.geometry.arrays import Bools, Floats, Indices
from mcaptrack.transforms.motion_limits import MotionLimits

# Rows of detections.
X, Y, Z, LENGTH, WIDTH, HEIGHT, HEADING, VX, VY, SCORE, CLASS, SOURCE = range(12)
DETECTION_ROWS: Final = 12
#: Detections that have covariances have three rows more: xx, xy, yy.
COVARIANCE: Final = slice(DETECTION_ROWS, DETECTION_ROWS + 3)
PLACE: Final = slice(X, Y + 1)
#: Position, size and heading.
BOX: Final = slice(X, HEADING + 1)


# The filter of the ground tracker for detections that have covariances, such as those of several cameras.
#
# The noise of such a detection differs along the axes and from one to the next, so each track has a covariance of
# its own over both axes: of position, velocity and acceleration along the first axis, then of those along the
# second one. The motion is that of ``state``.
#
# Letters: K tracks, N detections.


#: Rows of a covariance that are positions, velocities and accelerations, one of each axis.
_PLACE, _COVARIANCES_VELOCITY, _COVARIANCES_ACCELERATION = [0, 3], [1, 4], [2, 5]
_COVARIANCES_SIZE: Final = 6


class Covariances:
    """The covariances of tracks, ``values`` (K, 6, 6)."""

    def __init__(self, along_one_axis: Floats) -> None:
        """Begin with the same covariance (6, K) along both axes: pp, pv, pa, vv, va, aa."""
        self.values: Floats = _of_axes(along_one_axis)

    def add(self, along_one_axis: Floats, noise: Floats) -> None:
        """Add tracks, as in the constructor, but with these covariances (N, 3) of their positions."""
        new = _of_axes(along_one_axis)
        new[:, _PLACE[0], _PLACE[0]], new[:, _PLACE[1], _PLACE[1]] = noise[:, 0], noise[:, 2]
        new[:, _PLACE[0], _PLACE[1]] = new[:, _PLACE[1], _PLACE[0]] = noise[:, 1]
        self.values = np.concatenate([self.values, new])

    def places(self) -> Floats:
        """The covariances of positions, (3, K): xx, xy, yy."""
        p = self.values
        return np.stack([p[:, 0, 0], p[:, 0, 3], p[:, 3, 3]])

    def widen(self, track: Indices, more: Floats, passed_s: Floats) -> None:
        """Add ``more`` (N,) to the variance that the velocities of tracks (N,) had ``passed_s`` seconds (N,) ago."""
        for place, velocity in zip(_PLACE, _COVARIANCES_VELOCITY, strict=True):
            self.values[track, place, place] += more * passed_s**2
            self.values[track, place, velocity] += more * passed_s
            self.values[track, velocity, place] += more * passed_s
            self.values[track, velocity, velocity] += more

    def predict(self, transition: Floats, drift: Floats) -> None:
        """Predict with the transition (3, 3) of one axis and what is added for each track, (K, 3, 3), to each axis."""
        both = np.zeros((_COVARIANCES_SIZE, _COVARIANCES_SIZE))
        both[:3, :3] = both[3:, 3:] = transition
        self.values = both @ self.values @ both.T
        self.values[:, :3, :3] += drift
        self.values[:, 3:, 3:] += drift

    def correct(self, track: Indices, noise: Floats) -> Floats:
        """Correct tracks (N,) with a detection each, with these covariances (N, 3); returns the gains (N, 6, 2)."""
        p = self.values[track]
        cross = p[:, :, _PLACE]
        xx, xy, yy = p[:, 0, 0] + noise[:, 0], p[:, 0, 3] + noise[:, 1], p[:, 3, 3] + noise[:, 2]
        inverse = np.stack([yy, -xy, -xy, xx], axis=-1).reshape(-1, 2, 2) / (xx * yy - xy * xy)[:, None, None]
        gain: Floats = cross @ inverse
        p = p - gain @ np.swapaxes(cross, 1, 2)
        self.values[track] = (p + np.swapaxes(p, 1, 2)) / 2
        return gain

    def means(self) -> Floats:
        """The means over both axes, (6, K), as in the constructor."""
        p = self.values
        mean = (p[:, :3, :3] + p[:, 3:, 3:]) / 2
        return np.stack([mean[:, i, j] for i in range(3) for j in range(i, 3)])


def _of_axes(along_one_axis: Floats) -> Floats:
    """Covariances (K, 6, 6) of independent axes with the same covariance (6, K)."""
    count = along_one_axis.shape[1]
    block = np.empty((count, 3, 3))
    upper = [(i, j) for i in range(3) for j in range(i, 3)]
    for (i, j), values in zip(upper, along_one_axis, strict=True):
        block[:, i, j] = block[:, j, i] = values
    out = np.zeros((count, _COVARIANCES_SIZE, _COVARIANCES_SIZE))
    out[:, :3, :3] = out[:, 3:, 3:] = block
    return out


def along_axes(gain: Floats, off: Floats) -> tuple[Floats, Floats, Floats]:
    """Corrections of positions, velocities and accelerations, (2, N) each: gains (N, 6, 2) times innovations (2, N)."""
    by = np.einsum("nij,jn->in", gain, off)
    return by[_PLACE], by[_COVARIANCES_VELOCITY], by[_COVARIANCES_ACCELERATION]


_SIZE: Final = slice(LENGTH, HEIGHT + 1)
_SHAPE: Final = slice(Z, HEADING + 1)

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
    """The tracks that are alive: ``table`` (rows, K), and the scores of the classes that each had, ``votes`` (C, K).

    From the first detection with a covariance on, ``covariances`` are those of the tracks.
    """

    def __init__(self) -> None:
        self.table: Floats = no_tracks()
        self.covariances: Covariances | None = None
        self.votes: Floats = np.zeros((0, 0))
        self._classes: dict[int, int] = {}

    def __len__(self) -> int:
        return int(self.table.shape[1])

    def keep(self, which: Bools) -> None:
        """Keep some of the tracks."""
        self.table, self.votes = self.table.compress(which, axis=1), self.votes.compress(which, axis=1)
        if self.covariances:
            self.covariances.values = self.covariances.values.compress(which, axis=0)

    def expect_covariances(self) -> None:
        """Begin to keep a covariance over both axes for each track."""
        if self.covariances is None:
            self.covariances = Covariances(self.table[_COVARIANCE])

    def predict(self, dt: float) -> None:
        """Predict all tracks by ``dt`` seconds."""
        t = self.table
        if dt <= 0 or not len(self):
            return
        if self.covariances:
            self.covariances.predict(*_transition(t[_DRIFT], t[TURNS], dt))
            t[_COVARIANCE] = self.covariances.means()
        else:
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
        if self.covariances:
            self.covariances.widen(track, more, passed_s)

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
        if self.covariances:
            gain = self.covariances.correct(track, measured(t[NOISE], detections))
            _move(t, *along_axes(gain, detections[PLACE] - t[PLACE]))
            t[_COVARIANCE] = self.covariances.means()[:, track]
        else:
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
        if self.covariances:
            self.covariances.add(t[_COVARIANCE], measured(t[NOISE], detections))
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


def measured(noise_m: Floats, detections: Floats) -> Floats:
    """The covariances (N, 3) of detections (rows, N) of tracks with this noise (N,).

    Their own covariance says how well the cameras place them; people and boxes sway by the noise of their class, too.
    """
    out = np.stack([noise_m**2, np.zeros_like(noise_m), noise_m**2], axis=-1)
    return out + own_covariances(detections) if detections.shape[0] > DETECTION_ROWS else out


def certainty(detections: Floats) -> Floats:
    """The scores (N,) of detections (rows, N); 0.5 for those without a score."""
    return np.where(np.isnan(detections[SCORE]), 0.5, detections[SCORE])


def own_covariances(detections: Floats) -> Floats:
    """The covariances (N, 3) that detections (rows, N) came with; 0 where they have none."""
    has = detections.shape[0] > DETECTION_ROWS
    return np.asarray(np.nan_to_num(detections[COVARIANCE].T) if has else np.zeros((detections.shape[1], 3)))


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


def _transition(drift: Floats, turns: Floats, dt: float) -> tuple[Floats, Floats]:
    """The transition (3, 3) of one axis by ``dt`` seconds, and the covariance (K, 3, 3) that is added to each track."""
    fade = np.exp(-dt / _FADES_S)
    g, f = _FADES_S * (1 - fade), _FADES_S * (dt - _FADES_S * (1 - fade))
    added = np.zeros((6, len(drift)))
    _predict_covariance(added, drift, turns, dt)
    pp, pv, pa, vv, va, aa = added
    out = np.stack([pp, pv, pa, pv, vv, va, pa, va, aa], axis=-1).reshape(-1, 3, 3)
    return np.array([[1.0, dt, f], [0.0, 1.0, g], [0.0, 0.0, fade]]), out


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
    if weight.all() and np.isfinite(detections[_SHAPE]).all() and not np.isnan(t[_SHAPE]).any():
        # What nearly all detections are. All else comes to the same then.
        t[Z] += _HEIGHT_RATE * (detections[Z] - t[Z])
        t[_SIZED] += 1
        before = t[_SIZE]
        limit = np.where(t[_SIZED] <= _FIRST_SIZES, np.inf, _SIZE_LIMIT * before)
        change = np.minimum(np.maximum(detections[_SIZE] - before, -limit), limit)
        before += np.maximum(_SIZE_RATE, 1 / t[_SIZED]) * change
        _follow_heading(t, detections[HEADING], weight)
        return
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
