"""Tables, JSON and folders of boxes: every number up to its bound, every sentence in full, expected by hand."""

from __future__ import annotations

import json
import re
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.ingest.job import fitted
from mcaptrack.sources.ingest.labels import coco as coco_format
from mcaptrack.sources.ingest.labels import delimited, gathered, yolo
from mcaptrack.sources.ingest.labels import format as formats
from mcaptrack.sources.ingest.labels import text as texts
from mcaptrack.sources.ingest.labels.reading import read_labels
from mcaptrack.sources.ingest.labels.table import BoxTable
from mcaptrack.sources.ingest.labels.timeline import Timeline

NAN = float("nan")


def read(folder: Path, content: Any, role: str = "detections", name: str = "a", **options: Any) -> BoxTable:
    """Labels of a file with this text, or of JSON of something else."""
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_labels(path, role=role, **options)


def refused(folder: Path, content: Any, role: str = "detections") -> str:
    """What is said of it, after the name of the file."""
    with pytest.raises(McaptrackError) as error:
        read(folder, content, role)
    assert str(error.value).startswith(str(folder / "a"))
    return str(error.value)[len(str(folder / "a")) :]


def said(folder: Path, labels: BoxTable) -> list[str]:
    """Doubts, after the name of the file."""
    assert all(words.startswith(str(folder)) for words, _ in labels.doubts)
    return [words.removeprefix(str(folder / "a")) for words, _ in labels.doubts]


def table(*rows: str, header: str = "frame,x,y,w,h") -> str:
    return "\n".join([header, *rows])


# Numbers up to their bounds


@pytest.mark.parametrize(
    ("column", "taken", "not_taken", "words"),
    [
        ("frame", ["0", "2147483647"], ["-1", "2147483648", "0.5"], "the frame (a count of pictures, no time) has to be a whole number from 0 to 2147483647, not {:g}"),
        ("id", ["-1", "0", "9007199254740991"], ["-2", "9007199254740992", "1.5"], "the id has to be a whole number from -1 to 9007199254740991, not {:g}"),
        ("class", ["-1", "1", "2147483647"], ["-2", "2147483648", "2.5"], "the class has to be a whole number from -1 to 2147483647, not {:g}"),
        ("score", ["1e9", "-1e9"], ["1.5e9", "-1.5e9"], "a score can't be {:g}"),
        ("x", ["1e8", "-1e8"], ["1.5e8", "-1.5e8"], "a coordinate can't be {:g}; at most 1e+08"),
        ("h", ["0", "1e8"], ["1.5e8"], "a coordinate can't be {:g}; at most 1e+08"),
        ("w", ["0"], ["-0.5"], "a box can't be {:g} wide and 6 high"),
    ],
)  # fmt: skip
def test_a_number_of_a_table_is_taken_up_to_its_bound(column, taken, not_taken, words, tmp_path):
    keys = ["frame", "x", "y", "w", "h", "id", "class", "score"]
    usual = dict(zip(keys, ["3", "10", "20", "5", "6", "7", "2", "0.5"], strict=True))

    def rows(value: str) -> str:
        both = [",".join((usual | more).values()) for more in ({}, {column: value})]
        return table(*both, header="frame,x,y,w,h,track_id,class,score")

    for value in taken:
        labels = read(tmp_path, rows(value))
        assert len(labels.frame) == 2
        if column in ("frame", "id"):
            assert int(float(value)) in getattr(labels, column).tolist()
    for value in not_taken:
        shown = refused(tmp_path, rows(value))
        number = float(value)
        assert shown == ":3: " + words.format(abs(number) if column == "x" else number)


def test_a_category_has_a_number_within_bounds_and_a_name(tmp_path):
    people = {"id": 5, "name": "person"}
    for number in (0, 2**31 - 1):
        content = coco([0], [box(0)], categories=[people, {"id": number, "name": "dog"}])
        assert read(tmp_path, content).classes == {1: "person"} or number == 0
    wrong = [{"id": number, "name": "a"} for number in (-1, 2**31, True, 1.0)]
    for entry in (*wrong, 3, {"id": 1}, {"name": "a"}):
        content = coco([0], [box(0)], categories=[people, entry])
        assert refused(tmp_path, content) == ": category 1 has no whole number as its id, or no name"


