"""Calibrations of cameras on robots, and the ground that they see: a plane for each picture, from the transforms."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.pinhole import Lens, ground_homography
from mcaptrack.geometry.plane import GroundPlane, Planes
from mcaptrack.geometry.transform_tree import OTHER_CLOCK_S, Poses, TransformTree
from mcaptrack.notices import warn
from mcaptrack.schema.names import plain_name, shared_parts
from mcaptrack.schema.provenance import INGEST
from mcaptrack.sources.cameras import Camera, provenance_of
from mcaptrack.sources.fixed_frame import poses_at, transforms_of
from mcaptrack.sources.foreign.decoding import decoder_with_errors, frame_named
from mcaptrack.sources.foreign.flatten import frame_of, message_type_of
from mcaptrack.sources.foreign.things import HEADS, heads, read_channel
from mcaptrack.sources.pictures import picture_size

if TYPE_CHECKING:
    from mcaptrack.foxglove.views import MovingCamera

#: Schemas of calibrations, by their names in ROS 1 and Foxglove; ROS 2 adds "/msg/".
CALIBRATIONS_READ: Final = ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration")
#: The names of models of distortion: those of OpenCV with up to 8 coefficients, and its fisheye model.
_POLYNOMIAL: Final = ("plumb_bob", "rational_polynomial")
_FISHEYE: Final = ("equidistant", "kannala_brandt", "fisheye")
#: Heights of a camera above the ground that are believed, in metres, unless the user names the ground.
_HEIGHTS_M: Final = (0.05, 30.0)
#: Frames on the ground that robots have, in the order in which they are tried.
_GROUND_FRAMES: Final = ("base_footprint", "base_link")
#: A word of a topic of rectified pictures: /front/image_rect_color/compressed, but not /direct/image.
_RECTIFIED: Final = re.compile(r"(?<![a-z])(image)?rect(ified)?(?![a-z])", re.IGNORECASE)
#: A camera's frame is no optical one if its z axis points up: z of a unit vector is more than this.
_LOOKS_UP: Final = 0.7
#: Pictures were resized, not cropped, if their ratio of width to height differs by less than this share.
SHAPE: Final = 0.02
#: The plane of a picture in which no point is known to be on the ground.
_NOWHERE: Final = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0)


class Calibration(NamedTuple):
    """A calibration: the frame of the camera, its lens, and the size of its pictures in pixels.

    ``turn`` (3, 3) rotates points of the frame to the axes of rectified pictures; it is the identity for others.
    """

    frame_id: str
    lens: Lens
    width_px: int
    height_px: int
    turn: Floats


class GroundSeen(NamedTuple):
    """The ground planes of a camera for each picture, in metres of ``frame``, and where they are from.

    The ground is z = 0 of ``ground_frame``; ``topic`` is that of the calibration.
    """

    planes: Planes
    frame: str
    ground_frame: str
    topic: str


def holds_calibrations(channel: log.Channel) -> bool:
    """Return whether a channel has calibrations of cameras."""
    return plain_name(channel.schema_name) in CALIBRATIONS_READ


def find_calibration(opened: log.Log, source: str, frame_id: str) -> str:
    """Return the topic of the calibration for pictures, or boxes, in this topic and frame.

    It is one in the same frame, or else in the same folder of topics; of several, the one with the most similar name.
    Raises McaptrackError if there is none, or if several are as similar.
    """
    frame_at = {
        topic: frame_of(opened, topic) for topic, channel in opened.channels.items() if holds_calibrations(channel)
    }
    same = [topic for topic, named in frame_at.items() if frame_id and named == frame_id]
    # Compressed pictures are one level lower: /front/image/compressed is beside /front/camera_info.
    folder = source.rpartition("/")[0]
    folders = (folder, folder.rpartition("/")[0]) if folder.count("/") > 1 else (folder,)
    beside = [topic for topic in frame_at if topic.rpartition("/")[0] in folders]
    fitting = same or beside
    ingested = [topic for topic in fitting if (origin := provenance_of(opened, topic)) and origin.transform == INGEST]
    fitting = ingested or fitting  # what a user gave replaces what was recorded
    if not fitting:
        frames = ", ".join(f"{topic} (frame {named or 'without a name'})" for topic, named in sorted(frame_at.items()))
        raise McaptrackError(f"no calibration is of the frame {frame_id!r} of {source}; there is {frames or 'none'}")
    alike = {topic: shared_parts(topic, source) for topic in fitting}
    nearest = sorted(topic for topic in fitting if alike[topic] == max(alike.values()))
    usable = [topic for topic in nearest if len(nearest) == 1 or _is_usable(opened, topic)]
    if len(usable) != 1:
        raise McaptrackError(f"several calibrations fit {source}: {', '.join(nearest)}")
    return usable[0]


def read_calibrations(opened: log.Log, topic: str, is_rectified: bool) -> list[tuple[int, Calibration]]:
    """Return the calibrations of a channel, each with the log time in ns from which it holds; repeats are left out.

    ``is_rectified``: of pictures that are rectified already. Raises McaptrackError for what can't be read.
    """
    decode = decoder_with_errors(message_type_of(opened, topic), lambda message: calibration_of(message, is_rectified))
    out: list[tuple[int, Calibration]] = []
    for message in opened.timed(topic):
        try:
            calibration = decode(message.payload)
        except McaptrackError as error:
            raise McaptrackError(f"{topic} at {message.t_ns} ns: {error}") from None
        if not out or calibration[:4] != out[-1][1][:4] or not np.array_equal(calibration.turn, out[-1][1].turn):
            out.append((message.t_ns, calibration))
    if not out:
        raise McaptrackError(f"{topic} has no messages")
    return out


def see_ground(opened: log.Log, camera: Camera, frame: str = "", ground_frame: str = "") -> GroundSeen | None:
    """Return the ground planes of a camera: one for each picture at which its pose has changed.

    ``frame`` is the frame of the metres, by default the root above the camera; the ground is z = 0 of ``ground_frame``,
    by default of ``frame``. None if the log has no calibration of a camera. Raises McaptrackError if none fits the
    camera, or if no transforms connect it with the ground.
    """
    sources = [topic for topic in (camera.pictures, camera.boxes) if topic]
    if not sources or not any(map(holds_calibrations, opened.channels.values())):
        return None
    log_ns, stamp_ns, frame_id = _headers(opened, sources)
    topic, fitted = _fitting(opened, sources[0], frame_id, camera.pictures)
    eye = fitted[0][1].frame_id or frame_id
    tree = transforms_of(opened, sources[0])
    if tree is None:
        raise McaptrackError(f"there are no transforms, which say where the camera of {topic} is")
    if eye not in tree.frames():
        raise McaptrackError(f"no transform has the frame {eye!r} of {topic}; there are {', '.join(tree.frames())}")
    frame = frame or tree.root_of(eye)
    ground = ground_frame or _ground_frame(tree, frame, eye, stamp_ns)
    poses = poses_at(opened, sources[0], ground, eye, stamp_ns, log_ns)
    floor = poses_at(opened, sources[0], frame, ground, stamp_ns, log_ns) if ground != frame else None
    if not poses.is_known.any():
        raise McaptrackError(f"no pose of the frame {eye} in {ground} is known")
    if np.nanmedian(poses.rotation[:, 2, 2]) > _LOOKS_UP:
        text = f"{eye} looks up: z of a camera's frame points ahead (an optical frame), and that of {eye} doesn't"
        warn(f"{text}; no boxes are on the ground", "transforms")
    planes = _planes(log_ns, fitted, poses, floor)
    return GroundSeen(planes, frame, ground, topic)


def moving_camera(opened: log.Log, topic: str, frame: str) -> MovingCamera:
    """Return the pose of a camera in a frame at each of its pictures, and its lens.

    Raises McaptrackError if no calibration fits the pictures, or if no transforms connect the camera with the frame.
    """
    from mcaptrack.foxglove.views import MovingCamera

    log_ns, stamp_ns, frame_id = _headers(opened, [topic])
    _, fitted = _fitting(opened, topic, frame_id, topic)
    first = fitted[0][1]
    poses = poses_at(opened, topic, first.frame_id or frame_id, frame, stamp_ns, log_ns)
    if not poses.is_known.any():
        raise McaptrackError(f"no pose of the frame {first.frame_id or frame_id} in {frame} is known")
    which = _holding(fitted, log_ns)
    turn = np.array([calibration.turn for _, calibration in fitted])[which]
    is_other_clock = bool(len(log_ns)) and np.median(np.abs(log_ns - stamp_ns)) > OTHER_CLOCK_S * NS_PER_S
    return MovingCamera(
        log_ns, stamp_ns, log_ns if is_other_clock else np.maximum.accumulate(stamp_ns),
        turn @ poses.rotation, (turn @ poses.translation[..., None])[..., 0],
        [calibration.lens for _, calibration in fitted], which, first.width_px, first.height_px,
    )  # fmt: skip


def _fitting(
    opened: log.Log, source: str, frame_id: str, pictures: str | None
) -> tuple[str, list[tuple[int, Calibration]]]:
    """Return the topic of the calibration for a topic and its frame, and the calibrations scaled to the pictures."""
    topic, size = find_calibration(opened, source, frame_id), picture_size(opened, pictures)
    calibrations = read_calibrations(opened, topic, is_rectified_topic(source))
    return topic, [(since_ns, _fitted(calibration, size, topic)) for since_ns, calibration in calibrations]


def is_rectified_topic(topic: str) -> bool:
    """Return whether the pictures of a topic are rectified, by its last part or that before a kind of compression."""
    return any(_RECTIFIED.search(part) for part in topic.split("/")[-2:])


def _holding(calibrations: Sequence[tuple[int, Calibration]], log_ns: Ints) -> Ints:
    """Return which of the calibrations holds at each log time (N,)."""
    return np.maximum(np.searchsorted([t_ns for t_ns, _ in calibrations], log_ns, side="right") - 1, 0)


def _planes(
    log_ns: Ints, calibrations: Sequence[tuple[int, Calibration]], poses: Poses, floor: Poses | None
) -> list[tuple[int, GroundPlane]]:
    """Return the planes of pictures at log times (N,), from the poses of the camera on the ground.

    ``floor`` are the poses of the ground in the frame of the metres, unless that is the same.
    """
    which = _holding(calibrations, log_ns)
    is_known = poses.is_known if floor is None else poses.is_known & floor.is_known
    out: list[tuple[int, GroundPlane]] = []
    below = 0
    for number, t_ns in enumerate(log_ns.tolist()):
        calibration = calibrations[which[number]][1]
        size = calibration.width_px, calibration.height_px
        plane = GroundPlane(_NOWHERE, *size, lens=calibration.lens)
        if is_known[number]:
            back = calibration.turn @ poses.rotation[number].T
            metres = np.eye(3)
            if floor is not None:
                metres[:2] = np.column_stack([floor.rotation[number][:2, :2], floor.translation[number][:2]])
            try:
                homography = ground_homography(calibration.lens, back, -back @ poses.translation[number], metres)
                plane = GroundPlane(homography, *size, lens=calibration.lens)
            except McaptrackError:
                below += 1
        if out and out[-1][0] == t_ns:
            out.pop()
        if not out or out[-1][1] != plane:
            out.append((t_ns, plane))
    if below:
        warn(
            f"{below:,} of {len(log_ns):,} pictures have no ground plane: the camera is below the ground", "transforms"
        )
    return out


def _ground_frame(tree: TransformTree, frame: str, eye: str, stamps_ns: Ints) -> str:
    """Return the frame with the ground as z = 0: that of the metres, or one of the robot if that can't be."""

    def height_m(ground: str) -> float:
        heights = tree.lookup(ground, eye, stamps_ns).translation[:, 2]
        return float(np.median(heights[np.isfinite(heights)])) if np.isfinite(heights).any() else float("nan")

    above = height_m(frame)
    if not np.isfinite(above) or _HEIGHTS_M[0] < above < _HEIGHTS_M[1]:
        return frame
    for other in _GROUND_FRAMES:
        if other in tree.frames() and _HEIGHTS_M[0] < height_m(other) < _HEIGHTS_M[1]:
            text = f"{eye} is {above:.3g} m above z = 0 of {frame}: the ground is taken to be z = 0 of {other}"
            warn(f"{text}. `ground_frame=` chooses", "transforms")
            return other
    raise McaptrackError(
        f"{eye} is {above:.3g} m above z = 0 of {frame}; name a frame on the ground by `ground_frame=`"
    )


