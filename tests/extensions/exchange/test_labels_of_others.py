"""Files of other tools: one scene in every kind of file says the same, and what isn't read names a way."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mcaptrack.extensions.exchange.masks import box_of_mask
from mcaptrack.registry import own
from mcaptrack.sources.ingest.labels import of_packages
from mcaptrack.sources.ingest.labels.reading import label_file, read_labels
from mcaptrack.sources.ingest.labels.roles import WantedClasses
from tests.extensions.exchange.test_masks import youtube_vis
from tests.label_cases import WALK, Row, writers
from tests.test_label_classes import assert_kept, assert_numbered
from tests.test_labels_of_others import (
    ALL,
    NEITHER,
    NO_IDS,
    NO_SCORES,
    SCENE,
    SIZE,
    assert_not_read,
    assert_scene,
    places,
    written,
)

WRITERS = writers()
ROWS = [Row(frame, track, box, kind=label, score=score) for frame, track, label, *box, score in SCENE]


def old_labelme(folder: Path, number: int, rows: list[tuple[Any, ...]]) -> None:
    objects = ""
    for _, track, label, x, y, w, h, _ in rows:
        corners = "".join(f"<pt><x>{a}</x><y>{b}</y></pt>" for a in (x, x + w) for b in (y, y + h))
        objects += f"<object><name>{label}</name><polygon>{corners}</polygon><attributes>track_id={track}</attributes></object>"
    size = "<imagesize><nrows>480</nrows><ncols>640</ncols></imagesize>"
    written(folder / f"p{number}.xml", f"<annotation><filename>p{number}.jpg</filename>{size}{objects}</annotation>")


def kitti(with_id: bool, with_score: bool) -> Callable[[Path, int, list[tuple[Any, ...]]], None]:
    def write(folder: Path, number: int, rows: list[tuple[Any, ...]]) -> None:
        lines = ""
        for _, track, label, x, y, w, h, score in rows:
            lines += f"{label}{f' {track}' * with_id} 0 0 0 {x} {y} {x + w} {y + h} 0 0 0 0 0 0 0{f' {score}' * with_score}\n"
        written(folder / f"00_{number:06d}.txt", lines)

    return write


def yolo(folder: Path, number: int, rows: list[tuple[Any, ...]]) -> None:
    lines = ""
    for _, track, label, x, y, w, h, score in rows:
        centre = f"{(x + w / 2) / 640} {(y + h / 2) / 480} {w / 640} {h / 480}"
        lines += f"{('person', 'car').index(label)} {centre} {score} {track}\n"
    written(folder / f"p{number}.txt", lines)


def each(folder: Path, write: Callable[[Path, int, list[tuple[Any, ...]]], None], *others: tuple[str, Any]) -> Path:
    """A folder with a file of each picture, and other files beside it, by their place from it."""
    for number in range(4):  # the third picture has no rows
        write(folder, number, [row for row in SCENE if row[0] == number])
    for place, content in others:
        written(folder / place, content)
    return folder


def by_writer(name: str, folder: Path, place: str = "") -> Path:
    """The scene by the writer of a format, at a place in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    path = WRITERS[name].write(folder, ROWS)
    target = folder / place if place else path
    target.parent.mkdir(parents=True, exist_ok=True)
    return path.rename(target)


def via_project(folder: Path) -> Path:
    files = json.loads(by_writer("via", folder).read_text())
    for file in files.values():
        file["regions"] = {str(number): region for number, region in enumerate(file["regions"])}
    return written(folder / "a.json", {"_via_settings": {}, "_via_img_metadata": files})


def via_csv(folder: Path) -> Path:
    out = "filename,file_size,file_attributes,region_count,region_id,region_shape_attributes,region_attributes\n"
    for file in json.loads(by_writer("via", folder).read_text()).values():
        for region in file["regions"] or [{"shape_attributes": {}, "region_attributes": {}}]:
            cells = [json.dumps(value).replace('"', '""') for value in region.values()]
            out += f'{file["filename"]},9,"{{}}",1,0,"{cells[0]}","{cells[1]}"\n'
    return written(folder / "a.csv", out)


