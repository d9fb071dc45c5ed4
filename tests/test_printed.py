"""What commands print, as a whole: each command line and its lines are those in tests/printed.txt,
those of extensions in tests/extensions/NAME/printed.txt.

A text that was changed on purpose is written anew by ``PRINTED=write pytest tests/test_printed.py``; the difference of
the file is what changes for users. What varies between systems is replaced by #: times, bytes and versions.
"""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import mcaptrack
from mcaptrack import fleet
from mcaptrack.api.upkeep import LogCheck, LogRecovery
from mcaptrack.errors import McaptrackError
from mcaptrack.fleet import FleetResult, LogOutcome
from mcaptrack.log.check import CheckResult, Finding
from mcaptrack.notices import Notice
from mcaptrack.pipeline.several import CameraResult
from mcaptrack.pipeline.summary import Corrected, Looks, Repair, Summary, SummaryScores
from tests.commands import call, run_result
from tests.extension_cases import EXTENSIONS, of_extensions
from tests.worlds import write_clip

SECOND = 10**9
START = 1_700_000_000 * SECOND
#: What differs from system to system or from release to release, and isn't what a text is about.
VARYING = (
    (r"[\d,]+(?= bytes\b)|(?<=bytes became )[\d,]+", "#"),
    (r"(?<=\"bytes\": )\d+", "#"),
    (r"(?<=\"version\": )\"[^\"]+\"", "#"),
    (r"[0-9a-f]{40,}", "#"),
)


