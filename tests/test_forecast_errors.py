"""Errors of forecasts: scenes counted by hand, laws, and the channels in a log."""

from __future__ import annotations

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from typer.testing import CliRunner

from mcaptrack import log, notices, pipeline
from mcaptrack.cli import app
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import Candidate, EvaluateOptions, EvaluationInput, evaluate
from mcaptrack.evaluation.forecasts import find_forecast_errors
from mcaptrack.evaluation.metrics.displacement import pair_forecasts
from mcaptrack.predictors import Forecast
from mcaptrack.schema import FORECAST_ERRORS, FORECAST_SCORES, PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.predictions import forecast_to_rows
from mcaptrack.schema.provenance import Provenance, digest
from tests.forecasts import forecasts, positions, predicted
from tests.worlds import ns, walk

STEP_S = 0.4


def predictions(predict, ticks: int, variance: float = 1.0, step_s: float = STEP_S) -> list[Frame]:
    """Frames of forecasts; ``predict`` gives the places that each id is predicted at, for every tick."""
    frames = []
    for tick in range(ticks):
        said = predict(tick)
        rows = PREDICTIONS.empty()
        if said:
            mean = np.array(list(said.values()), float)
            cov = np.tile(variance * np.eye(2), (*mean.shape[:2], 1, 1))
            rows = forecast_to_rows(np.array(list(said), np.int64), Forecast(mean, cov), step_s)
        frames.append(Frame(ns(step_s * tick), tick, rows))
    return frames


def rows_of(frames: list[Frame]) -> np.ndarray:
    return np.concatenate([frame.rows for frame in frames])


def only(found):
    """The one forecast of a scene, and the scores of its frame."""
    (at,) = [number for number, frame in enumerate(found.errors) if len(frame.rows)]
    (row,) = found.errors[at].rows
    return row, found.scores[at].rows[0]


def straight_on(tick: int):
    """Person 1, half a metre a tick along the first axis."""
    return {1: (0.5 * tick, 0.0)}


# Scenes


@pytest.mark.parametrize(("aside_m", "truth_id"), [((1.0, 1.0), -1), ((1.0, 0.99), 1)])
def test_a_forecast_is_assigned_below_tau(aside_m, truth_id):
    """The mean squared distance of the pasts is 2 m^2, which is tau, and a little less."""
    truth = walk(straight_on, 12)
    tracks = walk(lambda n: {7: tuple(np.add(straight_on(n)[1], aside_m))}, 12)
    made = predictions(lambda n: {7: [(2.5, 1.0), (3.0, 1.0), (3.5, 1.0)]} if n == 4 else {}, 12)
    row, score = only(find_forecast_errors(made, tracks, truth, tracks))
    assert row["truth_id"] == truth_id
    assert score["false_forecasts"] == (truth_id == -1)
    assert score["scored"] == (truth_id == 1)


def test_a_forecast_that_veers_off():
    """1 m off to the side at the first step, 2 m at the second, 4 m at the third: by hand."""
    truth = walk(straight_on, 12)
    tracks = walk(lambda n: {7: straight_on(n)[1]}, 12)
    made = predictions(lambda n: {7: [(2.5, 1.0), (3.0, 2.0), (3.5, 4.0)]} if n == 4 else {}, 12)
    row, score = only(find_forecast_errors(made, tracks, truth, tracks))
    assert (row["track_id"], row["truth_id"], row["later_id"]) == (7, 1, 7)
    assert row["ade_m"] == pytest.approx((1 + 2 + 4) / 3)
    assert row["fde_m"] == pytest.approx(4.0)
    assert row["error_1s_m"] == pytest.approx(3.0)  # halfway between 0.8 s and 1.2 s
    assert row["within_95"] == pytest.approx(2 / 3)  # up to 2.45 deviations
    for name in ("ade_m", "fde_m", "error_1s_m", "within_95"):
        assert row["later_" + name] == row[name]
    assert (score["forecasts"], score["scored"], score["false_forecasts"], score["later_scored"]) == (1, 1, 0, 1)
    assert (score["ade_m"], score["ade_so_far_m"]) == pytest.approx((7 / 3, 7 / 3))