def runs(x: int, y: int, w: int, h: int) -> list[int]:
    """The runs of a mask that fills a box, column by column."""
    mask = np.zeros(SIZE, bool)
    mask[x : x + w, y : y + h] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask.ravel()])))
    return np.diff(np.concatenate([[0], edges, [mask.size]])).tolist()


def packed(counts: list[int]) -> str:
    """Runs as the text of COCO."""
    out = ""
    for at, count in enumerate(counts):
        value, goes_on = count - (counts[at - 2] if at > 2 else 0), True
        while goes_on:
            bits, value = value & 31, value >> 5
            goes_on = value != (-1 if bits & 16 else 0)
            out += chr(bits + 32 * goes_on + 48)
    return out


def with_masks(folder: Path) -> Path:
    content = json.loads(by_writer("youtube-vis", folder).read_text())
    for track in content["annotations"]:
        boxes = track.pop("bboxes")
        track["segmentations"] = [box and {"size": [480, 640], "counts": packed(runs(*box))} for box in boxes]
    return written(folder / "a.json", content)


def mots(rows: Any = SCENE) -> str:
    kinds = {"person": 2, "car": 1}
    return "".join(
        f"{row[0]} {row[1]} {kinds[row[2]]} 480 640 {packed(runs(*row[3:7]))}\n"
        for row in sorted(rows, key=lambda row: row[0])
    )


def test_a_mask_has_the_box_that_pycocotools_gives(tmp_path):
    box = {"size": [480, 640], "counts": "TU>^3b;" + "0" * 77 + "lR[8"}
    assert box_of_mask(box) == [30, 100, 40, 110]  # as pycocotools wrote a box of these sides
    assert box_of_mask({"size": [2, 3], "counts": [1, 2, 3]}) == [0, 0, 2, 2]  # a run over two columns fills them
    assert box_of_mask({"size": [2, 3], "counts": [6]}) == [0, 0, 0, 0]
    for wrong in ([1, 9], [-1, 2], "\x00"):
        with pytest.raises(ValueError, match="mask"):
            box_of_mask({"size": [2, 3], "counts": wrong})
    results = [{"image_id": 4, "category_id": 1, "segmentation": box, "score": 0.5}]
    labels = read_labels(written(tmp_path / "a.json", results), role="detections")
    assert (labels.frame.tolist(), labels.boxes_px.tolist()) == ([4], [[30, 100, 40, 110]])


def test_highd_has_corners_and_ind_has_centres_in_metres(tmp_path):
    highd = (
        "frame,id,x,y,width,height,xVelocity,yVelocity,xAcceleration,yAcceleration,laneId\n2,7,10,4,4.5,2,-30,0,0,0,2\n"
    )
    labels, where = places(written(tmp_path / "01_tracks.csv", highd))
    assert labels.boxes_m is not None
    assert (where, labels.boxes_m[0, 3:5].tolist(), labels.velocity.tolist()) == ([[12.25, 5]], [4.5, 2], [[-30, 0]])
    ind = "recordingId,trackId,frame,xCenter,yCenter,heading,width,length,xVelocity,yVelocity\n0,7,2,10,4,180,2,4.5,-8,0\n"
    labels, where = places(written(tmp_path / "00_tracks.csv", ind))
    assert labels.boxes_m is not None
    assert (where, labels.boxes_m[0, 3:5].tolist(), labels.format) == ([[10, 4]], [4.5, 2], "levelx")
    assert abs(labels.boxes_m[0, 6]) == pytest.approx(np.pi)


