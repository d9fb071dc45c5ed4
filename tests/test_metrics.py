"""Scores: cases by hand, py-motmetrics as oracle, TrackEval's numbers on real sequences."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import Candidate, EvaluateOptions, EvaluationInput, evaluate, metrics
from mcaptrack.evaluation.metrics import Matchup, combine, distances, metres_to_similarity, score, summary
from mcaptrack.evaluation.metrics.displacement import combine_displacements, displacement
from mcaptrack.evaluation.metrics.matchup import SparseTables
from mcaptrack.evaluation.occupancy import occupancy
from mcaptrack.geometry.boxes import iou
from mcaptrack.predictors import Forecast
from mcaptrack.schema import PREDICTIONS, Frame
from mcaptrack.schema.as_rows import forecast_to_rows
from tests.forecasts import forecasts, positions, predicted
from tests.worlds import boxed, ns, tracks_at, walk


def matchup(truth, tracks, gate: float = 1.0) -> Matchup:
    """People and tracks as {id: x} a frame, on a line, in metres."""
    true_ids = sorted({who for frame in truth for who in frame})
    track_ids = sorted({who for frame in tracks for who in frame})

    def points(frame):
        return np.array([[x, 0.0] for x in frame.values()]).reshape(-1, 2)

    return Matchup(
        tuple(np.array([true_ids.index(who) for who in frame], int) for frame in truth),
        tuple(np.array([track_ids.index(who) for who in frame], int) for frame in tracks),
        tuple(metres_to_similarity(distances(points(a), points(b)), gate) for a, b in zip(truth, tracks, strict=True)),
        0.5,
        len(true_ids),
        len(track_ids),
    )


def sparse(dense: Matchup) -> Matchup:
    """The same with tables of which only the similarities above 0 are stored."""
    frame, row, column, _, _, similarity = dense.pairs
    ends = (np.cumsum([0, *counts]) for counts in (dense.ground_truth_counts, dense.track_counts))
    return replace(dense, similarity=SparseTables(frame, row, column, similarity, *ends))


ONE = [{1: float(n)} for n in range(10)]
TWO = [{1: float(n), 2: 50.0} for n in range(10)]
CASES = {
    # what happens: truth, tracks, and what it counts
    "no people, no tracks": ([{}] * 3, [{}] * 3, {"MOTA": 0.0, "IDF1": 0.0, "FP": 0, "FN": 0, "GT": 0}),
    "too far away": (ONE, [{1: n + 1.01} for n in range(10)], {"FP": 10, "FN": 10, "MOTA": -1.0, "IDF1": 0.0}),
    "just near enough": (ONE, [{1: n + 0.99} for n in range(10)], {"FP": 0, "FN": 0, "MOTA": 1.0}),
    "one switch": (
        ONE,
        [{5 if n < 6 else 6: float(n)} for n in range(10)],
        {"IDSW": 1, "MOTA": 0.9, "IDF1": 0.6, "FP": 0, "FN": 0, "MT": 1, "Frag": 0},
    ),
    "a gap without any track, which the devkit skips": (
        ONE,
        [{} if n in (4, 5) else {5: float(n)} for n in range(10)],
        {"FN": 2, "Frag": 0, "IDSW": 0, "PT": 1},
    ),
    "a hole and another id": (
        TWO,
        [{9: 50.0} if n in (4, 5) else {5 if n < 4 else 6: float(n), 9: 50.0} for n in range(10)],
        {"FN": 2, "Frag": 1, "IDSW": 1, "MOTA": 0.85},
    ),
    "two who exchange names": (
        [{1: 0.0, 2: 10.0}] * 10,
        [{1: 0.0, 2: 10.0} if n < 5 else {2: 0.0, 1: 10.0} for n in range(10)],
        {"IDSW": 2, "IDF1": 0.5, "FP": 0, "FN": 0},
    ),
    "partly tracked": (ONE, [{1: float(n)} if n < 5 else {} for n in range(10)], {"PT": 1, "MT": 0, "ML": 0}),
}


@pytest.mark.parametrize(("truth", "tracks", "wanted"), CASES.values(), ids=CASES)
def test_cases_by_hand(truth, tracks, wanted):
    found = summary(score(matchup(truth, tracks)))
    assert {name: found[name] for name in wanted} == pytest.approx(wanted)


def test_people_of_other_parts_of_a_sequence_are_in_no_count():
    """The ids of a matchup may be those of a whole sequence, of which it has a part."""
    first = np.array([0])
    found = metrics.clear(Matchup((first,), (first,), (np.ones((1, 1)),), 0.5, n_ground_truth=3, n_tracks=2))
    assert [int(found[name]) for name in ("MT", "PT", "ML", "GT")] == [1, 0, 0, 1]


@pytest.mark.parametrize("rules", ["trackeval", "motmetrics"])
def test_tables_that_are_stored_sparsely_give_the_same_scores(rules, monkeypatch):
    rng = np.random.default_rng(3)
    frames = [
        [{int(one): float(rng.uniform(0, 6)) for one in rng.permutation(9)[: rng.integers(0, 8)]} for _ in range(40)]
        for _ in range(2)
    ]
    dense = matchup(*frames)
    other = sparse(dense)
    assert len(other.similarity) == len(dense.similarity)
    for one, two in zip(other.similarity, dense.similarity, strict=True):
        np.testing.assert_array_equal(one, two)
    wanted = score(dense, rules)
    kept = np.arange(9) % 3 > 0
    some = [summary(score(metrics._of_tracks(one, kept), rules)) for one in (dense, other)]
    assert some[0] == some[1]
    assert some[0]["FP"] < summary(wanted)["FP"]
    monkeypatch.setattr(metrics.best_tracks, "__defaults__", (0,))  # no table is small enough
    found = score(other, rules)
    assert found.counts == wanted.counts
    for name, values in wanted.hota.items():
        np.testing.assert_array_equal(found.hota[name], values)


NAMES = ("HOTA", "DetA", "AssA", "LocA", "MOTA", "IDF1", "IDP", "IDR", "IDSW", "Frag", "MT", "PT", "ML")
TRACKEVAL = {name: name for name in NAMES} | {"FP": "CLR_FP", "FN": "CLR_FN"}
MOTMETRICS = {name: name.lower() for name in ("MOTA", "IDF1", "IDP", "IDR")} | {
    "IDSW": "num_switches", "FP": "num_false_positives", "FN": "num_misses", "Frag": "num_fragmentations",
    "MT": "mostly_tracked", "PT": "partially_tracked", "ML": "mostly_lost", "GT": "num_unique_objects",
}  # fmt: skip


@pytest.mark.parametrize(("rules", "columns"), [("trackeval", TRACKEVAL), ("motmetrics", MOTMETRICS)])
def test_numbers_of_the_evaluators_on_real_sequences(data, rules, columns):
    folder = data / "mot15"
    with (folder / f"{rules}_reference.csv").open() as stream:
        rows = {next(iter(row.values())): row for row in csv.DictReader(stream)}
    parts = []
    for sequence in sorted(path.name for path in folder.iterdir() if path.is_dir()):
        truth, tracks = (
            np.loadtxt(folder / sequence / name, delimiter=",") for name in ("gt/gt.txt", "reference/sort.txt")
        )
        truth = truth[truth[:, 6] != 0]
        (true_ids, true_at), (track_ids, track_at) = (
            np.unique(part[:, 1], return_inverse=True) for part in (truth, tracks)
        )
        last = int(max(truth[:, 0].max(), tracks[:, 0].max()))
        frames = [(truth[:, 0] == n, tracks[:, 0] == n) for n in range(1, last + 1)]
        parts.append(
            score(
                Matchup(
                    tuple(true_at[a] for a, _ in frames),
                    tuple(track_at[b] for _, b in frames),
                    tuple(iou(truth[a, 2:6], tracks[b, 2:6]) for a, b in frames),
                    0.5,
                    len(true_ids),
                    len(track_ids),
                ),
                rules,
            )
        )
        found = summary(parts[-1])
        for ours, theirs in columns.items():
            assert found[ours] == pytest.approx(float(rows[sequence][theirs]), abs=1e-6), (sequence, ours)
    total = next((row for name, row in rows.items() if name in ("COMBINED", "OVERALL")), None)
    if total:
        found = summary(combine(parts))
        assert {ours: found[ours] for ours in columns} == pytest.approx(
            {ours: float(total[theirs]) for ours, theirs in columns.items()}, abs=1e-6
        )


def straight(who: int, steps: range, offset: float = 0.0, lane: float = 0.0) -> dict:
    return {who: {step: (step + offset, lane) for step in steps}}


class TestDisplacement:
    def test_people_without_a_whole_future_or_past_count_nowhere(self):
        truth = positions(
            straight(1, range(10)) | straight(2, range(6), lane=5.0) | straight(3, range(3, 10), lane=9.0)
        )
        tracks = positions(straight(7, range(10)) | straight(8, range(6), lane=5.0))
        made = forecasts(
            predicted(4, 7, [(5.0, 0), (6.0, 0), (7.0, 0)]), predicted(4, 8, [(9.0, 9), (9.0, 9), (9.0, 9)])
        )
        result = displacement(truth, tracks, made)
        assert result.people == 1
        assert result.summary()["ADE_m"] == 0.0
        assert result.false_forecasts == 0  # 8 is person 2, who leaves: neither for nor against

    def test_forecasts_of_tracks_without_positions_are_not_judged(self):
        """Neither of an id that is not in the tracks, nor at a time at which the track is not there."""
        truth, tracks = positions(straight(1, range(10))), positions(straight(7, range(10)))
        for step, who in ((4, 6), (4, 8), (-1, 7), (12, 7)):
            found = displacement(truth, tracks, forecasts(predicted(step, who, [(5.0, 0), (6.0, 0), (7.0, 0)])))
            assert found.false_forecasts == 0
            assert found.ade_m.tolist() == []

    def test_errors_by_step_are_of_pairs_below_the_threshold(self, monkeypatch):
        """Two people; one track is 1 m off and so d_obs is 1 m^2, the other 2 m off, which is 4 m^2."""
        truth = positions(straight(1, range(10)) | straight(2, range(10), lane=30.0))
        tracks = positions(straight(5, range(10), lane=1.0) | straight(6, range(10), lane=32.0))
        made = forecasts(
            predicted(4, 5, [(5.0, 0.5), (6.0, 1.5), (7.0, 2.5)]), predicted(4, 6, [(5.0, 37), (6.0, 38), (7.0, 39)])
        )
        result = displacement(truth, tracks, made)
        assert sorted(result.d_obs_m2.tolist()) == pytest.approx([1.0, 4.0])
        assert result.errors_by_step().tolist() == [[0.5, 1.5, 2.5]]  # tau is 2 m^2
        for tau_m2, wanted in ((5.0, [[0.5, 1.5, 2.5], [7.0, 8.0, 9.0]]), (1.0, [])):  # less than it, not equal to it
            with monkeypatch.context() as patch:
                patch.setattr("mcaptrack.evaluation.metrics.displacement.TAU_M2", tau_m2)
                assert sorted(result.errors_by_step().tolist()) == wanted
        assert result.summary()["recall"] == 0.5

    def test_consistency_of_consecutive_forecasts_by_hand(self):
        truth = positions(straight(1, range(10)))
        made = forecasts(
            predicted(4, 7, [(5.0, 0), (6.0, 0), (7.0, 0)]), predicted(5, 7, [(6.0, 1), (7.0, 2), (8.0, 9)])
        )
        found = displacement(truth, positions(straight(7, range(10))), made).summary()
        assert found["consistency_m"] == pytest.approx(1.5)

    def test_a_mean_with_a_value_that_is_not_finite_is_none(self):
        truth, made = positions(straight(1, range(10))), forecasts(predicted(4, 5, [(5.0, 0), (6.0, 0), (7.0, 2)]))
        good = displacement(truth, positions(straight(5, range(10))), made)
        for worse in (np.nan, np.inf):
            found = combine_displacements([good, replace(good, fde_m=np.array([worse]))]).summary()
            assert found["FDE_m"] is None
            assert found["ADE_m"] == pytest.approx(2 / 3)


# Against two other evaluators, on synthetic tracks with all kinds of errors


Sequence = tuple[list[dict[int, np.ndarray]], list[dict[int, np.ndarray]]]


@st.composite
def made(draw, exact: bool = False) -> Sequence:
    """People who walk side by side, and their tracks: missed, swapped, doubled, ghosts, ids that come again; frames in
    which there are no people or no tracks; one frame alone. ``exact`` doubles lie on their originals to the bit.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    frames, people = draw(st.integers(1, 12)), draw(st.integers(0, 5))
    noise = draw(st.sampled_from([0.0, 1.0, 4.0]))
    missed, swapped, doubled, ghosts, silent = (draw(st.sampled_from([0.0, 0.1, 0.4])) for _ in range(5))
    names = np.arange(people)
    place = np.stack([12.0 * np.arange(people), np.zeros(people)], axis=1) + rng.uniform(0, 5, (people, 2))
    truth, tracks = [], []
    for _ in range(frames):
        place = place + rng.normal(0, 2, place.shape)
        if people > 1 and rng.random() < swapped:
            a, b = rng.choice(people, 2, replace=False)
            names[[a, b]] = names[[b, a]]
        here = (
            {}
            if rng.random() < silent
            else {who: box(place[who]) for who in range(people) if rng.random() > missed / 2}
        )
        seen = {}
        if rng.random() >= silent:
            for who in range(people):
                if rng.random() > missed:
                    seen[int(names[who])] = box(place[who] + rng.normal(0, 1, 2) * noise)
                if rng.random() < doubled:
                    off = 0.0 if exact else rng.normal(0, 1, 2)
                    seen[int(20 + (who + rng.integers(0, 2)) % 6)] = box(place[who] + off)
            if rng.random() < ghosts:
                seen[int(40 + rng.integers(0, 2))] = box(rng.uniform(0, 60, 2))
        truth.append(here)
        tracks.append({who: seen[who] for who in rng.permutation(list(seen))})
    return truth, tracks


