"""Fuse the detections of several cameras, and correct their ground planes by the people that they see together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import mcaptrack
from mcaptrack.api.common import as_location, split_names, warn_unused, warnings_about
from mcaptrack.api.declared import Option, declared
from mcaptrack.api.options import (
    FILES,
    EachLog,
    Force,
    Output,
    Progress,
    Reports,
    Sidecar,
    Views,
    chooser,
    no_progress,
)
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.cameras.feet import FootFuser
from mcaptrack.extensions.cameras.scenes import FUSION
from mcaptrack.location import Location
from mcaptrack.notices import Notice
from mcaptrack.transforms import Transform

if TYPE_CHECKING:
    from mcaptrack import log as logs
    from mcaptrack import pipeline
    from mcaptrack.extensions.cameras.calibrating import CorrectedPlanes, Refined
    from mcaptrack.notices import Say
    from mcaptrack.pipeline.write import Made
    from mcaptrack.sources.fixed_frame import BoxesRead

Cameras = Annotated[str | Sequence[str] | None, Option(metavar="A,B", commas=True, shown="all with a ground plane")]
ClockOffsets = Annotated[
    Mapping[str, float] | None,
    Option(
        metavar="CAMERA=SECONDS",
        shown="estimated from people who walk",
        help="How many seconds the times of a camera are late, as in front=0.3; 0 for none.",
    ),
]
#: The largest offset of a clock, a day: more is no offset, but another recording.
_MOST_OFFSET_S: Final = 86_400.0


#: The parameters of the usual fuser.
_OPTIONS: Final = ("max_sigma", "max_distance_m", "min_score", "noise", "noise_m")


def _of_feet(name: str) -> Option:
    """The option for a parameter of the usual fuser, which declares its range and its help."""
    (about,) = (field.metadata for field in fields(FootFuser) if field.name == name)
    text = about["help"]
    return Option("", about["least"], about["most"], tuning=True, help=f"{text[:1].upper()}{text[1:]}.")


@declared(
    most_used=("to", "cameras", "clock_offset_s", "min_score", "output", "force"),
    settable=tuple(field.name for field in fields(FootFuser) if field.name in _OPTIONS and not field.metadata["flag"]),
    python_only=("sidecar", "views"),
    printed_by="mcaptrack.extensions.cameras.command:Fuse",
)
def fuse(
    log: EachLog,
    *,
    cameras: Cameras = None,
    clock_offset_s: ClockOffsets = None,
    fuser: Annotated[str | Transform, chooser("fuser")] = "feet",
    max_sigma: Annotated[float, _of_feet("max_sigma")] = FootFuser.max_sigma,
    max_distance_m: Annotated[float, _of_feet("max_distance_m")] = FootFuser.max_distance_m,
    min_score: Annotated[float, _of_feet("min_score")] = FootFuser.min_score,
    noise: Annotated[float, _of_feet("noise")] = FootFuser.noise,
    noise_m: Annotated[float, _of_feet("noise_m")] = FootFuser.noise_m,
    to: Annotated[str, Option(FILES)] = "world",
    output: Output = None,
    sidecar: Sidecar = None,
    views: Views = False,
    force: Force = False,
    progress: Reports = no_progress,
) -> mcaptrack.RunResult:
    """Fuse the detections of several cameras to those of one scene.

    From /CAMERA/detections and /CAMERA/ground_plane to /world/detections: boxes that stand at the same place are
    joined, at most one of each camera, and the score is the probability that a person is there. The ground planes have
    to be in the same metres. /world/detections/sightings has the boxes that each detection was made of.

    Cameras may have other rates. A camera that sees people elsewhere than the others do, or earlier or later, is named.

    `mcaptrack run log.mcap --camera world` tracks them.

    Parameters
    ----------
    cameras : str or sequence of str, optional
        Cameras to fuse.

        Also with commas between names. By default all that have detections and a measured ground plane.
    to : str, default "world"
        Name of the scene; its channels begin with /NAME.

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
    On the command line:

        mcaptrack fuse log.mcap --cameras front,left

    >>> import mcaptrack
    >>> mcaptrack.fuse("log.mcap", output="fused.mcap").channels
    ('/world/detections', '/world/detections/sightings')

    """
    from mcaptrack.api.running import Where, change, transform_of
    from mcaptrack.extensions.cameras.fusing import fuse_cameras
    from mcaptrack.pipeline.several import write_scene

    names = split_names("cameras", cameras if isinstance(cameras, str) else cameras or None)
    values = dict(zip(_OPTIONS, (max_sigma, max_distance_m, min_score, noise, noise_m), strict=True))
    changed = {name: value for name, value in values.items() if value != getattr(FootFuser, name)}
    chosen = transform_of(FUSION, fuser, changed)
    offsets = clock_offsets(clock_offset_s)
    if not to.strip("/") or not to.isprintable() or "/" in to.strip("/"):
        raise McaptrackError(f"`to={to!r}` is no name of a scene; give one such as world")

    def act(opened: logs.Log, target: Path | None, say: Say, boxes: BoxesRead) -> tuple[str, pipeline.Report]:
        def join(prefix: str, progress: Progress) -> dict[str, Made]:
            is_chosen = bool(names)
            return fuse_cameras(opened, names, prefix, chosen, offsets, progress, is_chosen, takes_strangers=True)

        return write_scene(opened, f"/{to.strip('/')}", join, progress, target, views)

    return change(Where(log, None, None, output, sidecar, force), act, progress, None)


def clock_offsets(seconds_by_camera: Mapping[str, float] | None) -> dict[str, float]:
    """Return the offsets of clocks in seconds, by the bare names of cameras.

    Raises McaptrackError for more than a day, and for NaN.
    """
    offsets = {name.strip("/"): float(value) for name, value in (seconds_by_camera or {}).items()}
    for name, value in offsets.items():
        if not abs(value) <= _MOST_OFFSET_S:
            raise McaptrackError(f"`clock_offset_s=` has {value:g} s for {name}; a clock is late by a day at most")
    return offsets


@dataclass(frozen=True)
class CameraCorrection:
    """The comparison of a camera with the others, and the correction of its ground plane.

    Distances are of the camera's feet from where the others see the same people, at times to which the correction was
    not fitted; None if there are too few to compare.

    Attributes
    ----------
    correction : str
        The kind of correction: "shift", "rigid" (with a rotation), "similarity" (with a scale), "affine" or "full"; of
        a camera with a lens "shift", "rigid" or "pose". "" if the plane stays as it is.
    moved_m : float
        How far the correction moves the feet of people, as the root of the mean square.
    pairs : int
        The number of feet that were compared.
    median_before_m, p90_before_m : float or None
        Median and 90th percentile of the distances before.
    median_after_m, p90_after_m : float or None
        The same after.
    why : str
        The reason why nothing was corrected, or "".
    limit : str
        What the walks of people don't determine, or "".
    clock_offset_s : float
        How late the times of the camera are; this was taken off for the comparison.
    homography : tuple of float or None
        The homography of the corrected plane, row by row; None if there is no correction.

    """

    correction: str
    moved_m: float
    pairs: int
    median_before_m: float | None
    p90_before_m: float | None
    median_after_m: float | None
    p90_after_m: float | None
    why: str
    limit: str
    clock_offset_s: float
    homography: tuple[float, ...] | None


@dataclass(frozen=True)
class CalibrateResult:
    """The result of comparing the cameras of a log.

    Attributes
    ----------
    log : pathlib.Path or str
        The log that holds the corrected planes; the URL of one in a store.
    cameras : dict of str to CameraCorrection
        What was found about each camera, by name.
    corrected : dict of str to str
        The topics of corrected planes by camera; those that would be written, in a dry run.
    unchanged : tuple of str
        Corrected cameras with a plane that the log had already; it is not written again.
    dropped : tuple of str
        Topics of earlier corrections that were removed, because the cameras agree without them; those that would be
        removed, in a dry run.
    is_dry_run : bool
        Whether nothing was to be written.
    stale : tuple of str
        Topics that are out of date now, because they were made with the planes before.
    written_to : pathlib.Path, str or None
        The file that holds the corrected planes; None if nothing was written.
    written_because : str
        Why they went there, where that needs a reason.
    warnings : tuple of mcaptrack.Notice
        What was left out or looks odd.
    seconds : float
        How long it took.

    """

    log: Location
    cameras: Mapping[str, CameraCorrection]
    corrected: Mapping[str, str]
    unchanged: tuple[str, ...]
    dropped: tuple[str, ...]
    is_dry_run: bool = False
    stale: tuple[str, ...] = ()
    written_to: Location | None = None
    written_because: str = ""
    warnings: tuple[Notice, ...] = ()
    seconds: float = 0.0


@declared(
    most_used=("reference", "cameras", "dry_run", "clock_offset_s", "output", "force"),
    python_only=("sidecar",),
    heading="Improve and repair",
    printed_by="mcaptrack.extensions.cameras.command:Calibrate",
)
def calibrate(
    log: EachLog,
    *,
    cameras: Cameras = None,
    reference: Annotated[
        str | Sequence[str] | None, Option(metavar="A,B", commas=True, shown="what most cameras agree on")
    ] = None,
    clock_offset_s: ClockOffsets = None,
    dry_run: bool = False,
    output: Output = None,
    sidecar: Sidecar = None,
    force: Force = False,
    progress: Reports = no_progress,
) -> CalibrateResult:
    """Correct the ground planes of cameras that disagree.

    They are compared by the people that cameras see together. Each camera is compared with what the others agree on. If
    its feet stand elsewhere, its plane is corrected by a shift, a rotation, a scale, or more, as far as that also holds
    at other times than those to which it was fitted; those that agree stay as they are.

    /CAMERA/ground_plane stays in the log, and the corrected plane in /CAMERA/ground_plane/refined is used instead:
    `run` and `fuse` make again what was made before. `mcaptrack drop log.mcap /CAMERA/ground_plane/refined` takes it
    back.

    The log needs detections and a measured ground plane of each camera. Of two cameras ``reference`` names the right
    one.

    Parameters
    ----------
    cameras : str or sequence of str, optional
        Cameras to compare.

        Also with commas between names. By default all that have detections and a measured ground plane.
    reference : str or sequence of str, optional
        Cameras that are right: the others are brought to them.
    dry_run : bool, default False
        Only compare; write nothing.

    Returns
    -------
    CalibrateResult
        What was found about each camera, and which planes were corrected.

    Raises
    ------
    McaptrackError
        If the log cannot be read or written, if fewer than two cameras have detections and a measured ground plane, or
        if there are two and none is a reference.

    Examples
    --------
    On the command line:

        mcaptrack calibrate log.mcap --dry-run

    >>> import mcaptrack
    >>> result = mcaptrack.calibrate("log.mcap", dry_run=True)  # doctest: +SKIP
    >>> result.cameras["left"].correction  # doctest: +SKIP
    'rigid'

    """
    from mcaptrack import log as logs
    from mcaptrack import pipeline
    from mcaptrack.api.running import Where, change, warn_stale
    from mcaptrack.extensions.cameras.calibrating import calibrate_cameras, changes_of, write_changes
    from mcaptrack.schema.provenance import REFINE

    names = split_names("cameras", cameras if isinstance(cameras, str) else cameras or None)
    right = split_names("reference", reference if isinstance(reference, str) else reference or None)
    offsets = clock_offsets(clock_offset_s)

    path = as_location(log)
    outcome: list[tuple[CalibrateResult, set[str]]] = []

    def compare(opened: logs.Log) -> tuple[CalibrateResult, CorrectedPlanes]:
        def report(done: int, total: int) -> None:
            progress(REFINE, done, total)

        refined, offset_s, planes = calibrate_cameras(opened, names, right, offsets, report)
        changes = changes_of(opened, refined, planes)
        corrections = {camera.name: _correction(camera, offset_s, planes) for camera in refined}
        return CalibrateResult(path, corrections, dict(changes.topics), changes.unchanged, changes.dropped), changes

    def act(opened: logs.Log, target: Path | None, say: Say, boxes: BoxesRead) -> tuple[str, pipeline.Report]:
        result, changes = compare(opened)
        outcome.append((result, {topic for topic in opened.channels if pipeline.is_stale(opened, topic)}))
        is_new = write_changes(opened, changes, target)
        return "", pipeline.Report(stages=[REFINE] if is_new or target is not None else [])

    with warnings_about(log) as warnings:
        if dry_run:
            unused = {"output": output is not None, "sidecar": sidecar is not None, "force": force}
            warn_unused("a dry run writes nothing", **unused)
            with logs.read(path) as opened:
                result, _ = compare(opened)
            return replace(result, is_dry_run=True, warnings=tuple(dict.fromkeys(warnings)))
        done = change(Where(log, None, None, output, sidecar, force), act, progress, None)
        ((result, before),) = outcome
        with logs.read(done.log) as opened:
            stale = sorted(
                topic for topic in opened.channels if topic not in before and pipeline.is_stale(opened, topic)
            )
            warn_stale(opened, stale)
    return replace(
        result,
        log=done.log,
        stale=tuple(stale),
        written_to=done.written_to,
        written_because=done.written_because,
        warnings=tuple(dict.fromkeys(warnings)),
        seconds=done.seconds,
    )


def _correction(camera: Refined, offset_s: Mapping[str, float], planes: Mapping[str, Any]) -> CameraCorrection:
    before, after = camera.before, camera.after
    return CameraCorrection(
        correction=camera.model,
        moved_m=round(camera.moved_m, 4),
        pairs=before.pairs if before else 0,
        median_before_m=before.median_m if before else None,
        p90_before_m=before.p90_m if before else None,
        median_after_m=after.median_m if after else None,
        p90_after_m=after.p90_m if after else None,
        why=camera.why,
        limit=camera.limit,
        clock_offset_s=offset_s.get(camera.name, 0.0),
        homography=planes[camera.name].homography if camera.name in planes else None,
    )
