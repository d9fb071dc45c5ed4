"""Frames that are made in a thread while those before them are worked on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextvars import copy_context
from queue import Full, Queue
from threading import Event, Thread
from typing import Final

from mcaptrack.schema import Frame

#: Frames that wait at most: pictures take megabytes.
_WAITING: Final = 3
#: How soon the thread notices that no more frames are wanted, in seconds.
_PAUSE_S: Final = 0.05


class Ahead:
    """Frames that are made in a thread, a few before they are asked for; as often as they are read.

    Decoding releases Python's lock, so it runs beside what is computed with the pictures. Exceptions of the thread are
    raised where the frames are read, and its warnings are those of the reader.

    Parameters
    ----------
    frames : iterable of Frame
        What makes them each time that it is iterated.
    """

    def __init__(self, frames: Iterable[Frame]) -> None:
        self._frames = frames

    def __iter__(self) -> Iterator[Frame]:
        made: Queue[Frame | BaseException | None] = Queue(_WAITING)
        is_over = Event()
        thread = Thread(target=copy_context().run, args=(_make, self._frames, made, is_over), daemon=True)
        thread.start()
        try:
            while isinstance(frame := made.get(), Frame):
                yield frame
            if frame is not None:
                raise frame
        finally:
            is_over.set()
            thread.join()


def _make(frames: Iterable[Frame], made: Queue[Frame | BaseException | None], is_over: Event) -> None:
    """Put frames into the queue until they are all made or no more are wanted; then None, or what went wrong."""
    last: BaseException | None = None
    try:
        for frame in frames:
            if not _put(frame, made, is_over):
                break
    except BaseException as error:  # it is raised where frames are read
        last = error
    _put(last, made, is_over)


def _put(one: Frame | BaseException | None, made: Queue[Frame | BaseException | None], is_over: Event) -> bool:
    while not is_over.is_set():
        try:
            made.put(one, timeout=_PAUSE_S)
        except Full:
            continue
        return True
    return False
