"""Reads of an object in a store: the right bytes in few requests, whatever is announced, asked for or forgotten."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.location import parse
from mcaptrack.log import chunks, messages, remote
from mcaptrack.log.records import Damaged
from mcaptrack.log.remote import RemoteFile
from tests.logs import write_stock

KIB = 2**10
#: The end that is read when an object is opened, and what expected ranges are made longer by.
END, MARGIN = 128 * KIB, 4 * KIB
SIZE = 4 * 2**20 + 17
CONTENT = np.random.default_rng(3).bytes(SIZE)


class Store:
    """One object, and the ranges that were asked for."""

    def __init__(self, content: bytes) -> None:
        self.content, self.asked = content, []

    def read_end(self, _: object, size: int) -> tuple[SimpleNamespace, bytes]:
        return SimpleNamespace(size=len(self.content)), self.content[-size:]

    def read_ranges(self, _: object, __: object, ranges: list[tuple[int, int]]) -> list[bytes]:
        assert all(0 <= low < high <= len(self.content) for low, high in ranges)
        self.asked.append(list(ranges))
        return [self.content[low:high] for low, high in ranges]


def opened(monkeypatch: pytest.MonkeyPatch, content: bytes = CONTENT) -> tuple[RemoteFile, Store]:
    store = Store(content)
    monkeypatch.setattr(remote, "store_of", lambda _: store)
    return RemoteFile(parse("s3://bucket/a.mcap")), store


def reads(file: RemoteFile, at: int, size: int) -> None:
    assert file.read(at, size) == CONTENT[at : at + size]


def test_the_end_is_there_from_the_start(monkeypatch):
    file, store = opened(monkeypatch)
    assert (file.size, file.signature()) == (SIZE, (SIZE, 0, 0))
    reads(file, SIZE - END, END)
    reads(file, SIZE - 5, 5)
    assert file.read(SIZE, 0) == b""
    assert store.asked == []
    reads(file, SIZE - END - 10, 30)  # what was read already isn't read again
    assert store.asked == [[(SIZE - END - 10, SIZE - END)]]
    with pytest.raises(Damaged, match=f"the object ends before byte {SIZE + 1}"):
        file.read(SIZE, 1)
    with pytest.raises(Damaged, match=f"the object ends before byte {SIZE + 4}"):
        file.read(SIZE - 4, 8)
    file.close()
    with pytest.raises(McaptrackError, match="the log is closed"):
        file.read(0, 1)
    with pytest.raises(McaptrackError, match="it is empty"):
        opened(monkeypatch, b"")


def test_reads_that_follow_one_another_grow_and_others_do_not(monkeypatch):
    file, store = opened(monkeypatch)
    reads(file, 0, 10)
    reads(file, 16 * KIB, 1)
    reads(file, 48 * KIB, 1)
    reads(file, 1000 * KIB, 100 * KIB)  # longer than what is read ahead
    reads(file, 2000 * KIB, 1)
    assert [one for (one,) in store.asked] == [
        (0, 16 * KIB), (16 * KIB, 48 * KIB), (48 * KIB, 112 * KIB), (1000 * KIB, 1100 * KIB), (2000 * KIB, 2016 * KIB),
    ]  # fmt: skip
    reads(file, 5, 112 * KIB - 5)
    reads(file, 1050 * KIB, 50 * KIB)
    assert len(store.asked) == 5


def test_announced_ranges_come_in_one_request_and_near_ones_as_one(monkeypatch):
    file, store = opened(monkeypatch)
    # The third begins where the second ends with its margin and the gap, the fourth a byte further.
    second = 100 * KIB + MARGIN + 4 * KIB
    ranges = [(second, second + KIB), (100 * KIB, 101 * KIB), (0, 10), (100 * KIB + 5, 100 * KIB + 6), (-9, 3)]
    far = second + KIB + MARGIN + 4 * KIB + 1
    file.expect([*ranges, (far, far + 1), (SIZE - END - 1, SIZE), (SIZE - END, SIZE - 5), (9, -MARGIN)], 4 * KIB)
    reads(file, 100 * KIB + 7, 20)
    joined = (100 * KIB, second + KIB + MARGIN)
    assert store.asked == [[joined, (far, far + 1 + MARGIN), (SIZE - END - 1, SIZE - END)]]
    reads(file, far, MARGIN)
    reads(file, SIZE - END - 1, 100)
    reads(file, *(second, KIB))
    assert len(store.asked) == 1
    reads(file, 2, 10)  # announced, and before the others
    assert store.asked[1:] == [[(0, 10 + MARGIN), joined, (far, far + 1 + MARGIN), (SIZE - END - 1, SIZE - END)]]
    reads(file, 50 * KIB, 1)  # in no range
    assert store.asked[2:] == [[(50 * KIB, 66 * KIB)]]
    file.expect([])
    reads(file, 90 * KIB, 1)
    assert store.asked[3:] == [[(90 * KIB, 106 * KIB)]]


def test_announced_ranges_are_read_up_to_a_limit(monkeypatch):
    monkeypatch.setattr(remote, "_MAX_AHEAD", 64 * KIB)
    file, store = opened(monkeypatch)
    ranges = [(100 * KIB, 400 * KIB), (1000 * KIB, 1026 * KIB), (1100 * KIB, 1126 * KIB), (1200 * KIB, 1201 * KIB)]
    file.expect(ranges, 0)
    reads(file, 150 * KIB, KIB)
    assert store.asked.pop() == [(100 * KIB, 164 * KIB)]
    reads(file, 300 * KIB, KIB)  # what lies between is more than the limit
    assert store.asked.pop() == [(300 * KIB, 364 * KIB)]
    reads(file, 1000 * KIB, KIB)
    assert store.asked.pop() == [(1000 * KIB, 1030 * KIB), (1100 * KIB, 1130 * KIB)]
    file.expect(ranges, 0)
    reads(file, 1200 * KIB, 70 * KIB)
    assert store.asked.pop() == [(1200 * KIB, 1270 * KIB)]


def test_the_oldest_is_forgotten_first(monkeypatch):
    monkeypatch.setattr(remote, "_KEPT_BYTES", 40 * KIB)
    file, store = opened(monkeypatch)
    for at in (0, 100, 200):
        reads(file, at * KIB, KIB)
    reads(file, 100 * KIB, 16 * KIB)
    reads(file, 200 * KIB, 16 * KIB)
    assert len(store.asked) == 3
    reads(file, 0, 1)
    assert store.asked[3:] == [[(0, 16 * KIB)]]
    reads(file, 100 * KIB, 1)
    assert store.asked[4:] == [[(100 * KIB, 116 * KIB)]]
    reads(file, 1000 * KIB, 300 * KIB)  # one that is larger than all that is kept
    assert len(store.asked) == 6
    reads(file, 1001 * KIB, 299 * KIB)
    assert len(store.asked) == 6
    reads(file, 100 * KIB, 1)
    assert len(store.asked) == 7


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_bytes_are_those_of_the_object(data):
    places = st.integers(0, SIZE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(remote, "_KEPT_BYTES", data.draw(st.sampled_from([200 * KIB, 64 * 2**20])))
        file, store = opened(patch)
        for _ in range(data.draw(st.integers(1, 8))):
            if data.draw(st.booleans()):
                file.expect([(low, low + data.draw(places) // 8) for low in data.draw(st.lists(places, max_size=5))])
            at = data.draw(places)
            reads(file, at, data.draw(st.integers(0, min(SIZE - at, 300 * KIB))))
    assert all(len(one) > 0 for one in store.asked)


def messages_log(path, compressed: bool = False):
    """A log of 60 chunks, one of each channel after the other, of 30 kB each: the index is in its end."""
    payload = np.random.default_rng(5).bytes(30_000)
    some = [("abc"[n % 3], 10 * n, n, bytes([n]) + payload) for n in range(60)]
    write_stock(path, some, chunk_size=100, compression=CompressionType.LZ4 if compressed else CompressionType.NONE)
    return {topic: [(t_ns, n, data) for name, t_ns, n, data in some if name == topic] for topic in "abc"}


@pytest.mark.parametrize("compressed", [False, True])
def test_a_channel_of_a_log_takes_few_requests(monkeypatch, tmp_path, compressed):
    path = tmp_path / "a.mcap"
    there = messages_log(path, compressed)
    store = Store(path.read_bytes())
    monkeypatch.setattr(remote, "store_of", lambda _: store)
    monkeypatch.setattr(messages, "GAP_BYTES", 1000)

    def read(topic: str, span: tuple = (None, None), only_times: bool = False) -> tuple[list, int, int]:
        store.asked.clear()
        with log.read(parse("s3://bucket/a.mcap"), sidecar=False) as opened:
            store.asked.clear()
            if only_times:
                found = opened.times(topic).tolist()
            else:
                found = [(m.t_ns, m.sequence, m.payload) for m in opened.messages(topic, *span)]
        return found, len(store.asked), sum(high - low for one in store.asked for low, high in one)

    whole = 20 * 30_000
    found, requests, size = read("b")
    assert (found, requests) == (there["b"], 1)
    assert whole - 150_000 < size < whole + 20 * 5000
    found, requests, size = read("b", (200, 310))
    assert (found, requests) == ([one for one in there["b"] if 200 <= one[0] < 310], 1)
    assert size < 4 * 36_000
    found, requests, size = read("c", only_times=True)
    assert (found, requests) == ([t_ns for t_ns, *_ in there["c"]], 1)
    assert size < 20 * 4000
    # Larger ones: first their indexes, then the chunks, as they are needed.
    monkeypatch.setattr(messages, "_READ_AT_ONCE_BYTES", whole // 2)
    monkeypatch.setattr(messages, "_MIN_GAP_BYTES", 1000)
    found, requests, size = read("b")
    assert (found, requests) == (there["b"], 2)
    assert size < path.stat().st_size + 20 * 9000  # with what is between them, which is less than another request


def test_an_uncompressed_chunk_that_is_too_large_for_memory_stays_in_the_store(monkeypatch, tmp_path):
    path = tmp_path / "a.mcap"
    there = messages_log(path)
    monkeypatch.setattr(chunks, "_MAX_PLAIN_BYTES", 10_000)
    store = Store(path.read_bytes())
    monkeypatch.setattr(remote, "store_of", lambda _: store)
    for place in (path, parse("s3://bucket/a.mcap")):
        with log.read(place, sidecar=False) as opened:
            for topic, wanted in there.items():
                assert [(m.t_ns, m.sequence, m.payload) for m in opened.messages(topic)] == wanted
