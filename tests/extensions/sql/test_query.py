"""Queries in SQL: the same answers from logs and from exported tables, without access to anything else."""

from __future__ import annotations

import csv
import io
import json
import re
import subprocess
import sys
from contextlib import chdir, redirect_stdout
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import mcaptrack
from mcaptrack import log, tables
from mcaptrack.extensions.sql.database import Database
from mcaptrack.schema import EVENTS, FORECAST_ERRORS, PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import Provenance
from mcaptrack.tables.export import ALWAYS, default_folder, export
from tests.commands import GROUP, Outcome, Terminal, call
from tests.logs import write_channels
from tests.tiers import thorough
from tests.worlds import ns, tracks_at

PAGE = (Path(__file__).parents[3] / "docs" / "extensions" / "sql.md").read_text()
PRELUDE = re.findall(r"```sql\n(create view.*?)```", PAGE, re.S)[0]
#: Queries of the page that one log answers.
QUERIES = [
    query for query in re.findall(r"```sql\n(.*?)```", PAGE, re.S) if not re.search("create view|before join", query)
]


def rows_of(table):
    return table.schema.names, [list(row.values()) for row in table.to_pylist()]


def agree(found, wanted):
    assert found[0] == wanted[0]
    assert len(found[1]) == len(wanted[1])
    for one, other in zip(found[1], wanted[1], strict=True):
        assert one == pytest.approx(other, abs=1e-9), (one, other)


def run(*words) -> Outcome:
    return call("query", *words)


def refusal(*words):
    outcome = run(*words)
    assert outcome.code == 1, outcome.out + outcome.err
    (line,) = outcome.err.splitlines()
    return line.removeprefix("mcaptrack: ")


def test_the_prelude_names_the_tables_that_always_have_a_file():
    assert set(re.findall(r"create view (\w+)", PRELUDE)) == ALWAYS | {"recordings"}


def forecasts(rows):
    who, step, x_m, y_m = (list(column) for column in zip(*rows, strict=True))
    return PREDICTIONS.rows(track_id=who, step=step, ahead_s=[0.4 * n for n in step], x_m=x_m, y_m=y_m)


