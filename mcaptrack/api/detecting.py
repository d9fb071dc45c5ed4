"""Run a stage that reads pictures: detect, motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated

from mcaptrack.api.checked import declared
from mcaptrack.api.declared import PYTHON_ONLY
from mcaptrack.api.options import Camera, EachLog, Force, Output, Reports, Sidecar, To, Topic, Value, no_progress
from mcaptrack.transforms import Transform

if TYPE_CHECKING:
    from mcaptrack.api.running import RunResult

#: Transforms of other stages, for channels that are missing.
Stages = Annotated[Mapping[str, str | Transform] | None, PYTHON_ONLY]


@declared(most_used=("detector", "threshold", "classes", "min_score", "output", "topic", "to", "camera", "force"))
def detect(
    log: EachLog,
    *,
    detector: str | Transform | None = None,
    topic: Topic = None,
    to: To = None,
    camera: Camera = None,
    output: Output = None,
    sidecar: Sidecar = None,
    force: Force = False,
    stages: Stages = None,
    progress: Reports = no_progress,
    **options: Value,
) -> RunResult:
    """Detect what moves in the video of a log.

    Parameters
    ----------
    log : path
        The log.
    detector : str or Transform, optional
        "median" (the default), "knn", "onnx:FILE", "yolox-nano" or another name that
        `models` lists, the name of an installed detector, "module:Class", or a transform.
    topic : str, optional
        Read this channel instead of the usual one, /camera/video.
    to : str, optional
        Write to this channel instead of the usual one, /camera/detections.
    camera : str, optional
        Name of the camera, if the log has several.
    output : path, optional
        Write to this file instead; the log stays unchanged.
    sidecar : bool, optional
        Write into LOG.results.mcap beside the log (True) or into the log (False). By default beside recordings that
        ROS tools read, otherwise into the log.
    force : bool, default False
        Overwrite ``output`` if it exists.
    stages : mapping of str to str or Transform, optional
        Transforms, or their names, by stage, for channels that are missing and have to be made first.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.
    **options
        Options of the detector; `mcaptrack detect --help` lists them.

    Returns
    -------
    RunResult
        What was made: ``rows`` has the number of detections.

    Raises
    ------
    McaptrackError
        If the log cannot be read or written, if there is nothing to start from, or for an option that does not exist.

    Examples
    --------
    On the command line:

        mcaptrack detect log.mcap --detector median

    >>> import mcaptrack
    >>> mcaptrack.detect("log.mcap", detector="knn", output="boxes.mcap").stages
    ('detect',)

    """
    from mcaptrack.api.running import run_stage, transform_of

    return run_stage(
        "detect",
        transform_of("detect", detector, options),
        log,
        topic=topic,
        to=to,
        camera=camera,
        output=output,
        sidecar=sidecar,
        force=force,
        stages=stages,
        progress=progress,
    )


@declared(most_used=("output", "topic", "to", "camera", "force"))
def motion(
    log: EachLog,
    *,
    transform: Annotated[Transform | None, PYTHON_ONLY] = None,
    topic: Topic = None,
    to: To = None,
    camera: Camera = None,
    output: Output = None,
    sidecar: Sidecar = None,
    force: Force = False,
    stages: Stages = None,
    progress: Reports = no_progress,
    **options: Value,
) -> RunResult:
    """Estimate how the camera moves, from picture to picture.

    Trackers move their predictions by it. ``run`` estimates it where it is needed: for boxes of a detector that takes
    any camera.

    Parameters
    ----------
    log : path
        The log.
    transform : Transform, optional
        The transform to use instead of ``mcaptrack.transforms.EstimateMotion``.
    topic : str, optional
        Read this channel instead of the usual one, /camera/video.
    to : str, optional
        Write to this channel instead of the usual one, /camera/motion.
    camera : str, optional
        Name of the camera, if the log has several.
    output : path, optional
        Write to this file instead; the log stays unchanged.
    sidecar : bool, optional
        Write into LOG.results.mcap beside the log (True) or into the log (False). By default beside recordings that
        ROS tools read, otherwise into the log.
    force : bool, default False
        Overwrite ``output`` if it exists.
    stages : mapping of str to str or Transform, optional
        Transforms, or their names, by stage, for channels that are missing and have to be made first.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.
    **options
        Options such as ``mask_boxes``; `mcaptrack motion --help` lists them.

    Returns
    -------
    RunResult
        What was made: ``rows`` has the number of pictures.

    Raises
    ------
    McaptrackError
        If the log cannot be read or written, if it has no pictures, or for an option that does not exist.

    Examples
    --------
    On the command line:

        mcaptrack motion log.mcap

    >>> import mcaptrack
    >>> mcaptrack.motion("log.mcap", output="motion.mcap").stages
    ('motion',)

    """
    from mcaptrack.api.running import run_stage, transform_of

    return run_stage(
        "motion",
        transform_of("motion", transform, options),
        log,
        topic=topic,
        to=to,
        camera=camera,
        output=output,
        sidecar=sidecar,
        force=force,
        stages=stages,
        progress=progress,
    )
