"""Several inputs of one command: an input that fails is reported and listed, and the others are processed."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

from tests.commands import GROUP, call
from tests.extension_cases import of_extensions
from tests.logs import READING
from tests.tiers import one_in

SEVERAL = {
    name
    for name, command in GROUP.commands.items()
    if any(one.nargs == -1 for one in command.params) and "output" in command.settings and name != "drop"
}
#: Commands that make one thing of all their inputs: without one of them it would be another thing, so they refuse.
COMBINING = {name for name in SEVERAL if "jobs" not in GROUP.commands[name].settings}


@pytest.fixture
def folder(template, tmp_path, monkeypatch) -> Path:
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
def test_a_broken_input_does_not_stop_the_others(command, folder):
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


def test_a_missing_input_is_one_line(folder):
    for command in sorted(SEVERAL - COMBINING):
        outcome = call(command, "missing.mcap", "--json")
        assert (outcome.code, outcome.out, outcome.err.count("\n")) == (1, "", 1), command
        assert outcome.err.startswith("mcaptrack: ")


def test_a_command_that_combines_inputs_needs_all_of_them(folder):
    before = sorted(folder.rglob("*"))
    for command in sorted(COMBINING & READING.keys()):
        name = {"cut": "out.mcap", "query": "out.csv", "tune": "out.toml"}.get(command, "out.html")
        outcome = call(command, "a.mcap", "broken.mcap", *of_extensions("NEEDS").get(command, ()), "-o", name)
        assert (outcome.code, outcome.out) == (1, "")
        assert "broken.mcap" in outcome.err
        assert sorted(folder.rglob("*")) == before