def box(place) -> np.ndarray:
    return np.array([*place, 10.0, 24.0])


def boxes_compared(truth, tracks, threshold: float = 0.5) -> Matchup:
    true_ids, track_ids = (
        {who: n for n, who in enumerate(sorted({w for f in part for w in f}))} for part in (truth, tracks)
    )

    def boxes(frame):
        return np.array(list(frame.values())).reshape(-1, 4)

    return Matchup(
        tuple(np.array([true_ids[who] for who in frame], int) for frame in truth),
        tuple(np.array([track_ids[who] for who in frame], int) for frame in tracks),
        tuple(iou(boxes(a), boxes(b)) for a, b in zip(truth, tracks, strict=True)),
        threshold,
        len(true_ids),
        len(track_ids),
    )


OURS_AND_TRACKEVALS = {
    **{name: name for name in ("MOTA", "IDF1", "IDP", "IDR", "IDSW", "Frag", "MT", "PT", "ML")},
    "FP": "CLR_FP",
    "FN": "CLR_FN",
    "HOTA": "HOTA",
    "DetA": "DetA",
    "AssA": "AssA",
    "LocA": "LocA",
}


def by_trackeval(part: Matchup) -> list[tuple]:
    metrics = pytest.importorskip("trackeval.metrics")
    data = {
        "num_tracker_dets": part.track_rows,
        "num_gt_dets": part.ground_truth_rows,
        "num_gt_ids": part.n_ground_truth,
        "num_tracker_ids": part.n_tracks,
        "num_timesteps": len(part.ground_truth),
        "gt_ids": list(part.ground_truth),
        "tracker_ids": list(part.tracks),
        "similarity_scores": list(part.similarity),
    }
    quiet = {"PRINT_CONFIG": False}
    kinds = (
        metrics.CLEAR(quiet | {"THRESHOLD": part.threshold}),
        metrics.Identity(quiet | {"THRESHOLD": part.threshold}),
    )
    return [(kind, kind.eval_sequence(data)) for kind in (*kinds, metrics.HOTA())]


