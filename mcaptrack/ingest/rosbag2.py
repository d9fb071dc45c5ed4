"""rosbag2: folders with a metadata.yaml, their SQLite databases and MCAP files, and such files alone.

The databases are read as rosbag2's sqlite3 storage plugin lays them out (schema versions 1 to 4): nothing that they
hold is made sense of, so nothing is refused. rosbags knows the definitions of ROS's own messages, for databases that
were recorded before definitions were kept in them.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import cache
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any, Final

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.ingest.bag_metadata import METADATA, Bag, read_metadata
from mcaptrack.ingest.source import Connection, Found, Source
from mcaptrack.provenance import CLOCK

_MCAP_MAGIC, _SQLITE_MAGIC, _ZSTD_MAGIC = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd"
#: A message that is larger decompressed is not read.
_MAX_MESSAGE_BYTES: Final = 2**28


def open_bag(folder: Path) -> Source:
    """The bag in a folder with a metadata.yaml. Raises McaptrackError if it can't be read or is incomplete."""
    bag, names = read_metadata(folder / METADATA)
    paths = [folder / PurePath(name).name for name in names]
    paths = [path if path.exists() else path.with_name(path.name + ".zstd") for path in paths]
    missing = [str(path).removesuffix(".zstd") for path in paths if not path.exists()]
    if missing:
        raise McaptrackError(
            f"{folder / METADATA} names {missing[0]}, which does not exist; a part of the bag is missing"
        )
    source = open_files(paths, folder, bag) if paths else _Files([], folder, bag)
    ours = {path.name for path in paths}
    beside = [entry.name for entry in folder.iterdir() if entry.suffix in (".db3", ".mcap") and entry.name not in ours]
    if beside and isinstance(source, _Files):
        source.words.notes += [f"{folder / name} is not named in {METADATA}; it is left out" for name in sorted(beside)]
    return source


def open_files(paths: Sequence[Path], whole: Path, bag: Bag | None = None) -> Source:
    """The parts of a recording, which is called ``whole``, one after another."""
    if bag is None:
        bag = _bag_around(paths)
    with ExitStack() as opened:
        parts = [_unpacked(path, opened) for path in paths]
        heads = [_head(path) for path in parts]
        if all(head.startswith(_SQLITE_MAGIC) for head in heads):
            source: _Files = Databases(parts, whole, bag)
        elif all(head.startswith(_MCAP_MAGIC) for head in heads):
            source = Logs(parts, whole, bag)
        else:
            wrong = next(
                (
                    path
                    for path, head in zip(paths, heads, strict=True)
                    if not head.startswith((_MCAP_MAGIC, _SQLITE_MAGIC))
                ),
                None,
            )
            if wrong is None:
                raise McaptrackError(f"{whole} holds both MCAP files and databases; one bag is made of either")
            raise McaptrackError(f"{wrong} is neither an MCAP file nor a rosbag2 database; it may be damaged")
        source.closing.push(opened.pop_all())
        return source


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(16)


def _unpacked(path: Path, opened: ExitStack) -> Path:
    """The file, or what it holds if it is compressed as a whole."""
    if not _head(path).startswith(_ZSTD_MAGIC):
        return path
    import zstandard

    out = Path(opened.enter_context(TemporaryDirectory())) / path.name.removesuffix(".zstd")
    try:
        with path.open("rb") as packed, out.open("wb") as stream:
            zstandard.ZstdDecompressor(max_window_size=2**27).copy_stream(packed, stream)
    except zstandard.ZstdError as error:
        raise McaptrackError(f"{path} can't be decompressed: {error}") from None
    except OSError as error:
        raise McaptrackError(f"{path} can't be decompressed to {out.parent}: {error.strerror}") from None
    return out


def _bag_around(paths: Sequence[Path]) -> Bag:
    """What the metadata.yaml beside a single file says of it, if there is one that names it: not how much there is."""
    beside = paths[0].with_name(METADATA)
    if len(paths) == 1 and beside.is_file() and b"rosbag2_bagfile_information" in beside.read_bytes():
        bag, names = read_metadata(beside)
        if paths[0].name.removesuffix(".zstd") in [PurePath(name).name.removesuffix(".zstd") for name in names]:
            return Bag(distro=bag.distro, packed=bag.packed)
    return Bag()


