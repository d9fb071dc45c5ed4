"""The table of logs: what stands for a whole log, and the one file with the rows of many."""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import SimpleNamespace

import pyarrow as pa
import pyarrow.parquet as pq

import mcaptrack
from mcaptrack import log
from mcaptrack.schema import SCHEMAS, TRACKS, Frame
from mcaptrack.schema.provenance import Provenance
from mcaptrack.tables import catalogue
from mcaptrack.tables.export.contents import best_tracks, worst_score
from mcaptrack.tables.fields import TABLES
from tests.logs import some_log, write_channels

CAMERA = SimpleNamespace(prefix="/c")


def test_the_best_tracks_stand_for_a_camera():
    for topics, best in (
        (["/c/tracks", "/c/retracks/online", "/c/retracks"], "/c/retracks"),
        (["/c/tracks", "/c/retracks/online", "/d/retracks"], "/c/retracks/online"),
        (["/d/retracks", "/c/truth", "/c/tracks"], "/c/tracks"),
        (["/c/truth", "/tracks"], None),
    ):
        assert best_tracks(CAMERA, iter(topics)) == best


def score(topic: str, idf1: float, rule: tuple[str, float] = ("metres", 1.0), **more: object) -> dict[str, object]:
    plain = {"topic": topic, "similarity": rule[0], "gate": rule[1], "IDF1": idf1}
    return plain | {"MOTA": 0.25, "HOTA": 0.5, "IDSW": 3, "class": None, "AMOTA": None} | more


def test_the_worst_camera_stands_for_the_scores_of_a_log():
    scores = [
        score("/a", 0.9), score("/b", 0.4, MOTA=-1, HOTA=0.1, IDSW=7), score("/c", 0.1), score("/b", 0.1, ("iou", 0.5)),
        score("/b", 0.01, **{"class": "car"}), score("/d", 0.2, ("iou", 0.75)),
    ]  # fmt: skip
    assert worst_score(["/a", "/b", "/d"], scores) == {
        "scored": "/b", "similarity": "metres", "gate": 1.0, "MOTA": -1, "IDF1": 0.4, "HOTA": 0.1, "IDSW": 7,
    }  # fmt: skip
    assert worst_score(["/a"], scores)["IDF1"] == 0.9
    assert worst_score(["/d"], scores) == worst_score([], scores) == worst_score(["/a"], []) == {}
    # By overlap in the picture where there is none in metres; objects in space by 2 m, if they have a score for all.
    assert worst_score(["/e"], [score("/e", 0.3, ("iou", 0.5))])["similarity"] == "iou"
    space = [score("/e", 0.3), score("/e", 0.2, ("metres", 2.0), AMOTA=0.5)]
    assert worst_score(["/e"], space)["gate"] == 2.0
    assert worst_score(["/e"], [*space[:1], score("/e", 0.2, ("metres", 2.0))])["gate"] == 1.0


def test_warnings_and_versions_of_channels_are_named_once(tmp_path):
    def channel(version: str, *warnings: tuple[str, str]) -> tuple[object, ...]:
        return TRACKS, Provenance("track", {}, version=version, warnings=warnings), [Frame(0, 0, TRACKS.empty())]

    both = ("lost", "a é"), ("other", "b")
    channels = {
        "/e/b": channel("0.2", both[1], both[0]), "/e/a": channel("0.1", both[0]), "/f/a": channel("0.2", both[0]),
    }  # fmt: skip
    with mcaptrack.open(write_channels(tmp_path / "a.mcap", channels)) as opened:
        (row,) = opened.table("recordings").to_pylist()
        warnings = opened.table("warnings").to_pylist()
    texts = [{"code": code, "message": message} for code, message in both]
    wanted = {"warnings": 2, "warning_texts": json.dumps(texts, ensure_ascii=False), "versions": "0.1, 0.2"}
    assert {name: row[name] for name in wanted} == wanted
    assert "é" in row["warning_texts"]
    assert [tuple(warning.values()) for warning in warnings] == [
        ("/e/a", "e", *both[0], "a"), ("/e/b", "e", *both[1], "a"), ("/f/a", "f", *both[0], "a"),
    ]  # fmt: skip
    with mcaptrack.open(write_channels(tmp_path / "b.mcap", {})) as opened:
        (row,) = opened.table("recordings").to_pylist()
        assert opened.table("warnings").num_rows == 0
    assert {name: row[name] for name in wanted} == {"warnings": 0, "warning_texts": None, "versions": None}


