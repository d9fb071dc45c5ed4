"""Rows as Parquet and back to the bit, read by DuckDB, Polars and pandas too."""

from __future__ import annotations

import csv
import datetime as dt
import errno
import gc
import io
import json
import math
import os
import re
import resource
import signal
import sys
from pathlib import Path
from unittest.mock import patch

import duckdb
import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import tables
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import EVENTS, SCHEMAS, SIGHTINGS, TRACKS, Frame
from mcaptrack.schema.frame_columns import collect
from mcaptrack.schema.provenance import Provenance
from mcaptrack.tables import TABLES, Pointers, build, files, messages, text
from mcaptrack.tables import files as tables_files
from mcaptrack.tables.fields import CODES
from tests.bounded import held
from tests.commands import call
from tests.logs import flat_table, write_channels
from tests.strategies import columns
from tests.tiers import one_in, thorough
from tests.worlds import ns, table_to_frames, tracks_at

ROOT = Path(__file__).parent.parent
ALL = st.sampled_from(sorted(SCHEMAS.values(), key=lambda schema: schema.name))
TIMES = st.integers(0, 2**63 - 1)
DOUBLES = st.floats(allow_nan=False) | st.sampled_from([-0.0, 5e-324, -2.2e-308, float("inf"), -float("inf"), 0.1])


def pointers(frames):
    """Where these frames might stand in a log."""
    numbers = [np.array(part, np.int64) for part in zip(*((f.t_ns, f.index, len(f.rows)) for f in frames), strict=True)]
    t_ns, index, rows = numbers or [np.empty(0, np.int64)] * 3
    return Pointers("a.mcap", t_ns, index, rows, np.full(len(t_ns), 8), np.arange(len(t_ns)) * 100)


def some_tracks(people):
    return tables.rows_in_pieces(TRACKS, {"/a": [Frame(n, n, tracks_at(who)) for n, who in enumerate(people)]}).table()


#: Columns, each of which differs from the first of its line in one value, or in which rows are null.
DIGESTED = [
    [pa.array(values, kind) for values in lines]
    for kind, *lines in [
        (pa.int64(), [1, 2, 0], [1, 3, 0], [1, 2, None], [1, None, 0], [2, 1, 0]),
        (pa.float64(), [0.5, 0.0, -1.0], [0.5, -0.0, -1.0], [0.5, None, -1.0], [0.25, 0.0, -1.0]),
        (pa.bool_(), [True, False, False], [True, True, False], [True, None, False], [True, False, None]),
        (pa.string(), ["ab", "c", ""], ["a", "bc", ""], ["ab", "c", None], ["ab", "d", ""], ["ab", "", "c"]),
        (pa.large_string(), ["ab", "c", ""], ["a", "bc", ""], ["ab", "c", None]),
        (pa.binary(), [b"ab", b"c", b""], [b"a", b"bc", b""], [b"ab", b"c", None]),
        (pa.timestamp("ns"), [1, 2, 0], [1, 3, 0], [1, 2, None]),
        (pa.list_(pa.int32()), [[1, 2], [], [3]], [[1], [2], [3]], [[1, 2], None, [3]], [[1, 2], [], [4]]),
        (pa.list_(pa.string()), [["a", "b"], [], []], [["ab"], [], []], [["a", "c"], [], []]),
        (
            pa.struct({"x": pa.int8()}),
            [{"x": 1}, {"x": 2}, {"x": 0}],
            [{"x": 1}, {"x": 3}, {"x": 0}],
            [{"x": 1}, {"x": 2}, None],
        ),
        (pa.dictionary(pa.int8(), pa.string()), ["a", "b", "a"], ["a", "b", "b"], ["a", "b", None]),
        (pa.null(), [None, None, None]),
    ]
]


def test_a_digest_is_of_names_types_and_values_and_not_of_pieces():
    def digest(name: str, *pieces: pa.Array) -> str:
        parts = [pa.table({"id": pa.array([7] * len(one), pa.int8()), name: one}) for one in pieces]
        return tables_files.digest(parts[0].schema, parts)[0]

    found = {digest("other", DIGESTED[0][0])}
    for same in DIGESTED:
        for one in same:
            whole = digest("x", one)
            assert digest("x", one[:0], one[:1], one[1:]) == digest("x", one[:2], one[2:]) == whole
            assert whole not in found
            found.add(whole)
    # Names in other places of a dictionary are the same names; rows are counted where all values are null.
    words = DIGESTED[-2][0]
    turned = pa.DictionaryArray.from_arrays(pa.array([1, 0, 1], pa.int8()), ["b", "a"])
    assert digest("x", turned) == digest("x", words)
    assert digest("x", DIGESTED[-1][0][:2]) not in found


