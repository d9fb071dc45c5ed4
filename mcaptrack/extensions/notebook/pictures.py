"""The pictures of a log and what is drawn on them, made small enough for a notebook.

Without pictures it is the ground, seen from above. Times are seconds since the start of the log, as in reports and
events.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from math import ceil, isfinite
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import log, pipeline
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.foxglove import ANNOTATIONS, SCENE, views
from mcaptrack.foxglove.messages import message_class
from mcaptrack.foxglove.views import SCENE_SUFFIX
from mcaptrack.geometry.arrays import Image, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.notices import Progress, warn
from mcaptrack.schema import PREDICTIONS, Schema
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.framing import has_any
from mcaptrack.sources.camera_motion import path_of, tracks_topic
from mcaptrack.sources.cameras import cameras
from mcaptrack.sources.foreign import holds_pictures
from mcaptrack.sources.foreign.flatten import message_decoder
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import encode_image
from mcaptrack.transforms import FULL
from mcaptrack.viewing import from_above
from mcaptrack.viewing.from_above import Sight, sights
from mcaptrack.viewing.painting import CLOSED, draw, message_at, scaled, strokes, without_repeated

#: The largest width of a player and of a still in pixels, unless it is given.
PLAYER_PX: Final = 640
_STILL_PX: Final = 960
_QUALITY: Final = 65
_STILL_QUALITY: Final = 88
#: The largest number of pictures of a player, unless it is given which.
_MOST: Final = 1500
#: The number of pictures that are encoded to estimate the size of all, and the size in bytes of what a view draws.
_TRIED: Final = 5
_DRAWN_BYTES: Final = 500
#: The growth of bytes that are written as text (base64).
_AS_TEXT: Final = 4 / 3


# Annotation messages as lines and texts in JSON, for a page that draws them over pictures.
#
# A line is [kind, thickness, colour, fill, [x, y, x, y, ...]]. Its kind is closed, open or pairs of points; colour
# and fill are numbers in the list of colours, the fill of a line that has none is -1. A text is [x, y, size,
# colour, background, text], at its lower left corner. All is in pixels of the picture.


#: The decimal places of coordinates.
_DIGITS: Final = 2

Line = list[Any]
Text = list[Any]


class Strokes:
    """Converts annotations to lines and texts; ``colours`` are those that occurred so far, as CSS writes them."""

    def __init__(self) -> None:
        self._number: dict[str, int] = {}

    @property
    def colours(self) -> list[str]:
        """The colours, by number."""
        return list(self._number)

    def of(self, annotations: Any) -> list[list[Any]]:
        """Return the lines and the texts of an ImageAnnotations message; what can't be seen is left out."""
        lines: list[Line] = []
        for line in strokes(annotations):
            colour = self._colour(line.colour)
            fill = self._colour(line.fill) if line.kind == CLOSED else -1
            if max(colour, fill) >= 0:
                points = [round(value, _DIGITS) for value in line.points.ravel().tolist()]
                lines.append([line.kind, round(line.thickness, 2), colour, fill, points])
        texts: list[Text] = [
            [
                round(text.position.x, _DIGITS),
                round(text.position.y, _DIGITS),
                round(text.font_size, _DIGITS),
                self._colour(text.text_color),
                self._colour(text.background_color),
                text.text,
            ]
            for text in annotations.texts
            if isfinite(text.position.x) and isfinite(text.position.y)
        ]
        return [lines, texts]

    def _colour(self, rgba: Any) -> int:
        """Return the number of a colour; -1 if it can't be seen."""
        parts = [round(255 * min(1.0, max(0.0, part))) for part in (rgba.r, rgba.g, rgba.b, rgba.a)]
        if not parts[3]:
            return -1
        return self._number.setdefault("#" + bytes(parts).hex(), len(self._number))


@dataclass
class Clip:
    """N pictures: their times, numbers in the channel, sizes in pixels (width, height) and, unless they are seen from
    above, JPEG files, which may be smaller.

    ``drawn`` has for each picture the lines and texts of each of ``layers``, in pixels of that size. Layers are topics
    of views; the ground that is seen from above is "". ``hidden`` are those that a player shows only if it is asked to.
    """

    layers: tuple[str, ...]
    hidden: tuple[str, ...] = ()
    t_ns: list[int] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    sizes: list[tuple[int, int]] = field(default_factory=list)
    jpegs: list[bytes] = field(default_factory=list)
    drawn: list[list[list[Any]]] = field(default_factory=list)
    strokes: Strokes = field(default_factory=Strokes)

    def half(self) -> Clip:
        """Every second picture."""
        parts = self.t_ns[::2], self.numbers[::2], self.sizes[::2], self.jpegs[::2], self.drawn[::2]
        return Clip(self.layers, self.hidden, *parts, self.strokes)


