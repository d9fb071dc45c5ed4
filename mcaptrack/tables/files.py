"""Tables as files, published when they are complete and were read back.

Parquet: floats are split by byte and whole numbers stored as differences, which makes files smaller and writing faster
than the defaults; pages have checksums and an index. The metadata hold ``source``, which identifies the input, and
``digest``, that of the pages or of the content; a file that would not change is not touched.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import IO, Any, Final, get_args

import numpy as np

from mcaptrack.choices import TableFormat
from mcaptrack.environment import release_memory
from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish, unreadable
from mcaptrack.tables.build import PIECE_ROWS, pieces_of
from mcaptrack.tables.fields import table_version

FORMATS: Final[tuple[TableFormat, ...]] = get_args(TableFormat)
_ZSTD_LEVEL: Final = 1  # higher levels hardly make floats that are split by byte smaller
#: The values of so many rows of each file are compared when it was written; of fewer if they are larger.
_ROWS_COMPARED: Final = 1024
_BYTES_READ: Final = 4 * 2**20
#: Smaller files leave so little memory behind that looking for it takes longer than they did.
_BYTES_WORTH_RELEASING: Final = 64 * 1024
_PREFIX: Final = "mcaptrack."


@contextmanager
def opened_parquet(path: Path) -> Iterator[Any]:
    """Open a Parquet file as one of pyarrow. Raises McaptrackError if it can't be read, also later in the block."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with path.open("rb") as stream:  # a name would be taken for a URL, and those of its folders for columns
            yield pq.ParquetFile(stream)
    except (OSError, pa.ArrowException) as error:
        if getattr(error, "errno", None):
            raise unreadable(path, error) from None
        raise McaptrackError(f"{path} can't be read as Parquet: {str(error).partition(chr(10))[0]}") from None


def write(
    path: Path,
    table: Any,
    provenance: Mapping[str, str],
    order: Sequence[str] = (),
    form: TableFormat = "parquet",
    force: bool = False,
) -> bool:
    """Write a table; the file appears when it is complete and was read back. Returns whether it was written.

    ``table`` is an Arrow table or ``TablePieces``; these are written piece by piece. ``provenance`` goes into the
    metadata, ``order`` names the columns by which rows are sorted. A file with the same content and metadata is left as
    it is, unless ``force``. Raises McaptrackError if the file can't be written.

    ``form`` is the format.
    """
    if form == "parquet":
        file = ParquetTable(path, table.schema, provenance, order, force)
        with file.published():
            for piece in pieces_of(table):
                file.add(piece)
                del piece  # else it would stay while the next one is made
        return file.is_new
    metadata = _stated(provenance)
    if form == "arrow":
        metadata["digest"], _ = digest(table.schema, pieces_of(table))
        if not force and _without_source(file_metadata(path, form) or {}) == _without_source(metadata):
            return False
    with _publishing(path) as part:
        if form == "arrow":
            _write_arrow(part, table, metadata)
            if verify(part, form) != table.num_rows:
                raise _Different
        else:
            from mcaptrack.tables import text

            text.write(part, pieces_of(table), form)
    return True


class _Different(Exception):
    """A file does not hold what was written to it."""


class _Unchanged(Exception):
    """The file at its place has the same content already."""


def _stated(provenance: Mapping[str, str]) -> dict[str, str]:
    return {"table_version": table_version()} | dict(provenance)


@contextmanager
def _publishing(path: Path) -> Iterator[Path]:
    """A path to write a file to, which is published then. Raises McaptrackError if it can't be written."""
    is_large = False
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with publish(path) as part:
            yield part
            is_large = part.stat().st_size >= _BYTES_WORTH_RELEASING
    except _Unchanged:
        pass
    except _Different:
        raise McaptrackError(
            f"{path} can't be written: what was written does not read back the same; the disk or the memory of this "
            "machine may be at fault"
        ) from None
    except OSError as error:
        raise McaptrackError(f"{path} can't be written: {error.strerror or error}") from error
    if is_large:  # memory that is not used goes back to the system
        import pyarrow as pa

        pa.default_memory_pool().release_unused()
        release_memory()


