"""Crowds seen by a camera: what a detector finds of drawn people in the pictures of a camera at any height.

People of ``crowds.py`` walk on the ground before a pinhole camera that stands, shakes or is carried along. Who is
behind others, or behind a post or a parked car, is found seldom, late, or in part; scores follow what is seen and how
tall it is; boxes jitter, slowly and at once; some detections are of nobody. All is drawn from wide ranges; no recording
is used.

Letters: F frames, N true boxes.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from corruptions import STEP_S
from crowds import scenes

from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import DETECTIONS, TRACKS, Frame

#: People in pictures are at least so tall, in px, and so far away, in metres.
LEAST_PX, NEAREST_M = 25.0, 1.5
#: Boxes of a scene that is of use.
LEAST_ROWS = 600
#: Points of a box that are covered or not, across and down.
ACROSS, DOWN = 5, 8


class Pictured(NamedTuple):
    """The true boxes and the detections of a scene, a frame each."""

    true: list[Frame]
    detected: list[Frame]


class Camera(NamedTuple):
    """Where a camera is in each of F frames, (F, 3) in m, and how it is turned, (F, 3, 3), for a picture in px."""

    place: np.ndarray
    turn: np.ndarray
    focal_px: float
    size_px: tuple[int, int]

    @classmethod
    def drawn(cls, rng: np.random.Generator, t_s: np.ndarray, side_m: float) -> Camera:
        width, height = [(640, 480), (1280, 720), (1920, 1080)][rng.integers(3)]
        focal = width * np.exp(rng.uniform(np.log(0.65), np.log(1.5)))
        high = np.exp(rng.uniform(np.log(1.3), np.log(9.0)))
        away = rng.uniform(-0.45, 0.15) * side_m  # before the square, or in it
        around, middle = rng.uniform(0, 2 * np.pi), np.full(2, side_m / 2)
        ahead = np.array([np.cos(around), np.sin(around)])
        place = middle - ahead * (side_m / 2 + away) * (0.6 if away < 0 else 1.0)
        far = np.exp(rng.uniform(np.log(6), np.log(25)))  # the ground in the middle of the picture
        pitch = np.full(len(t_s), np.arctan2(high - 0.9, far))
        yaw = np.full(len(t_s), around)
        places = np.tile(np.append(place, high), (len(t_s), 1))
        drawn = rng.random()
        if drawn < 0.4:  # carried or on wheels
            pace = rng.uniform(0.2, 1.4)
            yaw += rng.uniform(0, 0.25) * np.sin(2 * np.pi * t_s / rng.uniform(6, 25) + rng.uniform(0, 6))
            step = np.stack([np.cos(yaw), np.sin(yaw)], -1) * pace * np.gradient(t_s)[:, None]
            places[:, :2] += step.cumsum(axis=0)
            bob = rng.uniform(0, 0.006)
            pitch += bob * np.sin(2 * np.pi * 1.8 * t_s) + rng.uniform(0, 0.02) * np.sin(2 * np.pi * t_s / 5)
        elif drawn < 0.6:  # shaken
            pitch += np.cumsum(rng.normal(0, 2e-4, len(t_s)))
            yaw += np.cumsum(rng.normal(0, 2e-4, len(t_s)))
        forward = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)], -1)
        right = np.stack([np.sin(yaw), -np.cos(yaw), 0 * yaw], -1)
        return cls(places, np.stack([right, np.cross(forward, right), forward], axis=1), focal, (width, height))

    def see(self, frame: np.ndarray, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 3) in m in the pictures (N,): places (N, 2) in px, and depths (N,) in m."""
        seen = np.einsum("nij,nj->ni", self.turn[frame], points_m - self.place[frame])
        depth = np.maximum(seen[:, 2], 1e-3)
        return self.focal_px * seen[:, :2] / depth[:, None] + np.array(self.size_px) / 2, seen[:, 2]

    def boxes(self, frame: np.ndarray, feet_m: np.ndarray, tall_m: np.ndarray, wide_m: np.ndarray):
        """Boxes (N, 4) of left, top, width and height of what stands at places (N, 2), and depths (N,)."""
        ground = np.column_stack([feet_m, np.zeros(len(feet_m))])
        (foot, depth), (head, _) = (self.see(frame, ground + up) for up in (0.0, np.outer(tall_m, [0, 0, 1])))
        width = self.focal_px * wide_m / np.maximum(depth, 1e-3)
        return np.column_stack(
            [(foot[:, 0] + head[:, 0] - width) / 2, head[:, 1], width, foot[:, 1] - head[:, 1]]
        ), depth


