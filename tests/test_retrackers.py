"""The two methods of re-tracking as entries of the registry: their options, old names of these, and old logs."""

from __future__ import annotations

import json
from dataclasses import fields

import pytest

from mcaptrack import log
from mcaptrack.pipeline.rebuild import rebuild
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import PROFILES, STAGES, Retrack, RetrackByConsistency
from tests.commands import call

#: Old names of options, by new name, as version 0.1 had them.
OLD = {
    "drift_m_per_s": "drift",
    "drift_ratio": "drift_share",
    "same_id_bonus": "same_source",
    "interpolated": "filled",
    "link_confidence": "link_certainty",
    "resolve_swaps": "part",
    "track_confidence": "min_certainty",
    "merge_distance_m": "share_m",
    "merge_timeout_s": "share_s",
    "confirm_s": "sure_s",
    "gate_m": "max_jump_m",
    "priority_distance": "certain_distance",
    "trim_ends": "confirm",
}
KINDS = {"likelihood": Retrack, "consistency": RetrackByConsistency}


@pytest.fixture
def walked(tmp_path, monkeypatch):
    """The working folder, with a log of one track."""
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"{frame},1,{10 + frame},20,10,30,1,-1,-1,-1\n" for frame in range(1, 41))
    (tmp_path / "t.txt").write_text(rows)
    assert call("ingest", "t.txt", "--as", "tracks", "--fps", "10", "-o", "a.mcap").code == 0
    return tmp_path


def made(path) -> dict[str, object]:
    with log.read(path) as opened:
        said = Provenance.from_metadata(opened.channel("/camera/retracks").metadata)
    assert said is not None
    return dict(said.parameters)


def test_old_names_are_those_of_version_0_1():
    declared = {f.name: f.metadata["was"] for kind in KINDS.values() for f in fields(kind) if f.metadata.get("was")}
    assert declared == OLD


def test_old_names_are_accepted_in_a_file_in_the_environment_and_on_the_command_line(walked, monkeypatch):
    (walked / "mcaptrack.toml").write_text("[retrack]\nshare-m = 0.7\npart = false\n")
    monkeypatch.setenv("MCAPTRACK_RETRACK_SURE_S", "0.8")
    result = call("retrack", "a.mcap", "--same-source", "5", "--filled")
    assert result.code == 0, result.err
    found = made(walked / "a.mcap")
    wanted = {"merge_distance_m": 0.7, "resolve_swaps": False, "confirm_s": 0.8, "same_id_bonus": 5.0}
    wanted |= {"interpolated": True, "retracker": "likelihood"}
    assert {name: found[name] for name in wanted} == wanted
    assert not found.keys() & set(OLD.values())
    assert "--same-source is called --same-id-bonus now" in result.err


def test_a_profile_names_its_method_and_distance_implies_it(walked):
    assert call("retrack", "a.mcap", "--profile", "authors").code == 0
    assert made(walked / "a.mcap")["retracker"] == "consistency"
    result = call("retrack", "a.mcap", "--set", "distance=now")
    assert result.code == 0
    assert "--retracker consistency" in result.err
    assert (made(walked / "a.mcap")["retracker"], made(walked / "a.mcap")["distance"]) == ("consistency", "now")
    result = call("retrack", "a.mcap", "--profile", "authors", "--retracker", "likelihood")
    assert (result.code, result.err) == (
        1,
        "mcaptrack: the profile authors is of the retracker consistency, not of likelihood\n",
    )
    result = call("retrack", "a.mcap", "--profile", "paper", "--set", "coast_s=1")
    assert (result.code, result.err) == (1, "mcaptrack: --set coast_s is an option of likelihood, not of consistency\n")


@pytest.mark.parametrize("profile", PROFILES)
def test_logs_of_version_0_1_are_rebuilt_with_the_same_parameters(profile):
    """There ``distance`` chose the method, both methods had all options, and some options had other names."""
    transform = PROFILES[profile]
    options = [f for kind in KINDS.values() for f in fields(kind) if not f.metadata.get("context")]
    had = {f.name: getattr(transform, f.name, f.default) for f in options}
    if isinstance(transform, Retrack):
        had["distance"] = "likelihood"
    old = json.loads(json.dumps({OLD.get(name, name): value for name, value in had.items()}))
    stage = STAGES["retrack"]
    assert rebuild(stage, Provenance("retrack", old), {}) == transform
    now = {f.name: getattr(transform, f.name) for f in fields(transform) if not f.metadata.get("context")}
    assert rebuild(stage, Provenance("retrack", now | {"retracker": stage.choice(transform)}), {}) == transform
