"""A log as tables: a folder for each table, a file for each log, ready for DuckDB, Polars and pandas.

    <folder>/<table>/recording=<name of the log>/part-0.parquet
    <folder>/topics/<channel>/recording=<name of the log>/part-0.parquet     foreign channels, on request
    <folder>/manifest/recording=<name of the log>/part-0.json                what these channels are

Files that have not changed since the last export are not touched. ``recordings`` is written last: if its digest is that
of the log, all tables are up to date.
"""

from __future__ import annotations

import csv
import fcntl
import glob
import json
import os
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcaptrack import __version__, environment, log, tables
from mcaptrack.choices import TableFormat
from mcaptrack.errors import McaptrackError, call
from mcaptrack.files import make_folder, place_of, publish_bytes, sweep, writing
from mcaptrack.location import Location, Url, is_remote, local_name, parse
from mcaptrack.log.messages import Payloads, Span
from mcaptrack.notices import Progress
from mcaptrack.schema.provenance import INGEST, Provenance
from mcaptrack.sources import foreign
from mcaptrack.sources.fixed_frame import BoxesRead
from mcaptrack.tables import TABLES, ParquetTable, TypedMessages
from mcaptrack.tables.build import PendingRows
from mcaptrack.tables.export.contents import (
    WHOLE,
    LogTables,
    MessagesPart,
    file_name,
    location_of,
    recording_key,
    recording_name,
    topic_folder,
)
from mcaptrack.tables.files import FORMATS
from mcaptrack.tables.messages import PIECE_BYTES

#: The folder of the tables of single channels.
TOPICS: Final = "topics"
#: The folder of what these tables are.
MANIFEST: Final = "manifest"
#: Tables that have a file also without rows, because most queries name one of them.
ALWAYS: Final = frozenset(
    (
        "frames",
        "detections",
        "tracks",
        "predictions",
        "events",
        "zone_crossings",
        "track_summary",
        "metrics",
        "channels",
        "warnings",
    )
)


@dataclass
class Exported:
    """The tables of a log in a folder: rows of each, those that have no file because they have no rows, which were
    written and removed, and notes for people.
    """

    rows: dict[str, int] = field(default_factory=dict)
    spare: list[str] = field(default_factory=list)
    written: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def default_folder(path: Location) -> Path:
    """The default folder for the tables of a log: log.mcap -> log.tables beside it."""
    return local_name(path, ".tables")


def main_file(path: Location, folder: Path, form: TableFormat = "parquet") -> Path:
    """The file of a log that is written last: if it exists, all tables of the log do."""
    return folder / "recordings" / f"recording={recording_name(path)}" / f"part-0.{form}"


def current_file(contents: LogTables, folder: Path, name: str) -> Path | None:
    """The Parquet file of a table in a folder, if it is up to date."""
    path = folder.joinpath(name, f"recording={contents.recording}", "part-0.parquet")
    metadata = tables.file_metadata(path, "parquet") or {}
    stored = (metadata.get("recording"), metadata.get("table_version"), metadata.get("source"))
    now = (file_name(contents.opened.path), tables.table_version())
    return path if stored[:2] == now and stored[2] == contents.source(name) else None


# Which log the tables in a folder are of, so that those of another log are never replaced unasked.
#
# The table ``recordings`` says it: the place of its log, and digests of what was recorded, which stay the same
# whatever stages add to the log and wherever it is moved.


#: The table that says which log the tables are of.
_TABLE: Final = "recordings"
_PREFIX: Final = "recording="
#: Digests of so many recorded channels are kept: channels with pictures first, then by their number of messages.
_MOST_CHANNELS: Final = 16


class _Owner(NamedTuple):
    """The log that tables are of: the name of its file, its place (also as seen from the folder), what was recorded."""

    file: str
    location: str
    below: str
    recorded: Mapping[str, str]


