"""Tables of rows, and tables as files: one row for each object in each frame; metadata hold units and provenance.

TABLES                               all tables with their columns
rows_table(schema, channels)         rows -> Arrow; missing numbers are null in tables and NaN in rows
rows_in_pieces(schema, channels)     the same in pieces, for as many rows as there are
write(path, table, provenance)       Arrow -> Parquet, Arrow IPC, CSV or JSON lines
verify(path)                         check that a file holds what was written
join(parts)                          the same table of several logs as one
write_answer(path, table, form)      the answer of a query as a file
read_tracks(path), read_columns(...) files -> arrays and frames, also of files from other tools
"""

from mcaptrack.tables.build import (
    Pointers,
    columns_of,
    frames_table,
    records_table,
    rows_of_topic,
    table_of,
    table_to_array,
    table_to_frames,
    with_recording,
)
from mcaptrack.tables.fields import RECORDING, TABLE_VERSION, TABLES, Field, Table
from mcaptrack.tables.files import FORMATS, Format, file_metadata, verify, write
from mcaptrack.tables.join import join
from mcaptrack.tables.messages import messages_table
from mcaptrack.tables.read import holds_tracks, read_columns, read_tracks
from mcaptrack.tables.results import ANSWERS, cells, pieces, tidy, write_answer
from mcaptrack.tables.rows import TrackNames, names_by_track, rows_in_pieces, rows_table, summary_table
from mcaptrack.tables.table_pieces import TablePieces

__all__ = [
    "ANSWERS",
    "FORMATS",
    "RECORDING",
    "TABLES",
    "TABLE_VERSION",
    "Field",
    "Format",
    "Pointers",
    "Table",
    "TablePieces",
    "TrackNames",
    "cells",
    "columns_of",
    "file_metadata",
    "frames_table",
    "holds_tracks",
    "join",
    "messages_table",
    "names_by_track",
    "pieces",
    "read_columns",
    "read_tracks",
    "records_table",
    "rows_in_pieces",
    "rows_of_topic",
    "rows_table",
    "summary_table",
    "table_of",
    "table_to_array",
    "table_to_frames",
    "tidy",
    "verify",
    "with_recording",
    "write",
    "write_answer",
]
