"""Every option of every transform has a scene in which it matters, with the expected effect."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise
from typing import get_type_hints

import numpy as np
import pytest

from mcaptrack.transforms import (
    STAGES,
    TRACKERS,
    TRANSFORMS,
    GroundTracker,
    OnnxDetector,
    RetrackByConsistency,
)
from mcaptrack.transforms.protocol import bare_type
from mcaptrack.transforms.retrack import RetrackOptions
from tests.effects import Case, ground, others, retrack, sort
from tests.tiers import one_in

CASES = retrack.CASES | sort.CASES | others.CASES | ground.CASES
KINDS = dict(TRANSFORMS) | dict(TRACKERS) | {"consistency": RetrackByConsistency, "ground": GroundTracker}
BUILT_IN = {f"{stage} {name}": kind for stage, one in STAGES.items() for name, kind in one.built_in().items()}
ORDER = ("least", "more", "most")


@pytest.mark.parametrize(
    ("option", "case"), one_in(2, [(name, case) for (_, name), case in CASES.items()]), ids=map("-".join, CASES)
)
def test_an_option_has_the_effect_that_its_scene_says(option: str, case: Case):
    found = {}
    for value in case.wanted:
        transform = replace(case.transform, **{option: value})
        found[value] = case.number([list(output) for output in zip(*transform(case.frames), strict=True)])
    if set(case.wanted.values()) <= set(ORDER):
        ordered = sorted(found, key=lambda value: ORDER.index(case.wanted[value]))
        numbers = [found[value] for value in ordered]
        assert all(more > 1.02 * less for less, more in pairwise(numbers)), found
    else:
        assert found == pytest.approx(case.wanted), case.scene


def test_every_option_has_a_scene():
    options = {(kind, o.name) for kind, made in KINDS.items() for o in fields(made) if not o.metadata.get("context")}
    shared = {("consistency", o.name) for o in fields(RetrackOptions)}  # their scenes are those of retrack
    assert set(CASES) == options - shared


#: Ranges that don't follow from what an option is.
RANGES = {
    "class_id": (0, 2**31 - 1),
    "direction_frames": (2, 100),
    "history_s": (0.1, 1e6),
    "horizon_s": (0.1, 60.0),
    "least_visible": (0.05, 1.0),
    "link_confidence": (0.01, 0.99),
    "max_memory_mb": (10, 1_000_000),
    "max_pixels": (1000, 10**9),
    "min_history": (1, 100),
    "min_hits": (0, 1000),
    "overlap": (0.0, 0.5),
    "rate_hz": (0.1, 1000.0),
    "sigma_m": (1e-6, 1e6),
}
SHARES = {"alpha", "beta", "birth_score", "max_iou", "min_iou", "low_min_iou", "track_confidence"}
ANY = {"min_score", "high_score", "new_score"}


@pytest.mark.parametrize("kind", BUILT_IN.values(), ids=BUILT_IN)
def test_ranges_quantities_are_not_negative_and_shares_are_within_0_and_1(kind):
    for option in fields(kind):
        name, hint = option.name, get_type_hints(kind)[option.name]
        if option.metadata.get("context") or bare_type(hint) not in (int, float):
            continue
        is_share = name in SHARES or (issubclass(kind, OnnxDetector) and name == "min_score")
        usual = (0.0, 1.0) if is_share else (-np.inf, np.inf) if name in ANY else (0.0, 1e6)
        assert (option.metadata["least"], option.metadata["most"]) == RANGES.get(name, usual), name
        low, high = option.metadata["search"] or (option.metadata["least"], option.metadata["most"])
        assert option.metadata["least"] <= low < high <= option.metadata["most"]
        assert option.default is None or low <= option.default <= high
