"""Rows as Parquet and back, read by DuckDB too."""

from __future__ import annotations

import json

import duckdb
import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaptrack import export, log, tables
from mcaptrack.errors import McaptrackError
from mcaptrack.provenance import Provenance
from mcaptrack.schema import DETECTIONS, PREDICTIONS, SCHEMAS, TRACKS, Frame
from tests.strategies import columns
from tests.worlds import boxes_at, tracks_at

ALL = st.sampled_from(sorted(SCHEMAS.values(), key=lambda schema: schema.name))


@given(st.data())
def test_rows_survive_parquet_to_the_bit_with_frames_in_which_nobody_was(tmp_path_factory, data):
    folder, schema = tmp_path_factory.mktemp("tables"), data.draw(ALL)
    channels = {}
    for topic in ("/a", "/b/c"):
        times = sorted(data.draw(st.sets(st.integers(0, 2**62), max_size=4)))
        channels[topic] = [Frame(t, n, schema.rows(**data.draw(columns(schema, 4)))) for n, t in enumerate(times)]
    entries = {topic: [(f.t_ns, f.index, len(f.rows)) for f in frames] for topic, frames in channels.items()}
    tables.write(folder / "rows.parquet", tables.rows_table(schema, channels), {})
    tables.write(folder / "frames.parquet", tables.frames_table(entries), {})
    rows, frames = pq.read_table(folder / "rows.parquet"), pq.read_table(folder / "frames.parquet")
    for topic, wanted in channels.items():
        found = tables.table_to_frames(schema, rows, frames, topic)
        assert [(f.t_ns, f.index, schema.codec.encode(f.rows)) for f in found] == [
            (f.t_ns, f.index, schema.codec.encode(f.rows)) for f in wanted
        ]


def some_log(path):
    with log.create(path) as writer:
        for topic, schema, frames in (
            ("/camera/detections", DETECTIONS, [Frame(123_456_789_012_345_678, 0, boxes_at([(5, 5), (9, 9)]))]),
            ("/camera/tracks", TRACKS, [Frame(10, 0, tracks_at({4: (1.5, 2.5)})), Frame(20, 1, TRACKS.empty())]),
            ("/camera/retracks", TRACKS, [Frame(10, 0, tracks_at({1: (1.5, 2.5)}))]),
        ):
            made = Provenance("track", {"max_age_s": 1.4}, "/camera/detections").to_metadata()
            number = writer.add_channel(topic, (schema.name, "protobuf", schema.descriptor), "protobuf", made)
            for frame in frames:
                writer.add_message(number, frame.t_ns, frame.index, schema.codec.encode(frame.rows))
    return path


def test_a_log_becomes_a_folder_that_duckdb_reads(tmp_path):
    with log.read(some_log(tmp_path / "walk = 1.mcap")) as opened:
        rows = export.export(opened, tmp_path / "tables")
    assert rows == {
        "channels": 3,
        "detections": 2,
        "events": 0,
        "frames": 4,
        "ground_planes": 0,
        "predictions": 0,
        "tracks": 2,
    }

    def ask(query: str):
        return duckdb.sql(query.replace("@", f"{tmp_path}/tables")).fetchall()

    assert ask(
        "select recording, topic, frame, t_ns, track_id, x_m, x_px from '@/tracks/*/*.parquet' order by topic"
    ) == [
        ("walk_1", "/camera/retracks", 0, 10, 1, 1.5, None),
        ("walk_1", "/camera/tracks", 0, 10, 4, 1.5, None),
    ]
    assert ask("select topic, t_ns, rows from '@/frames/*/*.parquet' where rows = 0") == [("/camera/tracks", 20, 0)]
    assert ask("select count(*) from '@/predictions/*/*.parquet'") == [(0,)]
    assert ask("select transform, input from '@/channels/*/*.parquet' where topic = '/camera/tracks'") == [
        ("track", "/camera/detections")
    ]
    joined = (
        "select count(*) from '@/tracks/*/*.parquet' join '@/frames/*/*.parquet' using (recording, topic, frame, t_ns)"
    )
    assert ask(joined) == [(2,)]
    assert ask("select epoch_ns(t) - t_ns from '@/detections/*/*.parquet'") == [(0,), (0,)]


