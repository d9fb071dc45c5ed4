"""A detector can name the tracker that suits it: `run` takes that one, says so, and obeys who chooses another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest

import mcaptrack
from mcaptrack.schema import DETECTIONS, VIDEO
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import STAGES, OnnxDetector
from tests.commands import call

BOX = {"x_px": [10.0], "y_px": [10.0], "w_px": [8.0], "h_px": [20.0]}


@dataclass(frozen=True, kw_only=True)
class Plain:
    """One box in each picture."""

    reads: ClassVar = VIDEO
    writes: ClassVar = {"": DETECTIONS}
    latency_s: ClassVar = {"": 0.0}

    def __call__(self, frames) -> Iterator:
        for frame in frames:
            yield (frame._replace(rows=DETECTIONS.rows(score=[0.9], class_id=[1], **BOX)),)


@dataclass(frozen=True, kw_only=True)
class Choosy(Plain):
    suits: ClassVar = {"tracker": "ocsort"}


@pytest.fixture
def log(tmp_path) -> Path:
    folder = tmp_path / "pictures"
    folder.mkdir()
    for number in range(8):
        cv2.imwrite(str(folder / f"{number}.png"), np.full((48, 64, 3), 20 * number, np.uint8))
    path = tmp_path / "log.mcap"
    mcaptrack.ingest(folder, output=path, fps=10)
    return path


def tracker_of(path: Path) -> str:
    with mcaptrack.log.read(path) as opened:
        made = Provenance.from_metadata(opened.channel("/camera/tracks").metadata)
    assert made is not None
    return str(made.parameters["tracker"])


def run(path: Path, **options) -> tuple[str, list[str]]:
    """The tracker that a run took, and the notes that name it."""
    result = mcaptrack.run(path, tables=False, events=False, **options)
    return tracker_of(path), [note for note in result.notes if "suits" in note]


def test_a_run_takes_the_tracker_that_suits_the_detector_and_says_so(log):
    tracker, notes = run(log, detector=Choosy())
    assert tracker == "ocsort"
    assert len(notes) == 1
    assert "track by ocsort, which suits the detector" in notes[0]


def test_another_tracker_can_be_chosen(log):
    assert run(log, detector=Choosy(), tracker="sort") == ("sort", [])


def test_a_detector_that_names_none_gets_the_usual_one(log):
    assert run(log, detector=Plain()) == ("sort", [])


def test_who_only_detected_before_gets_the_suited_one_too(log):
    mcaptrack.detect(log, detector="knn")
    assert run(log)[0] == "sort"
    assert run(log, detector=Choosy())[0] == "ocsort"


def test_another_detector_brings_its_tracker(log):
    assert run(log, detector=Plain(), tracker="bytetrack")[0] == "bytetrack"
    assert run(log, detector=Choosy())[0] == "ocsort"
    assert run(log)[0] == "ocsort"  # nothing is due
    assert run(log, detector=Plain(), tracker="sort") == ("sort", [])
    assert run(log, detector=Choosy(), tracker="bytetrack") == ("bytetrack", [])


def test_the_command_line_says_it_on_stderr(log, monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[1])
    said = call("run", log, "--detector", "tests.test_suited_trackers:Choosy", "--no-tables")
    assert said.code == 0
    assert "track by ocsort, which suits the detector tests.test_suited_trackers:Choosy; --tracker chooses" in said.err
    assert tracker_of(log) == "ocsort"


def test_suited_trackers_exist():
    named = [dict(getattr(cls, "suits", {})) for stage in STAGES.values() for cls in stage.built_in().values()]
    assert {name for suits in named for name in suits.items()} == {("tracker", "bytetrack")}
    assert OnnxDetector.suits["tracker"] in STAGES["track"].built_in()
