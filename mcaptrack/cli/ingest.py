"""``mcaptrack ingest``: make logs of videos, images, recordings and label files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from mcaptrack.cli import common, labels
from mcaptrack.cli.flags import with_flags
from mcaptrack.cli.inputs import expand, only_one_output
from mcaptrack.cli.many import LogWork, many_options, process, takes_many
from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location

if TYPE_CHECKING:
    from mcaptrack import IngestResult
    from mcaptrack.fleet import NamedLog

Inputs = Annotated[
    list[Path],
    typer.Argument(
        metavar="INPUT",
        help="Videos, folders of images, ROS bags, MCAP files, or label files (YOLO: a folder), patterns, or - for a "
        "list of these on stdin; each becomes a log.",
        show_default=False,
    ),
]


def _label_file(words: str) -> Any:
    return common.option(panel=labels.LABELS, help=f"Label file with {words}.")


_PICTURES: Final = "Pictures"
#: How label files are read.
_READING: Final = "Reading of label files"


@common.one_line
@takes_many()
def ingest(
    inputs: Inputs,
    output: Annotated[Path | None, common.output("INPUT.mcap in the working folder")] = None,
    camera: Annotated[
        str, common.option("--camera", panel=common.FILES, help="Name of the camera; its channels begin with /NAME.")
    ] = "camera",
    fps: Annotated[
        str | None,
        common.option(
            "--fps",
            panel=_PICTURES,
            tuning=labels.FPS_PATTERN,
            help="Frames per second, instead of the file's own times.",
            show_default=False,
        ),
    ] = None,
    start_time: Annotated[
        str | None,
        common.option(
            "--start-time",
            panel=_PICTURES,
            help="When the recording began (2026-05-01T12:00:00Z, or seconds since 1970).",
            show_default="as the file says, otherwise 0",
        ),
    ] = None,
    image_format: Annotated[
        Literal["auto", "h264", "h265", "jpeg", "png"],
        common.option(
            "--image-format",
            panel=_PICTURES,
            tuning=True,
            help="How pictures are stored. auto: H.264, VP9 and AV1 as they are where viewers play them, otherwise "
            "H.264; h264: H.264 alone; h265: like auto, and H.265 as it is; jpeg, png: one image per picture.",
        ),
    ] = "auto",
    quality: Annotated[
        int | None,
        common.option(
            "--quality",
            panel=_PICTURES,
            least=1,
            most=100,
            tuning=True,
            help="Quality of encoding: for H.264 the constant rate factor, 1 (best) to 51; for JPEG 1 to 100 (best).",
            show_default="23; JPEG 90",
        ),
    ] = None,
    keyframe_interval_s: Annotated[
        float | None,
        common.option(
            "--keyframe-interval-s",
            panel=_PICTURES,
            least=0.01,
            most=60,
            tuning=True,
            help="Longest time between keyframes, in seconds; streams with longer gaps are re-encoded.",
            show_default="2 if copied, 1 if encoded",
        ),
    ] = None,
    ground_plane: labels.GroundPlane = None,
    calibration: Annotated[
        list[Path] | None,
        common.option(
            "--calibration",
            panel=labels.LABELS,
            metavar="FILE",
            help="File with the calibration of the camera, of OpenCV, ROS (camera_info) or Kalibr; twice if intrinsics "
            "and the pose in the world are two files. The ground plane follows from both.",
            show_default=False,
        ),
    ] = None,
    calibration_name: Annotated[
        str | None,
        common.option(
            "--calibration-name",
            panel=labels.LABELS,
            metavar="NAME",
            help="Which camera of a calibration of several, such as cam1.",
            show_default="the one of the same topic or name",
        ),
    ] = None,
    calibration_unit: Annotated[
        Literal["auto", "m", "cm", "mm"],
        common.option(
            "--calibration-unit",
            panel=labels.LABELS,
            tuning=True,
            help="Unit of lengths of the pose. auto: that in which the camera has a usual height.",
        ),
    ] = "auto",
    point: labels.Point = "foot",
    detections: Annotated[Path | None, _label_file("detections: boxes without ids")] = None,
    tracks: Annotated[Path | None, _label_file("tracks: boxes or positions with ids")] = None,
    truth: Annotated[Path | None, _label_file("ground truth: boxes or positions with true ids")] = None,
    motion: Annotated[
        Path | None,
        common.option(
            panel=_PICTURES,
            help="File with the motion of the camera: a row per frame, of its number (from 0) and the 2x3 transform "
            "from pixels of the frame before.",
        ),
    ] = None,
    label_format: Annotated[
        Literal[
            "auto",
            "mot",
            "kitti",
            "sdd",
            "trajnet",
            "obsmat",
            "coco",
            "cvat",
            "yolo",
            "supervision",
            "csv",
            "kitti-3d",
            "nuscenes",
            "argoverse",
        ],
        common.option(
            "--format",
            panel=_READING,
            tuning=True,
            help="Format of the label files. auto: as the content tells; csv: any table with a header.",
        ),
    ] = "auto",
    columns: Annotated[
        str | None,
        common.option(
            "--columns",
            panel=_READING,
            help="Columns of label files with a header: x=left,y=top,w=width,h=height,frame=n. Also x2, y2, cx, cy, t "
            "(seconds), score, class, name (of the class), id; 3D boxes: x_m, y_m, z_m, length_m, width_m, height_m, "
            "heading_rad, heading_deg, qw to qz.",
            show_default="guessed from the header",
        ),
    ] = None,
    classes: Annotated[
        str | None,
        common.option(
            "--classes",
            panel=_READING,
            help="Classes of tracks and ground truth, by name or number, as in person,car; all for every one.",
            show_default="person; 3D boxes: all",
        ),
    ] = None,
    frame: Annotated[
        str | None,
        common.option(
            "--frame",
            panel=_READING,
            help="Frame of reference of 3D boxes.",
            show_default="that of the format, or the root of the log's transforms",
        ),
    ] = None,
    scene: Annotated[
        str | None,
        common.option("--scene", panel=_READING, help="Name of the scene, of nuScenes.", show_default=False),
    ] = None,
    size: Annotated[
        str | None,
        common.option(
            "--size",
            panel=_READING,
            help="Width and height of the pictures, like 1920x1080, if there are only labels in shares of them.",
            show_default=False,
        ),
    ] = None,
    first_frame: Annotated[
        int | None,
        common.option(
            "--first-frame",
            panel=_READING,
            least=0,
            most=10**12,
            tuning=True,
            help="Number of the first picture in label files.",
            show_default="1 in MOTChallenge, otherwise 0",
        ),
    ] = None,
    frames: Annotated[
        int | None,
        common.option(
            "--frames",
            panel=_READING,
            least=1,
            most=10_000_000,
            tuning=True,
            help="Number of frames, if there are labels but no pictures.",
            show_default="as seqinfo.ini says, otherwise up to the last label",
        ),
    ] = None,
    role: Annotated[
        Literal["detections", "tracks", "truth", "corrections", "motion", "calibration"] | None,
        common.option(
            "--as",
            panel=labels.LABELS,
            help="What INPUT holds, if it is a label file. corrections: tracks of the log that a person has "
            "corrected; run then takes them over.",
            show_default="as its ids tell",
        ),
    ] = None,
    into: Annotated[
        Path | None,
        common.option(
            "--into", panel=common.FILES, help="Add to this log, instead of making a new one.", show_default=False
        ),
    ] = None,
    sidecar: common.Sidecar = None,
    force: Annotated[
        bool,
        common.option(
            "--force", panel=common.FILES, help="Overwrite the log; with --into, replace the channels it has already."
        ),
    ] = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Make a log of a video, a folder of images, a ROS bag, an MCAP file, or a label file.

    Writes /camera/video, /camera/ground_plane, /camera/calibration, /camera/detections, /camera/tracks, /camera/truth
    and /camera/motion, as far as they are given. Streams that viewers can play (H.264, VP9, AV1) are copied without
    re-encoding; others are re-encoded as H.264, and the reason is printed. Timestamps are those of the file, exact to
    the nanosecond.

    From a ROS 1 bag, a rosbag2 folder or database, or an MCAP file every message is copied unchanged, with its
    timestamps; labels belong to its only camera, or to the one that --camera names.

    Example: mcaptrack ingest video.mp4 --ground-plane homography.txt --truth gt.txt -o log.mcap
    """
    import mcaptrack

    sources = expand(inputs, each=True)
    only_one_output(sources, output or into)
    if into is not None and many_options().output_dir is not None:
        raise McaptrackError("--into and --output-dir are two places for the same results; give one")
    given: dict[str, Any] = {
        "camera": camera,
        "fps": fps,
        "start_time": start_time,
        "image_format": image_format,
        "quality": quality,
        "keyframe_interval_s": keyframe_interval_s,
        "ground_plane": ground_plane,
        "calibration": calibration or None,
        "calibration_name": calibration_name,
        "calibration_unit": calibration_unit,
        "point": point,
        "detections": detections,
        "tracks": tracks,
        "truth": truth,
        "motion": motion,
        "label_format": label_format,
        "first_frame": first_frame,
        "frames": frames,
        "columns": columns,
        "size": size,
        "classes": classes,
        "frame": frame,
        "scene": scene,
        "role": role,
        "into": into,
        "sidecar": sidecar,
        "force": force,
    }
    with common.Talk(quiet, verbose).open() as talk:
        work: LogWork[IngestResult] = LogWork(
            "ingest",
            mcaptrack.ingest,
            given,
            lambda _, done: _print(done, talk),
            _as_json,
            _line,
            names_output=not into,
        )
        results, totals = process(_named(sources), work, talk, output)
    if json:
        common.print_json({"results": [_as_json(done) for done in results], **totals})
    if any(done.lost for done in results):
        raise typer.Exit(common.LOST)


def _named(sources: Sequence[Location]) -> list[NamedLog]:
    """Return inputs, each once, with the names of their logs."""
    from mcaptrack.api.ingesting import default_log
    from mcaptrack.fleet import NamedLog

    return [NamedLog(source, default_log(Path(source))) for source in dict.fromkeys(sources)]


def _print(done: IngestResult, talk: common.Talk) -> None:
    for words in done.notes:
        talk.say(words)
    for words in done.details:
        talk.detail(words)
    talk.say(f"{done.log}: {_counts(done)}")


def _line(done: IngestResult) -> str:
    """Return the result for one of many inputs in one line."""
    return "; ".join([f"{done.log} {_counts(done)}", *done.notes])


def _counts(done: IngestResult) -> str:
    return ", ".join(f"{topic} {count}" for topic, count in done.messages.items())


def _as_json(done: IngestResult) -> dict[str, Any]:
    """Return the result for one input as values of JSON."""
    return {
        "log": str(done.log),
        "messages": done.messages,
        "notes": [with_flags(words) for words in (*done.notes, *done.details)],
        "lost": [with_flags(words) for words in done.lost],
        **({"changes": done.changes} if done.changes is not None else {}),
    }
