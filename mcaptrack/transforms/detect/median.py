"""A motion detector that reads the pictures twice: it knows the background of the whole recording before it compares.

The first time it registers the pictures, learns a background for each view and each block of time, and how tall people
are and which shape they have. The second time it compares each picture with its background and separates people.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from math import inf
from types import MappingProxyType
from typing import ClassVar, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY
from mcaptrack.geometry.arrays import Floats, Image
from mcaptrack.geometry.clocks import seconds_to_ns
from mcaptrack.schema import DETECTIONS, VIDEO, Frame, Schema
from mcaptrack.transforms.detect.background import (
    MAX_FOREGROUND,
    boxes_to_rows,
    clear_border,
    halve,
    unwarp_boxes,
    warp,
)
from mcaptrack.transforms.detect.camera_motion import CameraMotion
from mcaptrack.transforms.detect.median_background import MIN_THRESHOLD, Background, Sampler
from mcaptrack.transforms.detect.people import Separator
from mcaptrack.transforms.detect.person_model import Learner, Person, region_boxes, typical_height
from mcaptrack.transforms.detect.steadiness import Steadiness
from mcaptrack.transforms.protocol import Colour, check_options, option

#: A block of fewer pictures than this has no background.
_MIN_SAMPLES: Final = 5


@dataclass(frozen=True, kw_only=True)
class MedianDetector:
    """Detect who differs from the median of the recording, in colour; shadows are removed, groups separated.

    Reads video twice, writes detections: one box for each person. People who stand still are found as long as they
    stand for less than half of ``history_s``.

    Examples
    --------
    A bright square of 20 pixels moves over a dark picture, and is gone in the second half:

    >>> import numpy as np
    >>> from mcaptrack.schema import Frame
    >>> frames = [Frame(n * 40_000_000, n, np.full((80, 160, 3), 30, np.uint8)) for n in range(60)]
    >>> for frame in frames[:30]:
    ...     frame.rows[30:50, 4 * frame.index : 4 * frame.index + 20] = 200
    >>> rows = [frame.rows for (frame,) in MedianDetector()(frames)]
    >>> len(rows[10]), float(rows[10]["x_px"][0]), len(rows[40])
    (1, 40.0, 0)

    References
    ----------
    The median as a background: R. Cucchiara et al., "Detecting moving objects, ghosts, and shadows in video streams",
    TPAMI 2003. Shapes of people that explain a mask: F. Fleuret et al., "Multicamera people tracking with a
    probabilistic occupancy map", TPAMI 2008.

    """

    threshold: float = option(
        MIN_THRESHOLD, "difference of colour (0 to 255) that counts as motion at least", least=0.0
    )
    history_s: float = option(600.0, "length of the blocks of time that have one background, in seconds", least=0.1)
    max_pixels: int = option(
        1_000_000, "pictures are halved until they have no more pixels than this", least=1_000, most=1_000_000_000
    )
    stabilise: bool = option(True, "compensate the motion of a shaking camera")
    remove_shadows: bool = option(True, "leave out what is darker than the background, but of the same colour")
    separate: bool = option(True, "separate people who are one region, by the height and shape of people in the scene")
    least_visible: float = option(
        0.5, "share of a person that has to be seen for a box of their own beside others", least=0.05, most=1.0
    )

    colour: ClassVar[Colour] = "bgr"
    passes: ClassVar[int] = 2
    needs_still_camera: ClassVar[bool] = True
    reads: ClassVar[Schema] = VIDEO
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": DETECTIONS})
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": inf})

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        if iter(frames) is frames:
            raise McaptrackError("the median detector reads the pictures twice; give it a list, not an iterator")
        views = self._learn(frames)
        for view, part in _with_views(frames, views):
            yield from view.detect(part, self)

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why there are no detections, for a warning."""
        return f"nothing in its {len(made)} pictures differs from their median by more than the threshold"

    def _learn(self, frames: Iterable[Frame]) -> list[_View]:
        camera, steadiness = CameraMotion(), Steadiness()
        views: list[_View] = []
        for frame in frames:
            image, _ = _picture(frame, self.max_pixels)
            to_reference, is_new = _register(camera, image) if self.stabilise else (IDENTITY, False)
            is_new = is_new or not views or views[-1].size != image.shape
            steadiness.update(frame.t_ns, camera.view, is_new)
            if is_new:
                if views:
                    views[-1].close(self)
                views.append(_View(image.shape))
            views[-1].add(frame.t_ns, image, to_reference, self)
        if views:
            views[-1].close(self)
        steadiness.check()
        return views