def owner_words(opened: log.Log, folder: Path) -> dict[str, str]:
    """The metadata of ``recordings`` that say which log the tables in a folder are of."""
    return {
        "location": location_of(opened.path),
        "log_from_here": _seen_from(folder, opened.path),
        "recorded": json.dumps(_recorded(opened), sort_keys=False, separators=(",", ":")),
    }


def refuse_tables_of_another(opened: log.Log, path: Location, folder: Path) -> None:
    """Raise McaptrackError if a folder has tables of another log than ``opened``, which is or will be at ``path``."""
    name = recording_name(path)
    try:
        recordings = [entry.removeprefix(_PREFIX) for entry in os.listdir(folder / _TABLE) if entry.startswith(_PREFIX)]
    except OSError:
        return
    for taken in sorted(recordings):
        if recording_key(taken) != recording_key(name):
            continue
        for form in FORMATS:
            file = folder / _TABLE / f"{_PREFIX}{taken}" / f"part-0.{form}"
            owner = _owner(file, form) if file.is_file() else None
            if owner is None or (taken == name and _is_of(owner, opened, path, folder)):
                continue
            kept = owner.location or owner.file or "another log"
            why = (
                "" if owner.recorded else f"; {form} doesn't say what was recorded, by which a log that moved is known"
            )
            same = f"both are {name}" if taken == name else f"{taken} and {name} are one name on some file systems"
            raise McaptrackError(
                f"{folder} holds the tables of {kept}, not of {path}: {same}{why}. Give another folder with `output=`, "
                "or `force=True` to replace them"
            )


@contextmanager
def claimed(folder: Path, name: str) -> Iterator[None]:
    """Let no other process write tables of this recording in a folder: one that tries waits."""
    place = folder / _TABLE / f"{_PREFIX}{name}"
    make_folder(place)
    with writing(place):
        handle = os.open(place, os.O_RDONLY)
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _is_of(owner: _Owner, opened: log.Log, path: Location, folder: Path) -> bool:
    """Whether tables are of this log.

    They are of the log at their place, whatever it holds now. Elsewhere it has to hold what was recorded, and to have
    moved: if there still is a log at the place of the tables', this is a copy, which may have other results.
    """
    if owner.location == location_of(path):
        return True
    own = None if is_remote(path) else local_name(path, ".tables")
    if own is not None and place_of(folder) == place_of(own) and owner.file == file_name(path):
        return True  # the folder beside the log, copied along with it
    if not _is_same(owner.recorded, _recorded(opened)):
        return False
    if owner.below and owner.below == _seen_from(folder, path):
        return True
    before = parse(owner.location) if owner.location else None
    return isinstance(before, Path) and not before.exists()


def _is_same(before: Mapping[str, str], now: Mapping[str, str]) -> bool:
    """Whether two logs are of the same recording, by the first channel (in the order of ``before``) that both have."""
    topic = next((topic for topic in before if topic in now), None)
    return topic is not None and before[topic] == now[topic]


def _recorded(opened: log.Log) -> dict[str, str]:
    """Digests of what was recorded, by topic."""
    channels = []
    for channel in opened.channels.values():
        how = Provenance.from_metadata(channel.metadata)
        if channel.messages and (how is None or (how.transform == INGEST and not how.written_by)):
            channels.append((not foreign.holds_pictures(channel), -channel.messages, channel.topic, how))
    channels.sort(key=lambda row: row[:3])
    return {
        topic: ((how.digest if how else "") or opened.fingerprint(topic))[:32]
        for _, _, topic, how in channels[:_MOST_CHANNELS]
    }


def _seen_from(folder: Path, path: Location) -> str:
    """The path of a log as seen from a folder; "" for an object."""
    place = place_of(path)
    if isinstance(place, Url):
        return ""
    return os.fsencode(os.path.relpath(place, place_of(folder))).decode("utf-8", "backslashreplace")


def _owner(file: Path, form: TableFormat) -> _Owner | None:
    """The log that ``recordings`` names; None if it names none."""
    about = tables.file_metadata(file, form)
    if about:
        recorded = json.loads(about.get("recorded", "{}"))
        return _Owner(about.get("recording", ""), about.get("location", ""), about.get("log_from_here", ""), recorded)
    row = _first_row(file, form)
    return _Owner(str(row.get("file", "")), str(row.get("location", "")), "", {}) if row else None