# The views that a notebook shows: those in the log, or else drawings of rows that have no view yet.
#
# Only runs write views. A channel that was only ingested, such as a ground truth, is drawn while it is shown.


#: The channels that are drawn if there are no views, below the name of a camera: the first that there is.
_BEST: Final = (f"retracks{FULL}", "retracks", "tracks", "detections", "truth")
#: The time before the first picture from which pictures are drawn, for trails.
_TRAIL_NS: Final = 3 * NS_PER_S


class ShownView(NamedTuple):
    """A view: its topic, or that of the rows which are drawn; and how its messages are read.

    ``messages`` gives time in ns and payload of each message in a span of times, for rising times of pictures.
    """

    topic: str
    messages: Callable[[Ints, tuple[int, int]], Iterator[tuple[int, bytes]]]
    read: Callable[[bytes], Any]


class ToShow(NamedTuple):
    """The views that are shown, and the topic of the pictures that they are on; "" for the ground, from above.

    ``t_ns`` are the times of the pictures or scenes.
    """

    views: list[ShownView]
    pictures: str
    t_ns: Ints


def find_drawings(opened: log.Log, prefix: str, topics: Sequence[str]) -> ToShow:
    """Return what is shown of a camera: given channels, or those that layouts show by default.

    A given channel of pictures is shown with nothing on it. Pictures without anything to draw on them are shown, too,
    with a warning. Raises McaptrackError if there is nothing to see, if a given channel can't be drawn, or if the views
    of given ones don't fit together.
    """
    full_topics = [opened.find(topic, prefix) for topic in topics]
    if len(full_topics) == 1 and full_topics[0] in opened.channels and holds_pictures(opened.channels[full_topics[0]]):
        return ToShow([], full_topics[0], opened.times(full_topics[0]))
    without = [topic for topic in full_topics if not _has_view(opened, topic)]
    for topic in full_topics:
        if without or (topic in opened.channels and "/view/" not in topic):
            _schema_of(opened, topic)
    if without:
        return _drawn_now(opened, prefix, full_topics)
    try:
        shown = pipeline.find_views(opened, prefix, full_topics)
    except McaptrackError as error:
        usable = [topic for topic in _candidates(opened, prefix) if not full_topics][:1]
        if not usable and (full_topics or pipeline.camera_at(opened, prefix).pictures is None):
            raise
        if not usable:
            warn(f"nothing is drawn on the pictures: {error}", "nothing-found")
        return _drawn_now(opened, prefix, usable)
    t_ns = opened.times(shown.pictures or shown.views[0])
    return ToShow([_recorded(opened, topic) for topic in shown.views], shown.pictures, t_ns)


def _other_tracks(opened: log.Log, view: str) -> list[ShownView]:
    """Return the views of the tracker's tracks and of the ground truth in the same place as a view."""
    suffix = next((name for name in views.SUFFIXES if name in view), "")
    camera = next((each for each in cameras(opened) if view in each.topics), None)
    if not suffix or camera is None:
        return []
    place = view.partition(suffix)[2]
    topics = (f"{tracks}{suffix}{place}" for tracks in (f"{camera.prefix}/tracks", camera.truth))
    return [_recorded(opened, topic) for topic in topics if topic in opened.channels and topic != view]


def _has_view(opened: log.Log, topic: str) -> bool:
    begin = tuple(name + suffix for name in (topic, topic + FULL) for suffix in views.SUFFIXES)
    is_view = any(suffix in topic for suffix in views.SUFFIXES)
    return is_view or any(channel.startswith(begin) for channel in opened.channels)


def _candidates(opened: log.Log, prefix: str) -> list[str]:
    """Return the channels of a camera that can be drawn, the best ones first."""
    best = [f"{prefix}/{name}" for name in _BEST]
    names = [*best, *sorted(pipeline.camera_at(opened, prefix).topics)]
    return [topic for topic in dict.fromkeys(names) if topic in opened.channels and _kind(opened.channels[topic])]


def _kind(channel: log.Channel) -> Schema | None:
    return next((schema for schema in views.DRAWN if channel.holds(schema)), None)


def _schema_of(opened: log.Log, topic: str) -> Schema:
    """Return the schema of a channel to draw. Raises McaptrackError if it can't be drawn."""
    schema = _kind(opened.channel(topic))
    if schema is None:
        names = list_names(sorted(channel.topic for channel in opened.channels.values() if _kind(channel)))
        raise McaptrackError(f"{opened.path}: {topic} has no boxes, tracks or predictions to draw; there are {names}")
    return schema


def _recorded(opened: log.Log, topic: str) -> ShownView:
    def messages(_: Ints, span: tuple[int, int]) -> Iterator[tuple[int, bytes]]:
        return ((message.t_ns, message.payload) for message in opened.messages(topic, *span))

    return ShownView(topic, messages, message_decoder(opened, topic))