def test_errors_against_ground_truth_and_later_tracks_differ():
    """The track was half a metre beside the person until it was re-tracked: there are two errors."""
    truth = walk(straight_on, 12)
    tracks = walk(lambda n: {7: (0.5 * n, 0.5)}, 12)
    mended = walk(lambda n: {3: (0.5 * n, 0.2)}, 12)
    made = predictions(lambda n: {7: [(0.5 * (n + k), 0.5) for k in (1, 2, 3)]} if n == 5 else {}, 12)
    row, _ = only(find_forecast_errors(made, tracks, truth, mended))
    assert (row["truth_id"], row["later_id"]) == (1, 3)
    assert (row["ade_m"], row["later_ade_m"]) == pytest.approx((0.5, 0.3))


@pytest.mark.parametrize("truth", [None, [], walk(lambda n: {}, 12), walk(lambda n: {1: (np.nan, np.nan)}, 12)])
def test_without_ground_truth_forecasts_are_compared_with_later_tracks(truth):
    tracks = walk(straight_on, 12)
    made = predictions(lambda n: {1: [(0.5 * (n + k), 1.0) for k in (1, 2, 3)]} if n == 5 else {}, 12)
    row, score = only(find_forecast_errors(made, tracks, truth, tracks))
    assert (row["truth_id"], row["later_id"], row["later_ade_m"]) == (-1, 1, 1.0)
    assert np.isnan([row[name] for name in ("ade_m", "fde_m", "error_1s_m", "within_95")]).all()
    assert np.isnan([score[name] for name in ("scored", "false_forecasts", "ade_m", "ade_so_far_m")]).all()
    assert (score["later_scored"], score["later_fde_m"]) == (1, 1.0)


def test_ground_truth_of_another_time_is_ignored():
    tracks = walk(straight_on, 12)
    later = [frame._replace(t_ns=frame.t_ns + ns(100)) for frame in tracks]
    made = predictions(lambda n: {1: [(0.5 * (n + k), 1.0) for k in (1, 2, 3)]} if n == 5 else {}, 12)
    _, score = only(find_forecast_errors(made, tracks, later, tracks))
    assert np.isnan(score["false_forecasts"])


@pytest.mark.parametrize(
    ("step_s", "steps", "wanted"), [(0.5, 3, 2.0), (1.0, 2, 1.0), (1.0, 1, 1.0), (0.25, 3, None), (2.0, 3, None)]
)
def test_one_second_ahead_is_between_steps_and_not_outside(step_s, steps, wanted):
    """Off by 1 m at the first step, 2 m at the second and so on."""
    truth = walk(straight_on, 14, 1 / step_s)
    tell = [(0.5 * (5 + k), float(k)) for k in range(1, steps + 1)]
    made = predictions(lambda n: {1: tell} if n == 5 else {}, 14, step_s=step_s)
    row, _ = only(find_forecast_errors(made, truth, truth, truth))
    assert row["error_1s_m"] == pytest.approx(np.nan if wanted is None else wanted, nan_ok=True)


def test_forecasts_of_different_lengths_are_refused():
    truth = walk(straight_on, 12)
    made = predictions(lambda n: {1: [(0.0, 0.0)] * (2 if n == 5 else 3)} if n in (5, 6) else {}, 12)
    with pytest.raises(McaptrackError, match="/p: not all forecasts have 3 steps"):
        find_forecast_errors(made, truth, truth, truth, "/p")


def test_frames_without_forecasts_have_scores():
    found = find_forecast_errors(predictions(lambda n: {}, 4), walk(straight_on, 4), walk(straight_on, 4), [])
    assert [len(frame.rows) for frame in found.errors] == [0] * 4
    assert rows_of(found.scores)["forecasts"].tolist() == [0] * 4
    assert [list(frames) for frames in find_forecast_errors([], [], [], [])] == [[], []]


