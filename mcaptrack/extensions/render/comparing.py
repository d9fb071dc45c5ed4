"""A video that compares tracks: the same pictures side by side, with SORT's tracks, re-tracked ones and ground truth.
Logs without pictures are compared from above.

Above each picture stands a counter: identity switches so far where the log has ground truth, otherwise tracks and
repairs. Below are the clock, what happened in the last seconds, and the re-tracked people on the ground.

Letters: R events.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.evaluation.event_text import describe
from mcaptrack.extensions.render.legend import INK
from mcaptrack.extensions.render.video import (
    RenderOptions,
    SceneDrawing,
    empty_ground,
    pictures_of_video,
    rate_of,
    scene_times,
    scenes_of,
    views_at,
)
from mcaptrack.foxglove import views
from mcaptrack.geometry.arrays import Image, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.notices import Progress
from mcaptrack.pipeline import RobotPath
from mcaptrack.schema import EVENTS, TRACKS, EventKind
from mcaptrack.schema.framing import frame_times, joined_parts
from mcaptrack.schema.resampling import interval_ns
from mcaptrack.sources.cameras import provenance_of
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import write_clip
from mcaptrack.transforms import FULL
from mcaptrack.viewing.formatting import tracker_name
from mcaptrack.viewing.from_above import sights
from mcaptrack.viewing.painting import BACKGROUND, draw, put_text, scaled, text_size

#: The largest width of a comparison in pixels, unless one is given.
_WIDTH_PX: Final = 1920
_FAINT: Final = (150, 145, 140)
#: Events stand below the pictures for this time, the newest ones of all panels.
_SHOWN_S: Final = 4.0
_REPAIRS: Final = (EventKind.JOINED, EventKind.PARTED)
#: The share of the width that the ground takes, and the height of a line in shares of a panel's width, and of its text.
_GROUND: Final = 0.25
_LINE, _TEXT = 0.055, 0.7


class Panel(NamedTuple):
    """A channel of tracks in a comparison: its title, its topic, its view, and that of its events, "" for none."""

    title: str
    topic: str
    view: str
    events: str


class _Happened(NamedTuple):
    """Events (R,) that a panel counts and tells, by rising times; the births of its tracks; whether it has switches."""

    t_ns: Ints
    words: list[str]
    is_switch: list[bool]
    born_ns: Ints
    is_compared: bool


def find_panels(opened: log.Log, prefix: str, pictures: str | None) -> list[Panel]:
    """Return what can be compared: SORT's tracks, re-tracked ones, and ground truth if there is any.

    Without ``pictures`` they are scenes. Raises McaptrackError if the log lacks the views of one of the first two.
    """
    suffix = views.SCENE_SUFFIX if pictures is None else views.SUFFIX
    names = (("", "tracks", ""), ("re-tracked", "retracks", FULL), ("ground truth", "truth", ""))
    out = []
    for title, name, rest in names:
        topic = f"{prefix}/{name}"
        candidates = (topic + rest, topic)
        view = next((candidate + suffix for candidate in candidates if candidate + suffix in opened.channels), "")
        if view:
            shown = view.removesuffix(suffix)
            events = topic + "/events" if topic + "/events" in opened.channels else ""
            own = tracker_name(provenance_of(opened, topic)) if name == "tracks" else title
            out.append(Panel(own, shown, view, events))
        elif name != "truth":
            raise McaptrackError(
                f"{opened.path} has no view {topic}{suffix} to compare; {call('run', opened.path)} makes it"
            )
    return out


def compare(
    opened: log.Log,
    picture_topic: str | None,
    panels: Sequence[Panel],
    output: Path,
    options: RenderOptions,
    path_of_robot: Callable[[Ints], RobotPath | None] = lambda _: None,
    progress: Progress = lambda *_: None,
) -> int:
    """Draw panels side by side on the pictures of a channel, or from above, and write a video, .mp4 or .gif.

    Parameters
    ----------
    opened : Log
    picture_topic : str or None
        None: the views of the panels are scenes, and they are seen from above.
    panels : sequence of Panel
    output : Path
    options : RenderOptions
        The width is that of all panels together.
    path_of_robot : callable
        Where the robot is at times (M,) in ns; what is seen from above follows it.
    progress : callable
        Called with "render", the number of finished pictures and their total.

    Returns
    -------
    int
        The number of pictures in the video.

    Raises
    ------
    McaptrackError
        If there are no pictures, or scenes, in the period, or if pictures can't be decoded.
    """
    if picture_topic is None:
        times = scene_times(opened, panels[1].view, output, options)
        shown = _from_above(opened, panels, times, options, path_of_robot(times))
        scene, first = "", opened.times(panels[1].view)
    else:
        pictures, numbers = pictures_of_video(opened, picture_topic, output, options)
        times, first = pictures.t_ns[numbers], pictures.t_ns
        shown = _on_pictures(opened, panels, pictures, numbers, options)
        scene = panels[1].topic + views.SCENE_SUFFIX
    span = int(times[0]), int(times[-1]) + 1
    start_ns = int(first[0])
    happened = [_happened(opened, panel, start_ns) for panel in panels]

    def composed() -> Iterator[tuple[int, Image]]:
        ground: SceneDrawing | None = None
        for done, (t_ns, parts) in enumerate(shown, 1):
            if ground is None and scene in opened.channels:
                ground = SceneDrawing(opened, [scene], span)
                width = max(16, round(parts[0].shape[1] * len(parts) * _GROUND))
                sight = sights(scenes_of(opened, scene, span), width, None, 1)[0]
            counters = [_counter(panel, events, t_ns) for panel, events in zip(panels, happened, strict=True)]
            inset = ground.drawn(empty_ground(sight), t_ns, sight) if ground is not None else None
            clock, captions = _clock((t_ns - start_ns) / NS_PER_S), _captions(panels, happened, t_ns)
            yield t_ns, _composed(parts, panels, counters, clock, captions, inset)
            progress("render", done, len(times))

    return write_clip(output, composed(), rate_of(times))


def _on_pictures(
    opened: log.Log, panels: Sequence[Panel], pictures: Pictures, numbers: Ints, options: RenderOptions
) -> Iterator[tuple[int, list[Image]]]:
    """The time of each picture, and the panels drawn on it."""
    span = int(pictures.t_ns[numbers[0]]), int(pictures.t_ns[numbers[-1]]) + 1
    drawn = views_at(opened, [panel.view for panel in panels], span)
    width = 0
    for frame in pictures.readable(numbers.tolist()):
        whole = np.asarray(frame.rows, np.uint8)
        width = width or _panel_width(options, whole.shape[1], len(panels))
        plain, scale = scaled(whole, width), width / whole.shape[1]
        messages = [view(frame.t_ns) for view in drawn]
        yield frame.t_ns, [plain.copy() if one is None else draw(plain.copy(), one, scale) for one in messages]


def _from_above(
    opened: log.Log, panels: Sequence[Panel], times: Ints, options: RenderOptions, path: RobotPath | None
) -> Iterator[tuple[int, list[Image]]]:
    """The time of each scene, and the panels seen from above."""
    span = int(times[0]), int(times[-1]) + 1
    drawn = [SceneDrawing(opened, [panel.view], span) for panel in panels]
    width = _panel_width(options, _WIDTH_PX // 2, len(panels))
    seen = sights(scenes_of(opened, panels[1].view, span), width, path, len(times))
    for number, (t_ns, sight) in enumerate(zip(times.tolist(), seen, strict=True)):
        plain = empty_ground(sight, path, number)
        yield t_ns, [drawing.drawn(plain.copy(), t_ns, sight) for drawing in drawn]


def _panel_width(options: RenderOptions, usual_px: int, count: int) -> int:
    total = options.width_px or min(_WIDTH_PX, usual_px * count)
    return max(2, total // count // 2 * 2)


def _happened(opened: log.Log, panel: Panel, start_ns: int) -> _Happened:
    """The switches of a panel, or its repairs if it was not compared with ground truth."""
    frames = opened.frame_columns(panel.topic, TRACKS)
    interval_s = interval_ns(frame_times(frames)) / NS_PER_S
    first: dict[int, int] = {}
    for _, _, joined in joined_parts(TRACKS, frames):
        ids, where = np.unique(joined.rows["track_id"], return_index=True)
        for track_id, at in zip(ids.tolist(), joined.row_ns[where].tolist(), strict=True):
            first.setdefault(track_id, at)
    born_ns = np.sort(np.fromiter(first.values(), np.int64, len(first)))
    rows = []
    if panel.events:
        for frame in opened.frame_columns(panel.events, EVENTS):
            rows += [(frame.t_ns, row, EventKind(int(row["kind"]))) for row in frame.rows]
    is_compared = any(kind in (EventKind.MISS, EventKind.FALSE_TRACK, EventKind.SWITCH) for _, _, kind in rows)
    wanted = [item for item in rows if item[2] is EventKind.SWITCH or item[2] in _REPAIRS]
    texts = [describe(row, f"at {(at - start_ns) / NS_PER_S:.1f} s", interval_s) for at, row, _ in wanted]
    t_ns = np.array([at for at, _, _ in wanted], np.int64)
    return _Happened(t_ns, texts, [kind is EventKind.SWITCH for _, _, kind in wanted], born_ns, is_compared)


def _counter(panel: Panel, happened: _Happened, now_ns: int) -> str:
    """The text of a counter at a time."""
    until = int(np.searchsorted(happened.t_ns, now_ns, "right"))
    tracks = int(np.searchsorted(happened.born_ns, now_ns, "right"))
    if not panel.events:
        return f"{tracks} {'person' if tracks == 1 else 'people'} so far"
    switches = sum(happened.is_switch[:until])
    repairs = until - switches
    parts = [f"{switches} identity switch{'' if switches == 1 else 'es'}"] if happened.is_compared else []
    parts += [f"{tracks} track{'' if tracks == 1 else 's'}"]
    parts += [f"{repairs} repair{'' if repairs == 1 else 's'}"] if repairs else []
    return ", ".join(parts)


def _captions(panels: Sequence[Panel], happened: Sequence[_Happened], now_ns: int) -> list[str]:
    """The events of the last seconds as texts, the newest first."""
    captions = []
    for panel, events in zip(panels, happened, strict=True):
        low = int(np.searchsorted(events.t_ns, now_ns - seconds_to_ns(_SHOWN_S), "right"))
        high = int(np.searchsorted(events.t_ns, now_ns, "right"))
        captions += [(int(events.t_ns[n]), f"{panel.title}: {events.words[n]}") for n in range(low, high)]
    return [caption for _, caption in sorted(captions, key=lambda pair: -pair[0])]


def _clock(seconds: float) -> str:
    minutes, rest = divmod(seconds + 0.05, 60)
    return f"{int(minutes)}:{int(rest):02d}.{int(rest % 1 * 10)}"


def _composed(
    parts: Sequence[Image],
    panels: Sequence[Panel],
    counters: Sequence[str],
    clock: str,
    captions: Sequence[str],
    inset: Image | None,
) -> Image:
    """The whole picture: panels below their titles, and a strip with the clock, captions and the ground."""
    height, width = parts[0].shape[:2]
    line = max(8, round(width * _LINE))
    header = round(line * 1.5)
    below = max(line * 4, 0 if inset is None else inset.shape[0])
    total = (header + height + below + 1) // 2 * 2
    out = np.full((total, width * len(parts), 3), BACKGROUND, np.uint8)
    for number, part in enumerate(parts):
        left = number * width
        out[header : header + height, left : left + width] = part
        end = _write(out, panels[number].title, (left + line // 3, line), line, INK, width - line)
        _write(out, counters[number], (end + line // 2, line), line, _FAINT, left + width - end - line)
        if number:
            out[: header + height, left - 1 : left + 1] = 0
    space = out.shape[1] - line
    if inset is not None:
        left = out.shape[1] - inset.shape[1]
        out[header + height : header + height + inset.shape[0], left:] = inset
        space = left - line
    top = header + height
    _write(out, clock, (line // 3, top + round(line * 1.6)), round(line * 1.7), INK, space)
    lines = int((total - top - line * 2.2) // (line * 1.25))
    for number, caption in enumerate(captions[: max(lines, 0)]):
        at = (line // 3, top + round(line * (3.2 + 1.25 * number)))
        _write(out, caption, at, line, INK if number == 0 else _FAINT, space)
    return out


def _write(image: Image, text: str, at: tuple[int, int], line_px: int, bgr: Any, most_px: int) -> int:
    """Write a line of text from its lower left corner on, smaller if it is too long; returns where it ends."""
    size_px = line_px * _TEXT
    size_px *= min(1.0, max(most_px, 1) / max(text_size(text, size_px)[0], 1))
    put_text(image, text, at, size_px, bgr)
    return at[0] + text_size(text, size_px)[0]
