"""``mcaptrack query``: what is asked, and how the answer is printed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import mcaptrack
from mcaptrack.api.common import warn_unused
from mcaptrack.api.declared import Option
from mcaptrack.api.options import PathLike
from mcaptrack.cli import common
from mcaptrack.cli.common import expand
from mcaptrack.cli.declared import Once, Printed
from mcaptrack.cli.text import console, print_table, printable, show
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.sql.api import QUERY
from mcaptrack.extensions.sql.database import write_answer
from mcaptrack.files import is_same_file, refuse_overwrite, unreadable

if TYPE_CHECKING:
    from mcaptrack import TableList

Form = Literal["table", "csv", "json", "jsonl", "parquet", "arrow"]
#: Number of rows that a terminal shows by default.
_SHOWN: Final = 60
#: Most characters of a cell in a table: on a terminal, and elsewhere.
_WIDEST: Final = 60
_WIDEST_UNBROKEN: Final = 1000
#: The columns of the answer of EXPLAIN: a drawing of many lines.
_PLAN: Final = ["explain_key", "explain_value"]
_KEYWORDS: Final = ("select", "from", "with", "describe", "summarize", "explain", "pivot", "show", "values")


class Query(Once[Any]):
    """Answer a query, or list what can be queried; the list is another function."""

    class More(Printed):
        """Options that the function has no use for."""

        file: Annotated[
            PathLike | None,
            Option(QUERY, short="f", shown=False, help="Read the query from this file; all arguments are logs."),
        ] = None
        form: Annotated[
            Form | None, Option(QUERY, flag="format", shown="table, or what -o ends with", help="Format of the answer.")
        ] = None
        rows: Annotated[
            int | None,
            Option(QUERY, 0, 10**9, shown="60 on a terminal", help="Number of rows that a table shows; 0 for all."),
        ] = None
        tables: Annotated[
            bool, Option(QUERY, help="List the tables with their columns, units and meanings; no query.")
        ] = False

    most_used = ("file", "form", "rows", "tables", "worlds", "output", "force")

    @property
    def function(self) -> Callable[..., Any]:
        """The function: another one lists the tables."""
        return mcaptrack.list_tables if self.values["tables"] else mcaptrack.query

    def arguments(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the arguments of the function: what the words of the command line mean."""
        given, output = self.values, self.values["output"]
        paths, sql = _asked(given["words"] or [], given["file"], given["tables"])
        if given["tables"]:
            warn_unused("--tables lists what could be asked", form=True, rows=True, worlds=True)
        logs = expand(paths, folders=True)
        if output is not None:
            refuse_overwrite(output, given["force"])
            if any(is_same_file(output, path) for path in logs):
                raise McaptrackError(f"{output} is both input and output; give another name with -o")
        self._form = _form(given["form"], output, given["json"])
        return {"log": logs, "files": _named(given["files"] or [])} | (
            {} if given["tables"] else {"sql": sql, "worlds": given["worlds"]}
        )

    def print_result(self, done: Any, talk: common.Talk) -> None:
        """Print the answer, or write it to a file."""
        output, json = self.values["output"], self.values["json"]
        if self.values["tables"]:
            with self.printed():
                _print_tables(done, json)
        elif self._form == "table":
            limit = _SHOWN if sys.stdout.isatty() and output is None else 0
            with self.printed():
                note = _print_answer(done, limit if self.values["rows"] is None else self.values["rows"])
            if note:
                talk.say(note)
        else:
            warn_unused(f"{self._form} has all rows", rows=True)
            with self.printed() if json else nullcontext():
                _write(done, self._form, output, json)


def _asked(arguments: Sequence[str], file: Path | None, tables: bool) -> tuple[list[Path], str]:
    """Return the logs and the query that the words of the command line give."""
    from_file = file is not None or tables
    names = list(arguments) if from_file else list(arguments[:-1])
    stray = next((name for name in names if name.lower() in _KEYWORDS and not Path(name).exists()), None)
    if stray is not None:
        raise McaptrackError(f'{stray} is not a log; the query is one argument, in quotes: "{stray} ..."')
    if tables:
        if file is not None:
            raise McaptrackError("--tables needs no query; leave -f out")
        return [Path(name) for name in names], ""
    if not arguments or (not from_file and _exists(arguments[-1])):
        raise McaptrackError("there is no query; give it last, in quotes, or with -f FILE (--tables lists the tables)")
    if not names:
        raise McaptrackError("there is no log; give logs or folders of tables before the query")
    sql = arguments[-1] if file is None and arguments[-1] != "-" else _read(file)
    if not sql.strip(" \t\r\n;"):
        raise McaptrackError("the query is empty")
    return [Path(name) for name in names], sql


def _read(file: Path | None) -> str:
    """Return the query in a file; None or "-" is stdin."""
    if file is None or str(file) == "-":
        return sys.stdin.read()
    try:
        return file.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise unreadable(file, error) from None
    except UnicodeDecodeError:
        raise McaptrackError(f"{file} is not text in UTF-8") from None


