"""Second implementations of SORT, ByteTrack and OC-SORT: slow, one object for each track, written from their papers.

Bewley et al., ICIP 2016 (section 3.2: state u, v, s, r and the rates of the first three; P0, Q and R as in its program),
Zhang et al., ECCV 2022, and Cao et al., CVPR 2023. The numbers of frames come from ``FrameClock``, as in the package.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import acos, hypot, isnan, nan, pi, sqrt

import numpy as np
from scipy.optimize import linear_sum_assignment

from mcaptrack.geometry.clocks import FrameClock

MOVE = np.eye(7) + np.eye(7, k=4)
SEE = np.eye(4, 7)
R = np.diag([1.0, 1.0, 10.0, 10.0])
P0 = np.diag([10.0, 10.0, 10.0, 10.0, 1e4, 1e4, 1e4])
Q = np.diag([1.0, 1.0, 1.0, 1.0, 0.01, 0.01, 1e-4])


@dataclass(frozen=True)
class Box:
    """Left, top, right, bottom."""

    left: float
    top: float
    right: float
    bottom: float
    score: float = nan
    class_id: int = 1

    @property
    def centre(self) -> tuple[float, float]:
        return (self.left + self.right) / 2, (self.top + self.bottom) / 2

    @property
    def area(self) -> float:
        return (self.right - self.left) * (self.bottom - self.top)

    def measured(self) -> np.ndarray:
        wide, high = self.right - self.left, self.bottom - self.top
        return np.array([*self.centre, wide * high, wide / high])

    def iou(self, other: Box) -> float:
        wide = min(self.right, other.right) - max(self.left, other.left)
        high = min(self.bottom, other.bottom) - max(self.top, other.top)
        both = max(wide, 0) * max(high, 0)
        return both / (self.area + other.area - both)

    def towards(self, other: Box, share: float) -> Box:
        ends = ((self.left, other.left), (self.top, other.top), (self.right, other.right), (self.bottom, other.bottom))
        return Box(*(a + share * (b - a) for a, b in ends))


@dataclass
class Filter:
    """The Kalman filter with its 7 x 7 covariance."""

    mean: np.ndarray
    cov: np.ndarray

    @classmethod
    def start(cls, box: Box) -> Filter:
        return cls(np.concatenate([box.measured(), np.zeros(3)]), P0.copy())

    def predict(self) -> None:
        if self.mean[2] + self.mean[6] < 1e-9:  # an area that would vanish stops shrinking
            self.mean[6] = 0
        self.mean, self.cov = MOVE @ self.mean, MOVE @ self.cov @ MOVE.T + Q

    def correct(self, box: Box) -> None:
        gain = self.cov @ SEE.T @ np.linalg.inv(SEE @ self.cov @ SEE.T + R)
        self.mean = self.mean + gain @ (box.measured() - SEE @ self.mean)
        self.cov = (np.eye(7) - gain @ SEE) @ self.cov

    def stretch(self, factor: float) -> None:
        scale = np.diag([1.0, 1, 1, 1, factor, factor, factor])
        self.mean, self.cov = scale @ self.mean, scale @ self.cov @ scale

    def box(self) -> Box:
        u, v, s, r = self.mean[:4]
        wide = sqrt(s * r)
        high = s / wide
        return Box(u - wide / 2, v - high / 2, u + wide / 2, v + high / 2)

    def copy(self) -> Filter:
        return Filter(self.mean.copy(), self.cov.copy())


@dataclass
class Track:
    track_id: int
    filter: Filter
    box: Box  # the last detection
    frame: int  # its frame
    missed: float = 0.0
    streak: float = 0.0
    last_filter: Filter | None = None  # the filter after the last detection
    centres: dict[int, tuple[float, float]] = field(default_factory=dict)


Similarities = dict[tuple[int, int], float]


def assign(similarity: Similarities, least: float) -> list[tuple[int, int]]:
    """The pairs above the threshold if none compete; otherwise those of the largest total, then the threshold."""
    close = [pair for pair, value in similarity.items() if value > least]
    if close and all(len({pair[side] for pair in close}) == len(close) for side in (0, 1)):
        return close
    if not similarity:
        return []
    table = np.zeros([1 + max(pair[side] for pair in similarity) for side in (0, 1)])
    for pair, value in similarity.items():
        table[pair] = value
    best = zip(*(side.tolist() for side in linear_sum_assignment(-table)), strict=True)
    return [pair for pair in best if similarity.get(pair, 0.0) > 0 and similarity[pair] >= least]


class ReferenceSort:
    def __init__(self, options) -> None:
        self.options, self.clock = options, FrameClock()
        self.tracks: list[Track] = []
        self.last_id = self.count = self.frame = 0
        self.first_ns = self.last_ns = 0

    def run(self, frames: list[tuple[int, list[Box]]]) -> list[list[tuple[int, Box, float]]]:
        """For each frame, a time and its boxes, the tracks that are written: id, box, score."""
        return [self.step(t_ns, boxes) for t_ns, boxes in frames]

    def step(self, t_ns: int, boxes: list[Box]) -> list[tuple[int, Box, float]]:
        o = self.options
        if not self.count:
            self.first_ns = self.last_ns = t_ns
        steps, passed, usual = self.clock.tick(t_ns), t_ns - self.last_ns, self.clock.interval_ns
        self.count, self.last_ns, self.frame = self.count + 1, t_ns, self.frame + steps
        if o.max_age_frames is None:
            self.aged, extra, oldest = max(passed, 1), usual, o.max_age_s * 1e9 + usual / 2
        else:
            self.aged, extra, oldest = steps, 1, o.max_age_frames
        if o.min_hits_frames is None:
            hit, hits = min(max(passed, 0), 2 * usual), o.min_hits_s * 1e9 - usual / 2
            is_starting = t_ns - self.first_ns < hits
        else:
            hit, hits, is_starting = 1, o.min_hits_frames, self.count <= o.min_hits_frames
        for track in self.tracks:
            track.missed += self.aged
        if steps > 1:
            self.tracks = [track for track in self.tracks if track.missed <= oldest + extra]
        for track in self.tracks:
            track.filter.stretch(self.clock.stretch)
            for _ in range(steps):
                track.filter.predict()
        boxes = [b for b in boxes if b.right - b.left > 1e-4 and b.bottom - b.top > 1e-4]
        boxes = [b for b in boxes if o.min_score is None or not b.score < o.min_score]
        boxes = [b for b in boxes if o.class_id is None or b.class_id == o.class_id]
        pairs = self.pairs(boxes)
        for at, track in pairs:
            self.update(self.tracks[track], boxes[at], steps)
            is_sure = o.min_hits_frames is None and boxes[at].score >= 0.5
            self.tracks[track].streak += max(hit, 1e8) if is_sure else hit
        for track in self.tracks:
            track.streak = 0.0 if track.missed else track.streak
        for at, box in enumerate(boxes):
            if at not in {pair[0] for pair in pairs} and self.can_start(box):
                self.last_id += 1
                self.tracks.append(Track(self.last_id, Filter.start(box), box, self.frame))
                self.store(self.tracks[-1], box)
        written = [track for track in self.tracks if not track.missed and (is_starting or track.streak >= hits)]
        out = [(track.track_id, track.filter.box(), track.box.score) for track in written]
        self.tracks = [track for track in self.tracks if track.missed <= oldest]
        return out

    def similarities(self, boxes: list[Box]) -> tuple[Similarities, float]:
        """Similarities of boxes and tracks that pass the gate, and the least similarity of an assignment."""
        o, out = self.options, {}
        for at, box in enumerate(boxes):
            for number, track in enumerate(self.tracks):
                predicted = track.filter.box()
                if o.cost == "iou":
                    value = box.iou(predicted)
                elif o.cost == "pixels":
                    value = 1 - hypot(*np.subtract(box.centre, predicted.centre)) / o.max_distance_px
                else:
                    scale = o.ground_planes[0][1].homography[0]  # a plain scale; feet are at the lower edge
                    feet = [(one.centre[0] * scale, one.bottom * scale) for one in (box, predicted)]
                    value = 1 - hypot(*np.subtract(*feet)) / o.max_distance_m
                if value > 0 and self.same_class(box, track):
                    out[at, number] = value
        return out, o.min_iou if o.cost == "iou" else 0.0

    def same_class(self, box: Box, track: Track) -> bool:
        return self.options.across_classes or box.class_id == track.box.class_id

    def pairs(self, boxes: list[Box]) -> list[tuple[int, int]]:
        return assign(*self.similarities(boxes))

    def can_start(self, box: Box) -> bool:
        return True

    def update(self, track: Track, box: Box, steps: int) -> None:
        track.filter.correct(box)
        track.missed = 0.0
        self.store(track, box)

    def store(self, track: Track, box: Box) -> None:
        track.box, track.frame, track.last_filter = box, self.frame, track.filter.copy()
        track.centres[self.frame] = box.centre


class ReferenceByteTrack(ReferenceSort):
    def pairs(self, boxes: list[Box]) -> list[tuple[int, int]]:
        similarities, least = self.similarities(boxes)
        low = {at for at, box in enumerate(boxes) if box.score < self.options.high_score}
        first = assign({pair: value for pair, value in similarities.items() if pair[0] not in low}, least)
        taken = {track for _, track in first}
        left = {t for t, track in enumerate(self.tracks) if t not in taken and track.missed == self.aged}
        rest = {(at, t): value for (at, t), value in similarities.items() if at in low and t in left}
        return first + assign(rest, self.options.low_min_iou if self.options.cost == "iou" else least)

    def can_start(self, box: Box) -> bool:
        return not box.score < self.options.new_score


class ReferenceOcSort(ReferenceSort):
    def pairs(self, boxes: list[Box]) -> list[tuple[int, int]]:
        o = self.options
        similarities, least = self.similarities(boxes)
        near = {pair: value for pair, value in similarities.items() if value >= least}
        if o.inertia > 0:
            near = {
                (at, t): v + o.inertia * (0.5 + self.direction(boxes[at], self.tracks[t]))
                for (at, t), v in near.items()
            }
        found = assign(near, 0.0)
        if not o.recover:
            return found
        boxes_left = set(range(len(boxes))) - {at for at, _ in found}
        left = set(range(len(self.tracks))) - {track for _, track in found}
        again = {(at, t): boxes[at].iou(self.tracks[t].box) for at in boxes_left for t in left}
        again = {p: v for p, v in again.items() if v > 0 and self.same_class(boxes[p[0]], self.tracks[p[1]])}
        return found + assign(again, o.min_iou)

    def direction(self, box: Box, track: Track) -> float:
        """0.5 straight on in the direction of the last frames, -0.5 straight back; times the score."""
        oldest = [f for f in sorted(track.centres) if self.frame - f <= self.options.direction_frames]
        if not oldest:
            return 0.0
        before = track.centres[oldest[0]]
        was, now = np.subtract(track.box.centre, before), np.subtract(box.centre, before)
        length = hypot(*was) * hypot(*now)
        angle = acos(min(max(float(was @ now) / length, -1), 1)) if length else pi / 2
        return (0.5 - angle / pi) * (1.0 if isnan(box.score) else min(max(box.score, 0), 1))

    def update(self, track: Track, box: Box, steps: int) -> None:
        ago = self.frame - track.frame
        if self.options.reupdate and ago > steps:
            again = track.last_filter.copy()
            for frame in range(1, ago + 1):
                again.predict()
                if frame < ago:
                    again.correct(track.box.towards(box, frame / ago))
            track.filter = again
        super().update(track, box, steps)
