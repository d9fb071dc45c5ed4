"""The whole line on the log of a robot: what is made of its boxes, and what commands show of it."""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

import mcaptrack
from mcaptrack import log
from mcaptrack.evaluation import sequence_of_log
from mcaptrack.evaluation.forecasts import score_forecasts
from mcaptrack.foxglove import class_colour, colour
from mcaptrack.pipeline import summary
from mcaptrack.sources import fixed_frame
from tests.commands import done
from tests.robot_runs import OBJECTS, passing_robot, place, write_passing
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


def test_a_video_from_above_follows_the_robot_and_has_all_objects_in_their_places(passed, tmp_path):
    result = mcaptrack.render(passed, tmp_path / "a.mp4", start_s=1.15, end_s=1.35)
    assert result.views == ("/lidar/retracks/full/view/scene", "/lidar/retracks/predictions/view/scene")
    with log.read(passed) as opened:
        t_ns = opened.times(result.views[0])[12:14]
    with av.open(str(tmp_path / "a.mp4")) as container:
        frames = [frame.to_ndarray(format="bgr24").astype(int) for frame in container.decode(video=0)]
    assert len(frames) == len(t_ns) == result.pictures
    robot = passing_robot(SHOTS)
    start_ns = robot.shots[0].stamp_ns
    image, at_ns = frames[0], int(t_ns[0])
    base = [np.interp(at_ns, robot.stamps.astype(float), robot.place[:, axis]) for axis in (0, 1)]
    assert image.shape[0] > 720  # a legend below
    assert image.shape[1:] == (960, 3)
    assert image[360, 480].min() > 180  # the robot is in the middle, in white
    x, y = (place(3, at_ns, start_ns)[:2] - base) * 12 * [1, -1] + [480, 360]
    near = image[round(y) + 3 : round(y) + 6, round(x) - 12 : round(x) - 2].reshape(-1, 3)  # beside the label
    with mcaptrack.open(passed) as opened:
        rows = opened.array("tracks", "/lidar/retracks/full")
    now = rows[rows["t_ns"] == at_ns]
    nearest = np.hypot(now["x_m"] - place(3, at_ns, start_ns)[0], now["y_m"] - place(3, at_ns, start_ns)[1]).argmin()
    wanted = np.array(colour(int(now["track_id"][nearest]))[2::-1]) * 255
    paint = near - [32, 28, 26]
    share = (paint * (wanted - [32, 28, 26])).sum(axis=1) / np.sum((wanted - [32, 28, 26]) ** 2)
    assert np.median(share) == pytest.approx(0.625, abs=0.12)
    away = image[round(720 - y), round(960 - x)]
    assert np.abs(away - [32, 28, 26]).max() < 40


def test_without_a_robot_all_places_are_in_the_video(tmp_path):
    rows = [f"{n * 100_000_000},{k},{100 + 300 * k + n},{50 - 20 * k},0.5,4,2,1.5,0" for n in range(16) for k in (1, 2)]
    (tmp_path / "truth.csv").write_text("\n".join(["t_ns,id,x_m,y_m,z_m,length_m,width_m,height_m,heading_rad", *rows]))
    path = tmp_path / "a.mcap"
    mcaptrack.ingest(tmp_path / "truth.csv", output=path, role="tracks", frame="map")
    mcaptrack.run(path, tables=False, events=False)
    result = mcaptrack.render(path, tmp_path / "a.gif", topic="/camera/tracks", width=320)
    assert (result.pictures, result.views) == (16, ("/camera/tracks/view/scene",))
    with av.open(str(tmp_path / "a.gif")) as container:
        image = next(container.decode(video=0)).to_ndarray(format="bgr24").astype(int)
    bright = np.argwhere(image[:240].max(axis=2) > 120)[:, 1]
    assert image.shape[0] > 240  # a legend below
    assert image.shape[1:] == (320, 3)
    assert (bright < 60).any()
    assert (bright > 260).any()


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
