"""Published motions of cameras: read, placed at pictures, refused in one line where they are none, and used."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mcaptrack import log
from mcaptrack.geometry.camera_path import Verdict
from mcaptrack.schema import CAMERA_MOTION, DETECTIONS, TRACKS, Frame
from mcaptrack.schema.as_rows import frames_to_path
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.ingest.job import motion_frames, read_motions
from tests.commands import call, done
from tests.logs import add_rows, provenance_of
from tests.worlds import boxes_at, ns, write_clip

STEP = -40.0


def labels(path: Path, frames: int = 40) -> None:
    """Two people who stand, before a camera that pans by 40 px in every fourth frame."""
    rows = []
    for frame in range(frames):
        pan = STEP * (frame // 4)
        rows += [f"{frame + 1},-1,{x + pan},100,20,60,1,-1,-1,-1" for x in (500, 900)]
    path.write_text("\n".join(rows) + "\n")


def motions(path: Path, frames: int = 40, separator: str = "\t") -> None:
    rows = [[n, 1.0, 0.0, STEP if n % 4 == 0 and n else 0.0, 0.0, 1.0, 0.0] for n in range(frames)]
    path.write_text("\n".join(separator.join(map(str, row)) for row in rows) + "\n")


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    labels(tmp_path / "det.txt")
    motions(tmp_path / "motion.txt")
    return tmp_path


def tracks(path: str) -> int:
    with log.read(Path(path)) as opened:
        return len(np.unique(opened.rows("/camera/tracks", TRACKS).rows["track_id"]))


def test_tracks_follow_the_motion_that_was_ingested_beside_boxes(folder):
    done("ingest", "det.txt", "--fps", 10, "--motion", "motion.txt", "-o", "a.mcap", "-q")
    with log.read(Path("a.mcap")) as opened:
        frames = opened.frames("/camera/motion", CAMERA_MOTION)
        made = Provenance.from_metadata(opened.channel("/camera/motion").metadata)
        times = opened.times("/camera/detections").tolist()
    assert [frame.t_ns for frame in frames] == times
    assert [float(frame.rows["m02_px"][0]) for frame in frames[:6]] == [0, 0, 0, 0, STEP, 0]
    assert all(np.isnan(frame.rows["inliers"][0]) for frame in frames)
    assert frames_to_path(frames).verdict is Verdict.MOVING
    assert (made.transform, made.parameters) == ("ingest", {"file": "motion.txt"})
    said = json.loads(done("run", "a.mcap", "--no-tables", "--json", "-q").out)["results"][0]
    assert said["summary"]["camera_motion"] == "moving"
    assert "motion" not in said["stages"]
    assert tracks("a.mcap") == 2
    how = provenance_of("a.mcap", "/camera/tracks")
    assert how.references == {"/camera/motion": made.digest}
    assert "camera_path" not in how.parameters
    done("run", "a.mcap", "--camera-motion", "off", "--no-tables", "-q")
    assert tracks("a.mcap") > 4
    assert json.loads(done("run", "a.mcap", "--no-tables", "--json", "-q").out)["results"][0]["stages"] == []


def test_motion_that_is_added_later_makes_tracks_out_of_date(folder):
    done("ingest", "det.txt", "--fps", 10, "-o", "a.mcap", "-q")
    done("run", "a.mcap", "--no-tables", "-q")
    assert tracks("a.mcap") > 4
    done("ingest", "motion.txt", "--as", "motion", "--into", "a.mcap", "-q")
    assert "track" in json.loads(done("run", "a.mcap", "--no-tables", "--json", "-q").out)["results"][0]["stages"]
    assert tracks("a.mcap") == 2
    outcome = call("ingest", "motion.txt", "--as", "motion", "--into", "a.mcap")
    assert (outcome.code, "already; --force replaces them" in outcome.err) == (1, True), outcome.err


def test_motion_belongs_to_pictures_and_no_stage_replaces_it(folder):
    write_clip(folder / "clip.mp4", 12)
    motions(folder / "motion.txt", 12, ",")
    done("ingest", "clip.mp4", "--motion", "motion.txt", "-o", "a.mcap", "-q")
    with log.read(Path("a.mcap")) as opened:
        assert opened.times("/camera/motion").tolist() == opened.times("/camera/video").tolist()
    done("ingest", "clip.mp4", "-o", "b.mcap", "-q")
    (folder / "few.txt").write_text("1,-1,5,5,10,20,1,-1,-1,-1\n")
    done("ingest", "few.txt", "--as", "detections", "--into", "b.mcap", "--motion", "motion.txt", "-q")
    for path in ("a.mcap", "b.mcap"):
        with log.read(Path(path)) as opened:
            rows = opened.rows("/camera/motion", CAMERA_MOTION).rows
        assert {(row["width_px"], row["height_px"]) for row in rows} == {(64, 48)}
    outcome = call("motion", "a.mcap")
    assert (outcome.code, "was ingested" in outcome.err) == (1, True), outcome.err
    done("motion", "a.mcap", "--to", "/camera/estimated", "-q")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "motion.txt holds no camera motion"),
        ("0 1 0 0 0 1\n", "motion.txt:1: not a camera motion (frame,m00,m01,m02,m10,m11,m12: 7 columns), 6 columns:"),
        ("0 1 0 0 0 1 x\n", "not all are numbers"),
        ("0 1 0 0 0 1 0\n2 1 0 0 0 1 0\n", "motion.txt:2: frame 2 is not 1: frames count from 0, without gaps"),
        ("1 1 0 0 0 1 0\n", "motion.txt:1: frame 1 is not 0: frames count from 0"),
        ("0 1 0 0 1 0 0\n", "motion.txt:1: the motion is not finite, or can't be inverted"),
        (
            "0 1 0 0 0 1 0\n1 0 -5 0 5 0 0\n",
            "motion.txt:2: the motion enlarges the picture 5 times; no camera does that",
        ),
        ("0 0.2 0 0 0 0.2 0\n", "motion.txt:1: the motion enlarges the picture 0.2 times"),
        ("0 1 0 nan 0 1 0\n", "motion.txt:1: the motion is not finite, or can't be inverted"),
    ],
)
def test_what_is_no_motion_is_refused_in_one_line(folder, text, words):
    (folder / "motion.txt").write_text(text)
    outcome = call("ingest", "det.txt", "--fps", 10, "--motion", "motion.txt", "-o", "a.mcap")
    assert (outcome.code, len(outcome.err.splitlines()), Path("a.mcap").exists()) == (1, 1, False), outcome.err
    assert words in outcome.err


def test_motion_alone_needs_a_log(folder):
    outcome = call("ingest", "motion.txt", "--as", "motion")
    assert outcome.code == 1
    assert "belongs to a log with its pictures or boxes; name it with --into" in outcome.err


def test_other_numbers_of_frames_are_said(folder):
    for count, words in ((30, "it is taken as none in the rest"), (50, "the rest is left out")):
        motions(folder / "motion.txt", count)
        said = done("ingest", "det.txt", "--fps", 10, "--motion", "motion.txt", "-o", f"{count}.mcap").err
        assert f"motion.txt has the motion of {count} frames, and " in said
        assert words in said
        with log.read(Path(f"{count}.mcap")) as opened:
            verdicts = opened.rows("/camera/motion", CAMERA_MOTION).rows["verdict"]
        assert (verdicts == Verdict.LOST).sum() == max(40 - count, 0)


def test_the_motion_of_missing_pictures_is_not_lost(tmp_path):
    motions(tmp_path / "motion.txt", 12)
    index = np.array([0, 1, 5, 9, 10])  # pictures 4 and 8 can't be read
    frames = motion_frames(read_motions(tmp_path / "motion.txt"), index, index * 10, (640, 480))
    assert [float(frame.rows["m02_px"][0]) for frame in frames] == [0, 0, STEP, STEP, 0]
    assert [frame.index for frame in frames] == index.tolist()


def test_damaged_motion_is_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    broken = CAMERA_MOTION.empty(1)
    with log.create(Path("a.mcap")) as writer:
        seen = [Frame(ns(n / 10), n, boxes_at([(50, 50)])) for n in range(20)]
        add_rows(writer, "/camera/detections", DETECTIONS, seen, "ingest", "")
        add_rows(writer, "/camera/motion", CAMERA_MOTION, [frame._replace(rows=broken) for frame in seen], "ingest", "")
    outcome = call("track", "a.mcap")
    assert (outcome.code, len(outcome.err.splitlines())) == (1, 1), outcome.err
    assert "/camera/motion: a camera motion is 6 finite numbers, 2 rows of 3, that can be inverted" in outcome.err
