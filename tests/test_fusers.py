"""Fusers of other packages: found, checked, recorded and used again like detectors and trackers."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.registry import names
from mcaptrack.testing import check_transform
from mcaptrack.transforms import FUSION
from tests.commands import call
from tests.places import CAMERAS, fused, write_log

CELLS = '''
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mcaptrack.schema import DETECTIONS, SIGHTINGS
from mcaptrack.transforms.protocol import option


@dataclass(frozen=True, kw_only=True)
class CellFuser:
    """Join boxes that stand in one cell of a grid."""

    cell_m: float = option(1.0, "size of the cells in metres", least=0.1)

    reads: ClassVar = SIGHTINGS
    writes: ClassVar = {"": DETECTIONS, "sightings": SIGHTINGS}
    latency_s: ClassVar = {"": 0.0, "sightings": 0.0}

    def __call__(self, frames):
        for frame in frames:
            rows = frame.rows[np.lexsort((frame.rows["box_row"], frame.rows["camera"]))]
            xy_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
            cells, of = np.unique(np.floor(xy_m / self.cell_m), axis=0, return_inverse=True)
            rows["detection"] = of
            x_m, y_m = (cells.T + 0.5) * self.cell_m
            found = DETECTIONS.rows(x_m=x_m, y_m=y_m, class_id=[1] * len(cells))
            yield frame._replace(rows=found), frame._replace(rows=rows)


class Silent(CellFuser):
    writes: ClassVar = {"": DETECTIONS}


class Tracker(CellFuser):
    reads: ClassVar = DETECTIONS


class Broken(CellFuser):
    def __call__(self, frames):
        yield from ()
        raise ValueError("no cells")
'''
NAME = "cells_of_a_test:CellFuser"


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("fusers") / "boxes.mcap", CAMERAS[:2])


@pytest.fixture
def path(boxes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cells_of_a_test.py").write_text(CELLS)
    return Path(shutil.copy(boxes, tmp_path / "log.mcap"))


def test_a_fuser_of_a_module_makes_the_scene_and_is_recorded(path: Path) -> None:
    mcaptrack.fuse(path, fuser=NAME)
    for t_ns, rows in fused(path).items():
        seen = fused(path, "/world/detections/sightings")[t_ns] if t_ns < 3_000_000_000 else None
        if seen is not None:  # boxes of one cell are one detection, in its middle
            cells = {(np.floor(x), np.floor(y)) for x, y in zip(seen["x_m"], seen["y_m"], strict=True)}
            assert {(x - 0.5, y - 0.5) for x, y in zip(rows["x_m"], rows["y_m"], strict=True)} == cells
    (channel,) = (one for one in mcaptrack.info(path).channels if one.topic == "/world/detections")
    assert channel.parameters is not None
    assert (channel.parameters["fuser"], channel.parameters["cell_m"]) == (NAME, 1.0)
    assert channel.plugins is not None
    assert channel.plugins["transform"]["implementation"] == NAME


def test_a_later_run_uses_the_same_fuser_if_it_may(path: Path) -> None:
    made = FUSION.make(NAME, cell_m=2.0)
    mcaptrack.fuse(path, fuser=made)
    with mcaptrack.open(path) as log:
        frames = [mcaptrack.detections([], [], [], t_ns, box_format="xywh") for t_ns in (1_000_000_000, 2_000_000_000)]
        log.write("/north/detections", frames, replace=True)
    options = {"camera": "world", "tables": False, "events": False, "predictor": "cv"}
    with collected(), pytest.raises(McaptrackError, match="is imported only if you name it"):
        mcaptrack.run(path, **options)
    with collected():
        again = mcaptrack.run(path, fuser=NAME, **options)
        assert any(note.endswith("fusing east, north again, as before") for note in again.notes) or any(
            note.endswith("fusing north, east again, as before") for note in again.notes
        )
        other = mcaptrack.run(path, fuser="feet", **options)
    assert any(note.endswith("again, by the fuser feet") for note in other.notes)
    (channel,) = (one for one in mcaptrack.info(path).channels if one.topic == "/world/detections")
    assert channel.parameters is not None
    assert channel.parameters["fuser"] == "feet"
    assert channel.parameters["max_sigma"] == 3.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--fuser", "cells_of_a_test:Silent"), "has no output 'sightings'; a fuser also writes which boxes it joined"),
        (("--fuser", "cells_of_a_test:Tracker"), "reads mcaptrack.Detections; a fuser reads mcaptrack.Sightings"),
        (("--fuser", "cells_of_a_test:Broken"), "ValueError: no cells (cells_of_a_test.py, line"),
        (("--fuser", "feets"), "no fuser is called feets; did you mean feet?"),
        (("--fuser", NAME, "--max-sigma", "2"), "has no parameter max_sigma; there are cell_m"),
    ],
)
def test_a_fuser_that_can_not_be_used_is_refused_in_one_line(path: Path, options: tuple[str, ...], words: str) -> None:
    before = path.read_bytes()
    outcome = call("fuse", path, *options)
    assert (outcome.code, path.read_bytes()) == (1, before)
    assert words in outcome.err
    assert len(outcome.err.splitlines()) == 1


def test_the_laws_of_transforms_are_those_of_fusers(path: Path) -> None:
    assert names("fuser")[0] == "feet"
    check_transform(FUSION.make(NAME))
    check_transform(FUSION.make())