def same(ours: dict, theirs: dict) -> None:
    for name, other in OURS_AND_TRACKEVALS.items():
        assert ours[name] == pytest.approx(float(np.mean(theirs[other])), abs=1e-9), name


EMPTY: Sequence = ([{}] * 3, [{}] * 3)
GHOSTS: Sequence = ([{}] * 3, [{1: box((0, 0))}] * 3)
ALL_MISSED: Sequence = ([{1: box((0, 0))}] * 3, [{}] * 3)


@given(made(exact=True))
@example(EMPTY)
@example(GHOSTS)
@example(ALL_MISSED)
@settings(max_examples=60)
def test_scores_equal_trackeval(sequence):
    part = boxes_compared(*sequence)
    theirs = {name: value for _, result in by_trackeval(part) for name, value in result.items()}
    same(summary(score(part)), theirs)


@given(st.lists(made(), min_size=2, max_size=3), st.sampled_from([0.3, 0.5, 0.7]))
@settings(max_examples=40)
def test_combined_scores_equal_trackeval(sequences, threshold):
    parts = [boxes_compared(*sequence, threshold) for sequence in sequences]
    if not any(part.ground_truth_rows for part in parts):
        return  # without people and tracks TrackEval's sums and its single sequences disagree
    results = [by_trackeval(part) for part in parts]
    theirs = {}
    for at, (kind, _) in enumerate(results[0]):
        theirs |= kind.combine_sequences({str(n): result[at][1] for n, result in enumerate(results)})
    same(summary(combine([score(part) for part in parts])), theirs)


