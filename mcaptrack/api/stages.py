"""Run one stage on a log: detect, motion, track, sample, predict, retrack; or write the events of its tracks.

Inputs of a stage that are missing are made first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Literal

import mcaptrack
from mcaptrack.api.common import names_of, warn_unused
from mcaptrack.api.declared import PYTHON_ONLY, Option, PythonOnly, checked, declared
from mcaptrack.api.options import (
    FILES,
    Camera,
    ClassNames,
    Definitions,
    EachLog,
    FieldMap,
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
    Views,
    chooser,
    gate_m,
    min_iou,
    no_progress,
    similarity,
)
from mcaptrack.choices import Mode, Similarity
from mcaptrack.errors import McaptrackError
from mcaptrack.transforms import STAGES, Transform

# Run a stage that reads pictures: detect, motion.


#: Transforms of other stages.
Stages = Annotated[
    Mapping[str, str | Transform] | None,
    PythonOnly("Transforms, or their names, by stage, for channels that are missing and have to be made first."),
]


@declared(
    most_used=("detector", "threshold", "classes", "min_score", "output", "topic", "to", "camera", "force"),
    python_only=("definitions", "views"),
)
def detect(
    log: EachLog,
    *,
    detector: Annotated[str | Transform | None, chooser("detector", shown="median")] = None,
    topic: Topic = None,
    to: To = None,
    camera: Camera = None,
    output: Output = None,
    definitions: Definitions = None,
    sidecar: Sidecar = None,
    views: Views = False,
    force: Force = False,
    stages: Stages = None,
    progress: Reports = no_progress,
    **options: Value,
) -> mcaptrack.RunResult:
    """Detect people, or what a network finds, in the video of a log.

    Reads /camera/video, writes /camera/detections: one box for each person or object.

    Parameters
    ----------
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

    chosen = transform_of("detect", detector, options)
    return run_stage(
        "detect", chosen, log, topic, to, camera, output, sidecar, force, stages, progress,
        views=views, definitions=definitions,
    )  # fmt: skip


@declared(most_used=("output", "topic", "to", "camera", "force"), python_only=("sidecar",))
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
) -> mcaptrack.RunResult:
    """Estimate how the camera moves, from picture to picture.

    Reads /camera/video, writes /camera/motion: one row per picture, with the transform from the picture before, the one
    to a reference picture, and whether the camera is still, shaking or moving. Trackers move their predictions by it.
    ``run`` estimates it where it is needed: for boxes of a detector that takes any camera.

    Parameters
    ----------
    transform : Transform, optional
        The transform to use instead of ``mcaptrack.transforms.EstimateMotion``.
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

    chosen = transform_of("motion", transform, options)
    return run_stage("motion", chosen, log, topic, to, camera, output, sidecar, force, stages, progress)


@declared(
    most_used=("tracker", "max_age_s", "min_hits_s", "min_iou", "min_score", "output", "topic", "to", "force"),
    python_only=("frame", "map", "class_map", "definitions", "views"),
)
def track(
    log: EachLog,
    *,
    tracker: Annotated[str | Transform | None, chooser("tracker", shown="sort")] = None,
    topic: Topic = None,
    to: To = None,
    camera: Camera = None,
    frame: Frame = None,
    map: FieldMap = None,  # noqa: A002  # the name of the option
    class_map: ClassNames = None,
    output: Output = None,
    definitions: Definitions = None,
    sidecar: Sidecar = None,
    views: Views = False,
    force: Force = False,
    stages: Stages = None,
    progress: Reports = no_progress,
    **options: Value,
) -> mcaptrack.RunResult:
    """Track detections: give each person an id that stays.

    Reads /camera/detections, writes /camera/tracks: one row per frame for each person who is tracked and detected in
    it. Boxes in space (3D) are tracked by ``ground``, unless another tracker is named. Inputs that are missing are made
    first.

    Parameters
    ----------
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

    chosen = None if tracker is None else transform_of("track", tracker, options)
    make = partial(transform_of, "track", options=options)
    return run_stage(
        "track", chosen, log, topic, to, camera, output, sidecar, force, stages, progress,
        frame=frame, fields=map, class_map=class_map, make=make, views=views, definitions=definitions,
    )  # fmt: skip


