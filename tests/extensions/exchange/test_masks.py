"""Files of mots."""

from __future__ import annotations

from tests.label_cases import Row, Writer, number, text


def mots(row: Row) -> str:
    """A mask that is one pixel wide, in the column that the box begins with."""
    return f"{row.frame} {number(row.id, '-1')} 2 8 9 {chr(48 + 8 * (row.frame % 2))}84l0"


WRITERS = {
    "mots": Writer(text(mots), "box pixels score kind size numbered", first="listed"),
}