@given(made())
@settings(max_examples=30)
def test_counts_of_boxes_equal_motmetrics(sequence):
    import motmetrics

    truth, tracks = sequence
    part = boxes_compared(truth, tracks)
    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    for people, found, near in zip(truth, tracks, part.similarity, strict=True):
        apart = np.where(near >= 0.5, 1 - near, np.nan)
        accumulator.update(list(people), list(found), apart)
    names = {
        "num_switches": "IDSW", "num_false_positives": "FP", "num_misses": "FN", "num_fragmentations": "Frag",
        "mostly_tracked": "MT", "partially_tracked": "PT", "mostly_lost": "ML", "num_unique_objects": "GT",
        "idf1": "IDF1", "idp": "IDP", "idr": "IDR", "mota": "MOTA",
    }  # fmt: skip
    theirs = motmetrics.metrics.create().compute(accumulator, metrics=list(names), name="x").loc["x"]
    ours = summary(score(part, "motmetrics"))
    for name, ours_name in names.items():
        if np.isfinite(theirs[name]):
            assert ours[ours_name] == pytest.approx(float(theirs[name]), abs=1e-9), name


# Scores of logs and label files against ground truth


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


# Where people spend their time: person-seconds on a grid


S = 10**9


def test_nothing_is_an_empty_grid():
    t_ns, ids = np.array([0, 1, 0, 1]) * S, np.array([1, 1, 2, 2])
    for rows in (0, 1):
        heat = occupancy(t_ns[:rows], ids[:rows], np.zeros((rows, 2)))
        assert heat.person_s.shape == (0, 0)
    unknown = np.array([[np.nan, 0.0], [0.0, 0.0], [1.0, np.inf], [0.0, 0.0]])
    assert occupancy(t_ns, ids, unknown).person_s.size == 0


