"""A log as tables: a folder for each table, a file for each log, ready for DuckDB, Polars and pandas.

    <folder>/<table>/recording=<name of the log>/part-0.parquet
    <folder>/topics/<channel>/recording=<name of the log>/part-0.parquet     foreign channels, on request

Files that have not changed since the last export are not touched. ``recordings`` is written last: if its digest is that
of the log, all tables are up to date.
"""

from __future__ import annotations

import glob
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from mcaptrack import __version__, log, tables
from mcaptrack.files import sweep
from mcaptrack.location import Location, local_name
from mcaptrack.sources.fixed_frame import BoxesRead
from mcaptrack.tables import TABLES, Format
from mcaptrack.tables.export.contents import LogTables, file_name, recording_key, recording_name, topic_folder
from mcaptrack.tables.export.ownership import claimed, owner_words, refuse_tables_of_another

#: The folder of the tables of single channels.
TOPICS: Final = "topics"


@dataclass
class Exported:
    """The tables of a log in a folder: rows of each, which were written and removed, and notes for people."""

    rows: dict[str, int] = field(default_factory=dict)
    written: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def default_folder(path: Location) -> Path:
    """The default folder for the tables of a log: log.mcap -> log.tables beside it."""
    return local_name(path, ".tables")


def main_file(path: Location, folder: Path, form: Format = "parquet") -> Path:
    """The file of a log that is written last: if it exists, all tables of the log do."""
    return folder / "recordings" / f"recording={recording_name(path)}" / f"part-0.{form}"


def current_file(contents: LogTables, folder: Path, name: str) -> Path | None:
    """The Parquet file of a table in a folder, if it is up to date."""
    path = folder.joinpath(name, f"recording={contents.recording}", "part-0.parquet")
    metadata = tables.file_metadata(path, "parquet") or {}
    stored = (metadata.get("recording"), metadata.get("table_version"), metadata.get("source"))
    now = (file_name(contents.opened.path), tables.TABLE_VERSION)
    return path if stored[:2] == now and stored[2] == contents.source(name) else None


def export(
    opened: log.Log,
    folder: Path,
    progress: Callable[[str, int, int], None] = lambda *_: None,
    *,
    form: Format = "parquet",
    topics: Sequence[str] = (),
    blobs: bool = False,
    force: bool = False,
    boxes: BoxesRead | None = None,
) -> Exported:
    """Update the tables of a log in a folder. Tables without rows are written, too, with their columns.

    Parameters
    ----------
    opened : Log
    folder : Path
    progress : callable
        Called with a text, the number of finished tables and their total.
    form : {"parquet", "arrow", "csv", "jsonl"}
    topics : sequence of str
        Foreign channels that get tables of their own. Existing ones are updated, and removed if their channel is gone.
    blobs : bool
        Whether these tables have fields of bytes.
    force : bool
        Write all tables again, and replace those of another log with the same name.
    boxes : BoxesRead, optional
        Boxes of other software that were read before.

    Returns
    -------
    Exported

    Raises
    ------
    McaptrackError
        If a channel does not exist or can't be read, and if the folder holds tables of another log with the same name.
    """
    contents = LogTables(opened, boxes)
    for topic in topics:
        opened.channel(topic)
    job = _Job(contents, folder, form, force, Exported())
    if not force:
        refuse_tables_of_another(opened, opened.path, folder)
    with claimed(folder, contents.recording):
        if not force:  # once more, because another process may have written them meanwhile
            refuse_tables_of_another(opened, opened.path, folder)
        job.tidy()
        _write_all(job, topics, blobs, progress)
    return job.done


def _write_all(job: _Job, topics: Sequence[str], blobs: bool, progress: Callable[[str, int, int], None]) -> None:
    opened = job.contents.opened
    *names, last = TABLES
    topics_before = job.known_topics()
    wanted = sorted({*topics, *(topic for topic in topics_before if topic in opened.channels)})
    total = len(TABLES) + len(wanted)
    for count, name in enumerate(names, start=1):
        job.table(name)
        progress("export", count, total)
    for count, topic in enumerate(wanted, start=len(TABLES)):
        job.messages(topic, blobs if topic in topics else topics_before[topic])
        progress("export", count, total)
    job.remove([topic for topic in topics_before if topic not in wanted])
    job.table(last)
    progress("export", total, total)


