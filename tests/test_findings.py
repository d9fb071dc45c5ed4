"""What runs say of what they found: numbers, what was assumed, what is odd, and what they can't do."""

from __future__ import annotations

import importlib
import json
import shutil
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

import pytest

import mcaptrack
from mcaptrack import log, notices, pipeline
from mcaptrack.pipeline.planes import AS_BEFORE, make_plane
from mcaptrack.pipeline.write import RunState
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import TRANSFORMS
from tests.commands import done
from tests.logs import provenance_of, write_channels
from tests.worlds import assert_same_rows, ns, tracks_at, walk

runner = importlib.import_module("mcaptrack.pipeline.runner")
steps = importlib.import_module("mcaptrack.pipeline.steps")


@pytest.fixture
def path(template, tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copy(template, tmp_path / "a.mcap"))


def written(path: Path, **tracks: list[Frame]) -> Path:
    made = {name: Provenance("retrack" if name == "retracks" else "track", {}) for name in tracks}
    return write_channels(path, {f"/camera/{name}": (TRACKS, made[name], frames) for name, frames in tracks.items()})


def kept(path: Path) -> list[tuple[str, str]]:
    with mcaptrack.open(path) as opened:
        rows = opened.table("warnings").to_pylist()
        assert opened.table("recordings")["warnings"].to_pylist() == [len({row["message"] for row in rows})]
    return [(row["topic"], row["code"]) for row in rows]


# The summary


def of_sources(*parts: tuple[int, int]) -> list[Frame]:
    """Return re-tracked frames, one row and one second each, with these pairs of track id and source id."""
    frames = []
    for number, (track, source) in enumerate(parts):
        rows = tracks_at({track: (float(number), 1.0)})
        rows["source_id"] = source
        frames.append(Frame(ns(float(number)), number, rows))
    return frames


def test_summary_counts_joined_split_and_missing_tracks(tmp_path):
    """Tracks 1 and 2 are joined as 10, 3 is split into 11 and 12, and 4 is left out."""
    tracks = [Frame(ns(float(n)), n, tracks_at({n + 1: (float(n), 1.0)})) for n in range(4)]
    path = written(tmp_path / "a.mcap", tracks=tracks, retracks=of_sources((10, 1), (10, 2), (11, 3), (12, 3)))
    with log.read(path) as opened:
        summary = pipeline.summarise(opened, "/camera")
    assert summary.tracks == 4
    assert summary.repair is not None
    assert asdict(summary.repair) == {"tracks": 3, "joined": 1, "parted": 1, "left_out": 1}
    assert (summary.pictures, summary.boxes, summary.forecasts, summary.scores) == (None, None, None, None)