def coco(images: list[Any], entries: list[Any], **more: Any) -> dict[str, Any]:
    """Annotations of images with these ids, or as they are given."""
    return {
        "images": [one if isinstance(one, dict) else {"id": one} for one in images],
        "annotations": entries,
        "categories": [{"id": 5, "name": "person"}],
    } | more


def box(image: Any, place: tuple[float, ...] = (1, 2, 3, 4), **more: Any) -> dict[str, Any]:
    return {"image_id": image, "bbox": [*place], "category_id": 5} | more


def test_images_are_objects_with_an_id(tmp_path):
    for images in (None, "ab", {"id": 1}, [1], [{"id": 1}, {}], [[]]):
        content = {"images": images, "annotations": [box(1)]}
        assert refused(tmp_path, content) == ": `images` is not a list of objects with an id each"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"bbox": [1, 2, 3]}, "has no bbox of 4 numbers: left, top, width, height"),
        ({"bbox": [1, 2, 3, 4, 5]}, "has no bbox of 4 numbers: left, top, width, height"),
        ({"bbox": [1, 2, 3, True]}, "has no bbox of 4 numbers: left, top, width, height"),
        ({"bbox": "1234"}, "has no bbox of 4 numbers: left, top, width, height"),
        ({"score": "0.5"}, "has a score that isn't a number, '0.5'"),
        ({"category_id": [1]}, "has a category_id that isn't a number, [1]"),
        ({"track_id": [1]}, "has a track_id that isn't a number, [1]"),
        ({"iscrowd": "no"}, "has a iscrowd that isn't a number, 'no'"),
        ({"image_id": 7}, "is of image 7, which isn't among the images"),
    ],
)
def test_an_annotation_that_is_wrong_is_named(change, words, tmp_path):
    assert refused(tmp_path, coco([0], [box(0), box(0) | change])) == f": annotation 1 {words}"
    assert refused(tmp_path, coco([0], [box(0), 3])) == ": annotation 1 is not an object"


def test_results_need_an_image(tmp_path):
    assert refused(tmp_path, [box(0), {"bbox": [1, 2, 3, 4]}]) == ": result 1 has no image_id"
    labels = read(tmp_path, [box(4), box("cam_0007.jpg")])
    assert labels.frame.tolist() == [4, 7]
    assert labels.remarks[0].partition(": ")[2] == "the number in image_id is taken as the frame"


@pytest.mark.parametrize("seed", range(8))
def test_results_have_the_frames_sizes_and_names_of_the_annotations_beside_them(seed, tmp_path):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 9))
    ids = rng.choice(600_000, count, replace=False)  # as those of COCO, in no order
    images = [
        {"id": int(key), "file_name": f"cam_{frame + seed:06}.jpg", "width": 640, "height": 480}
        for frame, key in enumerate(ids)
    ]
    places = rng.uniform(0, 400, (count, 4)).round(2).tolist()
    truth = coco(images, [box(image["id"], place) for image, place in zip(images, places, strict=True)])
    some = rng.permutation(count)[: int(rng.integers(1, count + 1))]
    results = [box(int(ids[at]), places[at], score=0.5) for at in some]
    (tmp_path / "other.json").write_text(json.dumps(coco([1, 2], [])))
    before = read(tmp_path, results)
    assert sorted(before.frame.tolist()) == sorted(ids[some].tolist())
    expected = read(tmp_path, truth, name="truth.json")
    labels = read(tmp_path, results)
    assert labels.frame.tolist() == [at + seed for at in sorted(some.tolist())]
    assert labels.boxes_px.tolist() == [places[at] for at in sorted(some.tolist())]
    assert (labels.facts.names, labels.facts.size) == ({5: "person"}, (640, 480))
    assert (labels.facts.sizes, labels.first_frame) == (expected.facts.sizes, expected.first_frame)
    assert labels.facts.named_by == str(tmp_path / "truth.json")
    assert [
        words for words in labels.remarks if words.endswith(f"are those of the images in {tmp_path / 'truth.json'}")
    ]
    changed = [{**image, "file_name": f"cam_{frame + 99:06}.jpg"} for frame, image in enumerate(images)]
    (tmp_path / "two.json").write_text(json.dumps({"images": changed}))
    labels = read(tmp_path, results)
    assert sorted(labels.frame.tolist()) == sorted(ids[some].tolist())
    assert any(
        "truth.json and two.json beside it name its images differently" in words for words in said(tmp_path, labels)
    )


