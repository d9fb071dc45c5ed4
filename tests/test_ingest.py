"""Label files, homographies, and logs made of whatever exists."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import DETECTIONS, GROUND_PLANE, TRACKS
from mcaptrack.schema.ground_plane import plane_to_rows, rows_to_plane
from mcaptrack.schema.provenance import CLOCK
from mcaptrack.sources.demo import demo_scene
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.sources.ingest.labels.reading import read_homography, read_labels
from tests.worlds import ids, ns, write_clip

MOT15 = "1,3,10,20,4,8,1,-1,-1,-1\n2,3,11,20,4,8,0.5,-1,-1,-1\n1,5,50,60,4,8,1,-1,-1,-1\n"


TRAJNET = "0 7 1.5 2.5\n12 7 1.6 2.5\n12 9 3.0 4.0\n24 7 1.7 2.5\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


class TestLabels:
    def test_what_is_no_text_is_said(self, tmp_path):
        (tmp_path / "a.txt").write_bytes(b"\xff\xfe\x00\x00" * 10)
        with pytest.raises(McaptrackError, match="is not text in UTF-8"):
            read_labels(tmp_path / "a.txt")
        with pytest.raises(McaptrackError, match=r"none\.txt does not exist"):
            read_labels(tmp_path / "none.txt")

    @pytest.mark.parametrize("text", ["1,0,0\n0,1,0\n0,0,1\n", "1 0 0\n0 1 0\n0 0 1", "1.0e0\t0\t0\n0,1,0\n0 0 1\n"])
    def test_homographies_by_comma_or_blank(self, tmp_path, text):
        assert read_homography(write(tmp_path / "h.txt", text)) == (1, 0, 0, 0, 1, 0, 0, 0, 1)

    def test_planes_come_back_from_their_channel(self):
        plane = demo_scene().ground_plane()
        assert rows_to_plane(GROUND_PLANE.codec.decode(GROUND_PLANE.codec.encode(plane_to_rows(plane)))) == plane


@pytest.fixture
def clip(tmp_path) -> Path:
    write_clip(tmp_path / "clip.mp4", options={"bf": "0", "g": "10"})
    return tmp_path / "clip.mp4"


def options(**given) -> IngestOptions:
    return IngestOptions(**given)


class TestIngest:
    def test_label_files_of_one_log_share_a_clock(self, tmp_path):
        """Boxes at every frame that begin at frame 8, truth at every twelfth: frame 1 of these is frame 0 of those."""
        found = write(tmp_path / "det.txt", "".join(f"{n},-1,10,20,4,8,1,-1,-1,-1\n" for n in range(8, 30)))
        truth = write(tmp_path / "gt.txt", TRAJNET)
        out = tmp_path / "a.mcap"
        ingest(found, out, options(fps=Fraction(30), labels={"truth": truth}))
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
        report = ingest(found, out, options(role="truth"))
        assert report.remarks == [f"{found}: 4 frames (by seqinfo.ini) from 1 on, 14 a second (by seqinfo.ini)"]
        with log.read(out) as opened:
            frames = opened.frames("/camera/truth", TRACKS)
            assert [(f.t_ns, ids(f)) for f in frames] == [
                (0, [3, 5]),
                (ns(1 / 14), [3]),
                (ns(2 / 14), []),
                (ns(3 / 14), []),
            ]
        report = ingest(found, out, options(role="truth", fps=Fraction(7), frames=3))
        assert [(notice.message, notice.code) for notice in report.warnings] == [
            (f"{found}: 14 frames a second by seqinfo.ini, and 7 by `fps=`, which is used", "clock")
        ]
        write(tmp_path / "seqinfo.ini", "frameRate=14\nseqLength=1\n")
        with pytest.raises(
            McaptrackError, match=r"the frames that seqinfo\.ini counts end with frame 1, the labels with"
        ):
            ingest(found, out, options(role="truth"))
        for rate in ("1.2.3", "9" * 5000, "0", "1e-30"):
            write(tmp_path / "seqinfo.ini", f"frameRate={rate}\n")
            with pytest.raises(McaptrackError, match=r"seqinfo\.ini: frameRate is no number of frames a second"):
                ingest(found, out, options(role="truth"))

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
            ingest(clip, tmp_path / "a.mcap", options(**named))
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
