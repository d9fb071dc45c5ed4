"""Delta tables of many logs: none is lost, none stands there twice, whatever is interrupted and whoever writes."""

from __future__ import annotations

import json
import os
import shutil
import threading
from pathlib import Path

import deltalake
import duckdb
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import mcaptrack
from mcaptrack import log, tables
from mcaptrack.errors import McaptrackError
from mcaptrack.location import parse
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.tables.delta import DeltaFolder, ExportedLog, columns, commit, remove
from mcaptrack.tables.delta.commit import Batch, predicate
from mcaptrack.tables.export import export, recording_name
from tests.commands import call, done
from tests.logs import add_rows, some_log
from tests.tiers import one_in, thorough
from tests.worlds import boxes_at, ns


@pytest.fixture(scope="module")
def some(tmp_path_factory) -> Path:
    """A log and its tables. Not to be changed."""
    path = some_log(tmp_path_factory.mktemp("some") / "a.mcap")
    mcaptrack.export(path)
    return path


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def exported(path: Path, folder: Path, detections: int = 3) -> ExportedLog:
    """A log with so many detections, and its tables in a folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with log.create(path) as writer:
        boxes = [Frame(ns(n), n, boxes_at([(n, 5)])) for n in range(detections)]
        add_rows(writer, "/camera/detections", DETECTIONS, boxes, "detect", "/camera/video")
    with log.read(path) as opened:
        export(opened, folder)
    return ExportedLog(path, folder)


def copies(some: Path, place: Path, names: list[str]) -> list[Path]:
    """The same log under several names."""
    return [Path(shutil.copy(some, place / f"{name}.mcap")) for name in names]


def counts(where: Path, table: str = "detections") -> dict[str, int]:
    """The rows of each log, as Polars finds them."""
    rows = pl.read_delta(str(where / table)).group_by("recording").len()
    return dict(sorted(rows.iter_rows()))


def test_a_log_is_added_once_replaced_when_it_changes_and_removed(some, place):
    shutil.copy(some, "a.mcap")
    shutil.copy(some, "b.mcap")
    assert mcaptrack.export("a.mcap", delta="lake").delta == "added"
    assert mcaptrack.export("b.mcap", delta="lake").delta == "added"
    before = {one.name: one.version for one in mcaptrack.delta("lake").tables}
    assert mcaptrack.export("a.mcap", delta="lake").delta == "unchanged"
    assert {one.name: one.version for one in mcaptrack.delta("lake").tables} == before
    assert counts(place / "lake", "tracks") == {"a": 12, "b": 12}
    mcaptrack.drop("a.mcap", "/camera/detections")
    assert mcaptrack.export("a.mcap", delta="lake").delta == "replaced"
    after = {one.name: one.version for one in mcaptrack.delta("lake").tables}
    assert {name for name in after if after[name] != before[name]} == {"frames", "detections", "channels", "recordings"}
    assert counts(place / "lake") == {"b": 3}
    assert counts(place / "lake", "tracks") == {"a": 12, "b": 12}
    assert mcaptrack.delta("lake", remove="a").removed == ("a",)
    assert {name for one in tables.TABLES for name in counts(place / "lake", one)} == {"b"}
    assert counts(place / "lake", "tracks") == {"b": 12}


def test_all_readers_find_the_rows_that_were_exported(some, place):
    shutil.copy(some, "a.mcap")
    mcaptrack.export("a.mcap", delta="lake")
    for name in tables.TABLES:
        mine = pq.read_table(some.with_suffix(".tables") / name / "recording=a" / "part-0.parquet")
        theirs = deltalake.DeltaTable(f"lake/{name}").to_pyarrow_table()
        assert theirs.num_rows == mine.num_rows == pl.scan_delta(f"lake/{name}").collect().height, name
        exact = [column for column in mine.column_names if column not in ("t", "location", "size_bytes", "file")]
        for column in exact:
            if not pa.types.is_timestamp(mine.schema.field(column).type):
                assert theirs[column].to_pylist() == mine[column].to_pylist(), (name, column)
        words = theirs.schema.field("recording").metadata
        assert words[b"comment"] == tables.RECORDING.description.encode()
    rows = deltalake.DeltaTable("lake/tracks").to_pyarrow_table()
    assert rows["t"].cast(pa.int64()).to_pylist() == [t // 1000 for t in rows["t_ns"].to_pylist()]
    files = deltalake.DeltaTable("lake/tracks").file_uris()
    assert duckdb.sql(f"select count(*), count(distinct track_id) from read_parquet({files})").fetchall() == [(12, 2)]


def test_queries_of_delta_tables_give_the_answers_of_the_log(some, place):
    shutil.copy(some, "a.mcap")
    mcaptrack.export("a.mcap", topic="/imu", delta="lake")
    for query in (
        "select * exclude (t) from tracks order by all",
        'select recording, topic, t_ns, n from "/imu" order by all',
        "select recording, digest, tracks, IDF1, cameras, versions, location from recordings",
        "select count(*) from events",
    ):
        assert mcaptrack.query("lake", query).to_pylist() == mcaptrack.query("a.mcap", query).to_pylist(), query
    assert mcaptrack.query("lake", "select t from tracks order by t_ns").column(0).type == pa.timestamp("us", "UTC")
    listed = mcaptrack.list_tables("lake")
    assert (listed.recordings, listed.channels) == (("a",), ("/imu",))
    with pytest.raises(McaptrackError, match="a is the name of two logs"):
        mcaptrack.query(["lake", "a.mcap"], "select 1")
    shutil.copy(some, "b.mcap")
    both = mcaptrack.query(["lake", "b.mcap"], "select recording, count(*) as n from tracks group by all order by all")
    assert both.to_pylist() == [{"recording": "a", "n": 12}, {"recording": "b", "n": 12}]


@thorough
def test_a_batch_is_one_transaction_a_table(some, place):
    names = [f"log{n}" for n in range(5)]
    copies(some, place, names)
    outcome = done("export", *(f"{name}.mcap" for name in names), "--delta", "lake", "--json")
    found = json.loads(outcome.out)["delta"]
    assert (found["added"], found["replaced"], found["unchanged"]) == (5, 0, 0)
    # All tables with rows, and those that are still empty: none of these needs one.
    assert found["transactions"] == 7
    assert counts(place / "lake", "tracks") == dict.fromkeys(names, 12)
    again = done("export", *(f"{name}.mcap" for name in names), "--delta", "lake")
    assert "5 unchanged in 0 transactions" in again.err


def test_writers_at_once_lose_and_double_nothing(place):
    """Each of four writers adds logs of its own, and one that all of them add; tools/bench/lake.py has processes."""
    logs = [exported(place / f"log{n}.mcap", place / "tables") for n in range(8)]
    shared = exported(place / "shared.mcap", place / "tables")
    lake, failed = place / "lake", []

    def add(first: int) -> None:
        for one in (logs[first], shared, logs[first + 4]):
            fresh = ExportedLog(one.log, one.folder)
            failed.append(commit(lake, [fresh], force=one is shared).failed)

    threads = [threading.Thread(target=add, args=[first]) for first in range(4)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert failed == [{}] * 12
    for name, each in (("detections", 3), ("frames", 3), ("recordings", 1)):
        assert counts(lake, name) == dict.fromkeys([*(f"log{n}" for n in range(8)), "shared"], each), name


def test_the_last_of_two_that_write_one_log_at_once_writes_all_its_tables(place, monkeypatch):
    """One is slower, and finds after its rows of tables that the other has changed the row of the log."""
    old, new = (
        exported(place / where / "a.mcap", place / f"{where}.tables", rows) for where, rows in (("x", 2), ("y", 7))
    )
    lake = place / "lake"
    other = []

    def write_rows(self, table, logs):
        if not other:
            other.append(new)
            commit(lake, [new], force=True)
        return inner(self, table, logs)

    inner = Batch.write_rows
    monkeypatch.setattr(Batch, "write_rows", write_rows)
    outcome = commit(lake, [old], force=True)
    assert outcome.replaced == ["a"]
    assert counts(lake) == {"a": 2}
    assert counts(lake, "frames") == {"a": 2}
    (row,) = pl.read_delta(str(lake / "recordings")).to_dicts()
    assert (row["messages"], row["location"]) == (2, str(place / "x" / "a.mcap"))


def test_a_transaction_that_came_too_late_is_repeated(place, monkeypatch):
    """The library refuses each first one, as where another process was quicker with the same log."""
    one, refused = exported(place / "a.mcap", place / "tables"), []

    def replace(self, table, name, *given):
        if name not in refused:
            refused.append(name)
            raise deltalake.exceptions.CommitFailedError(name)
        return inner(self, table, name, *given)

    inner = Batch._replace
    monkeypatch.setattr(Batch, "_replace", replace)
    found = commit(place / "lake", [one])
    assert (found.added, found.conflicts) == (["a"], len(refused))
    assert {"detections", "frames", "recordings"} <= set(refused)
    for name, rows in (("detections", 3), ("frames", 3), ("recordings", 1)):
        assert counts(place / "lake", name) == {"a": rows}, name


@pytest.mark.parametrize("after", one_in(5, range(5)))
def test_what_was_killed_between_two_transactions_is_completed_by_the_next_call(place, monkeypatch, after):
    """A kill after so many tables; rows without a row in recordings are replaced, and none stands there twice."""
    first = exported(place / "a.mcap", place / "tables")
    lake = place / "lake"
    other = exported(place / "b.mcap", place / "tables")
    commit(lake, [other])
    left = [after]

    def replace(self, *given):
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        return inner(self, *given)

    inner = Batch._replace
    with monkeypatch.context() as patch:
        patch.setattr(Batch, "_replace", replace)
        if after < 4:
            with pytest.raises(KeyboardInterrupt):
                commit(lake, [first])
    assert commit(lake, [first]).added == ["a"]
    for name in ("detections", "frames"):
        assert counts(lake, name) == {"a": 3, "b": 3}, name
    assert commit(lake, [first]).unchanged == ["a"]


def test_a_removal_that_was_killed_is_completed_by_removing_again_or_by_exporting(place, monkeypatch):
    lake = place / "lake"
    first = exported(place / "a.mcap", place / "tables")
    for last in ("remove", "commit"):
        commit(lake, [first])

        def change(self, name, how, inner=Batch.change):
            if name == "tracks":
                raise KeyboardInterrupt
            inner(self, name, how)

        with monkeypatch.context() as patch:
            patch.setattr(Batch, "change", change)
            with pytest.raises(KeyboardInterrupt):
                remove(lake, ["a"])
        assert counts(lake) == {}
        if last == "remove":
            remove(lake, ["a"])
            assert DeltaFolder(lake).recordings() == []
        else:
            assert commit(lake, [first]).replaced == ["a"]
            assert counts(lake) == {"a": 3}


def test_another_log_of_the_same_name_is_refused_and_a_log_that_was_moved_is_not(place):
    lake = place / "lake"
    assert commit(lake, [exported(place / "x" / "a.mcap", place / "1")]).added == ["a"]
    other = exported(place / "y" / "a.mcap", place / "2", 5)
    found = commit(lake, [other]).failed
    assert list(found) == [other.log]
    assert f"{lake} has another log of the name a, {place / 'x' / 'a.mcap'}; rename one of them" in found[other.log]
    assert counts(lake) == {"a": 3}
    code, _, said = call("export", other.log, "-o", "2", "--delta", lake)
    assert code == 1
    assert "or replace it with --force" in said.splitlines()[-1]
    assert commit(lake, [other], force=True).replaced == ["a"]
    assert counts(lake) == {"a": 5}
    (place / "z").mkdir()
    moved = (place / "y" / "a.mcap").rename(place / "z" / "a.mcap")
    assert mcaptrack.export(moved, "2", delta=lake).delta == "replaced"
    twice = commit(lake, [ExportedLog(moved, place / "2"), other])
    assert list(twice.failed) == [other.log]


def test_one_log_that_cannot_be_added_does_not_stop_the_others(some, place):
    logs = copies(some, place, ["a", "b", "c"])
    for path in logs:
        mcaptrack.export(path, "tables")
    (place / "tables/tracks/recording=b/part-0.parquet").write_bytes(b"noise")
    (place / "tables/recordings/recording=c/part-0.parquet").unlink()
    found = commit(place / "lake", [ExportedLog(path, place / "tables") for path in logs])
    assert (found.added, list(found.failed)) == (["a"], logs[1:])
    assert "tracks/recording=b/part-0.parquet is no exported table" in found.failed[logs[1]]
    assert counts(place / "lake", "tracks") == {"a": 12}


@pytest.mark.parametrize("name", one_in(5, ['-a"b; %2Fetc', "it's", "日本語 é", "0001", "a\udcff"]))
def test_names_with_signs_that_mean_something_elsewhere(some, place, name):
    path = place / f"{name}.mcap"
    try:
        shutil.copy(some, path)
    except OSError:
        pytest.skip("the file system has no such names")
    assert mcaptrack.export(path, "tables", delta="lake").delta == "added"
    assert mcaptrack.export(path, "tables", delta="lake", force=True).delta == "replaced"
    assert counts(place / "lake", "tracks") == {recording_name(path): 12}
    assert mcaptrack.delta("lake", remove=recording_name(path)).tables[2].rows == 0


def test_a_quote_in_a_name_cannot_leave_the_condition():
    assert predicate(["a' OR '1'='1", "b"]) == "recording IN ('a'' OR ''1''=''1', 'b')"


def test_logs_of_several_versions_and_kinds_stand_in_one_table(place, monkeypatch):
    """A column that is new is null in the rows before, and one that is missing in the rows after."""
    lake = place / "lake"
    old = exported(place / "old.mcap", place / "tables")
    path = old.file("detections")
    whole = pq.read_table(path, partitioning=None)
    words = {key.decode().removeprefix("mcaptrack."): value.decode() for key, value in whole.schema.metadata.items()}
    words = {key: value for key, value in words.items() if key not in ("digest", "ARROW:schema")}
    tables.write(path, whole.drop_columns(["z_m", "class"]), words)
    commit(lake, [exported(place / "new.mcap", place / "tables")])
    commit(lake, [old])
    newer = exported(place / "newer.mcap", place / "tables")
    more = pq.read_table(newer.file("detections"), partitioning=None)
    tables.write(newer.file("detections"), more.append_column("later", pa.array([1, 2, 3])), words)
    commit(lake, [newer])
    rows = {row["recording"]: row for row in pl.read_delta(str(lake / "detections")).sort("t_ns").to_dicts()}
    assert [rows[name]["later"] for name in ("old", "new", "newer")] == [None, None, 3]
    assert rows["old"]["class"] is None
    assert counts(lake) == {"new": 3, "newer": 3, "old": 3}


@thorough
def test_channels_whose_columns_have_other_types_are_left_out_with_a_line(place):
    for name, value in (("a", 1), ("b", "text"), ("c", 2), ("d", 0.5)):
        with log.create(place / f"{name}.mcap") as writer:
            channel = writer.add_channel("/odd name", ("", "", b""), "json", {})
            writer.add_message(channel, 1, 1, json.dumps({"x y": value, "X_Y": 1, "none": []}).encode())
        outcome = done("export", f"{name}.mcap", "--topic", "/odd name", "--delta", "lake")
        assert ("left out" in outcome.err) == (name in "bd"), outcome.err
    assert "its column x_y is string, and int64 there" in call("export", "b.mcap", "--delta", "lake", "--force").err
    answer = mcaptrack.query("lake", 'select recording, x_y, "X_Y_2" from "/odd name" order by all')
    assert answer.to_pylist() == [{"recording": "a", "x_y": 1, "X_Y_2": 1}, {"recording": "c", "x_y": 2, "X_Y_2": 1}]


def test_types_become_those_that_delta_has():
    schema = pa.schema(
        {"a": pa.uint32(), "b": pa.dictionary(pa.int32(), pa.string()), "t": pa.timestamp("ns", "UTC"), "n": pa.null()}
        | {"l": pa.list_(pa.uint8()), "u": pa.uint64()}
    )
    made = columns.columns_of(schema)
    assert made.names == ["recording", "a", "b", "t", "l", "u"]
    assert [str(field.type) for field in made][1:5] == [
        "int64",
        "string",
        "timestamp[us, tz=UTC]",
        "list<element: int16>",
    ]
    assert pa.types.is_decimal(made.field("u").type)


def test_an_empty_log_stands_in_recordings(place):
    with log.create(place / "empty.mcap"):
        pass
    assert mcaptrack.export("empty.mcap", delta="lake").delta == "added"
    assert mcaptrack.query("lake", "select recording, messages, tracks from recordings").to_pylist() == [
        {"recording": "empty", "messages": 0, "tracks": None}
    ]
    assert mcaptrack.export("empty.mcap", delta="lake").delta == "unchanged"


def test_tables_of_other_programs_are_refused_in_one_line(some, place):
    shutil.copy(some, "a.mcap")
    deltalake.write_deltalake("other/recordings", pa.table({"x": [1]}))
    with pytest.raises(McaptrackError, match="is not one of logs: it has no column recording; give another folder"):
        mcaptrack.export("a.mcap", delta="other")
    deltalake.write_deltalake("typed/tracks", pa.table({"recording": ["z"], "track_id": ["text"]}))
    with pytest.raises(McaptrackError, match="is not one of logs: its column track_id is int64, and string there"):
        mcaptrack.export("a.mcap", delta="typed")
    assert deltalake.DeltaTable("typed/tracks").version() == 0
    deltalake.write_deltalake("alone", pa.table({"recording": ["z"]}))
    with pytest.raises(McaptrackError, match="alone"):
        mcaptrack.query("alone", "select 1")
    with pytest.raises(McaptrackError, match="alone has no Delta tables of logs"):
        mcaptrack.delta("alone")
    Path("damaged/recordings/_delta_log").mkdir(parents=True)
    Path("damaged/recordings/_delta_log/00000000000000000000.json").write_text("noise")
    with pytest.raises(McaptrackError, match=r"the Delta table .*damaged/recordings can't be read"):
        mcaptrack.query("damaged", "from recordings")


def test_what_cannot_be_written_is_said_before_logs_are_exported(some, place):
    copies(some, place, ["a", "b"])
    Path("file").write_text("")
    for where, words in (("file", "can't be written"), ("a%20b", "% has a meaning"), ("file/lake", "can't be written")):
        code, _, said = call("export", "a.mcap", "b.mcap", "--delta", where)
        assert (code, words in said.splitlines()[-1], len(said.splitlines())) == (1, True, 1), said
    assert not Path("a.tables").exists()
    for words in (["--format", "csv"], ["--format", "rosbag2"]):
        code, _, said = call("export", "a.mcap", *words, "--delta", "lake")
        assert (code, said.count("\n")) == (1, 1)
    assert not Path("lake").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written_is_one_line(some, place):
    shutil.copy(some, "a.mcap")
    Path("lake").mkdir(mode=0o500)
    assert "can't be written: it may not be written here" in call("export", "a.mcap", "--delta", "lake").err


@thorough
def test_small_files_are_joined_old_ones_deleted_and_old_versions_read(some, place):
    for name in "abc":
        shutil.copy(some, f"{name}.mcap")
        mcaptrack.export(f"{name}.mcap", delta="lake")
    before = mcaptrack.query("lake", "from tracks order by all").to_pylist()
    found = mcaptrack.delta("lake", compact=True)
    assert found.compacted["tracks"] == (3, 1)
    assert mcaptrack.query("lake", "from tracks order by all").to_pylist() == before
    version = next(one.version for one in found.tables if one.name == "tracks")
    assert counts(place / "lake", "tracks") == dict.fromkeys("abc", 12)
    assert pl.read_delta("lake/tracks", version=version - 2).height == 24
    old = list(Path("lake/tracks").glob("*.parquet"))
    for path in old:
        os.utime(path, (0, 0))
    assert len(old) == 4
    outcome = done("delta", "lake", "--keep-days", "1", "--remove", "[ab]", "--json")
    assert json.loads(outcome.out)["removed"] == ["a", "b"]
    assert counts(place / "lake", "tracks") == {"c": 12}
    with pytest.raises(McaptrackError, match=r"lake has no log x; it has c$"):
        mcaptrack.delta("lake", remove="x")


@thorough
def test_a_ledger_that_says_done_does_not_keep_a_log_out_of_the_tables(some, place):
    """A kill after the export, before the transaction."""
    copies(some, place, ["a", "b"])
    done("export", "a.mcap", "b.mcap", "--ledger", "ledger.jsonl")
    outcome = done("export", "a.mcap", "b.mcap", "--ledger", "ledger.jsonl", "--delta", "lake")
    assert counts(place / "lake", "tracks") == {"a": 12, "b": 12}, outcome.err


@thorough
def test_writers_in_one_store_lose_nothing_and_its_faults_are_one_plain_line(store):
    """The library colours its messages, and repeats them; what a store answers is said as for logs."""
    lake, failed = parse("s3://bucket/lake"), []
    logs = [exported(Path(f"{name}.mcap"), Path("tables")) for name in "abc"]

    def add(*those: ExportedLog) -> None:
        failed.extend(commit(lake, [ExportedLog(one.log, one.folder)]).failed for one in those)

    threads = [threading.Thread(target=add, args=(logs[n], logs[2])) for n in range(2)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert failed == [{}] * 4
    found = mcaptrack.query(lake, "select recording, count(*) as n from detections group by all order by all")
    assert found.to_pylist() == [{"recording": name, "n": 3} for name in "abc"]
    assert mcaptrack.query(lake, "select count(*) as n from recordings").to_pylist() == [{"n": 3}]
    forbidden, expired = (
        "the store refuses it to these credentials (forbidden)",
        "the credentials have expired; renew them",
    )
    for kind, words in (("denied", forbidden), ("expired", expired)):
        with store.failing(lambda request, kind=kind: kind if request.method == "PUT" else ""):
            with pytest.raises(McaptrackError) as error:
                commit(lake, logs[:1], force=True)
            assert str(error.value) == f"the Delta table {lake}/frames can't be written: {words}"
        with store.failing(lambda request, kind=kind: kind if ".parquet" in request.key else ""):
            with pytest.raises(McaptrackError) as error:
                mcaptrack.query(lake, "select max(x_px) from detections")
            assert str(error.value) == f"the Delta tables {lake} can't be read: {words}"
    assert commit(lake, logs).unchanged == ["a", "b", "c"]