def _headers(opened: log.Log, topics: Sequence[str]) -> tuple[Ints, Ints, str]:
    """Return log times and stamps in ns of all messages, (N,) each, by log time; and the frame of the first message."""
    times, frame_id = [np.empty((2, 0), np.int64)], ""
    for topic in topics:
        log_ns = opened.times(topic)
        stamp_ns = log_ns.copy()
        with suppress(McaptrackError):  # rows of mcaptrack have no stamps
            for which, (stamps_ns, frames) in read_channel(opened, topic, heads, HEADS).parts:
                stamp_ns[which] = stamps_ns
                frame_id = frame_id or next(filter(None, frames), "").removeprefix("/")
        times.append(np.stack([log_ns, stamp_ns]))
    log_ns, stamp_ns = np.concatenate(times, axis=1)
    order = np.lexsort((stamp_ns, log_ns))
    return log_ns[order], stamp_ns[order], frame_id


def _is_usable(opened: log.Log, topic: str) -> bool:
    try:
        return bool(read_calibrations(opened, topic, is_rectified=False))
    except McaptrackError:
        return False


def calibration_of(message: Any, is_rectified: bool) -> Calibration:
    """Return the calibration that a message holds; ``is_rectified``: of pictures that are rectified already.

    Raises McaptrackError if it isn't calibrated, or has distortion of another kind.
    """
    width, height = int(message.width), int(message.height)
    numbers = {name: _numbers(message, name) for name in "DKRP"}
    model = str(message.distortion_model).strip().lower()
    if is_rectified and len(numbers["P"]) == 12 and numbers["P"][0] > 0:
        p = numbers["P"]
        turn = np.reshape(numbers["R"], (3, 3)) if any(numbers["R"]) else np.eye(3)
        return Calibration(frame_named(message), Lens((p[0], p[5]), (p[2], p[6])), width, height, turn)
    k = numbers["K"]
    if len(k) != 9 or not k[0] > 0:
        raise McaptrackError(f"it isn't calibrated: its focal length is {k[0] if k else 0:g} pixels")
    bent = numbers["D"] if any(numbers["D"]) else []
    if bent and model not in (*_POLYNOMIAL, *_FISHEYE):
        raise McaptrackError(f"distortion by {model!r} is not read; {', '.join((*_POLYNOMIAL, *_FISHEYE))} are")
    is_fisheye = bool(bent) and model in _FISHEYE
    while not is_fisheye and len(bent) > 8 and not bent[-1]:
        bent.pop()
    lens = Lens((k[0], k[4]), (k[2], k[5]), tuple(bent), is_fisheye)
    return _cropped(message, Calibration(frame_named(message), lens, width, height, np.eye(3)))