@given(st.data())
@settings(max_examples=15)
def test_rows_and_empty_frames_survive_files_to_the_bit(tmp_path_factory, data):
    folder, schema = tmp_path_factory.mktemp("tables"), data.draw(ALL)
    form = data.draw(st.sampled_from(["parquet", "arrow"]))
    channels = {}
    for topic in ("/a", "/b/c"):
        times = sorted(data.draw(st.lists(st.integers(0, 2**62), max_size=4)))  # one time may come twice
        channels[topic] = [Frame(t, n, schema.rows(**data.draw(columns(schema, 4)))) for n, t in enumerate(times)]
    table = tables.rows_in_pieces(schema, channels).table()
    tables.write(folder / "rows", table, {}, tables.table_of(schema).order, form)
    places = [tables.frames_table(topic, pointers(frames), [*channels, "a.mcap"]) for topic, frames in channels.items()]
    tables.write(folder / "frames", pa.concat_tables(places), {}, (), form)
    read = pq.read_table if form == "parquet" else lambda path: pa.ipc.open_file(pa.memory_map(str(path))).read_all()
    rows, frames = (read(folder / name) for name in ("rows", "frames"))
    assert rows.schema.remove_metadata() == table.schema.remove_metadata()
    for topic, wanted in channels.items():
        found = table_to_frames(schema, rows, frames, topic)
        assert [(f.t_ns, f.index, schema.codec.encode(f.rows)) for f in found] == [
            (f.t_ns, f.index, schema.codec.encode(f.rows)) for f in wanted
        ]


@given(st.lists(st.tuples(TIMES, DOUBLES, st.none() | DOUBLES), min_size=1, max_size=12))
@example([(0, 0.0, None), (2**63 - 1, 0.0, None)])
@settings(max_examples=20)
@thorough
def test_other_libraries_read_the_same_bits_and_nanoseconds(tmp_path_factory, given_rows):
    path = tmp_path_factory.mktemp("t") / "t.parquet"
    frames = []
    for number, (t_ns, x, y) in enumerate(sorted(given_rows, key=lambda row: row[0])):
        rows = TRACKS.empty(1)
        rows["x_m"], rows["y_m"] = x, np.nan if y is None else y
        for name in ("x_px", "y_px", "w_px", "h_px", "score"):
            rows[name] = np.nan
        rows["source_id"] = np.iinfo(np.int64).min
        frames.append(Frame(t_ns, number, rows))
    tables.write(path, tables.rows_in_pieces(TRACKS, {"/a": frames}).table(), {})
    wanted = [
        (f.t_ns, f.rows["x_m"].view("<u8")[0], None if np.isnan(f.rows["y_m"][0]) else f.rows["y_m"].view("<u8")[0])
        for f in frames
    ]

    def bits(values):
        return [None if v is None or v is pd.NA or v != v else np.float64(v).view("<u8") for v in values]

    of_duckdb = duckdb.sql(f"select epoch_ns(t), t_ns, x_m, y_m from '{path}'").fetchall()
    t, t_ns, x, y = zip(*of_duckdb, strict=True)
    if not duckdb.__version__.startswith("1."):  # DuckDB 1 cuts times to microseconds
        assert list(t) == [None if value == 2**63 - 1 else value for value in t_ns]  # the last one is its infinity
    assert list(zip(t_ns, bits(x), bits(y), strict=True)) == wanted

    polars = pl.read_parquet(path)
    assert polars.schema["t"] == pl.Datetime("ns", "UTC")
    assert polars["t"].dt.timestamp("ns").to_list() == polars["t_ns"].to_list()
    assert list(zip(polars["t_ns"], bits(polars["x_m"]), bits(polars["y_m"]), strict=True)) == wanted

    pandas = pd.read_parquet(path)
    assert str(pandas["t"].dtype) == "datetime64[ns, UTC]"
    assert pandas["t"].astype("int64").to_list() == pandas["t_ns"].to_list()
    assert list(zip(pandas["t_ns"].tolist(), bits(pandas["x_m"]), bits(pandas["y_m"]), strict=True)) == wanted
    assert set(pandas["source_id"]) == {np.iinfo(np.int64).min}


