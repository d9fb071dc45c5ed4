"""Pictures of what questions are about: a few crops of each side of a gap."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mcaptrack import log
from mcaptrack.extensions.review.questions import Question, Tracklet
from mcaptrack.geometry.arrays import Image
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import Frame
from mcaptrack.sources.pictures import Pictures

#: Crops of each side, of samples at most so many seconds from the gap.
_CROPS, _WITHIN_S = 4, 4.0
#: A crop shows so much around its box, as a share of the box on either side.
_AROUND = 0.25


def crops(opened: log.Log, topic: str, samples: Sequence[Frame], asked: Sequence[Question]) -> list[list[list[Image]]]:
    """The crops of both sides of each question, the nearest to the gap first: (height, width, 3), blue, green, red.

    Pictures of ``topic`` are decoded once, in order. A question about one tracklet has crops of its whole length on
    one side, and none on the other. Crops of pictures that can't be decoded are left out.
    """
    sides = [(at, side, tracklet) for at, q in enumerate(asked) for side, tracklet in enumerate((q.before, q.after))]
    wanted: dict[int, list[tuple[int, int, int, int]]] = {}
    out: list[list[list[Image]]] = [[[], []] for _ in asked]
    times = np.array([frame.t_ns for frame in samples])
    pictures = Pictures(opened, topic)
    for at, side, tracklet in sides:
        if tracklet is None:
            continue
        for rank, number in enumerate(_chosen(times, tracklet, asked[at].after is not None and side == 0, asked[at])):
            shown = int(max(np.searchsorted(pictures.t_ns, times[number], "right") - 1, 0))
            wanted.setdefault(shown, []).append((at, side, rank, number))
    for picture in pictures.readable(wanted):
        for at, side, _, number in wanted[picture.index]:
            tracklet = asked[at].after if side else asked[at].before
            rows = samples[number].rows
            boxes = columns_to_boxes(rows[rows["track_id"] == tracklet.source_id]) if tracklet else np.empty((0, 4))
            if len(boxes) and np.isfinite(boxes).all() and (crop := _crop(picture.rows, boxes[0])).size:
                out[at][side].insert(0 if side == 0 and asked[at].after else len(out[at][side]), crop)
    return out


def _chosen(times: np.ndarray, tracklet: Tracklet, is_end: bool, question: Question) -> list[int]:
    """The numbers of the samples that are shown of a tracklet."""
    inside = np.flatnonzero((times >= tracklet.begin_ns) & (times <= tracklet.end_ns))
    if question.after is not None:
        edge = tracklet.end_ns if is_end else tracklet.begin_ns
        inside = inside[np.abs(times[inside] - edge) <= _WITHIN_S * NS_PER_S]
    places = np.unique(np.linspace(0, len(inside) - 1, min(_CROPS, len(inside))).round().astype(int))
    return [int(number) for number in inside[places]]


def _crop(picture: Image, box: np.ndarray) -> Image:
    left, top, width, height = box
    low = np.maximum([top - _AROUND * height, left - _AROUND * width], 0).astype(int)
    high = np.maximum([top + (1 + _AROUND) * height, left + (1 + _AROUND) * width], 0).astype(int) + 1
    return picture[low[0] : high[0], low[1] : high[1]].copy()