def test_metadata_that_no_table_can_hold_harms_no_table(tmp_path):
    half, of_tracks = "\ud800", "mcaptrack.Tracks"
    made = {"mcaptrack.transform": "retrack", "mcaptrack.version": "0.3"}
    odd = {
        "warnings": [["x", half], ["y"], 7], "plugins": {"transform": {"name": half}, "predictor": 5},
        "zones": {"0": half, "x": "y"}, "classes": {"1": half},
        "parameters": {"cameras": [half, [], None], "poor_scale": [1], "retracker": 5, half: half},
    }  # fmt: skip
    with log.create(tmp_path / "a.mcap") as writer:
        for schema in SCHEMAS.values():
            topic = f"/camera/{schema.name.partition('.')[2].lower()}"
            record = (schema.name, "protobuf", schema.descriptor)
            metadata = made | {f"mcaptrack.{name}": json.dumps(value) for name, value in odd.items()}
            number = writer.add_channel(topic, record, "protobuf", metadata if schema.name != of_tracks else made)
            writer.add_message(number, 0, 0, schema.codec.encode(schema.empty(1)))
    mcaptrack.export(tmp_path / "a.mcap", tmp_path / "tables")
    with mcaptrack.open(tmp_path / "a.mcap") as opened:
        assert ("x", r"\ud800") in {(row["code"], row["message"]) for row in opened.table("warnings").to_pylist()}
        assert opened.table("sightings")["camera_name"].to_pylist() == [r"\ud800"]
        assert opened.table("zone_visits")["zone"].to_pylist() == [r"\ud800"]


def test_a_log_has_a_row(tmp_path):
    path = some_log(tmp_path / "a.mcap")
    with mcaptrack.open(path) as opened:
        (row,) = opened.table("recordings").to_pylist()
        frames = opened.table("frames").num_rows
    assert (row["recording"], row["location"], row["size_bytes"]) == ("a", str(path), path.stat().st_size)
    assert (row["cameras"], row["tracks"], row["scored"]) == (1, 2, "/camera/tracks")
    assert row["messages"] == 4 + 3 + 4 + 3
    assert frames == 3 + 4 + 3
    bare = tmp_path / "b.mcap"
    with log.create(bare) as writer:
        writer.add_channel("/imu", ("robot/Imu", "jsonschema", b"{}"), "json", {}, group="imu")
    with mcaptrack.open(bare) as opened:
        (row,) = opened.table("recordings").to_pylist()
    assert (row["messages"], row["tracks"], row["scored"], row["IDF1"]) == (0, None, None, None)


def put(folder: Path, name: str, messages: int) -> Path:
    """The row of a log, as `export` writes it."""
    path = folder / "recordings" / f"recording={name}" / "part-0.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    schema = pa.schema([field for field in TABLES["recordings"].arrow if field.name != "recording"])
    row = {field.name: None for field in schema} | {"messages": messages, "file": name, "mcaptrack_version": "1"}
    schema = pa.schema([field.with_nullable(True) for field in schema])
    pq.write_table(pa.Table.from_pylist([row], schema), path)
    return path


def test_one_file_has_the_rows_of_all_logs(tmp_path):
    def rows() -> list[tuple[str, int]]:
        ours, stock = catalogue.read_catalogue(tmp_path), pq.read_table(tmp_path / catalogue.FILE).to_pylist()
        ours, stock = ([(row["recording"], row["messages"]) for row in found] for found in (ours, stock))
        assert ours == stock
        return stock

    assert catalogue.refresh(tmp_path) is False
    assert not catalogue.is_folder_of_tables(tmp_path)
    (tmp_path / "recordings" / "other").mkdir(parents=True)
    assert not catalogue.is_folder_of_tables(tmp_path)
    assert catalogue.refresh(tmp_path) is False
    put(tmp_path, "b", 2)
    first = put(tmp_path, "a", 1)
    (tmp_path / "recordings" / "recording=empty").mkdir()
    assert catalogue.is_folder_of_tables(tmp_path)
    assert (catalogue.refresh(tmp_path), catalogue.refresh(tmp_path)) == (True, False)
    assert rows() == [("a", 1), ("b", 2)]
    # Rows of logs that didn't change are those of the file: here they are read from nowhere else.
    about = first.stat()
    first.write_bytes(bytes(about.st_size))
    os.utime(first, ns=(about.st_atime_ns, about.st_mtime_ns))
    put(tmp_path, "c", 3)
    assert catalogue.refresh(tmp_path) is True
    assert rows() == [("a", 1), ("b", 2), ("c", 3)]
    put(tmp_path, "a", 10)
    put(tmp_path, "b", 20).unlink()
    assert catalogue.refresh(tmp_path) is True
    assert rows() == [("a", 10), ("c", 3)]
    (tmp_path / catalogue.FILE).write_bytes(b"damaged")
    assert catalogue.refresh(tmp_path) is True
    assert rows() == [("a", 10), ("c", 3)]
