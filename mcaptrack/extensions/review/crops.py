"""Pictures of what questions are about: a few crops of each side of a gap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from mcaptrack import log
from mcaptrack.extensions.review.questions import Question, Tracklet
from mcaptrack.geometry.arrays import Floats, Image, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import Frame, Rows
from mcaptrack.sources.pictures import Pictures

#: Crops of each side at most, of samples at most so many seconds from the gap.
_CROPS: Final = 4
_WITHIN_NS: Final = 4 * NS_PER_S
#: A crop shows so much around its box, as a share of the box on either side.
_AROUND: Final = 0.25


def crops(
    opened: log.Log, topic: str, samples: Sequence[Frame], asked: Sequence[Question], around: float = 1.0
) -> list[tuple[list[Image], list[Image]]]:
    """The crops of both sides of each question, in order of time: (height, width, 3), blue, green, red.

    Pictures of ``topic`` are decoded once, in order. A question about one tracklet has crops of its whole length after
    the gap. Crops of pictures that can't be decoded are left out. ``around`` is the brightness outside of the box.
    """
    out: list[tuple[list[Image], list[Image]]] = [([], []) for _ in asked]
    times = np.array([frame.t_ns for frame in samples])
    pictures = Pictures(opened, topic)
    wanted: dict[int, list[tuple[list[Image], Rows]]] = {}
    for question, sides in zip(asked, out, strict=True):
        for tracklet, side in zip((question.before, question.after), sides, strict=True):
            if tracklet is None:
                continue
            for number in _chosen(times, tracklet, question):
                rows = samples[number].rows
                shown = int(max(np.searchsorted(pictures.t_ns, times[number], "right") - 1, 0))
                wanted.setdefault(shown, []).append((side, rows[rows["track_id"] == tracklet.source_id]))
    for picture in pictures.readable(wanted):
        for side, rows in wanted[picture.index]:
            boxes = columns_to_boxes(rows)
            if len(boxes) and np.isfinite(boxes).all() and (crop := _crop(picture.rows, boxes[0], around)).size:
                side.append(crop)
    return out


def _chosen(times: Ints, tracklet: Tracklet, question: Question) -> list[int]:
    """The numbers of the samples that are shown of a tracklet."""
    low, high = tracklet.begin_ns, tracklet.end_ns
    if tracklet is question.before:
        low = max(low, high - _WITHIN_NS)
    elif question.before:
        high = min(high, low + _WITHIN_NS)
    inside = np.flatnonzero((times >= low) & (times <= high))
    places = np.linspace(0, len(inside) - 1, min(_CROPS, len(inside))).round().astype(int)
    return [int(number) for number in inside[places]]


def _crop(picture: Image, box: Floats, around: float) -> Image:
    """The part of a picture around a box, darker outside of it."""
    corner, size = box[1::-1], box[:1:-1]  # down, and to the right

    def cut(share: float) -> Ints:
        ends = np.stack([corner - share * size, corner + (1 + share) * size])
        return np.asarray(np.maximum(ends, 0).astype(np.int64) + np.array([[0], [1]]))

    outer, inner = cut(_AROUND), cut(0)
    shown = picture[outer[0, 0] : outer[1, 0], outer[0, 1] : outer[1, 1]]
    (top, left), (bottom, right) = inner - outer[0]
    crop = (shown * around).astype(np.uint8)
    crop[top:bottom, left:right] = shown[top:bottom, left:right]
    return crop
