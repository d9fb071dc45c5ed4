"""How good forecasts are that were made from tracks: displacement errors over recall, and more.

At every prediction time the tracks that carry a forecast are assigned to the true people by how well their last
``t_obs`` positions agree (Yu and Zhou 2021, Eq. 4). One assignment a time serves every threshold: sorted by that
distance, the running mean of the errors against the share of people matched so far is the exact curve.

Counted are people with ``t_obs`` past and all future positions, and forecasts of tracks with ``t_obs`` past positions
(holes inside a track filled linearly between what was known by then). Others are counted neither for nor against.

Letters: N rows, S true people at one time, F forecasts at one time, T future steps, P matched pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.match import solve
from mcaptrack.metrics.calibration import LEVELS, mahalanobis_squared

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: The threshold of association at which single numbers are given, in m^2 (the paper's tau).
TAU_M2: Final = 2.0
#: The quantiles of chi^2 with 2 degrees of freedom that belong to the levels of calibration.
_CHI2: Final = -2 * np.log(1 - np.array(LEVELS))


@dataclass(frozen=True)
class Path:
    """Positions on a regular clock. ``step`` (N,), ``id`` (N,) whole numbers, ``xy_m`` (N, 2)."""

    step: Ints
    id: Ints
    xy_m: Floats

    def table(self, fill: bool) -> tuple[Ints, int, Floats]:
        """Ids (I,), first step, and positions (I, steps, 2) with NaN where there are none; holes filled on request."""
        known, row = np.unique(self.id, return_inverse=True)
        first, count = (int(self.step.min()), int(np.ptp(self.step)) + 1) if len(self.step) else (0, 0)
        positions = np.full((len(known), count, 2), np.nan)
        positions[row, self.step - first] = self.xy_m
        if fill:
            steps = np.arange(count)
            for path in positions:
                have = np.isfinite(path[:, 0])
                inside = (steps >= have.argmax()) & (steps <= count - 1 - have[::-1].argmax()) & ~have
                for axis in (0, 1):
                    path[inside, axis] = np.interp(steps[inside], steps[have], path[have, axis])
        return known, first, positions


@dataclass(frozen=True)
class Forecasts:
    """Forecasts made at ``step`` (N,) for ``id`` (N,): mean (N, T, 2) in m, covariance (N, T, 2, 2) in m^2."""

    step: Ints
    id: Ints
    mean_m: Floats
    cov_m2: Floats


@dataclass(frozen=True)
class Displacement:
    """The pairs (P,) of people and forecasts of one or several sequences, and what is left over."""

    d_obs_m2: Floats
    ade_m: Floats
    fde_m: Floats
    ade_squared_m2: Floats
    covered: Floats  # (P, 3): share of the future steps inside the 50, 90 and 95 % ellipse; NaN without covariance
    people: int
    false_forecasts: int
    frames: int
    drift_m: Floats  # |P_t - P_t+1| over the shared steps of consecutive forecasts of one track
    away_m: Floats  # (P, T): how far each step is from the truth; NaN where another sequence foretells further

    def curve(self) -> tuple[Floats, Floats]:
        """Recall (P,) and ADE in m (P,): entry k holds for the k + 1 pairs that agree best on the past."""
        order = np.argsort(self.d_obs_m2, kind="stable")
        count = np.arange(1, len(order) + 1)
        return count / max(self.people, 1), np.cumsum(self.ade_m[order]) / count

    def squared_at(self, recall: float) -> float:
        """The squared ADE in m^2 (the paper's) of the pairs that agree best on the past, up to a recall; NaN beyond."""
        count = round(recall * self.people)
        best = np.argsort(self.d_obs_m2, kind="stable")[:count]
        return float(self.ade_squared_m2[best].mean()) if 0 < count == len(best) else float("nan")

    def away_by_step(self, tau_m2: float = TAU_M2) -> Floats:
        """How far the steps of the pairs that count at one threshold are from the truth, (pairs, T) in m."""
        return self.away_m[self.d_obs_m2 < tau_m2]

    def summary(self, tau_m2: float = TAU_M2) -> dict[str, float | None]:
        """The numbers at one threshold; None where there is nothing to average."""
        kept = self.d_obs_m2 < tau_m2

        def mean(values: Floats) -> float | None:
            return float(values.mean()) if len(values) and np.isfinite(values).all() else None

        _, running = self.curve()
        return {
            "ADE_m": mean(self.ade_m[kept]),
            "FDE_m": mean(self.fde_m[kept]),
            "ADE_squared_m2": mean(self.ade_squared_m2[kept]),
            "recall": kept.sum() / self.people if self.people else None,
            "AADE_m": mean(running[: int(kept.sum())]),
            "false_forecasts_per_frame": self.false_forecasts / self.frames if self.frames else None,
            "consistency_m": mean(self.drift_m),
            **{f"coverage_{100 * p:g}": mean(self.covered[kept, k]) for k, p in enumerate(LEVELS)},
        }


def combine(parts: list[Displacement]) -> Displacement:
    """Several sequences as one: all pairs pooled."""

    def pooled(name: str) -> Floats:
        return np.concatenate([getattr(part, name) for part in parts])

    furthest = max(part.away_m.shape[1] for part in parts)
    away = [np.pad(p.away_m, ((0, 0), (0, furthest - p.away_m.shape[1])), constant_values=np.nan) for p in parts]
    return Displacement(
        d_obs_m2=pooled("d_obs_m2"),
        ade_m=pooled("ade_m"),
        fde_m=pooled("fde_m"),
        ade_squared_m2=pooled("ade_squared_m2"),
        covered=pooled("covered"),
        people=sum(part.people for part in parts),
        false_forecasts=sum(part.false_forecasts for part in parts),
        frames=sum(part.frames for part in parts),
        drift_m=pooled("drift_m"),
        away_m=np.concatenate(away),
    )


def displacement(
    truth: Path, tracks: Path, forecasts: Forecasts, t_obs: int = 4, tau_m2: float = TAU_M2
) -> Displacement:
    """Compare the forecasts made for tracks with the true future of the people they belong to.

    All three share one clock. ``tracks`` are the positions that the forecasts were made from.
    """
    horizon = forecasts.mean_m.shape[1]
    _, truth_first, true_xy = truth.table(fill=False)
    track_ids, track_first, track_xy = tracks.table(fill=True)
    pairs: list[tuple[Floats, ...]] = []
    people = false_forecasts = frames = 0
    for step in np.unique(forecasts.step):
        at = np.flatnonzero(forecasts.step == step)
        past_true = _window(true_xy, int(step) - truth_first - t_obs + 1, t_obs)
        future_true = _window(true_xy, int(step) - truth_first + 1, horizon)
        whole = np.isfinite(past_true.sum(axis=(1, 2)))
        scored = whole & np.isfinite(future_true.sum(axis=(1, 2)))
        slot = np.searchsorted(track_ids, forecasts.id[at])
        known = (slot < len(track_ids)) & (track_ids[np.minimum(slot, len(track_ids) - 1)] == forecasts.id[at])
        past = _window(track_xy, int(step) - track_first - t_obs + 1, t_obs)[np.where(known, slot, 0)]
        with_past = known & np.isfinite(past).all(axis=(1, 2))
        at, past = at[with_past], past[with_past]
        frames += 1
        people += int(scored.sum())
        subject = np.flatnonzero(whole)
        if len(at) == 0 or len(subject) == 0:
            false_forecasts += len(at)
            continue
        d_obs = ((past_true[subject][:, None] - past[None]) ** 2).sum(axis=-1).mean(axis=-1)
        rows, columns = solve(d_obs)
        false_forecasts += len(at) - int((d_obs[rows, columns] < tau_m2).sum())
        kept = scored[subject[rows]]
        rows, columns = rows[kept], columns[kept]
        off = forecasts.mean_m[at[columns]] - future_true[subject[rows]]
        pairs.append((d_obs[rows, columns], *_errors(off, forecasts.cov_m2[at[columns]])))
    pairs.append((*(np.empty(0) for _ in range(4)), np.empty((0, len(LEVELS))), np.empty((0, horizon))))
    columns_of_pairs = (np.concatenate(column) for column in zip(*pairs, strict=True))
    d_obs_m2, ade_m, fde_m, squared_m2, covered, away_m = columns_of_pairs
    return Displacement(
        d_obs_m2=d_obs_m2,
        ade_m=ade_m,
        fde_m=fde_m,
        ade_squared_m2=squared_m2,
        covered=covered,
        people=people,
        false_forecasts=false_forecasts,
        frames=frames,
        drift_m=_drift(forecasts),
        away_m=away_m,
    )


def _window(positions: Floats, start: int, length: int) -> Floats:
    """``length`` steps from ``start`` of positions (I, steps, 2); NaN where they reach outside."""
    out = np.full((len(positions), length, 2), np.nan)
    low, high = max(start, 0), min(start + length, positions.shape[1])
    if low < high:
        out[:, low - start : high - start] = positions[:, low:high]
    return out


def _errors(off: Floats, cov: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """ADE, FDE, squared ADE, covered shares and distances (P, T) of P pairs.

    From errors (P, T, 2) and covariances (P, T, 2, 2).
    """
    squared = (off**2).sum(axis=-1)
    euclidean = np.sqrt(squared)
    with np.errstate(invalid="ignore", divide="ignore"):
        away = mahalanobis_squared(off, cov)[..., None]
    inside = np.where(np.isfinite(away), away <= _CHI2, np.nan)
    return euclidean.mean(axis=-1), euclidean[..., -1], squared.mean(axis=-1), inside.mean(axis=-2), euclidean


def _drift(forecasts: Forecasts) -> Floats:
    order = np.lexsort((forecasts.step, forecasts.id))
    step, who, mean = forecasts.step[order], forecasts.id[order], forecasts.mean_m[order]
    next_one = (who[1:] == who[:-1]) & (step[1:] == step[:-1] + 1)
    off = mean[:-1, 1:][next_one] - mean[1:, :-1][next_one]
    return np.asarray(np.hypot(off[..., 0], off[..., 1]).mean(axis=-1) if len(off) else np.empty(0))
