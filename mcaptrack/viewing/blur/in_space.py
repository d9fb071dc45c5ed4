"""People in 3D boxes, as they are seen in the pictures of a calibrated camera that may move.

Letters: N boxes, M pictures, P points of a box.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import DamagedError, McaptrackError
from mcaptrack.foxglove import Cuboids
from mcaptrack.foxglove.views import MovingCamera
from mcaptrack.foxglove.views.projected import corners
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.pinhole import project
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.classes import class_names
from mcaptrack.schema.framing import frame_times, joined_parts
from mcaptrack.schema.provenance import frame_id_of
from mcaptrack.sources.calibrations import moving_camera
from mcaptrack.sources.fixed_frame import holds_boxes_3d, named_detections
from mcaptrack.viewing.blur.classes import people_among
from mcaptrack.viewing.blur.pieces import Pieces, around, linked

#: The state of a 3D box.
_STATE: Final = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad")
#: Boxes are cut off so far before the camera, and each edge is so many points.
_NEAR_M: Final = 0.1
_POINTS: Final = 6
#: Points beyond the edge of the lens are at most so far outside.
_FAR_PX: Final = 1e6
#: Detections in space count for this time before and after their own.
_NEAR_NS: Final = 250_000_000


class SeenInSpace(NamedTuple):
    """People in 3D boxes that a camera sees: their pieces, the times of the boxes, and the camera."""

    topic: str
    pieces: Pieces
    frame_ns: Ints
    camera: MovingCamera

    def between(self, first: int, last: int) -> tuple[Ints, Floats, Floats]:
        """The boxes in the pictures ``first`` to before ``last``: their pictures (N,) from 0, the boxes (N, 4), and for
        how long a person was not seen (N,), in s.
        """
        picture, states, unseen_s = self.pieces.at(self.camera.at_ns[first:last])
        boxes = outlines(states, picture + first, self.camera)
        seen = np.isfinite(boxes).all(axis=1)
        return picture[seen], boxes[seen], unseen_s[seen]

    def unknown(self) -> Bools:
        """Which pictures (M,) can't have boxes, because it is not known where the camera was."""
        return np.asarray(~np.isfinite(self.camera.rotation).all(axis=(1, 2)), np.bool_)


def people_in_space(opened: log.Log, pictures: str, problems: list[str]) -> list[SeenInSpace]:
    """The people in all 3D boxes of a log, in the pictures of a channel; ``problems`` gets what is in the way."""
    out: list[SeenInSpace] = []
    cameras: dict[str, MovingCamera | None] = {}
    for topic in sorted(opened.channels):
        try:
            found = _read(opened, topic)
        except DamagedError:
            raise
        except McaptrackError as error:
            problems.append(f"{topic}: {error}")
            continue
        if found is None:
            continue
        pieces, frame_ns, frame_id = found
        if frame_id not in cameras:
            try:
                cameras[frame_id] = moving_camera(opened, pictures, frame_id)
            except McaptrackError as error:
                cameras[frame_id] = None
                problems.append(f"{topic} can't be placed in {pictures}: {error}")
        camera = cameras[frame_id]
        if camera is not None:
            out.append(SeenInSpace(topic, pieces, frame_ns, camera))
    return out


def _read(opened: log.Log, topic: str) -> tuple[Pieces, Ints, str] | None:
    """The people in a channel of 3D boxes, the times of its frames and its frame of reference; None for others."""
    channel = opened.channels[topic]
    schema: Schema | None = next((one for one in (TRACKS, DETECTIONS) if channel.holds(one)), None)
    frames: Sequence[Frame]
    if schema is not None:
        frame_id = frame_id_of(channel.metadata)
        if not frame_id:
            return None
        frames, names = opened.frame_columns(topic, schema), class_names(channel.metadata)
    elif holds_boxes_3d(opened, topic):
        found = named_detections(opened, topic)
        schema, frames, frame_id, names = DETECTIONS, found.frames, found.frame_id, found.classes
    else:
        return None
    parts: list[tuple[Ints, Ints, Floats]] = []
    for _, _, part in joined_parts(schema, frames):
        state = np.stack([part.rows[name].astype(np.float64) for name in _STATE], axis=-1)
        # Boxes without a heading may stand in any direction.
        turned = np.isfinite(state[:, 6])
        state[~turned, 3:5] = state[~turned, 3:5].max(axis=1, keepdims=True, initial=0)
        state[~turned, 6] = 0
        known = np.isfinite(state).all(axis=1) & people_among(part.rows["class_id"], names)
        number = part.rows["track_id"] if schema is TRACKS else np.zeros(len(state), np.int64)
        parts.append((part.row_ns[known], number[known].astype(np.int64), state[known]))
    if not sum(len(part[0]) for part in parts):
        return None
    t_ns, number, state = (np.concatenate([part[n] for part in parts]) for n in range(3))
    pieces = linked(t_ns, number, state, state[:, :3]) if schema is TRACKS else around(t_ns, state, _NEAR_NS)
    return pieces, frame_times(frames), frame_id


def outlines(states: Floats, picture: Ints, camera: MovingCamera) -> Floats:
    """The boxes (N, 4) in pictures around 3D boxes (N, 7), each in one of the pictures (N,); NaN where none is seen."""
    box = corners(Cuboids(states[:, :3], states[:, 3:6], states[:, 6]))
    at = np.einsum("nij,npj->npi", camera.rotation[picture], box) + camera.translation[picture][:, None]
    # Points along the lines between all corners: those behind the camera would be mirrored, and lenses bend lines.
    pairs = np.array(np.triu_indices(box.shape[1], 1)).T
    share = np.linspace(0, 1, _POINTS)[:, None]
    ends = at[:, pairs]
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = ends[..., 2]
        cut = np.clip((_NEAR_M - depth) / (depth[..., ::-1] - depth), 0, 1)
        ends = np.where((depth < _NEAR_M)[..., None], ends + cut[..., None] * (ends[..., ::-1, :] - ends), ends)
        points = (ends[:, :, None, 0] * (1 - share) + ends[:, :, None, 1] * share).reshape(len(states), -1, 3)
        is_ahead = points[..., 2] > _NEAR_M * (1 - 1e-9)
    px = np.full((*points.shape[:2], 2), np.nan)
    for number in np.unique(camera.lens[picture]).tolist():
        lens, mine = camera.lenses[number], camera.lens[picture] == number
        flat = points[mine].reshape(-1, 3)
        found = project(flat, lens, np.eye(3), np.zeros(3))[0]
        with np.errstate(invalid="ignore", divide="ignore"):
            straight = flat[:, :2] / flat[:, 2:] * lens.focal_px + lens.centre_px
        beyond = np.isnan(found).any(axis=1)
        found[beyond] = straight[beyond].clip(-_FAR_PX, _FAR_PX)
        px[mine] = found.reshape(px[mine].shape)
    px[~is_ahead] = np.nan
    low, high = np.fmin.reduce(px, axis=1), np.fmax.reduce(px, axis=1)
    size = np.array([camera.width_px, camera.height_px], np.float64)
    with np.errstate(invalid="ignore"):
        is_inside = ((high > 0) & (low < size)).all(axis=1)
    return np.where(is_inside[:, None], np.concatenate([low, high - low], axis=1), np.nan)
