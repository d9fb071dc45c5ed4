"""Scores of 3D tracks by class: by distance and by overlap of oriented boxes, against py-motmetrics and by hand."""

from __future__ import annotations

import functools
import json
import re

import motmetrics as mm
import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log as LogMessage
from scipy.spatial.transform import Rotation

import mcaptrack
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import Candidate, EvaluateOptions, EvaluationInput, aligned, averages, evaluate
from mcaptrack.evaluation.aligned import of_class
from mcaptrack.evaluation.event_text import PEOPLE, log_messages, nouns_of
from mcaptrack.evaluation.events import EventOptions, default_rule, find_events
from mcaptrack.evaluation.metrics import ScoredMatchup, average_over_recalls, metres_to_similarity
from mcaptrack.evaluation.metrics.matchup import Matchup
from mcaptrack.geometry.boxes import ORIENTED_COLUMNS, bev_iou_of_pairs, columns_to_oriented_boxes, iou_3d_of_pairs
from mcaptrack.schema import TRACKS, Frame
from tests.commands import call
from tests.logs import recorder
from tests.worlds import ns

NAMES = {1: "pedestrian", 2: "car", 3: "truck"}
SIZES = {1: (0.6, 0.6, 1.8), 2: (4.5, 1.9, 1.5), 3: (9.0, 2.6, 3.2)}


def frame(number: int, boxes: list, ids: list, classes: list, scores: list | None = None) -> Frame:
    columns = dict(zip(ORIENTED_COLUMNS, np.array(boxes, float).reshape(-1, 7).T, strict=True))
    rows = TRACKS.rows(
        track_id=np.array(ids, int),
        observed=np.ones(len(ids), bool),
        source_id=np.full(len(ids), -1),
        class_id=np.array(classes, int),
        score=np.full(len(ids), np.nan) if scores is None else np.array(scores, float),
        **columns,
    )
    return Frame(ns(100 + number / 10), number, rows)


