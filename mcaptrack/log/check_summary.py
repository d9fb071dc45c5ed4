"""Compare the summary of a log with its data section; and the findings of a check."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Final, Literal, NamedTuple

import numpy as np
from mcap.opcode import Opcode

from mcaptrack.log.index import DATA_END_SIZE, FOOTER_SIZE, Index, add_summary_record, read_footer
from mcaptrack.log.records import FOOTER_BODY, MAGIC, Bytes, Damaged, Reader, walk

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
        _Checker(buffer, data_index, findings).check()
    except Damaged as error:
        findings.add("summary-structure", data_index.data_end, f"the summary can't be read: {error}")


class _Checker:
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
