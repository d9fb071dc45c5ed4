"""Make logs of videos, folders of images, recordings and label files."""

from __future__ import annotations

import datetime as dt
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from mcaptrack.api import labels
from mcaptrack.api.declared import OneOfMany, Option, declared
from mcaptrack.api.options import (
    FILES,
    LABELS,
    Definitions,
    Force,
    GroundPlane,
    PathLike,
    PointOfBox,
    Reports,
    Sidecar,
    no_progress,
    output,
)
from mcaptrack.choices import ImageFormat, InputRole, LengthUnit
from mcaptrack.errors import McaptrackError, call
from mcaptrack.location import sibling
from mcaptrack.notices import Notice

if TYPE_CHECKING:
    from mcaptrack.sources.ingest import IngestReport

_EPOCH: Final = dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
#: A heading in the help: how pictures are stored.
_PICTURES: Final = "Pictures"

Source = Annotated[
    PathLike,
    OneOfMany(
        "inputs",
        "INPUT",
        "Videos, folders of images, ROS bags, MCAP files, or label files (YOLO: a folder), patterns, or - for a list "
        "of these on stdin; each becomes a log.",
    ),
]
_Labels = Annotated[PathLike | None, Option(LABELS)]


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
    labels : dict
        The facts about label files by role: format, clock, classes and labelled frames, and where these are from.
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
    labels: Mapping[str, Mapping[str, Any]]
    changes: Mapping[str, Any] | None

    @classmethod
    def of(
        cls, log: Path, report: IngestReport, warnings: Iterable[Notice], changes: Mapping[str, Any] | None
    ) -> IngestResult:
        """The result of making ``log``."""
        return cls(
            log=log,
            messages=report.messages,
            notes=tuple(report.remarks),
            details=tuple(report.notes),
            lost=tuple(report.lost),
            warnings=tuple(dict.fromkeys(warnings)),
            has_labels=report.has_labels,
            uses_camera=report.uses_camera,
            labels=report.facts,
            changes=changes,
        )


