"""Correct the ground planes of cameras by the people that they see together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mcaptrack.api.common import as_location, clock_offsets, split_names, warn_unused, warnings_about
from mcaptrack.api.declared import Option, declared
from mcaptrack.api.options import (
    Cameras,
    ClockOffsets,
    EachLog,
    Force,
    Output,
    Reports,
    Sidecar,
    no_progress,
)
from mcaptrack.location import Location
from mcaptrack.notices import Notice

if TYPE_CHECKING:
    from mcaptrack.pipeline.calibrating import CorrectedPlanes, Refined
    from mcaptrack.pipeline.several import Say
    from mcaptrack.sources.fixed_frame import BoxesRead


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
    heading="Improve and repair",
    printed_by="mcaptrack.cli.calibrate:Calibrate",
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
    from mcaptrack.pipeline.calibrating import calibrate_cameras, changes_of, write_changes
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
