"""Synthetic scenes of people to fit and to choose settings on: squares, streets, crossings and open places.

People walk by social forces as in `mcaptrack train synthetic`, which knows no borders. Here they come and go: over a
square from gate to gate, along a street in two flows of some lanes, over a crossing of two streets, or past an open
place of which a camera sees the middle. Of each scene a share sits or stands for all the time or for long, goes by
bicycle, or walks in groups. All shares, sizes and speeds are drawn from wide ranges that are general knowledge about
people; no recording is used.

Letters: S scenes, M people there at once, T steps.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from corruptions import STEP_S, Corruption, Rows

from mcaptrack.sources import walks

SCENES, PEOPLE = walks.SCENES, walks.PEOPLE
SHAPES = ("square", "street", "crossing", "open")
SQUARE, STREET, CROSSING, OPEN = range(4)
#: How far outside people turn round, in metres; how many gates a square has; and the shortest presence, in steps.
OUTSIDE_M, GATES, SHORTEST = 2.0, 6, 8


class Crowd(walks.Crowd):
    """S scenes of M people, the ``kind`` (S, 1) of each, and who has just come in (S, M): somebody else left."""

    @classmethod
    def begin(cls, rng: np.random.Generator) -> Crowd:
        crowd = cls.start(rng)
        shape, scene = crowd.pace.shape, np.arange(SCENES)[:, None]
        crowd.kind = np.arange(SCENES)[:, None] % len(SHAPES)
        side = np.exp(rng.uniform(np.log(20), np.log(120), (SCENES, 1)))
        crowd.side_m = np.where(crowd.kind == OPEN, 1.5 * side, side)
        crowd.width_m = np.minimum(rng.uniform(3, 16, (SCENES, 1)), crowd.side_m)
        stands, rides, joins = (np.maximum(rng.uniform(-0.5 * most, most, (SCENES, 1)), 0) for most in (0.5, 0.5, 0.6))
        drawn = rng.random(shape)
        crowd.stands = drawn < stands
        crowd.pace = np.where(drawn > 1 - rides, rng.uniform(2.0, 6.0, shape), crowd.pace)
        follows, most = rng.random(shape) < joins, rng.integers(1, 5, shape)
        crowd.leader, place = np.tile(np.arange(PEOPLE), (SCENES, 1)), np.zeros(shape, int)
        for person in range(1, PEOPLE):
            is_member = follows[:, person] & (place[:, person - 1] < most[:, person])
            crowd.leader[:, person] = np.where(is_member, crowd.leader[:, person - 1], person)
            place[:, person] = np.where(is_member, place[:, person - 1] + 1, 0)
        aside = np.where(place % 2 == 1, 1, -1) * ((place + 1) // 2)  # left and right of the leader by turns
        crowd.offset = np.stack([aside * rng.uniform(0.5, 1.1, shape), -rng.uniform(-0.2, 0.5, shape) * place], -1)
        crowd.pace, crowd.stands = crowd.pace[scene, crowd.leader], crowd.stands[scene, crowd.leader]
        crowd.rest_s = np.where(crowd.stands, rng.exponential(60, shape), 0.0)[scene, crowd.leader]
        sits = rng.random(shape) < np.maximum(rng.uniform(-0.2, 0.4, (SCENES, 1)), 0)
        crowd.rest_s = np.where(sits, np.inf, crowd.rest_s)[scene, crowd.leader]
        crowd.gates = rng.uniform(0, 1, (SCENES, GATES, 2)) * crowd.side_m[..., None]
        edge = rng.integers(0, 4, (SCENES, GATES))
        for number in range(4):
            axis, end = divmod(number, 2)
            at = np.where(end, crowd.side_m + OUTSIDE_M / 2, -OUTSIDE_M / 2)
            crowd.gates[..., axis] = np.where(edge == number, at, crowd.gates[..., axis])
        crowd.gate, crowd.way = np.zeros(shape, int), np.zeros(shape, int)
        crowd._enter(np.ones(shape, bool))
        inside = rng.uniform(0, 1, (*shape, 2)) * crowd.side_m[..., None]
        lane = crowd.place
        crowd.place = np.where((crowd.kind == STREET)[..., None], np.stack([inside[..., 0], lane[..., 1]], -1), inside)
        along = (crowd.way < 2)[..., None] == np.array([True, False])
        crowd.place = np.where((crowd.kind == CROSSING)[..., None], np.where(along, inside, lane), crowd.place)
        crowd.place = crowd.place[scene, crowd.leader] + crowd.offset
        return crowd

    def _enter(self, which: np.ndarray) -> None:
        """Let other people come in, at a gate or at an end of a street, for those who have left."""
        rng, shape = self.rng, which.shape
        self.gate = np.where(which, rng.integers(0, GATES, shape), self.gate)
        way = rng.integers(0, 4, shape)  # to the east, to the west, to the north, to the south
        self.way = np.where(which, np.where(self.kind == STREET, way % 2, way), self.way)
        start = self.gates[np.arange(SCENES)[:, None], self.gate] + rng.uniform(-0.9, 0.9, (*shape, 2))
        across = (self.side_m + self.width_m * rng.uniform(-1, 1, shape)) / 2
        begin = np.where(self.way % 2 == 0, -OUTSIDE_M / 2, self.side_m + OUTSIDE_M / 2) * np.ones(shape)
        lane = np.where((self.way < 2)[..., None], np.stack([begin, across], -1), np.stack([across, begin], -1))
        start = np.where((self.kind == SQUARE)[..., None], start, lane)
        self.place = np.where(which[..., None], start, self.place)
        self.speed = np.where(which[..., None], 0.0, self.speed)
        self._new_goal(which, 3.0)

    def _new_goal(self, which: np.ndarray, spread: float) -> None:
        rng, shape = self.rng, which.shape
        super()._new_goal(which & (self.kind == OPEN), spread)
        other = (self.gate + rng.integers(1, GATES, shape)) % GATES
        gate = self.gates[np.arange(SCENES)[:, None], other]
        gate = gate + 4 * OUTSIDE_M * ((gate > self.side_m[..., None]) * 1.0 - (gate < 0))  # they walk on outside
        inner = rng.uniform(0.1, 0.9, (*shape, 2)) * self.side_m[..., None]
        gate = np.where((rng.random(shape) < 0.2)[..., None], inner, gate)
        ahead = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])[self.way]
        lane = self.place + ahead * (self.side_m + 40)[..., None] + rng.normal(0, 8, (*shape, 2)) * (ahead == 0)
        goal = np.where((self.kind == SQUARE)[..., None], gate, lane)
        self.goal = np.where((which & (self.kind != OPEN))[..., None], goal, self.goal)

    def step(self) -> None:
        super().step()
        scene = np.arange(SCENES)[:, None]
        low, high = self.place.min(axis=-1), self.place.max(axis=-1)
        is_out = (low < -OUTSIDE_M) | (high > self.side_m + OUTSIDE_M)
        before = self.place.copy()
        gone = is_out & (self.leader == np.arange(PEOPLE)) & (self.kind != OPEN)
        self._enter(gone)
        self.entered = gone[scene, self.leader]
        follows = self.entered & ~gone
        moved = (self.place - before)[scene, self.leader]
        self.place = np.where(follows[..., None], self.place + moved, self.place)


@cache
def scenes(seed: int, steps: int, count: int = SCENES) -> list[Rows]:
    """The true rows (step, person, x, y) of scenes, all shapes by turns; the same seed gives the same rows."""
    rng = np.random.default_rng([seed, 7])
    crowd = Crowd.begin(rng)
    for _ in range(60):
        crowd.step()
    fine = round(STEP_S / walks.FINE_S)
    path, entered, came = [], [], np.zeros(crowd.pace.shape, bool)
    for number in range(steps * fine):
        crowd.step()
        came |= crowd.entered
        if number % fine == 0:
            path.append(crowd.place)
            entered.append(came)
            came = np.zeros_like(came)
    places, new = np.stack(path, axis=2), np.stack(entered, axis=2)
    return [_seen(places[one], new[one], float(crowd.side_m[one, 0]), int(crowd.kind[one, 0])) for one in range(count)]


def _seen(places: np.ndarray, new: np.ndarray, side_m: float, kind: int) -> Rows:
    """Rows of people (M, T, 2) while they are in the picture; who comes in is another person."""
    margin = side_m / 6 if kind == OPEN else 0.0
    seen = ((places > margin) & (places < side_m - margin)).all(axis=-1)
    begins = seen & (new | ~np.pad(seen, ((0, 0), (1, 0)))[:, :-1])
    person = begins.ravel().cumsum().reshape(seen.shape)
    row, step = np.nonzero(seen)
    rows = np.column_stack([step, person[row, step], places[row, step]])
    lasts = np.bincount(rows[:, 1].astype(int)) >= SHORTEST
    rows = rows[lasts[rows[:, 1].astype(int)]]
    return rows[np.argsort(rows[:, 0], kind="stable")]


def faults(rng: np.random.Generator) -> Corruption:
    """Faults of a tracker, of any strength and in any company: each kind is there or not.

    False tracks that stand still for long are rarer than people who do, from whom little tells them.
    """

    def maybe(share: float, low: float, high: float) -> float:
        value = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        return value if rng.random() < share else 0.0

    longest = float(np.exp(rng.uniform(np.log(0.8), np.log(10.0))))
    merge_m = maybe(0.2, 0.5, 1.2)
    return Corruption(
        noise_m=float(np.exp(rng.uniform(np.log(0.01), np.log(0.4)))),
        noise_s=maybe(0.3, 0.4, 2.0),
        seen_s=float(np.exp(rng.uniform(np.log(1.8), np.log(30.0)))),
        hidden_s=(0.4, longest),
        standing=1.0 + maybe(0.3, 0.5, 2.0),
        new_id=float(rng.uniform(0.3, 1.0)),
        breaks_per_min=maybe(0.25, 1.0, 60.0),
        swap=maybe(0.6, 0.01, 0.15),
        merge_m=merge_m,
        merge_s=maybe(0.4, 2.0, 10.0) if merge_m else 0.0,
        doubles=maybe(0.2, 0.02, 0.15),
        flicker=maybe(0.8, 0.02, 0.15),
        clutter=maybe(0.08, 0.02, 0.2),
        lit=maybe(0.08, 0.02, 0.2),
        beside=maybe(0.2, 0.02, 0.15),
    )


def drawn(seed: int, steps: int) -> Iterator[tuple[Rows, Corruption]]:
    """The true rows of scenes, and the faults of each."""
    for number, rows in enumerate(scenes(seed, steps)):
        yield rows, faults(np.random.default_rng([seed, number, 1]))