def happened(rows):
    names = ("kind", "truth_id", "previous_id", "track_id", "duration_s")
    columns = {name: list(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}
    columns["duration_s"] = [float(value) for value in columns["duration_s"]]
    count = len(rows)
    return EVENTS.rows(**columns, source_id=[-1] * count, frames=[0] * count, x_m=[2.4] * count, y_m=[0.2] * count)


def known_log(path, tracked=(7, 8)):
    """A log in which person 1 walks along the first axis and person 2 stands, with track 8 half a metre away."""
    ticks = range(11)
    people = [Frame(ns(0.4 * n), n, tracks_at({1: (0.4 * n, 0.0), 2: (0.0, 10.0)})) for n in ticks]
    tracks = {7: lambda n: (0.4 * n, 0.0), 8: lambda n: (0.0, 10.5)}
    samples = [Frame(ns(0.4 * n), n, tracks_at({who: tracks[who](n) for who in tracked})) for n in ticks]
    seen = [tracks_at({3: (0.0, 0.0)}, observed=n <= 10 or n >= 30) for n in range(40)]
    whole = [Frame(ns(0.1 * n), n, rows) for n, rows in enumerate(seen)]
    ahead = [(7, 1, 0.4, 0.3), (7, 2, 0.8, 0.0), (8, 1, 0.0, 10.5), (8, 2, 0.4, 10.8)]
    predicted = Provenance("predict", {}, "/camera/samples")
    of_whom = FORECAST_ERRORS.rows(track_id=[7, 8], truth_id=[1, 2], later_id=[-1, -1])
    told = [
        Frame(ns(2.4), 6, happened([(4, 1, 7, 9, 0.4), (2, 1, 7, -1, 0.8), (2, 2, 8, -1, 0.4), (2, 1, 9, -1, 1.2)]))
    ]
    return write_channels(
        path,
        {
            "/camera/truth": (TRACKS, Provenance("ingest", {}, ""), people),
            "/camera/tracks": (TRACKS, Provenance("track", {}, "/camera/detections"), samples),
            "/camera/samples": (TRACKS, Provenance("sample", {}, "/camera/tracks"), samples),
            "/camera/retracks": (TRACKS, Provenance("retrack", {}, "/camera/samples"), samples),
            "/camera/retracks/full": (TRACKS, Provenance("carry", {}, "/camera/retracks"), whole),
            "/camera/predictions": (PREDICTIONS, predicted, [Frame(0, 0, forecasts(ahead))]),
            "/camera/predictions/errors": (
                FORECAST_ERRORS,
                Provenance("events", {}, "/camera/predictions"),
                [Frame(0, 0, of_whom)],
            ),
            "/camera/tracks/events": (EVENTS, Provenance("events", {}, "/camera/tracks"), told),
        },
    )


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> Path:
    return known_log(tmp_path_factory.mktemp("known") / "known.mcap")


@pytest.fixture(scope="module")
def exported(known) -> Path:
    """The folder of the log, with its tables where the page has those of the demonstration."""
    with log.read(known) as opened:
        export(opened, known.parent / "demo.tables")
    return known.parent


#: By a part of each query of docs/extensions/sql.md, its answer on the known log, by hand.
ANSWERS = {
    "t_ns = 10_000_000_000": [],
    "as seen_s": [],
    "as frames\nfrom (select": [[2, 11]],
    "as begin": [[0, 2]],
    "as visits": [],
    "with zones(": [["near", 0, 1, 1.0]],
    "as fastest_m_s": [[1, 1.0, 1.0], [2, 0.0, 0.0]],
    "as closest_m": [[1, 2, 10.0, 0.0]],
    "kind = 4": [[1, 7, 9, 2.4, 2.0, 0.0]],
    "as hidden_s": [[3, 1.0, 2.0]],
    "kind = 2": [[1, 2, 2.0], [2, 1, 0.4]],
    "made.input": [[0.4, 2, 0.15], [0.8, 2, 0.25]],  # off by 0.1 and 0.2, and by 0.2 and 0.3 m
    "json_each": [],
    "recursive": [
        ["/camera/retracks", "retrack", "/camera/samples"],
        ["/camera/samples", "sample", "/camera/tracks"],
        ["/camera/tracks", "track", "/camera/detections"],
    ],
    "order by recording, topic": [
        ["known", f"/camera/{name}", 1.0, 1.0, 0] for name in ("retracks", "samples", "tracks")
    ],
}
#: Of queries that the known log has no answer to, that on a log of ``of_visits``.
OF_VISITS = {
    "t_ns = 10_000_000_000": [[1, 1.0, 12.0], [2, 9.0, 12.0]],
    "as seen_s": [[1, 11.0, 5.0, 12.0], [2, 11.0, 9.0, 12.0]],
    "as visits": [[1, 2, 3.0]],  # 1.5 s, and another 0.5 s after 3 s elsewhere, of which 1 s counts
    "as begin": [[0, 2]],
    "json_each": [["file", '"a.txt"'], ["format", '"mot"']],
}


def of_visits(path):
    """Person 1 leaves the rectangle of the page after 10 s, for 3 s; person 2 is elsewhere. Two frames a second."""
    rows = [tracks_at({1: (5.0 if 21 <= n < 26 else 1.0, 12.0), 2: (9.0, 12.0)}) for n in range(28)]
    frames = [Frame(ns(n / 2), n, frame) for n, frame in enumerate(rows) if n >= 17]
    return write_channels(
        path, {"/camera/truth": (TRACKS, Provenance("ingest", {"file": "a.txt", "format": "mot"}), frames)}
    )


def query_with(part):
    (query,) = (query for query in QUERIES if part in query)
    return query


def test_queries_of_the_page_give_these_answers_also_in_duckdb(exported, known, tmp_path):
    """That they print what the page has, tests/test_docs.py has."""
    assert [sum(part in query for part in ANSWERS) for query in QUERIES] == [1] * len(ANSWERS)
    for part, answer in ANSWERS.items():
        with chdir(exported), duckdb.connect() as connection:
            connection.execute(PRELUDE)
            asked = connection.sql(query_with(part))
            wanted = asked.columns, [list(row) for row in asked.fetchall()]
        agree(wanted, (wanted[0], answer))
        with Database([known]) as database:
            agree(rows_of(database.ask(query_with(part))), wanted)
    with Database([of_visits(tmp_path / "a.mcap")]) as database:
        for part, answer in OF_VISITS.items():
            names, rows = rows_of(database.ask(query_with(part)))
            agree((names, rows), (names, answer))


def test_runs_are_compared_once_and_not_by_class(tmp_path):
    """Before, one of two people was tracked: half of the people are found, and IDF1 is 2 / 3."""
    for name, tracked in (("before", (7,)), ("after", (7, 8))):
        with log.read(known_log(tmp_path / f"{name}.mcap", tracked)) as opened:
            export(opened, tmp_path / "demo.tables")
    (query,) = (query for query in re.findall(r"```sql\n(.*?)```", PAGE, re.S) if "before join" in query)
    with chdir(tmp_path), duckdb.connect() as connection:
        connection.execute(PRELUDE)
        found = [list(row) for row in connection.sql(query).fetchall()]
    assert found == [[f"/camera/{name}", 0.33, 0.5, 0] for name in ("retracks", "samples", "tracks")]


def test_keys_of_the_page_about_tables_join(exported):
    page = (Path(__file__).parents[3] / "docs" / "tables.md").read_text()
    (people,) = re.findall(r"^select f\.t,.*?;", page, re.M | re.S)
    (speeds,) = re.findall(r"^select recording, topic, track_id, path_m.*?;", page, re.M | re.S)
    with chdir(exported), duckdb.connect() as connection:
        found = [
            connection.sql(re.sub(r"\bf\.t\b", "f.t_ns", query).replace("'tables/", "'demo.tables/")).fetchall()
            for query in (people, speeds)
        ]
    assert found[0] == [(ns(0.4 * n), 2) for n in range(11)]
    walked = {(row[1].rpartition("/")[2], row[2]): row[3:5] for row in found[1]}
    assert walked == {
        (name, who): pytest.approx(of)
        for name in ("tracks", "samples", "retracks")
        for who, of in ((7, (4.0, 1.0)), (8, (0.0, 0.0)))
    }


# Where tables come from


def test_a_query_reads_only_the_tables_it_names(known, tmp_path):
    content = bytearray(known.read_bytes())
    with log.read(known) as opened:
        number = opened.channel("/camera/predictions").id
        (chunk,) = (c for c in opened.index.chunks if number in c.message_index_offsets)
    content[chunk.chunk_start_offset + 120] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(content)
    assert run(damaged, "select count(*) as n from tracks where topic = '/camera/truth'", "--format", "csv").out == (
        '"n"\n22\n'
    )
    assert re.search(r"damaged\.mcap.*damaged.*recover", refusal(damaged, "select count(*) from predictions"))


def test_exported_tables_are_read_while_they_are_up_to_date(tmp_path):
    path = known_log(tmp_path / "a.mcap")
    query = "select count(*) as n from tracks where topic = '/camera/samples'"
    with Database([path]) as database:
        assert rows_of(database.ask(query))[1] == [[22]]
        assert "read from the log" in database.notes[0]
    with log.read(path) as opened:
        export(opened, default_folder(path))
    with Database([path]) as database:
        assert rows_of(database.ask(query))[1] == [[22]]
        assert "a.tables" in database.notes[0]
    known_log(path, tracked=(7,))
    with Database([path]) as database:
        assert rows_of(database.ask(query))[1] == [[11]]
        assert "read from the log" in database.notes[0]


#: Tables that the log with known answers has no rows for.
EMPTY = {
    *("detections", "camera_motions", "counts", "ground_planes", "forecast_scores", "sightings"),
    *("zone_visits", "zone_crossings", "zone_counts", "decisions", "appearances", "worlds", "warnings"),
}


def test_files_and_logs_give_the_same_tables(known, tmp_path):
    other = tmp_path / "other.mcap"
    other.write_bytes(known.read_bytes())
    with log.read(other) as opened:
        export(opened, tmp_path / "tables")
    for name in tables.TABLES:
        columns = "* exclude (recording, file, digest, location)" if name == "recordings" else "* exclude (recording)"
        columns = "* exclude (recording, file)" if name == "frames" else columns
        with Database([known, tmp_path / "tables"]) as database:
            here, there = (
                database.ask(f"select {columns} from {name} where recording = '{which}' order by all")
                for which in ("known", "other")
            )
            assert database.recordings == ("known", "other")
        assert here.equals(there), name
        assert bool(here.num_rows) == (name not in EMPTY), name


@pytest.mark.parametrize("name", ["a'b", 'a"b; drop table tracks', "ä $x {0}", "%s? :1", "--x"])
def test_names_of_logs_and_channels_are_not_parsed_as_sql(tmp_path, name):
    path = known_log(tmp_path / f"{name}.mcap")
    topic = f"/{name}"
    with log.read(path) as opened, log.extend(opened) as writer:
        number = writer.add_channel(topic, ("x", "jsonschema", b"{}"), "json", {}, group=topic)
        writer.add_message(number, 5, 0, b'{"value": 3}')
    with Database([path]) as database:
        quoted = topic.replace('"', '""')
        assert rows_of(database.ask(f'select value, t_ns from "{quoted}"')) == (["value", "t_ns"], [[3, 5]])
        assert rows_of(database.ask("select count(distinct recording) from tracks"))[1] == [[1]]


def test_the_channels_of_a_folder_are_tables_too(known, tmp_path):
    path = tmp_path / "robot.mcap"
    with log.create(path) as writer:
        number = writer.add_channel("/imu", ("x", "jsonschema", b"{}"), "json", {}, group="imu")
        for n in range(3):
            writer.add_message(number, n, n, json.dumps({"value": n / 2}).encode())
    with log.read(path) as opened:
        export(opened, tmp_path / "tables", topics=["/imu"])
    for source in (path, tmp_path / "tables"):
        with Database([source, known]) as database:
            assert rows_of(database.ask('select recording, sum(value) as s from "/imu" group by all'))[1] == [
                ["robot", 1.5]
            ]
            assert "/imu" in database.channels


# Nothing else


@pytest.mark.parametrize(
    "query",
    [
        "copy tracks to 'new.csv'",
        "copy (select 1) to 'new.parquet'",
        "explain analyze copy (select 1) to 'new.csv'",
        "export database 'new'",
        "attach 'new.db'",
        "attach 'secret.db' as other",
        "install httpfs",
        "load './new.duckdb_extension'",
        "select * from read_csv('secret.csv')",
        "select * from 'secret.csv'",
        "select * from read_text('secret.csv')",
        "select * from glob('*')",
        "select * from parquet_schema('secret.parquet')",
        "set enable_external_access = true",
        "set temp_directory = 'new'; select 1",
        "pragma enable_profiling; pragma profiling_output = 'new'; select 1",
        "create persistent secret (type http); select 1",
        "import database '.'",
        "select 1; copy (select 1) to 'new.csv'",
        "create view v as from read_csv('secret.csv'); from v",
        "select * from query_table('secret.csv')",
        "select * from environ",
    ],
)
def test_queries_read_only_the_logs(known, tmp_path, monkeypatch, query):
    monkeypatch.chdir(tmp_path)
    environ = duckdb.sql("select 'hush' as a").to_arrow_table()  # a name that Python knows  # noqa: F841
    Path("secret.csv").write_text("a\nhush\n")
    with duckdb.connect("secret.db") as connection:
        connection.execute("create table hush as select 'hush' as a")
        connection.execute("copy hush to 'secret.parquet'")
    there = sorted(tmp_path.rglob("*"))
    outcome = run(known, query)
    assert outcome.code == 1
    assert "hush" not in outcome.out + outcome.err
    assert sorted(tmp_path.rglob("*")) == there


def test_all_kinds_of_statements_load_tables(known):
    with Database([known]) as database:
        found = database.ask("pivot Tracks on topic using count(*) group by observed")
        assert found.column("/camera/truth").to_pylist() in ([22, None], [None, 22], [22, 0], [0, 22])
        assert "x_m" in database.ask("describe predictions").column("column_name").to_pylist()
        assert database.ask("summarize select x_m, kind from events").num_rows == 2
        assert database.ask("explain from metrics").num_rows
        query = "with tracks as (from main.track_summary) from (select count(*) as n, (select count(*) from frames) from tracks)"
        assert rows_of(database.ask(query))[1][0][0] == 9
        assert rows_of(
            database.ask("set variable who = 7; select count(*) from tracks where track_id = getvariable('who')")
        ) == (
            ["count_star()"],
            [[33]],
        )


def test_a_given_file_is_a_table(known, tmp_path):
    (tmp_path / "zones.csv").write_text("zone,low_m,high_m\nleft,-1,2\nright,2.1,9\n")
    query = (
        "select zone, count(*) as n from tracks join zones on x_m between low_m and high_m "
        "where topic = '/camera/truth' group by all order by all"
    )
    outcome = run(known, query, "--with", f"zones={tmp_path / 'zones.csv'}", "--format", "csv")
    assert outcome.out == '"zone","n"\n"left",17\n"right",5\n'
    assert "no such file" in refusal(known, query, "--with", "zones=none.csv")
    assert "can't name a table" in refusal(known, query, "--with", f"tracks={tmp_path / 'zones.csv'}")
    assert "end with" in refusal(known, query, "--with", f"zones={known}")


@thorough
def test_ctrl_c_ends_a_query_and_the_database_stays_usable(known):
    program = (
        "import os, signal, sys, threading\n"
        "from pathlib import Path\n"
        "from mcaptrack.extensions.sql.database import Database\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "with Database([Path(sys.argv[1])]) as database:\n"
        "    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()\n"
        "    try:\n"
        "        database.ask('select count(*) from range(10000000000) a, range(1000000) b where a.range % 7 = b.range')\n"
        "    except KeyboardInterrupt:\n"
        "        print(database.ask('select 42 as a').to_pylist())\n"
    )
    done = subprocess.run([sys.executable, "-c", program, known], check=True, capture_output=True, text=True)
    assert done.stdout == "[{'a': 42}]\n"


# What people see


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["select * from trakcs"], r"no table trakcs \(did you mean tracks\?\); there are frames"),
        (['select * from "/camera/trakcs"'], "did you mean /camera/tracks"),
        (["select x_n from tracks"], '"x_n" not found.*"x_m"'),
        (['select x_m from tracks where topic = "/camera/truth"'], "single quotes"),
        (["selct 1"], "syntax error at or near"),
        (["select 1\n\nform tracks where\n"], "in line 3"),
        (["create view a as select 1"], "needs a SELECT"),
        (["select error('sorry')"], "sorry"),
        (["show tables"], "--tables"),
    ],
)
def test_errors_are_one_line(known, words, said):
    line = refusal(known, *words)
    assert re.search(said, line)
    assert "LINE" not in line


