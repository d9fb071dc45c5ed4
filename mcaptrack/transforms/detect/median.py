"""A motion detector that reads the pictures twice: it knows the background of the whole recording before it compares.

The first time it registers the pictures, learns a background for each view and each block of time, and how tall people
are and which shape they have. The second time it compares each picture with its background and separates people.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from math import inf
from types import MappingProxyType
from typing import ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY
from mcaptrack.geometry.arrays import Bools, Floats, Image
from mcaptrack.geometry.clocks import seconds_to_ns
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, VIDEO, Frame, Schema
from mcaptrack.transforms.detect.background import (
    MAX_FOREGROUND,
    KnnDetector,
    Registration,
    Steadiness,
    boxes_to_rows,
    clear_border,
    halve,
    unwarp_boxes,
    warp,
)
from mcaptrack.transforms.detect.people import Learner, Person, Separator, region_boxes, typical_heights
from mcaptrack.transforms.protocol import Colour, option, parameters, setting

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


# The background of a camera that stands still: the median of pictures from a long time, in colour.
#
# A picture differs from it where a colour lies outside of the range that the background has within a pixel, by more
# than the noise there. What sways (leaves, flags, tapes) shows colours that lie close by in the background: there
# the range is taken over a wider surrounding.
#
# Letters: S samples, H, W height and width of pictures.


#: Samples are taken evenly over time: at most so many, at least half of that from a longer recording.
MAX_SAMPLES: Final = 48
#: Differences of colour (0 to 255) that always count as noise, and the multiple of the standard deviation that does.
MIN_THRESHOLD: Final = 22.0
_DEVIATIONS: Final = 4.0
#: Pictures are blurred where the usual noise counts for more than this multiple of the threshold, over so many pixels.
_NOISY: Final = 1.5
_BLUR_PX: Final = 5
#: Standard deviation of normal noise in units of its median absolute deviation.
_PER_MAD: Final = 1.4826
#: A colour this far outside of the range of the surrounding still lies within.
_SWAY_MARGIN: Final = 8
#: A place sways if at least this share of what differs there is in the range of the surrounding.
_SWAY_SHARE: Final = 0.6
#: In units of the height of people: the surrounding, and the cells in which shares are counted.
_SWAY_RADIUS: Final = 0.2
_SWAY_CELL: Final = 0.3
#: Cells with less than this sum of differing pixels a pixel, over all samples, are not judged.
_SWAY_LEAST: Final = 0.02
#: A shadow is darker by these factors, nearly the same in all colours.
_SHADOW: Final = (0.55, 0.98)
_SHADOW_TINT: Final = 0.12
#: Light that is brighter or darker by more than this share is compensated, on a grid of every so many pixels.
_LIGHT: Final = 0.02
_GRID: Final = 8


#: Rows of pictures of which the median is taken together.
_STRIP: Final = 8


class Sampler:
    """Keeps pictures that lie evenly in time, however many come."""

    def __init__(self) -> None:
        self.pictures: list[Image] = []
        self._step, self._seen = 1, 0

    def add(self, picture: Callable[[], Image]) -> None:
        """Take the next picture, which is only made if it is kept."""
        if self._seen % self._step == 0:
            if len(self.pictures) == MAX_SAMPLES:
                self.pictures = self.pictures[::2]
                self._step *= 2
            if self._seen % self._step == 0:
                self.pictures.append(picture())
        self._seen += 1


def largest(image: Image) -> Image:
    """The largest channel of each pixel, (H, W)."""
    import cv2

    blue, green, red = cv2.split(image)
    return np.asarray(cv2.max(cv2.max(blue, green), red), np.uint8)


def _middle(images: Sequence[Image]) -> Image:
    """The median of each pixel and channel, of at most 255 pictures; of an even number the upper one.

    It is found bit by bit, as the largest value that at most half of the pictures are below: that takes a sixth of the
    time of a partition.
    """
    at = len(images) // 2
    out = np.zeros_like(images[0])
    for row in range(0, len(out), _STRIP):  # in strips, which stay in the processor's cache
        strip, median = np.stack([image[row : row + _STRIP] for image in images]), out[row : row + _STRIP]
        for bit in (128, 64, 32, 16, 8, 4, 2, 1):
            candidate = median | np.uint8(bit)
            below = (strip < candidate).view(np.uint8).sum(axis=0, dtype=np.uint8)
            np.copyto(median, candidate, where=below <= at)
    return out


@dataclass(frozen=True)
class Background:
    """A background, and which pixels of a picture differ from it.

    Attributes
    ----------
    median : (H, W, 3) uint8
        Its colours: blue, green, red.
    threshold : (H, W) uint8
        The largest difference that is noise.
    is_grey : bool
        Whether it has no colours, so that shadows can't be told by them.
    is_blurred : bool
        Whether it is one of blurred pictures, because there is much noise.
    sways : (H, W) bool, optional
        Where it sways, and over which distance ``sway_px``.
    lowest, highest : (H, W, 3) uint8
        The range of its colours around each pixel. They are computed when they are needed first, because a long
        recording has many backgrounds, and needs one at a time.

    """

    median: Image
    threshold: Image
    is_grey: bool
    is_blurred: bool = False
    sways: Bools | None = None
    sway_px: int = 0

    @cached_property
    def _limits(self) -> tuple[Image, Image]:
        near = _range(self.median, 1)
        if self.sways is None:
            return near
        lowest, highest = (
            np.where(self.sways[..., None], far, close)
            for far, close in zip(_range(self.median, self.sway_px), near, strict=True)
        )
        return lowest, highest

    @cached_property
    def _usual(self) -> tuple[Image, Image]:
        """The lowest and the highest colours that don't differ."""
        import cv2

        noise = cv2.merge([self.threshold] * 3)
        return np.asarray(cv2.subtract(self.lowest, noise), np.uint8), np.asarray(
            cv2.add(self.highest, noise), np.uint8
        )

    @cached_property
    def _light(self) -> NDArray[np.float32]:
        """The background's colours on a coarse grid, plus 1, so that they can be divided by."""
        return self.median[::_GRID, ::_GRID].astype(np.float32) + 1

    @property
    def lowest(self) -> Image:
        return self._limits[0]

    @property
    def highest(self) -> Image:
        return self._limits[1]

    @classmethod
    def of(cls, samples: Sequence[Image], threshold: float | None = None) -> Background:
        """The background of pictures (H, W, 3), with the differences that count as noise everywhere at least."""
        least = MIN_THRESHOLD if threshold is None else threshold
        median, noise = _median_and_noise(samples)
        is_blurred = bool(np.median(noise) > _NOISY * least)
        if is_blurred:
            median, noise = _median_and_noise([_blurred(image) for image in samples])
        limit = np.clip(np.maximum(least, noise), 0, 255).astype(np.uint8)
        return cls(median, limit, not np.ptp(median, axis=-1).any(), is_blurred)

    def swaying(self, samples: Sequence[Image], person_px: float) -> Background:
        """The background with a wider range at places that sway in ``samples``.

        ``person_px`` is how tall people are, in pixels.
        """
        import cv2

        sway_px = max(2, round(_SWAY_RADIUS * person_px))
        lowest, highest = _range(self.median, sway_px)
        differs = np.zeros(self.threshold.shape, np.float32)
        is_near = differs.copy()
        for image in samples:
            mask = self.mask(image, shadows=True) > 0
            differs += mask
            seen = _blurred(image) if self.is_blurred else image
            is_near += mask & (_outside(seen, lowest, highest) <= _SWAY_MARGIN)
        cell = round(_SWAY_CELL * person_px) | 1
        total = np.asarray(cv2.boxFilter(differs, -1, (cell, cell)), np.float32)
        near = np.asarray(cv2.boxFilter(is_near, -1, (cell, cell)), np.float32)
        sways = (near > _SWAY_SHARE * total) & (total > _SWAY_LEAST)
        half = cell // 2 | 1
        wide: Bools = np.asarray(cv2.dilate(sways.astype(np.uint8), np.ones((half, half), np.uint8))) > 0
        return replace(self, sways=wide, sway_px=sway_px)

    def mask(self, image: Image, shadows: bool) -> Image:
        """255 where ``image`` (H, W, 3) differs; not where it only lies in the shade, if ``shadows`` are removed."""
        import cv2

        image = self._same_light(_blurred(image) if self.is_blurred else image)
        mask = np.asarray(cv2.bitwise_not(cv2.inRange(image, *self._usual)), np.uint8)
        if shadows and not self.is_grey:
            at = np.flatnonzero(mask.view(np.bool_))
            seen, usual = (np.take(colours.reshape(-1, 3), at, axis=0).T for colours in (image, self.median))
            blue, green, red = (seen.astype(np.float32) + 1) / (usual.astype(np.float32) + 1)
            darker = (blue + green + red) / 3
            tint = np.maximum(np.maximum(blue, green), red) - np.minimum(np.minimum(blue, green), red)
            is_shadow = (darker > _SHADOW[0]) & (darker < _SHADOW[1]) & (tint < _SHADOW_TINT)
            mask.reshape(-1)[at[is_shadow]] = 0
        return mask

    def _same_light(self, image: Image) -> Image:
        """The picture in the light of the background: exposure and clouds change all of it by a factor."""
        import cv2

        factors = self._light / (image[::_GRID, ::_GRID].astype(np.float32) + 1)
        least = factors.size // 2 - 1  # if fewer are beyond a limit, the median isn't
        low, high = np.count_nonzero(factors <= 1 - _LIGHT / 2), np.count_nonzero(factors >= 1 + _LIGHT / 2)
        if max(low, high) < least:
            return image
        factor = float(np.median(factors))
        return image if abs(factor - 1) < _LIGHT else np.asarray(cv2.convertScaleAbs(image, alpha=factor), np.uint8)


