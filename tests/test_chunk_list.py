"""Index entries of chunks as columns: they are as in a list of records."""

from __future__ import annotations

import heapq
import struct
from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import ChunkIndex

from mcaptrack import log
from mcaptrack.log.index import ChunkList
from mcaptrack.log.records import chunk_index

NUMBERS = st.integers(0, 2**64 - 1)
CHANNELS = st.dictionaries(st.one_of(st.integers(0, 3), st.just(2**16 - 1)), NUMBERS, max_size=3)
PLACES = st.one_of(st.integers(0, 9), NUMBERS)
ENTRIES = st.builds(
    ChunkIndex, message_start_time=NUMBERS, message_end_time=NUMBERS, chunk_start_offset=PLACES, chunk_length=PLACES,
    message_index_offsets=CHANNELS, message_index_length=NUMBERS,
    compression=st.sampled_from(["", "zstd", "lz4", "other"]), compressed_size=NUMBERS, uncompressed_size=NUMBERS,
)  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(plain=st.lists(ENTRIES, max_size=7), wanted=st.sets(st.integers(0, 4)))
def test_columns_hold_what_a_list_of_records_holds(plain, wanted):
    made = ChunkList(plain)
    assert (list(made), len(made), made[1:], made[::-1]) == (plain, len(plain), plain[1:], plain[::-1])
    assert [made[number] for number in range(-len(plain), len(plain))] == plain + plain
    assert list(made.with_channels(wanted)) == [one for one in plain if wanted & set(one.message_index_offsets)]
    assert made.channels == {channel for one in plain for channel in one.message_index_offsets}
    assert made.offsets.tolist() == [one.chunk_start_offset for one in plain]
    assert made.are_all_indexed == all(one.message_index_offsets for one in plain)
    assert made.listed == sum(one.message_index_length - 15 * len(one.message_index_offsets) for one in plain)
    full = [one for one in plain if one.message_index_offsets]
    spans = (min(one.message_start_time for one in full), max(one.message_end_time for one in full)) if full else None
    assert made.times() == spans
    ends = [0, *(one.chunk_start_offset + one.chunk_length for one in plain)]
    starts = [*(one.chunk_start_offset for one in plain), 30]
    assert made.are_apart(0, 30) == all(end <= start for end, start in zip(ends, starts, strict=True))
    made.sort_by_offset()
    ordered = sorted(plain, key=lambda one: one.chunk_start_offset)
    assert list(made) == ordered
    for end in (0, 5, 2**64):
        part, kept = made.before(end), [one for one in ordered if one.chunk_start_offset < end]
        part.append(plain[0] if plain else chunk_index((0, 0), (0, 0), {1: 2}, 0, ("new", 0, 0)))
        assert list(part)[:-1] == kept
    assert list(made) == ordered  # what is added to a part isn't added here
    for one in ordered:
        assert made.at(one.chunk_start_offset) == next(
            other for other in ordered if other.chunk_start_offset == one.chunk_start_offset
        )
        assert (made.at(one.chunk_start_offset + 1) is None) == all(
            other.chunk_start_offset != one.chunk_start_offset + 1 for other in ordered
        )


@settings(max_examples=60, deadline=None)
@given(one=st.lists(ENTRIES, max_size=3), other=st.lists(ENTRIES, max_size=3), change=st.integers(0, 8))
def test_columns_are_equal_if_the_lists_are(one, other, change):
    assert ChunkList(one) == ChunkList(one)
    assert (ChunkList(one) == ChunkList(other)) == (one == other)
    for number, entry in enumerate(one):
        name, value = list(vars(entry).items())[change]
        new = {7: 8} if isinstance(value, dict) else "x" if isinstance(value, str) else value ^ 1
        changed = replace(entry, **{name: new})
        assert ChunkList([*one[:number], changed, *one[number + 1 :]]) != ChunkList(one)


def test_chunks_that_stay_open_for_other_channels_are_counted_once_each(tmp_path, monkeypatch):
    """Their number doesn't matter for the time that the next takes, and their size is limited."""
    from mcaptrack.log import messages

    path = tmp_path / "a.mcap"
    with log.create(path) as writer:
        ids = [writer.add_channel(topic, ("", "", b""), "raw", {}) for topic in ("/a", "/b")]
        for number in range(60):
            heads = [struct.pack("<BQHIQQ", 5, 122, one, number, number, number) + bytes(100) for one in ids]
            writer.write_kept_records(
                "media", [(one, number, memoryview(h)) for one, h in zip(ids, heads, strict=True)]
            )
    monkeypatch.setattr(messages, "_KEPT_BYTES", 2000)
    with log.read(path) as opened:
        together = heapq.merge(*map(opened.messages, ["/a", "/b"]), key=lambda m: m.t_ns)
        assert [m.t_ns for m in together] == [n for n in range(60) for _ in range(2)]
        reading = opened.snapshot.messages
        assert reading._opened_bytes == sum(map(len, reading._opened.values())) <= 2000
        list(opened.messages("/b"))
        assert reading._opened_bytes == sum(map(len, reading._opened.values())) <= 2000
