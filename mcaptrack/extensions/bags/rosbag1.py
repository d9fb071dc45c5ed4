"""ROS 1 bags, version 2.0, as http://wiki.ros.org/Bags/Format/2.0 describes them.

Read sequentially, chunk by chunk, and checked against the index: memory does not grow with the bag, and of a bag that
was cut off the complete part is read.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from mcap.well_known import MessageEncoding, Profile, SchemaEncoding

from mcaptrack.contracts import ReadingNotes, RecordedChannel, RecordedMessage, RecordingReader
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.bags.unpacking import decompress_steps
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.sources.ingest.decompression import limit_of, too_large

_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7
_MAGIC: Final = b"#ROSBAG V2.0\n"
_U32: Final = struct.Struct("<I")
_U32_PAIR: Final = struct.Struct("<II")
_MAX_HEADER_BYTES: Final = 2**20
#: Records with more data are not read.
_MAX_DATA_BYTES: Final = 2**28

Fields = Mapping[bytes, bytes]


class _InvalidRecord(Exception):
    """Bytes that are not a complete, valid record."""


class _Record(NamedTuple):
    op: int
    fields: Fields
    data: int
    end: int


class Bag1(RecordingReader):
    """A ROS 1 bag, open for reading."""

    profile = Profile.ROS1

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self._file = self.closing.enter_context(path.open("rb"))
        self._size = path.stat().st_size
        self._known: dict[int, RecordedChannel] = {}
        try:
            self._end, self._why_unindexed = self._read_index()
            if self._why_unindexed:
                for _ in self.messages(ReadingNotes()):
                    pass
        except _InvalidRecord as error:
            self.close()
            raise McaptrackError(f"{path} can't be read as a ROS bag: {error}") from None
        except BaseException:
            self.close()
            raise
        self.channels = list(self._known.values())

    def messages(self, report: ReadingNotes) -> Iterator[RecordedMessage]:
        """All messages in the order of the bag. Parts that can't be read are reported in ``report``."""
        at = self._start
        if self._why_unindexed:  # without an index there is no way to tell whether messages are missing
            lines = report.lost if self._index_at else report.notes
            lines.append(f"{self.path} {self._why_unindexed}; what is complete in it is read")
        while at < self._end:
            try:
                record = self._record(at, self._end)
            except _InvalidRecord as error:
                report.lost.append(f"{self.path}: byte {at} and what follows: {error}")
                return
            parts = self._chunk(record, report) if record.op == _CHUNK else self._unchunked(record, report)
            for number, t_ns, payload in parts:
                channel = self._known.get(number)
                if channel is None:
                    report.lost.append(f"{self.path}: a message of connection {number}, which is not described")
                    continue
                yield RecordedMessage(channel, t_ns, payload)
            at = record.end

    # The file

    def _read_index(self) -> tuple[int, str]:
        """The end of the messages, and why there is no usable index ("" if there is one)."""
        magic = self._at(0, min(len(_MAGIC), self._size))
        if magic != _MAGIC:
            version = magic.removeprefix(b"#ROSBAG V").split(b"\n")[0].decode("ascii", "replace")
            raise _InvalidRecord(f"it is of version {version}; 2.0 is read")
        bag = self._record(len(_MAGIC), self._size)
        if bag.op != _BAG:
            raise _InvalidRecord("it has no header")
        if bag.fields.get(b"encryptor"):
            raise _InvalidRecord(f"it is encrypted by {bag.fields[b'encryptor'].decode('utf-8', 'replace')}")
        self._start = bag.end
        self._index_at = int.from_bytes(bag.fields.get(b"index_pos", b""), "little")
        if not self._index_at:
            return self._size, "was never closed and has no index"
        if self._index_at > self._size:
            return self._size, f"is cut off: {self._size} bytes, and its index would begin at byte {self._index_at}"
        try:
            self._read_declared_counts(
                self._number(bag.fields, b"conn_count"), self._number(bag.fields, b"chunk_count")
            )
        except _InvalidRecord as error:
            self._known.clear()
            return self._index_at, f"has an index that can't be read ({error})"
        return self._index_at, ""

    def _read_declared_counts(self, connections: int, chunks: int) -> None:
        at, counts, seen = self._index_at, dict[int, int](), 0
        while at < self._size:
            record = self._record(at, self._size)
            if record.op == _CONNECTION:
                self._describe(record.fields, self._at(record.data, record.end))
            elif record.op == _CHUNK_INFO:
                seen += 1
                data = self._at(record.data, record.end)
                for number, count in _U32_PAIR.iter_unpack(data[: len(data) // 8 * 8]):
                    counts[number] = counts.get(number, 0) + count
            at = record.end
        if len(self._known) != connections or seen != chunks:
            raise _InvalidRecord(
                f"{len(self._known)} connections and {seen} chunks where the header says {connections} and {chunks}"
            )
        if not counts.keys() <= self._known.keys():
            raise _InvalidRecord("it counts messages of connections that it does not describe")
        self.declared_counts = {connection: counts.get(number, 0) for number, connection in self._known.items()}

    def _at(self, start: int, end: int) -> bytes:
        if end - start > _MAX_DATA_BYTES:
            raise _InvalidRecord(f"a record has {end - start} bytes; at most {_MAX_DATA_BYTES} are read")
        self._file.seek(start)
        data = self._file.read(end - start)
        if len(data) != end - start:
            raise _InvalidRecord("the file is shorter than it was")
        return data

    def _record(self, at: int, end: int) -> _Record:
        """The record at an offset of the file; the data of a chunk that is cut off may extend beyond ``end``."""
        if end - at < 4:
            raise _InvalidRecord("a record is cut off")
        size = _U32.unpack(self._at(at, at + 4))[0]
        if size > min(_MAX_HEADER_BYTES, end - at - 8):
            raise _InvalidRecord("a record is cut off or invalid")
        head = self._at(at + 4, at + 8 + size)
        fields = _fields(head[:size])
        data = at + 8 + size
        record = _Record(_op(fields), fields, data, data + _U32.unpack_from(head, size)[0])
        if record.end > end and record.op != _CHUNK:
            raise _InvalidRecord("a record is cut off")
        return record

    # Records

    def _describe(self, fields: Fields, data: bytes) -> None:
        number, described = self._number(fields, b"conn"), _connection(fields, _fields(data))
        before = self._known.setdefault(number, described)
        if (before.topic, before.schema) != (described.topic, described.schema):
            raise _InvalidRecord(
                f"connection {number} is of {before.topic}, and of {described.topic} or of other words here"
            )

    def _unchunked(self, record: _Record, report: ReadingNotes) -> Iterator[tuple[int, int, bytes]]:
        """A record outside of chunks: messages of a chunk that was never finished."""
        if record.op in (_MESSAGE, _CONNECTION):
            try:
                whole = self._at(record.data, record.end)
                yield from self._take(record.op, record.fields, whole)
            except _InvalidRecord as error:
                report.lost.append(f"{self.path}: byte {record.data}: {error}")

    def _chunk(self, record: _Record, report: ReadingNotes) -> Iterator[tuple[int, int, bytes]]:
        """The messages of a chunk, or of its complete part."""
        where = f"{self.path}: the chunk at byte {record.data}"
        try:
            size = self._number(record.fields, b"size")
            data = self._at(record.data, min(record.end, self._end))
            content = _decompress(data, record.fields.get(b"compression", b"none"), size)
        except _InvalidRecord as error:
            report.lost.append(f"{where}: {error}")
            return
        at = 0
        try:
            while at < len(content):
                fields, start, end = _record_in(content, at)
                yield from self._take(_op(fields), fields, content[start:end])
                at = end
            if record.end > self._end or len(content) != size:
                raise _InvalidRecord("its records end there")
        except _InvalidRecord as error:
            cut = "which is cut off, " if record.end > self._end else ""
            report.lost.append(f"{where}, {cut}from its byte {at} of {size} on: {error}")

    def _take(self, op: int, fields: Fields, data: bytes) -> Iterator[tuple[int, int, bytes]]:
        if op == _CONNECTION:
            self._describe(fields, data)
        elif op == _MESSAGE:
            time = fields.get(b"time", b"")
            if len(time) != _U32_PAIR.size:
                raise _InvalidRecord("a message has no time")
            seconds, nanoseconds = _U32_PAIR.unpack(time)
            yield self._number(fields, b"conn"), seconds * NS_PER_S + nanoseconds, data

    @staticmethod
    def _number(fields: Fields, name: bytes) -> int:
        value = fields.get(name, b"")
        if len(value) != _U32.size:
            raise _InvalidRecord(f"a record has no {name.decode()}")
        return int.from_bytes(value, "little")


def _record_in(content: bytes, at: int) -> tuple[Fields, int, int]:
    """The record at an offset of a chunk: its fields, and start and end of its data."""
    if len(content) - at < 4:
        raise _InvalidRecord("a record is cut off")
    start = at + 8 + _U32.unpack_from(content, at)[0]
    if start > len(content):
        raise _InvalidRecord("a record is cut off")
    end = start + _U32.unpack_from(content, start - 4)[0]
    if end > len(content):
        raise _InvalidRecord("a record is cut off")
    return _fields(content[at + 4 : start - 4]), start, end


def _fields(data: bytes) -> dict[bytes, bytes]:
    """Parse the header of a record: name=value fields, each preceded by its length."""
    fields, at = {}, 0
    while at < len(data):
        end = at + 4 + _U32.unpack_from(data, at)[0] if len(data) - at >= 4 else len(data) + 1
        name, sign, value = data[at + 4 : end].partition(b"=")
        if end > len(data) or not sign:
            raise _InvalidRecord("the header of a record is invalid")
        fields[name] = value
        at = end
    return fields


def _op(fields: Fields) -> int:
    value = fields.get(b"op", b"")
    if len(value) != 1:
        raise _InvalidRecord("a record does not say what it is")
    return value[0]


def _connection(fields: Fields, published: Mapping[bytes, bytes]) -> RecordedChannel:
    """Parse a connection: ``fields`` is the header of the record, ``published`` that of the publisher."""
    topic = _text(fields.get(b"topic", b""))
    if not topic or not published.get(b"type"):
        raise _InvalidRecord("a connection has no topic or no type")
    schema = (
        _text(published.get(b"type", b"")),
        SchemaEncoding.ROS1,
        _text(published.get(b"message_definition", b"")).encode(),
    )
    metadata = {
        _text(name): _text(value) for name, value in published.items() if name not in (b"type", b"message_definition")
    }
    if "latching" in metadata:  # as the ros1 profile of the MCAP registry has it
        metadata["latching"] = "true" if metadata["latching"].strip() == "1" else "false"
    return RecordedChannel(topic, schema, MessageEncoding.ROS1, metadata)


def _text(data: bytes) -> str:
    """Decode UTF-8, or else Latin-1, which old definitions often have in comments."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _decompress(data: bytes, compression: bytes, size: int) -> bytes:
    """Decompress to at most ``size`` + 1 bytes; to less if ``data`` is cut off."""
    most = limit_of(len(data))
    if size > most:
        raise _InvalidRecord(str(too_large(size, most)))
    try:
        if compression == b"none":
            return data
        if compression == b"bz2":
            import bz2

            return decompress_steps(bz2.BZ2Decompressor(), data, size + 1)
        if compression == b"lz4":
            import lz4.frame

            return decompress_steps(lz4.frame.LZ4FrameDecompressor(), data, size + 1)
    except (OSError, ValueError, RuntimeError, EOFError) as error:
        raise _InvalidRecord(f"it can't be decompressed ({error})") from None
    raise _InvalidRecord(f"it is compressed with {compression.decode('utf-8', 'replace')!r}; bz2 and lz4 are read")
