"""Errors of forecasts: scenes counted by hand, laws, and the channels in a log."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

import mcaptrack
from mcaptrack import log, notices, pipeline
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import Candidate, EvaluateOptions, EvaluationInput, evaluate
from mcaptrack.evaluation.forecasts import find_forecast_errors, score_forecasts, smoothed_predictions
from mcaptrack.evaluation.metrics.displacement import combine_displacements, displacement, pair_forecasts
from mcaptrack.predictors import Forecast
from mcaptrack.schema import FORECAST_ERRORS, FORECAST_SCORES, PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.as_rows import forecast_to_rows
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import Predict
from tests.commands import done, printed
from tests.forecasts import forecasts, positions, predicted
from tests.logs import add_rows
from tests.worlds import ns, replace_channel, walk, write_channels

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
def test_constant_velocity_beside_forecasts_is_what_its_predictor_scores(scene):
    truth, tracks, _ = scene
    made = [frame for (frame,) in Predict(predictor="cv", horizon_s=3 * STEP_S)(tracks)]
    moved = [frame._replace(rows=frame.rows.copy()) for frame in made]
    for frame in moved:
        frame.rows["x_m"] += 1.0
    scored = [score_forecasts(forecasts, tracks, truth, "p") for forecasts in (made, moved)]
    if None in scored:
        return
    beside = [displacement.constant_velocity() for displacement in scored]
    assert beside[0] == pytest.approx({name: scored[0].summary()[name] for name in ("ADE_m", "FDE_m")}, abs=1e-9)
    assert beside[1] == pytest.approx(beside[0], abs=1e-9)
    both = combine_displacements(scored).constant_velocity()
    assert both == pytest.approx(beside[0], abs=1e-9)


@given(scene=scenes(), seed=st.integers(0, 99))
def test_errors_and_scores_add_up_to_what_evaluate_prints_in_any_order_of_rows(scene, seed):
    rng = np.random.default_rng(seed)

    def shuffled(frames):
        return [Frame(f.t_ns, f.index, f.rows[rng.permutation(len(f.rows))]) for f in frames]

    truth, tracks, made = scene
    if not any(len(frame.rows) for frame in truth) or not any(len(frame.rows) for frame in tracks):
        return
    printed = evaluated(truth, tracks, made)
    if printed is None:
        return
    found = find_forecast_errors(shuffled(made), shuffled(tracks), shuffled(truth), tracks)
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
    given_all = positions(truth), positions(seen), made
    found = pair_forecasts(*given_all)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mcaptrack.evaluation.metrics.displacement._PAIRS_AT_ONCE", 12)
        for one, other in zip(pair_forecasts(*given_all), found, strict=True):
            np.testing.assert_array_equal(one, other)

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


# In a log


TRUTH = walk(straight_on, 20)
SAMPLES = walk(lambda n: {7: (0.5 * n, 0.25)}, 20)
BECAME = walk(lambda n: {3: (0.5 * n, 0.1)}, 20)
PREDICTED = predictions(lambda n: {7: [(0.5 * (n + k), 0.25) for k in (1, 2, 3)]} if n > 3 else {}, 20)
ERRORS, SCORES = "/camera/predictions/errors", "/camera/predictions/scores"


def watched(path, again: bool = False):
    with log.read(path) as opened:
        return pipeline.run(opened, "/camera", [], finishing=[pipeline.Watch(again=again)], views=True)


ALL = {"samples": SAMPLES, "predictions": PREDICTED, "retracks": BECAME, "truth": TRUTH}


def test_errors_are_channels_beside_the_forecasts(tmp_path):
    path = write_channels(tmp_path / "a.mcap", **ALL)
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
    path = write_channels(tmp_path / "a.mcap", **ALL)
    watched(path)
    replace_channel(path, f"/camera/{name}", ALL[name][:-2])
    with log.read(path) as opened:
        assert pipeline.is_stale(opened, ERRORS)
        assert pipeline.is_stale(opened, SCORES)
    watched(path)
    with log.read(path) as opened:
        assert not pipeline.is_stale(opened, ERRORS)
    assert watched(path).stages == []


def test_the_layout_plots_what_is_known(tmp_path):
    path = write_channels(tmp_path / "a.mcap", **ALL)
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
    path = write_channels(tmp_path / "a.mcap", **ALL | {"predictions": odd})
    with log.read(path) as opened, notices.collected() as heard:
        pipeline.run(opened, "/camera", [], finishing=[pipeline.Watch()])
    assert [notice.message for notice in heard] == [
        "no errors of forecasts: /camera/predictions: not all forecasts have 3 steps"
    ]
    with log.read(path) as opened:
        assert ERRORS not in opened.channels


def test_drop_takes_errors_along_and_tables_have_them(tmp_path):
    path = write_channels(tmp_path / "a.mcap", **ALL)

    done("events", path)
    done("export", path, "-o", tmp_path / "tables")
    for name, schema in (("forecast_errors", FORECAST_ERRORS), ("forecast_scores", FORECAST_SCORES)):
        table = pq.read_table(tmp_path / "tables" / name / "recording=a" / "part-0.parquet")
        assert {column.name for column in schema.columns} <= set(table.column_names)
    table = pq.read_table(tmp_path / "tables" / "forecast_errors" / "recording=a" / "part-0.parquet").to_pylist()
    assert [row["ade_m"] for row in table][-4:] == [pytest.approx(0.25), None, None, None]
    done("drop", path, "/camera/predictions")
    with log.read(path) as opened:
        assert not [topic for topic in opened.channels if topic.startswith("/camera/predictions")]


# SORT + smoothing and the curves of error over recall


RECORDED = Provenance("record", {})
SVG = "{http://www.w3.org/2000/svg}"


def smoothed_past(xy: np.ndarray) -> np.ndarray:
    """Eq. 3 of the paper with alpha = beta = 0.5 on a whole track (T, 2); positions rebuilt back from the last one."""
    level, trend, steps = None, np.zeros(2), []
    for k in range(1, len(xy)):
        moved = xy[k] - xy[k - 1]
        if level is None:
            level = moved
        else:
            before, level = level, 0.5 * moved + 0.5 * (level + trend)
            trend = 0.5 * (level - before) + 0.5 * trend
        steps.append(level)
    out = [xy[-1]]
    for moved in reversed(steps):
        out.append(out[-1] - moved)
    return np.array(out[::-1])


def of_track(frames: list[Frame], number: int) -> dict[int, np.ndarray]:
    rows = {frame.index: frame.rows[frame.rows["track_id"] == number] for frame in frames}
    return {k: np.stack([one["x_m"], one["y_m"]], axis=-1) for k, one in rows.items() if len(one)}


@pytest.mark.parametrize("predictor", ["cv", "kalman"])
def test_smoothed_predictions_are_those_of_smoothed_tracks(predictor):
    """Two tracks, one of which begins late, has a gap and begins again, and their pasts smoothed one by one."""
    rng = np.random.default_rng(8)
    noise = rng.normal(0, 0.3, (30, 3, 2))
    here = {1: range(30), 2: [*range(5, 14), *range(17, 30)]}

    def path(n):
        return {who: (0.5 * n + noise[n, who, 0], 4.0 * who + noise[n, who, 1]) for who in here if n in here[who]}

    samples, predict = walk(path, 30), Predict(predictor=predictor, horizon_s=1.2)
    found = list(smoothed_predictions(samples, predict))
    assert [frame.t_ns for frame in found] == [frame.t_ns for frame in samples]
    runs = {1: [range(30)], 2: [range(5, 14), range(17, 30)]}
    for who, parts in runs.items():
        predictions = of_track(found, who)
        assert sorted(predictions) == [n for part in parts for n in part[3:]]
        for part in parts:
            for n in part[3:]:
                xy = smoothed_past(np.array([path(k)[who] for k in part if k <= n]))[-8:]
                alone = walk(lambda k, xy=xy: {1: tuple(xy[k])}, len(xy))
                *_, (wanted,) = predict(alone)
                np.testing.assert_allclose(predictions[n], of_track([wanted], 1)[wanted.index], atol=1e-6)


def swept(truth: dict, tracks: dict, made: list[tuple], tau: float, horizon: int) -> tuple[float, float, float]:
    """Recall, ADE and squared ADE at one threshold: Eq. 4 and 5 of the paper, a Hungarian assignment for each time."""
    people, errors, squared = 0, [], []
    for step in sorted({one[0] for one in made}):
        subjects = [who for who, path in truth.items() if all(step + k in path for k in range(-3, 1))]
        own = [one for one in made if one[0] == step]
        cost = np.array(
            [
                [
                    np.mean([np.sum((np.array(truth[s][step - k]) - tracks[o[1]][step - k]) ** 2) for k in range(4)])
                    for o in own
                ]
                for s in subjects
            ]
        ).reshape(len(subjects), len(own))
        known = [s for s in subjects if all(step + k in truth[s] for k in range(1, horizon + 1))]
        people += len(known)
        for row, column in zip(*linear_sum_assignment(cost), strict=True):
            if cost[row, column] < tau and subjects[row] in known:
                true = np.array([truth[subjects[row]][step + k] for k in range(1, horizon + 1)])
                off = np.sum((np.array(own[column][2]) - true) ** 2, axis=1)
                errors.append(np.sqrt(off).mean())
                squared.append(off.mean())
    return len(errors) / people, float(np.mean(errors)), float(np.mean(squared))


def test_the_curve_is_that_of_matching_at_each_threshold_from_the_start():
    """Six people who cross, tracks with errors of all sizes, and two tracks of no one."""
    rng = np.random.default_rng(2)
    truth = {
        who: {n: tuple(rng.uniform(-6, 6, 2) * 0.1 + [0.6 * n * (-1) ** who, 1.1 * who]) for n in range(16)}
        for who in range(6)
    }
    tracks = {
        who + 10: {n: tuple(np.array(truth[who % 6][n]) + rng.normal(0, 0.3 + 0.4 * who, 2)) for n in range(16)}
        for who in range(8)
    }
    made = [
        predicted(n, who, [tuple(np.array(tracks[who][n]) + rng.normal(0, 1, 2)) for _ in range(3)])
        for who in tracks
        for n in range(3, 16, 2)
    ]
    result = displacement(positions(truth), positions(tracks), forecasts(*made))
    (recall, error), (_, squared) = result.curve(), result.curve(squared=True)
    d_obs = np.sort(result.d_obs_m2)
    assert len(recall) > 25
    for tau in (*np.quantile(d_obs, [0.1, 0.3, 0.5, 0.9]) + 1e-9, 1e9):
        at = int((d_obs < tau).sum()) - 1
        assert (recall[at], error[at], squared[at]) == pytest.approx(swept(truth, tracks, made, tau, 3))


@pytest.fixture(scope="module")
def walked(tmp_path_factory) -> Path:
    """Three people tracked with noise and predicted, also as if by re-tracking, and their ground truth."""
    noise = np.random.default_rng(5).normal(0, 0.15, (40, 3, 2))
    truth = walk(lambda n: {who: (0.4 * n, 3.0 * who) for who in range(3)}, 40)
    samples = walk(lambda n: {w: (0.4 * n + noise[n, w, 0], 3.0 * w + noise[n, w, 1]) for w in range(3)}, 40)
    predict = Predict(predictor="cv", min_history=3)
    made = [frame for (frame,) in predict(samples)]
    known = Provenance("predict", {"predictor": "cv", "min_history": 3, "rate_hz": 2.5})
    file = tmp_path_factory.mktemp("walked") / "walked.mcap"
    with log.create(file) as writer:
        for topic, frames in {"truth": truth, "samples": samples, "retracks/online": samples}.items():
            add_rows(writer, f"/camera/{topic}", TRACKS, frames, made=RECORDED)
        for topic in ("predictions", "retracks/predictions"):
            add_rows(writer, f"/camera/{topic}", PREDICTIONS, made, made=known)
    return file


def test_evaluate_scores_smoothed_samples_and_draws_the_curves(walked, tmp_path):
    out, _ = printed(
        "evaluate", walked, "--set", "smoothed=true", "--curves", tmp_path / "a.svg", "--gate-m", "1", "--json"
    )
    rows = {one["tracks"]: one["displacement"] for one in json.loads(out)["results"]}
    assert list(rows) == ["/camera/samples", "/camera/retracks/online", "/camera/samples, smoothed"]
    plain, smoothed = rows["/camera/samples"], rows["/camera/samples, smoothed"]
    assert smoothed["recall"] == plain["recall"] == 1.0
    assert smoothed["ADE_m"] < plain["ADE_m"]
    with log.read(walked) as opened:
        samples, truth = (opened.frames(f"/camera/{name}", TRACKS) for name in ("samples", "truth"))
        predict = Predict(predictor="cv", min_history=3)
        candidate = mcaptrack.evaluation.Candidate("t", None, samples, list(smoothed_predictions(samples, predict)))
        given = mcaptrack.evaluation.EvaluationInput("walked", truth, [candidate])
        wanted = mcaptrack.evaluation.evaluate([given], mcaptrack.evaluation.EvaluateOptions(("metres",), (1.0,)))
        assert smoothed["ADE_m"] == pytest.approx(wanted.results[0].to_json()["displacement"]["ADE_m"])
    drawing = ElementTree.parse(tmp_path / "a.svg").getroot()
    charts = drawing.findall(f"{SVG}g")
    assert len(charts) == 2  # in metres, and squared
    for chart in charts:
        assert len(chart.findall(f"{SVG}polyline")) == len(chart.findall(f"{SVG}circle")) == 3
        names = [text.text for text in chart.iter(f"{SVG}text") if "name" in text.get("class", "")]
        assert sorted(names) == sorted(rows)


def test_curves_end_where_the_scores_say(walked, tmp_path):
    """The error at the full recall of 1, in the coordinates of the axes."""
    scores = mcaptrack.evaluate(walked, gate_m=1.0)
    drawing = ElementTree.parse(scores.draw_curves(tmp_path / "b.svg")).getroot()
    (row, *_) = scores.rows()
    for chart, wanted in zip(drawing.findall(f"{SVG}g"), ("ADE_m", "ADE_squared_m2"), strict=True):
        ticks = {
            float(text.text or ""): float(text.get("y", ""))
            for text in chart.iter(f"{SVG}text")
            if text.get("class") == "end"
        }
        low, high = min(ticks), max(ticks)
        x, y = map(float, chart.findall(f"{SVG}polyline")[0].get("points", "").split()[-1].split(","))
        axis = max(float(line.get("x2", "")) for line in chart.iter(f"{SVG}line"))
        assert x == pytest.approx(axis, abs=0.1)
        value = low + (ticks[low] - y) / (ticks[low] - ticks[high]) * (high - low)
        assert value == pytest.approx(row["displacement"][wanted], abs=0.02)


def test_curves_need_predictions_and_do_not_replace_files(walked, tmp_path):
    scores = mcaptrack.evaluate(walked, gate_m=1.0)
    scores.draw_curves(tmp_path / "c.svg")
    with pytest.raises(McaptrackError, match="exists"):
        scores.draw_curves(tmp_path / "c.svg")
    assert scores.draw_curves(tmp_path / "c.svg", force=True) == tmp_path / "c.svg"
    without = mcaptrack.evaluate(walked, gate_m=1.0, topic="/camera/truth")
    with pytest.raises(McaptrackError, match="no predictions were scored; there are no curves to draw"):
        without.draw_curves(tmp_path / "d.svg")


def test_predictions_of_unknown_making_are_not_smoothed(tmp_path):
    file = tmp_path / "recorded.mcap"
    samples = walk(lambda n: {1: (0.4 * n, 0.0)}, 20)
    with log.create(file) as writer:
        for topic in ("truth", "samples"):
            add_rows(writer, f"/camera/{topic}", TRACKS, samples, made=RECORDED)
    with pytest.raises(McaptrackError, match=r"recorded\.mcap has no /camera/predictions; .* makes them"):
        mcaptrack.evaluate(file, smoothed=True)
    with log.create(tmp_path / "b.mcap") as writer:
        for topic in ("truth", "samples"):
            add_rows(writer, f"/camera/{topic}", TRACKS, samples, made=RECORDED)
        add_rows(writer, "/camera/predictions", PREDICTIONS, [f for (f,) in Predict()(samples)], made=RECORDED)
    with pytest.raises(McaptrackError, match=r"/camera/predictions of .*b.mcap is recorded: how it was predicted"):
        mcaptrack.evaluate(tmp_path / "b.mcap", smoothed=True)