def _picture(frame: Frame, max_pixels: int) -> tuple[Image, int]:
    """The picture (H, W, 3), halved until it is small enough, and how often; grey is three equal colours."""
    image, halvings = halve(frame.rows, max_pixels)
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2), halvings


def _register(camera: CameraMotion, image: Image) -> tuple[Floats, bool]:
    """The similarity (2, 3) to the reference picture, estimated from brightness at half the size."""
    import cv2

    height, width = image.shape[:2]
    half = cv2.resize(image, (max(width // 2, 1), max(height // 2, 1)), interpolation=cv2.INTER_AREA)
    to_reference, is_new = camera.estimate(np.asarray(cv2.cvtColor(half, cv2.COLOR_BGR2GRAY), np.uint8))
    if to_reference is not IDENTITY:
        to_reference = to_reference * np.array([1.0, 1.0, 2.0])
    return to_reference, is_new


@dataclass(eq=False)
class _View:
    """Pictures in a row that show the same scene: how each is registered, backgrounds by time, and how people look."""

    size: tuple[int, ...]
    to_reference: list[Floats] = field(default_factory=list)
    person: Person | None = None
    _person_px: float = 0.0
    _sampler: Sampler = field(default_factory=Sampler)
    _learner: Learner = field(default_factory=Learner)
    _start_ns: int | None = None
    _last_ns: int = 0
    #: Backgrounds, and when each begins to hold.
    _blocks: list[tuple[int, Background]] = field(default_factory=list)

    def add(self, t_ns: int, image: Image, to_reference: Floats, detector: MedianDetector) -> None:
        """Take a picture, the first time."""
        if self._start_ns is None:
            self._start_ns = t_ns
        elif t_ns - self._start_ns >= seconds_to_ns(detector.history_s):
            self._finish_block(detector)
            self._start_ns, self._sampler = t_ns, Sampler()
        self._last_ns = t_ns
        self.to_reference.append(to_reference)
        self._sampler.add(lambda: warp(image, to_reference))

    def _finish_block(self, detector: MedianDetector) -> None:
        samples, start_ns = self._sampler.pictures, self._start_ns or 0
        is_short = self._last_ns - start_ns < seconds_to_ns(detector.history_s) // 2
        if len(samples) < _MIN_SAMPLES or (self._blocks and is_short):
            return  # the background before it holds on
        background = Background.of(samples, detector.threshold)
        masks = [background.mask(image, detector.remove_shadows) for image in samples]
        person_px = typical_height(masks)
        background = background.swaying(samples, person_px)
        self._learner.add([background.mask(image, detector.remove_shadows) for image in samples], person_px)
        self._person_px = person_px
        self._blocks.append((start_ns, background))

    def close(self, detector: MedianDetector) -> None:
        """No more pictures come: forget the samples."""
        self._finish_block(detector)
        self.person = self._learner.person() if detector.separate else None
        self._sampler, self._learner = Sampler(), Learner()

    def detect(self, frames: Iterable[Frame], detector: MedianDetector) -> Iterator[tuple[Frame]]:
        """The detections of its pictures, which come for the second time."""
        separator = Separator(self.person, detector.least_visible) if self.person else None
        block = 0
        for frame, to_reference in zip(frames, self.to_reference, strict=True):
            image, halvings = _picture(frame, detector.max_pixels)
            while block + 1 < len(self._blocks) and frame.t_ns >= self._blocks[block + 1][0]:
                block += 1
            boxes = np.empty((0, 4))
            if self._blocks:
                seen = self._blocks[block][1].mask(warp(image, to_reference), detector.remove_shadows)
                mask = clear_border(seen, to_reference)
                if np.count_nonzero(mask) <= MAX_FOREGROUND * mask.size:
                    boxes = separator.boxes(mask) if separator else region_boxes(mask, self._person_px)
            yield (Frame(frame.t_ns, frame.index, boxes_to_rows(unwarp_boxes(boxes, to_reference) * 2**halvings)),)


def _with_views(frames: Iterable[Frame], views: Sequence[_View]) -> Iterator[tuple[_View, Iterator[Frame]]]:
    """Views and their frames."""
    pictures = iter(frames)
    for view in views:
        yield view, islice(pictures, len(view.to_reference))
