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
from mcaptrack.registry import KINDS
from mcaptrack.schema import DETECTIONS, VIDEO
from mcaptrack.transforms import STAGES
from mcaptrack.transforms.protocol import Suited, traits_of
from tests.logs import provenance_of
from tests.tiers import thorough

BOX = {"x_px": [10.0], "y_px": [10.0], "w_px": [8.0], "h_px": [20.0]}


@dataclass(frozen=True, kw_only=True)
class Plain:
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
    return str(provenance_of(path, "/camera/tracks").parameters["tracker"])


def run(path: Path, **options) -> tuple[str, list[str]]:
    """The tracker that a run took, and the notes that name it."""
    result = mcaptrack.run(path, tables=False, events=False, **options)
    return tracker_of(path), [note for note in result.notes if "suits" in note]


@thorough
def test_another_detector_brings_its_tracker(log):
    assert run(log, detector=Plain(), tracker="bytetrack")[0] == "bytetrack"
    assert run(log, detector=Choosy())[0] == "ocsort"
    assert run(log)[0] == "ocsort"  # nothing is due
    assert run(log, detector=Plain(), tracker="sort") == ("sort", [])
    assert run(log, detector=Choosy(), tracker="bytetrack") == ("bytetrack", [])


def test_suited_trackers_exist():
    classes = [cls for one in STAGES.values() for cls in one.built_in().values()]
    suited = [one for cls in classes for kind in KINDS if (one := traits_of(cls).suited(kind)) is not None]
    for one in suited:
        assert STAGES["track"].make(one.name, **{**one.parameters, **one.on_ground}) is not None


@dataclass(frozen=True, kw_only=True)
class Strict(Plain):
    suits: ClassVar = {"tracker": Suited("bytetrack", {"new_score": 0.9}, on_ground={"cost": "metres"})}


@pytest.mark.parametrize(("is_planar", "said"), [(False, "(new_score 0.9)"), (True, "(new_score 0.9, cost metres)")])
def test_the_suited_tracker_is_made_with_the_parameters_that_the_detector_names(log, is_planar, said):
    if is_planar:
        plane = log.with_name("plane.txt")
        plane.write_text("0.1 0 0\n0 0.1 0\n0 0 1\n")
        mcaptrack.ingest(log.with_name("pictures"), output=log, fps=10, ground_plane=plane, force=True)
    tracker, notes = run(log, detector=Strict())
    assert tracker == "bytetrack"
    assert f"track by bytetrack {said}, which suits" in notes[0]


@dataclass(frozen=True, kw_only=True)
class Lost(Plain):
    suits: ClassVar = {"tracker": "nosuch"}


@dataclass(frozen=True, kw_only=True)
class Wrong(Plain):
    suits: ClassVar = {"tracker": Suited("sort", {"nosuch": 1})}


@pytest.mark.parametrize(
    ("detector", "said"), [(Lost, "no tracker is called nosuch"), (Wrong, "tracker sort has no parameter nosuch")]
)
def test_a_suited_tracker_that_there_is_not_is_refused_with_the_detector_and_the_way_out(log, detector, said):
    with pytest.raises(mcaptrack.McaptrackError, match=said) as refused:
        run(log, detector=detector())
    assert f"detector tests.test_suited_trackers:{detector.__name__}" in str(refused.value)
    assert "`tracker=` chooses another" in str(refused.value)
    assert run(log, detector=detector(), tracker="sort") == ("sort", [])


@pytest.mark.parametrize("suits", ["bytetrack", {"tracker": 5}, {"tracked": "sort"}, None])
def test_a_class_with_other_suits_is_refused(monkeypatch, suits):
    monkeypatch.setattr(Choosy, "suits", suits)
    with pytest.raises(mcaptrack.McaptrackError, match=r"has suits = .*; it maps kinds to names") as refused:
        STAGES["detect"].find(f"{__name__}:Choosy")
    assert "\n" not in str(refused.value)