# Laws


@st.composite
def scenes(draw):
    """People who walk as they like and come and go, tracks that are near some of them, and forecasts of some."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    ticks, people = draw(st.integers(5, 18)), draw(st.integers(1, 5))
    paths = np.cumsum(rng.normal(0, 0.3, (people, ticks, 2)), axis=1) + rng.uniform(-2, 2, (people, 1, 2))
    seen = paths + rng.normal(0, draw(st.sampled_from([0.05, 0.5, 2.0])), paths.shape)
    there, tracked = rng.random((2, people, ticks)) < draw(st.sampled_from([0.8, 1.0]))

    def frames(places, mask, first):
        return walk(lambda n: {first + p: tuple(places[p, n]) for p in range(people) if mask[p, n]}, ticks)

    def predict(n):
        ahead = rng.normal(0, 1, (people, 3, 2))
        return {50 + p: seen[p, n] + ahead[p] for p in range(people) if tracked[p, n] and rng.random() < 0.9}

    return frames(paths, there, 1), frames(seen, tracked, 50), predictions(predict, ticks)


def evaluated(truth, tracks, made):
    options = EvaluateOptions(similarities=("metres",), gates_m=(1.0,))
    (result,) = evaluate([EvaluationInput("x", truth, [Candidate("t", None, tracks, made, "p")])], options).results
    return result.displacement and result.displacement.summary()


@given(scene=scenes())
def test_errors_and_scores_add_up_to_what_evaluate_prints(scene):
    truth, tracks, made = scene
    if not any(len(frame.rows) for frame in truth) or not any(len(frame.rows) for frame in tracks):
        return
    printed = evaluated(truth, tracks, made)
    if printed is None:
        return
    found = find_forecast_errors(made, tracks, truth, tracks)
    rows, scores = rows_of(found.errors), rows_of(found.scores)
    with_rows = [frame for frame in made if len(frame.rows)]
    assert scores["false_forecasts"].sum() / len(with_rows) == pytest.approx(printed["false_forecasts_per_frame"])
    known = np.isfinite(rows["ade_m"])
    assert scores["scored"].sum() == known.sum()
    if not known.any():
        assert printed["ADE_m"] is None
        return
    for name, theirs in (("ade_m", "ADE_m"), ("fde_m", "FDE_m"), ("within_95", "coverage_95")):
        assert rows[name][known].mean() == pytest.approx(printed[theirs], abs=1e-12)
        assert np.nansum(scores[name] * scores["scored"]) / known.sum() == pytest.approx(printed[theirs], abs=1e-12)
    assert scores["ade_so_far_m"][-1] == pytest.approx(printed["ADE_m"], abs=1e-12)
    assert scores["fde_so_far_m"][-1] == pytest.approx(printed["FDE_m"], abs=1e-12)


@given(scene=scenes(), seed=st.integers(0, 99))
def test_the_order_of_rows_does_not_matter(scene, seed):
    rng = np.random.default_rng(seed)

    def shuffled(frames):
        return [Frame(f.t_ns, f.index, f.rows[rng.permutation(len(f.rows))]) for f in frames]

    truth, tracks, made = scene
    once = find_forecast_errors(made, tracks, truth, tracks)
    again = find_forecast_errors(shuffled(made), shuffled(tracks), shuffled(truth), shuffled(tracks))
    for one, other in zip(once, again, strict=True):
        assert [f.rows.tobytes() for f in one] == [f.rows.tobytes() for f in other]


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32), people=st.integers(1, 6), tracks=st.integers(1, 6))
def test_pairs_are_those_of_least_total_distance(seed, people, tracks):
    """Against the definition, one time after another, with SciPy's solver for each."""
    rng = np.random.default_rng(seed)

    def some(count: int, first: int):
        return {
            first + who: {n: tuple(rng.normal(0, 1.5, 2)) for n in range(9) if rng.random() < 0.93}
            for who in range(count)
        }

    truth, seen = some(people, 1), some(tracks, 20)
    asked = [(n, who) for n in range(9) for who in seen if rng.random() < 0.7]
    if not asked:
        return
    made = forecasts(*(predicted(n, who, [(0.0, 0.0), (1.0, 1.0)]) for n, who in asked))
    found = pair_forecasts(positions(truth), positions(seen), made)

    def filled(path, n):
        known = sorted(path)
        if not known or not known[0] <= n <= known[-1]:
            return None
        return np.array([np.interp(n, known, [path[k][axis] for k in known]) for axis in (0, 1)])

    wanted = set()
    for n in sorted({n for n, _ in asked}):
        pasts = {who: [path.get(k) for k in range(n - 3, n + 1)] for who, path in truth.items()}
        pasts = {who: np.array(past) for who, past in pasts.items() if all(place is not None for place in past)}
        mine = {k: [filled(seen[who], at) for at in range(n - 3, n + 1)] for k, (m, who) in enumerate(asked) if m == n}
        mine = {k: np.array(past) for k, past in mine.items() if all(place is not None for place in past)}
        cost = np.array([[((a - b) ** 2).sum(axis=1).mean() for b in mine.values()] for a in pasts.values()])
        if cost.size:
            for row, column in zip(*linear_sum_assignment(cost), strict=True):
                who = list(pasts)[row]
                off = [
                    (np.array([k, k]) - truth[who][n + 1 + k]) if n + 1 + k in truth[who] else np.nan for k in (0, 1)
                ]
                is_known = not any(np.isnan(part).any() for part in off)
                total = np.round(np.sum(off), 9) if is_known else None
                wanted.add((list(mine)[column], who, round(cost[row, column], 9), total))
    assert {
        (int(k), int(who), round(d, 9), np.round(off.sum(), 9) if np.isfinite(off).all() else None)
        for k, who, d, off in zip(found.forecast, found.person, found.d_obs_m2, found.offset_m, strict=True)
    } == wanted


