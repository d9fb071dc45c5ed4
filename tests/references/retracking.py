"""Shared by both references of re-tracking: rows, claims, assignment, and the offline steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from tests.references.false_tracks import DECIDED, DECIDED_BIAS, log_odds_in_log
from tests.references.hypotheses import Claim, swept
from tests.references.offline import FITTED, Motion, exchanged, sigmoid, smoothed_in_log

Point = tuple[float, float]
Row = dict[str, float]
Predict = Callable[[list[Point]], tuple[np.ndarray, np.ndarray]]
#: The least noise (m) and speed (m/s).
LEAST = 1e-3
LINEAR = ("x_px", "y_px", "w_px", "h_px", "x_m", "y_m", "score")


class Undecided(Exception):
    """Two assignments are equally good, so the result is not defined."""


def constant_velocity(steps: int) -> Predict:
    """Continue by the mean of the last three displacements, with unit covariance."""

    def predict(points: list[Point]) -> tuple[np.ndarray, np.ndarray]:
        back = min(3, len(points) - 1)
        here = np.array(points[-1])
        each = (here - points[-1 - back]) / back if back else np.zeros(2)
        return np.array([here + k * each for k in range(1, steps + 1)]), np.array([np.eye(2)] * steps)

    return predict


def best_assignment(value: list[list[float | None]], most_pairs: bool) -> list[tuple[int, int]]:
    """The pairs (row, column) of the largest total value, by trying all; None is no pair.

    With ``most_pairs`` the number of pairs counts first. Raises Undecided on a tie.
    """
    columns = len(value[0]) if value else 0
    found: list[tuple[tuple[float, float], list[tuple[int, int]]]] = []

    def go_on(row: int, used: frozenset[int], score: tuple[float, float], pairs: list[tuple[int, int]]) -> None:
        if row == len(value):
            found.append((score, pairs))
            return
        go_on(row + 1, used, score, pairs)
        for column in set(range(columns)) - used:
            worth = value[row][column]
            if worth is not None:
                more = (score[0] + most_pairs, score[1] + worth)
                go_on(row + 1, used | {column}, more, [*pairs, (row, column)])

    go_on(0, frozenset(), (0, 0.0), [])
    found.sort(key=lambda each: each[0])
    if len(found) > 1 and found[-1][0][0] == found[-2][0][0] and found[-1][0][1] - found[-2][0][1] < 1e-5:
        raise Undecided
    return found[-1][1]


def steps_of(times_ns: list[int], rate_hz: float) -> list[int]:
    """The number of each frame on the clock of prediction."""
    steps = [0]
    for before, now in pairwise(times_ns):
        steps.append(steps[-1] + max(1, round((now - before) / 1e9 * rate_hz)))
    return steps[: len(times_ns)]


def median_speed(samples: list[list[Row]], times_ns: list[int]) -> float:
    """The median in m/s of the speeds over three samples of a track, of those above 0.5; 0 if they are fewer than 30."""
    paths: dict[int, list[tuple[int, float, float]]] = {}
    for t_ns, rows in zip(times_ns, samples, strict=True):
        for row in rows:
            paths.setdefault(row["track_id"], []).append((t_ns, row["x_m"], row["y_m"]))
    pairs = [(a, b) for path in paths.values() for a, b in zip(path, path[3:], strict=False)]
    speeds = [np.hypot(b[1] - a[1], b[2] - a[2]) / (b[0] - a[0]) * 1e9 for a, b in pairs]
    speeds = [speed for speed in speeds if speed > 0.5]
    return float(np.median(speeds)) if len(speeds) >= 30 else 0.0


@dataclass
class Claims:
    """The samples of tracks, in the order in which they were assigned."""

    made: list[tuple[int, int, int]] = field(default_factory=list)  # step, track, source
    confirmed: dict[int, int] = field(default_factory=dict)  # track -> last step
    asks: bool = False

    def paths(self, samples: dict[tuple[int, int], Row], shared: bool) -> dict[int, dict[int, Row]]:
        """Each track's samples by step. A sample belongs to the track that claimed it first, unless it is shared."""
        out: dict[int, dict[int, Row]] = {}
        taken = set()
        for step, track, source in self.made:
            row = samples.get((step, source))
            if row is None or (self.asks and step > self.confirmed.get(track, -1)):
                continue
            if step in out.get(track, {}) or (not shared and (step, source) in taken):
                continue
            taken.add((step, source))
            out.setdefault(track, {})[step] = row
        return out


