"""The laws that hold for every transform."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import fields, replace
from typing import get_type_hints

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import TRACKS, VIDEO, Frame
from mcaptrack.transforms import PROFILES, STAGES, TRACKERS, TRANSFORMS, Retrack, Transform
from mcaptrack.transforms.protocol import bare_type
from tests.worlds import boxes_at, ids, ns, walk

PLANE = GroundPlane((0.05, 0, 0, 0, 0.05, 0, 0, 0, 1), 640, 480)
SEEDS = st.integers(0, 2**32 - 1)


def pictures(rng: np.random.Generator) -> list[Frame]:
    """A noisy picture on which a bright block wanders."""
    floor = rng.integers(60, 140, (48, 64))
    frames = []
    for number in range(12):
        image = floor + rng.integers(-3, 4, floor.shape)
        image[10 : 10 + 20, 4 * number : 4 * number + 8] = 230
        frames.append(Frame(ns(number / 10), number, image.astype(np.uint8)))
    return frames


def boxes(rng: np.random.Generator) -> list[Frame]:
    """People who walk over the picture, now and then missed, and boxes of nobody."""
    start, speed = rng.uniform(50, 500, (4, 2)), rng.normal(0, 6, (4, 2))
    frames, now = [], 0.0
    for number in range(30):
        now += 0.1 * rng.choice([1, 1, 1, 1, 1, 4]) + rng.uniform(-0.01, 0.01)
        centres = [*(start + speed * number)[rng.random(4) > 0.25], *rng.uniform(0, 600, (rng.poisson(0.3), 2))]
        rows = boxes_at(rng.permutation(np.array(centres).reshape(-1, 2)))
        rows["score"] = rng.uniform(0.2, 1.0, len(rows))
        frames.append(Frame(ns(now), number, rows))
    return frames


def tracks(step_s: float) -> Callable[[np.random.Generator], list[Frame]]:
    """People who walk in metres, with holes, births and ends, and ids that break."""

    def make(rng: np.random.Generator) -> list[Frame]:
        place, speed, names = rng.uniform(-5, 5, (5, 2)), rng.normal(0, 1, (5, 2)), rng.permutation(50)[:5]
        frames = []
        for number in range(40):
            place = place + speed * step_s + rng.normal(0, 0.05, place.shape)
            there = np.flatnonzero(rng.random(5) > 0.2)
            if rng.random() < 0.1:
                names[rng.integers(5)] = 50 + number
            rows = TRACKS.rows(
                track_id=names[there].astype(np.int64),
                x_px=place[there, 0] * 20 + 200,
                y_px=place[there, 1] * 20 + 200,
                w_px=np.full(len(there), 10.0),
                h_px=np.full(len(there), 30.0),
                x_m=place[there, 0],
                y_m=place[there, 1],
                score=rng.random(len(there)),
                observed=rng.random(len(there)) > 0.1,
                source_id=np.full(len(there), -1),
            )
            frames.append(Frame(ns(number * step_s), number, rows[rng.permutation(len(rows))]))
        return frames

    return make


INPUTS = {"detect": pictures, "track": boxes, "sample": tracks(0.1), "predict": tracks(0.4), "retrack": tracks(0.4)}


def variants() -> list[tuple[str, Transform]]:
    """Every transform with its defaults, and with what changes its course."""
    out: list[tuple[str, Transform]] = [(name, kind()) for name, kind in TRANSFORMS.items()]
    out += [("retrack", profile) for profile in PROFILES.values()]
    out += [("retrack", Retrack(distance="first", min_history=1, backfill="none", max_age_s=1.0))]
    out += [("predict", TRANSFORMS["predict"](predictor=name)) for name in ("cv", "holt-cv")]
    out += [("detect", kind(stabilise=False)) for kind in STAGES["detect"].built_in().values()]
    plane = {"ground_planes": ((0, PLANE),)}
    out += [("track", kind()) for kind in TRACKERS.values()]
    out += [("track", kind(max_age_frames=9, min_hits_frames=3, cost="metres", **plane)) for kind in TRACKERS.values()]
    out += [("track", TRACKERS["sort"](cost="pixels", min_score=0.4, class_id=1))]
    return out


def describe(value: object) -> str:
    return str(value)[:60]


every = pytest.mark.parametrize(("name", "transform"), variants(), ids=describe)


def key(frame: Frame) -> tuple[int, int, bytes]:
    """A frame to the bit, but for what lies between the columns."""
    names = frame.rows.dtype.names
    content = b"".join(frame.rows[name].tobytes() for name in names) if names else frame.rows.tobytes()
    return frame.t_ns, frame.index, content


@every
@given(seed=SEEDS)
@settings(max_examples=8)
def test_conforms_and_keeps_time(name, transform, seed):
    frames = INPUTS[name](np.random.default_rng(seed))
    outputs = list(zip(*transform(frames), strict=True))
    assert len(outputs) == len(transform.writes)
    for schema, output in zip(transform.writes.values(), outputs, strict=True):
        for frame in output:
            schema.check(frame.rows)
        times = [frame.t_ns for frame in output]
        assert times == sorted(times)
        assert len(times) == len(set(times))


@every
@given(seed=SEEDS, cut=st.integers(1, 30))
@settings(max_examples=8)
def test_causal_the_run_of_a_prefix_is_a_prefix_of_the_run(name, transform, seed, cut):
    frames = INPUTS[name](np.random.default_rng(seed))
    prefix = frames[:cut]
    whole, part = (list(zip(*transform(given), strict=True)) for given in (frames, prefix))
    for latency, of_whole, of_part in zip(transform.latency_s.values(), whole, part, strict=True):
        if latency == float("inf"):
            continue
        certain = prefix[-1].t_ns - latency * NS_PER_S
        assert [key(f) for f in of_part if f.t_ns <= certain] == [key(f) for f in of_whole if f.t_ns <= certain]


@every
@given(seed=SEEDS)
@settings(max_examples=5)
def test_pure_the_same_input_gives_the_same_output_and_runs_do_not_touch(name, transform, seed):
    rng = np.random.default_rng(seed)
    first, second = INPUTS[name](rng), INPUTS[name](rng)
    before = [key(frame) for frame in first]
    alone = [[key(f) for f in result] for result in transform(first)]
    one, two = transform(first), transform(second)
    together = []
    for result in one:
        together.append([key(f) for f in result])
        next(two, None)
    assert together == alone
    assert [key(frame) for frame in first] == before


@every
@given(seed=SEEDS)
@settings(max_examples=8)
def test_order_blind_shuffled_rows_rename_ids_at_most(name, transform, seed):
    if transform.reads is VIDEO:
        return  # pictures have no rows
    rng = np.random.default_rng(seed)
    frames = INPUTS[name](rng)
    shuffled = [frame._replace(rows=frame.rows[rng.permutation(len(frame.rows))]) for frame in frames]
    renamed: dict[int, int] = {}
    for result, other in zip(transform(frames), transform(shuffled), strict=True):
        for a, b in zip(result, other, strict=True):
            rows_a, rows_b = _without_ids(a.rows), _without_ids(b.rows)
            assert [row for row, _ in rows_a] == [row for row, _ in rows_b]
            for (_, id_a), (_, id_b) in zip(rows_a, rows_b, strict=True):
                assert renamed.setdefault(id_a, id_b) == id_b
    assert len(set(renamed.values())) == len(renamed)


def _without_ids(rows: np.ndarray) -> list[tuple[tuple, int]]:
    """Rows in an order of their own, with the id apart; numbers to 9 digits, since sums depend on the order."""
    names = [name for name in rows.dtype.names if name != "track_id"]
    out = []
    for row in rows:
        values = tuple("nan" if row[n] != row[n] else round(float(row[n]), 9) for n in names)
        out.append((values, int(row["track_id"])))
    return sorted(out, key=lambda pair: [str(value) for value in pair[0]])


@every
def test_unmoved_by_silence(name, transform):
    frames = INPUTS[name](np.random.default_rng(5))
    if transform.reads is VIDEO:
        silent = [frame._replace(rows=np.full_like(frame.rows, 100)) for frame in frames]
    else:
        silent = [frame._replace(rows=frame.rows[:0]) for frame in frames]
    results = list(transform(silent))
    assert results
    assert all(len(frame.rows) == 0 for result in results for frame in result)
    assert list(transform([])) == []


@every
def test_frames_in_the_middle_may_be_silent(name, transform):
    frames = INPUTS[name](np.random.default_rng(6))
    if transform.reads is VIDEO:
        return
    broken = [f._replace(rows=f.rows[:0]) if 10 <= n < 20 else f for n, f in enumerate(frames)]
    rows = [sum(len(frame.rows) for frame in result) for result in transform(broken)]
    assert sum(rows[-5:]) > 0


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
@settings(max_examples=25)
def test_options_at_the_ends_of_their_ranges_run_without_warnings(name, data, seed):
    """Any options at the least or greatest value that they accept: rows conform to the schema, and no warnings."""
    kind = KINDS[name]
    base = data.draw(st.sampled_from(list(PROFILES.values()))) if name == "retrack" else kind()
    ends = ends_of_ranges(kind)
    chosen = data.draw(st.lists(st.sampled_from(sorted(ends)), unique=True))
    transform = replace(base, **{option: data.draw(st.sampled_from(ends[option])) for option in chosen})
    outputs = zip(*transform(INPUTS[INPUT_OF[name]](np.random.default_rng(seed))), strict=True)
    for schema, output in zip(transform.writes.values(), outputs, strict=True):
        for frame in output:
            schema.check(frame.rows)


@pytest.mark.parametrize("distance", ["likelihood", "now"])
def test_zero_noise_and_zero_speeds_drop_no_track(distance):
    """Taken literally, a noise of 0 m or speeds of 0 m/s would make covariances singular."""
    frames = walk(lambda n: {1: (0.5 * n, 0.0), 2: (10.0 - 0.5 * n, 0.5)}, 30)
    for options in ({}, {"speed_m_per_s": 0.0, "drift": 0.0, "drift_share": 0.0}):
        still = walk(lambda n: {1: (0.0, 0.0), 2: (10.0, 0.5)}, 30) if options else frames
        outputs = [offline for offline, _, _ in Retrack(distance=distance, noise_m=0.0, link_s=4.0, **options)(still)]
        assert [ids(frame) for frame in outputs] == [[1, 2]] * 30


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
