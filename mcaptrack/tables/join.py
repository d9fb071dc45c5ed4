"""The same table of several logs as one table, in memory or in files, which are read only as far as needed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.tables.build import with_recording
from mcaptrack.tables.fields import RECORDING

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
        known = [columns] if columns is not None else []
        schema = pa.unify_schemas(
            [*known, *(table.schema.remove_metadata() for table in loose), *(_columns(path) for _, path in files)],
            promote_options="permissive",
        )
        at = schema.get_field_index(RECORDING.name)
        schema = (schema if at < 0 else schema.remove(at)).append(RECORDING.arrow)
        schema = pa.schema([field.with_nullable(True).remove_metadata() for field in schema])
        table = pa.concat_tables([_filled(table, schema) for table in loose]) if loose else schema.empty_table()
    except (pa.ArrowException, TypeError) as error:
        raise McaptrackError(f"{_COLUMNS}: {str(error).splitlines()[0]}") from None
    if not files:
        return table
    read = _dataset(files, schema)
    return ds.UnionDataset(schema, [read, ds.dataset(table)]) if loose else read


def _columns(path: Path) -> Any:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with path.open("rb") as stream:  # a name with a colon would be taken for a URL
            return pq.read_schema(stream).remove_metadata()
    except (OSError, pa.ArrowException) as error:
        raise McaptrackError(f"{path} can't be read as Parquet: {str(error).splitlines()[0]}") from None


def _filled(table: Any, schema: Any) -> Any:
    """A table with all columns, in order; missing ones are null."""
    import pyarrow as pa

    columns = [
        table.column(field.name).cast(field.type)
        if field.name in table.schema.names
        else pa.nulls(table.num_rows, field.type)
        for field in schema
    ]
    return pa.table(columns, schema=schema)


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
