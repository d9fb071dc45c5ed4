"""What a person looks at: what is drawn on every picture, and on the ground plane, made from the rows around it.

Tracks on another clock than the video's are brought to the times of its pictures, so that boxes move with the people.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.plane import Planes
from mcaptrack.schema import DETECTIONS, PREDICTIONS, TRACKS, Frame, Schema
from mcaptrack.views import ground, image
from mcaptrack.views.image import View
from mcaptrack.views.looks import look_of

__all__ = ["DRAWN", "SCENE_SUFFIX", "SUFFIX", "SUFFIXES", "View", "ground", "scene", "view"]

Ints = NDArray[np.int64]

#: Suffixes of the topics of views: on the pictures, and on the ground.
SUFFIX: Final = "/view/image"
SCENE_SUFFIX: Final = "/view/scene"
SUFFIXES: Final = (SUFFIX, SCENE_SUFFIX)
#: What can be drawn.
DRAWN: Final = (DETECTIONS, TRACKS, PREDICTIONS)


def view(
    topic: str,
    schema: Schema,
    frames: Sequence[Frame],
    picture_ns: Ints,
    planes: Planes,
    stamp_ns: Ints | None = None,
    made_by: str = "",
    trails: bool = True,
) -> View:
    """The annotation messages (time, frame, payload) of a channel, one for each picture.

    ``picture_ns`` are the times of the pictures, rising; ``stamp_ns`` what stands in them, by which viewers match what
    is drawn, if that is another time. Predictions need ``planes`` to come back to pixels. ``made_by`` is the stage that
    made the channel. Without ``trails`` boxes and numbers are drawn alone.
    """
    pictures = image.Pictures(picture_ns, picture_ns if stamp_ns is None else stamp_ns)
    if schema is DETECTIONS:
        yield from image.detections(frames, pictures, planes)
    elif schema is TRACKS:
        look = look_of(topic, made_by)
        yield from image.tracks(frames, pictures, planes, look if trails else look._replace(dash=0.0))
    elif schema is PREDICTIONS:
        yield from image.predictions(frames, pictures, planes)


def scene(
    topic: str,
    schema: Schema,
    frames: Sequence[Frame],
    t_ns: Ints,
    planes: Planes,
    frame_id: str,
    made_by: str = "",
) -> View:
    """The scene messages (time, frame, payload) of a channel in metres, one for each of the rising times ``t_ns``.

    ``frame_id`` is the coordinate frame that they lie in; the rest as in ``view``.
    """
    if schema is TRACKS:
        yield from ground.tracks(frames, t_ns, frame_id, planes, look_of(topic, made_by))
    elif schema is PREDICTIONS:
        yield from ground.predictions(frames, t_ns, frame_id)
