"""The tables of a log in a folder, as ``export`` wrote them, and their rows as Delta has them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location
from mcaptrack.tables.delta import columns
from mcaptrack.tables.delta.opening import CATALOGUE
from mcaptrack.tables.export import TOPICS, recording_name
from mcaptrack.tables.fields import TABLES
from mcaptrack.tables.files import file_metadata

#: Rows that are read at once.
_ROWS: Final = 64 * 1024


@dataclass(frozen=True)
class ExportedLog:
    """A log, and the folder with its tables in Parquet as ``export`` wrote them."""

    log: Location
    folder: Path

    @property
    def recording(self) -> str:
        """The name of the log in tables."""
        return recording_name(self.log)

    def file(self, name: str) -> Path:
        """The file of a table."""
        return self.folder.joinpath(*name.split("/"), f"recording={self.recording}", "part-0.parquet")

    @cached_property
    def topics(self) -> tuple[str, ...]:
        """The tables of channels of other software."""
        folder = self.folder / TOPICS
        found = sorted(folder.iterdir()) if folder.is_dir() else []
        return tuple(name for one in found if self.file(name := f"{TOPICS}/{one.name}").is_file())

    def digest(self, name: str) -> str:
        """The digest of a table. Raises McaptrackError if the file is missing or no table."""
        known = file_metadata(self.file(name), "parquet") or {}
        if "digest" not in known:
            raise McaptrackError(f"{self.file(name)} is no exported table: it is missing, or can't be read")
        return known["digest"][:16] if known.get("rows") != "0" else ""

    @cached_property
    def digests(self) -> dict[str, str]:
        """The digests of all tables; "" for those without rows."""
        return {name: self.digest(name) for name in (*TABLES, *self.topics)}

    @cached_property
    def row(self) -> dict[str, Any]:
        """The row of the log in ``recordings``."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            with self.file(CATALOGUE).open("rb") as stream:
                return dict(pq.read_table(stream).to_pylist()[0])
        except (OSError, IndexError, pa.ArrowException) as error:
            raise McaptrackError(f"{self.file(CATALOGUE)} can't be read: {error}") from None

    def is_as(self, known: Mapping[str, str]) -> bool:
        """Whether tables with these digests are those of the log; reads one file only, if channels have no tables."""
        if self.topics or any(name not in TABLES for name in known):
            return self.digests == known
        return bool(known) and self.digest(CATALOGUE) == known.get(CATALOGUE)


def schema_of(one: ExportedLog, name: str) -> Any:
    """The columns of a table of a log. Raises McaptrackError if the file can't be read."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = one.file(name)
    try:
        with path.open("rb") as stream:
            return pq.read_schema(stream)
    except (OSError, pa.ArrowException) as error:
        raise McaptrackError(f"{path} can't be read as Parquet: {str(error).splitlines()[0]}") from None


def rows_of(name: str, logs: Sequence[ExportedLog], own: Mapping[str, Any], schema: Any) -> Iterator[Any]:
    """The rows of a table of logs, log after log, in batches."""
    import pyarrow.parquet as pq

    for one in logs:
        with one.file(name).open("rb") as stream, pq.ParquetFile(stream, page_checksum_verification=True) as file:
            for batch in file.iter_batches(_ROWS):
                yield columns.converted(batch, one.recording, own[one.recording], schema)
