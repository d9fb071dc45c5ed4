"""Any picture of a log, without decoding the video from its beginning.

Decoding begins at the last key picture that has its parameter sets with it. Which one that is, the first bytes of the
messages say, from the wanted picture backwards.

Letters: M messages.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator
from typing import Final, Protocol

import numpy as np

from mcaptrack import log
from mcaptrack.errors import DamagedError, McaptrackError
from mcaptrack.geometry.arrays import Ints
from mcaptrack.log.journal_check import recover_command
from mcaptrack.schema import Frame
from mcaptrack.sources import foreign
from mcaptrack.sources.video import EncodedPicture, decode_bgr, read_head

#: So many messages are looked at in the second step back to a key picture, so many times more in each further one, and
#: never more than so many at once.
_STEP, _FURTHER, _MOST = 8, 4, 512
#: Pictures that are no further apart than this are reached by reading on.
_NEAR: Final = 64
_BLOCK: Final = 128
#: So many groups before its own a picture is looked for that its own does not show.
_BACK: Final = 2


class Pixels(Protocol):
    """Encoded pictures -> those that are wanted: ``video.decode_bgr`` or ``video.decode_gray``."""

    def __call__(self, pictures: Iterable[EncodedPicture], wanted: Container[int] | None = None, /) -> Iterator[Frame]:
        """Frames whose rows are pixels."""


class Pictures:
    """The pictures of a channel, each for the decoding of one group of pictures at most.

    ``t_ns`` are their log times, rising, (M,); pictures are numbered in that order. ``decoded`` is how many have been
    decoded so far. Raises McaptrackError if the channel is not there or holds something else.
    """

    def __init__(self, opened: log.Log, topic: str) -> None:
        self._opened, self._topic = opened, topic
        self._picture = foreign.picture_reader(opened, topic)
        self.t_ns: Ints = opened.times(topic)
        self.decoded = 0

    def at(self, times_ns: Iterable[int], pixels: Pixels = decode_bgr) -> Iterator[Frame]:
        """What is seen at these times: for each the last picture that is not later, rising, each once.

        Times before the first picture are those of the first.
        """
        found = np.searchsorted(self.t_ns, np.fromiter(times_ns, np.int64), "right") - 1
        return self.frames(np.maximum(found, 0).tolist() if len(self.t_ns) else [], pixels)

    def frames(self, numbers: Iterable[int], pixels: Pixels = decode_bgr) -> Iterator[Frame]:
        """The pictures with these numbers, rising, each once; ``index`` is the number.

        Rows are (height, width, 3) uint8, blue, green, red, or with ``pixels=brightness`` (height, width). Pictures of
        a video before the first that decoding can begin with are left out. Raises McaptrackError for pictures that are
        damaged or can't be decoded.
        """
        wanted = sorted(set(numbers))
        if wanted and not 0 <= wanted[0] <= wanted[-1] < len(self.t_ns):
            raise McaptrackError(f"{self._opened.path}: {self._topic} has {len(self.t_ns)} pictures, not {wanted[-1]}")
        while wanted:
            entered, fed = self._entry(wanted[0]), dict[int, bool]()
            start = entered or 0  # without a key picture from the beginning, since some streams refresh bit by bit
            missing = set(wanted)
            for frame in pixels(self._run(start, wanted, fed), set(wanted)):
                missing.discard(frame.index)
                yield frame
            for number, has_picture in fed.items():
                if has_picture and number in missing and entered is not None:
                    yield self._from_before(number, start, pixels)
            wanted = wanted[len(fed) :]

    def _entry(self, number: int) -> int | None:
        """Where decoding begins that is to show a picture: the last key picture up to it, or where its sets stand.

        None if there is none.
        """
        step, end, is_key = 1, number + 1, False
        while end > 0:
            start = max(0, end - step)
            for at, picture in reversed(list(self._read(start, end))):
                head = read_head(picture.format, picture.data)
                is_key |= head.is_key
                if is_key and head.has_parameter_sets:
                    return at
            end, step = start, _STEP if step == 1 else min(step * _FURTHER, _MOST)
        return None

    def _run(self, start: int, wanted: list[int], fed: dict[int, bool]) -> Iterator[EncodedPicture]:
        """What has to be decoded from ``start`` on, as far as it is of use.

        ``fed`` gets what that has of ``wanted``, and whether it holds a picture.
        """
        waiting: list[EncodedPicture] = []
        for number, picture in self._read(start, len(self.t_ns)):
            if number < wanted[0]:
                self.decoded += 1
                yield picture
                continue
            head = read_head(picture.format, picture.data)
            begins = number > start and head.is_key and head.has_parameter_sets
            if begins and not picture.is_video:
                waiting.clear()
            elif begins and waiting:
                return  # nothing of what waits is wanted, and what is wanted later need not have it
            waiting.append(picture)
            if number == wanted[len(fed)]:
                self.decoded += len(waiting)
                yield from waiting
                waiting.clear()
                fed[number] = head.has_picture
                if len(fed) == len(wanted) or wanted[len(fed)] - number > _NEAR:
                    return

    def _from_before(self, number: int, start: int, pixels: Pixels) -> Frame:
        """A picture that its key picture does not show: leading pictures of open groups need the group before."""
        for _ in range(_BACK):
            if start == 0:
                break
            start = self._entry(start - 1) or 0
            for frame in pixels(self._run(start, [number], {}), {number}):
                return frame
        where = f"{self._opened.path}: {self._topic} at {int(self.t_ns[number])} ns"
        raise McaptrackError(f"{where} can't be decoded, from the key picture before it on")

    def _read(self, start: int, end: int) -> Iterator[tuple[int, EncodedPicture]]:
        """The pictures from number ``start`` to before ``end``, as they stand in the log."""
        for first in range(start, end, _BLOCK):
            until = min(first + _BLOCK, end)
            # Messages may share a time: then some that are not meant come along.
            before = int(np.searchsorted(self.t_ns, self.t_ns[first]))
            span = int(self.t_ns[first]), int(self.t_ns[until - 1]) + 1
            read = first
            for number, message in enumerate(self._opened.messages(self._topic, *span), before):
                if first <= number < until:
                    read = number + 1
                    picture = self._picture(message)
                    where = f"{self._opened.path}: {self._topic} at {message.t_ns} ns"
                    yield (
                        number,
                        EncodedPicture(message.t_ns, number, picture.format, picture.data, picture.layout, where),
                    )
            if read < until:
                raise DamagedError(
                    f"{self._opened.path} is damaged: messages of {self._topic} lie outside of the times that their "
                    f"chunk names; {recover_command(self._opened.path)} mends that"
                )
