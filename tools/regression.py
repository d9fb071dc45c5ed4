"""Fits of `fit_retrack.py` and `fit_tails.py`: logistic regressions and how reliable they are, and mixtures.

Letters: N members, F features, D decisions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.mixtures import Tails
from mcaptrack.predictors.tail_calibration import CENTRES, LEAST_WIDE, MOST_WIDE
from mcaptrack.transforms.retrack.weights import probability

#: How strongly weights are drawn to 0, and how strongly those that groups have of their own (shares of right links).
RIDGE, OWN_RIDGE = 1e-5, 1e-4


def logistic(
    features: np.ndarray, right: np.ndarray, weight: np.ndarray, group: np.ndarray | None = None, ridge: float = RIDGE
) -> np.ndarray:
    """The weights of the features and the bias. Members of a group have a bias of their own in addition."""
    from scipy.optimize import minimize
    from scipy.sparse import coo_array

    mean, spread = features.mean(axis=0), features.std(axis=0) + 1e-9
    z = np.column_stack([(features - mean) / spread, np.ones(len(features))])
    count, share = z.shape[1], weight / weight.sum()
    group = np.zeros(len(z), int) if group is None else group
    own = coo_array((np.ones(len(z)), (group, np.arange(len(z)))), shape=(int(group.max()) + 1, len(z))).tocsr()
    shrink = np.full(count + own.shape[0], OWN_RIDGE)
    shrink[:count], shrink[count - 1] = ridge, 0.0

    def loss(t: np.ndarray) -> tuple[float, np.ndarray]:
        value = z @ t[:count] + t[count:][group]
        off = share * (probability(value) - right)
        slope = np.concatenate([z.T @ off, own @ off]) + 2 * shrink * t
        return float(share @ (np.logaddexp(0, value) - right * value) + shrink @ t**2), slope

    t = minimize(loss, np.zeros(len(shrink)), jac=True, method="L-BFGS-B", options={"maxiter": 2000, "gtol": 1e-9}).x
    weights = t[: count - 1] / spread
    return np.append(weights, t[count - 1] - weights @ mean)


class Chosen(NamedTuple):
    """What the ends and the beginnings of the tracklets (K,) of a scene chose, and what they could choose.

    ``before`` and ``after`` (E,) are the tracklets of links, ``gap`` (E,) their classes, ``terms`` (E, F) their terms;
    ``leaves`` and ``comes`` (K, G) the terms of choosing none. ``link_after`` and ``link_before`` (K,) are the links
    that are right at ends and at beginnings, or -1; -2 where nothing is right.
    """

    before: np.ndarray
    after: np.ndarray
    gap: np.ndarray
    terms: np.ndarray
    leaves: np.ndarray
    comes: np.ndarray
    link_after: np.ndarray
    link_before: np.ndarray

    def moved(self, tracklets: int, links: int) -> Chosen:
        """The same with numbers that follow on so many tracklets and links of other scenes."""
        right = [np.where(link >= 0, link + links, link) for link in (self.link_after, self.link_before)]
        sides = self.before + tracklets, self.after + tracklets
        return Chosen(*sides, *self[2:6], *right)


class Fitted(NamedTuple):
    """The weights of a multinomial logit, as in ``Choices``."""

    links: Floats
    leaves: Floats
    comes: Floats
    usual_leaves: Floats
    usual_comes: Floats


def multinomial(scenes: Sequence[Chosen], classes: int, ridge: float = 1.0) -> Fitted:
    """The weights under which what was chosen is likeliest (L-BFGS), and how often each class of links was."""
    from scipy.optimize import minimize

    counts = np.cumsum([(0, 0), *((len(scene.leaves), len(scene.before)) for scene in scenes)], axis=0)
    moved = [scene.moved(*count) for scene, count in zip(scenes, counts.tolist(), strict=False)]
    before, after, gap, terms, *others = (np.concatenate(parts) for parts in zip(*moved, strict=True))
    sides, right = others[:2], others[2:]
    spread, scales = terms.std(axis=0) + 1e-6, [np.abs(side).max(axis=0) + 1e-6 for side in sides]
    spread[0] = 1.0
    terms, sides = terms / spread, [side / scale for side, scale in zip(sides, scales, strict=True)]
    of_class = [np.flatnonzero(gap == number) for number in range(classes)]
    parts = [terms[own] for own in of_class]
    shape, count = (classes, terms.shape[1]), sides[0].shape[1]
    cuts = [shape[0] * shape[1], shape[0] * shape[1] + count]

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        of_links, *of_ends = np.split(weights, cuts)
        score = np.empty(len(before))
        for own, part, weight in zip(of_class, parts, of_links.reshape(shape), strict=True):
            score[own] = part @ weight
        total, slope, slopes = 0.0, np.zeros(len(before)), []
        for which, side, weight, target in zip((before, after), sides, of_ends, right, strict=True):
            none = side @ weight
            top = none.copy()
            np.maximum.at(top, which, score)
            all_ = top + np.log(np.exp(none - top) + np.bincount(which, np.exp(score - top[which]), len(none)))
            counts = target >= -1
            total += float((all_ - np.where(target >= 0, score[target], none))[counts].sum())
            slope += counts[which] * np.exp(score - all_[which]) - np.bincount(
                target[target >= 0], minlength=len(score)
            )
            slopes.append(side.T @ (counts * (np.exp(none - all_) - (target == -1))))
        slope_of_links = [part.T @ slope[own] for own, part in zip(of_class, parts, strict=True)]
        slopes = np.concatenate([*slope_of_links, *slopes]) + ridge * weights
        return total + ridge / 2 * float(weights @ weights), slopes

    start = np.zeros(cuts[1] + count)
    best = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": 400}).x
    of_links, leaves, comes = np.split(best, cuts)
    usual = []
    for target in right:
        classes_of = np.where(target >= 0, gap[target], classes)[target >= -1]
        usual.append(np.bincount(classes_of, minlength=classes + 1) / len(classes_of))
    return Fitted(of_links.reshape(shape) / spread, leaves / scales[0], comes / scales[1], *usual)


def shift(log_odds: np.ndarray, right: np.ndarray, weight: np.ndarray) -> float:
    """What has to be added to the log odds of members (N,) of whom these shares are right.

    One more member counts, with log odds of 0 and a share of a half: otherwise the answer would have no limit where
    all are right.
    """
    from scipy.optimize import brentq

    odds, share, each = (np.append(all_, one) for all_, one in ((log_odds, 0.0), (right, 0.5), (weight, weight.mean())))
    return float(brentq(lambda added: each @ (probability(odds + added) - share), -20.0, 20.0))


def show_reliability(name: str, likely: np.ndarray, right: np.ndarray) -> None:
    """Print how many of the decisions (D,) with a probability are right, by steps of it."""
    print(f"{name}: {len(right)}, {100 * right.mean():.1f} % right")
    place = np.minimum((likely * 10).astype(int), 9)
    for one in np.unique(place).tolist():
        here = place == one
        said, were = (100 * values[here].mean() for values in (likely, right))
        print(f"  {one / 10:.1f} to {one / 10 + 0.1:.1f}: {here.sum():6}, said {said:.1f} %, right {were:.1f} %")


def fit_mixture(counts: Floats, start: Tails, iterations: int) -> Tails:
    """The mixtures (T,) under which counts (T, B) of half the squared distances are likeliest.

    By expectation and maximisation, ``iterations`` times from ``start``.
    """
    weight, narrow, wide = (part[:, None] for part in start)
    total = counts.sum(axis=1, keepdims=True)
    for _ in range(iterations):
        of_narrow = (1 - weight) / narrow * np.exp(-CENTRES / narrow)
        two = weight / wide * np.exp(-CENTRES / wide)
        of_wide = counts * two / np.maximum(of_narrow + two, 1e-300)
        sums = of_wide.sum(axis=1, keepdims=True)
        wide = (of_wide @ CENTRES)[:, None] / np.maximum(sums, 1e-9)
        narrow = ((counts - of_wide) @ CENTRES)[:, None] / np.maximum(total - sums, 1e-9)
        weight = np.clip(sums / total, LEAST_WIDE, MOST_WIDE)
    return Tails(weight[:, 0], narrow[:, 0], wide[:, 0])
