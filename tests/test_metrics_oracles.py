"""Scores against two other evaluators, on synthetic tracks with all kinds of errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mcaptrack.evaluation.metrics import Matchup, combine, score, summary
from mcaptrack.geometry.boxes import iou

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


def matchup(truth, tracks, threshold: float = 0.5) -> Matchup:
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
    """Each of TrackEval's metrics with its result."""
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
    part = matchup(*sequence)
    theirs = {name: value for _, result in by_trackeval(part) for name, value in result.items()}
    same(summary(score(part)), theirs)


@given(st.lists(made(), min_size=2, max_size=3), st.sampled_from([0.3, 0.5, 0.7]))
@settings(max_examples=40)
def test_combined_scores_equal_trackeval(sequences, threshold):
    parts = [matchup(*sequence, threshold) for sequence in sequences]
    if not any(part.ground_truth_rows for part in parts):
        return  # without people and tracks TrackEval's sums and its single sequences disagree
    results = [by_trackeval(part) for part in parts]
    theirs = {}
    for at, (kind, _) in enumerate(results[0]):
        theirs |= kind.combine_sequences({str(n): result[at][1] for n, result in enumerate(results)})
    same(summary(combine([score(part) for part in parts])), theirs)


@given(made())
@settings(max_examples=60)
def test_counts_of_boxes_equal_motmetrics(sequence):
    import motmetrics

    truth, tracks = sequence
    part = matchup(truth, tracks)
    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    for people, found, near in zip(truth, tracks, part.similarity, strict=True):
        apart = np.where(near >= 0.5, 1 - near, np.nan)
        accumulator.update(list(people), list(found), apart)
    names = {
        "num_switches": "IDSW",
        "num_false_positives": "FP",
        "num_misses": "FN",
        "num_fragmentations": "Frag",
        "mostly_tracked": "MT",
        "partially_tracked": "PT",
        "mostly_lost": "ML",
        "num_unique_objects": "GT",
        "idf1": "IDF1",
        "idp": "IDP",
        "idr": "IDR",
        "mota": "MOTA",
    }
    theirs = motmetrics.metrics.create().compute(accumulator, metrics=list(names), name="x").loc["x"]
    ours = summary(score(part, "motmetrics"))
    for name, ours_name in names.items():
        if np.isfinite(theirs[name]):
            assert ours[ours_name] == pytest.approx(float(theirs[name]), abs=1e-9), name
