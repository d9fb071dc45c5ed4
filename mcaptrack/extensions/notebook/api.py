"""Logs in notebooks: players and stills that Jupyter and its relatives show, without widgets.

HTML with a script needs no package and no server, and stays in the notebook when it is converted or sent to someone; a
widget needs both, and is blank there. A player is a page of its own in a frame, so that its style and script and those
of the notebook don't meet. Below the frame lies a still with a caption: it is what remains where frames are taken out,
as in notebooks that are not trusted.
"""

from __future__ import annotations

import json
import zlib
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api.common import as_path, warn_unused, warnings_about
from mcaptrack.api.declared import checked
from mcaptrack.api.options import PathLike, Progress, no_progress
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.notebook.pictures import PLAYER_PX, Clip, PictureSource, still_jpeg
from mcaptrack.files import publish_bytes, refuse_overwrite
from mcaptrack.foxglove.views import SCENE_SUFFIX, SUFFIXES
from mcaptrack.location import Location
from mcaptrack.notices import Notice
from mcaptrack.transforms import FULL
from mcaptrack.viewing.formatting import policy, render
from mcaptrack.viewing.links import find_moments, opening_moment
from mcaptrack.viewing.painting import BACKGROUND
from mcaptrack.viewing.serving import AS_MANY_AS_FIT, Choice, LogPage

_MB: Final = 1e6
#: The largest size of a player of `mcaptrack view` in megabytes: it is opened from this machine.
_PAGE_MB: Final = 16.0
#: The part of the largest size that is planned for, because sizes are estimated.
_PLANNED: Final = 0.92


@dataclass(frozen=True)
class Player:
    """Pictures of a log with what was found in them, made by ``Recording.show``; notebooks show it.

    Attributes
    ----------
    log : pathlib.Path or str
        The log; the URL of one in a store.
    topic : str
        The channel of the pictures, or of the scenes.
    is_above : bool
        Whether scenes are shown, from above, instead of pictures.
    views : tuple of str
        Topics of the views that are drawn.
    pictures : int
        Number of pictures in the player; 1 for a still.
    of : int
        Number of pictures of the log in the period.
    every : int
        Every such picture of them is shown.
    first_s, last_s : float
        Times of the first and the last picture, in seconds since the start of the log.
    html : str
        What notebooks show. It opens no connection.
    page : str
        The player as a page of its own; "" for a still.
    still : bytes
        A JPEG file: the picture that the player opens with, for programs that show no HTML.
    warnings : tuple of mcaptrack.Notice
        What was left out or looks odd.

    """

    log: Location
    topic: str
    is_above: bool
    views: tuple[str, ...]
    pictures: int
    of: int
    every: int
    first_s: float
    last_s: float
    html: str = field(repr=False)
    still: bytes = field(repr=False)
    page: str = field(default="", repr=False)
    warnings: tuple[Notice, ...] = ()

    def __repr__(self) -> str:
        return f"Player({self.log.name}: {self.caption}; {len(self.html) / _MB:.1f} MB)"

    @property
    def caption(self) -> str:
        """The pictures and their number, in a line."""
        shown = f"{self.topic.removesuffix(SCENE_SUFFIX)} from above" if self.is_above else self.topic
        if self.pictures == self.of == 1:
            return f"{shown} at {self.first_s:.2f} s"
        step = "" if self.every == 1 else f" (every {_ordinal(self.every)})"
        count = f"all {self.of:,}" if self.pictures == self.of else f"{self.pictures:,} of {self.of:,}"
        what = "scenes" if self.is_above else "pictures"
        return f"{shown}, {self.first_s:.1f} to {self.last_s:.1f} s: {count} {what}{step}"

    @checked
    def save(self, path: PathLike, *, force: bool = False) -> Path:
        """Write it as a page that needs no other file.

        Parameters
        ----------
        path : path
            The HTML file.
        force : bool, default False
            Overwrite the file if it exists.

        Returns
        -------
        pathlib.Path
            The file.

        Raises
        ------
        McaptrackError
            If the file exists, or can't be written.

        Examples
        --------
        >>> import mcaptrack
        >>> with mcaptrack.open("log.mcap") as log:
        ...     log.show(end_s=1.0).save("walk.html").name
        'walk.html'

        """
        target = as_path(path)
        refuse_overwrite(target, force)
        head = '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>mcaptrack</title>\n'
        page = self.page or f"{head}{self.html}</html>\n"
        publish_bytes(target, page.encode("utf-8"))
        return target

    def _repr_mimebundle_(self, **_: Any) -> dict[str, Any]:
        """The forms that a notebook keeps: HTML, a picture for programs without it, and text."""
        return {"text/html": self.html, "image/jpeg": self.still, "text/plain": repr(self)}


class LogPlayer:
    """Makes players: for ``Recording.show``, and for `mcaptrack view`."""

    def show(
        self,
        opened: logs.Log,
        at_s: float | None = None,
        *,
        topics: Sequence[str] = (),
        camera: str | None = None,
        choice: Choice = AS_MANY_AS_FIT,
        max_mb: float,
        progress: Progress = no_progress,
        all_tracks: bool = False,
    ) -> Player:
        """Return a player, or a still of a time, of an open log. See ``Recording.show``.

        With ``all_tracks``, those that aren't shown at first are in the player, too.
        """
        with warnings_about(opened.path) as warnings, pipeline.with_views(opened) as (complete, _):
            source = PictureSource(complete, pipeline.find_camera(opened, camera), topics, all_tracks)
            if at_s is None:
                shown = _player(complete, source, choice, max_mb, progress)
            else:
                unused = {"start_s": choice.start_s > 0, "end_s": choice.end_s is not None, "every": bool(choice.every)}
                warn_unused("a still is one picture", **unused)
                shown = _still(complete, source, source.number_at(at_s), choice.width_px)
        return replace(shown, warnings=tuple(dict.fromkeys(warnings)))

    def page(self, camera: str, is_above: bool) -> LogPage:
        """Return the page of `mcaptrack view` with a player of a camera, or of its ground seen from above."""

        def make(opened: logs.Log) -> bytes:
            with pipeline.with_views(opened) as (complete, _):
                topics = pipeline.views_from_above(complete, camera) if is_above else ()
            return self.show(opened, topics=topics, camera=camera, max_mb=_PAGE_MB, all_tracks=True).page.encode()

        return LogPage(make, policy("player.js", package=__package__ or ""))


