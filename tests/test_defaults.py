"""The profiles of re-tracking, a second time. The defaults of all options stand in docs/options.md, which test_help holds."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from mcaptrack.transforms import PROFILES, TRANSFORMS, Retrack, RetrackByConsistency

#: Algorithm 1 as in the paper; numbers that the paper doesn't give are those of the authors' program.
PAPER = {
    "predictor": "cv", "distance": "mean", "covariance": "paper", "noise_m": 0.5, "gate_m": None, "same_id_bonus": 0.0,
    "max_age_s": 3.2, "alpha": 0.5, "beta": 0.5, "min_history": 4, "min_hits": 2, "link_s": 0.0, "resolve_swaps": False,
    "track_confidence": 0.0, "across_classes": False, "smooth": False, "interpolated": True,
}  # fmt: skip
AUTHORS = PAPER | {
    "distance": "max",
    "priority_distance": 0.15,
    "birth": "smoothed",
    "trim_ends": True,
    "backfill": "all",
}


def options_of(transform: Any) -> dict[str, Any]:
    return {o.name: getattr(transform, o.name) for o in fields(transform) if not o.metadata.get("context")}


def test_profiles_of_retracking():
    plain = options_of(RetrackByConsistency())
    wanted = {"default": options_of(Retrack()), "paper": plain | PAPER, "authors": plain | AUTHORS}
    assert {name: options_of(profile) for name, profile in PROFILES.items()} == wanted


def test_the_clock_of_prediction_ticks_at_2_5_hz():
    assert TRANSFORMS["retrack"]().rate_hz == TRANSFORMS["predict"]().rate_hz == TRANSFORMS["sample"]().rate_hz == 2.5
