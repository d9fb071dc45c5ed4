"""Drawn traffic: true objects around a robot, and the 3D boxes that a detector with faults makes of them.

Streets with parked cars, cars and trucks that go, brake and turn, cyclists, people who walk and stand. The detector
misses objects by distance and in bursts, has noise that is correlated over time, turns headings by half and quarter
turns, confuses classes, and adds false boxes: single ones, and clutter that lasts. Where objects hide one another
(``Faults.hidden``), what the sensor can't see has no ground truth, as in labels made from lidar points, and what it
sees little of is missed more often. All of it follows from a seed.

Letters: F frames, N objects, S steps of one object, R rays of the sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

#: Classes by number, and the usual length, width and height of each.
CLASSES: Final = {1: "pedestrian", 2: "bicycle", 3: "car", 4: "truck"}
_SIZES: Final = {1: (0.6, 0.6, 1.75), 2: (1.8, 0.6, 1.7), 3: (4.6, 1.9, 1.7), 4: (9.0, 2.6, 3.3)}
#: The class that a class is confused with.
_CONFUSED: Final = {1: 2, 2: 1, 3: 4, 4: 3}


@dataclass(frozen=True, kw_only=True)
class Faults:
    """The faults of a detector: probabilities a frame, lengths in metres, times in seconds."""

    miss_near: float = 0.05
    miss_far: float = 0.6
    occlusions_per_s: float = 0.12
    occlusion_s: float = 0.9
    noise_m: float = 0.08
    slow_noise_m: float = 0.18
    half_turns: float = 0.05
    quarter_turns: float = 0.02
    heading_noise: float = 0.08
    confused: float = 0.03
    confused_tracks: float = 0.08
    false_boxes: float = 1.0
    clutter: int = 5
    score_noise: float = 0.12
    hidden: bool = False
    groups: float = 0.0
    doubles: float = 0.0
    pose_noise_m: float = 0.0
    pose_noise_rad: float = 0.0


class Scene(NamedTuple):
    """Rows of true objects and of boxes: arrays of equal length by name of the column, with ``frame`` and ``t_ns``.

    ``robot_m`` (F, 2) is where the robot is.
    """

    truth: dict[str, np.ndarray]
    boxes: dict[str, np.ndarray]
    t_ns: np.ndarray
    robot_m: np.ndarray


def draw_traffic(
    seed: int,
    seconds: float = 16.0,
    rate_hz: float = 10.0,
    faults: Faults = Faults(),
    density: float = 1.0,
    lively: float = 1.0,
) -> Scene:
    """Draw a scene of traffic, seen from a robot that drives along the street.

    ``lively`` is the share of the usual number of vehicles that turn or stop.
    """
    rng = np.random.default_rng(seed)
    count = round(seconds * rate_hz)
    t_s = np.arange(count) / rate_hz + rng.normal(0, 0.01 / rate_hz, count)
    robot = np.stack([-20 + rng.uniform(0, 6) * t_s, np.full(count, -1.8)], axis=1)
    tracks = [_parked(rng) for _ in range(rng.poisson(16 * density))]
    tracks += [_vehicle(rng, t_s, 3, lively) for _ in range(rng.poisson(12 * density))]
    tracks += [_vehicle(rng, t_s, 4, lively) for _ in range(rng.poisson(3 * density))]
    tracks += [_vehicle(rng, t_s, 2, lively) for _ in range(rng.poisson(4 * density))]
    tracks += [_pedestrian(rng, t_s) for _ in range(rng.poisson(14 * density))]
    more = np.random.default_rng([seed, 1])  # a generator of its own: scenes without these faults stay as they are
    tracks += [one for _ in range(more.poisson(faults.groups * density)) for one in _group(more, t_s)]
    start_ns = 1_600_000_000_000_000_000
    t_ns = start_ns + np.rint(t_s * 1e9).astype(np.int64)
    true_parts, box_parts = [], []
    tracks = [_laid(track, count) for track in tracks]
    points = _points(more, robot, tracks) if faults.hidden else np.full((len(tracks), count), np.inf)
    for number, (xy, heading, class_id, size) in enumerate(tracks):
        far = np.hypot(*(xy - robot).T)
        there = np.flatnonzero((far < 60.0) & np.isfinite(xy[:, 0]) & (points[number] >= 1))
        if len(there) < 3:
            continue
        true_parts.append(_table(there, number + 1, class_id, xy[there], size, heading[there]))
        found = _boxes(rng, faults, there, far[there], xy[there], heading[there], class_id, size, rate_hz)
        if faults.hidden:
            few = np.exp(-points[number, found["frame"]] / 12)
            kept = more.random(len(few)) > few
            found = {name: values[kept] for name, values in found.items()}
            found["score"] = np.clip(found["score"] - 0.25 * few[kept], 0.05, 0.99)
        box_parts.append(found)
        if faults.doubles:
            box_parts.append(_doubles(more, faults, found))
    box_parts += [_false_boxes(rng, faults, robot, count), *_clutter(rng, faults, robot, count, rate_hz)]
    truth, boxes = (_joined(parts, t_ns, rng) for parts in (true_parts, box_parts))
    if faults.pose_noise_m or faults.pose_noise_rad:
        _shake(more, faults, boxes, robot, rate_hz)
    return Scene(truth, boxes, t_ns, robot)


class _Track(NamedTuple):
    xy: np.ndarray
    heading: np.ndarray
    class_id: int
    size: np.ndarray


def _laid(track: _Track, count: int) -> _Track:
    if len(track.xy) == 1:
        return track._replace(xy=np.repeat(track.xy, count, axis=0), heading=np.repeat(track.heading, count))
    return track


def _size(rng: np.random.Generator, class_id: int) -> np.ndarray:
    return np.array(_SIZES[class_id]) * rng.uniform(0.85, 1.2) * rng.uniform(0.95, 1.05, 3)


def _parked(rng: np.random.Generator) -> _Track:
    """A car at the kerb, or side by side with others."""
    if rng.random() < 0.6:
        xy = [6.4 * rng.integers(-9, 10) + rng.normal(0, 0.3), rng.choice([-6.5, 6.5]) + rng.normal(0, 0.1)]
        heading = rng.choice([0.0, np.pi])
    else:
        xy = [2.7 * rng.integers(-12, 12) + rng.normal(0, 0.1), rng.choice([-14.0, 14.0])]
        heading = rng.choice([1, -1]) * np.pi / 2
    return _Track(np.array([xy]), np.array([heading + rng.normal(0, 0.02)]), 3, _size(rng, 3))


def _vehicle(rng: np.random.Generator, t_s: np.ndarray, class_id: int, lively: float) -> _Track:
    """A vehicle that goes along a lane, may brake and stop, and may turn at the crossing."""
    top = {2: 5.0, 3: 11.0, 4: 9.0}[class_id] * rng.uniform(0.6, 1.4)
    lane = int(rng.integers(4))
    direction = lane * np.pi / 2
    offset = {2: 4.4, 3: 1.8, 4: 1.8}[class_id] + rng.normal(0, 0.2)
    begin = rng.uniform(-70, 10)
    radius = {2: 5.0, 3: 8.0, 4: 12.0}[class_id] * rng.uniform(0.8, 1.6)
    turn = float(rng.choice([0.0, 1.0, -1.0], p=[1 - 0.6 * lively, 0.3 * lively, 0.3 * lively]))
    turn_at = rng.uniform(-12, -6)
    speed, place, heading = top * rng.uniform(0.3, 1.0), np.array([begin, -offset]), 0.0
    stop_at, stop_for = (rng.uniform(-30, -8), rng.uniform(1, 5)) if rng.random() < 0.35 * lively else (np.inf, 0.0)
    xy, angles, waited = np.empty((len(t_s), 2)), np.empty(len(t_s)), 0.0
    steps = np.diff(t_s, prepend=t_s[0])
    for number, dt in enumerate(steps.tolist()):
        brakes = place[0] < stop_at and waited < stop_for and stop_at - place[0] < speed**2 / 5 + 1
        if speed < 0.1 and np.isfinite(stop_at):
            waited += dt
            brakes = waited < stop_for
        speed = max(0.0, speed - 3 * dt) if brakes else min(top, speed + 1.5 * dt)
        if turn and place[0] > turn_at and abs(heading) < np.pi / 2:
            speed = max(speed - 2 * dt, min(speed, 1.7 * radius**0.5))
            heading += turn * speed * dt / radius
        place = place + speed * dt * np.array([np.cos(heading), np.sin(heading)])
        xy[number], angles[number] = place, heading
    c, s = np.cos(direction), np.sin(direction)
    return _Track(xy @ np.array([[c, s], [-s, c]]), angles + direction, class_id, _size(rng, class_id))


def _pedestrian(rng: np.random.Generator, t_s: np.ndarray) -> _Track:
    """Somebody who walks along or across, turns now and then, or stands."""
    speed = 0.0 if rng.random() < 0.2 else rng.normal(1.35, 0.25)
    heading = rng.choice([0, np.pi, np.pi / 2, -np.pi / 2]) + rng.normal(0, 0.2)
    steps = np.diff(t_s, prepend=t_s[0])
    turns = np.where(rng.random(len(t_s)) < 0.05 * steps, rng.normal(0, 1.0, len(t_s)), 0)
    angles = heading + np.cumsum(turns + rng.normal(0, 0.15, len(t_s)) * np.sqrt(np.maximum(steps, 0)))
    pace = speed * (1 + 0.2 * np.sin(t_s / 3 + rng.uniform(0, 6)))
    moves = (pace * steps)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    side = rng.choice([-1, 1]) * rng.uniform(5, 12)
    start = np.array([rng.uniform(-40, 40), side])
    return _Track(start + np.cumsum(moves, axis=0), angles, 1, _size(rng, 1))


def _group(rng: np.random.Generator, t_s: np.ndarray) -> list[_Track]:
    """Two to five people who walk or stand side by side."""
    leader, count = _pedestrian(rng, t_s), int(rng.integers(2, 6))
    across = np.stack([-np.sin(leader.heading), np.cos(leader.heading)], axis=1)
    out = []
    for place in range(count):
        sway = 0.1 * np.sin(t_s * rng.uniform(0.2, 0.8) + rng.uniform(0, 6))
        offset = (place * 0.75 + sway)[:, None] * across + rng.normal(0, 0.2, 2)
        out.append(leader._replace(xy=leader.xy + offset, size=_size(rng, 1)))
    return out


def _points(rng: np.random.Generator, robot: np.ndarray, tracks: Sequence[_Track]) -> np.ndarray:
    """The number of lidar points on each object in each frame (N, F), of what nearer objects and walls don't hide."""
    count, rays = len(robot), 1440
    walls = np.stack([rng.uniform(-50, 50, 6), rng.choice([-1, 1], 6) * rng.uniform(8, 11, 6)], axis=1)
    xy = np.array([track.xy for track in tracks] + [np.repeat(one[None], count, axis=0) for one in walls])
    heading = np.array([track.heading for track in tracks] + [np.zeros(count)] * len(walls))
    length, width, height = np.array([track.size for track in tracks] + [np.array([4.0, 1.5, 2.5])] * len(walls)).T
    off = xy - robot
    far = np.maximum(np.hypot(off[..., 0], off[..., 1]), 1.0)
    angle = np.arctan2(off[..., 1], off[..., 0])
    side = np.abs(np.sin(angle - heading)) * length[:, None] + np.abs(np.cos(angle - heading)) * width[:, None]
    half = np.arctan2(side / 2, far)
    low = np.floor((angle - half) / (2 * np.pi) * rays).astype(int)
    high = np.maximum(np.ceil((angle + half) / (2 * np.pi) * rays).astype(int), low + 1)
    share = np.zeros(far.shape)
    for frame in range(count):
        top = np.zeros(rays)  # how high up the ray is blocked, as an elevation seen from the sensor at 1.9 m
        for one in np.argsort(far[:, frame]).tolist():
            ray = np.arange(low[one, frame], high[one, frame]) % rays
            d = far[one, frame]
            bottom, upper = -1.9 / d, (height[one] - 1.9) / d
            blocked = np.where(top[ray] == 0, bottom, top[ray])
            share[one, frame] = np.clip((upper - np.maximum(blocked, bottom)) / (upper - bottom), 0, 1).mean()
            top[ray] = np.maximum(blocked, upper)
    area = side * height[:, None] * share
    return rng.poisson(np.minimum(30_000 * area / far**2, 1e6))[: len(tracks)].astype(float)


