"""A clock that jumps between two frames: work doesn't grow with the jump, and nothing goes on after it."""

from __future__ import annotations

from itertools import chain

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import log
from mcaptrack.evaluation.forecasts import find_forecast_errors
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.transforms import STAGES
from tests.logs import write_stock
from tests.tiers import one_in

HOUR_NS = 3_600 * 10**9
YEARS_NS = 56 * 365 * 24 * HOUR_NS
JUMPS_NS = st.integers(HOUR_NS, YEARS_NS)
#: Every transform that reads rows, with options that make results of a short log.
TRANSFORMS = {
    f"{stage.name}: {name}": (stage, name)
    for stage in STAGES.values()
    for name in stage.built_in()
    if stage.default.reads in (DETECTIONS, TRACKS) and stage.name != "fuse"
}


def walkers(schema, rate_hz, seconds=8):
    """Three people who walk side by side for some seconds, each seen a little beside where they are."""
    noise = np.random.default_rng(1)
    for number in range(round(seconds * rate_hz)):
        x_m = 1.2 * number / rate_hz + noise.normal(0, 0.03, 3)
        y_m = np.array([0.0, 3.0, 6.0]) + noise.normal(0, 0.03, 3)
        columns = {
            "x_m": x_m, "y_m": y_m, "x_px": 40 * x_m, "y_px": 40 * y_m, "w_px": [20.0] * 3, "h_px": [60.0] * 3,
            "score": [0.9] * 3, "class_id": [1] * 3,
        }  # fmt: skip
        if schema is TRACKS:
            columns |= {"track_id": [1, 2, 3], "source_id": [-1] * 3, "observed": [True] * 3}
        yield Frame(round(number * 10**9 / rate_hz), number, schema.rows(**columns))


def recording(stage, jump_ns):
    """A stage's input: people walk, the clock jumps, and they walk there again. Also returns where it jumps."""
    schema = stage.default.reads
    first = list(walkers(schema, 2.5 if stage.name in ("predict", "retrack") else 10.0))
    after_ns = first[-1].t_ns + jump_ns
    return [*first, *(Frame(f.t_ns + after_ns, f.index + len(first), f.rows) for f in first)], after_ns


def results(transform, frames, after_ns):
    """The outputs of a transform, frame by frame; times after the jump count from it. And the ids on both sides."""
    outputs, ids = [], (set(), set())
    for together in transform(frames):
        for frame in together:
            is_after = frame.t_ns >= after_ns
            # As text: NaN is equal to itself, and padding doesn't count.
            outputs.append((is_after, frame.t_ns - after_ns * is_after, frame.index, repr(frame.rows.tolist())))
            if "track_id" in frame.rows.dtype.names:
                ids[is_after].update(frame.rows["track_id"].tolist())
    return outputs, ids


@pytest.mark.parametrize("name", one_in(3, TRANSFORMS))
@settings(max_examples=2, deadline=None)
@example(YEARS_NS)
@given(JUMPS_NS)
def test_results_depend_on_no_jump_beyond_an_hour(name, jump_ns):
    stage, chosen = TRANSFORMS[name]
    transform = stage.make(chosen if stage.kind else "")
    expected, (before, after) = results(transform, *recording(stage, HOUR_NS))
    assert before, "otherwise this shows nothing"
    assert after
    assert results(transform, *recording(stage, jump_ns))[0] == expected
    if transform.reads is DETECTIONS:  # else ids are those of the input, or of tracks that may have any
        assert not before & after, "a track goes on after the jump"


@pytest.mark.parametrize("name", one_in(3, TRANSFORMS))
@settings(max_examples=2, deadline=None)
@given(JUMPS_NS)
def test_before_a_jump_results_are_those_of_this_part_alone(name, jump_ns):
    stage, chosen = TRANSFORMS[name]
    transform = stage.make(chosen if stage.kind else "")
    frames, after_ns = recording(stage, jump_ns)
    alone = transform(frame for frame in frames if frame.t_ns < after_ns)
    settled = [number for number, name in enumerate(transform.writes) if np.isfinite(transform.latency_s[name])]
    for one, whole in zip(alone, transform(frames), strict=False):
        for number in settled:
            assert one[number][:2] == whole[number][:2]
            assert repr(one[number].rows.tolist()) == repr(whole[number].rows.tolist())


@settings(max_examples=2, deadline=None)
@example(YEARS_NS)
@given(JUMPS_NS)
def test_errors_of_forecasts_depend_on_no_jump(jump_ns):
    def errors(jump_ns):
        samples, _ = recording(STAGES["predict"], jump_ns)
        forecasts = [frame for (frame,) in STAGES["predict"].make(predictor="cv")(samples)]
        people, _ = recording(STAGES["sample"], jump_ns - 300_000_000)  # at 10 Hz, up to the same time
        found = find_forecast_errors(forecasts, samples, people, samples)
        return [repr(frame.rows.tolist()) for frame in chain(found.errors, found.scores)]

    expected = errors(HOUR_NS)
    assert any("nan" not in frame for frame in expected), "otherwise nothing is compared"
    assert errors(jump_ns) == expected


CUTS = st.lists(st.tuples(st.integers(5, 30), st.integers(61 * 10**9, YEARS_NS // 8)), max_size=2)


@pytest.mark.parametrize("chunk_size", [1, 10**6])
@given(cuts=CUTS, late=st.booleans())
@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_jumps_are_found_by_the_index_and_by_a_check(tmp_path, chunk_size, cuts, late):
    """Of parts of some messages at 10 Hz, in the order of time or with the last part first: the clock was set back."""
    t_ns, parts, jumps = 10**9, [], []
    for count, jump_ns in (*cuts, (20, 0)):
        parts.append([t_ns + 10**8 * number for number in range(count)])
        jumps.append((parts[-1][-1], parts[-1][-1] + jump_ns))
        t_ns = jumps[-1][1]
    messages = [("a", t_ns, 0, b"x") for part in (parts[::-1] if late else parts) for t_ns in part]
    expected = jumps[:-1] if len(cuts) * 10 <= len(messages) else []
    write_stock(path := tmp_path / "a.mcap", messages, chunk_size=chunk_size)
    with log.read(path) as opened:
        assert log.clock_jumps(opened) == expected
    named = [finding for finding in log.check(path).findings if finding.kind == "clock-jump"]
    assert [finding.times for finding in named] == ([len(expected)] if expected else [])


def test_a_run_and_info_say_where_the_clock_jumps(tmp_path):
    path = tmp_path / "a.mcap"
    times = [start + n * 10**8 for start in (0, 3 * HOUR_NS) for n in range(10)]
    write_stock(path, [("a", t_ns, 0, b"x") for t_ns in times])
    (warning,) = mcaptrack.info(path).warnings
    assert warning.code == "clock-jump"
    assert "no message for 3.0 hours after 0.900 s" in warning.message
