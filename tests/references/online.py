"""Online re-tracking by likelihood: a slow reference with one object per track."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import exp, hypot, log, pi

import numpy as np

from tests.references.offline import (
    LINK_BIAS,
    LINK_LEAST,
    LINK_WEIGHTS,
    Motion,
    State,
    gap_class,
    link_features,
    usual_by_gap,
)
from tests.references.retracking import (
    LEAST,
    Claims,
    Point,
    Predict,
    Row,
    Undecided,
    best_assignment,
    median_speed,
    move_to,
    offline,
    place,
    steps_of,
)


@dataclass
class Person:
    """A Kalman filter along both axes, which share their covariance, and the input ids of the track."""

    name: int
    mean: np.ndarray  # (2, 2): position and velocity along x, along y
    cov: np.ndarray  # (2, 2)
    source: int
    hits: int = 1
    missed: int = 0
    merged: int = 0
    row: Row | None = None

    @property
    def here(self) -> np.ndarray:
        return self.mean[:, 0]

    def predict(self, seconds: float, drift: float, drift_ratio: float) -> None:
        power = (drift + drift_ratio * hypot(*self.mean[:, 1])) ** 2
        move = np.array([[1, seconds], [0, 1]])
        noise = power * np.array([[seconds**3 / 3, seconds**2 / 2], [seconds**2 / 2, seconds]])
        self.mean, self.cov = self.mean @ move.T, move @ self.cov @ move.T + noise

    def correct(self, at: np.ndarray, noise_m: float) -> None:
        gain = self.cov[:, 0] / (self.cov[0, 0] + noise_m**2)
        self.mean = self.mean + np.outer(at - self.here, gain)
        self.cov = self.cov - np.outer(gain, self.cov[0])


class Lives:
    """What became of the tracks so far, and the area in which confirmed ones were seen."""

    LASTS, RETURNS, COUNTS = 0.6, 0.8, 2

    def __init__(self, confirm: int, max_age: int) -> None:
        self.lasting, self.max_age = 3 * (confirm - 1) + 1, max_age
        self.went_on, self.ended = Counter(), Counter()
        self.back, self.stayed = Counter(), Counter()
        self.places: list[Point] = []
        self.before: dict[int, tuple[int, int, bool]] = {}

    def learn(self, now: dict[int, tuple[int, int, bool]], passed: int) -> None:
        """``now`` has the observations, steps without one, and whether outside, of each track."""
        for name, (hits, missed, outside) in self.before.items() if passed == 1 else ():
            then = now.get(name)
            if hits < self.lasting and then is None:
                self.ended[hits] += 1
            elif hits < self.lasting and then[0] > hits:
                self.went_on[hits] += 1
            if missed and (hits < self.lasting or outside):
                if then is not None and then[1] == 0:
                    self.back[outside, missed] += 1
                elif then is None or then[1] > missed:  # one that is merged with another grows no older
                    self.stayed[outside, missed] += 1
        self.before = now

    def lasts(self, hits: int) -> float:
        each = self.LASTS ** (1 / max(self.lasting - 1, 1))
        out = 1.0
        for k in range(hits, self.lasting):
            total = self.went_on[k] + self.ended[k]
            out *= (self.went_on[k] + self.COUNTS * each) / (total + self.COUNTS)
        return out

    def comes_back(self, missed: int, outside: bool) -> float:
        each = (1 - self.RETURNS) ** (1 / self.max_age)
        away = 1.0
        for age in range(missed, self.max_age + 1):
            total = self.back[outside, age] + self.stayed[outside, age]
            away *= (self.stayed[outside, age] + self.COUNTS * each) / (total + self.COUNTS)
        return 1 - away

    def is_outside(self, at: np.ndarray) -> bool:
        """Whether the places so far are on one side of a line through a place, or on a line."""
        off = np.array(self.places).reshape(-1, 2) - at
        if len(off) < 3 or np.linalg.matrix_rank(off - off[0], tol=1e-9) < 2:
            return True
        angle = np.sort(np.arctan2(off[:, 1], off[:, 0]))
        return bool(max(np.diff(angle).max(), angle[0] + 2 * pi - angle[-1]) > pi)


class Places:
    """What became of the last 2000 tracks that were lost."""

    def __init__(self) -> None:
        self.all: list[tuple[np.ndarray, bool]] = []

    def ratio(self, at: np.ndarray) -> float:
        """The odds that it goes well within 2 m, compared with everywhere; 8 more are as everywhere."""
        ended = self.all[-2000:]
        well = (sum(good for _, good in ended) + 1) / (len(ended) + 2)
        near = [good for there, good in ended if hypot(*(there - at)) <= 2]
        return (near.count(True) / well + 8) / (near.count(False) / (1 - well) + 8)


def at_odds(probability: float, ratio: float) -> float:
    return probability * ratio / (1 - probability + probability * ratio)


class Losses:
    """Places where tracks were lost, of those that are lost, and the odds that these come back."""

    def __init__(self) -> None:
        self.lost = Places()
        self.now: dict[int, tuple[np.ndarray, float]] = {}

    def learn(self, people: list[Person], has: dict[int, Row], passed: int) -> None:
        for name in [one for one in self.now if one not in {person.name for person in people}]:
            place, _ = self.now.pop(name)
            if passed == 1:
                self.lost.all.append((place, False))
        for name in [one for one in self.now if one in has]:
            self.lost.all.append((self.now.pop(name)[0], True))
        for p in people:
            if p.name not in has and p.name not in self.now:
                self.now[p.name] = (p.here, self.lost.ratio(p.here))

    def ratio(self, name: int) -> float:
        return self.now[name][1] if name in self.now else 1.0


@dataclass
class Left:
    """A track as it was last observed, under the name that it is written."""

    first: int
    last: int
    begun: State
    state: State
    hits: int = 1
    written: int | None = None
    over: bool = False


class Returns:
    """Tracks under the names of lost ones that they continue."""

    def __init__(self, motion: Motion, options, confirm: int) -> None:
        self.motion, self.options, self.confirm = motion, options, confirm
        self.lasting = 3 * (confirm - 1) + 1
        self.tracks: dict[int, Left] = {}
        self.used: set[int] = set()
        self.made: list[tuple[float, bool, float]] = []
        self.estimated = 0
        self.shifts = usual_by_gap({})

    def learn(self, people: list[Person], has: dict[int, Row], step: int) -> None:
        for person in people:
            if person.name not in self.tracks:
                self.tracks[person.name] = Left(step, step, *[State(person.mean, person.cov)] * 2)
            if person.name in has:
                known = self.tracks[person.name]
                known.last, known.hits, known.state = step, person.hits, State(person.mean, person.cov)
        for name, known in self.tracks.items():
            known.over = name not in {person.name for person in people}

    def name(self, written: list[Person], step: int, has: dict[int, Row], people: list[Person]) -> list[Person]:
        """Decide on those without a name, or with their own; returns those that are written, too: they continue others."""
        from scipy.optimize import linear_sum_assignment

        more = [one for one in people if one.name in has and one not in written]
        first = [one for one in written if self.tracks[one.name].written is None]
        new = [one for one in people if one in first or one in more or (one in written and one.name in has)]
        new = [
            one
            for one in new
            if self.tracks[one.name].written is None
            or (self.tracks[one.name].written == one.name and one.hits <= self.lasting)
        ]
        for person in first:
            self.tracks[person.name].written = person.name
        if self.options.link_s <= 0:
            return []
        lost = [one for one, known in self.tracks.items() if known.over and known.written and one not in self.used]
        found, gains = {}, np.zeros((len(lost), len(new)))
        for i, one in enumerate(lost):
            for j, person in enumerate(new):
                known, begun = self.tracks[one], self.tracks[person.name].begun
                gap_s = (self.tracks[person.name].first - known.last) * self.motion.step_s
                apart = hypot(*(known.state.mean[:, 0] - begun.mean[:, 0]))
                if (
                    (step - known.last) * self.motion.step_s > self.options.link_s
                    or apart > 1 + 2.5 * gap_s
                    or known.last >= self.tracks[person.name].first
                ):
                    continue
                if person not in first and known.hits < self.confirm:
                    continue
                mean = np.stack([begun.mean[:, 0], person.mean[:, 1]], axis=1)
                cov = np.diag([begun.cov[0, 0], person.cov[1, 1]])
                if person.hits == 1:
                    mean[:, 1], cov[1, 1] = known.state.mean[:, 1], known.state.cov[1, 1]
                features = link_features(self.motion, known.state, State(mean, cov), gap_s)
                odds = float(np.dot(LINK_WEIGHTS, features) + LINK_BIAS)
                found[i, j], gains[i, j] = (odds, False, gap_s), max(odds - LINK_LEAST, 0)
        least = log(self.options.link_confidence / (1 - self.options.link_confidence))
        for i, j in zip(*linear_sum_assignment(-gains), strict=True):
            if gains[i, j] <= 0:
                continue
            shifted = found[i, j][0] + self.shifts[gap_class(found[i, j][2])]
            is_right = shifted > (least - log(3) if new[j] in first else least)
            if is_right:
                self.tracks[new[j].name].written = self.tracks[lost[i]].written
                self.used.add(lost[i])
            if is_right or new[j].hits >= self.lasting:
                self.made.append(found[i, j])
        if len(self.made) > self.estimated + min(self.estimated / 10, 50):
            self.estimated = len(self.made)
            self.shifts = usual_by_gap(dict(enumerate(self.made[-500:])))
        return [one for one in more if self.tracks[one.name].written not in (None, one.name)]


def log_density(off: np.ndarray, variance: float) -> float:
    """That of a normal distribution in the plane with the same variance along both axes."""
    return float(-(off**2).sum() / variance / 2 - log(2 * pi * variance))


class OnlineTracker:
    CAP, GATE, CROWD_M, FRESH, FLOOR_M = 26.0, 40.0, 1.7, 4.0, 0.1
    WIDE, MERGED = 0.1, 4.0

    def __init__(self, options, predict: Predict, past: int) -> None:
        o = self.options = options
        self.predict, self.past = predict, past
        self.noise_m = 0.2 if o.noise_m is None else max(o.noise_m, LEAST)
        self.confirm = max(1, round(o.confirm_s * o.rate_hz) + 1)
        self.max_age = max(1, round(o.max_age_s * o.rate_hz))
        self.people: list[Person] = []
        self.claims = Claims()
        self.known: set[int] = set()
        self.born = self.judged = 0

    def run(self, samples: list[list[Row]], times_ns: list[int]):
        o = self.options
        steps = steps_of(times_ns, o.rate_hz)
        if median_speed(samples, times_ns) > 1.5 * 1.4:
            raise Undecided  # offline tracks are made in another unit, which is tested by itself
        online, predictions = [], []
        places: dict[tuple[int, int], Point] = {}
        lives = Lives(self.confirm, self.max_age)
        losses = Losses()
        motion = Motion(self.noise_m, max(o.speed_m_per_s, LEAST), o.drift_m_per_s, o.drift_ratio, 1 / o.rate_hz)
        returns = Returns(motion, o, self.confirm)
        for at, (step, rows) in enumerate(zip(steps, samples, strict=True)):
            passed = step - steps[at - 1] if at else 1
            seen = sorted((r for r in rows if r["observed"] or o.interpolated), key=lambda row: row["track_id"])
            has = self.step(seen, passed)
            now = {
                one.name: (one.hits, 0 if one.name in has else one.missed, lives.is_outside(one.here))
                for one in self.people
            }
            lives.learn(now, passed)
            lives.places += [one.here for one in self.people if one.name in has and one.hits >= self.confirm]
            losses.learn(self.people, has, passed)
            returns.learn(self.people, has, step)
            written = [one for one in self.people if self.is_written(one, now[one.name], lives, losses)]
            written += returns.name(written, step, has, self.people)
            shown = []
            for person in self.people:
                row = has.get(person.name)
                if row is not None:
                    self.claims.made.append((step, person.name, row["track_id"]))
                    places[step, person.name] = (row["x_m"], row["y_m"])
                    person.row = row
                if person not in written:
                    continue
                name = returns.tracks[person.name].written
                if row is not None:
                    shown.append((row | {"source_id": row["track_id"], "track_id": name}, person))
                else:
                    lost = person.row | {"source_id": -1, "track_id": name, "observed": False}
                    move_to(lost, person.here, o.ground_planes)
                    shown.append((lost, person))
            shown.sort(key=lambda one: one[0]["track_id"])
            online.append([row for row, _ in shown])
            predictions.append(
                [
                    (row["track_id"], *self.forecast(row, person.name, step, places))
                    for row, person in shown
                    if person.hits >= self.confirm
                ]
            )
        return offline(self.claims, samples, steps, o, self.noise_m), online, predictions

    def is_written(self, person: Person, now: tuple[int, int, bool], lives: Lives, losses: Losses) -> bool:
        """Whether a track is written online."""
        o, (hits, missed, outside) = self.options, now
        if not o.adapt_online:
            enough = self.confirm if missed == 0 else 1.5 * self.confirm
            return hits >= enough and missed <= round(o.coast_s * o.rate_hz)
        if missed == 0:
            return hits >= self.confirm or lives.lasts(hits) >= 0.5
        if missed > round(o.coast_s * o.rate_hz):
            return False
        if hits >= lives.lasting and not outside:
            return True
        comes_back = at_odds(lives.comes_back(missed, outside), losses.ratio(person.name))
        return comes_back * lives.lasts(hits + 1) >= 0.5

    def forecast(self, row: Row, name: int, step: int, places: dict[tuple[int, int], Point]):
        past = [places.get((step - back, name)) for back in range(self.past - 1, 0, -1)]
        return self.predict([*past, (row["x_m"], row["y_m"])])

    def step(self, rows: list[Row], passed: int) -> dict[int, Row]:
        """One step; returns the row that each person has."""
        o = self.options
        young = min(self.confirm, self.max_age)
        for person in self.people:
            person.missed += passed
        self.people = [p for p in self.people if p.missed <= (self.max_age if p.hits >= self.confirm else young)]
        for person in self.people:
            person.predict(passed / o.rate_hz, o.drift_m_per_s, o.drift_ratio)
        value = [[self.gain(person, row, rows) for row in rows] for person in self.people]
        pairs = best_assignment(value, most_pairs=False)
        has = {self.people[a].name: rows[b] for a, b in pairs}
        hosts = self.merge(has, passed)
        self.learn(has, hosts, self.noise_m)
        for person in self.people:
            if person.name in has:
                row = has[person.name]
                host = person.name in hosts
                person.correct(place(row), o.merge_distance_m / 2 if host else self._noise_before)
                person.hits, person.missed, person.merged = person.hits + 1, 0, 0
                person.source = -1 if host else row["track_id"]
        for row in rows:
            if not any(row is other for other in has.values()):
                self.born += 1
                mean = np.stack([place(row), np.zeros(2)], axis=1)
                new = Person(
                    self.born, mean, np.diag([self.noise_m**2, max(o.speed_m_per_s, LEAST) ** 2]), row["track_id"]
                )
                self.people.append(new)
                has[new.name] = row
        self.known |= {row["track_id"] for row in rows}
        return has

    def gain(self, person: Person, row: Row, rows: list[Row]) -> float | None:
        """Twice the log likelihood ratio of a pair to no pair."""
        o = self.options
        variance = person.cov[0, 0] + self.noise_m**2 + self.FLOOR_M**2
        squared = ((place(row) - person.here) ** 2).sum() / variance
        if squared > self.GATE:
            return None
        gain = self.CAP - squared - 2 * log(variance)
        if person.source == row["track_id"]:
            others = [hypot(*(place(other) - place(row))) for other in rows if other is not row]
            gain += o.same_id_bonus / 3 if any(apart < self.CROWD_M for apart in others) else o.same_id_bonus
        if row["track_id"] not in self.known and person.missed == 1:
            gain -= self.FRESH
        gain = round(gain, 6)
        return gain if gain > 0 else None

    def merge(self, has: dict[int, Row], passed: int) -> set[int]:
        """Update lost tracks by detections that they share with another track; returns those other tracks."""
        o, hosts = self.options, set()
        sure = [p for p in self.people if p.name in has and p.hits >= self.confirm]
        for person in self.people:
            if (
                person.name in has
                or person.hits < self.confirm
                or person.merged / o.rate_hz >= o.merge_timeout_s
                or not sure
            ):
                continue
            host = min(sure, key=lambda p: hypot(*(place(has[p.name]) - person.here)))
            at = place(has[host.name])
            middle = (host.here + person.here) / 2
            is_between = hypot(*(at - middle)) < hypot(*(at - host.here))
            if hypot(*(at - person.here)) < o.merge_distance_m and is_between:
                noise = self.noise_m**2
                both = log_density(at - middle, (host.cov[0, 0] + person.cov[0, 0]) / 4 + noise)
                one = log_density(at - host.here, host.cov[0, 0] + noise)
                if 2 * (both - one) > self.MERGED or person.merged or person.source == -1:
                    hosts.add((host.name, person.name))
        for host, guest in hosts:
            person = next(p for p in self.people if p.name == guest)
            person.correct(place(has[host]), o.merge_distance_m / 2)
            person.missed, person.merged = max(person.missed - passed, 1), person.merged + passed
        return {host for host, _ in hosts}

    def learn(self, has: dict[int, Row], hosts: set[int], noise_m: float) -> None:
        """Adapt the noise: it grows if more than a tenth of positions lie outside the 90 % circle, and shrinks otherwise."""
        self._noise_before = noise_m
        if self.options.noise_m is not None:
            return
        outside = []
        for person in self.people:
            if person.name in has and person.name not in hosts and person.hits >= self.confirm:
                squared = ((place(has[person.name]) - person.here) ** 2).sum()
                outside.append(squared > -2 * log(self.WIDE) * (person.cov[0, 0] + noise_m**2))
        if outside:
            self.judged += len(outside)
            rate = max(0.01, 5 / (self.judged + 50))
            change = rate * sum(out - self.WIDE for out in outside)
            self.noise_m = min(max(exp(log(noise_m) + change), 0.03), 0.8)
