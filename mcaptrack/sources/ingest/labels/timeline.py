"""Assign labelled frames to pictures and their times, in one way for all inputs.

Label files number pictures, from 0 or 1 depending on the format. Frame ``first_frame`` of a file is picture 0 of the
camera, the next frame is picture 1, and so on: for pictures that are ingested together with the labels, for pictures of
an existing log, and for missing pictures, with times by a frame rate.

Letters: P pictures, F labelled frames.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Final, NamedTuple, Self, get_args

import numpy as np
from numpy.typing import NDArray

from mcaptrack import log
from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S, parse_fps
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, TRACKS, VIDEO, Frame, Rows
from mcaptrack.schema.framing import joined_parts
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import DEFAULT_CAMERA, provenance_of
from mcaptrack.sources.foreign.flatten import message_type_of
from mcaptrack.sources.ingest.labels.frames import MAX_FRAMES, FrameRanges, described
from mcaptrack.sources.ingest.labels.table import BoxTable
from mcaptrack.sources.pictures import size_of_pictures
from mcaptrack.sources.video import is_video_codec, read_head
from mcaptrack.transforms import STAGES

#: Limits for unlabelled frames of a file without pictures: in total, and for each labelled frame.
_EMPTY_FRAMES: Final = 100_000
_EMPTY_A_LABELLED: Final = 100
#: Intervals up to this multiple of the smallest are one frame.
_ALIKE: Final = 1.5
#: Times differ from those of pictures if it is by more than this, and by this share of half an interval.
_EXACT_MS: Final = 1.0
_NEAR: Final = 0.2
#: Pictures match a frame rate if none deviates by more than this share of a frame.
_OFF_FRAMES: Final = Fraction(1, 2)


class Placed(NamedTuple):
    """The labelled frames of a file (F,): their numbers in the file, picture indexes from 0, and times in ns.

    ``ranges`` are the frames that were labelled where it isn't all of them, and ``by`` is how that is known.
    """

    number: Ints
    index: Ints  # type: ignore[assignment]  # hides tuple.index, which is not needed here
    t_ns: Ints
    ranges: FrameRanges | None = None
    by: str = ""


@dataclass(frozen=True)
class Timeline:
    """The pictures of a camera: ``index`` (P,), counted from 0, and ``t_ns`` (P,), both strictly increasing.

    ``of`` describes them in messages. ``is_complete`` is false if pictures are known to be lost. ``every`` is the step
    of the numbers in their names: 12 for images of which every twelfth was kept with its number.
    """

    index: Ints
    t_ns: Ints
    of: str
    is_complete: bool = True
    every: int = 1

    @classmethod
    def spaced(cls, count: int, fps: Fraction, start_ns: int, of: str) -> Self:
        """``count`` pictures at a frame rate, the first at ``start_ns``.

        Raises McaptrackError if they end after 2262, the limit of int64 nanoseconds.
        """
        index = np.arange(count)
        last_ns = start_ns + round(Fraction(max(count - 1, 0)) / fps * NS_PER_S)
        if last_ns > LAST_NS:
            raise McaptrackError(
                f"{of}: {count} frames at {float(fps):g} a second end {float(count / fps) / 86400:.3g} days after the "
                "start; times reach to the year 2262"
            )
        return cls(index, start_ns + frame_times_ns(index, fps), of)

    @classmethod
    def of_times(cls, path: Path, seconds: Floats, fps: Fraction | None) -> tuple[Self, str]:
        """Pictures at the sorted times of labelled frames, and at regular times in between; and words about it.

        The frame rate is the given one, or that of the smallest interval, if all others are multiples of it. Otherwise
        frames without labels are not known. Raises McaptrackError if times don't fit the given frame rate.
        """
        since = seconds - seconds[0]
        gaps = np.diff(seconds)
        rate = float(fps) if fps else (1 / float(np.median(gaps[gaps < _ALIKE * gaps.min()])) if len(gaps) else 1.0)
        index = np.rint(since * rate)
        is_regular = bool((np.abs(since * rate - index) <= float(_OFF_FRAMES) / 2).all() and (np.diff(index) > 0).all())
        if fps and not is_regular:
            raise McaptrackError(f"{path}: its times are no multiples of 1/{fps} s; leave `fps=` out")
        count = int(index[-1]) + 1 if is_regular else len(seconds)
        if count > max(_EMPTY_FRAMES, _EMPTY_A_LABELLED * len(seconds)) or count > MAX_FRAMES:
            is_regular, count = False, len(seconds)
        all_seconds = np.interp(np.arange(count), index, seconds) if is_regular else seconds
        t_ns = np.rint(all_seconds * NS_PER_S).astype(np.int64)
        text = f"{count} frames by the times, about {rate:.4g} a second, {count - len(seconds)} of them without boxes"
        if not is_regular:
            text = f"{count} frames by the times, which are irregular; frames without boxes are not known"
        if (np.diff(t_ns) <= 0).any():
            raise McaptrackError(f"{path}: its times are less than a nanosecond apart")
        return cls(np.arange(count), t_ns, "the frames by the times in the file"), text

    def fits(self, fps: Fraction) -> bool:
        """Whether the pictures match a frame rate, within half a frame."""
        wanted = self.t_ns[0] + frame_times_ns(self.index - self.index[0], fps)
        return bool((np.abs(self.t_ns - wanted) <= float(_OFF_FRAMES / fps * NS_PER_S)).all())

    @property
    def fps(self) -> float:
        """Frame rate by the median interval; 0 if there are less than two pictures."""
        gaps = np.diff(self.t_ns) / np.diff(self.index)
        return NS_PER_S / float(np.median(gaps)) if len(gaps) else 0.0

    def place(self, labels: BoxTable, role: Role, lost: list[str], ranges: FrameRanges | None = None) -> Placed:
        """Assign the labelled frames of a file to pictures, including frames without labels in between.

        ``ranges`` are the frames that a user says were labelled.

        Raises McaptrackError if there are labels before the first or after the last picture. If pictures are known to
        be lost, such labels are reported in ``lost`` instead.
        """
        path = labels.path
        if labels.times_s is not None:
            return self._place_by_time(labels, labels.times_s, role, ranges)
        if labels.facts.is_in_order and len(labels.labelled) < len(self.index):
            text = f"{path} has {len(labels.labelled)} pictures without numbers, and {self.of} are {len(self.index)}"
            warn(
                f"{text}: they are taken as the first of these; one without labels would shift those after it", "clock"
            )
        every = self._every(labels)
        frame, count = labels.extent.frames
        end = int(self.index[-1]) + 1
        self._choose_first(labels, every, end)
        at = (frame - labels.first_frame) // every
        if at[0] < 0:
            raise McaptrackError(
                f"{path}: its first label is of frame {frame[0]}, and frame {labels.first_frame} is assumed to "
                "be the first picture; give the right number with `first_frame=`"
            )
        beyond = int(count[at >= end].sum())
        if beyond and (self.is_complete or (at >= end).all()):
            raise McaptrackError(self._beyond(labels, beyond, every * (end - 1) + labels.first_frame))
        if beyond:
            lost.append(f"{path}: {beyond} labels are of frames after the last picture that could be read, {end - 1}")
        missing = int(count[(at < end) & ~np.isin(at, self.index)].sum())
        if missing:
            lost.append(f"{path}: {missing} labels are of frames with missing pictures")
        return self._described(labels, role, every * self.index + labels.first_frame, labels.labelled, ranges, None)

    def _described(
        self, labels: BoxTable, role: Role, number: Ints, at: Ints, ranges: FrameRanges | None, place: Ints | None
    ) -> Placed:
        """The pictures that a file describes, as ``described``; ``place`` (P,) are their numbers in its rows."""
        shown = described(labels, role, number, at, ranges, self.of)
        some = shown.pictures
        return Placed((number if place is None else place)[some], self.index[some], self.t_ns[some], *shown[1:])

    def _place_by_time(self, labels: BoxTable, seconds: Floats, role: Role, ranges: FrameRanges | None) -> Placed:
        """Assign frames that have times to the nearest pictures: times of the log, or times since the first picture."""
        path = labels.path
        half = float(np.median(np.diff(self.t_ns))) / 2 if len(self.t_ns) > 1 else NS_PER_S / 2
        first, last = int(self.t_ns[0]), int(self.t_ns[-1])
        since = seconds * NS_PER_S - first  # exact enough: 256 ns today
        if since[0] < -half or since[-1] > last - first + half:
            since = seconds * NS_PER_S
        if since[-1] > last - first + half:
            raise McaptrackError(
                f"{path}: its times are from {seconds[0]:.9g} to {seconds[-1]:.9g} s, {self.of} from "
                f"{first / NS_PER_S:.3f} to {last / NS_PER_S:.3f} s; give times of the log, or since the first picture"
            )
        pictures = (self.t_ns - first).astype(float)
        after = np.clip(np.searchsorted(pictures, since), 1, max(len(pictures) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(pictures) - 1)
        nearest = np.where(np.abs(pictures[after] - since) < np.abs(since - pictures[before]), after, before)
        far = np.abs(pictures[nearest] - since) > half
        if far.any():
            raise McaptrackError(
                f"{path}: {int(far.sum())} of {len(seconds)} times are more than half an interval from any of "
                f"{self.of}, the first at {seconds[far.argmax()]:.9g} s"
            )
        same = np.flatnonzero(np.diff(nearest) == 0)
        if len(same):
            first_s, other = seconds[same[0]], seconds[same[0] + 1]
            raise McaptrackError(f"{path}: {first_s:.9g} and {other:.9g} s are nearest to the same of {self.of}")
        off_ms = float(np.abs(pictures[nearest] - since).max(initial=0.0)) / 1e6
        if off_ms > max(_EXACT_MS, half / 1e6 * _NEAR):
            text = f"{path}: its times are up to {off_ms:.3g} ms from those of {self.of}, and belong to the nearest one"
            warn(f"{text} (up to half an interval, {half / 1e6:.3g} ms)", "clock")
        place = np.full(len(self.t_ns), -1)
        place[nearest] = np.arange(len(seconds))
        return self._described(labels, role, self.index, self.index[nearest], ranges, place)

    def _every(self, labels: BoxTable) -> int:
        """The step of frame numbers in a label file, which may use the numbers in the names of images."""
        if self.every == 1 or ((labels.labelled - labels.first_frame) % self.every).any():
            return 1
        if int(labels.labelled[-1]) > labels.first_frame:
            warn(f"{labels.path} counts frames as the names of {self.of} do, every {self.every}", "clock")
        return self.every

    def _choose_first(self, labels: BoxTable, every: int, end: int) -> None:
        """Choose the number of the first picture by that of the last one where the file doesn't tell, and warn of it.

        A file that was taken to count from 0, as others do, counts from 1 if it has a label one after the last picture.
        The numbers of images that begin later are those of pictures if they fit; otherwise the first one is the first.
        """
        first, last = labels.first_frame, int(labels.labelled[-1])
        if not labels.facts.is_first_assumed or first == 1:
            return
        if first == 0:
            if last // every == end:
                labels.facts.first_frame = 1
                warn(f"{labels.path}: frame {last} is taken to be the last of {end} pictures, counted from 1", "clock")
            return
        text = "is assumed to be the first picture"
        if last // every <= end != (last - first) // every + 1:
            labels.facts.first_frame = int(last // every == end)
            text = f"is taken to be picture {first - labels.first_frame} of {end}, counted from 0"
        warn(
            f"{labels.path}: its first image has the number {first}, and {text}; `first_frame=` sets the number",
            "clock",
        )

    def _beyond(self, labels: BoxTable, beyond: int, end: int) -> str:
        """The error for labels after frame ``end`` of the file, the last picture."""
        frame, count = labels.extent.frames
        first, last = int(frame[0]), int(frame[-1])
        some = "all" if beyond == count.sum() else beyond
        text = (
            f"{labels.path}: {some} labels are of frames after the last picture: {self.of} end with frame "
            f"{end}, the labels with frame {last}"
        )
        if last - first <= end - labels.first_frame and first != labels.first_frame:
            return f"{text}; if frame {first} of the file is the first picture, say so with `first_frame={first}`"
        return f"{text}; give the labels of these pictures, or the part of the file that is of them"


def frame_times_ns(index: Ints, fps: Fraction) -> Ints:
    """The times of pictures (P,) at a frame rate in nanoseconds, rounded half to even."""
    most = int(np.abs(index).max(initial=1)) * fps.denominator * NS_PER_S
    if most >= 2**62 or fps.numerator >= 2**62:
        return np.array([round(Fraction(int(number)) / fps * NS_PER_S) for number in index], np.int64)
    whole, rest = np.divmod(index * (fps.denominator * NS_PER_S), fps.numerator)
    rounded: Ints = whole + ((2 * rest > fps.numerator) | ((2 * rest == fps.numerator) & (whole % 2 == 1)))
    return rounded


def count_frames(labels: BoxTable) -> int:
    """The number of frames up to the last one that a file labels.

    Raises McaptrackError if nearly all of them would be empty, which means that the numbers are wrong.
    """
    last = max(int(labels.labelled[-1]), int(labels.extent.frames[0][-1]))
    count = last - labels.first_frame + 1
    most = max(_EMPTY_FRAMES, _EMPTY_A_LABELLED * len(labels.labelled) * labels.step)
    if count > min(most, MAX_FRAMES):
        first = f"give the number of the first picture with `first_frame={labels.labelled[0]}`"
        mend = f"`frames={count}` takes it so" if count <= MAX_FRAMES else f"at most {MAX_FRAMES} are read"
        raise McaptrackError(
            f"{labels.path}: frame {last} would be the last of {count} frames, of which {len(labels.labelled)} are "
            f"labelled; {mend}, or {first}"
        )
    return count


# Labels as rows of detections and tracks. Letters: N rows.


#: The number of frames of a block, for which times are converted together.
_BLOCK: Final = 4096


def label_rows(labels: BoxTable, role: Role, plane: GroundPlane | None) -> Rows:
    """Convert the N rows of labels to rows of detections or tracks, with positions in metres if a plane is given."""
    if role == "detections" and labels.boxes_px is not None:
        x, y, w, h = labels.boxes_px.T
        return DETECTIONS.rows(x_px=x, y_px=y, w_px=w, h_px=h, score=labels.score, class_id=labels.class_id)
    nowhere = np.full((len(labels.frame), 4), np.nan)
    boxes = nowhere if labels.boxes_px is None else labels.boxes_px
    xy_m = labels.xy_m
    if xy_m is None:
        xy_m = plane.boxes_to_metres(boxes) if plane else nowhere[:, :2]
    columns = dict(zip(("x_px", "y_px", "w_px", "h_px", "x_m", "y_m"), [*boxes.T, *xy_m.T], strict=True))
    is_stated = role == "tracks" and labels.observed is not None
    columns["observed"] = labels.observed if is_stated else np.ones(len(labels.frame), bool)
    columns |= {"score": labels.score, "source_id": np.full(len(labels.frame), -1), "class_id": labels.class_id}
    return TRACKS.rows(track_id=labels.id, **columns)


def frames_of_labels(
    parts: Sequence[Callable[[], BoxTable]], role: Role, plane: GroundPlane | None, placed: Placed
) -> Callable[[], Iterator[Frame]]:
    """The rows of labels, in parts of whole frames, as frames: those that are ``placed``, also empty ones.

    They are made as often as the result is called, and converted once if there is one part.
    """

    @lru_cache(maxsize=1)
    def converted(number: int) -> tuple[Ints, Rows]:
        labels = parts[number]()
        return labels.frame, label_rows(labels, role, plane)

    def frames() -> Iterator[Frame]:
        low = 0
        for number in range(len(parts)):
            frame, rows = converted(number)
            is_last = number == len(parts) - 1
            high = len(placed.number) if is_last else int(np.searchsorted(placed.number, frame[-1], "right"))
            for start in range(low, high, _BLOCK):
                some = slice(start, min(start + _BLOCK, high))
                ends = (np.searchsorted(frame, placed.number[some], side) for side in ("left", "right"))
                columns = (column.tolist() for column in (placed.t_ns[some], placed.index[some], *ends))
                for t_ns, index, first, last in zip(*columns, strict=True):
                    yield Frame(t_ns, index, rows[first:last])
            low = high

    return frames


# Find the pictures that labels belong to. A camera is the part of a topic before its last "/".


class CameraTopics(NamedTuple):
    """The prefix of all topics of a camera, and the topic of its pictures, "" if there are none."""

    prefix: str
    pictures: str


def choose_camera(where: object, camera: str, topics: Collection[str]) -> CameraTopics:
    """The camera with this name, among topics of pictures.

    The name may also be a topic of pictures itself, or be below a camera: a second set of labels for the pictures of
    ``front`` goes to ``front/labels``. With the default name it is the only camera with pictures. Raises
    McaptrackError, with the names, if a camera has several topics of pictures, or if there are several cameras and none
    is named.
    """
    prefix = "/" + camera.strip("/")
    for at in (prefix, *map(str, list(PurePosixPath(prefix).parents)[:-1])):
        if at in topics:
            return CameraTopics(camera_prefix(at) if at == prefix else prefix, at)
        fitting = sorted(topic for topic in topics if camera_prefix(topic) == at)
        if len(fitting) == 1 or f"{at}/video" in fitting:
            return CameraTopics(prefix, f"{at}/video" if len(fitting) > 1 else fitting[0])
        if fitting:
            raise McaptrackError(
                f"{where}: {at} has several topics of pictures, {', '.join(fitting)}; name one with "
                f"`camera={fitting[0].strip('/')!r}`"
            )
    if camera != DEFAULT_CAMERA or not topics:
        return CameraTopics(prefix, "")
    if len(topics) > 1:
        names = sorted({camera_prefix(topic).strip("/") for topic in topics})
        names = names if len(names) == len(topics) else sorted(topic.strip("/") for topic in topics)
        raise McaptrackError(
            f"{where} has pictures of several cameras, {', '.join(sorted(topics))}; labels and ground planes belong to "
            f"those of one: choose with `camera={names[0]!r}`"
        )
    (topic,) = topics
    return CameraTopics(camera_prefix(topic), topic)


def camera_prefix(topic: str) -> str:
    """The prefix of the camera that a topic belongs to."""
    folder, slash, _ = topic.strip("/").rpartition("/")
    return f"/{folder}" if slash else f"/{DEFAULT_CAMERA}"


def camera_of(opened: log.Log, camera: str) -> CameraTopics:
    """The camera with this name in a log. Raises McaptrackError as ``choose_camera`` does."""
    topics = [c.topic for c in opened.channels.values() if foreign.holds_pictures(c) and c.messages]
    return choose_camera(opened.path, camera, topics)


def picture_predicate(kind: foreign.MessageType) -> Callable[[bytes], bool]:
    """A predicate: whether a message of a channel has a picture; video messages may have parameter sets alone."""
    if not foreign.is_compressed(kind.name):
        return lambda _: True
    decode = foreign.picture_decoder(kind)

    def test(payload: bytes) -> bool:
        try:
            picture = decode(payload)
        except McaptrackError:
            return True  # a damaged picture counts; decoding it reports what is wrong
        return read_head(picture.format, picture.data).has_picture

    return test


def timeline_of(opened: log.Log, topic: str) -> Timeline:
    """The pictures of a channel. Raises McaptrackError if it is damaged, or holds no pictures."""
    t_ns: NDArray[np.int64] = opened.times(topic)
    index, every, of = np.arange(len(t_ns)), 1, f"the pictures of {topic}"
    provenance = provenance_of(opened, topic)
    if provenance:
        value = provenance.parameters.get("every")
        every = value if isinstance(value, int) and value > 0 else 1
        last = max(message.sequence for message in opened.messages(topic, int(t_ns[-1])))
        if last + 1 != len(t_ns):  # some pictures could not be read; the others keep their numbers
            index = np.array([message.sequence for message in opened.messages(topic)], np.int64)
    elif _may_be_video(opened, topic):
        is_picture = picture_predicate(message_type_of(opened, topic))
        t_ns = np.array([m.t_ns for m in opened.messages(topic) if is_picture(m.payload)], np.int64)
        index = np.arange(len(t_ns))
    if not len(t_ns):
        raise McaptrackError(f"{opened.path}: {topic} has no pictures that labels could be of")
    return Timeline(index, t_ns, of, len(index) == index[-1] + 1, every)


def detections_topic(opened: log.Log, prefix: str) -> str:
    """The topic of detections made from pictures that were dropped since; "" if there is none."""
    channel, provenance = opened.channels.get(f"{prefix}/detections"), provenance_of(opened, f"{prefix}/detections")
    stage = STAGES.get(provenance.transform) if provenance else None
    is_of_pictures = stage is not None and stage.reads is VIDEO
    return channel.topic if channel and channel.messages and is_of_pictures else ""


def _may_be_video(opened: log.Log, topic: str) -> bool:
    """Whether the first picture of a channel is video, or can't be read."""
    if not foreign.is_compressed(opened.channel(topic).schema_name):
        return False
    decode = foreign.picture_decoder(message_type_of(opened, topic))
    try:
        return any(is_video_codec(decode(message.payload).format) for message in islice(opened.messages(topic), 1))
    except McaptrackError:
        return True