def _still(opened: logs.Log, source: PictureSource, number: int, width_px: int | None) -> Player:
    seconds = source.seconds(int(source.t_ns[number]))
    image = source.still(number, width_px)
    jpeg = still_jpeg(image)
    player = Player(
        opened.path, source.topic, source.is_above, source.views, 1, 1, 1, seconds, seconds, html="", still=jpeg
    )
    title = f"{opened.path.name}: {player.caption}"
    return replace(player, html=_in_notebook(jpeg, image.shape[1], title))


def _player(opened: logs.Log, source: PictureSource, choice: Choice, max_mb: float, progress: Progress) -> Player:
    numbers = source.numbers(choice.start_s, choice.end_s)
    moments = find_moments(opened)
    at_ns, _ = opening_moment(opened, moments)
    events = [(source.seconds(moment.t_ns), moment.text, moment.topic) for moment in moments]
    every = choice.every or source.step(numbers, _PLANNED * max_mb * _MB, choice.width_px)
    taken = source.take(numbers[::every], choice.width_px, progress)
    while True:
        seconds = [source.seconds(t_ns) for t_ns in taken.t_ns]
        opens_at = max(0, int(np.searchsorted(taken.t_ns, at_ns, "right")) - 1) if at_ns <= taken.t_ns[-1] else 0
        image = source.still(taken.numbers[opens_at], choice.width_px or min(PLAYER_PX, taken.sizes[0][0]))
        jpeg = still_jpeg(image)
        span = seconds[0], seconds[-1]
        player = Player(
            opened.path, source.topic, source.is_above, source.views,
            len(seconds), len(numbers), every, *span, html="", still=jpeg,
        )  # fmt: skip
        inside = [event for event in events if span[0] <= event[0] <= span[1]]
        caption = f"{opened.path.name}: {player.caption}"
        page = _player_page(taken, seconds, inside, opens_at, caption)
        html = _in_notebook(jpeg, max(image.shape[1], _LEAST_PX), caption, page)
        if len(html) <= max_mb * _MB or len(seconds) == 1:
            return replace(player, html=html, page=page)
        if choice.every is not None:
            raise McaptrackError(
                f"{opened.path}: {len(seconds)} {source.noun} make a player of {len(html) / _MB:.1f} MB, and "
                f"`max_mb={max_mb:g}` is the limit; give a larger `every=`, a smaller `width=` or a shorter period"
            )
        taken, every = taken.half(), 2 * every


def _ordinal(number: int) -> str:
    end = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{end}"


#: The least width of a player in pixels: there is room for what it is controlled with.
_LEAST_PX: Final = 420


def _in_notebook(jpeg: bytes, width_px: int, caption: str, page: str = "") -> str:
    """Return a still with a caption, below the frame of a player if there is one."""
    return str(render("in_notebook.html", __package__ or "", width=width_px, jpeg=jpeg, caption=caption, page=page))


def _player_page(
    taken: Clip, seconds: Sequence[float], events: Sequence[tuple[float, str, str]], opens_at: int, caption: str
) -> str:
    """Return the page of a player. ``events`` have a time in seconds, a text, and the topic of their tracks; those of
    tracks that have no layer are left out.
    """
    tracks = {topic: at for at, layer in enumerate(taken.layers) if (topic := _tracks_of(layer))}
    data = {
        "seconds": [round(second, 3) for second in seconds],
        "numbers": taken.numbers,
        "sizes": taken.sizes,
        "layers": taken.layers,
        "names": {topic: _name(topic) for topic in taken.layers if topic},
        "colours": taken.strokes.colours,
        "drawn": taken.drawn,
        "tracks": tracks,
        "hidden": [taken.layers.index(layer) for layer in taken.hidden],
        "events": [[round(at, 3), text, tracks[topic]] for at, text, topic in events if topic in tracks],
        "open": opens_at,
        "ground": "#" + bytes(BACKGROUND[::-1]).hex(),
    }
    pictures = " ".join(_base64(jpeg) for jpeg in taken.jpegs)
    packed = zlib.compress(json.dumps(data, allow_nan=False, separators=(",", ":")).encode(), 9)
    return str(render("player.html", __package__ or "", caption=caption, pictures=pictures, data=_base64(packed)))


def _tracks_of(layer: str) -> str:
    """The channel of tracks that a layer draws; "" for predictions and the ground."""
    for suffix in SUFFIXES:
        layer = layer.partition(suffix)[0]
    return "" if layer.endswith("/predictions") else layer.removesuffix(FULL)


def _name(topic: str) -> str:
    """The name of a view: the channel that it draws, without the camera."""
    for suffix in SUFFIXES:
        topic = topic.partition(suffix)[0]
    return topic.lstrip("/").partition("/")[2] or topic


def _base64(data: bytes) -> str:
    return b64encode(data).decode()
