"""A log as a recording of Rerun (.rrd): pictures, boxes, positions with trails, forecasts, and a blueprint of views.

camera             the pictures as they are in the log: a video stream, or encoded images
camera/boxes       the boxes of one channel, coloured by identity
ground/tracks      positions in metres, or 3D boxes
ground/trails      where each was in the last seconds
ground/forecasts   predicted paths

Rerun notes when it wrote each message, so that two files of one log differ in these times and in its own ids.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Final
from urllib.parse import urlencode

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError, lacks, needing
from mcaptrack.foxglove.palette import colours
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import Progress, warn
from mcaptrack.schema import DETECTIONS, PREDICTIONS, SCHEMAS, Frame
from mcaptrack.schema.classes import PERSON, class_name, class_names
from mcaptrack.sources import foreign
from mcaptrack.sources.box_files import boxes_topic
from mcaptrack.sources.cameras import Camera, cameras
from mcaptrack.sources.video import is_video_codec
from mcaptrack.viewing.serving import WebViewer

_APPLICATION: Final = "mcaptrack"
_NEEDED: Final = ("a recording of Rerun", "rerun-sdk", "rerun")
#: Times are dates from here on, and durations before.
_DATES_NS: Final = 10**9 * NS_PER_S
#: How long trails are.
_TRAIL_NS: Final = 3 * NS_PER_S
_IMAGES: Final = {"jpeg": "image/jpeg", "jpg": "image/jpeg", "png": "image/png", "webp": "image/webp"}
#: The channels of forecasts below the name of a camera, the best first.
_FORECASTS: Final = ("retracks/predictions", "predictions")
_BOXES, _POINTS, _TRAILS, _PATHS = "camera/boxes", "ground/tracks", "ground/trails", "ground/forecasts"
_RADIUS_M: Final = 0.15


def library() -> Any:
    """Rerun's library. Raises McaptrackError if it is not installed."""
    with needing(*_NEEDED):
        import rerun
    return rerun


class Rerun:
    """A recording of Rerun, as an exporter."""

    end: ClassVar[str] = ".rrd"

    def write(
        self, recording: Any, path: Path, topic: str | None = None, progress: Progress = lambda *_: None
    ) -> dict[str, int]:
        """Write a log with the boxes of a channel: by default the best tracks of the only camera, or its detections.

        Raises McaptrackError if the library is missing, or if there is no such channel.
        """
        with log.read(recording.path) as opened:
            return write_recording(opened, path, boxes_topic(opened, topic), progress)


def viewer() -> WebViewer:
    """Rerun's viewer on the web, of the version of the library that is installed."""
    return WebViewer(Rerun.end, _made, _link, _why_not)


def _made(opened: log.Log) -> bytes:
    with TemporaryDirectory(prefix="mcaptrack-rerun-") as folder:
        path = Path(folder, f"{opened.path.stem}{Rerun.end}")
        write_recording(opened, path, boxes_topic(opened))
        return path.read_bytes()


def _link(file: str) -> str:
    return f"https://app.rerun.io/version/{version('rerun-sdk')}/index.html?{urlencode({'url': file})}"


def _why_not(opened: log.Log) -> str:
    try:
        version("rerun-sdk")
        boxes_topic(opened)
    except PackageNotFoundError:
        return lacks(*_NEEDED)
    except McaptrackError as error:
        return str(error)
    return ""


def write_recording(opened: log.Log, output: Path, topic: str, progress: Progress = lambda *_: None) -> dict[str, int]:
    """Write a recording with the boxes of a channel; returns the number of its rows, and warns of what is left out.

    Raises McaptrackError if the library is missing.
    """
    rerun = library()
    channel = opened.channel(topic)
    frames = opened.frame_columns(topic, SCHEMAS[channel.schema_name])
    camera = next((each for each in cameras(opened) if topic in each.topics), None)
    recording = rerun.RecordingStream(_APPLICATION, recording_id=opened.path.stem, send_properties=False)
    job = _Job(rerun, recording, opened)
    recording.save(output, default_blueprint=job.blueprint())
    total = len(frames) + (opened.channel(camera.pictures).messages if camera and camera.pictures else 0)
    for done, _ in enumerate(job.write_all(camera, topic, frames), start=1):
        progress("export", min(done, total), total)
    recording.flush()
    recording.disconnect()
    return {topic: job.rows}