class _Stream(io.BufferedWriter):
    """A new file, and the digest of what was written to it so far."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path, "xb"))
        self.content = hashlib.sha256()

    def write(self, data: Any) -> int:
        """Write bytes."""
        self.content.update(data)
        return super().write(data)


class ParquetTable:
    """A Parquet file that is written piece by piece, and published when it is complete; arguments are as of ``write``.

    What was written is read back: all pages by their digest, and the values of the first rows.
    """

    def __init__(
        self, path: Path, schema: Any, provenance: Mapping[str, str], order: Sequence[str] = (), force: bool = False
    ) -> None:
        self.path, self.is_new = path, False
        self._schema, self._order, self._force = schema, order, force
        self._metadata = _stated(provenance)
        self._rows, self._first = 0, schema.empty_table()
        self._writer: Any = None

    @contextmanager
    def published(self) -> Iterator[None]:
        """Publish the file when the block ends, unless there is one of the same content, or the block fails."""
        with _publishing(self.path) as part:
            with _Stream(part) as stream:
                self._open(stream)
                try:
                    yield
                    self._metadata["digest"] = stream.content.hexdigest()
                    self._writer.add_key_value_metadata({_PREFIX + "digest": self._metadata["digest"]})
                    self._writer.close()
                except BaseException:
                    # Closing it, also when it is deleted, would make half a table look complete.
                    self._writer.is_open = False
                    raise
            old = file_metadata(self.path, "parquet") or {}
            if not self._force and _without_source(old) == _without_source(self._metadata):
                raise _Unchanged
            if not self._is_in(part):
                raise _Different
            self.is_new = True

    def _open(self, stream: Any) -> None:
        import pyarrow.parquet as pq

        ways = [(name, "ascending") for name in self._order]
        self._writer = pq.ParquetWriter(
            stream,
            self._schema.with_metadata({_PREFIX + key: value for key, value in self._metadata.items()}),
            compression="zstd",
            compression_level=_ZSTD_LEVEL,
            sorting_columns=pq.SortingColumn.from_ordering(self._schema, ways) if ways else None,
            write_page_index=True,
            write_page_checksum=True,
            store_schema=True,
            **_encodings(self._schema),
        )

    def add(self, piece: Any) -> None:
        """Write the next rows, an Arrow table, as a row group."""
        if not self._rows:
            self._first = piece.slice(
                0, max(1, min(_ROWS_COMPARED, piece.num_rows * _BYTES_READ // max(piece.nbytes, 1)))
            )
        self._writer.write_table(piece, row_group_size=PIECE_ROWS)
        self._rows += piece.num_rows

    def _is_in(self, part: Path) -> bool:
        """Whether a file holds what was written, as far as that is compared."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            with part.open("rb") as stream, pq.ParquetFile(stream, page_checksum_verification=True) as file:
                if _pages_digest(stream, file.metadata) != self._metadata["digest"]:
                    return False
                count = self._first.num_rows
                batches = file.iter_batches(count, [0], use_threads=False) if count else iter(())
                rows = pa.Table.from_batches([*islice(batches, 1)], file.schema_arrow)
                is_same = digest(self._schema, [rows]) == digest(self._schema, [self._first])
                return is_same and bool(file.metadata.num_rows == self._rows)
        except pa.ArrowException:
            return False


def _pages_digest(stream: IO[bytes], about: Any) -> str:
    """The digest of a Parquet file up to the end of its last page; ``about`` are its metadata."""
    end = 4
    if about.num_row_groups:
        group = about.row_group(about.num_row_groups - 1)
        for column in map(group.column, range(group.num_columns)):
            begin = column.dictionary_page_offset or column.data_page_offset
            end = max(end, begin + column.total_compressed_size)
    content = hashlib.sha256()
    stream.seek(0)
    while block := stream.read(min(_BYTES_READ, end - stream.tell())):
        content.update(block)
    return content.hexdigest()