def drawn(seed: int, seconds: float = 40.0, count: int = 24) -> Iterator[Pictured]:
    """Scenes, always the same of a seed."""
    steps = round(seconds / STEP_S) + 1
    both = [scenes(seed, steps), scenes(seed + 5000, steps)]
    for number in range(count):
        rng = np.random.default_rng([seed, number, 11])
        rows = both[0][number]
        if rng.random() < 0.5:  # twice as many
            other = both[1][number].copy()
            other[:, 1] += rows[:, 1].max() + 1
            rows = np.concatenate([rows, other])
        scene = None
        while scene is None:
            scene = _pictured(rng, rows, seconds)
        yield scene


def _pictured(rng: np.random.Generator, rows: np.ndarray, seconds: float) -> Pictured | None:
    fps = float(rng.choice([7, 10, 14, 25, 30, 30]))
    t_s = np.arange(round(seconds * fps)) / fps
    camera = Camera.drawn(rng, t_s, float(np.ptp(rows[:, 2:])))
    frame, person, feet = _between(rows, t_s)
    who = np.unique(person, return_inverse=True)[1]
    tall = np.clip(rng.normal(1.7, 0.09, who.max() + 1), 1.4, 2.0)[who]
    swing = 1 + 0.25 * np.sin(2 * np.pi * (1.8 * t_s[frame] + rng.random(who.max() + 1)[who]))
    box, depth = camera.boxes(frame, feet, tall, 0.36 * tall * swing)
    width, height = camera.size_px
    inside = np.clip(np.minimum(box[:, 0] + box[:, 2], width) - np.maximum(box[:, 0], 0), 0, None)
    inside = inside * np.clip(np.minimum(box[:, 1] + box[:, 3], height) - np.maximum(box[:, 1], 0), 0, None)
    inside = inside / (box[:, 2] * box[:, 3])
    kept = (depth > NEAREST_M) & (inside > 0.3) & (box[:, 3] > LEAST_PX) & (box[:, 3] < 1.3 * height)
    if kept.sum() < LEAST_ROWS:
        return None  # the camera sees hardly anybody
    frame, who, box, depth, inside = frame[kept], who[kept], box[kept], depth[kept], inside[kept]
    share, low = _shown(frame, box, depth, _things(rng, camera, t_s, rows), len(t_s))
    true = _frames(t_s, frame, TRACKS, track_id=who + 1, box=box, observed=True, source_id=-1)
    found = _detect(rng, frame, who, box, share * inside, low, t_s, camera)
    return Pictured(true, _frames(t_s, found[0], DETECTIONS, box=found[1], score=found[2], class_id=1))


