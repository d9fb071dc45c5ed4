"""A video of the pictures of a log with the drawings of its views, for people without a viewer.

The annotation messages themselves are drawn, so that colours, ids, trails and forecasts are the same as in viewers.

Letters: P points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.render.blur.people import HiddenPeople, hide
from mcaptrack.extensions.render.legend import LabelPlaces, with_legend
from mcaptrack.foxglove.views.ground import lifetime_ns
from mcaptrack.geometry.arrays import Image, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.notices import Progress
from mcaptrack.pipeline import RobotPath
from mcaptrack.sources.foreign.flatten import message_decoder
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import write_clip
from mcaptrack.viewing import from_above
from mcaptrack.viewing.from_above import ABOVE_PX, Sight, sights
from mcaptrack.viewing.painting import draw, message_at, scaled, without_repeated

_GIF_FPS: Final = 10.0


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
    progress: Progress = lambda *_: None,
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
    progress: Progress = lambda *_: None,
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
        self._places = LabelPlaces()

    def drawn(self, image: Image, t_ns: int, sight: Sight) -> Image:
        """The picture with the scenes at a time."""
        self._places.next_picture()
        for view in self._views:
            if (scene := view(t_ns)) is not None:
                image = draw(image, self._places.spread(from_above.drawing(scene, sight)))
        return image


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