def _drawn_now(opened: log.Log, prefix: str, topics: Sequence[str]) -> ToShow:
    """Return drawings of channels: on the pictures of the camera, or on the ground."""
    pictures = pipeline.camera_at(opened, prefix).pictures
    t_ns = opened.times(pictures or topics[0])
    return ToShow([_drawing(opened, prefix, topic, pictures is None) for topic in topics], pictures or "", t_ns)


def _drawing(opened: log.Log, prefix: str, topic: str, is_above: bool) -> ShownView:
    schema = _schema_of(opened, topic)
    frames = opened.frame_columns(topic, schema)
    if is_above and schema is not PREDICTIONS and not has_any(schema, frames, lambda rows: np.isfinite(rows["x_m"])):
        raise McaptrackError(
            f"{opened.path} has no pictures of {prefix}, and {topic} no positions in metres to show from above; "
            "with a ground plane, it has"
        )
    names = class_names(opened.channel(topic).metadata)
    path, _ = path_of(opened, prefix, tracks_topic(prefix))
    drawing = views.Drawing(topic, schema, frames, pipeline.read_planes(opened, prefix) or (), classes=names, path=path)

    def messages(t_ns: Ints, span: tuple[int, int]) -> Iterator[tuple[int, bytes]]:
        times = np.unique(t_ns[(t_ns >= span[0] - _TRAIL_NS) & (t_ns < span[1])])
        drawn = drawing.on_ground(times, "") if is_above else drawing.on_pictures(times, times)
        return ((at_ns, payload) for at_ns, _, payload in drawn if span[0] <= at_ns < span[1])

    return ShownView(topic, messages, message_class(SCENE if is_above else ANNOTATIONS).FromString)


