"""Offline re-tracking: a slow reference that uses nothing of the package.

A path is a dictionary of positions by step. The constants of the models stand here a second time: change them here, too,
when the package changes. Only the weights and biases that tools/fit_retrack.py fitted are read from their file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from importlib.resources import files
from itertools import combinations, pairwise
from math import exp, hypot, inf, log

import numpy as np

Point = tuple[float, float]
Path = dict[int, Point]

REACH_M_PER_S, NEAR_M, SPEED_M_PER_S = 2.5, 0.3, 0.15
FITTED = json.loads((files("mcaptrack") / "transforms/retrack/weights.json").read_text())
LINKS = FITTED["links"]["weights"]
LINK_NAMES = ("miss", "misfit to noise", "gap", "misfit or stay by gap", "turn", "stay and speed", "misfit and speed")
LINK_WEIGHTS = [LINKS[name] for name in LINK_NAMES]
GAPS_S, BY_GAP, GAP_LINKS = (0.9, 1.7, 3.3, 6.5, 13.0, 1e9), FITTED["links"]["usual by gap"], 5.0
LINK_BIAS, LINK_USUAL, LINK_LEAST = (FITTED["links"][name] for name in ("bias", "usual", "least"))
MEET_M, MARGIN, EXCHANGE_COST, LEAST_GAIN = 2.0, 10, 2.5, 1.0
DRIFTS = (0.05, 0.15, 0.4, 1.2)


@dataclass(frozen=True)
class Motion:
    """The motion model: noise of positions, spread and drift of velocities, and the seconds of a step."""

    noise_m: float
    speed_m_per_s: float
    drift: float
    drift_share: float
    step_s: float

    def start(self, at: Point) -> State:
        mean = np.stack([at, np.zeros(2)], axis=1)
        return State(mean, np.diag([self.noise_m**2, self.speed_m_per_s**2]))

    def ahead(self, state: State) -> tuple[State, np.ndarray]:
        """Predict the next step; also returns the transition matrix."""
        t = self.step_s
        move = np.array([[1, t], [0, 1]])
        power = (self.drift + self.drift_share * hypot(*state.mean[:, 1])) ** 2
        noise = power * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
        return State(state.mean @ move.T, move @ state.cov @ move.T + noise), move

    def filtered(self, path: Path) -> dict[int, State]:
        """The state at every step, from the positions up to this step."""
        out: dict[int, State] = {}
        for step in range(min(path), max(path) + 1):
            if not out:
                out[step] = self.start(path[step])
                continue
            state, _ = self.ahead(out[step - 1])
            if step in path:
                gain = state.cov[:, 0] / (state.cov[0, 0] + self.noise_m**2)
                off = np.array(path[step]) - state.mean[:, 0]
                state = State(state.mean + np.outer(off, gain), state.cov - np.outer(gain, state.cov[0]))
            out[step] = state
        return out

    def backwards(self, path: Path) -> dict[int, State]:
        """The state at every step, from the positions at this step and later."""
        turned = self.filtered({-step: at for step, at in path.items()})
        return {-step: State(state.mean * [1, -1], state.cov) for step, state in turned.items()}

    def smoothed(self, path: Path) -> dict[int, State]:
        """The state at every step, from all positions (Rauch, Tung, Striebel 1965)."""
        out = self.filtered(path)
        for step in range(max(path) - 1, min(path) - 1, -1):
            now, later = out[step], out[step + 1]
            ahead, move = self.ahead(now)
            gain = now.cov @ move.T @ np.linalg.inv(ahead.cov)
            mean = now.mean + (later.mean - ahead.mean) @ gain.T
            out[step] = State(mean, now.cov + gain @ (later.cov - ahead.cov) @ gain.T)
        return out


@dataclass(frozen=True)
class State:
    """``mean`` (2, 2): position and velocity, along x and along y; ``cov`` (2, 2), the same along both."""

    mean: np.ndarray
    cov: np.ndarray


def sigmoid(odds: float) -> float:
    return 1 / (1 + exp(-odds))


# Smoothing that follows the log.


def smoothed_in_log(motion: Motion, paths: dict[int, Path], is_noise_known: bool) -> dict[int, dict[int, State]]:
    """The state of each track at every step, with the noise of the log and the turns of each track."""
    levels = [replace(motion, noise_m=0.8 / 4**k, speed_m_per_s=20.0) for k in range(6)]
    fits = {name: [expected(level, path) for level in levels] for name, path in paths.items()}
    total = max(sum(len(path) - 1 for path in paths.values()), 1)
    alone = [max(sum(fit[k][0] for fit in fits.values()) / (2 * total), 1e-6) for k in range(6)]
    best = min(range(6), key=lambda k: total * log(alone[k]) + sum(fit[k][1] for fit in fits.values()))
    variance = max(motion.noise_m**2, 1e-6) if is_noise_known else alone[best]
    share = np.full(6, 1 / 6)
    for _ in range(30):
        likely = {}
        for name, fit in fits.items():
            score = [log(p) - square / (2 * variance) - spread for p, (square, spread) in zip(share, fit, strict=True)]
            weight = np.exp(np.array(score) - max(score))
            likely[name] = weight / weight.sum()
        share = sum(likely.values()) + 0.5
        share /= share.sum()
        if not is_noise_known:
            off = sum(likely[name][k] * fits[name][k][0] for name in fits for k in range(6))
            variance = max(off / (2 * (total + 30)), 1e-6)
    usual = motion.noise_m / max(usual_speed(motion, paths) / 1.4, 1.0) ** 2
    out = {}
    for name, path in paths.items():
        level_m = exp(sum(p * log(level.noise_m) for p, level in zip(likely[name], levels, strict=True)))
        out[name] = replace(levels[0], noise_m=max(level_m, min(usual, 2 * level_m))).smoothed(path)
    return out


def expected(motion: Motion, path: Path) -> tuple[float, float]:
    """How far off positions are where they are expected, squared and summed; and logarithms of what that should be.

    Both as multiples of the noise's variance, the first times that in m^2.
    """
    states, square, spread = motion.filtered(path), 0.0, 0.0
    for step in sorted(path)[1:]:
        state, _ = motion.ahead(states[step - 1])
        factor = state.cov[0, 0] / motion.noise_m**2 + 1
        square += ((np.array(path[step]) - state.mean[:, 0]) ** 2).sum() / factor
        spread += log(factor)
    return square, spread


def usual_speed(motion: Motion, paths: dict[int, Path]) -> float:
    """The root mean square of speeds over three steps."""
    pairs = [(path[step], path[step + 3]) for path in paths.values() for step in path if step + 3 in path]
    squares = [(hypot(b[0] - a[0], b[1] - a[1]) / (3 * motion.step_s)) ** 2 for a, b in pairs]
    return float(np.sqrt(np.mean(squares))) if squares else 0.0


# Links over gaps.


def link_spread(motion: Motion, before: State, after: State, gap_s: float) -> float:
    speed = max(hypot(*before.mean[:, 1]), hypot(*after.mean[:, 1]))
    variance = before.cov[0, 0] + after.cov[0, 0] + (before.cov[1, 1] + after.cov[1, 1]) * (gap_s / 2) ** 2
    return variance + (motion.drift + motion.drift_share * speed) ** 2 * gap_s**3 / 12


def link_features(motion: Motion, before: State, after: State, gap_s: float) -> list[float]:
    way = after.mean[:, 0] - before.mean[:, 0]
    left, came = before.mean[:, 1], after.mean[:, 1]
    miss = min(hypot(*(way - left * gap_s)), hypot(*(way - came * gap_s)))
    misfit, stay = hypot(*(way - (left + came) / 2 * gap_s)), hypot(*way)
    speed = max(hypot(*left), hypot(*came))
    variance = link_spread(motion, before, after, gap_s)
    return [
        log(miss + NEAR_M), log(1 + misfit**2 / (2 * variance)), gap_s,
        log(min(misfit, stay) + NEAR_M) * log(gap_s + 0.4), log(hypot(*(came - left)) + SPEED_M_PER_S),
        log(stay + NEAR_M) * log(speed + SPEED_M_PER_S), log(misfit + NEAR_M) * log(speed + SPEED_M_PER_S),
    ]  # fmt: skip


def gap_class(gap_s: float) -> int:
    """The class of a gap: the first one with a bound that isn't less."""
    return next(number for number, bound in enumerate(GAPS_S) if gap_s <= bound)


