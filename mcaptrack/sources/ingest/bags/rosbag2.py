"""Open recordings, and read those of rosbag2: folders with metadata.yaml, SQLite databases and MCAP files.

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

from mcap.well_known import MessageEncoding, SchemaEncoding

from mcaptrack import log
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.files import follow_links, read_beginning, refuse_special, temporary_folder, visible
from mcaptrack.log.recording_files import ZSTD
from mcaptrack.notices import warn
from mcaptrack.schema.provenance import CLOCK
from mcaptrack.sources.foreign.definitions import Defined, MessageType, defined, is_defined, is_packed
from mcaptrack.sources.ingest.bags import decompression
from mcaptrack.sources.ingest.bags.metadata_yaml import Bag, holds_metadata, read_metadata
from mcaptrack.sources.ingest.bags.recording import Connection, ReadingNotes, RecordingReader
from mcaptrack.sources.ingest.bags.rosbag1 import Bag1
from mcaptrack.sources.ingest.bags.sqlite_tables import SqliteTables, text_of
from mcaptrack.sources.sidecar import METADATA, holds_packed
from mcaptrack.sources.video import IMAGE_SUFFIXES

_MCAP, _ROS1, _SQLITE = b"\x89MCAP0\r\n", b"#ROSBAG V", b"SQLite format 3\0"
#: A message that is larger decompressed is not read.
_MAX_MESSAGE_BYTES: Final = 2**28
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
    source = open_files(paths, folder, bag) if paths else _Files([], folder, bag)
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
        source: _Files
        if all(head.startswith(_SQLITE) for head in heads):
            source = Databases(parts, whole, bag)
        elif all(head.startswith(_MCAP) for head in heads):
            source = Logs(parts, whole, bag)
        else:
            wrong = [path for path, head in zip(paths, heads, strict=True) if not head.startswith((_MCAP, _SQLITE))]
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
    decompression.unzstd_file(path, out)
    return out


def _own_metadata(paths: Sequence[Path]) -> Bag:
    """The metadata.yaml beside a single file, if it names the file; without the number of messages."""
    metadata = paths[0].with_name(METADATA)
    if len(paths) == 1 and holds_metadata(metadata):
        bag, names = read_metadata(metadata)
        if paths[0].name.removesuffix(".zstd") in [name.removesuffix(".zstd") for name in names]:
            return Bag(distro=bag.distro, packed=bag.packed)
    return Bag()


class _Files(RecordingReader):
    """Common parts of databases and MCAP files."""

    def __init__(self, paths: Sequence[Path], whole: Path, bag: Bag) -> None:
        super().__init__()
        self.paths, self.whole, self.bag = paths, whole, bag
        self.declared_counts: dict[Connection, int] = {}
        self._known_connections: dict[tuple[object, ...], Connection] = {}
        self._message_counts: dict[Connection, int] = {}
        #: Definitions of types that the recording doesn't define.
        self._found: dict[MessageType, Defined] = {}
        try:
            for number in range(len(paths)):
                self._open(number)
        except BaseException:
            self.close()
            raise
        self._compare()
        self.connections = list(self.declared_counts)
        for doubts in dict.fromkeys(found.doubts for found in self._found.values() if found.doubts):
            names = [kind.name for kind, found in self._found.items() if found.doubts == doubts]
            warn(f"{whole} does not say what {list_names(names)} is; {doubts}", "definitions")

    def messages(self, report: ReadingNotes) -> Iterator[tuple[Connection, log.Message]]:
        """All messages, file by file, in their order there."""
        self._message_counts = {}
        for number, path in enumerate(self.paths):
            left = decompression.limit_of(path.stat().st_size)
            for connection, message in self._messages(number):
                payload = message.payload
                if (self.bag.packed or connection.encoding == MessageEncoding.CDR) and is_packed(payload):
                    payload = _unpack_message(payload, path, message.t_ns, left)
                    left -= len(payload)
                    yield connection, message._replace(payload=payload)
                else:
                    yield connection, message

    def extras(self, writer: log.LogWriter, has_clock: bool, is_copied: bool) -> None:
        """Write metadata.yaml, which a copied MCAP file doesn't contain."""
        if self.bag.text:
            writer.add_attachment(METADATA, "application/yaml", self.bag.text)

    def _open(self, number: int) -> None:
        raise NotImplementedError

    def _defined(self, kind: MessageType, distribution: str = "", digest: str = "") -> Defined:
        """A message type with the definition that fits if the recording doesn't define it."""
        if is_defined(kind):
            return Defined(kind, "", "")
        if kind not in self._found:
            with closing(self._payloads(kind)) as payloads:
                self._found[kind] = defined(kind, payloads, distribution, digest)
            if not self._found[kind].doubts:
                text = f"{self.whole} does not say what {kind.name} is; its definition is {self._found[kind].origin}"
                self.findings.notes.append(text)
        return self._found[kind]

    def _payloads(self, kind: MessageType) -> Generator[bytes]:
        """The messages of a type, in all files."""
        raise NotImplementedError

    def _messages(self, number: int) -> Iterator[tuple[Connection, log.Message]]:
        """The messages of a file as they are stored."""
        raise NotImplementedError

    def _connection(self, repeats: dict[object, int], described: Connection, messages: int) -> Connection:
        """The connection that a part of the recording describes: the parts have the same ones.

        ``repeats`` counts, in one part, those that are described in the same words.
        """
        key = (described.topic, described.schema, described.encoding, *sorted(described.metadata.items()))
        repeats[key] = repeats.get(key, 0) + 1
        connection = self._known_connections.setdefault((*key, repeats[key]), described)
        self.declared_counts[connection] = self.declared_counts.get(connection, 0) + messages
        return connection

    def _compare(self) -> None:
        """Report topics and messages that metadata.yaml lists and the files lack."""
        holds: Counter[str] = Counter()
        for connection, count in self.declared_counts.items():
            holds[connection.topic] += count
        for topic, kind, encoding, qos, digest, messages in self.bag.topics:
            if topic not in holds:
                metadata = {"offered_qos_profiles": qos, "topic_type_hash": digest}
                self.declared_counts[Connection(topic, (kind, "", b""), encoding, metadata)] = holds[topic] = 0
                self.findings.notes.append(f"{topic} ({kind}) is in {METADATA} alone; its channel has no schema")
            if holds[topic] < messages:
                self.findings.lost.append(
                    f"{self.whole}: {METADATA} counts {messages} messages of {topic}, and {holds[topic]} are there"
                )


