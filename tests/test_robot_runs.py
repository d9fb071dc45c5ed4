"""The whole line on the log of a robot: what is made of its boxes, and what commands show of it."""

from __future__ import annotations

from pathlib import Path

import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.schema import TRACKS
from mcaptrack.viewing.report import gather, page
from tests.commands import done
from tests.robot_runs import OBJECTS, write_passing


@pytest.fixture(scope="module")
def passed(tmp_path_factory) -> Path:
    """A log of a robot with truth, after ``run``."""
    folder = tmp_path_factory.mktemp("robot")
    path, truth = write_passing(folder)
    mcaptrack.ingest(truth, into=path, role="truth", frame="map", sidecar=False)
    mcaptrack.run(path, sidecar=False)
    return path


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