def test_files_have_no_more_boxes_and_classes_than_the_limits(tmp_path, monkeypatch):
    monkeypatch.setattr(gathered, "MAX_ROWS", 2)
    monkeypatch.setattr(coco_format, "_MAX_CLASSES", 2)
    kinds = [{"id": number, "name": f"n{number}"} for number in range(5, 8)]
    for make in (lambda count: coco([0], [box(0)] * count), lambda count: [box(0)] * count):
        assert len(read(tmp_path, make(2)).frame) == 2
        assert refused(tmp_path, make(3)) == " has more than 2 boxes; give it in parts"
    assert len(read(tmp_path, coco([0], [box(0)], categories=kinds[:2])).frame) == 1
    assert refused(tmp_path, coco([0], [box(0)], categories=kinds)) == " has 3 categories; at most 2 are read"
    monkeypatch.setattr(formats, "_MAX_BYTES", 100)
    text = json.dumps([box(0)])
    assert len(read(tmp_path, text.ljust(100)).frame) == 1
    assert refused(tmp_path, text.ljust(101)) == " has 101 bytes; at most 100 of JSON are read: give it in parts"


# Frames, ids and classes


@pytest.mark.parametrize(
    ("images", "frames", "order"),
    [
        ([{"id": 7, "frame_id": 4}, {"id": 8, "frame_id": 2}], [4, 2], "frame_id"),
        ([{"id": 7, "frame_id": 0, "frame_index": 9}, {"id": 8, "frame_id": 1, "frame_index": 8}], [0, 1], "frame_id"),
        ([{"id": 7, "frame_id": 4, "frame_index": 9}, {"id": 8, "frame_id": 4, "frame_index": 8}], [9, 8], "frame_index"),
        ([{"id": 7, "frame_id": -1, "mot_frame_id": 3}, {"id": 8, "frame_id": 1, "mot_frame_id": 1}], [3, 1], "mot_frame_id"),
        ([{"id": 7, "frame_id": 2**31 - 1}, {"id": 8, "frame_id": 5}], [2**31 - 1, 5], "frame_id"),
        ([{"id": 7, "frame_id": 2**31}, {"id": 8, "frame_id": 1}], [0, 1], "the list `images`"),
        ([{"id": 7, "file_name": "a/x_12.jpg"}, {"id": 8, "file_name": "b/x_3.jpg"}], [12, 3], "the numbers in file_name"),
        ([{"id": 7, "file_name": "a_1.jpg"}, {"id": 8, "file_name": "b_2.jpg"}], [0, 1], "the list `images`"),
        ([{"id": 7, "file_name": "a_1.jpg"}, {"id": 8}], [0, 1], "the list `images`"),
    ],
)  # fmt: skip
def test_the_frame_of_an_image_is_the_best_number_that_it_has(images, frames, order, tmp_path):
    labels = read(tmp_path, coco(images, [box(7, (7, 2, 3, 4)), box(8, (8, 2, 3, 4))]))
    assert dict(zip(labels.boxes_px[:, 0].tolist(), labels.frame.tolist(), strict=True)) == {7: frames[0], 8: frames[1]}
    assert labels.first_frame == min(frames)
    assert labels.remarks[0] == f"{tmp_path / 'a'}: 2 images, in order of {order}"
    assert labels.facts.is_first_assumed == (min(frames) > 0)


def test_the_id_of_a_track_is_under_several_keys(tmp_path):
    entries = [
        box(0, attributes={"track_id": 4, "instance_id": 5}),
        box(0, instance_id=6, tracker_id=7, attributes={"track_id": 8}),
        box(0, tracker_id=9),
        box(0),
        box(0, attributes=[1]),
    ]
    assert sorted(read(tmp_path, coco([0], entries[:4])).id.tolist()) == [-1, 4, 6, 9]
    assert sorted(read(tmp_path, coco([0], entries)).id.tolist()) == [-1, -1, 4, 6, 9]


