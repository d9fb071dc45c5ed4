"""The HTML of players, stills and pages in notebooks: one piece that needs no other file and opens no connection.

A player is a page of its own in a frame, so that its style and script and those of the notebook don't meet. Below the
frame lies a still with a caption: it is what remains where frames are taken out, as in notebooks that are not trusted.
"""

from __future__ import annotations

import json
import zlib
from base64 import b64encode
from collections.abc import Sequence
from typing import Final, NamedTuple

from mcaptrack.extensions.notebook.pictures import Clip
from mcaptrack.foxglove.views import SUFFIXES
from mcaptrack.transforms import FULL
from mcaptrack.viewing.formatting import render
from mcaptrack.viewing.painting import BACKGROUND

#: The least width of a player in pixels: there is room for what it is controlled with.
_LEAST_PX: Final = 420


class Still(NamedTuple):
    """A picture with drawings as a JPEG file, and its width in pixels."""

    jpeg: bytes
    width_px: int


def in_notebook(still: Still, caption: str, page: str = "") -> str:
    """Return a picture with a caption, for a notebook; with the ``page`` of a player that in a frame above it."""
    width = max(still.width_px, _LEAST_PX) if page else still.width_px
    return str(render("in_notebook.html", __package__ or "", width=width, jpeg=still.jpeg, caption=caption, page=page))


def player_page(
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
