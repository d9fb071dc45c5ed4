"""Run a stage that reads rows: track, sample, predict, retrack. Inputs that are missing are made first."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Literal

from mcaptrack.api.declared import PYTHON_ONLY, Option, declared
from mcaptrack.api.options import (
    Camera,
    EachLog,
    Force,
    Frame,
    Output,
    Reports,
    Sidecar,
    To,
    Topic,
    Value,
    no_progress,
)
from mcaptrack.choices import Mode
from mcaptrack.errors import McaptrackError
from mcaptrack.transforms import PROFILES, Transform

if TYPE_CHECKING:
    from mcaptrack.api.running import RunResult


# Run a stage that reads pictures: detect, motion.


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


@declared(most_used=("tracker", "max_age_s", "min_hits_s", "min_iou", "min_score", "output", "topic", "to", "force"))
def track(
    log: EachLog,
    *,
    tracker: str | Transform | None = None,
    topic: Topic = None,
    to: To = None,
    camera: Camera = None,
    frame: Frame = None,
    output: Output = None,
    sidecar: Sidecar = None,
    force: Force = False,
    stages: Stages = None,
    progress: Reports = no_progress,
    **options: Value,
) -> RunResult:
    """Track detections: give each object an id that it keeps from frame to frame.

    Parameters
    ----------
    log : path
        The log.
    tracker : str or Transform, optional
        "sort" (the default), "bytetrack" or "ocsort" for boxes in pictures, "ground" (the default for these) for boxes
        in space, the name of an installed tracker, "module:Class", or a
        transform.
    topic : str, optional
        Read this channel instead of the usual one, /camera/detections.
    to : str, optional
        Write to this channel instead of the usual one, /camera/tracks.
    camera : str, optional
        Name of the camera, if the log has several.
    frame : str, optional
        Bring boxes in space (3D) to this frame, such as map; by default to the root of the tree of frames.
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
        Options of the tracker, such as ``max_age_s``; `mcaptrack track --help` lists them.

    Returns
    -------
    RunResult
        What was made: ``tracks`` has the number of track ids.

    Raises
    ------
    McaptrackError
        If the log cannot be read or written, if there is nothing to start from, or for an option that does not exist.

    Examples
    --------
    On the command line:

        mcaptrack track log.mcap --tracker bytetrack

    >>> import mcaptrack
    >>> result = mcaptrack.track("log.mcap", tracker="bytetrack", max_age_s=1.0, output="tracks.mcap")
    >>> list(result.tracks)
    ['/camera/tracks']

    """
    from mcaptrack.api.running import run_stage, transform_of

    return run_stage(
        "track",
        None if tracker is None else transform_of("track", tracker, options),
        log,
        make=lambda name: transform_of("track", name, options),
        frame=frame,
        topic=topic,
        to=to,
        camera=camera,
        output=output,
        sidecar=sidecar,
        force=force,
        stages=stages,
        progress=progress,
    )


@declared(most_used=("rate_hz", "max_gap_s", "output", "topic", "to", "camera", "force"))
def sample(
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
    """Resample tracks to a fixed rate and project them to the ground plane.

    Parameters
    ----------
    log : path
        The log.
    transform : Transform, optional
        The transform to use instead of ``mcaptrack.transforms.Sample``.
    topic : str, optional
        Read this channel instead of the usual one, /camera/tracks.
    to : str, optional
        Write to this channel instead of the usual one, /camera/samples.
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
        Options such as ``rate_hz``; `mcaptrack sample --help` lists them.

    Returns
    -------
    RunResult
        What was made.

    Raises
    ------
    McaptrackError
        If the log cannot be read or written, if there is nothing to start from, or for an option that does not exist.

    Examples
    --------
    On the command line:

        mcaptrack sample log.mcap --rate-hz 2.5

    >>> import mcaptrack
    >>> mcaptrack.sample("log.mcap", rate_hz=5.0, output="samples.mcap").channels
    ('/camera/samples',)

    """
    from mcaptrack.api.running import run_stage, transform_of

    return run_stage(
        "sample",
        transform_of("sample", transform, options),
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


@declared(most_used=("predictor", "horizon_s", "min_history", "output", "topic", "to", "camera", "force"))
def predict(
    log: EachLog,
    *,
    predictor: Annotated[str | Transform | None, PYTHON_ONLY] = None,
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
    """Predict the future positions of tracks, with covariance.

    Parameters
    ----------
    log : path
        The log.
    predictor : str or Transform, optional
        "red" (the default), "social" (looks at other people), "kalman", "holt-cv", "cv", "lstm" (less exact than "cv"),
        "red:FILE", "onnx:FILE", the name of an installed predictor, or "module:Class"; or a transform.
    topic : str, optional
        Read this channel instead of the usual one, /camera/samples.
    to : str, optional
        Write to this channel instead of the usual one, /camera/predictions.
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
        Options such as ``horizon_s``; `mcaptrack predict --help` lists them.

    Returns
    -------
    RunResult
        What was made.

    Raises
    ------
    McaptrackError
        If the log cannot be read or written, if there is nothing to start from, or for an option that does not exist.

    Examples
    --------
    On the command line:

        mcaptrack predict log.mcap --predictor cv

    >>> import mcaptrack
    >>> mcaptrack.predict("log.mcap", predictor="kalman", output="predictions.mcap").channels
    ('/camera/predictions',)

    """
    from mcaptrack.api.running import run_stage, transform_of

    return run_stage(
        "predict",
        transform_of("predict", predictor, options),
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


@declared(most_used=("profile", "mode", "retracker", "predictor", "max_age_s", "output", "topic", "to", "force"))
def retrack(
    log: EachLog,
    *,
    retracker: str | Transform | None = None,
    profile: Annotated[Literal["default", "paper", "authors"] | None, Option(tuning=True, shown="default")] = None,
    mode: Annotated[Mode, Option(tuning=True)] = "both",
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
    """Re-track by prediction: link and repair tracks, and leave out false ones.

    Parameters
    ----------
    log : path
        The log.
    retracker : str or Transform, optional
        "likelihood" (the default), "consistency", the name of an installed re-tracker, "module:Class", or a transform.
    profile : {"default", "paper", "authors"}, optional
        Values of all parameters: mcaptrack's own (default), the paper's, or those of its authors' program.

        They name the re-tracker, too. The paper is Yu and Zhou, IROS 2021.
    mode : {"both", "offline", "online"}, default "both"
        Write tracks that use the whole log (offline), the past alone (online), or both.
    topic : str, optional
        Read this channel instead of the usual one, /camera/samples.
    to : str, optional
        Write to this channel instead of the usual one, /camera/retracks.
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
        Options that differ from the profile; `mcaptrack retrack --help` lists them.

    Returns
    -------
    RunResult
        What was made: ``tracks`` has the number of track ids.

    Raises
    ------
    McaptrackError
        If the log cannot be read or written, if there is nothing to start from, or for an option that does not exist.

    Examples
    --------
    On the command line:

        mcaptrack retrack log.mcap --profile authors

    >>> import mcaptrack
    >>> result = mcaptrack.retrack("log.mcap", profile="paper", output="retracks.mcap")
    >>> result.channels[:2]
    ('/camera/retracks', '/camera/retracks/online')

    """
    from mcaptrack.api.running import run_stage, transform_of

    if profile is not None and retracker is not None:
        raise McaptrackError(f"the profile {profile} names a retracker; give one of them")
    if retracker is None:
        retracker = PROFILES[profile or "default"]
    return run_stage(
        "retrack",
        transform_of("retrack", retracker, options),
        log,
        mode=mode,
        topic=topic,
        to=to,
        camera=camera,
        output=output,
        sidecar=sidecar,
        force=force,
        stages=stages,
        progress=progress,
    )