class _Files:
    """What databases and MCAP files have in common. ``words`` is known before any message is read."""

    profile = "ros2"
    as_it_is: log.Log | None = None

    def __init__(self, paths: Sequence[Path], whole: Path, bag: Bag) -> None:
        self.paths, self.whole, self.bag = paths, whole, bag
        self.words = Found()
        self.closing = ExitStack()
        self.claims: dict[Connection, int] = {}
        self._same: dict[tuple[object, ...], Connection] = {}
        self._passed: dict[Connection, int] = {}
        try:
            for number in range(len(paths)):
                self._open(number)
        except BaseException:
            self.close()
            raise
        self._compare()

    @property
    def connections(self) -> list[Connection]:
        """All connections, also those without messages."""
        return list(self.claims)

    def close(self) -> None:
        """Let go of the files."""
        self.closing.close()

    def messages(self, found: Found) -> Iterator[tuple[Connection, log.Message]]:
        """All messages, file after file, as they stand there."""
        found.notes += self.words.notes
        found.lost += self.words.lost
        self._passed = {}
        for number in range(len(self.paths)):
            yield from self._messages(number, found)

    def extras(self, writer: log.LogWriter, has_clock: bool, passed_on: bool = False) -> None:
        """The bag's metadata.yaml, which is no part of what is passed on as it is."""
        if self.bag.text:
            writer.add_attachment(METADATA, "application/yaml", self.bag.text)

    def _open(self, number: int) -> None:
        raise NotImplementedError

    def _messages(self, number: int, found: Found) -> Iterator[tuple[Connection, log.Message]]:
        yield from ()

    def _connection(self, twins: dict[object, int], known: Connection, messages: int) -> Connection:
        """The connection that a part of the recording describes: the parts have the same ones.

        ``twins`` counts, in one part, those that are described in the same words.
        """
        words = (known.topic, known.schema, known.encoding, *sorted(known.metadata.items()))
        twins[words] = twins.get(words, 0) + 1
        connection = self._same.setdefault((*words, twins[words]), known)
        self.claims[connection] = self.claims.get(connection, 0) + messages
        return connection

    def _compare(self) -> None:
        """What the metadata has and the files have not."""
        for topic, kind, encoding, qos, digest, messages in self.bag.topics:
            there = [connection for connection in self.claims if connection.topic == topic]
            if not there:
                metadata = {"offered_qos_profiles": qos, "topic_type_hash": digest}
                self.claims[Connection(topic, (kind, "", b""), encoding, metadata)] = 0
                self.words.notes.append(f"{topic} ({kind}) is in {METADATA} alone; its channel has no schema")
            holds = sum(self.claims[connection] for connection in there)
            if holds < messages:
                self.words.lost.append(
                    f"{self.whole}: {METADATA} counts {messages} messages of {topic}, and {holds} are there"
                )


