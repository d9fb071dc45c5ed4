"""One table of all logs in a folder of tables: ``recordings`` with the column ``recording``.

    <folder>/recordings.parquet     the rows of <folder>/recordings/*/part-0.parquet, in one file

The file is made of the others, and only saves opening thousands of them: rows of logs with a file that has
changed since, as its time and size say, are read again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeGuard

from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish_stream
from mcaptrack.location import Location
from mcaptrack.tables.build import with_recording
from mcaptrack.tables.fields import RECORDING, TABLES
from mcaptrack.tables.files import opened_parquet

#: The table, and its file with the rows of all logs.
_TABLE: Final = "recordings"
FILE: Final = "recordings.parquet"
_MEMBERS: Final = b"mcaptrack.members"
_PREFIX: Final = "recording="


def is_folder_of_tables(place: Location) -> TypeGuard[Path]:
    """Whether logs were exported to a folder as Parquet files."""
    return isinstance(place, Path) and bool(_members(place))


def read_catalogue(folder: Path) -> list[dict[str, Any]]:
    """The rows of ``recordings`` of all logs, by name. Raises McaptrackError if they can't be read."""
    rows: list[dict[str, Any]] = _table(folder, _members(folder)).sort_by(RECORDING.name).to_pylist()
    return rows


def refresh(folder: Path) -> bool:
    """Write the file with the rows of all logs, if it is not up to date; returns whether it was written.

    Raises McaptrackError if it can't be.
    """
    import pyarrow.parquet as pq

    members = _members(folder)
    if not members or _known(folder)[0] == members:
        return False
    table = _table(folder, members)
    table = table.sort_by(RECORDING.name).replace_schema_metadata({_MEMBERS: json.dumps(members)})
    with publish_stream(folder / FILE) as stream:
        pq.write_table(table, stream, compression="zstd")
    return True


def _members(folder: Path) -> dict[str, list[int]]:
    """The logs of a folder by name: when their rows were written, and how many bytes that took."""
    members = {}
    try:
        with os.scandir(folder / _TABLE) as entries:
            for entry in entries:
                if entry.name.startswith(_PREFIX):
                    try:
                        about = os.stat(os.path.join(entry.path, "part-0.parquet"))
                    except OSError:
                        continue
                    members[entry.name.removeprefix(_PREFIX)] = [about.st_mtime_ns, about.st_size]
    except OSError:
        return {}
    return dict(sorted(members.items()))


def _known(folder: Path) -> tuple[dict[str, list[int]], Any]:
    """The logs that the file has, and their rows; none if there is no such file, or if it can't be read."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with (folder / FILE).open("rb") as stream:
            table = pq.read_table(stream)
        members = json.loads((table.schema.metadata or {})[_MEMBERS])
    except (OSError, pa.ArrowException, KeyError, ValueError):
        return {}, None
    return members if isinstance(members, dict) else {}, table


# The same table of several logs as one table, in memory or in files, which are read only as far as needed.


_COLUMNS: Final = "these tables can't be one"


def join(parts: Sequence[tuple[str, Any]], columns: Any = None) -> Any:
    """Join tables by the name of their log, each an Arrow table or the path of a Parquet file; adds ``recording``.

    ``columns`` is an Arrow schema with the first columns of the result. Columns that a part does not have are null.
    The result is an Arrow table, or a dataset if files are among the parts. Raises McaptrackError if a file can't be
    read or if a column has two types.
    """
    import pyarrow as pa
    import pyarrow.dataset as ds

    loose = [with_recording(part, name) for name, part in parts if not isinstance(part, Path)]
    files = [(name, part) for name, part in parts if isinstance(part, Path)]
    try:
        first = [columns] if columns is not None else []
        schema = pa.unify_schemas(
            [*first, *(table.schema.remove_metadata() for table in loose), *(_columns(path) for _, path in files)],
            promote_options="permissive",
        )
        at = schema.get_field_index(RECORDING.name)
        schema = (schema if at < 0 else schema.remove(at)).append(RECORDING.arrow)
        schema = pa.schema([field.with_nullable(True).remove_metadata() for field in schema])
        table = pa.concat_tables([schema.empty_table(), *loose], promote_options="permissive").cast(schema)
    except (pa.ArrowException, TypeError) as error:
        raise McaptrackError(f"{_COLUMNS}: {str(error).splitlines()[0]}") from None
    if not files:
        return table
    read = _dataset(files, schema)
    return ds.UnionDataset(schema, [read, ds.dataset(table)]) if loose else read


def _columns(path: Path) -> Any:
    with opened_parquet(path) as file:
        return file.schema_arrow.remove_metadata()


def _dataset(files: Sequence[tuple[str, Path]], schema: Any) -> Any:
    """Parquet files as one dataset with page checksums; the name of its log is a partition of each file."""
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.dataset as ds

    form = ds.ParquetFileFormat(
        default_fragment_scan_options=ds.ParquetFragmentScanOptions(page_checksum_verification=True)
    )
    local = pa.fs.LocalFileSystem()
    pieces = [
        form.make_fragment(*_opened(path, local), partition_expression=pc.field(RECORDING.name) == pa.scalar(name))
        for name, path in files
    ]
    return ds.FileSystemDataset(pieces, schema, form, local)


def _opened(path: Path, local: Any) -> tuple[Any, ...]:
    """A file for Arrow: its name and file system, or for a name that is not UTF-8 the open file."""
    import pyarrow as pa

    name = os.path.abspath(path) if ":" in str(path) else str(path)  # "http:x" would be taken for a URL
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return (pa.OSFile(os.fsencode(path)),)
    return name, local


def _table(folder: Path, members: Mapping[str, list[int]]) -> Any:
    """The rows of all logs: those in the file that are still valid, and those of logs that changed."""
    import pyarrow as pa
    import pyarrow.compute as pc

    states, table = _known(folder)
    kept = [name for name, state in members.items() if states.get(name) == state]
    new = [(name, folder / _TABLE / f"{_PREFIX}{name}" / "part-0.parquet") for name in members if name not in kept]
    parts = [join(new, TABLES[_TABLE].arrow).to_table()] if new else []
    if kept and table is not None:
        parts.append(table.filter(pc.is_in(table[RECORDING.name], pa.array(kept))).replace_schema_metadata(None))
    plain = [_without_dictionaries(part) for part in parts] or [TABLES[_TABLE].arrow.empty_table()]
    return pa.concat_tables(plain, promote_options="permissive")


def _without_dictionaries(table: Any) -> Any:
    import pyarrow as pa

    fields = [
        field.with_type(pa.string()) if pa.types.is_dictionary(field.type) else field
        for field in table.schema.remove_metadata()
    ]
    return table.cast(pa.schema(fields))