def filled(path: dict[int, Row], track: int) -> dict[int, Row]:
    """A row for every step of a track, on straight lines between its samples."""
    out = {}
    seen = sorted(path)
    for step in range(seen[0], seen[-1] + 1):
        low = max(s for s in seen if s <= step)
        row = dict(path[low])
        if step != low:
            high = min(s for s in seen if s > step)
            for name in LINEAR:
                row[name] += (step - low) / (high - low) * (path[high][name] - row[name])
            row["observed"] = False
        row["source_id"] = path[low]["track_id"] if step == low else -1
        row["track_id"] = track
        out[step] = row
    return out


def offline(claims: Claims, samples: list[list[Row]], steps: list[int], options, noise_m: float) -> list[list[Row]]:
    """The rows of each frame by the offline steps."""
    o = options
    motion = Motion(max(noise_m, LEAST), max(o.speed_m_per_s, LEAST), o.drift_m_per_s, o.drift_ratio, 1 / o.rate_hz)
    of = {(step, row["track_id"]): row for step, rows in zip(steps, samples, strict=True) for row in rows}
    paths = claims.paths(of, o.shares_samples)
    online = {(step, row["track_id"]): track for track, path in paths.items() for step, row in path.items()}
    for _ in range(2 if o.link_s > 0 else 0):
        places = [(track, step, row) for track, path in paths.items() for step, row in path.items()]
        held = [
            Claim(step, track, online[step, row["track_id"]], row["track_id"], (row["x_m"], row["y_m"]))
            for track, step, row in places
        ]
        paths = {}
        for track, (_, step, row) in zip(swept(motion, held, o.link_s, o.link_confidence), places, strict=True):
            paths.setdefault(track, {})[step] = row
    if o.resolve_swaps:
        owner, _ = exchanged(motion, places_of(paths))
        changed: dict[int, dict[int, Row]] = {}
        for track, path in paths.items():
            for step, row in path.items():
                changed.setdefault(owner[track][step], {})[step] = row
        paths = changed
    tracks = {track: filled(path, track) for track, path in paths.items()}
    smoothed = smoothed_in_log(motion, places_of(paths), o.noise_m is not None) if paths else {}
    odds = {
        track: DECIDED_BIAS + DECIDED * value
        for track, value in log_odds_in_log(motion, places_of(paths), (steps[0], steps[-1])).items()
    }
    for track in list(tracks):
        if o.smooth:
            for step, state in smoothed[track].items():
                move_to(tracks[track][step], state.mean[:, 0], () if step in paths[track] else o.ground_planes)
        least_s = min(o.min_track_s, (steps[-1] - steps[0]) / o.rate_hz / 3) if o.track_confidence else o.min_track_s
        length = len(tracks[track])
        if length < round(least_s * o.rate_hz) + 1 or person(odds[track]) < o.track_confidence:
            del tracks[track]
    return [[tracks[track][step] for track in sorted(tracks) if step in tracks[track]] for step in steps]


def person(odds: float) -> float:
    """The probability that a track is a person."""
    decided = FITTED["decided"]
    return sigmoid(decided["weights"]["log odds"] * odds + decided["bias"])


def places_of(paths: dict[int, dict[int, Row]]) -> dict[int, dict[int, Point]]:
    return {name: {step: (row["x_m"], row["y_m"]) for step, row in path.items()} for name, path in paths.items()}


def move_to(row: Row, to: np.ndarray, planes) -> None:
    """Move a row and its box to another position; planes only scale here."""
    if planes:
        scale = planes[0][1].homography[0]
        row["x_px"] += (to[0] - row["x_m"]) / scale
        row["y_px"] += (to[1] - row["y_m"]) / scale
    row["x_m"], row["y_m"] = to


def place(row: Row) -> np.ndarray:
    return np.array([row["x_m"], row["y_m"]])
