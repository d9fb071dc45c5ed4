"""What `info`, `check`, `recover`, `drop` and `zones` print of results that are given; line by line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.api.upkeep import LogCheck, LogRecovery
from mcaptrack.cli.show import _frames, _print, _when
from mcaptrack.cli.zones import print_zones, zones_in_short
from mcaptrack.evaluation.zones import ZoneTotals
from mcaptrack.log.check import CheckResult
from mcaptrack.log.check_summary import Finding
from tests.commands import call
from tests.commands import run_result as result

SECOND = 10**9
START = 1_700_000_000 * SECOND


@pytest.mark.parametrize(
    ("t_ns", "words"),
    [
        (0, "0.000 s"),
        (1_234_567_890, "1.235 s"),
        (315_532_800 * SECOND - 1, "315532800.000 s"),
        (315_532_800 * SECOND, "1980-01-01 00:00:00.000 UTC"),
        (START + 5_999_999, "2023-11-14 22:13:20.005 UTC"),
    ],
)
def test_times_are_dates_from_1980_on(t_ns, words):
    assert _when(t_ns) == words


def channel(
    topic: str, messages: int, rate_hz: float | None = None, replaced: bool = False, **more: Any
) -> dict[str, Any]:
    plain = {"schema": "test.Thing", "input": None, "transform": None, "plugins": None, "stale": False}
    plain |= {"parameters": None, "frame": None, "references": None}
    return plain | {"topic": topic, "messages": messages, "rate_hz": rate_hz, "replaced": replaced} | more


def info(**changed: Any) -> dict[str, Any]:
    plain = {"log": "a.mcap", "bytes": 12345, "messages": 6789, "start_ns": START, "end_ns": START + 1_500_000_000}
    return plain | {"results": None, "channels": [], "frames": None} | changed


def test_a_log_and_its_channels(capsys):
    channels = [
        channel("/a", 1234, 29.97), channel("/a", 5, 10.04, replaced=True),
        channel("/a/b", 7, input="/a", transform="track", frame="map", stale=True, parameters={"b": 2, "a": 1},
                references=["/x/events", "/x/corrected"]),
    ]  # fmt: skip
    _print(info(channels=channels, results="a.results.mcap"), verbose=True)
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert lines[:3] == ["a.mcap  12,345 bytes, 6,789 messages, 1.500 s", "starts at 2023-11-14 22:13:20.000 UTC",
                         "with results in a.results.mcap"]  # fmt: skip
    assert [line.split() for line in lines[3:7]] == [
        ["topic", "schema", "messages", "per", "second"], ["/a", "test.Thing", "1,234", "30.0"],
        ["/a", "(replaced", "by", "the", "results)", "test.Thing", "5", "10.0"], ["/a/b", "test.Thing", "7"],
    ]  # fmt: skip
    assert (
        lines[4].index("1,234") + 5 == lines[5].index("  5") + 3 == lines[6].index("7") + 1
    )  # numbers end below each other
    assert lines[7:] == [
        "lineage", "└── /a", "    └── /a/b  track  with /x/corrected  in map  out of date", "        └── a=1, b=2",
    ]  # fmt: skip
    _print(info(messages=0), verbose=False)
    assert capsys.readouterr().out.splitlines()[1] == "no messages"
    _print(info(frames=[]), verbose=False)
    assert capsys.readouterr().out.splitlines()[-1] == "no transforms"


def frame(name: str, parent: str | None, **more: Any) -> dict[str, Any]:
    plain = {"static": False, "rate_hz": 12.345, "start_ns": START + SECOND, "end_ns": START + 2 * SECOND}
    return plain | {"frame": name, "parent": parent, "gaps": [], "jumps": []} | more


def test_frames_of_a_log_hang_below_each_other():
    gaps = [{"start_ns": START + n * SECOND, "end_ns": START + n * SECOND + SECOND // 2} for n in range(4)]
    jumps = [{"t_ns": START + SECOND // 4, "distance_m": 1.234, "angle_deg": 44.6}]
    frames = [
        frame("map", None), frame("base", "map", gaps=gaps, jumps=jumps), frame("eye", "base", static=True),
        frame("foot", "base", gaps=gaps[:3], jumps=jumps * 2),
    ]  # fmt: skip
    root = _frames(frames, START)
    (top,) = root.children
    (base,) = top.children
    eye, foot = base.children
    assert str(top.label) == "map"
    assert str(base.label) == (
        "base  12.3 Hz, 1.000 to 2.000 s  gaps: 0.000 to 0.500 s, 1.000 to 1.500 s, 2.000 to 2.500 s and 1 more"
        "  jump: 0.250 s (1.2 m, 45 degrees)"
    )
    assert str(eye.label) == "eye  static"
    assert str(foot.label).endswith("2.000 to 2.500 s  jumps: 0.250 s (1.2 m, 45 degrees), 0.250 s (1.2 m, 45 degrees)")
    deep = _frames([frame("0", None), *(frame(str(n), str(n - 1)) for n in range(1, 40))], START)
    depth, node = 0, deep
    while node.children:
        depth, node = depth + 1, node.children[0]
    assert depth == 31
    one = _frames([frame("a", None, gaps=gaps[:1])], START).children[0]
    assert str(one.label) == "a  gap: 0.000 to 0.500 s"


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    with log.create(tmp_path / "a.mcap"):
        pass
    return tmp_path


LATE = Finding("warning", "late", 5, "messages later than 2262", 3)
CUT = Finding("error", "cut-off", 123, "the file is cut off")


def test_findings_are_a_table(place, monkeypatch):
    found = [CheckResult(Path("a.mcap"), 12, 3, [CUT, LATE]), CheckResult(Path("a.results.mcap"), 1, 1, [])]
    monkeypatch.setattr(mcaptrack, "check", lambda *_, **__: LogCheck(Path("a.mcap"), tuple(found), ()))
    code, out, _ = call("check", "a.mcap")
    lines = [line.split() for line in out.splitlines()]
    assert (code, lines[0]) == (1, ["a.mcap:", "damaged;", "12", "messages", "in", "3", "chunks"])
    assert [line for line in lines if line[:1] == ["error"]] == [
        ["error", "123", "1", "cut-off", "the", "file", "is", "cut", "off"]
    ]
    assert [line for line in lines if line[:1] == ["warning"]] == [
        ["warning", "5", "3", "late", "messages", "later", "than", "2262"]
    ]
    assert lines[-1] == ["a.results.mcap:", "sound;", "1", "messages", "in", "1", "chunks"]
    code, out, _ = call("check", "a.mcap", "-q")
    assert (code, "late" in out, "sound" in out, "cut-off" in out) == (1, False, False, True)
    code, out, _ = call("check", "a.mcap", "--json")
    assert json.loads(out)["results"][0] == {
        "log": "a.mcap", "sound": False, "messages": 12, "chunks": 3, "findings": [
            {"level": "error", "kind": "cut-off", "byte": 123, "times": 1, "words": "the file is cut off"},
            {"level": "warning", "kind": "late", "byte": 5, "times": 3, "words": "messages later than 2262"},
        ],
    }  # fmt: skip
    found[0].findings.remove(CUT)
    code, out, _ = call("check", "a.mcap", "-q")
    assert (code, out) == (0, "")


@pytest.mark.parametrize("count", [0, 1, 20, 21, 23])
def test_what_is_lost_is_listed(place, monkeypatch, count):
    saved = LogRecovery(Path("a.mcap"), Path("saved.mcap"), 12, 3, tuple(f"byte {n}" for n in range(count)), ())
    monkeypatch.setattr(mcaptrack, "recover", lambda *_, **__: saved)
    code, _, err = call("recover", "a.mcap", "-o", "saved.mcap")
    said = err.splitlines()
    assert (code, said[0]) == (3 if count else 0, "saved.mcap: 12 messages in 3 chunks are saved")
    shown = [f"lost: byte {n}" for n in range(min(count, 20))]
    more = [f"lost: {count - 20} more; -v shows them"] if count > 20 else []
    assert said[1:] == (shown + more or ["nothing was lost"])
    if count in (0, 23):
        assert call("recover", "a.mcap", "-o", "saved.mcap", "-v")[2].count("lost: byte") == count
        code, out, _ = call("recover", "a.mcap", "-o", "saved.mcap", "--json")
        (one,) = json.loads(out)["results"]
        assert one == {"log": "a.mcap", "output": "saved.mcap", "messages": 12, "chunks": 3, "lost": list(saved.lost)}


ROOM = ZoneTotals("room", False, 3, 4, 2, 1, 50.0, 12.54, 11.0, 2, 1.5)
EMPTY = ZoneTotals("room", False, 0)
DOOR = ZoneTotals("door", True, 7, forward=5, backward=6)


def test_zones_and_lines_have_tables(capsys):
    made = result(zones={"/a/tracks": [DOOR, ROOM], "/b/tracks": [EMPTY]})
    assert zones_in_short(made) == "2 zones and lines, of 2 channels of tracks"
    assert zones_in_short(result(zones={"/a": [ROOM]})) == "1 zone or line, of 1 channel of tracks"
    print_zones(made)
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line.strip(" ─")]
    assert lines == [
        ["zone", "tracks", "of", "tracks", "visits", "entered", "left", "mean", "stay", "most", "inside"],
        ["room", "/a/tracks", "3", "4", "2", "1", "12.5", "s", "2"], ["room", "/b/tracks", "0", "0", "0", "0", "0"],
        ["line", "tracks", "of", "tracks", "forward", "backward"], ["door", "/a/tracks", "7", "5", "6"],
    ]  # fmt: skip
    print_zones(result(zones={"/a": [DOOR]}))
    assert capsys.readouterr().out.split()[0] == "line"
    print_zones(result(zones={}))
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({}, "results are in a b.mcap"),
        ({"written_because": "ROS reads it"}, "results are in a b.mcap: ROS reads it"),
        ({"written_to": None}, "everything was up to date"),
        ({"written_to": None, "written_because": "why"}, "everything was up to date"),
    ],
)
def test_where_zones_are_written_is_said(place, monkeypatch, changed, words):
    made = result(zones={"/a": [ROOM]}, stages=("zones",), **changed)
    monkeypatch.setattr(mcaptrack, "zones", lambda *_, **__: made)
    code, out, err = call("zones", "a.mcap", "--zones", "z.geojson")
    assert (code, err.splitlines()[-1], "room" in out) == (0, f"a b.mcap: {words}", True)
    code, out, err = call("zones", "a.mcap", "--zones", "z.geojson", "--json", "-q")
    (one,) = json.loads(out)["results"]
    written = changed.get("written_to", "a b.mcap")
    assert one == {
        "log": "a b.mcap", "stages": ["zones"], "zones": {"/a": [ROOM.to_json()]}, "written_to": written, "seconds": 1.26,
    }  # fmt: skip
    assert err == ""