def test_eight_classes_without_a_name_are_listed(tmp_path):
    for count, shown in ((8, "10, 11, 12, 13, 14, 15, 16, 17"), (9, "10, 11, 12, 13, 14, 15, 16, 17 and 1 more")):
        labels = read(tmp_path, coco([0], [box(0, (n, 2, 3, 4), category_id=10 + n) for n in range(count)] + [box(0)]))
        assert said(tmp_path, labels) == [f": {count} boxes have classes without a name ({shown}); their class_id is 0"]
        assert labels.class_id.tolist() == [0] * count + [1]


def test_boxes_that_are_there_before_are_counted(tmp_path):
    same = [box(0), box(0), box(0), box(0, (1, 2, 3, 5)), box(0, category_id=None), box(0, track_id=1), box(1)]
    images = [{"id": 0, "frame_id": 0}, {"id": 1, "frame_id": 1}]
    words = ": 2 of 7 boxes are there before, with the same frame and class; they stay as they are"
    assert words in said(tmp_path, read(tmp_path, coco(images, same)))
    assert not any("there before" in words for words in said(tmp_path, read(tmp_path, coco(images, same[2:]))))


def test_boxes_without_a_class_have_none_and_that_is_said(tmp_path):
    without = {"image_id": 0, "bbox": [1, 2, 3, 4]}
    labels = read(tmp_path, coco([0], [box(0), without, without | {"bbox": [5, 2, 3, 4]}]))
    assert labels.class_id.tolist() == [1, 0, 0]
    assert said(tmp_path, labels) == [": 2 boxes without a class have class_id 0"]
    assert labels.doubts[0][1] == "classes"
    for text, wanted in (
        (table("1,1,1,1,1,2", "1,2,2,2,2,-1", header="frame,x,y,w,h,class"), [2, 0]),
        (table("1,1,1,1,1,0", "1,2,2,2,2,", header="frame,x,y,w,h,class"), [1, 0]),
    ):
        labels = read(tmp_path, text)
        assert labels.class_id.tolist() == wanted
        people = "class 1 is taken as people"
        if wanted[0] == 1:
            people = "class 0 is taken as people, and class_id is one higher than the file's numbers"
        said_of_both = [": 1 boxes without a class have class_id 0", f" has no class names; {people}"]
        assert all(any(words.startswith(one) for words in said(tmp_path, labels)) for one in said_of_both)


def test_rows_that_do_not_suit_tracks_are_counted(tmp_path):
    names = [f"k{n:02}" for n in range(10)]
    kinds = [{"id": 5, "name": "person"}, *({"id": 10 + n, "name": name} for n, name in enumerate(names))]
    entries = [box(0, track_id=1), box(0), box(0), box(0, iscrowd=1, category_id=10)]
    entries += [box(0, category_id=10 + n) for n in range(10) for _ in range(10 - n)]
    content = coco([0], entries, categories=kinds)
    listed = ", ".join(f"{10 - n} {name}" for n, name in enumerate(names[:8]))
    labels = read(tmp_path, content, "tracks")
    others = "3 of other classes and 1 regions (iscrowd) and 2 boxes without a track id"
    assert labels.left_out == f"{listed}, {others}"
    assert labels.id.tolist() == [1]
    assert labels.ignored is None
    truth = read(tmp_path, content, "truth").ignored
    assert (truth.frame.tolist(), truth.boxes_px.tolist()) == ([0], [[1, 2, 3, 4]])
    assert (truth.forgiven.tolist(), truth.region.tolist()) == ([False], [True])
    assert len(read(tmp_path, content).frame) == len(entries) - 1
    only = coco([0], [box(0, category_id=10), box(0, category_id=99)], categories=kinds)
    why = " holds no people, only 1 k00, 1 of unknown class; `classes=` takes others"
    assert refused(tmp_path, only, "tracks") == why
    crowds = coco([0], [box(0, iscrowd=1)] * 2)
    assert refused(tmp_path, crowds) == " holds no such boxes, only 2 regions (iscrowd)"
    eight = coco([0], [box(0, track_id=1), *entries[4:]], categories=kinds[:1] + kinds[1:9])
    assert "of other classes" not in read(tmp_path, {**eight, "annotations": [
        one for one in eight["annotations"] if one["category_id"] < 18]}, "tracks").left_out  # fmt: skip


