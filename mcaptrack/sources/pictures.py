"""Random access to the pictures of a log, without decoding the video from its beginning.

Decoding begins at the last key picture with parameter sets before the wanted picture. It is found by the first bytes of
messages, searching backwards.

Letters: M messages.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Container, Iterable, Iterator
from typing import Final

import numpy as np

from mcaptrack import log
from mcaptrack.errors import DamagedError, McaptrackError, offer
from mcaptrack.geometry.arrays import Ints
from mcaptrack.log.journal import recover_command
from mcaptrack.notices import warn
from mcaptrack.schema import Frame
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import VIDEO, cameras
from mcaptrack.sources.video import EncodedPicture, decode_bgr, decode_gray, read_head

__all__ = ["Pictures"]

#: The backward search for a key picture: messages in the second step, the factor for each further step, and the maximum
#: in one step.
_STEP, _FURTHER, _MOST = 8, 4, 512
#: Wanted pictures at most this far apart are decoded in one run.
_NEAR: Final = 64
_BLOCK: Final = 128
#: The number of earlier groups of pictures to try for a picture that decoding from its own key picture doesn't show.
_BACK: Final = 2
#: After so many pictures in a row that can't be decoded, it is taken that none can be.
_MOST_IN_A_ROW: Final = 20


def size_of_pictures(opened: log.Log, topic: str) -> tuple[int, int] | None:
    """Return width and height in pixels of the first picture of a channel that can be decoded; None if none can."""
    decoded = enumerate(foreign.pictures(opened, topic))
    where = f"{opened.path}: {topic}"
    return size_of((picture.encoded(m.t_ns, n, f"{where} at {m.t_ns} ns") for n, (m, picture) in decoded))


def picture_size(opened: log.Log, topic: str | None) -> tuple[int, int] | None:
    """Return width and height of the pictures of a channel; None if there are none, or none that can be read."""
    try:
        return size_of_pictures(opened, topic) if topic else None
    except McaptrackError:
        return None


def size_of(pictures: Iterable[EncodedPicture]) -> tuple[int, int] | None:
    """Return width and height in pixels of the first picture that can be decoded; None if none can."""
    first = next(decode_gray(pictures, unreadable=[]), None)
    return None if first is None else (first.rows.shape[1], first.rows.shape[0])


#: The interface of ``video.decode_bgr`` and ``video.decode_gray``: pictures, and which of them are wanted.
Pixels = Callable[[Iterable[EncodedPicture], Container[int]], Iterator[Frame]]


def find_pictures(opened: log.Log, topic: str) -> str:
    """Return the channel of pictures with this topic, or with a topic that ends with it; of "video" the only camera's.

    Raises McaptrackError if there is none, or several.
    """
    topics = [channel.topic for channel in opened.channels.values() if foreign.holds_pictures(channel)]
    name = opened.find(topic, among=topics)
    if name not in topics and topic == VIDEO:  # the name of ingested pictures stands for those of the only camera
        name = only_pictures(opened)
    if name not in topics:
        has = offer(topic, sorted(topics), "it has pictures in") if topics else "it has no pictures"
        raise McaptrackError(f"{opened.path} has no channel {topic} with pictures; {has}")
    return name


def only_pictures(opened: log.Log) -> str:
    """Return the pictures of the only camera, but for depths and worse forms of others; "" of none or several."""
    topics = {camera.pictures for camera in cameras(opened) if camera.pictures}
    if len(topics) > 1:
        forms = [topic for topic in topics if not foreign.better_form(opened, topic)]
        topics = {topic for topic in forms if not foreign.depth_of(opened, topic)} or {*forms}
    return topics.pop() if len(topics) == 1 else ""


class Pictures:
    """The pictures of a channel with random access: reading one decodes at most one group of pictures.

    ``t_ns`` are their sorted log times, (M,); pictures are numbered in this order. ``decoded`` counts the pictures that
    have been decoded. Raises McaptrackError if there is no such channel, or if it holds no pictures.
    """

    def __init__(self, opened: log.Log, topic: str) -> None:
        self._opened, self._topic = opened, topic
        self._picture = foreign.picture_reader(opened, topic)
        self.t_ns: Ints = opened.times(topic)
        self.decoded = 0

    def at(self, times_ns: Iterable[int], pixels: Pixels = decode_bgr) -> Iterator[Frame]:
        """Yield, for each of these times in ns, the latest picture that is not later; in order, without repeats.

        Times before the first picture give the first one.
        """
        index = np.searchsorted(self.t_ns, np.fromiter(times_ns, np.int64), "right") - 1
        return self.frames(np.maximum(index, 0).tolist() if len(self.t_ns) else [], pixels)

    def frames(self, numbers: Iterable[int], pixels: Pixels = decode_bgr) -> Iterator[Frame]:
        """Yield the pictures with these numbers, in order, without repeats; ``index`` is the number.

        Rows are (height, width, 3) uint8, blue, green, red, or with ``pixels=brightness`` (height, width). Pictures of
        a video before the first that decoding can begin with are left out. Raises McaptrackError for pictures that are
        damaged or can't be decoded.
        """
        wanted = sorted(set(numbers))
        if wanted and not 0 <= wanted[0] <= wanted[-1] < len(self.t_ns):
            raise McaptrackError(f"{self._opened.path}: {self._topic} has {len(self.t_ns)} pictures, not {wanted[-1]}")
        cause = foreign.facts_of(self._opened, self._topic).recogniser.cause
        if wanted and cause:
            raise McaptrackError(f"{self._opened.path}: {self._topic}: no picture can be decoded: {cause}")
        while wanted:
            entered, fed = self._entry(wanted[0]), dict[int, bool]()
            start = entered or 0  # without a key picture from the beginning, because some streams use gradual refresh
            missing = set(wanted)
            for frame in pixels(self._run(start, wanted, fed), set(wanted)):
                missing.discard(frame.index)
                yield frame
            for number, has_picture in fed.items():
                if has_picture and number in missing and entered is not None:
                    yield self._from_before(number, start, pixels)
            wanted = wanted[len(fed) :]

    def readable(self, numbers: Iterable[int], damaged: list[McaptrackError] | None = None) -> Iterator[Frame]:
        """Yield the pictures with these numbers, as ``frames``, without those that are damaged or can't be decoded.

        Their errors are added to ``damaged``, or without it said in one warning. Raises McaptrackError if many in a row
        can't be decoded, or none can.
        """
        wanted, errors = sorted(set(numbers)), list[McaptrackError]()
        done, in_a_row, yielded = 0, 0, 0
        while done < len(wanted):
            try:
                for frame in self.frames(wanted[done:]):
                    done, in_a_row, yielded = bisect_right(wanted, frame.index), 0, yielded + 1
                    yield frame
                break
            except McaptrackError as error:
                errors.append(error)
                done, in_a_row = done + 1, in_a_row + 1
                if in_a_row > _MOST_IN_A_ROW:
                    raise
        if errors and not yielded:
            raise errors[0]
        if damaged is not None:
            damaged.extend(errors)
        elif errors:
            left_out = f"{len(errors)} of {len(wanted)} pictures of {self._topic} can't be decoded and are left out"
            warn(f"{self._opened.path}: {left_out}, the first: {errors[0]}", "lost")

    def entry_ns(self, t_ns: int) -> int:
        """The time of the message at which decoding of the first picture from a time on begins, or else that time."""
        number = int(np.searchsorted(self.t_ns, t_ns))
        entry = self._entry(number) if number < len(self.t_ns) else None
        return t_ns if entry is None else int(self.t_ns[entry])

    def _entry(self, number: int) -> int | None:
        """Return the message at which decoding of a picture begins: its key picture, or the parameter sets of that.

        None if there is none.
        """
        step, end, is_key = 1, number + 1, False
        while end > 0:
            start = max(0, end - step)
            for at, picture in reversed(list(self._read(start, end))):
                if picture.error:
                    continue
                head = read_head(picture.format, picture.data)
                is_key |= head.is_key
                if is_key and head.has_parameter_sets:
                    return at
            end, step = start, _STEP if step == 1 else min(step * _FURTHER, _MOST)
        return None

    def _run(self, start: int, wanted: list[int], fed: dict[int, bool]) -> Iterator[EncodedPicture]:
        """Yield the pictures to decode from ``start`` on.

        Adds each wanted number to ``fed``, with whether its message contains a picture.
        """
        waiting: list[EncodedPicture] = []
        for number, picture in self._read(start, len(self.t_ns)):
            if number < wanted[0]:
                self.decoded += 1
                yield picture
                continue
            head = read_head(picture.format, picture.data)
            begins = number > start and not picture.error and head.is_key and head.has_parameter_sets
            if begins and not picture.is_video:
                waiting.clear()
            elif begins and waiting:
                return  # none of the pending pictures is wanted, and later wanted ones don't depend on them
            waiting.append(picture)
            if number == wanted[len(fed)]:
                self.decoded += len(waiting)
                yield from waiting
                waiting.clear()
                fed[number] = head.has_picture
                if len(fed) == len(wanted) or wanted[len(fed)] - number > _NEAR:
                    return

    def _from_before(self, number: int, start: int, pixels: Pixels) -> Frame:
        """Decode a picture from an earlier key picture: leading pictures of open groups depend on the group before."""
        for _ in range(_BACK):
            if start == 0:
                break
            start = self._entry(start - 1) or 0
            for frame in pixels(self._run(start, [number], {}), {number}):
                return frame
        where = f"{self._opened.path}: {self._topic} at {int(self.t_ns[number])} ns"
        raise McaptrackError(f"{where} can't be decoded, from the key picture before it on")

    def _read(self, start: int, end: int) -> Iterator[tuple[int, EncodedPicture]]:
        """Yield the encoded pictures with numbers from ``start`` (inclusive) to ``end`` (exclusive)."""
        for first in range(start, end, _BLOCK):
            until = min(first + _BLOCK, end)
            # Messages may share a time, so the interval may contain others.
            before = int(np.searchsorted(self.t_ns, self.t_ns[first]))
            span = int(self.t_ns[first]), int(self.t_ns[until - 1]) + 1
            read = first
            for number, message in enumerate(self._opened.messages(self._topic, *span), before):
                if first <= number < until:
                    read = number + 1
                    where = f"{self._opened.path}: {self._topic} at {message.t_ns} ns"
                    yield number, self._picture(message).encoded(message.t_ns, number, where)
            if read < until:
                raise DamagedError(
                    f"{self._opened.path} is damaged: messages of {self._topic} lie outside of the times that their "
                    f"chunk names; {recover_command(self._opened.path)} repairs that"
                )
