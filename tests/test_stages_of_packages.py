"""Stages of installed packages: the one of docs/extend.md, and what its class may declare."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import TRACKS
from tests.commands import call, done
from tests.logs import provenance_of
from tests.test_extensions import add, one_line, site  # noqa: F401  # a fixture
from tests.tiers import thorough

#: A stage that counts the marks and the tracks of the first frame.
COUNTS = """
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar
from mcaptrack import schema_of
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.transforms.protocol import context
COUNT = schema_of("Count", [("visits", "i4")])
@dataclass(frozen=True, kw_only=True)
class Part:
    marks: Any = context(tuple, is_recorded=False)
    reads: ClassVar = TRACKS
    writes: ClassVar = {"": COUNT}
    latency_s: ClassVar = {"": float("inf")}
    input_topic: ClassVar = "tracks"
    output_topic: ClassVar = "tracks/visits"
    also_reads: ClassVar = {"marks": ("marks", DETECTIONS)}
    def __call__(self, frames):
        visits = sum(len(frame.rows) for frame in self.marks)
        for frame in frames:
            yield (frame._replace(rows=COUNT.rows(visits=[visits])),)
"""


def mark(path: Path, count: int) -> None:
    """Write so many marks into a log."""
    boxes = mcaptrack.detections([[10, 20, 30, 40]] * count, [0.9] * count, [1] * count, 10**9, box_format="xyxy")
    with mcaptrack.open(path) as recording:
        recording.write("/camera/marks", [boxes], replace=True)


@pytest.fixture
def path(finished, tmp_path) -> Path:
    return Path(shutil.copy(finished, tmp_path / "log.mcap"))


@pytest.mark.usefixtures("site")
def test_settings_of_a_stage_are_its_own_and_no_matter_for_other_commands(path):
    Path("mcaptrack.toml").write_text("[speed]\nmax-gap-s = 0.5\n")
    done("info", path)
    done("speed", path)
    assert provenance_of(path, "/camera/speed").parameters["max_gap_s"] == 0.5


@pytest.mark.usefixtures("site")
def test_the_speed_of_the_page_is_that_of_the_positions(path):
    line = "speed Speed and heading of each track, from its positions (my-trackers 1.0)."
    assert line in " ".join(done("--help").out.split())
    done("speed", path, "--max-gap-s", "0.5")
    with log.read(path) as opened:
        rows = np.concatenate([frame.rows for frame in opened.frames("/camera/retracks", TRACKS)])
        t_ns = np.repeat(*zip(*((f.t_ns, len(f.rows)) for f in opened.frames("/camera/retracks", TRACKS)), strict=True))
    wanted = []
    for track in np.unique(rows["track_id"]):
        its = rows["track_id"] == track
        t_s, xy = t_ns[its] / 1e9, np.stack([rows["x_m"][its], rows["y_m"][its]], axis=-1)
        step, away = np.diff(t_s), np.diff(xy, axis=0)
        fast = np.hypot(*away.T)[step <= 0.5] / step[step <= 0.5]
        wanted += zip([int(track)] * len(fast), fast.tolist(), strict=True)
    with mcaptrack.open(path) as recording:
        table = recording.table("/camera/speed").to_pylist()
    found = sorted((row["track_id"], row["speed_m_per_s"]) for row in table)
    assert len(found) > 30
    np.testing.assert_allclose(found, sorted(wanted), rtol=1e-5)
    assert provenance_of(path, "/camera/speed").plugins["transform"][:3] == ("speed", "speed:Speed", "my-trackers")


@thorough
def test_run_makes_its_channel_again_and_never_first(site, path, monkeypatch):  # noqa: F811
    assert "/camera/speed" not in mcaptrack.run(path, tables=False).channels
    mcaptrack.stage("speed", path, max_gap_s=0.5)
    assert mcaptrack.run(path, tables=False).is_up_to_date
    assert "/camera/speed" in mcaptrack.retrack(path, profile="paper").stale
    result = mcaptrack.run(path, tables=False, events=False)
    assert result.stages == ("speed", "views")
    assert provenance_of(path, "/camera/speed").parameters["max_gap_s"] == 0.5
    shutil.rmtree(site / "my_trackers-1.0.dist-info")
    for choice in ({"retracker": "likelihood"}, {}):  # the run that outdates it, and those after it
        said = [notice.message for notice in mcaptrack.run(path, tables=False, events=False, **choice).warnings]
        assert [line for line in said if "the stage speed made it, which is not installed; install my-trackers" in line]
    with pytest.raises(McaptrackError, match="no stage is called speed"):
        mcaptrack.stage("speed", path)


def test_a_stage_reads_channels_beside_its_input_and_is_outdated_by_them(site, path):  # noqa: F811
    add(site, "stage", "visits", COUNTS)
    done("visits", path)
    with mcaptrack.open(path) as recording:
        assert set(recording.array("/camera/tracks/visits")["visits"].tolist()) == {0}
    mark(path, 3)
    done("visits", path)
    with mcaptrack.open(path) as recording:
        assert set(recording.array("/camera/tracks/visits")["visits"].tolist()) == {3}
    assert [*provenance_of(path, "/camera/tracks/visits").references] == ["/camera/marks"]
    mark(path, 2)
    assert json.loads(done("info", path, "--json").out)
    assert "visits" in mcaptrack.run(path, tables=False).stages


@pytest.mark.parametrize(
    ("schema", "topic"), [("VIDEO", "video"), ("DETECTIONS", "detections"), ("PREDICTIONS", "predictions")]
)
def test_a_stage_reads_any_rows(site, path, schema, topic):  # noqa: F811
    code = COUNTS.replace("reads: ClassVar = TRACKS", f"reads: ClassVar = {schema}").replace('"tracks"', f'"{topic}"')
    add(site, "stage", "visits", code.replace("import DETECTIONS, TRACKS", f"import DETECTIONS, {schema}"))
    done("visits", path)
    with mcaptrack.open(path) as recording:
        assert len(recording.array("/camera/tracks/visits"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("@dataclass(frozen=True, kw_only=True)", ""), "is no dataclass"),
        (("reads: ClassVar = TRACKS", "reads: ClassVar = 'tracks'"), "needs the schemas that it reads and writes"),
        (('writes: ClassVar = {"": COUNT}', "writes: ClassVar = {'a': COUNT}"), "needs the schemas that it reads"),
        (('{"": COUNT}', '{"": COUNT, "view": COUNT}'), "has an output 'view', which is a name of what is made"),
        (('input_topic: ClassVar = "tracks"', "input_topic: ClassVar = 3"), "has input_topic = 3; it is a topic below"),
        (('"tracks/visits"', '"/camera/visits"'), "has output_topic = '/camera/visits'; it is a topic below"),
        (("    marks: ", "    mark: "), "has also_reads = marks without a field of that name"),
        (("    marks: ", "    force: bool = False\n    marks: "), "can't have a parameter force"),
        (('    output_topic: ClassVar = "tracks/visits"\n', ""), "has output_topic = None; it is a topic below"),
        (("    also_reads", "    before = ('shake',)\n    also_reads"), "has before = shake; there are memory, planes"),
        (("def __call__", "def call"), "can't be called with frames"),
        (("COUNT = ", "COUNT = 1 / 0 or "), "ZeroDivisionError: division by zero (another.py"),
        (
            ("        visits = sum", "        1 / 0\n        visits = sum"),
            "ZeroDivisionError: division by zero (another.py",
        ),
    ],
)
def test_a_broken_stage_is_said_in_one_line(site, path, change, said):  # noqa: F811
    assert change[0] in COUNTS
    add(site, "stage", "visits", COUNTS.replace(*change))
    before = path.read_bytes()
    line = one_line("visits", str(path))
    assert said in line
    assert "another 2.0" in line
    assert path.read_bytes() == before
    assert call("info", path).code == 0


def test_a_stage_has_no_name_of_ours(site, path):  # noqa: F811
    add(site, "stage", "track", COUNTS)
    done("track", path, "--to", "/camera/others")
    assert provenance_of(path, "/camera/others").parameters["tracker"] == "sort"
