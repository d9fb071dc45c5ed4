"""A motion detector: pictures -> boxes around what differs from a background that is learned from the past.

Each picture is halved until it is small enough, registered to a reference picture, and compared with the background.
The mask of differing pixels is cleaned, and its connected regions become boxes, in pixels of the picture before halving
and registration.

Letters: N boxes.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY, compose, invert, move_boxes, shift_px
from mcaptrack.geometry.arrays import Floats, Image, Ints
from mcaptrack.geometry.camera_path import FAR, CameraPose, MotionEstimator, Verdict
from mcaptrack.geometry.clocks import NS_PER_S, FrameClock
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, VIDEO, Frame, Schema
from mcaptrack.transforms.protocol import Colour, option, parameters, setting

# In units of the height of a person as measured in the picture: one body often gives several regions above each other,
# which are joined over this distance; regions with a smaller area than this (times the height squared) are left out.
_JOIN_HEIGHTS: Final = 0.2
_MIN_AREA_HEIGHTS: Final = 0.03
#: If a larger share of the picture than this differs, the light changed or the model is new: no detections.
MAX_FOREGROUND: Final = 0.5
#: Smaller regions are noise, whatever the height of people.
_MIN_AREA_PX: Final = 20.0
#: The height of people until enough regions were measured.
_INITIAL_HEIGHT_PX: Final = 20.0
_MIN_REGIONS: Final = 10
_PERSON_CLASS: Final = 1
#: Squared distance of brightness that counts as motion, if no other is given.
_THRESHOLD: Final = 800.0
_FOREGROUND: Final = 255  # OpenCV marks shadows with 127


# Registration of pictures to the view that a camera shows: a shaking camera shakes about it, a cut begins another.


#: How a picture lies to its view: near it (steady); further away than a camera shakes, so that a part of the picture
#: has no background, or on its way from picture to picture (moving); unknown (lost).
View = Literal["steady", "moving", "lost"]

#: A picture without a place in the view is one of a moving camera if more than this share of the diagonal lies between
#: it and the picture before.
_MOVING: Final = 0.002
#: After so many pictures in a row without a place in the view the next one begins another: until then, something large
#: may have passed before the camera.
_PATIENCE: Final = 15


class Registration:
    """Registers the pictures of a camera to views.

    A view begins with the first picture, some pictures after a cut, and where the camera has settled further away than
    it shakes.
    """

    def __init__(self) -> None:
        self.view: View = "steady"
        self._camera = MotionEstimator()
        self._size = (0, 0)
        self._misses = 0
        # The reference of the view, and the transforms from pixels of the view to it, and from the last picture.
        self._reference = (0, 0)
        self._anchor, self._last = IDENTITY, IDENTITY

    def register(self, image: Image) -> tuple[Floats, bool]:
        """The transform (2, 3) from pixels of ``image`` to those of its view, and whether the view begins with it.

        It is the object ``IDENTITY`` where the camera is still. Sets ``view``.
        """
        camera, before, self._size = self._camera, self._size, (image.shape[1], image.shape[0])
        pose, diagonal = camera.step(image), float(np.hypot(*self._size))
        reference, self.view = (pose.reference, camera.breaks), "steady"
        is_known = pose.verdict is not Verdict.LOST and not camera.is_guess and reference == self._reference
        self._misses = 0 if is_known else self._misses + 1
        if self._size != before or self._misses > _PATIENCE or (is_known and self._is_settled(pose, FAR * diagonal)):
            self._reference, self._anchor, self._last, self._misses = reference, pose.to_reference, IDENTITY, 0
            return IDENTITY, True
        if not is_known:
            self.view = "moving" if shift_px(pose.from_previous, *self._size) > _MOVING * diagonal else "lost"
            return self._last, False
        is_there = pose.to_reference is self._anchor
        self._last = IDENTITY if is_there else compose(invert(self._anchor), pose.to_reference)
        self.view = "moving" if shift_px(self._last, *self._size) > FAR * diagonal else "steady"
        return self._last, False

    def _is_settled(self, pose: CameraPose, far_px: float) -> bool:
        """Whether the camera stands elsewhere than in the view."""
        is_there = pose.to_reference is self._camera.stand
        return is_there and shift_px(compose(invert(self._anchor), pose.to_reference), *self._size) > far_px


# Check that the camera stands still enough for a motion detector, and warn or refuse if it does not.


#: A camera that moves in a larger share of the pictures than this is refused, in at least so many pictures.
_MAX_MOVING: Final = 0.5
_MIN_MOVING_PICTURES: Final = 15
#: From this share of the pictures on, a moving camera or a lost view is a warning.
_WARN_FROM: Final = 0.02


class Steadiness:
    """Counts the views of the camera, picture by picture."""

    def __init__(self) -> None:
        self._views: Counter[View] = Counter()
        self._restarts = -1  # the first picture starts the model
        self._start_ns: int | None = None
        self._span_ns: dict[str, tuple[int, int]] = {}

    def update(self, t_ns: int, view: View, is_new: bool) -> None:
        """Take the view at a picture, and whether the background model starts again with it."""
        self._start_ns = t_ns if self._start_ns is None else self._start_ns
        self._views[view] += 1
        self._restarts += is_new
        seen = (view if view != "steady" else "", "restart" if is_new and self._restarts > 0 else "")
        for key in filter(None, seen):
            self._span_ns[key] = (self._span_ns.get(key, (t_ns, t_ns))[0], t_ns)

    def check(self) -> None:
        """Warn if the camera moved or its view was lost. Raises McaptrackError if it moved in most pictures."""
        pictures = max(self._views.total(), 1)
        moving = self._views["moving"] / pictures
        lost = self._views["lost"] / pictures
        if moving > _MAX_MOVING and moving * pictures >= _MIN_MOVING_PICTURES:
            raise McaptrackError(
                f"the camera moves in {moving:.0%} of the pictures; a motion detector can't separate people from the "
                "background then. Use a detector that works on single pictures, or switch stabilise off to run anyway"
            )
        if moving >= _WARN_FROM:
            warn(
                f"the camera moves in {moving:.0%} of the pictures, {self._when('moving')}: detections there "
                "are incomplete and may be wrong",
                "camera-moves",
            )
        if lost >= _WARN_FROM or (self._restarts > 0 and moving < _WARN_FROM):
            text = f"the background model started again {self._restarts} times" if self._restarts > 0 else ""
            if lost:
                share = f"the view of the camera was lost in {lost:.0%} of the pictures, {self._when('lost')}"
                text = f"{share}; {text}" if text else share
            else:
                text = f"{text}, {self._when('restart')}"
            warn(
                f"{text}: cuts, changes of light, or a large object before the camera; detections there may be wrong",
                "view-lost",
            )

    def _when(self, what: str) -> str:
        first, last = ((t_ns - (self._start_ns or 0)) / NS_PER_S for t_ns in self._span_ns[what])
        return f"from {first:.1f} s to {last:.1f} s"


@dataclass(frozen=True, kw_only=True)
@parameters
class KnnDetector:
    """Detect what moves, by subtracting a background model (k nearest neighbours).

    Reads video, writes detections: one box for each connected region that differs from the background.

    Parameters
    ----------
    threshold : float or None
        Difference from the background that counts as motion; each detector has its own default.
    history_s : float
        Memory of the background model, in seconds.
    max_pixels : int
        Pictures are halved until they have no more pixels than this.
    stabilise : bool
        Compensate the motion of a shaking camera.

    Examples
    --------
    A bright square of 20 pixels moves over a dark picture, which was empty for a second:

    >>> import numpy as np
    >>> from mcaptrack.schema import Frame
    >>> frames = [Frame(n * 40_000_000, n, np.full((80, 160), 30, np.uint8)) for n in range(40)]
    >>> for frame in frames[25:]:
    ...     frame.rows[30:50, 4 * frame.index - 80 : 4 * frame.index - 60] = 200
    >>> *_, (last,) = KnnDetector()(frames)
    >>> len(last.rows), float(last.rows["h_px"][0])
    (1, 20.0)

    References
    ----------
    Z. Zivkovic and F. van der Heijden, "Efficient adaptive density estimation per image pixel for the task of
    background subtraction", Pattern Recognition Letters 27, 2006.
    """

    threshold: float | None = option(None, least=0.0)
    history_s: float = setting(60.0, least=0.1)
    max_pixels: int = setting(1_000_000, least=1_000, most=1_000_000_000)
    stabilise: bool = setting(True)

    colour: ClassVar[Colour] = "grey"
    needs_still_camera: ClassVar[bool] = True
    reads: ClassVar[Schema] = VIDEO
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": DETECTIONS})
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": 0.0})

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        steadiness = Steadiness()
        yield from self.detect(frames, steadiness)
        steadiness.check()

    def detect(self, frames: Iterable[Frame], steadiness: Steadiness) -> Iterator[tuple[Frame]]:
        """The detections of pictures; ``steadiness`` takes how the camera moved."""
        clock, camera, height = FrameClock(), Registration(), _PersonHeight()
        foreground = _BackgroundModel(self.threshold, self.history_s)
        size: tuple[int, ...] = ()
        for frame in frames:
            clock.tick(frame.t_ns)
            image, halvings = halve(frame.rows, self.max_pixels)
            to_reference, is_new = camera.register(image) if self.stabilise else (IDENTITY, image.shape != size)
            size = image.shape
            steadiness.update(frame.t_ns, camera.view, is_new)
            if is_new:  # another view has another background
                foreground = _BackgroundModel(self.threshold, self.history_s)
            mask = clear_border(foreground.mask(warp(image, to_reference), clock), to_reference)
            if np.count_nonzero(mask) > MAX_FOREGROUND * mask.size:
                mask = np.zeros_like(mask)
            boxes = _find_boxes(mask, height.update(mask))
            yield (Frame(frame.t_ns, frame.index, boxes_to_rows(unwarp_boxes(boxes, to_reference) * 2**halvings)),)

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why there are no detections, for a warning."""
        return f"no motion in its {len(made)} pictures exceeds the threshold"


