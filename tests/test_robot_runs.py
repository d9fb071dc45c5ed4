"""The whole line on the log of a robot: what is made of its boxes, and what commands show of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

import mcaptrack
from mcaptrack import log
from mcaptrack.schema import TRACKS
from mcaptrack.sources import fixed_frame
from mcaptrack.viewing.report import gather, page
from tests.commands import done
from tests.robot_runs import OBJECTS, place, write_passing


@pytest.fixture(scope="module")
def passed(tmp_path_factory) -> Path:
    """A log of a robot with truth, after ``run``."""
    folder = tmp_path_factory.mktemp("robot")
    path, truth = write_passing(folder)
    mcaptrack.ingest(truth, into=path, role="truth", frame="map", sidecar=False)
    mcaptrack.run(path, sidecar=False)
    return path


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
    assert result.summary.boxes == result.tables["detections"] == 25 * len(OBJECTS)
    assert mcaptrack.run(path, sidecar=False).summary.boxes == 25 * len(OBJECTS)
    assert len(decoded) == 2  # nothing is tracked, and the tables are up to date
    mcaptrack.run(path, frame="base_link", sidecar=False, tables=False)
    assert decoded[2:] == [("/lidar/boxes", "base_link")]


def test_boxes_that_viewers_cannot_draw_have_a_view_in_the_frame_of_the_tracks(passed, tmp_path):
    with log.read(passed) as opened:
        messages = [SceneUpdate.FromString(one.payload) for one in opened.messages("/lidar/boxes/view/scene")]
        layout = json.loads(opened.attachment("mcaptrack.layout.json"))
    assert len(messages) == 25
    start_ns = messages[0].entities[0].timestamp.ToNanoseconds()
    for message in messages:
        assert [entity.frame_id for entity in message.entities] == ["map"] * len(OBJECTS)
        for entity in message.entities:
            number, name = entity.texts[0].text.split()
            cube, (wanted, *_, size) = entity.cubes[0], OBJECTS[int(number)]
            centre = place(int(number), entity.timestamp.ToNanoseconds(), start_ns)
            at = cube.pose.position
            np.testing.assert_allclose([at.x, at.y, at.z], centre, atol=0.02)
            np.testing.assert_allclose([cube.size.x, cube.size.y, cube.size.z], size, atol=0.02)
            assert name == wanted
    shown = [panel["topics"] for name, panel in layout["configById"].items() if name.startswith("3D!recorded")]
    assert [topics["/lidar/boxes/view/scene"]["visible"] for topics in shown] == [True]
    path, _ = write_passing(tmp_path, "scene updates", shots=4)
    mcaptrack.track(path, topic="/lidar/boxes", sidecar=False)
    assert "/lidar/boxes/view/scene" not in {channel.topic for channel in mcaptrack.info(path).channels}


def test_info_names_the_frame_of_metres(passed):
    frames = {channel.topic: channel.frame for channel in mcaptrack.info(passed).channels}
    assert frames["/lidar/boxes"] is None
    assert {frames[f"/lidar/{name}"] for name in ("truth", "tracks", "retracks", "retracks/full")} == {"map"}
    lines = done("info", passed).out.splitlines()
    assert [line for line in lines if "/lidar/tracks" in line and line.endswith("  track  in map")]


def test_the_report_has_averages_over_recalls_where_evaluate_has_them(passed):
    scores = {
        (row.tracks, row.of_class): row.averages["AMOTA"]
        for row in mcaptrack.evaluate(passed, similarity="metres", gate_m=2.0).results
    }
    assert scores["/lidar/retracks/full", "car"] == 1.0
    with log.read(passed) as opened:
        text = page([gather(opened, None)])
    assert "AMOTA: MOTA averaged over recalls" in text
    assert ">AMOTA<" in text
    assert ">AMOTP_m<" in text


def test_a_run_across_classes_tracks_and_retracks_so_until_told_otherwise(passed, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(passed.read_bytes())

    def parameters() -> list[object]:
        found = {channel.topic: channel.parameters for channel in mcaptrack.info(path).channels}
        return [found[f"/lidar/{name}"]["across_classes"] for name in ("tracks", "retracks")]

    quick = {"events": False, "tables": False, "sidecar": False}
    assert parameters() == [False, False]
    result = mcaptrack.run(path, across_classes=True, **quick)
    assert {"track", "retrack"} <= set(result.stages)
    assert any("with another `across_classes=` or `frame=`" in note for note in result.notes)
    assert parameters() == [True, True]
    assert mcaptrack.run(path, **quick).stages == ()
    assert "--across-classes" in done("run", "--help").out
    done("run", path, "--within-classes", "--no-events", "--no-tables", "--in-place", "-q")
    assert parameters() == [False, False]
    with log.read(path) as opened:
        assert len(opened.rows("/lidar/tracks", TRACKS).rows) > 10 * len(OBJECTS)
