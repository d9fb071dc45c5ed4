"""The pictures that a transform reads, decoded.

Those that it reads twice are kept in a temporary file in between, so that they are decoded once: the difference of each
picture from the one before, compressed, because much of it is zero where a camera stands still, above all in a video.
Pictures that take more than ``MAX_BYTES`` together, or more room than there is, aren't kept, but decoded again.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextvars import copy_context
from dataclasses import replace
from functools import partial
from queue import Full, Queue
from threading import Event, Thread
from typing import Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Image, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import Progress, warn
from mcaptrack.pipeline.checks import Job
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.framing import frame_times, has_any, nearest_times
from mcaptrack.schema.provenance import Provenance
from mcaptrack.schema.spill import SpillFile, Stored
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import VIDEO, camera_at
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import EncodedPicture, decode_bgr, decode_gray
from mcaptrack.transforms import Transform
from mcaptrack.transforms.protocol import latency_of, traits_of
from mcaptrack.transforms.retrack.appearance import LENGTH, Descriptors, at_border, describe, is_clear

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
                    place = file.put(np.ascontiguousarray(difference).data)
                except McaptrackError:  # there is no room
                    left = 0
                else:
                    before, left = rows, left - place.stored
                    kept.append(_Kept(frame.t_ns, frame.index, rows.shape, place))
                if left <= 0:
                    kept, file = [], SpillFile()
            yield frame
        self._kept, self._file, self._is_complete = kept, file, left > 0

    def _again(self) -> Iterator[Frame]:
        before: Image = np.zeros(0, np.uint8)
        for t_ns, index, shape, place in self._kept:
            difference = np.frombuffer(self._file.get(place), np.uint8).reshape(shape)
            before = before + difference if before.shape == shape else difference
            yield Frame(t_ns, index, before.copy())


# Frames that are made in a thread while those before them are worked on.


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
        queue: Queue[Frame | BaseException | None] = Queue(_WAITING)
        is_over = Event()
        thread = Thread(target=copy_context().run, args=(_make, self._frames, queue, is_over), daemon=True)
        thread.start()
        try:
            while isinstance(frame := queue.get(), Frame):
                yield frame
            if frame is not None:
                raise frame
        finally:
            is_over.set()
            thread.join()


def _make(frames: Iterable[Frame], queue: Queue[Frame | BaseException | None], is_over: Event) -> None:
    """Put frames into the queue until they are all made or no more are wanted; then None, or what went wrong."""
    last: BaseException | None = None
    try:
        for frame in frames:
            if not _put(frame, queue, is_over):
                break
    except BaseException as error:  # it is raised where frames are read
        last = error
    _put(last, queue, is_over)


def _put(item: Frame | BaseException | None, queue: Queue[Frame | BaseException | None], is_over: Event) -> bool:
    while not is_over.is_set():
        try:
            queue.put(item, timeout=_PAUSE_S)
        except Full:
            continue
        return True
    return False


def pictures_of(
    opened: log.Log, job: Job, stamps: list[int], damaged: list[int], unreadable: list[McaptrackError]
) -> tuple[Callable[[], str], Iterable[Frame]]:
    """Return the digest (once they were read) and the pictures for a job, decoded in its transform's colour format.

    They are decoded in a thread. The capture time of each in ns is appended to ``stamps``, the numbers of damaged ones
    of videos to ``damaged``, the errors of images that are left out to ``unreadable``.
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
            yield picture.encoded(message.t_ns, index, where)

    stamps.clear()
    max_bytes = MAX_BYTES if traits_of(job.transform).passes > 1 else 0

    def decoded() -> Iterator[Frame]:
        is_first, last = not stamps, -1
        frames = decode(encoded(is_first), None, damaged if is_first else None, unreadable if is_first else [])
        for frame in frames:
            if is_first and frame.index < last:
                text = "pictures are shown in another order than messages have (B-frames); their times are of messages"
                warn(f"{channel.topic}: {text}", "clock")
                is_first = False
            last = frame.index
            yield frame

    return total.hexdigest, Ahead(KeptPictures(decoded, max_bytes))


# Descriptors of tracks in the pictures of their camera, for transforms that compare what tracks look like.
#
# They are held in memory during the run. What is written, on request, are the means of each track.


#: The name under which progress is reported.
STAGE: Final = "appearance"
#: The picture that shows a sample is at most this far away: people have hardly moved.
_NEAR_NS: Final = NS_PER_S // 10


def with_descriptors(
    transform: Transform,
    opened: log.Log,
    prefix: str,
    frames: Sequence[Frame],
    progress: Progress = lambda *_: None,
    keep: Collection[str] | None = None,
) -> Transform:
    """Return a transform of tracks that compares what these look like, or writes it, with descriptors of ``frames``,
    its input; any other transform as it is.

    Boxes are in pixels of the picture of their time. ``progress`` is called as by ``run``; ``keep`` are the outputs
    that are written, None for all. Pictures that can't be decoded are left out, with a warning; so is what the user
    asked for and the log doesn't allow.
    """
    compares, stores = getattr(transform, "appearance", False), getattr(transform, "store_appearance", False)
    if compares is False and not stores:
        return transform
    topic, descriptors = camera_at(opened, prefix).pictures, None
    why = _why_not(transform, frames, keep) if topic else f"the log has no pictures of {prefix}"
    if topic and not why:
        descriptors, why = _descriptors(opened, topic, frames, progress)
    if compares and why:
        warn(f"`appearance=` changes nothing here: {why}", "option-not-used")
    if stores and why:
        warn(f"`store_appearance=` finds nothing to write: {why}", "option-not-used")
    return transform if descriptors is None else replace(transform, descriptors=descriptors)


