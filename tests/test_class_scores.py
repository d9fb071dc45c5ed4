"""Scores and events by class: only objects of one class match, and classes are the same where their names are."""

from __future__ import annotations

import json

import numpy as np
import pytest

import mcaptrack
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import Candidate, EvaluateOptions, EvaluationInput, evaluate
from mcaptrack.evaluation.aligned import of_class
from mcaptrack.evaluation.events import EventOptions, find_events
from mcaptrack.schema import EVENTS, TRACKS, EventKind, Frame
from tests.commands import call
from tests.worlds import ns

OPTIONS = EvaluateOptions(similarities=("metres",), gates_m=(1.0,))


def world(seed, frames=40, noise=0.0, classes=(1, 2), names=3):
    """Walks of ``names`` objects of each class in one place, and perhaps errors of a tracker: noise, misses, switches."""
    rng = np.random.default_rng(5)
    count = names * len(classes)
    start, speed = rng.uniform(0, 6, (count, 2)), rng.uniform(-0.3, 0.3, (count, 2))
    of = np.repeat(classes, names)
    errors = np.random.default_rng(seed)
    ids = np.arange(count)
    out = []
    for t in range(frames):
        there = np.flatnonzero(errors.random(count) > (0.15 if noise else 0.0))
        if noise and errors.random() < 0.4:
            a, b = errors.integers(0, names, 2) + names * errors.integers(0, len(classes))
            ids[[a, b]] = ids[[b, a]]
        x, y = (start + speed * t + errors.normal(0, noise, (count, 2)))[there].T
        rows = TRACKS.rows(
            track_id=ids[there], x_m=x, y_m=y, observed=np.ones(len(there), bool), source_id=there, class_id=of[there]
        )
        out.append(Frame(ns(t / 10), t, rows))
    return out


def scored(ground_truth, tracks, ground_truth_names={}, names={}):  # noqa: B006
    candidate = Candidate("/a/tracks", None, tracks, classes=names)
    result = evaluate([EvaluationInput("a", ground_truth, [candidate], ground_truth_names)], OPTIONS)
    return {row.of_class: row for row in result.results}, result.notes


def test_a_class_has_the_scores_that_it_has_alone_and_counts_of_all_are_sums():
    truth, tracks = world(0), world(1, noise=0.3)
    found, notes = scored(truth, tracks, {1: "person", 2: "cart"}, {1: "person", 2: "cart"})
    assert list(found) == [None, "person", "cart"]
    assert notes == []
    for number, name in ((1, "person"), (2, "cart")):
        alone, _ = scored(of_class(truth, number), of_class(tracks, number))
        assert list(alone) == [None]
        assert alone[None].to_json() | {"class": name} == found[name].to_json()
    rows = {name: row.to_json() for name, row in found.items()}
    for name in ("FP", "FN", "IDSW", "Frag", "GT", "MT"):
        assert rows[None][name] == rows["person"][name] + rows["cart"][name]
    total = sum(len(frame.rows) for frame in truth)
    wrong = rows[None]["FN"] + rows[None]["FP"] + rows[None]["IDSW"]
    assert rows[None]["MOTA"] == pytest.approx(1 - wrong / total)
    for name in ("MOTA", "HOTA", "IDF1"):
        assert rows[None]["class_means"][name] == pytest.approx((rows["person"][name] + rows["cart"][name]) / 2)
    assert rows["person"]["IDSW"] > 0
    assert "class_means" not in rows["person"]


