"""Recordings that follow one another: people at the cut keep their ids, as if nothing had been split."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import collected
from mcaptrack.pipeline import following
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from tests.commands import call, done
from tests.logs import provenance_of
from tests.places import write_parts
from tests.tiers import thorough

FPS, FRAMES = 10, 210
#: The first frame of each of three parts.
CUTS = (0, 80, 147)
#: The channels of ids of the same people.
CHANNELS = ("tracks", "retracks", "retracks/online", "retracks/full")
PLANE = "0.02,0,0\n0,0.02,0\n0,0,1\n"


def places() -> np.ndarray:
    """The middles of the feet of six people in px, (F, 6, 2): they cross, and come and go; NaN where they are not."""
    t = np.arange(FRAMES)[:, None] / FPS
    x = np.concatenate(
        [20 + 55 * t, 620 - 50 * t, 100 + 40 * (t - 4), 560 - 45 * (t - 3), 60 + 50 * (t - 12), 320 + 3 * t], axis=1
    )
    y = np.broadcast_to([150.0, 190, 260, 300, 390, 440], x.shape) + 8 * np.sin(t)
    there = (x > 10) & (x < 630)
    there[:40, 2] = there[:30, 3] = there[:120, 4] = False
    return np.where(there[..., None], np.stack([x, y], axis=-1), np.nan)


PLACES = places()


def lines(first: int, last: int, places: np.ndarray) -> str:
    """Detections of these frames as a label file, each of a person."""
    rng = np.random.default_rng(3)
    shake = rng.normal(0, 0.4, places.shape)
    rows = [
        f"{frame - first + 1},-1,{x - 12:.2f},{y - 60:.2f},24,60,0.9,-1,-1,-1"
        for frame in range(first, last)
        for x, y in (places[frame] + shake[frame]).tolist()
        if np.isfinite(x)
    ]
    return "\n".join(rows) + "\n"


def part(
    path: Path,
    first: int,
    last: int,
    start_s: float | None = None,
    camera: str = "camera",
    places: np.ndarray = PLACES,
) -> Path:
    """A log of the detections of these frames, at their times in the whole recording."""
    label = path.with_suffix(".txt")
    label.write_text(lines(first, last, places))
    plane = path.with_name("plane.csv")
    plane.write_text(PLANE)
    mcaptrack.ingest(
        label, path, fps=FPS, start_time=first / FPS if start_s is None else start_s, frames=last - first,
        ground_plane=plane, camera=camera,
    )  # fmt: skip
    return path


def ids_of(path: Path, name: str) -> dict[tuple[int, int], int]:
    """The id of each person at each frame of the whole recording, by where people truly are."""
    found = {}
    with log.read(path) as opened:
        for frame in opened.frames(f"/camera/{name}", TRACKS):
            at = round(frame.t_ns / 1e9 * FPS)
            for row in frame.rows[frame.rows["observed"]]:
                foot = np.array([row["x_px"] + row["w_px"] / 2, row["y_px"] + row["h_px"]])
                away = np.hypot(*(PLACES[at] - foot).T)
                if np.nanmin(away) < 10:
                    found[at, int(np.nanargmin(away))] = int(row["track_id"])
    return found


@pytest.fixture(scope="module")
def parts(tmp_path_factory) -> list[Path]:
    """Three recordings that follow one another, run with --continue. Tests must not change them."""
    folder = tmp_path_factory.mktemp("parts")
    ends = (*CUTS[1:], FRAMES)
    paths = [part(folder / f"{n}.mcap", first, last) for n, (first, last) in enumerate(zip(CUTS, ends, strict=True))]
    for path in paths:
        mcaptrack.run(path, follows=paths, tables=False)
    return paths


@pytest.mark.parametrize("name", CHANNELS)
def test_people_at_a_cut_keep_their_ids_and_others_get_new_ones(parts, name):
    found = [ids_of(path, name) for path in parts]
    seen: set[int] = set()
    for before, after, cut in zip(found, found[1:], CUTS[1:], strict=False):
        seen |= set(before.values())
        near = [{one for at, one in part if abs(at - cut) < 15} for part in (before, after)]
        at_cut = [one for one in near[0] & near[1] if np.isfinite(PLACES[cut - 1 : cut + 1, one]).all()]
        assert len(at_cut) >= 3
        for person in at_cut:
            last = max(at for at, one in before if one == person)
            first = min(at for at, one in after if one == person)
            assert before[last, person] == after[first, person]
        kept = {before[max(at for at, one in before if one == person), person] for person in at_cut}
        assert not (set(after.values()) - kept) & seen


def test_parts_have_the_tracks_and_the_samples_of_the_whole(parts, tmp_path):
    whole = part(tmp_path / "whole.mcap", 0, FRAMES)
    mcaptrack.run(whole, tables=False)
    with log.read(whole) as opened:
        frames = {frame.t_ns: frame.rows for frame in opened.frames("/camera/tracks", TRACKS)}
        sampled = set(opened.times("/camera/samples").tolist())
        predicted = {frame.t_ns: len(frame.rows) for frame in opened.frames("/camera/predictions", PREDICTIONS)}
    for path in parts:
        with log.read(path) as opened:
            assert set(opened.times("/camera/samples").tolist()) <= sampled
            for frame in opened.frames("/camera/tracks", TRACKS):
                boxes, others = (np.sort(rows["x_px"]) for rows in (frame.rows, frames[frame.t_ns]))
                assert len(boxes) == len(others)
                assert np.abs(boxes - others).max(initial=0) < 2
            own = {frame.t_ns: len(frame.rows) for frame in opened.frames("/camera/predictions", PREDICTIONS)}
            assert own == {t_ns: predicted[t_ns] for t_ns in own}


def test_a_second_run_has_nothing_to_do_until_the_log_before_changes(parts, tmp_path):
    paths = [Path(tmp_path / one.name) for one in parts[:2]]
    for old, new in zip(parts, paths, strict=False):
        new.write_bytes(old.read_bytes())
    again = [mcaptrack.run(path, follows=paths, tables=False) for path in paths]
    assert [one.stages for one in again] == [(), ()]
    assert again[0].continued is None
    assert again[1].continued.to_json() == {"log": str(paths[0]), "gap_s": pytest.approx(0.1), "at_cut": {}, "kept": {}}
    mcaptrack.run(paths[0], force=True, tables=False)
    assert mcaptrack.run(paths[1], follows=paths[0], tables=False).is_up_to_date  # the same as before
    mcaptrack.track(paths[0], min_hits_s=1.0)
    assert mcaptrack.run(paths[1], tables=False).is_up_to_date  # who doesn't ask for it keeps what there is
    renewed = mcaptrack.run(paths[1], follows=str(paths[0]), tables=False)
    assert renewed.stages[:2] == ("track", "sample")
    assert "/camera/tracks goes on from another log: running track again" in renewed.notes
    assert renewed.continued.kept["/camera/retracks"] == renewed.continued.at_cut["/camera/retracks"] > 2
    alone = mcaptrack.run(paths[1], force=True, tables=False)
    said = [notice.message for notice in alone.warnings if notice.code == "other-settings"]
    assert [one.partition(" ")[0] for one in said] == ["/camera/tracks", "/camera/retracks"]
    assert provenance_of(paths[1], "/camera/tracks").continued == {}


@thorough
def test_the_command_line_takes_logs_in_their_order(parts, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for old in parts[:2]:
        Path(old.name).write_bytes(old.read_bytes())
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"0.mcap\n1.mcap\n")))  # it can be read once
    out = json.loads(done("run", "-", "--continue", "--no-tables", "--no-events", "--json").out)
    assert "continued" not in out["results"][0]
    assert out["results"][1]["continued"] == {"log": "0.mcap", "gap_s": pytest.approx(0.1), "at_cut": {}, "kept": {}}
    for words, said in (
        (("0.mcap",), "--continue needs several logs, in the order of their times"),
        (("0.mcap", "1.mcap", "--jobs", 2), "--continue doesn't go with --jobs: one log is done after the other"),
        (
            ("0.mcap", "1.mcap", "--ledger", "x.jsonl"),
            "--continue doesn't go with --ledger: it judges each log by itself",
        ),
        (("0.mcap", "1.mcap", "-o", "x"), "--continue doesn't go with --output"),
    ):
        code, _, err = call("run", *words, "--continue")
        assert code == 1
        assert said in err


def test_logs_that_do_not_follow_one_another_are_refused_in_a_line(parts, tmp_path):
    first, second, third = parts
    for before, after, said in (
        (second, first, r"0.mcap begins at 0.000 s, and .*1.mcap, which is to be the one before, at 8.000 s: name"),
        (part(tmp_path / "late.mcap", 0, 80, 3.0), second, r"has no tracks that ids could go on from; `mcaptrack.run"),
        (first, first, "can't follow itself"),
    ):
        with pytest.raises(McaptrackError, match=said):
            mcaptrack.run(after, follows=before)
    mcaptrack.run(tmp_path / "late.mcap", tables=False)
    with pytest.raises(McaptrackError, match=r"late.mcap ends at 10.900 s: they overlap by 2.900 s"):
        mcaptrack.run(second, follows=tmp_path / "late.mcap")
    same = part(tmp_path / "same.mcap", 80, 147, 0.0)
    with pytest.raises(McaptrackError, match=r"if the times are wrong, ingest each with its `start_time=`"):
        mcaptrack.run(same, follows=first)
    other = part(tmp_path / "other.mcap", 80, 147, camera="left")
    with pytest.raises(McaptrackError, match=r"other.mcap is of the camera left, and .*0.mcap is of camera; ids go on"):
        mcaptrack.run(other, follows=first)
    with pytest.raises(McaptrackError, match=r"is not one of the logs of `follows=`"):
        mcaptrack.run(third, follows=[first, second])
    tracks = tmp_path / "tracks.txt"
    tracks.write_text("1,1,10,10,24,60,1,-1,-1,-1\n2,1,12,10,24,60,1,-1,-1,-1\n")
    mcaptrack.ingest(tracks, tmp_path / "own.mcap", role="tracks", fps=FPS, start_time=8.0)
    with pytest.raises(McaptrackError, match=r"has no pictures and no detections of camera|wasn't made by `track`"):
        mcaptrack.run(tmp_path / "own.mcap", follows=first)


def test_over_a_missing_recording_no_id_is_taken_over_and_none_is_used_twice(parts, tmp_path):
    third = part(tmp_path / "third.mcap", CUTS[2], FRAMES, 40.0)
    found = mcaptrack.run(third, follows=parts[0], tables=False)
    (said,) = [notice.message for notice in found.warnings if "in between were missing" in notice.message]
    assert "begins 32.1 s after the end of" in said
    for name in CHANNELS:
        with log.read(parts[0]) as before, log.read(third) as after:
            largest = max(before.rows(f"/camera/{one}", TRACKS).rows["track_id"].max() for one in CHANNELS[1:])
            ids = after.rows(f"/camera/{name}", TRACKS).rows["track_id"]
            known = before.rows(f"/camera/{name}", TRACKS).rows["track_id"].max()
        assert ids.min() > (known if name == "tracks" else largest)


@pytest.fixture
def several(tmp_path) -> list[Path]:
    return write_parts(tmp_path)


@thorough
def test_a_camera_that_the_log_before_lacks_begins_and_others_go_on(several):
    mcaptrack.drop(several[0], ["/south/detections", "/south/ground_plane"])
    with collected():
        mcaptrack.run(several[0], follows=several, tables=False, predictor="cv", events=False)
        result = mcaptrack.run(several[1], follows=several, tables=False, predictor="cv", events=False)
    assert result.continued is not None
    assert {topic.split("/")[1] for topic in result.continued.kept} - {"world"} == {"east", "north"}
    (line,) = (one.message for one in result.warnings if "its ids begin" in one.message)
    assert line == f"{several[0]} has no camera south: its ids begin with {several[1]}"


def rows_at(places: dict[int, tuple[float, float]], high: float = 100.0, metres: tuple[float, float] | None = None):
    """Tracks with boxes around these middles, or without boxes at these places in metres."""
    x, y = np.array(list(places.values()), float).reshape(-1, 2).T
    count = len(places)
    boxes = {} if metres else {"x_px": x - 20, "y_px": y - high / 2, "w_px": [40.0] * count, "h_px": [high] * count}
    return TRACKS.rows(
        track_id=list(places), observed=[True] * count, source_id=[-1] * count, **boxes,
        x_m=x * metres[0] if metres else [9.0] * count, y_m=y * metres[1] if metres else [8.0] * count,
    )  # fmt: skip


def test_a_lead_is_brought_to_other_planes():
    one, two = (GroundPlane((scale, 0, 0, 0, scale, 0, 0, 0, 1), 640, 480) for scale in (0.1, 0.2))
    assert following._differ([(0, one)], [(5, two)])
    assert not following._differ([(0, one)], [(5, one)])
    assert following._differ(None, [(5, one)])
    rows = np.concatenate([rows_at({1: (100, 100)}), rows_at({2: (7, 7)}, metres=(1.0, 1.0))])
    lead = Frame(9, 4, rows)
    moved = following._in_planes(lead, [(0, one), (9, two)])
    assert moved["x_m"].tolist() == [20.0, 7.0]
    assert moved["y_m"].tolist() == [30.0, 7.0]  # the foot, at 150 px
    assert rows["x_m"].tolist() == [9.0, 7.0]
    assert following._in_planes(lead, []) is rows
    alone = Frame(9, 4, rows[1:])
    assert following._in_planes(alone, [(0, one)]) is alone.rows
