"""The path of a camera: how it moved, picture by picture, and what it did.

A transform is affine, (2, 3), see ``affine``. Letters: F pictures.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence
from enum import IntEnum
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.affine import IDENTITY, compose, invert, scale_of, shift_px
from mcaptrack.geometry.arrays import Bools, Floats, Ints

#: Less than this, in pixels of the full picture, is no motion.
STILL_PX: Final = 0.3
#: From this share of the diagonal on, a camera does more than shake: it looks elsewhere.
FAR: Final = 0.1
# A camera that has moved by less than this share of the diagonal over so many pictures stands again.
_SETTLED: Final = 0.01
_SETTLED_PICTURES: Final = 15
# A reference is given up once a picture is enlarged by this much against it, or so many diagonals away: numbers would
# lose their precision.
_MOST_ZOOM: Final = 16.0
_MOST_AWAY: Final = 100.0
#: A camera that moves in fewer pictures than this share of all doesn't: it has shaken once.
_LEAST_MOVING: Final = 0.02


class Verdict(IntEnum):
    """The state of a camera at a picture: the column ``verdict`` of camera motion.

    Still: it shows the same view as before. Shaking: it moves about that view. Moving: it is on its way, or shows
    another view. Cut: the picture shows another scene than the one before. Lost: its motion can't be estimated.
    """

    STILL = 0
    SHAKING = 1
    MOVING = 2
    CUT = 3
    LOST = 4


class CameraPose(NamedTuple):
    """The position of the camera at a picture.

    Attributes
    ----------
    from_previous : (2, 3) array
        From pixels of the picture before to pixels of this one; the identity at the first picture, at a cut and where
        nothing is known.
    to_reference : (2, 3) array
        From pixels of this picture to pixels of its reference, the first picture since the last cut.
    reference : int
        The number of that picture, counted from 0.
    inliers : float
        How many features agree on the motion; NaN where that isn't known.
    verdict : Verdict
    is_elsewhere : bool
        Whether the camera looks elsewhere than at its reference, further away than it shakes.

    """

    from_previous: Floats
    to_reference: Floats
    reference: int
    inliers: float
    verdict: Verdict
    is_elsewhere: bool = False


class Stance:
    """The position of a camera and its state: still, shaking about that position, or moving away from it."""

    def __init__(self, width_px: float, height_px: float, is_away: bool = False) -> None:
        self._size = (width_px, height_px)
        self._diagonal = float(np.hypot(width_px, height_px))
        self._recent: deque[Floats] = deque(maxlen=_SETTLED_PICTURES)
        # From pixels of the view where it stands to those of the reference; None where it began on its way.
        self.stand: Floats | None = None if is_away else IDENTITY
        # Whether the last picture lies further from the reference than a camera shakes.
        self.is_elsewhere = False
        self._is_away = is_away

    def step(self, to_reference: Floats) -> tuple[Floats, Verdict]:
        """Take the pose of the next picture; returns it, or that of the stand to the bit if the camera is there."""
        off = np.inf
        if self.stand is not None:
            off = shift_px(compose(invert(self.stand), to_reference), *self._size)
            to_reference = self.stand if off < STILL_PX else to_reference
        self.is_elsewhere = shift_px(to_reference, *self._size) > FAR * self._diagonal
        self._recent.append(to_reference)
        self._is_away = off > FAR * self._diagonal or (self._is_away and off >= STILL_PX)
        if self._is_away and len(self._recent) == _SETTLED_PICTURES:
            back = invert(to_reference)
            if all(shift_px(compose(back, pose), *self._size) < _SETTLED * self._diagonal for pose in self._recent):
                self.stand, self._is_away = to_reference, False
                return to_reference, Verdict.STILL
        if off < STILL_PX:
            return to_reference, Verdict.STILL
        return to_reference, Verdict.MOVING if self._is_away else Verdict.SHAKING


def is_too_far(to_reference: Floats, width_px: float, height_px: float) -> bool:
    """Whether a picture lies so far from its reference that another reference is needed for numbers to stay exact."""
    zoom = scale_of(to_reference)
    away = np.hypot(*to_reference[:, 2]) > _MOST_AWAY * np.hypot(width_px, height_px)
    return bool(away or not 1 / _MOST_ZOOM < zoom < _MOST_ZOOM)


def poses_of(motions: Floats, width_px: float, height_px: float) -> list[CameraPose]:
    """The poses that motions from the picture before (F, 2, 3) lead to; these stay as they are.

    Pictures have no cuts there, and the number of features that agree is not known.
    """
    poses: list[CameraPose] = []
    stance, to_reference, reference = Stance(width_px, height_px), IDENTITY, 0
    for number, motion_before in enumerate(motions):
        motion = IDENTITY if number == 0 or np.array_equal(motion_before, IDENTITY) else motion_before
        to_reference = compose(to_reference, invert(motion))
        if is_too_far(to_reference, width_px, height_px):
            stance, to_reference, reference = Stance(width_px, height_px, is_away=True), IDENTITY, number
        _, verdict = stance.step(to_reference)
        poses.append(CameraPose(motion, to_reference, reference, np.nan, verdict, stance.is_elsewhere))
    return poses


def verdict_of(verdicts: NDArray[np.integer], elsewhere: Bools) -> Verdict:
    """The state of a camera over a whole log, by its verdicts (F,) and views (F,): moving, shaking or still.

    It moves, too, if it has come to look elsewhere so slowly, or so long ago, that it seems to shake or to stand there.
    Cuts and lost pictures don't count.
    """
    least = _LEAST_MOVING * max(len(verdicts), 1)
    is_judged = verdicts <= Verdict.MOVING
    moving = np.count_nonzero(is_judged & (elsewhere | (verdicts == Verdict.MOVING)))
    shaking = np.count_nonzero(verdicts == Verdict.SHAKING)
    if moving >= least:
        return Verdict.MOVING
    return Verdict.SHAKING if moving + shaking >= least else Verdict.STILL


class CameraPath:
    """The motion of a camera in a log.

    Parameters
    ----------
    t_ns : (F,) array of int64
        The times of its pictures, in order.
    poses : sequence of CameraPose
        Its position at each.

    Examples
    --------
    >>> import numpy as np
    >>> step = np.array([[1.0, 0.0, -3.0], [0.0, 1.0, 0.0]])  # all moves 3 px to the left: the camera pans to the right
    >>> path = CameraPath(np.array([0, 40, 80]), poses_of(np.array([step] * 3), 640, 480))
    >>> path.between(0, 80)[0, 2]
    np.float64(-6.0)

    """

    def __init__(self, t_ns: Ints, poses: Sequence[CameraPose]) -> None:
        self._t_ns: list[int] = t_ns.tolist()
        self._poses = list(poses)

    def between(self, before_ns: int, t_ns: int) -> Floats | None:
        """Return the transform (2, 3) from pixels at one time to pixels at a later one.

        It is the object ``IDENTITY`` where the camera is still, and None where a cut lies between.
        """
        out = IDENTITY
        for pose in self._poses[bisect_right(self._t_ns, before_ns) : bisect_right(self._t_ns, t_ns)]:
            if pose.verdict is Verdict.CUT:
                return None
            out = compose(pose.from_previous, out)
        return out

    def pose_at(self, t_ns: int) -> CameraPose | None:
        """Return the pose of the picture that is shown at a time: the last one until then; None without pictures."""
        if not self._poses:
            return None
        return self._poses[max(bisect_right(self._t_ns, t_ns) - 1, 0)]

    def poses_between(self, since_ns: int | None, until_ns: int | None) -> list[tuple[int, CameraPose]]:
        """Return times and poses of the pictures from one time on and before another; None for no limit."""
        first = 0 if since_ns is None else bisect_left(self._t_ns, since_ns)
        last = len(self._t_ns) if until_ns is None else bisect_left(self._t_ns, until_ns)
        return list(zip(self._t_ns[first:last], self._poses[first:last], strict=True))

    @cached_property
    def verdict(self) -> Verdict:
        """The state of the camera over the whole log, see ``verdict_of``."""
        verdicts = np.array([pose.verdict for pose in self._poses], np.int64)
        return verdict_of(verdicts, np.array([pose.is_elsewhere for pose in self._poses], np.bool_))

    @cached_property
    def cuts_ns(self) -> list[int]:
        """The times at which another scene begins."""
        return [t_ns for t_ns, pose in zip(self._t_ns, self._poses, strict=True) if pose.verdict is Verdict.CUT]

    @property
    def matters(self) -> bool:
        """Whether tracks are worse without it: the camera does more than shake, or there are cuts."""
        return self.verdict is Verdict.MOVING or bool(self.cuts_ns)

    def to_scene(self, boxes: Floats, t_ns: Ints) -> Floats:
        """Move boxes (N, 4) of pictures at times (N,) to the pixels of their reference picture.

        There, what is at rest stays where it is; between two pictures the camera is taken to move evenly.
        """
        return _moved_each(self._to_reference(t_ns), boxes)

    def to_pictures(self, boxes: Floats, t_ns: Ints) -> Floats:
        """Move boxes (N, 4) from the pixels of the reference picture to those of the picture at each time (N,)."""
        linear, shift = np.split(self._to_reference(t_ns), [2], axis=2)
        back = np.linalg.inv(linear)
        return _moved_each(np.concatenate([back, -back @ shift], axis=2), boxes)

    def _to_reference(self, t_ns: Ints) -> Floats:
        """The transforms to the reference picture (N, 2, 3) at times (N,)."""
        matrices, references, times = self._arrays
        after = np.searchsorted(times, t_ns, "right")
        before, after = np.clip(after - 1, 0, None), np.clip(after, None, len(times) - 1)
        after = np.where(references[after] == references[before], after, before)
        span = np.maximum(times[after] - times[before], 1)
        share = np.clip((t_ns - times[before]) / span, 0.0, 1.0)[:, None, None]
        return np.asarray(matrices[before] + share * (matrices[after] - matrices[before]))

    @cached_property
    def _arrays(self) -> tuple[Floats, Ints, Ints]:
        matrices = np.array([pose.to_reference for pose in self._poses])
        return matrices, np.array([pose.reference for pose in self._poses]), np.array(self._t_ns)


def _moved_each(matrices: Floats, boxes: Floats) -> Floats:
    """Move each box (N, 4) by a transform of its own (N, 2, 3); boxes stay upright."""
    size = boxes[:, 2:] * np.sqrt(np.abs(np.linalg.det(matrices[:, :, :2])))[:, None]
    middle = (matrices[:, :, :2] @ (boxes[:, :2] + boxes[:, 2:] / 2)[:, :, None])[:, :, 0] + matrices[:, :, 2]
    return np.concatenate([middle - size / 2, size], axis=1)
