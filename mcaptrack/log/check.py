"""Check a log for damage: read every record without relying on the summary, then compare the summary with them.

Letters: M messages.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import numpy as np
from mcap.opcode import Opcode

from mcaptrack import notices
from mcaptrack.errors import McaptrackError
from mcaptrack.files import follow_links
from mcaptrack.geometry.clocks import JUMP_S, NS_PER_S, seconds_to_ns
from mcaptrack.location import Location, Url
from mcaptrack.log import records
from mcaptrack.log.byte_source import ByteSource, OpenFile, ReadFile, RunningChecksum, open_file
from mcaptrack.log.chunks import (
    HEAD,
    MAX_NS,
    Entries,
    message_head,
    message_heads_at,
    open_chunk,
    read_index_entries,
    records_between,
    scan_entries,
)
from mcaptrack.log.index import (
    DATA_END_SIZE,
    FOOTER_SIZE,
    Index,
    add_summary_record,
    attachment_entry,
    count_messages,
    edges_of,
    ends_with_magic,
    metadata_entry,
    read_footer,
    starts_with_magic,
)
from mcaptrack.log.journal import changed, find_journal, journal_of, load_old_content
from mcaptrack.log.records import FOOTER_BODY, MAGIC, Bytes, Damaged, Reader, Record, attachment_is_whole, walk
from mcaptrack.notices import Progress

if TYPE_CHECKING:
    from mcaptrack.log.reader import Log


@dataclass
class CheckResult:
    """The result of ``check``.

    ``path`` is the log; ``messages`` and ``chunks`` are their numbers; ``findings`` are its errors and warnings.
    """

    path: Location
    messages: int = 0
    chunks: int = 0
    findings: list[Finding] = field(default_factory=list)

    @property
    def is_sound(self) -> bool:
        """Whether there are no errors; warnings don't count."""
        return all(finding.level != "error" for finding in self.findings)


def check(path: Location, progress: Progress = lambda *_: None) -> CheckResult:
    """Check every byte of a log.

    Parameters
    ----------
    path : Path or Url
        An MCAP file, or an object that is one.
    progress : callable, optional
        Called with "check", the bytes read, and the size of the file.

    Returns
    -------
    CheckResult
        Findings about checksums, sizes and times of chunks, message indexes, the order of each channel's messages,
        attachments, summary and footer; one finding of each kind, with the number of times.

    Raises
    ------
    McaptrackError
        Only if the file can't be read at all, or changes meanwhile.
    """
    with open_bytes(path) as (source, file):
        signature = file.signature()
        state = find_journal(path, file)
        if state and state.is_busy:
            raise McaptrackError(f"{path} is being written to by another process; try again when it is done")
        half = state.journal if state else None
        if state and not half:
            notices.warn(state.message, "journal")
        look = _Checker((half.old_content() if half else source).sequential(), progress)
        if state and half:
            look.findings.add("half-written", half.start, state.message)
        try:
            look.check_all()
        except Damaged as error:  # an unreadable file; damaged content is a finding
            raise McaptrackError(f"{path} can't be read to its end: {error}") from None
        if file.signature() != signature:
            raise changed(path)
    findings = sorted(look.findings, key=lambda finding: (finding.level, finding.where))
    return CheckResult(path, sum(look.found.counts.values()), len(look.found.chunks), findings)


def is_sound(source: ByteSource) -> bool:
    """Whether a check of every byte finds no error."""
    look = _Checker(source.sequential(), lambda *_: None)
    try:
        look.check_all()
    except Damaged:
        return False
    return all(finding.level != "error" for finding in look.findings)


def content_to_recover(path: Location, source: ByteSource, file: ReadFile) -> ByteSource:
    """The content that `recover` reads: the old content by a journal if the file itself is damaged, else the file.

    The log itself is not written to, so a journal is good enough that doesn't prove that it belongs to this file.
    """
    journal = find_journal(path, file)
    if journal is None or isinstance(path, Url) or not isinstance(file, OpenFile):
        return source
    before = journal.journal.old_content() if journal.journal else load_old_content(follow_links(path), file)
    if before is None or (not journal.journal and is_sound(source)) or not is_sound(before):
        notices.warn(journal.message, "journal")
        return source
    notices.warn(
        f"{path} was left half written by an interrupted change; its state before that is recovered with the help "
        f"of {journal_of(follow_links(path)).name}",
        "journal",
    )
    return before


