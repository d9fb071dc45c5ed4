"""All records of a log in file order, to copy them to another log."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from mcaptrack.log import records
from mcaptrack.log.chunks import message_head, open_chunk
from mcaptrack.log.messages import Message
from mcaptrack.log.reader import Log
from mcaptrack.log.records import MAGIC, Bytes, Opcode, Record, walk
from mcaptrack.log.writer import LogWriter


def stream(log: Log) -> Iterator[tuple[int, Message]]:
    """All messages in file order, each with the id of its channel; one chunk in memory at a time.

    Raises McaptrackError where the log is damaged, and at the end if it was changed meanwhile.
    """
    source = log.snapshot.source.sequential()
    with log.snapshot.reporting_damage():
        for record in walk(source, len(MAGIC), log.index.data_end):
            if record.opcode == Opcode.MESSAGE:
                yield _message(source, record)
            elif record.opcode == Opcode.CHUNK:
                content = open_chunk(source, record)
                for inner in walk(content, 0, len(content)):
                    if inner.opcode == Opcode.MESSAGE:
                        yield _message(content, inner)
        log.snapshot.confirm_file_unchanged()


def _message(buffer: Bytes, record: Record) -> tuple[int, Message]:
    channel, sequence, t_ns, publish_ns = message_head(buffer, record)
    payload = bytes(buffer[record.body + records.MESSAGE_HEAD.size : record.end])
    return channel, Message(t_ns, sequence, publish_ns, payload)


def header(log: Log) -> tuple[str, str]:
    """The profile and the library in the header of a log."""
    with log.snapshot.reporting_damage():
        whole = log.snapshot.record(len(MAGIC))
        return records.read_header(whole, records.record_at(whole, 0))


def copy_attachments_and_metadata(log: Log, writer: LogWriter, *, without: Collection[str] = ()) -> None:
    """Copy the attachments of a log, and its metadata records except those named in ``without``."""
    with log.snapshot.reporting_damage():
        for listed in log.index.metadata:
            if listed.name not in without:
                writer.copy_metadata(bytes(log.snapshot.record(listed.offset)))
        for listed in log.index.attachments:
            writer.copy_attachment(bytes(log.snapshot.record(listed.offset)))
