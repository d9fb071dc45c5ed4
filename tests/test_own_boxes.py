"""Boxes of other detectors: every format gives the boxes that were written, and what is wrong in one is one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import DETECTIONS
from mcaptrack.sources.ingest.labels.delimited import KEYS, parse_columns
from mcaptrack.sources.ingest.labels.reading import read_labels

SIZE = (256, 128)


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(text.encode())
    return path


def test_times_are_frames_and_gaps_are_empty_frames(tmp_path):
    path = written(tmp_path, "t.csv", "time,cx,cy,w,h\n2.0,50,50,10,20\n2.1,51,50,10,20\n2.3,52,50,10,20\n")
    result = mcaptrack.ingest(path, tmp_path / "t.mcap", role="detections")
    with log.read(result.log) as opened:
        frames = list(opened.frames("/camera/detections", DETECTIONS))
    assert [round(frame.t_ns / 1e6) for frame in frames] == [2000, 2100, 2200, 2300]
    assert [frame.rows["x_px"].tolist() for frame in frames] == [[45], [46], [], [47]]


def test_columns_are_named_by_the_user(tmp_path):
    path = written(tmp_path, "a.csv", "n,a,b,c,d,p\n3,1,2,11,22,90\n")
    labels = read_labels(path, columns=parse_columns("x=a,y=b,x2=c,y2=d,frame=n,score=p"), role="detections")
    assert (labels.boxes_px.tolist(), labels.score.tolist()) == ([[1, 2, 10, 20]], [90])
    assert any("states no classes; all boxes are taken as people" in words for words in labels.remarks)


HEAD = "frame,left,top,width,height"
BAD = {
    "no frame": ("left,top,width,height\n1,2,3,4\n", "no column for the frame or the time"),
    "two lefts": ("frame,x,left,top,w,h\n1,1,1,2,3,4\n", r"x and left could both be x; choose with `columns='x=x'`"),
    "a short row": (f"{HEAD}\n1,2,3\n", r"a:2: .*3 columns, and the header has 5"),
    "a word": (f"{HEAD}\n1,2,x,3,4\n", "a:2: .*the column top holds 'x', which is no number: 1,2,x"),
    "a decimal comma": (f'{HEAD}\n1,2,"3,5",3,4\n', "'3,5', which is no number; decimal commas are read"),
    "a header twice": ("frame,x,x,y,w,h\n1,1,1,2,3,4\n", "several columns are named x; its columns are frame, x, x, y"),
    "an empty object": ("{}", "an object\\) of no label format"),
    "not a number": (f"{HEAD}\n1,2,nan,3,4\n", "a:2: a number of the box is missing or not finite"),
    "infinite": (f"{HEAD}\n1,2,3,4,1e999\n", "a:2: a number of the box is missing"),
    "two sequences": (f"{HEAD}\na_1.jpg,2,3,4,1\nb_1.jpg,2,3,4,1\n", "names of several sequences"),
    "a header alone": (f"{HEAD}\n", "holds no boxes"),
    "one id twice": (f"{HEAD},track_id\n1,2,3,4,5,6\n1,2,3,4,5,6\n", "id 6 appears twice in frame 1"),
    "other JSON": ('{"a": 1}', "an object with a\\) of no label format"),
    "broken JSON": ("[1,", "is not valid JSON"),
    "deep JSON": ("[" * 100_000, "is nested deeper|is not valid JSON"),
    "no boxes": ("[]", "holds no boxes"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_one_line_with_its_place(case, tmp_path):
    assert_refused(*BAD[case], tmp_path)


def assert_refused(text: str, words: str, folder: Path) -> None:
    with pytest.raises(McaptrackError, match=words) as error:
        read_labels(written(folder, "a", text))
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 600


#: Ids of boxes, one in a frame.
IDS = ["b-7", "a-2", "", "b-7", "31"]


def assert_numbered(path: Path) -> None:
    labels = read_labels(path, role="detections")
    assert dict(zip(labels.frame.tolist(), labels.id.tolist(), strict=True)) == {0: 1, 1: 2, 2: -1, 3: 1, 4: 3}
    (said,) = [words for words in labels.remarks if "its ids are texts" in words]
    assert said.endswith("numbered from 1 on as they come: 'b-7' is 1, 'a-2' is 2")
    assert read_labels(path, role="tracks").id.tolist() == [1, 2, 1, 3]


def test_ids_that_are_texts_are_numbered_as_they_come(tmp_path):
    lines = [f"{frame},{one},{10 * frame},2,3,4" for frame, one in enumerate(IDS)]
    assert_numbered(written(tmp_path, "i.csv", "\n".join(["frame,id,left,top,width,height", *lines])))


def test_more_texts_than_ids_can_be_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("mcaptrack.sources.ingest.labels.text._MAX_TEXTS", 2)
    path = written(tmp_path, "i.csv", f"{HEAD},id\n" + "".join(f"{k},1,2,3,4,t{k}\n" for k in range(3)))
    with pytest.raises(McaptrackError, match=r"i\.csv:4: .*the column of ids has more than 2 texts"):
        read_labels(path)


def test_a_damaged_table_is_not_taken_for_a_video(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(f"{HEAD}\n1,2,3,4,5\n".encode() + bytes(20))
    with pytest.raises(McaptrackError, match=r"a\.csv:3: not a row of .*1 columns, and the header has 5"):
        mcaptrack.ingest(path, tmp_path / "a.mcap", fps=10)


@pytest.mark.parametrize("text", ["x", "x=", "q=a", "x=a,x=b"])
def test_wrong_columns_are_refused_with_the_known_ones(text):
    with pytest.raises(McaptrackError, match=f"`columns=`.*({KEYS[0]}=left|{KEYS[-1]}|twice)"):
        parse_columns(text)


def table(tmp_path, text, role="detections", name="a.csv", **options):
    return read_labels(written(tmp_path, name, text), role=role, **options)


def test_a_width_and_height_beside_two_corners_are_those_of_the_picture(tmp_path):
    text = "filename,width,height,class,xmin,ymin,xmax,ymax\nf_12.jpg,640,480,person,1,2,31,42\n"
    assert table(tmp_path, text).boxes_px.tolist() == [[1, 2, 30, 40]]
    named = table(tmp_path, text, columns=parse_columns("x=xmin,y=ymin,w=width,h=height"))
    assert named.boxes_px.tolist() == [[1, 2, 640, 480]]


@pytest.mark.parametrize(
    ("head", "expected"),
    [
        ("# frame,x1,y1,x2,y2,score", ("csv", [2, 3, 8, 7])),
        ("#frame,id,x,y,w,h", ("mot", [3, 10, 10, 5])),
        ("# frame,id,bb_left,bb_top,bb_width,bb_height", ("mot", [3, 10, 10, 5])),
        ("# made on Monday, by hand", ("mot", [3, 10, 10, 5])),
    ],
)
def test_a_header_that_is_a_comment_names_columns(head, expected, tmp_path):
    labels = table(tmp_path, f"{head}\n1,2,3,10,10,5\n")
    assert (labels.format, *labels.boxes_px.tolist()) == expected


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ("x=a,y=a,w=c,h=d", "names a for y and for another key"),
        ("x=a,y=b,w=c,h=d,x2=e", "w is not read beside x, y, h, x2"),
    ],
)
def test_columns_that_are_not_read_are_refused(columns, words, tmp_path):
    with pytest.raises(McaptrackError, match=words):
        table(tmp_path, "frame,a,b,c,d,e\n0,1,2,3,4,5\n", columns=parse_columns(columns))


class TestPositionsInMetres:
    def test_they_are_rows_with_boxes_or_without(self):
        frame = mcaptrack.detections(
            positions_m=[[1, 2], [3, 4]], sizes_m=[[4, 2, 1.5]] * 2, headings_rad=[0.5, -0.5], velocities_m_per_s=[[1, 0]] * 2,
            source_ids=[7, -1], scores=[0.5, 0.25], t_ns=9,
        )  # fmt: skip
        columns = ("x_m", "y_m", "length_m", "width_m", "height_m", "heading_rad", "vx_m_per_s", "source_id", "score")
        assert [frame.rows[name].tolist() for name in columns] == [
            [1, 3], [2, 4], [4, 4], [2, 2], [1.5, 1.5], [0.5, -0.5], [1, 1], [7, -1], [0.5, 0.25]
        ]  # fmt: skip
        assert np.isnan(frame.rows["z_m"]).all()
        assert np.isnan(frame.rows["x_px"]).all()
        both = mcaptrack.detections([[0, 0, 2, 3]], positions_m=[[1, 2, 3]], box_format="xywh")
        assert (both.rows["h_px"].tolist(), both.rows["z_m"].tolist()) == ([3], [3])
        assert len(mcaptrack.detections(positions_m=[]).rows) == 0

    @pytest.mark.parametrize(
        ("given", "words"),
        [
            ({}, r"detections need boxes in pixels \(`boxes=`\), or positions in metres \(`positions_m=`\)"),
            ({"positions_m": [1, 2]}, r"`positions_m=` needs numbers of shape \(N, 2\) or \(N, 3\), not \(2,\)"),
            ({"positions_m": [["a", "b"]]}, "`positions_m=` needs numbers: "),
            ({"positions_m": [[1, 2]], "sizes_m": [[1, 2, 3]] * 2}, r"1 boxes need `sizes_m=` of shape \(1,\), not \(2,\)"),
            ({"positions_m": [[1, np.nan]]}, "has only a part of x_m, y_m in 1 rows"),
            ({"positions_m": [[1, 2]], "headings_rad": [[1, 2]]}, r"`headings_rad=` needs numbers of shape \(N,\), not \(1, 2\)"),
            ({"positions_m": [[1, 2]], "box_format": "xyxy"}, "`box_format=` says what the columns of `boxes=` are"),
        ],
    )  # fmt: skip
    def test_what_is_none_is_one_line(self, given, words):
        with pytest.raises(McaptrackError, match=words):
            mcaptrack.detections(**given)


def test_shares_of_the_picture_need_its_size(tmp_path):
    with pytest.raises(McaptrackError, match="`size='WIDTHxHEIGHT'`"):
        path = written(tmp_path, "a.csv", f"{HEAD}\n0,0.25,0.5,0.125,0.25\n")
        mcaptrack.ingest(path, tmp_path / "a.mcap", fps=10)