@contextmanager
def open_bytes(path: Location) -> Iterator[tuple[ByteSource, ReadFile]]:
    """Open the bytes of a file. Raises McaptrackError if it is missing or empty."""
    file = open_file(path)
    try:
        source = ByteSource.of(file)
        if not len(source):
            raise McaptrackError(f"{path} is empty")
        yield source, file
    finally:
        file.close()


# Jumps of the clock of a log: long times without a message of any channel, found by the index.
#
# Letters: S spans of times, J jumps.


_JUMP_NS: Final = seconds_to_ns(JUMP_S)
#: A log with more jumps than one in so many messages is slow, as a time lapse is: its clock doesn't jump.
_MESSAGES_EACH: Final = 10
#: Units of long times in seconds, the longest first.
_UNITS: Final = ((365.25 * 86_400, "years"), (86_400.0, "days"), (3_600.0, "hours"), (60.0, "minutes"))


class ClockJump(NamedTuple):
    """A time without messages: those of the last message before it and of the first one after it, in nanoseconds."""

    before_ns: int
    after_ns: int


Span = tuple[int, int]


def spans_of(span: Span, entries: Mapping[int, Entries]) -> list[Span]:
    """The spans of the messages of a chunk, none of which contains a jump."""
    if span[1] - span[0] <= _JUMP_NS or not entries:
        return [span]
    t_ns = np.unique(np.concatenate([listed[:, 0] for listed in entries.values()]))
    cuts = np.flatnonzero(np.diff(t_ns) > _JUMP_NS)
    return list(zip(t_ns[[0, *(cuts + 1)]].tolist(), t_ns[[*cuts, -1]].tolist(), strict=True))


def joined(first: Span, two: Span) -> Span | None:
    """The span of both; None if there is a jump between them."""
    both = min(first[0], two[0]), max(first[1], two[1])
    return both if max(first[0], two[0]) - min(first[1], two[1]) <= _JUMP_NS else None


def jumps_between(spans: Iterable[Span], messages: int) -> list[ClockJump]:
    """The jumps (J) between spans (S) of the messages of a log, in any order."""
    jumps: list[ClockJump] = []
    last_ns: int | None = None
    for first, last in sorted(spans):
        if last_ns is not None and first - last_ns > _JUMP_NS:
            jumps.append(ClockJump(last_ns, first))
        last_ns = last if last_ns is None else max(last_ns, last)
    return jumps if len(jumps) * _MESSAGES_EACH <= messages else []


def clock_jumps(opened: Log) -> list[ClockJump]:
    """The jumps of the clock of a log in the order of time. Raises McaptrackError if its index is damaged."""
    with opened.snapshot.reporting_damage():
        spans = [span for part in opened.parts for span in _spans(part)]
    return jumps_between(spans, sum(sum(part.index.counts.values()) for part in opened.parts))


def jumps_text(jumps: list[ClockJump], start_ns: int) -> str:
    """The jumps as a clause: how long the longest is, and when it begins in the log; "" if there are none.

    ``start_ns`` is the time of the first message.
    """
    if not jumps:
        return ""
    longest = max(jumps, key=lambda jump: jump.after_ns - jump.before_ns)
    after_s = (longest.before_ns - start_ns) / NS_PER_S
    text = f"there is no message for {_long((longest.after_ns - longest.before_ns) / NS_PER_S)} after {after_s:.3f} s"
    if len(jumps) > 1:
        text += f", the longest of {len(jumps)} gaps of more than {JUMP_S:g} s"
    return text


def _long(seconds: float) -> str:
    size, name = next((unit for unit in _UNITS if seconds >= unit[0]), (1.0, "s"))
    return f"{seconds / size:.1f} {name}"


def _spans(part: Log) -> Iterator[Span]:
    index = part.index
    for chunk in index.chunks:
        span, entries = (chunk.message_start_time, chunk.message_end_time), dict[int, Entries]()
        if span[1] - span[0] > _JUMP_NS:
            for channel, at in chunk.message_index_offsets.items():
                listed = read_index_entries(part.snapshot.source, at, channel) if at else None
                entries[channel] = index.entries[chunk.chunk_start_offset][channel] if listed is None else listed
            entries = {channel: listed for channel, listed in entries.items() if len(listed)}
        if chunk.message_index_offsets:
            yield from spans_of(span, entries)
    loose = {channel: listed for channel, listed in index.loose.items() if len(listed)}
    if loose:
        edges = edges_of(loose)
        yield from spans_of((min(edges), max(edges)), loose)