def _why_not(transform: Transform, frames: Sequence[Frame], keep: Collection[str] | None) -> str:
    """Return why pictures can't be used; "" if they can."""
    if keep is not None and all(latency_of(transform).get(output) != float("inf") for output in keep):
        return "tracks that use the past alone (online) don't look at pictures"
    if getattr(transform, "leaves_unchanged", False) and not getattr(transform, "links_in_picture", False):
        return "tracks are left as they are"
    if not has_any(TRACKS, frames, lambda rows: rows["observed"] & np.isfinite(rows["x_px"])):
        return "the tracks have no boxes in pictures"
    return ""


def _descriptors(
    opened: log.Log, topic: str, frames: Sequence[Frame], progress: Progress
) -> tuple[Descriptors | None, str]:
    """Return the descriptors of ``frames`` in the pictures of a channel; or None, and the reason."""
    damaged: list[McaptrackError] = []
    try:
        pictures = Pictures(opened, topic)
        nearest = _nearest(pictures.t_ns, frame_times(frames))
        parts = list(_described(pictures, frames, nearest, partial(progress, STAGE), damaged))
        if damaged and not parts:
            raise damaged[0]
    except McaptrackError as error:
        warn(f"colours of clothes are not compared (appearance): {error}", "option-not-used")
        return None, "pictures can't be decoded"
    if damaged:
        count = f"{len(damaged)} of {len(np.unique(nearest[nearest >= 0]))} pictures"
        warn(f"colours of clothes are compared without {count} that can't be decoded, the first: {damaged[0]}", "lost")
    if not parts:
        return None, f"no picture of {topic} is within {_NEAR_NS / NS_PER_S:g} s of a sample"
    return Descriptors(*(np.concatenate(members) for members in zip(*parts, strict=True))), ""


def _nearest(picture_ns: Ints, sample_ns: Ints) -> Ints:
    """The number of the picture that shows each sample time, or -1."""
    if len(picture_ns) == 0:
        return np.full(len(sample_ns), -1)
    number = nearest_times(picture_ns, sample_ns)
    return np.where(np.abs(picture_ns[number] - sample_ns) <= _NEAR_NS, number, -1)


def _described(
    pictures: Pictures,
    frames: Sequence[Frame],
    nearest: Ints,
    progress: Callable[[int, int], None],
    damaged: list[McaptrackError],
) -> Iterator[Descriptors]:
    """Yield the descriptors of each frame with a picture; errors of pictures are added to ``damaged``."""
    shown = np.flatnonzero(nearest >= 0)  # in order of time, as pictures are
    wanted, of_picture = np.unique(nearest[shown], return_index=True)
    decoded = pictures.readable(wanted.tolist(), damaged)
    place = dict(zip(wanted.tolist(), shown[of_picture].tolist(), strict=True))
    for done, picture in enumerate(decoded):
        progress(done + 1, len(wanted))
        at = place[picture.index]
        while at < len(frames) and nearest[at] == picture.index:
            frame = frames[at]
            boxes = columns_to_boxes(frame.rows)
            height, width = picture.rows.shape[:2]
            places = np.flatnonzero(frame.rows["observed"] & np.isfinite(boxes).all(axis=1))
            places = places[np.argsort(frame.rows["track_id"][places], kind="stable")]
            boxes, ids = boxes[places], frame.rows["track_id"][places].astype(np.int64)
            clear = is_clear(boxes, width, height)
            values = np.zeros((len(ids), LENGTH), np.uint8)
            values[clear] = describe(picture.rows, boxes[clear])
            yield Descriptors(np.full(len(ids), frame.t_ns), ids, values, clear, at_border(boxes, width, height))
            at += 1


class PictureClock(NamedTuple):
    """The topic of a camera's pictures, None without any; their times, rising, and their stamps (M,) in ns."""

    topic: str | None
    t_ns: Ints
    stamp_ns: Ints


def picture_clock(opened: log.Log, prefix: str, stamps: Mapping[str, Sequence[int]]) -> PictureClock:
    """Return the times of a camera's pictures; ``stamps`` as for ``write``."""
    usual = f"{prefix}/{VIDEO}"
    video = usual if usual in opened.channels else next(iter(stamps), None) or camera_at(opened, prefix).pictures
    picture_ns = opened.times(video) if video else np.empty(0, np.int64)
    video = video if len(picture_ns) else None
    stamp_ns = _stamps(opened, video, stamps.get(video, ())) if video else picture_ns
    return PictureClock(video, picture_ns, stamp_ns)


def _stamps(opened: log.Log, topic: str, read_before: Sequence[int]) -> Ints:
    """Return the capture times of a channel's pictures in ns, (M,) for M pictures.

    ``read_before`` are the times if they were read before. Pictures that were ingested have their capture time as log
    time; in other recordings the messages contain it.
    """
    if Provenance.from_metadata(opened.channel(topic).metadata):
        return opened.times(topic)
    return np.array(read_before, np.int64) if read_before else foreign.stamps(opened, topic)