@pytest.mark.parametrize("is_worse", [False, True])
def test_summary_scores_samples_and_retracks_and_warns_of_a_loss(tmp_path, is_worse):
    truth = walk(lambda n: {1: (n * 0.4, 0.0), 2: (n * 0.4, 5.0)}, 10)
    swapped = walk(lambda n: {1 + n // 5: (n * 0.4, 0.0), 2 - n // 5: (n * 0.4, 5.0)}, 10)
    samples, retracks = (truth, swapped) if is_worse else (swapped, truth)
    path = written(tmp_path / "a.mcap", truth=truth, samples=samples, retracks=retracks)
    with log.read(path) as opened, notices.collected() as said:
        scores = pipeline.summarise(opened, "/camera").scores
    assert scores is not None
    assert (scores.idf1, scores.switches) == (((1.0, 0.5), (0, 2)) if is_worse else ((0.5, 1.0), (2, 0)))
    words = "re-tracking made it worse: IDF1 100.0% before, 50.0% after, against /camera/truth, within 1 m"
    assert [(notice.message, notice.code) for notice in said] == [(words, "worse")] * is_worse
    assert kept(path) == [("/camera/retracks", "worse")] * is_worse


def test_every_run_repeats_the_warnings_even_with_quiet(path):
    """This holds for runs with nothing to do, and includes warnings of inputs."""
    done("ingest", path.with_name("a.mcap"), "-o", "b.mcap", "-q")
    done("drop", "b.mcap", "/camera/ground_plane", "/camera/[!v]*", "-q")
    first = json.loads(done("run", "b.mcap", "--no-tables", "--json", "-q").out)
    again = done("run", "b.mcap", "--no-tables", "--json", "-q")
    assert json.loads(again.out)["results"][0]["stages"] == []
    assert json.loads(again.out)["warnings"] == first["warnings"]
    codes = [one["code"] for one in first["warnings"]]
    assert "assumed-ground-plane" in codes
    assert len(codes) == len(set(codes))
    assert again.err.count("warning: ") == len(codes)
    alone = json.loads(done("detect", "b.mcap", "--force", "-o", "c.mcap", "--json", "-q").out)["warnings"]
    assert "assumed-ground-plane" not in [one["code"] for one in alone]
    lines = done("run", "b.mcap", "--no-tables").err
    assert f"{len(codes)}, see above: {', '.join(codes)}" in lines
    assert "the scale of the ground, from the heights of boxes" in lines
    assert provenance_of(Path("b.mcap"), "/camera/tracks").warnings == []
    assert {code for _, code in kept(Path("b.mcap"))} == set(codes)


def test_run_warns_of_too_little_memory(path, monkeypatch):
    monkeypatch.setattr(steps, "free_memory", lambda: 1_000_000)
    said = json.loads(done("track", path, "--json", "-q").out)["warnings"]
    assert [one["code"] for one in said] == ["memory"]


def test_the_memory_warning_begins_at_the_estimated_need(monkeypatch):
    """The need is 400 MB, and 3 kB for each second that a person is seen, as measured."""
    frames = [Frame(n * 100_000_000, n, DETECTIONS.empty(20)) for n in range(1_000)]
    needed = 400_000_000 + 2_000 * 3_000
    for free, is_little in ((needed, False), (needed - 1, True), (None, False)):
        monkeypatch.setattr(steps, "free_memory", lambda free=free: free)
        with notices.collected() as said:
            steps.warn_memory(frames)
        assert [one.code for one in said] == ["memory"] * is_little
    monkeypatch.setattr(steps, "free_memory", lambda: 160_000_000)
    with notices.collected() as said:
        steps.warn_memory([Frame(n * 40_000_000, n, DETECTIONS.empty(10)) for n in range(50_000)])
    words = (
        "500,000 boxes, of people who are seen for 6 hours together, take about 0.5 GB of memory, and 0.2 GB are "
        "free: re-tracking has all samples in memory"
    )
    assert [one.message for one in said] == [words]


def test_empty_results_are_explained_by_the_input_or_the_transform():
    none, some = Frame(ns(0), 0, TRACKS.empty()), Frame(ns(1), 1, TRACKS.empty(1))
    for given, words in (
        ([none, none], "/camera/tracks holds nothing, so nothing was made of it"),
        ([none, some], "no samples of /camera/tracks: "),
    ):
        with notices.collected() as said:
            runner.warn_no_rows("sample", "/camera/tracks", TRANSFORMS["sample"](), given, [none])
        assert [one.message.startswith(words) for one in said] == [True]
    with notices.collected() as said:
        runner.warn_no_rows("sample", "/camera/tracks", TRANSFORMS["sample"](), [none, some], [none, some])
    assert said == []


# Without a ground plane


def test_a_guessed_scale_covers_all_boxes_and_begins_with_the_first_frame(path):
    boxes = {"x_px": [10.0, 300.0], "y_px": [20.0, 5.0], "w_px": [20.0, 40.4], "h_px": [34.0, 34.0]}
    rows = DETECTIONS.rows(**boxes, score=[1.0, 1.0], class_id=[1, 1])
    frames = [Frame(ns(3), 0, DETECTIONS.empty()), Frame(ns(4), 1, rows)]
    with log.read(path) as opened:
        state, source = RunState(opened, "/other", {}), ("/other/detections", "")
        planes, made = make_plane(state, frames, source, AS_BEFORE, "")
        assert make_plane(state, frames[:1], source, AS_BEFORE, "") == (None, None)
    assert planes is not None
    assert made is not None
    (((start, plane),), (frame,)) = planes, made.frames
    assert (start, frame.t_ns) == (ns(3), ns(3))
    assert (plane.width_px, plane.height_px, plane.assumed) == (340, 54, True)
    assert plane.homography[0] == pytest.approx(1.7 / 34)  # people are 1.7 m high


def ingested(path: Path, rows: Iterable[str], *words: object) -> Path:
    path.with_suffix(".txt").write_text("\n".join(rows) + "\n")
    done("ingest", path.with_suffix(".txt"), "--as", "detections", "--fps", "10", *words, "-o", path, "-q")
    return path


def side_by_side(frames: int = 60) -> list[str]:
    """Return tracks of people who pass each other, seen by a camera at their height."""
    return [f"{n},-1,{x},20,20,60,1,-1,-1,-1" for n in range(1, frames) for x in (n * 3, 200 - n * 3)]


def test_tracks_of_a_side_view_are_passed_on_with_a_warning(tmp_path):
    path = ingested(tmp_path / "a.mcap", side_by_side())
    data = json.loads(done("run", path, "--no-tables", "--json", "-q").out)
    assert {"held-back", "assumed-ground-plane"} <= {one["code"] for one in data["warnings"]}
    assert sorted(code for _, code in kept(path)) == sorted(one["code"] for one in data["warnings"])
    with log.read(path) as opened:
        samples, retracks = (opened.rows(f"/camera/{name}", TRACKS).rows for name in ("samples", "retracks"))
    assert_same_rows(retracks, samples)
    insisted = json.loads(done("retrack", path, "--set", "side_view=true", "--json", "-q").out)
    assert "held-back" not in {one["code"] for one in insisted["warnings"]} | {code for _, code in kept(path)}
    assert provenance_of(path, "/camera/retracks").parameters["side_view"] is True
