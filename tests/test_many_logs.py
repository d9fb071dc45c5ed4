"""Commands that take many logs: what they print, their exit codes, and one log as it ever was."""

from __future__ import annotations

import io
import json
import os
import shutil
import sys
from pathlib import Path

import pytest

from mcaptrack.fleet import FleetStatus, Running
from tests.commands import call, done

pytestmark = pytest.mark.usefixtures("never_waits")


@pytest.fixture
def folder(template, tmp_path, monkeypatch) -> Path:
    """A working folder with a folder of two logs that are up to date."""
    (tmp_path / "logs" / "deep").mkdir(parents=True)
    for name in ("logs/a.mcap", "logs/deep/b.mcap"):
        shutil.copy(template, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_run_processes_a_folder_and_skips_it_the_second_time(folder):
    (folder / "logs" / "cut.mcap").write_bytes((folder / "logs" / "a.mcap").read_bytes()[:3000])
    (folder / "logs" / "noise.mcap").write_bytes(os.urandom(1000))
    words = ("run", "logs/", "--jobs", "2", "--ledger", "night.jsonl", "--no-tables", "--json")
    code, out, err = call(*words)
    data, lines = json.loads(out), err.splitlines()
    assert code == 3
    assert [one["log"] for one in data["results"]] == ["logs/a.mcap", "logs/deep/b.mcap"]
    assert {one["input"]: one["state"] for one in data["failed"]} == dict.fromkeys(
        ("logs/cut.mcap", "logs/noise.mcap"), "failed"
    )
    totals = {"logs": 4, "up-to-date": 2, "done": 0, "skipped": 0, "failed": 2, "not-tried": 0}
    assert data["fleet"].items() >= totals.items()
    assert data["fleet"]["peak_bytes"] > 1e7
    assert [line for line in lines if line.startswith("logs/a.mcap: ")] == [
        "logs/a.mcap: nothing to do, everything is up to date; 1 track"
    ]
    assert lines[-1] == "mcaptrack: 2 of 4 failed: " + ", ".join(one["input"] for one in data["failed"])
    assert "2 up-to-date" in lines[-2]
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in Path("logs").rglob("*") if path.is_file()}
    again = json.loads(call(*words).out)
    assert (again["results"], again["fleet"]["skipped"], again["fleet"]["failed"]) == ([], 2, 2)
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in before} == before


def test_results_for_stdout_come_in_the_order_of_the_logs_and_list_on_stdin(folder, monkeypatch):
    names = ["logs/deep/b.mcap", "logs/a.mcap"]
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO("\n".join(names).encode())))
    out = done("info", "-", "--jobs", "2").out
    assert [line.split()[0] for line in out.splitlines() if " bytes, " in line] == names
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"")))
    assert call("info", "-") == (0, "", "the list of logs is empty; there is nothing to do\n")


def test_outputs_go_to_a_folder_under_the_names_of_the_logs(folder):
    done("sample", "logs", "--output-dir", "out", "--rate-hz", "2.5", "--jobs", "2")
    assert sorted(map(str, Path("out").rglob("*.mcap"))) == ["out/a.mcap", "out/deep/b.mcap"]
    done("drop", "out", "/camera/video", "--output-dir", "small")
    assert Path("small/deep/b.mcap").stat().st_size < Path("out/deep/b.mcap").stat().st_size
    done("export", "logs", "--output-dir", "tables")
    assert sorted(path.name for path in Path("tables/tracks").iterdir()) == ["recording=a", "recording=b"]
    code, _, err = call("run", "logs", "--output-dir", "x", "-o", "y.mcap")
    assert (code, err) == (1, "mcaptrack: --output and --output-dir are two places for the same results; give one\n")


def test_one_log_is_processed_as_ever_unless_an_option_for_many_is_given(folder):
    plain = done("info", "logs/a.mcap", "--json").out
    assert "fleet" not in json.loads(plain)
    fleet = json.loads(done("info", "logs/a.mcap", "--json", "--timeout", "1h").out)
    assert fleet.pop("fleet")["done"] == 1
    assert fleet == json.loads(plain)


def test_commands_that_combine_logs_take_folders_and_lists(folder, monkeypatch):
    done("report", "logs", "-o", "page.html")
    data = json.loads(done("evaluate", "logs", "--json").out)
    assert {one["sequence"] for one in data["results"]} == {"a", "b", "COMBINED"}
    rows = done("query", "logs", "select count(distinct recording) as n from tracks", "--format", "csv").out
    assert rows.split()[-1] == "2"
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"logs/a.mcap\n")))
    assert {one["sequence"] for one in json.loads(done("evaluate", "-", "--json").out)["results"]} == {"a"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--timeout", "soon"], "--timeout needs a time such as 90s, 10m or 2h, not 'soon'"),
        (["--memory-limit", "1"], "--memory-limit needs a size such as 2GB or 500MB, not '1': that is too little"),
        (
            ["--ledger", "logs/a.mcap"],
            "logs/a.mcap is not a ledger: it does not begin with a line of JSON; give another name",
        ),
    ],
)
def test_what_is_wrong_is_one_line(folder, words, said):
    assert call("check", "logs", *words) == (1, "", f"mcaptrack: {said}\n")


def test_the_table_on_a_terminal_names_the_logs_that_run(folder):
    from rich.console import Console

    from mcaptrack.cli.live import table_of

    running = (Running(Path("logs/\x1b[31mx.mcap"), "detect", 3, 4, 12.3, 250_000_000), Running(Path("y.mcap")))
    console = Console(file=io.StringIO(), width=80)
    console.print(table_of(FleetStatus(9, {"done": 3, "killed": 1}, running, 61.0)))
    shown = console.file.getvalue()
    assert "4 of 9 logs in 61 s: 3 done, 1 killed" in shown
    assert [part for part in ("detect", "75%", "12", "250") if part not in shown] == []
    assert "\x1b" not in shown
