"""Linking of tracks that were cut: a slow reference. See ``offline``."""

from __future__ import annotations

from math import hypot, log

import numpy as np

from tests.references.offline import (
    FITTED,
    LINK_BIAS,
    LINK_LEAST,
    LINK_NAMES,
    LINK_USUAL,
    LINK_WEIGHTS,
    REACH_M_PER_S,
    Cut,
    Motion,
    Path,
    link_features,
    sigmoid,
)

NAMES = (*LINK_NAMES, "same track", "odds of join", "same input id", "odds before", "odds after")
NAMES = (*NAMES, "cut before", "cut after", "log before", "log after", "next step", "short gap")
WEIGHTS, BIAS = FITTED["relinks"]["weights"], FITTED["relinks"]["bias"]
GAPS_S, BY_GAP, GAP_LINKS = (0.9, 1.7, 3.3, 6.5, 13.0, 1e9), FITTED["links"]["usual by gap"], 5.0
Candidate = tuple[float, bool, float]  # log odds, whether it is at a cut, seconds of the gap
SHORT_S, SAME_ID_S, AT_CUTS, ELSEWHERE = 1.0, 6.0, 1 / 11, 1 / 3


def linked(
    motion: Motion,
    paths: dict[int, Path],
    ids: dict[int, dict[int, int]],
    max_gap_s: float,
    least: float,
    cuts: list[Cut],
) -> dict[int, int]:
    """The id of each track after linking: that of the first one in its chain."""
    name = {track: track for track in paths}
    follows = links(motion, paths, ids, max_gap_s, least, cuts)
    for track in sorted(follows, key=lambda t: min(paths[t])):
        name[follows[track]] = name[track]
    return name


def links(
    motion: Motion,
    paths: dict[int, Path],
    ids: dict[int, dict[int, int]],
    max_gap_s: float,
    least: float,
    cuts: list[Cut],
) -> dict[int, int]:
    """For each linked track the track that continues it."""
    candidates = odds_of(motion, paths, ids, max_gap_s, cuts)
    shifts = usual_by_gap(best(candidates, [0.0] * len(GAPS_S)))
    made = best(candidates, shifts)
    shifts = usual_by_gap(made)
    out = {}
    for (a, b), (odds, is_cut, gap_s) in made.items():
        enough = log(AT_CUTS) if is_cut else log(ELSEWHERE) - shifts[gap_class(gap_s)]
        if odds > log(least / (1 - least)) + enough:
            out[a] = b
    return out


def odds_of(
    motion: Motion, paths: dict[int, Path], ids: dict[int, dict[int, int]], max_gap_s: float, cuts: list[Cut]
) -> dict[tuple[int, int], Candidate]:
    """The links that may be."""
    ends = {name: motion.filtered(path)[max(path)] for name, path in paths.items()}
    begins = {name: motion.backwards(path)[min(path)] for name, path in paths.items()}
    after = {one: (other, min(max(likely, 1e-6), 1 - 1e-6)) for one, other, likely in cuts}
    before = dict(after.values())
    out = {}
    for a, b in ((a, b) for a in paths for b in paths):
        gap = min(paths[b]) - max(paths[a])
        gap_s = gap * motion.step_s
        apart = hypot(*(ends[a].mean[:, 0] - begins[b].mean[:, 0]))
        if not (0 < gap <= round(max_gap_s / motion.step_s) and apart <= 1 + REACH_M_PER_S * gap_s):
            continue
        plain = link_features(motion, ends[a], begins[b], gap_s)
        odds = float(np.dot(LINK_WEIGHTS, plain) + LINK_BIAS)
        is_cut = a in after or b in before
        is_own = a in after and after[a][0] == b
        is_same = ids[a][max(paths[a])] == ids[b][min(paths[b])]
        if not (odds > LINK_LEAST or is_own or (is_same and is_cut and gap_s < SAME_ID_S)):
            continue
        if is_cut:
            joins = [log(likely / (1 - likely)) for likely in (after.get(a, (0, 0.5))[1], before.get(b, 0.5))]
            found = [
                *plain, is_own, joins[0] * is_own, is_same, *((0, 0) if is_own else joins), a in after, b in before,
            ]  # fmt: skip
            found += [log(len(paths[a])), log(len(paths[b])), gap == 1, gap_s < SHORT_S]
            odds = sum(WEIGHTS[one] * value for one, value in zip(NAMES, found, strict=True)) + BIAS
        out[a, b] = odds, is_cut, gap_s
    return out


def best(candidates: dict[tuple[int, int], Candidate], shifts: list[float]) -> dict[tuple[int, int], Candidate]:
    """The set of links with the largest sum of log odds above the least; shifts are added to those without a cut."""
    from scipy.optimize import linear_sum_assignment

    names = sorted({name for pair in candidates for name in pair})
    gains = np.zeros((len(names), len(names)))
    for (a, b), (odds, is_cut, gap_s) in candidates.items():
        shift = 0.0 if is_cut else shifts[gap_class(gap_s)]
        gains[names.index(a), names.index(b)] = max(odds + shift - LINK_LEAST, 0)
    pairs = [(names[i], names[j]) for i, j in zip(*linear_sum_assignment(-gains), strict=True) if gains[i, j]]
    return {pair: candidates[pair] for pair in pairs}


def gap_class(gap_s: float) -> int:
    """The class of a gap: the first one with a bound that isn't less."""
    return next(number for number, bound in enumerate(GAPS_S) if gap_s <= bound)


def usual_by_gap(made: dict[tuple[int, int], Candidate]) -> list[float]:
    """The same for each class of gaps: all links count as some links of each class."""
    elsewhere = [(odds, gap_class(gap_s)) for odds, is_cut, gap_s in made.values() if not is_cut]
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