def _doubles(rng: np.random.Generator, faults: Faults, found: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Second boxes of the same object, beside the first."""
    one = rng.random(len(found["frame"])) < faults.doubles
    out = {name: values[one].copy() for name, values in found.items()}
    for name in ("x_m", "y_m"):
        out[name] += rng.normal(0, 0.25, int(one.sum())) * np.maximum(out["length_m"], 1.0)
    out["score"] = out["score"] * rng.uniform(0.3, 0.9, int(one.sum()))
    return out


def _shake(rng: np.random.Generator, faults: Faults, boxes: dict[str, np.ndarray], robot: np.ndarray, rate_hz: float):
    """Errors of the robot's own pose, which move all boxes of a frame together, in place."""
    spread = [faults.pose_noise_m, faults.pose_noise_m, faults.pose_noise_rad]
    off = _slow_noise(rng, (len(robot), 3), rate_hz) * spread
    frame = boxes["frame"]
    x, y = boxes["x_m"] - robot[frame, 0], boxes["y_m"] - robot[frame, 1]
    turn = off[frame, 2]
    boxes["x_m"] = robot[frame, 0] + x * np.cos(turn) - y * np.sin(turn) + off[frame, 0]
    boxes["y_m"] = robot[frame, 1] + x * np.sin(turn) + y * np.cos(turn) + off[frame, 1]
    boxes["heading_rad"] = np.arctan2(np.sin(boxes["heading_rad"] + turn), np.cos(boxes["heading_rad"] + turn))


def _table(frame: np.ndarray, number: int, class_id: object, xy: np.ndarray, size: np.ndarray, heading: np.ndarray):
    ones = np.ones(len(frame))
    return {
        "frame": frame,
        "id": np.full(len(frame), number),
        "class_id": class_id * np.ones(len(frame), np.int64),
        "x_m": xy[:, 0],
        "y_m": xy[:, 1],
        "z_m": ones * size[2] / 2,
        "length_m": ones * size[0],
        "width_m": ones * size[1],
        "height_m": ones * size[2],
        "heading_rad": np.arctan2(np.sin(heading), np.cos(heading)),
    }


def _bursts(rng: np.random.Generator, count: int, begin: float, last: float) -> np.ndarray:
    """A mask of runs that begin with a probability a frame and last so many frames on average."""
    out, frame = np.zeros(count, bool), 0
    while begin > 0 and (frame := frame + int(rng.geometric(min(begin, 1.0)))) < count:
        length = int(rng.geometric(1 / max(last, 1.0)))
        out[frame : frame + length] = True
        frame += length
    return out


def _slow_noise(rng: np.random.Generator, shape: tuple[int, ...], rate_hz: float) -> np.ndarray:
    """Noise of variance 1 that is correlated over half a second."""
    keep, white = np.exp(-2.0 / rate_hz), rng.normal(0, 1, shape)
    for number in range(1, shape[0]):
        white[number] = keep * white[number - 1] + np.sqrt(1 - keep**2) * white[number]
    return white


def _boxes(rng, faults: Faults, frame, far, xy, heading, class_id: int, size, rate_hz: float):
    count = len(frame)
    far = far / 60
    missed = rng.random(count) < faults.miss_near + (faults.miss_far - faults.miss_near) * far**2
    missed |= _bursts(rng, count, faults.occlusions_per_s / rate_hz, faults.occlusion_s * rate_hz)
    noise = faults.noise_m * rng.normal(0, 1, (count, 2)) + faults.slow_noise_m * _slow_noise(rng, (count, 2), rate_hz)
    turned = heading + faults.heading_noise * rng.normal(0, 1, count)
    if class_id != 1:
        turned = turned + np.pi * _bursts(rng, count, faults.half_turns / 3, 3)
        turned = turned + np.pi / 2 * (rng.random(count) < faults.quarter_turns)
    confused = rng.random(count) < faults.confused
    if rng.random() < faults.confused_tracks:
        confused |= _bursts(rng, count, 0.1, 4)
    score = 0.9 - 0.5 * far + faults.score_noise * rng.normal(0, 1, count) - 0.15 * confused
    classes = np.where(confused, _CONFUSED[class_id], class_id)
    out = _table(frame, 0, classes, xy + noise * (0.7 + 0.6 * far[:, None]), size, turned)
    for name in ("length_m", "width_m", "height_m"):
        out[name] = out[name] * np.maximum(0.5, 1 + 0.05 * rng.normal(0, 1, count))
    out["score"] = np.clip(score, 0.05, 0.99)
    return {name: values[~missed] for name, values in out.items()}


def _false_boxes(rng, faults: Faults, robot, count: int):
    frame = np.repeat(np.arange(count), rng.poisson(faults.false_boxes, count))
    xy = robot[frame] + 60 * (rng.random((len(frame), 2)) * 2 - 1)
    class_id = rng.integers(1, 5, len(frame))
    out = _table(frame, 0, class_id, xy, np.array([2.0, 1.0, 1.5]), rng.uniform(-3.1, 3.1, len(frame)))
    return out | {"score": np.clip(rng.beta(2.5, 5, len(frame)), 0.05, 0.95)}


def _clutter(rng, faults: Faults, robot, count: int, rate_hz: float):
    """Places where boxes come again and again, though nothing is there."""
    for _ in range(rng.poisson(faults.clutter)):
        begin = int(rng.integers(count))
        frame = np.arange(begin, min(count, begin + round(rng.uniform(1, 8) * rate_hz)))
        frame = frame[rng.random(len(frame)) < rng.uniform(0.2, 0.75)]
        place, class_id = robot[begin] + rng.uniform(-40, 40, 2), int(rng.integers(1, 5))
        xy = place + rng.normal(0, 0.25, (len(frame), 2))
        out = _table(frame, 0, class_id, xy, np.array(_SIZES[class_id]), rng.uniform(-3.1, 3.1, len(frame)))
        yield out | {"score": np.clip(rng.normal(rng.uniform(0.3, 0.45), 0.1, len(frame)), 0.05, 0.8)}


def _joined(parts: Sequence[dict[str, np.ndarray]], t_ns: np.ndarray, rng: np.random.Generator):
    parts = list(parts)
    out = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.lexsort((rng.random(len(out["frame"])), out["frame"]))
    out = {name: values[order] for name, values in out.items()}
    return out | {"t_ns": t_ns[out["frame"]]}