#: What writes the scene, the format that it is found to be of, and what beside boxes and classes it holds.
KINDS: dict[str, tuple[Callable[[Path], Path], str, str]] = {
    "voc": (lambda p: by_writer("voc", p), "voc", NO_SCORES),
    "voc, inside": (lambda p: by_writer("voc", p / "x", "Annotations").parent, "voc", NO_SCORES),
    "labelme xml": (lambda p: each(p / "x", old_labelme), "voc", NO_SCORES),
    "labelme": (lambda p: by_writer("labelme", p), "labelme", NO_IDS),
    "deepstream": (lambda p: each(p / "x", kitti(False, True)), "kitti-frames", NO_IDS),
    "deepstream tracks": (lambda p: each(p / "x", kitti(True, True)), "kitti-frames", ALL),
    "kitti": (lambda p: each(p / "training/label_2", kitti(False, False)).parent.parent, "kitti-frames", NEITHER),
    "via": (lambda p: by_writer("via", p), "via", NO_SCORES),
    "via project": (via_project, "via", NO_SCORES),
    "via csv": (via_csv, "via", NO_SCORES),
    "datumaro": (lambda p: by_writer("datumaro", p, "annotations/default.json").parent.parent, "datumaro", ALL),
    "darknet": (lambda p: by_writer("darknet", p), "darknet", NO_IDS),
    "youtube-vis": (lambda p: by_writer("youtube-vis", p), "youtube-vis", ALL),
    "youtube-vis masks": (with_masks, "youtube-vis", ALL),
    "mots": (lambda p: written(p / "a.txt", mots()), "mots", NO_SCORES),
    "coco folder": (lambda p: written(by_writer("coco", p, "annotations/instances_a.json").with_name("image_info_a.json"), {"images": []}).parent.parent, "coco", ALL),
    "yolo of datumaro": (lambda p: each(p / "obj_train_data", yolo, ("../obj.names", "person\ncar\n"), ("../train.txt", "data/p0.jpg")).parent, "yolo", ALL),
    "yolo of ultralytics": (lambda p: each(p / "labels/train", yolo, ("../../data.yaml", "names: [person, car]\n")).parent.parent, "yolo", ALL),
}  # fmt: skip


@pytest.mark.parametrize("name", KINDS)
def test_one_scene_says_the_same_in_every_kind_of_file(name, tmp_path):
    assert_scene(name, *KINDS[name], tmp_path)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.xml", "<fcd-export><timestep/></fcd-export>", "its tool xml2csv.py makes CSV of it"),
        ("a.xml", '<!DOCTYPE a [<!ENTITY b "c">]><annotation/>', "a document type"),
        (
            "a.json",
            youtube_vis(ROWS) | {"videos": [{"id": 1}, {"id": 2}]},
            "give one file for each",
        ),
        ("a.txt", "0 1 2 480 640 ^^\n", "not MOTS"),
        (
            "a/p0.xml",
            "<annotation><object><bndbox><xmin>1</xmin></bndbox></object></annotation>",
            "p0.xml: not Pascal VOC",
        ),
    ],
)
def test_what_is_not_read_names_what_was_seen_and_a_way(name, content, words, tmp_path):
    assert_not_read(name, content, words, tmp_path)


def test_one_of_several_splits_is_given(tmp_path):
    row, path = "0 0.5 0.5 0.1 0.1\n", tmp_path / "a"
    written(path / "labels/train/p0.txt", row)
    assert label_file(path).path == path / "labels/train"
    words = "holds labels in 2 places, labels/train, labels/val; give one of them"
    assert_not_read("a/labels/val/p0.txt", row, words, tmp_path)


@pytest.mark.parametrize("names", [*permutations(("voc", "labelme", "kitti-frames"), 2)])
def test_a_folder_with_files_of_two_formats_is_of_the_one_of_less_rank(names, tmp_path, monkeypatch):
    for name in names:
        WRITERS[name].write(tmp_path, WALK)
    order = ("voc", "labelme", "kitti-frames")
    assert read_labels(tmp_path / "a", role="detections").format == min(names, key=order.index)
    monkeypatch.setattr(of_packages, "own", lambda kind: dict(reversed(own(kind).items())))
    assert read_labels(tmp_path / "a", role="detections").format == min(names, key=order.index)


# Classes other than people in files of KITTI and COCO


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