class _Checker:
    """One check of a file; ``found`` is the index that its records should have."""

    def __init__(self, buffer: ByteSource, progress: Progress) -> None:
        self.found = Index()
        self.findings = Findings()
        self._find = self.findings.add
        self._buffer, self._progress = buffer, progress
        self._chunk: tuple[Record, dict[int, int]] | None = (
            None  # the last chunk, and the offsets of its message indexes
        )
        self._latest: dict[int, int] = {}  # latest log time by channel
        self._spans: list[Span] = []  # times with messages, without jumps of the clock
        self._places: dict[int, int] = {}  # of records, by the first time of a span

    def check_all(self) -> None:
        buffer = self._buffer
        if not starts_with_magic(buffer):
            self._find("magic", 0, "the file does not begin as an MCAP file does")
            return
        ends_well = ends_with_magic(buffer)
        if not ends_well:
            self._find("cut-off", len(buffer), "the file is cut off: the magic bytes at its end are missing")
        end = len(buffer) - len(MAGIC) if ends_well else len(buffer)
        try:
            self._at_data(end)
        except Damaged as error:
            self._find("structure", 0, f"{error}; what follows can't be checked")
        self._close_chunk()
        self._find_jumps()
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
                checksum.advance(record.start)
            if record.opcode == Opcode.DATA_END:
                self.found.data_end = record.start
                self.found.data_crc = Reader(buffer, record.body, record.end).number(4)
                if self.found.data_crc and self.found.data_crc != checksum.up_to(record.start):
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
        buffer, index = self._buffer, self.found
        if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._describe(buffer, record, record.start)
        elif record.opcode == Opcode.CHUNK:
            self._chunk = (record, {})
        elif record.opcode == Opcode.MESSAGE_INDEX:
            channel, _ = records.read_message_entries(buffer, record)
            if self._chunk is None:
                self._find("stray-index", record.start, "a message index that follows no chunk")
            elif channel in self._chunk[1]:
                self._find("double-index", record.start, f"two message indexes of channel {channel} for one chunk")
            else:
                self._chunk[1][channel] = record.start
        elif record.opcode == Opcode.MESSAGE:
            channel, _, t_ns, _ = message_head(buffer, record)
            self._find("unchunked", record.start, "a message outside of chunks: finding it takes a scan", "warning")
            self._count({channel: np.array([[t_ns, record.start]], "<u8")}, record.start)
        elif record.opcode == Opcode.ATTACHMENT:
            if not attachment_is_whole(buffer, record):
                self._find("attachment-checksum", record.start, "the checksum of an attachment is wrong")
            index.attachments.append(attachment_entry(buffer, record, record.start))
        elif record.opcode == Opcode.METADATA:
            index.metadata.append(metadata_entry(buffer, record, record.start))
        elif record.opcode == Opcode.HEADER:
            records.read_header(buffer, record)
        elif record.opcode == 0 or record.opcode in (Opcode.FOOTER, Opcode.STATISTICS, Opcode.CHUNK_INDEX):
            self._find("misplaced", record.start, f"a {record_name(record.opcode)} record in the data section")
        elif record.opcode < 0x80 and record.opcode > Opcode.DATA_END:
            self._find("unknown", record.start, f"a record of kind {record.opcode:#04x}, which is not known", "warning")

    def _describe(self, buffer: Bytes, record: Record, where: int) -> None:
        """Register a schema or channel record; repeated ones must be equal."""
        if record.opcode == Opcode.SCHEMA:
            schema = records.read_schema(buffer, record)
            if schema.id == 0:
                self._find("schema-zero", where, "a schema with id 0, which means no schema")
            elif self.found.schemas.setdefault(schema.id, schema) != schema:
                self._find("two-schemas", where, f"two different schemas have the id {schema.id}")
        else:
            channel = records.read_channel(buffer, record)
            if channel.schema_id and channel.schema_id not in self.found.schemas:
                self._find("no-schema", where, f"{channel.topic} has schema {channel.schema_id}, not described before")
            if self.found.channels.setdefault(channel.id, channel) != channel:
                self._find("two-channels", where, f"two different channels have the id {channel.id} ({channel.topic})")

    def _close_chunk(self) -> None:
        """Check the last chunk, now that its message indexes are known."""
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
            self._find("no-checksum", record.start, "a chunk without a checksum, so damage is not detected", "warning")
        entries = self._indexed(record, content, indexes) if indexes else scan_entries(content)
        if not indexes:
            self._describe_all(content, record.start)
            if entries:
                text = "a chunk without message indexes: finding a message takes a scan"
                self._find("no-message-index", record.start, text, "warning")
        self._count(entries, record.start)
        times = [int(edge) for e in entries.values() if len(e) for edge in (e[:, 0].min(), e[:, 0].max())]
        span = (min(times), max(times)) if times else (0, 0)
        if (head.start_ns, head.end_ns) != span:
            text = (
                f"a chunk declares times from {head.start_ns} to {head.end_ns} ns; its messages are from "
                f"{span[0]} to {span[1]}"
            )
            self._find("chunk-times", record.start, text)
        last = max((records.record_at(buffer, at).end for at in indexes.values()), default=record.end)
        sizes = (head.compression, head.end - head.start, head.uncompressed_size)
        span, place = (head.start_ns, head.end_ns), (record.start, record.end - record.start)
        self.found.chunks.append(records.chunk_index(span, place, dict(indexes), last - record.end, sizes))

    def _add_spans(self, entries: Mapping[int, Entries], where: int) -> None:
        """Keep the spans of time of messages: those of one record, by channel."""
        edges = edges_of(entries)
        for span in spans_of((min(edges), max(edges)), entries) if edges else ():
            if self._spans and (both := joined(self._spans[-1], span)):
                self._spans[-1] = both
            else:
                self._spans.append(span)
                self._places.setdefault(span[0], where)

    def _find_jumps(self) -> None:
        jumps = jumps_between(self._spans, sum(self.found.counts.values()))
        if jumps:
            where = self._places.get(jumps[0].after_ns, 0)
            self._find("clock-jump", where, jumps_text(jumps, self.found.start_ns), "warning", len(jumps))

    def _describe_all(self, content: Bytes, where: int) -> None:
        for inner in walk(content, 0, len(content)):
            if inner.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._describe(content, inner, where)

    def _indexed(self, record: Record, content: Bytes, indexes: Mapping[int, int]) -> dict[int, Entries]:
        """The index entries of a chunk, which must list all of its messages and nothing else."""
        entries: dict[int, Entries] = {}
        starts, ends = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        for channel, at in indexes.items():
            listed = read_index_entries(self._buffer, at, channel)
            try:
                heads = message_heads_at(content, channel, listed[:, 0], listed[:, 1].astype(np.int64))
            except Damaged as error:
                self._find("wrong-index", at, f"a message index does not fit its chunk: {error}")
                self._describe_all(content, record.start)
                return scan_entries(content)
            entries[channel] = listed[np.argsort(listed[:, 1], kind="stable")]
            starts.append(heads.start - HEAD.itemsize)
            ends.append(heads.end)
        for inner in records_between(content, np.concatenate(starts), np.concatenate(ends)):
            if inner.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._describe(content, inner, record.start)
            elif inner.opcode == Opcode.MESSAGE:
                channel, _, t_ns, _ = message_head(content, inner)
                self._find("not-listed", record.start, f"a message of channel {channel} that no message index lists")
                entry = np.array([[t_ns, inner.start]], "<u8")
                entries[channel] = np.concatenate([entries.get(channel, entry[:0]), entry])
        return entries

    def _count(self, entries: Mapping[int, Entries], where: int) -> None:
        """Add messages, in file order, to ``found``."""
        entries = {channel: listed for channel, listed in entries.items() if len(listed)}
        self._add_spans(entries, where)
        count_messages(self.found, entries)
        for channel, listed in entries.items():
            if channel not in self.found.channels:
                self._find("no-channel", where, f"messages of channel {channel}, which was not described before")
            t_ns = listed[:, 0]
            latest = self._latest.get(channel, 0)
            described = self.found.channels.get(channel)
            topic = described.topic if described else f"channel {channel}"
            behind = t_ns < np.maximum(np.maximum.accumulate(t_ns), np.uint64(latest))
            if behind.any():
                text = f"messages of {topic} that follow later ones"
                self._find("order", where, text, "warning", int(behind.sum()))
            late = t_ns > np.uint64(MAX_NS)
            if late.any():
                text = f"messages of {topic} later than the year 2262, which are kept, but nothing is computed with"
                self._find("late", where, text, "warning", int(late.sum()))
            self._latest[channel] = max(latest, int(t_ns.max()))


