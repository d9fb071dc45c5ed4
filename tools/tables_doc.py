"""Write the tables of docs/tables.md anew, from the schemas.

.venv/bin/python tools/tables_doc.py
"""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa

from mcaptrack.tables import TABLES

DOCUMENT = Path(__file__).parent.parent / "docs" / "tables.md"
BEGIN, END = "<!-- tables: begin, written by tools/tables_doc.py -->", "<!-- tables: end -->"


def described() -> str:
    """All tables with their columns, as Markdown."""
    parts = []
    for table in TABLES.values():
        key = ", ".join(
            f"`{name}`" for name in (("recording",) if table.key == ("recording",) else ("recording", *table.key))
        )
        order = f" Sorted by {', '.join(f'`{name}`' for name in table.order)}." if table.order else ""
        lines = [
            f"### {table.name}",
            "",
            table.doc,
            "",
            f"Key: {key}.{order}",
            "",
            "| column | type | unit | meaning |",
        ]
        lines.append("|---|---|---|---|")
        for field in table.arrow:
            words = {name.decode(): value.decode() for name, value in field.metadata.items()}
            missing = ", may be null" if field.nullable else ""
            lines.append(
                f"| `{field.name}` | {_kind(field.type)}{missing} | {words['unit']} | {words['description']} |"
            )
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def _kind(kind: pa.DataType) -> str:
    return "text" if pa.types.is_dictionary(kind) or pa.types.is_string(kind) else str(kind)


def with_tables(text: str) -> str:
    """The document with its tables as they are now."""
    before, _, rest = text.partition(BEGIN)
    return f"{before}{BEGIN}\n\n{described()}\n\n{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    DOCUMENT.write_text(with_tables(DOCUMENT.read_text()))
