"""The pictures that a transform reads, decoded.

Those that it reads twice are kept in a temporary file in between, so that they are decoded once: the difference of each
picture from the one before, compressed, because much of it is zero where a camera stands still, above all in a video.
Pictures that take more than ``MAX_BYTES`` together, or more room than there is, aren't kept, but decoded again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Image
from mcaptrack.pipeline.ahead import Ahead
from mcaptrack.pipeline.checks import Job
from mcaptrack.schema import Frame
from mcaptrack.schema.spill import SpillFile, Stored
from mcaptrack.sources import foreign
from mcaptrack.sources.video import EncodedPicture, decode_bgr, decode_gray
from mcaptrack.transforms.protocol import traits_of

MAX_BYTES: Final = 500_000_000


class _Kept(NamedTuple):
    t_ns: int
    index: int  # type: ignore[assignment]  # hides tuple.index, which is not needed here
    shape: tuple[int, ...]
    difference: Stored


class KeptPictures:
    """Pictures that can be read repeatedly.

    Parameters
    ----------
    decoded : callable
        Gives the pictures from the first one on.
    max_bytes : int, optional
        The room that they may take in the file; with 0 they are always decoded again.
    """

    def __init__(self, decoded: Callable[[], Iterator[Frame]], max_bytes: int = MAX_BYTES) -> None:
        self._decoded, self._max_bytes = decoded, max_bytes
        self._kept: list[_Kept] = []
        self._file = SpillFile()
        self._is_complete = False

    def __iter__(self) -> Iterator[Frame]:
        return self._again() if self._is_complete else self._first()

    def _first(self) -> Iterator[Frame]:
        kept, file = list[_Kept](), SpillFile()
        left, before = self._max_bytes, np.zeros(0, np.uint8)
        for frame in self._decoded():
            if left > 0:
                rows = frame.rows.copy()  # a transform may draw into its pictures
                difference = rows - before if rows.shape == before.shape else rows
                try:
                    there = file.put(np.ascontiguousarray(difference).data)
                except McaptrackError:  # there is no room
                    left = 0
                else:
                    before, left = rows, left - there.stored
                    kept.append(_Kept(frame.t_ns, frame.index, rows.shape, there))
                if left <= 0:
                    kept, file = [], SpillFile()
            yield frame
        self._kept, self._file, self._is_complete = kept, file, left > 0

    def _again(self) -> Iterator[Frame]:
        before: Image = np.zeros(0, np.uint8)
        for t_ns, index, shape, there in self._kept:
            difference = np.frombuffer(self._file.get(there), np.uint8).reshape(shape)
            before = before + difference if before.shape == shape else difference
            yield Frame(t_ns, index, before.copy())


def pictures_of(
    opened: log.Log, job: Job, stamps: list[int], damaged: list[int]
) -> tuple[Callable[[], str], Iterable[Frame]]:
    """Return the digest (once they were read) and the pictures for a job, decoded in its transform's colour format.

    They are decoded in a thread. The capture time of each in ns is appended to ``stamps``, the numbers of damaged ones
    to ``damaged``.
    """
    import hashlib

    total, channel = hashlib.sha256(), opened.channel(job.source)
    decode = decode_bgr if traits_of(job.transform).colour == "bgr" else decode_gray

    def encoded(is_first: bool) -> Iterator[EncodedPicture]:
        for index, (message, picture) in enumerate(foreign.pictures(opened, channel.topic)):
            if is_first:
                total.update(message.t_ns.to_bytes(8, "little") + message.payload)
                stamps.append(picture.stamp_ns)
            where = f"{opened.path}: {channel.topic} at {message.t_ns} ns: frame {index}"
            yield EncodedPicture(message.t_ns, index, picture.format, picture.data, picture.layout, where)

    stamps.clear()
    max_bytes = MAX_BYTES if traits_of(job.transform).passes > 1 else 0

    def decoded() -> Iterator[Frame]:
        is_first = not stamps
        return decode(encoded(is_first), damaged=damaged if is_first else None)

    return total.hexdigest, Ahead(KeptPictures(decoded, max_bytes))
