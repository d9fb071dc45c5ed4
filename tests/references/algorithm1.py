"""Algorithm 1 of the paper (Yu and Zhou, IROS 2021) with Eq. 1 to 3: a slow reference with one object per track."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import hypot, inf, sqrt

import numpy as np

from tests.references.retracking import Claims, Point, Predict, Row, best_assignment, offline, steps_of


def histories(
    samples: list[list[Row]], steps: list[int], length: int
) -> Iterable[tuple[int, list[tuple[Row, list[Point]]]]]:
    """For each step its rows, each with the last positions of its id without a gap, ``length`` at most."""
    places: dict[tuple[int, int], Point] = {}
    for step, rows in zip(steps, samples, strict=True):
        for row in rows:
            places[step, row["track_id"]] = (row["x_m"], row["y_m"])
        out = []
        for row in rows:
            run: list[Point] = []
            while len(run) < length and (step - len(run), row["track_id"]) in places:
                run.insert(0, places[step - len(run), row["track_id"]])
            out.append((row, run))
        yield step, out


@dataclass
class Smoothed:
    """Eq. 3: a track's last position and its smoothed displacements."""

    last: Point
    alpha: float
    beta: float
    displacements: list[np.ndarray] = field(default_factory=list)
    trend: np.ndarray = field(default_factory=lambda: np.zeros(2))

    def move(self, to: Point, steps: int) -> None:
        each = (np.array(to) - self.last) / steps
        for _ in range(steps):
            if not self.displacements:
                self.displacements.append(each)
                continue
            before = self.displacements[-1]
            level = self.alpha * each + (1 - self.alpha) * (before + self.trend)
            self.trend = self.beta * (level - before) + (1 - self.beta) * self.trend
            self.displacements.append(level)
        self.last = to

    def past(self, length: int) -> list[Point]:
        points = [np.array(self.last)]
        for displacement in self.displacements[::-1][: length - 1]:
            points.insert(0, points[0] - displacement)
        return [tuple(point) for point in points]


@dataclass
class Track:
    name: int
    seen: int
    source: int
    motion: Smoothed
    mean: np.ndarray
    cov: np.ndarray
    hits: int = 0


class Algorithm1:
    def __init__(self, options, predict: Predict, past: int) -> None:
        self.options, self.predict = options, predict
        self.length = max(past, options.min_history, 2)
        self.tracks: list[Track] = []
        self.claims = Claims(asks=options.trim_ends)
        self.born = 0

    def run(self, samples: list[list[Row]], times_ns: list[int]):
        o = self.options
        steps = steps_of(times_ns, o.rate_hz)
        online, predictions = [], []
        for step, rows in histories(samples, steps, self.length):
            ready = [(r, run) for r, run in rows if len(run) >= o.min_history and (o.interpolated or r["observed"])]
            observations = [(row, run, *self.predict(run)) for row, run in ready]
            pairs = self.match(step, observations)
            shown = self.update(step, pairs, observations) + self.start(step, pairs, observations)
            self.tracks = [t for t in self.tracks if (step - t.seen) / o.rate_hz <= o.max_age_s + 1e-9]
            shown = sorted((pair for pair in shown if pair[0].hits >= o.min_hits), key=lambda pair: pair[0].name)
            online.append([row | {"source_id": row["track_id"], "track_id": t.name} for t, row in shown])
            predictions.append([(t.name, t.mean, t.cov) for t, _ in shown])
        return offline(self.claims, samples, steps, o, 0.2 if o.noise_m is None else o.noise_m), online, predictions

    def match(self, step: int, observations) -> list[tuple[int, int]]:
        o = self.options
        value: list[list[float | None]] = []
        for track in self.tracks:
            value.append([])
            for row, run, mean, cov in observations:
                age = step - track.seen
                distance = round(self.distance(track, age, mean, cov), 6)
                jump = hypot(*(track.mean[age - 1] - run[-1])) if age <= len(track.mean) else inf
                near = distance <= o.max_distance and (o.gate_m is None or jump <= o.gate_m)
                cost = distance if near else None
                if distance < o.priority_distance:
                    cost = -100.0
                same = o.same_id_bonus if row["track_id"] == track.source else 0.0
                value[-1].append(None if cost is None else same - cost)
        return best_assignment(value, most_pairs=True)

    def distance(self, track: Track, age: int, mean: np.ndarray, cov: np.ndarray) -> float:
        """Eq. 1 at each step that both predict, and Eq. 2 or a variant of it."""
        o, horizon = self.options, len(mean)

        def spread(own: np.ndarray, ahead: int) -> np.ndarray:
            return ahead * o.sigma_m**2 * np.eye(2) if o.covariance == "paper" else own

        def mahalanobis(off: np.ndarray, of: np.ndarray) -> float:
            return float(sqrt(off @ np.linalg.inv(of) @ off))

        each = []
        for u in range(1, horizon - age + 1):  # u steps from now
            of = spread(track.cov[age + u - 1], age + u) + spread(cov[u - 1], u)
            each.append(mahalanobis(track.mean[age + u - 1] - mean[u - 1], of))
        if not each:
            return inf
        return {"mean": sum(each) / len(each), "max": max(each)}[o.distance]

    def update(self, step: int, pairs: list[tuple[int, int]], observations) -> list[tuple[Track, Row]]:
        shown = []
        for at, track in enumerate(self.tracks):
            mine = [b for a, b in pairs if a == at]
            if not mine:
                track.hits = 0
                continue
            row, run, _, _ = observations[mine[0]]
            track.motion.move(run[-1], step - track.seen)
            track.mean, track.cov = self.predict(track.motion.past(self.length))
            track.seen, track.source, track.hits = step, row["track_id"], track.hits + 1
            self.claims.made.append((step, track.name, row["track_id"]))
            if track.hits >= self.options.min_hits:
                self.claims.confirmed[track.name] = step
            shown.append((track, row))
        return shown

    def start(self, step: int, pairs: list[tuple[int, int]], observations) -> list[tuple[Track, Row]]:
        o, new = self.options, []
        for at, (row, run, *raw) in enumerate(observations):
            if at in {b for _, b in pairs}:
                continue
            self.born += 1
            motion = Smoothed(run[0], o.alpha, o.beta)
            for point in run[1:]:
                motion.move(point, 1)
            forecast = raw if o.birth == "raw" else self.predict(motion.past(self.length))
            track = Track(self.born, step, row["track_id"], motion, *forecast)
            self.claims.made.append((step, track.name, row["track_id"]))
            self.claims.confirmed[track.name] = step
            new.append((track, row, run))
        if o.backfill != "none":
            for track, row, run in new:
                for back in range(1, min(len(run), max(o.min_history, 4))):
                    self.claims.made.append((step - back, track.name, row["track_id"]))
        self.tracks += [track for track, _, _ in new]
        return [(track, row) for track, row, _ in new]
