"""A log as tables: one folder a table, one file a log, ready for DuckDB, Polars and pandas.

    <folder>/<table>/recording=<name of the log>/part-0.parquet
    <folder>/topics/<channel>/recording=<name of the log>/part-0.parquet     channels of others that were asked for

What has not changed since it was exported is not touched. ``recordings`` is written last: where its digest is that of
the log, so are the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from mcaptrack import __version__, log, tables
from mcaptrack.errors import McaptrackError
from mcaptrack.tables import TABLES, Format
from mcaptrack.tables.export.contents import Contents
from mcaptrack.tables.export.names import file_name, recording_name, topic_folder

__all__ = ["TOPICS", "Contents", "Exported", "default_folder", "export", "recording_name", "standing", "topic_folder"]

#: The folder of the tables of single channels.
TOPICS: Final = "topics"


@dataclass
class Exported:
    """What a folder holds of a log now: rows of each table, which of them were written, and words about them."""

    rows: dict[str, int] = field(default_factory=dict)
    written: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def default_folder(path: Path) -> Path:
    """Where the tables of a log go unless said otherwise: log.mcap -> log.tables beside it."""
    return path.with_suffix(".tables")


def standing(contents: Contents, folder: Path, name: str) -> Path | None:
    """The Parquet file of a table in a folder, if it is what exporting the table now would write."""
    path = folder.joinpath(name, f"recording={contents.recording}", "part-0.parquet")
    known = tables.described(path, "parquet") or {}
    said = (known.get("recording"), known.get("table_version"), known.get("source"))
    now = (file_name(contents.opened.path), tables.TABLE_VERSION)
    return path if said[:2] == now and said[2] == contents.source(name) else None


def export(
    opened: log.Log,
    folder: Path,
    progress: Callable[[str, int, int], None] = lambda *_: None,
    *,
    form: Format = "parquet",
    topics: Sequence[str] = (),
    blobs: bool = False,
    force: bool = False,
) -> Exported:
    """Bring the tables of a log in a folder up to date. Tables without rows are written too, with their columns.

    With ``force`` all of them are made again, and those of another log of the same name are replaced.

    ``topics`` are channels of others that get tables of their own, with fields of bytes if ``blobs``; those that have
    one already are kept up to date, and go when their channel is gone. Raises McaptrackError if a channel isn't there
    or can't be read, and if the folder holds another log's tables under the name of this one.
    """
    contents = Contents(opened)
    for topic in topics:
        opened.channel(topic)
    job = _Job(contents, folder, form, force, Exported())
    *names, last = TABLES
    known = job.known_topics()
    wanted = sorted({*topics, *(topic for topic in known if topic in opened.channels)})
    total = len(TABLES) + len(wanted)
    for count, name in enumerate(names, start=1):
        job.table(name)
        progress("export", count, total)
    for count, topic in enumerate(wanted, start=len(TABLES)):
        job.messages(topic, blobs if topic in topics else known[topic])
        progress("export", count, total)
    job.remove([topic for topic in known if topic not in wanted])
    job.table(last)
    progress("export", total, total)
    return job.done


@dataclass
class _Job:
    contents: Contents
    folder: Path
    form: Format
    force: bool
    done: Exported

    def path(self, *names: str) -> Path:
        return self.folder.joinpath(*names, f"recording={self.contents.recording}", f"part-0.{self.form}")

    def table(self, name: str) -> None:
        """Bring one of ``TABLES`` up to date."""
        words = {"lineage": self.contents.lineage(name), "source": self.contents.source(name)}
        path = self.path(name)
        if not self._stands(name, path, words["source"]):
            made = self.contents.table(name)
            note = self.contents.notes.get(name)
            self._write(name, path, made, words | ({"note": note} if note else {}), TABLES[name].order)
            self.done.notes += [f"{name}: {note}"] if note else []

    def messages(self, topic: str, blobs: bool) -> None:
        """Bring the table of a channel up to date."""
        name = f"{TOPICS}/{topic_folder(topic)}"
        path = self.path(*name.split("/"))
        words = {"topic": topic, "blobs": str(blobs).lower(), "source": self.contents.messages_source(topic, blobs)}
        known = tables.described(path, self.form) or {}
        if not self._stands(name, path, words["source"]):
            made, left_out = self.contents.messages(topic, blobs)
            words |= {"left_out": ", ".join(left_out)} if left_out else {}
            self._write(name, path, made, words, ("topic", "t_ns"))
        left = words.get("left_out") or known.get("left_out")
        self.done.notes += [f"{topic}: {left} left out, bytes; --blobs keeps them"] if left else []

    def _stands(self, name: str, path: Path, source: str) -> bool:
        """Whether a table is there already as it would be, and may stay."""
        if self.force:
            return False
        known = tables.described(path, self.form) or {}
        file = file_name(self.contents.opened.path)
        if known.get("recording", file) != file:
            raise McaptrackError(
                f"{path.parent} holds the tables of {known['recording']}, not of {file}; give another folder with -o"
            )
        if (known.get("source"), known.get("table_version")) != (source, tables.TABLE_VERSION):
            return False
        self.done.rows[name] = int(known["rows"])
        return True

    def _write(self, name: str, path: Path, made: object, words: dict[str, str], order: Sequence[str]) -> None:
        rows = made.num_rows  # type: ignore[attr-defined]  # an Arrow table, which only tables knows
        words |= {"version": __version__, "recording": file_name(self.contents.opened.path), "rows": str(rows)}
        if tables.write(path, made, words, order, self.form, self.force):
            self.done.written.append(name)
        self.done.rows[name] = rows

    def known_topics(self) -> dict[str, bool]:
        """The channels of this log that have tables of their own in the folder, and whether with bytes."""
        out = {}
        for path in self._topic_files():
            known = tables.described(path, self.form) or {}
            if known.get("recording") == file_name(self.contents.opened.path) and "topic" in known:
                out[known["topic"]] = known.get("blobs") == "true"
        return out

    def _topic_files(self) -> Iterator[Path]:
        tail = (f"recording={self.contents.recording}", f"part-0.{self.form}")
        folder = self.folder / TOPICS
        members = sorted(folder.iterdir()) if folder.is_dir() else []
        yield from (path for member in members if (path := member.joinpath(*tail)).is_file())

    def remove(self, topics: Sequence[str]) -> None:
        """Tables of channels that are gone go too, with the folders that are empty then."""
        for topic in topics:
            path = self.path(TOPICS, topic_folder(topic))
            path.unlink(missing_ok=True)
            with suppress(OSError):
                path.parent.rmdir()
                path.parent.parent.rmdir()
            self.done.removed.append(f"{TOPICS}/{topic_folder(topic)}")