class PictureSource:
    """The pictures of a log, or its scenes seen from above, with the views that are drawn on them.

    ``t_ns`` are their rising times (N,); ``noun`` is "pictures" or "scenes". With ``all_tracks`` those that aren't
    shown at first are drawn, too; ``hidden`` are their views. Raises McaptrackError if there are none.
    """

    def __init__(self, opened: log.Log, prefix: str, topics: Sequence[str], all_tracks: bool = False) -> None:
        shown = find_drawings(opened, prefix, topics)
        others = _other_tracks(opened, shown.views[0].topic) if all_tracks and shown.views else []
        self._opened, self._prefix, self._views = opened, prefix, [*shown.views, *others]
        self.views = tuple(view.topic for view in self._views)
        self.hidden = tuple(view.topic for view in others)
        self._pictures = Pictures(opened, shown.pictures) if shown.pictures else None
        self.topic = shown.pictures or self.views[0]
        self.is_above = not shown.pictures
        self.noun = "scenes" if self.is_above else "pictures"
        self.t_ns: Ints = shown.t_ns
        if not len(self.t_ns):
            raise McaptrackError(f"{opened.path}: {self.topic} has no {self.noun}")

    def seconds(self, t_ns: int) -> float:
        """Return a log time as seconds since the start of the log."""
        return (t_ns - self._opened.start_ns) / NS_PER_S

    def number_at(self, at_s: float) -> int:
        """Return the number of the picture that is shown at a time: the last one that is not later.

        Raises McaptrackError for a time before the first picture, or after the last one.
        """
        at_ns = self._opened.start_ns + seconds_to_ns(at_s)
        rest = np.diff(self.t_ns)
        usual = int(np.median(rest)) if len(rest) else NS_PER_S
        # Times are written with three decimals, so that the first picture is that of its time as it is printed.
        number = int(np.searchsorted(self.t_ns, at_ns + NS_PER_S // 1000, "right")) - 1
        if number < 0 or at_ns > int(self.t_ns[-1]) + usual:
            raise McaptrackError(f"{self._opened.path} has no {self.noun[:-1]} at {at_s:g} s; {self._there()}")
        return number

    def numbers(self, start_s: float, end_s: float | None) -> Ints:
        """Return the numbers of the pictures of a period (M,). Raises McaptrackError if there are none."""
        first = self._opened.start_ns + seconds_to_ns(start_s)
        last = int(self.t_ns[-1]) if end_s is None else self._opened.start_ns + seconds_to_ns(end_s)
        numbers = np.flatnonzero((self.t_ns >= first) & (self.t_ns <= last))
        if not len(numbers):
            end = "the end" if end_s is None else f"{end_s:g} s"
            raise McaptrackError(
                f"{self._opened.path} has no {self.noun} between {start_s:g} s and {end}; {self._there()}"
            )
        return without_repeated(self.t_ns, numbers, self.noun)

    def step(self, numbers: Ints, most_bytes: float, width_px: int | None) -> int:
        """Return the step between pictures with which about as many as fit into ``most_bytes`` are taken."""
        each = float(_DRAWN_BYTES * (1 + len(self.views)))
        if self._pictures is not None:
            tried = numbers[np.unique(np.linspace(0, len(numbers) - 1, _TRIED).astype(int))]
            small = (self._small(frame.rows, width_px) for frame in self._pictures.frames(tried.tolist()))
            sizes = [len(encode_image(picture, "jpeg", _QUALITY)) for picture in small]
            each += _AS_TEXT * float(np.mean(sizes)) if sizes else 0.0
        return max(1, ceil(len(numbers) / max(1.0, min(_MOST, most_bytes / each))))

    def take(self, numbers: Ints, width_px: int | None, progress: Progress) -> Clip:
        """Return pictures with these rising numbers (M,). A video's pictures before the first key picture are missing.

        Raises McaptrackError for pictures and views that are damaged.
        """
        out = Clip(self.views if self._pictures is not None else ("", *self.views), self.hidden)
        for done, (number, size, image, drawings) in enumerate(self._drawn_on(numbers, width_px or PLAYER_PX), 1):
            out.t_ns.append(int(self.t_ns[number]))
            out.numbers.append(number)
            out.sizes.append(size)
            if self._pictures is not None:
                out.jpegs.append(encode_image(self._small(image, width_px), "jpeg", _QUALITY))
            out.drawn.append([out.strokes.of(drawing) if drawing is not None else [[], []] for drawing in drawings])
            progress("show", done, len(numbers))
        if not out.t_ns:
            raise McaptrackError(f"{self._opened.path}: no picture of {self.topic} in this period can be decoded")
        return out

    def still(self, number: int, width_px: int | None) -> Image:
        """Return a picture with its drawings, BGR (height, width, 3)."""
        for _, size, image, drawings in self._drawn_on(np.array([number]), width_px or _STILL_PX):
            width = width_px or min(_STILL_PX, size[0])
            out = scaled(image, width) if self._pictures is not None else image
            for drawing in drawings:
                out = draw(out, drawing, out.shape[1] / size[0]) if drawing is not None else out
            return out
        where = f"{self._opened.path}: {self.topic} at {self.seconds(int(self.t_ns[number])):.3f} s"
        raise McaptrackError(f"{where} can't be decoded: the video has no key picture before it")

    def _drawn_on(self, numbers: Ints, above_px: int) -> Iterator[tuple[int, tuple[int, int], Image, list[Any]]]:
        """Yield number, size, picture, and the annotations of each layer, None where a view has none."""
        chosen = self.t_ns[numbers]
        span = int(chosen[0]), int(chosen[-1]) + 1
        views = [message_at(view.messages(self.t_ns, span), view.read) for view in self._views]
        if self._pictures is not None:
            for frame in self._pictures.readable(numbers.tolist()):
                image = np.asarray(frame.rows, np.uint8)
                yield frame.index, (image.shape[1], image.shape[0]), image, [view(frame.t_ns) for view in views]
            return
        for number, sight, ground in self._ground(numbers, span, above_px):
            scenes = [view(int(self.t_ns[number])) for view in views]
            drawings = [None if scene is None else from_above.drawing(scene, sight) for scene in scenes]
            yield number, (sight.width_px, sight.height_px), from_above.ground(sight), [ground, *drawings]

    def _ground(self, numbers: Ints, span: tuple[int, int], width_px: int) -> Iterator[tuple[int, Sight, Any]]:
        """Yield number, the part of the ground that is in view, and annotations of its grid and of the robot."""
        first = self.views[0]
        is_view = first.endswith(SCENE_SUFFIX)  # rows that are drawn now are seen without the robot
        path = pipeline.robot_path(self._opened, self._prefix, first, self.t_ns[numbers]) if is_view else None
        scenes = (self._views[0].read(payload) for _, payload in self._views[0].messages(self.t_ns, span))
        seen = sights(scenes, width_px, path, len(numbers))
        for place, (number, sight) in enumerate(zip(numbers.tolist(), seen, strict=True)):
            ground = from_above.grid(sight)
            if path is not None:
                ground.MergeFrom(from_above.robot(sight, path.at_m[place], float(path.heading_rad[place])))
            yield number, sight, ground

    def _small(self, image: Any, width_px: int | None) -> Image:
        """A picture in the width of the player."""
        width = width_px or min(PLAYER_PX, image.shape[1])
        return scaled(np.asarray(image, np.uint8), width)

    def _there(self) -> str:
        first, last = self.seconds(int(self.t_ns[0])), self.seconds(int(self.t_ns[-1]))
        return f"its {self.noun} are from {first:.3f} to {last:.3f} s"


def still_jpeg(image: Image) -> bytes:
    """Return a still as a JPEG file."""
    return encode_image(image, "jpeg", _STILL_QUALITY)