def usual_by_gap(made: dict[object, tuple[float, bool, float]]) -> list[float]:
    """By how much the log odds of links over gaps of each class are shifted: all links count as some of each class.

    Links have log odds, whether they don't count, and the seconds of their gap.
    """
    elsewhere = [(odds, gap_class(gap_s)) for odds, is_other, gap_s in made.values() if not is_other]
    all_of = usual([odds for odds, _ in elsewhere])
    out = []
    for one, often in enumerate(BY_GAP):
        here = [odds for odds, number in elsewhere if number == one]
        expected, shift = sigmoid(log(often / (1 - often)) + all_of), 0.0
        for _ in range(50):
            right = sum(sigmoid(odds + shift) for odds in here) + GAP_LINKS * expected
            share = right / (len(here) + GAP_LINKS)
            shift = log(share / (1 - share)) - log(often / (1 - often))
        out.append(shift)
    return out


def usual(made: list[float]) -> float:
    """By how much the log odds of links are shifted in this log."""
    shift = 0.0
    for _ in range(1000):
        share = (sum(sigmoid(odds + shift) for odds in made) + 0.3) / (len(made) + 3)
        shift = log(share / (1 - share)) - log(LINK_USUAL / (1 - LINK_USUAL))
    return shift


# Encounters: two people come near each other; were their track ids swapped?


