"""Write the answers in docs/sql.md anew, from the tables of the demonstration, with DuckDB alone.

.venv/bin/python tools/sql_doc.py mcaptrack-demo
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Sequence
from pathlib import Path

import duckdb

DOCUMENT = Path(__file__).resolve().parent.parent / "docs" / "sql.md"
#: A query, and its answer if it has one.
QUERY = re.compile(
    r"```sql\n(?P<query>(?!create view).*?)```\n(?P<answer>\n(?:For example:\n\n)?(?:\|[^\n]*\n)+)?", re.S
)
PRELUDE = re.compile(r"```sql\n(create view.*?)```", re.S)
#: Only the answers that no tracker has a hand in are sure.
SURE = re.compile(r"'/camera/(?!truth')")


def answered(text: str, folder: Path) -> str:
    """The document with the answers that the tables in a folder give."""
    os.chdir(folder)
    connection = duckdb.connect()
    connection.execute(PRELUDE.findall(text)[0])

    def with_answer(found: re.Match[str]) -> str:
        query = found["query"]
        relation = connection.sql(query)  # once, because a query may make a macro
        rows = relation.fetchall()
        if not rows:  # it asks for other logs
            return found[0]
        sure = "from metrics" not in query and not SURE.search(query)
        head = "" if sure else "For example:\n\n"
        return f"```sql\n{query}```\n\n{head}{answer(relation.columns, rows)}"

    return QUERY.sub(with_answer, text)


def answer(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """What a query answers, as a table in Markdown."""
    head = f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|\n"
    return head + "".join(f"| {' | '.join(map(word, row))} |\n" for row in rows)


def word(value: object) -> str:
    return "null" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="what `mcaptrack demo` made")
    chosen = parser.parse_args()
    DOCUMENT.write_text(answered(DOCUMENT.read_text(), chosen.folder.resolve()))
