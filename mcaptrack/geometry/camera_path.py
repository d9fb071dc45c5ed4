"""The path of a camera: how it moved, picture by picture, and what it did.

A transform is affine, (2, 3), see ``affine``. Letters: F pictures.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence
from enum import IntEnum
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.affine import IDENTITY, compose, invert, move_boxes, move_points, scale_of, shift_px
from mcaptrack.geometry.arrays import Bools, Floats, Image, Ints

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


# Camera motion: how the pixels of a scene at rest move from one picture of a camera to the next.
#
# ``MotionEstimator`` estimates it from pictures, by sparse optical flow from a key picture at half size or less.
# What is known for a whole log is a ``CameraPath`` (see ``camera_path``).
#
# Transforms are affine, (2, 3), see ``affine``. Letters: N points or boxes.


Points = NDArray[np.float32]

#: Pictures are reduced by two, and on until they have no more pixels than this.
_MOST_PIXELS: Final = 200_000
# A key picture has about so many cells, with the best feature of each: texts that lie over the picture, or one person,
# are few of them. Flat cells have none: the smaller eigenvalue of their gradients is less than a share of that of the
# good cells, or than noise gives.
_FEATURES: Final = 100
_LEAST_OF_GOOD: Final = 0.01
_LEAST_EIGENVALUE: Final = 1e-4
# At least so many features have to agree on a transform, so large a share of them, over this share of the picture.
_MIN_INLIERS: Final = 12
_MIN_SHARE: Final = 0.35


# Whether a part of the picture moves as a whole, otherwise than the scene: one motion can't be right for both then.
#
# Such a part is the inside of a vehicle that the camera looks out of, or a place much nearer than the rest.
#
# Transforms are affine, (2, 3), see ``affine``.


#: One picture of so many is compared with that so many before it.
_EVERY, _APART = 10, 3
#: Of the features, so large a share moves otherwise than the scene, and so large a share as one, over this share of
#: the picture.
_OTHERS, _AS_ONE, _SECOND_MOTION_MIN_AREA = 0.3, 0.25, 0.1
_MIN_FEATURES: Final = 24
# In pixels of the reduced picture: from here on features move otherwise, and up to here alike.
_OTHERWISE_PX, _ALIKE_PX = 1.0, 0.75


class SecondMotion:
    """Looks in some pictures for a part that moves as a whole, otherwise than the scene.

    Attributes
    ----------
    examined, divided : int
        How many pictures were looked at, and in how many of them a part moves otherwise.

    """

    def __init__(self) -> None:
        self.examined = self.divided = 0
        self._count = 0
        self._before: Image | None = None
        self._boxes: Floats | None = None
        self._motion = IDENTITY

    def step(self, image: Image, pose: CameraPose, boxes: Floats | None = None) -> None:
        """Take the next picture (height, width) in gray, with the pose that was estimated.

        ``boxes`` (N, 4) are left, top, width and height, in pixels, of what may move by itself.
        """
        at, self._count = self._count % _EVERY, self._count + 1
        if at == 0:
            self._before, self._boxes, self._motion = image, boxes, IDENTITY
            return
        if self._before is None:
            return
        if pose.verdict > Verdict.MOVING or self._before.shape != image.shape:
            self._before = None
            return
        self._motion = compose(pose.from_previous, self._motion)
        if at == _APART:
            self.examined += 1
            self.divided += _is_divided(self._before, image, self._motion, self._boxes)
            self._before = None


def _is_divided(before: Image, now: Image, motion: Floats, boxes: Floats | None) -> bool:
    """Whether a part of two pictures moves as a whole, otherwise than ``motion`` (2, 3)."""
    (first, to_small), (second, _) = reduced(before), reduced(now)
    points, _ = features(first.image, None if boxes is None else move_boxes(to_small, boxes))
    if len(points) < _MIN_FEATURES:
        return False
    moved, is_followed = _followed(first.image, second.image, points, points.copy(), _WIDE_LEVELS)
    then, now_at = points[is_followed, 0], moved[is_followed]
    if len(then) < _MIN_FEATURES:
        return False
    small = compose(to_small, compose(motion, invert(to_small)))
    off = np.hypot(*(move_points(small, then.astype(float)) - now_at).T)
    others = off > _OTHERWISE_PX
    if np.count_nonzero(others) < _OTHERS * len(then):
        return False
    _, as_one = _agreeing(then[others], now_at[others], _ALIKE_PX)
    if np.count_nonzero(as_one) < _AS_ONE * len(then):
        return False
    return bool(np.ptp(now_at[others][as_one], axis=0).prod() >= _SECOND_MOTION_MIN_AREA * first.image.size)


_MIN_AREA: Final = 0.06
# Flow is searched in windows of this size, on so many reduced copies of the picture: few where it is known about where,
# more where it isn't.
_WINDOW_PX: Final = 11
_LEVELS: Final = 2
_WIDE_LEVELS: Final = 4
_ITERATIONS: Final = (3, 10, 0.03)
# How far features may lie from the transform, and from where they were if they are at rest, in pixels of the reduced
# picture.
_INLIER_PX: Final = 0.75
_AT_REST_PX: Final = 0.25
# Where some features are at rest and others move, those at rest are the scene if they are so large a share of all, and
# so many against the others.
_REST_SHARE: Final = 0.3
_REST_RATIO: Final = 0.65
# Another key picture is taken when fewer features agree than this share of the most that did with this one, or when the
# camera has moved by this share of the diagonal. A crowd hides many features of any picture.
_KEY_SHARE: Final = 0.5
_KEY_SHIFT: Final = 0.12
#: Key pictures that are kept, to be recognised after a cut.
_KEYS_KEPT: Final = 4
#: After so many pictures in a row without a transform the camera looks elsewhere.
_PATIENCE: Final = 15
#: Small copies of pictures of two scenes correlate less than this; light that changes doesn't change that.
_CUT_CORRELATION: Final = 0.7
#: A picture of less contrast shows nothing, such as a covered lens, nor does one of so much less than the one before,
#: such as a flash.
_LEAST_CONTRAST: Final = 4.0
#: Small copies are alike in values that differ by no more than this, and the same if so large a share is alike.
_ALIKE, _SAME_SHARE = 4, 0.8
_LEAST_CONTRAST_KEPT: Final = 0.4
# The mean brightness about each pixel, over so many pixels, is taken away, so that light that changes is no motion; so
# is contrast, if it differs by more than this factor.
_MEAN_OVER_PX: Final = 31
_SAME_CONTRAST: Final = 1.15
_GREY: Final = 128.0


class _Picture(NamedTuple):
    """A reduced picture, against its mean brightness about each pixel; its contrast; and a small copy as it was."""

    image: Image
    contrast: float
    copy: Image


class _Key(NamedTuple):
    """A key picture: its features (N, 1, 2), its pose, and the number of the reference of that."""

    picture: _Picture
    points: Points
    weight: Floats
    to_reference: Floats
    reference: int


class MotionEstimator:
    """Estimates how a camera moves, picture by picture, from the past alone.

    Features of a key picture are found again by optical flow, near where the motion so far has taken them; what moves
    by itself are outliers of a robust fit. As long as the key picture lasts, errors don't add up, and a camera that is
    still gives the identity to the bit.

    Examples
    --------
    >>> import numpy as np
    >>> picture = np.random.default_rng(0).integers(0, 255, (120, 160)).astype(np.uint8)
    >>> camera = MotionEstimator()
    >>> [camera.step(picture).verdict.name for _ in range(3)]
    ['STILL', 'STILL', 'STILL']

    """

    def __init__(self) -> None:
        self._count = 0
        self._keys: list[_Key] = []  # the one in use last
        self._before: _Picture | None = None
        self._last = CameraPose(IDENTITY, IDENTITY, 0, 0.0, Verdict.STILL)
        self._misses = 0
        # Key pictures from before poses became guesses, how long that is ago, and how often guesses had to be accepted.
        self._sure: list[_Key] = []
        self._unsure, self.breaks = 0, 0
        self._most = 0  # features that agreed with the last key picture
        self._is_sudden, self._has_view = False, False
        self._stance = Stance(1, 1)

    @property
    def stand(self) -> Floats | None:
        """The transform from pixels at the camera's stand to the reference; the same object while it stands there."""
        return self._stance.stand

    @property
    def is_guess(self) -> bool:
        """Whether the pose relies on the camera having been still while its motion could not be estimated."""
        return bool(self._sure)

    def step(self, image: Image, boxes: Floats | None = None) -> CameraPose:
        """Take the next picture.

        Parameters
        ----------
        image : (height, width) array of uint8
            The picture in gray. Where the size changes, another scene begins.
        boxes : (N, 4) array, optional
            Left, top, width and height, in pixels, of what may move by itself: no features are taken there.

        Returns
        -------
        CameraPose

        """
        picture, to_small = reduced(image)
        hidden = None if boxes is None else move_boxes(to_small, boxes)
        self._size = (image.shape[1], image.shape[0])
        self._to_small, self._from_small = to_small, invert(to_small)
        before, self._before = self._before, picture
        if before is None:
            pose = self._first(picture, hidden)
        elif before.image.shape != picture.image.shape:
            self._keys.clear()
            pose = self._first(picture, hidden, Verdict.CUT)
        else:
            pose = self._next(before, picture, hidden)
        self._last, self._count = pose, self._count + 1
        return pose

    def _first(self, picture: _Picture, hidden: Floats | None, verdict: Verdict = Verdict.STILL) -> CameraPose:
        """Begin a new reference with this picture."""
        self._stance, self._misses, self._has_view = Stance(*self._size), 0, verdict is Verdict.LOST
        self._sure = []
        self._add_key(_Key(picture, *features(picture.image, hidden), IDENTITY, self._count))
        return CameraPose(IDENTITY, IDENTITY, self._count, 0.0, verdict)

    def _add_key(self, key: _Key) -> None:
        self._keys, self._most = [*self._keys[1 - _KEYS_KEPT :], key], 0

    def _next(self, before: _Picture, picture: _Picture, hidden: Floats | None) -> CameraPose:
        key, last = self._keys[-1], self._last
        if len(key.points) < _MIN_INLIERS and (
            _correlation(key.picture, picture) >= _CUT_CORRELATION
            or len(features(picture.image, hidden)[0]) < _MIN_INLIERS
        ):
            return self._posed(last.to_reference, 0)  # pictures without features show no motion
        fit = self._fit_sure(picture, hidden)
        key = self._keys[-1]
        expected = compose(invert(last.to_reference), key.to_reference)
        for is_sudden in (self._is_sudden, not self._is_sudden) if fit is None else ():
            # Where the key picture's features should be now: as far on as from the picture before the last to the
            # last, or as far as the small copies are shifted.
            motion = self._shift(before, picture) if is_sudden else last.from_previous
            if (fit := self._fit(key, picture, compose(motion, expected), hidden)) is not None:
                self._is_sudden = is_sudden
                break
        if fit is None:  # the key picture is too long ago
            latest = _Key(before, *features(before.image, hidden), last.to_reference, last.reference)
            if (fit := self._fit(latest, picture, IDENTITY, hidden, _WIDE_LEVELS)) is not None:
                if last.verdict is Verdict.LOST and self._misses and not self._sure:
                    self._sure, self._unsure = self._keys, self._misses + 1
                self._add_key(latest)
                key = latest
        cell_px = self._size[0] / picture.copy.shape[1]
        if (fit is None or shift_px(fit[0], *self._size) > cell_px) and _is_same(key.picture, picture):
            return self._posed(key.to_reference, 0)  # nor if its few features are of what moves by itself
        if fit is None:
            return self._unknown(before, picture, hidden)
        matrix, inliers = fit
        self._has_view, self._most = True, max(self._most, inliers)
        pose = self._posed(compose(key.to_reference, invert(matrix)), inliers)
        is_far = shift_px(matrix, *self._size) > _KEY_SHIFT * np.hypot(*self._size)
        if is_far or inliers < _KEY_SHARE * self._most:
            self._add_key(_Key(picture, *features(picture.image, hidden), pose.to_reference, pose.reference))
        return pose

    def _fit_sure(self, picture: _Picture, hidden: Floats | None) -> tuple[Floats, int] | None:
        """The transform from the last key picture before poses were guesses; if there is one, these are forgotten."""
        if not self._sure:
            return None
        self._unsure += 1
        fit = self._fit(self._sure[-1], picture, IDENTITY, hidden, _WIDE_LEVELS)
        if fit is not None:
            self._keys, self._sure, self._most = self._sure, [], 0
        elif self._unsure > _PATIENCE:
            self._sure = []
            self.breaks += 1
        return fit

    def _shift(self, before: _Picture, picture: _Picture) -> Floats:
        """About how far the picture is shifted against the one before, (2, 3), by phase correlation."""
        import cv2

        height, width = picture.copy.shape
        window = np.outer(np.hanning(height), np.hanning(width)).astype(np.float32)
        small = (cv2.resize(side.image, (width, height), interpolation=cv2.INTER_AREA) for side in (before, picture))
        (x, y), _ = cv2.phaseCorrelate(*((np.asarray(side, np.float32) - _GREY) * window for side in small))
        return np.array([[1.0, 0.0, x * self._size[0] / width], [0.0, 1.0, y * self._size[1] / height]])

    def _posed(self, to_reference: Floats, inliers: int) -> CameraPose:
        """The pose of a picture with a known transform."""
        last, self._misses = self._last, 0
        to_reference, verdict = self._stance.step(to_reference)
        is_same = to_reference is last.to_reference
        from_previous = IDENTITY if is_same else compose(invert(to_reference), last.to_reference)
        if not is_too_far(to_reference, *self._size):
            is_elsewhere = self._stance.is_elsewhere
            return CameraPose(from_previous, to_reference, last.reference, float(inliers), verdict, is_elsewhere)
        back, self._sure = invert(to_reference), []
        self._keys = [
            key._replace(to_reference=compose(back, key.to_reference), reference=self._count)
            for key in self._keys
            if key.reference == last.reference
        ]
        self._stance = Stance(*self._size, is_away=True)
        return CameraPose(from_previous, IDENTITY, self._count, float(inliers), verdict)

    def _unknown(self, before: _Picture, picture: _Picture, hidden: Floats | None) -> CameraPose:
        """The pose of a picture that shows nothing of the key picture: a cut, or a camera that sees nothing."""
        has_contrast = picture.contrast >= max(_LEAST_CONTRAST, _LEAST_CONTRAST_KEPT * before.contrast)
        is_cut = self._has_view and has_contrast and _correlation(before, picture) < _CUT_CORRELATION
        self._misses += 1
        if is_cut or self._misses > _PATIENCE:
            for key in reversed(self._keys[:-1] if is_cut else []):  # one that was seen before?
                fit = self._fit(key, picture, IDENTITY, hidden, _WIDE_LEVELS)
                if fit is not None:
                    self._add_key(key)
                    self._stance, self._misses, self._sure = Stance(*self._size), 0, []
                    to_reference, _ = self._stance.step(compose(key.to_reference, invert(fit[0])))
                    return CameraPose(IDENTITY, to_reference, key.reference, float(fit[1]), Verdict.CUT)
            return self._first(picture, hidden, Verdict.CUT if is_cut else Verdict.LOST)
        return self._last._replace(from_previous=IDENTITY, inliers=0.0, verdict=Verdict.LOST)

    def _fit(
        self, key: _Key, picture: _Picture, guess: Floats, hidden: Floats | None, levels: int = _LEVELS
    ) -> tuple[Floats, int] | None:
        """The transform (2, 3) from a key picture to this one, and how many features agree; None if too few do.

        ``guess`` is about where it leads. All but the reduced pictures is in pixels of the full picture.
        """
        import cv2

        if len(key.points) < _MIN_INLIERS:
            return None
        near = move_points(compose(self._to_small, compose(guess, self._from_small)), key.points[:, 0].astype(float))
        second, start = _in_light_of(key.picture, picture), np.ascontiguousarray(near[:, None], np.float32)
        how = {"criteria": _ITERATIONS, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
        now_at, is_followed = _followed(key.picture.image, second, key.points, start, levels, **how)
        then, is_followed = key.points[:, 0], is_followed & _inside(now_at, picture.image)
        if hidden is not None:
            is_followed &= ~_within(now_at, hidden)
        then, now_at, weight = then[is_followed], now_at[is_followed], key.weight[is_followed]
        least = max(_MIN_INLIERS, _MIN_SHARE * len(then))
        if len(then) < least:
            return None
        matrix, inliers = _agreeing(then, now_at, _INLIER_PX)
        fitted = IDENTITY if matrix is None else _similarity(then[inliers], now_at[inliers], weight[inliers])
        if (at_rest := _at_rest(then, now_at, fitted)) is not None:
            return IDENTITY, at_rest
        area = np.ptp(now_at[inliers], axis=0).prod() if inliers.any() else 0.0
        if matrix is None or np.count_nonzero(inliers) < least or area < _MIN_AREA * picture.image.size:
            return None
        return compose(self._from_small, compose(fitted, self._to_small)), int(np.count_nonzero(inliers))


def _followed(
    first: Image, second: Image, points: Points, start: Points, levels: int, **how: Any
) -> tuple[Points, Bools]:
    """Where points (N, 1, 2) of a picture are in another, (N, 2), and which were found; ``start`` is about where."""
    import cv2

    # Called without a type: the stubs of OpenCV 4 and 5 differ on what may be None.
    window = (_WINDOW_PX, _WINDOW_PX)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(first, second, points, start, winSize=window, maxLevel=levels, **how)
    return np.asarray(moved, np.float32)[:, 0], np.asarray(status).ravel() == 1


def _agreeing(then: Points, targets: Points, most_px: float) -> tuple[Any, Bools]:
    """The similarity that most points (N, 2) agree on, within a distance, None if there is none; and which agree."""
    import cv2

    how = {"method": cv2.RANSAC, "ransacReprojThreshold": most_px, "maxIters": 200, "refineIters": 0}
    matrix, agree = cv2.estimateAffinePartial2D(then, targets, **how)  # type: ignore[call-overload]
    return matrix, np.asarray(agree, np.bool_).ravel()


def reduced(image: Image) -> tuple[_Picture, Floats]:
    """A picture at half its size, or less, and the transform (2, 3) to its pixels."""
    import cv2

    height, width = image.shape
    factor = 2
    while height // factor * (width // factor) > _MOST_PIXELS:
        factor *= 2
    size = (max(width // factor, 1), max(height // factor, 1))
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    x, y = size[0] / width, size[1] / height  # a pixel is an area about its centre
    copy = cv2.resize(small, (max(size[0] // 4, 1), max(size[1] // 4, 1)), interpolation=cv2.INTER_AREA)
    about = cv2.boxFilter(small, -1, (_MEAN_OVER_PX, _MEAN_OVER_PX))
    flat = np.asarray(cv2.addWeighted(small, 1.0, about, -1.0, _GREY), np.uint8)
    picture = _Picture(flat, float(cv2.meanStdDev(flat)[1][0, 0]), np.asarray(copy, np.uint8))
    return picture, np.array([[x, 0.0, (x - 1) / 2], [0.0, y, (y - 1) / 2]])


def features(image: Image, hidden: Floats | None) -> tuple[Points, Floats]:
    """Points (N, 1, 2) that can be found again, spread over the picture, outside of boxes (N, 4), and weights (N,)."""
    import cv2

    height, width = image.shape
    cell = max(round(np.sqrt(height * width / _FEATURES)), 1)
    strength = np.asarray(cv2.cornerMinEigenVal(image, 3), np.float32)
    strength[strength < np.asarray(cv2.dilate(strength, np.ones((3, 3), np.uint8)))] = 0
    for left, top, w, h in hidden if hidden is not None else ():
        x, y = np.clip([left, left + w], 0, None), np.clip([top, top + h], 0, None)
        strength[int(y[0]) : int(np.ceil(y[1])) + 1, int(x[0]) : int(np.ceil(x[1])) + 1] = 0
    rows, columns = -(-height // cell), -(-width // cell)
    padded = np.zeros((rows * cell, columns * cell), np.float32)
    padded[:height, :width] = strength
    cells = padded.reshape(rows, cell, columns, cell).swapaxes(1, 2).reshape(-1, cell * cell)
    best = cells.argmax(axis=1)
    peak = cells[np.arange(len(cells)), best]
    kept = np.flatnonzero(peak >= _LEAST_EIGENVALUE)
    good = float(np.quantile(peak[kept], 0.75)) if len(kept) else 0.0
    kept = kept[peak[kept] >= _LEAST_OF_GOOD * good]
    x, y = kept % columns * cell + best[kept] % cell, kept // columns * cell + best[kept] // cell
    return np.stack([x, y], axis=1).astype(np.float32)[:, None], np.minimum(peak[kept], good).astype(float)


def _similarity(points: Points, targets: Points, weight: Floats) -> Floats:
    """The similarity (2, 3) that takes points (N, 2) closest to others (N, 2), by weights (N,)."""
    first, second = (side.astype(float) @ [1, 1j] for side in (points, targets))
    share = weight / weight.sum()
    from_middle, to_middle = first @ share, second @ share
    away = first - from_middle
    turn = (share * away.conj()) @ (second - to_middle) / max(share @ np.abs(away) ** 2, 1e-12)
    shift = to_middle - turn * from_middle
    return np.array([[turn.real, -turn.imag, shift.real], [turn.imag, turn.real, shift.imag]])


def _at_rest(then: Points, targets: Points, fitted: Floats) -> int | None:
    """The number of features (N, 2) at rest, if the scene is; None if it moves as was fitted (2, 3)."""
    rest, off = _apart(then, targets), _apart(move_points(fitted, then.astype(float)), targets)
    at_rest = int(np.count_nonzero(rest < _AT_REST_PX))
    if at_rest >= _REST_SHARE * len(then) and at_rest >= _REST_RATIO * np.count_nonzero(off < _AT_REST_PX):
        return at_rest
    alone = np.count_nonzero((rest < _AT_REST_PX) & (off > _INLIER_PX))
    others = np.count_nonzero((off < _INLIER_PX) & (rest > _INLIER_PX))
    is_scene = alone >= max(_MIN_INLIERS, _REST_SHARE * len(then)) and alone >= _REST_RATIO * others
    return at_rest if is_scene else None  # what moves, moves by itself


def _apart(points: Floats | Points, targets: Points) -> Floats:
    """The distances of points (N, 2) from their expected positions (N, 2)."""
    return np.asarray(np.hypot(*(points - targets).T), np.float64)


def _in_light_of(first: _Picture, second: _Picture) -> Image:
    """The second picture with the contrast of the first, if they differ."""
    import cv2

    ratio = (first.contrast + 1e-6) / (second.contrast + 1e-6)
    if 1 / _SAME_CONTRAST < ratio < _SAME_CONTRAST:
        return second.image
    return np.asarray(cv2.convertScaleAbs(second.image, alpha=ratio, beta=_GREY * (1 - ratio)), np.uint8)


def _correlation(first: _Picture, second: _Picture) -> float:
    """The correlation of the small copies of two pictures of one size, from -1 to 1."""
    a, b = (side.copy - side.copy.mean() for side in (first, second))
    scale = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / scale if scale > 0 else float(not a.any() and not b.any())


def _is_same(first: _Picture, second: _Picture) -> bool:
    """Whether two pictures of one size are alike nearly everywhere."""
    import cv2

    off = np.asarray(cv2.absdiff(first.copy, second.copy))
    return bool(np.count_nonzero(off <= _ALIKE) >= _SAME_SHARE * off.size)


def _inside(points: Points, image: Image) -> Bools:
    height, width = image.shape
    inside = ((points >= 0) & (points <= (width - 1, height - 1))).all(axis=1)
    return np.asarray(inside, np.bool_)


def _within(points: Points, boxes: Floats) -> Bools:
    """Which points (N, 2) lie in one of the boxes."""
    x, y = points.T[:, :, None]
    left, top, width, height = boxes.T
    within: Bools = ((x >= left) & (x <= left + width) & (y >= top) & (y <= top + height)).any(axis=1)
    return within
