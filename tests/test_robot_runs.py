"""The whole line on the log of a robot: what is made of its boxes, and what commands show of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

import mcaptrack
from mcaptrack import log
from mcaptrack.evaluation import sequence_of_log
from mcaptrack.evaluation.forecasts import score_forecasts
from mcaptrack.foxglove import class_colour
from mcaptrack.pipeline import summary
from mcaptrack.sources import fixed_frame
from tests.commands import done
from tests.robot_runs import OBJECTS, place, write_passing
from tests.tiers import thorough

#: Enough for predictions with a known future, 4.8 s ahead.
SHOTS = 70


@pytest.fixture(scope="module")
def passed(tmp_path_factory) -> Path:
    """A log of a robot with truth, after ``run``."""
    folder = tmp_path_factory.mktemp("robot")
    path, truth = write_passing(folder, shots=SHOTS)
    mcaptrack.ingest(truth, into=path, role="truth", frame="map", sidecar=False)
    mcaptrack.run(path, sidecar=False, tables=False)
    return path


@thorough
def test_recorded_boxes_are_decoded_once_in_a_run(passed, tmp_path, monkeypatch):
    """By the tracker; the table of detections and the number of boxes in the summary are of the same rows."""
    path, decoded = tmp_path / "a.mcap", []
    path.write_bytes(passed.read_bytes())
    read = fixed_frame.named_detections

    def counted(opened, topic, frame_id=""):
        decoded.append((topic, frame_id))
        return read(opened, topic, frame_id)

    monkeypatch.setattr(fixed_frame, "named_detections", counted)
    result = mcaptrack.run(path, force=True, sidecar=False)
    assert decoded == [("/lidar/boxes", "")]
    assert result.summary.boxes == result.tables["detections"] == SHOTS * len(OBJECTS)
    assert mcaptrack.run(path, sidecar=False).summary.boxes == SHOTS * len(OBJECTS)
    assert len(decoded) == 2  # nothing is tracked, and the tables are up to date
    mcaptrack.run(path, frame="base_link", sidecar=False, tables=False)
    assert decoded[2:] == [("/lidar/boxes", "base_link")]


@thorough
def test_the_summary_names_the_frame_in_which_boxes_in_space_were_tracked(passed, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(passed.read_bytes())
    plain = {"sidecar": False, "tables": False, "events": False}
    assert mcaptrack.run(path, **plain).summary.frame_id == "map"
    assert mcaptrack.run(path, frame="base_link", **plain).summary.frame_id == "base_link"
    with log.read(path) as opened, pytest.MonkeyPatch.context() as patch:
        patch.setattr(summary, "has_any", lambda *_: True)  # of tracks on pictures, too, metres may be in a frame
        assert summary.summarise(opened, "/lidar").frame_id is None


def test_limits_of_classes_that_there_are_not_are_named(passed, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(passed.read_bytes())
    limits = {"class_limits": "caar=4, pedestrian=5, truck=30", "sidecar": False, "force": True}
    found = [one for one in mcaptrack.predict(path, **limits).warnings if one.code == "option-not-used"]
    assert len(found) == 1
    assert "names caar: no such class is in the table of limits or in the boxes" in found[0].message


def test_boxes_that_viewers_cannot_draw_have_a_view_in_the_frame_of_the_tracks(passed, tmp_path):
    with log.read(passed) as opened:
        messages = [SceneUpdate.FromString(one.payload) for one in opened.messages("/lidar/boxes/view/scene")]
        layout = json.loads(opened.attachment("mcaptrack.layout.json"))
    assert len(messages) == SHOTS
    start_ns = messages[0].entities[0].timestamp.ToNanoseconds()
    for message in messages:
        assert [entity.frame_id for entity in message.entities] == ["map"] * len(OBJECTS)
        for entity in message.entities:
            number = int(entity.texts[0].text)
            cube, (name, *_, size) = entity.cubes[0], OBJECTS[number]
            centre = place(number, entity.timestamp.ToNanoseconds(), start_ns)
            at = cube.pose.position
            np.testing.assert_allclose([at.x, at.y, at.z], centre, atol=0.02)
            np.testing.assert_allclose([cube.size.x, cube.size.y, cube.size.z], size, atol=0.02)
            assert (cube.color.r, cube.color.g, cube.color.b) == class_colour(1, name)
    shown = [panel["topics"] for name, panel in layout["configById"].items() if name.startswith("3D!recorded")]
    assert [topics["/lidar/boxes/view/scene"]["visible"] for topics in shown] == [True]
    path, _ = write_passing(tmp_path, "scene updates", shots=4)
    mcaptrack.track(path, topic="/lidar/boxes", sidecar=False)
    assert "/lidar/boxes/view/scene" not in {channel.topic for channel in mcaptrack.info(path).channels}


def test_rows_about_tracks_have_their_classes_in_tables(passed):
    with mcaptrack.open(passed) as opened:
        names = {}
        for topic in ("/lidar/samples", "/lidar/retracks/online", "/lidar/retracks"):
            rows = [row for row in opened.table("tracks").to_pylist() if row["topic"] == topic]
            names[topic] = {row["track_id"]: row["class"] for row in rows}
        assert set(names["/lidar/samples"].values()) == {"car", "pedestrian"}
        for topic, tracks in (("predictions", "samples"), ("retracks/predictions", "retracks/online")):
            for table, ending in (("predictions", ""), ("forecast_errors", "/errors")):
                rows = [row for row in opened.table(table).to_pylist() if row["topic"] == f"/lidar/{topic}{ending}"]
                assert len(rows) > 10
                assert all(row["class"] == names[f"/lidar/{tracks}"][row["track_id"]] for row in rows)
        events = [row for row in opened.table("events").to_pylist() if row["topic"] == "/lidar/retracks/events"]
        truth = {number: name for number, (name, *_) in OBJECTS.items()}
        wanted = [names["/lidar/retracks"].get(row["track_id"], truth.get(row["truth_id"])) for row in events]
        assert [row["class"] for row in events] == wanted
        assert None not in wanted


def test_errors_of_predictions_are_those_of_each_class_alone(passed):
    """Both walk and drive straight on: a class scored by itself has the errors that a log of it alone would have."""
    scores = mcaptrack.evaluate(passed, similarity="metres", gate_m=2.0)
    rows = {row.of_class: row.displacement for row in scores.results if row.tracks == "/lidar/samples"}
    assert set(rows) == {None, "car", "pedestrian"}
    with log.read(passed) as opened:
        sequence = sequence_of_log(opened, "/lidar", ("/lidar/samples",))
    (candidate,) = sequence.candidates
    for name, number in (("car", 3), ("pedestrian", 8)):
        class_id = next(one for one, known in candidate.classes.items() if known == name)
        ids = {int(row["track_id"]) for frame in candidate.frames for row in frame.rows if row["class_id"] == class_id}
        alone = [
            [frame._replace(rows=frame.rows[np.isin(frame.rows["track_id"], list(wanted))]) for frame in frames]
            for frames, wanted in (
                (candidate.forecasts, ids), (candidate.frames, ids), (sequence.ground_truth, {number})
            )
        ]  # fmt: skip
        wanted = score_forecasts(*alone, "alone").summary()
        assert rows[name].summary() == wanted
        assert wanted["recall"] > 0.3
    found = {name: rows[name].summary()["ADE_m"] for name in rows}
    assert min(found["car"], found["pedestrian"]) <= found[None] <= max(found["car"], found["pedestrian"])
    out = done("evaluate", passed, "--similarity", "metres").out
    table = out[out.rindex("forecasts of") :].splitlines()
    assert table[0].split()[:3] == ["forecasts", "of", "class"]
    assert [tuple(line.split()[:2]) for line in table[1:4]] == [
        ("/lidar/samples", "all" if name is None else name) for name in rows
    ]