def test_scores_that_are_no_likelihoods_are_said(tmp_path):
    for scores, words in (
        ([0, 1], []),
        ([1.5, 3, 0.5], ["of 3 scores 2 above 1 (up to 3)"]),
        ([-0.5, 0.5], ["of 2 scores 1 below 0 (down to -0.5)"]),
        ([-0.5, 2], ["of 2 scores 1 above 1 (up to 2)", "of 2 scores 1 below 0 (down to -0.5)"]),
    ):
        labels = read(tmp_path, coco([0], [box(0, (n, 2, 3, 4), score=score) for n, score in enumerate(scores)]))
        assert labels.score.tolist() == scores
        assert said(tmp_path, labels) == [f": {one}; they stay as they are" for one in words]


WHOLLY, MOSTLY = "lie outside of their pictures", "lie outside of their pictures by more than half"


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ((97.5, 0, 5, 5), None),
        ((97.6, 0, 5, 5), MOSTLY),
        ((99.5, 0, 5, 5), MOSTLY),
        ((100, 0, 5, 5), WHOLLY),
        ((0, 50, 5, 5), WHOLLY),
        ((0, 49.5, 5, 5), MOSTLY),
        ((0, 47.5, 5, 5), None),
        ((-5, 0, 5, 5), WHOLLY),
        ((-5, 0, 5.5, 5), MOSTLY),
        ((-2.5, 0, 5, 5), None),
        ((0, -5, 5, 5), WHOLLY),
        ((0, -2.6, 5, 5), MOSTLY),
        ((0, -2.5, 5, 5), None),
        ((-2, -2, 5, 5), MOSTLY),  # 9 of 25
        ((-1, -1, 5, 5), None),  # 16 of 25
        ((-100, -50, 300, 150), MOSTLY),  # the picture is a ninth of it
    ],
)
def test_a_box_is_outside_where_no_pixel_of_it_or_less_than_half_is_inside(place, words, tmp_path):
    wanted = [f"of 2 boxes 1 {words}; they stay as they are"] if words else []
    images = [{"id": 0, "frame_id": 0, "width": 100, "height": 50}, {"id": 1, "frame_id": 1, "width": 1}]
    labels = read(tmp_path, coco(images, [box(0, place), box(1, (500, 500, 1, 1))]))
    assert [words.removeprefix(": ") for words in said(tmp_path, labels)] == wanted
    path = tmp_path / "a"
    labels = read(tmp_path, table(f"0,{','.join(map(str, place))}", "1,1,1,1.5,1"))
    before = labels.boxes_px.tolist()
    labels = fitted(labels, (100, 50))
    assert [words.removeprefix(f"{path}: ") for words, _ in labels.doubts] == wanted
    assert labels.boxes_px.tolist() == before


def test_shares_become_pixels_once(tmp_path):
    labels = read(tmp_path, table("0,0.25,0.5,0.125,1"))
    assert labels.is_normalised
    for _ in range(2):
        labels = fitted(labels, (64, 32))
        assert labels.boxes_px.tolist() == [[16, 16, 8, 32]]
    assert read(tmp_path, table("0,0.25,0.5,0.125,2")).is_normalised
    assert not read(tmp_path, table("0,0.25,0.5,0.125,2.01")).is_normalised
    assert not read(tmp_path, table("0,1,0,1,2")).is_normalised  # whole numbers
    assert read(tmp_path, table("0,-2,0.5,0.125,0.5")).is_normalised


# Tables


def test_the_first_frame_is_0_or_1_or_given(tmp_path):
    for first, frame in ((0, 0), (1, 1), (1, 5)):
        labels = read(tmp_path, table(f"{frame},1,2,3,4"))
        assert labels.first_frame == first
        words = (
            f": frames begin with {frame}; frame 1 is assumed to be the first picture, `first_frame=` sets the number"
        )
        assert said(tmp_path, labels) == ([words] if frame else [])
    assert said(tmp_path, read(tmp_path, table("5,1,2,3,4"), first_frame=5)) == []


