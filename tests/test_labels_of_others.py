"""Labels that other software writes: one scene in every kind of file says the same, and what isn't read names a way."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
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
from mcaptrack.sources.ingest.labels.reading import read_labels
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
    "mot folder": (lambda p: written(p / "gt/gt.txt", text(",", "#", [(*r[:2], *r[3:7], r[7], ("person", "car").index(r[2]) + 1, 1) for r in SCENE])).parent.parent, "mot", ALL),
}  # fmt: skip


@pytest.mark.parametrize("name", KINDS)
def test_one_scene_says_the_same_in_every_kind_of_file(name, tmp_path):
    assert_scene(name, *KINDS[name], tmp_path)


def assert_scene(name: str, write: Callable[[Path], Path], label_format: str, holds: str, tmp_path: Path) -> None:
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
        ("a.json", [{"frame": 0, "id": 1, "speed": 3}], "is JSON (a list with frame, id, speed) of no label format"),
        ("a.jsonl", '{"frame": 0, "x": 1}\n{"frame": 0, "x": }\n', "a.jsonl:2: not valid JSON"),
        ("a/notes.md", "nothing", "looked in gt/gt.txt, "),
    ],
)
def test_what_is_not_read_names_what_was_seen_and_a_way(name, content, words, tmp_path):
    assert_not_read(name, content, words, tmp_path)


def assert_not_read(name: str, content: Any, words: str, tmp_path: Path) -> None:
    written(tmp_path / name, content)
    path = tmp_path / name.partition("/")[0]
    with pytest.raises(McaptrackError) as error:
        ingest(path, output=tmp_path / "out.mcap", fps="10")
    said = str(error.value).replace("`columns='", "--columns ")
    assert words in said
    assert str(path) in said