def test_units_meaning_and_provenance_are_in_the_file(tmp_path):
    with log.read(some_log(tmp_path / "a.mcap")) as opened:
        export.export(opened, tmp_path / "tables")
    schema = pq.read_schema(tmp_path / "tables" / "tracks" / "recording=a" / "part-0.parquet")
    assert schema.field("x_m").metadata == {b"unit": b"m", b"description": b"position on the ground plane, first axis"}
    assert schema.field("t_ns").metadata[b"unit"] == b"ns"
    assert str(schema.field("t").type) == "timestamp[ns, tz=UTC]"
    lineage = json.loads(schema.metadata[b"mcaptrack.lineage"])
    assert lineage["/camera/tracks"] == {
        "transform": "track",
        "input": "/camera/detections",
        "parameters": {"max_age_s": 1.4},
    }
    assert schema.metadata[b"mcaptrack.recording"] == b"a.mcap"


def test_tables_without_rows_keep_their_columns(tmp_path):
    tables.write(tmp_path / "a.parquet", tables.rows_table(PREDICTIONS, {}), {})
    read = pq.read_table(tmp_path / "a.parquet")
    assert read.num_rows == 0
    assert read.schema.names == ["topic", "frame", "t", "t_ns", *(column.name for column in PREDICTIONS.columns)]


def test_the_same_log_gives_the_same_tables(tmp_path):
    for name in ("x", "y"):
        with log.read(some_log(tmp_path / "a.mcap")) as opened:
            export.export(opened, tmp_path / name)
    for file in (tmp_path / "x").rglob("*.parquet"):
        assert file.read_bytes() == (tmp_path / "y" / file.relative_to(tmp_path / "x")).read_bytes()


def test_exporting_again_replaces_and_leaves_other_logs_alone(tmp_path):
    with log.read(some_log(tmp_path / "a.mcap")) as a, log.read(some_log(tmp_path / "b.mcap")) as b:
        for _ in range(2):
            export.export(a, tmp_path / "tables")
            export.export(b, tmp_path / "tables")
    assert len(list((tmp_path / "tables").rglob("*"))) == 7 * (1 + 2 + 2)


@pytest.mark.parametrize(
    ("name", "recording"), [("../../etc/x.mcap", "x"), ("a=b c.mcap", "a_b_c"), ("...mcap", "log"), ("ü.1.mcap", "ü.1")]
)
def test_names_of_logs_never_climb_out_of_the_folder(tmp_path, name, recording):
    assert export.recording_name(tmp_path / name) == recording


def test_a_folder_that_can_not_be_written_is_said(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(McaptrackError, match="can't be written"):
        tables.write(tmp_path / "file" / "t.parquet", tables.rows_table(TRACKS, {}), {})


def test_half_a_table_is_never_left(tmp_path, monkeypatch):
    path = tmp_path / "t.parquet"
    tables.write(path, tables.rows_table(TRACKS, {"/a": [Frame(1, 0, tracks_at({1: (0, 0)}))]}), {})
    before = path.read_bytes()

    def interrupted(*args, **kwargs):
        args[1].write_bytes(b"PAR1 half a table")
        raise KeyboardInterrupt

    monkeypatch.setattr(pq, "write_table", interrupted)
    with pytest.raises(KeyboardInterrupt):
        tables.write(path, tables.rows_table(TRACKS, {}), {})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_floats_are_floats_and_missing_is_null(tmp_path):
    frame = Frame(1, 0, tracks_at({1: (0.1, 0.2)}))
    tables.write(tmp_path / "t.parquet", tables.rows_table(TRACKS, {"/a": [frame]}), {})
    table = pq.read_table(tmp_path / "t.parquet")
    assert table.column("x_px").null_count == 1
    assert np.isnan(frame.rows["x_px"]).all()
    assert table.column("x_m").to_pylist() == [0.1]