@pytest.mark.parametrize(
    ("header", "unit"),
    [("t", 1), ("time_s", 1), ("t_ms", 1e-3), ("time us", 1e-6), ("timestamp(ns)", 1e-9), ("timestamp_ns", 1e-9)],
)
def test_the_unit_of_times_is_in_the_name_of_the_column(header, unit, tmp_path):
    labels = read(tmp_path, table("5,1,2,3,4", "3,1,2,3,4", "5,9,9,9,9", header=f"{header},x,y,w,h"))
    np.testing.assert_allclose(labels.times_s, [3 * unit, 5 * unit], rtol=1e-15)
    assert (labels.first_frame, labels.frame.tolist()) == (0, [0, 1, 1])


def test_times_reach_to_2262(tmp_path):
    for time in ("0", "9.2e9"):
        assert read(tmp_path, table(f"{time},1,2,3,4", header="t,x,y,w,h")).times_s.tolist() == [float(time)]
    for time in ("-0.1", "9.3e9", "nan"):
        words = f":2: a time is a number of seconds from 0 to the year 2262, not {float(time):g}; "
        words += "the name of its column may end with _ms, _us or _ns"
        assert refused(tmp_path, table(f"{time},1,2,3,4", header="t,x,y,w,h")) == words


def test_a_column_of_ids_that_numbers_rows_is_none(tmp_path):
    rows = ["1,1,2,3,4,7", "1,5,6,7,8,9", "2,5,6,7,8,8"]
    labels = read(tmp_path, table(*rows, header="frame,x,y,w,h,ID"))
    assert labels.id.tolist() == [-1] * 3
    assert f"{tmp_path / 'a'}: every box has another ID, so it numbers rows, not tracks" in labels.remarks
    assert sorted(read(tmp_path, table(*rows, "3,1,1,1,1,7", header="frame,x,y,w,h,ID")).id.tolist()) == [7, 7, 8, 9]
    assert sorted(read(tmp_path, table(*rows, header="frame,x,y,w,h,track_id")).id.tolist()) == [7, 8, 9]
    assert read(tmp_path, table(rows[0], header="frame,x,y,w,h,id")).id.tolist() == [7]
    named = read(tmp_path, table(*rows, header="frame,x,y,w,h,id"), columns={"id": "id"})
    assert sorted(named.id.tolist()) == [7, 8, 9]


def test_a_cell_may_say_nothing(tmp_path):
    for empty in ("", "nan", "None", "NULL", "n/a", "NA"):
        labels = read(tmp_path, table(f"1,1,2,3,4,{empty},{empty}", header="frame,x,y,w,h,score,track_id"))
        assert (str(labels.score.tolist()), labels.id.tolist()) == ("[nan]", [-1])


@pytest.mark.parametrize(
    ("header", "row", "wanted"),
    [
        ("frame,x,y,w,h", "1,10,20,4,6", [10, 20, 4, 6]),
        ("frame,x1,y1,x2,y2", "1,10,20,14,26", [10, 20, 4, 6]),
        ("frame,cx,cy,w,h", "1,10,20,4,6", [8, 17, 4, 6]),
        ("frame,x1,y1,w,h,x2,y2", "1,10,20,640,480,14,26", [10, 20, 4, 6]),
        ("frame;x;y;w;h", "1;10,5;20;4;6", [10.5, 20, 4, 6]),
        ("frame\tx\ty\tw\th", "1\t10.5\t20\t4\t6", [10.5, 20, 4, 6]),
        ("frame\tx\ty\tw\th", "1\t10,5\t20\t4\t6", [10.5, 20, 4, 6]),
    ],
)
def test_boxes_have_corners_or_sizes_or_centres(header, row, wanted, tmp_path):
    labels = read(tmp_path, table(row, header=header))
    assert labels.boxes_px.tolist() == [wanted]
    assert ("; not read: w, h" in labels.remarks[0]) == ("w,h,x2" in header)


