"""Finishers and sections of the report of installed packages: those of docs/extend.md, and what they may not do."""

from __future__ import annotations

import copy
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.api.finishing import PartsOfRun
from mcaptrack.api.running import OF_JSON
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.registry import others
from mcaptrack.schema import TRACKS
from tests.commands import done
from tests.logs import provenance_of
from tests.test_extensions import add, site  # noqa: F401  # a fixture
from tests.tiers import thorough

TOPIC = "/camera/tracks/crowded"
#: What a package has: a finisher that makes a channel of no rows, or another one.
CODE = """
from mcaptrack.pipeline.write import Made
from mcaptrack.schema import TRACKS
from mcaptrack.schema.provenance import Provenance
class Step:
    def make(self, state, planes, stamps):
        how = Provenance("odd", {}, "/camera/tracks", state.digest("/camera/tracks"))
        return {"/camera/tracks/odd": Made.of(TRACKS, [], how)}
def Part(odd: int = 0):
    return Step()
"""


@pytest.fixture
def path(finished, tmp_path) -> Path:
    return Path(shutil.copy(finished, tmp_path / "log.mcap"))


@pytest.fixture
def run(monkeypatch) -> Any:
    """``run`` with the finishers that are installed now; those of ``mcaptrack.run`` are of the time of its import."""

    def run(path: Path, **options: Any) -> mcaptrack.RunResult:
        finishers = PartsOfRun()
        finishers.options(())
        monkeypatch.setattr("mcaptrack.api.run._PARTS", finishers)
        return inspect.unwrap(mcaptrack.run)(path, tables=False, **options)

    return run


def crowded(path: Path, least: int) -> int:
    with log.read(path) as opened:
        return sum(len(frame.rows) >= least for frame in opened.frames("/camera/tracks", TRACKS))


def test_the_command_line_and_python_have_the_options_of_a_finisher(site, path):  # noqa: F811
    def said(*words: str) -> str:
        environment = {**os.environ, "PYTHONPATH": str(site), "COLUMNS": "100"}
        command = [sys.executable, *words]
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert not ended.returncode, ended.stderr
        return ended.stdout

    count = crowded(path, 2)
    assert 0 < count < crowded(path, 1)
    code = f"""
import json, mcaptrack
from tests.commands import done
print("--crowded N" in done("run", "--help-all").out)
print(json.dumps(json.loads(done("run", {str(path)!r}, "--no-tables", "--crowded", "2", "--json").out)))
result = mcaptrack.run({str(path)!r}, crowded=1, tables=False)
print(result.stages, result.crowded)
"""
    listed, made, again = said("-c", code).splitlines()
    assert listed == "True"
    assert json.loads(made)["results"][0]["crowded"] == {TOPIC: count}
    assert again == str(("crowded",)) + f" {{{TOPIC!r}: {crowded(path, 1)}}}"


