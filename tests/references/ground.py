"""The ground tracker: a slow reference, one track and one detection at a time, with matrices from the textbook.

Position, velocity and acceleration along one axis; the acceleration is a first-order Markov process (R. A. Singer,
"Estimating Optimal Tracking Filter Performance for Manned Maneuvering Targets", IEEE T-AES 1970).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import linear_sum_assignment

from mcaptrack.geometry.boxes import bev_iou_of_pairs
from mcaptrack.transforms.motion_limits import MotionLimits

FADES_S = 2.0
NOISE_SHARE = 0.1


@cache
def transition(seconds: float) -> NDArray[np.float64]:
    return np.asarray(expm(seconds * np.array([[0, 1, 0], [0, 0, 1], [0, 0, -1 / FADES_S]])))


class Axis:
    """A Kalman filter along one axis: mean (3,) and covariance (3, 3)."""

    def __init__(self, at: float, noise: float, speed: float, drift: float, turns: bool) -> None:
        lasting = (1 - NOISE_SHARE) * drift * turns
        self.mean = np.array([at, 0.0, 0.0])
        self.cov = np.diag([noise**2, speed**2, lasting**2])
        self.noise, self.lasting = noise, lasting
        self.power = (drift - lasting) ** 2

    def predict(self, seconds: float) -> None:
        move = transition(seconds)
        drift = np.zeros((3, 3))
        drift[:2, :2] = self.power * np.array([[seconds**3 / 3, seconds**2 / 2], [seconds**2 / 2, seconds]])
        drift[2, 2] = self.lasting**2 * (1 - np.exp(-2 * seconds / FADES_S))
        self.mean, self.cov = move @ self.mean, move @ self.cov @ move.T + drift

    def correct(self, at: float) -> None:
        h = np.array([[1.0, 0, 0]])
        gain = self.cov @ h.T @ np.linalg.inv(h @ self.cov @ h.T + self.noise**2)
        self.mean = self.mean + (gain * (at - self.mean[0]))[:, 0]
        self.cov = (np.eye(3) - gain @ h) @ self.cov


def sinc(angle: float) -> float:
    return float(np.sin(angle) / angle) if angle else 1.0


def wrapped(angle: float) -> float:
    return float(np.pi - (np.pi - angle) % (2 * np.pi))


class Track:
    """One track: position, velocity and acceleration as complex numbers, with one covariance for both axes."""

    def __init__(self, number: int, found: Mapping[str, float], limits: MotionLimits, frame: int, order: list[int]):
        has_speed = np.isfinite(found["vx"]) and np.isfinite(found["vy"])
        start = Axis(0, limits.noise_m, 1.0 if has_speed else limits.speed_m_per_s, limits.drift_m_per_s, limits.turns)
        self.axis, self.limits, self.number, self.order = start, limits, number, order
        self.p = complex(found["x"], found["y"])
        self.v = complex(found["vx"], found["vy"]) if has_speed else 0j
        self.a = 0j
        self.box = {name: found[name] for name in ("z", "length", "width", "height", "heading")}
        has_heading = np.isfinite(found["heading"])
        self.double = np.exp(2j * found["heading"]) if has_heading else 0j
        self.facing = float(has_heading)
        self.sizes = float(np.isfinite(found["length"]))
        self.score, self.source, self.kind = found["score"], found["source"], found["class"]
        self.scores, self.hits, self.missed_s, self.frame = 0.0, 0, 0.0, frame
        self.votes: dict[int, float] = {}
        self.is_confirmed = False
        self._count(found)
        self.last = self.whole()

    def _count(self, found: Mapping[str, float]) -> None:
        score = 0.5 if np.isnan(found["score"]) else found["score"]
        kind = int(found["class"])
        self.votes[kind] = self.votes.get(kind, 0.0) + score
        self.scores, self.hits = self.scores + score, self.hits + 1

    def whole(self) -> dict[str, float]:
        return {"x": self.p.real, "y": self.p.imag} | self.box

    @property
    def spread(self) -> float:
        return float(self.axis.cov[0, 0] + self.axis.noise**2)

    def predict(self, seconds: float) -> None:
        self.axis.predict(seconds)
        fade = float(np.exp(-seconds / FADES_S))
        to_speed = FADES_S * (1 - fade)
        to_place = FADES_S * (seconds - to_speed)
        turn = 0.0
        if self.limits.turns:
            turn = float(np.clip((self.v.conjugate() * self.a).imag / (abs(self.v) ** 2 + 1.5**2), -0.9, 0.9))
        straight = self.a - 1j * turn * self.v  # what of the acceleration is no turn
        angle = turn * (to_speed if seconds > 0.5 else seconds)
        self.p += seconds * sinc(angle / 2) * np.exp(0.5j * angle) * self.v + to_place * straight
        self.v = np.exp(1j * angle) * self.v + to_speed * straight
        self.a = np.exp(1j * angle) * self.a * fade
        self.double = np.exp(2j * angle) * self.double
        self.missed_s += seconds

    def correct(self, found: Mapping[str, float], is_same_class: bool, frame: int) -> None:
        off = complex(found["x"], found["y"]) - self.p
        gain = self.axis.cov[:, 0] / self.spread
        self.axis.correct(0.0)
        self.p, self.v, self.a = self.p + gain[0] * off, self.v + gain[1] * off, self.a + gain[2] * off
        if abs(self.v) > self.limits.max_speed_m_per_s:
            self.v *= self.limits.max_speed_m_per_s / abs(self.v)
        self._count(found)
        self._follow(found, is_same_class)
        self.score, self.source = found["score"], found["source"]
        self.missed_s, self.frame = 0.0, frame
        self.last = self.whole()
        if len(self.order) > 1:
            self.kind = max(self.order, key=lambda kind: self.votes.get(kind, 0.0))

    def _follow(self, found: Mapping[str, float], is_same_class: bool) -> None:
        box = self.box
        if np.isnan(box["z"]):
            box["z"] = found["z"]
        elif np.isfinite(found["z"]):
            box["z"] += 0.3 * (found["z"] - box["z"])
        self.sizes += np.isfinite(found["length"]) and is_same_class
        rate = max(0.05, 1 / max(self.sizes, 1))
        for name in ("length", "width", "height"):
            if np.isnan(box[name]):
                box[name] = found[name]
            elif is_same_class and np.isfinite(found[name]):
                most = np.inf if self.sizes <= 3 else 0.1 * box[name]
                box[name] += rate * min(max(found[name] - box[name], -most), most)
        is_turned = np.isfinite(found["heading"]) and is_same_class
        measured = found["heading"] if is_turned else 0.0
        if is_turned:
            self.double += 0.25 * (np.exp(2j * measured) - self.double)
        axis = float(np.angle(self.double)) / 2
        axis += np.pi * round(((measured if np.isnan(box["heading"]) else box["heading"]) - axis) / np.pi)
        facing = 0.95 * self.facing + (np.cos(measured - axis) if is_turned else 0.0)
        if abs(self.v) > 1 and self.limits.turns:
            facing += 2 * (self.v * np.exp(-1j * axis)).real / abs(self.v)
        self.facing = abs(facing)
        box["heading"] = wrapped(axis + np.pi * (facing < 0)) if self.double else np.nan


def pairs(
    tracks: Sequence[Track], found: Sequence[Mapping[str, float]], allowed: NDArray[np.bool_], least_iou: float | None
) -> list[tuple[int, int]]:
    """The allowed pairs with the largest sum of gains."""
    gain = np.zeros(allowed.shape)
    for k, n in np.argwhere(allowed).tolist():
        track, one = tracks[k], found[n]
        if least_iou is None:
            squared = abs(complex(one["x"], one["y"]) - track.p) ** 2
            gain[k, n] = 30 - squared / track.spread - 2 * np.log(track.spread)
        else:
            boxes = [
                np.array([[each[name] for name in ("x", "y", "z", "length", "width", "height", "heading")]])
                for each in (track.whole(), one)
            ]
            iou = bev_iou_of_pairs(*boxes)[0]
            gain[k, n] = iou if iou >= max(least_iou, 1e-6) else 0.0
    return [(k, n) for k, n in zip(*linear_sum_assignment(-gain), strict=True) if gain[k, n] > 0]


def associated(
    tracks: Sequence[Track], found: Sequence[Mapping[str, float]], least_iou: float | None, across_classes: bool
) -> list[tuple[int, int, bool]]:
    """Tracks and detections that belong together, and whether they are of one class."""
    near, same, other = (np.zeros((len(tracks), len(found)), bool) for _ in range(3))
    for k, track in enumerate(tracks):
        reach = track.limits.gate_m * (1 + track.missed_s)
        for n, one in enumerate(found):
            squared = abs(complex(one["x"], one["y"]) - track.p) ** 2
            near[k, n] = squared <= min(16 * track.spread, reach**2)
            same[k, n] = across_classes or track.kind == one["class"]
            limit = min(9 * track.spread, max(0.4 * reach, 3 * track.limits.noise_m) ** 2)
            other[k, n] = near[k, n] and squared <= limit and track.hits >= 2
    first = pairs(tracks, found, near & same, least_iou)
    if same.all():
        return [(k, n, True) for k, n in first]
    for k, n in first:
        other[k], other[:, n] = False, False
    return [(k, n, True) for k, n in first] + [(k, n, False) for k, n in pairs(tracks, found, other, least_iou)]


def ground_tracks(
    frames: Sequence[tuple[int, Sequence[Mapping[str, float]]]],
    limits: Mapping[int, MotionLimits],
    *,
    max_age_s: float = 2.0,
    delay_s: float = 1.0,
    confirm_score: float = 0.9,
    birth_score: float = 0.2,
    least_iou: float | None = None,
    across_classes: bool = False,
) -> list[list[dict[str, float]]]:
    """The rows of each frame, given its time in nanoseconds and its detections, with their columns by name."""
    tracks: list[Track] = []
    order: list[int] = []
    rows: list[list[dict[str, float]]] = []
    done: list[list[dict[str, float]]] = []
    confirmed: set[int] = set()
    next_number = 1

    def row(track: Track, **changed: float) -> dict[str, float]:
        usual = {"vx": track.v.real, "vy": track.v.imag, "score": track.score, "source": track.source, "observed": True}
        return track.whole() | usual | {"class": track.kind, "id": track.number} | changed

    def note(some: Iterable[int]) -> None:
        """Note the classes of some detections: of classes with the same votes the first one wins."""
        order.extend(sorted({int(found[n]["class"]) for n in some} - {*order}))

    def write(until_ns: float) -> None:
        while len(done) < len(rows) and frames[len(done)][0] <= until_ns:
            done.append(sorted((one for one in rows[len(done)] if one["id"] in confirmed), key=lambda one: one["id"]))

    for number, (now, given) in enumerate(frames):
        passed = (now - frames[number - 1][0]) / 1e9 if number else 0.0
        found = sorted(given, key=lambda one: (one["x"], one["y"]))
        if passed > 0:
            for track in tracks:
                track.predict(passed)
        rows.append([])
        used = set()
        together = associated(tracks, found, least_iou, across_classes)
        note(n for _, n, _ in together)
        for k, n, is_same in together:
            track = tracks[k]
            used.add(n)
            before, speed, since, missed_s = track.last, track.v, track.frame, track.missed_s
            track.correct(found[n], is_same, number)
            for at in range(max(since + 1, len(done)), number):
                share = 1 - (now - frames[at][0]) / 1e9 / missed_s
                between = {name: before[name] + share * (track.last[name] - before[name]) for name in before}
                turn = wrapped(track.last["heading"] - before["heading"])
                between["heading"] = wrapped(before["heading"] + share * turn)
                moves = speed * (1 - share) + track.v * share
                lacks = {"score": np.nan, "source": -1, "observed": False}
                rows[at].append(row(track, **between, vx=moves.real, vy=moves.imag, **lacks))
        born = [n for n, one in enumerate(found) if n not in used and not one["score"] < birth_score]
        note(born)
        for one in (found[n] for n in born):
            tracks.append(Track(next_number, one, limits[int(one["class"])], number, order))
            next_number += 1
        for track in tracks:
            if track.scores >= confirm_score:
                track.is_confirmed = True
                confirmed.add(track.number)
            if track.frame == number:
                rows[number].append(row(track))
        ages = {track.number: max_age_s if track.is_confirmed else min(0.6, max_age_s) for track in tracks}
        tracks = [track for track in tracks if track.missed_s <= max(ages[track.number], 1.5 * passed)]
        write(now - delay_s * 1e9)
    write(np.inf)
    return done
