"""Scores of KITTI tracking: what counts there, and the same numbers as TrackEval has."""

from __future__ import annotations

import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.tables.compared import compare_files
from tests.test_compared import by_trackeval, crowd, same_as_trackeval, scores


def kitti(frame, who, kind, x, *, truncated=0, occluded=0, height=50.0, more=()):
    box = (x, 10.0, x + 20.0, 10.0 + height)
    return " ".join(map(str, (frame, who, kind, truncated, occluded, 0.1, *box, 1.7, 0.5, 0.5, 1, 1, 1, 0.0, *more)))


def test_kitti_counts_pedestrians_and_ignores_its_regions(tmp_path):
    truth, found = [], []
    for n in range(5):
        truth += [kitti(n, 1, "Pedestrian", 10), kitti(n, 2, "Car", 100), kitti(n, 3, "Person_sitting", 200)]
        truth += [kitti(n, 4, "Pedestrian", 300, occluded=3), kitti(n, -1, "DontCare", 400, height=300)]
        found += [kitti(n, who, "Pedestrian", x, more=(0.9,)) for who, x in ((1, 10), (2, 100), (3, 200), (4, 300))]
        found += [kitti(n, 5, "Pedestrian", 402), kitti(n, 6, "Pedestrian", 600, height=20.0), kitti(n, 7, "Car", 700)]
    a, b = tmp_path / "t.txt", tmp_path / "gt.txt"
    a.write_text("\n".join(found))
    b.write_text("\n".join(truth))
    row, _ = scores(a, b)
    assert (row["GT"], row["FN"], row["FP"]) == (1, 0, 5)  # false: who stands where the car is
    b.write_text("\n".join(kitti(0, 1, "Car", 1.0) for _ in range(2)))
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
