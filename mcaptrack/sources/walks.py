"""Synthetic walks: simulated crowds to train predictors on without recordings.

People walk towards goals at their own preferred speed; they wander a little, choose new goals, stop and continue,
stand, walk in groups, and avoid each other. Parameters are general knowledge about pedestrians (speeds of 1.3 m/s with
a standard deviation of 0.26, Weidmann 1993; a repulsion that decreases with distance, Helbing and Molnar 1995), not
fitted to any recording.

Letters: S scenes, M people in each, T steps, W walks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Floats

#: Time step of the simulation, and how long it runs before walks are recorded, in seconds.
FINE_S: Final = 0.2
_SETTLE_S: Final = 8.0
SCENES, PEOPLE = 48, 24
WALKS_EACH: Final = 5
#: Share of scenes with up to seven times as frequent changes of direction.
_RESTLESS: Final = 0.1
#: Shares of people who mostly stand, stroll, walk, and run or ride.
_PACES: Final = (0.24, 0.12, 0.61, 0.03)


@dataclass
class Crowd:
    """The state of S scenes with M people each."""

    rng: np.random.Generator
    side_m: Floats  # (S, 1) side of the square of each scene
    restless: Floats  # (S, 1) factor of changes of goal and of wandering
    place: Floats  # (S, M, 2)
    speed: Floats  # (S, M, 2) velocity
    goal: Floats  # (S, M, 2)
    pace: Floats  # (S, M) preferred speed, m/s
    stands: Bools  # (S, M) whether a person mostly stands
    rest_s: Floats  # (S, M) remaining time of a stop
    haste: Floats  # (S, M) current share of the preferred speed, fluctuating around 1
    veer: Floats  # (S, M) angle off the direction of the goal in radians, fluctuating around 0
    leader: NDArray[np.int64]  # (S, M) leader of the group; the person itself if alone
    offset: Floats  # (S, M, 2) place in the group, metres sideways and back

    @classmethod
    def start(cls, rng: np.random.Generator) -> Crowd:
        """Place people in scenes, with their paces, goals and groups."""
        shape = (SCENES, PEOPLE)
        side = np.exp(rng.uniform(np.log(30), np.log(150), (SCENES, 1)))
        kind = rng.choice(4, shape, p=_PACES)
        pace = np.select(
            [kind == 1, kind == 3],
            [rng.uniform(0.3, 0.9, shape), rng.uniform(2.0, 4.5, shape)],
            np.clip(rng.normal(1.3, 0.26, shape), 0.6, 2.2),
        )
        place = rng.uniform(0, 1, (*shape, 2)) * side[..., None]
        leader = np.tile(np.arange(PEOPLE), (SCENES, 1))
        offset = np.zeros((*shape, 2))
        # A quarter joins the person before, with its speed, beside or a little behind.
        joins = (rng.random(shape) < 0.25) & (np.arange(PEOPLE) > 0)
        for person in range(1, PEOPLE):
            ahead = leader[:, person - 1]
            leader[:, person] = np.where(joins[:, person], ahead, person)
        offset[joins] = np.stack(
            [
                rng.choice([-1, 1], joins.sum()) * rng.uniform(0.5, 1.0, joins.sum()),
                rng.uniform(-0.6, 0.3, joins.sum()),
            ],
            -1,
        )
        scene = np.arange(SCENES)[:, None]
        place = np.where(joins[..., None], place[scene, leader] + offset, place)
        crowd = cls(
            rng=rng,
            side_m=side,
            restless=np.exp(
                rng.choice([0.0, 1.0], (SCENES, 1), p=(1 - _RESTLESS, _RESTLESS)) * rng.uniform(0, 2, (SCENES, 1))
            ),
            place=place,
            speed=np.zeros((*shape, 2)),
            goal=rng.uniform(0, 1, (*shape, 2)) * side[..., None],
            pace=pace[scene, leader],
            stands=(kind == 0)[scene, leader],
            rest_s=np.zeros(shape),
            haste=rng.normal(1, 0.08, shape),
            veer=rng.normal(0, 0.12, shape),
            leader=leader,
            offset=offset,
        )
        crowd.rest_s = np.where(crowd.stands, rng.exponential(60, shape), 0.0)
        return crowd

    def step(self) -> None:
        """Advance by ``FINE_S``."""
        rng, dt = self.rng, FINE_S
        scene = np.arange(SCENES)[:, None]
        shape = self.pace.shape
        self.haste += dt / 3 * (1 - self.haste) + 0.08 * np.sqrt(2 * dt / 3) * rng.normal(size=shape)
        veer = 0.12 * np.sqrt(self.restless)
        self.veer += -dt / 2 * self.veer + veer * np.sqrt(dt) * rng.normal(size=shape)
        self._rest(dt)
        self._turn()
        way = self.goal - self.place
        away = np.hypot(way[..., 0], way[..., 1])
        cos, sin = np.cos(self.veer), np.sin(self.veer)
        way = np.stack([cos * way[..., 0] - sin * way[..., 1], sin * way[..., 0] + cos * way[..., 1]], -1)
        going = (self.rest_s <= 0) * self.pace * self.haste
        wish = way / np.maximum(away, 0.1)[..., None] * going[..., None]
        # Members of a group keep their place beside the leader.
        follows = self.leader != np.arange(PEOPLE)
        first, along = self.place[scene, self.leader], self.speed[scene, self.leader]
        pace = np.hypot(along[..., 0], along[..., 1])
        ahead = along / np.maximum(pace, 0.2)[..., None]
        aside = np.stack([-ahead[..., 1], ahead[..., 0]], -1)
        spot = first + self.offset[..., :1] * aside + self.offset[..., 1:] * ahead
        off = np.where((pace > 0.2)[..., None], spot - self.place, 0.0)
        off /= np.maximum(np.hypot(off[..., 0], off[..., 1]), 1.0)[..., None]
        wish = np.where(follows[..., None], along + 0.5 * off, wish)
        fidget = np.where(going > 0, 0.12, 0.06)[..., None] * rng.normal(size=(*shape, 2)) / np.sqrt(dt)
        push = (wish - self.speed) / 0.55 + self._repulsion() + 0.6 * fidget
        self.speed = self.speed + dt * push
        self.place = self.place + dt * self.speed

    def _rest(self, dt: float) -> None:
        """Stop at random times, for seconds or longer, and continue, often in another direction."""
        rng, shape = self.rng, self.rest_s.shape
        ends = (self.rest_s > 0) & (self.rest_s <= dt)
        self.rest_s = np.maximum(self.rest_s - dt, 0.0)
        stops = (self.rest_s == 0) & ~ends & (rng.random(shape) < dt / np.where(self.stands, 8.0, 250.0))
        pause = np.where(self.stands, rng.exponential(45, shape), 4 * np.exp(rng.normal(0, 0.9, shape)))
        self.rest_s = np.where(stops, pause, self.rest_s)
        self._new_goal(ends & (rng.random(shape) < 0.5), spread=1.2)

    def _turn(self) -> None:
        """Choose a new goal, mostly ahead, after reaching one and at random times."""
        away = np.hypot(*np.moveaxis(self.goal - self.place, -1, 0))
        shape = away.shape
        self._new_goal((away < 1.0) | (self.rng.random(shape) < self.restless * FINE_S / 140), spread=0.35)

    def _new_goal(self, which: Bools, spread: float) -> None:
        rng, shape = self.rng, which.shape
        heading = np.arctan2(self.speed[..., 1], self.speed[..., 0])
        heading = heading + spread * rng.standard_t(3, shape) / 1.7
        far = np.exp(rng.uniform(np.log(12), np.log(100), shape)) / self.restless * np.maximum(self.pace / 1.3, 1.0)
        goal = self.place + far[..., None] * np.stack([np.cos(heading), np.sin(heading)], -1)
        outside = ((goal < 0) | (goal > self.side_m[..., None])).any(-1)
        goal = np.where(outside[..., None], rng.uniform(0, 1, (*shape, 2)) * self.side_m[..., None], goal)
        self.goal = np.where(which[..., None], goal, self.goal)

    def _repulsion(self) -> Floats:
        """Accelerations away from people who are near, stronger from those ahead than from those behind."""
        east, north = (self.place[:, :, None, axis] - self.place[:, None, :, axis] for axis in (0, 1))
        near = np.sqrt(east**2 + north**2) + 1e-6
        strength = np.minimum(2.0 * np.exp((0.5 - near) / 0.35), 3.0)
        strength[:, np.arange(PEOPLE), np.arange(PEOPLE)] = 0
        strength *= np.where(self.leader[:, :, None] == self.leader[:, None], 0.3, 1.0)
        ahead = self.speed / np.maximum(np.hypot(self.speed[..., 0], self.speed[..., 1]), 0.3)[..., None]
        facing = -(east * ahead[:, :, None, 0] + north * ahead[:, :, None, 1]) / near
        strength *= (0.4 + 0.3 * (1 + facing)) / near
        return np.stack([np.einsum("smn,smn->sm", strength, off) for off in (east, north)], axis=-1)


def walks(count: int, steps: int, step_s: float, seed: int) -> tuple[Floats, NDArray[np.int64]]:
    """Walks (W, T, 2) of ``steps`` positions in metres, every ``step_s`` seconds, and the scene (W,) of each.

    The same seed gives the same walks.
    """
    rng = np.random.default_rng(seed)
    every = step_s / FINE_S
    out: list[Floats] = []
    count_done = 0
    while count_done < count:
        crowd = Crowd.start(rng)
        for _ in range(round(_SETTLE_S / FINE_S)):
            crowd.step()
        # Several consecutive walks of each person.
        path = []
        for _ in range(int(np.ceil(WALKS_EACH * steps * every)) + 2):
            path.append(crowd.place)
            crowd.step()
        places = np.stack(path, axis=2).reshape(SCENES * PEOPLE, -1, 2)
        at = np.arange(WALKS_EACH * steps) * every
        low = at.astype(int)
        share = (at - low)[:, None]
        sampled = (1 - share) * places[:, low] + share * places[:, low + 1]
        out.append(sampled.reshape(-1, steps, 2))
        count_done += len(out[-1])
    scene = np.arange(len(out) * SCENES).repeat(PEOPLE * WALKS_EACH)
    return np.concatenate(out)[:count], scene[:count]