@dataclass
class Survivor:
    """One hypothesis of swaps: a filter of the relative position of two people, as it would be without swaps."""

    mean: np.ndarray
    cov: np.ndarray
    score: float
    course: list[bool] = field(default_factory=list)

    def likelihood(self, at: np.ndarray, noise: float) -> float:
        """By Student's distribution in the plane with six degrees of freedom, but for a constant."""
        variance = self.cov[0, 0] + noise
        return -4 * log(1 + ((at - self.mean[:, 0]) ** 2).sum() / (6 * variance)) - log(variance)

    def after(self, at: np.ndarray | None, noise: float, score: float, exchanged: bool) -> Survivor:
        mean, cov = self.mean, self.cov
        if at is not None:
            gain = cov[:, 0] / (cov[0, 0] + noise)
            mean, cov = mean + np.outer(at - mean[:, 0], gain), cov - np.outer(gain, cov[0])
        return Survivor(mean, cov, score, [*self.course, exchanged])


def course_of(
    apart: list[np.ndarray | None], motion: Motion, drift: float, evidence: float = 0.0
) -> tuple[list[bool], float, float]:
    """The likeliest hypothesis of swaps (Viterbi), its gain over no swap, and its log likelihood.

    ``evidence`` is a log likelihood ratio that both are swapped in the end.
    """
    t, noise = motion.step_s, 2 * motion.noise_m**2
    move = np.array([[1, t], [0, 1]])
    wander = drift**2 * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
    cov = np.diag([noise, 2 * motion.speed_m_per_s**2])
    kept, crossed, never = (Survivor(np.zeros((2, 2)), cov, score) for score in (0.0, -inf, 0.0))
    started = False
    for step, at in enumerate(apart):
        for one in (kept, crossed, never):
            if step:
                one.mean, one.cov = one.mean @ move.T, move @ one.cov @ move.T + wander
            if at is not None and not started:
                side = -1 if one is crossed else 1
                one.mean = np.stack([side * at, np.zeros(2)], axis=1)
        if at is None or not started:
            new = [(one, None, one.score, one is crossed) for one in (kept, crossed, never)]
        else:
            new = [
                max(
                    (
                        (one, at, one.score + one.likelihood(at, noise) - fee, False)
                        for one, fee in ((kept, 0.0), (crossed, EXCHANGE_COST))
                    ),
                    key=lambda each: each[2],
                ),
                max(
                    (
                        (one, -at, one.score + one.likelihood(-at, noise) - fee, True)
                        for one, fee in ((crossed, 0.0), (kept, EXCHANGE_COST))
                    ),
                    key=lambda each: each[2],
                ),
                (never, at, never.score + never.likelihood(at, noise), False),
            ]
        kept, crossed, never = (one.after(where, noise, score, side) for one, where, score, side in new)
        started |= at is not None
    crossed.score += evidence
    best = crossed if crossed.score > kept.score else kept
    return best.course, best.score - never.score, best.score


def encounters(paths: dict[int, Path]) -> list[tuple[int, int, int, int, int, int]]:
    """Pairs of tracks that come near each other, with the first and last step of the encounter, and those between which
    they are near.
    """
    out = []
    for a, b in combinations(sorted(paths), 2):
        one, other = paths[a], paths[b]
        near = [
            s for s in sorted(one) if s in other and hypot(one[s][0] - other[s][0], one[s][1] - other[s][1]) < MEET_M
        ]
        groups: list[list[int]] = []
        for step in near:
            if groups and step - groups[-1][-1] <= 2 * MARGIN:
                groups[-1].append(step)
            else:
                groups.append([step])
        first, last = max(min(one), min(other)), min(max(one), max(other))
        for group in groups:
            met, parted = group[0], group[-1]
            out.append((a, b, max(met - MARGIN, first), min(parted + MARGIN, last), met, parted))
    return out


def exchanged(motion: Motion, paths: dict[int, Path]) -> tuple[dict[int, dict[int, int]], int]:
    """For each track the one to which each step belongs after identity swaps, and how many encounters were changed."""
    decided = []
    for a, b, low, high, *_ in encounters(paths):
        steps = range(low, high + 1)
        apart = [np.subtract(paths[a][s], paths[b][s]) if s in paths[a] and s in paths[b] else None for s in steps]
        course, gain, _ = max((course_of(apart, motion, d) for d in DRIFTS), key=lambda each: each[2])
        if gain >= LEAST_GAIN:
            decided.append((gain, a, b, low, high, course))

    def meet(one: tuple, other: tuple) -> bool:
        return bool({*one[1:3]} & {*other[1:3]}) and one[3] <= other[4] and other[3] <= one[4]

    best: list[tuple] = []
    for one in sorted(decided, key=lambda each: -each[0]):
        best += [] if any(meet(one, other) for other in best) else [one]
    toggled: dict[int, list[tuple[int, int]]] = {}
    for _, a, b, low, _, course in best:
        for step, (was, now) in enumerate(pairwise([False, *course]), low):
            if was != now:
                toggled.setdefault(step, []).append((a, b))
    owner: dict[int, dict[int, int]] = {track: {} for track in paths}
    goes_on = {track: track for track in paths}
    for step in sorted({step for path in paths.values() for step in path} | set(toggled)):
        for a, b in toggled.get(step, ()):
            goes_on[a], goes_on[b] = goes_on[b], goes_on[a]
        for track, path in paths.items():
            if step in path:
                owner[track][step] = goes_on[track]
    return owner, len(best)
