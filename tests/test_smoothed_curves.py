"""SORT + smoothing and the curves of error over recall, against the definitions of the paper written out slowly."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.forecasts import smoothed_predictions
from mcaptrack.evaluation.metrics.displacement import displacement
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import Predict
from tests.commands import printed
from tests.forecasts import forecasts, positions, predicted
from tests.logs import add_rows
from tests.worlds import walk

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
    """The predicted positions of a track by frame."""
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
    out, _ = printed("evaluate", walked, "--smoothed", "--curves", tmp_path / "a.svg", "--gate-m", "1", "--json")
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