def test_an_object_of_another_class_is_a_miss_and_a_false_positive():
    truth = world(0)
    tracks = [frame._replace(rows=frame.rows.copy()) for frame in truth]
    for frame in tracks:
        frame.rows["class_id"][frame.rows["track_id"] == 0] = 2
    found, _ = scored(truth, tracks)
    person, other = found["person"].to_json(), found["class 2"].to_json()
    assert (person["FN"], person["FP"], other["FN"], other["FP"]) == (40, 0, 0, 40)
    happened = find_events(tracks, truth, EventOptions("metres", 1.0))
    events = EVENTS.joined([frame.rows for frame in happened.events])
    missed, false = (events[events["kind"] == kind] for kind in (EventKind.MISS, EventKind.FALSE_TRACK))
    assert (missed["truth_id"].tolist(), missed["frames"].tolist()) == ([0], [40])
    assert (false["track_id"].tolist(), false["frames"].tolist()) == ([0], [40])


def test_classes_are_the_same_where_their_names_are_whatever_their_numbers():
    truth, tracks = world(0, classes=(1, 2)), world(1, noise=0.3, classes=(9, 0))
    wanted, _ = scored(truth, world(1, noise=0.3), {2: "Cart"}, {2: "cart"})
    found, _ = scored(truth, tracks, {1: "Pedestrian", 2: "Cart"}, {9: "human", 0: "cart "})
    assert [row.to_json() for row in found.values()] == [
        row.to_json() | ({"class": "Pedestrian"} if row.of_class == "person" else {}) for row in wanted.values()
    ]


def test_classes_of_one_kind_of_object_are_compared_if_each_side_has_one():
    truth, tracks = world(0), world(1, noise=0.3)
    names = {1: "pedestrian", 2: "REGULAR_VEHICLE"}
    wanted, _ = scored(truth, tracks, names, {1: "pedestrian", 2: "regular_vehicle"})
    found, notes = scored(truth, tracks, names, {1: "human.pedestrian.adult", 2: "car"})
    assert [row.to_json() for row in found.values()] == [row.to_json() for row in wanted.values()]
    pairs = "REGULAR_VEHICLE with car, pedestrian with human.pedestrian.adult"
    assert notes == [f"a: classes of one kind of object are compared, whatever their names: {pairs}"]
    for names in ({1: "car", 2: "van"}, {1: "blob", 2: "cone"}):  # a taxi is no van where there are cars
        found, notes = scored(truth, tracks, names, {1: names[1], 2: "taxi"})
        assert found[names[2]].to_json()["MOTA"] == 0
        assert len(notes) == 2
    found, notes = scored(truth, tracks, {1: "car", 2: "van"}, {1: "pedestrian", 2: "taxi"})
    assert len(notes) == 2


def test_what_cannot_be_compared_by_class_is_said():
    truth, tracks = world(0), world(1, noise=0.3)
    people, _ = scored(of_class(truth, 1), of_class(tracks, 1))
    found, notes = scored(of_class(truth, 1), tracks, {}, {2: "cart"})
    count = sum(len(frame.rows) for frame in of_class(tracks, 2))
    why = "rows of /a/tracks of classes that the ground truth doesn't have are not compared"
    assert notes == [f"a: {why}: {count} of cart"]
    assert [row.to_json() for row in found.values()] == [row.to_json() for row in people.values()]
    nothing = [frame._replace(rows=frame.rows.copy()) for frame in truth]
    for frame in nothing:
        frame.rows["class_id"] = 0
    found, notes = scored(nothing, tracks)
    assert list(found) == [None]
    assert notes == ["a: the ground truth states no classes; objects of all classes are compared with one another"]
    _, notes = scored(truth, [frame._replace(rows=frame.rows[:0]) for frame in truth])
    assert notes == []


def test_events_match_objects_of_one_class_and_add_up_to_the_scores():
    truth, tracks = world(0), world(1, noise=0.3)
    found = find_events(tracks, truth, EventOptions("metres", 1.0), classes=({2: "cart"}, {2: "cart"}))
    events = EVENTS.joined([frame.rows for frame in found.events])
    rows = scored(truth, tracks)[0][None].to_json()
    for kind, name in ((EventKind.MISS, "FN"), (EventKind.FALSE_TRACK, "FP")):
        assert events["frames"][events["kind"] == kind].sum() == rows[name]
    assert (events["kind"] == EventKind.SWITCH).sum() == rows["IDSW"]
    people = find_events(tracks, of_class(truth, 1), EventOptions("metres", 1.0), classes=({}, {2: "cart"}))
    assert any("of classes that the ground truth doesn't have" in note for note in people.notes)
    of_people = EVENTS.joined([frame.rows for frame in people.events])
    false = of_people["track_id"][of_people["kind"] == EventKind.FALSE_TRACK]
    assert {int(one) for one in false} <= {0, 1, 2}


