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
from tests.label_cases import WALK, writers
from tests.test_labels_of_others import (
    ALL,
    NEITHER,
    NO_IDS,
    NO_SCORES,
    SCENE,
    SIZE,
    assert_not_read,
    assert_scene,
    frames,
    places,
    written,
)


def voc(folder: Path, number: int, rows: list[tuple[Any, ...]]) -> None:
    objects = "".join(
        f"<object><name>{row[2]}</name><bndbox><xmin>{row[3]}</xmin><ymin>{row[4]}</ymin><xmax>{row[3] + row[5]}</xmax>"
        f"<ymax>{row[4] + row[6]}</ymax></bndbox></object>"
        for row in rows
    )
    size = "<size><width>640</width><height>480</height></size>"
    written(folder / f"p{number}.xml", f"<annotation><filename>p{number}.jpg</filename>{size}{objects}</annotation>")


def old_labelme(folder: Path, number: int, rows: list[tuple[Any, ...]]) -> None:
    objects = ""
    for _, track, label, x, y, w, h, _ in rows:
        corners = "".join(f"<pt><x>{a}</x><y>{b}</y></pt>" for a in (x, x + w) for b in (y, y + h))
        objects += f"<object><name>{label}</name><polygon>{corners}</polygon><attributes>track_id={track}</attributes></object>"
    size = "<imagesize><nrows>480</nrows><ncols>640</ncols></imagesize>"
    written(folder / f"p{number}.xml", f"<annotation><filename>p{number}.jpg</filename>{size}{objects}</annotation>")


def labelme(folder: Path, number: int, rows: list[tuple[Any, ...]]) -> None:
    shapes = [
        {"label": row[2], "points": [[row[3] + row[5], row[4]], [row[3], row[4] + row[6]]], "shape_type": "rectangle"}
        for row in rows
    ]
    written(
        folder / f"p{number}.json",
        {"shapes": shapes, "imagePath": f"p{number}.jpg", "imageWidth": 640, "imageHeight": 480},
    )


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
    for number, rows in frames():
        write(folder, number, rows)
    for place, content in others:
        written(folder / place, content)
    return folder


def via(rows: list[tuple[Any, ...]]) -> list[dict[str, Any]]:
    return [
        {
            "shape_attributes": {"name": "rect", "x": x, "y": y, "width": w, "height": h},
            "region_attributes": {"class": label, "track": str(track)},
        }
        for _, track, label, x, y, w, h, _ in rows
    ]


def via_csv() -> str:
    out = "filename,file_size,file_attributes,region_count,region_id,region_shape_attributes,region_attributes\n"
    for number, rows in frames():
        for region in via(rows) or [{"shape_attributes": {}, "region_attributes": {}}]:
            cells = [json.dumps(value).replace('"', '""') for value in region.values()]
            out += f'p{number}.jpg,9,"{{}}",1,0,"{cells[0]}","{cells[1]}"\n'
    return out


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


def youtube_vis(key: str, box: Callable[..., Any]) -> dict[str, Any]:
    tracks = []
    for track, label in ((1, 7), (2, 9)):
        places = {row[0]: box(*row[3:7]) for row in SCENE if row[1] == track}
        tracks.append(
            {"id": track, "video_id": 1, "category_id": label, key: [places.get(number) for number in range(4)]}
        )
    video = {
        "id": 1,
        "width": 640,
        "height": 480,
        "length": 4,
        "file_names": [f"v/{number:05d}.jpg" for number in range(4)],
    }
    return {
        "videos": [video],
        "annotations": tracks,
        "categories": [{"id": 7, "name": "person"}, {"id": 9, "name": "car"}],
    }


def datumaro() -> dict[str, Any]:
    items = [
        {
            "id": f"p{number}",
            "annotations": [
                {
                    "type": "bbox", "bbox": row[3:7], "label_id": ("person", "car").index(row[2]),
                    "attributes": {"track_id": row[1], "score": row[7]},
                }
                for row in rows
            ],
            "image": {"size": [480, 640]},
        }
        for number, rows in frames()
    ]  # fmt: skip
    return {"categories": {"label": {"labels": [{"name": "person"}, {"name": "car"}]}}, "items": items}


