"""Run a stage that reads pictures: detect, motion."""

from __future__ import annotations

from collections.abc import Mapping

from mcaptrack.api.checked import checked
from mcaptrack.api.common import PathLike, Progress, no_progress
from mcaptrack.api.running import Option, RunResult, run_stage, transform_of
from mcaptrack.transforms import Transform


@checked()
def detect(
    log: PathLike,
    *,
    detector: str | Transform | None = None,
    topic: str | None = None,
    to: str | None = None,
    camera: str | None = None,
    output: PathLike | None = None,
    sidecar: bool | None = None,
    force: bool = False,
    stages: Mapping[str, str | Transform] | None = None,
    progress: Progress = no_progress,
    **options: Option,
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
    >>> import mcaptrack
    >>> mcaptrack.detect("log.mcap", detector="knn", output="boxes.mcap").stages
    ('detect',)

    """
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


@checked()
def motion(
    log: PathLike,
    *,
    transform: Transform | None = None,
    topic: str | None = None,
    to: str | None = None,
    camera: str | None = None,
    output: PathLike | None = None,
    sidecar: bool | None = None,
    force: bool = False,
    stages: Mapping[str, str | Transform] | None = None,
    progress: Progress = no_progress,
    **options: Option,
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
    >>> import mcaptrack
    >>> mcaptrack.motion("log.mcap", output="motion.mcap").stages
    ('motion',)

    """
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
