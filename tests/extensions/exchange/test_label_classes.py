"""Classes other than people in files of KITTI and COCO."""

from __future__ import annotations

import json

import pytest

from mcaptrack.sources.ingest.labels.reading import read_labels
from mcaptrack.sources.ingest.labels.roles import WantedClasses
from tests.test_label_classes import assert_kept, assert_numbered

KITTI = "".join(
    f"{t} {who} {kind} {cut} 0 0 {100 * who} 50 {100 * who + 40} 110 1 1 1 1 1 1 0\n"
    for t in (0, 1)
    for who, kind, cut in ((1, "Pedestrian", 0), (2, "Car", 0), (3, "Car", 1), (-1, "DontCare", -1))
)


COCO = json.dumps({
    "images": [{"id": n, "file_name": f"{n:03}.jpg", "width": 640, "height": 480} for n in (1, 2)],
    "categories": [{"id": 1, "name": "person"}, {"id": 17, "name": "cat"}, {"id": 3, "name": "car"}],
    "annotations": [
        {"id": 10 * n + c, "image_id": n, "category_id": c, "bbox": [10 * c, 20, 30, 60], "track_id": c}
        for n in (1, 2) for c in (1, 17, 3)
    ],
})  # fmt: skip


def test_people_of_kitti_that_are_hidden_or_cut_off_are_ignored_if_all_classes_count(tmp_path):
    (tmp_path / "a.txt").write_text("".join(
        f"0 {x} {kind} {cut} {hidden} 0 {x} 20 {x + 9} 40 1 1 1 1 1 1 0\n"
        for x, kind, cut, hidden in (
            (10, "Pedestrian", 0, 2), (20, "Pedestrian", 0, 3), (30, "Pedestrian", 1, 0), (50, "Car", 0, 0),
            (60, "DontCare", -1, -1),
        )
    ))  # fmt: skip
    every = read_labels(tmp_path / "a.txt", "kitti", "truth", wanted=WantedClasses("all"))
    assert (every.id.tolist(), every.left_out) == (
        [10, 50],
        "1 regions (DontCare) and 2 boxes that don't count (hidden or cut off)",
    )
    assert every.ignored.boxes_px[:, 0].tolist() == [20, 30, 60]


@pytest.mark.parametrize(
    ("form", "people", "everything", "one", "of_one"),
    [
        (("gt.txt", KITTI), {("Pedestrian", 1): {1}}, {("Pedestrian", 1): {1}, ("Car", 3): {2}}, "CAR", {("Car", 3): {2}}),
        (("gt.json", COCO), {("person", 1): {1}}, {("person", 1): {1}, ("car", 3): {3}, ("cat", 17): {17}}, "pedestrian,cat",
         {("person", 1): {1}, ("cat", 17): {17}}),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_wanted_classes_are_kept_with_their_names(tmp_path, form, people, everything, one, of_one):
    assert_kept(tmp_path, form, people, everything, one, of_one)


@pytest.mark.parametrize(
    "numbers",
    [
        {"Pedestrian": 1, "Cyclist": 2, "Car": 3, "Van": 4, "Truck": 5, "Tram": 6, "Person_sitting": 7, "Misc": 8, "Cow": 9},
        {"Person": 7, "Bus": 9},
    ],
)  # fmt: skip
def test_classes_have_their_numbers_and_others_the_next_ones(numbers, tmp_path):
    rows = [f"0 {n} {name} 0 0 0 {10 * n} 20 {10 * n + 9} 40 1 1 1 1 1 1 0\n" for n, name in enumerate(numbers)]
    assert_numbered("kitti", rows, numbers, tmp_path)
