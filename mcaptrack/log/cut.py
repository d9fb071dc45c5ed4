"""Copy messages of logs to another log, chunk by chunk in the order of time.

A chunk that is wanted as it is stays so, to the byte. Of others the messages that are wanted become a new chunk. Each
chunk is opened, so that damage is found here and not by those who read the copy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode

from mcaptrack.geometry.arrays import Bools, Ints
from mcaptrack.log import records
from mcaptrack.log.chunks import (
    HEAD,
    LOG_MAX_NS,
    Entries,
    MessageHeads,
    chunk_record,
    contents_of,
    message_head,
    message_heads_at,
    open_chunk,
    read_index_entries,
    records_between,
)
from mcaptrack.log.reader import Log
from mcaptrack.log.records import MAGIC, Bytes, Damaged, walk
from mcaptrack.log.writer import ChunkKind, LogWriter
from mcaptrack.notices import Progress

#: Messages outside of chunks become chunks of so many.
_TOGETHER: Final = 4096
_IDS: Final = 2**16


class Part(NamedTuple):
    """The channels of a file to copy: for each its id in the new log, and the time of the first message to copy.

    ``ids`` are those ids by the id in this ``log``, and ``since_ns`` these times in ns.
    """

    log: Log
    ids: dict[int, int]
    since_ns: dict[int, int]


def copy_messages(
    writer: LogWriter, parts: Sequence[Part], end_ns: int, progress: Progress = lambda *_: None
) -> list[str]:
    """Copy the messages of parts of logs before a time; the channels are added to the new log already.

    Returns a line for each chunk that is lost because it is damaged. Raises McaptrackError if a log changes meanwhile.

    They are written by ``writer``, up to before ``end_ns``; ``progress`` is called with "cut", and the chunks that are
    done and all.
    """
    lost: list[str] = []
    copies = [_Copy(writer, part, end_ns - 1) for part in parts]
    todo = sorted((t_ns, number, place) for number, copy in enumerate(copies) for t_ns, place in copy.places())
    for done, (_, number, place) in enumerate(todo):
        try:
            copies[number].copy(place)
        except Damaged as error:
            lost.append(f"{parts[number].log.path}: {error}; {copies[number].held(place)}")
        progress("cut", done + 1, len(todo))
    for part in parts:
        part.log.snapshot.confirm_file_unchanged()
    return lost


class _Copy:
    """Copies messages of one file. A place is a row of its list of chunks, or below 0 messages outside of chunks."""

    def __init__(self, writer: LogWriter, part: Part, last_ns: int) -> None:
        self._writer, self._last_ns = writer, np.uint64(last_ns)
        self._log, self._index, self._source = part.log, part.log.index, part.log.snapshot.source
        self._ids, self._since = np.zeros(_IDS, np.int64), np.full(_IDS, LOG_MAX_NS, np.uint64)
        for number, new in part.ids.items():
            self._ids[number], self._since[number] = new, part.since_ns[number]
        self._schemas = {number for number, it in self._index.schemas.items() if writer.schemas.get(number) == it}
        #: Channels that are described in the new log by the same records.
        self._same = {
            number
            for number, new in part.ids.items()
            if (channel := self._index.channels[number]) == writer.channels[new]
            if not channel.schema_id or channel.schema_id in self._schemas
        }
        self._loose = self._pieces()

    def _pieces(self) -> list[tuple[Ints, Entries]]:
        """Channels and entries of the messages outside of chunks, by time."""
        loose = {number: entries for number, entries in self._index.loose.items() if self._ids[number]}
        if not loose:
            return []
        channel = np.repeat(list(loose), [len(entries) for entries in loose.values()])
        entries = np.concatenate(list(loose.values()))
        order = np.argsort(entries[:, 0], kind="stable")
        order = order[self._are_wanted(channel[order], entries[order, 0])]
        return [
            (channel[some], entries[some])
            for some in np.split(order, range(_TOGETHER, len(order), _TOGETHER))
            if len(some)
        ]

    def _are_wanted(self, channel: Ints, t_ns: Entries) -> Bools:
        return (self._ids[channel] > 0) & (t_ns >= self._since[channel]) & (t_ns <= self._last_ns)

    def places(self) -> Iterator[tuple[int, int]]:
        """The places that may have wanted messages, each with its first time; a store learns that they will be read."""
        chunks = self._index.chunks
        rows = chunks.rows_with(np.flatnonzero(self._ids).tolist())
        start_ns, end_ns = chunks.start_ns[rows], chunks.end_ns[rows]
        near = (end_ns >= self._since.min()) & (start_ns <= self._last_ns)
        rows, start_ns = rows[near], start_ns[near]
        self._source.expect(list(zip(chunks.offsets[rows].tolist(), chunks.ends[rows].tolist(), strict=True)))
        yield from zip(start_ns.tolist(), rows.tolist(), strict=True)
        yield from ((int(entries[0, 0]), -1 - number) for number, (_, entries) in enumerate(self._loose))

    def held(self, place: int) -> str:
        """The messages of a place that is lost, as text."""
        if place < 0:
            return f"{len(self._loose[-1 - place][0])} messages outside of chunks are left out"
        return f"its {contents_of(self._index.chunks[place], self._index.channels)} are left out"

    def copy(self, place: int) -> None:
        """Copy the wanted messages of a place."""
        if place < 0:
            channel, entries = self._loose[-1 - place]
            self._one_by_one(self._source, channel, entries[:, 1].astype(np.int64))
            return
        listed = self._index.chunks[place]
        those = {
            number: read_index_entries(self._source, at, number)
            if at
            else self._index.entries[listed.chunk_start_offset][number]
            for number, at in listed.message_index_offsets.items()
            if self._ids[number]
        }
        channel = np.repeat(list(those), [len(entries) for entries in those.values()])
        t_ns, offset = np.concatenate(list(those.values())).T
        offset = offset.astype(np.int64)
        wanted = self._are_wanted(channel, t_ns)
        if not wanted.any():
            return
        record = chunk_record(self._source, listed)
        content = open_chunk(self._source, record)
        order = np.flatnonzero(wanted)[np.argsort(offset[wanted], kind="stable")]
        if not isinstance(content, memoryview):  # it is too large for memory
            self._one_by_one(content, channel[order], offset[order])
            return
        heads = message_heads_at(content, channel.astype(np.uint16), t_ns, offset)
        head, span = records.read_chunk(self._source, record), (int(t_ns.min()), int(t_ns.max()))
        is_whole = wanted.all() and len(those) == len(listed.message_index_offsets)
        if is_whole and (head.start_ns, head.end_ns) == span and self._describes_the_same(content, heads):
            whole = bytes(self._source[record.start : record.end])
            self._writer.copy_chunk(whole, listed, {number: entries.tobytes() for number, entries in those.items()})
            return
        heads = MessageHeads(heads.head[order], heads.start[order], heads.end[order])
        kind: ChunkKind = "rows" if listed.compression else "media"
        self._writer.copy_messages(kind, content, heads, self._ids[channel[order]])

    def _describes_the_same(self, content: Bytes, heads: MessageHeads) -> bool:
        """Whether a chunk may stay as it is: all that it describes, the new log describes by the same ids."""
        if not self._same.issuperset(np.unique(heads.head["channel"]).tolist()):
            return False
        for inner in records_between(content, heads.start - HEAD.itemsize, heads.end):
            if inner.opcode == Opcode.CHANNEL:
                is_same = records.read_channel(content, inner).id in self._same
            else:
                is_same = inner.opcode == Opcode.SCHEMA and records.read_schema(content, inner).id in self._schemas
            if not is_same:
                return False
        return True

    def _one_by_one(self, buffer: Bytes, channel: Ints, offset: Ints) -> None:
        """Copy messages at offsets of a buffer, which may be a file."""
        for number, at in zip(channel.tolist(), offset.tolist(), strict=True):
            record = records.record_at(buffer, at)
            _, _, t_ns, _ = message_head(buffer, record)
            whole = bytearray(buffer[record.start : record.end])
            new = int(self._ids[number])
            whole[records.MESSAGE_ID_AT : records.MESSAGE_ID_AT + 2] = records.number(new, 2)
            self._writer.copy_message(new, t_ns, memoryview(whole))
        self._writer.close_chunks()


def private_records(log: Log) -> Iterator[bytes]:
    """The records outside of chunks of a kind that MCAP doesn't define. Known records are not read.

    ``log`` is open for reading.
    """
    index, source = log.index, log.snapshot.source
    spans = [*zip(index.chunks.offsets.tolist(), index.chunks.ends.tolist(), strict=True), (index.data_end,) * 2]
    spans += [(it.offset, records.record_at(source, it.offset).end) for it in (*index.attachments, *index.metadata)]
    at = len(MAGIC)
    for start, end in sorted(spans):
        for record in walk(source, at, start):
            if record.opcode > Opcode.DATA_END:
                yield bytes(source[record.start : record.end])
        at = end
