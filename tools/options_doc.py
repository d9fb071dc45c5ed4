"""Write the tables of docs/options.md anew, from what the transforms declare.

.venv/bin/python tools/options_doc.py
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

from mcaptrack.transforms import ALTERNATIVES, PROFILES, TRANSFORMS
from mcaptrack.transforms.protocol import bare_type, choices, range_words

DOCUMENT = Path(__file__).parent.parent / "docs" / "options.md"
BEGIN, END = "<!-- options: begin, written by tools/options_doc.py -->", "<!-- options: end -->"
_KINDS = {bool: "yes or no", int: "whole number", float: "number", str: "text"}


def described() -> str:
    """All options of stages with what they take, as Markdown."""
    parts = []
    for command in TRANSFORMS:
        kinds = dict(ALTERNATIVES[command].kinds) if command in ALTERNATIVES else {"": TRANSFORMS[command]}
        known: set[str] = set()
        for name, kind in kinds.items():
            made = PROFILES["default"] if command == "retrack" else kind()
            rows = [_row(made, field) for field in fields(kind) if not field.metadata.get("context")]
            new = [row for row in rows if row.split("`")[1] not in known]
            known |= {row.split("`")[1] for row in rows}
            several = f", with `--{ALTERNATIVES[command].option} {name}` alone" if _stands(parts, command) else ""
            head = f"### {command}{several}"
            parts.append("\n".join([head, "", "| option | values | default | meaning |", "|---|---|---|---|", *new]))
    return "\n\n".join(parts)


def _stands(parts: list[str], command: str) -> bool:
    """Whether there is a table of this command already."""
    return any(part.startswith(f"### {command}") for part in parts)


def _row(made: Any, field: Any) -> str:
    kind = bare_type(get_type_hints(type(made))[field.name])
    default = getattr(made, field.name)
    shown = "none" if default is None else str(default).lower() if kind is bool else f"{default}"
    values = (
        " ".join(f"`{name}`" for name in choices(kind)) or f"{_KINDS[kind]} {range_words(field).lower().rstrip('.')}"
    )
    words = field.metadata["help"]
    return f"| `--{field.name.replace('_', '-')}` | {values.strip()} | {shown} | {words[:1].upper()}{words[1:]} |"


def with_options(text: str) -> str:
    """The document with its tables as they are now."""
    before, _, rest = text.partition(BEGIN)
    return f"{before}{BEGIN}\n\n{described()}\n\n{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    DOCUMENT.write_text(with_options(DOCUMENT.read_text()))
