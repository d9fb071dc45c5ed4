"""The background of a camera that stands still: the median of pictures from a long time, in colour.

A picture differs from it where a colour lies outside of the range that the background has within a pixel, by more than
the noise there. What sways (leaves, flags, tapes) shows colours that lie close by in the background: there the range is
taken over a wider surrounding.

Letters: S samples, H, W height and width of pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Image

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