@declared(
    most_used=("rate_hz", "max_gap_s", "output", "topic", "to", "camera", "force"), python_only=("sidecar", "views")
)
def sample(
    log: EachLog,
    *,
    transform: Annotated[Transform | None, PYTHON_ONLY] = None,
    topic: Topic = None,
    to: To = None,
    camera: Camera = None,
    output: Output = None,
    sidecar: Sidecar = None,
    views: Views = False,
    force: Force = False,
    stages: Stages = None,
    progress: Reports = no_progress,
    **options: Value,
) -> mcaptrack.RunResult:
    """Resample tracks to a fixed rate, in metres on the ground.

    Reads /camera/tracks, writes /camera/samples: one row per person and sample time; ``observed`` is false where a gap
    was interpolated. Inputs that are missing are made first.

    Parameters
    ----------
    transform : Transform, optional
        The transform to use instead of ``mcaptrack.transforms.Sample``.
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

    chosen = transform_of("sample", transform, options)
    return run_stage("sample", chosen, log, topic, to, camera, output, sidecar, force, stages, progress, views=views)


@declared(
    most_used=("predictor", "horizon_s", "output", "topic", "to", "camera", "force"), python_only=("sidecar", "views")
)
def predict(
    log: EachLog,
    *,
    predictor: Annotated[str | Transform | None, PYTHON_ONLY] = None,
    topic: Topic = None,
    to: To = None,
    camera: Camera = None,
    output: Output = None,
    sidecar: Sidecar = None,
    views: Views = False,
    force: Force = False,
    stages: Stages = None,
    progress: Reports = no_progress,
    **options: Value,
) -> mcaptrack.RunResult:
    """Predict where tracked people will be, with covariance.

    Reads /camera/samples, writes /camera/predictions: one row per track and future step, for tracks with enough past
    positions. Inputs that are missing are made first.

    Parameters
    ----------
    predictor : str or Transform, optional
        "blend" (the default: the mean of "red" and "cv"), "red", "social" (looks at other people), "kalman", "holt-cv",
        "cv", "lstm" (less exact than "cv"), "red:FILE", the name of an installed predictor, or "module:Class"; or a
        transform.
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

    chosen = transform_of("predict", predictor, options)
    return run_stage("predict", chosen, log, topic, to, camera, output, sidecar, force, stages, progress, views=views)