def _median_and_noise(samples: Sequence[Image]) -> tuple[Image, NDArray[np.float32]]:
    """The median of pictures (H, W, 3), and how far a pixel's noise takes it from there, (H, W)."""
    import cv2

    median = _middle(samples)
    deviation = _middle([largest(np.asarray(cv2.absdiff(image, median), np.uint8)) for image in samples])
    return median, np.float32(_DEVIATIONS * _PER_MAD) * deviation.astype(np.float32)


def _blurred(image: Image) -> Image:
    import cv2

    return np.asarray(cv2.GaussianBlur(image, (_BLUR_PX, _BLUR_PX), 0), np.uint8)


def _range(image: Image, radius: int) -> tuple[Image, Image]:
    """The lowest and the highest value of each channel within a distance."""
    import cv2

    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE if radius > 1 else cv2.MORPH_RECT, (2 * radius + 1,) * 2)
    return np.asarray(cv2.erode(image, kernel), np.uint8), np.asarray(cv2.dilate(image, kernel), np.uint8)


def _outside(image: Image, lowest: Image, highest: Image) -> Image:
    """The distance of each pixel from a range, in its worst channel, (H, W)."""
    import cv2

    return largest(np.asarray(cv2.max(cv2.subtract(image, highest), cv2.subtract(lowest, image)), np.uint8))