def test_evaluate_gives_a_row_for_each_class_in_python_on_the_terminal_and_in_tables(tmp_path):
    path = tmp_path / "a.mcap"
    with mcaptrack.open(path, create=True) as log:
        log.write("/camera/truth", world(0), classes={2: "cart"})
        log.write("/camera/tracks", world(1, noise=0.3), classes={2: "cart"})
    scores = mcaptrack.evaluate(path, gate_m=1.0)
    whole, cart = scores.score("MOTA", "tracks"), scores.score("MOTA", "tracks", of_class="cart")
    assert whole != cart
    assert len(scores.below({"MOTA": max(whole, cart) + 0.1})) == 1  # limits are for all classes together
    with pytest.raises(McaptrackError, match="no class 'bus' was scored by itself; there are person, cart"):
        scores.score("MOTA", of_class="bus")
    said = call("evaluate", str(path), "--gate-m", "1").out
    assert said.startswith("within 1 m: IDF1 ")
    assert [line.split()[1] for line in said.splitlines()[3:7]] == ["all", "mean", "person", "cart"]
    rows = json.loads(call("evaluate", str(path), "--gate-m", "1", "--json").out)["results"]
    assert [row["class"] for row in rows] == [None, "person", "cart"]
    lines = call("evaluate", str(path), "--gate-m", "1", "--csv").out.splitlines()
    assert len(lines) == 4
    with mcaptrack.open(path) as log:
        table = [row for row in log.table("metrics").to_pylist() if row["gate"] == 1.0]
    assert [row["class"] for row in table] == [None, "cart", "person"]
    means = [row["class_mean_HOTA"] for row in table]
    assert means[0] == pytest.approx((table[1]["HOTA"] + table[2]["HOTA"]) / 2)
    assert means[1:] == [None, None]


HEAD = "frame,id,x,y,w,h,class"


def table(folder, name, kinds, separator=","):
    """A table of one object of each class, 90 pixels apart, in ten frames."""
    rows = [f"{t},{k},{90 * k},{t},40,80,{kind}" for t in range(10) for k, kind in enumerate(kinds)]
    (folder / name).write_text("\n".join([HEAD, *rows]).replace(",", separator))
    return folder / name


@pytest.mark.parametrize("separator", [",", ";"])
def test_label_files_are_scored_by_class(separator, tmp_path):
    truth = table(tmp_path, "t.csv", ["person", "car", "dog"])
    tracks = table(tmp_path, "k.csv", ["person", "dog", "bus"], separator)  # the car is taken for a dog
    (people,) = mcaptrack.evaluate(tracks, truth=truth).results
    assert (people.of_class, people.to_json()["MOTA"]) == (None, 1.0)
    found = mcaptrack.evaluate(tracks, truth=truth, classes="all").results
    counts = {row.of_class: tuple(row.to_json()[name] for name in ("GT", "FN", "FP")) for row in found}
    assert counts == {None: (3, 20, 10), "person": (1, 0, 0), "car": (1, 10, 0), "dog": (1, 10, 10)}
    found = mcaptrack.evaluate(tracks, truth=truth, classes="person,car").results
    counts = {row.of_class: tuple(row.to_json()[name] for name in ("GT", "FN", "FP")) for row in found}
    assert counts == {None: (2, 10, 0), "person": (1, 0, 0), "car": (1, 10, 0)}