def slowly(t_ns, ids, xy, cell, gap_s):
    """Step by step, piece by piece; the extent by adding up the time of ends of steps along each axis."""
    steps = []
    for one in sorted(set(ids.tolist())):
        mine = sorted((int(t), *at) for t, at in zip(t_ns[ids == one], xy[ids == one].tolist(), strict=True))
        steps += [
            (a, b) for a, b in pairwise([row for row in mine if np.isfinite(row).all()]) if b[0] - a[0] <= gap_s * S
        ]
    bounds = []
    for axis in (0, 1):
        ends = sorted((end[1 + axis], (b[0] - a[0]) / S) for a, b in steps for end in (a, b))
        total = np.cumsum([time for _, time in ends])
        place = [
            next(at for (at, _), so_far in zip(ends, total, strict=True) if so_far >= share * total[-1])
            for share in (0.002, 0.998)
        ]
        bounds.append(tuple(math.floor(at / cell) for at in place))
    (x0, x1), (y0, y1) = bounds
    grid, outside = np.zeros((max(y1 - y0 + 1, 1), max(x1 - x0 + 1, 1))), 0.0
    for a, b in steps:
        way = [b[1] - a[1], b[2] - a[2]]
        pieces = min(max(math.ceil(8 * max(map(abs, way)) / cell), 1), 64)
        for piece in range(pieces):
            x, y = (a[1 + axis] + (piece + 0.5) / pieces * way[axis] for axis in (0, 1))
            column, row = math.floor(x / cell) - x0, math.floor(y / cell) - y0
            if 0 <= row < len(grid) and 0 <= column < grid.shape[1]:
                grid[row, column] += (b[0] - a[0]) / S / pieces
            else:
                outside += (b[0] - a[0]) / S / pieces
    return grid, (x0 * cell, y0 * cell), outside


