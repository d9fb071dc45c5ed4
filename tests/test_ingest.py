"""Logs made of whatever exists, and what a job of `ingest` decides and says before it writes."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import CLOCK
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.sources.ingest.job import IngestJob
from mcaptrack.sources.ingest.labels.reading import read_labels
from mcaptrack.sources.ingest.labels.roles import WantedClasses
from mcaptrack.sources.ingest.labels.timeline import boxes_extent
from tests.logs import add_rows
from tests.worlds import boxes_at, ids, ns, tracks_at, write_clip

MOT15 = "1,3,10,20,4,8,1,-1,-1,-1\n2,3,11,20,4,8,0.5,-1,-1,-1\n1,5,50,60,4,8,1,-1,-1,-1\n"
TRAJNET = "0 7 1.5 2.5\n12 7 1.6 2.5\n12 9 3.0 4.0\n24 7 1.7 2.5\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_what_is_no_text_is_said(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"\xff\xfe\x00\x00" * 10)
    with pytest.raises(McaptrackError, match="is not text in UTF-8"):
        read_labels(tmp_path / "a.txt")
    with pytest.raises(McaptrackError, match=r"none\.txt does not exist"):
        read_labels(tmp_path / "none.txt")


@pytest.fixture
def clip(tmp_path) -> Path:
    write_clip(tmp_path / "clip.mp4", options={"bf": "0", "g": "10"})
    return tmp_path / "clip.mp4"


class TestIngest:
    def test_label_files_of_one_log_share_a_clock(self, tmp_path):
        """Boxes at every frame that begin at frame 8, truth at every twelfth: frame 1 of these is frame 0 of those."""
        found = write(tmp_path / "det.txt", "".join(f"{n},-1,10,20,4,8,1,-1,-1,-1\n" for n in range(8, 30)))
        truth = write(tmp_path / "gt.txt", TRAJNET)
        out = tmp_path / "a.mcap"
        ingest(found, out, IngestOptions(fps=Fraction(30), labels={"truth": truth}))
        with log.read(out) as opened:
            frames = opened.frames("/camera/detections", DETECTIONS)
            assert [(f.t_ns, len(f.rows)) for f in frames] == [(ns(k / 30), int(k > 6)) for k in range(29)]
            assert [f.t_ns for f in opened.frames("/camera/truth", TRACKS)] == [0, ns(0.4), ns(0.8)]
            assert opened.metadata(CLOCK) == {"start_ns": "0"}

    def test_rate_and_length_of_a_sequence_are_read_beside_it(self, tmp_path):
        (tmp_path / "gt").mkdir()
        write(tmp_path / "seqinfo.ini", "[Sequence]\nname=x\nframeRate=14\nseqLength=4\n")
        out = tmp_path / "a.mcap"
        found = write(tmp_path / "gt" / "gt.txt", MOT15)
        report = ingest(found, out, IngestOptions(role="truth"))
        assert report.remarks == [f"{found}: 4 frames (by seqinfo.ini) from 1 on, 14 a second (by seqinfo.ini)"]
        with log.read(out) as opened:
            frames = opened.frames("/camera/truth", TRACKS)
            assert [(f.t_ns, ids(f)) for f in frames] == [
                (0, [3, 5]),
                (ns(1 / 14), [3]),
                (ns(2 / 14), []),
                (ns(3 / 14), []),
            ]
        report = ingest(found, out, IngestOptions(role="truth", fps=Fraction(7), frames=3))
        assert [(notice.message, notice.code) for notice in report.warnings] == [
            (f"{found}: 14 frames a second by seqinfo.ini, and 7 by `fps=`, which is used", "clock")
        ]
        write(tmp_path / "seqinfo.ini", "frameRate=14\nseqLength=1\n")
        with pytest.raises(
            McaptrackError, match=r"the frames that seqinfo\.ini counts end with frame 1, the labels with"
        ):
            ingest(found, out, IngestOptions(role="truth"))
        for rate in ("1.2.3", "9" * 5000, "0", "1e-30"):
            write(tmp_path / "seqinfo.ini", f"frameRate={rate}\n")
            with pytest.raises(McaptrackError, match=r"seqinfo\.ini: frameRate is no number of frames a second"):
                ingest(found, out, IngestOptions(role="truth"))

    REFUSED = {
        "labels without ids": ({"labels": {"truth": "0,-1,1,1,2,2\n"}}, "has no ids"),
        "detections in metres": ({"labels": {"detections": TRAJNET}}, "holds positions, not boxes"),
        "a singular plane": ({"ground_plane": "1 0 0\n2 0 0\n0 0 1\n"}, "the homography is singular"),
        "no plane at all": ({"ground_plane": "1 0\n"}, "is not a homography"),
        "a strange camera": ({"camera": "../x y"}, "a camera's name is made of"),
        "a role for a video": ({"role": "truth"}, "is not a label file; `role=` applies to those"),
    }

    @pytest.mark.parametrize(("given", "words"), REFUSED.values(), ids=REFUSED)
    def test_what_is_refused_leaves_nothing_behind(self, tmp_path, clip, given, words):
        named = dict(given)
        if "labels" in named:
            named["labels"] = {role: write(tmp_path / f"{role}.txt", text) for role, text in named["labels"].items()}
        if "ground_plane" in named:
            named["ground_plane"] = write(tmp_path / "h.txt", named["ground_plane"])
        before = sorted(tmp_path.iterdir())
        with pytest.raises(McaptrackError, match=words):
            ingest(clip, tmp_path / "a.mcap", IngestOptions(**named))
        assert sorted(tmp_path.iterdir()) == before


NO_VIDEOS = {
    "is a playlist; give a video file": b"#EXTM3U\n#EXT-X-VERSION:3\n0.ts\n",
    "is an animated WebP": b"RIFF\x80\0\0\0WEBPVP8X\n\0\0\0\2\0\0\0\0\0\0\0\0\0ANIM",
}


@pytest.mark.parametrize(("words", "head"), NO_VIDEOS.items(), ids=NO_VIDEOS)
@pytest.mark.parametrize("suffix", [".dat", ".csv"])
def test_files_that_are_neither_videos_nor_labels_are_named_by_their_bytes(tmp_path, words, head, suffix):
    path = write(tmp_path / f"a{suffix}", "")
    path.write_bytes(head + b"\0" * 200)
    with pytest.raises(McaptrackError, match=words):
        ingest(path, tmp_path / "a.mcap", IngestOptions(fps=Fraction(10)))
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


# What a job says and decides before it writes: names, sizes, parameters


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
