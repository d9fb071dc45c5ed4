"""Cases of ``query`` for the tests of the core."""

from pathlib import Path
from typing import Any

import pyarrow as pa

import mcaptrack

READING = {"query": lambda log, out: [log, "select count(*) from tracks"]}
DEEDS = {"query": ["read"]}
NEEDS = {"query": ("select 1",)}
NAMED = {"query": ["query", "select count(*) > 0 as many from tracks", "--json"]}
ANSWERS = {"query": ["select * from tracks order by all"]}
PRINTING = {f"query a.mcap 'select * from tracks' {more}".strip(): more for more in ("", "--format csv")}
PACKAGES = {"query": "duckdb", "list_tables": "duckdb"}
SAID = {"`mcaptrack.list_tables('a.mcap')`": "`mcaptrack query a.mcap --tables`"}
EFFECTS = {
    "query": (
        "query a.mcap 'select topic, t_ns from tracks order by all'",
        {
            "file": ("query a.mcap", "--file query.sql"),
            "format": "--format csv",
            "with": ("query a.mcap 'from more'", "--with more=more.csv"),
            "rows": "--rows 2",
            "tables": ("query a.mcap", "--tables"),
            "output": "-o b.csv",
            "force": ("query a.mcap 'select 1' -o clip.mp4", "--force"),
            "verbose": ("query a.mcap 'select 1'", "-v"),
            "worlds": "--worlds",
        },
    )
}
USES = {"query": ["query a.mcap 'from events'", "query a.mcap 'from events' --format csv", "query a.mcap --tables"]}
PROPOSALS = {
    "extensions/sql/database.py:_answer:list_tables": lambda s: s.says("query", "LOG", "show tables"),
    "extensions/sql/database.py:_worlds_answer:retrack": lambda s: s.says(
        "query", "LOG", "--worlds", "select count(*) from tracks"
    ),
}


def _together(logs: list[Path], folder: Path) -> list[str]:
    """The names of logs; each has all of its rows."""
    rows = [mcaptrack.query(log, "select count(*) as n from tracks").to_pydict()["n"] for log in logs]
    answer = mcaptrack.query(logs, "select recording, count(*) as n from tracks group by all").to_pydict()
    assert sorted(answer["n"]) == sorted(n for some in rows for n in some)
    return answer["recording"]


TOGETHER = {"sql": _together}


def _printed(to: Any) -> None:
    answer = pa.table({"n": [1, 1000], "word": ["a\x1b[31m", "x" * 70], "x": [0.5, None]})
    for more in ("", "--rows 1", "--rows 1 -q", "--rows 1 --format csv", "--format jsonl", "--json"):
        to.run(f"query x.mcap 'select 1' {more}".strip(), query=answer)
    to.run("query x.mcap 'select 1'", query=answer.slice(0, 0))
    to.run("query x.mcap 'select 1'", query=pa.table({"a": ["x" * 1001, "x" * 1000]}))
    to.run("query --tables --rows 2 --format csv", list_tables=mcaptrack.TableList((), (), ()))
    for line in ("--format parquet", "--format arrow", "--json --format csv", "--with a=", "-f none.sql", "-f bad.sql",
                 "-f q.sql --tables", "-o x.mcap --force"):  # fmt: skip
        query = "" if line.startswith("-f") else "'select 1' "
        to.run(f"query x.mcap {query}{line}", query=answer)
    for line in ("x.mcap", "", "'select 1'", "x.mcap FROM x", "x.mcap ';'"):
        to.run(f"query {line}", query=answer)


PRINTED = {"sql": _printed}