def _without_source(metadata: Mapping[str, str]) -> dict[str, str]:
    """Metadata of a content: its source may change while it does not."""
    return {name: text for name, text in metadata.items() if name != "source"}


def _encodings(schema: Any) -> dict[str, Any]:
    """The encoding of each column: text by dictionary, floats split by byte, whole numbers as differences."""
    import pyarrow as pa

    encodings, dictionaries = {}, []
    for name, kind in (leaf for field in schema for leaf in _leaves(field.name, field.type)):
        if pa.types.is_floating(kind):
            encodings[name] = "BYTE_STREAM_SPLIT"
        elif (pa.types.is_integer(kind) and kind.bit_width >= 32) or pa.types.is_timestamp(kind):
            encodings[name] = "DELTA_BINARY_PACKED"
        elif pa.types.is_string(kind) or pa.types.is_dictionary(kind):
            dictionaries.append(name)
    return {"use_dictionary": dictionaries, "column_encoding": encodings}


def _leaves(name: str, kind: Any) -> Iterator[tuple[str, Any]]:
    """The columns of a Parquet file that hold a column, also those in lists and structs, and their types."""
    import pyarrow as pa

    if pa.types.is_list(kind):
        yield from _leaves(f"{name}.list.element", kind.value_type)
    elif pa.types.is_struct(kind):
        for field in kind:
            yield from _leaves(f"{name}.{field.name}", field.type)
    else:
        yield name, kind


def _write_arrow(part: Path, table: Any, texts: Mapping[str, str]) -> None:
    import pyarrow as pa

    schema = table.schema.with_metadata({_PREFIX + key: value for key, value in texts.items()})
    options = pa.ipc.IpcWriteOptions(compression="zstd", unify_dictionaries=True)
    with part.open("xb") as stream, pa.ipc.new_file(stream, schema, options=options) as writer:
        for piece in pieces_of(table):
            writer.write_table(piece.combine_chunks())


def file_metadata(path: Path, form: TableFormat) -> dict[str, str] | None:
    """The metadata of a file, read from its end; None if there is no such file.

    ``form`` is its format.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        if form not in ("parquet", "arrow"):
            return None
        with path.open("rb") as stream:  # Arrow opens no file with a name that is not UTF-8
            file_metadata = pq.read_metadata(stream) if form == "parquet" else pa.ipc.open_file(stream).schema
            raw = file_metadata.metadata or {}
    except (OSError, pa.ArrowException):
        return None
    pairs = ((key.decode("utf-8", "replace"), value.decode("utf-8", "replace")) for key, value in raw.items())
    return {key.removeprefix(_PREFIX): value for key, value in pairs if key.startswith(_PREFIX)}


def verify(path: Path, form: TableFormat = "parquet") -> int:
    """Read a whole file and compare its content with the digest in its metadata; returns the number of rows.

    Raises McaptrackError if it can't be read, has no digest or holds something else.

    ``form`` is its format.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    stored = (file_metadata(path, form) or {}).get("digest")
    if stored is None:
        raise McaptrackError(f"{path} is no exported table: it has no digest")
    try:
        with path.open("rb") as stream:
            if form == "parquet":
                about = pq.read_metadata(stream)
                rows, content = about.num_rows, _pages_digest(stream, about)
            else:
                reader = pa.ipc.open_file(stream)
                batches = (reader.get_batch(number) for number in range(reader.num_record_batches))
                content, rows = digest(reader.schema, (pa.Table.from_batches([batch]) for batch in batches))
    except (OSError, pa.ArrowException) as error:
        raise McaptrackError(f"{path} can't be read back: {str(error).splitlines()[0]}") from None
    if content != stored:
        raise McaptrackError(f"{path} does not hold what was written to it; export it again")
    return int(rows)