def darknet() -> list[dict[str, Any]]:
    names = ("center_x", "center_y", "width", "height")
    return [
        {
            "frame_id": number + 1, "filename": f"p{number}.jpg",
            "objects": [
                {
                    "class_id": 0, "name": label, "confidence": score,
                    "relative_coordinates": dict(
                        zip(names, ((x + w / 2) / 640, (y + h / 2) / 480, w / 640, h / 480), strict=True)
                    ),
                }
                for _, _, label, x, y, w, h, score in rows
            ],
        }
        for number, rows in frames()
    ]  # fmt: skip


def coco() -> dict[str, Any]:
    boxes = [{"image_id": row[0], "bbox": row[3:7], "category_id": 7 if row[1] == 1 else 9} for row in SCENE]
    images = [{"id": number, "file_name": f"p{number}.jpg", "width": 640, "height": 480} for number in range(4)]
    return {"images": images, "annotations": boxes, "categories": youtube_vis("bboxes", lambda *_: None)["categories"]}


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
    "voc": (lambda p: each(p / "voc", voc), "voc", NEITHER),
    "voc, inside": (lambda p: each(p / "Annotations", voc).parent, "voc", NEITHER),
    "labelme xml": (lambda p: each(p / "x", old_labelme), "voc", NO_SCORES),
    "labelme": (lambda p: each(p / "x", labelme), "labelme", NEITHER),
    "deepstream": (lambda p: each(p / "x", kitti(False, True)), "kitti-frames", NO_IDS),
    "deepstream tracks": (lambda p: each(p / "x", kitti(True, True)), "kitti-frames", ALL),
    "kitti": (lambda p: each(p / "training/label_2", kitti(False, False)).parent.parent, "kitti-frames", NEITHER),
    "via": (lambda p: written(p / "a.json", {f"p{k}.jpg99": {"filename": f"p{k}.jpg", "size": 99, "regions": via(rows)} for k, rows in frames()}), "via", NO_SCORES),
    "via project": (lambda p: written(p / "a.json", {"_via_settings": {}, "_via_img_metadata": {f"p{k}": {"filename": f"p{k}.jpg", "regions": {str(n): region for n, region in enumerate(via(rows))}} for k, rows in frames()}}), "via", NO_SCORES),
    "via csv": (lambda p: written(p / "a.csv", via_csv()), "via", NO_SCORES),
    "datumaro": (lambda p: written(p / "annotations/default.json", datumaro()).parent.parent, "datumaro", ALL),
    "darknet": (lambda p: written(p / "a.json", darknet()), "darknet", NO_IDS),
    "youtube-vis": (lambda p: written(p / "a.json", youtube_vis("bboxes", lambda *box: box)), "youtube-vis", NO_SCORES),
    "youtube-vis masks": (lambda p: written(p / "a.json", youtube_vis("segmentations", lambda *box: {"size": [480, 640], "counts": packed(runs(*box))})), "youtube-vis", NO_SCORES),
    "mots": (lambda p: written(p / "a.txt", mots()), "mots", NO_SCORES),
    "coco folder": (lambda p: written(written(p / "annotations/instances_a.json", coco()).with_name("image_info_a.json"), {"images": []}).parent.parent, "coco", NEITHER),
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
            youtube_vis("bboxes", lambda *box: box) | {"videos": [{"id": 1}, {"id": 2}]},
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


WRITERS = writers()


@pytest.mark.parametrize("names", [*permutations(("voc", "labelme", "kitti-frames"), 2)])
def test_a_folder_with_files_of_two_formats_is_of_the_one_of_less_rank(names, tmp_path, monkeypatch):
    for name in names:
        WRITERS[name].write(tmp_path, WALK)
    order = ("voc", "labelme", "kitti-frames")
    assert read_labels(tmp_path / "a", role="detections").format == min(names, key=order.index)
    monkeypatch.setattr(of_packages, "own", lambda kind: dict(reversed(own(kind).items())))
    assert read_labels(tmp_path / "a", role="detections").format == min(names, key=order.index)