@pytest.mark.parametrize(("part", "gap_s"), [(1 << 18, 2.0), (40, 2.0), (40, 0.5)])
def test_the_grid_is_that_of_a_slow_count(part, gap_s, monkeypatch):
    for name, value in {"_PART": part, "_CELL_M": 0.7, "MAX_GAP_S": gap_s}.items():
        monkeypatch.setattr(f"mcaptrack.evaluation.occupancy.{name}", value)
    rng = np.random.default_rng(5)
    count = 120
    ids = rng.integers(0, 5, count)
    t_ns = np.sort(rng.choice(400, count, replace=False)) * (S // 10)
    xy = rng.normal(0, 3, (count, 2))
    xy[7, 0], xy[30] = np.nan, 60.0  # not known, and farther than 64 pieces tell
    heat = occupancy(t_ns, ids, xy)
    grid, low_m, outside = slowly(t_ns, ids, xy, 0.7, gap_s)
    np.testing.assert_allclose(heat.person_s, grid, atol=1e-9)
    assert heat.low_m == pytest.approx(low_m)
    assert heat.high_m == pytest.approx((low_m[0] + 0.7 * grid.shape[1], low_m[1] + 0.7 * grid.shape[0]))
    assert heat.outside_s == pytest.approx(outside)


def test_cells_grow_where_there_would_be_more_than_two_hundred():
    t_ns, ids = np.array([0, 1]) * S, np.array([1, 1])
    for extent, cell in (
        *((100.0, 0.5), (100.5, 1.0), (200.0, 1.0), (200.5, 2.0), (400.0, 2.0), (401.0, 5.0), (1000.0, 5.0)),
        *((1001.0, 10.0), (2000.0, 10.0), (2001.0, 20.0), (4001.0, 50.0), (10_001.0, 100.0), (1e6, 5000.0)),
    ):
        for way in ((extent, 1.0), (1.0, -extent)):
            assert occupancy(t_ns, ids, np.array([(0.0, 0.0), way])).cell_m == cell
    nothing = occupancy(t_ns[:1], ids[:1], np.zeros((1, 2)))
    assert (nothing.low_m, nothing.high_m, nothing.cell_m, nothing.outside_s) == ((0.0, 0.0), (0.0, 0.0), 0.5, 0.0)
