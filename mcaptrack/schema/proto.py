"""Parse the row schemas: a strict subset of proto3 in which every field has a fixed width.

A schema file holds one message with one nested message ``Row`` and one field ``repeated Row rows = 1``. Everything
else is refused, because the row codec requires that all rows have the same number of bytes. The comments of the file
are the descriptions of columns in ``--help``, Arrow and Parquet. A comment ``// since VERSION, ...`` on a line of its
own stands above columns that were added in a later version.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

#: proto3 scalar -> (NumPy format, bytes on the wire, wire type, FieldDescriptorProto.Type)
KINDS: Final = {
    "double": ("<f8", 8, 1, 1),
    "float": ("<f4", 4, 5, 2),
    "fixed64": ("<u8", 8, 1, 6),
    "fixed32": ("<u4", 4, 5, 7),
    "bool": ("?", 1, 0, 8),
    "sfixed32": ("<i4", 4, 5, 15),
    "sfixed64": ("<i8", 8, 1, 16),
}
UNITS: Final = {"px": "px", "m": "m", "m2": "m^2", "rad": "rad", "m_per_s": "m/s", "s": "s", "ns": "ns", "hz": "Hz"}
#: Kinds that can be optional, and the value in rows of a column that is missing.
_MISSING: Final[dict[str, float]] = {"double": math.nan, "float": math.nan, "sfixed32": -1, "sfixed64": -1}

_SINCE = re.compile(r"since (\S+),")
_COMMENT = re.compile(r"//\s?(.*)$")
_FIELD = re.compile(r"(optional\s+)?(\w+)\s+([a-z]\w*)\s*=\s*(\d+)\s*;$")
_MESSAGE = re.compile(r"message\s+([A-Z]\w*)\s*\{$")


@dataclass(frozen=True)
class Column:
    """One column of a row. ``optional``: the value may be missing, which is NaN in rows and null in tables.

    A whole number that is missing is -1, in tables, too, as ids of other columns are.

    ``since`` is the version that added the column, "" for those that were there from the beginning; ``group`` counts
    the comments that say so up to it, because columns are added in groups. ``stated_unit`` is the unit of a column
    with a name that doesn't say it.

    ``kind`` is its type in protobuf, ``doc`` its description.
    """

    name: str
    kind: str
    number: int
    optional: bool
    doc: str
    since: str = ""
    group: int = 0
    stated_unit: str = ""

    @property
    def unit(self) -> str:
        """The unit as it is stated, or in the suffix of the name ("px", "m", "m^2", "m/s"), "" if there is none."""
        if self.stated_unit:
            return self.stated_unit
        endings = [ending for ending in UNITS if self.name.endswith(f"_{ending}")]
        return UNITS[max(endings, key=len)] if endings else ""

    @property
    def missing(self) -> float:
        """The value in rows of a missing one; 0 where it can't be missing."""
        return _MISSING[self.kind] if self.optional else 0

    @property
    def is_nullable(self) -> bool:
        """Whether a missing value is null in tables."""
        return math.isnan(self.missing)


@dataclass(frozen=True)
class Definition:
    """One schema file: the message's full name ("mcaptrack.Tracks"), its description and its columns in order."""

    name: str
    doc: str
    columns: tuple[Column, ...]

    def file_descriptor_set(self) -> FileDescriptorSet:
        """The protobuf descriptor of the file, as stored in MCAP schema records."""
        from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet

        package, _, message_name = self.name.rpartition(".")
        files = FileDescriptorSet()
        file = files.file.add(name=f"{package}/{message_name}.proto", package=package, syntax="proto3")
        message = file.message_type.add(name=message_name)
        message.field.add(
            name="rows",
            json_name="rows",
            number=1,
            label=FieldDescriptorProto.LABEL_REPEATED,
            type=FieldDescriptorProto.TYPE_MESSAGE,
            type_name=f".{self.name}.Row",
        )
        row = message.nested_type.add(name="Row")
        json_names = [_json_name(column.name) for column in self.columns]
        if len(set(json_names)) < len(json_names):  # of a_1 and a1, which protobuf refuses
            json_names = [column.name for column in self.columns]
        for column, json_name in zip(self.columns, json_names, strict=True):
            field = row.field.add(
                name=column.name,
                json_name=json_name,
                number=column.number,
                label=FieldDescriptorProto.LABEL_OPTIONAL,
                type=FieldDescriptorProto.Type.ValueType(KINDS[column.kind][3]),
            )
            if column.optional:  # proto3 wraps each optional scalar in a separate oneof
                field.proto3_optional = True
                field.oneof_index = len(row.oneof_decl)
                row.oneof_decl.add(name=f"_{column.name}")
        return files


def _json_name(name: str) -> str:
    """The name of a field in protobuf's JSON: x_px -> xPx."""
    head, *tail = name.split("_")
    return head + "".join(word.capitalize() for word in tail)


def parse(text: str, origin: str) -> Definition:
    """Parse the text of one schema file; ``origin`` names it in errors.

    Raises ValueError, with the line, for anything outside the subset.
    """
    package, depth, closed, since, group = "", 0, False, "", 0
    names: list[str] = []
    doc: list[str] = []
    columns: list[Column] = []
    for number, raw in enumerate(text.splitlines(), start=1):
        comment = _COMMENT.search(raw)
        line = (raw[: comment.start()] if comment else raw).strip()
        if not line:
            if comment and not names:
                doc.append(comment.group(1).strip())
            elif comment and (added := _SINCE.match(comment.group(1).strip())):
                since, group = added.group(1), group + 1
            continue
        message, field = _MESSAGE.match(line), _FIELD.match(line)
        if line == 'syntax = "proto3";':
            continue
        if line.startswith("package ") and line.endswith(";") and not package:
            package = line[len("package ") : -1].strip()
        elif message and depth < 2 and (depth == 0) == (not names) and (depth == 0 or message.group(1) == "Row"):
            names.append(message.group(1))
            depth += 1
        elif line == "}" and depth:
            depth -= 1
        elif line == "repeated Row rows = 1;" and depth == 1 and len(names) == 2:
            closed = True
        elif field and depth == 2 and field.group(2) in KINDS:
            optional, kind, name, tag = field.groups()
            if optional and kind not in _MISSING:
                raise ValueError(f"{origin}:{number}: only {', '.join(_MISSING)} can be optional, not {kind} {name}")
            description = comment.group(1).strip() if comment else ""
            columns.append(Column(name, kind, int(tag), bool(optional), description, since, group))
        else:
            raise ValueError(f"{origin}:{number}: not a row schema (fixed-width fields in message Row): {line}")
    numbers = [column.number for column in columns]
    if depth or not closed or not package or numbers != sorted(set(numbers)):
        raise ValueError(f"{origin}: a row schema needs a package, 'repeated Row rows = 1;' and rising field numbers")
    return Definition(f"{package}.{names[0]}", " ".join(doc), tuple(columns))