@declared(
    most_used=("output", "into", "role", "ground_plane", "truth", "detections", "fps", "camera", "force"),
    settable=("keyframe_interval_s", "calibration_unit"),
    heading="Start here",
    printed_by="mcaptrack.cli.ingest:Ingest",
)
def ingest(
    source: Source,
    output: Annotated[PathLike | None, output("INPUT.mcap in the working folder")] = None,
    *,
    camera: Annotated[str, Option(FILES)] = "camera",
    fps: Annotated[float | str | Fraction | None, Option(_PICTURES, tuning=labels.FPS_PATTERN, shown=False)] = None,
    start_time: Annotated[float | str | dt.datetime | None, Option(_PICTURES)] = None,
    image_format: Annotated[ImageFormat, Option(_PICTURES, tuning=True)] = "auto",
    quality: Annotated[int | None, Option(_PICTURES, 1, 100, tuning=True)] = None,
    keyframe_interval_s: Annotated[float | None, Option(_PICTURES, 0.01, 60, tuning=True)] = None,
    stream: Annotated[int | None, Option(_PICTURES, 0, 1000)] = None,
    ground_plane: GroundPlane = None,
    calibration: Annotated[PathLike | Sequence[PathLike] | None, Option(LABELS, metavar="FILE", shown=False)] = None,
    calibration_name: Annotated[str | None, Option(LABELS, metavar="NAME")] = None,
    calibration_unit: Annotated[LengthUnit, Option(LABELS, tuning=True)] = "auto",
    point: PointOfBox = "foot",
    detections: _Labels = None,
    tracks: _Labels = None,
    truth: _Labels = None,
    motion: Annotated[PathLike | None, Option(_PICTURES)] = None,
    label_format: labels.Format = "auto",
    columns: labels.Columns = None,
    classes: labels.Classes = None,
    class_map: labels.ClassNames = None,
    first_frame: labels.FirstFrame = None,
    frames: labels.LabelledFrames = None,
    size: labels.Size = None,
    frame: Annotated[str | None, Option(labels.READING)] = None,
    scene: Annotated[str | None, Option(labels.READING, shown=False)] = None,
    role: Annotated[InputRole | None, Option(LABELS, flag="as")] = None,
    into: Annotated[PathLike | None, Option(FILES)] = None,
    definitions: Definitions = None,
    sidecar: Sidecar = None,
    force: Force = False,
    progress: Reports = no_progress,
) -> IngestResult:
    """Make a log of a video, images, a recording or a label file.

    Takes folders of images, ROS bags and MCAP files, too. Writes /camera/video, /camera/ground_plane,
    /camera/calibration, /camera/detections, /camera/tracks, /camera/truth and /camera/motion, as far as they are given.
    Streams that viewers can play (H.264, VP9, AV1) are copied without re-encoding; others are re-encoded as H.264, and
    a note says why. Timestamps are those of the file, exact to the nanosecond.

    From a ROS 1 bag, a rosbag2 folder or database, or an MCAP file every message is copied unchanged, with its
    timestamps; labels belong to its only camera, or to the one that ``camera`` names.

    Parameters
    ----------
    source : path
        The input.
    output : path, optional
        Write to this file, of several inputs to this folder; they stay unchanged.
    camera : str, default "camera"
        Name of the camera; its channels begin with /NAME.
    fps : float, str or Fraction, optional
        Frames per second, such as 25 or 30000/1001, instead of the file's own times.
    start_time : float, str or datetime, optional
        When the recording began (2026-05-01T12:00:00Z, or seconds since 1970); by default as the file says, or 0.
    image_format : {"auto", "h264", "h265", "jpeg", "png"}, default "auto"
        How pictures are stored. auto: H.264, VP9 and AV1 as they are where viewers play them, otherwise H.264; h264:
        H.264 alone; h265: like auto, and H.265 as it is; jpeg, png: one image per picture.
    quality : int, optional
        Quality of encoding: for H.264 the constant rate factor, 1 (best) to 51; for JPEG 1 to 100 (best); by default
        23, of JPEG 90.
    keyframe_interval_s : float, optional
        Longest time between keyframes, in seconds; streams with longer gaps are re-encoded; by default 2 if copied, 1
        if encoded.
    stream : int, optional
        Which video of a file that holds several, from 0; by default the first of more than one picture.
    calibration : path or sequence of path, optional
        File with the calibration of the camera, of OpenCV, ROS (camera_info) or Kalibr; two if intrinsics and the pose
        in the world are two files. The ground plane (z = 0) follows from both.
    calibration_name : str, optional
        Which camera of a calibration of several, such as cam1; by default the one of the same topic or name.
    calibration_unit : {"auto", "m", "cm", "mm"}, default "auto"
        Unit of lengths of the pose. auto: that in which the camera has a usual height.

        A warning says so if that isn't metres.
    detections : path, optional
        Label file with detections: boxes without ids.
    tracks : path, optional
        Label file with tracks: boxes or positions with ids.
    truth : path, optional
        Label file with ground truth: boxes or positions with true ids.
    motion : path, optional
        File with the motion of the camera: a row per frame, of its number (from 0) and the 2x3 transform from pixels of
        the frame before.
    frame : str, optional
        Frame of reference of 3D boxes; by default that of the format, or the root of the log's transforms.
    scene : str, optional
        Name of the scene, of nuScenes.
    role : {"detections", "tracks", "truth", "corrections", "motion", "calibration"}, optional
        What the input holds, if it is a label file. corrections: tracks of the log that a person has corrected; run
        then takes them over; by default as its ids tell.

        The motion of a camera, its calibration and corrections of its tracks go ``into`` a log.
    into : path, optional
        Add to this log, instead of making a new one.
    sidecar : bool, optional
        With ``into``: write into LOG.results.mcap beside the log (True) or into the log (False).
    force : bool, default False
        Overwrite the log; with ``into``, replace the channels it has already.

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
    On the command line:

        mcaptrack ingest video.mp4 --ground-plane homography.txt --truth gt.txt -o log.mcap

    >>> import mcaptrack
    >>> result = mcaptrack.ingest("video.mp4", "new.mcap", ground_plane="plane.txt", truth="truth.txt")
    >>> sorted(result.messages)
    ['/camera/ground_plane', '/camera/truth', '/camera/video']

    """
    from mcaptrack.api.common import as_path, optional_path, paths_of, warnings_about
    from mcaptrack.sources.foreign.definitions import definitions_of
    from mcaptrack.sources.ingest import ingest as make_log

    _check_places(output, into, sidecar)
    path, files = as_path(source), {"detections": detections, "tracks": tracks, "truth": truth}
    how = labels.label_options(
        label_format=label_format, columns=columns, classes=classes, class_map=class_map, first_frame=first_frame,
        frames=frames, fps=fps, size=size, ground_plane=ground_plane, point=point,
    )  # fmt: skip
    options = replace(
        how,
        camera=camera,
        start_ns=parse_start_time(start_time),
        image_format=image_format,
        quality=quality,
        keyframe_interval_s=keyframe_interval_s,
        stream=stream,
        calibration=tuple(paths_of(calibration)),
        calibration_name=calibration_name,
        calibration_unit=calibration_unit,
        labels={name: as_path(label) for name, label in files.items() if label is not None},  # type: ignore[misc]
        role=role,
        motion=optional_path(motion),
        frame_id=frame,
        scene=scene,
    )
    make = partial(make_log, path, options=options, progress=progress)
    with warnings_about(path) as warnings, definitions_of(definitions):
        if into is None:
            target = _new_log(path, output, force)
            report = make(target)
        else:
            target = as_path(into)
            report = _add_to(target, sidecar, partial(make, force=force))
        changes = _changes(target, report) if role == "corrections" else None
    return IngestResult.of(target, report, warnings, changes)