class Databases(_Files):
    """SQLite databases."""

    def __init__(self, paths: Sequence[Path], whole: Path, bag: Bag) -> None:
        self._databases: list[SqliteTables] = []
        self._topics: list[dict[int, Connection]] = []
        self._distro = bag.distro
        super().__init__(paths, whole, bag)

    def extras(self, writer: log.LogWriter, has_clock: bool, is_copied: bool) -> None:
        """Write metadata.yaml and the metadata in the databases, as rosbag2 writes them to MCAP files."""
        super().extras(writer, has_clock, is_copied)
        if self._distro:
            writer.add_metadata("mcaptrack.bag", {"file": self.whole.name, "ros_distro": self._distro})
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
        described: dict[int, Connection] = {}
        for key, *values in database.rows("topics", ["id", "name", "type", "serialization_format", *optional]):
            topic, kind, encoding, *more = map(text_of, values)
            extra = dict(zip(optional, more, strict=True))
            digest = extra.get("type_description_hash", "")
            own, own_digest = definitions.get(kind, (("", "", b""), ""))
            of_type = MessageType(kind, *own[1:], encoding)
            found = Defined(of_type, "", "") if own[0] else self._defined(of_type, self._distro.lower(), digest)
            qos = extra.get("offered_qos_profiles", "")
            metadata = {"offered_qos_profiles": qos, "topic_type_hash": digest or own_digest, **found.metadata}
            described[key] = Connection(topic, found.kind[:3], encoding, metadata)
        counts = self._count(database, described)
        repeats: dict[object, int] = {}
        self._topics.append(
            {key: self._connection(repeats, described[key], counts[key]) for key in sorted(described, key=_in_order)}
        )

    def _count(self, database: SqliteTables, described: dict[int, Connection]) -> Counter[int]:
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

    def _messages(self, number: int) -> Iterator[tuple[Connection, log.Message]]:
        connections, path = self._topics[number], self.paths[number]
        for key, t_ns, data in self._databases[number].rows("messages", ["topic_id", "timestamp", "data"]):
            connection = connections.get(key)
            if connection is None:
                continue
            if not isinstance(t_ns, int) or not isinstance(data, bytes):
                raise McaptrackError(f"{path} is damaged: a message without time or data")
            count = self._message_counts.get(connection, 0)
            self._message_counts[connection] = count + 1
            yield connection, log.Message(t_ns, count % 2**32, t_ns, data)


