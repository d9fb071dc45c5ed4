"""Tables of logs as HTML, for notebooks and pages: the first and the last rows, with units and the number of rows."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

from markupsafe import Markup

from mcaptrack import tables
from mcaptrack.viewing.formatting import render

if TYPE_CHECKING:
    import pyarrow as pa

#: The module and name of the class of Arrow tables.
_ARROW: Final = ("pyarrow.lib", "Table")
#: The number of rows that are shown at the beginning and at the end.
FIRST: Final = 8
LAST: Final = 2
#: The longest text in a cell.
_LONGEST: Final = 60


class ShownColumn(NamedTuple):
    """A column of a table: its name, unit ("" if it has none) and meaning; whether it holds numbers; and its texts in
    the rows that are shown, None where a value is missing.
    """

    name: str
    unit: str
    meaning: str
    is_number: bool
    texts: Sequence[str | None]


def table_html(columns: Sequence[ShownColumn], rows: int) -> Markup:
    """Return a table of some rows as HTML. ``columns`` hold all rows, or the first and the last ones of more."""
    shown = len(columns[0].texts) if columns else 0
    lines = [[_short(column.texts[row]) for column in columns] for row in range(shown)]
    gap = FIRST if shown < rows else -1
    caption = f"{rows:,} rows, {len(columns)} columns"
    if shown < rows:
        caption += f"; the first {FIRST} and the last {LAST} rows are shown"
    return render("table.html", columns=columns, lines=lines, gap=gap, caption=caption)


def _short(text: str | None) -> str | None:
    return text if text is None or len(text) <= _LONGEST else text[: _LONGEST - 1] + "\N{HORIZONTAL ELLIPSIS}"


def show_tables() -> None:
    """Let the running notebook show tables of logs with their units, unless it has its own way to show Arrow tables."""
    jupyter = sys.modules.get("IPython")
    shell = jupyter.get_ipython() if jupyter is not None else None
    if shell is None:
        return
    html = shell.display_formatter.formatters["text/html"]
    if _ARROW not in html.deferred_printers and not any(_name_of(printer) == _ARROW for printer in html.type_printers):
        html.for_type_by_name(*_ARROW, arrow_html)


def _name_of(cls: type) -> tuple[str, str]:
    return cls.__module__, cls.__qualname__


def arrow_html(table: pa.Table) -> str | None:
    """Return a table of a log as HTML; None for tables of others, which are shown as always.

    Examples
    --------
    >>> import pyarrow
    >>> arrow_html(pyarrow.table({"a": [1]})) is None
    True
    """
    import pyarrow as pa

    about = [{key.decode(): text.decode() for key, text in (field.metadata or {}).items()} for field in table.schema]
    if not any("unit" in metadata and "description" in metadata for metadata in about):
        return None
    rows = table.num_rows
    is_whole = rows <= FIRST + LAST
    numbers, texts = tables.cells(table, rows if is_whole else FIRST)
    texts += [] if is_whole else tables.cells(table.slice(rows - LAST), LAST)[1]
    units = [  # dates and seconds have theirs in the text
        "" if pa.types.is_timestamp(kind) else metadata.get("unit", "")
        for kind, metadata in zip(table.schema.types, about, strict=True)
    ]
    columns = [
        ShownColumn(name, unit, metadata.get("description", ""), is_number, [line[place] for line in texts])
        for place, (name, unit, metadata, is_number) in enumerate(
            zip(table.column_names, units, about, numbers, strict=True)
        )
    ]
    return table_html(columns, rows)
