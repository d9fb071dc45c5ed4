"""Make logs of videos, folders of images, recordings and label files."""

from __future__ import annotations

import datetime as dt
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

from mcaptrack import log as logs
from mcaptrack.api.checked import checked
from mcaptrack.api.common import (
    PathLike,
    Progress,
    as_path,
    log_output,
    no_progress,
    optional_path,
    paths_of,
    warn_unused,
    warnings_about,
)
from mcaptrack.errors import McaptrackError, call
from mcaptrack.evaluation.corrections import changes_in
from mcaptrack.files import is_same_file, refuse_overwrite
from mcaptrack.geometry import boxes, clocks
from mcaptrack.geometry.plane import Point
from mcaptrack.location import sibling
from mcaptrack.notices import Notice, warn
from mcaptrack.sources.corrections import CORRECTED
from mcaptrack.sources.ingest import Format, ImageFormat, IngestOptions, IngestReport, InputRole
from mcaptrack.sources.ingest import ingest as make_log
from mcaptrack.sources.ingest.bags.metadata_update import update_metadata
from mcaptrack.sources.ingest.calibration import LengthUnit
from mcaptrack.sources.ingest.labels.columns import check_keys, parse_columns
from mcaptrack.sources.ingest.labels.wanted import WantedClasses
from mcaptrack.sources.ingest.sidecar import SidecarChoice

_EPOCH: Final = dt.datetime(1970, 1, 1, tzinfo=dt.UTC)


@dataclass(frozen=True)
class IngestResult:
    """The result of ingesting one input.

    Attributes
    ----------
    log : pathlib.Path
        The log.
    messages : dict of str to int
        Number of messages that were written, by topic.
    notes, details : tuple of str
        What was done with the input, such as why a video was encoded again; ``details`` are less important.
    lost : tuple of str
        What could not be read, such as damaged pictures.
    warnings : tuple of mcaptrack.Notice
        What was assumed, left out or looks odd, and what was lost.
    has_labels : bool
        Whether there were label files.
    uses_camera : bool
        Whether anything was written below the name of the camera.
    changes : dict or None
        What corrections changed: numbers of boxes that are the same, moved, added and removed, and ids of tracks that
        were joined, split, added and removed; None if there were none.

    """

    log: Path
    messages: Mapping[str, int]
    notes: tuple[str, ...]
    details: tuple[str, ...]
    lost: tuple[str, ...]
    warnings: tuple[Notice, ...]
    has_labels: bool
    uses_camera: bool
    changes: Mapping[str, Any] | None = None


