"""Logs of former versions: read as they were, and left as they are until they are made again.

The logs in old_logs/ were made by these versions of a drawn clip, by `ingest` and `run`, and lost their video and views to
`drop`. The numbers of rows are those that these versions printed.
"""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

import mcaptrack
from tests.commands import call, done

OLD = Path(__file__).parent / "old_logs"
ROWS = {
    "0.1.0": {"/camera/samples": 15, "/camera/tracks": 57, "/camera/retracks": 13, "/camera/retracks/full": 53},
    "0.2.0": {"/camera/samples": 15, "/camera/tracks": 60, "/camera/retracks": 15, "/camera/retracks/full": 60},
}


@pytest.fixture(params=ROWS)
def version(request, tmp_path, monkeypatch) -> str:
    """A former version; a.mcap in the working folder is a log of it."""
    monkeypatch.chdir(tmp_path)
    Path("a.mcap").write_bytes(gzip.decompress((OLD / f"{request.param}.mcap.gz").read_bytes()))
    return str(request.param)


def test_a_log_of_a_former_version_is_sound_and_has_the_same_rows(version):
    assert mcaptrack.check("a.mcap").is_sound
    with mcaptrack.open("a.mcap") as log:
        assert {topic: len(log.array("tracks", topic)) for topic in ROWS[version]} == ROWS[version]
    made = mcaptrack.query("a.mcap", "select topic, version from channels where topic = '/camera/tracks'")
    assert made.to_pylist() == [{"topic": "/camera/tracks", "version": version}]


def test_run_leaves_it_as_it_is_until_all_is_to_be_made_again(version):
    before = Path("a.mcap").read_bytes()
    code, _, err = call("run", "a.mcap", "--no-tables")
    assert (code, Path("a.mcap").read_bytes()) == (0, before)
    assert "a.mcap: nothing to do, everything is up to date" in err.splitlines()
    done("retrack", "a.mcap", "--force")
    made = mcaptrack.query(
        "a.mcap", "select topic, version from channels where topic in ('/camera/retracks', '/camera/tracks')"
    )
    assert {row["topic"]: row["version"] for row in made.to_pylist()} == {
        "/camera/retracks": mcaptrack.__version__,
        "/camera/tracks": version,
    }
    assert mcaptrack.check("a.mcap").is_sound
