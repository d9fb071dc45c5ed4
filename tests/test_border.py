"""The law of the border: every format of labels, and every check of ``labels.checks``.

For each format there is a writer of rows here, and for each check rows that break it. Whatever the format, the check
speaks: with its code, or with an error. A format without a writer, and a check without rows that break it, fail.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaptrack
from mcaptrack.errors import McaptrackError
from mcaptrack.registry import own
from mcaptrack.sources.ingest.labels.checks import OF_ROLE, OF_SOURCE
from mcaptrack.sources.ingest.labels.of_packages import format_named
from mcaptrack.sources.ingest.labels.reading import is_3d, read_labels
from mcaptrack.sources.ingest.labels.table import BoxTable
from mcaptrack.testing import check_label_format
from tests.label_cases import WALK, Row, writers

NAN = math.nan


WRITERS = writers()


def changed(at: int = 3, **changes: Any) -> list[Row]:
    return [*WALK[:at], replace(WALK[at], **changes), *WALK[at + 1 :]]


def all_with(**changes: Any) -> list[Row]:
    return [replace(row, **changes) for row in WALK]


SPREAD = [replace(row, xy=(300.0 * row.frame, row.xy[1])) for row in WALK]
SHARES = [replace(row, box=(0.1 * row.frame, 0.2 * row.id, 0.1, 0.2)) for row in WALK]
METRES = [Row(frame, who, (3.25 * frame, 2.5 * who, 4.5, 1.75)) for frame in range(1, 11) for who in (1, 2, 3)]
LATE = [replace(row, frame=row.frame + 6) for row in WALK]
#: By check: rows that break it, the column that they need, what they are read as, and what is said: a code in <>, or
#: words of an error.
BROKEN: dict[str, list[tuple[list[Row], str, str, str]]] = {
    "rows": [
        ([], "", "truth", "no (boxes|labels|people|3D boxes)|needs a header|is no(t|ne)? |of no label format|has no box|has no samples|no label files|0 tasks"),
        (changed(id=-2), "numbered", "truth", "the id has to be a whole number from -1"),
        (changed(score=1.5e9), "score", "detections", "a score can't be 1.5e\\+09"),
    ],
    "boxes": [
        (changed(box=(10, 20, -5, 60)), "box", "truth", "a box can't be -"),
        (changed(box=(10, 20, 1.5e8, 60)), "box", "truth", "a coordinate can't be|is no share"),
    ],
    "positions": [
        (changed(xy=(NAN, 2)), "xy", "truth", "a number is not finite"),
        (SPREAD, "xy", "truth", "<units>"),
    ],
    "boxes in space": [
        (all_with(size=(900, 900, 900)), "space", "truth", "sizes have to be in metres"),
        (changed(xy=(2e8, 0)), "space", "truth", "a coordinate can't be 2e\\+08"),
    ],
    "shares": [(SHARES, "pixels", "truth", "<units>"), (METRES, "pixels", "truth", "<units>"), (changed(box=(1200, 20, 1700, 60)), "share", "truth", "is no share")],
    "scores": [(changed(score=5), "score", "detections", "<scores>")],
    "repeated": [([*WALK, WALK[2]], "", "detections", "<repeated>")],
    "first frame": [(LATE, "frames", "truth", "<clock>")],
    "labelled": [(WALK, "", "truth", "")],
    "size": [(changed(box=(700, 20, 30, 60)), "size", "truth", "<outside>")],
    "ids": [
        ([*WALK, replace(WALK[2], box=(200, 200, 9, 9))], "", "truth", "appears twice"),
        (all_with(id=None), "id", "truth", "has no ids|holds no people|need ids"),
    ],
    "classes": [
        (changed(kind=None), "kind", "detections", "<classes>"),
        (changed(kind="77"), "numbers", "detections", "<classes>"),
    ],
}  # fmt: skip


def test_every_format_and_every_check_is_here():
    assert set(WRITERS) == set(own("label_format"))
    assert set(BROKEN) == {*OF_SOURCE, *OF_ROLE, "classes"}


def has(name: str) -> set[str]:
    """The columns and facts of a format, as they are declared here."""
    writer = WRITERS[name]
    out = {writer.kind, "score", "kind", "id", "numbered"} - {*writer.lacks.split()}
    out |= {"share"} if writer.shares else {"pixels"} if writer.kind == "box" else set()
    out |= {"size"} if writer.size else set()
    out |= {"numbers"} if not writer.names else set()
    out -= {*writer.lacks.split()}
    return out if writer.first else out | {"frames"}


@pytest.mark.parametrize("name", WRITERS)
def test_rows_without_fault_are_read_without_a_word(name, tmp_path):
    path = WRITERS[name].write(tmp_path, WALK)
    for label_format in ("auto", name):
        if (label_format, name) == ("auto", "kitti-3d"):
            continue
        for role in ("truth", "detections") if WRITERS[name].tracks else ("detections",):
            table = read_labels(path, label_format, role, columns=None)
            assert table.format == name
            assert table.facts.found_by == ("content" if label_format == "auto" else "option")
            said = [
                words
                for words, code in table.doubts
                if (name, code) not in {("csv", "clock"), ("yolo", "clock"), ("records", "clock")}
            ]
            assert [words for words in said if "no class names" not in words] == []
            assert (len(table.frame), set(table.class_id.tolist())) == (8, {1})
            assert is_3d(path, label_format) == table.in_space
            assert_walk(name, table, role)


def assert_walk(name: str, table: BoxTable, role: str) -> None:
    """Check that all that the format holds of ``WALK`` is as it was written, whatever it counts frames from."""
    writer = WRITERS[name]
    wanted = {key: np.array([getattr(row, key) for row in WALK], float) for key in ("box", "xy", "size", "heading")}
    assert np.unique(table.frame, return_inverse=True)[1].tolist() == [row.frame - 1 for row in WALK]
    if writer.tracks:
        assert table.id.tolist() == [row.id for row in WALK]
    if "score" not in writer.lacks and (name != "mot" or role == "detections"):  # a flag of ground truth
        assert table.score.tolist() == [0.5] * len(WALK)
    if writer.kind == "box":
        assert table.boxes_px is not None
        boxes = table.boxes_px * ([640, 480, 640, 480] if table.is_normalised else 1)
        if name != "mots":  # a mask
            np.testing.assert_allclose(boxes, wanted["box"])
        return
    np.testing.assert_allclose(table.xy_m if table.boxes_m is None else table.boxes_m[:, :2], wanted["xy"], atol=1e-9)
    if writer.kind == "space":
        assert table.boxes_m is not None
        height = slice(3, 5 if name == "levelx" else 6)
        np.testing.assert_allclose(table.boxes_m[:, height], wanted["size"][:, : height.stop - 3])
        np.testing.assert_allclose(table.boxes_m[:, 6], wanted["heading"], atol=1e-9)


@pytest.mark.parametrize("name", WRITERS)
def test_every_check_speaks_whatever_the_format(name, tmp_path):
    writer = WRITERS[name]
    for check, cases in BROKEN.items():
        for order, (rows, needs, role, said) in enumerate(cases):
            if (not needs or needs in has(name)) and (check != "ids" or writer.tracks):
                folder = tmp_path / f"{check} {order}"
                folder.mkdir()
                path = writer.write(folder, rows)
                assert_speaks(path, name, check, role if writer.tracks else "detections", said)


def assert_speaks(path: Path, name: str, check: str, role: str, said: str) -> None:
    if said.startswith("<") or not said:
        table = read_labels(path, name, role)
        codes = [code for _, code in table.doubts]
        assert not said or said[1:-1] in codes, (check, table.doubts)
        if check == "labelled":
            assert set(table.frame.tolist()) <= set(table.labelled.tolist())
            assert (np.diff(table.labelled) > 0).all()
        return
    with pytest.raises(McaptrackError) as refused:
        read_labels(path, name, role)
    assert re.search(said, str(refused.value)), (check, str(refused.value))
    assert "\n" not in str(refused.value)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> Path:
    """A log with 12 pictures of 64 x 48."""
    import cv2

    folder = tmp_path_factory.mktemp("pictures") / "frames"
    folder.mkdir()
    for number in range(12):
        cv2.imwrite(str(folder / f"{number:06}.png"), np.full((48, 64, 3), 9 * number, np.uint8))
    return mcaptrack.ingest(folder, folder.parent / "log.mcap", fps=10).log


@pytest.mark.parametrize("name", [name for name in WRITERS if WRITERS[name].kind != "space"])
def test_boxes_outside_of_the_pictures_are_said_of_every_format(name, tmp_path, pictures):
    path = WRITERS[name].write(tmp_path, WALK)
    log = tmp_path / "a.mcap"
    log.write_bytes(pictures.read_bytes())
    role = "truth" if WRITERS[name].tracks else "detections"
    result = mcaptrack.ingest(path, into=log, label_format=name, role=role, force=True, first_frame=1)
    codes = [notice.code for notice in result.warnings]
    table = read_labels(path, name, role)
    in_pixels = table.boxes_px is not None and not table.is_normalised
    assert ("outside" in codes) == in_pixels


@pytest.mark.parametrize("name", [name for name in WRITERS if WRITERS[name].first == "listed"])
def test_a_first_picture_that_is_assumed_is_said(name, tmp_path, pictures):
    log = tmp_path / "a.mcap"
    log.write_bytes(pictures.read_bytes())
    result = mcaptrack.ingest(
        WRITERS[name].write(tmp_path, LATE),
        into=log,
        label_format=name,
        role="truth" if WRITERS[name].tracks else "detections",
    )
    assert "clock" in [notice.code for notice in result.warnings]


def test_positions_in_metres_have_a_hint_that_works(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("frame,ped_id,pos_x,pos_y\n1,7,1.5,2.5\n2,7,1.6,2.5\n")
    with pytest.raises(McaptrackError) as refused:
        mcaptrack.ingest(path, tmp_path / "a.mcap", fps=10)
    (hint,) = re.findall(r"positions in metres are read with `columns='(.*)'`", str(refused.value))
    result = mcaptrack.ingest(path, tmp_path / "a.mcap", fps=10, columns=hint)
    with mcaptrack.open(result.log) as log:
        rows = log.array("tracks", "/camera/tracks")
    assert (rows["x_m"].tolist(), rows["track_id"].tolist()) == ([1.5, 1.6], [7, 7])


#: Rows of MOTChallenge, names beside them, and the classes of detections, by hand.
NAMED: dict[str, tuple[list[str], dict[str, str], dict[int, str], list[int]]] = {
    "visdrone": (["1,0,0"] * 2 + ["4,0,1", "2,1,2"], {}, {1: "pedestrian", 4: "car"}, [1, 1, 4, 1]),
    "ten columns without a meaning": (["1,-1,-1", "3,-1,-1"], {}, {}, [1, 3]),
    "COCO in ten columns": (["0,-1,-1", "2,-1,-1"], {}, {}, [1, 3]),
    "places in the world": (["7,8,9", "-3.5,2,0"], {}, {}, [1, 1]),
    "labels of CVAT": (["1,1.0", "2,1.0"], {"labels.txt": "car\nperson\n"}, {3: "car", 1: "person"}, [3, 1]),
    "names from 0": (["0,1", "2,1"], {"classes.txt": "person\nbike\ncar"}, {1: "person", 2: "car"}, [1, 2]),
    "a file of names": (["1,1", "2,1"], {"my.names": "car\nperson"}, {3: "car", 1: "person"}, [3, 1]),
    "a data.yaml": (["0,1", "2,1"], {"data.yaml": "names: [person, bike, car]"}, {1: "person", 2: "car"}, [1, 2]),
    "MOT17": (["1,1", "3,0.5"], {}, {1: "pedestrian", 3: "car"}, [1, 3]),
}


@pytest.mark.parametrize(("ends", "files", "classes", "ids"), NAMED.values(), ids=NAMED)
def test_column_8_of_motchallenge_is_a_class_where_it_can_be_one(ends, files, classes, ids, tmp_path):
    path = tmp_path / "gt.txt"
    path.write_text("".join(f"1,{n},{100 * n},20,30,60,1,{end}\n" for n, end in enumerate(ends, start=1)))
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    table = read_labels(path, role="detections")
    assert (table.classes, table.class_id.tolist()) == (classes, ids)
    people = read_labels(path, role="tracks")
    assert people.id.tolist() == [n for n, kind in enumerate(ids, start=1) if kind == 1]
    is_nameless = not classes and set(ids) != {1}
    assert ("classes" in [code for _, code in table.doubts]) == is_nameless


@pytest.mark.parametrize("name", WRITERS)
def test_a_format_obeys_the_laws_and_refuses_damaged_files_in_a_line(name, tmp_path):
    check_label_format(format_named(name), WRITERS[name].write(tmp_path, WALK))


@pytest.mark.parametrize("name", WRITERS)
def test_hidden_files_beside_labels_change_nothing(name, tmp_path):
    path = WRITERS[name].write(tmp_path, WALK)
    before = read_labels(path, name, "detections")
    for file in [*tmp_path.rglob("*")]:
        (file.parent / f"._{file.name}").write_bytes(b"\0\5\26\7\0\2\0\0Mac OS X        \xff")
    for hidden in ("._a.names", "._9.jpg", "._9.txt"):
        for folder in (tmp_path, path if path.is_dir() else path.parent):
            (folder / hidden).write_bytes(b"\0\5\26\7")
    after = read_labels(path, name, "detections")
    assert (after.facts.found_by, after.remarks, after.doubts) == (before.facts.found_by, before.remarks, before.doubts)
    for column, values in before.columns().items():
        np.testing.assert_array_equal(after.columns()[column], values)
