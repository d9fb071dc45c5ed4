"""A video of the pictures of a log with the drawings of its views, for people without a viewer.

The annotation messages themselves are drawn, so that colours, ids, trails and forecasts are the same as in viewers.

Letters: P points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack import log, notices
from mcaptrack.errors import McaptrackError
from mcaptrack.foxglove.views.ground import lifetime_ns
from mcaptrack.geometry.arrays import Floats, Image, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.pipeline import RobotPath
from mcaptrack.sources.foreign.flatten import message_decoder
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import write_clip
from mcaptrack.viewing import from_above
from mcaptrack.viewing.blur.people import HiddenPeople, hide
from mcaptrack.viewing.from_above import Sight
from mcaptrack.viewing.legend import with_legend
from mcaptrack.viewing.painting import draw

_GIF_FPS: Final = 10.0
#: Seen from above: the width of a video in pixels and its height as a share of it, the width in metres around a robot,
#: the least one around places, and the margin around these as a factor.
ABOVE_PX: Final = 960
_HEIGHT: Final = 0.75
_AROUND_M: Final = 80.0
_LEAST_M: Final = 10.0
_MARGIN: Final = 1.2


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """Options of a video: the width in pixels (None: that of the pictures), the highest frame rate, and the period.

    Seconds count from the first picture.
    """

    width_px: int | None = None
    max_fps: float | None = None
    start_s: float = 0.0
    end_s: float | None = None


def render(
    opened: log.Log,
    picture_topic: str,
    view_topics: Sequence[str],
    output: Path,
    options: RenderOptions,
    progress: Callable[[str, int, int], None] = lambda *_: None,
    hidden: HiddenPeople | None = None,
) -> int:
    """Draw views on the pictures of a channel and write a video, .mp4 or .gif by the suffix of ``output``.

    Parameters
    ----------
    opened : Log
    picture_topic : str
    view_topics : sequence of str
        Channels of ImageAnnotations, drawn in this order.
    output : Path
    options : RenderOptions
    progress : callable
        Called with "render", the number of finished pictures and their total.
    hidden : HiddenPeople, optional
        The people of these pictures, to hide.

    Returns
    -------
    int
        The number of pictures in the video.

    Raises
    ------
    McaptrackError
        If there are no pictures in the period, or if they can't be decoded.
    """
    pictures, numbers = pictures_of_video(opened, picture_topic, output, options)
    chosen = pictures.t_ns[numbers]

    def drawn() -> Iterator[tuple[int, Image]]:
        span = int(chosen[0]), int(chosen[-1]) + 1
        views, done = views_at(opened, view_topics, span), 0
        for done, frame in enumerate(pictures.readable(numbers.tolist()), 1):
            whole = np.asarray(frame.rows, np.uint8)
            if hidden is not None:
                whole, _ = hide(whole, hidden.at(frame.index))
            image = scaled(whole, options.width_px)
            scale = image.shape[1] / frame.rows.shape[1]
            for view in views:
                if (annotations := view(frame.t_ns)) is not None:
                    image = draw(image, annotations, scale)
            yield frame.t_ns, with_legend(image, view_topics)
            progress("render", done, len(chosen))
        if not done:
            raise McaptrackError(f"{opened.path}: no picture of {picture_topic} in this time can be decoded")

    return write_clip(output, drawn(), rate_of(chosen))


def pictures_of_video(
    opened: log.Log, picture_topic: str, output: Path, options: RenderOptions
) -> tuple[Pictures, Ints]:
    """Return the pictures of a channel, and the numbers (N,) of those that become a video."""
    check_suffix(output)
    pictures = Pictures(opened, picture_topic)
    if not len(pictures.t_ns):
        raise McaptrackError(f"{opened.path}: {picture_topic} has no pictures")
    return pictures, chosen_pictures(opened, pictures.t_ns, "pictures", output, options)


def render_from_above(
    opened: log.Log,
    view_topics: Sequence[str],
    output: Path,
    options: RenderOptions,
    path_of_robot: Callable[[Ints], RobotPath | None] = lambda _: None,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> int:
    """Draw scenes, seen from above, and write a video, .mp4 or .gif by the suffix of ``output``.

    Parameters
    ----------
    opened : Log
    view_topics : sequence of str
        Channels of SceneUpdate, drawn in this order; the first one gives the times.
    output : Path
    options : RenderOptions
    path_of_robot : callable
        Where the robot is at times (M,) in ns; the view follows it. Without one, all places are in the view.
    progress : callable
        Called with "render", the number of finished pictures and their total.

    Returns
    -------
    int
        The number of pictures in the video.

    Raises
    ------
    McaptrackError
        If there is no scene in the period.
    """
    chosen = scene_times(opened, view_topics[0], output, options)
    span = int(chosen[0]), int(chosen[-1]) + 1
    path = path_of_robot(chosen)
    scenes = scenes_of(opened, view_topics[0], span)
    seen = sights(scenes, options.width_px or ABOVE_PX, path, len(chosen))

    def drawn() -> Iterator[tuple[int, Image]]:
        drawing = SceneDrawing(opened, view_topics, span)
        for done, (t_ns, sight) in enumerate(zip(chosen.tolist(), seen, strict=True), 1):
            image = drawing.drawn(empty_ground(sight, path, done - 1), t_ns, sight)
            yield t_ns, with_legend(image, view_topics)
            progress("render", done, len(chosen))

    return write_clip(output, drawn(), rate_of(chosen))


def scene_times(opened: log.Log, topic: str, output: Path, options: RenderOptions) -> Ints:
    """The times of the scenes of a channel that become a video. Raises McaptrackError if there is none."""
    check_suffix(output)
    times = opened.times(topic)
    if not len(times):
        raise McaptrackError(f"{opened.path}: {topic} has no scenes")
    return times[chosen_pictures(opened, times, "scenes", output, options)]


def empty_ground(sight: Sight, path: RobotPath | None = None, number: int = 0) -> Image:
    """The ground seen from above, with its grid, and with the robot at the time of a picture of its path."""
    image = draw(from_above.ground(sight), from_above.grid(sight))
    if path is None:
        return image
    return draw(image, from_above.robot(sight, path.at_m[number], float(path.heading_rad[number])))


def scenes_of(opened: log.Log, topic: str, span: tuple[int, int]) -> Iterator[Any]:
    """The scenes of a channel from a time to before another."""
    read = message_decoder(opened, topic)
    return (read(message.payload) for message in opened.messages(topic, *span))


class SceneDrawing:
    """Draws scenes of channels, seen from above, at rising times; their labels keep apart."""

    def __init__(self, opened: log.Log, topics: Sequence[str], span: tuple[int, int]) -> None:
        self._views = views_at(opened, topics, span, is_held=True)
        self._places = from_above.LabelPlaces()

    def drawn(self, image: Image, t_ns: int, sight: Sight) -> Image:
        """The picture with the scenes at a time."""
        self._places.next_picture()
        for view in self._views:
            if (scene := view(t_ns)) is not None:
                image = draw(image, self._places.spread(from_above.drawing(scene, sight)))
        return image


def sights(scenes: Iterable[Any], width_px: int, path: RobotPath | None, count: int) -> list[Sight]:
    """The part of the ground in each picture: the surroundings of the robot, or all boxes and people of the scenes."""
    if path is not None:
        placed = np.flatnonzero(np.isfinite(path.at_m).all(axis=1))
        if len(placed):
            nearest = placed[np.abs(placed[None] - np.arange(count)[:, None]).argmin(axis=1)]
            width, height = size_from_above(width_px)
            return [Sight(x, y, width / _AROUND_M, width, height) for x, y in path.at_m[nearest].tolist()]
    places = [
        (shape.pose.position.x, shape.pose.position.y)
        for scene in scenes
        for entity in scene.entities
        for shape in (*entity.cubes, *entity.cylinders)
    ]
    low, high = np.quantile(np.array(places), [0.01, 0.99], axis=0) if places else np.array([[-5.0, -5.0], [5.0, 5.0]])
    return [sight_of(low, high, np.maximum((high - low) * _MARGIN, _LEAST_M), width_px)] * count


def size_from_above(width_px: int) -> tuple[int, int]:
    """The size of a picture that is seen from above, even numbers."""
    return width_px // 2 * 2, max(2, round(width_px * _HEIGHT) // 2 * 2)


def sight_of(low: Floats, high: Floats, extent: Floats, width_px: int) -> Sight:
    """The part of the ground in a picture that has the middle of two corners (2,), and shows an extent (2,) in m."""
    width, height = size_from_above(width_px)
    x, y = ((low + high) / 2).tolist()
    return Sight(x, y, float(min(width / extent[0], height / extent[1])), width, height)


def check_suffix(output: Path) -> None:
    """Raise McaptrackError for a name that is not that of a video."""
    if output.suffix.lower() not in (".mp4", ".gif"):
        raise McaptrackError(f"{output}: a video is rendered to .mp4 or .gif, not to {output.suffix or 'no suffix'}")


def chosen_pictures(opened: log.Log, times: Ints, what: str, output: Path, options: RenderOptions) -> Ints:
    """The numbers of the pictures, or scenes, of a video. Raises McaptrackError if there is none in the period."""
    first = int(times[0]) + seconds_to_ns(options.start_s)
    last = int(times[-1]) if options.end_s is None else int(times[0]) + seconds_to_ns(options.end_s)
    numbers = np.flatnonzero((times >= first) & (times <= last))
    numbers = without_repeated(times, numbers, what)
    max_fps = options.max_fps or (_GIF_FPS if output.suffix.lower() == ".gif" else None)
    if max_fps is not None and len(numbers):
        ticks = np.floor((times[numbers] - times[numbers[0]]) / NS_PER_S * max_fps + 1e-6)
        numbers = numbers[np.flatnonzero(np.diff(ticks, prepend=-1))]
    if not len(numbers):
        end = "the end" if options.end_s is None else f"{options.end_s:g} s"
        period = f"the {what} are from 0 to {(int(times[-1]) - int(times[0])) / NS_PER_S:.3f} s"
        raise McaptrackError(f"{opened.path} has no {what[:-1]} between {options.start_s:g} s and {end}; {period}")
    return numbers


def without_repeated(times: Ints, numbers: Ints, what: str) -> Ints:
    """Leave out pictures, or scenes, that have the time of another, with a warning."""
    _, first_of = np.unique(times[numbers], return_index=True)
    if len(first_of) < len(numbers):
        notices.warn(f"{len(numbers) - len(first_of)} {what} have the time of another and are left out", "left-out")
    return np.asarray(numbers[first_of], np.int64)


def rate_of(t_ns: Ints) -> Fraction:
    """The frame rate of a video with pictures at these times."""
    rest = np.diff(t_ns)
    rest = rest[rest > 0]
    return Fraction(NS_PER_S, int(np.median(rest))).limit_denominator(1001) if len(rest) else Fraction(1)


def views_at(
    opened: log.Log, topics: Sequence[str], span: tuple[int, int], is_held: bool = False
) -> list[Callable[[int], Any]]:
    """For each topic, a function that returns the message at a time in a span, for rising times, or None.

    With ``is_held`` messages are shown until the next one is due, as viewers do with scenes.
    """
    return [
        message_at(
            ((message.t_ns, message.payload) for message in opened.messages(topic, *span)),
            message_decoder(opened, topic),
            lifetime_ns(opened.times(topic)) if is_held else 0,
        )
        for topic in topics
    ]


def message_at(
    coming: Iterator[tuple[int, bytes]], read: Callable[[bytes], Any], held_ns: int = 0
) -> Callable[[int], Any]:
    """A function that reads the message at a time, for rising times, or the last one that is at most so much older.

    None if there is none.
    """
    last: tuple[int, bytes] | None = None
    waiting = next(coming, None)

    def at(t_ns: int) -> Any:
        nonlocal last, waiting
        while waiting is not None and waiting[0] <= t_ns:
            last, waiting = waiting, next(coming, None)
        return read(last[1]) if last is not None and last[0] >= t_ns - held_ns else None

    return at


def scaled(image: Image, width_px: int | None) -> Image:
    """The picture in the given width, and of even size, as video needs it."""
    import cv2

    height, width = image.shape[:2]
    wide = width_px or width
    size = (max(2, wide // 2 * 2), max(2, round(height * wide / width) // 2 * 2))
    if size == (width, height):
        return image
    if width_px is None:
        return np.ascontiguousarray(image[: size[1], : size[0]])
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