def _between(rows: np.ndarray, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The frame, the person and the place (N, 2) of all people at the times of frames."""
    out = []
    for person in np.unique(rows[:, 1]):
        own = rows[rows[:, 1] == person]
        at = np.flatnonzero((t_s >= own[0, 0] * STEP_S) & (t_s <= own[-1, 0] * STEP_S))
        feet = [np.interp(t_s[at], own[:, 0] * STEP_S, own[:, axis]) for axis in (2, 3)]
        out.append(np.column_stack([at, np.full(len(at), person), *feet]))
    joined = np.concatenate(out)
    joined = joined[np.argsort(joined[:, 0], kind="stable")]
    return joined[:, 0].astype(int), joined[:, 1].astype(int), joined[:, 2:]


def _things(rng: np.random.Generator, camera: Camera, t_s: np.ndarray, rows: np.ndarray):
    """Boxes (F, T, 4) and depths (F, T) of posts, stalls and cars."""
    count = int(rng.integers(0, 7))
    low, high = rows[:, 2:].min(axis=0), rows[:, 2:].max(axis=0)
    feet = rng.uniform(low, high, (count, 2))
    wide = np.exp(rng.uniform(np.log(0.2), np.log(4.0), count))
    tall = np.exp(rng.uniform(np.log(0.8), np.log(3.5), count))
    frame = np.repeat(np.arange(len(t_s)), count)
    boxes, depth = camera.boxes(frame, *(np.tile(part, (len(t_s), 1)[: part.ndim]) for part in (feet, tall, wide)))
    depth = np.where(depth < NEAREST_M, np.inf, depth)
    return boxes.reshape(len(t_s), count, 4), depth.reshape(len(t_s), count)


def _shown(frame, box, depth, things, count) -> tuple[np.ndarray, np.ndarray]:
    """Which share of each box (N,) nothing covers, and how far down it is shown, from 0 to 1."""
    share, low = np.ones(len(frame)), np.ones(len(frame))
    down, across = (np.arange(DOWN) + 0.5) / DOWN, (np.arange(ACROSS) + 0.5) / ACROSS
    ends = np.searchsorted(frame, np.arange(count + 1))
    for number in range(count):
        own = slice(ends[number], ends[number + 1])
        if ends[number] == ends[number + 1]:
            continue
        body = box[own] * [1, 1, 0.75, 1] + box[own] * [0, 0, 0.125, 0] @ [[0] * 4, [0] * 4, [1, 0, 0, 0], [0] * 4]
        before = np.concatenate([body, things[0][number]])
        far = np.concatenate([depth[own], things[1][number]])
        x = box[own, 0:1] + box[own, 2:3] * across
        y = box[own, 1:2] + box[own, 3:4] * down
        nearer = far[None] < depth[own][:, None] - 0.05
        in_x = (x[:, None] >= before[:, 0, None]) & (x[:, None] <= (before[:, 0] + before[:, 2])[:, None])
        in_y = (y[:, None] >= before[:, 1, None]) & (y[:, None] <= (before[:, 1] + before[:, 3])[:, None])
        hidden = (in_y[..., :, None] & in_x[..., None, :] & nearer[..., None, None]).any(axis=1)
        share[own] = 1 - hidden.mean(axis=(1, 2))
        rows_shown = (~hidden).mean(axis=2) > 0.4
        low[own] = np.where(rows_shown.any(axis=1), (DOWN - rows_shown[:, ::-1].argmax(axis=1)) / DOWN, 0.2)
    return share, low


def _wandering(rng: np.random.Generator, who: np.ndarray, frame: np.ndarray, per_frame: float, parts: int):
    """Noise (N, parts) of unit variance that varies slowly, for each person by itself."""
    count = int(who.max(initial=0)) + 1
    out, state = np.empty((len(who), parts)), rng.normal(0, 1, (count, parts))
    ends = np.searchsorted(frame, np.arange(frame.max(initial=0) + 2))
    for number in range(len(ends) - 1):
        state = per_frame * state + np.sqrt(1 - per_frame**2) * rng.normal(0, 1, (count, parts))
        own = slice(ends[number], ends[number + 1])
        out[own] = state[who[own]]
    return out


def _detect(rng, frame, who, box, share, low, t_s, camera):
    """What a detector finds: frames, boxes and scores, ordered by frame."""
    fps = 1 / (t_s[1] - t_s[0])
    good, slope = rng.uniform(1.0, 4.0), rng.uniform(6, 14)
    hidden_at, tall_at = rng.uniform(0.2, 0.6), np.exp(rng.uniform(np.log(15), np.log(60)))
    slow, slow_s = rng.uniform(0.3, 1.2), np.exp(rng.uniform(np.log(0.1), np.log(1.5)))
    wander = _wandering(rng, who, frame, np.exp(-1 / (fps * slow_s)), 5)
    odds = good + slope * np.minimum(share - hidden_at - 0.3, 0.2) + 2 * np.minimum(np.log(box[:, 3] / tall_at), 0.7)
    odds += slow * wander[:, 0] + 0.4 * rng.normal(0, 1, len(odds)) + rng.normal(0, 0.5, who.max() + 1)[who]
    score = 1 / (1 + np.exp(-odds))
    steady, quick = (np.exp(rng.uniform(np.log(a), np.log(b))) for a, b in ((0.01, 0.05), (0.005, 0.03)))
    off = steady * wander[:, 1:5] + quick * rng.normal(0, 1, (len(odds), 4))
    shrinks = rng.uniform(0.0, 1.0) * (1 - low)  # the rest is hidden
    middle = box[:, :2] + box[:, 2:] / 2 + off[:, :2] * box[:, 3:]
    size = box[:, 2:] * np.exp(off[:, 2:])
    found = np.column_stack([middle - size / 2, size])
    found[:, 3] *= 1 - shrinks
    least = float(rng.choice([0.1, 0.3, 0.5, 0.6]))
    is_found = score >= least
    parts = [(frame[is_found], found[is_found], score[is_found])]
    parts += _of_nobody(rng, frame, box, t_s, fps, least)
    frames, boxes, scores = (np.concatenate(part) for part in zip(*parts, strict=True))
    width, height = camera.size_px
    corners = np.column_stack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]])
    if rng.random() < 0.7:  # boxes end at the borders
        corners = np.clip(corners, 0, [width, height, width, height])
    boxes = np.column_stack([corners[:, :2], corners[:, 2:] - corners[:, :2]])
    keep = (boxes[:, 2:] > 4).all(axis=1)
    order = np.argsort(frames[keep], kind="stable")
    return frames[keep][order], boxes[keep][order], scores[keep][order]


def _of_nobody(rng, frame, box, t_s, fps, least) -> list:
    """Detections of nobody: at one place for a while, and parts of people."""
    parts, total = [], len(frame)
    for kind in range(2):
        share = max(rng.uniform(-0.05, 0.08), 0.0)
        lasts_s = np.exp(rng.uniform(np.log(0.05), np.log(2.0)))
        count = int(share * total / max(lasts_s * fps, 1)) if total else 0
        if not count:
            continue
        start = rng.integers(0, total, count)
        length = np.ceil(rng.exponential(lasts_s * fps, count)).astype(int)
        for row, many in zip(start.tolist(), length.tolist(), strict=True):
            if kind == 0:
                at = frame[row] + np.arange(many)
                aside = rng.normal(0, 0.5, 4) * [box[row, 3], box[row, 3], 0, 0]
                place = np.tile(box[rng.integers(0, total)] + aside, (many, 1))
            else:  # of the same person, as long as it is there
                near = np.abs(box[row : row + 60 * many, 0] - box[row, 0]) < 0.5 * box[row, 3]
                same = row + np.flatnonzero(near)[:many]
                at, size = frame[same], rng.uniform(0.4, 0.8)
                place = box[same] * [1, 1, size, size] + box[same][:, [2, 3, 2, 3]] * [*rng.uniform(-0.3, 0.4, 2), 0, 0]
            place = place + rng.normal(0, 0.02, place.shape) * place[:, 3:]
            score = rng.uniform(least, 0.5 + least / 2, len(at))
            inside = at < len(t_s)
            parts.append((at[inside], place[inside], score[inside]))
    return parts


def _frames(t_s, frame, schema, box, **columns) -> list[Frame]:
    """Rows of each of the frames at times in s."""
    names = dict(zip(("x_px", "y_px", "w_px", "h_px"), box.T, strict=True))
    rows = schema.rows(**names, **{k: np.broadcast_to(v, len(frame)) for k, v in columns.items()})
    ends = np.searchsorted(frame, np.arange(len(t_s) + 1))
    return [Frame(round(t * NS_PER_S), n, rows[ends[n] : ends[n + 1]]) for n, t in enumerate(t_s)]
