"""The laws that hold for every transform."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from typing import Any, get_type_hints

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, TRACKS, VIDEO
from mcaptrack.testing import LAWS, sample_frames
from mcaptrack.transforms import (
    PROFILES,
    STAGES,
    TRACKERS,
    TRANSFORMS,
    KnnDetector,
    Retrack,
    RetrackByConsistency,
    Transform,
)
from mcaptrack.transforms.protocol import bare_type
from tests.tiers import one_in

PLANE = GroundPlane((0.05, 0, 0, 0, 0.05, 0, 0, 0, 1), 640, 480)
SEEDS = st.integers(0, 2**32 - 1)


#: What the transform of each step reads, by random seed.
INPUTS = {
    "detect": lambda seed: sample_frames(VIDEO, seed),
    "motion": lambda seed: sample_frames(VIDEO, seed),
    "track": lambda seed: sample_frames(DETECTIONS, seed),
    "sample": lambda seed: sample_frames(TRACKS, seed, step_s=0.1),
    "predict": lambda seed: sample_frames(TRACKS, seed),
    "retrack": lambda seed: sample_frames(TRACKS, seed),
}


def variants() -> list[tuple[str, Transform]]:
    """Every transform with its defaults, and with what changes its course."""
    out: list[tuple[str, Transform]] = [(name, kind()) for name, kind in TRANSFORMS.items()]
    out += [("retrack", profile) for profile in PROFILES.values()]
    out += [("retrack", RetrackByConsistency(min_history=1, backfill="none", max_age_s=1.0))]
    out += [("predict", TRANSFORMS["predict"](predictor=name)) for name in ("cv", "holt-cv")]
    out += [("detect", KnnDetector(stabilise=False))]
    plane = {"ground_planes": ((0, PLANE),)}
    out += [("track", kind()) for kind in TRACKERS.values()]
    out += [("track", kind(max_age_frames=9, min_hits_frames=3, cost="metres", **plane)) for kind in TRACKERS.values()]
    out += [("track", TRACKERS["sort"](cost="pixels", min_score=0.4, class_id=1))]
    return [each for number, each in enumerate(out) if each not in out[:number]]


def describe(value: object) -> str:
    return str(value)[:60]


def _variants() -> list[object]:
    """All variants, of which those after the defaults run in the thorough tier, but for one in five."""
    return [*variants()[: len(TRANSFORMS)], *one_in(5, variants()[len(TRANSFORMS) :])]


every = pytest.mark.parametrize(("name", "transform"), _variants(), ids=describe)


@every
@pytest.mark.parametrize("law", LAWS)
@given(seed=SEEDS, length=st.integers(2, 40))
@settings(max_examples=3)
def test_laws_hold(name, transform, law, seed, length):
    LAWS[law](transform, INPUTS[name](seed)[:length], seed)


KINDS = dict(TRANSFORMS) | dict(TRACKERS)
INPUT_OF = {name: name for name in TRANSFORMS} | dict.fromkeys(TRACKERS, "track")


def ends_of_ranges(kind) -> dict[str, list]:
    """The least and the greatest value of every option that has one."""
    hints = get_type_hints(kind)
    out = {}
    for option in fields(kind):
        limits = [option.metadata[end] for end in ("least", "most") if np.isfinite(option.metadata.get(end, np.inf))]
        out[option.name] = [bare_type(hints[option.name])(limit) for limit in limits]
    return {name: values for name, values in out.items() if values}


@pytest.mark.parametrize("name", KINDS)
@given(data=st.data(), seed=SEEDS)
@settings(max_examples=5)
def test_options_at_the_ends_of_their_ranges_run_without_warnings(name, data, seed):
    kind = KINDS[name]
    base = data.draw(st.sampled_from(list(PROFILES.values()))) if name == "retrack" else kind()
    ends = ends_of_ranges(type(base))
    chosen = data.draw(st.lists(st.sampled_from(sorted(ends)), unique=True)) if ends else []
    transform = replace(base, **{option: data.draw(st.sampled_from(ends[option])) for option in chosen})
    outputs = zip(*transform(INPUTS[INPUT_OF[name]](seed)), strict=True)
    for schema, output in zip(transform.writes.values(), outputs, strict=True):
        for frame in output:
            schema.check(frame.rows)


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_every_parameter_says_what_it_is_and_refuses_what_it_can_not_be(kind):
    for parameter in fields(kind):
        if parameter.metadata.get("context"):
            continue
        assert parameter.metadata["help"]
        with pytest.raises(McaptrackError, match=parameter.name):
            kind(**{parameter.name: object()})
        least, most = parameter.metadata["least"], parameter.metadata["most"]
        words = f"from {least:.15g} to {most:.15g}"
        number = bare_type(get_type_hints(kind)[parameter.name])
        for value in (least - 1, most + 1):
            if np.isfinite(value):
                refused = f"{parameter.name} has to be {words}, not {number(value)}"
                with pytest.raises(McaptrackError, match=re.escape(refused)):
                    kind(**{parameter.name: number(value)})
    with pytest.raises(AttributeError):
        kind().reads = None
    assert replace(kind()) == kind()


def test_each_output_has_a_latency_and_what_is_online_has_none():
    for name, transform in variants():
        assert set(transform.latency_s) == set(transform.writes), name
        assert all(latency >= 0 for latency in transform.latency_s.values()), name
    for profile in PROFILES.values():
        wanted = {"": float("inf"), "online": 0.0, "predictions": 0.0, "decisions": float("inf")}
        assert profile.latency_s == {name: wanted[name] for name in profile.writes}


@pytest.mark.parametrize("stage", STAGES.values(), ids=lambda stage: stage.name)
def test_the_transforms_of_a_stage_read_and_write_what_it_declares(stage):
    for kind in stage.built_in().values():
        assert kind.reads is stage.reads
        assert stage.writes.items() >= kind.writes.items()
    assert dict(stage.default.writes) == dict(stage.writes)
    assert next(iter(stage.built_in().values())) is stage.default


# The profiles of re-tracking, a second time. The defaults of all options stand in docs/options.md


#: Algorithm 1 as in the paper; numbers that the paper doesn't give are those of the authors' program.
PAPER = {
    "predictor": "cv", "distance": "mean", "covariance": "paper", "noise_m": 0.5, "gate_m": None, "same_id_bonus": 0.0,
    "max_age_s": 3.2, "alpha": 0.5, "beta": 0.5, "min_history": 4, "min_hits": 2, "min_track_s": 2.0, "link_s": 0.0,
    "resolve_swaps": False, "track_confidence": 0.0, "across_classes": False, "smooth": False, "interpolated": True,
}  # fmt: skip
AUTHORS = PAPER | {
    "distance": "max", "priority_distance": 0.15, "birth": "smoothed", "trim_ends": True, "backfill": "all",
}  # fmt: skip


def options_of(transform: Any) -> dict[str, Any]:
    return {o.name: getattr(transform, o.name) for o in fields(transform) if not o.metadata.get("context")}


def test_profiles_of_retracking():
    plain = options_of(RetrackByConsistency())
    wanted = {"default": options_of(Retrack()), "paper": plain | PAPER, "authors": plain | AUTHORS}
    assert {name: options_of(profile) for name, profile in PROFILES.items()} == wanted


def test_the_clock_of_prediction_ticks_at_2_5_hz():
    assert TRANSFORMS["retrack"]().rate_hz == TRANSFORMS["predict"]().rate_hz == TRANSFORMS["sample"]().rate_hz == 2.5
