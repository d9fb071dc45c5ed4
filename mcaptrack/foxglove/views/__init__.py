"""What a person looks at: what is drawn on every picture, and on the ground plane, made from the rows around it.

Tracks on another clock than the video's are brought to the times of its pictures, so that boxes move with the people.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from mcaptrack.foxglove.views import ground, image, looks
from mcaptrack.foxglove.views.image import View
from mcaptrack.foxglove.views.looks import look_of
from mcaptrack.foxglove.views.people import People, people_at
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.plane import Planes
from mcaptrack.schema import DETECTIONS, PREDICTIONS, TRACKS, Frame, Schema

__all__ = ["DRAWN", "SCENE_SUFFIX", "SUFFIX", "SUFFIXES", "Drawing", "View", "ground"]


#: Suffixes of the topics of views: on the pictures, and on the ground.
SUFFIX: Final = "/view/image"
SCENE_SUFFIX: Final = "/view/scene"
SUFFIXES: Final = (SUFFIX, SCENE_SUFFIX)
#: What can be drawn.
DRAWN: Final = (DETECTIONS, TRACKS, PREDICTIONS)


class Drawing:
    """A channel to be drawn; ``made_by`` is the stage that made it. Predictions need ``planes`` to come to pixels."""

    def __init__(self, topic: str, schema: Schema, frames: Sequence[Frame], planes: Planes, made_by: str = "") -> None:
        self._schema, self._frames, self._planes = schema, frames, planes
        self._look = look_of(topic, made_by)
        self._known: tuple[Ints, People] | None = None

    def on_pictures(self, picture_ns: Ints, stamp_ns: Ints) -> View:
        """Annotation messages (time, frame, payload), one for each picture.

        ``picture_ns`` are the times of the pictures, rising; ``stamp_ns`` what stands in them, by which viewers match
        what is drawn.
        """
        pictures = image.Pictures(picture_ns, stamp_ns)
        if self._schema is DETECTIONS:
            yield from image.detections(self._frames, pictures, self._planes)
        elif self._schema is TRACKS:
            unit = looks.unit(self._frames, self._planes)
            yield from image.tracks(self._people(picture_ns), pictures, unit, self._look)
        elif self._schema is PREDICTIONS:
            yield from image.predictions(self._frames, pictures, self._planes)

    def on_ground(self, t_ns: Ints, frame_id: str) -> View:
        """Scene messages (time, frame, payload) in metres, one for each of the rising times ``t_ns``.

        ``frame_id`` is the coordinate frame that they lie in.
        """
        if self._schema is TRACKS:
            yield from ground.tracks(self._people(t_ns), t_ns, frame_id, self._look)
        elif self._schema is PREDICTIONS:
            yield from ground.predictions(self._frames, t_ns, frame_id)

    def _people(self, t_ns: Ints) -> People:
        """Who is where, found out once for both views."""
        if self._known is None or not np.array_equal(self._known[0], t_ns):
            self._known = t_ns, people_at(self._frames, t_ns, self._planes)
        return self._known[1]
