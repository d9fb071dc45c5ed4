"""Draw the tracks of a scene on the pictures of the cameras that it was fused of, with the ids of the scene.

A track gets the box that a camera has of the detection that the track was at, and a box as large as those of others
that stand there where the camera has none. Letters: N rows, F frames, D detections.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from mcaptrack.extensions.cameras.feet import CameraView
from mcaptrack.foxglove.views.people import by_plane
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.assignment import assign
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import seconds_to_ns
from mcaptrack.geometry.plane import Planes
from mcaptrack.pipeline.checks import read_frames
from mcaptrack.pipeline.pictures import PictureClock, picture_clock
from mcaptrack.pipeline.scenes import Member
from mcaptrack.pipeline.write import RunState
from mcaptrack.schema import BOX_PX, DETECTIONS, SIGHTINGS, TRACKS, Frame, Schema
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import JoinedFrames, frame_numbers, frame_times, joined_parts
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.camera_motion import planes_in
from mcaptrack.sources.cameras import camera_at, detections_of, detections_topic

#: A track is at a detection of its time if it is at most so far away.
_AT_M: Final = 1.0
#: Boxes that a camera doesn't have are drawn if so much of their height and width is in the picture.
_INSIDE: Final = 0.5


@dataclass(frozen=True)
class SceneCamera:
    """A camera of a scene, and its pictures; ``number`` is that of its sightings, ``late_ns`` how late its clock is."""

    number: int
    clock: PictureClock
    view: CameraView
    boxes: Sequence[Frame]
    late_ns: int


class SceneOnPictures:
    """The detections of a scene, and the sightings that they were made of."""

    def __init__(self, detections: Sequence[Frame], sightings: Sequence[Frame]) -> None:
        self._detections, self._sightings = detections, sightings

    def on_camera(
        self, camera: SceneCamera, schema: Schema, frames: Sequence[Frame], is_true: bool
    ) -> tuple[Sequence[Frame], Planes]:
        """Return tracks (with boxes) or forecasts at the times of a camera's pictures, and the camera's planes.

        The boxes of ground truth are not taken from detections.
        """
        if schema is TRACKS:
            return self._boxes(frames, camera, is_true), camera.view.planes
        return [frame._replace(t_ns=frame.t_ns + camera.late_ns) for frame in frames], camera.view.planes

    def _boxes(self, tracks: Sequence[Frame], camera: SceneCamera, is_true: bool) -> FrameColumns:
        """Return tracks with boxes in a camera's pictures; those of ground truth are not taken from detections."""
        out, numbers, last_ns = FrameCollector(TRACKS), frame_numbers(tracks), -1
        for low, high, joined in joined_parts(TRACKS, tracks):
            rows, box = joined.rows.copy(), np.full((len(joined.rows), 4), np.nan)
            t_ns = joined.t_ns + camera.late_ns
            if not is_true:
                box, t_ns = self._detected(joined, camera, t_ns)
                rows["observed"] = np.isfinite(box[:, 0])
            lacks = np.isnan(box[:, 0])
            xy_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
            box[lacks] = _standing(camera.view, xy_m[lacks], t_ns[joined.frame[lacks]])
            for name, values in zip(BOX_PX, box.T, strict=True):
                rows[name] = values
            kept = np.isfinite(box).all(axis=1)
            later = t_ns > np.maximum.accumulate(np.concatenate([[last_ns], t_ns[:-1]]))
            kept &= later[joined.frame]
            ends = np.concatenate([[0], np.cumsum(np.bincount(joined.frame[kept], minlength=len(t_ns))[later])])
            out.extend(t_ns[later], numbers[low:high][later], ends, rows[kept])
            last_ns = int(t_ns[later][-1]) if later.any() else last_ns
        return out.done()

    def _detected(self, joined: JoinedFrames, camera: SceneCamera, usual_ns: Ints) -> tuple[Floats, Ints]:
        """Return the camera's detected boxes of tracks (N, 4), NaN without one, and the times of its pictures (F,)."""
        box, t_ns = np.full((len(joined.rows), 4), np.nan), usual_ns.copy()
        detected_ns, box_ns = frame_times(self._detections), frame_times(camera.boxes)
        for number, now_ns in enumerate(joined.t_ns.tolist()):
            at = int(np.searchsorted(detected_ns, now_ns))
            if at == len(detected_ns) or detected_ns[at] != now_ns:
                continue
            seen = self._sightings[at].rows
            seen = seen[seen["camera"] == camera.number]
            if not len(seen):
                continue
            picture_ns = int(seen["picture_ns"][0])
            t_ns[number] = picture_ns
            own = int(np.searchsorted(box_ns, picture_ns))
            low, high = int(joined.ends[number]), int(joined.ends[number + 1])
            track, detection = _matched(joined.rows[low:high], self._detections[at].rows)
            of, box_row = np.full(len(self._detections[at].rows), -1), seen["box_row"].astype(np.int64)
            used = seen["detection"] >= 0
            of[seen["detection"][used].astype(np.int64)] = box_row[used]
            has_box = of[detection] >= 0
            boxes = columns_to_boxes(camera.boxes[own].rows)
            box[low + track[has_box]] = boxes[of[detection[has_box]]]
        return box, t_ns


