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
LINK_NAMES = ("miss", "misfit", "gap", "misfit or stay", "turn", "distance and speed", "misfit and speed")
LINK_WEIGHTS = [LINKS[name] for name in LINK_NAMES]
LINK_BIAS, LINK_USUAL, LINK_LEAST = (FITTED["links"][name] for name in ("bias", "usual", "least"))
CUTS, CUT_BIAS = FITTED["cuts"]["weights"], FITTED["cuts"]["bias"]
JOIN_NAMES = (*LINK_NAMES, "margin", "alternative", "taken over", "given away", "log before", "log after")
JOIN_NAMES = (*JOIN_NAMES, "log rate", "log elsewhere")
JOIN_MARGIN, JOIN_BRIEF_S, JOIN_QUESTIONED, JOIN_RATE_SAMPLES = 12.0, 1.0, 0.7, 50
Cut = tuple[int, int, float]  # the ids of both pieces, and the probability that they belong together
MEET_M, MARGIN, EXCHANGE_COST, SAME_ID, LEAST_COST, LEAST_GAIN = 2.0, 10, 2.0, 1.0, 1.0, 1.0
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


def links(motion: Motion, paths: dict[int, Path], max_gap_s: float, least: float) -> dict[int, int]:
    """For each linked track the track that continues it."""
    from scipy.optimize import linear_sum_assignment

    names = sorted(paths)
    ends = {name: motion.filtered(paths[name])[max(paths[name])] for name in names}
    begins = {name: motion.backwards(paths[name])[min(paths[name])] for name in names}
    gains = np.zeros((len(names), len(names)))
    for a, b in ((a, b) for a in names for b in names):
        gap = min(paths[b]) - max(paths[a])
        gap_s = gap * motion.step_s
        apart = hypot(*(ends[a].mean[:, 0] - begins[b].mean[:, 0]))
        if 0 < gap <= round(max_gap_s / motion.step_s) and apart <= 1 + REACH_M_PER_S * gap_s:
            odds = np.dot(LINK_WEIGHTS, link_features(motion, ends[a], begins[b], gap_s)) + LINK_BIAS
            gains[names.index(a), names.index(b)] = max(odds - LINK_LEAST, 0)
    made = {
        (i, j): gains[i, j] + LINK_LEAST for i, j in zip(*linear_sum_assignment(-gains), strict=True) if gains[i, j]
    }
    shift = 0.0
    for _ in range(1000):  # the share of right links in this log
        share = (sum(sigmoid(odds + shift) for odds in made.values()) + 0.3) / (len(made) + 3)
        shift = log(share / (1 - share)) - log(LINK_USUAL / (1 - LINK_USUAL))
    return {names[i]: names[j] for (i, j), odds in made.items() if sigmoid(odds + shift) > least}


# Joins: a track goes on with another input track. Is it the same person?


def joins(motion: Motion, paths: dict[int, Path], ids: dict[int, dict[int, int]]) -> list[tuple[int, int, list[float]]]:
    """Each join as its track, the first step of the new input id, and its features; by track and step."""
    ahead = {name: motion.filtered(path) for name, path in paths.items()}
    back = {name: motion.backwards(path) for name, path in paths.items()}
    held: dict[int, list[tuple[int, int]]] = {}  # steps and tracks of each input id
    for name in sorted(paths):
        for step in sorted(paths[name]):
            held.setdefault(ids[name][step], []).append((step, name))
    for places in held.values():
        places.sort()

    def fit(a: tuple[int, int], b: tuple[int, int]) -> float:
        """Student's distribution with two degrees of freedom."""
        before, after, gap_s = ahead[a[0]][a[1]], back[b[0]][b[1]], (b[1] - a[1]) * motion.step_s
        misfit = link_features(motion, before, after, gap_s)[1]
        return -2 * misfit - log(link_spread(motion, before, after, gap_s))

    out = []
    for name in sorted(paths):
        for before, after, counts in source_changes(ids[name], JOIN_BRIEF_S / motion.step_s):
            gap_s = (after - before) * motion.step_s
            margin, own = JOIN_MARGIN, fit((name, before), (name, after))
            for other in sorted(paths):
                if other == name or after not in paths[other]:
                    continue
                reach = hypot(*(back[other][after].mean[:, 0] - ahead[name][before].mean[:, 0]))
                if reach > 1 + REACH_M_PER_S * gap_s:
                    continue
                value = own - fit((name, before), (other, after))
                earlier = [step for step in paths[other] if step < after]
                if earlier:
                    theirs = other, max(earlier)
                    value += fit(theirs, (other, after)) - fit(theirs, (name, after))
                margin = min(margin, value)
            had, has = held[ids[name][after]], held[ids[name][before]]
            at, since = had.index((after, name)), has.index((before, name)) + 1
            features = link_features(motion, ahead[name][before], back[name][after], gap_s)
            features += [max(margin, -JOIN_MARGIN), float(margin < JOIN_MARGIN)]
            features += [float(at > 0 and had[at - 1][1] != name), float(since < len(has) and has[since][1] != name)]
            out.append((name, after, [*features, log(counts[0]), log(counts[1])]))
    samples = sum(len(path) for path in paths.values())
    elsewhere = sum(sum(features[9:11]) for *_, features in out)
    for *_, features in out:
        features += [log((len(out) + 1) / (samples + JOIN_RATE_SAMPLES)), log((elsewhere + 0.5) / (len(out) + 1))]
    return out


