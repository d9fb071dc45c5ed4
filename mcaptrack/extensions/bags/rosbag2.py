"""Read recordings of rosbag2: folders with metadata.yaml, SQLite databases and MCAP files.

The databases are read as rosbag2's sqlite3 storage plugin lays them out (schema versions 1 to 4): nothing that they
hold is made sense of, so nothing is refused. rosbags knows the definitions of ROS's own messages, for databases that
were recorded before definitions were kept in them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Final

from mcap.well_known import SchemaEncoding

from mcaptrack import log
from mcaptrack.contracts import RecordedChannel, RecordedMessage, RecordingReader
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.bags import unpacking
from mcaptrack.extensions.bags.files import METADATA, SQLITE
from mcaptrack.extensions.bags.metadata_yaml import Bag, holds_metadata, read_metadata
from mcaptrack.extensions.bags.sqlite_tables import SqliteTables, text_of
from mcaptrack.files import follow_links, read_beginning, temporary_folder, visible
from mcaptrack.log.recording_files import ZSTD
from mcaptrack.notices import warn
from mcaptrack.sources.foreign.definitions import Defined, MessageType
from mcaptrack.sources.ingest.recording import McapRecording, Parts

#: Definitions are tried on the messages of at most this many topics of a type.
_TOPICS_TRIED: Final = 20
#: At most this many unknown topic ids are named.
_MAX_STRANGE: Final = 10
_NEEDED: Final = {
    "topics": {"id", "name", "type", "serialization_format"},
    "messages": {"topic_id", "timestamp", "data"},
}
_TABLES: Final = ("topics", "messages", "metadata", "schema", "message_definitions")


def open_bag(folder: Path) -> RecordingReader:
    """Open the bag in a folder with metadata.yaml. Raises McaptrackError if it can't be read or is incomplete."""
    bag, names = read_metadata(folder / METADATA)
    paths = [folder / name for name in names]
    paths = [path if path.exists() else path.with_name(path.name + ".zstd") for path in paths]
    missing = [str(path).removesuffix(".zstd") for path in paths if not path.exists()]
    if missing:
        raise McaptrackError(
            f"{folder / METADATA} names {missing[0]}, which does not exist; a part of the bag is missing"
        )
    places: dict[tuple[int, int], Path] = {}
    for path in paths:
        status = path.stat()
        other = places.setdefault((status.st_dev, status.st_ino), path)
        if other is not path:
            raise McaptrackError(f"{folder / METADATA} names {other.name} and {path.name}, which are one file")
    source = open_files(paths, folder, bag) if paths else _Described([], folder, bag)
    ours, results = {path.name for path in paths}, {log.results_path(path).name for path in paths}
    unnamed = [
        entry.name
        for entry in visible(folder.iterdir())
        if entry.suffix in (".db3", ".mcap") and entry.name not in ours | results
    ]
    for name in unnamed:
        warn(f"{folder / name} is not named in {METADATA}; it is left out", "left-out")
    for path in paths:
        if not follow_links(path).is_relative_to(follow_links(folder)):
            warn(f"{path} is a link out of the folder, to {follow_links(path)}, which is read")
    return source


def open_files(paths: Sequence[Path], whole: Path, bag: Bag | None = None) -> RecordingReader:
    """Open the files of a split recording as one; ``whole`` names it in messages."""
    if bag is None:
        bag = _own_metadata(paths)
    with ExitStack() as opened:
        parts = [_decompressed_file(path, opened) for path in paths]
        heads = [read_beginning(path, 16) for path in parts]
        source: RecordingReader
        if all(head.startswith(SQLITE) for head in heads):
            source = Databases(parts, whole, bag)
        elif all(head.startswith(log.MAGIC) for head in heads):
            source = Logs(parts, whole, bag)
        else:
            wrong = [path for path, head in zip(paths, heads, strict=True) if not head.startswith((log.MAGIC, SQLITE))]
            if not wrong:
                raise McaptrackError(f"{whole} holds both MCAP files and databases; one bag is made of either")
            raise McaptrackError(f"{wrong[0]} is neither an MCAP file nor a rosbag2 database; it may be damaged")
        source.closing.push(opened.pop_all())
        return source


