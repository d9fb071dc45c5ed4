"""A log as a folder of tables: complete, joined, and written only where something changed."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import duckdb
import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest

from mcaptrack import log, tables
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import GROUND_PLANE, TRACKS, Frame
from mcaptrack.schema.as_rows import plane_to_rows
from mcaptrack.tables import TABLES
from mcaptrack.tables.export import ALWAYS, LogTables, export, recording_name, topic_folder
from mcaptrack.tables.fields import table_version
from tests.commands import call, done
from tests.logs import add_rows, recorder, some_log
from tests.ros_messages import ros_writer
from tests.worlds import ns, tracks_at


def ask(query, folder):
    return duckdb.sql(query.replace("@", str(folder))).fetchall()


def exported(path, folder, **options):
    with log.read(path) as opened:
        return export(opened, folder, **options)


def test_a_log_becomes_a_folder_that_duckdb_joins(tmp_path):
    done = exported(some_log(tmp_path / "walk = 1.mcap"), tmp_path / "tables")
    assert done.rows == dict.fromkeys(tables.TABLES, 0) | {
        "channels": 4, "detections": 3, "frames": 10, "metrics": 3, "recordings": 1, "track_summary": 4, "tracks": 12,
    }  # fmt: skip
    folder = tmp_path / "tables"
    assert ask("select topic, t_ns, rows from '@/frames/*/*.parquet' where rows = 0 order by all", folder) == [
        ("/camera/detections", ns(2), 0),
        ("/camera/tracks", ns(3), 0),
    ]
    joined = "select count(*) from '@/tracks/*/*.parquet' join '@/frames/*/*.parquet' using (recording, topic, frame, t_ns, t)"
    assert ask(joined, folder) == [(12,)]
    assert ask("select count(*) from '@/predictions/*/*.parquet'", folder) == [(0,)]
    assert ask(
        "select track_id, s.rows, path_m, s.duration_s, mean_speed_m_s, input, version is not null, start_t_ns "
        "from '@/track_summary/*/*.parquet' s join '@/channels/*/*.parquet' using (recording, topic) "
        "join '@/recordings/*/*.parquet' using (recording) where topic = '/camera/tracks' order by track_id",
        folder,
    ) == [(4, 3, 1.0, 2.0, 0.5, "/camera/detections", True, 0), (9, 3, 0.5, 2.0, 0.25, "/camera/detections", True, 0)]
    assert {path.name for path in folder.iterdir()} == {*ALWAYS, "recordings"} == {*tables.TABLES} - {*done.spare}
    for name in (*ALWAYS, "recordings"):
        key = ", ".join(dict.fromkeys(("recording", *tables.TABLES[name].key)))
        assert ask(f"select {key} from '@/{name}/*/*.parquet' group by all having count(*) > 1", folder) == [], name


def test_scores_are_those_of_evaluate(tmp_path):
    path = some_log(tmp_path / "a.mcap")
    exported(path, tmp_path / "tables")
    wanted = json.loads(done("evaluate", path, "--json").out)["results"]
    rows = pq.read_table(tmp_path / "tables/metrics/recording=a/part-0.parquet").to_pylist()
    assert len(rows) == len(wanted) == 3
    for result in wanted:
        (row,) = (r for r in rows if (r["topic"], r["gate"]) == (result["tracks"], result["gate"]))
        shared = set(row) & set(result)
        assert {name: row[name] for name in shared} == {name: result[name] for name in shared}
        assert {"MOTA", "IDF1", "HOTA", "IDSW", "GT", "similarity", "rules", "mode"} <= shared
    assert set(wanted[0]) - {"sequence", "tracks", "displacement"} <= set(rows[0])


def test_unusable_ground_truth_leaves_no_scores_and_a_note(tmp_path):
    with log.create(tmp_path / "a.mcap") as writer:
        add_rows(writer, "/camera/truth", TRACKS, [Frame(0, 0, tracks_at({1: (0, 0)}))], "ingest", "")
    done = exported(tmp_path / "a.mcap", tmp_path / "tables")
    assert done.rows["metrics"] == 0
    assert "has no tracks to score" in done.notes[0]
    assert done.notes[0].endswith(f"role='tracks', into='{tmp_path / 'a.mcap'}')` takes them from a file")


def test_recordings_say_what_the_log_is(tmp_path):
    plane = GroundPlane((0.1, 0, 0, 0, 0.1, 0, 0, 0, 1), 320, 180, "foot", True)
    plain = some_log(tmp_path / "plain.mcap")
    planar = some_log(
        tmp_path / "p.mcap", **{"/camera/ground_plane": (GROUND_PLANE, [Frame(0, 0, plane_to_rows(plane))])}
    )
    with log.read(plain) as a, log.read(planar) as b:
        first, second = (LogTables(opened).table("recordings").to_pylist()[0] for opened in (a, b))
    assert (first["file"], first["messages"], first["duration_s"], first["ground_plane"]) == (
        "plain.mcap", 14, 3.000000007, None,
    )  # fmt: skip
    assert first["size_bytes"] == plain.stat().st_size
    assert second["ground_plane"] == "assumed"
    assert json.loads(first["source"]) == {"/camera/truth": {"max_age_s": 1.4}}
    assert re.fullmatch("[0-9a-f]{64}", first["digest"])
    assert first["digest"] != second["digest"]


def test_units_meaning_and_provenance_are_in_the_file(tmp_path):
    exported(some_log(tmp_path / "a.mcap"), tmp_path / "tables")
    schema = pq.read_schema(tmp_path / "tables" / "tracks" / "recording=a" / "part-0.parquet")
    assert schema.field("x_m").metadata == {b"unit": b"m", b"description": b"position on the ground plane, first axis"}
    lineage = json.loads(schema.metadata[b"mcaptrack.lineage"])
    assert lineage["/camera/tracks"] == {
        "transform": "track",
        "input": "/camera/detections",
        "parameters": {"max_age_s": 1.4},
    }
    assert set(lineage) == {"/camera/tracks", "/camera/truth", "/camera/detections"}  # back to what was recorded
    assert schema.metadata[b"mcaptrack.recording"] == b"a.mcap"


# Again


def stamps(folder):
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("part-0.*")}


def test_exporting_again_writes_what_changed_and_touches_nothing_else(tmp_path):
    path, folder = some_log(tmp_path / "a.mcap"), tmp_path / "tables"
    first = exported(path, folder, topics=["/imu"])
    second = exported(some_log(tmp_path / "b.mcap"), folder)
    before = stamps(folder)
    with_rows = {f"{name}/recording=b/part-0.parquet" for name, rows in second.rows.items() if rows}
    with_file = first.rows.keys() - {*first.spare}
    assert before.keys() == with_rows | {f"{name}/recording=a/part-0.parquet" for name in with_file} | {
        "manifest/recording=a/part-0.json"
    }  # b has no tables without rows: patterns find those of a
    assert exported(path, folder).written == []
    assert stamps(folder) == before

    with log.read(path) as opened, log.extend(opened, drop=["/camera/tracks"]) as writer:
        add_rows(writer, "/camera/tracks", TRACKS, [Frame(0, 0, tracks_at({4: (7.0, 7.0)}))])
    done = exported(path, folder)
    assert set(done.written) == {"frames", "tracks", "track_summary", "metrics", "channels", "recordings"}
    changed = {name for name, at in stamps(folder).items() if at != before[name]}
    assert changed == {f"{name}/recording=a/part-0.parquet" for name in done.written}
    assert pl.read_parquet(f"{folder}/tracks/*/*.parquet", hive_partitioning=True).filter(
        recording="a", topic="/camera/tracks"
    )["x_m"].to_list() == [7.0]


def test_a_table_that_was_damaged_or_lost_is_made_again(tmp_path):
    path, folder = some_log(tmp_path / "a.mcap"), tmp_path / "tables"
    exported(path, folder)
    (folder / "tracks/recording=a/part-0.parquet").write_bytes(b"PAR1 half a table")
    (folder / "events/recording=a/part-0.parquet").unlink()
    assert set(exported(path, folder).written) == {"tracks", "events"}


@pytest.mark.parametrize("change", [{"unit": "km"}, {"description": "in words"}])
def test_tables_with_other_columns_have_another_version_and_are_made_again(tmp_path, monkeypatch, change):
    path, folder = some_log(tmp_path / "a.mcap"), tmp_path / "tables"
    exported(path, folder)
    *others, last = TABLES["frames"].fields
    changed = replace(TABLES["frames"], fields=(*others, replace(last, **change)))
    monkeypatch.setitem(TABLES, "frames", changed)
    table_version.cache_clear()
    assert "frames" in exported(path, folder).written
    monkeypatch.undo()
    table_version.cache_clear()
    assert exported(path, folder).written
    assert exported(path, folder).written == []


def test_tables_of_channels_that_are_gone_go(tmp_path):
    path, folder = some_log(tmp_path / "a.mcap"), tmp_path / "tables"
    exported(path, folder, topics=["/imu"])
    assert (folder / "topics/imu/recording=a/part-0.parquet").is_file()
    with log.read(path) as opened, log.extend(opened, drop=["/imu", "/camera/detections"]):
        pass
    done = exported(path, folder)
    assert done.removed == ["topics/imu"]
    assert not (folder / "topics/imu").exists()
    assert ask("select count(*) from '@/detections/*/*.parquet'", folder) == [(0,)]


# Names


def test_names_of_logs_never_climb_out_of_the_folder_and_are_no_numbers_or_dates():
    names = {"../../etc/x": "x", "a=b c": "a_b_c", "..": "log", "ü.1": "ü.1", "walk_07": "walk_07"}
    names |= {"2026-05-01 10:00:00": "log-2026-05-01_10_00_00"}
    names |= {name: f"log-{name}" for name in ("0001", "1.5", "1e5", "2026-05-01", "true", "NaN", "-7")}
    assert {name: recording_name(Path(f"logs/{name}.mcap")) for name in names} == names


EVIL = [
    "/../../etc/x", "..", "/", "", "/a/b", "/a.b", "a/b", "/a/../b", "/a\\b", "/a\0b", "/ü", "/a=b", "//a", "/.",
    "/" + "x/" * 300,
]  # fmt: skip


def test_topics_become_folders_of_their_own_that_stay_where_they_belong(tmp_path):
    names = [topic_folder(topic) for topic in EVIL]
    assert len(set(names)) == len(EVIL)
    for name in names:
        assert not set(name) & set("/\\\0=")
        assert name.strip(".")
        assert len(name.encode()) < 240
        assert (tmp_path / name).resolve().parent == tmp_path.resolve()
    assert topic_folder("/imu/data_raw") == "imu.data_raw"


def test_a_topic_with_an_evil_name_is_exported_inside_of_the_folder(tmp_path):
    with log.create(tmp_path / "a.mcap") as writer:
        number = writer.add_channel("/../../x", ("", "", b""), "json", {})
        writer.add_message(number, 1, 0, b'{"../y": "=cmd()", "a\\nb": 1}')
    exported(tmp_path / "a.mcap", tmp_path / "in" / "tables", topics=["/../../x"])
    assert {path.name for path in tmp_path.iterdir()} == {"a.mcap", "in"}
    assert {path.name for path in (tmp_path / "in").iterdir()} == {"tables"}


# Channels of others


def test_a_foreign_channel_becomes_a_table_with_sql_names(tmp_path):
    told = []
    done = exported(some_log(tmp_path / "a.mcap"), tmp_path, topics=["/imu"], progress=lambda *some: told.append(some))
    assert told == [("export", count, len(told)) for count in range(1, len(told) + 1)]  # one table after the other
    assert done.rows["topics/imu"] == 4
    query = "select frame, t_ns, epoch_ns(header_stamp), header_frame_id, gyro_x, cov[2], n from '@/topics/imu/*/*.parquet' order by n"
    assert ask(query, tmp_path) == [(n, ns(n) + 7, ns(1) + 5, "imu", 0.5, 2.0, n) for n in range(4)]
    assert ask("select distinct topic from '@/topics/imu/*/*.parquet'", tmp_path) == [("/imu",)]
    field = pq.read_schema(tmp_path / "topics/imu/recording=a/part-0.parquet").field("gyro_x")
    assert field.metadata[b"path"] == b"gyro.x"
    with log.read(tmp_path / "a.mcap") as opened:
        assert field.metadata[b"description"].decode() == f"field gyro.x of {opened.channel('/imu').schema_name}"


@pytest.mark.parametrize("ros1", [False, True])
def test_fields_of_ros_have_the_units_that_it_states(ros1, tmp_path):
    name, schema_encoding, definition, encoding = ros_writer("nav_msgs/Odometry", ros1=ros1).kind
    with recorder(tmp_path / "a.mcap") as writer:
        writer.add_channel("/odom", (name, schema_encoding, definition), encoding)
    with log.read(tmp_path / "a.mcap") as opened:
        schema = LogTables(opened).messages("/odom").schema
    units = {field.name: field.metadata[b"unit"].decode() for field in schema}
    wanted = {"header_stamp": "ns", "pose_pose_position_x": "m", "pose_pose_orientation_w": "1", "child_frame_id": ""}
    wanted |= {"twist_twist_linear_y": "m/s", "twist_twist_angular_z": "rad/s", "pose_covariance": ""}
    assert {name: units[name] for name in wanted} == wanted


@pytest.mark.parametrize("form", ["csv", "jsonl", "arrow"])
def test_other_formats_hold_the_same(tmp_path, form):
    path = some_log(tmp_path / "a.mcap")
    said = done("export", path, "-o", tmp_path / "t", "--format", form, "--topic", "/imu", "--json").out
    assert json.loads(said)["results"][0]["rows"]["tracks"] == 12
    read = {
        "csv": lambda p: pl.read_csv(p, schema_overrides={"gyro_y": pl.Float64}),
        "jsonl": pl.read_ndjson,
        "arrow": pl.read_ipc,
    }[form]
    with log.read(path) as opened:
        wanted = LogTables(opened).table("tracks")
        imu = LogTables(opened).messages("/imu")
    found = read(tmp_path / "t" / "tracks" / "recording=a" / f"part-0.{form}")
    for name in ("topic", "t_ns", "track_id", "x_m", "observed"):
        assert found[name].to_list() == wanted.column(name).to_pylist()
    found = read(tmp_path / "t" / "topics" / "imu" / "recording=a" / f"part-0.{form}")
    assert found.columns == imu.column_names
    assert np.array_equal(np.signbit(found["gyro_y"].to_numpy()), [True] * 4)


def test_an_unreadable_message_is_reported_with_its_time(tmp_path):
    with log.create(tmp_path / "a.mcap") as writer:
        number = writer.add_channel("/x", ("", "", b""), "json", {})
        writer.add_message(number, 5, 0, b"{")
    with pytest.raises(McaptrackError, match=r"/x at 5 ns: 1 bytes are not a json message"):
        exported(tmp_path / "a.mcap", tmp_path / "t", topics=["/x"])
    outcome = call("export", tmp_path / "a.mcap", "--blobs")
    assert (outcome.code, "with --topic" in outcome.err) == (1, True)
    with pytest.raises(McaptrackError, match="has no channel /y"):
        exported(tmp_path / "a.mcap", tmp_path / "t", topics=["/y"])
