"""A whole log as it stands in its file, for whoever passes everything on."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from mcaptrack.log import records
from mcaptrack.log.chunks import message_head, open_chunk
from mcaptrack.log.messages import Message
from mcaptrack.log.reader import Log
from mcaptrack.log.records import MAGIC, Bytes, Opcode, Record, walk
from mcaptrack.log.writer import LogWriter


def stream(log: Log) -> Iterator[tuple[int, Message]]:
    """The channel (its id) and the message of all messages, a chunk in memory at a time.

    Raises McaptrackError where the log is damaged, and at the end if it was changed meanwhile.
    """
    source = log.snapshot.source.front_to_back()
    with log.snapshot.mending():
        for record in walk(source, len(MAGIC), log.index.data_end):
            if record.opcode == Opcode.MESSAGE:
                yield _message(source, record)
            elif record.opcode == Opcode.CHUNK:
                content = open_chunk(source, record)
                for inner in walk(content, 0, len(content)):
                    if inner.opcode == Opcode.MESSAGE:
                        yield _message(content, inner)
        log.snapshot.confirm_all()


def _message(buffer: Bytes, record: Record) -> tuple[int, Message]:
    channel, sequence, t_ns, publish_ns = message_head(buffer, record)
    payload = bytes(buffer[record.body + records.MESSAGE_HEAD.size : record.end])
    return channel, Message(t_ns, sequence, publish_ns, payload)


def header(log: Log) -> tuple[str, str]:
    """The profile that the log's header names, and the library that wrote it."""
    with log.snapshot.mending():
        whole = log.snapshot.record(len(MAGIC))
        return records.read_header(whole, records.record_at(whole, 0))


def copy_attachments_and_metadata(log: Log, writer: LogWriter, *, without: Collection[str] = ()) -> None:
    """Write the log's attachments, and its metadata records of all names but these, as they are."""
    with log.snapshot.mending():
        for listed in log.index.metadata:
            if listed.name not in without:
                writer.put_metadata(bytes(log.snapshot.record(listed.offset)))
        for listed in log.index.attachments:
            writer.put_attachment(bytes(log.snapshot.record(listed.offset)))