def test_pairing_is_independent_of_batches(monkeypatch):
    """Pairs are assigned in batches; the result does not depend on them."""
    rng = np.random.default_rng(3)
    truth = {who: {n: tuple(rng.normal(0, 3, 2)) for n in range(30)} for who in range(5)}
    made = forecasts(*(predicted(n, who, [(0.0, 0.0)]) for n in range(4, 29) for who in truth))
    once = pair_forecasts(positions(truth), positions(truth), made)
    monkeypatch.setattr("mcaptrack.evaluation.metrics.displacement._PAIRS_AT_ONCE", 60)
    again = pair_forecasts(positions(truth), positions(truth), made)
    assert len(once.forecast) == 25 * 5
    assert all(np.array_equal(a, b) for a, b in zip(once, again, strict=True))


# In a log


TRUTH = walk(straight_on, 20)
SAMPLES = walk(lambda n: {7: (0.5 * n, 0.25)}, 20)
BECAME = walk(lambda n: {3: (0.5 * n, 0.1)}, 20)
PREDICTED = predictions(lambda n: {7: [(0.5 * (n + k), 0.25) for k in (1, 2, 3)]} if n > 3 else {}, 20)
ERRORS, SCORES = "/camera/predictions/errors", "/camera/predictions/scores"


def written(path, **channels):
    """A log of rows, all of which we made."""
    with log.create(path) as writer:
        for place, (name, frames) in enumerate(channels.items()):
            schema = PREDICTIONS if name == "predictions" else TRACKS
            messages = [(f.t_ns, f.index, schema.codec.encode(f.rows)) for f in frames]
            made = Provenance("ingest", {"of": place}, digest=digest(messages))
            record = (schema.name, "protobuf", schema.descriptor)
            number = writer.add_channel(f"/camera/{name}", record, "protobuf", made.to_metadata())
            for t_ns, index, payload in messages:
                writer.add_message(number, t_ns, index, payload)
    return path


