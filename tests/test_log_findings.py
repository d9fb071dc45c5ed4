"""What `check` finds in logs that are put together record by record, one thing wrong in each: what, and at which byte."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import IndexType

from mcaptrack import log
from tests.logs import SOME, write_stock

MAGIC = b"\x89MCAP0\r\n"


def text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def record(opcode: int, body: bytes = b"") -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


HEADER, END = record(0x01, text("") + text("")), record(0x0F, bytes(4))


def schema(number: int, name: str = "Thing") -> bytes:
    return record(0x03, struct.pack("<H", number) + text(name) + text("json") + text("{}"))


def channel(number: int, of: int, topic: str = "/a") -> bytes:
    return record(0x04, struct.pack("<HH", number, of) + text(topic) + text("json") + bytes(4))


def message(number: int, t_ns: int) -> bytes:
    return record(0x05, struct.pack("<HIQQ", number, 0, t_ns, t_ns) + b"{}")


def chunk(*records: bytes, times: tuple[int, int] = (0, 0), has_checksum: bool = True) -> bytes:
    content = b"".join(records)
    checksum = zlib.crc32(content) if has_checksum else 0
    return record(
        0x06,
        struct.pack("<QQQI", *times, len(content), checksum) + text("") + struct.pack("<Q", len(content)) + content,
    )


def index(number: int, *entries: tuple[int, int]) -> bytes:
    return record(
        0x07, struct.pack("<HI", number, 16 * len(entries)) + b"".join(struct.pack("<QQ", *e) for e in entries)
    )


A, B = schema(1), channel(2, 1)
SIZE = len(message(2, 5))
WHOLE = [chunk(message(2, 5), message(2, 7), times=(5, 7)), index(2, (5, 0), (7, SIZE))]

FIVE, SEVEN, LATE = message(2, 5), message(2, 7), message(2, 2**63)
OTHER = schema(1, "Other")


def with_head(*records: bytes) -> list[bytes]:
    """The records of a data section that begins as usual; the fourth is the first of these."""
    return [HEADER, A, B, *records, END]


#: The records of a data section: which of them the finding names by its first byte, its kind, and how bad it is.
CASES: dict[str, tuple[Sequence[bytes], int, str, str]] = {
    "no header": ([A, HEADER, B, *WHOLE, END], 0, "no-header", "error"),
    "an index without a chunk": (with_head(index(2, (5, 0)), *WHOLE), 3, "stray-index", "error"),
    "an index after another record": (with_head(*WHOLE, A, index(2, (5, 0))), 6, "stray-index", "error"),
    "two indexes of a channel": (with_head(*WHOLE, WHOLE[1]), 5, "double-index", "error"),
    "a message outside": (with_head(*WHOLE, message(2, 9)), 5, "unchunked", "warning"),
    "statistics before the end": (with_head(*WHOLE, record(0x0B, bytes(46))), 5, "misplaced", "error"),
    "a record of a kind to come": (with_head(*WHOLE, record(0x10, b"?")), 5, "unknown", "warning"),
    "a schema of number zero": ([HEADER, A, schema(0), B, *WHOLE, END], 2, "schema-zero", "error"),
    "a schema that changes": (with_head(OTHER, *WHOLE), 3, "two-schemas", "error"),
    "a channel that changes": (with_head(channel(2, 1, "/b"), *WHOLE), 3, "two-channels", "error"),
    "a channel of a schema that comes later": ([HEADER, B, A, *WHOLE, END], 1, "no-schema", "error"),
    "messages of a channel that comes later": ([HEADER, A, *WHOLE, B, END], 2, "no-channel", "error"),
    "a message of a channel that comes later": ([HEADER, A, FIVE, B, END], 2, "no-channel", "error"),
    "a chunk without a checksum": (
        with_head(chunk(FIVE, times=(5, 5), has_checksum=False), index(2, (5, 0))), 3, "no-checksum", "warning"
    ),
    "a chunk without an index": (with_head(WHOLE[0]), 3, "no-message-index", "warning"),
    "a chunk that ends later": (with_head(chunk(FIVE, times=(5, 4)), index(2, (5, 0))), 3, "chunk-times", "error"),
    "a chunk that begins earlier": (with_head(chunk(FIVE, times=(6, 5)), index(2, (5, 0))), 3, "chunk-times", "error"),
    "a message that no index lists": (with_head(WHOLE[0], index(2, (5, 0))), 3, "not-listed", "error"),
    "an index that points elsewhere": (
        with_head(chunk(FIVE, times=(5, 5)), index(2, (5, 3))), 4, "wrong-index", "error"
    ),
    "an index with another time": (with_head(chunk(FIVE, times=(5, 5)), index(2, (6, 0))), 4, "wrong-index", "error"),
    "messages that go back within a chunk": (
        with_head(chunk(SEVEN, FIVE, times=(5, 7)), index(2, (7, 0), (5, SIZE))), 3, "order", "warning"
    ),
    "messages that go back from chunk to chunk": (
        with_head(*WHOLE, chunk(message(2, 6), times=(6, 6)), index(2, (6, 0))), 5, "order", "warning"
    ),
    "a message after the year 2262": (
        with_head(chunk(LATE, times=(2**63, 2**63)), index(2, (2**63, 0))), 3, "late", "warning"
    ),
    "a schema that changes within a chunk": (
        with_head(chunk(OTHER, FIVE, times=(5, 5)), index(2, (5, len(OTHER)))), 3, "two-schemas", "error"
    ),
    "no end of the data": (with_head(*WHOLE)[:-1], 5, "no-data-end", "error"),
}  # fmt: skip


def put_together(path: Path, records: Sequence[bytes]) -> list[int]:
    """Write a log of these records without a summary; returns where each begins, and where the last one ends."""
    places = [len(MAGIC)]
    for one in records:
        places.append(places[-1] + len(one))
    tail = record(0x02, bytes(20)) if records[-1] == END else b""
    path.write_bytes(MAGIC + b"".join(records) + tail + MAGIC)
    return places


#: What is found of a log besides: it has no summary here.
BESIDES = {"no-summary"}


def test_a_log_without_faults_has_no_findings_but_that_it_has_no_summary(tmp_path):
    put_together(tmp_path / "a.mcap", [HEADER, A, B, *WHOLE, A, B, END])
    checked = log.check(tmp_path / "a.mcap")
    assert {finding.kind for finding in checked.findings} == BESIDES
    assert (checked.messages, checked.chunks, checked.is_sound) == (2, 1, True)


@pytest.mark.parametrize(("records", "at", "kind", "level"), CASES.values(), ids=CASES)
def test_a_fault_is_found_where_it_is_and_nothing_else(records, at, kind, level, tmp_path):
    places = put_together(tmp_path / "a.mcap", records)
    checked = log.check(tmp_path / "a.mcap")
    found = [(f.kind, f.where, f.level, f.times) for f in checked.findings if f.kind not in BESIDES]
    assert (kind, places[at], level, 1) in found
    assert checked.is_sound == (level == "warning")
    others = {"no-footer"} if kind == "no-data-end" else {"unchunked"} if kind == "no-channel" else set()
    assert {f[0] for f in found} - others == {kind}


#: Options of the stock writer: logs with a summary, with one that has no checksum, and without one.
SUMMARIES: dict[str, dict[str, Any]] = {
    "summary": {},
    "summary without checksum": {"enable_crcs": False},
    "no summary": dict.fromkeys(("repeat_channels", "repeat_schemas", "use_statistics", "use_summary_offsets"), False)
    | {"index_types": IndexType.NONE},
}
TAIL = len(record(0x02, bytes(20)) + MAGIC)


def findings(path: Path) -> list[tuple[str, int, str, str]]:
    return [(found.kind, found.where, found.level, found.words) for found in log.check(path).findings]


@pytest.mark.parametrize("options", SUMMARIES.values(), ids=SUMMARIES)
def test_no_flipped_bit_of_the_footer_and_of_the_magic_behind_it_goes_unnoticed(options, tmp_path):
    path = tmp_path / "a.mcap"
    write_stock(path, SOME, chunk_size=60, **options)
    whole, known = path.read_bytes(), findings(path)
    unnoticed = []
    for at in range(len(whole) - TAIL, len(whole)):
        for bit in (0, at % 7 + 1):
            changed = bytearray(whole)
            changed[at] ^= 1 << bit
            path.write_bytes(changed)
            if findings(path) == known:
                unnoticed.append((at - len(whole), bit))
    assert unnoticed == []


@pytest.mark.parametrize("length", [0, 19, 21, 2**63])
@pytest.mark.parametrize("options", SUMMARIES.values(), ids=SUMMARIES)
def test_a_footer_that_declares_another_length_is_an_error(options, length, tmp_path):
    """The checksum covers the length, too, so it is computed again."""
    path = tmp_path / "a.mcap"
    write_stock(path, SOME, chunk_size=60, **options)
    known = findings(path)
    changed = bytearray(path.read_bytes())
    footer = len(changed) - TAIL
    start = int.from_bytes(changed[footer + 9 : footer + 17], "little") or footer
    changed[footer + 1 : footer + 9] = length.to_bytes(8, "little")
    if any(changed[footer + 25 : footer + 29]):
        changed[footer + 25 : footer + 29] = zlib.crc32(changed[start : footer + 25]).to_bytes(4, "little")
    path.write_bytes(changed)
    words = f"the footer declares a length of {length} bytes; it has 20"
    assert set(findings(path)) - set(known) == {("footer", footer, "error", words)}
    assert not log.check(path).is_sound


def test_no_changed_byte_of_a_summary_goes_unnoticed(tmp_path):
    """Every number of the summary is compared with the data, also where its checksum was computed again."""
    path = tmp_path / "a.mcap"
    write_stock(path, SOME, chunk_size=150)
    assert log.check(path).findings == []
    whole = path.read_bytes()
    footer = len(whole) - len(MAGIC) - 20
    start = int.from_bytes(whole[footer : footer + 8], "little")
    unnoticed = []
    for at in range(start, footer + 16, 3):  # each byte would take a second
        changed = bytearray(whole)
        changed[at] ^= 1
        changed[footer + 16 : footer + 20] = zlib.crc32(changed[start : footer + 16]).to_bytes(4, "little")
        path.write_bytes(changed)
        if not log.check(path).findings:
            unnoticed.append(at - start)
    assert unnoticed == []


def summarised(path: Path, *records: bytes, offsets: int | None = None) -> int:
    """Write a log with a schema, a channel and a chunk, and a summary of these records; returns where that begins.

    The footer places the summary offsets at so many bytes from there.
    """
    data = MAGIC + b"".join([HEADER, A, B, *WHOLE, END])
    footer = struct.pack("<BQQQ", 0x02, 20, len(data), 0 if offsets is None else len(data) + offsets)
    crc = zlib.crc32(b"".join(records) + footer)
    path.write_bytes(data + b"".join(records) + footer + crc.to_bytes(4, "little") + MAGIC)
    return len(data)


STATISTICS = record(0x0B, struct.pack("<QHIIIIQQIHQ", 2, 1, 1, 0, 0, 1, 5, 7, 10, 2, 2))
CHUNK_AT = len(MAGIC + HEADER + A + B)
CHUNK_INDEX = record(
    0x08,
    struct.pack("<QQQQ", 5, 7, CHUNK_AT, len(WHOLE[0]))
    + struct.pack("<IHQQ", 10, 2, CHUNK_AT + len(WHOLE[0]), len(WHOLE[1]))
    + text("")
    + struct.pack("<QQ", 2 * SIZE, 2 * SIZE),
)
#: The records of a summary, and what is found of them: kind, level and words.
LACKING: dict[str, tuple[Sequence[bytes], list[tuple[str, str, str]]]] = {
    "nothing": ([A, B, CHUNK_INDEX, STATISTICS], []),
    "schemas and channels": ([CHUNK_INDEX, STATISTICS], []),
    "a schema": ([schema(3), B, CHUNK_INDEX, STATISTICS], [("summary-no-schema", "warning", "schema 1 is missing in the summary")]),
    "a channel": (
        [A, channel(3, 1, "/b"), CHUNK_INDEX, STATISTICS],
        [("summary-no-channel", "error", "channel 2 is missing in the summary")],
    ),
    "a schema as it is": (
        [OTHER, B, CHUNK_INDEX, STATISTICS],
        [("summary-schema", "error", "schema 1 in the summary differs from that in the data section")],
    ),
    "a channel as it is": (
        [A, channel(2, 1, "/b"), CHUNK_INDEX, STATISTICS],
        [("summary-channel", "error", "channel 2 in the summary differs from that in the data section")],
    ),
    "chunks": ([A, B, STATISTICS], [("no-chunk-index", "warning", "the summary lists no chunks: finding a message takes a scan")]),
    "statistics": ([A, B, CHUNK_INDEX], [("no-statistics", "warning", "there are no statistics: counting takes a scan")]),
}  # fmt: skip


@pytest.mark.parametrize(("records", "found"), LACKING.values(), ids=LACKING)
def test_what_a_summary_lacks_is_a_warning_where_it_costs_time_and_an_error_where_it_hides_messages(
    records, found, tmp_path
):
    start = summarised(tmp_path / "a.mcap", *records)
    assert findings(tmp_path / "a.mcap") == [(kind, start, level, words) for kind, level, words in found]


def test_summary_offsets_are_in_the_summary_and_name_its_groups(tmp_path):
    path, records = tmp_path / "a.mcap", [A, B, CHUNK_INDEX, STATISTICS]
    size, start = sum(map(len, records)), summarised(path, *records)
    for offsets in (-1, size + 1, -start + 3):
        summarised(path, *records, offsets=offsets)
        words = f"the footer places the summary offsets at byte {start + offsets}"
        assert findings(path) == [("footer", start + size, "error", words)]

    def offset(place: int, of: int | None = None, longer: int = 0) -> bytes:
        low = start + sum(map(len, records[:place]))
        whole = len(records[place]) if of is None else of
        return record(0x0E, struct.pack("<BQQ", records[place][0], low, whole + longer))

    groups = [offset(place) for place in range(4)]
    at = start + size
    for listed, found in (
        (groups, []),
        (groups[:3], [("no-summary-offset", at, "warning", "the statistics records have no summary offset")]),
        ([*groups[1:], A], [
            ("summary-offset", at + 3 * len(groups[0]), "error", "a schema among summary offsets"),
            ("no-summary-offset", at, "warning", "the schema records have no summary offset"),
        ]),
        ([offset(0, longer=1), *groups[1:]], [
            ("summary-offset", at, "error", "the schema records are not at their summary offset")
        ]),
        ([*groups[:2], offset(2, of=0), groups[3]], [
            ("empty-group", at + 2 * len(groups[0]), "warning", "a summary offset of an empty group of chunk-index "
             "records; some readers report it as damage")
        ]),
    ):  # fmt: skip
        summarised(path, *records, *listed, offsets=size)
        assert findings(path) == found


def test_a_summary_that_lacks_the_schema_of_one_of_its_channels_is_not_believed(tmp_path):
    """As many schemas as there are, but not those: the data section says which schema the second channel has."""
    more = [schema(3, "Other"), channel(4, 3, "/c")]
    data = MAGIC + b"".join([HEADER, A, B, *more, *WHOLE, END])
    moved = CHUNK_AT + sum(map(len, more))
    index_of_chunk = CHUNK_INDEX.replace(struct.pack("<Q", CHUNK_AT), struct.pack("<Q", moved)).replace(
        struct.pack("<Q", CHUNK_AT + len(WHOLE[0])), struct.pack("<Q", moved + len(WHOLE[0]))
    )
    statistics = record(0x0B, struct.pack("<QHIIIIQQIHQ", 2, 2, 2, 0, 0, 1, 5, 7, 10, 2, 2))
    for third, said in ((schema(3, "Summary"), "Summary"), (schema(9, "Summary"), "Other")):
        records = b"".join([A, third, B, channel(4, 3, "/c"), index_of_chunk, statistics])
        footer = struct.pack("<BQQQ", 0x02, 20, len(data), 0)
        crc = zlib.crc32(records + footer).to_bytes(4, "little")
        (tmp_path / "a.mcap").write_bytes(data + records + footer + crc + MAGIC)
        with log.read(tmp_path / "a.mcap") as opened:
            assert opened.channel("/c").schema_name == said
            assert opened.channel("/a").schema_name == "Thing"
