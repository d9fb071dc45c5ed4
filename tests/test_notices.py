"""Warnings: heard by whoever started the work, never hidden, and in the JSON of every command."""

from __future__ import annotations

import ast
import json
import re
import warnings
from contextvars import copy_context
from pathlib import Path
from threading import Thread
from typing import get_args

import pytest

import mcaptrack
from mcaptrack import log, notices, pipeline
from mcaptrack.cli import common
from mcaptrack.notices import Code, McaptrackWarning, Notice
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.transforms import Sort
from tests.commands import done

PACKAGE = Path(mcaptrack.__file__).parent
NO_PLANE = "no ground plane is known"


@pytest.fixture
def boxes(tmp_path) -> Path:
    """A log of boxes without a ground plane."""
    (tmp_path / "det.txt").write_text("".join(f"{n},-1,{10 + 2 * n},20,10,34,1,-1,-1,-1\n" for n in range(1, 30)))
    path = tmp_path / "boxes.mcap"
    ingest(tmp_path / "det.txt", path, IngestOptions(role="detections", fps=10))
    return path


def test_a_warning_is_shown_even_when_quiet_and_stands_in_the_json(boxes):
    outcome = copy_context().run(done, "track", boxes, "--json", "-q")
    (line,) = outcome.err.splitlines()
    assert line.startswith(f"warning: {boxes}: {NO_PLANE}")
    (said,) = json.loads(outcome.out)["warnings"]
    assert (said["code"], said["log"]) == ("assumed-ground-plane", str(boxes))
    assert line == f"warning: {boxes}: {said['message']}"


def test_the_same_warning_is_shown_once(capsys):
    @common.one_line
    def command() -> None:
        with common.Talk(quiet=True).open():
            notices.warn("twice")
            notices.warn("twice")
            notices.warn("the\nother", "lost")
        common.print_json({})

    command()
    out, err = capsys.readouterr()
    assert err == "warning: twice\nwarning: the other\n"
    assert json.loads(out)["warnings"] == [
        {"message": "twice", "code": "other", "log": None},
        {"message": "the other", "code": "lost", "log": None},
    ]


def test_a_report_has_the_warnings_and_passes_them_on(boxes):
    heard: list[Notice] = []
    with log.read(boxes) as opened, notices.listening(heard.append):
        jobs = pipeline.plan_stage(opened, "/camera", "track", Sort())
        report = pipeline.run(opened, "/camera", jobs)
    assert [notice.code for notice in report.warnings] == ["assumed-ground-plane"]
    assert heard == report.warnings


def test_where_no_one_listens_a_warning_is_pythons():
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        with notices.about("a.mcap"):
            notices.warn("odd")
        with notices.collected() as kept:
            notices.warn("odder", "lost")
    assert [(str(w.message), w.category) for w in found] == [
        ("a.mcap: odd", McaptrackWarning),
        ("odder", McaptrackWarning),
    ]
    assert kept == [Notice("odder", "lost")]


def test_threads_hear_their_own_warnings_alone():
    heard: dict[str, list[Notice]] = {"one": [], "two": []}

    def work(name: str) -> None:
        with notices.listening(heard[name].append):
            notices.warn(name)

    threads = [Thread(target=work, args=(name,)) for name in heard]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert heard == {name: [Notice(name)] for name in heard}


def test_the_document_lists_every_code():
    page = (PACKAGE.parent / "docs" / "warnings.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `([a-z-]+)` \|", page, re.MULTILINE)
    assert sorted(listed) == sorted(get_args(Code))


def test_json_is_printed_in_one_place():
    """So that the warnings of every command stand in it, those of commands to come too."""
    printing = {
        path.name
        for path in (PACKAGE / "cli").glob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("json.dumps", "json.dump", "dumps")
    }
    assert printing <= {"common.py", "text.py"}  # text.py prints lines with their own warnings