@declared(
    most_used=("profile", "retracker", "predictor", "max_age_s", "output", "topic", "to", "force"),
    settable=("mode",),
    python_only=("views",),
)
def retrack(
    log: EachLog,
    *,
    retracker: Annotated[str | Transform | None, chooser("retracker", shown="likelihood")] = None,
    profile: Annotated[Literal["default", "paper", "authors"] | None, Option(tuning=True, shown="default")] = None,
    mode: Annotated[Mode, Option(tuning=True)] = "both",
    topic: Topic = None,
    to: To = None,
    camera: Camera = None,
    output: Output = None,
    sidecar: Sidecar = None,
    views: Views = False,
    force: Force = False,
    stages: Stages = None,
    progress: Reports = no_progress,
    **options: Value,
) -> mcaptrack.RunResult:
    """Repair tracks by prediction: join parts, split mixed ones.

    False tracks are left out. Reads /camera/samples, writes /camera/retracks: tracks that use the whole log (offline),
    tracks that use the past alone (online), predictions from the latter, and what was decided offline, with how likely
    each decision is right. Inputs that are missing are made first.

    Parameters
    ----------
    profile : {"default", "paper", "authors"}, optional
        Values of all parameters: mcaptrack's own (default), the paper's, or those of its authors' program.

        They name the re-tracker, too. The paper is Yu and Zhou, IROS 2021.
    mode : {"both", "offline", "online"}, default "both"
        Write tracks that use the whole log (offline), the past alone (online), or both.
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
    from mcaptrack.transforms import PROFILES

    if profile is not None and retracker is not None:
        raise McaptrackError(f"the profile {profile} names a retracker; give one of them")
    if retracker is None:
        retracker = PROFILES[profile or "default"]
    chosen = transform_of("retrack", retracker, options)
    return run_stage(
        "retrack", chosen, log, topic, to, camera, output, sidecar, force, stages, progress, mode=mode, views=views
    )


@checked
def stage(
    name: str,
    log: PathLike,
    *,
    topic: str | None = None,
    to: str | None = None,
    camera: str | None = None,
    output: PathLike | None = None,
    sidecar: bool | None = None,
    force: bool = False,
    stages: Mapping[str, str | Transform] | None = None,
    progress: Progress = no_progress,
    **options: Value,
) -> mcaptrack.RunResult:
    """Run a stage by its name: one of an installed package, or of mcaptrack.

    Parameters
    ----------
    name : str
        Its name, as that of the command.
    log : path
        The log, or its URL.
    topic, to, camera, output, sidecar, force, stages, progress
        As for ``track``.
    **options
        Parameters of its transform.

    Returns
    -------
    RunResult
        What was made.

    Raises
    ------
    McaptrackError
        If there is no such stage, if the log cannot be read or written, or for an option that does not exist.

    Examples
    --------
    >>> import mcaptrack
    >>> mcaptrack.stage("sample", "log.mcap", output="samples.mcap").channels
    ('/camera/samples',)

    """
    from mcaptrack.api.running import run_stage, transform_of
    from mcaptrack.registry import find

    if name not in STAGES:
        find("stage", name)  # which says what there is
    chosen = transform_of(name, None, options)
    return run_stage(name, chosen, log, topic, to, camera, output, sidecar, force, stages, progress)


def declaration_of(name: str) -> Callable[..., mcaptrack.RunResult]:
    """Return the declaration of the command of a stage of another package, made from the docstring of its class."""
    own = STAGES[name]

    def command(
        log: EachLog,
        *,
        topic: Topic = None,
        to: To = None,
        camera: Camera = None,
        output: Output = None,
        sidecar: Sidecar = None,
        force: Force = False,
        stages: Stages = None,
        progress: Reports = no_progress,
        **options: Value,
    ) -> mcaptrack.RunResult:
        return stage(
            name, log, topic=topic, to=to, camera=camera, output=output, sidecar=sidecar, force=force, stages=stages,
            progress=progress, **options,
        )  # fmt: skip

    summary = (own.default.__doc__ or "").strip().partition("\n\n")[0]
    reads, writes = f"/camera/{own.input_topic}", f"/camera/{own.output_topic}"
    command.__doc__ = f"""{summary or f"Run the stage {name}."}

    Reads {reads}, writes {writes}. A stage of {" ".join(own.package)}.

    Parameters
    ----------
    **options
        Options of the stage.

    Returns
    -------
    RunResult
        What was made.
    """
    command.__name__ = name
    return declared()(command)


@declared(
    most_used=("topic", "similarity", "gate_m", "output", "force"),
    python_only=("sidecar",),
    heading="Results",
    printed_by="mcaptrack.cli.running:Events",
)
def events(
    log: EachLog,
    *,
    topic: Annotated[str | Sequence[str] | None, Option(FILES, shown="tracks, retracks")] = None,
    similarity: Annotated[Similarity | None, similarity("iou at the video's rate, otherwise metres")] = None,
    gate_m: Annotated[float | None, gate_m("1.0, and 2.0 for 3D boxes")] = None,
    min_iou: Annotated[float | None, min_iou("0.5")] = None,
    camera: Camera = None,
    output: Output = None,
    sidecar: Sidecar = None,
    force: Force = False,
    progress: Reports = no_progress,
) -> mcaptrack.RunResult:
    """Write begins, ends and identity switches of tracks into the log.

    Events are the begin and end of tracks, and which tracks re-tracking joined or split; if the log has /camera/truth
    also missed people, false tracks and identity switches, matched as in `mcaptrack evaluate`. They go to
    /camera/tracks/events (rows), .../events/view/log (text) and /camera/tracks/counts (totals frame by frame); for
    /camera/retracks likewise.

    Errors of predictions, against ground truth and against re-tracked tracks, go to /camera/predictions/errors and,
    frame by frame, to .../scores; for /camera/retracks/predictions likewise. With ``topic`` they are left out.
    `mcaptrack run` writes all this, too.

    Parameters
    ----------
    topic : str or sequence of str, optional
        Write events of these channels of tracks.

        By default of /camera/tracks and /camera/retracks, with the errors of predictions.

    Returns
    -------
    RunResult
        What was made: ``events`` has the number of events of each kind.

    Raises
    ------
    McaptrackError
        If the log cannot be read or written, or has no tracks.

    Examples
    --------
    On the command line:

        mcaptrack events log.mcap --similarity metres --gate-m 1

    >>> import mcaptrack
    >>> result = mcaptrack.events("log.mcap", similarity="metres", gate_m=0.5)
    >>> sorted(result.events)
    ['/camera/retracks', '/camera/tracks']

    """
    from mcaptrack.api.running import Where, work
    from mcaptrack.evaluation.events import EventOptions
    from mcaptrack.pipeline import Job, Watch

    def plan(*_: object) -> list[Job]:
        if similarity is not None:
            unused = {"min_iou": min_iou is not None} if similarity == "metres" else {"gate_m": gate_m is not None}
            warn_unused(f"ground truth and tracks are compared by {similarity}", **unused)
        return []

    watch = Watch(EventOptions(similarity, gate_m, min_iou), topics=names_of(topic), again=True)
    return work(Where(log, camera, None, output, sidecar, force), plan, progress, finishing=(watch,), views=True)
