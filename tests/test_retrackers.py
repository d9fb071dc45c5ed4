"""The two methods of re-tracking as entries of the registry."""

from __future__ import annotations

import pytest

from mcaptrack import log
from mcaptrack.schema.provenance import Provenance
from tests.commands import call


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
