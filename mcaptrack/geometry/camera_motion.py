"""Camera motion: how the pixels of a scene at rest move from one picture of a camera to the next.

``MotionEstimator`` estimates it from pictures, by sparse optical flow from a key picture at half size or less. What is
known for a whole log is a ``CameraPath`` (see ``camera_path``).

Transforms are affine, (2, 3), see ``affine``. Letters: N points or boxes.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.affine import IDENTITY, compose, invert, move_boxes, move_points, shift_px
from mcaptrack.geometry.arrays import Bools, Floats, Image
from mcaptrack.geometry.camera_path import CameraPose, Stance, Verdict, is_too_far

Points = NDArray[np.float32]

#: Pictures are reduced by two, and on until they have no more pixels than this.
_MOST_PIXELS: Final = 200_000
# Features of a key picture, of which at least so many have to agree on a transform, and so large a share of them.
_FEATURES: Final = 100
_FEATURE_DISTANCE_PX: Final = 8
_MIN_INLIERS: Final = 12
_MIN_SHARE: Final = 0.4
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
# Another key picture is taken when fewer features than this share of all are found again, or when the camera has moved
# by this share of the diagonal.
_KEY_SHARE: Final = 0.5
_KEY_SHIFT: Final = 0.12
#: Key pictures that are kept, to be recognised after a cut.
_KEYS_KEPT: Final = 4
#: After so many pictures in a row without a transform the camera looks elsewhere.
_PATIENCE: Final = 15
#: A cut changes brightness by at least this much on average; a covered lens shows too few features.
_CUT_DIFFERENCE: Final = 8.0


class _Key(NamedTuple):
    """A key picture, reduced: its features (N, 1, 2), its pose, and the number of the reference of that."""

    image: Image
    points: Points
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
        self._before: Image | None = None
        self._last = CameraPose(IDENTITY, IDENTITY, 0, 0.0, Verdict.STILL)
        self._misses = 0
        self._stance = Stance(1, 1)

    @property
    def stand(self) -> Floats | None:
        """From pixels of the view where the camera stands to those of the reference: the same object while it does."""
        return self._stance.stand

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
        small, to_small = _reduced(image)
        hidden = None if boxes is None else move_boxes(to_small, boxes)
        self._size = (image.shape[1], image.shape[0])
        self._to_small, self._from_small = to_small, invert(to_small)
        before, self._before = self._before, small
        if before is None:
            pose = self._first(small, hidden)
        elif before.shape != small.shape:
            self._keys.clear()
            pose = self._first(small, hidden, Verdict.CUT)
        else:
            pose = self._next(before, small, hidden)
        self._last, self._count = pose, self._count + 1
        return pose

    def _first(self, small: Image, hidden: Floats | None, verdict: Verdict = Verdict.STILL) -> CameraPose:
        """Begin a new reference with this picture."""
        self._stance, self._misses = Stance(*self._size), 0
        self._add_key(_Key(small, _features(small, hidden), IDENTITY, self._count))
        return CameraPose(IDENTITY, IDENTITY, self._count, 0.0, verdict)

    def _add_key(self, key: _Key) -> None:
        self._keys = [*self._keys[1 - _KEYS_KEPT :], key]

    def _next(self, before: Image, small: Image, hidden: Floats | None) -> CameraPose:
        key, last = self._keys[-1], self._last
        # Where the key picture's features should be now: as far on as from the picture before the last to the last.
        back = compose(last.from_previous, compose(invert(last.to_reference), key.to_reference))
        fit = self._fit(key, small, back, hidden)
        if fit is None and len(key.points) < _MIN_INLIERS and _difference(key.image, small) < _CUT_DIFFERENCE:
            return self._posed(last.to_reference, 0)  # a picture without features shows no motion either
        if fit is None:  # too fast, or the key picture is too long ago
            latest = _Key(before, _features(before, hidden), last.to_reference, last.reference)
            if (fit := self._fit(latest, small, IDENTITY, hidden, _WIDE_LEVELS)) is not None:
                self._add_key(latest)
                key = latest
        if fit is None:
            return self._unknown(before, small, hidden)
        matrix, inliers = fit
        pose = self._posed(compose(key.to_reference, invert(matrix)), inliers)
        is_far = shift_px(matrix, *self._size) > _KEY_SHIFT * np.hypot(*self._size)
        if is_far or inliers < _KEY_SHARE * len(key.points):
            self._add_key(_Key(small, _features(small, hidden), pose.to_reference, pose.reference))
        return pose

    def _posed(self, to_reference: Floats, inliers: int) -> CameraPose:
        """The pose of a picture with a known transform."""
        last, self._misses = self._last, 0
        to_reference, verdict = self._stance.step(to_reference)
        is_same = to_reference is last.to_reference
        from_previous = IDENTITY if is_same else compose(invert(to_reference), last.to_reference)
        if not is_too_far(to_reference, *self._size):
            return CameraPose(from_previous, to_reference, last.reference, float(inliers), verdict)
        back = invert(to_reference)
        self._keys = [
            key._replace(to_reference=compose(back, key.to_reference), reference=self._count)
            for key in self._keys
            if key.reference == last.reference
        ]
        self._stance = Stance(*self._size, is_away=True)
        return CameraPose(from_previous, IDENTITY, self._count, float(inliers), verdict)

    def _unknown(self, before: Image, small: Image, hidden: Floats | None) -> CameraPose:
        """The pose of a picture that shows nothing of the key picture: a cut, or a camera that sees nothing."""
        is_cut = _difference(before, small) >= _CUT_DIFFERENCE and len(_features(small, hidden)) >= _MIN_INLIERS
        self._misses += 1
        if is_cut or self._misses > _PATIENCE:
            for key in reversed(self._keys[:-1] if is_cut else []):  # one that was seen before?
                fit = self._fit(key, small, IDENTITY, hidden, _WIDE_LEVELS)
                if fit is not None:
                    self._add_key(key)
                    self._stance, self._misses = Stance(*self._size), 0
                    to_reference, _ = self._stance.step(compose(key.to_reference, invert(fit[0])))
                    return CameraPose(IDENTITY, to_reference, key.reference, float(fit[1]), Verdict.CUT)
            return self._first(small, hidden, Verdict.CUT if is_cut else Verdict.LOST)
        return self._last._replace(from_previous=IDENTITY, inliers=0.0, verdict=Verdict.LOST)

    def _fit(
        self, key: _Key, small: Image, guess: Floats, hidden: Floats | None, levels: int = _LEVELS
    ) -> tuple[Floats, int] | None:
        """The transform (2, 3) from a key picture to this one, and how many features agree; None if too few do.

        ``guess`` is about where it leads. All but the reduced picture ``small`` is in pixels of the full picture.
        """
        import cv2

        if len(key.points) < _MIN_INLIERS:
            return None
        near = move_points(compose(self._to_small, compose(guess, self._from_small)), key.points[:, 0].astype(float))
        # Called without a type: the stubs of OpenCV 4 and 5 differ on what may be None.
        moved, found, _ = cv2.calcOpticalFlowPyrLK(
            key.image,
            small,
            key.points,
            np.ascontiguousarray(near[:, None], np.float32),
            winSize=(_WINDOW_PX, _WINDOW_PX),
            maxLevel=levels,
            criteria=_ITERATIONS,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        there, then = np.asarray(moved, np.float32)[:, 0], key.points[:, 0]
        known = (np.asarray(found).ravel() == 1) & _inside(there, small)
        if hidden is not None:
            known &= ~_within(there, hidden)
        then, there = then[known], there[known]
        least = max(_MIN_INLIERS, _MIN_SHARE * len(then))
        if len(then) < least:
            return None
        matrix, agree = cv2.estimateAffinePartial2D(
            then, there, method=cv2.RANSAC, ransacReprojThreshold=_INLIER_PX, maxIters=200, refineIters=10
        )
        inliers = 0 if matrix is None else int(np.asarray(agree).sum())
        at_rest = _within_reach(then, there, _AT_REST_PX)
        fitted = np.asarray(IDENTITY if matrix is None else matrix, np.float64)
        if at_rest >= least and at_rest >= _within_reach(move_points(fitted, then), there, _AT_REST_PX):
            return IDENTITY, at_rest  # what moves, moves by itself
        if matrix is None or inliers < least:
            return None
        return compose(self._from_small, compose(fitted, self._to_small)), inliers


def _reduced(image: Image) -> tuple[Image, Floats]:
    """A picture at half its size, or less, and the transform (2, 3) to its pixels."""
    import cv2

    height, width = image.shape
    factor = 2
    while height // factor * (width // factor) > _MOST_PIXELS:
        factor *= 2
    size = (max(width // factor, 1), max(height // factor, 1))
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    x, y = size[0] / width, size[1] / height  # a pixel is an area about its centre
    return small, np.array([[x, 0.0, (x - 1) / 2], [0.0, y, (y - 1) / 2]])


def _features(image: Image, hidden: Floats | None) -> Points:
    """Points (N, 1, 2) that can be found again, outside of boxes (N, 4)."""
    import cv2

    mask = None
    if hidden is not None and len(hidden):
        mask = np.full(image.shape, 255, np.uint8)
        for left, top, width, height in hidden:
            x, y = np.clip([left, left + width], 0, None), np.clip([top, top + height], 0, None)
            mask[int(y[0]) : int(np.ceil(y[1])) + 1, int(x[0]) : int(np.ceil(x[1])) + 1] = 0
    found = cv2.goodFeaturesToTrack(image, _FEATURES, 0.01, _FEATURE_DISTANCE_PX, mask=mask)
    return np.empty((0, 1, 2), np.float32) if found is None else np.asarray(found, np.float32)


def _within_reach(points: Floats | Points, expected: Points, reach: float) -> int:
    """Count the points (N, 2) within reach of their expected positions (N, 2)."""
    away = points - expected
    return int(np.count_nonzero((away * away).sum(axis=1) < reach * reach))


def _inside(points: Points, image: Image) -> Bools:
    height, width = image.shape
    inside = ((points >= 0) & (points <= (width - 1, height - 1))).all(axis=1)
    return np.asarray(inside, np.bool_)


def _within(points: Points, boxes: Floats) -> Bools:
    """Mask the points (N, 2) that lie in one of the boxes."""
    x, y = points.T[:, :, None]
    left, top, width, height = boxes.T
    within: Bools = ((x >= left) & (x <= left + width) & (y >= top) & (y <= top + height)).any(axis=1)
    return within


def _difference(first: Image, second: Image) -> float:
    """Mean difference of brightness of two pictures of one size."""
    import cv2

    return float(np.asarray(cv2.absdiff(first, second)).mean())