def watched(path, again: bool = False):
    with log.read(path) as opened:
        return pipeline.run(opened, "/camera", [], watch=pipeline.Watch(again=again))


ALL = {"samples": SAMPLES, "predictions": PREDICTED, "retracks": BECAME, "truth": TRUTH}


def test_errors_are_channels_beside_the_forecasts(tmp_path):
    path = written(tmp_path / "a.mcap", **ALL)
    watched(path)
    with log.read(path) as opened:
        errors, scores = opened.frames(ERRORS, FORECAST_ERRORS), opened.frames(SCORES, FORECAST_SCORES)
        assert [(f.t_ns, f.index) for f in errors] == [(f.t_ns, f.index) for f in scores]
        assert [f.t_ns for f in errors] == [f.t_ns for f in PREDICTED]
        rows = rows_of(errors)
        assert set(rows["truth_id"]) == {1}
        assert set(rows["later_id"]) == {3}
        known = np.isfinite(rows["ade_m"])
        assert known.sum() == 13
        assert rows["ade_m"][known] == pytest.approx(0.25)
        assert rows["later_ade_m"][known] == pytest.approx(0.15)
        made = Provenance.from_metadata(opened.channel(ERRORS).metadata)
        now = {topic: Provenance.from_metadata(opened.channel(topic).metadata).digest for topic in opened.channels}
        names = ("predictions", "samples", "retracks", "truth")
        assert made.made_from() == {f"/camera/{name}": now[f"/camera/{name}"] for name in names}
    assert watched(path, again=True).stages == ["events"]
    once = path.read_bytes()
    assert watched(path).stages == []
    assert watched(path, again=True).stages == ["events"]
    assert path.read_bytes() == once
    assert log.check(path).is_sound


@pytest.mark.parametrize("name", ["predictions", "samples", "retracks", "truth"])
def test_every_input_makes_errors_out_of_date(tmp_path, name):
    path = written(tmp_path / "a.mcap", **ALL)
    watched(path)
    other = written(tmp_path / "b.mcap", **ALL | {name: ALL[name][:-2]})
    with log.read(other) as opened:
        taken = list(opened.messages(f"/camera/{name}"))
        channel = opened.channel(f"/camera/{name}")
    with log.read(path) as opened, log.extend(opened, drop={f"/camera/{name}"}) as writer:
        schema = PREDICTIONS if name == "predictions" else TRACKS
        record = (schema.name, "protobuf", schema.descriptor)
        number = writer.add_channel(channel.topic, record, "protobuf", channel.metadata)
        for message in taken:
            writer.add_message(number, message.t_ns, message.sequence, message.payload)
    with log.read(path) as opened:
        assert pipeline.is_stale(opened, ERRORS)
        assert pipeline.is_stale(opened, SCORES)
    watched(path)
    with log.read(path) as opened:
        assert not pipeline.is_stale(opened, ERRORS)
    assert watched(path).stages == []


def test_forecasts_are_compared_with_re_tracked_tracks(tmp_path):
    """Before re-tracking a forecast is compared with its own track, afterwards with the re-tracked one."""
    path = written(tmp_path / "a.mcap", samples=SAMPLES, predictions=PREDICTED)
    watched(path)
    with log.read(path) as opened:
        rows = rows_of(opened.frames(ERRORS, FORECAST_ERRORS))
        assert set(rows["later_id"]) == {7}
        assert rows["later_ade_m"][0] == pytest.approx(0.0)
        layout = json.loads(opened.attachment("mcaptrack.predictions.layout.json"))
        assert layout["configById"]["Plot!errors"]["foxglovePanelTitle"].endswith("later tracks")
    with log.read(path) as opened, log.extend(opened) as writer:
        made = Provenance("retrack", {}, "/camera/samples", digest="x").to_metadata()
        number = writer.add_channel("/camera/retracks", (TRACKS.name, "protobuf", TRACKS.descriptor), "protobuf", made)
        for frame in BECAME:
            writer.add_message(number, frame.t_ns, frame.index, TRACKS.codec.encode(frame.rows))
    watched(path)
    with log.read(path) as opened:
        assert set(rows_of(opened.frames(ERRORS, FORECAST_ERRORS))["later_id"]) == {3}


