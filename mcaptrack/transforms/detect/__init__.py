"""Pictures -> detections: a motion detector for cameras that stand still, or nearly.

Each picture is halved until it is small enough, moved onto where the camera stood at first, and compared with what was
there before; what differs is cleaned and boxed. Boxes are in pixels of the full picture as it is.

Letters: N boxes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Image
from mcaptrack.geometry.clocks import FrameClock
from mcaptrack.schema import DETECTIONS, VIDEO, Frame, Schema
from mcaptrack.transforms.detect.foreground import Method, model
from mcaptrack.transforms.detect.motion import IDENTITY, CameraMotion
from mcaptrack.transforms.detect.steadiness import Steadiness
from mcaptrack.transforms.protocol import check_options, option

# In units of a person's height as measured on the picture: a body falls into pieces above each other, which are joined
# over this distance, and what is left smaller than this area (height squared) is no person.
_JOIN: Final = 0.2
_LEAST_AREA: Final = 0.03
#: Where more of the picture than this differs, it is not people that differ.
_MOST: Final = 0.5
_SPECK_PX: Final = 20.0
_FIRST_HEIGHT_PX: Final = 20.0
_PERSON: Final = 1


@dataclass(frozen=True, kw_only=True)
class MotionDetector:
    """What the motion detectors share: all but how a picture is compared with those before it."""

    threshold: float | None = option(
        None, "difference from the background that counts as motion; each detector has its own default", least=0.0
    )
    history_s: float = option(60.0, "memory of the background model, in seconds", least=0.1)
    max_pixels: int = option(
        1_000_000, "pictures are halved until they have no more pixels than this", least=1_000, most=1_000_000_000
    )
    stabilise: bool = option(True, "compensate the motion of a shaking camera")

    method: ClassVar[Method]
    reads: ClassVar[Schema] = VIDEO
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": DETECTIONS})
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": 0.0})

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        clock, camera, size, steadiness = FrameClock(), CameraMotion(), _PersonSize(), Steadiness()
        foreground = model(self.method, self.threshold, self.history_s)
        for frame in frames:
            clock.tick(frame.t_ns)
            image, halvings = _halve(frame.rows, self.max_pixels)
            to_reference, is_new = camera.follow(image) if self.stabilise else (IDENTITY, False)
            steadiness.see(frame.t_ns, camera.view, is_new)
            if is_new:  # another view has another background
                foreground = model(self.method, self.threshold, self.history_s)
            mask = _steady_mask(foreground.mask(_move(image, to_reference), clock), to_reference)
            if np.count_nonzero(mask) > _MOST * mask.size:  # a model that knows nothing yet, or a lamp that went on
                mask = np.zeros_like(mask)
            boxes = _boxes(mask, size.measure(mask))
            yield (Frame(frame.t_ns, frame.index, _rows(_back(boxes, to_reference) * 2**halvings)),)
        steadiness.judge()

    def why_nothing(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why no rows came of frames, for a warning."""
        return f"nothing moves in its {len(made)} pictures that stands out by the threshold"


@dataclass(frozen=True, kw_only=True)
class KnnDetector(MotionDetector):
    """Detect what moves, by subtracting a background model (k nearest neighbours).

    Reads video, writes detections: one box for each connected region that differs from the background.
    """

    method: ClassVar[Method] = "knn"


@dataclass(frozen=True, kw_only=True)
class Mog2Detector(MotionDetector):
    """With `--detector mog2` the background model is a mixture of Gaussians (Zivkovic, ICPR 2004)."""

    method: ClassVar[Method] = "mog2"


@dataclass(frozen=True, kw_only=True)
class FrameDifferenceDetector(MotionDetector):
    """With `--detector frame-difference` pictures are compared with those just before them, as in the paper."""

    method: ClassVar[Method] = "frame-difference"


def _halve(image: Image, max_pixels: int) -> tuple[Image, int]:
    import cv2

    halvings = 0
    while image.size > max_pixels and min(image.shape) >= 4:
        height, width = image.shape
        image = np.asarray(cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8)
        halvings += 1
    return image, halvings


def _move(image: Image, to_reference: Floats) -> Image:
    import cv2

    if to_reference is IDENTITY:
        return image
    size = (image.shape[1], image.shape[0])
    return np.asarray(cv2.warpAffine(image, to_reference, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def _steady_mask(mask: Image, to_reference: Floats) -> Image:
    """Nothing is known of the edge that a moved picture has left bare."""
    if to_reference is IDENTITY:
        return mask
    height, width = mask.shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float)
    bare = int(np.ceil(np.abs(corners @ to_reference.T - corners[:, :2]).max())) + 1
    inner = np.zeros_like(mask)
    inner[bare:-bare, bare:-bare] = mask[bare:-bare, bare:-bare]
    return inner


def _contour_boxes(mask: Image, least_area: float) -> Floats:
    """Boxes (N, 4) around connected parts of a mask."""
    import cv2

    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    found = [cv2.boundingRect(contour) for contour in contours if cv2.contourArea(contour) >= least_area]
    return np.array(found, np.float64).reshape(-1, 4)


class _PersonSize:
    """How tall people are in the picture: the median height of raw blobs, weighted by their area.

    Taken before anything is joined or left out, so that it can't feed on itself.
    """

    _memory = 2000

    def __init__(self) -> None:
        self._seen: deque[tuple[float, float]] = deque(maxlen=self._memory)

    def measure(self, mask: Image) -> float:
        import cv2

        joined = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)), np.uint8)
        boxes = _contour_boxes(joined, _SPECK_PX)
        boxes = boxes[boxes[:, 3] < mask.shape[0] / 2]
        self._seen.extend(zip(boxes[:, 3].tolist(), (boxes[:, 2] * boxes[:, 3]).tolist(), strict=True))
        if len(self._seen) < 10:
            return _FIRST_HEIGHT_PX
        height, area = np.array(sorted(self._seen)).T
        total = np.cumsum(area)
        return float(height[np.searchsorted(total, total[-1] / 2)])


def _boxes(mask: Image, person_px: float) -> Floats:
    import cv2

    tall = max(1, round(_JOIN * person_px) // 2 * 2 + 1)
    joined = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((tall, 1), np.uint8)), np.uint8)
    return _contour_boxes(joined, max(_SPECK_PX, _LEAST_AREA * person_px**2))


def _back(boxes: Floats, to_reference: Floats) -> Floats:
    """Boxes of the reference picture as boxes of the picture itself. A small turn leaves a box upright."""
    if to_reference is IDENTITY:
        return boxes
    import cv2

    to_image = np.asarray(cv2.invertAffineTransform(to_reference), np.float64)
    scale = float(np.sqrt(np.abs(np.linalg.det(to_image[:, :2]))))
    centres = (boxes[:, :2] + boxes[:, 2:] / 2) @ to_image[:, :2].T + to_image[:, 2]
    size = boxes[:, 2:] * scale
    return np.concatenate([centres - size / 2, size], axis=1)


def _rows(boxes: Floats) -> NDArray[np.void]:
    """In reading order, from the top left, so that the order means something."""
    boxes = boxes[np.lexsort((boxes[:, 0], boxes[:, 1]))]
    x, y, w, h = boxes.T
    return DETECTIONS.rows(x_px=x, y_px=y, w_px=w, h_px=h, class_id=np.full(len(boxes), _PERSON))