def _matched(tracks: np.ndarray, detections: np.ndarray) -> tuple[Ints, Ints]:
    """Match tracks with detections at the same place, and return the rows of both."""
    here, places = (np.stack([rows["x_m"], rows["y_m"]], axis=-1) for rows in (tracks, detections))
    apart = here[:, None] - places
    cost = np.where(tracks["observed"][:, None], np.hypot(apart[..., 0], apart[..., 1]), np.inf)
    cost[tracks["class_id"][:, None] != detections["class_id"]] = np.inf
    return assign(cost, _AT_M)


def _standing(view: CameraView, xy_m: Floats, t_ns: Ints) -> Floats:
    """Boxes (N, 4) around people who stand at places (N, 2) at times (N,); NaN outside of the picture."""
    box = np.full((len(xy_m), 4), np.nan)
    if view.heights is None:
        return box
    for plane, held in by_plane(view.planes, t_ns):
        foot = plane.metres_to_pixels(xy_m[held])
        high = view.heights_at(foot)
        boxes = plane.standing_boxes(xy_m[held], np.stack([view.width * high, high], axis=-1))
        size = np.array([plane.width_px, plane.height_px], float)
        low, up = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
        inside = np.minimum(up, size) - np.maximum(low, 0)
        is_seen: Bools = (high > 1) & (inside > _INSIDE * boxes[:, 2:]).all(axis=1)
        box[held] = np.where(is_seen[:, None], boxes, np.nan)
    return box


def members_of(state: RunState, how: Provenance) -> list[Member]:
    """Return the cameras with pictures of the scene of a run, which was fused so, and what draws it on them."""
    opened, target = state.opened, detections_topic(state.prefix)
    scene_cameras = []
    offsets = dict(zip(how.parameters["cameras"], how.parameters["clock_offset_s"], strict=True))
    for number, (name, late_s) in enumerate(offsets.items()):
        camera = camera_at(opened, f"/{name}")
        clock = picture_clock(opened, camera.prefix, {})
        topic = detections_of(opened, camera)
        if clock.topic is None or topic is None or camera.ground_plane not in opened.channels:
            continue
        planes = planes_in(opened, camera.ground_plane)
        boxes = read_frames(opened, topic, DETECTIONS)
        view = CameraView(name=name, planes=tuple(planes)).with_heights_in(boxes)
        scene_cameras.append(SceneCamera(number, clock, view, boxes, seconds_to_ns(late_s)))
    if not scene_cameras:
        return []
    scene = SceneOnPictures(state.frames(target, DETECTIONS), state.frames(f"{target}/sightings", SIGHTINGS))
    return [Member(camera.clock, partial(scene.on_camera, camera)) for camera in scene_cameras]
