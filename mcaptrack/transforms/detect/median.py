"""A motion detector that reads the pictures twice: it knows the background of the whole recording before it compares.

The first time it registers the pictures, learns a background for each view and each block of time, and how tall people
are and which shape they have. The second time it compares each picture with its background and separates people.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from math import inf
from types import MappingProxyType
from typing import ClassVar, Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY
from mcaptrack.geometry.arrays import Floats, Image
from mcaptrack.geometry.clocks import seconds_to_ns
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, VIDEO, Frame, Schema
from mcaptrack.transforms.detect.background import (
    MAX_FOREGROUND,
    KnnDetector,
    boxes_to_rows,
    clear_border,
    halve,
    unwarp_boxes,
    warp,
)
from mcaptrack.transforms.detect.median_background import MIN_THRESHOLD, Background, Sampler
from mcaptrack.transforms.detect.people import Separator
from mcaptrack.transforms.detect.person_model import Learner, Person, region_boxes, typical_heights
from mcaptrack.transforms.detect.registration import Registration, Steadiness
from mcaptrack.transforms.protocol import Colour, check_options, option, setting

#: A shorter view, or one of fewer pictures, has no background of its own: people hardly move in that time.
_MIN_SPAN_S: Final = 1.8
_MIN_PICTURES: Final = 10
#: Pictures in a row without a place in a view that are kept, because they may belong to the next one.
_MAX_UNKNOWN: Final = 30
#: People are of two sizes, close ones and far ones, where half of the outline of all regions belongs to ones that are
#: lower by this factor than those with half of the area.
_APART: Final = 1.5
#: The heights of people are called contradicted from this share of the moving pixels on.
_CONTRADICTED: Final = 0.1
#: The same as ``MAX_FOREGROUND``, where the picture could not be registered.
_MAX_FOREGROUND_LOST: Final = 0.2


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
    history_s: float = setting(600.0, "length of the blocks of time that have one background, in seconds", least=0.1)
    max_pixels: int = setting(
        1_000_000, "pictures are halved until they have no more pixels than this", least=1_000, most=1_000_000_000
    )
    stabilise: bool = setting(True, "compensate the motion of a shaking camera")
    remove_shadows: bool = setting(True, "leave out what is darker than the background, but of the same colour")
    separate: bool = setting(True, "separate people who are one region, by the height and shape of people in the scene")
    least_visible: float = setting(
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
        _warn_of_short(views)
        _warn_of_heights(views)

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why there are no detections, for a warning."""
        return f"nothing in its {len(made)} pictures differs from their median by more than the threshold"

    def _learn(self, frames: Iterable[Frame]) -> list[_View]:
        camera, steadiness = Registration(), Steadiness()
        views: list[_View] = []
        unknown: list[_Picture] = []
        for frame in frames:
            image, _ = _picture(frame, self.max_pixels)
            to_reference, is_new = _register(camera, image) if self.stabilise else (IDENTITY, False)
            is_new = is_new or not views or views[-1].size != image.shape
            steadiness.update(frame.t_ns, camera.view, is_new)
            picture = _Picture(frame.t_ns, image, to_reference, camera.view != "steady" and not is_new)
            if picture.is_lost:
                unknown.append(picture)
                if len(unknown) > _MAX_UNKNOWN:
                    views[-1].add(unknown.pop(0), self)
                continue
            begun = _of_next_view(unknown, image) if is_new else []
            for seen in unknown[: len(unknown) - len(begun)]:
                views[-1].add(seen, self)
            if is_new:
                if views:
                    views[-1].close(self)
                views.append(_View(image.shape))
            for seen in (*begun, picture):
                views[-1].add(seen, self)
            unknown = []
        if views:
            for seen in unknown:
                views[-1].add(seen, self)
            views[-1].close(self)
        steadiness.check()
        return views


class _Picture(NamedTuple):
    """A picture, halved and registered; ``is_lost`` if that failed, or if it lies too far from its view."""

    t_ns: int
    image: Image
    to_reference: Floats
    is_lost: bool = False


def _of_next_view(unknown: Sequence[_Picture], reference: Image) -> list[_Picture]:
    """The latest pictures without a view that show the scene of ``reference``, registered to it.

    A camera that has settled, or a cut without contrast, is noticed only after some pictures.
    """
    camera, registered = Registration(), deque[_Picture]()
    _register(camera, reference)
    for picture in reversed(unknown):
        to_reference, is_new = _register(camera, picture.image)
        if is_new or camera.view != "steady":
            break
        registered.appendleft(picture._replace(to_reference=to_reference, is_lost=False))
    return [*registered]


def _picture(frame: Frame, max_pixels: int) -> tuple[Image, int]:
    """The picture (H, W, 3), halved until it is small enough, and how often; grey pictures get three equal channels."""
    image, halvings = halve(frame.rows, max_pixels)
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2), halvings


def _register(camera: Registration, image: Image) -> tuple[Floats, bool]:
    """The transform (2, 3) from a picture (H, W, 3) to its view, and whether the view begins with it."""
    import cv2

    return camera.register(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8))