@dataclass(frozen=True, kw_only=True)
@parameters
class MedianDetector:
    """Detect who differs from the median of the recording, in colour; shadows are removed, groups separated.

    Reads video twice, writes detections: one box for each person. People who stand still are found as long as they
    stand for less than half of ``history_s``.

    Parameters
    ----------
    threshold : float
        Difference of colour (0 to 255) that counts as motion at least.
    history_s : float
        Length of the blocks of time that have one background, in seconds.
    max_pixels : int
        Pictures are halved until they have no more pixels than this.
    stabilise : bool
        Compensate the motion of a shaking camera.
    remove_shadows : bool
        Leave out what is darker than the background, but of the same colour.
    separate : bool
        Separate people who are one region, by the height and shape of people in the scene.
    least_visible : float
        Share of a person that has to be seen for a box of their own beside others.

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

    threshold: float = option(MIN_THRESHOLD, least=0.0)
    history_s: float = setting(600.0, least=0.1)
    max_pixels: int = setting(1_000_000, least=1_000, most=1_000_000_000)
    stabilise: bool = setting(True)
    remove_shadows: bool = setting(True)
    separate: bool = setting(True)
    least_visible: float = setting(0.5, least=0.05, most=1.0)

    colour: ClassVar[Colour] = "bgr"
    passes: ClassVar[int] = 2
    needs_still_camera: ClassVar[bool] = True
    reads: ClassVar[Schema] = VIDEO
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": DETECTIONS})
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": inf})

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
    is_lost: bool


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
        usual = Background.of(samples, detector.threshold)

        def masks_of(background: Background) -> list[Image]:
            return [background.mask(image, detector.remove_shadows) for image in samples]

        person_px, _ = typical_heights(masks_of(usual))
        background = usual.swaying(samples, person_px)
        masks = masks_of(background)
        # what sways has as much outline as people far away: only without it the outlines tell how tall these are
        _, smaller_px = typical_heights(masks)
        is_apart = smaller_px * _APART < person_px
        if is_apart:
            background = usual.swaying(samples, smaller_px)
            masks = masks_of(background)
        self._person_px = smaller_px if is_apart else person_px
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