def _decompressed_file(path: Path, opened: ExitStack) -> Path:
    """The file, or its decompressed copy if it is compressed as a whole."""
    if not read_beginning(path, 16).startswith(ZSTD):
        return path
    out = Path(opened.enter_context(temporary_folder())) / path.name.removesuffix(".zstd")
    unpacking.unzstd_file(path, out)
    return out


def _own_metadata(paths: Sequence[Path]) -> Bag:
    """The metadata.yaml beside a single file, if it names the file; without the number of messages."""
    metadata = paths[0].with_name(METADATA)
    if len(paths) == 1 and holds_metadata(metadata):
        bag, names = read_metadata(metadata)
        if paths[0].name.removesuffix(".zstd") in [name.removesuffix(".zstd") for name in names]:
            return Bag(distro=bag.distro, packed=bag.packed)
    return Bag()


class _Described(Parts):
    """The files of a bag, and what its metadata.yaml says of them."""

    def __init__(self, paths: Sequence[Path], whole: Path, bag: Bag) -> None:
        self.bag, self.is_packed = bag, bag.packed
        super().__init__(paths, whole)

    def extras(self, writer: log.LogWriter, has_clock: bool, is_copied: bool) -> None:
        """Write metadata.yaml, which a copied MCAP file doesn't contain."""
        if self.bag.text:
            writer.add_attachment(METADATA, "application/yaml", self.bag.text)
        super().extras(writer, has_clock, is_copied)

    def _compare(self) -> None:
        """Report topics and messages that metadata.yaml lists and the files lack."""
        holds: Counter[str] = Counter()
        for channel, count in self.declared_counts.items():
            holds[channel.topic] += count
        for topic, kind, encoding, qos, digest, messages in self.bag.topics:
            if topic not in holds:
                metadata = {"offered_qos_profiles": qos, "topic_type_hash": digest}
                self.declared_counts[RecordedChannel(topic, (kind, "", b""), encoding, metadata)] = holds[topic] = 0
                self.findings.notes.append(f"{topic} ({kind}) is in {METADATA} alone; its channel has no schema")
            if holds[topic] < messages:
                self.findings.lost.append(
                    f"{self.whole}: {METADATA} counts {messages} messages of {topic}, and {holds[topic]} are there"
                )


class Logs(_Described, McapRecording):
    """MCAP files."""