class ExistingLabels(NamedTuple):
    """Labels in a log: their sorted times, the number of frames, the frame rate if it is known, and whether their file
    counts them from 0 although its format may count from 1.
    """

    t_ns: NDArray[np.int64]
    frames: int
    fps: Fraction | None
    counts_from_0: bool


def labels_of(opened: log.Log, prefix: str) -> dict[str, ExistingLabels]:
    """The ingested labels of a camera in a log, by topic."""
    out = {}
    for role in get_args(Role):
        channel, provenance = opened.channels.get(f"{prefix}/{role}"), provenance_of(opened, f"{prefix}/{role}")
        if channel and channel.messages and provenance and provenance.transform == "ingest":
            t_ns = opened.times(channel.topic)
            value = provenance.parameters.get("fps")
            fps = parse_fps(value) if isinstance(value, str) else None
            frames = 1 + max(message.sequence for message in opened.messages(channel.topic, int(t_ns[-1])))
            out[channel.topic] = ExistingLabels(t_ns, frames, fps, provenance.parameters.get("first_frame") == 0)
    return out


def boxes_extent(opened: log.Log, topic: str) -> tuple[int, int]:
    """Width and height, at least 1, of pictures that contain all boxes of a channel; (0, 0) if it has no detections."""
    channel = opened.channels.get(topic)
    if channel is None or not channel.messages or channel.schema_name != DETECTIONS.name:
        return 0, 0
    corner = np.ones(2)
    for _, _, part in joined_parts(DETECTIONS, opened.frame_columns(topic, DETECTIONS)):
        boxes = columns_to_boxes(part.rows)
        corner = np.maximum(corner, (boxes[:, :2] + boxes[:, 2:]).max(axis=0, initial=1.0))
    right, bottom = np.ceil(corner).tolist()
    return int(right), int(bottom)


def picture_size(opened: log.Log, topic: str) -> tuple[int, int]:
    """Width and height of the pictures of a channel. Raises McaptrackError if none of them can be decoded."""
    size = size_of_pictures(opened, topic)
    if size is None:
        raise McaptrackError(f"{opened.path}: {topic} has no picture that can be decoded")
    return size
