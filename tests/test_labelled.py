"""Which frames were labelled: what a source states, what a user says, what is assumed; others count in no score."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.api import labels
from mcaptrack.api.declared import hints_of
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.forecasts import score_forecasts
from mcaptrack.schema import TRACKS
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.ingest.labels.frames import FrameRanges, Frames, parse_first_frames
from mcaptrack.transforms import Predict
from tests.tiers import one_in
from tests.worlds import walk, write_clip

PICTURES, FPS, PEOPLE = 60, 10, 2
SIZE = (640, 360)
Box = tuple[float, float, float, float]


def place(k: int, who: int) -> Box:
    """The box of a person in picture ``k``: who moves so far that the box of the next picture doesn't overlap."""
    return 30.0 * (k % 20), 100.0 * who, 20.0, 50.0


def rows(frames: Iterable[int]) -> list[tuple[int, int, Box]]:
    return [(k, who, place(k, who)) for k in frames for who in range(PEOPLE)]


def mot(path: Path, frames: Iterable[int], first: int = 1) -> Path:
    path.write_text("".join(f"{k + first},{who + 1},{','.join(map(str, box))},1\n" for k, who, box in rows(frames)))
    return path


def csv(path: Path, frames: Iterable[int]) -> Path:
    path.write_text(
        "frame,id,x,y,w,h\n" + "".join(f"{k},{who},{','.join(map(str, box))}\n" for k, who, box in rows(frames))
    )
    return path


def timed(path: Path, frames: Iterable[int], off_s: float = 0.0) -> Path:
    lines = (f"{k / FPS + off_s},{who},{','.join(map(str, box))}\n" for k, who, box in rows(frames))
    path.write_text("t,id,x,y,w,h\n" + "".join(lines))
    return path


def sdd(path: Path, frames: Iterable[int]) -> Path:
    lines = (f'{who} {x} {y} {x + w} {y + h} {k} 0 0 0 "Pedestrian"\n' for k, who, (x, y, w, h) in rows(frames))
    path.write_text("".join(lines))
    return path


class Way:
    """Ground truth of some of the pictures, by its file: ``labelled`` are all that it describes, ``by`` says how it is
    known which these are, None if they are all.
    """

    def __init__(self, make: Callable[[Path], Path], labelled: Iterable[int], by: str | None, **options: Any) -> None:
        self.make, self.labelled, self.by, self.options = make, [*labelled], by, options


PART, THIRD, TWELFTH = range(20, 30), range(20, 51, 3), range(0, PICTURES, 12)
WAYS = {
    "mot": Way(lambda p: mot(p / "t.txt", PART), PART, "labels"),
    "mot from 0": Way(lambda p: mot(p / "t.txt", [0, 3], 0), range(4), "labels", first_frame="truth=0,tracks=1"),
    "sdd": Way(lambda p: sdd(p / "t.txt", PART), PART, "labels"),
    "csv": Way(lambda p: csv(p / "t.csv", PART), PART, "labels", first_frame={"truth": 0}),
    "one frame": Way(lambda p: mot(p / "t.txt", [7]), [7], "labels"),
    "with gaps": Way(lambda p: mot(p / "t.txt", [20, 21, 24, 29]), PART, "labels"),
    "every third of a part": Way(lambda p: mot(p / "t.txt", THIRD), THIRD, "labels"),
    "every twelfth": Way(lambda p: mot(p / "t.txt", TWELFTH), TWELFTH, None),
    "all": Way(lambda p: mot(p / "t.txt", range(PICTURES)), range(PICTURES), None),
    "nine tenths": Way(lambda p: mot(p / "t.txt", range(3, 57)), range(PICTURES), None),
    "a range": Way(lambda p: mot(p / "t.txt", [22, 25]), PART, "frames", frames="21:31"),
    "two ranges": Way(lambda p: mot(p / "t.txt", [5, 6, 22]), [5, 6, *PART], "frames", frames="6:8, 21:31"),
    "all by a range": Way(lambda p: mot(p / "t.txt", PART), range(PICTURES), "frames", frames=":"),
}  # fmt: skip


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("clip") / "clip.mp4"
    write_clip(path, PICTURES, fps=FPS, size=SIZE, options={"g": "60"})
    return path


def scored(scores: mcaptrack.Scores) -> dict[str, Any]:
    (row,) = (row for row in scores.rows() if row["similarity"] == "iou")
    return {name: value for name, value in row.items() if name not in ("sequence", "tracks", "mode", "class")}