@thorough
def test_later_runs_do_it_again_and_one_line_says_where_nothing_can(site, path, run):  # noqa: F811
    assert run(path).finished.keys() <= {"zones"}
    assert run(path, crowded=2).stages == ("crowded",)
    assert run(path).is_up_to_date
    mcaptrack.track(path, tracker="ocsort")
    assert TOPIC in run(path).channels
    assert provenance_of(path, TOPIC).parameters == {"least": 2}
    assert (site / "my_trackers-1.0.dist-info").is_dir()
    shutil.rmtree(site / "my_trackers-1.0.dist-info")
    assert run(path).is_up_to_date
    mcaptrack.track(path, tracker="bytetrack")
    for _ in range(2):  # the run that brings the rest up to date, and those after it
        late = [notice.message for notice in run(path).warnings if notice.code == "out-of-date"]
        why = "because the input was replaced: no installed package has the finisher crowded"
        assert late == [f"{TOPIC} is out of date, {why}"]
    with mcaptrack.open(path) as recording:
        assert recording.array(TOPIC)["people"].min() == 2


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (("class Step", "1 / 0\nclass Step"), "finisher odd (another 2.0) can't be imported: ZeroDivisionError"),
        (("odd: int = 0", "odd"), "finisher odd (another 2.0) can't have the option odd: it has no default"),
        (("odd: int = 0", "topic: int = 0"), "finisher odd (another 2.0) can't have the option topic: run has one"),
        (("odd: int = 0", "odd: 'nothing' = 0"), "finisher odd (another 2.0) has annotations that can't be read"),
        (
            ("odd: int = 0", "odd: dict[str, complex] = None"),
            "finisher odd (another 2.0) can't have the option odd: TypeError: an option can't have the type",
        ),
        (
            ("    return Step()\n", "    return Step()\nPart.most_used = 7\n"),
            "finisher odd (another 2.0) has annotations",
        ),
    ],
)
def test_a_finisher_that_cannot_have_its_options_is_left_out_and_each_run_says_so(site, change, why):  # noqa: F811
    assert change[0] in CODE
    add(site, "finisher", "odd", CODE.replace(*change))
    finishers = PartsOfRun()
    assert not {"odd", "topic"} & finishers.options({"topic"}).keys()
    with collected() as warnings:
        assert "odd" not in {step.name for step in finishers.finishers({}, False)}
    (notice,) = warnings
    assert notice.message.startswith(why)
    assert notice.message.endswith("; it is left out")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (("return Step()", "raise OSError('no licence')"), "failed: OSError: no licence (another.py"),
        (("return Step()", "return 3"), "failed: AttributeError"),
        (
            ("        how = ", "        1 / 0\n        how = "),
            "failed: ZeroDivisionError: division by zero (another.py",
        ),
        (("how)}", "how), 'x': 3}"), "failed: AttributeError"),
        (('{"/camera/tracks/odd"', '{"/camera/odd"'), "makes /camera/odd, which is not below its input"),
        (('Provenance("odd"', 'Provenance("track"'), "makes /camera/tracks/odd, which is not below its input"),
        (
            ('{"/camera/tracks/odd"', '{"/camera/tracks/events"'),
            "would replace /camera/tracks/events, which was made by",
        ),
    ],
)
def test_what_a_finisher_may_not_do_is_said_in_one_line_and_changes_nothing(site, path, run, change, why):  # noqa: F811
    assert change[0] in CODE
    add(site, "finisher", "odd", CODE.replace(*change))
    before = path.read_bytes()
    with pytest.raises(McaptrackError) as refusal:
        run(path)
    assert "finisher odd (another 2.0)" in str(refusal.value)
    assert why in str(refusal.value)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("report", "why"),
    [
        ("'text'", "gave a str; report has to give a Finished"),
        ("Finished({}, object(), '')", "gave what is no Finished: TypeError"),
        ("Finished(3, {}, '')", "gave what is no Finished: TypeError"),
    ],
)
def test_the_report_of_a_finisher_that_is_none_is_one_line(site, path, run, report, why):  # noqa: F811
    code = CODE.replace("def Part", f"    def report(self, *_):\n        return {report}\ndef Part")
    add(site, "finisher", "odd", f"from mcaptrack.contracts import Finished\n{code}")
    with pytest.raises(McaptrackError, match=re.escape(f"finisher odd (another 2.0) {why}")):
        run(path)


def test_a_finisher_cannot_have_the_name_of_a_command_of_the_core(site):  # noqa: F811
    add(site, "finisher", "track", CODE)
    plugins = json.loads(done("doctor", "--json").out)["plugins"]
    assert "there is a command track; rename it" in plugins["finisher track (another 2.0)"]


@pytest.mark.parametrize("name", ["frames", "next"])
def test_a_finisher_with_a_name_of_the_result_is_left_out_and_one_that_comes_late_is_named(site, name):  # noqa: F811
    parts = PartsOfRun()
    add(site, "finisher", name, CODE)
    for finishers, why in (
        (parts, f"finisher {name} was installed after run was imported; it is left out"),
        (
            PartsOfRun(),
            f"finisher {name} (another 2.0) can't have its name: the result of run has {name}; it is left out",
        ),
    ):
        finishers.options(())
        with collected() as warnings:
            assert name not in {step.name for step in finishers.finishers({}, False)}
        assert [notice.message for notice in warnings] == [why]


def test_no_key_of_the_json_of_a_run_can_be_the_name_of_a_finisher(finished):
    (said,) = json.loads(done("run", finished, "--no-tables", "--json").out)["results"]
    assert {"next", "log", "summary"} <= said.keys()
    assert said.keys() <= {*mcaptrack.RunResult.__dataclass_fields__, *OF_JSON, *others("finisher")}


def test_nothing_is_asked_of_packages_for_names_that_python_looks_up(finished, monkeypatch):
    result = mcaptrack.run(finished, tables=False)
    monkeypatch.setattr("mcaptrack.api.running.others", None)
    assert copy.copy(result) == result


def test_an_option_of_nothing_is_refused():
    with pytest.raises(TypeError, match="has no parameter crowdedd; "):
        mcaptrack.run("log.mcap", crowdedd=2)
    with pytest.raises(AttributeError, match="has no attribute 'crowdedd'"):
        _ = mcaptrack.RunResult.__getattr__(mcaptrack.RunResult.__new__(mcaptrack.RunResult), "crowdedd")
