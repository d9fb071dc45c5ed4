"""The tables of many logs as Delta tables (delta.io), which DuckDB, Polars and Spark read: a folder for each table.

    <folder or URL>/<table>/_delta_log/...
    <folder or URL>/topics/<channel>/_delta_log/...     foreign channels that were exported

Rows have the column ``recording``, by which a log is replaced or removed; a file may hold many logs. A batch of logs is
one transaction a table. ``recordings`` is committed last, and only if no other process has changed these logs
meanwhile, so that what it says about a log holds for all tables. Only here: deltalake.

commit(where, logs)             add or replace logs, from the folders that ``export`` wrote
remove(where, recordings)       remove logs
compact(where), vacuum(where)   join small files; delete those of old versions
describe(where)                 what there is: version, rows, files and size of each table
DeltaFolder(where)              the tables, to read them
"""

from mcaptrack.tables.delta.commit import Committed, commit, prepare
from mcaptrack.tables.delta.exported import ExportedLog
from mcaptrack.tables.delta.opening import DeltaFolder, is_delta_folder, reason_of_store
from mcaptrack.tables.delta.removal import remove
from mcaptrack.tables.delta.upkeep import TableState, compact, describe, vacuum

__all__ = [
    "Committed",
    "DeltaFolder",
    "ExportedLog",
    "TableState",
    "commit",
    "compact",
    "describe",
    "is_delta_folder",
    "prepare",
    "reason_of_store",
    "remove",
    "vacuum",
]
