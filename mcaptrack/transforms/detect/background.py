"""A motion detector: pictures -> boxes around what differs from a background that is learned from the past.

Each picture is halved until it is small enough, registered to a reference picture, and compared with the background.
The mask of differing pixels is cleaned, and its connected regions become boxes, in pixels of the picture before halving
and registration.

Letters: N boxes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.affine import IDENTITY, move_boxes
from mcaptrack.geometry.arrays import Floats, Image, Ints
from mcaptrack.geometry.clocks import FrameClock
from mcaptrack.schema import DETECTIONS, VIDEO, Frame, Schema
from mcaptrack.transforms.detect.registration import Registration, Steadiness
from mcaptrack.transforms.protocol import Colour, check_options, option, setting

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


@dataclass(frozen=True, kw_only=True)
class KnnDetector:
    """Detect what moves, by subtracting a background model (k nearest neighbours).

    Reads video, writes detections: one box for each connected region that differs from the background.

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

    threshold: float | None = option(
        None, "difference from the background that counts as motion; each detector has its own default", least=0.0
    )
    history_s: float = setting(60.0, "memory of the background model, in seconds", least=0.1)
    max_pixels: int = setting(
        1_000_000, "pictures are halved until they have no more pixels than this", least=1_000, most=1_000_000_000
    )
    stabilise: bool = setting(True, "compensate the motion of a shaking camera")

    colour: ClassVar[Colour] = "grey"
    needs_still_camera: ClassVar[bool] = True
    reads: ClassVar[Schema] = VIDEO
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": DETECTIONS})
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": 0.0})

    def __post_init__(self) -> None:
        check_options(self)

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
