"""The bytes of a log in a store: as few requests as its index allows, and never parts of two versions.

Opening an object reads its end, which holds the index of a log. What an index says will be read is announced with
``expect``. It comes in few requests then: neighbouring ranges are one, and those that follow are read ahead. Everything
that was read is kept, up to a limit.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.files import temporary_folder
from mcaptrack.location import Url
from mcaptrack.log.byte_source import GAP_BYTES, MIN_AHEAD, Signature
from mcaptrack.log.recording_files import RESULTS_SUFFIX
from mcaptrack.log.records import Damaged
from mcaptrack.objects import AbsentError, Version, replaced, store_of

#: The bytes at the end of an object that are read when it is opened. The index of most logs fits in.
_END_BYTES: Final = 128 * 2**10
#: The least bytes of a request, the most that are read ahead of what was asked for, and the most that are kept.
_MIN_AHEAD: Final = 16 * 2**10
_MAX_AHEAD: Final = 16 * 2**20
_KEPT_BYTES: Final = 64 * 2**20
#: Expected ranges are made longer by this, because a small read, as of the head of a record, takes as many bytes.
_MARGIN: Final = MIN_AHEAD

Range = tuple[int, int]


class RemoteFile:
    """A version of an object, open for reading. It is an ``OpenFile`` in a store.

    Reading raises McaptrackError if the object has been replaced or the store doesn't answer.
    """

    def __init__(self, url: Url) -> None:
        self.url = url
        try:
            if not url.key.strip("/"):
                raise AbsentError
            self.version, end = store_of(url).read_end(url, _END_BYTES)
        except AbsentError:
            why = "" if url.name.endswith(RESULTS_SUFFIX) else store_of(url).why_absent(url)  # results may be absent
            raise AbsentError(f"{url} can't be read: {why}") from None
        if not self.version.size:
            raise McaptrackError(f"{url} can't be read as an MCAP file: it is empty")
        self._end_at = self.version.size - len(end)
        self._end = memoryview(end)
        self._kept: dict[int, memoryview] = {}  # what was read, by its offset, the latest last
        self._starts: list[int] = []  # its offsets, sorted
        self._kept_bytes = 0
        self._expected: list[Range] = []
        self._ahead, self._next = _MIN_AHEAD, -1
        self._is_open = True

    @property
    def size(self) -> int:
        """The size of the object in bytes."""
        return self.version.size

    def signature(self) -> Signature:
        """The signature, which stays the same: another version of the object is never read."""
        return Signature(self.version.size, 0, 0)

    def close(self) -> None:
        """Forget what was read."""
        self._is_open = False
        self._kept, self._starts, self._kept_bytes = {}, [], 0

    def expect(self, ranges: Iterable[Range], gap: int = GAP_BYTES) -> None:
        """Announce ranges that will be read, in place of those that were announced before."""
        merged: list[Range] = []
        for start, end in sorted(ranges):
            low, high = max(start, 0), min(end + _MARGIN, self._end_at)
            if low >= high:
                continue
            if merged and low - merged[-1][1] <= gap:
                merged[-1] = (merged[-1][0], max(merged[-1][1], high))
            else:
                merged.append((low, high))
        self._expected = merged

    def read(self, at: int, size: int) -> bytes:
        """``size`` bytes from offset ``at``."""
        if not self._is_open:
            raise McaptrackError("the log is closed; what is read bit by bit, such as pictures, needs it open")
        if at + size > self.version.size:
            raise Damaged(f"the object ends before byte {at + size}")
        parts, end = [], at + size
        while at < end:
            piece = self._find(at)
            if piece is None:
                self._fetch(at, end)
                piece = self._find(at)
            assert piece is not None
            parts.append(piece[: end - at])
            at += len(parts[-1])
        return bytes(parts[0]) if len(parts) == 1 else b"".join(parts)

    def _find(self, at: int) -> memoryview | None:
        """The bytes from ``at`` on that are here, if there are any."""
        if at >= self._end_at:
            return self._end[at - self._end_at :]
        last = bisect_right(self._starts, at)
        for start in reversed(self._starts[max(last - 2, 0) : last]):
            if at < start + len(self._kept[start]):
                return self._kept[start][at - start :]
        return None

    def _fetch(self, at: int, end: int) -> None:
        """Read what is missing from ``at`` to ``end``, and what is expected behind it."""
        wanted = self._announced(at, end) or [(at, self._look_ahead(at, end))]
        wanted = [(start, min(stop, self._end_at)) for start, stop in wanted]
        self._next = wanted[-1][1]
        for (start, _), data in zip(
            wanted, store_of(self.url).read_ranges(self.url, self.version, wanted), strict=True
        ):
            self._forget(start)
            until = start + len(data)
            for inner in self._starts[bisect_right(self._starts, start) : bisect_right(self._starts, until)]:
                if inner + len(self._kept[inner]) <= until:
                    self._forget(inner)  # ``_find`` would see it instead of what holds it
            self._kept[start] = memoryview(data)
            self._kept_bytes += len(data)
            insort(self._starts, start)
        while self._kept_bytes > _KEPT_BYTES and len(self._kept) > len(wanted):
            self._forget(next(iter(self._kept)))

    def _forget(self, start: int) -> None:
        """Drop what was read from an offset, if anything."""
        if start in self._kept:
            self._kept_bytes -= len(self._kept.pop(start))
            self._starts.remove(start)

    def _announced(self, at: int, end: int) -> list[Range]:
        """The announced ranges from ``at`` on, up to a limit; none if this part was not announced."""
        number = bisect_right(self._expected, at, key=lambda span: span[0]) - 1
        if number < 0 or self._expected[number][1] <= at:
            return []
        low = max(self._expected[number][0], self._end_before(at))
        low = low if end - low <= _MAX_AHEAD else at  # what comes before is wanted, too
        high = min(max(self._expected[number][1], end), max(low + _MAX_AHEAD, end))
        ranges, total = [(low, high)], high - low
        for start, stop in self._expected[number + 1 :]:
            total += stop - start
            if total > _MAX_AHEAD:
                break
            if start >= high:
                ranges.append((start, stop))
        return ranges

    def _end_before(self, at: int) -> int:
        """The end of the kept bytes that begin before ``at``."""
        last = bisect_right(self._starts, at) - 1
        return self._starts[last] + len(self._kept[self._starts[last]]) if last >= 0 else 0

    def _look_ahead(self, at: int, end: int) -> int:
        """The end of a read that was not announced: each read that continues the last one is longer."""
        self._ahead = min(self._ahead * 2, _MAX_AHEAD) if at == self._next else _MIN_AHEAD
        return max(end, at + self._ahead)


def refuse_replaced(url: Url, version: Version | None) -> None:
    """Raise McaptrackError if an object is not the version that was opened: results would be those of another log."""
    if store_of(url).find(url) != version:
        raise replaced(url)


@contextmanager
def publish_object(url: Url, before: Version | None) -> Iterator[IO[bytes]]:
    """A stream to write an object to; it replaces the version ``before`` when the block succeeds.

    The bytes go to a temporary file first. Raises McaptrackError if the object has another version by then.
    """
    with temporary_folder() as folder:
        part = Path(folder, url.name)
        with part.open("xb") as stream:
            yield stream
        store_of(url).replace(url, part, before)
