"""Identities over a whole log: a slow reference of one sweep, from the description in docs/method.md. See ``offline``.

A claim says that a track has a sample: its step, the track, the online track, the input id and the position.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from math import exp, hypot, log

import numpy as np

from tests.references.offline import (
    FITTED,
    LINK_BIAS,
    LINK_LEAST,
    LINK_WEIGHTS,
    REACH_M_PER_S,
    Motion,
    Path,
    Point,
    State,
    link_features,
    link_spread,
)

CHOICES = FITTED["choices"]
GAPS = ("next step", "up to 1.7 s", "up to 5 s", "longer")
ENOUGH, USUAL, BESIDE_M, ALONE, ALONE_M_PER_S = 1 / 5, 20, 2.0, 8.0, 1.1


@dataclass(frozen=True)
class Claim:
    step: int
    track: int
    online: int
    source: int
    at: Point


@dataclass
class Scene:
    """The tracklets of claims, by their first steps, and the states of each track and of each tracklet alone."""

    motion: Motion
    claims: list[Claim]

    def __post_init__(self) -> None:
        self.tracks: dict[int, list[Claim]] = {}
        for claim in sorted(self.claims, key=lambda c: (c.track, c.step)):
            self.tracks.setdefault(claim.track, []).append(claim)
        parts = [
            list(part)
            for track in self.tracks.values()
            for _, part in groupby(track, key=lambda c: (c.online, c.source))
        ]
        self.tracklets = sorted(parts, key=lambda part: (part[0].step, part[0].track, part[0].source))
        self.ahead = {name: self.motion.filtered(path_of(track)) for name, track in self.tracks.items()}
        self.back = {name: self.motion.backwards(path_of(track)) for name, track in self.tracks.items()}

    def sides(self, a: list[Claim], b: list[Claim]) -> tuple[tuple[State, State], tuple[State, State]]:
        """The states at the end of ``a`` and at the beginning of ``b``: of their tracks, and of them alone."""
        end, begin = a[-1].step, b[0].step
        alone = self.motion.filtered(path_of(a))[end], self.motion.backwards(path_of(b))[begin]
        return (self.ahead[a[0].track][end], self.back[b[0].track][begin]), alone

    def beside(self, claim: Claim) -> dict[int, float]:
        """How near other tracks are, from 0 to 1, also while they are missed."""
        out = {}
        for name, states in self.ahead.items():
            if name != claim.track and claim.step in states:
                x, y = states[claim.step].mean[:, 0]
                near = 1 - hypot(x - claim.at[0], y - claim.at[1]) / BESIDE_M
                if near > 0:
                    out[name] = near
        return out

    def follows(self, a: list[Claim], b: list[Claim]) -> bool:
        """Whether ``b`` comes next in the track of ``a``."""
        track = self.tracks[a[0].track]
        at = track.index(a[-1]) + 1
        return at < len(track) and track[at] is b[0]

    def link(self, a: list[Claim], b: list[Claim], max_gap_s: float) -> dict[str, float] | None:
        """The terms of a link, or None if it is no candidate."""
        gap = b[0].step - a[-1].step
        gap_s = gap * self.motion.step_s
        if gap <= 0:
            return None
        (before, after), alone = self.sides(a, b)
        plain = link_features(self.motion, before, after, gap_s)
        apart = hypot(*(before.mean[:, 0] - after.mean[:, 0]))
        near = gap <= round(max_gap_s / self.motion.step_s) and apart <= 1 + REACH_M_PER_S * gap_s
        likely = np.dot(LINK_WEIGHTS, plain) + LINK_BIAS > LINK_LEAST
        if not (self.follows(a, b) or (near and likely)):
            return None
        way, left, came = after.mean[:, 0] - before.mean[:, 0], before.mean[:, 1], after.mean[:, 1]
        misfit, stay = hypot(*(way - (left + came) / 2 * gap_s)), hypot(*way)
        own = link_features(self.motion, *alone, gap_s)
        ends, begins = self.beside(a[-1]), self.beside(b[0])
        before_track, after_track = self.tracks[a[0].track], self.tracks[b[0].track]
        samples = len(self.claims)
        return {
            "link": 1.0,
            "miss": plain[0],
            "misfit to noise": plain[1],
            "misfit": log(misfit + 0.2),
            "misfit or stay": log(min(misfit, stay) + 0.3),
            "turn": plain[4],
            "stay and speed": plain[5],
            "misfit and speed": plain[6],
            "speed": log(max(hypot(*left), hypot(*came)) + 0.15),
            "noise": log(link_spread(self.motion, before, after, gap_s)),
            "miss alone": own[0],
            "misfit to noise alone": own[1],
            "gap": gap_s,
            "log gap": log(gap_s + 0.2),
            "same input id": a[0].source == b[0].source,
            "same track": a[0].online == b[0].online,
            "beside one track": max((min(ends[name], begins[name]) for name in ends if name in begins), default=0.0),
            "samples before": log(len(a)),
            "samples after": log(len(b)),
            "track before": log(sum(claim.step <= a[-1].step for claim in before_track)),
            "track after": log(sum(claim.step >= b[0].step for claim in after_track)),
            "rate of input ids": log((len(self.tracklets) + 1) / (samples + 50)),
            "rate of tracks": log((len({claim.online for claim in self.claims}) + 1) / (samples + 50)),
        }

    def is_alone(self, a: list[Claim], b: list[Claim]) -> bool:
        """Whether a link is to the next step of one online track, nearby, with no other track beside."""
        end, begin = a[-1], b[0]
        apart = hypot(begin.at[0] - end.at[0], begin.at[1] - end.at[1])
        near = begin.step - end.step == 1 and apart < ALONE_M_PER_S * self.motion.step_s
        return near and begin.online == end.online and not self.beside(end) and not self.beside(begin)

    def end(self, part: list[Claim], leaves: bool) -> dict[str, float]:
        """The terms of leaving at the end of a tracklet, or of coming at its beginning."""
        claim = part[-1] if leaves else part[0]
        state = (self.ahead if leaves else self.back)[claim.track][claim.step]
        places = np.array([other.at for other in self.claims])
        low, high = np.percentile(places, [1, 99], axis=0)
        inside = min(min(claim.at[k] - low[k], high[k] - claim.at[k]) for k in (0, 1))
        steps = [other.step for other in self.claims]
        left_s = (max(steps) - claim.step if leaves else claim.step - min(steps)) * self.motion.step_s
        return {
            "end": 1.0,
            "beside a track": max(self.beside(claim).values(), default=0.0),
            "border": log(max(inside, 0.0) + 0.5),
            "speed": log(hypot(*state.mean[:, 1]) + 0.1),
            "last second": left_s < 1,
            "log left": log(left_s + 1),
            "long left": left_s > 20,
            "samples": log(len(part)),
            "single": len(part) == 1,
            "few": len(part) < 4,
        }


def path_of(claims: list[Claim]) -> Path:
    return {claim.step: claim.at for claim in claims}


def total(weights: dict[str, float], terms: dict[str, float]) -> float:
    return sum(weights[name] * value for name, value in terms.items())


def gains_of(scene: Scene, max_gap_s: float, least: float) -> dict[tuple[int, int], float]:
    """How much each candidate link gains over leaving at its end and coming at its beginning."""
    motion, parts = scene.motion, scene.tracklets
    candidates = {(i, j): scene.link(a, b, max_gap_s) for i, a in enumerate(parts) for j, b in enumerate(parts)}
    gap, link = {}, {}
    for (i, j), terms in candidates.items():
        if terms is not None:
            bounds = np.maximum.accumulate([1.5 * motion.step_s, 1.7, 5.0])
            gap[i, j] = GAPS[int(np.searchsorted(bounds, terms["gap"]))]
            link[i, j] = total(CHOICES["links"][gap[i, j]], terms) + ALONE * scene.is_alone(parts[i], parts[j])
    gains = dict.fromkeys(link, -log(least / (1 - least) * ENOUGH))
    for side, name in enumerate(("leaves", "comes")):
        none = [total(CHOICES[name], scene.end(part, name == "leaves")) for part in parts]
        shift = shifts(side, link, none, gap, CHOICES[f"usual_{name}"])
        for pair, score in link.items():
            gains[pair] += (score + shift[gap[pair]] - none[pair[side]] - shift["none"]) / 2
    return gains


def swept(motion: Motion, claims: list[Claim], max_gap_s: float, least: float) -> list[int]:
    """The track of each claim after one sweep."""
    from scipy.optimize import linear_sum_assignment

    scene = Scene(motion, claims)
    parts = scene.tracklets
    gains = np.zeros((len(parts), len(parts)))
    for pair, gain in gains_of(scene, max_gap_s, least).items():
        gains[pair] = max(gain, 0.0)
    root = list(range(len(parts)))
    for i, j in zip(*linear_sum_assignment(-gains), strict=True):
        if gains[i, j] > 0:
            root[j] = i
    names: dict[int, int] = {}
    following = max((claim.online for claim in claims), default=0)
    for i in range(len(parts)):  # a continuation stands behind what it continues
        root[i] = root[root[i]]
        if root[i] == i:
            own = parts[i][0].online
            following += own in names.values()
            names[i] = following if own in names.values() else own
    return [names[root[next(i for i, part in enumerate(parts) if claim in part)]] for claim in claims]


def shifts(side: int, link: dict, none: list[float], gap: dict, usual: dict[str, float]) -> dict[str, float]:
    """The shifts of scores in this log: what ends choose on average, beside what is usual."""
    shift = dict.fromkeys(usual, 0.0)
    for _ in range(30):
        chosen = dict.fromkeys(usual, 0.0)
        for i, score in enumerate(none):
            odds = {pair: exp(link[pair] + shift[gap[pair]]) for pair in link if pair[side] == i}
            whole = exp(score + shift["none"]) + sum(odds.values())
            chosen["none"] += exp(score + shift["none"]) / whole
            for pair, value in odds.items():
                chosen[gap[pair]] += value / whole
        share = {name: (chosen[name] + USUAL * usual[name]) / (len(none) + USUAL) for name in usual}
        before, shift = shift, {name: log(share[name] / usual[name]) for name in usual}
        if max(abs(shift[name] - before[name]) for name in usual) < 1e-3:
            break
    return shift
