"""Files of kitti."""

from __future__ import annotations

import math

import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.ingest.labels.reading import read_labels
from mcaptrack.tables.compared import compare_files
from tests.label_cases import Row, Writer, corners, number, per_frame, text
from tests.test_compared import by_trackeval, crowd, same_as_trackeval, scores
from tests.test_label_files import FORMATS, Read, assert_read, assert_refused, written


def kitti(row: Row) -> str:
    boxes = " ".join(map(number, corners(row)))
    length, width, height = row.size
    space = f"{height} {width} {length} {-row.xy[1]} 0 {row.xy[0]} {-row.heading - math.pi / 2}"
    who = {"person": "Pedestrian"}.get(row.kind, row.kind)
    return f"{row.frame} {number(row.id, '-1')} {who} 0 0 0 {boxes} {space} {number(row.score)}"


def kitti_frame(_: int, rows: list[Row]) -> str:
    lines = [kitti(row).split() for row in rows]
    return "".join(f"{kind} {own} {' '.join(more)}\n" for _, own, kind, *more in lines)


WRITERS = {
    "kitti": Writer(text(kitti), "kind", first="stated"),
    "kitti-3d": Writer(text(kitti), "kind", "space", first="stated"),
    "kitti-frames": Writer(per_frame("{}.txt", kitti_frame), "kind", first="listed"),
}


NAN = float("nan")


KITTI = """2 1 Pedestrian 0 0 0 10 20 14 28 1 1 1 1 1 1 0 0.5
0 2 Pedestrian 0 2 0 11 21 16 30 1 1 1 1 1 1 0
0 3 Pedestrian 0 3 0 12 22 18 32 1 1 1 1 1 1 0
1 4 Pedestrian 1 0 0 13 23 20 34 1 1 1 1 1 1 0
1 5 Car 0 0 0 14 24 22 36 1 1 1 1 1 1 0
1 -1 DontCare -1 -1 -10 15 25 24 38 1 1 1 1 1 1 0
3 6 Person_sitting 0 0 0 16 26 26 40 1 1 1 1 1 1 0
3 7 Person 0 0 0 17 27 28 42 1 1 1 1 1 1 0
4 8 Tricycle 0 0 0 18 28 30 44 1 1 1 1 1 1 0
"""


KITTI_BOXES = {k: [10 + k, 20 + k, 4 + k, 8 + k] for k in range(9)}


#: Role, and what is read, sorted by frame and id.
FILES: dict[str, tuple[str, str, str, Read]] = {
    "kitti truth": (KITTI, "kitti", "truth", Read(
        [0, 2], [2, 1], [KITTI_BOXES[k] for k in (1, 0)], [NAN, 0.5], [0, 1, 2, 3, 4], [1, 1], {1: "Pedestrian"},
        "2 Person_sitting, 1 Car, 1 Tricycle and 1 regions (DontCare) and 2 boxes that don't count (hidden or cut off)",
        ([0, 1, 1, 3, 3], [KITTI_BOXES[k] for k in (2, 3, 5, 6, 7)], [True, True, False, True, True],
         [False, False, True, False, False]))),
    "kitti tracks": (KITTI, "kitti", "tracks", Read(
        [0, 0, 1, 2], [2, 3, 4, 1], [KITTI_BOXES[k] for k in (1, 2, 3, 0)], [NAN, NAN, NAN, 0.5], [0, 1, 2, 3, 4], [1] * 4,
        {1: "Pedestrian"}, "2 Person_sitting, 1 Car, 1 Tricycle and 1 regions (DontCare)")),
    "kitti detections": (KITTI, "kitti", "detections", Read(
        [0, 0, 1, 1, 2, 3, 3, 4], [2, 3, 4, 5, 1, 6, 7, 8], [KITTI_BOXES[k] for k in (1, 2, 3, 4, 0, 6, 7, 8)],
        [NAN, NAN, NAN, NAN, 0.5, NAN, NAN, NAN], [0, 1, 2, 3, 4], [1, 1, 1, 3, 1, 7, 7, 10],
        {1: "Pedestrian", 3: "Car", 7: "Person_sitting", 10: "Tricycle"}, "1 regions (DontCare)")),
}  # fmt: skip


@pytest.mark.parametrize(("text", "name", "role", "wanted"), FILES.values(), ids=FILES)
def test_every_column_is_read_as_by_hand(text, name, role, wanted, tmp_path):
    assert_read(text, name, role, wanted, tmp_path)