def _cropped(message: Any, calibration: Calibration) -> Calibration:
    """Return the calibration of pictures that are a part of what the sensor sees, or have fewer pixels."""
    step_x, step_y = (max(int(getattr(message, f"binning_{axis}", 0)), 1) for axis in "xy")
    roi = getattr(message, "roi", None)
    left, top, width, height = (int(getattr(roi, name, 0)) for name in ("x_offset", "y_offset", "width", "height"))
    cx, cy = calibration.lens.centre_px
    lens = replace(calibration.lens, centre_px=(cx - left, cy - top)).scaled(1 / step_x, 1 / step_y)
    size = ((width or calibration.width_px) // step_x, (height or calibration.height_px) // step_y)
    return calibration._replace(lens=lens, width_px=size[0], height_px=size[1])


def _fitted(calibration: Calibration, size: tuple[int, int] | None, topic: str) -> Calibration:
    """Return the calibration scaled to pictures of this size, which may have been resized; unchanged for None."""
    if size in (None, (calibration.width_px, calibration.height_px), (0, 0)) or size is None:
        return calibration
    if not calibration.width_px or not calibration.height_px:
        return calibration._replace(width_px=size[0], height_px=size[1])
    across, down = size[0] / calibration.width_px, size[1] / calibration.height_px
    if abs(across / down - 1) > SHAPE:
        was = f"{calibration.width_px} x {calibration.height_px}"
        raise McaptrackError(f"{topic} is for pictures of {was} pixels, and these are {size[0]} x {size[1]}")
    return calibration._replace(lens=calibration.lens.scaled(across, down), width_px=size[0], height_px=size[1])


def _numbers(message: Any, name: str) -> list[float]:
    """Return a field by its name in ROS 1 and Foxglove, or in ROS 2, where it is in small letters."""
    values = getattr(message, name) if hasattr(message, name) else getattr(message, name.lower())
    return [float(value) for value in values]