@dataclass
class _Job:
    contents: LogTables
    folder: Path
    form: Format
    force: bool
    done: Exported

    def path(self, *names: str) -> Path:
        return self.folder.joinpath(*names, f"recording={self.contents.recording}", f"part-0.{self.form}")

    def table(self, name: str) -> None:
        """Update one of ``TABLES``."""
        metadata = {"lineage": self.contents.lineage(name), "source": self.contents.source(name)}
        metadata |= owner_words(self.contents.opened, self.folder) if name == "recordings" else {}
        path = self.path(name)
        if not self._stands(name, path, metadata["source"]):
            pieces = self.contents.pieces(name)
            note = self.contents.notes.get(name)
            self._write(name, path, pieces, metadata | ({"note": note} if note else {}), TABLES[name].order)
            self.done.notes += [f"{name}: {note}"] if note else []

    def messages(self, topic: str, blobs: bool) -> None:
        """Update the table of a channel."""
        name = f"{TOPICS}/{topic_folder(topic)}"
        path = self.path(*name.split("/"))
        metadata = {"topic": topic, "blobs": str(blobs).lower(), "source": self.contents.messages_source(topic, blobs)}
        metadata_before = tables.file_metadata(path, self.form) or {}
        if not self._stands(name, path, metadata["source"]):
            pieces, left_out = self.contents.message_pieces(topic, blobs)
            metadata |= {"left_out": ", ".join(left_out)} if left_out else {}
            self._write(name, path, pieces, metadata, ("topic", "t_ns"))
        left = metadata.get("left_out") or metadata_before.get("left_out")
        self.done.notes += [f"{topic}: {left} left out, bytes; `blobs=True` keeps them"] if left else []

    def _stands(self, name: str, path: Path, source: str) -> bool:
        """Whether a table is up to date and may stay."""
        if self.force:
            return False
        metadata = tables.file_metadata(path, self.form) or {}
        if (metadata.get("source"), metadata.get("table_version")) != (source, tables.TABLE_VERSION):
            return False
        self.done.rows[name] = int(metadata["rows"])
        return True

    def _write(self, name: str, path: Path, pieces: object, metadata: dict[str, str], order: Sequence[str]) -> None:
        rows = pieces.num_rows  # type: ignore[attr-defined]  # a table, which only tables knows
        metadata |= {"version": __version__, "recording": file_name(self.contents.opened.path), "rows": str(rows)}
        if tables.write(path, pieces, metadata, order, self.form, self.force):
            self.done.written.append(name)
        self.done.rows[name] = rows

    def known_topics(self) -> dict[str, bool]:
        """The channels of this log with tables of their own in the folder, and whether these have bytes."""
        out = {}
        for path in self._topic_files():
            metadata = tables.file_metadata(path, self.form) or {}
            if metadata.get("recording") == file_name(self.contents.opened.path) and "topic" in metadata:
                out[metadata["topic"]] = metadata.get("blobs") == "true"
        return out

    def _topic_files(self) -> Iterator[Path]:
        tail = (f"recording={self.contents.recording}", f"part-0.{self.form}")
        folder = self.folder / TOPICS
        members = sorted(folder.iterdir()) if folder.is_dir() else []
        yield from (path for member in members if (path := member.joinpath(*tail)).is_file())

    def tidy(self) -> None:
        """Remove what processes that were killed have left: temporary files, and folders of channels without a file."""
        sweep(self.folder)
        member = f"recording={self.contents.recording}"
        for path in (*self.folder.glob(f"*/{glob.escape(member)}"), *self._topic_folders()):
            sweep(path)
        for path in self._topic_folders():
            with suppress(OSError):
                path.rmdir()
                path.parent.rmdir()

    def _topic_folders(self) -> list[Path]:
        return sorted((self.folder / TOPICS).glob(f"*/{glob.escape(f'recording={self.contents.recording}')}"))

    def remove(self, topics: Sequence[str]) -> None:
        """Remove tables of channels that are gone, and folders that are empty then."""
        for topic in topics:
            path = self.path(TOPICS, topic_folder(topic))
            path.unlink(missing_ok=True)
            with suppress(OSError):
                path.parent.rmdir()
                path.parent.parent.rmdir()
            self.done.removed.append(f"{TOPICS}/{topic_folder(topic)}")
