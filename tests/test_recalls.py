"""AMOTA, AMOTP and sAMOTA, against py-motmetrics with one accumulator for each recall, and numbers by hand."""

from __future__ import annotations

import functools

import motmetrics as mm
import numpy as np
import pytest

from mcaptrack.evaluation import averages
from mcaptrack.evaluation.metrics import Matchup, ScoredMatchup, average_over_recalls, metres_to_similarity

GATE_M = 2.0


def drawn(seed: int) -> tuple[list, list, np.ndarray]:
    """Objects on lines, tracks with noise, misses, swaps and ghosts, each track with a score; per frame {id: place}."""
    rng = np.random.default_rng(seed)
    count, ghosts = 6, 3
    start, speed = rng.uniform(0, 12, (count, 2)), rng.uniform(-0.5, 0.5, (count, 2))
    score = np.concatenate([rng.uniform(0.2, 1, count), rng.uniform(0, 0.7, ghosts)])
    score[1] = score[0]
    names = np.arange(count)
    truth, tracks = [], []
    for t in range(12):
        place = start + t * speed
        if rng.random() < 0.3:
            a, b = rng.choice(count, 2, replace=False)
            names[[a, b]] = names[[b, a]]
        seen = {int(names[who]): place[who] + rng.normal(0, 0.4, 2) for who in range(count) if rng.random() > 0.2}
        seen |= {count + one: rng.uniform(0, 12, 2) for one in range(ghosts) if rng.random() < 0.5}
        truth.append({who: place[who] for who in range(count) if rng.random() > 0.1 and t != 7})
        tracks.append(seen)
    return truth, tracks, score


def matchup(truth, tracks, ids: int) -> Matchup:
    def away(a, b):
        return np.array([[np.hypot(*(p - q)) for q in b.values()] for p in a.values()]).reshape(len(a), len(b))

    return Matchup(
        tuple(np.array(list(frame), int) for frame in truth),
        tuple(np.array(list(frame), int) for frame in tracks),
        tuple(metres_to_similarity(away(a, b), GATE_M) for a, b in zip(truth, tracks, strict=True)),
        0.5,
        6,
        ids,
    )


def slow(sequences) -> dict[str, float]:
    """The same by py-motmetrics, with the formulas as they stand in the papers; distances instead of similarities."""

    def accumulated(least):
        return of_kept(tuple(tuple((score >= least).tolist()) for _, _, score in sequences))

    @functools.cache
    def of_kept(all_kept):
        accumulators = []
        for (truth, tracks, _), kept in zip(sequences, all_kept, strict=True):
            one = mm.MOTAccumulator(auto_id=True)
            for people, found in zip(truth, tracks, strict=True):
                seen = {name: place for name, place in found.items() if kept[name]}
                apart = np.array([[np.hypot(*(p - q)) for q in seen.values()] for p in people.values()])
                apart = apart.reshape(len(people), len(seen))
                one.update(list(people), list(seen), np.where(apart <= GATE_M, apart, np.nan))
            accumulators.append(one.events)
        matched = [events[events.Type.isin(("MATCH", "SWITCH"))] for events in accumulators]
        counts = {kind: sum(int((events.Type == kind).sum()) for events in accumulators) for kind in ("SWITCH", "FP")}
        missed = sum(int((events.Type == "MISS").sum()) for events in accumulators)
        of = [score[one.HId.to_numpy(int)] for one, (_, _, score) in zip(matched, sequences, strict=True)]
        return counts["SWITCH"], counts["FP"], missed, np.concatenate(of), sum(one.D.sum() for one in matched)

    total = sum(len(people) for truth, _, _ in sequences for people in truth)
    all_scores = sorted(accumulated(-1.0)[3], reverse=True)
    recalls = np.arange(1, len(all_scores) + 1) / total

    def values(wanted, value, worst):
        out = []
        for r in wanted:
            if r > recalls[-1]:
                out.append(worst)
                continue
            switches, fp, fn, _, apart = accumulated(np.interp(r, recalls, all_scores))
            out.append(value(r, switches, fp, fn, apart))
        return float(np.mean(out))

    def motar(_, switches, fp, fn, __):
        r = (total - fn) / total
        return max(0, 1 - (switches + fp + fn - (1 - r) * total) / (r * total))

    nuscenes, ab3dmot = np.linspace(0.1, 1, 40).round(12), np.arange(1, 41) / 40
    return {
        "AMOTA": values(nuscenes, motar, 0),
        "AMOTP": values(nuscenes, lambda _, s, fp, fn, apart: apart / (total - fn), GATE_M),
        "sAMOTA": values(
            ab3dmot,
            lambda r, s, fp, fn, _: min(1, max(0, 1 - (s + fp + fn - (1 - r) * total) / (r * total))),
            0,
        ),
        "AMOTA_unscaled": values(ab3dmot, lambda r, s, fp, fn, _: 1 - (s + fp + fn) / total, 0),
    }


@pytest.mark.parametrize("seeds", [(0,), (1, 2)])
def test_they_are_those_of_one_accumulator_for_each_recall(seeds):
    sequences = [drawn(seed) for seed in seeds]
    parts = [ScoredMatchup(matchup(truth, tracks, 9), score) for truth, tracks, score in sequences]
    found, wanted = average_over_recalls(parts, "motmetrics"), slow(sequences)
    found["AMOTP"] = 2 * GATE_M * (1 - found["AMOTP"])
    assert found == pytest.approx(wanted)
    assert 0.2 < found["AMOTA"] < 0.9
    assert 0.2 < found["sAMOTA"] < 0.9


def one_frame(n_truth: int, matched: int, false: int) -> Matchup:
    similarity = np.zeros((n_truth, matched + false))
    similarity[range(matched), range(matched)] = 0.8
    ids = (np.arange(n_truth),), (np.arange(matched + false),)
    return Matchup(*ids, (similarity,), 0.5, n_truth, matched + false)


def test_what_is_never_reached_counts_as_nothing():
    found = average_over_recalls([ScoredMatchup(one_frame(4, 1, 0), np.array([0.3]))], worst=0.0)
    assert found["sAMOTA"] == pytest.approx(sum(min(1, 0.25 / (k / 40)) for k in range(1, 11)) / 40)
    assert found["AMOTA_unscaled"] == pytest.approx(10 * 0.25 / 40)
    assert found["AMOTP"] == pytest.approx(0.8 * (np.linspace(0.1, 1, 40) <= 0.25).sum() / 40)
    nothing = average_over_recalls([ScoredMatchup(one_frame(4, 0, 2), np.array([0.3, 0.4]))])
    assert nothing == {"AMOTA": 0.0, "AMOTP": 0.5, "sAMOTA": 0.0, "AMOTA_unscaled": 0.0}
    parts = [ScoredMatchup(one_frame(4, 1, 0), np.array([0.3]))]
    reached = (np.linspace(0.1, 1, 40) <= 0.25).sum() / 40
    assert averages(parts, "iou", 0.5, "trackeval")["AMOTP"] == pytest.approx(0.8 * reached)
    # Pairs are 0.2 of 2 gates apart, and what is not reached is at the gate.
    assert averages(parts, "metres", 3.0, "trackeval")["AMOTP_m"] == pytest.approx(1.2 * reached + 3.0 * (1 - reached))
    assert np.isnan(list(average_over_recalls([ScoredMatchup(one_frame(0, 0, 1), np.ones(1))]).values())).all()
