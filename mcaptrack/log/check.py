"""Is a log sound? Every record is looked at, whatever the summary says; then the summary is held against them.

Letters: M messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mcaptrack import notices
from mcaptrack.errors import McaptrackError
from mcaptrack.files import follow_links
from mcaptrack.log import records
from mcaptrack.log.byte_source import ByteSource, OpenFile, RunningChecksum, Signature
from mcaptrack.log.check_summary import Finding, Findings, check_summary, record_name
from mcaptrack.log.chunks import (
    HEAD,
    MAX_NS,
    Entries,
    chunk_entries,
    heads_at,
    listed_entries,
    message_head,
    open_chunk,
)
from mcaptrack.log.index import Index, begins_as_log, ends_as_log, list_attachment, list_metadata
from mcaptrack.log.journal import find_content, journal_of
from mcaptrack.log.journal_check import changed, find_journal
from mcaptrack.log.records import MAGIC, Bytes, ChunkIndexRecord, Damaged, Opcode, Reader, Record, walk

Progress = Callable[[str, int, int], None]


@dataclass
class CheckResult:
    """What was found in a log."""

    path: Path
    messages: int = 0
    chunks: int = 0
    findings: list[Finding] = field(default_factory=list)

    @property
    def is_sound(self) -> bool:
        """Whether nothing is wrong; what could be better doesn't count."""
        return all(finding.level != "error" for finding in self.findings)


def check(path: Path, progress: Progress = lambda *_: None) -> CheckResult:
    """Look at every byte of a log. Raises McaptrackError only if there is no file to look at.

    Checksums, sizes and times of chunks, message indexes, the order of each channel's messages, attachments, and
    everything that the summary and the footer say. What is found is grouped by kind.
    """
    with open_bytes(path) as (source, file):
        signature = Signature.of(file.handle)
        found = find_journal(path, file)
        if found and found.is_busy:
            raise McaptrackError(f"{path} is being written to by another process; try again when it is done")
        half = found.journal if found else None
        if found and not half:
            notices.warn(found.words, "journal")
        look = _Look((half.overlay() if half else source).front_to_back(), progress)
        if found and half:
            look.findings.add("half-written", half.start, found.words)
        try:
            look.at_everything()
        except Damaged as error:  # damage to the content is a finding
            raise McaptrackError(f"{path} can't be read to its end: {error}") from None
        if Signature.of(file.handle) != signature:
            raise changed(path)
    findings = sorted(look.findings, key=lambda found: (found.level, found.where))
    return CheckResult(path, sum(look.found.counts.values()), len(look.found.chunks), findings)


def is_sound(source: ByteSource) -> bool:
    """Whether a look at every byte finds no error."""
    look = _Look(source.front_to_back(), lambda *_: None)
    try:
        look.at_everything()
    except Damaged:
        return False
    return all(finding.level != "error" for finding in look.findings)


def best_content(path: Path, source: ByteSource, file: OpenFile) -> ByteSource:
    """What to save of a log that a journal lies beside: the log as the journal has it where the file itself is damaged.

    Since the log itself stays as it is, a journal will do that doesn't prove that it is of this very file.
    """
    found = find_journal(path, file)
    if found is None:
        return source
    before = found.journal.overlay() if found.journal else find_content(follow_links(path), file)
    if before is None or (not found.journal and is_sound(source)) or not is_sound(before):
        notices.warn(found.words, "journal")
        return source
    notices.warn(
        f"{path} was left half written by a change that was interrupted; it is saved as it was before, by what "
        f"{journal_of(follow_links(path)).name} holds",
        "journal",
    )
    return before


@contextmanager
def open_bytes(path: Path) -> Iterator[tuple[ByteSource, OpenFile]]:
    """The bytes of a file. Raises McaptrackError if it is none or empty."""
    file = OpenFile.at(path)
    try:
        source = ByteSource.of(file)
        if not len(source):
            raise McaptrackError(f"{path} is empty")
        yield source, file
    finally:
        file.close()