@dataclass(eq=False)
class _View:
    """Pictures in a row that show the same scene: how each is registered, backgrounds by time, and how people look."""

    size: tuple[int, ...]
    to_reference: list[Floats] = field(default_factory=list)
    #: Numbers of pictures that could not be registered.
    lost: set[int] = field(default_factory=set)
    person: Person | None = None
    _person_px: float = 0.0
    _sampler: Sampler = field(default_factory=Sampler)
    _learner: Learner = field(default_factory=Learner)
    _start_ns: int | None = None
    _last_ns: int = 0
    #: Backgrounds, and when each begins to hold.
    _blocks: deque[tuple[int, Background]] = field(default_factory=deque)

    @property
    def is_short(self) -> bool:
        """Whether no part of it is long enough for a background."""
        return not self._blocks

    def add(self, picture: _Picture, detector: MedianDetector) -> None:
        """Take a picture, the first time."""
        t_ns, image, to_reference, is_lost = picture
        if self._start_ns is None:
            self._start_ns = t_ns
        elif t_ns - self._start_ns >= seconds_to_ns(detector.history_s):
            self._finish_block(detector)
            self._start_ns, self._sampler = t_ns, Sampler()
        self._last_ns = t_ns
        if is_lost:
            self.lost.add(len(self.to_reference))
        else:
            self._sampler.add(lambda: warp(image, to_reference))
        self.to_reference.append(to_reference)

    def _finish_block(self, detector: MedianDetector) -> None:
        samples, start_ns = self._sampler.pictures, self._start_ns or 0
        least_s = detector.history_s / 2 if self._blocks else min(_MIN_SPAN_S, detector.history_s / 2)
        if len(samples) < _MIN_PICTURES or self._last_ns - start_ns < seconds_to_ns(least_s):
            return  # the background before it holds on, if there is one
        background = Background.of(samples, detector.threshold)
        masks = [background.mask(image, detector.remove_shadows) for image in samples]
        person_px, smaller_px = typical_heights(masks)
        is_apart = smaller_px * _APART < person_px
        self._person_px = smaller_px if is_apart else person_px
        background = background.swaying(samples, self._person_px)
        masks = [background.mask(image, detector.remove_shadows) for image in samples]
        self._learner.add(masks, person_px, smaller_px if is_apart else None)
        self._blocks.append((start_ns, replace(background)))  # a copy without the ranges that were computed

    def close(self, detector: MedianDetector) -> None:
        """No more pictures come: forget the samples."""
        self._finish_block(detector)
        self.person = self._learner.person()
        self._sampler, self._learner = Sampler(), Learner()

    def detect(self, frames: Iterable[Frame], detector: MedianDetector) -> Iterator[tuple[Frame]]:
        """The detections of its pictures, which come for the second time."""
        if self.is_short:
            once = KnnDetector(max_pixels=detector.max_pixels, stabilise=detector.stabilise)
            yield from once.detect(map(_in_grey, frames), Steadiness())
            return
        separator = Separator(self.person, detector.least_visible) if self.person else None
        for number, (frame, to_reference) in enumerate(zip(frames, self.to_reference, strict=True)):
            image, halvings = _picture(frame, detector.max_pixels)
            while len(self._blocks) > 1 and frame.t_ns >= self._blocks[1][0]:
                self._blocks.popleft()  # no more pictures of this one come
            boxes, people = np.empty((0, 4)), None
            seen = self._blocks[0][1].mask(warp(image, to_reference), detector.remove_shadows)
            mask = clear_border(seen, to_reference)
            most = _MAX_FOREGROUND_LOST if number in self.lost else MAX_FOREGROUND
            if np.count_nonzero(mask) <= most * mask.size:
                if separator and detector.separate:
                    boxes, people = separator.boxes(mask)
                else:
                    boxes = region_boxes(mask, self._person_px)
                    people = separator.counts(mask, boxes) if separator else None
            rows = boxes_to_rows(unwarp_boxes(boxes, to_reference) * 2**halvings, people)
            yield (Frame(frame.t_ns, frame.index, rows),)


def _in_grey(frame: Frame) -> Frame:
    import cv2

    return frame if frame.rows.ndim == 2 else frame._replace(rows=cv2.cvtColor(frame.rows, cv2.COLOR_BGR2GRAY))


def _warn_of_short(views: Sequence[_View]) -> None:
    """Warn of pictures in views that were too short."""
    pictures = sum(len(view.to_reference) for view in views)
    short = sum(len(view.to_reference) for view in views if view.is_short)
    if short:
        where = "all" if short == pictures else f"{short} of {pictures}"
        warn(
            f"{where} pictures are in views or blocks of less than {_MIN_SPAN_S} s or {_MIN_PICTURES} pictures: too few"
            " for a median as the background; detections there are by the detector knn",
            "few-pictures",
        )


def _warn_of_heights(views: Sequence[_View]) -> None:
    """Warn where the learned heights of people are not used, because moving regions contradict them."""
    share = max((view.person.contradicted for view in views if view.person), default=0.0)
    if share >= _CONTRADICTED:
        warn(
            f"the heights of people that were learned don't hold everywhere: {share:.0%} of the moving pixels are of "
            "regions more than twice as tall and shaped like one person or vehicle. Where these prevail, each is one "
            "box, and people close to each other there are not separated",
            "heights",
        )


def _with_views(frames: Iterable[Frame], views: Sequence[_View]) -> Iterator[tuple[_View, Iterator[Frame]]]:
    """Views and their frames."""
    pictures = iter(frames)
    for view in views:
        yield view, islice(pictures, len(view.to_reference))