Level = Literal["error", "warning"]

#: The fields of a statistics record in order, and their sizes in bytes.
_STATISTICS: Final = {
    "messages": 8,
    "schemas": 2,
    "channels": 4,
    "attachments": 4,
    "metadata": 4,
    "chunks": 4,
    "first log time": 8,
    "last log time": 8,
}


class Finding(NamedTuple):
    """An error or a warning: its first offset in the file, and how often it occurs.

    ``level`` is "error" or "warning", ``kind`` names what is wrong for programs, ``words`` for people. ``where`` is the
    offset in bytes, and ``times`` the number of times.
    """

    level: Level
    kind: str
    where: int
    words: str
    times: int = 1


class Findings:
    """Findings, one of each kind."""

    def __init__(self) -> None:
        self._first: dict[tuple[Level, str], tuple[int, str]] = {}
        self._times: Counter[tuple[Level, str]] = Counter()

    def __iter__(self) -> Iterator[Finding]:
        for (level, kind), (where, message) in self._first.items():
            yield Finding(level, kind, where, message, self._times[level, kind])

    def add(self, kind: str, where: int, message: str, level: Level = "error", times: int = 1) -> None:
        """Add a finding, or count it if there is one of its kind."""
        self._first.setdefault((level, kind), (where, message))
        self._times[level, kind] += times


