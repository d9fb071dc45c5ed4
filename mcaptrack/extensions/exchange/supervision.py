"""Tables that supervision writes: CSV of its CSVSink, and JSON of its JSONSink."""

from __future__ import annotations

from typing import Final

from mcaptrack.sources.ingest.labels.delimited import choose_columns, header_of, opened, read_table, records
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import Asked, BoxTable

#: Columns that supervision writes before those of the user.
_COLUMNS: Final = ("x_min", "y_min", "x_max", "y_max", "class_id", "confidence", "tracker_id")
#: The column that counts frames from 0, as examples of supervision add it.
_FRAME_INDEX: Final = "frame_index"


class Supervision(Format):
    """Tables of the CSVSink of supervision, and JSON of its JSONSink."""

    title = "supervision"
    row = f"`{','.join(_COLUMNS)},...`, or JSON with these keys"
    takes = ("columns",)

    def recognises(self, file: LabelFile) -> bool:
        """Whether the columns, or the keys, are those of supervision."""
        if file.is_json:
            return isinstance(file.json, list) and "x_min" in file.keys if file.keys else False
        return set(_COLUMNS) <= set(header_of(file.path, file.row)) if file.row else False

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a table, or of JSON: objects with the same keys."""
        table = records(file) if file.is_json else opened(file)
        frame = choose_columns(table.where, table.header, asked.columns).get("frame")
        rows = read_table(table, asked.columns)
        if frame is not None and table.header[frame].lower() == _FRAME_INDEX:
            rows.facts.first_frame = 0
        return rows
