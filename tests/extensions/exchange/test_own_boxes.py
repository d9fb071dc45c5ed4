"""Boxes of other detectors in files of COCO, YOLO and supervision, as tools write them."""

from __future__ import annotations

import json

import pytest

from mcaptrack.sources.ingest.labels.reading import read_labels
from tests.extensions.exchange.test_supervision import WRITERS
from tests.label_cases import Row
from tests.test_own_boxes import IDS, assert_numbered, assert_refused, table, written


def coco_with(tmp_path, images=None, box=(1, 2, 30, 40), category="3", name="person"):
    content = {
        "images": images or [{"id": k, "file_name": f"f_{k}.jpg", "width": 100, "height": 80} for k in range(2)],
        "annotations": [{"image_id": 1, "category_id": category, "bbox": box}],
        "categories": [{"id": category, "name": name}],
    }
    return table(tmp_path, json.dumps(content), name="a.json")


def test_coco_as_it_comes_from_tools(tmp_path):
    assert coco_with(tmp_path).classes == {1: "person"}  # numbers as text
    shares = coco_with(tmp_path, box=(0.1, 0.2, 0.5, 0.5))
    assert shares.is_normalised
    hashed = [{"id": k, "file_name": f"f_{5 - k}_jpg.rf.{'0a1b' * 8}.jpg"} for k in range(2)]
    assert coco_with(tmp_path, hashed).frame.tolist() == [4]
    unordered = coco_with(tmp_path, [{"id": 1, "file_name": "b.jpg"}, {"id": 0, "file_name": "a.jpg"}])
    assert unordered.frame.tolist() == [0]
    assert any("the order in `images` is taken as that of the pictures" in words for words, _ in unordered.doubts)


def test_yolo_as_it_comes_from_tools(tmp_path):
    for number, text in ((1, "0 .5 .5 .1 .2 .9\n"), (2, "1 .5 .5 .1 .2 .8\n")):
        written(tmp_path / "y", f"v_{number}_jpg.rf.{'0a1b' * 8}.txt", text)
    written(tmp_path / "y", "data.yaml", "names: [person\n")
    labels = read_labels(tmp_path / "y", role="detections")
    assert (labels.frame.tolist(), labels.score.tolist()) == ([1, 2], [0.9, 0.8])
    assert any("column 6 holds confidences" in words for words in labels.remarks)
    assert any("is not valid YAML" in words and "class names are not known" in words for words, _ in labels.doubts)


def test_only_frame_index_of_supervision_counts_from_0(tmp_path):
    text = WRITERS["supervision"].write(tmp_path, [Row(1)]).read_text()
    for column, first in (("frame_index", 0), ("frame_number", 1)):
        assert table(tmp_path, text.replace("frame_index", column)).first_frame == first


COCO = {"images": [{"id": 1}], "annotations": [{"image_id": 1, "bbox": [1, 2, 3, 4]}]}
BAD = {
    "an image without a number": ('[{"image_id":"","bbox":[1,2,3,4]}]', "result 0 has a wrong image_id: .* without a num"),
    "a number of 5000 digits": ('[{"image_id":1,"bbox":[1,1,1,' + "9" * 5000 + "]}]", "not valid JSON"),
    "NaN in JSON": ('[{"image_id":1,"bbox":[1,1,NaN,1]}]', "result 0: a number of the box is missing or not finite"),
    "an image twice": (json.dumps(COCO | {"images": [{"id": 1}, {"id": 1}]}), "1 is the id of several images"),
    "two videos": (json.dumps(COCO | {"images": [{"id": 1, "video_id": 1}, {"id": 2, "video_id": 2}]}), "2 videos"),
    "a category twice": (json.dumps(COCO | {"categories": [{"id": 1, "name": "a"}] * 2}), "1 is the id of several cat"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "words"), BAD.values(), ids=BAD)
def test_what_is_wrong_is_one_line_with_its_place(text, words, tmp_path):
    assert_refused(text, words, tmp_path)


def test_ids_that_are_texts_are_numbered_as_they_come(tmp_path):
    boxes = [{"image_id": k, "bbox": [10 * k, 2, 3, 4], "track_id": one or None} for k, one in enumerate(IDS)]
    text = json.dumps({"images": [{"id": k} for k in range(5)], "annotations": boxes})
    assert_numbered(written(tmp_path, "i.json", text))
