"""Fits of `fit_retrack.py` and `fit_tails.py`: logistic regressions and how reliable they are, and mixtures.

Letters: N members, F features, D decisions.
"""

from __future__ import annotations

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
