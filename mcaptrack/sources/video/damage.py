"""Find damage in streams without decoding them: by zeros where a NAL unit can't have any, by jumps in the numbers of
pictures (H.264), and by packets that are missing in a transport stream.

Other damage shows only when pictures are decoded.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Ints
from mcaptrack.sources.video.h264 import FrameNumber, FrameNumbers

#: As many zero bytes are no padding between NAL units but a hole in the file.
_HOLE: Final = bytes(64)
_START: Final = b"\x01"
#: Encoders that pad pictures with zeros do so in more than this share of them; those that don't count pictures as the
#: standard wants have more jumps than this share.
_PADDED, _UNCOUNTED = 0.1, 0.25
#: Transport streams: the bytes of a packet and its first byte; formats have 0, 4 (M2TS) or 16 (checksums) bytes more.
_PACKET, _SYNC, _EXTRA = 188, 0x47, (0, 4, 16)
_BLOCK: Final = 1 << 22
_SURE: Final = 4


class Holes:
    """Counts pictures of H.264 or H.265 (Annex B) in which a part was replaced by zeros, as file systems and broken
    transfers leave them.

    Within NAL units there are no three zero bytes in a row (ITU-T H.264, 7.4.1), and between them only before a start
    code. Zeros at the end of a picture may be padding, if many have them.
    """

    def __init__(self) -> None:
        self._pictures, self._within, self._at_end = 0, 0, 0

    def add(self, data: bytes) -> None:
        """Look at one picture."""
        self._pictures += 1
        at, is_hole = data.find(_HOLE), False
        if at < 0:
            return
        while at >= 0:
            rest = data[at:].lstrip(b"\x00")
            is_hole |= bool(rest) and not rest.startswith(_START)
            at = data.find(_HOLE, len(data) - len(rest)) if rest else -1
        self._within += is_hole
        self._at_end += not is_hole and data.endswith(_HOLE)

    @property
    def count(self) -> int:
        """The number of damaged pictures."""
        return self._within + (self._at_end if self._at_end <= _PADDED * self._pictures else 0)


class MissingPictures:
    """Counts pictures of H.264 that are missing, by the numbers in their slices (7.4.3)."""

    def __init__(self) -> None:
        self._numbers = FrameNumbers()
        self._before: FrameNumber | None = None
        self._pictures = 0
        self._places: list[int] = []

    def add(self, index: int, data: bytes) -> None:
        """Look at picture ``index``."""
        number = self._numbers.of(data)
        self._pictures += 1
        if number is None:
            self._before = None
            return
        before = self._before
        # After a reset of the numbers by the encoder (memory management control operation 5) they go on from 0.
        is_counted = not (number.is_idr or number.may_jump) and number.value > 1
        if before and is_counted and (number.value - before.value) % number.modulus > 1:
            self._places.append(index)
        if number.is_reference or before is None:
            self._before = number

    @property
    def places(self) -> list[int]:
        """The pictures before which others are missing; none if the encoder doesn't count as the standard wants."""
        return self._places if len(self._places) <= _UNCOUNTED * self._pictures else []


def transport_faults(path: Path, pid: int) -> int:
    """The number of places in a transport stream (ISO 13818-1, 2.4.3) where packets of a stream are missing or
    damaged: jumps of their counter, and bytes between packets that belong to none.
    """
    faults, last = 0, -1
    for packets, is_after_gap in _transport_packets(path):
        faults += is_after_gap
        head = packets[:, :6].astype(np.int64)
        mine = ((head[:, 1] & 0x1F) << 8 | head[:, 2]) == pid
        faults += int((mine & (head[:, 1] & 0x80 > 0)).sum())  # transport_error_indicator
        mine &= head[:, 3] & 0x10 > 0  # has a payload
        counters: Ints = head[mine, 3] & 0x0F
        is_restart: Bools = (head[mine, 3] & 0x20 > 0) & (head[mine, 4] > 0) & (head[mine, 5] & 0x80 > 0)
        before = np.concatenate([[last], counters[:-1]])[: len(counters)]
        step = (counters - before) % 16
        jumps = (step > 1) & ~is_restart & (before >= 0)  # a packet may come twice
        faults += int(jumps.sum()) if not is_after_gap else int(jumps[1:].sum())
        last = int(counters[-1]) if len(counters) else last
    return faults


def _transport_packets(path: Path) -> Iterator[tuple[np.ndarray, bool]]:
    """The packets of a transport stream (N, 188), in blocks, and whether other bytes stand before a block."""
    with path.open("rb") as file:
        data, at = np.frombuffer(file.read(_BLOCK), np.uint8), 0
        size = next((_PACKET + more for more in _EXTRA if _in_step(data, _PACKET + more) is not None), 0)
        if not size:
            return
        at = _in_step(data, size) or 0
        is_after_gap = False
        while True:
            count = (len(data) - at) // size
            rows = data[at : at + count * size].reshape(count, size)
            wrong = np.flatnonzero(rows[:, 0] != _SYNC)
            good = int(wrong[0]) if len(wrong) else count
            if good:
                yield rows[:good, :_PACKET], is_after_gap
                is_after_gap = False
            at += good * size
            if good < count:
                found = _in_step(data[at:], size)
                is_after_gap = True
                if found is not None:
                    at += found
                    continue
                at = max(at, len(data) - _SURE * size)
            more = np.frombuffer(file.read(_BLOCK), np.uint8)
            if not len(more):
                return
            data, at = np.concatenate([data[at:], more]), 0


def _in_step(data: np.ndarray, size: int) -> int | None:
    """The first offset from which on packets of ``size`` bytes follow one another; None if there is none."""
    starts = np.flatnonzero(data[: max(0, len(data) - (_SURE - 1) * size)] == _SYNC)
    for number in range(1, _SURE):
        starts = starts[data[starts + number * size] == _SYNC]
    return int(starts[0]) if len(starts) else None