@pytest.mark.parametrize(
    ("header", "rows", "classes", "names"),
    [
        # numbers alone, from 0 on and from 1 on
        ("class", ["0", "1", "3"], [1, 2, 4], {}),
        ("class", ["1", "3", "3"], [1, 3, 3], {}),
        # names: people are 1, others by the alphabet, in any case
        ("class", ["dog", "Human", "Car"], [3, 1, 2], {3: "dog", 1: "Human", 2: "Car"}),
        ("class_name", ["dog", "DOG", "pedestrian"], [2, 2, 1], {2: "dog", 1: "pedestrian"}),
        # numbers with their names
        ("class,class_name", ["7,dog", "0,person", "7,dog"], [7, 1, 7], {7: "dog", 1: "person"}),
        # names of something else
        ("team,name", ["7,dog", "0,person"], [1, 1], {}),
        # a number that has two names is none
        ("class,class_name", ["7,dog", "0,person", "7,cat"], [3, 1, 2], {3: "dog", 1: "person", 2: "cat"}),
    ],
)
def test_classes_are_numbers_or_names_or_both(header, rows, classes, names, tmp_path):
    text = table(*(f"{n},1,2,3,4,{row}" for n, row in enumerate(rows)), header=f"frame,x,y,w,h,{header}")
    labels = read(tmp_path, text)
    assert labels.class_id.tolist() == classes
    assert labels.classes == names


def test_rows_of_json_say_which_one_is_wrong(tmp_path):
    good = {"x_min": 1, "y_min": 2, "x_max": 3, "y_max": 4, "class_id": 0, "confidence": 0.5, "tracker_id": 1}
    row = good | {"frame_index": 0}
    assert read(tmp_path, [row]).boxes_px.tolist() == [[1, 2, 2, 2]]
    assert refused(tmp_path, [row, row | {"more": 1}]).startswith(
        ": row 2 has other keys than the first one: {'x_min': 1"
    )
    assert "the column of frames holds names without a number" in refused(tmp_path, [row, good])
    assert refused(tmp_path, [row, 5]).startswith(" holds no rows: a list of objects")
    assert refused(tmp_path, [good]).startswith(":1: no column for the frame or the time of boxes")
    assert refused(tmp_path, [row, row | {"x_min": "a"}]).startswith(":2: not a row of x_min, y_min, ")
    assert read(tmp_path, [row | {"frame_index": 9}]).first_frame == 0
    assert refused(tmp_path, [row | {f"k{n}": 0 for n in range(1017)}]) == ":1: more than 1024 columns"
    assert len(read(tmp_path, [row | {f"k{n}": 0 for n in range(1016)}]).frame) == 1


def test_a_header_has_four_names_and_no_number(tmp_path):
    assert refused(tmp_path, "a,b,c\n1,2,3").startswith(":1: a row of 3 columns fits no label format")
    assert refused(tmp_path, "a,b,c,d\n1,2,3,4").startswith(":1: no columns for x and x2 (or x and w)")
    assert delimited.header_of(Path("a"), "a,b,c,5") == []
    assert delimited.header_of(Path("a"), '"a b", "c;d",e,f') == ["a b", "c;d", "e", "f"]
    assert delimited.header_of(Path("a"), "abcd") == []


def test_names_of_pictures_are_numbered_in_one_sequence():
    numbers = texts.numbers_of_names
    assert numbers(["d/x12_a.jpg", "e\\x007_a.png"]) == [12, 7]
    assert numbers(["1_2.jpg", "1_3.jpg"]) == [2, 3]
    assert numbers(["x1.jpg", "y2.jpg"]) is None
    assert numbers(["x1a.jpg", "x2b.jpg"]) is None
    assert numbers(["x1.jpg", "x01.jpg"]) is None
    assert numbers(["x"]) is None
    assert numbers([]) == []
    assert numbers([f"{2**31 - 1}"]) == [2**31 - 1]
    assert numbers([f"{2**31}"]) is None
    with pytest.raises(ValueError, match=r"names of several sequences, 'a.b' and 'c'"):
        reader = texts.FrameNames()
        assert (reader.number("a.3b.jpg"), reader.number("4c")) == (3, 4)


# Folders of YOLO


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
    monkeypatch.setattr(yolo, "MAX_ROWS", 2)
    monkeypatch.setattr(yolo, "_MAX_FILES", 2)
    assert len(read_labels(tmp_path, role="detections").frame) == 2
    (tmp_path / "a.txt").write_text(f"{ROW}\n{ROW}")
    with pytest.raises(McaptrackError, match="has more than 2 rows; give it in parts"):
        read_labels(tmp_path, role="detections")
    (tmp_path / "c.txt").write_text("")
    with pytest.raises(McaptrackError, match="holds 3 label files; at most 2 are read"):
        read_labels(tmp_path, role="detections")