@pytest.mark.skipif(int(duckdb.__version__[0]) < 2, reason="DuckDB 1 cuts times to microseconds")
def test_functions_that_lack_nanoseconds_are_named_with_the_remedy(known):
    query = "select date_trunc('minute', t) from tracks limit 1"
    assert "t::timestamptz" in refusal(known, query)
    assert run(known, query.replace("t)", "t::timestamptz)")).code == 0


def test_a_file_that_is_not_a_log_is_refused(tmp_path):
    (tmp_path / "empty.mcap").touch()
    assert "it is empty" in refusal(tmp_path / "empty.mcap", "select 1")
    assert "does not exist" in refusal(tmp_path / "none.mcap", "select 1")
    assert "no log" in refusal("select 1")
    assert "it is empty" in refusal(tmp_path, "select 1")  # a folder stands for the logs in it
    (tmp_path / "folder").mkdir()
    assert "a folder without tables" in refusal(tmp_path / "folder", "select 1")
    assert "no file matches" in refusal(tmp_path / "x*.mcap", "select 1")


def test_a_damaged_table_is_refused(exported, tmp_path):
    damaged = tmp_path / "tracks/recording=a/part-0.parquet"
    damaged.parent.mkdir(parents=True)
    source = exported / "demo.tables/tracks/recording=known/part-0.parquet"
    content = bytearray(source.read_bytes())
    where = pq.read_metadata(source).row_group(0).column(10)
    assert where.path_in_schema == "x_m"
    content[where.data_page_offset + where.total_compressed_size // 2] ^= 0xFF
    damaged.write_bytes(content)
    assert refusal(tmp_path, "select sum(x_m) from tracks")
    damaged.write_bytes(content[:5000])
    assert "can't be read as Parquet" in refusal(tmp_path, "select sum(x_m) from tracks")


def test_missing_duckdb_is_named_with_the_command_that_installs_it(known, monkeypatch):
    monkeypatch.setitem(sys.modules, "duckdb", None)
    assert "`pip install 'mcaptrack[sql]'`" in refusal(known, "select 1")


EVERYTHING = """select t, t_ns, 0.1 + 0.2 as d, sum(track_id) over () as s, 1.25::decimal(9, 2) as e, date '2026-05-01' as f,
interval '1 month 2 days 1.5 seconds' as g, [1.5, null] as h, {'a': 'b'} as i, null as j, 'inf'::double as k, 1 as t,
12345678901234567890123::hugeint as big, 'a"b,\n' as words, true as yes
from tracks where topic = '/camera/retracks/full' order by t_ns limit 1 offset 7"""


def test_answers_are_exact_in_every_form(known, tmp_path):
    (row,) = map(json.loads, run(known, EVERYTHING, "--format", "jsonl").out.splitlines())
    wanted = {
        "t": "1970-01-01T00:00:00.700000000Z" if int(duckdb.__version__[0]) > 1 else "1970-01-01T00:00:00.700000Z",
        "t_ns": 700_000_000,
        "d": 0.1 + 0.2,
        "s": 120,
        "e": 1.25,
        "f": "2026-05-01",
        "g": "1 month 2 days 00:00:01.5",
        "h": [1.5, None],
        "i": {"a": "b"},
        "j": None,
        "k": "Infinity",
        "t_1": 1,
        "big": "12345678901234567890123",
        "words": 'a"b,\n',
        "yes": True,
    }
    assert row == wanted
    assert json.loads(run(known, EVERYTHING, "--format", "json").out) == [wanted]
    whole = json.loads(run(known, EVERYTHING, "--json").out)
    assert (whole["schema_version"], whole["results"]) == (1, [wanted])
    assert [column["name"] for column in whole["columns"]] == list(wanted)
    (cells,) = csv.DictReader(io.StringIO(run(known, EVERYTHING, "--format", "csv").out, newline=""))
    assert (cells["t"], cells["big"], cells["h"], cells["i"]) == (
        wanted["t"],
        wanted["big"],
        "[1.5, null]",
        '{"a": "b"}',
    )
    assert (cells["words"], float(cells["d"]), cells["j"]) == ('a"b,\n', 0.1 + 0.2, "")
    for form in ("parquet", "arrow"):
        target = tmp_path / f"answer.{form}"
        assert run(known, EVERYTHING, "-o", target).code == 0
        table = pq.read_table(target) if form == "parquet" else pa.ipc.open_file(target).read_all()
        assert table.column("t_ns").to_pylist() == [700_000_000]
        assert table.column("t").cast(pa.int64()).to_pylist()[0] in (700_000_000, 700_000)


def test_an_answer_is_written_to_a_file_without_loss(known, tmp_path):
    target = tmp_path / "a.csv"
    assert run(known, "select 1 as a", "-o", target).code == 0
    assert target.read_text() == '"a"\n1\n'
    assert "exists" in refusal(known, "select 2 as a", "-o", target)
    assert "a.xlsx: answers end with .csv" in refusal(known, "select 2 as a", "-o", target.with_name("a.xlsx"))
    assert run(known, "select error('no') from tracks", "-o", target, "--force").code == 1
    assert target.read_text() == '"a"\n1\n'
    assert run(known, "select 2 as a", "-o", target, "--force").code == 0
    assert target.read_text() == '"a"\n2\n'
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]
    copy = tmp_path / "known.mcap"
    copy.write_bytes(known.read_bytes())
    assert "both input and output" in refusal(copy, "select 1", "-o", copy, "--force")