class Databases(_Described):
    """SQLite databases."""

    def __init__(self, paths: Sequence[Path], whole: Path, bag: Bag) -> None:
        self._databases: list[SqliteTables] = []
        self._topics: list[dict[int, RecordedChannel]] = []
        self._distro = bag.distro
        super().__init__(paths, whole, bag)

    def extras(self, writer: log.LogWriter, has_clock: bool, is_copied: bool) -> None:
        """Write metadata.yaml and the metadata in the databases, as rosbag2 writes them to MCAP files."""
        super().extras(writer, has_clock, is_copied)
        for database in self._databases:
            if "metadata" in database.columns("metadata"):
                for (text,) in database.rows("metadata", ["metadata"]):
                    writer.add_metadata("rosbag2", {"serialized_metadata": text_of(text)})

    def _open(self, number: int) -> None:
        if not number:  # definitions are tried on the messages of all files
            for path in self.paths:
                database = SqliteTables(path, _TABLES)
                self.closing.callback(database.close)
                self._databases.append(database)
                if not all(columns <= set(database.columns(table)) for table, columns in _NEEDED.items()):
                    raise McaptrackError(f"{path} is a database, but none of rosbag2: it has no topics and messages")
        database = self._databases[number]
        definitions = self._definitions(database)
        has = database.columns("topics")
        optional = [name for name in ("offered_qos_profiles", "type_description_hash") if name in has]
        described: dict[int, RecordedChannel] = {}
        for key, *values in database.rows("topics", ["id", "name", "type", "serialization_format", *optional]):
            topic, kind, encoding, *more = map(text_of, values)
            extra = dict(zip(optional, more, strict=True))
            digest = extra.get("type_description_hash", "")
            own, own_digest = definitions.get(kind, (("", "", b""), ""))
            of_type = MessageType(kind, *own[1:], encoding)
            found = Defined(of_type, "", "") if own[0] else self._defined(of_type, self._distro.lower(), digest)
            qos = extra.get("offered_qos_profiles", "")
            metadata = {"offered_qos_profiles": qos, "topic_type_hash": digest or own_digest, **found.metadata}
            described[key] = RecordedChannel(topic, found.kind[:3], encoding, metadata)
        counts = self._count(database, described)
        repeats: dict[object, int] = {}
        self._topics.append(
            {key: self._channel(repeats, described[key], counts[key]) for key in sorted(described, key=_in_order)}
        )

    def _count(self, database: SqliteTables, described: dict[int, RecordedChannel]) -> Counter[int]:
        """Count the messages of each topic. Messages of unknown topics are lost."""
        counts: Counter[int] = Counter()
        strange: Counter[object] = Counter()
        for (key,) in database.rows("messages", ["topic_id"]):
            if key in described:
                counts[key] += 1
            else:
                strange[key if key in strange or len(strange) < _MAX_STRANGE else "other numbers"] += 1
        total, counted = database.count("messages"), counts.total() + strange.total()
        if total != counted:
            raise McaptrackError(
                f"{database.path} does not add up: its index counts {total} messages, and {counted} are there"
            )
        self.findings.lost += [
            f"{database.path}: {count} messages of topic {text_of(key)[:80]}, which is not described"
            for key, count in strange.items()
        ]
        return counts

    def _definitions(self, database: SqliteTables) -> dict[str, tuple[tuple[str, str, bytes], str]]:
        """Schema record and type hash of each message type that a database defines."""
        if not self._distro and "ros_distro" in database.columns("schema"):
            self._distro = next((text_of(row[0]) for row in database.rows("schema", ["ros_distro"])), "")
        has = database.columns("message_definitions")
        if not {"topic_type", "encoding", "encoded_message_definition"} <= set(has):
            return {}
        wanted = ["topic_type", "encoding", "encoded_message_definition"]
        wanted += ["type_description_hash"] * ("type_description_hash" in has)
        rows = [[*map(text_of, row), ""] for row in database.rows("message_definitions", wanted)]
        return {
            kind: ((kind, encoding, text.encode()), type_hash)
            for kind, encoding, text, type_hash, *_ in rows
            if encoding in (SchemaEncoding.ROS2, SchemaEncoding.ROS2IDL) and (text or kind.endswith("/Empty"))
        }

    def _payloads(self, kind: MessageType) -> Generator[bytes]:
        for database in self._databases:
            keys = [key for key, name in database.rows("topics", ["id", "type"]) if text_of(name) == kind.name]
            for key in keys[:_TOPICS_TRIED]:
                with closing(database.rows("messages", ["data"], where=("topic_id", key))) as those:
                    yield from (data for (data,) in those if isinstance(data, bytes))

    def _messages(self, number: int) -> Iterator[RecordedMessage]:
        channels, path = self._topics[number], self.paths[number]
        for key, t_ns, data in self._databases[number].rows("messages", ["topic_id", "timestamp", "data"]):
            if key not in channels:
                continue
            if not isinstance(t_ns, int) or not isinstance(data, bytes):
                raise McaptrackError(f"{path} is damaged: a message without time or data")
            yield RecordedMessage(channels[key], t_ns, data)


def _in_order(key: Any) -> tuple[int, Any]:
    """Sort key: integer topic ids first, then other values, which SQLite allows, too."""
    return (0, key) if isinstance(key, int) else (1, str(key))
