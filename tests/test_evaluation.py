"""Scores of logs and label files against ground truth."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import Candidate, EvaluateOptions, EvaluationInput, evaluate
from mcaptrack.predictors import Forecast
from mcaptrack.schema import PREDICTIONS, Frame
from mcaptrack.schema.predictions import forecast_to_rows
from tests.worlds import boxed, ns, tracks_at, walk

METRES = EvaluateOptions(similarities=("metres",), gates_m=(1.0,))


def scored(truth, tracks, options=METRES, forecasts=None):
    outcome = evaluate([EvaluationInput("x", truth, [Candidate("t", None, tracks, forecasts, "p")])], options)
    return [result.to_json() for result in outcome.results]


@pytest.mark.parametrize("similarity", ["metres", "iou"])
def test_rows_that_cannot_be_compared_are_as_if_they_were_not_there(similarity):
    """Of the ground truth and of the tracks, in the first frame, in the middle and in the last one."""
    rng = np.random.default_rng(3)
    options = EvaluateOptions(similarities=(similarity,), gates_m=(1.0,))
    whole, lacking, without = [], [], []
    for n in range(12):
        places = {number: (10.0 * number + n, rng.normal(0, 0.2)) for number in (3, 5, 8)}
        rows = tracks_at(places) if similarity == "metres" else boxed({k: (20 * x, y) for k, (x, y) in places.items()})
        gone = rng.random(3) < (0.7 if n in (0, 6, 11) else 0.1)
        odd = rows.copy()
        for name in ("x_m", "y_m") if similarity == "metres" else ("x_px", "y_px", "w_px", "h_px"):
            odd[name][gone] = np.nan
        whole.append(Frame(ns(n), n, rows))
        lacking.append(Frame(ns(n), n, odd))
        without.append(Frame(ns(n), n, rows[~gone]))
    for one, other in ((whole, lacking), (lacking, whole), (lacking, lacking)):
        same = [without if some is lacking else some for some in (one, other)]
        assert scored(one, other, options) == scored(*same, options)


def test_frames_without_tracks_count_as_missed():
    truth = walk(lambda n: {1: (float(n), 0.0)}, 10)
    (row,) = scored(truth, truth[:7])
    assert (row["FN"], row["FP"]) == (3, 0)


def test_tracks_with_more_frames_are_scored_at_labelled_times():
    truth = walk(lambda n: {1: (float(n), 0.0)}, 10)
    tracks = [Frame(ns(n / 30), n, tracks_at({1: (n / 12, 0.0)})) for n in range(9 * 12 + 1)]
    (row,) = scored(truth, tracks)
    assert (row["MOTA"], row["FN"], row["FP"]) == (1.0, 0, 0)


def test_ground_truth_is_resampled_to_the_prediction_rate():
    """Truth at 7 frames a second, tracks at 2.5: no time in common but a few, all rows comparable."""
    truth = [Frame(ns(n / 7), n, tracks_at({1: (n / 7, 0.0)})) for n in range(71)]
    tracks = walk(lambda n: {1: (0.4 * n, 0.05)}, 26)
    (row,) = scored(truth, tracks)
    assert (row["MOTA"], row["FN"], row["FP"]) == (1.0, 0, 0)


def test_unlabelled_times_are_not_scored():
    truth = [Frame(ns(n / 7), n, tracks_at({1: (0.0, 0.0)})) for n in range(35)]  # 5 s
    tracks = walk(lambda n: {1: (0.0, 0.0), 2: (50.0, 0.0)}, 50)  # 20 s
    (row,) = scored(truth, tracks)
    assert row["FP"] == 13  # the ghost, at the 13 ticks within the labels


def test_boxes_and_metres_are_scored_where_both_sides_have_them():
    boxes = [Frame(ns(n), n, boxed({1: (5 * n, 0)})) for n in range(5)]
    rows = scored(boxes, boxes, EvaluateOptions())
    assert [(row["similarity"], row["gate"], row["MOTA"]) for row in rows] == [("iou", 0.5, 1.0)]
    with pytest.raises(McaptrackError, match="the ground truth and t have no positions in metres"):
        scored(boxes, boxes, METRES)
    with pytest.raises(McaptrackError, match="t and the ground truth share neither boxes nor positions"):
        scored(boxes, walk(lambda n: {1: (0.0, 0.0)}, 13), EvaluateOptions())


def test_input_that_cannot_be_compared_is_refused_not_scored_as_zero():
    truth = walk(lambda n: {1: (0.0, 0.0)}, 5)
    later = [frame._replace(t_ns=frame.t_ns + ns(1000)) for frame in truth]
    with pytest.raises(
        McaptrackError, match=r"the ground truth \(0\.000 to 1\.600 s\) and t \(1000\.000 to .*never overlap in time"
    ):
        scored(truth, later)
    with pytest.raises(McaptrackError, match="the ground truth of x is empty"):
        scored(walk(lambda n: {}, 5), truth)


def test_several_sequences_are_combined():
    truth = walk(lambda n: {1: (float(n), 0.0)}, 10)
    sequences = [
        EvaluationInput(name, truth, [Candidate("t", None, tracks)])
        for name, tracks in (("a", truth), ("b", truth[:5]))
    ]
    rows = [result.to_json() for result in evaluate(sequences, METRES).results]
    assert [(row["sequence"], row["FN"]) for row in rows] == [("a", 0), ("b", 5), ("COMBINED", 5)]
    assert rows[2]["MOTA"] == pytest.approx(0.75)
    assert rows[2]["GT"] == 2


def test_forecasts_are_compared_with_the_true_future():
    """Constant velocity for a person who turns after 4 s: right before, wrong after, and not judged at the end."""

    def path(n):
        return {1: (0.5 * min(n, 10), 0.5 * max(n - 10, 0))}

    truth = walk(path, 30)
    frames = []
    for n in range(30):
        x, y = path(n)[1]
        mean = np.array([[[x + 0.5 * k, y] for k in range(1, 4)]])
        rows = forecast_to_rows(np.array([1]), Forecast(mean, np.tile(np.eye(2), (1, 3, 1, 1))), 0.4)
        frames.append(Frame(ns(0.4 * n), n, rows if n >= 3 else PREDICTIONS.empty()))
    (row,) = scored(truth, truth, METRES, frames)
    found = row["displacement"]
    assert found["recall"] == 1.0
    assert found["ADE_m"] > 0
    assert len(found["curve_recall"]) == 24  # ticks 3 to 26 have a past and a future
    assert found["curve_recall"][-1] == 1.0
    early = [frame for frame in frames if frame.index <= 7]
    (row,) = scored(truth, truth, METRES, early)
    assert row["displacement"]["ADE_m"] == pytest.approx(0.0, abs=1e-12)
