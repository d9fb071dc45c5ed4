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


def join(parts: Sequence[tuple[str, Any]], columns: Any = None, of_many: Sequence[Any] = ()) -> Any:
    """Join tables by the name of their log, each an Arrow table or the path of a Parquet file; adds ``recording``.

    ``columns`` is an Arrow schema with the first columns of the result. Columns that a part does not have are null.
    ``of_many`` are datasets of many logs, which have the column ``recording``; one alone is read only as far as needed.
    The result is an Arrow table, or a dataset if files are among the parts. Raises McaptrackError if a file can't be
    read or if a column has two types.
    """
    import pyarrow as pa
    import pyarrow.dataset as ds

    if len(of_many) == 1 and not parts:
        return _completed(of_many[0], columns)
    loose = [with_recording(part, name) for name, part in parts if not isinstance(part, Path)]
    loose += [
        _with_dictionaries(dataset.to_table(), [columns, *(table.schema for table in loose)]) for dataset in of_many
    ]
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


def _with_dictionaries(table: Any, schemas: Sequence[Any]) -> Any:
    """A table with text as dictionaries where other tables have it so."""
    import pyarrow as pa

    named = {field.name for schema in schemas for field in schema or () if pa.types.is_dictionary(field.type)}
    for at, field in enumerate(table.schema):
        if field.name in (named | {RECORDING.name}) and pa.types.is_string(field.type):
            table = table.set_column(at, field.name, table.column(at).dictionary_encode())
    return table


def _completed(dataset: Any, columns: Any) -> Any:
    """A dataset with all columns; those that it does not have are null."""
    import pyarrow as pa

    missing = [field for field in columns or () if field.name not in dataset.schema.names]
    fields = [field.with_nullable(True).remove_metadata() for field in (*dataset.schema, *missing)]
    return dataset.replace_schema(pa.schema(fields))


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