class _Look:
    """One look at a file; ``found`` is what its records say, the way an index would say it."""

    def __init__(self, buffer: ByteSource, progress: Progress) -> None:
        self.found = Index()
        self.findings = Findings()
        self._find = self.findings.add
        self._buffer, self._progress = buffer, progress
        self._chunk: tuple[Record, dict[int, int]] | None = None  # the last one, and the indexes behind it
        self._latest: dict[int, int] = {}  # log time, of each channel

    def at_everything(self) -> None:
        buffer = self._buffer
        if not begins_as_log(buffer):
            self._find("magic", 0, "the file does not begin as an MCAP file does")
            return
        ends_well = ends_as_log(buffer)
        if not ends_well:
            self._find("cut-off", len(buffer), "the file is cut off: the magic bytes at its end are missing")
        end = len(buffer) - len(MAGIC) if ends_well else len(buffer)
        try:
            self._at_data(end)
        except Damaged as error:
            self._find("structure", 0, f"{error}; what follows can't be looked at")
        self._close_chunk()
        if ends_well:
            check_summary(buffer, self.found, self.findings)

    # The data section

    def _at_data(self, end: int) -> None:
        buffer, is_first, shown = self._buffer, True, 0
        checksum = RunningChecksum(buffer)
        for record in walk(buffer, len(MAGIC), end):
            if is_first and record.opcode != Opcode.HEADER:
                self._find("no-header", record.start, "the first record is not a header")
            is_first = False
            if record.opcode != Opcode.MESSAGE_INDEX:
                self._close_chunk()
                checksum.pass_over(record.start)
            if record.opcode == Opcode.DATA_END:
                self.found.data_end = record.start
                self.found.data_crc = Reader(buffer, record.body, record.end).number(4)
                if self.found.data_crc and self.found.data_crc != checksum.upto(record.start):
                    self._find("data-checksum", record.start, "the checksum of the data section is wrong")
                return
            try:
                self._at_record(record)
            except Damaged as error:
                self._find(f"bad-{record_name(record.opcode)}", record.start, str(error))
            if record.end - shown >= records.BLOCK:
                shown = record.end
                self._progress("check", shown, len(buffer))
        self._find("no-data-end", end, "the data section has no end: records are missing")

    def _at_record(self, record: Record) -> None:
        buffer, found = self._buffer, self.found
        if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._describe(buffer, record, record.start)
        elif record.opcode == Opcode.CHUNK:
            self._chunk = (record, {})
        elif record.opcode == Opcode.MESSAGE_INDEX:
            channel, _ = records.read_message_entries(buffer, record)
            if self._chunk is None:
                self._find("stray-index", record.start, "a message index that stands behind no chunk")
            elif channel in self._chunk[1]:
                self._find("double-index", record.start, f"two message indexes of channel {channel} behind one chunk")
            else:
                self._chunk[1][channel] = record.start
        elif record.opcode == Opcode.MESSAGE:
            channel, _, t_ns, _ = message_head(buffer, record)
            self._find("unchunked", record.start, "a message outside of chunks: finding it takes a scan", "warning")
            self._count({channel: np.array([[t_ns, record.start]], "<u8")}, record.start)
        elif record.opcode == Opcode.ATTACHMENT:
            if not records.attachment_is_whole(buffer, record):
                self._find("attachment-checksum", record.start, "the checksum of an attachment is wrong")
            found.attachments.append(list_attachment(buffer, record, record.start))
        elif record.opcode == Opcode.METADATA:
            found.metadata.append(list_metadata(buffer, record, record.start))
        elif record.opcode == Opcode.HEADER:
            records.read_header(buffer, record)
        elif record.opcode == 0 or record.opcode in (Opcode.FOOTER, Opcode.STATISTICS, Opcode.CHUNK_INDEX):
            self._find("misplaced", record.start, f"a {record_name(record.opcode)} record in the data section")
        elif record.opcode < 0x80 and record.opcode > Opcode.DATA_END:
            self._find("unknown", record.start, f"a record of kind {record.opcode:#04x}, which is not known", "warning")

    def _describe(self, buffer: Bytes, record: Record, where: int) -> None:
        """A schema or channel, which is the same wherever it stands."""
        if record.opcode == Opcode.SCHEMA:
            schema = records.read_schema(buffer, record)
            if schema.id == 0:
                self._find("schema-zero", where, "a schema of number 0, which means none")
            elif self.found.schemas.setdefault(schema.id, schema) != schema:
                self._find("two-schemas", where, f"schema {schema.id} is described in two ways")
        else:
            channel = records.read_channel(buffer, record)
            if channel.schema_id and channel.schema_id not in self.found.schemas:
                self._find("no-schema", where, f"{channel.topic} has schema {channel.schema_id}, not described before")
            if self.found.channels.setdefault(channel.id, channel) != channel:
                self._find("two-channels", where, f"channel {channel.id} ({channel.topic}) is described in two ways")

    def _close_chunk(self) -> None:
        """Look into the last chunk, now that its indexes are known."""
        if self._chunk is None:
            return
        (record, indexes), self._chunk = self._chunk, None
        try:
            self._at_chunk(record, indexes)
        except Damaged as error:
            self._find("bad-chunk", record.start, str(error))

    def _at_chunk(self, record: Record, indexes: Mapping[int, int]) -> None:
        buffer = self._buffer
        head = records.read_chunk(buffer, record)
        content = open_chunk(buffer, record)
        if not head.uncompressed_crc and len(content):
            self._find("no-checksum", record.start, "a chunk without a checksum: damage goes unseen", "warning")
        entries = self._indexed(record, content, indexes) if indexes else chunk_entries(content)
        if not indexes:
            self._describe_all(content, record.start)
            if entries:
                words = "a chunk without message indexes: finding a message takes a scan"
                self._find("no-message-index", record.start, words, "warning")
        self._count(entries, record.start)
        times = [int(edge) for e in entries.values() if len(e) for edge in (e[:, 0].min(), e[:, 0].max())]
        span = (min(times), max(times)) if times else (0, 0)
        if (head.start_ns, head.end_ns) != span:
            words = (
                f"a chunk says it runs from {head.start_ns} to {head.end_ns} ns; its messages {span[0]} to {span[1]}"
            )
            self._find("chunk-times", record.start, words)
        last = max((records.record_at(buffer, at).end for at in indexes.values()), default=record.end)
        sizes = (head.compression, head.end - head.start, head.uncompressed_size)
        place = (record.start, record.end - record.start, dict(indexes), last - record.end)
        self.found.chunks.append(ChunkIndexRecord(head.start_ns, head.end_ns, *place, *sizes))

    def _describe_all(self, content: Bytes, where: int) -> None:
        for inner in walk(content, 0, len(content)):
            if inner.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._describe(content, inner, where)

    def _indexed(self, record: Record, content: Bytes, indexes: Mapping[int, int]) -> dict[int, Entries]:
        """What the indexes of a chunk list, which is all of its messages and nothing else."""
        entries: dict[int, Entries] = {}
        starts, ends = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        for channel, at in indexes.items():
            listed = listed_entries(self._buffer, at, channel)
            try:
                heads = heads_at(content, channel, listed[:, 0], listed[:, 1].astype(np.int64))
            except Damaged as error:
                self._find("wrong-index", at, f"a message index does not fit its chunk: {error}")
                self._describe_all(content, record.start)
                return chunk_entries(content)
            entries[channel] = listed[np.argsort(listed[:, 1], kind="stable")]
            starts.append(heads.start - HEAD.itemsize)
            ends.append(heads.end)
        start, end = np.sort(np.concatenate(starts)), np.sort(np.concatenate(ends))
        # Between the messages that are listed stand the others, and what describes them.
        gap_from = np.concatenate([[0], end])
        gap_to = np.concatenate([start, [len(content)]])
        for low, high in zip(*(edge[gap_from != gap_to].tolist() for edge in (gap_from, gap_to)), strict=True):
            for inner in walk(content, low, high):
                if inner.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._describe(content, inner, record.start)
                elif inner.opcode == Opcode.MESSAGE:
                    channel, _, t_ns, _ = message_head(content, inner)
                    self._find("not-listed", record.start, f"a message of channel {channel} that no index lists")
                    entry = np.array([[t_ns, inner.start]], "<u8")
                    entries[channel] = np.concatenate([entries.get(channel, entry[:0]), entry])
        return entries

    def _count(self, entries: Mapping[int, Entries], where: int) -> None:
        """Add messages, in the order in which they stand, to what was found."""
        for channel, listed in entries.items():
            if not len(listed):
                continue
            if channel not in self.found.channels:
                self._find("no-channel", where, f"messages of channel {channel}, which was not described before")
            t_ns = listed[:, 0]
            latest = self._latest.get(channel, 0)
            known = self.found.channels.get(channel)
            topic = known.topic if known else f"channel {channel}"
            behind = t_ns < np.maximum(np.maximum.accumulate(t_ns), np.uint64(latest))
            if behind.any():
                words = f"messages of {topic} that stand behind later ones"
                self._find("order", where, words, "warning", int(behind.sum()))
            late = t_ns > np.uint64(MAX_NS)
            if late.any():
                words = f"messages of {topic} later than the year 2262, which are kept, but nothing is computed with"
                self._find("late", where, words, "warning", int(late.sum()))
            self._latest[channel] = max(latest, int(t_ns.max()))
            if not self.found.counts:
                self.found.start_ns = int(t_ns.min())
            self.found.start_ns = min(self.found.start_ns, int(t_ns.min()))
            self.found.end_ns = max(self.found.end_ns, int(t_ns.max()))
            self.found.counts[channel] = self.found.counts.get(channel, 0) + len(listed)