def halve(image: Image, max_pixels: int) -> tuple[Image, int]:
    """The picture, halved until it has at most ``max_pixels``, and how often."""
    import cv2

    halvings = 0
    while (size := image.shape[:2])[0] * size[1] > max_pixels and min(size) >= 4:
        height, width = size
        image = np.asarray(cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8)
        halvings += 1
    return image, halvings


def warp(image: Image, to_reference: Floats) -> Image:
    """The picture as the reference camera would see it."""
    import cv2

    if to_reference is IDENTITY:
        return image
    size = (image.shape[1], image.shape[0])
    return np.asarray(cv2.warpAffine(image, to_reference, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def clear_border(mask: Image, to_reference: Floats) -> Image:
    """The mask without the border that a warped picture does not cover."""
    if to_reference is IDENTITY:
        return mask
    height, width = mask.shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float)
    border = int(np.ceil(np.abs(corners @ to_reference.T - corners[:, :2]).max())) + 1
    inner = np.zeros_like(mask)
    inner[border:-border, border:-border] = mask[border:-border, border:-border]
    return inner


def _region_boxes(mask: Image, min_area_px: float) -> Floats:
    """Boxes (N, 4) around connected regions of a mask."""
    import cv2

    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    boxes = [cv2.boundingRect(contour) for contour in contours if cv2.contourArea(contour) >= min_area_px]
    return np.array(boxes, np.float64).reshape(-1, 4)


class _PersonHeight:
    """Estimates how tall people are in the picture: the median height of regions, weighted by their area.

    Regions are measured before joining and filtering, which depend on the estimate: there is no feedback.
    """

    _memory = 2000

    def __init__(self) -> None:
        self._regions: deque[tuple[float, float]] = deque(maxlen=self._memory)  # height, area

    def update(self, mask: Image) -> float:
        """Take the regions of a mask; returns the estimate, in pixels."""
        import cv2

        closed = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)), np.uint8)
        boxes = _region_boxes(closed, _MIN_AREA_PX)
        boxes = boxes[boxes[:, 3] < mask.shape[0] / 2]
        self._regions.extend(zip(boxes[:, 3].tolist(), (boxes[:, 2] * boxes[:, 3]).tolist(), strict=True))
        if len(self._regions) < _MIN_REGIONS:
            return _INITIAL_HEIGHT_PX
        height, area = np.array(sorted(self._regions)).T
        total = np.cumsum(area)
        return float(height[np.searchsorted(total, total[-1] / 2)])