def test_missing_is_null_and_null_is_missing_whatever_bits_a_nan_has():
    rows = tracks_at({1: (0.0, 0.0), 2: (0.0, 0.0)}).copy()
    rows["x_m"] = np.array([0x7FF8_0000_DEAD_BEEF, 0xFFF0_0000_0000_0001], np.uint64).view(float)
    table = tables.rows_in_pieces(TRACKS, {"/a": [Frame(1, 0, rows)]}).table()
    assert table.column("x_m").null_count == 2
    assert table.column("y_m").null_count == 0
    (frame,) = table_to_frames(TRACKS, table, tables.frames_table("/a", pointers([Frame(1, 0, rows)])), "/a")
    assert np.isnan(frame.rows["x_m"]).all()


# What stands in a file


def test_rows_of_a_track_stand_together_and_the_file_says_in_which_order(tmp_path):
    people = [{5: (n, 0), 3: (0, n), -2: (1, 1)} for n in range(4)]
    order = TABLES["tracks"].order
    tables.write(tmp_path / "t.parquet", some_tracks(people), {}, order)
    read = pq.read_table(tmp_path / "t.parquet")
    keys = list(zip(*(read.column(name).to_pylist() for name in order), strict=True))
    assert keys == sorted(keys)
    file = pq.ParquetFile(tmp_path / "t.parquet")
    ways, _ = pq.SortingColumn.to_ordering(file.schema_arrow, file.metadata.row_group(0).sorting_columns)
    assert [name for name, _ in ways] == list(order)
    assert read.column("row").to_pylist() == [2, 5, 8, 11, 1, 4, 7, 10, 0, 3, 6, 9]


def test_columns_are_compressed_and_described_as_they_should_be(tmp_path):
    people = [{n: (n / 7, n / 3) for n in range(50)} for _ in range(40)]
    tables.write(tmp_path / "t.parquet", some_tracks(people), {}, TABLES["tracks"].order)
    group = pq.read_metadata(tmp_path / "t.parquet").row_group(0)
    for number in range(group.num_columns):
        column = group.column(number)
        assert column.compression == "ZSTD"
        assert column.is_stats_set
        assert column.has_offset_index
        if column.physical_type in ("DOUBLE", "FLOAT"):
            assert "BYTE_STREAM_SPLIT" in column.encodings
        if column.physical_type == "INT64":
            assert "DELTA_BINARY_PACKED" in column.encodings


@pytest.mark.parametrize("table", TABLES.values(), ids=list(TABLES))
def test_every_column_says_its_unit_and_meaning(table):
    for field in table.arrow:
        words = {key.decode(): value.decode() for key, value in field.metadata.items()}
        assert words["description"].strip(), field.name
        assert "unit" in words, field.name
        tail = field.name.rpartition("_")[2]
        if tail in ("px", "m", "s", "ns", "m2", "rad") and not field.name.endswith(("_m_s", "_m_per_s")):
            assert words["unit"] == {"m2": "m^2"}.get(tail, tail), field.name
        if pa.types.is_integer(field.type) or pa.types.is_floating(field.type):
            assert words["unit"], field.name
    assert set(table.key) <= {*table.arrow.names, "recording"}
    assert set(table.order) <= set(table.arrow.names)


def test_the_page_of_the_tables_has_every_column_with_unit_and_meaning():
    page = call("docs", "tables").out
    for table in TABLES.values():
        section = page.partition(f"\n### {table.name}\n")[2].partition("\n### ")[0]
        rows = [[cell.strip() for cell in line.split("|")[1:5]] for line in section.splitlines() if line[:3] == "| `"]
        assert [row[0].strip("`") for row in rows] == table.arrow.names
        for (_, kind, unit, meaning), field in zip(rows, table.arrow, strict=True):
            assert ("may be null" in kind) is field.nullable
            assert (unit, meaning) == tuple(field.metadata[key].decode() for key in (b"unit", b"description"))


# Text


WORDS = st.text(st.characters(codec="utf-8"), max_size=12) | st.sampled_from(
    ['a"b', "a,b", "a\nb", "a\r\nb", "", "=1+1", "ü"]
)