class Logs(_Files):
    """MCAP files."""

    def __init__(self, paths: Sequence[Path], whole: Path, bag: Bag) -> None:
        self.logs: list[log.Log] = []
        self._channels: list[dict[int, Connection]] = []
        super().__init__(paths, whole, bag)
        profiles = {log.header(opened)[0] for opened in self.logs}
        self.profile = profiles.pop() if len(profiles) == 1 else ""
        is_whole = len(self.logs) == 1 and not any(found.origin for found in self._found.values())
        self.as_log = self.logs[0] if is_whole and not holds_packed(self.logs[0]) else None

    def extras(self, writer: log.LogWriter, has_clock: bool, is_copied: bool) -> None:
        """Write metadata.yaml, and all attachments and metadata records of the files."""
        super().extras(writer, has_clock, is_copied)
        for opened in [] if is_copied else self.logs:
            log.copy_attachments_and_metadata(opened, writer, without=[CLOCK] if has_clock else [])

    def _open(self, number: int) -> None:
        if not number:
            self.logs += [self.closing.enter_context(log.read(path, sidecar=False)) for path in self.paths]
        path, opened = self.paths[number], self.logs[number]
        if log.results_path(path).exists():
            warn(f"{log.results_path(path)} holds results of {path.name}; they are left out", "left-out")
        connections: dict[int, Connection] = {}
        repeats: dict[object, int] = {}
        for channel in opened.index.channels.values():
            record = opened.index.schemas.get(channel.schema_id)
            fields = (record.name, record.encoding, record.data) if record else ("", "", b"")
            found = self._defined(MessageType(*fields, channel.message_encoding))
            metadata = channel.metadata | found.metadata
            described = Connection(channel.topic, found.kind[:3], channel.message_encoding, metadata)
            connections[channel.id] = self._connection(repeats, described, opened.index.counts.get(channel.id, 0))
        self._channels.append(connections)

    def _payloads(self, kind: MessageType) -> Generator[bytes]:
        for opened in self.logs:
            for topic, channel in opened.channels.items():
                if (opened.record_name(channel), channel.message_encoding) == (kind.name, kind.encoding):
                    yield from (message.payload for message in opened.messages(topic))

    def _messages(self, number: int) -> Iterator[tuple[Connection, log.Message]]:
        return ((self._channels[number][channel], message) for channel, message in log.stream(self.logs[number]))


def _in_order(key: Any) -> tuple[int, Any]:
    """Sort key: integer topic ids first, then other values, which SQLite allows, too."""
    return (0, key) if isinstance(key, int) else (1, str(key))


def _unpack_message(data: bytes, path: Path, t_ns: int, left: int) -> bytes:
    """Decompress a single message; ``left`` is the limit for all remaining messages together."""
    try:
        return decompression.unzstd(data, min(left, _MAX_MESSAGE_BYTES))
    except decompression.NotUnpackedError as error:
        raise McaptrackError(f"{path}: the message at {t_ns} ns can't be decompressed: {error}") from None


# Open a recording: its kind is detected by its first bytes, not by the name of the file.


_SUFFIXES: Final = {".mcap": "an MCAP file", ".bag": "a ROS bag", ".db3": "a rosbag2 database"}


def open_recording(path: Path) -> RecordingReader | None:
    """Open the recording at ``path``; None if it is something else.

    Raises McaptrackError for a recording that can't be read.
    """
    if path.is_dir():
        return _open_folder(path)
    head = read_beginning(path, 16)
    if head.startswith(_ROS1):
        return Bag1(path)
    if head.startswith((ZSTD, _MCAP, _SQLITE)):
        return open_files([path], path)
    if path.suffix.lower() in _SUFFIXES:
        what = "is empty" if not head else "does not begin as one does"
        raise McaptrackError(f"{path} can't be read as {_SUFFIXES[path.suffix.lower()]}: it {what}")
    return None


def is_mcap(path: Path) -> bool:
    """Whether a file begins with the magic bytes of MCAP; False if it can't be read."""
    refuse_special(path)
    try:
        with path.open("rb") as stream:
            return stream.read(len(_MCAP)) == _MCAP
    except OSError:
        return False


def _open_folder(path: Path) -> RecordingReader | None:
    if holds_metadata(path / METADATA):
        return open_bag(path)
    names = [entry.name for entry in visible(path.iterdir())]
    if any(Path(name).suffix.lower() in IMAGE_SUFFIXES for name in names):
        return None
    if parts := log.split_files_in(path):
        return open_files(parts, path) if len(parts) > 1 else open_recording(parts[0])
    logs = [name for name in names if Path(name).suffix.lower() in _SUFFIXES]
    if logs:
        raise McaptrackError(
            f"{path} has no {METADATA}, and its {len(logs)} logs are no parts of one; give {logs[0]} and so on by name"
        )
    return None