@checked(quality=(1, 100), keyframe_interval_s=(0.01, 60), first_frame=(0, 10**12), frames=(1, 10_000_000))
def ingest(
    source: PathLike,
    output: PathLike | None = None,
    *,
    camera: str = "camera",
    fps: float | str | Fraction | None = None,
    start_time: float | str | dt.datetime | None = None,
    image_format: ImageFormat = "auto",
    quality: int | None = None,
    keyframe_interval_s: float | None = None,
    ground_plane: PathLike | None = None,
    calibration: PathLike | Sequence[PathLike] | None = None,
    calibration_name: str | None = None,
    calibration_unit: LengthUnit = "auto",
    point: Point = "foot",
    detections: PathLike | None = None,
    tracks: PathLike | None = None,
    truth: PathLike | None = None,
    motion: PathLike | None = None,
    label_format: Format = "auto",
    first_frame: int | None = None,
    frames: int | None = None,
    columns: str | Mapping[str, str] | None = None,
    size: str | tuple[int, int] | None = None,
    classes: str | None = None,
    frame: str | None = None,
    scene: str | None = None,
    role: InputRole | None = None,
    into: PathLike | None = None,
    sidecar: bool | None = None,
    force: bool = False,
    progress: Progress = no_progress,
) -> IngestResult:
    """Make a log of a video, a folder of images, a ROS bag, an MCAP file, or a label file.

    Parameters
    ----------
    source : path
        The input.
    output : path, optional
        The log to write, by default SOURCE.mcap in the working folder.
    camera : str, default "camera"
        Name of the camera; its topics begin with /NAME.
    fps : float, str or Fraction, optional
        Frames per second, such as 25 or "30000/1001", instead of the timestamps of the file.
    start_time : float, str or datetime, optional
        When the recording began: seconds since 1970, or 2026-05-01T12:00:00Z. By default as the file says, or 0.
    image_format : {"auto", "h264", "h265", "jpeg", "png"}, default "auto"
        How pictures are stored.
    quality : int, optional
        Quality of encoding: for H.264 the constant rate factor, 1 (best) to 51; for JPEG 1 to 100 (best).
    keyframe_interval_s : float, optional
        Longest time between keyframes in seconds.
    ground_plane : path, optional
        File with a 3x3 homography from pixels to metres on the ground.
    calibration : path or sequence of path, optional
        Files with the calibration of the camera, of OpenCV (XML, YAML or JSON), ROS (``camera_info``) or Kalibr:
        intrinsics and, in the same file or another one, its pose in the world, from which the ground plane follows
        (z = 0).
    calibration_name : str, optional
        Which camera, if a file has several, such as "cam1"; by default the one of this topic or name.
    calibration_unit : {"auto", "m", "cm", "mm"}, default "auto"
        Unit of lengths of the pose. By default the one in which the camera has a usual height, with a warning if that
        isn't metres.
    point : {"foot", "center"}, default "foot"
        Which point of a box touches the ground.
    detections, tracks, truth : path, optional
        Label files with detections, tracks and ground truth.
    motion : path, optional
        File with the motion of the camera: a row per frame, of its number (from 0) and the 2x3 transform from pixels of
        the frame before.
    label_format : {"auto", "mot", "kitti", "sdd", "trajnet", "obsmat", "coco", "cvat", "yolo", "supervision", ...}
        Format of the label files, by default "auto": as their content tells. "csv" is any table with a header. Those of
        3D boxes are "csv", "kitti-3d", "nuscenes" and "argoverse".
    first_frame : int, optional
        Number of the first picture in label files.
    frames : int, optional
        Number of frames, if there are labels but no pictures.
    columns : dict of str to str, or str, optional
        Names of the columns of label files with a header, by what they hold: ``{"x": "left", "frame": "n"}`` or
        "x=left,frame=n". There are x, y, w, h, x2, y2, cx, cy, frame, t (seconds), score, class, name (of the class)
        and id; of 3D boxes x_m, y_m, z_m, length_m, width_m, height_m, heading_rad or heading_deg, qw, qx, qy, qz,
        vx_m_per_s and vy_m_per_s.
    size : tuple of int, or str, optional
        Width and height of the pictures, (1920, 1080) or "1920x1080", if there are only labels in shares of them.
    classes : str, optional
        Classes of tracks and ground truth, by name or number with commas between them, or "all"; by default "person",
        and all of 3D boxes. Detections keep all.
    frame : str, optional
        Frame of reference of 3D boxes; by default that of the format, or else the root of the log's transforms.
    scene : str, optional
        Name of the scene, if the labels are of nuScenes.
    role : {"detections", "tracks", "truth", "corrections", "motion", "calibration"}, optional
        What ``source`` holds, if it is a label file; by default as its ids tell. The motion of a camera, its
        calibration and corrections of its tracks go ``into`` a log; ``run`` then takes corrected tracks in place of
        those that it found.
    into : path, optional
        Add to this log instead of making a new one.
    sidecar : bool, optional
        With ``into``: write into LOG.results.mcap beside the log (True) or into the log (False).
    force : bool, default False
        Overwrite the log; with ``into``, replace the channels that it has already.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    IngestResult
        The log, and what was written into it.

    Raises
    ------
    McaptrackError
        If anything of the input cannot be understood, or if the log exists; nothing is written then.

    Examples
    --------
    >>> import mcaptrack
    >>> result = mcaptrack.ingest("video.mp4", "new.mcap", ground_plane="plane.txt", truth="truth.txt")
    >>> sorted(result.messages)
    ['/camera/ground_plane', '/camera/truth', '/camera/video']

    """
    if into is not None and output is not None:
        raise McaptrackError("`into=` adds to a log in place; it does not go with `output=`")
    if into is None and sidecar is not None:
        raise McaptrackError(f"`sidecar={sidecar}` needs a log to add to; name it with `into=`")
    path, labels = as_path(source), {"detections": detections, "tracks": tracks, "truth": truth}
    options = IngestOptions(
        camera=camera,
        fps=parse_fps(fps),
        start_ns=parse_start_time(start_time),
        image_format=image_format,
        quality=quality,
        keyframe_interval_s=keyframe_interval_s,
        ground_plane=optional_path(ground_plane),
        calibration=() if calibration is None else tuple(paths_of(calibration)),
        calibration_name=calibration_name,
        calibration_unit=calibration_unit,
        point=point,
        labels={name: as_path(label) for name, label in labels.items() if label is not None},  # type: ignore[misc]
        label_format=label_format,
        first_frame=first_frame,
        frames=frames,
        role=role,
        motion=optional_path(motion),
        columns=parse_columns(columns) if isinstance(columns, str) else check_keys(columns) if columns else None,
        size=parse_size(size),
        classes=None if classes is None else WantedClasses(classes),
        frame_id=frame,
        scene=scene,
    )
    changes = None
    with warnings_about(path) as warnings:
        if into is None:
            target = default_log(path) if output is None else log_output(output, path)
            refuse_overwrite(target, force or is_same_file(target, path))
            report = make_log(path, target, options, progress=progress)
        else:
            target, place = as_path(into), SidecarChoice(sidecar)
            with logs.read(target, sidecar=place) as opened:
                opened.lock()
                report = make_log(path, target, options, into=opened, force=force, progress=progress)
                written_to = opened.parts[-1].path
            changes = _changes(target, report) if role == "corrections" else None
            if place.why:
                report.remarks.append(place.words(written_to))
            if written_to == target:
                update_metadata(target)
        for lost in report.lost:
            warn(f"lost: {lost}", "lost")
        warn_unused("there is no label file", label_format=label_format != "auto" and not report.has_labels)
        warn_unused("there is no label file", columns=columns is not None and not report.has_labels)
        warn_unused("no label file is of a detector's format", size=size is not None and not report.uses_size)
        is_unused = classes is not None and not report.uses_classes
        warn_unused("there are no tracks and no ground truth", classes=is_unused)
        without_3d = not report.holds_boxes_3d
        warn_unused("there are no 3D boxes", frame=frame is not None and without_3d)
        warn_unused("there are no tables of nuScenes", scene=scene is not None and without_3d)
        is_calibrated = bool(options.calibration) or any(topic.endswith("/calibration") for topic in report.messages)
        without_plane = ground_plane is None and not is_calibrated
        warn_unused("there is no ground plane", point=point != "foot" and without_plane)
        about = {"calibration_name": calibration_name is not None, "calibration_unit": calibration_unit != "auto"}
        warn_unused("there is no calibration", **{} if is_calibrated else about)
        keep = "the channels of a recording keep their names"
        warn_unused(keep, camera=camera != "camera" and not report.uses_camera)
    return IngestResult(
        log=target,
        messages=report.messages,
        notes=tuple(report.remarks),
        details=tuple(report.notes),
        lost=tuple(report.lost),
        warnings=tuple(dict.fromkeys(warnings)),
        has_labels=report.has_labels,
        uses_camera=report.uses_camera,
        changes=changes,
    )


