"""Run a stage that reads rows: track, sample, predict, retrack. Inputs that are missing are made first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api.common import Notes, clock_offsets, split_names
from mcaptrack.api.declared import PYTHON_ONLY, Option, checked, declared
from mcaptrack.api.options import (
    Camera,
    EachLog,
    Force,
    Frame,
    Output,
    PathLike,
    Progress,
    Reports,
    Sidecar,
    To,
    Topic,
    Value,
    no_progress,
)
from mcaptrack.api.running import RunResult, Where, change, transform_of
from mcaptrack.choices import Mode
from mcaptrack.errors import McaptrackError
from mcaptrack.sources.fixed_frame import BoxesRead
from mcaptrack.transforms import FUSION, PROFILES, Transform
from mcaptrack.transforms.fuse import FootFuser
from mcaptrack.transforms.protocol import LARGEST

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
        Options of the detector; `mcaptrack detect --help-all` lists them.

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
        Options such as ``mask_boxes``; `mcaptrack motion --help-all` lists them.

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
        Options of the tracker, such as ``max_age_s``; `mcaptrack track --help-all` lists them.

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
        Options such as ``rate_hz``; `mcaptrack sample --help-all` lists them.

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
        Options such as ``horizon_s``; `mcaptrack predict --help-all` lists them.

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
        Options that differ from the profile; `mcaptrack retrack --help-all` lists them.

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


# Fuse the detections of several cameras.


#: The parameters of the usual fuser.
_OPTIONS: Final = ("max_sigma", "max_distance_m", "min_score", "noise", "noise_m")


@checked(
    max_sigma=(0.0, 100.0),
    max_distance_m=(0.0, LARGEST),
    min_score=(0.0, 1.0),
    noise=(0.001, 1.0),
    noise_m=(0.001, 100.0),
)
def fuse(
    log: PathLike,
    *,
    cameras: str | Sequence[str] | None = None,
    to: str = "world",
    fuser: str | Transform = "feet",
    max_sigma: float = FootFuser.max_sigma,
    max_distance_m: float = FootFuser.max_distance_m,
    min_score: float = FootFuser.min_score,
    noise: float = FootFuser.noise,
    noise_m: float = FootFuser.noise_m,
    clock_offset_s: Mapping[str, float] | None = None,
    output: PathLike | None = None,
    sidecar: bool | None = None,
    force: bool = False,
    progress: Progress = no_progress,
) -> RunResult:
    """Fuse the detections of several cameras with one ground to detections of the whole scene.

    Boxes that stand at the same place are joined, at most one of each camera. The score is the probability that a
    person is there. ``mcaptrack.run(log, camera="world")`` tracks them.

    Parameters
    ----------
    log : path
        The log, with detections and a measured ground plane of each camera, all in the same metres.
    cameras : str or sequence of str, optional
        Names of the cameras to fuse, also with commas between them; by default all that have what is needed.
    to : str, default "world"
        Name of the scene: results are written as those of a camera with this name.
    fuser : str or Transform, default "feet"
        The fuser: a built-in name, the name of an installed one, "module:Class", or a transform of sightings to
        detections, with own parameters. The parameters below are those of "feet".
    max_sigma : float, default 3.0
        Boxes are joined if their feet are at most so many standard deviations apart.
    max_distance_m : float, default 1.2
        Boxes are joined if their feet are at most this far apart.
    min_score : float, default 0.5
        Leave out places where a person is less probable.
    noise : float, default 0.04
        Noise of the lower edges of boxes, as a share of their heights.
    noise_m : float, default 0.1
        Noise of the ground planes in metres.
    clock_offset_s : mapping of str to float, optional
        How many seconds the times of a camera are late, by its name; those of others are estimated from people who
        walk.
    output : path, optional
        Write to this file instead; the log stays unchanged.
    sidecar : bool, optional
        Write into LOG.results.mcap beside the log (True) or into the log (False). By default beside recordings that
        ROS tools read, otherwise into the log.
    force : bool, default False
        Overwrite ``output`` if it exists.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    RunResult
        What was made: /world/detections, and /world/detections/sightings with the boxes that each was made of.

    Raises
    ------
    McaptrackError
        If the log cannot be read or written, or if no camera has detections and a measured ground plane.

    Examples
    --------
    >>> import mcaptrack
    >>> mcaptrack.fuse("log.mcap", output="fused.mcap").channels
    ('/world/detections', '/world/detections/sightings')

    """
    names = split_names("cameras", cameras if isinstance(cameras, str) else cameras or None)
    values = dict(zip(_OPTIONS, (max_sigma, max_distance_m, min_score, noise, noise_m), strict=True))
    changed = {name: value for name, value in values.items() if value != getattr(FootFuser, name)}
    chosen = transform_of(FUSION.name, fuser, changed)
    offsets = clock_offsets(clock_offset_s)
    if not to.strip("/") or not to.isprintable() or "/" in to.strip("/"):
        raise McaptrackError(f"`to={to!r}` is no name of a scene; give one such as world")

    def act(opened: logs.Log, target: Path | None, notes: Notes, boxes: BoxesRead) -> tuple[str, pipeline.Report]:
        return pipeline.fuse_cameras(opened, names, to.strip("/"), chosen, offsets, target, progress)

    return change(Where(log, None, None, output, sidecar, force), act, progress, None)
