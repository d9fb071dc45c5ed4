"""Detections -> tracks: SORT, written from the paper (Bewley et al., ICIP 2016).

A Kalman filter a track says where its box will be; boxes and tracks are assigned by their overlap; a track is shown
once it has been hit often enough and dropped when it has been missed for too long.

Letters: N detections, K tracks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mcaptrack.boxes import columns_to_boxes, iou
from mcaptrack.clock import FrameClock
from mcaptrack.kalman import BoxFilter
from mcaptrack.match import solve
from mcaptrack.plane import Planes, plane_at
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Schema
from mcaptrack.transforms.protocol import check_options, context, option

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True, kw_only=True)
class Sort:
    """Track boxes over time (SORT).

    Reads detections, writes tracks: one row for each person who is tracked and seen in a frame.
    """

    max_age_s: float = option(1.4, "a track is dropped after so long without a detection", least=0.0)
    max_age_frames: int | None = option(None, "the same in frames, instead of seconds", least=0)
    min_hits_s: float = option(0.3, "a track is shown after so long of unbroken detections", least=0.0)
    min_hits_frames: int | None = option(None, "the same in frames, instead of seconds", least=0)
    min_iou: float = option(0.2, "the least overlap of a detection with a track's expected box", least=0.0, most=1.0)
    ground_planes: Planes = context(tuple)

    reads: ClassVar[Schema] = DETECTIONS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": TRACKS})
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": 0.0})

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        tracks = _Tracks.none()
        clock, next_id = FrameClock(), 1
        for count, frame in enumerate(frames, start=1):
            elapsed = clock.tick(frame.t_ns)
            max_age = clock.frames(self.max_age_s) if self.max_age_frames is None else self.max_age_frames
            min_hits = clock.frames(self.min_hits_s) if self.min_hits_frames is None else self.min_hits_frames

            tracks.streak[tracks.missed > 0] = 0
            tracks.missed += elapsed
            for _ in range(min(elapsed, max_age + 1)):  # frames that nobody saw still move people
                tracks.filter.predict()
            tracks = tracks[np.isfinite(tracks.filter.boxes.sum(axis=1))]

            boxes, score = columns_to_boxes(frame.rows), frame.rows["score"]
            real = (boxes[:, 2] > 0) & (boxes[:, 3] > 0) & np.isfinite(boxes).all(axis=1)
            boxes, score = boxes[real], score[real]
            detection, track = _pairs(iou(boxes, tracks.filter.boxes), self.min_iou)
            tracks.filter.correct(track, boxes[detection])
            tracks.missed[track] = 0
            tracks.streak[track] += 1
            tracks.score[track] = score[detection]

            new = np.ones(len(boxes), bool)
            new[detection] = False
            tracks = tracks + _Tracks.born(next_id, boxes[new], score[new])
            next_id += int(new.sum())

            shown = (tracks.missed == 0) & ((tracks.streak >= min_hits) | (count <= min_hits))
            yield (self._frame(frame, tracks[shown]),)
            tracks = tracks[tracks.missed <= max_age]

    def _frame(self, frame: Frame, tracks: _Tracks) -> Frame:
        boxes = tracks.filter.boxes
        plane = plane_at(self.ground_planes, frame.t_ns)
        xy_m = plane.boxes_to_metres(boxes) if plane else np.full((len(boxes), 2), np.nan)
        rows = TRACKS.rows(
            track_id=tracks.ids,
            x_px=boxes[:, 0],
            y_px=boxes[:, 1],
            w_px=boxes[:, 2],
            h_px=boxes[:, 3],
            x_m=xy_m[:, 0],
            y_m=xy_m[:, 1],
            score=tracks.score,
            observed=np.ones(len(boxes), bool),
            source_id=np.full(len(boxes), -1),
        )
        return Frame(frame.t_ns, frame.index, rows)


@dataclass
class _Tracks:
    """K tracks: frames since the last hit (``missed``), hits in a row (``streak``), score of the last detection."""

    filter: BoxFilter
    ids: NDArray[np.int64]
    missed: NDArray[np.int64]
    streak: NDArray[np.int64]
    score: Floats

    @classmethod
    def none(cls) -> _Tracks:
        return cls.born(1, np.empty((0, 4)), np.empty(0))

    @classmethod
    def born(cls, first_id: int, boxes: Floats, score: Floats) -> _Tracks:
        """Tracks that start on boxes (K, 4), with ids from ``first_id`` on."""
        count = len(boxes)
        nothing = np.zeros(count, np.int64)
        return cls(BoxFilter.born(boxes), first_id + np.arange(count), nothing, nothing.copy(), score)

    def __getitem__(self, kept: NDArray[np.bool_]) -> _Tracks:
        return _Tracks(self.filter[kept], self.ids[kept], self.missed[kept], self.streak[kept], self.score[kept])

    def __add__(self, other: _Tracks) -> _Tracks:
        return _Tracks(
            self.filter + other.filter,
            np.concatenate([self.ids, other.ids]),
            np.concatenate([self.missed, other.missed]),
            np.concatenate([self.streak, other.streak]),
            np.concatenate([self.score, other.score]),
        )


def _pairs(overlap: Floats, least: float) -> tuple[Ints, Ints]:
    """Detections and tracks that belong together, from their overlaps (N, K).

    Where no detection and no track has a choice there is nothing to weigh. Otherwise the whole is assigned for the
    largest total overlap, and pairs that overlap too little are let go afterwards, as the original program does.
    """
    if overlap.size == 0:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    close = overlap > least
    if close.any() and (close.sum(axis=0) <= 1).all() and (close.sum(axis=1) <= 1).all():
        detection, track = np.nonzero(close)
        return detection, track
    detection, track = solve(-overlap)
    kept = overlap[detection, track] >= least
    return detection[kept], track[kept]
