"""Views: rows drawn on pictures and on the ground plane.

Tracks with other times than the pictures are resampled to these, so that boxes move with the people.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from mcaptrack.foxglove.views import ground, image, projected
from mcaptrack.foxglove.views.image import View
from mcaptrack.foxglove.views.people import PeopleInParts
from mcaptrack.foxglove.views.projected import MovingCamera
from mcaptrack.foxglove.views.styles import Scale, style_of
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.plane import Planes
from mcaptrack.schema import DETECTIONS, PREDICTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.provenance import SCENE_SUFFIX, VIEW_SUFFIX

__all__ = ["DRAWN", "SCENE_SUFFIX", "SUFFIX", "SUFFIXES", "Drawing", "MovingCamera", "View", "ground"]


#: Ends of the topics of views.
SUFFIX: Final[str] = VIEW_SUFFIX
SUFFIXES: Final = (SUFFIX, SCENE_SUFFIX)
#: The schemas of rows that can be drawn.
DRAWN: Final[tuple[Schema, ...]] = (DETECTIONS, TRACKS, PREDICTIONS)


class Drawing:
    """A channel to draw.

    ``is_retracked`` says that its tracks are repaired; ``classes`` are names of classes by number. Predictions need
    ``planes`` to be drawn on pictures. ``path`` is how the camera moves, if boxes between pictures and trails are to be
    compensated for it; so are ``planes`` then.
    """

    def __init__(
        self,
        topic: str,
        schema: Schema,
        frames: Sequence[Frame],
        planes: Planes,
        is_retracked: bool = False,
        classes: Mapping[int, str] = {},
        path: CameraPath | None = None,
    ) -> None:
        self._classes = classes
        self._schema, self._frames, self._planes, self._path = schema, frames, planes, path
        self._style = style_of(topic, is_retracked)
        self._known: PeopleInParts | None = None

    def on_pictures(self, picture_ns: Ints, stamp_ns: Ints) -> View:
        """Annotation messages (time, frame, payload), one for each picture.

        ``picture_ns`` are the times of the pictures, rising; ``stamp_ns`` their stamps, by which viewers match
        drawings.
        """
        pictures = image.PictureTimes(picture_ns, stamp_ns)
        if self._schema is DETECTIONS:
            yield from image.detections(self._frames, pictures, self._planes)
        elif self._schema is TRACKS:
            scale = Scale.of(self._frames, self._planes)
            yield from image.tracks(self._people(picture_ns), pictures, scale, self._style, self._path)
        elif self._schema is PREDICTIONS:
            yield from image.predictions(self._frames, pictures, self._planes, self._path)

    def on_camera(self, camera: MovingCamera, bodies: Sequence[Frame] = ()) -> View:
        """Annotation messages (time, frame, payload), one for each picture of a calibrated camera, of 3D boxes.

        ``bodies`` are the tracks with 3D boxes that forecasts belong to.
        """
        if self._schema is TRACKS:
            yield from projected.tracks(self._frames, camera, self._style)
        elif self._schema is PREDICTIONS:
            yield from projected.predictions(self._frames, camera, bodies)

    def on_ground(self, t_ns: Ints, frame_id: str, bodies: Sequence[Frame] = ()) -> View:
        """Scene messages (time, frame, payload) in metres, one for each of the rising times ``t_ns``.

        ``frame_id`` is their coordinate frame; ``bodies`` are the tracks with 3D boxes that forecasts belong to.
        """
        if self._schema is TRACKS:
            yield from ground.tracks(self._people(t_ns), t_ns, frame_id, self._style)
        elif self._schema is PREDICTIONS:
            yield from ground.predictions(self._frames, t_ns, frame_id, bodies)
        elif self._schema is DETECTIONS:
            yield from ground.detections(self._frames, t_ns, frame_id, self._classes)

    def _people(self, t_ns: Ints) -> PeopleInParts:
        """The people at these times, computed once for both views."""
        if self._known is None or not np.array_equal(self._known.at_ns, t_ns):
            self._known = PeopleInParts(self._frames, t_ns, self._planes, self._classes, self._path)
        return self._known