def drawn(seed: int, numbers: dict[int, int] = {1: 1, 2: 2, 3: 3}, scores: bool = True):  # noqa: B006
    """Objects that drive about, and tracks with noise, misses, switches and ghosts; ``numbers``: classes of tracks."""
    rng = np.random.default_rng(seed)
    of = np.array([1, 1, 1, 2, 2, 2, 2, 3])
    start, heading = rng.uniform(-15, 15, (8, 2)), rng.uniform(-3, 3, 8)
    speed = np.where(of == 1, 1.0, 6.0)
    track_score = np.concatenate([rng.uniform(0.3, 1, 8), [0.2, 0.5]])
    ids = np.arange(8)
    truth, tracks = [], []
    for t in range(15):
        xy = start + (t / 10 * speed)[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        boxes = [[x, y, 0.5, *SIZES[k], h] for (x, y), k, h in zip(xy, of, heading, strict=True)]
        truth.append(frame(t, boxes, list(range(8)), list(of)))
        if rng.random() < 0.3:
            a, b = rng.choice(np.flatnonzero(of == rng.choice([1, 2])), 2, replace=False)
            ids[[a, b]] = ids[[b, a]]
        seen = [k for k in range(8) if rng.random() > 0.2]
        noisy = [np.array(boxes[k]) + rng.normal(0, [0.3, 0.3, 0.1, 0.05, 0.05, 0.05, 0.1]) for k in seen]
        ghosts = [[*rng.uniform(-15, 15, 2), 0.5, *SIZES[2], 1.0] for _ in range(2)]
        names = [int(ids[k]) for k in seen] + [8, 9]
        classes = [numbers[int(of[k])] for k in seen] + [numbers[2]] * 2
        tracks.append(frame(t, noisy + ghosts, names, classes, [track_score[n] for n in names] if scores else None))
    return truth, tracks


def scored(truth, tracks, options, names=NAMES):
    result = evaluate(
        [EvaluationInput("a", truth, [Candidate("/lidar/tracks", None, tracks, classes=names)], NAMES)], options
    )
    return {(row.similarity, row.gate, row.of_class): row.to_json() for row in result.results}, result.notes


def by_motmetrics(truth, tracks, similarity: str, gate: float) -> dict[str, float]:
    """CLEAR and identity of all classes together by py-motmetrics: an accumulator for each class."""
    accumulators = []
    for number in NAMES:
        one = mm.MOTAccumulator(auto_id=True)
        for a, b in zip(of_class(truth, number), of_class(tracks, number), strict=True):
            boxes = [columns_to_oriented_boxes(part.rows) for part in (a, b)]
            pairs = [np.repeat(boxes[0], len(boxes[1]), axis=0), np.tile(boxes[1], (len(boxes[0]), 1))]
            if similarity == "metres":
                cost = np.hypot(*(pairs[0] - pairs[1])[:, :2].T)
                cost[cost > gate] = np.nan
            else:
                cost = 1 - (bev_iou_of_pairs if similarity == "bev-iou" else iou_3d_of_pairs)(*pairs)
                cost[cost > 1 - gate] = np.nan
            one.update(a.rows["track_id"], b.rows["track_id"], cost.reshape(len(boxes[0]), len(boxes[1])))
        accumulators.append(one)
    names = ["mota", "idf1", "num_switches", "num_false_positives", "num_misses"]
    found = mm.metrics.create().compute_many(accumulators, metrics=names, generate_overall=True).loc["OVERALL"]
    return dict(zip(("MOTA", "IDF1", "IDSW", "FP", "FN"), found.tolist(), strict=True))


@pytest.mark.parametrize(("similarity", "gate"), [("metres", 2.0), ("metres", 0.5), ("bev-iou", 0.5), ("3d-iou", 0.3)])
def test_all_classes_together_are_those_of_py_motmetrics(similarity, gate):
    truth, tracks = drawn(1)
    options = EvaluateOptions((similarity,), (gate,), gate, "motmetrics")
    found, notes = scored(truth, tracks, options)
    assert notes == []
    assert [one for _, _, one in found] == [None, "pedestrian", "car", "truck"]
    row = found[similarity, gate, None]
    wanted = by_motmetrics(truth, tracks, similarity, gate)
    assert {name: row[name] for name in wanted} == pytest.approx(wanted)
    assert row["FP"] > 20
    assert row["FN"] > 10
    means = row["class_means"]["MOTA"]
    assert means == pytest.approx(np.mean([found[similarity, gate, one]["MOTA"] for one in NAMES.values()]))


def test_classes_are_joined_by_name_and_the_others_are_named():
    options = EvaluateOptions(("metres",), (2.0,))
    truth, tracks = drawn(2)
    wanted, _ = scored(truth, tracks, options)
    _, renumbered = drawn(2, {1: 7, 2: 1, 3: 2})
    found, notes = scored(truth, renumbered, options, {7: "Pedestrian", 1: "car", 2: "truck"})
    assert notes == []
    assert list(found.values()) == list(wanted.values())
    _, notes = scored(truth, renumbered, options, {7: "pedestrian", 1: "cart", 2: "truck"})
    count = sum(int((one.rows["class_id"] == 2).sum()) for one in tracks)
    assert notes == [
        f"a: rows of /lidar/tracks of classes that the ground truth doesn't have are not compared: {count} of cart",
        "a: /lidar/tracks has no tracks of classes that the ground truth has; all are misses: 60 of car",
    ]


def test_averages_are_given_at_the_largest_gate_for_tracks_with_scores():
    truth, tracks = drawn(3)
    found, notes = scored(truth, tracks, EvaluateOptions(("metres", "bev-iou"), (1.0, 2.0), 0.3))
    assert notes == []
    assert "AMOTA" not in found["metres", 1.0, None]
    row = found["metres", 2.0, "car"]
    assert 0.1 < row["AMOTA"] < 1
    for name in ("AMOTA", "sAMOTA", "AMOTP_m"):
        mean = np.mean([found["metres", 2.0, one][name] for one in NAMES.values()])
        assert found["metres", 2.0, None][name] == pytest.approx(mean)
    assert 0.3 <= found["bev-iou", 0.3, "car"]["AMOTP"] < 1
    for one in tracks:
        one.rows["score"][one.rows["track_id"] == 9] = np.nan  # those without a score count as the least likely
    assert "AMOTA" in scored(truth, tracks, EvaluateOptions(("metres",), (2.0,)))[0]["metres", 2.0, "car"]
    found, notes = scored(truth, drawn(3, scores=False)[1], EvaluateOptions(("metres",), (2.0,)))
    assert "AMOTA" not in found["metres", 2.0, None]
    assert notes == ["a: /lidar/tracks has no scores; there is no AMOTA and no sAMOTA"]


def test_averages_of_several_sequences_are_of_all_their_matches_together():
    sequences = [drawn(4), drawn(5)]
    options = EvaluateOptions(("metres",), (2.0,))
    inputs = [
        EvaluationInput(name, truth, [Candidate("t", None, tracks, classes=NAMES)], NAMES)
        for name, (truth, tracks) in zip("ab", sequences, strict=True)
    ]
    rows = {(row.sequence, row.of_class): row for row in evaluate(inputs, options).results}
    whole, parts = rows["COMBINED", "car"], [rows[name, "car"] for name in "ab"]
    assert len(whole.scored) == 2
    wanted = average_over_recalls([one for part in parts for one in part.scored])
    assert whole.to_json()["AMOTA"] == pytest.approx(wanted["AMOTA"])
    assert whole.to_json()["AMOTA"] != parts[0].to_json()["AMOTA"]


def lines(frames: list[Frame]) -> str:
    names = ("track_id", *ORIENTED_COLUMNS, "score")
    rows = [
        ",".join([str(one.t_ns), NAMES[int(row["class_id"])], *(str(row[name]) for name in names)])
        for one in frames
        for row in one.rows
    ]
    return "\n".join([",".join(["t_ns", "class", *names]), *rows]) + "\n"


def test_a_log_of_3d_labels_is_evaluated_on_the_command_line(tmp_path):
    truth, tracks = drawn(7)
    log = tmp_path / "log.mcap"
    for role, frames in (("truth", truth), ("tracks", tracks)):
        (tmp_path / f"{role}.csv").write_text(lines(frames))
        mcaptrack.ingest(
            tmp_path / f"{role}.csv", None if log.exists() else log, into=log if log.exists() else None, role=role
        )
    said = call("evaluate", log, "--gate-m", "2", "--json")
    assert said.code == 0, said.err
    rows = {row["class"]: row for row in json.loads(said.out)["results"]}
    wanted, _ = scored(truth, tracks, EvaluateOptions(("metres",), (2.0,)))
    for name in (None, *NAMES.values()):
        assert {"IDSW": rows[name]["IDSW"], "AMOTA": rows[name]["AMOTA"]} == pytest.approx(
            {"IDSW": wanted["metres", 2.0, name]["IDSW"], "AMOTA": wanted["metres", 2.0, name]["AMOTA"]}
        )
    verdict, _, columns, *_ = call("evaluate", log, "--gate-m", "1,2").out.splitlines()
    assert verdict.startswith("within 2 m: ")
    assert columns.split()[-2:] == ["AMOTA", "sAMOTA"]
    by_overlap = call("evaluate", log, "--similarity", "3d-iou", "--min-iou", "0.3").out.splitlines()
    assert by_overlap[0].startswith("with 3D IoU 0.3: ")
    assert [line.split()[1] for line in by_overlap[3:]] == ["all", "mean", *NAMES.values()]
    table = call("evaluate", log, "--gate-m", "1,2", "--csv").out.splitlines()
    assert "AMOTA" in table[0].split(",")
    assert len(table) == 9
    assert call("evaluate", log, "--gate-m", "2", "--fail-under", "amota=0.99").code == 4
    with pytest.raises(McaptrackError, match=r"have no boxes in pictures$"):
        mcaptrack.evaluate(log, similarity="iou")


def test_events_name_the_classes_of_objects_where_not_all_are_people():
    truth, tracks = drawn(8)
    found = find_events(tracks, truth, EventOptions(), classes=(NAMES, NAMES))
    assert found.rule == ("metres", 2.0)
    of = {int(row["track_id"]): NAMES[int(row["class_id"])] for one in truth for row in one.rows}
    of_tracks = {int(row["track_id"]): NAMES[int(row["class_id"])] for one in tracks for row in one.rows}

    def said(nouns) -> str:
        messages = log_messages(found.events, "/t", 0, found.frame_interval_s, nouns)
        return "\n".join(LogMessage.FromString(data).message for *_, data in messages)

    text = said(nouns_of(truth, tracks, (NAMES, NAMES)))
    missed = re.findall(r"(\w+) (\d+) (?:is missed|and track|: track)", text)
    false = re.findall(r"track (\d+) matches no (\w+)", text)
    assert len(missed) > 5
    assert len(false) >= 2
    assert {(noun, of[int(number)]) for noun, number in missed} == {
        ("car", "car"),
        ("person", "pedestrian"),
        ("truck", "truck"),
    }
    assert {(noun, of_tracks[int(number)]) for number, noun in false} <= {("car", "car"), ("person", "pedestrian")}
    people = [of_class(side, 1) for side in (truth, tracks)]
    assert nouns_of(*people, (NAMES, NAMES)) is PEOPLE
    assert "car" not in said(PEOPLE)


def test_the_default_gate_is_two_metres_for_boxes_in_space_and_one_for_positions():
    truth, tracks = drawn(9)
    assert default_rule(truth, tracks) == ("metres", 2.0)
    flat = [one._replace(rows=one.rows.copy()) for one in truth]
    for one in flat:
        one.rows["length_m"] = np.nan
    assert default_rule(flat, tracks) == ("metres", 1.0)
    assert find_events(tracks, truth, EventOptions(gate_m=0.7)).rule == ("metres", 0.7)


def transforms(path, poses: dict[int, tuple[Rotation, np.ndarray]]) -> None:
    """A recording with the poses of "odom" in "map", as JSON."""
    with recorder(path) as writer:
        channel = writer.add_channel("/tf", ("foxglove.FrameTransform", "jsonschema", b"{}"))
        for t_ns, (turn, shift) in poses.items():
            stamp = {"sec": t_ns // 10**9, "nsec": t_ns % 10**9}
            x, y, z, w = turn.as_quat().tolist()
            words = {"timestamp": stamp, "parent_frame_id": "map", "child_frame_id": "odom"}
            words["translation"] = dict(zip("xyz", shift.tolist(), strict=True))
            words["rotation"] = {"x": x, "y": y, "z": z, "w": w}
            writer.add_message(channel, t_ns, json.dumps(words).encode(), t_ns)


def test_ground_truth_in_another_frame_is_brought_to_that_of_the_tracks(tmp_path):
    truth, tracks = drawn(10)
    log = tmp_path / "log.mcap"
    rng = np.random.default_rng(1)
    poses = {one.t_ns: (Rotation.from_euler("z", rng.uniform(-3, 3)), rng.uniform(-50, 50, 3)) for one in truth}
    transforms(log, poses)
    moved = []
    for one in tracks:
        rows, (turn, shift) = one.rows.copy(), poses[one.t_ns]
        place = turn.inv().apply(np.stack([rows["x_m"], rows["y_m"], rows["z_m"]], axis=1) - shift)
        rows["x_m"], rows["y_m"], rows["z_m"] = place.T
        rows["heading_rad"] -= turn.as_euler("zyx")[0]
        moved.append(one._replace(rows=rows))
    for role, frames, frame_id in (("truth", truth, None), ("tracks", moved, "odom")):
        (tmp_path / f"{role}.csv").write_text(lines(frames))
        mcaptrack.ingest(tmp_path / f"{role}.csv", into=log, role=role, frame=frame_id)
    wanted, _ = scored(truth, tracks, EvaluateOptions(("3d-iou",), min_iou=0.3))
    found = mcaptrack.evaluate(log, similarity="3d-iou", min_iou=0.3)
    for row in found.rows():
        for name in ("MOTA", "LocA", "AMOTA"):
            assert row[name] == pytest.approx(wanted["3d-iou", 0.3, row["class"]][name], abs=1e-9)
    mcaptrack.ingest(tmp_path / "truth.csv", into=log, role="truth", frame="mars", force=True)
    with pytest.raises(McaptrackError, match="is in the frame mars, tracks are in odom, and no transform between them"):
        mcaptrack.evaluate(log)


def test_files_of_3d_boxes_are_compared_by_their_times(tmp_path):
    truth, tracks = drawn(11)
    for role, frames in (("truth", truth), ("tracks", tracks)):
        (tmp_path / f"{role}.csv").write_text(lines(frames))
    found = mcaptrack.evaluate(tmp_path / "tracks.csv", truth=tmp_path / "truth.csv", gate_m=2.0)
    wanted, _ = scored(truth, tracks, EvaluateOptions(("metres",), (2.0,)))
    assert [row["class"] for row in found.rows()] == [None, "pedestrian", "car", "truck"]
    for row in found.rows():
        for name in ("MOTA", "IDF1", "AMOTA"):
            assert row[name] == pytest.approx(wanted["metres", 2.0, row["class"]][name])


@pytest.mark.parametrize(("similarity", "gate", "by_class"), [("metres", 3.0, True), ("bev-iou", 0.1, False)])
def test_it_makes_no_difference_how_many_pairs_are_compared_at_once(similarity, gate, by_class, monkeypatch):
    """Each frame beside distances or overlaps of all its pairs; in one go, some frames at a time, and frame by frame."""
    truth, tracks = drawn(3)
    tracks[4] = frame(4, [], [], [])
    truth[7].rows["x_m"][2] = np.nan  # a row without a position is compared with nothing
    sides = [(a.rows[np.isfinite(a.rows["x_m"])], b.rows) for a, b in zip(truth, tracks, strict=True)]
    wanted = []
    for one, other in sides:
        i, j = (part.ravel() for part in np.indices((len(one), len(other))))
        if similarity == "metres":
            apart = np.hypot(one["x_m"][i] - other["x_m"][j], one["y_m"][i] - other["y_m"][j])
            alike = np.maximum(1 - apart / (2 * gate), 0)
        else:
            alike = bev_iou_of_pairs(columns_to_oriented_boxes(one)[i], columns_to_oriented_boxes(other)[j])
        same = one["class_id"][i] == other["class_id"][j]
        wanted.append(np.where(same | (not by_class), alike, 0).reshape(len(one), len(other)))
    for most in (1_000_000, 200, 1):
        monkeypatch.setattr(aligned, "_PAIRS_AT_ONCE", most)
        compared = aligned.compare_rows(truth, tracks, similarity, gate, by_class)
        for number, (one, other) in enumerate(sides):
            np.testing.assert_allclose(compared.matchup.similarity[number], wanted[number], atol=1e-9)
            assert compared.ground_truth.ids[compared.matchup.ground_truth[number]].tolist() == one["track_id"].tolist()
            assert compared.tracks.ids[compared.matchup.tracks[number]].tolist() == other["track_id"].tolist()
        assert compared.matchup.threshold == (0.5 if similarity == "metres" else gate)


# AMOTA, AMOTP and sAMOTA, against py-motmetrics with one accumulator for each recall, and numbers by hand


GATE_M = 2.0


def drawn_lines(seed: int) -> tuple[list, list, np.ndarray]:
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
            ab3dmot, lambda r, s, fp, fn, _: min(1, max(0, 1 - (s + fp + fn - (1 - r) * total) / (r * total))), 0
        ),
        "AMOTA_unscaled": values(ab3dmot, lambda r, s, fp, fn, _: 1 - (s + fp + fn) / total, 0),
    }


@pytest.mark.parametrize("seeds", [(0,), (1, 2)])
def test_they_are_those_of_one_accumulator_for_each_recall(seeds):
    sequences = [drawn_lines(seed) for seed in seeds]
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