class _Job:
    """Writes messages to a recording, and counts rows."""

    def __init__(self, rerun: Any, recording: Any, opened: log.Log) -> None:
        self._rr, self._recording, self._opened = rerun, recording, opened
        self.rows = 0

    def blueprint(self) -> Any:
        """Pictures with boxes on the left, the ground on the right."""
        import rerun.blueprint as views

        return views.Blueprint(
            views.Horizontal(
                views.Spatial2DView(origin="camera", name="pictures"),
                views.Spatial3DView(origin="ground", name="ground"),
                column_shares=[3, 2],
            ),
            views.TimePanel(timeline="time"),
            collapse_panels=True,
        )

    def write_all(self, camera: Camera | None, topic: str, frames: Any) -> Iterator[None]:
        """Write pictures, then rows, then forecasts; yields after each message."""
        rr = self._rr
        self._recording.log("ground", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if camera and camera.pictures:
            yield from self._pictures(camera.pictures)
        yield from self._tracks(topic, frames)
        names = [f"{camera.prefix}/{name}" for name in _FORECASTS] if camera else []
        for name in [name for name in names if self._opened.holds(name, PREDICTIONS)][:1]:
            yield from self._forecasts(name)

    def _at(self, t_ns: int, number: int | None) -> None:
        when = np.datetime64(t_ns, "ns") if t_ns >= _DATES_NS else None
        if when is not None:
            self._recording.set_time("time", timestamp=when)
        else:
            self._recording.set_time("time", duration=np.timedelta64(t_ns, "ns"))
        if number is not None:
            self._recording.set_time("frame", sequence=number)

    def _pictures(self, topic: str) -> Iterator[None]:
        rr, lost = self._rr, 0
        has_codec = False
        for number, (message, picture) in enumerate(foreign.pictures(self._opened, topic)):
            self._at(message.t_ns, number)
            if is_video_codec(picture.format) and picture.layout is None:
                if not has_codec:
                    codec = getattr(rr.VideoCodec, picture.format.upper())
                    self._recording.log("camera", rr.VideoStream(codec=codec), static=True)
                    has_codec = True
                self._recording.log("camera", rr.VideoStream.from_fields(sample=picture.data))
            elif picture.format in _IMAGES and picture.layout is None:
                image = rr.EncodedImage(contents=picture.data, media_type=_IMAGES[picture.format])
                self._recording.log("camera", image)
            else:
                lost += 1
            yield
        if lost:
            warn(f"{topic}: {lost} pictures that are neither video, JPEG, PNG nor WebP are left out", "left-out")

    def _tracks(self, topic: str, frames: Any) -> Iterator[None]:
        rr, names = self._rr, class_names(self._opened.channel(topic).metadata)
        is_detections = self._opened.channel(topic).schema_name == DETECTIONS.name
        trails: dict[int, deque[tuple[int, Floats]]] = {}
        for frame in frames:
            rows = frame.rows
            self.rows += len(rows)
            self._at(frame.t_ns, frame.index)
            ids = rows["class_id"].astype(np.int64) if is_detections else rows["track_id"]
            texts = [
                " ".join(([] if is_detections else [str(id_)]) + ([] if kind == PERSON else [class_name(kind, names)]))
                for id_, kind in zip(ids.tolist(), rows["class_id"].tolist(), strict=True)
            ]
            boxes = columns_to_boxes(rows)
            here = np.isfinite(boxes).all(axis=1)
            self._recording.log(
                _BOXES,
                rr.Boxes2D(
                    array=boxes[here],
                    array_format=rr.Box2DFormat.XYWH,
                    colors=colours(ids[here]),
                    labels=[texts[at] for at in np.flatnonzero(here).tolist()],
                ),
            )
            self._on_ground(frame, ids, texts)
            if not is_detections:
                self._trails(frame, trails)
            yield

    def _on_ground(self, frame: Frame, ids: Any, texts: list[str]) -> None:
        rr, rows = self._rr, frame.rows
        xyz = np.stack([rows["x_m"], rows["y_m"], np.nan_to_num(rows["z_m"])], axis=-1)
        size = np.stack([rows[name] for name in ("length_m", "width_m", "height_m")], axis=-1)
        placed = np.isfinite(xyz).all(axis=1)
        solid = placed & np.isfinite(size).all(axis=1)
        labels = np.array(texts, object)
        if solid.any():
            turns = [rr.RotationAxisAngle(axis=[0, 0, 1], radians=row) for row in rows["heading_rad"][solid].tolist()]
            boxes = rr.Boxes3D(
                centers=xyz[solid],
                sizes=size[solid],
                rotation_axis_angles=turns,
                colors=colours(ids[solid]),
                labels=labels[solid].tolist(),
            )
            self._recording.log(f"{_POINTS}/boxes", boxes)
        points = rr.Points3D(xyz[placed], radii=_RADIUS_M, colors=colours(ids[placed]), labels=labels[placed].tolist())
        self._recording.log(_POINTS, points)

    def _trails(self, frame: Frame, trails: dict[int, deque[tuple[int, Floats]]]) -> None:
        rows = frame.rows
        for track_id, x, y, z in zip(rows["track_id"].tolist(), rows["x_m"], rows["y_m"], rows["z_m"], strict=True):
            if np.isfinite(x):
                trails.setdefault(track_id, deque()).append((frame.t_ns, np.array([x, y, np.nan_to_num(z)])))
        for track_id in list(trails):
            while trails[track_id] and trails[track_id][0][0] < frame.t_ns - _TRAIL_NS:
                trails[track_id].popleft()
            if not trails[track_id]:
                del trails[track_id]
        long = {long_id: [place for _, place in trail] for long_id, trail in trails.items() if len(trail) > 1}
        ids = np.array(list(long), np.int64)
        self._recording.log(_TRAILS, self._rr.LineStrips3D(list(long.values()), colors=colours(ids)))

    def _forecasts(self, topic: str) -> Iterator[None]:
        for frame in self._opened.frames(topic, PREDICTIONS):
            self._at(frame.t_ns, None)
            ids = np.unique(frame.rows["track_id"])
            strips = []
            for track_id in ids.tolist():
                own = frame.rows[frame.rows["track_id"] == track_id]
                strips.append(np.stack([own["x_m"], own["y_m"], np.zeros(len(own))], axis=-1))
            shown = self._rr.LineStrips3D(
                strips, colors=np.concatenate([colours(ids), np.full((len(ids), 1), 0.5)], axis=1)
            )
            self._recording.log(_PATHS, shown)
            yield
