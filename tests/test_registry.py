"""Detectors, trackers and predictors are found by name: built-in ones, entry points, and ``module:Class``."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from mcaptrack import registry
from mcaptrack.errors import McaptrackError
from mcaptrack.predictors import NAMES
from mcaptrack.registry import BUILT_IN, KINDS, entry_of, find, names
from mcaptrack.transforms import STAGES, ByteTrack, Sort
from tests.distributions import package

PLUGIN = """
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import ClassVar

from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.transforms.protocol import option


@dataclass(frozen=True, kw_only=True)
class Nearest:
    gain: float = option(2.0, "how much", least=0.0)

    reads: ClassVar = DETECTIONS
    writes: ClassVar = {"": TRACKS}
    latency_s: ClassVar = {"": 0.0}

    def __call__(self, frames):
        for frame in frames:
            yield (frame._replace(rows=TRACKS.empty()),)
"""


@pytest.fixture
def installed(tmp_path, monkeypatch) -> Path:
    """A folder that stands for installed packages, with one that has a tracker."""
    folder = tmp_path / "site"
    (folder / "own_trackers").mkdir(parents=True)
    (folder / "own_trackers" / "__init__.py").write_text(PLUGIN)
    package(folder, "own-trackers", "1.5", "mcaptrack.trackers", {"nearest": "own_trackers:Nearest"})
    monkeypatch.syspath_prepend(str(folder))
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "own_trackers"]:
        del sys.modules[name]


@pytest.mark.parametrize("kind", KINDS)
def test_every_built_in_name_is_found_and_is_its_class_again(kind):
    assert names(kind)[: len(BUILT_IN[kind])] == tuple(BUILT_IN[kind])
    for name in BUILT_IN[kind]:
        entry = find(kind, name)
        assert (entry.name, entry.kind, entry.distribution, entry.is_built_in) == (name, kind, "mcaptrack", True)
        assert entry_of(kind, entry.cls) == entry


def test_predictors_that_need_no_file_are_the_built_in_ones_but_onnx():
    assert set(NAMES) == set(BUILT_IN["predictor"]) - {"onnx"}


@pytest.mark.parametrize("stage", [stage for stage in STAGES.values() if stage.kind], ids=lambda stage: stage.name)
def test_the_default_of_a_stage_is_the_first_of_its_kind(stage):
    assert stage.built_in()[next(iter(BUILT_IN[stage.kind]))] is stage.default
    assert {cls.reads for cls in stage.built_in().values()} == {stage.default.reads}


def test_an_entry_point_is_found_and_listed_without_an_import(installed):
    assert names("tracker") == ("sort", "bytetrack", "ocsort", "nearest")
    assert "own_trackers" not in sys.modules
    entry = find("tracker", "nearest")
    assert (entry.name, entry.implementation) == ("nearest", "own_trackers:Nearest")
    assert (entry.distribution, entry.version, entry.is_built_in) == ("own-trackers", "1.5", False)
    assert str(entry) == "tracker nearest (own-trackers 1.5)"
    assert entry_of("tracker", entry.cls) == entry
    assert STAGES["track"].make("nearest", gain=3.0).gain == 3.0


def test_module_and_class_is_found_also_in_the_working_folder(tmp_path, monkeypatch):
    (tmp_path / "beside_it.py").write_text(PLUGIN)
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    entry = find("tracker", "beside_it:Nearest")
    assert sys.path == before
    assert (entry.implementation, entry.distribution, entry.version) == ("beside_it:Nearest", "", "")
    assert entry_of("tracker", entry.cls) == entry
    del sys.modules["beside_it"]


def test_a_class_that_inherits_from_a_built_in_one_is_another(monkeypatch):
    class Sort(ByteTrack):
        pass

    entry = entry_of("tracker", Sort)
    assert not entry.is_built_in
    assert entry.name.startswith(f"{__name__}:")


def test_built_in_names_cannot_be_taken(installed):
    package(installed, "thief", "1", "mcaptrack.trackers", {"sort": "own_trackers:Nearest"})
    assert names("tracker").count("sort") == 1
    assert find("tracker", "sort").cls is Sort


def test_two_packages_of_one_name_are_refused(installed):
    package(installed, "other", "2", "mcaptrack.trackers", {"nearest": "elsewhere:Nearest"})
    with pytest.raises(McaptrackError, match=r"several installed packages have a tracker nearest: elsewhere:Nearest"):
        find("tracker", "nearest")


@pytest.mark.parametrize(
    ("text", "name", "said"),
    [
        ("", "nosuch", "no tracker is called nosuch; there are sort, bytetrack, ocsort, nearest; an installed package"),
        ("", "ocsrot", "no tracker is called ocsrot; did you mean ocsort\\? there are"),
        ("", "missing_module:A", "tracker missing_module:A can't be imported: ModuleNotFoundError: No module named"),
        ("raise SystemError('two\\nlines')", "own_trackers:A", "can't be imported: SystemError: two lines"),
        ("x = (", "nearest", r"tracker nearest \(own-trackers 1.5\) can't be imported: SyntaxError"),
        ("", "nearest", r"tracker nearest \(own-trackers 1.5\): own_trackers has no class Nearest"),
        ("Nearest = 3", "own_trackers:Nearest", "Nearest in own_trackers is no class but of type int"),
        ("raise SystemExit(0)", "own_trackers:Nearest", "can't be imported: SystemExit: 0"),
        ("", "own_trackers:", "own_trackers: is not of the form module:Class"),
        ("", "a b:C", "a b:C is not of the form module:Class"),
    ],
)
def test_what_cannot_be_found_is_said_in_one_line(installed, text, name, said):
    (installed / "own_trackers" / "__init__.py").write_text(text)
    with pytest.raises(McaptrackError, match=said) as refused:
        find("tracker", name)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (PLUGIN.replace("@dataclass(frozen=True, kw_only=True)", ""), "is no dataclass"),
        (
            PLUGIN.replace("reads: ClassVar = DETECTIONS", ""),
            r"reads no schema \(the class attribute reads\); a tracker",
        ),
        (
            PLUGIN.replace('{"": TRACKS}', '{"": DETECTIONS}'),
            "writes mcaptrack.Detections; a tracker writes mcaptrack.Tr",
        ),
        (PLUGIN.replace('{"": TRACKS}', "TRACKS"), "writes nothing"),
        (PLUGIN.replace("__call__", "call"), "can't be called with frames"),
        (PLUGIN.replace("gain: float", "gain: dict"), "Nearest.gain is a dict; a parameter is a float"),
        (PLUGIN.replace("gain: float", "tracker: float"), "a parameter can't have the name of the option `tracker=`"),
        (
            PLUGIN.replace('gain: float = option(2.0, "how much", least=0.0)', "gain: float"),
            "Nearest.gain has no default",
        ),
    ],
)
def test_a_class_that_cannot_track_is_refused_in_one_line(installed, text, said):
    (installed / "own_trackers" / "__init__.py").write_text(text)
    with pytest.raises(McaptrackError, match=said) as refused:
        STAGES["track"].find("nearest")
    assert "\n" not in str(refused.value)
    assert "nearest (own-trackers 1.5)" in str(refused.value)


def test_parameters_that_there_are_not_are_said_with_those_that_there_are(installed):
    with pytest.raises(McaptrackError, match=r"has no parameter gian; did you mean gain\? there are gain"):
        STAGES["track"].make("nearest", gian=1.0)
    with pytest.raises(McaptrackError, match="sample has one transform only"):
        STAGES["sample"].find("nearest")


def test_the_groups_of_entry_points_are_those_of_the_documentation():
    groups = {f"mcaptrack.{kind}s" for kind in KINDS}
    assert groups == {
        "mcaptrack.detectors",
        "mcaptrack.trackers",
        "mcaptrack.predictors",
        "mcaptrack.retrackers",
        "mcaptrack.fusers",
    }
    for group in groups:
        assert f".{group.partition('.')[2]}``" in (registry.__doc__ or "")