class Transcript:
    """Command lines and what they print: to stdout as it is, to stderr after "! ", and exit codes other than 0."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def head(self, title: str) -> None:
        self.lines += ["", f"# {title}"]

    def run(self, line: str, shows_answer: bool = True, **results: Any) -> None:
        """Run a command; ``results`` are what functions of the library return or raise instead of doing anything."""
        with pytest.MonkeyPatch.context() as patch:
            for name, result in results.items():
                patch.setattr(mcaptrack, name, returning(result))
            code, out, err = call(*shlex.split(line))
        if out.startswith("{\n"):
            out = json.dumps(json.loads(out))
        printed = [*(out.splitlines() if shows_answer else []), *(f"! {one}" for one in err.splitlines())]
        printed = [normalised(one) for one in printed if not re.match(r"!   time ", one)]
        self.lines += ["", f"$ mcaptrack {line}", *printed, *([f"exit code {code}"] if code else [])]

    def took(self) -> None:
        """Leave out how long the last command took."""
        self.lines = [re.sub(r"(?<= in )[\d.]+ s$", "# s", one) for one in self.lines]


def normalised(line: str) -> str:
    for pattern, instead in VARYING:
        line = re.sub(pattern, instead, line)
    return re.sub(r"\d+\.\d{7,}", lambda number: f"{float(number[0]):.6f}", line).rstrip()


def returning(result: Any) -> Callable[..., Any]:
    def function(*_: Any, **__: Any) -> Any:
        if isinstance(result, Exception):
            raise result
        return result

    return function


# Commands on a log of labels: two people walk beside each other, one of them is missed once


def write_labels() -> None:
    places = [(frame, person, frame + 20 * person) for frame in range(90) for person in (0, 1)]
    Path("truth.txt").write_text("".join(f"{f + 1},{p + 1},{x},24,8,8,1,1,1\n" for f, p, x in places))
    seen = [one for one in places if one[:2] != (40, 0)]
    Path("boxes.txt").write_text("".join(f"{f + 1},-1,{x + 0.5},24,8,8,0.9,-1,-1,-1\n" for f, p, x in seen))
    Path("plane.txt").write_text("0.1,0,0\n0,0.1,0\n0,0,1\n")


def of_a_log(to: Transcript) -> None:
    write_labels()
    labels = "--as detections --truth truth.txt --ground-plane plane.txt --fps 10"
    to.run(f"ingest boxes.txt {labels} -o a.mcap")
    to.run("run a.mcap --no-tables --predictor kalman")
    to.run("run a.mcap --no-tables")
    to.run("drop a.mcap '/camera/retracks/*' -o b.mcap")
    to.run("track b.mcap --min-hits-s 2")
    to.run("events a.mcap")
    to.run("export a.mcap -o tables -v")
    to.run("export a.mcap -o tables -v")
    to.run("info b.mcap")
    to.run("check a.mcap")
    to.run("evaluate a.mcap")
    to.run("evaluate a.mcap b.mcap --similarity metres --gate-m 1")
    to.run("evaluate a.mcap b.mcap --csv --similarity iou")
    to.run("evaluate a.mcap --json --similarity iou --topic /camera/tracks")
    to.run("evaluate a.mcap --fail-under IDF1=1 --fail-under mota=-1 --similarity iou --topic /camera/tracks")
    to.took()


# Results that are given


def several_cameras() -> dict[str, CameraResult]:
    def camera(is_scene: bool = False, **counts: Any) -> CameraResult:
        return CameraResult(
            ("track",), {"/x/tracks": 3}, {"/x/tracks": 4}, {"/x/tracks": 2}, Summary(**counts), is_scene
        )

    scores = SummaryScores((0.5, 0.755), (3, 2), "by boxes")
    return {
        "left": camera(pictures=1000, boxes=2000, tracks=1, ground_plane="given", appearance=Looks(True, 0.9, 8)),
        "right": camera(tracks=1200, repair=Repair(1100, 0, 0, 0), scores=scores, appearance=Looks(False, 0.55, 12)),
        "scene": camera(True, tracks=9),
    }


SUMMARIES = (
    Summary(),
    Summary(tracks=0, boxes=0, forecasts=0, ground_plane="estimated", appearance=Looks(False, None, 0)),
    Summary(
        pictures=1000, boxes=2000, tracks=1200, repair=Repair(1, 2, 3, 4000), corrected=Corrected(1200, 3, 40),
        scores=SummaryScores((0.5, 0.75), (1234, 5), "within 1 m"), forecasts=1234, horizon_s=4.8,
        ground_plane="assumed", camera_motion="shaking", appearance=Looks(True, 0.914, 1),
    ),
    Summary(boxes=1200, frame_id="map", tracks=1, repair=Repair(1000, 0, 0, 0), appearance=Looks(False, 0.55, 12)),
)  # fmt: skip


def of_runs(to: Transcript) -> None:
    for summary in SUMMARIES:
        to.run("run x.mcap", run=run_result(summary=summary))
    said = tuple(Notice(words, code) for words, code in (("a", "other"), ("b", "lost"), ("c", "other")))
    parts = {"read": 0.5, "track": 7.25, "write": 0.49, "detect": 2.5}
    to.run("run x.mcap", run=run_result(stages=("track",), warnings=said, summary=SUMMARIES[0], seconds=10.0,
                                        seconds_by_part=parts))  # fmt: skip
    cameras = several_cameras()
    apart = {"left_out": {"up": "has no tracks; give `topic=`"}, "not_fused": "there is no ground; `min_iou=0.5`"}
    to.run("run x.mcap", run=run_result(cameras=cameras, left_out=apart["left_out"], summary=Summary(tracks=9)))
    to.run("run x.mcap", run=run_result(cameras={"left": cameras["left"]}, **apart))
    to.run("run x.mcap --json", run=run_result(cameras={"scene": cameras["scene"]}, **apart))
    stages = run_result(
        stages=("detect", "track"), frames={"/a/detections": 1000, "/a/tracks": 10},
        rows={"/a/detections": 12345, "/a/tracks": 20}, tracks={"/a/tracks": 1001}, tables={"tracks": 5, "frames": 6},
        events={"/a/tracks": {"birth": 3, "end": 0, "switch": 1}, "/b": {"birth": 0}},
        written_to=Path("other.mcap"), written_because="ROS reads it",
    )  # fmt: skip
    for more in ("", "-v", "-q", "--json"):
        to.run(f"events x.mcap {more}".strip(), events=stages)
    to.run("events x.mcap", events=run_result(stages=("events",), written_because="why", written_to=None))


def channel(topic: str, messages: int, rate_hz: float | None = None, **more: Any) -> dict[str, Any]:
    plain = dict.fromkeys(("input", "transform", "plugins", "parameters", "frame", "references"))
    plain |= {"schema": "test.Thing", "stale": False, "replaced": False}
    return plain | {"topic": topic, "messages": messages, "rate_hz": rate_hz} | more


def frame(name: str, parent: str | None, **more: Any) -> dict[str, Any]:
    plain = {"static": False, "rate_hz": 12.345, "start_ns": START + SECOND, "end_ns": START + 2 * SECOND}
    return plain | {"frame": name, "parent": parent, "gaps": [], "jumps": [], "namespace": ""} | more


def of_contents(to: Transcript) -> None:
    def info(line: str, **changed: Any) -> None:
        plain = {"log": "a\x1b.mcap", "bytes": 12345, "messages": 6789, "start_ns": START}
        plain |= {"end_ns": START + 1_500_000_000, "results": None, "channels": [], "frames": None}
        to.run(line, info=SimpleNamespace(to_json=lambda: plain | changed))

    plugin = {"name": "own", "distribution": "pkg", "version": "1.2"}
    channels = [
        channel("/a", 1234, 29.97),
        channel("/a", 5, 10.04, replaced=True),
        channel("/a/b", 7, input="/a", transform="track", frame="map", stale=True, parameters={"b": 2, "a": 1},
                references=["/x/events", "/x/corrected"], plugins={"transform": plugin}),
        channel("/a/c", 7, input="/a", transform="track",
                plugins={"transform": plugin | {"distribution": "", "version": ""}}),
        channel("/a/view", 7, input="/a", transform="view"),
        channel("/d", 7, input="/gone", transform="track"),
    ]  # fmt: skip
    info("info x.mcap -v", channels=channels, results="a.results.mcap")
    cameras = [channel("/b/x", 1, camera="b"), channel("/imu", 1), channel("/a/x", 1, camera="a")]
    info("info x.mcap", channels=cameras, start_ns=1_234_567_890, end_ns=1_234_567_890)
    for start_ns in (315_532_800 * SECOND - 1, 315_532_800 * SECOND, START + 5_999_999):  # dates from 1980 on
        info("info x.mcap", start_ns=start_ns, end_ns=start_ns)
    info("info x.mcap", messages=0, frames=[])
    gaps = [{"start_ns": START + n * SECOND, "end_ns": START + n * SECOND + SECOND // 2} for n in range(4)]
    jumps = [{"t_ns": START + SECOND // 4, "distance_m": 1.234, "angle_deg": 44.6}]
    frames = [
        frame("map", None), frame("base", "map", gaps=gaps, jumps=jumps), frame("eye", "base", static=True),
        frame("foot", "base", gaps=gaps[:1], jumps=jumps * 2),
    ]  # fmt: skip
    info("info x.mcap --frames", frames=frames)
    deep = [channel(f"/{n}", 1, input=f"/{n - 1}", transform="track") for n in range(1, 34)]
    info("info x.mcap", channels=deep)


def of_upkeep(to: Transcript) -> None:
    cut = Finding("error", "cut-off", 123, "the file is cut off")
    late = Finding("warning", "late", 5, "messages later than 2262", 3)
    beside = CheckResult(Path("a.results.mcap"), 1, 1, [])
    for findings, more in (([cut, late], ("", "-q", "--json")), ([late], ("", "-q"))):
        files = (CheckResult(Path("a.mcap"), 12, 3, findings), beside)
        for one in more:
            to.run(f"check x.mcap {one}".strip(), check=LogCheck(Path("a.mcap"), files, ()))
    for count, more in ((0, ""), (20, ""), (22, ""), (22, "-v"), (2, "--json -q")):
        lost = tuple(f"byte {n}" for n in range(count))
        saved = LogRecovery(Path("a.mcap"), Path("saved.mcap"), 12, 3, lost, ())
        to.run(f"recover x.mcap -o saved.mcap {more}".strip(), recover=saved)


@contextmanager
def fleets_end_with(*outcomes: LogOutcome[Any], stopped: str = "") -> Iterator[None]:
    """Let logs end like this, one after the other, instead of starting processes."""

    def run(*_: Any, on_outcome: Callable[[LogOutcome[Any]], None], **__: Any) -> FleetResult[Any]:
        for outcome in outcomes:
            on_outcome(outcome)
        return FleetResult(outcomes, 4.0, stopped)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fleet, "run", run)
        yield


def of_many_logs(to: Transcript) -> None:
    said = (Notice("x", "lost"), Notice("y", "lost"), Notice("z", "other"))
    happened = {"/a": {"birth": 2, "end": 0}, "/b": {"switch": 1}}
    whole = run_result(
        stages=("track", "track", "sample"), cameras=several_cameras(), summary=Summary(tracks=1200), warnings=said,
        events=happened, log=Path("x.mcap"),
    )  # fmt: skip
    nothing = run_result(summary=Summary(tracks=1), events={"/a": {"birth": 0}}, log=Path("y.mcap"))
    x, y, z = Path("x.mcap"), Path("y.mcap"), Path("z.mcap")
    outcomes = (
        LogOutcome(y, "done", nothing, printed="hello\nworld", tries=1, seconds=2.0, cpu_seconds=1.5, peak_bytes=250_000_000),
        LogOutcome(x, "done", whole, tries=1),
        LogOutcome(z, "failed", error="it is cut off, says `topic=`", detail="last\nwords", tries=2, cpu_seconds=0.5),
    )  # fmt: skip
    with fleets_end_with(*outcomes):
        for line in (
            "run x.mcap y.mcap z.mcap",
            "events x.mcap y.mcap z.mcap",
        ):
            to.run(line)
    with fleets_end_with(
        LogOutcome(x, "skipped"), LogOutcome(z, "killed", error="z.mcap: its worker died", detail="why")
    ):
        to.run("run x.mcap z.mcap -v")
    left = [LogOutcome(Path(f"{n}.mcap"), "not-tried") for n in range(18)]
    with fleets_end_with(*outcomes[1:], *left, stopped="the disk is full"):
        to.run("run x.mcap y.mcap z.mcap")
    one, other = (LogCheck(path, (CheckResult(path, 12, 3, []),), ()) for path in (x, y))
    with fleets_end_with(LogOutcome(y, "done", other), LogOutcome(x, "done", one), LogOutcome(z, "skipped")):
        to.run("check x.mcap y.mcap z.mcap")


def of_mistakes(to: Transcript) -> None:
    for command in ("detect", "track", "sample", "predict", "retrack", "run", "events", "recover", "ingest"):
        to.run(f"{command} x.mcap y.mcap -o z.mcap")
    for gates in ("0", "1,-1", "inf", "nan", "1,", "''"):
        to.run(f"evaluate x.mcap --gate-m {gates}")
    for limit in ("idf1", "idf1=", "luck=1", "idf1=70", "idf1=nan"):
        to.run(f"evaluate x.mcap --fail-under {limit}")
    for words in ("alpha", "alhpa=1", "alpha=x", "min_hits=1.5", "trim_ends=maybe", "alpha=1 --set alpha=2",
                  "max_age_s=1 --max-age-s 2", "alpha=2 --profile paper"):  # fmt: skip
        to.run(f"retrack a.mcap --set {words}")
    for time in ("0", "0.0h", "-1", "1d", "m", "''", "1.", "'1 2'"):
        to.run(f"run x.mcap --timeout={time}")
    to.run("run x.mcap --ledger x.mcap")
    write_clip(Path("clip.mp4"), options={"bf": "0"})
    for words in ("--quality 60", "--image-format jpeg --quality 0", "--image-format png --quality 9",
                  "--image-format jpeg --set keyframe_interval_s=1", "--set keyframe_interval_s=0"):  # fmt: skip
        to.run(f"ingest clip.mp4 -o c.mcap {words}")
    to.run("ingest truth.txt -o c.mcap --quality 20")
    to.lines.append(f"c.mcap is there: {Path('c.mcap').exists()}")
    to.run("run x.mcap", run=McaptrackError("give `fps=25` or `force=True`; `mcaptrack.run('a b.mcap', events=False)`"))


PARTS: Sequence[tuple[str, Callable[[Transcript], None]]] = (
    ("A log of labels", of_a_log), ("Runs and stages", of_runs), ("Contents", of_contents),
    ("Check and recover", of_upkeep),
    ("Many logs", of_many_logs), ("Mistakes", of_mistakes),
)  # fmt: skip


#: By the file with what they print: the parts of the core, and those of extensions.
SNAPSHOTS = {Path(__file__).with_name("printed.txt"): PARTS} | {
    EXTENSIONS / name / "printed.txt": [(name, part)] for name, part in of_extensions("PRINTED").items()
}


@pytest.mark.parametrize("snapshot", SNAPSHOTS, ids=lambda path: path.parent.name)
def test_commands_print_what_the_snapshot_has(snapshot, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("x.mcap", "y.mcap", "z.mcap", "bad.sql"):
        Path(name).write_bytes(b"\xff")
    Path("q.sql").write_text("select 2")
    to = Transcript()
    for title, part in SNAPSHOTS[snapshot]:
        to.head(title)
        part(to)
    found = [*to.lines[1:], ""]
    if os.environ.get("PRINTED") == "write":
        snapshot.write_text("\n".join(found), encoding="utf-8")
    assert found == snapshot.read_text(encoding="utf-8").split("\n")
