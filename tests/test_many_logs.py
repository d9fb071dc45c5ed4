"""Commands that take many logs: what they print, their exit codes, and one log as it ever was."""

from __future__ import annotations

import io
import json
import os
import shutil
import sys
import time
from datetime import datetime
from pathlib import Path

import pytest

from mcaptrack.cli import common
from mcaptrack.pipeline import LAYOUTS, layout_path
from tests.commands import GROUP, call, done
from tests.extension_cases import of_extensions
from tests.logs import READING
from tests.tiers import one_in, thorough

pytestmark = pytest.mark.usefixtures("never_waits")


@pytest.fixture
def folder(template, tmp_path, monkeypatch) -> Path:
    (tmp_path / "logs" / "deep").mkdir(parents=True)
    for name in ("logs/a.mcap", "logs/deep/b.mcap"):
        shutil.copy(template, tmp_path / name)
        for kind in LAYOUTS:
            shutil.copy(layout_path(template, kind), layout_path(tmp_path / name, kind))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@thorough
def test_results_for_stdout_come_in_the_order_of_the_logs_and_list_on_stdin(folder, monkeypatch):
    names = ["logs/deep/b.mcap", "logs/a.mcap"]
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO("\n".join(names).encode())))
    out = done("info", "-", "--jobs", "2").out
    assert [line.split()[0] for line in out.splitlines() if " bytes, " in line] == names
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"")))
    assert call("info", "-") == (0, "", "the list of logs is empty; there is nothing to do\n")


def test_outputs_go_to_a_folder_under_the_names_of_the_logs(folder):
    done("drop", "logs", "/camera/video", "-o", "small", "--jobs", "1")
    assert sorted(map(str, Path("small").rglob("*.mcap"))) == ["small/a.mcap", "small/deep/b.mcap"]
    assert Path("small/deep/b.mcap").stat().st_size < Path("logs/deep/b.mcap").stat().st_size
    done("export", "logs", "-o", "tables", "--jobs", "1")
    assert sorted(path.name for path in Path("tables/tracks").iterdir()) == ["recording=a", "recording=b"]
    Path("made").mkdir()
    done("drop", "logs/a.mcap", "/camera/video", "-o", "made")
    assert Path("made/a.mcap").read_bytes() == Path("small/a.mcap").read_bytes()
    assert call("drop", "logs", "/camera/video", "-o", "one.mcap").err.endswith(
        "name a folder for their results, or leave it out\n"
    )


def test_commands_that_combine_logs_take_folders_and_lists(folder, monkeypatch):
    data = json.loads(done("evaluate", "logs", "--json").out)
    assert {one["sequence"] for one in data["results"]} == {"a", "b", "COMBINED"}
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"logs/a.mcap\n")))
    assert {one["sequence"] for one in json.loads(done("evaluate", "-", "--json").out)["results"]} == {"a"}


def test_lines_of_json_say_when_what_ended_and_how(folder, monkeypatch):
    (folder / "logs" / "noise.mcap").write_bytes(b"noise")
    monkeypatch.setattr(common, "PROGRESS_S", 0.0)
    began = time.time() - 0.001  # times have milliseconds
    code, out, err = call("export", "logs", "--jobs", "1", "--log-format", "json", "--json")
    said, results = [json.loads(line) for line in err.splitlines()], json.loads(out)["results"]
    assert code == 3
    assert all({"time", "level", "event", "command", "message"} <= line.keys() for line in said)
    times = [datetime.fromisoformat(line["time"]) for line in said]
    assert times == sorted(times)
    assert began <= times[0].timestamp() <= times[-1].timestamp() <= time.time()
    ended = {line["log"]: (line["level"], line["state"]) for line in said if line["event"] == "log"}
    good = {f"logs/{name}.mcap": ("info", "done") for name in ("a", "deep/b")}
    assert ended == good | {"logs/noise.mcap": ("error", "failed")}
    rows = {one["log"]: one["rows"]["tracks"] for one in results}
    assert rows.keys() == good.keys()
    assert rows["logs/a.mcap"] == rows["logs/deep/b.mcap"] > 0
    (total,) = [line for line in said if line["event"] == "summary"]
    assert (total["logs"], total["done"], total["failed"]) == (3, 2, 1)
    moving = [line for line in said if line["event"] == "progress"]
    assert all(line["total"] == 3 for line in moving)
    assert {one["log"] for line in moving for one in line["running"]} <= set(ended)
    assert (said[-1]["level"], said[-1]["failed"]) == ("error", 1)


