"""Files of yolo and darknet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mcaptrack import notices
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange import pictures, yolo
from mcaptrack.sources.ingest.labels.reading import read_labels
from mcaptrack.sources.ingest.labels.timeline import Timeline
from tests.label_cases import Row, Writer, as_json, by_frame, number, shares


def labels(folder: Path, rows: Sequence[Row]) -> Path:
    """Shares of 640x480 of boxes in pixels; those that are shares are far too large then."""
    (folder / "labels").mkdir(exist_ok=True)
    for frame, mine in by_frame(rows).items():
        lines = []
        for row in mine:
            place = shares(row)
            kind = {"person": "0", "77": "77"}.get(row.kind, "-1")
            lines.append(f"{kind} {' '.join(map(str, place))} {number(row.score, '1')} {number(row.id, '-1')}")
        (folder / "labels" / f"{frame:06}.txt").write_text("\n".join(lines))
    if not any(row.kind == "77" for row in rows):
        (folder / "classes.txt").write_text("person\n")
    return folder / "labels"


def darknet(rows: Sequence[Row]) -> Any:
    """Shares of 640x480 of boxes in pixels; those that are shares are far too large then."""
    out = []
    for frame, mine in by_frame(rows).items():
        objects = []
        for row in mine:
            place = dict(zip(("center_x", "center_y", "width", "height"), shares(row), strict=True))
            objects.append(
                {"name": row.kind or "", "class_id": "", "confidence": row.score, "relative_coordinates": place}
            )
        out.append({"frame_id": frame, "objects": objects})
    return out


WRITERS = {
    "darknet": Writer(as_json(darknet), "id numbered", tracks=False, first="listed", shares=True),
    "yolo": Writer(labels, names=False, shares=True),
}


NAN = float("nan")


def folder_of(place: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(text)
    return place


ROW = "0 0.5 0.5 0.25 0.5"


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (ROW, None),
        ("0 2 -2 2 2", None),
        ("0 2.01 0.5 0.1 0.1", "2.01 is no share of the picture's size, as its boxes are"),
        ("0 0.5 -2.01 0.1 0.1", "2.01 is no share of the picture's size, as its boxes are"),
        (f"{ROW} 1 2 3", "8 columns, as outlines have, which are not read"),
        ("0 0.5 0.5 0.1", "4 columns"),
    ],
)
def test_rows_of_yolo_are_shares(row, words, tmp_path):
    folder_of(tmp_path, {"1.txt": ROW, "2.txt": row})
    if words is None:
        assert len(read_labels(tmp_path, role="detections").frame) == 2
        return
    with pytest.raises(McaptrackError) as error:
        read_labels(tmp_path, role="detections")
    assert str(error.value).startswith(f"{tmp_path / '2.txt'}:1: ")
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("rows", "role", "scores", "ids"),
    [
        (["0.5", "1"], "detections", [0.5, 1], [-1, -1]),
        (["0", "1"], "detections", [0, 1], [-1, -1]),  # whole numbers up to 1 may be scores
        (["0", "2"], "detections", [NAN, NAN], [0, 2]),
        (["0", "1"], "tracks", [NAN, NAN], [0, 1]),
        (["0.5 3", "1 4"], "detections", [0.5, 1], [3, 4]),
        (["0.5 3", "1"], "detections", [0.5, 1], [3, -1]),
    ],
)
def test_a_sixth_column_is_a_score_or_an_id(rows, role, scores, ids, tmp_path):
    folder_of(tmp_path, {f"{n}.txt": f"{ROW} {row}" for n, row in enumerate(rows)})
    labels = read_labels(tmp_path, role=role)
    assert (str(labels.score.tolist()), labels.id.tolist()) == (str([float(s) if s == s else s for s in scores]), ids)


@pytest.mark.parametrize(
    ("files", "named_by", "names"),
    [
        ({}, None, {}),
        ({"labels/classes.txt": "person\n big  dog \n"}, "labels/classes.txt", {1: "person", 2: "big dog"}),
        ({"obj.names": "person\ndog", "data.yaml": "names: [a, b]"}, "obj.names", {1: "person", 2: "dog"}),
        ({"data.yml": "names:\n  0: person\n  1: cat\n"}, "data.yml", {1: "person", 2: "cat"}),
        ({"data.yaml": "path: x"}, None, {}),
        ({"classes.txt": "1: big  dog\n0: person"}, "classes.txt", {1: "person", 2: "big dog"}),
        ({"classes.txt": "1,dog 9\n0,person"}, "classes.txt", {1: "person", 2: "dog 9"}),
        ({"classes.txt": "person\n1 dog"}, "classes.txt", {1: "person", 2: "1 dog"}),
    ],
)
def test_names_of_classes_are_beside_the_labels_or_above(files, named_by, names, tmp_path):
    place = tmp_path / "set"
    folder_of(place, {"labels/1.txt": f"{ROW}\n1 0.5 0.5 0.1 0.1", **files})
    labels = read_labels(place, role="detections")
    assert labels.class_id.tolist() == [1, 2]
    assert labels.classes == names
    wanted = [f"{place}: class names by {place / named_by}"] if named_by else []
    assert [words for words in labels.remarks if "class names by" in words] == wanted
    assert labels.remarks[0] == f"{place}: 1 files, frames are numbered by their names"


def test_a_folder_of_labels_has_no_more_than_its_limits(tmp_path, monkeypatch):
    folder_of(tmp_path, {"b.txt": ROW, "a.txt": f"{ROW}\n", "readme.txt": "x"})
    assert read_labels(tmp_path, role="detections").remarks[0].endswith("2 files, frames are numbered by their order")
    pictures_of = Timeline(np.arange(3), np.arange(3) * 10, "the pictures")
    with notices.listening(lambda _: None), notices.collected() as warned:
        pictures_of.place(read_labels(tmp_path, role="detections"), "detections", [])
    assert "has 2 pictures without numbers, and the pictures are 3: they are taken as the first" in warned[0].message
    monkeypatch.setattr(yolo, "MAX_ROWS", 2)
    monkeypatch.setattr(pictures, "_MAX_PICTURES", 3)
    assert len(read_labels(tmp_path, role="detections").frame) == 2
    (tmp_path / "a.txt").write_text(f"{ROW}\n{ROW}")
    with pytest.raises(McaptrackError, match="has more than 2 rows; give it in parts"):
        read_labels(tmp_path, role="detections")
    (tmp_path / "c.txt").write_text("")
    with pytest.raises(McaptrackError, match="holds 4 label files; at most 3 are read"):
        read_labels(tmp_path, role="detections")