def digest(schema: Any, pieces: Iterable[Any]) -> tuple[str, int]:
    """SHA-256 of the content of a table (names, types and values, independent of pieces), and its number of rows."""
    columns, rows = [_ColumnDigest() for _ in schema], 0
    for piece in pieces:
        for column, values in zip(columns, piece.columns, strict=True):
            for chunk in values.chunks:
                if len(chunk):  # lists of nothing are as no lists
                    column.add(chunk)
        rows += piece.num_rows
    total = hashlib.sha256(rows.to_bytes(8, "little"))
    for field, column in zip(schema, columns, strict=True):
        total.update(f"{field.name}\0{_kind(field.type)}\0{column.digest()}\0".encode())
    return total.hexdigest(), rows


def _kind(kind: Any) -> str:
    """The name of a type, independent of the name that Parquet and Arrow give to members of lists."""
    import pyarrow as pa

    if pa.types.is_struct(kind):
        return f"struct<{', '.join(f'{field.name}: {_kind(field.type)}' for field in kind)}>"
    return f"list<{_kind(kind.value_type)}>" if pa.types.is_list(kind) else str(kind)


class _ColumnDigest:
    """The digest of a column: bits of numbers, bytes of text, and which rows are null."""

    def __init__(self) -> None:
        self._values, self._missing, self._lengths = hashlib.sha256(), hashlib.sha256(), hashlib.sha256()
        self._rows = 0
        self._within: list[_ColumnDigest] = []

    def add(self, array: Any) -> None:
        """Add values, an Arrow array."""
        import pyarrow as pa
        import pyarrow.compute as pc

        if array.null_count:
            at = np.flatnonzero(array.is_null().to_numpy(zero_copy_only=False)) + self._rows
            self._missing.update(at.astype("<i8").tobytes())
        self._rows += len(array)
        kind = array.type
        if pa.types.is_dictionary(kind):
            self._add_dictionary(array)
        elif pa.types.is_string(kind) or pa.types.is_binary(kind) or pa.types.is_large_string(kind):
            filled = array.fill_null("" if not pa.types.is_binary(kind) else b"")
            self._lengths.update(pc.binary_length(filled).to_numpy().astype("<i8").tobytes())
            self._values.update(_bytes(filled.cast(pa.large_binary())))
        elif pa.types.is_list(kind):
            self._lengths.update(pc.list_value_length(array).fill_null(0).to_numpy().astype("<i8").tobytes())
            self._add_within([array.flatten()])
        elif pa.types.is_struct(kind):
            self._add_within(array.flatten())
        elif pa.types.is_null(kind):
            pass
        else:
            filled = array.fill_null(False if pa.types.is_boolean(kind) else 0) if array.null_count else array
            numbers = filled.cast(pa.int64()) if pa.types.is_timestamp(kind) else filled
            self._values.update(np.ascontiguousarray(numbers.to_numpy(zero_copy_only=False)).view(np.uint8).data)

    def _add_within(self, arrays: Sequence[Any]) -> None:
        self._within = self._within or [_ColumnDigest() for _ in arrays]
        for column, array in zip(self._within, arrays, strict=True):
            column.add(array)

    def _add_dictionary(self, array: Any) -> None:
        names = array.dictionary.to_pylist()
        short = [hashlib.sha256(str(name).encode("utf-8", "surrogatepass")).digest()[:8] for name in names]
        hashes = np.frombuffer(b"".join([*short, bytes(8)]), "<u8")
        at = array.indices.fill_null(len(names)).to_numpy()
        self._values.update(hashes[at].tobytes())

    def digest(self) -> str:
        """The digest of all added values."""
        parts = [self._values.hexdigest(), self._missing.hexdigest(), self._lengths.hexdigest()]
        return " ".join([*parts, *([column.digest() for column in self._within] or [""])])


def _bytes(array: Any) -> Any:
    """The bytes of all values of an array of large_binary, one behind the other."""
    _, ends, data = array.buffers()
    if data is None:
        return b""
    first, last = np.frombuffer(ends, np.int64)[[array.offset, array.offset + len(array)]].tolist()
    return memoryview(data)[first:last]