def record_name(opcode: int) -> str:
    """The name of a record type."""
    try:
        return Opcode(opcode).name.lower().replace("_", "-")
    except ValueError:
        return f"{opcode:#04x}"


def check_summary(buffer: Bytes, data_index: Index, findings: Findings) -> None:
    """Check summary and footer of a log; ``data_index`` is the index of its data section."""
    try:
        _SummaryChecker(buffer, data_index, findings).check()
    except Damaged as error:
        findings.add("summary-structure", data_index.data_end, f"the summary can't be read: {error}")


class _SummaryChecker:
    def __init__(self, buffer: Bytes, data_index: Index, findings: Findings) -> None:
        self._buffer, self._found, self._find = buffer, data_index, findings.add

    def check(self) -> None:
        buffer, data_index = self._buffer, self._found
        footer = read_footer(buffer)
        if footer is None:
            self._find("no-footer", max(len(buffer) - FOOTER_SIZE, 0), "there is no footer at the end of the file")
            return
        at, start, offsets_start, crc = footer
        behind = data_index.data_end + DATA_END_SIZE
        length = Reader(buffer, at + 1, len(buffer)).number(8)
        if length != FOOTER_BODY.size:  # readers that read the footer as a record take its length from here
            self._find("footer", at, f"the footer declares a length of {length} bytes; it has {FOOTER_BODY.size}")
        if start == 0:
            text = "there is no summary: opening the log takes a scan"
            self._find("no-summary", at, text, "warning")
            if offsets_start:
                text = f"the footer places summary offsets at byte {offsets_start}, but there is no summary"
                self._find("footer", at, text, "warning")
            self._compare_checksum(at, crc)
            if behind != at and data_index.data_end:
                self._find("footer", at, "there are records after the data section, and the footer names no summary")
            return
        if not len(MAGIC) <= start <= at or (data_index.data_end and start != behind):
            self._find(
                "footer", at, f"the footer places the summary at byte {start}; the data section ends at {behind}"
            )
            return
        self._compare_checksum(start, crc)
        if not crc:
            self._find(
                "no-summary-checksum", start, "the summary has no checksum, so damage is not detected", "warning"
            )
        if offsets_start and not start <= offsets_start <= at:
            self._find("footer", at, f"the footer places the summary offsets at byte {offsets_start}")
            offsets_start = 0
        groups: dict[int, tuple[int, int, int]] = {}  # start, end and total size of the records of a type
        summary, statistics = Index(), None
        for record in walk(buffer, start, offsets_start or at):
            low, _, kinds = groups.get(record.opcode, (record.start, 0, 0))
            groups[record.opcode] = (low, record.end, kinds + record.end - record.start)
            statistics = record if record.opcode == Opcode.STATISTICS else statistics
            add_summary_record(summary, buffer, record)
        self._compare(summary, start)
        if statistics is None:
            self._find("no-statistics", start, "there are no statistics: counting takes a scan", "warning")
        else:
            self._compare_statistics(Reader(buffer, statistics.body, statistics.end), summary, statistics.start)
        if offsets_start:
            self._compare_offsets(offsets_start, at, groups)

    def _compare_checksum(self, start: int, crc: int) -> None:
        """Compare the checksum, unless it is 0, with the bytes from ``start`` to the footer's own field of it."""
        if crc and zlib.crc32(self._buffer[start : len(self._buffer) - len(MAGIC) - 4]) != crc:
            self._find("summary-checksum", start, "the checksum of the summary is wrong")

    def _compare(self, summary: Index, where: int) -> None:
        data_index = self._found
        for name, theirs, ours in (
            ("schema", summary.schemas, data_index.schemas),
            ("channel", summary.channels, data_index.channels),
        ):
            for number, record in theirs.items():
                if ours.get(number, record) != record:
                    self._find(
                        f"summary-{name}",
                        where,
                        f"{name} {number} in the summary differs from that in the data section",
                    )
            missing = ours.keys() - theirs.keys()
            if missing and theirs:
                text = f"{name} {min(missing)} is missing in the summary"
                self._find(f"summary-no-{name}", where, text, "error" if name == "channel" else "warning")
        self._compare_chunks(summary, where)
        for name, listed, in_data in (
            ("attachment", summary.attachments, data_index.attachments),
            ("metadata", summary.metadata, data_index.metadata),
        ):
            if listed and sorted(part.entry for part in listed) != sorted(part.entry for part in in_data):
                self._find(f"{name}-index", where, f"the {name} index differs from the {name} records in the log")
            if in_data and not listed:
                self._find(f"no-{name}-index", where, f"the summary does not list {len(in_data)} {name}", "warning")

    def _compare_chunks(self, summary: Index, where: int) -> None:
        ours = self._found.chunks
        if len(ours) and not len(summary.chunks):
            text = "the summary lists no chunks: finding a message takes a scan"
            self._find("no-chunk-index", where, text, "warning")
            return
        missing = np.ones(len(ours), bool)
        for chunk in summary.chunks:
            row = ours.row_at(chunk.chunk_start_offset)
            if row is None or not missing[row]:
                self._find(
                    "chunk-index",
                    where,
                    f"the summary lists a chunk at byte {chunk.chunk_start_offset}, where there is no intact one",
                )
                continue
            missing[row] = False
            present, stated = vars(ours[row]), vars(chunk)
            names = [name for name, value in stated.items() if value != present[name]]
            if names:
                text = f"the chunk index differs from the chunk at byte {chunk.chunk_start_offset}: {', '.join(names)}"
                self._find("chunk-index", where, text)
        if missing.any():
            text = "a chunk that the summary does not list"
            self._find("chunk-not-listed", int(ours.offsets[missing].min()), text, times=int(missing.sum()))

    def _compare_statistics(self, reader: Reader, summary: Index, where: int) -> None:
        ours = self._found
        loose = [sum(ours.counts.values()), len(ours.schemas), len(ours.channels), len(ours.attachments)]
        actual = [*loose, len(ours.metadata), len(ours.chunks), ours.start_ns, ours.end_ns]
        for (name, size), number in zip(_STATISTICS.items(), actual, strict=True):
            value = reader.number(size)
            only_described = name in ("schemas", "channels") and value == len(getattr(summary, name))
            if value != number and not only_described:
                self._find("statistics", where, f"the statistics say {value} for {name}; it is {number}")
        if {n: count for n, count in summary.counts.items() if count} != ours.counts:
            self._find("statistics-counts", where, "the statistics have a wrong number of messages for a channel")

    def _compare_offsets(self, start: int, end: int, groups: Mapping[int, tuple[int, int, int]]) -> None:
        listed = set()
        for record in walk(self._buffer, start, end):
            if record.opcode != Opcode.SUMMARY_OFFSET:
                self._find("summary-offset", record.start, f"a {record_name(record.opcode)} among summary offsets")
                continue
            reader = Reader(self._buffer, record.body, record.end)
            opcode, low, size = reader.number(1), reader.number(8), reader.number(8)
            listed.add(opcode)
            if size == 0:
                text = (
                    f"a summary offset of an empty group of {record_name(opcode)} records; some readers report "
                    "it as damage"
                )
                self._find("empty-group", record.start, text, "warning")
            elif groups.get(opcode) != (low, low + size, size):
                text = f"the {record_name(opcode)} records are not at their summary offset"
                self._find("summary-offset", record.start, text)
        missing = groups.keys() - listed
        if missing:
            text = f"the {record_name(min(missing))} records have no summary offset"
            self._find("no-summary-offset", start, text, "warning")