def test_lines_of_json_of_one_log_and_of_a_fault_of_the_program(folder, monkeypatch):
    monkeypatch.setattr(common, "PROGRESS_S", 0.0)
    ran = done("track", "logs/a.mcap", "--force", "--log-format", "json")
    said = [json.loads(line) for line in ran.err.splitlines()]
    assert ("progress", "track") in {(line["event"], line.get("stage")) for line in said}
    (ended,) = [line for line in said if line["event"] == "log"]
    assert (ended["log"], ended["state"]) == ("logs/a.mcap", "done")
    code, _, err = call("check", "logs", "--jobs", "many", "--log-format=json")
    assert (code, json.loads(err)["level"]) == (2, "error")
    monkeypatch.setattr("mcaptrack.info", lambda *_, **__: 1 / 0)
    code, _, err = call("info", "logs/a.mcap", "--log-format", "json")
    fault = json.loads(err)
    assert (code, fault["level"]) == (1, "error")
    assert "ZeroDivisionError: division by zero" in fault["message"]
    assert "Traceback" in fault["traceback"]
    assert call("check", "none.mcap").err.startswith("mcaptrack: none.mcap")


@thorough
def test_many_inputs_are_ingested_by_workers_and_once(folder, monkeypatch):
    Path("labels").mkdir()
    for name in ("x", "y"):
        Path(f"labels/{name}.txt").write_text("1,1,5,5,9,9\n2,1,6,5,9,9\n")
    words = ("--as", "truth", "--fps", "10", "--jobs", "1", "--ledger", "ingest.jsonl", "-o", "made")
    first = json.loads(done("ingest", "labels/*.txt", *words, "--json").out)
    assert [one["log"] for one in first["results"]] == ["made/x.mcap", "made/y.mcap"]
    assert first["fleet"]["done"] == 2
    Path("labels/y.txt").write_text("1,1,5,5,9,9\n")
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"labels/x.txt\nlabels/y.txt\n")))
    code, out, err = call("ingest", "-", *words, "--json")
    totals = json.loads(out)["fleet"]
    assert (code, totals["skipped"], totals["failed"]) == (3, 1, 1)
    assert "made/y.mcap exists" in err
    assert (folder / "made" / "x.mcap").exists()
    code, _, err = call("ingest", "labels/x.txt", "labels/y.txt", "-o", "z.mcap")
    assert (code, "can't all be written to z.mcap" in err) == (1, True)


# Several inputs of one command: an input that fails is reported and listed, and the others are processed.


SEVERAL = {
    name
    for name, command in GROUP.commands.items()
    if any(one.nargs == -1 for one in command.params) and "output" in command.settings and name != "drop"
}
#: Commands that make one thing of all their inputs: without one of them it would be another thing, so they refuse.
COMBINING = {name for name in SEVERAL if "jobs" not in GROUP.commands[name].settings}


@pytest.fixture
def mixed(template, tmp_path, monkeypatch) -> Path:
    for name in ("a.mcap", "z.mcap"):
        shutil.copy(template, tmp_path / name)
    (tmp_path / "broken.mcap").write_bytes(b"no log at all")
    for name, text in of_extensions("FILES").items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def inputs(command: str, *names: str) -> list[str]:
    """Return the arguments of a command that processes these inputs; ingest must not overwrite its own input."""
    if command == "ingest":
        Path("in").mkdir(exist_ok=True)
        for name in names:
            if Path(name).exists():
                os.replace(name, f"in/{name}")
        return [f"in/{name}" for name in names]
    return list(names)


@pytest.mark.parametrize("command", one_in(12, sorted(SEVERAL & READING.keys() - COMBINING)))
def test_a_broken_input_does_not_stop_the_others(command, mixed):
    bad = ["missing.mcap"] if command == "check" else ["broken.mcap", "missing.mcap"]  # check tells what is broken
    *bad, good = inputs(command, *bad, "a.mcap")
    outcome = call(command, *bad, good, *of_extensions("NEEDS").get(command, ()), "--json")
    assert outcome.code == 3, outcome.err
    data = json.loads(outcome.out)
    assert [Path(one["log"]).name for one in data["results"]] == ["a.mcap"]
    assert [one["input"] for one in data["failed"]] == bad
    lines = outcome.err.splitlines()
    for one in data["failed"]:
        assert one["input"] in one["error"]
        assert f"mcaptrack: {one['error']}" in lines
    assert lines[-1] == f"mcaptrack: {len(bad)} of {len(bad) + 1} failed: {', '.join(bad)}"


def test_a_missing_input_is_one_line(mixed):
    for command in sorted(SEVERAL - COMBINING):
        outcome = call(command, "missing.mcap", "--json")
        assert (outcome.code, outcome.out, outcome.err.count("\n")) == (1, "", 1), command
        assert outcome.err.startswith("mcaptrack: ")


def test_a_command_that_combines_inputs_needs_all_of_them(mixed):
    before = sorted(mixed.rglob("*"))
    for command in sorted(COMBINING & READING.keys()):
        name = {"cut": "out.mcap", "query": "out.csv", "tune": "out.toml"}.get(command, "out.html")
        outcome = call(command, "a.mcap", "broken.mcap", *of_extensions("NEEDS").get(command, ()), "-o", name)
        assert (outcome.code, outcome.out) == (1, "")
        assert "broken.mcap" in outcome.err
        assert sorted(mixed.rglob("*")) == before
