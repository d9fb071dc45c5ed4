"""Labels that other software writes: one scene in every kind of file says the same, and what isn't read names a way."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet
import pytest
import zstandard

from mcaptrack import ingest
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange.masks import box_of_mask
from mcaptrack.sources.ingest.labels.reading import label_file, read_labels
from mcaptrack.sources.ingest.labels.roles import WantedClasses
from mcaptrack.sources.ingest.labels.table import BoxTable

NAN = float("nan")
#: Frame, track, class, left, top, width, height, score.
SCENE = [
    (0, 1, "person", 10, 20, 30, 60, 0.75),
    (1, 1, "person", 12, 20, 30, 60, 0.5),
    (1, 2, "car", 200, 100, 80, 40, 0.25),
    (3, 2, "car", 210, 100, 80, 40, 0.25),
]
KEYS = ("frame", "track_id", "class", "left", "top", "width", "height", "score")
ROWS = [dict(zip(KEYS, row, strict=True)) for row in SCENE]
SIZE = (640, 480)


def frames() -> Iterator[tuple[int, list[tuple[Any, ...]]]]:
    """The rows of each of the four pictures; the third has none."""
    by_frame = {frame: list(rows) for frame, rows in groupby(SCENE, key=lambda row: row[0])}
    for frame in range(4):
        yield frame, by_frame.get(frame, [])


def text(delimiter: str = ",", header: str | None = None, rows: Any = SCENE) -> str:
    lines = [header or delimiter.join(KEYS), *(delimiter.join(map(str, row)) for row in rows)]
    return "\n".join(lines) + "\n"


def written(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    data = content if isinstance(content, str | bytes) else json.dumps(content)
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return path


def arrow(path: Path, write: Callable[[pa.Table, str], object]) -> Path:
    write(pa.table({key: [row[key] for row in ROWS] for key in KEYS}), str(path))
    return path


def arrow_stream(table: pa.Table, path: str) -> None:
    with pa.ipc.new_stream(path, table.schema) as stream:
        stream.write_table(table)


def boxed(name: str, corners: bool) -> list[dict[str, Any]]:
    """Rows with the box as a list."""
    return [
        {
            "frame": frame,
            "id": track,
            "label": label,
            "conf": score,
            name: [x, y, x + w, y + h] if corners else [x, y, w, h],
        }
        for frame, track, label, x, y, w, h, score in SCENE
    ]


def coordinates(x: int, y: int, w: int, h: int) -> dict[str, int]:
    return {"x1": x, "y1": y, "x2": x + w, "y2": y + h}


def list_cells(rows: list[dict[str, Any]]) -> str:
    cells = (";".join(str(value) for value in row.values()) for row in rows)
    return "\n".join([";".join(rows[0]), *cells])


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


ALL, NO_IDS, NO_SCORES, NEITHER = "id score", "score", "id", ""
#: What writes the scene, the format that it is found to be of, and what beside boxes and classes it holds.
KINDS: dict[str, tuple[Callable[[Path], Path], str, str]] = {
    "gzip": (lambda p: written(p / "a.csv.gz", gzip.compress(text()[:40].encode()) + gzip.compress(text()[40:].encode())), "csv", ALL),
    "zstd": (lambda p: written(p / "a.csv.zst", zstandard.compress(text()[:40].encode()) + zstandard.compress(text()[40:].encode())), "csv", ALL),
    "utf-16": (lambda p: written(p / "a.csv", text().encode("utf-16")), "csv", ALL),
    "pipes": (lambda p: written(p / "a.csv", text("|")), "csv", ALL),
    "blanks": (lambda p: written(p / "a.txt", text("  ")), "csv", ALL),
    "comments": (lambda p: written(p / "a.csv", "# of a run\n#" + text()), "csv", ALL),
    "lists": (lambda p: written(p / "a.csv", list_cells(boxed("bbox", False))), "csv", ALL),
    "corners": (lambda p: written(p / "a.csv", list_cells(boxed("xyxy", True))), "csv", ALL),
    "parquet": (lambda p: arrow(p / "a.parquet", pa.parquet.write_table), "records", ALL),
    "parquet of any name": (lambda p: arrow(p / "labels", pa.parquet.write_table), "records", ALL),
    "feather": (lambda p: arrow(p / "a.feather", pa.feather.write_feather), "records", ALL),
    "arrow stream": (lambda p: arrow(p / "a.arrows", arrow_stream), "records", ALL),
    "json lines": (lambda p: written(p / "a.jsonl", "\n".join(map(json.dumps, ROWS))), "records", ALL),
    "json lines, packed": (lambda p: written(p / "a.jsonl.gz", gzip.compress("\n".join(map(json.dumps, ROWS)).encode())), "records", ALL),
    "json rows": (lambda p: written(p / "a.json", ROWS), "records", ALL),
    "json columns": (lambda p: written(p / "a.json", {key: {str(k): row[key] for k, row in enumerate(ROWS)} for key in KEYS}), "records", ALL),
    "json boxes": (lambda p: written(p / "a.json", [{"frame": r[0], "name": r[2], "class": ("person", "car").index(r[2]), "track_id": r[1], "confidence": r[7], "box": coordinates(*r[3:7])} for r in SCENE]), "records", ALL),
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
    "mot folder": (lambda p: written(p / "gt/gt.txt", text(",", "#", [(*r[:2], *r[3:7], r[7], ("person", "car").index(r[2]) + 1, 1) for r in SCENE])).parent.parent, "mot", ALL),
    "yolo of datumaro": (lambda p: each(p / "obj_train_data", yolo, ("../obj.names", "person\ncar\n"), ("../train.txt", "data/p0.jpg")).parent, "yolo", ALL),
    "yolo of ultralytics": (lambda p: each(p / "labels/train", yolo, ("../../data.yaml", "names: [person, car]\n")).parent.parent, "yolo", ALL),
}  # fmt: skip


@pytest.mark.parametrize("name", KINDS)
def test_one_scene_says_the_same_in_every_kind_of_file(name, tmp_path):
    write, label_format, holds = KINDS[name]
    path = write(tmp_path)
    labels = read_labels(path, role=None, wanted=WantedClasses("all"))
    assert labels.format == label_format
    # A mask of a box is counted in pixels, and boxes in shares of a picture of 640x480 are shares.
    scale = np.array([*SIZE, *SIZE]) if labels.is_normalised else np.ones(4)
    assert labels.boxes_px is not None
    np.testing.assert_allclose(labels.boxes_px * scale, [row[3:7] for row in SCENE], atol=1e-9)
    assert labels.frame.tolist() == [row[0] for row in SCENE]
    kinds = [labels.classes.get(number, "person") for number in labels.class_id.tolist()]
    people = ("person", "pedestrian")
    if name != "mot folder":  # where the names of classes are those of the data set
        assert [kind if kind not in people else "person" for kind in kinds] == [row[2] for row in SCENE]
    assert labels.id.tolist() == ([row[1] for row in SCENE] if "id" in holds else [-1] * 4)
    np.testing.assert_array_equal(labels.score, [row[7] for row in SCENE] if "score" in holds else [NAN] * 4)
    assert labels.labelled[0] == 0
    assert labels.labelled[-1] == 3


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


def places(path: Path) -> tuple[BoxTable, list[list[float]]]:
    labels = read_labels(path, role=None)
    assert labels.boxes_m is not None
    return labels, labels.boxes_m[:, :2].tolist()


def test_programs_that_write_metres_are_known_by_their_columns(tmp_path):
    sumo = "timestep_time;person_angle;person_id;person_speed;person_x;person_y\n0.5;90;ped1;1.2;0.75;2.5\n1.0;90;ped1;1;1;3\n"
    labels, where = places(written(tmp_path / "sumo.csv", sumo))
    assert (where, labels.frame.tolist(), labels.id.tolist()) == (
        [[0.75, 2.5], [1, 3]],
        [500_000_000, 1_000_000_000],
        [1, 1],
    )
    echo = (
        "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.pose.position.x,field.pose.position.y\n"
    )
    labels, where = places(
        written(tmp_path / "echo.csv", f"{echo}1777636800000000001,0,1777636800000000001,map,0.75,2.5\n")
    )
    assert (where, labels.frame.tolist()) == ([[0.75, 2.5]], [1777636800000000001])
    table = pa.table({"t": [0.5, 1.0], "track_uuid": ["a", "a"], "x_m": [0.75, 1.0], "y_m": [2.5, 3.0]})
    pa.parquet.write_table(table, tmp_path / "a.parquet")
    labels, where = places(tmp_path / "a.parquet")
    assert labels.format == "records"
    assert (where, labels.frame.tolist(), labels.id.tolist()) == (
        [[0.75, 2.5], [1, 3]], [500_000_000, 1_000_000_000], [1, 1]
    )  # fmt: skip
    vadere = "pedestrianId simTime x-PID1 y-PID1 targetId-PID2\n1 0.4 0.75 2.5 1\n"
    labels, where = places(written(tmp_path / "postvis.traj", vadere))
    assert (where, labels.frame.tolist(), labels.id.tolist()) == ([[0.75, 2.5]], [400_000_000], [1])
    jupedsim = "# description: walk\n# framerate: 8.00\n\n#ID\tFR\tX\tY\tZ\n3\t4\t0.75\t2.5\t0\n"
    labels, where = places(written(tmp_path / "juped.txt", jupedsim))
    assert (where, labels.frame.tolist(), labels.id.tolist()) == ([[0.75, 2.5]], [500_000_000], [3])


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


@pytest.mark.parametrize(
    ("cell", "t_ns"),
    [
        ("1970-01-01T00:00:01.5", 1_500_000_000),
        ("1970-01-01 00:00:01.500000+00:00", 1_500_000_000),
        ("1970-01-01 02:00:01.5+0200", 1_500_000_000),
        ("2026-05-01T12:00:00.123456789Z", 1_777_636_800_123_456_789),
        ("1970-01-01 00:00:02 UTC", 2_000_000_000),
    ],
)
def test_a_column_of_times_may_hold_dates(cell, t_ns, tmp_path):
    labels, _ = places(written(tmp_path / "a.csv", f"time,x_m,y_m,id\n{cell},1,2,3\n"))
    assert labels.frame.tolist() == [t_ns]
    labels = read_labels(written(tmp_path / "b.csv", f"time,x,y,w,h\n{cell},1,2,3,4\n"), role=None)
    assert labels.times_s.tolist() == [t_ns / 1e9]
    assert [code for _, code in labels.doubts] == ["clock"] * cell.endswith(".5")  # without a zone


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.csv", "0,1,person,30.5,100.25,40.0,110.5,0.9\n", "needs a first line that names its columns"),
        ("a.csv", "frame,id,pos_x,pos_y\n0,1,2,3\n", "--columns x_m=pos_x,y_m=pos_y"),
        ("a.csv", 'frame,bbox,a,b\n0,"[1, 2, 3]",4,5\n', "holds '[1, 2, 3]', which are no four numbers"),
        ("a.mat", b"MATLAB 5.0 MAT-file", "save its table as CSV"),
        ("a.parquet", b"PAR1 cut off", "is no table that can be read"),
        ("a.csv.gz", gzip.compress(text().encode())[:-9], "can't be decompressed: it is cut off"),
        ("a.csv.zst", zstandard.compress(text().encode())[:-1], "can't be decompressed: it is cut off"),
        ("a.xml", "<fcd-export><timestep/></fcd-export>", "its tool xml2csv.py makes CSV of it"),
        ("a.xml", '<!DOCTYPE a [<!ENTITY b "c">]><annotation/>', "a document type"),
        ("a.json", [{"frame": 0, "id": 1, "speed": 3}], "is JSON (a list with frame, id, speed) of no label format"),
        ("a.jsonl", '{"frame": 0, "x": 1}\n{"frame": 0, "x": }\n', "a.jsonl:2: not valid JSON"),
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
        ("a/notes.md", "nothing", "looked in gt/gt.txt, "),
        ("a/labels/train/p0.txt", "0 0.5 0.5 0.1 0.1\n", None),
    ],
)
def test_what_is_not_read_names_what_was_seen_and_a_way(name, content, words, tmp_path):
    path = written(tmp_path / name, content)
    path = tmp_path / name.partition("/")[0]
    if words is None:  # and once more with another split beside it
        assert label_file(path).path == path / "labels/train"
        written(path / "labels/val/p0.txt", content)
        words = "holds labels in 2 places, labels/train, labels/val; give one of them"
    with pytest.raises(McaptrackError) as error:
        ingest(path, output=tmp_path / "out.mcap", fps="10")
    said = str(error.value).replace("`columns='", "--columns ")
    assert words in said
    assert str(path) in said
