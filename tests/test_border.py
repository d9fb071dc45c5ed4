"""The law of the border: every format of labels, and every check of ``labels.checks``.

For each format there is a writer of rows here, and for each check rows that break it. Whatever the format, the check
speaks: with its code, or with an error. A format without a writer, and a check without rows that break it, fail.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pyarrow import feather

import mcaptrack
from mcaptrack.errors import McaptrackError
from mcaptrack.registry import BUILT_IN
from mcaptrack.sources.ingest.labels.checks import OF_ROLE, OF_SOURCE
from mcaptrack.sources.ingest.labels.reading import is_3d, read_labels
from mcaptrack.sources.ingest.labels.table import BoxTable

NAN = math.nan


@dataclass(frozen=True)
class Row:
    """A row of labels, as it is in a picture, as a position and as a box in space."""

    frame: int = 0
    id: int | None = 1
    box: tuple[float, ...] = (10, 20, 30, 60)
    xy: tuple[float, ...] = (1.5, 2.5)
    size: tuple[float, ...] = (0.5, 0.5, 1.8)
    heading: float = 0.25
    score: float | None = 0.5
    kind: str | None = "person"


@dataclass(frozen=True)
class Writer:
    """A writer of a format: ``write`` rows to a folder, and the columns that the format lacks.

    ``kind`` is "box", "xy" or "space"; ``names``: classes are names, and no numbers; ``size``: the file states that of
    its pictures, 640x480; ``tracks``: it has ids.
    """

    write: Callable[[Path, Sequence[Row]], Path]
    lacks: str = ""
    kind: str = "box"
    names: bool = True
    size: bool = False
    tracks: bool = True


def text(line: Callable[[Row], str], head: str = "", name: str = "a.txt") -> Callable[[Path, Sequence[Row]], Path]:
    def write(folder: Path, rows: Sequence[Row]) -> Path:
        path = folder / name
        path.write_text("\n".join([*([head] if head else []), *(line(row) for row in rows)]) + "\n")
        return path

    return write


def as_json(content: Callable[[Sequence[Row]], Any]) -> Callable[[Path, Sequence[Row]], Path]:
    def write(folder: Path, rows: Sequence[Row]) -> Path:
        path = folder / "a.json"
        path.write_text(json.dumps(content(rows)))
        return path

    return write


def number(value: float | None, missing: str = "") -> str:
    return missing if value is None else f"{value:g}"


def corners(row: Row) -> tuple[float, ...]:
    left, top, width, height = row.box
    return left, top, left + width, top + height


def by_frame(rows: Sequence[Row]) -> dict[int, list[Row]]:
    return {frame: [row for row in rows if row.frame == frame] for frame in sorted({row.frame for row in rows})}


def kitti(row: Row) -> str:
    boxes = " ".join(map(number, corners(row)))
    length, width, height = row.size
    space = f"{height} {width} {length} {-row.xy[1]} 0 {row.xy[0]} {-row.heading - math.pi / 2}"
    who = {"person": "Pedestrian"}.get(row.kind, row.kind)
    return f"{row.frame} {number(row.id, '-1')} {who} 0 0 0 {boxes} {space} {number(row.score)}"


def coco(rows: Sequence[Row]) -> Any:
    kinds = {"person": 1, "77": 77, None: None}
    images = [{"id": n, "frame_id": n, "width": 640, "height": 480} for n in sorted({row.frame for row in rows})]
    entries = [
        {"image_id": row.frame, "track_id": row.id, "bbox": list(row.box), "score": row.score, "category_id": kinds[row.kind]}
        for row in rows
    ]  # fmt: skip
    return {"images": images, "annotations": entries, "categories": [{"id": 1, "name": "person"}]}


def cvat(folder: Path, rows: Sequence[Row]) -> Path:
    """Tracks, whose attribute is the id; a row without one is a track of its own."""
    frames = by_frame(rows)
    parts = ["<annotations><meta><task><size>99</size></task></meta>"]
    for frame, mine in frames.items():
        for row in mine:
            left, top, right, bottom = corners(row)
            own = "" if row.id is None else f'<attribute name="track_id">{row.id}</attribute>'
            parts.append(
                f'<image id="{frame}" width="640" height="480"><box label="{row.kind or ""}" xtl="{left}" ytl="{top}" xbr="{right}" '
                f'ybr="{bottom}">{own}</box></image>'
                if frame not in frames or len(mine) == 1
                else f'<box label="{row.kind or ""}" xtl="{left}" ytl="{top}" xbr="{right}" ybr="{bottom}">{own}</box>'
            )
        if len(mine) > 1:
            parts[-len(mine)] = f'<image id="{frame}" width="640" height="480">' + parts[-len(mine)]
            parts[-1] += "</image>"
    path = folder / "a.xml"
    path.write_text("".join(parts) + "</annotations>")
    return path


def shares(row: Row) -> tuple[float, ...]:
    """Centre and size of a box as shares of 640x480; those that are shares are far too large then."""
    left, top, width, height = row.box
    across, down = (1, 1) if width <= 2 else (640, 480)
    return (left + width / 2) / across, (top + height / 2) / down, width / across, height / down


def yolo(folder: Path, rows: Sequence[Row]) -> Path:
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


def label_studio(rows: Sequence[Row]) -> Any:
    results = []
    for order, row in enumerate(rows):
        left, top, width, height = (
            100 * part / whole for part, whole in zip(row.box, (640, 480, 640, 480), strict=True)
        )
        if row.box[2] <= 2:
            left, top, width, height = (100 * part for part in row.box)
        place = {"frame": row.frame, "enabled": False, "x": left, "y": top, "width": width, "height": height}
        value = {"framesCount": 99, "duration": 9.9, "sequence": [place], "labels": [row.kind] if row.kind else []}
        results.append({"type": "videorectangle", "id": f"t{row.id}" if row.id is not None else "", "value": value})
        results[-1]["order"] = order
    return [{"id": 3, "annotations": [{"result": results}]}]


def nuscenes(folder: Path, rows: Sequence[Row]) -> Path:
    tables = {
        "scene": [{"token": "one", "name": "scene-1"}],
        "sample": [{"token": f"s{n}", "timestamp": 100 + n, "scene_token": "one"} for n in range(9)],
        "instance": [{"token": f"i{row.id}", "category_token": row.kind} for row in rows],
        "category": [{"token": kind, "name": "human.pedestrian.adult"} for kind in ("person", None) if kind],
        "sample_annotation": [
            {"token": f"a{n}", "sample_token": f"s{row.frame}", "instance_token": f"i{row.id}",
             "translation": [*row.xy, 1.0], "size": [row.size[1], row.size[0], row.size[2]],
             "rotation": [math.cos(row.heading / 2), 0, 0, math.sin(row.heading / 2)]}
            for n, row in enumerate(rows)
        ],
    }  # fmt: skip
    for name, content in tables.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    return folder


def argoverse(folder: Path, rows: Sequence[Row]) -> Path:
    columns = {
        "timestamp_ns": pa.array([row.frame for row in rows], pa.int64()),
        "track_uuid": [f"t{row.id}" for row in rows],
        "category": pa.array(["PEDESTRIAN" if row.kind else None for row in rows], pa.string()),
        **{f"{name}_m": [float(row.size[at]) for row in rows] for at, name in enumerate(("length", "width", "height"))},
        "qw": [math.cos(row.heading / 2) for row in rows],
        "qz": [math.sin(row.heading / 2) for row in rows],
        "qx": [0.0 for _ in rows],
        "qy": [0.0 for _ in rows],
        "tx_m": [float(row.xy[0]) for row in rows],
        "ty_m": [float(row.xy[1]) for row in rows],
        "tz_m": [1.0 for _ in rows],
    }
    feather.write_feather(pa.table(columns), folder / "annotations.feather")
    return folder


def bdd(rows: Sequence[Row]) -> Any:
    frames = []
    for frame, mine in by_frame(rows).items():
        labels = [
            {"id": row.id, "category": row.kind, "score": row.score,
             "box2d": dict(zip(("x1", "y1", "x2", "y2"), corners(row), strict=True))}
            for row in mine
        ]  # fmt: skip
        frames.append({"name": f"v-{frame + 1:07}.jpg", "videoName": "v", "frameIndex": frame, "labels": labels})
    return frames


def jrdb(rows: Sequence[Row]) -> Any:
    return {"labels": {
        f"{frame:06}.jpg": [
            {"box": list(row.box), "label_id": f"{row.kind or ''}:{number(row.id)}", "score": row.score} for row in mine
        ]
        for frame, mine in by_frame(rows).items()
    }}  # fmt: skip


def trajnetpp(row: Row) -> str:
    return json.dumps({"track": {"f": row.frame, "p": row.id, "x": row.xy[0], "y": row.xy[1]}})


def per_frame(name: str, content: Callable[[int, list[Row]], str]) -> Callable[[Path, Sequence[Row]], Path]:
    """A folder with a file for each frame, and one without rows if there are none."""

    def write(folder: Path, rows: Sequence[Row]) -> Path:
        for frame, mine in (by_frame(rows) or {0: []}).items():
            path = folder / "a" / name.format(frame)
            path.parent.mkdir(exist_ok=True)
            path.write_text(content(frame, mine))
        return folder / "a"

    return write


def voc(frame: int, rows: list[Row]) -> str:
    """Ids are attributes, as LabelMe has them."""
    parts = [f"<annotation><filename>{frame}.jpg</filename><size><width>640</width><height>480</height></size>"]
    for row in rows:
        ends = "".join(
            f"<{key}>{end}</{key}>" for key, end in zip(("xmin", "ymin", "xmax", "ymax"), corners(row), strict=True)
        )
        own = "" if row.id is None else f"<attributes>track_id={row.id}</attributes>"
        parts.append(f"<object><name>{row.kind or ''}</name><bndbox>{ends}</bndbox>{own}</object>")
    return "".join(parts) + "</annotation>"


def labelme(frame: int, rows: list[Row]) -> str:
    shapes = [
        {
            "label": row.kind,
            "points": [corners(row)[:2], corners(row)[2:]],
            "shape_type": "rectangle",
            "score": row.score,
        }
        for row in rows
    ]
    return json.dumps({"shapes": shapes, "imagePath": f"{frame}.jpg", "imageWidth": 640, "imageHeight": 480})


def kitti_frame(_: int, rows: list[Row]) -> str:
    lines = [kitti(row).split() for row in rows]
    return "".join(f"{kind} {own} {' '.join(more)}\n" for _, own, kind, *more in lines)


def via(rows: Sequence[Row]) -> Any:
    out = {}
    for frame, mine in by_frame(rows).items():
        regions = [
            {"shape_attributes": {"name": "rect", **dict(zip(("x", "y", "width", "height"), row.box, strict=True))},
             "region_attributes": {"class": row.kind, "track": row.id}} for row in mine
        ]  # fmt: skip
        out[f"{frame}.jpg9"] = {"filename": f"{frame}.jpg", "regions": regions}
    return out


def datumaro(rows: Sequence[Row]) -> Any:
    kinds = sorted({row.kind for row in rows if row.kind})
    items = [
        {"id": f"{frame}", "image": {"size": [480, 640]}, "annotations": [
            {"type": "bbox", "bbox": row.box, "label_id": kinds.index(row.kind) if row.kind else None,
             "attributes": {"track_id": row.id, "score": row.score}} for row in mine]}
        for frame, mine in by_frame(rows).items()
    ]  # fmt: skip
    return {"items": items, "categories": {"label": {"labels": [{"name": kind} for kind in kinds]}}}


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


def youtube_vis(rows: Sequence[Row]) -> Any:
    """A track for each row."""
    names = [f"{frame}.jpg" for frame in range(max((row.frame for row in rows), default=0) + 1)]
    tracks = [
        {"id": row.id, "video_id": 1, "category_id": row.kind or "", "score": row.score,
         "bboxes": [row.box if name == f"{row.frame}.jpg" else None for name in names]} for row in rows
    ]  # fmt: skip
    return {"videos": [{"id": 1, "width": 640, "height": 480, "file_names": names}], "annotations": tracks}


def mots(row: Row) -> str:
    """A mask that is one pixel wide, in the column that the box begins with."""
    return f"{row.frame} {number(row.id, '-1')} 2 8 9 {chr(48 + 8 * (row.frame % 2))}84l0"


def levelx(folder: Path, rows: Sequence[Row]) -> Path:
    lines = ["trackId,frame,xCenter,yCenter,heading,width,length,xVelocity,yVelocity"]
    for row in rows:
        length, width, _ = row.size
        place = f"{row.xy[0]},{row.xy[1]},{math.degrees(row.heading)},{width},{length}"
        lines.append(f"{number(row.id, '-1')},{row.frame},{place},1,0")
    kinds = {f"{row.id},{'pedestrian' if row.kind == 'person' else row.kind}" for row in rows}
    (folder / "00_tracksMeta.csv").write_text("\n".join(["trackId,class", *kinds]))
    (folder / "00_tracks.csv").write_text("\n".join(lines))
    return folder / "00_tracks.csv"


def parquet(folder: Path, rows: Sequence[Row]) -> Path:
    keys = ("frame", "id", "x", "y", "w", "h", "score", "class")
    values = [[row.frame, row.id, *map(float, row.box), row.score, row.kind] for row in rows]
    table = pa.table({key: [row[at] for row in values] for at, key in enumerate(keys)})
    pq.write_table(table, folder / "a.parquet")
    return folder / "a.parquet"


def mot(row: Row) -> str:
    kind = {"person": "1", None: "-1"}.get(row.kind, row.kind)
    box = ",".join(map(number, row.box))
    return f"{row.frame + 1},{number(row.id, '-1')},{box},{number(row.score, '1')},{kind},1"


def sdd(row: Row) -> str:
    box = " ".join(map(number, corners(row)))
    return f'{number(row.id, "-1")} {box} {row.frame} 0 0 0 "{ {"person": "Pedestrian"}.get(row.kind, row.kind) }"'


CSV, SUPERVISION = "frame,id,x,y,w,h,score,class", "x_min,y_min,x_max,y_max,class_id,confidence,tracker_id,frame_index"
WRITERS = {
    "mot": Writer(text(mot), names=False),
    "kitti": Writer(text(kitti), "kind"),
    "sdd": Writer(text(sdd), "score kind"),
    "trajnet": Writer(text(lambda row: f"{row.frame} {number(row.id, '-1')} {row.xy[0]} {row.xy[1]}"), "score kind", "xy"),
    "obsmat": Writer(
        text(lambda row: f"{row.frame} {number(row.id, '-1')} {row.xy[0]} 0 {row.xy[1]} 0 0 0"), "score kind", "xy"
    ),
    "coco": Writer(as_json(coco), names=False, size=True),
    "cvat": Writer(cvat, "score numbered", size=True),
    "yolo": Writer(yolo, names=False),
    "trajnet++": Writer(
        text(trajnetpp, '{"scene": {"id": 0, "p": 1, "s": 0, "e": 9, "fps": 2.5}}', "a.ndjson"), "score kind", "xy"
    ),
    "bdd": Writer(as_json(bdd)),
    "jrdb": Writer(as_json(jrdb), "numbered"),
    "label-studio": Writer(as_json(label_studio), "score numbered"),
    "voc": Writer(per_frame("{}.xml", voc), "score", size=True),
    "labelme": Writer(per_frame("{}.json", labelme), "box id numbered", size=True, tracks=False),
    "via": Writer(as_json(via), "score"),
    "datumaro": Writer(as_json(datumaro), size=True),
    "darknet": Writer(as_json(darknet), "id numbered", tracks=False),
    "youtube-vis": Writer(as_json(youtube_vis), size=True),
    "mots": Writer(text(mots), "box pixels score kind size numbered"),
    "kitti-frames": Writer(per_frame("{}.txt", kitti_frame), "kind"),
    "levelx": Writer(levelx, "score kind numbered", "space"),
    "records": Writer(parquet),
    "supervision": Writer(
        text(lambda row: ",".join(
            [*map(number, corners(row)), {"person": "0"}.get(row.kind, row.kind or ""), number(row.score),
             number(row.id, "-1"), f"{row.frame}"]), SUPERVISION, "a.csv"), names=False),
    "csv": Writer(
        text(lambda row: ",".join(
            [f"{row.frame}", number(row.id), *map(number, row.box), number(row.score), row.kind or ""]),
            CSV, "a.csv")),
    "kitti-3d": Writer(text(kitti), "kind", "space"),
    "nuscenes": Writer(nuscenes, "score kind id numbered", "space"),
    "argoverse": Writer(argoverse, "score id numbered", "space"),
}  # fmt: skip
#: What a format states in all of its files.
STATED_FIRST = (
    "supervision", "mot", "kitti", "sdd", "trajnet", "obsmat", "trajnet++", "cvat", "jrdb", "label-studio", "kitti-3d",
    "youtube-vis", "levelx",
)  # fmt: skip
#: The first of the pictures that these list is taken as the first; what is assumed is said once the clock is known.
BY_LIST = ("coco", "bdd", "voc", "labelme", "via", "datumaro", "darknet", "mots", "kitti-frames")
TIMED = ("nuscenes", "argoverse")
#: Formats of boxes in shares of the picture.
SHARED = ("yolo", "label-studio", "darknet")

#: Two people that walk, without fault.
WALK = [
    Row(frame, who, (10 + 3 * frame + 40 * who, 20, 30, 60), (1.5 + 0.2 * frame, 2.5 * who)) for frame in range(1, 5) for who in (1, 2)
]  # fmt: skip


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
    assert set(WRITERS) == set(BUILT_IN["label_format"])
    assert set(BROKEN) == {*OF_SOURCE, *OF_ROLE, "classes"}


def has(name: str) -> set[str]:
    """The columns and facts of a format, as they are declared here."""
    writer = WRITERS[name]
    out = {writer.kind, "score", "kind", "id", "numbered"} - {*writer.lacks.split()}
    out |= {"pixels"} if writer.kind == "box" and name not in SHARED else {"share"} if name in SHARED else set()
    out |= {"size"} if writer.size else set()
    out |= {"numbers"} if not writer.names else set()
    out -= {*writer.lacks.split()}
    return out | ({"frames"} if name not in (*TIMED, *STATED_FIRST, *BY_LIST) else set())


CASES = [
    pytest.param(
        name, check, *case[:2], case[2] if WRITERS[name].tracks else "detections", case[3], id=f"{name}-{check}-{order}"
    )
    for name in WRITERS
    for check, cases in BROKEN.items()
    for order, case in enumerate(cases)
    if (not case[1] or case[1] in has(name)) and (check != "ids" or WRITERS[name].tracks)
]


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


@pytest.mark.parametrize(("name", "check", "rows", "needs", "role", "said"), CASES)
def test_every_check_speaks_whatever_the_format(name, check, rows, needs, role, said, tmp_path):
    writer = WRITERS[name]
    path = writer.write(tmp_path, rows)
    if said.startswith("<") or not said:
        table = read_labels(path, name, role)
        codes = [code for _, code in table.doubts]
        assert not said or said[1:-1] in codes, table.doubts
        if check == "labelled":
            assert set(table.frame.tolist()) <= set(table.labelled.tolist())
            assert (np.diff(table.labelled) > 0).all()
        return
    with pytest.raises(McaptrackError) as refused:
        read_labels(path, name, role)
    assert re.search(said, str(refused.value)), str(refused.value)
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


@pytest.mark.parametrize("name", BY_LIST)
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


#: What replaces a number, a text or null.
ODD = (b"null", b"[]", b"{}", b"-1", b"1e999", b"NaN", b'""', b"true", b"9" * 400, b"\xff", b"\0", b'"x"', b"1e18")


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_are_read_or_refused_in_a_line(name, tmp_path):
    rng = np.random.default_rng(7)
    path = WRITERS[name].write(tmp_path, WALK)
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    for number in range(16):
        file = files[number % len(files)]
        data = file.read_bytes()
        spots = list(re.finditer(rb'-?\d+\.?\d*|"[^"]*"|null', data))
        spot = spots[rng.integers(len(spots))] if spots else None
        cut = int(rng.integers(len(data)))
        damaged = data[:cut] if spot is None or number % 4 == 3 else b""
        if spot is not None and not damaged:
            damaged = data[: spot.start()] + ODD[rng.integers(len(ODD))] + data[spot.end() :]
        file.write_bytes(damaged)
        for role in ("truth", "detections", None):
            try:
                read_labels(path, name, role)
                read_labels(path, "auto", role)
            except McaptrackError as error:
                assert "\n" not in str(error), error
        file.write_bytes(data)


def test_a_video_of_several_is_chosen_while_a_log_is_made(tmp_path):
    label = {"id": "1", "category": "person", "box2d": {"x1": 1, "y1": 1, "x2": 20, "y2": 40}}
    frames = [
        {"name": f"{name}-{number}.jpg", "videoName": name, "frameIndex": number, "labels": [label]}
        for name, count in (("a", 3), ("b", 5))
        for number in range(count)
    ]
    (tmp_path / "a.json").write_text(json.dumps(frames))
    out = mcaptrack.ingest(tmp_path / "a.json", tmp_path / "a.mcap", role="truth", fps=10, scene="b")
    assert out.messages == {"/camera/truth": 5}


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