@given(st.lists(st.tuples(WORDS, st.none() | DOUBLES, TIMES), max_size=6))
@settings(max_examples=15)
def test_text_is_read_back_by_others_as_it_was(tmp_path_factory, rows):
    folder = tmp_path_factory.mktemp("text")
    words, numbers, times = zip(*rows, strict=True) if rows else ((), (), ())
    table = pa.table(
        {
            "w": pa.array(words, pa.string()),
            "x": pa.array(numbers, pa.float64()),
            "t": pa.array(times, pa.int64()).cast(pa.timestamp("ns", "UTC")),
            "l": pa.array([[number] for number in times], pa.list_(pa.int64())),
        }
    )
    for form in ("csv", "jsonl"):
        tables.write(folder / f"a.{form}", table, {}, (), form)
    raw = (folder / "a.csv").read_bytes().decode("utf-8")
    read = list(csv.reader(io.StringIO(raw, newline="")))
    assert read[0] == ["w", "x", "t", "l"]
    assert [row[0] for row in read[1:]] == list(words)
    assert [None if row[1] == "" else float(row[1]) for row in read[1:]] == list(numbers)
    assert [row[2] for row in read[1:]] == [iso(t) for t in times]
    assert [json.loads(row[3]) for row in read[1:]] == [[t] for t in times]
    lines = [json.loads(line) for line in (folder / "a.jsonl").read_bytes().splitlines()]
    assert [line["w"] for line in lines] == list(words)
    assert [None if line["x"] is None else float(line["x"]) for line in lines] == list(numbers)
    assert [(line["t"], line["l"]) for line in lines] == [(iso(t), [t]) for t in times]