def _changes(path: Path, report: IngestReport) -> dict[str, Any] | None:
    """Compare corrections that were written with their tracks, and say in a line of the report what they changed."""
    (topic,) = (topic for topic in report.messages if topic.endswith(f"/{CORRECTED}"))
    with logs.read(path) as opened:
        found = changes_in(opened, topic)
    if found is None:
        report.remarks.append(f"{path} has no tracks to compare {topic} with")
        return None
    report.remarks.append(f"{topic}: {found.words}; {call('run', path)} takes it over")
    return found.to_json()


def default_log(source: Path) -> Path:
    """Return the default path of the log of an input: in the working folder."""
    whole = Path(os.path.abspath(source))  # "." has no name
    return sibling(Path(whole.name or "log"), ".mcap", of=whole.name if source.is_dir() else whole.stem)


def parse_fps(fps: float | str | Fraction | None) -> Fraction | None:
    """Return frames per second as a fraction, from 25, "29.97" or "30000/1001"."""
    try:
        return None if fps is None else clocks.parse_fps(str(fps))
    except ValueError:
        raise McaptrackError(
            f"`fps=` needs a number like 25, 29.97 or 30000/1001, from one frame a day to 10000 a second, not {fps!r}"
        ) from None


def parse_size(size: str | tuple[int, int] | None) -> tuple[int, int] | None:
    """Return width and height from "1920x1080" or two numbers."""
    if size is None:
        return None
    found = boxes.parse_size(size if isinstance(size, str) else "x".join(map(str, size)))
    if found is None:
        raise McaptrackError(f"`size=` is the width and height of pictures in pixels, like 1920x1080, not {size!r:.40}")
    return found


def parse_start_time(time: float | str | dt.datetime | None) -> int | None:
    """Return nanoseconds since 1970 from ISO 8601, seconds since 1970, or a datetime (UTC unless it says otherwise)."""
    if time is None:
        return None
    try:
        seconds = clocks.parse_ratio(str(time))
    except ValueError:
        try:
            moment = time if isinstance(time, dt.datetime) else dt.datetime.fromisoformat(str(time))
        except ValueError:
            raise McaptrackError(
                f"`start_time=` needs 2026-05-01T12:00:00Z or seconds since 1970, not {time!r}"
            ) from None
        passed = (moment if moment.tzinfo else moment.replace(tzinfo=dt.UTC)) - _EPOCH
        seconds = Fraction(passed.days * 86400 + passed.seconds) + Fraction(passed.microseconds, 1_000_000)
    if not 0 <= seconds < clocks.LAST_NS // clocks.NS_PER_S:
        raise McaptrackError(f"`start_time=` has to lie between 1970 and 2262, not {time!r}")
    return round(seconds * clocks.NS_PER_S)