@pytest.mark.parametrize("row", ["1 1 Person_sitting" + 14 * " 1", "1 1 Car" + 15 * " 1"])
def test_it_is_told_by_the_first_row(row, tmp_path):
    assert read_labels(written(tmp_path / "a.txt", f"# a remark\n\n{row}\n"), role="detections").format == "kitti"


#: What is refused, with the text of the file and the words after its name.
REFUSED = {
    "sixteen of kitti": ("kitti", "truth", "1 1 Car" + 13 * " 1", None),
    "cars": ("kitti", "tracks", KITTI.splitlines()[4], " holds no people, only 1 Car; `classes=` takes others"),
    "regions": ("kitti", "detections", KITTI.splitlines()[5], " holds no such boxes, only 1 regions (DontCare)"),
    "coco": ("auto", "tracks", '[{"image_id": 1}]', f" is JSON (a list with image_id) of no label format ({FORMATS})"),
    "xml": ("auto", "tracks", '\ufeff<annotations "images">', ":1: not valid XML: not well-formed (invalid token)"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "role", "text", "words"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_file_of_labels_is_refused_in_these_words(name, role, text, words, tmp_path):
    assert_refused(name, role, text, words, tmp_path)


def line_of(frame, who, kind, x, *, truncated=0, occluded=0, height=50.0, more=()):
    box = (x, 10.0, x + 20.0, 10.0 + height)
    return " ".join(map(str, (frame, who, kind, truncated, occluded, 0.1, *box, 1.7, 0.5, 0.5, 1, 1, 1, 0.0, *more)))


def test_kitti_counts_pedestrians_and_ignores_its_regions(tmp_path):
    truth, found = [], []
    for n in range(5):
        truth += [line_of(n, 1, "Pedestrian", 10), line_of(n, 2, "Car", 100), line_of(n, 3, "Person_sitting", 200)]
        truth += [line_of(n, 4, "Pedestrian", 300, occluded=3), line_of(n, -1, "DontCare", 400, height=300)]
        found += [line_of(n, who, "Pedestrian", x, more=(0.9,)) for who, x in ((1, 10), (2, 100), (3, 200), (4, 300))]
        found += [
            line_of(n, 5, "Pedestrian", 402),
            line_of(n, 6, "Pedestrian", 600, height=20.0),
            line_of(n, 7, "Car", 700),
        ]
    a, b = tmp_path / "t.txt", tmp_path / "gt.txt"
    a.write_text("\n".join(found))
    b.write_text("\n".join(truth))
    row, _ = scores(a, b)
    assert (row["GT"], row["FN"], row["FP"]) == (1, 0, 5)  # false: who stands where the car is
    b.write_text("\n".join(line_of(0, 1, "Car", 1.0) for _ in range(2)))
    with pytest.raises(McaptrackError, match="holds no people, only 2 Car"):
        compare_files(a, b)


@pytest.mark.parametrize("seed", range(3))
def test_kitti_is_scored_as_by_trackeval(seed, tmp_path, capsys):
    datasets = pytest.importorskip("trackeval.datasets")
    kinds = [("Pedestrian", 0, 0)] * 4 + [("Pedestrian", 0, 3), ("Pedestrian", 1, 0), ("Person", 0, 0)]
    labels, found = crowd(seed, [*kinds, ("Car", 0, 0), ("DontCare", -1, -1)])

    def line(n, who, kind, cut, hidden, box, *score):
        x, y, w, h = box
        who = -1 if kind == "DontCare" else who
        return f"{n} {who} {kind} {cut} {hidden} 0.1 {x} {y} {x + w} {y + h} 1.7 0.5 0.5 1 1 1 0.0 {' '.join(score)}"

    truth, tracks = tmp_path / "gt/label_02/0000.txt", tmp_path / "tr/us/data/0000.txt"
    for path, lines in (
        (truth, [line(n - 1, who, *kind, box) for n, who, kind, box in labels]),
        (tracks, [line(n - 1, who, "Pedestrian", 0, 0, box, "0.9") for n, who, box in found]),
    ):
        path.parent.mkdir(parents=True)
        path.write_text("\n".join(text.strip() for text in lines) + "\n")
    (tmp_path / "gt/evaluate_tracking.seqmap.training").write_text("0000 empty 000000 000030\n")
    folders = {"GT_FOLDER": str(tmp_path / "gt"), "TRACKERS_FOLDER": str(tmp_path / "tr"), "PRINT_CONFIG": False}
    theirs = datasets.Kitti2DBox(folders)
    data = theirs.get_preprocessed_seq_data(theirs.get_raw_seq_data("us", "0000"), "pedestrian")
    same_as_trackeval(scores(tracks, truth)[0], by_trackeval(data))