def _find_boxes(mask: Image, person_px: float) -> Floats:
    """Boxes (N, 4) of people of about this height in a mask."""
    import cv2

    tall = max(1, round(_JOIN_HEIGHTS * person_px) // 2 * 2 + 1)
    closed = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((tall, 1), np.uint8)), np.uint8)
    return _region_boxes(closed, max(_MIN_AREA_PX, _MIN_AREA_HEIGHTS * person_px**2))


def unwarp_boxes(boxes: Floats, to_reference: Floats) -> Floats:
    """Boxes (N, 4) of the reference picture in the picture itself. They stay upright, as rotations are small."""
    if to_reference is IDENTITY:
        return boxes
    import cv2

    return move_boxes(np.asarray(cv2.invertAffineTransform(to_reference), np.float64), boxes)


def boxes_to_rows(boxes: Floats, people: Ints | None = None) -> NDArray[np.void]:
    """Rows of boxes (N, 4), sorted from top to bottom, then from left to right.

    ``people`` (N,) is how many each holds, if that was counted.
    """
    order = np.lexsort((boxes[:, 0], boxes[:, 1]))
    x, y, w, h = boxes[order].T
    count = np.zeros(len(boxes), np.int64) if people is None else people[order]
    return DETECTIONS.rows(x_px=x, y_px=y, w_px=w, h_px=h, class_id=np.full(len(boxes), _PERSON_CLASS), people=count)


class _BackgroundModel:
    """Background subtraction with OpenCV's KNN, which learns over ``history_s``, and faster at first."""

    def __init__(self, threshold: float | None, history_s: float) -> None:
        import cv2

        # Annotated loosely: the stubs of OpenCV 4 and 5 differ.
        make: Any = cv2.createBackgroundSubtractorKNN
        self._model = make(500, _THRESHOLD if threshold is None else threshold, True)
        self._history_s = history_s
        self._count = 0

    def mask(self, image: Image, clock: FrameClock) -> Image:
        """255 where ``image`` (height, width) shows foreground."""
        import cv2

        self._count += 1
        # KNN draws from OpenCV's random number generator; without a seed results would differ from run to run.
        cv2.setRNGSeed(self._count)
        rate = 1 / min(2 * self._count, max(clock.frames(self._history_s), 2))
        labels = self._model.apply(image, learningRate=rate)
        return np.where(np.asarray(labels) == _FOREGROUND, np.uint8(255), np.uint8(0))