def test_a_query_is_read_from_a_file_or_from_standard_input(known, tmp_path, monkeypatch):
    (tmp_path / "q.sql").write_text(
        "\ufeff-- how many\nselect count(*) as n from tracks where topic = '/camera/truth';\n"
    )
    wanted = '"n"\n22\n'
    assert run(known, "-f", tmp_path / "q.sql", "--format", "csv").out == wanted
    text = (tmp_path / "q.sql").read_text(encoding="utf-8-sig")
    for place in (["-"], ["-f", "-"]):
        monkeypatch.setattr(sys, "stdin", io.StringIO(text))
        assert run(known, *place, "--format", "csv").out == wanted


def test_answers_as_a_table(known):
    query = "select track_id, x_m / 3 as third, null as nothing, '\x1b[31mred' as word from tracks where topic = '/camera/samples' order by row limit 3"
    outcome = run(known, query)
    lines = outcome.out.splitlines()
    assert lines[0].split() == ["track_id", "third", "nothing", "word"]
    assert lines[2].split() == ["7", "0", "null", "\\x1b[31mred"]
    assert lines[4].split()[1] == "0.133333"


def test_only_the_last_of_several_questions_is_answered_and_that_is_said(known):
    outcome = run(known, "select 1 as a; create temp table t as select 5 as c; select c from t", "--format", "csv")
    assert outcome.out.split() == ['"c"', "5"]
    assert "warning: the query asks 2 questions; only the last is answered" in outcome.err
    assert "questions" not in run(known, "create temp table t as select 5 as c; select c from t").err