def iso(t_ns):
    second = dt.datetime.fromtimestamp(0, dt.UTC) + dt.timedelta(seconds=t_ns // 10**9)
    return f"{second:%Y-%m-%dT%H:%M:%S}.{t_ns % 10**9:09}Z"


# Summaries


def test_a_track_is_summed_up(tmp_path):
    places = {1: [(0, 0), (3, 4), (3, 4), (3, 5)], 7: [None, (1, 1), None, (1, 3)]}
    frames = []
    for number in range(4):
        there = {who: path[number] for who, path in places.items() if path[number]}
        frames.append(Frame(ns(number / 2), 10 + number, tracks_at(there, observed=number != 1)))
    first, second = tables.summary_table({"/a": collect(TRACKS, frames)}).to_pylist()
    assert (first["track_id"], first["rows"], first["path_m"], first["duration_s"]) == (1, 4, 6.0, 1.5)
    assert (first["mean_speed_m_s"], first["max_speed_m_s"]) == (4.0, 10.0)
    assert (first["first_t_ns"], first["last_t_ns"], first["first_frame"], first["last_frame"]) == (0, ns(1.5), 10, 13)
    assert (first["first_x_m"], first["first_y_m"], first["last_x_m"], first["last_y_m"]) == (0, 0, 3, 5)
    assert (first["observed_share"], second["observed_share"]) == (0.75, 0.5)
    assert (second["path_m"], second["mean_speed_m_s"], second["max_speed_m_s"]) == (2.0, 2.0, 2.0)
    assert second["first_x_px"] is None


@given(st.data())
@settings(max_examples=15)
def test_summaries_are_what_duckdb_makes_of_the_rows(data):
    people = st.dictionaries(
        st.integers(0, 3), st.tuples(*[st.floats(-50, 50) | st.just(float("nan"))] * 2), max_size=4
    )
    frames = [Frame(ns(n), n, tracks_at(who)) for n, who in enumerate(data.draw(st.lists(people, max_size=8)))]
    rows = tables.rows_in_pieces(TRACKS, {"/a": frames}).table()  # noqa: F841  # DuckDB finds it by name
    summary = tables.summary_table({"/a": collect(TRACKS, frames)})
    wanted = duckdb.sql("""
        with known as (select *, lag(x_m) over w as px, lag(y_m) over w as py, lag(t_ns) over w as pt from rows
                       where x_m is not null and y_m is not null window w as (partition by track_id order by t_ns)),
             paths as (select track_id, coalesce(sum(sqrt((x_m - px)^2 + (y_m - py)^2)), 0) as path,
                              max(sqrt((x_m - px)^2 + (y_m - py)^2) / ((t_ns - pt) / 1e9)) as fastest
                       from known group by track_id)
        select track_id, min(t_ns), max(t_ns), count(*), any_value(path), any_value(fastest)
        from rows left join paths using (track_id) group by track_id order by track_id
    """).fetchall()
    names = ("track_id", "first_t_ns", "last_t_ns", "rows", "path_m", "max_speed_m_s")
    found = list(zip(*(summary.column(name).to_pylist() for name in names), strict=True))
    assert [row[:4] for row in found] == [row[:4] for row in wanted]
    for mine, theirs in zip(found, wanted, strict=True):
        assert [value is None for value in mine] == [value is None for value in theirs]
        known = [pair for pair in zip(mine[4:], theirs[4:], strict=True) if pair[0] is not None]
        assert all(a == pytest.approx(b, rel=1e-9, abs=1e-12) for a, b in known)


# Faults


def two_tables():
    """A table of which the file has several pages, and another."""
    rng = np.random.default_rng(0)
    return [
        some_tracks([{k: tuple(rng.normal(size=2)) for k in range(count)} for _ in range(60)]) for count in (40, 50)
    ]


def same(path, form, table):
    assert tables.verify(path, form) == table.num_rows if form in ("parquet", "arrow") else path.stat().st_size
    read = {
        "parquet": pq.read_table,
        "arrow": lambda p: pa.ipc.open_file(p).read_all(),
        "csv": lambda p: pl.read_csv(p).to_arrow(),
        "jsonl": lambda p: pl.read_ndjson(p).to_arrow(),
    }[form](path)
    return read.column("track_id").to_pylist() == table.column("track_id").to_pylist()


@pytest.mark.parametrize("form", one_in(4, tables.FORMATS))
def test_killed_at_any_byte_or_call_the_file_is_the_old_one_or_the_new_one(tmp_path, monkeypatch, form):
    path, (old, new) = tmp_path / "t", two_tables()
    tables.write(path, new, {}, (), form)
    size, seen = path.stat().st_size, set()
    tables.write(path, old, {}, (), form)
    before = path.read_bytes()
    # At a file size the kernel stops the writer, whoever writes; at a call we do.
    deaths = [("size", size * k // 4) for k in range(4)] + [("call", n) for n in range(1, 4)] + [("none", 0)]
    for way, at in deaths:
        path.write_bytes(before)
        child = os.fork()
        if child == 0:
            sys.dont_write_bytecode = True  # a compiled module without room would be kept
            if way == "size":
                signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
                resource.setrlimit(resource.RLIMIT_FSIZE, (at, at))
            calls = []

            def counted(real, calls=calls, at=at, way=way):
                def call(*args, **kwargs):
                    calls.append(real)
                    if way == "call" and len(calls) == at:
                        os.kill(os.getpid(), signal.SIGKILL)
                    return real(*args, **kwargs)

                return call

            for name in ("fsync", "replace"):
                setattr(os, name, counted(getattr(os, name)))
            try:
                tables.write(path, new, {}, (), form)
            finally:
                os._exit(0)
        _, status = os.waitpid(child, 0)
        assert (status == 0) == (way == "none"), (way, at)
        is_new = path.read_bytes() != before
        assert same(path, form, new if is_new else old)
        seen.add(is_new)
    assert seen == {True, False}
    tables.write(path, old, {}, (), form)  # sweeps away what the killed ones left
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_reads_back_differently_is_not_published(tmp_path, monkeypatch):
    path, (old, new) = tmp_path / "t.parquet", two_tables()
    tables.write(path, old, {})
    before = path.read_bytes()
    real = pq.ParquetWriter.write_table
    for wrong in (new.slice(1), new.set_column(6, "x_px", pa.array(np.zeros(new.num_rows)))):
        monkeypatch.setattr(
            pq.ParquetWriter, "write_table", lambda self, _, wrong=wrong, **k: real(self, wrong.cast(new.schema), **k)
        )
        with pytest.raises(McaptrackError, match="does not read back the same"):
            tables.write(path, new, {})
        assert path.read_bytes() == before
        assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_could_not_be_written_is_not_written_to_later(tmp_path, monkeypatch):
    """A writer of Arrow that is deleted while it is open writes the end of the file, or fails unseen."""
    said: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", said.append)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pq.ParquetWriter, "write_table", full)
    with pytest.raises(McaptrackError, match="No space left"):
        tables.write(tmp_path / "t.parquet", some_tracks([{1: (0.0, 0.0)}]), {})
    gc.collect()
    assert said == []


@given(st.data())
@settings(max_examples=15)
def test_a_byte_that_changed_on_the_disk_is_noticed(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("t") / "t.parquet"
    table = some_tracks([{k: (k / 3, n / 7) for k in range(30)} for n in range(30)])
    tables.write(path, table, {})
    raw = bytearray(path.read_bytes())
    low = pq.read_metadata(path).row_group(0).column(0).dictionary_page_offset or 4
    footer = int.from_bytes(raw[-8:-4], "little") + 8
    at = data.draw(st.integers(low, len(raw) - footer - 1))
    raw[at] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(raw)
    try:
        rows = tables.verify(path)
    except McaptrackError as error:
        assert "\n" not in str(error)
    else:  # page headers and indexes hold bits that are not needed to read the rows
        assert rows == table.num_rows
        assert pq.read_table(path).equals(table.replace_schema_metadata(pq.read_schema(path).metadata))


@pytest.mark.parametrize("more", [(), ("topic",), ("observed",), ("topic", "observed")])
def test_tracks_of_other_tools_are_read_as_frames(tmp_path, more):
    """Rows in any order; those without a place are left out; what a file doesn't say is unknown, or was observed."""
    table = {
        "t_ns": [5, 7, 5, 7, 7],
        "track_id": [2, 1, 1, 2, 9],
        "x_m": [0.5, 1.5, 2.5, 3.5, None],
        "y_m": [0.0, 1.0, 2.0, 3.0, 4.0],
        "topic": ["/b", "/a", "/a", "/b", "/a"],
        "observed": [True, False, True, True, True],
    }
    chosen = {name: values for name, values in table.items() if name not in ("topic", "observed") or name in more}
    path = tmp_path / "tracks.parquet"
    pq.write_table(pa.table(chosen), path)
    assert tables.holds_tracks(path)
    found = tables.read_tracks(path)
    if "topic" in more:
        assert {name: [f.t_ns for f in frames] for name, frames in found.items()} == {"/a": [5, 7], "/b": [5, 7]}
        rows = [row for topic in ("/a", "/b") for frame in found[topic] for row in frame.rows]
        wanted = [(1, 2.5), (1, 1.5), (2, 0.5), (2, 3.5)]
    else:
        (frames,) = found.values()
        assert list(found) == [""]
        assert [(frame.t_ns, frame.index) for frame in frames] == [(5, 0), (7, 1)]
        rows = [row for frame in frames for row in frame.rows]
        wanted = [(1, 2.5), (2, 0.5), (1, 1.5), (2, 3.5)]
    assert [(row["track_id"], row["x_m"]) for row in rows] == wanted
    for row in rows:
        TRACKS.check(np.array([row], TRACKS.dtype))
        assert row["source_id"] == -1
        assert row["observed"] == ("observed" not in more or row["x_m"] != 1.5)
        assert all(np.isnan(row[name]) for name in ("x_px", "y_px", "w_px", "h_px", "score"))


def test_rows_about_tracks_have_the_class_of_the_track_or_of_the_object_that_is_missed():
    rows = EVENTS.empty(4)
    rows["kind"], rows["track_id"], rows["truth_id"] = 5, [3, -1, 4, -1], [-1, 3, 9, 8]
    named = tables.TrackNames({3: "car", 9: "bus"}, {3: "dog", 9: "cat"})
    table = tables.rows_in_pieces(
        EVENTS, {"/b/events": [Frame(1, 0, rows)], "/a/events": [Frame(1, 0, rows)]}, {}, {"/b/events": named}
    ).table()
    found = {(row["topic"], row["row"]): row["class"] for row in table.to_pylist()}
    assert [found["/b/events", n] for n in range(4)] == ["car", "dog", None, None]
    assert {found["/a/events", n] for n in range(4)} == {None}


# Tables as text, and fields of recorded messages as columns, at their limits


@pytest.mark.parametrize("count", [0, 1, 3, 4, 5, 8, 9])
def test_a_table_is_written_in_pieces_that_lack_nothing(count, monkeypatch):
    monkeypatch.setattr(text, "_PIECE", 4)
    values = {"n": list(range(count)), "word": [f'"{n}", é' for n in range(count)], "x": [n / 4 for n in range(count)]}
    table = pa.table(values)
    pieces = list(text.csv(table))
    assert len(pieces) == max(1, math.ceil(count / 4))
    head, *rows = csv.reader(io.StringIO(b"".join(pieces).decode()))
    assert head == ["n", "word", "x"]
    assert [(int(n), word, float(x)) for n, word, x in rows] == list(zip(*values.values(), strict=True))
    assert [json.loads(line) for line in text.json_lines(table)] == table.to_pylist()


def column(*values: object) -> pa.ChunkedArray:
    pieces, _ = flat_table([{"a": value} for value in values], blobs=True)
    return pa.concat_tables(pieces).column("a")


@pytest.mark.parametrize(
    ("values", "kind", "wanted"),
    [
        ([True, False], "bool", [True, False]),
        ([1, None], "int64", [1, None]),
        ([-(2**63), 2**63 - 1], "int64", None),
        ([0, 2**63], "uint64", None),
        ([2**64 - 1], "uint64", None),
        ([-1, 2**63], "string", ["-1", str(2**63)]),
        ([2**64], "string", [str(2**64)]),
        ([-(2**63) - 1], "string", [str(-(2**63) - 1)]),
        ([1, 0.5], "double", [1.0, 0.5]),
        ([2**53, -(2**53), 0.5], "double", None),
        ([2**53 + 1, 0.5], "string", [str(2**53 + 1), "0.5"]),
        ([-(2**53) - 1, 0.5], "string", [str(-(2**53) - 1), "0.5"]),
        ([True, 1], "string", ["true", "1"]),
        (["é", "b"], "string", None),
        (["é", 1], "string", ['"é"', "1"]),
        ([b"\x01\xff"], "binary", None),
        ([b"\x01\xff", 1], "string", ['"01ff"', "1"]),
        ([[1, 2], [], None], "list<item: int64>", [[1, 2], [], None]),
        ([[1], [0.5]], "list<item: double>", [[1.0], [0.5]]),
        ([[1], ["a"]], "string", ["[1]", '["a"]']),
        ([[1], 2], "string", ["[1]", "2"]),
        (["\ud800é"], "string", ["?é"]),
        ([["\ud800é"]], "string", ['["?é"]']),
        ([None, None], "double", None),
    ],
)
def test_a_field_becomes_the_narrowest_column_that_holds_all_its_values(values, kind, wanted):
    found = column(*values)
    assert str(found.type).replace("element", "item") == kind
    assert found.to_pylist() == (values if wanted is None else wanted)


def test_fields_of_bytes_are_left_out_unless_they_are_wanted():
    rows = [{"b": b"x", "T": 1}, {"b": None, "c_ns": 5}, {"c_ns": 7}]
    for blobs in (False, True):
        pieces, left_out = flat_table(rows, blobs)
        table = pa.concat_tables(pieces)
        assert left_out == ([] if blobs else ["b"])
        assert table.column_names[-2 - blobs :] == [*["b"][: int(blobs)], "T_2", "c_ns"]  # t is the time
        assert table.column("T_2").to_pylist() == [1, None, None]
        assert table.column("c_ns").to_pylist() == [None, 5, 7]
        words = table.schema.field("c_ns").metadata
        assert words == {b"unit": b"ns", b"description": b"field c_ns of A", b"path": b"c_ns"}


# Names beside numbers


@pytest.mark.parametrize("name", [name for name, code in CODES.items() if code.names])
def test_codes_are_named_as_the_schema_says(name):
    schema, code = SCHEMAS[name], CODES[name]
    text = (ROOT / "schemas" / f"{name.removeprefix('mcaptrack.')}.proto").read_text()
    (said,) = re.findall(rf" {code.column} = \d+; *// (.*)", text)
    wanted = {int(number): word for number, word in re.findall(r"\b(\d+) ([a-z]+(?: [a-z]+)?)(?=[,;:]| \(|$)", said)}
    assert len(wanted) > 1
    rows = schema.empty(len(wanted) + 1)
    rows[code.column] = [*wanted, 99]
    table = tables.rows_in_pieces(schema, {"/a": [Frame(0, 0, rows)]}).table()
    found = dict(zip(table[code.column].to_pylist(), table[code.beside.name].to_pylist(), strict=True))
    assert found == wanted | {99: None}


def test_cameras_of_sightings_are_named_as_the_channel_says(tmp_path):
    rows = SIGHTINGS.empty(3)
    rows["camera"] = [1, 0, 7]
    channels = {
        "/a/sightings": (SIGHTINGS, Provenance("fuse", {"cameras": ["east", "west"]}), [Frame(0, 0, rows)]),
        "/b/sightings": (SIGHTINGS, None, [Frame(0, 0, rows)]),
    }
    with mcaptrack.open(write_channels(tmp_path / "a.mcap", channels)) as opened:
        table = opened.table("sightings")
    assert table["camera_name"].to_pylist() == ["west", "east", None, None, None, None]


# Tables of single channels are made in parts: the same as of all messages at once, and without holding them


NUMBERS = st.integers(-(2**64), 2**65) | st.sampled_from([0, 1, 2**53, 2**53 + 1, 2**63, -(2**63), 2**64 - 1])
PLAIN = st.booleans() | NUMBERS | st.floats(allow_nan=False) | st.sampled_from(["", "a", "1"])
LISTS = st.lists(st.integers(-3, 2**63), max_size=3) | st.lists(st.floats(0, 1), max_size=2) | st.just([])
FIELDS = {
    "flag": st.booleans(),
    "whole": st.integers(0, 9),
    "large": NUMBERS,
    "number": st.integers(-5, 2**54) | st.floats(0, 1),
    "text": st.text(max_size=3),
    "list": LISTS,
    "mixed": PLAIN | LISTS,
    "parts": st.lists(
        st.fixed_dictionaries({}, optional={"a": st.integers(0, 9), "b": st.text(max_size=2)}), max_size=3
    ),
    "blob": st.binary(max_size=3) | st.none(),
}
MESSAGES = st.lists(st.fixed_dictionaries({}, optional=FIELDS), max_size=12)


def equals(value: object, stored: object) -> bool:
    """Whether a stored value is the value: a struct has all fields, and what no type holds is JSON."""
    if isinstance(value, dict) and isinstance(stored, dict):
        return all(equals(value.get(name), stored[name]) for name in stored) and value.keys() <= stored.keys()
    if isinstance(value, list) and isinstance(stored, list):
        return len(value) == len(stored) and all(map(equals, value, stored))
    if isinstance(stored, str) and stored != value:
        return bool(json.loads(stored) == (value.hex() if isinstance(value, bytes) else value))
    return bool(value == stored)


@settings(max_examples=40)
@given(MESSAGES, st.booleans(), st.integers(1, 5), st.integers(1, 300), st.integers(1, 6))
def test_parts_give_the_table_of_all_messages(rows, blobs, count, piece, piece_rows):
    whole, left_out = flat_table(rows, blobs)
    expected = whole.table()
    with (
        patch.object(messages, "_PART_MESSAGES", count),
        patch.object(messages, "PIECE_BYTES", piece),
        patch.object(build, "PIECE_ROWS", piece_rows),
    ):
        pieces, without = flat_table(rows, blobs)
        table = pa.concat_tables(list(pieces))
    assert (table.schema, without) == (expected.schema, left_out)
    assert table.equals(expected) or table.to_pylist() == expected.to_pylist()  # infinities in lists
    assert table.column("message_offset").to_pylist() == list(range(len(rows)))
    for name in table.column_names[7:]:
        for row, stored in zip(rows, table.column(name).to_pylist(), strict=True):
            assert equals(row.get(name), stored), name


def test_a_channel_of_pictures_is_exported_without_holding_them(tmp_path):
    """Pictures of 40 kB: with their bytes and without, the log may be of any length."""
    random = np.random.default_rng(1)
    pictures = [random.bytes(40_000) for _ in range(8)]

    def export(count: int, blobs: bool) -> tuple[int, int]:
        rows = [{"format": "raw", "data": pictures[n % 8]} for n in range(count)]

        def work() -> None:
            made, _ = flat_table(rows, blobs)
            files.write(tmp_path / "a.parquet", made, {}, force=True)

        before, pool = pa.default_memory_pool(), pa.proxy_memory_pool(pa.default_memory_pool())
        pa.set_memory_pool(pool)
        try:
            _, most = held(work)
        finally:
            pa.set_memory_pool(before)
        file = pq.ParquetFile(tmp_path / "a.parquet")
        assert file.metadata.num_rows == count
        if blobs:
            assert file.read_row_group(file.num_row_groups - 1)["data"].to_pylist()[-1] == pictures[(count - 1) % 8]
        return most, pool.max_memory()

    with (
        patch.object(messages, "_PART_MESSAGES", 4),
        patch.object(messages, "PIECE_BYTES", 2**18),
        patch.object(files, "_BYTES_READ", 2**18),
    ):
        for blobs in (False, True):
            few, many = export(40, blobs), export(140, blobs)
            assert sum(many) - sum(few) < 0.2 * 100 * 40_000