def _first_row(file: Path, form: TableFormat) -> Mapping[str, Any]:
    try:
        with file.open(encoding="utf-8", newline="") as stream:
            row: Any = next(csv.DictReader(stream), {}) if form == "csv" else json.loads(next(stream, "{}"))
    except (OSError, ValueError, csv.Error):
        return {}
    return row if isinstance(row, dict) else {}


def export(
    opened: log.Log,
    folder: Path,
    progress: Progress = lambda *_: None,
    *,
    form: TableFormat = "parquet",
    topics: Sequence[str] | None = (),
    part: MessagesPart = WHOLE,
    force: bool = False,
    boxes: BoxesRead | None = None,
) -> Exported:
    """Update the tables of a log in a folder. Of tables without rows only those in ``ALWAYS`` are written, for one log
    of the folder, so that patterns such as ``events/*/*.parquet`` find a file.

    Parameters
    ----------
    opened : Log
    folder : Path
    progress : callable
        Called with a text, the number of finished tables and their total.
    form : {"parquet", "arrow", "csv", "jsonl"}
    topics : sequence of str, optional
        Foreign channels that get tables of their own, as those with rows of a user's own schema always do.
        Existing ones are updated, and removed if their channel is gone. None: all channels, and a note of those that
        can't be read.
    part : MessagesPart
        Which messages and fields these tables hold; of existing ones, what they held before.
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
    are_all = topics is None
    topics = [opened.find(topic) for topic in (contents.other_topics() if topics is None else topics)]
    for topic in topics:
        opened.channel(topic)
    job = _Job(contents, folder, form, force, Exported())
    if not force:
        refuse_tables_of_another(opened, opened.path, folder)
    with claimed(folder, contents.recording):
        if not force:  # once more, because another process may have written them meanwhile
            refuse_tables_of_another(opened, opened.path, folder)
        job.tidy()
        _write_all(job, topics, part, are_all, progress)
    return job.done


def _write_all(
    job: _Job,
    topics: Sequence[str],
    part: MessagesPart,
    are_all: bool,
    progress: Progress,
) -> None:
    opened = job.contents.opened
    *names, last = TABLES
    topics_before = job.known_topics()
    kept = (topic for topic in topics_before if topic in opened.channels)
    wanted = sorted({*topics, *kept, *job.contents.own_topics()})
    alike: dict[str, str] = {}
    for topic in wanted:
        if (other := alike.setdefault(recording_key(topic_folder(topic)), topic)) != topic:
            job.done.notes.append(f"the tables of {other} and {topic} are in one folder where capitals don't count")
    total, done = len(TABLES) + len(wanted), len(TABLES) - 1
    for count, name in enumerate(names, start=1):
        job.table(name)
        progress("export", count, total)

    def fail(topic: str, error: McaptrackError) -> None:
        if not are_all:
            raise error
        job.done.notes.append(f"{error}; it has no table")
        job.reasons[topic] = str(error)
        job.remove([topic])

    passes: dict[Span, list[ChannelFile]] = {}
    parts = {topic: part if topic in topics else topics_before.get(topic, WHOLE) for topic in wanted}
    for topic, of_topic in parts.items():
        channel = None
        try:
            channel = job.messages(topic, of_topic)
        except McaptrackError as error:
            fail(topic, error)
        if channel is not None:
            passes.setdefault((of_topic.start_ns, of_topic.end_ns), []).append(channel)
        else:
            done += 1
            progress("export", done, total)
    for span, channels in passes.items():

        def tell(count: int, done: int = done) -> None:
            progress("export", done + count, total)

        write_in_one_pass(opened, channels, span, fail, tell)
        done += len(channels)
        for channel in channels:
            job.finish(channel)
    job.remove([topic for topic in topics_before if topic not in wanted])
    job.manifest(parts)
    job.table(last)
    progress("export", total, total)


@dataclass
class _Job:
    contents: LogTables
    folder: Path
    form: TableFormat
    force: bool
    done: Exported
    #: Why channels have no table.
    reasons: dict[str, str] = field(default_factory=dict)

    def path(self, *names: str) -> Path:
        return self.folder.joinpath(*names, f"recording={self.contents.recording}", f"part-0.{self.form}")

    def table(self, name: str) -> None:
        """Update one of ``TABLES``."""
        metadata = {"lineage": self.contents.lineage(name), "source": self.contents.source(name)}
        metadata |= owner_words(self.contents.opened, self.folder) if name == "recordings" else {}
        path = self.path(name)
        if not self._stands(name, path, metadata["source"]):
            pieces = self.contents.pieces(name)
            if self._is_spare(name, path, pieces.num_rows):
                return
            note = self.contents.notes.get(name)
            self._write(name, path, pieces, metadata | ({"note": note} if note else {}), TABLES[name].order)
            self.done.notes += [f"{name}: {note}"] if note else []

    def messages(self, topic: str, part: MessagesPart) -> ChannelFile | None:
        """Update the table of a channel, unless it can be written in one pass with others: then it comes back."""
        name = f"{TOPICS}/{topic_folder(topic)}"
        path = self.path(*name.split("/"))
        metadata = {"topic": topic, "part": json.dumps(part), "source": self.contents.messages_digest(topic, part)}
        if self._stands(name, path, metadata["source"]):
            metadata_before = tables.file_metadata(path, self.form) or {}
            self._note_left_out(topic, metadata_before.get("left_out", ""))
            return None
        if self._is_spare(name, path, self.contents.timing(topic, part).messages):
            self.reasons[topic] = "it has no messages"
            self.done.notes.append(f"{topic} has no messages in the table's span of time, and no table")
            return None
        messages = self.contents.typed_messages(topic, part) if self.form == "parquet" else None
        if messages is not None:
            left_out = [".".join(path) for path in messages.left_out]
        else:
            pieces, left_out = self.contents.message_pieces(topic, part)
        metadata |= {"left_out": ", ".join(left_out)} if left_out else {}
        if messages is not None:
            about = self._about(metadata, messages.source.total)
            file = tables.ParquetTable(path, messages.schema, about, ("topic", "t_ns"), self.force)
            return ChannelFile(messages, file)
        self._write(name, path, pieces, metadata, ("topic", "t_ns"))
        self._note_left_out(topic, metadata.get("left_out", ""))
        return None

    def finish(self, channel: ChannelFile) -> None:
        """Note a table that was written in one pass with others."""
        if channel.is_done:
            name = f"{TOPICS}/{topic_folder(channel.topic)}"
            self._note(name, channel.messages.source.total, channel.file.is_new)
            self._note_left_out(channel.topic, ", ".join(".".join(path) for path in channel.messages.left_out))

    def _note_left_out(self, topic: str, left_out: str) -> None:
        if left_out:
            keep = call("export", self.contents.opened.path, topic=topic, blobs=True)
            self.done.notes.append(f"{topic}: {left_out} left out, bytes; {keep} keeps them")

    def _stands(self, name: str, path: Path, source: str) -> bool:
        """Whether a table is up to date and may stay."""
        if self.force:
            return False
        metadata = tables.file_metadata(path, self.form) or {}
        if (metadata.get("source"), metadata.get("table_version")) != (source, tables.table_version()):
            return False
        self.done.rows[name] = int(metadata["rows"])
        return True

    def _is_spare(self, name: str, path: Path, rows: int) -> bool:
        """Whether a table has no rows and needs no file; one that there is goes."""
        if rows or (name in ALWAYS and (path.exists() or not any(self.folder.glob(f"{name}/{_PREFIX}*/{path.name}")))):
            return False
        self.done.rows[name] = 0
        self.done.spare.append(name)
        if path.exists():
            self.done.removed.append(name)
        _remove(path)
        return True

    def _write(self, name: str, path: Path, pieces: object, metadata: dict[str, str], order: Sequence[str]) -> None:
        rows = pieces.num_rows  # type: ignore[attr-defined]  # a table, which only tables knows
        self._note(name, rows, tables.write(path, pieces, self._about(metadata, rows), order, self.form, self.force))

    def _about(self, metadata: dict[str, str], rows: int) -> dict[str, str]:
        """The metadata of a table."""
        recording = file_name(self.contents.opened.path)
        return metadata | {"version": __version__, "recording": recording, "rows": str(rows)}

    def _note(self, name: str, rows: int, is_written: bool) -> None:
        self.done.rows[name] = rows
        self.done.written += [name] if is_written else []

    def known_topics(self) -> dict[str, MessagesPart]:
        """The channels of this log with tables of their own in the folder, and what these hold."""
        out = {}
        for folder in self._topic_folders():
            metadata = tables.file_metadata(folder / f"part-0.{self.form}", self.form) or {}
            if metadata.get("recording") == file_name(self.contents.opened.path) and "topic" in metadata:
                blobs, columns, *span = json.loads(metadata.get("part", "[false, [], null, null]"))
                out[metadata["topic"]] = MessagesPart(blobs, tuple(columns), *span)
        return out

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
            if path.exists():
                _remove(path)
                self.done.removed.append(f"{TOPICS}/{topic_folder(topic)}")

    def manifest(self, parts: Mapping[str, MessagesPart]) -> None:
        """Write what channels with tables of their own are, and those of other software without, and why."""
        path = self.path(MANIFEST).with_suffix(".json")
        if not parts:
            _remove(path)
            return
        rows = []
        for topic in sorted({*parts, *self.contents.other_topics()}):
            name = f"{TOPICS}/{topic_folder(topic)}"
            file = self.path(*name.split("/"))
            why = self.reasons.get(topic) or (None if topic in parts else "it was not asked for")
            about = {} if why else tables.file_metadata(file, self.form) or {}
            rows.append(
                self.contents.manifest(topic, parts.get(topic, WHOLE))
                | {"file": None if why else file.relative_to(self.folder).as_posix(), "rows": self.done.rows.get(name)}
                | {"bytes": None if why else file.stat().st_size, "left_out": about.get("left_out"), "reason": why}
            )
        text = json.dumps(rows, indent=1, ensure_ascii=False).encode("utf-8", "backslashreplace")
        if not path.is_file() or path.read_bytes() != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            publish_bytes(path, text)


def _remove(path: Path) -> None:
    """Remove a file, and its folders if they are empty then, also if a process that was killed has removed the file."""
    path.unlink(missing_ok=True)
    for folder in (path.parent, path.parent.parent):
        with suppress(OSError):
            folder.rmdir()


# The messages of many channels as tables in one pass over a log: each chunk is opened once for all of them.
#
# Pieces of tables are made one after the other, and written by threads where there are several cores; the same bytes
# come out, however many.


#: Tables that are written at once, each to an open file.
_MOST_AT_ONCE: Final = 256
#: Rows of all tables together wait for others of their piece in so many bytes at most.
_WAITING_BYTES: Final = 256 * 2**20


class ChannelFile:
    """The table of a channel that is being written; ``is_done`` says whether it was: not if it can't be read."""

    def __init__(self, messages: TypedMessages, file: ParquetTable) -> None:
        self.topic, self.total = messages.source.topic, messages.source.total
        self.messages, self.file = messages, file
        self.waiting, self.is_done = PendingRows(messages.schema, PIECE_BYTES), False
        self.is_open, self._stack = False, ExitStack()
        self._writing: Future[None] | None = None

    def write(self, piece: Any, threads: Executor | None) -> Future[None] | None:
        """Write a piece, behind those before it."""
        self._finish_writing()
        if not self.is_open:
            self._stack.enter_context(self.file.published())
            self.is_open = True
        if threads is None:
            self._add(piece)
        else:
            self._writing = threads.submit(self._add, piece)
        return self._writing

    def _add(self, piece: Any) -> None:
        with writing(self.file.path):
            self.file.add(piece)

    def _finish_writing(self) -> None:
        if self._writing is not None:
            self._writing.result()
            self._writing = None

    def publish(self) -> None:
        """Publish the file, of which all pieces were written."""
        self._finish_writing()
        self._stack.close()
        self.messages.warn()
        self.is_done = True

    def discard(self, error: BaseException) -> None:
        """Remove what was written, because of an error."""
        if self._writing is not None:
            wait([self._writing])
        with suppress(type(error), McaptrackError):  # which the file that failed has raised already
            self._stack.__exit__(type(error), error, error.__traceback__)


