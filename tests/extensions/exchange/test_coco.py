"""Files of coco."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from mcaptrack.extensions.exchange import coco as coco_format
from mcaptrack.extensions.exchange import gathered
from mcaptrack.sources.ingest.job import fitted
from mcaptrack.sources.ingest.labels import format as formats
from tests.label_cases import Row, Writer, as_json, read, refused, said, table


def annotations(rows: Sequence[Row]) -> Any:
    kinds = {"person": 1, "car": 2, "77": 77, None: None}
    images = [{"id": n, "frame_id": n, "width": 640, "height": 480} for n in sorted({row.frame for row in rows})]
    entries = [
        {"image_id": row.frame, "track_id": row.id, "bbox": list(row.box), "score": row.score, "category_id": kinds[row.kind]}
        for row in rows
    ]  # fmt: skip
    return {
        "images": images,
        "annotations": entries,
        "categories": [{"id": kinds[kind], "name": kind} for kind in ("person", "car")],
    }


WRITERS = {
    "coco": Writer(as_json(annotations), names=False, size=True, first="listed"),
}


NAN = float("nan")


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
    monkeypatch.setattr(coco_format, "MAX_NAMES", 2)
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
