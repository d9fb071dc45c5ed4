"""Correct the ground planes of cameras by the people that they see together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api.common import Notes, as_location, clock_offsets, split_names, warn_unused, warnings_about
from mcaptrack.api.declared import checked
from mcaptrack.api.options import PathLike, Progress, no_progress
from mcaptrack.api.running import Where, change, warn_stale
from mcaptrack.location import Location
from mcaptrack.notices import Notice
from mcaptrack.pipeline.calibrating import CorrectedPlanes, Refined, calibrate_cameras, changes_of, write_changes
from mcaptrack.schema.provenance import REFINE
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
    is_dry_run: bool
    stale: tuple[str, ...]
    written_to: Location | None
    written_because: str
    warnings: tuple[Notice, ...]
    seconds: float


@checked()
def calibrate(
    log: PathLike,
    *,
    cameras: str | Sequence[str] | None = None,
    reference: str | Sequence[str] | None = None,
    clock_offset_s: Mapping[str, float] | None = None,
    dry_run: bool = False,
    output: PathLike | None = None,
    sidecar: bool | None = None,
    force: bool = False,
    progress: Progress = no_progress,
) -> CalibrateResult:
    """Correct the ground planes of cameras by the people that they see together.

    Each camera is compared with what the others agree on. The plane of one that is off is corrected by a shift, a
    rotation, a scale, or more, as far as that holds at other times than those to which it was fitted. The plane that
    was given stays in the log; the corrected one is used instead.

    Parameters
    ----------
    log : path
        The log, with detections and a measured ground plane of each camera, all of one place.
    cameras : str or sequence of str, optional
        Names of the cameras to compare, also with commas between them; by default all that have what is needed.
    reference : str or sequence of str, optional
        Cameras that are right: their planes stay, and the others are brought to them. By default what most cameras
        agree on is right; with two cameras one has to be named.
    clock_offset_s : mapping of str to float, optional
        How many seconds the times of a camera are late, by its name; those of others are estimated from people who
        walk.
    dry_run : bool, default False
        Only compare; nothing is written.
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
    CalibrateResult
        What was found about each camera, and which planes were corrected.

    Raises
    ------
    McaptrackError
        If the log cannot be read or written, if fewer than two cameras have detections and a measured ground plane, or
        if there are two and none is a reference.

    Examples
    --------
    >>> import mcaptrack
    >>> result = mcaptrack.calibrate("log.mcap", dry_run=True)  # doctest: +SKIP
    >>> result.cameras["left"].correction  # doctest: +SKIP
    'rigid'

    """
    names = split_names("cameras", cameras if isinstance(cameras, str) else cameras or None)
    right = split_names("reference", reference if isinstance(reference, str) else reference or None)
    offsets = clock_offsets(clock_offset_s)

    def compare(opened: logs.Log) -> Any:
        def report(done: int, total: int) -> None:
            progress(REFINE, done, total)

        return calibrate_cameras(opened, names, right, offsets, report)

    outcome: list[Any] = []

    def act(opened: logs.Log, target: Path | None, notes: Notes, boxes: BoxesRead) -> tuple[str, pipeline.Report]:
        refined, offset_s, planes = compare(opened)
        before = {topic for topic in opened.channels if pipeline.is_stale(opened, topic)}
        changes = changes_of(opened, refined, planes)
        is_new = write_changes(opened, changes, target)
        outcome.extend((refined, offset_s, planes, changes, before))
        stages = [REFINE] if is_new or target is not None else []
        return "", pipeline.Report(stages=stages)

    with warnings_about(log) as warnings:
        if dry_run:
            unused = {"output": output is not None, "sidecar": sidecar is not None, "force": force}
            warn_unused("a dry run writes nothing", **unused)
            path = as_location(log)
            with logs.read(path) as opened:
                refined, offset_s, planes = compare(opened)
                changes = changes_of(opened, refined, planes)
            return _result(path, refined, offset_s, planes, changes, is_dry_run=True, warnings=warnings)
        done = change(Where(log, None, None, output, sidecar, force), act, progress, None)
        refined, offset_s, planes, changes, before = outcome
        with logs.read(done.log) as opened:
            stale = sorted(
                topic for topic in opened.channels if topic not in before and pipeline.is_stale(opened, topic)
            )
            named = {topic: pipeline.camera_to_name(opened, topic) for topic in stale}
        for topic in stale:
            warn_stale(topic, done.log, named)
    return _result(
        done.log, refined, offset_s, planes, changes, tuple(stale), done.written_to, done.written_because, warnings,
        done.seconds,
    )  # fmt: skip


def _result(
    path: Location,
    refined: Sequence[Refined],
    offset_s: Mapping[str, float],
    planes: Mapping[str, Any],
    changes: CorrectedPlanes,
    stale: tuple[str, ...] = (),
    written_to: Location | None = None,
    written_because: str = "",
    warnings: Sequence[Notice] = (),
    seconds: float = 0.0,
    is_dry_run: bool = False,
) -> CalibrateResult:
    def of(camera: Refined) -> CameraCorrection:
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

    return CalibrateResult(
        log=path,
        cameras={camera.name: of(camera) for camera in refined},
        corrected=dict(changes.topics),
        unchanged=changes.unchanged,
        dropped=changes.dropped,
        is_dry_run=is_dry_run,
        stale=stale,
        written_to=written_to,
        written_because=written_because,
        warnings=tuple(dict.fromkeys(warnings)),
        seconds=seconds,
    )