# Times


@pytest.mark.parametrize(
    ("seconds", "fps", "times", "words"),
    [
        ([1.0, 1.5, 2.5], None, [1.0, 1.5, 2.0, 2.5], "4 frames by the times, about 2 a second, 1 of them without boxes"),
        ([3.0], None, [3.0], "1 frames by the times, about 1 a second, 0 of them without boxes"),
        ([1.0, 1.5, 2.3], None, [1.0, 1.5, 2.3], "3 frames by the times, which are irregular; frames without boxes are not known"),
        ([0.0, 1.0, 2.5], None, [0.0, 1.0, 2.5], "3 frames by the times, which are irregular; frames without boxes are not known"),
        ([1.0, 2.0], Fraction(2), [1.0, 1.5, 2.0], "3 frames by the times, about 2 a second, 1 of them without boxes"),
        ([1.0, 1.6], Fraction(2), [1.0, 1.6], "2 frames by the times, about 2 a second, 0 of them without boxes"),
    ],
)  # fmt: skip
def test_pictures_by_times(seconds, fps, times, words):
    made, text = Timeline.of_times(Path("a"), np.array(seconds), fps)
    assert (made.t_ns / 1e9).tolist() == times
    assert made.index.tolist() == list(range(len(times)))
    assert text == words


def test_pictures_by_times_have_limits():
    for last, count in ((99_999.0, 100_000), (100_000.0, 3)):
        made, _ = Timeline.of_times(Path("a"), np.array([0.0, 1.0, last]), None)
        assert len(made.index) == count
    for times in ([0.0, 0.63], [0.0, 0.1, 1.0]):  # the second has two in one frame
        with pytest.raises(McaptrackError, match=r"^a: its times are no multiples of 1/2 s; leave `fps=` out$"):
            Timeline.of_times(Path("a"), np.array(times), Fraction(2))
    with pytest.raises(McaptrackError, match="its times are less than a nanosecond apart"):
        Timeline.of_times(Path("a"), np.array([1.0, 1.0 + 4e-10]), None)


def placed(folder: Path, made: Timeline, *seconds: float) -> list[int]:
    """The row of labels at these times that each picture has; -1 for none."""
    labels = read(folder, table(*(f"{s},1,2,3,4" for s in seconds), header="t,x,y,w,h"))
    return made.place(labels, "tracks", []).number.tolist()


def test_times_of_labels_belong_to_the_nearest_picture_that_is_near(tmp_path):
    even = Timeline.spaced(4, Fraction(10), 10**15, "the pictures")
    assert placed(tmp_path, even, 0.0, 0.3) == [0, -1, -1, 1]
    assert placed(tmp_path, even, 0.049, 0.151) == [0, -1, 1, -1]
    assert placed(tmp_path, even, 0.35) == [-1, -1, -1, 0]
    since_1970 = Timeline.spaced(4, Fraction(10), 1_700_000_000 * 10**9, "the pictures")
    assert placed(tmp_path, since_1970, 1_700_000_000.21, 1_700_000_000.09) == [-1, 0, 1, -1]
    uneven = Timeline(np.arange(5), np.array([0, 1, 2, 9, 10]) * 10**8, "the pictures")
    one = Timeline(np.array([0]), np.array([5 * 10**9]), "the pictures")
    for seconds in (0.4, 0.5, 5.5, 4.5):  # in the log, or since the only picture
        assert placed(tmp_path, one, seconds) == [0]
    for made, times, words in (
        (even, (0.051, 0.149), "0.051 and 0.149 s are nearest to the same of the pictures"),
        (
            uneven,
            (0.15, 0.5, 0.9),
            "1 of 3 times are more than half an interval from any of the pictures, the first at 0.5 s",
        ),
        (uneven, (0.9, 1.06), "its times are from 0.9 to 1.06 s, the pictures from 0.000 to 1.000 s"),
        (one, (0.51,), "from 0.51 to 0.51 s, the pictures from 5.000 to 5.000 s"),
        (one, (5.51,), "from 5.51 to 5.51 s, the pictures from 5.000 to 5.000 s"),
    ):
        with pytest.raises(McaptrackError, match=re.escape(words)):
            placed(tmp_path, made, *times)