@pytest.mark.parametrize("way", one_in(2, WAYS.values()), ids=WAYS)
def test_a_file_and_the_log_that_it_is_ingested_into_give_the_same_scores(tmp_path, clip, way, recwarn):
    assert_same_scores(tmp_path, clip, way)


def assert_same_scores(tmp_path: Path, clip: Path, way: Way) -> None:
    """Tracks of every picture: right in all that were labelled but one, with a ghost that is there all the time."""
    truth, path = way.make(tmp_path), tmp_path / "log.mcap"
    wrong = way.labelled[len(way.labelled) // 2]
    found = [(k, who, place(k, who)) for k in range(PICTURES) for who in range(PEOPLE) if (k, who) != (wrong, 0)]
    found += [(k, 9, (300.0, 250.0, 20.0, 50.0)) for k in range(PICTURES)]
    lines = (f"{k + 1},{who + 1},{','.join(map(str, box))},1,-1,-1,-1\n" for k, who, box in found)
    (tmp_path / "tracks.txt").write_text("".join(lines))
    result = mcaptrack.ingest(clip, path, tracks=tmp_path / "tracks.txt", truth=truth, **way.options)
    with log.read(path) as opened:
        frames = opened.frames("/camera/truth", TRACKS)
        how = Provenance.from_metadata(opened.channel("/camera/truth").metadata)
    assert [frame.index for frame in frames] == way.labelled
    of_log = mcaptrack.evaluate(path)
    size = {"size": SIZE} if truth.is_dir() else {}
    of_files = mcaptrack.evaluate(tmp_path / "tracks.txt", truth=truth, **way.options, **size)
    row = scored(of_log)
    people = sum(len(frame.rows) for frame in frames)
    missed = any(len(frame.rows) for frame in frames if frame.index == wrong)
    assert row["FN"] == missed
    assert row["FP"] == len([k for k, _, _ in found if k in way.labelled]) - (people - missed)
    assert scored(of_files) == row
    for warnings in (result.warnings, of_log.warnings, of_files.warnings):
        assert ("labelled" in [notice.code for notice in warnings]) == (way.by == "labels")
    assert how is not None
    assert of_log.labelled["log"] == of_files.labelled["tracks"] == (how.parameters.get("frames"), way.by)
    assert (how.parameters.get("frames") is None) == (way.by is None)


def codes(warnings: Iterable[mcaptrack.Notice]) -> list[str]:
    return [notice.code for notice in warnings]


def evaluated(tracks: Path, truth: Path, **options: Any) -> tuple[float, list[str]]:
    scores = mcaptrack.evaluate(tracks, truth=truth, similarity="iou", **options)
    return scores.score("MOTA"), codes(scores.warnings)


#: Frames of ground truth and of tracks as their files number them; whether a difference is one of numbering; what is
#: said. Tracks are right where the numbers are understood.
NUMBERED = {
    "a tracker that saw nothing in frame 0": (range(10), range(1, 10), 0, ["clock"]),
    "a tracker that saw nothing in the first frames": (range(10), range(3, 10), 0, ["clock"]),
    "ground truth of a part, a tracker from 0 on": (range(100, 110), range(200), 0, ["clock", "labelled"]),
    "both count from 0": (range(10), range(10), 0, []),
    "both count from 1": (range(1, 11), range(1, 11), 0, []),
    "a tracker from 0 on": (range(1, 11), range(10), 1, ["clock"]),
    "a tracker from 0 on that stops early": (range(1, 11), range(8), 1, ["clock"]),
    "a tracker from 1 on": (range(10), range(1, 11), -1, ["clock"]),
}


@pytest.mark.parametrize(("truth", "found", "shift", "said"), NUMBERED.values(), ids=NUMBERED)
@pytest.mark.parametrize("write", [lambda p, f: mot(p, f, 0), csv])
def test_the_numbers_of_a_file_follow_those_of_the_file_beside_it(tmp_path, truth, found, shift, said, write, recwarn):
    gt = write(tmp_path / "gt", truth)
    frames = [(k, who, place(k + shift, who)) for k in found for who in range(PEOPLE)]
    if write is csv:
        text = "frame,id,x,y,w,h\n" + "".join(f"{k},{who},{','.join(map(str, b))}\n" for k, who, b in frames)
    else:
        text = "".join(f"{k},{who + 1},{','.join(map(str, b))},1\n" for k, who, b in frames)
    (tmp_path / "tr").write_text(text)
    mota, warned = evaluated(tmp_path / "tr", gt)
    seen = {k + shift for k in found} & {*truth}
    assert mota == pytest.approx(len(seen) / len(truth))
    assert {*said} <= {*warned} <= {*said, *(["clock"] if write is csv else [])}  # 1 is an assumption in tables


def test_first_frame_is_of_all_files_or_of_each_kind(tmp_path):
    gt, tr = mot(tmp_path / "gt.txt", range(10), 0), mot(tmp_path / "tr.txt", range(2, 10), 1)
    assert evaluated(tr, gt, first_frame={"truth": 0, "tracks": 1}) == (0.8, ["clock"])
    assert evaluated(tr, gt, first_frame="truth=0, tracks=1")[0] == 0.8
    assert evaluated(tr, gt, first_frame=0)[0] < 0
    with pytest.raises(McaptrackError, match=r"gt.txt: its first frame is 0, before `first_frame=2`"):
        evaluated(tr, gt, first_frame=2)
    assert parse_first_frames(3) == parse_first_frames("3") == 3
    for wrong in (-1, "a", "truth=", "cars=1", "truth=-1", 1.5, "", {"truth": "x"}):
        with pytest.raises(McaptrackError, match="`first_frame=` is a whole number from 0 to"):
            parse_first_frames(wrong)  # type: ignore[arg-type]


def test_tracks_that_are_added_to_a_log_count_as_its_labels_do(tmp_path, clip):
    path = tmp_path / "log.mcap"
    mcaptrack.ingest(clip, path, truth=mot(tmp_path / "gt.txt", range(50), 0))
    result = mcaptrack.ingest(mot(tmp_path / "tr.txt", range(3, 50), 0), into=path, role="tracks")
    assert codes(result.warnings) == ["clock"]
    assert "as those of /camera/truth" in result.warnings[0].message
    assert mcaptrack.evaluate(path, similarity="iou").score("MOTA") == pytest.approx(47 / 50)


def test_ranges_of_frames_are_slices():
    assert Frames.parse(None) == (None, None)
    assert Frames.parse(302) == Frames.parse("302") == (302, None)
    number = np.arange(12)
    for text in ("2:5", ":3", "7:", ":", "0:2,4:6,9:"):
        held = np.zeros(len(number), bool)
        for part in text.split(","):
            held[slice(*(int(end) if end else None for end in part.split(":")))] = True
        ranges = Frames.parse(text).ranges
        assert ranges is not None
        assert ranges.hold(number).tolist() == held.tolist()
        assert str(ranges) == text
    for wrong in (
        0,
        -5,
        "",
        "5:5",
        "9:3",
        "1:2:3",
        "1-2",
        "a:b",
        ",",
        "1:2,",
        "5,1:2",
        "\u0663:\u0665",
        True,
        2.5,
        "9" * 30,
    ):
        with pytest.raises(McaptrackError, match="`frames=` is a number of frames from 1 to"):
            Frames.parse(wrong)  # type: ignore[arg-type]
    assert FrameRanges(((None, None),)).hold(number).all()


def test_frames_that_hold_no_label_are_refused(tmp_path, clip):
    gt, tr = mot(tmp_path / "gt.txt", PART), mot(tmp_path / "tr.txt", range(PICTURES))
    words = "none of the frames 40: is labelled; it has labels of frames 21 to 30"
    for call in (lambda: evaluated(tr, gt, frames="40:"), lambda: mcaptrack.ingest(clip, truth=gt, frames="40:")):
        with pytest.raises(McaptrackError, match=words):
            call()
    assert evaluated(tr, gt, frames="25:31") == (1.0, ["left-out"])


def test_tracks_outside_of_what_was_labelled_count_in_no_way(tmp_path):
    gt, tr = mot(tmp_path / "gt.txt", PART), mot(tmp_path / "tr.txt", [*range(3, 6), *range(50, 60)])
    mota, warned = evaluated(tr, gt)
    assert (mota, warned) == (0.0, ["labelled"])  # all are missed, and none is false


def test_times_that_are_not_those_of_pictures_are_said(tmp_path, clip):
    for off_s, said in ((0.0, []), (0.0005, []), (0.03, ["clock"])):
        path = tmp_path / f"{off_s}.mcap"
        result = mcaptrack.ingest(clip, path, truth=timed(tmp_path / "gt.csv", range(58), off_s))
        assert codes(result.warnings) == said
        assert all("up to 30 ms from those of the pictures" in str(notice) for notice in result.warnings)


def test_times_of_a_part_and_of_every_third_picture(tmp_path, clip):
    for frames in (PART, THIRD):
        path = tmp_path / f"{frames.step}.mcap"
        result = mcaptrack.ingest(clip, path, truth=timed(tmp_path / "gt.csv", frames))
        with log.read(path) as opened:
            assert [frame.index for frame in opened.frames("/camera/truth", TRACKS)] == [*frames]
        assert codes(result.warnings) == ["labelled"]


def test_options_of_label_files_are_the_same_in_every_command():
    names = ("ingest", "evaluate", "tune", "train")
    commands = [getattr(mcaptrack, name) for name in names if name in mcaptrack.__all__]
    of_all, of_two = ("label_format", "classes"), ("columns", "class_map", "first_frame", "frames", "size")
    for name, some in (*((name, commands) for name in of_all), *((name, commands[:2]) for name in of_two)):
        assert len({repr(hints_of(command)[name]) for command in some}) == 1, name
    for command in commands[1:]:
        assert hints_of(command)["fps"] == labels.LabelFps


def test_tables_say_which_frames_were_labelled(tmp_path, clip):
    path = tmp_path / "log.mcap"
    mcaptrack.ingest(clip, path, truth=mot(tmp_path / "gt.txt", PART), tracks=mot(tmp_path / "tr.txt", range(PICTURES)))
    with mcaptrack.open(path) as opened:
        (row,) = opened.table("recordings").to_pylist()
    assert (
        json.loads(row["source"])["/camera/truth"] | {"frames": "21:31", "frames_by": "labels"}
        == json.loads(row["source"])["/camera/truth"]
    )
    assert [warning["code"] for warning in json.loads(row["warning_texts"])] == ["labelled"]


def test_forecasts_with_a_past_that_was_not_labelled_are_not_judged():
    """Right tracks of two walkers, and of a third that is nobody: of the labelled steps 10 to 19 with a whole past."""
    walks = walk(lambda k: {1: (0.5 * k, 0.0), 2: (4.0, 0.5 * k), 3: (80.0, 80.0)}, 30)
    people = [frame._replace(rows=frame.rows[:2]) for frame in walks]
    forecasts = [frame for (frame,) in Predict(predictor="cv")(walks)]
    whole, part = (score_forecasts(forecasts, walks, truth, "x") for truth in (people, people[10:20]))
    assert whole is not None
    assert part is not None
    assert (part.frames, part.false_forecasts) == (7, 7)  # the third one, at the steps 13 to 19
    assert whole.false_forecasts >= 27
    assert part.people == 0 or part.people < whole.people


def test_tables_with_times_take_no_frames(tmp_path):
    (tmp_path / "t.csv").write_text("t,id,x_m,y_m,length_m\n0.1,1,2,3,1\n0.2,1,2,3,1\n")
    with pytest.raises(McaptrackError, match=r"has times, which say what it describes; leave `frames=` out"):
        mcaptrack.ingest(tmp_path / "t.csv", tmp_path / "x.mcap", role="truth", frames="1:")


@pytest.mark.parametrize("told", ["2=person,7=car", {"2": "person", "7": "car"}])
def test_a_class_map_names_classes_in_every_command(tmp_path, told):
    lines = (f"{k},{n},{30 * k},2,20,40,{n}" for k in range(10) for n in (2, 7))
    table = tmp_path / "table.csv"
    table.write_text("\n".join(["frame,id,x,y,w,h,class", *lines]) + "\n")
    result = mcaptrack.ingest(table, tmp_path / "log.mcap", role="truth", fps=FPS, classes="all", class_map=told)
    with log.read(tmp_path / "log.mcap") as opened:
        assert class_names(opened.channel("/camera/truth").metadata) == {1: "person", 7: "car"}
    assert not result.warnings
    scores = mcaptrack.evaluate(table, truth=table, classes="all", class_map=told)
    assert {row["class"] for row in scores.rows()} == {None, "person", "car"}
    other = mcaptrack.evaluate(table, truth=table, classes="all", class_map={"x": "y"})
    assert "option-not-used" in codes(other.warnings)
