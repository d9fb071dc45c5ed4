"""What a job of `ingest` says and decides before it writes: topics, names, sizes, parameters."""

from __future__ import annotations

from pathlib import Path

import pytest

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.sources.ingest.job import IngestJob, IngestOptions
from mcaptrack.sources.ingest.labels.roles import WantedClasses
from mcaptrack.sources.ingest.labels.timeline import boxes_extent
from tests.logs import add_rows
from tests.worlds import boxes_at, tracks_at

MOT = "".join(
    f"{frame},{who},{10 * who},20,9,30,1,{kind},1\n" for frame in (1, 7, 13) for who, kind in ((1, 1), (2, 3))
)
ZERO = "".join(f"{frame},3,10,20,9,30,1,1,1\n" for frame in (0, 1, 2))


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name, text in (("gt.txt", MOT), ("zero.txt", ZERO)):
        Path(name).write_text(text)
    Path("motion.txt").write_text("".join(f"{n},1,0,{n},0,1,0\n" for n in range(3)))
    return tmp_path


def job(*, source: str = "a.mp4", **options) -> IngestJob:
    labels = {role: Path(name) for role, name in options.pop("labels", {}).items()}
    return IngestJob(Path(source), IngestOptions(labels=labels, **options))


def test_what_is_assumed_and_left_out_is_said(place):
    made = job(labels={"truth": "gt.txt", "tracks": "zero.txt"})
    with collected() as warnings:
        made.report_assumptions()
    assert [one.message for one in warnings] == [
        "frame 1 of gt.txt and frame 0 of zero.txt are assumed to be the same picture; `first_frame=` sets the number",
        "gt.txt also holds 3 car; left out of truth",
    ]
    assert "gt.txt has labels every 6 frames, from 1 on; the frames in between are left out" in made.report.remarks
    assert not any("zero.txt" in one for one in made.report.remarks)
    every = job(labels={"truth": "gt.txt"}, classes=WantedClasses("all"))
    with collected() as warnings:
        every.report_assumptions()
    assert [one.message for one in warnings] == []
    assert any("gt.txt has several classes; class_id is" in one for one in every.report.remarks)


def test_parameters_of_labels(place):
    one = job(labels={"truth": "gt.txt"})
    labels = one.labels["truth"]
    assert one.label_parameters("truth", labels) == {}
    other = job(labels={"truth": "gt.txt"}, first_frame=1, classes=WantedClasses("all"), size=(640, 480))
    assert other.label_parameters("truth", labels) == {
        "first_frame": 1, "classes": "all", "size": "640x480",
    }  # fmt: skip
    assert other.label_parameters("detections", labels) == {"first_frame": 1, "size": "640x480"}
    Path("a.csv").write_text("frame,id,x,y,w,h\n1,1,1,2,3,4\n2,1,1,2,3,4\n3,1,1,2,3,4\n")
    table = job(
        labels={"tracks": "a.csv"}, size=(640, 480), columns={"x": "x", "y": "y"}, classes=WantedClasses("person")
    )
    found = table.label_parameters("tracks", table.labels["tracks"])
    assert (found["columns"], found.get("size", "640x480")) == ("x=x,y=y", "640x480")
    assert "classes" not in found


def test_boxes_in_shares_of_the_picture_need_its_size(place):
    Path("shares.csv").write_text("frame,cx,cy,w,h,score\n0,0.5,0.5,0.25,0.5,0.9\n1,0.5,0.5,0.25,0.5,0.9\n")
    made = job(labels={"detections": "shares.csv"}, size=(640, 480))
    made.fit_to_pictures(lambda: (640, 480))
    assert made.labels["detections"].boxes_px[0].tolist() == [240, 120, 160, 240]
    again = job(labels={"detections": "shares.csv"}, size=(100, 200))
    again.fit_to_pictures(None)
    assert again.labels["detections"].boxes_px[0].tolist() == [37.5, 50, 25, 100]
    with pytest.raises(McaptrackError, match=r"a.mp4: the pictures are 640x480, not 100x200; leave `size=` out"):
        job(labels={"detections": "shares.csv"}, size=(100, 200)).fit_to_pictures(lambda: (640, 480))
    with pytest.raises(McaptrackError, match=r"has boxes in shares of the picture's size; give it with `size="):
        job(labels={"detections": "shares.csv"}).fit_to_pictures(None)
    small = job(labels={"truth": "gt.txt"})
    small.fit_to_pictures(lambda: (8, 8))
    assert [code for _, code in small.labels["truth"].doubts] == ["outside"]


def test_pictures_are_as_large_as_what_their_boxes_reach(place):
    with log.create(place / "a.mcap") as writer:
        boxes = [boxes_at([(30, 40)], (20.5, 10)), boxes_at([(5, 90), (7, 3)], (2, 4.2))]
        add_rows(writer, "/a/detections", DETECTIONS, [Frame(n, n, rows) for n, rows in enumerate(boxes)])
        add_rows(writer, "/b/detections", DETECTIONS, [Frame(0, 0, boxes_at([(-50, -60)]))])
        add_rows(writer, "/c/detections", DETECTIONS, [])
        add_rows(writer, "/d/tracks", TRACKS, [Frame(0, 0, tracks_at({1: (2, 3)}))])
    with log.read(place / "a.mcap") as opened:
        found = [
            boxes_extent(opened, f"/{name}")
            for name in ("a/detections", "b/detections", "c/detections", "d/tracks", "e")
        ]
    assert found == [(41, 93), (1, 1), (0, 0), (0, 0), (0, 0)]


# Other places where an input is taken, paired or refused