def write_in_one_pass(
    opened: log.Log,
    channels: Sequence[ChannelFile],
    span: Span,
    fail: Callable[[str, McaptrackError], None],
    progress: Callable[[int], None],
) -> None:
    """Write the tables of channels, with the messages in a span of time.

    ``fail`` gets the topic of a channel that can't be read, and why: it may raise the error, or leave the channel out.
    ``progress`` gets numbers of channels that are finished.
    """
    everything, done = iter(channels), 0
    while some := list(islice(everything, _MOST_AT_ONCE)):

        def tell(share: float, done: int = done, count: int = len(some)) -> None:
            progress(done + int(share * count))

        try:
            _Pass(some, fail).run(opened, span, tell)
        except BaseException as error:
            for channel in some:
                channel.discard(error)
            raise
        done += len(some)


class _Pass:
    def __init__(self, channels: Sequence[ChannelFile], fail: Callable[[str, McaptrackError], None]) -> None:
        self._by_topic = {channel.topic: channel for channel in channels}
        self._fail = fail
        self._cores = environment.threads()
        self._in_flight: deque[Future[None]] = deque()
        self._waiting_bytes = 0

    def run(self, opened: log.Log, span: Span, progress: Callable[[float], None]) -> None:
        topics, messages, done = list(self._by_topic), sum(channel.total for channel in self._by_topic.values()), 0
        with ThreadPoolExecutor(self._cores) if self._cores > 1 else nullcontext() as threads:
            for topic, batch in opened.payloads_of(topics, *span, self._lose):
                self._add(topic, batch, threads)
                done += len(batch.t_ns)
                progress(done / max(messages, 1))
            for channel in self._by_topic.values():
                if channel.waiting.rows or not channel.is_open:
                    self._write(channel, channel.waiting.rest(), threads)
            for channel in self._by_topic.values():
                channel.publish()

    def _lose(self, topic: str, count: int, why: str) -> None:
        self._try(topic, lambda channel: channel.messages.unread.lose(count, why))

    def _try(self, topic: str, work: Callable[[ChannelFile], None]) -> None:
        if topic in self._by_topic:
            try:
                work(self._by_topic[topic])
            except McaptrackError as error:
                channel = self._by_topic.pop(topic)
                self._waiting_bytes -= channel.waiting.nbytes
                channel.discard(error)
                self._fail(topic, error)

    def _add(self, topic: str, batch: Payloads, threads: Executor | None) -> None:
        def add(channel: ChannelFile) -> None:
            before = channel.waiting.nbytes
            pieces = list(channel.waiting.add(channel.messages.rows(batch)))
            self._waiting_bytes += channel.waiting.nbytes - before
            for piece in pieces:
                self._write(channel, piece, threads)

        self._try(topic, add)
        while self._waiting_bytes > _WAITING_BYTES:
            largest = max(self._by_topic.values(), key=lambda channel: channel.waiting.nbytes)
            self._waiting_bytes -= largest.waiting.nbytes
            self._write(largest, largest.waiting.rest(), threads)

    def _write(self, channel: ChannelFile, piece: Any, threads: Executor | None) -> None:
        """Write a piece; not more wait for that than there are threads."""
        if len(self._in_flight) > self._cores:
            self._in_flight.popleft().result()
        writing = channel.write(piece, threads)
        if writing is not None:
            self._in_flight.append(writing)