def test_the_tables_are_listed_with_columns_units_and_meanings(known):
    words = run("--tables").out
    listed = json.loads(run(known, "--tables", "--json").out)
    assert [table["table"] for table in listed["results"]] == list(tables.TABLES)
    assert listed["recordings"] == ["known"]
    assert "/camera/predictions" in listed["channels"]
    for table in tables.TABLES.values():
        for field in table.arrow:
            assert field.name in words
    (tracks,) = (table for table in listed["results"] if table["table"] == "tracks")
    column = next(column for column in tracks["columns"] if column["name"] == "x_m")
    assert re.search(r"^  x_m +\w+ +m +position on the ground plane, first axis *$", words, re.MULTILINE)
    assert "timestamp[ns, tz=UTC]" in words
    assert (column["unit"], column["meaning"]) == ("m", "position on the ground plane, first axis")


LONG = "select range(5000) as many, repeat('x', 5000) as words, {'a': range(5000)} as nested, 1 as one"


def test_long_values_are_cut_in_tables_only(known):
    shown = run(known, LONG)
    assert max(map(len, shown.out.splitlines())) < 4000
    assert "3 long values are cut; --format json or csv has all of it" in shown.err
    assert "columns fit" not in shown.err  # only a terminal has an end
    assert "1 long value is cut" in run(known, "select repeat('x', 5000) as words").err
    assert "cut" not in run(known, "select repeat('x', 1000) as words").err
    for form in ("json", "jsonl", "csv"):
        assert len(run(known, LONG, "--format", form).out) > 3 * 5000
    (row,) = json.loads(run(known, LONG, "--json").out)["results"]
    assert (row["many"], row["nested"]["a"], len(row["words"])) == ([*range(5000)], [*range(5000)], 5000)