def _check_places(output: PathLike | None, into: PathLike | None, sidecar: bool | None) -> None:
    """Raise McaptrackError for places of a result that don't go together."""
    if into is not None and output is not None:
        raise McaptrackError("`into=` adds to a log in place; it does not go with `output=`")
    if into is None and sidecar is not None:
        raise McaptrackError(f"`sidecar={sidecar}` needs a log to add to; name it with `into=`")


def _new_log(source: Path, output: PathLike | None, force: bool) -> Path:
    """Return the path of the log of an input. Raises McaptrackError if another file stands there, unless forced."""
    from mcaptrack.api.common import log_output
    from mcaptrack.files import is_same_file, refuse_overwrite

    target = default_log(source) if output is None else log_output(output, source)
    refuse_overwrite(target, force or is_same_file(target, source))
    return target


def _add_to(log: Path, sidecar: bool | None, make: Callable[..., IngestReport]) -> IngestReport:
    """Add what is made of an input to a log, or to the results beside it, and say where it is."""
    from mcaptrack import log as logs
    from mcaptrack.sources.sidecar import SidecarChoice

    place = SidecarChoice(sidecar)
    with logs.read(log, sidecar=place) as opened:
        opened.lock()
        report = make(log, into=opened)
        written_to = opened.parts[-1].path
    if place.why:
        report.remarks.append(place.words(written_to))
    if written_to == log:
        logs.update_listing(log)
    return report


def _changes(path: Path, report: IngestReport) -> dict[str, Any] | None:
    """Compare corrections that were written with their tracks, and say in a line of the report what they changed."""
    from mcaptrack import log as logs
    from mcaptrack.evaluation.corrections import changes_in
    from mcaptrack.sources.corrections import CORRECTED

    (topic,) = (topic for topic in report.messages if topic.endswith(f"/{CORRECTED}"))
    with logs.read(path) as opened:
        changes = changes_in(opened, topic)
    if changes is None:
        report.remarks.append(f"{path} has no tracks to compare {topic} with")
        return None
    report.remarks.append(f"{topic}: {changes.words}; {call('run', path)} takes it over")
    return changes.to_json()


def default_log(source: Path) -> Path:
    """Return the default path of the log of an input: in the working folder."""
    whole = Path(os.path.abspath(source))  # "." has no name
    return sibling(Path(whole.name or "log"), ".mcap", of=whole.name if source.is_dir() else whole.stem)


def parse_start_time(time: float | str | dt.datetime | None) -> int | None:
    """Return nanoseconds since 1970 from ISO 8601, seconds since 1970, or a datetime (UTC unless it says otherwise)."""
    from mcaptrack.geometry import clocks

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