def source_changes(ids: dict[int, int], brief: float) -> list[tuple[int, int, tuple[int, int]]]:
    """The steps before and after each change of the input id, and the numbers of samples of both; without brief ones."""
    runs: list[list[int]] = []
    for step in sorted(ids):
        if runs and ids[runs[-1][-1]] == ids[step]:
            runs[-1].append(step)
        else:
            runs.append([step])
    long: list[list[int]] = []
    for number, run in enumerate(runs):
        inner = 0 < number < len(runs) - 1
        is_between = inner and ids[runs[number - 1][0]] == ids[runs[number + 1][0]]
        is_brief = is_between and runs[number + 1][0] - run[0] < brief
        if long and (is_brief or ids[long[-1][0]] == ids[run[0]]):
            long[-1] += run
        else:
            long.append(list(run))
    return [(a[-1], b[0], (len(a), len(b))) for a, b in pairwise(long)]


def cut(
    motion: Motion, paths: dict[int, Path], ids: dict[int, dict[int, int]], least: float
) -> tuple[dict[int, dict[int, int]], list[Cut]]:
    """The track of each step after tracks are cut at joins that are less likely to be right; and the cuts."""
    following, cuts = max(paths, default=0), {}
    for name, step, features in joins(motion, paths, ids):
        odds = sum(CUTS[one] * value for one, value in zip(JOIN_NAMES, features, strict=True)) + CUT_BIAS
        if sigmoid(odds) < max(JOIN_QUESTIONED, least):
            following += 1
            cuts[name, step] = following, sigmoid(odds)
    out: dict[int, dict[int, int]] = {}
    pieces = []
    for name, path in paths.items():
        now = name
        for step in sorted(path):
            if (name, step) in cuts:
                piece, likely = cuts[name, step]
                pieces.append((now, piece, likely))
                now = piece
            out.setdefault(name, {})[step] = now
    return out, sorted(pieces, key=lambda one: one[1])


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
    apart: list[np.ndarray | None], cost: list[float], motion: Motion, drift: float, evidence: float = 0.0
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
                        for one, fee in ((kept, 0.0), (crossed, cost[step]))
                    ),
                    key=lambda each: each[2],
                ),
                max(
                    (
                        (one, -at, one.score + one.likelihood(-at, noise) - fee, True)
                        for one, fee in ((crossed, 0.0), (kept, cost[step]))
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


def exchange_costs(a: dict[int, int], b: dict[int, int], low: int, high: int) -> list[float]:
    """The cost of a swap at each step, by the input ids of the two tracks."""
    costs, last_a, last_b = [], None, None
    for step in range(low, high + 1):
        now_a, now_b = a.get(step), b.get(step)
        same = (now_a is not None and now_a == last_a) + (now_b is not None and now_b == last_b)
        crossed = (now_a is not None and now_a == last_b) + (now_b is not None and now_b == last_a)
        costs.append(max(EXCHANGE_COST + SAME_ID * (same - crossed), LEAST_COST))
        last_a, last_b = last_a if now_a is None else now_a, last_b if now_b is None else now_b
    return costs


def pace(motion: Motion, path: Path, steps: range) -> tuple[float, float] | None:
    """The mean speed between the first and last position in these steps, and its variance; None for less than 1.2 s."""
    seen = [step for step in steps if step in path]
    seconds = (seen[-1] - seen[0]) * motion.step_s if seen else 0.0
    if seconds < 1.2 - 1e-9:
        return None
    (x0, y0), (x1, y1) = path[seen[0]], path[seen[-1]]
    return hypot(x1 - x0, y1 - y0) / seconds, 2 * motion.noise_m**2 / seconds**2


def by_pace(motion: Motion, a: Path, b: Path, met: int, parted: int) -> float:
    """The log likelihood ratio that two who came at their paces went on at each other's, at most 3."""
    span = round(8 / motion.step_s)
    before, after = range(met - span, met + 1), range(parted, parted + span + 1)
    paces = [pace(motion, path, steps) for steps in (before, after) for path in (a, b)]
    if None in paces:
        return 0.0
    (a0, b0, a1, b1), spread = zip(*paces, strict=True)
    variance = 0.4**2 + sum(spread) / 2

    def log_likelihood(*changes: float) -> float:
        return sum(-(change**2) / (2 * variance) for change in changes)

    return min(max(log_likelihood(b1 - a0, a1 - b0) - log_likelihood(a1 - a0, b1 - b0), -3.0), 3.0)


def exchanged(
    motion: Motion, paths: dict[int, Path], ids: dict[int, dict[int, int]]
) -> tuple[dict[int, dict[int, int]], int]:
    """For each track the one to which each step belongs after identity swaps, and how many encounters were changed."""
    decided = []
    for a, b, low, high, met, parted in encounters(paths):
        steps = range(low, high + 1)
        apart = [np.subtract(paths[a][s], paths[b][s]) if s in paths[a] and s in paths[b] else None for s in steps]
        costs = exchange_costs(ids[a], ids[b], low, high)
        paces = by_pace(motion, paths[a], paths[b], met, parted)
        course, gain, _ = max((course_of(apart, costs, motion, d, paces) for d in DRIFTS), key=lambda each: each[2])
        if gain >= LEAST_GAIN:
            decided.append((gain, a, b, low, high, course))

    def meet(one: tuple, other: tuple) -> bool:
        return bool({*one[1:3]} & {*other[1:3]}) and one[3] <= other[4] and other[3] <= one[4]

    sets = [[]]
    for one in decided:
        sets += [[*some, one] for some in sets if not any(meet(one, other) for other in some)]
    best = max(sets, key=lambda some: sum(one[0] for one in some))
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