def _exists(word: str) -> bool:
    try:
        return Path(word).exists()
    except (OSError, ValueError):  # too long for a name, as queries are
        return False


def _form(form: Form | None, output: Path | None, json: bool) -> Form:
    """Return the format of the answer: as the options say, as the name of the file ends, or a table."""
    if json and form not in (None, "json"):
        raise McaptrackError(f"--json and --format {form} are two formats; give one")
    end = output.suffix.removeprefix(".").lower() if output is not None else ""
    by_ending: dict[str, Form] = {name: name for name in ("csv", "json", "jsonl", "parquet", "arrow")}
    if output is not None and form is None and not json and end not in (*by_ending, "", "txt", "md"):
        raise McaptrackError(f"{output}: answers end with .{', .'.join(by_ending)}; --format table writes text there")
    chosen: Form = "json" if json else form or by_ending.get(end, "table")
    if chosen in ("parquet", "arrow") and output is None:
        raise McaptrackError(f"--format {chosen} is not text; name a file with -o")
    return chosen


def _named(files: Sequence[str]) -> dict[str, Path]:
    out = {}
    for file in files:
        name, equals, path = file.partition("=")
        if not equals or not path:
            raise McaptrackError(f"--with {file}: give a name and a file, such as --with zones=zones.csv")
        out[name] = Path(path)
    return out


def _write(answer: Any, form: Form, output: Path | None, json: bool) -> None:
    from mcaptrack import tables

    if json:
        import json as codec

        rows = codec.loads(b"".join(tables.pieces(answer, "json")))
        columns = [{"name": field.name, "type": str(field.type)} for field in answer.schema]
        common.print_json({"columns": columns, "results": rows})
    elif output is not None:
        write_answer(output, answer, form)
    else:
        for piece in tables.pieces(answer, form):  # type: ignore[arg-type]
            text = piece.decode("utf-8")
            sys.stdout.write("\n".join(map(printable, text.split("\n"))) if sys.stdout.isatty() else text)


def _print_answer(answer: Any, limit: int) -> str:
    """Print an answer as a table with the columns that fit; returns a note on what is not shown, or ""."""
    from rich.text import Text

    from mcaptrack.tables import cells

    shown = min(limit or answer.num_rows, answer.num_rows)
    are_numbers, rows = cells(answer, shown)
    if answer.schema.names == _PLAN:
        show(*(line for row in rows for line in (row[1] or "").splitlines()))
        return ""
    widest = _WIDEST if sys.stdout.isatty() else _WIDEST_UNBROKEN
    words = [[None if word is None else printable(word) for word in row] for row in rows]
    shown_rows = [[Text("null", "dim") if word is None else _cut(word, widest) for word in row] for row in words]
    names = [printable(name) for name in answer.schema.names]
    numbers = {name for name, is_number in zip(names, are_numbers, strict=True) if is_number}
    # Times in nanoseconds, where the same time is a column, too; then from the right.
    twice = [name for name in names[1:] if name.endswith("_ns") and name.removesuffix("_ns") in names]
    spare = [*reversed(twice), *(name for name in reversed(names[1:]) if name not in twice)]
    left_out = print_table(names, shown_rows, numbers, spare, ruled=True)
    without = ", ".join(name for name in names if name in left_out)
    cut = sum(word is not None and len(word) > widest for row in words for word in row)
    notes = {
        f"{cut} long value{'s are' if cut > 1 else ' is'} cut; --format json or csv has all of it": cut,
        f"the first {shown} of {answer.num_rows} rows; --rows 0 shows all": shown < answer.num_rows,
        "no rows": not answer.num_rows,
        f"{len(names) - len(left_out)} of {len(names)} columns fit; name those that you want, or see them with "
        f"--format csv: {without}": bool(left_out),
    }
    return "; ".join(note for note, holds in notes.items() if holds)


def _cut(word: str, widest: int) -> str:
    return word if len(word) <= widest else word[: widest - 1] + "\N{HORIZONTAL ELLIPSIS}"


def _print_tables(listed: TableList, json: bool) -> None:
    other_names = {"recordings": listed.recordings, "channels": listed.channels} if listed.recordings else {}
    if json:
        results = [
            {"table": table.name, "meaning": table.meaning, "columns": [asdict(column) for column in table.columns]}
            for table in listed.tables
        ]
        common.print_json({"results": results} | {what: list(names) for what, names in other_names.items()})
        return
    from rich.table import Table
    from rich.text import Text

    out = console()
    for table in listed.tables:
        out.print(Text(table.name, "bold"))
        out.print(Text(table.meaning, "dim"))
        shown = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
        for column in table.columns:
            shown.add_row(f"  {column.name}", column.type, column.unit, column.meaning)
        out.print(shown)
        out.print()
    for what, names in other_names.items():
        out.print(f"{what}: {', '.join(names)}")