class Databases(_Files):
    """SQLite databases."""

    def __init__(self, paths: Sequence[Path], whole: Path, bag: Bag) -> None:
        self._databases: list[sqlite3.Connection] = []
        self._topics: list[dict[int, Connection]] = []
        self._distro = bag.distro
        self._undefined: dict[str, str] = {}
        super().__init__(paths, whole, bag)
        for kind, where in sorted(self._undefined.items()):
            words = (
                f"its definition is that of {where}" if where else "nobody here knows its definition: it has no schema"
            )
            self.words.notes.append(f"{whole} does not say what {kind} is; {words}")

    def extras(self, writer: log.LogWriter, has_clock: bool, passed_on: bool = False) -> None:
        """The bag's metadata, and those in the databases, as rosbag2 writes them to MCAP files."""
        super().extras(writer, has_clock, passed_on)
        if self._distro:
            writer.add_metadata("mcaptrack.bag", {"file": self.whole.name, "ros_distro": self._distro})
        for number in range(len(self.paths)):
            if self._columns(number, "metadata") >= {"metadata"}:
                for (text,) in self._ask(number, "SELECT metadata FROM metadata ORDER BY rowid"):
                    writer.add_metadata("rosbag2", {"serialized_metadata": _text(text)})

    def _open(self, number: int) -> None:
        path = self.paths[number]
        # What a recorder that was killed left beside it belongs to it; otherwise nothing is written beside it.
        left = any(path.with_name(path.name + end).exists() for end in ("-wal", "-journal"))
        try:
            name = f"{path.resolve().as_uri()}?{'mode=ro' if left else 'immutable=1'}"
            database = sqlite3.connect(name, uri=True)
        except sqlite3.Error as error:
            raise McaptrackError(f"{path} can't be opened: {error}") from None
        self.closing.callback(database.close)
        database.text_factory = bytes
        self._databases.append(database)
        topics, messages = (self._columns(number, table) for table in ("topics", "messages"))
        wanted = {"id", "name", "type", "serialization_format"}
        if not topics >= wanted or not messages >= {"topic_id", "timestamp", "data"}:
            raise McaptrackError(f"{path} is a database, but none of rosbag2: it has no topics and messages")
        counts = dict(self._ask(number, "SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
        ((total,),) = self._ask(number, "SELECT count(*) FROM messages")  # by the index of times, if there is one
        if total != sum(counts.values()):
            raise McaptrackError(
                f"{path} does not add up: its index counts {total} messages, and {sum(counts.values())} are there"
            )
        definitions = self._definitions(number)
        columns = [name if name in topics else "''" for name in ("offered_qos_profiles", "type_description_hash")]
        known: dict[int, Connection] = {}
        twins: dict[object, int] = {}
        query = f"SELECT id, name, type, serialization_format, {', '.join(columns)} FROM topics ORDER BY id"  # noqa: S608
        for key, *words in self._ask(number, query):
            topic, kind, encoding, qos, digest = map(_text, words)
            schema, defined_digest = definitions.get(kind) or (self._schema(kind, digest), "")
            metadata = {"offered_qos_profiles": qos, "topic_type_hash": digest or defined_digest}
            described = Connection(topic, schema, encoding, metadata)
            known[key] = self._connection(twins, described, counts.pop(key, 0))
        self._topics.append(known)
        for key, count in counts.items():
            self.words.lost.append(f"{path}: {count} messages of topic {key}, which is not described")

    def _definitions(self, number: int) -> dict[str, tuple[tuple[str, str, bytes], str]]:
        """The schema record and the hash of each type that a database defines."""
        if not self._distro and self._columns(number, "schema") >= {"ros_distro"}:
            self._distro = next((_text(row[0]) for row in self._ask(number, "SELECT ros_distro FROM schema")), "")
        columns = self._columns(number, "message_definitions")
        if not columns >= {"topic_type", "encoding", "encoded_message_definition"}:
            return {}
        digest = "type_description_hash" if "type_description_hash" in columns else "''"
        query = f"SELECT topic_type, encoding, encoded_message_definition, {digest} FROM message_definitions"  # noqa: S608
        rows = [tuple(map(_text, row)) for row in self._ask(number, query)]
        return {
            kind: ((kind, encoding, text.encode()), said)
            for kind, encoding, text, said in rows
            if encoding in ("ros2msg", "ros2idl") and (text or kind.endswith("/Empty"))
        }

    def _schema(self, kind: str, digest: str) -> tuple[str, str, bytes]:
        """The schema record of a type that the database does not define."""
        text, self._undefined[kind] = _known_definition(kind, self._distro.lower(), digest)
        return (kind, "ros2msg", text.encode()) if self._undefined[kind] else (kind, "", b"")

    def _messages(self, number: int, found: Found) -> Iterator[tuple[Connection, log.Message]]:
        known = self._topics[number]
        for key, t_ns, data in self._ask(number, "SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"):
            connection = known.get(key)
            if connection is None:
                continue
            if not isinstance(t_ns, int) or not isinstance(data, bytes):
                raise McaptrackError(f"{self.paths[number]} is damaged: a message without time or data")
            if self.bag.packed or (data.startswith(_ZSTD_MAGIC) and connection.encoding == "cdr"):  # CDR begins with 0
                data = _unpack_message(data, self.paths[number], t_ns)  # noqa: PLW2901
            count = self._passed.get(connection, 0)
            self._passed[connection] = count + 1
            yield connection, log.Message(t_ns, count % 2**32, t_ns, data)

    def _ask(self, number: int, query: str) -> Iterator[tuple[Any, ...]]:
        try:
            yield from self._databases[number].execute(query)
        except (sqlite3.Error, UnicodeDecodeError) as error:  # SQLite quotes what is damaged
            why = "it can't be understood" if isinstance(error, UnicodeDecodeError) else str(error)
            raise McaptrackError(f"{self.paths[number]} is damaged: {why}") from None

    def _columns(self, number: int, table: str) -> set[str]:
        return {_text(row[1]) for row in self._ask(number, f"PRAGMA table_info({table})")}


class Logs(_Files):
    """MCAP files."""

    def __init__(self, paths: Sequence[Path], whole: Path, bag: Bag) -> None:
        self.logs: list[log.Log] = []
        self._channels: list[dict[int, Connection]] = []
        super().__init__(paths, whole, bag)
        profiles = {log.profile(opened) for opened in self.logs}
        self.profile = profiles.pop() if len(profiles) == 1 else ""
        self.as_it_is = self.logs[0] if len(self.logs) == 1 and not bag.packed else None

    def extras(self, writer: log.LogWriter, has_clock: bool, passed_on: bool = False) -> None:
        """The bag's metadata, and all attachments and metadata of the files."""
        super().extras(writer, has_clock, passed_on)
        for opened in [] if passed_on else self.logs:
            log.pass_on_extras(opened, writer, without=[CLOCK] if has_clock else [])

    def _open(self, number: int) -> None:
        opened = self.closing.enter_context(log.read(self.paths[number], sidecar=False))
        self.logs.append(opened)
        known: dict[int, Connection] = {}
        twins: dict[object, int] = {}
        for channel in opened.index.channels.values():
            found = opened.index.schemas.get(channel.schema_id)
            schema = (found.name, found.encoding, found.data) if found else ("", "", b"")
            described = Connection(channel.topic, schema, channel.message_encoding, channel.metadata)
            known[channel.id] = self._connection(twins, described, opened.index.counts.get(channel.id, 0))
        self._channels.append(known)

    def _messages(self, number: int, found: Found) -> Iterator[tuple[Connection, log.Message]]:
        known = self._channels[number]
        for channel, message in log.stream(self.logs[number]):
            if self.bag.packed:
                payload = _unpack_message(message.payload, self.paths[number], message.t_ns)
                yield known[channel], message._replace(payload=payload)
            else:
                yield known[channel], message


def _text(value: Any) -> str:
    """Text that a database holds, as bytes or as something else."""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else "" if value is None else str(value)


def _unpack_message(data: bytes, path: Path, t_ns: int) -> bytes:
    import zstandard

    try:
        with zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(data) as stream:
            out: bytes = stream.read(_MAX_MESSAGE_BYTES + 1)
    except zstandard.ZstdError as error:
        raise McaptrackError(f"{path}: the message at {t_ns} ns can't be decompressed: {error}") from None
    if len(out) > _MAX_MESSAGE_BYTES:
        raise McaptrackError(f"{path}: the message at {t_ns} ns has more than {_MAX_MESSAGE_BYTES} bytes, decompressed")
    return out


@cache
def _known_definition(kind: str, distro: str, digest: str) -> tuple[str, str]:
    """The definition of a type and whose it is: of the distribution, or else of the newest whose hash is the same."""
    from rosbags.typesys import Stores, get_typestore

    all_stores = {store.value.removeprefix("ros2_"): store for store in Stores if store.value.startswith("ros2_")}
    named = {distro: all_stores[distro]} if distro in all_stores else {}
    for name, store in (named or dict(reversed(all_stores.items()))).items():
        types = get_typestore(store)
        try:
            if digest.startswith("RIHS01_") and types.hash_rihs01(kind) != digest:
                continue
            return types.generate_msgdef(kind, ros_version=2)[0], f"ROS 2 {name.capitalize()}"
        except Exception:  # noqa: BLE001, PERF203, S112, RUF100  # it fails in many ways for types it has not
            continue
    return "", ""
