"""What is printed about many logs and several cameras, line by line, and as JSON."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mcaptrack.api.several import CameraResult
from mcaptrack.cli import common, many, running, text
from mcaptrack.cli.many import LogWork, ManyOptions, _Printer, _seconds, _summarise
from mcaptrack.errors import McaptrackError
from mcaptrack.fleet import FleetResult, FleetStatus, LogOutcome, Running
from mcaptrack.fleet.expansion import NamedLog
from mcaptrack.notices import Notice
from mcaptrack.pipeline.summary import Corrected, Looks, Repair, Summary, SummaryScores
from tests.commands import run_result as result

A, B, C = Path("a.mcap"), Path("b.mcap"), Path("c.mcap")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def command() -> Iterator[common._Batch]:
    """What a command sets for what it calls."""
    batch = common._Batch()
    tokens = [(one, one.set(value)) for one, value in (
        (common._BATCH, batch), (common._WARNED, []), (many._OPTIONS, ManyOptions()),
    )]  # fmt: skip
    yield batch
    for one, token in tokens:
        one.reset(token)


def talk(quiet: bool = False, verbose: bool = False) -> common.Talk:
    return common.Talk(quiet, verbose)


def lines_of_json(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


# Several cameras


def camera(is_scene: bool = False, **counts: Any) -> CameraResult:
    return CameraResult(("track",), {"/x/tracks": 3}, {"/x/tracks": 4}, {"/x/tracks": 2}, Summary(**counts), is_scene)


LEFT = camera(pictures=1000, boxes=2000, tracks=1, ground_plane="given", appearance=Looks(True, 0.9, 8))
RIGHT = camera(
    tracks=1200, repair=Repair(1100, 0, 0, 0), scores=SummaryScores((0.5, 0.755), (3, 2), "by boxes"), camera_motion="x",
    appearance=Looks(False, 0.55, 12),
)  # fmt: skip
SCENE = camera(True, tracks=9)
BOTH = {"left": LEFT, "right": RIGHT, "scene": SCENE}


def test_each_camera_has_a_line_and_the_scene_its_summary():
    whole = result(cameras=BOTH, left_out={"up": "has no tracks; give `topic=`"}, summary=Summary(tracks=9))
    assert list(running._lines_of_run(whole)) == [
        ("left", "1,000 pictures, 2,000 boxes, 1 track, colours compared, ground plane given"),
        ("right", "1,200 tracks, 1,100 after re-tracking, colours not compared, IDF1 75.5%"),
        ("up", "left out: it has no tracks; give --topic"),
        ("fused", "scene, the scene"),
        ("tracks", "9"),
    ]
    apart = result(cameras={"left": LEFT, "none": camera()}, not_fused="there is no common ground; `min_iou=0.5`")
    assert list(running._lines_of_run(apart))[1:] == [
        ("none", ""), ("fused", "no: there is no common ground; --min-iou 0.5"),
    ]  # fmt: skip


def test_corrections_of_people_are_counted():
    lines = running._lines_of_run(result(summary=Summary(corrected=Corrected(1200, 3, 40))))
    assert list(lines) == [("corrected", "1,200 boxes of 3 tracks by people, in 40 pictures")]


def test_the_result_of_several_cameras_as_json():
    data = running._as_json(result(cameras={"left": LEFT, "scene": SCENE}, summary=SCENE.summary, tables={"tracks": 4}))
    assert (data["tables"], data["summary"], "rows" in data) == ({"tracks": 4}, SCENE.summary.to_json(), False)
    assert data["cameras"]["scene"] == {
        "is_scene": True, "stages": ["track"], "frames": {"/x/tracks": 3}, "rows": {"/x/tracks": 4},
        "tracks": {"/x/tracks": 2}, "summary": SCENE.summary.to_json(),
    }  # fmt: skip
    assert (data["left_out"], data["not_fused"], data["next"]) == ({}, None, ["mcaptrack view 'a b.mcap'"])
    data = running._as_json(result(cameras={"left": LEFT}, left_out={"up": "why"}, not_fused="no `plane=`"))
    assert (data["summary"], data["left_out"], data["not_fused"]) == (None, {"up": "why"}, "no --plane")
    one = running._as_json(result(summary=Summary(tracks=1), tables={"a": 1}, seconds_by_part={"read": 0.5}))
    assert (one["tables"], one["summary"]["tracks"], one["seconds_by_part"]) == ({"a": 1}, 1, {"read": 0.5})
    assert not {"cameras", "rows", "left_out", "not_fused", "zones", "continued"} & one.keys()
    stage = running._as_json(result(rows={"/a": 3}, tracks={"/a": 2}, zones={"/a": []}, left_out={"up": "why"}))
    assert (stage["rows"], stage["tracks"], stage["zones"], stage["left_out"]) == (
        {"/a": 3},
        {"/a": 2},
        {"/a": []},
        {"up": "why"},
    )
    assert not {"cameras", "summary", "tables"} & stage.keys()


def test_the_next_command_of_several_cameras():
    assert running._next(result(cameras={"left": LEFT})) == ["mcaptrack view 'a b.mcap'"]
    assert running._next(result(cameras={"left": LEFT}, log="s3://x/a.mcap")) == ["mcaptrack info s3://x/a.mcap"]
    assert running._next(result(log="s3://x/a.mcap", summary=Summary(tracks=1))) == ["mcaptrack report s3://x/a.mcap"]
    fused = result(stages=("fuse",), frames={"/yard/detections": 4, "/other/x": 2})
    assert running._next(fused) == ["mcaptrack run 'a b.mcap' --camera yard"]


def test_the_slow_parts_of_a_run_are_named_the_slowest_first():
    parts = {"read": 0.5, "track": 7.25, "write": 0.49, "detect": 2.5}
    assert running._slow_parts(result(seconds=10.0, seconds_by_part=parts)) == "track 7.2 s, detect 2.5 s, read 0.5 s"
    assert running._slow_parts(result(seconds=1.0, seconds_by_part={"a": 0.05})) == "a 0.1 s"
    assert running._slow_parts(result(seconds=0.99, seconds_by_part={"a": 0.9})) == ""


def test_a_log_of_many_has_one_line():
    said = (Notice("x", "lost"), Notice("y", "lost"), Notice("z", "other"))
    events = {"/a": {"birth": 2, "end": 0}, "/b": {"switch": 1}}
    whole = result(
        stages=("track", "track", "sample"), cameras=BOTH, summary=Summary(tracks=1200), warnings=said, events=events
    )
    line = "track, sample in 1.3 s; 2 cameras; 1,200 tracks; warnings: lost, other"
    assert running._line_of(whole, False) == line
    assert running._line_of(whole, True) == line.replace("cameras;", "cameras; birth 2, switch 1;")
    quiet = result(summary=Summary(tracks=1), events={"/a": {"birth": 0}})
    assert running._line_of(quiet, True) == "nothing to do, everything is up to date; nothing happened; 1 track"
    assert running._line_of(result(), False) == "nothing to do, everything is up to date"


# Many logs


def test_what_becomes_of_logs_is_printed_when_it_is_known_and_results_in_their_order(capsys, command):
    shown = []
    work = LogWork("check", None, {}, show=lambda *one: shown.append(one), data=str)
    printer = _Printer(work, talk(), [A, B, C])
    printer.hear(LogOutcome(B, "done", "two", printed="hello\nworld"))
    assert (shown, printer.ended) == ([], 1)
    printer.hear(LogOutcome(A, "skipped"))
    assert shown == [(B, "two")]
    printer.hear(LogOutcome(C, "failed", error="it is cut off", detail="a trace"))
    assert (shown, printer.ended) == ([(B, "two")], 3)
    assert capsys.readouterr().err.splitlines() == [
        "b.mcap: hello",
        "b.mcap: world",
        "mcaptrack: c.mcap: it is cut off",
    ]
    assert [tuple(one) for one in command.failed] == [("c.mcap", "c.mcap: it is cut off", "failed")]


def test_details_of_logs_are_printed_with_verbose(capsys):
    shown = []
    work = LogWork("run", None, {}, show=lambda *one: shown.append(one), data=str, line=lambda one: f"made {one}")
    brief, verbose = _Printer(work, talk(), [A, B, C]), _Printer(work, talk(verbose=True), [A, B, C])
    for printer in (brief, verbose):
        printer.hear(LogOutcome(A, "done", 7))
        printer.hear(LogOutcome(B, "skipped"))
        printer.hear(LogOutcome(C, "killed", error="c.mcap: its worker died", detail="last\nwords"))
    assert shown == [(A, 7)]
    assert capsys.readouterr().err.splitlines() == [
        "a.mcap: made 7", "mcaptrack: c.mcap: its worker died",
        "b.mcap: done before, as the ledger says", "last", "words", "mcaptrack: c.mcap: its worker died",
    ]  # fmt: skip


def test_how_far_logs_are_is_said_now_and_then(capsys, monkeypatch):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(many, "monotonic", lambda: clock.now)
    monkeypatch.setattr(common, "PROGRESS_S", 5.0)
    tables = []
    table = SimpleNamespace(show=tables.append)
    status = FleetStatus(9, {"done": 3, "killed": 1}, (Running(A, "detect", 3, 4, 12.34, 25),), 61.0)
    with text.log_format("json", "run"):
        printer = _Printer(LogWork("run", None, {}, show=print, data=str), talk(), [A])
        for now in (104.9, 105.0, 109.9, 110.0):
            clock.now = now
            printer.watch(status, table)
    assert tables == [status] * 4
    said = lines_of_json(capsys.readouterr().err)
    assert len(said) == 2
    assert {key: said[0][key] for key in said[0] if key not in ("time", "level")} == {
        "event": "progress", "command": "run", "message": "4 of 9 logs", "done": 4, "total": 9,
        "states": {"done": 3, "killed": 1},
        "running": [{"log": "a.mcap", "stage": "detect", "done": 3, "total": 4, "seconds": 12.3, "resident_bytes": 25}],
    }  # fmt: skip


def test_the_totals_of_many_logs(capsys):
    ran = LogOutcome(A, "done", 1, tries=1, seconds=2.0, cpu_seconds=1.5, peak_bytes=250_000_000)
    lost = LogOutcome(B, "failed", error="it is cut off", tries=2, cpu_seconds=0.5, peak_bytes=1)
    _summarise(FleetResult((ran, lost, LogOutcome(C, "skipped")), 4.0), talk())
    assert capsys.readouterr().err.splitlines() == [
        "3 logs in 4.0 s (0.8 a second): 1 done, 1 failed, 1 skipped; at most 250 MB of memory, 1.00 s of processor "
        "time a log"
    ]
    _summarise(FleetResult((LogOutcome(A, "skipped"),), 0.0), talk())
    assert capsys.readouterr().err == "1 logs in 0.0 s (1000.0 a second): 1 skipped\n"
    left = tuple(LogOutcome(Path(f"{n}.mcap"), "not-tried") for n in range(17))
    _summarise(FleetResult((ran, lost, *left), 4.0), talk())
    assert len(capsys.readouterr().err.splitlines()) == 1
    _summarise(FleetResult((ran, lost, *left, LogOutcome(C, "not-tried")), 4.0, "the disk is full"), talk())
    first, second, last = capsys.readouterr().err.splitlines()
    assert first.startswith("20 logs in 4.0 s (5.0 a second): 1 done, 1 failed, 18 not-tried; at most 250 MB")
    assert second == "  failed: it is cut off"
    assert last == "mcaptrack: the disk is full; 18 of 20 logs are left, and the same command goes on"


@pytest.mark.parametrize(
    ("words", "seconds"),
    [("90s", 90), ("90", 90), (" 1.5M ", 90), ("2h", 7200), ("10 m", 600), ("0.5", 0.5), (None, None)],
)
def test_times(words, seconds):
    assert _seconds(words) == seconds


@pytest.mark.parametrize("words", ["0", "0.0h", "-1", "1d", "m", "", "1.", "1 2"])
def test_what_is_no_time(words):
    with pytest.raises(McaptrackError, match="--timeout needs a time such as 90s, 10m or 2h, not"):
        _seconds(words)


def test_the_table_of_logs_that_run():
    from rich.console import Console

    busy = [
        Running(Path(f"a/long/path/{n}.mcap"), "track", n, 4 * n or None, 10.0 * n, n * 1_500_000_000) for n in range(3)
    ]
    console = Console(file=io.StringIO(), width=79)
    console.print(many.table_of(FleetStatus(9, {"killed": 1, "done": 3}, tuple(busy), 61.4)))
    title, head, *rows = (line.rstrip() for line in console.file.getvalue().splitlines())
    assert title == "4 of 9 logs in 61 s: 3 done, 1 killed"
    assert head.split() == ["log", "stage", "done", "seconds", "MB"]
    assert [row.split() for row in rows] == [
        ["a/long/path/2.mcap", "track", "25%", "20", "3,000"], ["a/long/path/1.mcap", "track", "25%", "10", "1,500"], ["a/long/path/0.mcap", "track", "0", "0"],
    ]  # fmt: skip
    ends = [head.index("done") + 4, head.index("seconds") + 7, head.index("MB") + 2]
    for row in rows[:2]:
        assert [row[end - 1] != " " and row[end : end + 1] in ("", " ") for end in ends] == [True] * 3
        assert row[head.index("stage") :].startswith("track")
    console = Console(file=io.StringIO(), width=60)
    console.print(many.table_of(FleetStatus(9, seconds=3)))
    assert console.file.getvalue().splitlines()[0].rstrip() == "0 of 9 logs in 3 s"


@pytest.mark.parametrize(
    ("hidden", "stream", "is_shown"),
    [(False, Terminal(), True), (True, Terminal(), False), (False, io.StringIO(), False)],
)
def test_a_table_is_shown_on_terminals(hidden, stream, is_shown, monkeypatch):
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "60")
    with many.LiveTable.on_terminal(hidden) as table:
        table.show(FleetStatus(9, {"done": 3}))
    assert ("3 of 9 logs in 0 s: 3 done" in stream.getvalue()) == is_shown


@pytest.mark.parametrize(
    ("options", "words", "line", "is_hidden"),
    [
        (ManyOptions(), {}, str, False),
        (ManyOptions(), {"verbose": True}, str, False),
        (ManyOptions(), {"quiet": True}, str, True),
        (ManyOptions(json_lines=True), {}, str, True),
        (ManyOptions(), {}, None, True),
    ],
    ids=["a line a log", "details", "quiet", "lines of JSON", "results on stdout"],
)
def test_a_table_is_shown_unless_results_are_printed_or_nothing_is(options, words, line, is_hidden, monkeypatch):
    asked = []

    @contextmanager
    def on_terminal(hidden: bool) -> Iterator[None]:
        asked.append(hidden)
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(many.LiveTable, "on_terminal", on_terminal)
    monkeypatch.setattr(many, "RUNNING", SimpleNamespace(get=lambda: SimpleNamespace(params={})))
    token = many._OPTIONS.set(options)
    work = LogWork("check", print, {}, show=print, data=str, line=line)
    with pytest.raises(KeyboardInterrupt):
        many.process([NamedLog(A, A), NamedLog(B, B)], work, talk(**words))
    many._OPTIONS.reset(token)
    assert asked == [is_hidden]


# Progress


def test_progress_of_a_stage_is_said_now_and_then_as_json(capsys, monkeypatch):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(common, "monotonic", lambda: clock.now)
    monkeypatch.setattr(common, "PROGRESS_S", 5.0)
    with text.log_format("json", "run"):
        printer = talk()
        for clock.now, total in ((100.0, 9), (104.9, 9), (105.0, None)):
            printer.progress("detect", 3.5, total)
    first, second = lines_of_json(capsys.readouterr().err)
    assert (first["message"], first["stage"], first["done"], first["total"]) == ("detect: 3.5 of 9", "detect", 3.5, 9)
    assert (second["message"], second["total"]) == ("detect: 3.5", None)


@pytest.mark.parametrize(
    ("options", "concern"),
    [
        ({}, False),
        ({"jobs": 3}, False),
        ({"scheduler": "tcp://a:1"}, True),
        ({"output_dir": Path("out")}, True),
        ({"ledger": Path("a.jsonl")}, True),
        ({"timeout": "1h"}, True),
        ({"memory_limit": "1GB"}, True),
        ({"json_lines": True}, True),
    ],
)
def test_any_of_the_options_that_concern_a_single_log_make_it_one_of_many(options, concern):
    assert ManyOptions(**options).concern_one == concern