def test_the_layout_plots_what_is_known(tmp_path):
    path = written(tmp_path / "a.mcap", **ALL)
    watched(path)
    with log.read(path) as opened:
        panels = json.loads(opened.attachment("mcaptrack.predictions.layout.json"))["configById"]
    assert panels["Plot!errors"]["foxglovePanelTitle"] == "Prediction errors (m), against ground truth"
    assert {curve["value"]: curve["label"] for curve in panels["Plot!errors"]["paths"]} == {
        "/camera/predictions/scores.rows[:].ade_m": "ADE, tracker",
        "/camera/predictions/scores.rows[:].fde_m": "FDE, tracker",
    }
    assert {curve["value"]: curve["label"] for curve in panels["Plot!spread"]["paths"]} == {
        "/camera/predictions/scores.rows[:].spread_mean_m": "mean (m)",
        "/camera/predictions/scores.rows[:].spread_90_m": "90 % (m)",
    }


def test_forecasts_without_reference_do_not_fail_a_run(tmp_path):
    odd = predictions(lambda n: {1: [(0.0, 0.0)] * (2 if n == 5 else 3)} if n in (5, 6) else {}, 20)
    path = written(tmp_path / "a.mcap", **ALL | {"predictions": odd})
    with log.read(path) as opened, notices.collected() as heard:
        pipeline.run(opened, "/camera", [], watch=pipeline.Watch())
    assert [notice.message for notice in heard] == [
        "no errors of forecasts: /camera/predictions: not all forecasts have 3 steps"
    ]
    with log.read(path) as opened:
        assert ERRORS not in opened.channels


def test_a_recorded_channel_is_never_replaced(tmp_path):
    path = written(tmp_path / "a.mcap", **ALL)
    with log.read(path) as opened, log.extend(opened) as writer:
        writer.add_message(writer.add_channel(SCORES, ("", "", b""), "json", {}), 0, 0, b"{}")
    with log.read(path) as opened, notices.collected() as heard:
        pipeline.run(opened, "/camera", [], watch=pipeline.Watch(again=True))
    assert [notice.message for notice in heard] == [
        f"no errors of /camera/predictions: they would replace {SCORES}, which was recorded by others (no schema)"
    ]
    with log.read(path) as opened:
        assert [message.payload for message in opened.messages(SCORES)] == [b"{}"]
        assert ERRORS not in opened.channels


def test_drop_takes_errors_along_and_tables_have_them(tmp_path):
    path = written(tmp_path / "a.mcap", **ALL)

    def call(*words):
        result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
        assert result.exit_code == 0, result.output

    call("events", path)
    call("export", path, "-o", tmp_path / "tables")
    for name, schema in (("forecast_errors", FORECAST_ERRORS), ("forecast_scores", FORECAST_SCORES)):
        table = pq.read_table(tmp_path / "tables" / name / "recording=a" / "part-0.parquet")
        assert {column.name for column in schema.columns} <= set(table.column_names)
    table = pq.read_table(tmp_path / "tables" / "forecast_errors" / "recording=a" / "part-0.parquet").to_pylist()
    assert [row["ade_m"] for row in table][-4:] == [pytest.approx(0.25), None, None, None]
    call("drop", path, "/camera/predictions")
    with log.read(path) as opened:
        assert not [topic for topic in opened.channels if topic.startswith("/camera/predictions")]