def test_a_table_is_no_wider_than_the_terminal(known, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    for rows in ([], ["--rows", "0"]):
        with redirect_stdout(Terminal()) as screen, pytest.raises(SystemExit):
            GROUP(["query", str(known), LONG, *rows])
        assert "…" in screen.shown()
        assert max(map(len, screen.shown().splitlines())) <= 80


def test_a_terminal_shows_sixty_rows_of_an_answer_and_a_pipe_all(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TERM", "xterm")
    Path("x.mcap").write_bytes(b"no log")
    answer = pa.table({"n": pa.array(range(61), pa.int64()), "word": ["a\x1b[31m"] * 61})
    monkeypatch.setattr(mcaptrack, "query", lambda log, sql, **_: answer)

    def on_screen(*words: str) -> str:
        screen = Terminal()
        with redirect_stdout(screen), pytest.raises(SystemExit):
            GROUP.main(["query", "x.mcap", "select 1", *words], prog_name="mcaptrack")
        return screen.shown()

    for words, rows in (((), 60), (("--rows", "0"), 61), (("--rows", "5"), 5)):
        assert len(on_screen(*words).splitlines()) - 2 == rows
    assert r'0,"a\x1b[31m"' in on_screen("--format", "csv")  # data keep what a terminal would act on elsewhere
    assert '0,"a\x1b[31m"\n' in call("query", "x.mcap", "select 1", "--format", "csv").out
    assert len(call("query", "x.mcap", "select 1").out.splitlines()) == 63


def test_a_log_by_two_names_does_not_count_twice(known, tmp_path):
    (tmp_path / "link.mcap").symlink_to(known)
    rows = "select count(*) as n from tracks"
    assert (
        mcaptrack.query([known, tmp_path / "link.mcap"], rows).to_pydict() == mcaptrack.query(known, rows).to_pydict()
    )


def test_own_channels_are_tables_of_logs_and_of_folders(tmp_path):
    speeds = mcaptrack.schema_of("Speed", [("m_per_s", "f8")])
    frames = [Frame(ns(1), 0, speeds.rows(m_per_s=[0.25, np.nan])), Frame(ns(2), 1, speeds.rows(m_per_s=[0.5]))]
    with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
        opened.write("/gps/speed", frames, schema=speeds)
    exported = mcaptrack.export(tmp_path / "a.mcap", topic="/gps/speed")
    for place in (tmp_path / "a.mcap", exported.folder):
        assert mcaptrack.query(place, 'select sum(m_per_s) as v from "/gps/speed"').to_pydict() == {"v": [0.75]}
        rows = mcaptrack.query(place, 'select t_ns from "/gps/speed" where m_per_s is null')
        assert rows.to_pydict() == {"t_ns": [ns(1)]}
