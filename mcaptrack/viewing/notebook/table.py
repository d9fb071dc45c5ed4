"""Tables for notebooks: the first and the last rows, with units and the number of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from mcaptrack.viewing.report.html import render

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


def table_html(columns: Sequence[ShownColumn], rows: int) -> str:
    """Return a table of some rows as HTML. ``columns`` hold all rows, or the first and the last ones of more."""
    shown = len(columns[0].texts) if columns else 0
    lines = [[_short(one.texts[row]) for one in columns] for row in range(shown)]
    gap = FIRST if shown < rows else -1
    caption = f"{rows:,} rows, {len(columns)} columns"
    if shown < rows:
        caption += f"; the first {FIRST} and the last {LAST} rows are shown"
    return str(render("table.html", columns=columns, lines=lines, gap=gap, caption=caption))


def _short(text: str | None) -> str | None:
    return text if text is None or len(text) <= _LONGEST else text[: _LONGEST - 1] + "\N{HORIZONTAL ELLIPSIS}"
