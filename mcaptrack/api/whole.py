"""Run all stages on a log, and write events of tracks."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api.common import as_location, as_path, log_location, names_of, optional_path, split_names, warn_unused
from mcaptrack.api.declared import checked
from mcaptrack.api.options import PathLike, Progress, no_progress
from mcaptrack.api.running import Fusing, RunResult, Where, transform_of, transforms_of, work
from mcaptrack.api.several import unfitting
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.events import EventOptions
from mcaptrack.evaluation.zones import ZoneOptions
from mcaptrack.files import publish_bytes, refuse_overwrite
from mcaptrack.geometry.zones import Zone
from mcaptrack.location import Location, local_name
from mcaptrack.pipeline import Job, PlaneChoice, Watch, ZoneWatch
from mcaptrack.sources.zones import parse_zones, read_zones
from mcaptrack.transforms import FUSION, STAGES, Transform
from mcaptrack.viewing.zones_page import zones_page

# Count visits of zones and crossings of lines.


_PAGE: Final = ".zones.html"

#: Zones and lines: a file of GeoJSON, or its content.
ZonesLike = PathLike | Mapping[str, Any]


def zones_of(source: ZonesLike | None) -> tuple[Zone, ...]:
    """Return the zones of a file, or of GeoJSON; none of None. Raises McaptrackError if they can't be read."""
    if source is None:
        return ()
    if isinstance(source, Mapping):
        try:
            return parse_zones(dict(source))
        except McaptrackError as error:
            raise McaptrackError(f"`zones=`: {error}") from None
    return read_zones(as_path(source))


@checked(margin_m=(0, 100), max_gap_s=(0, 1e6))
def zones(
    log: PathLike,
    *,
    zones: ZonesLike | None = None,
    topic: str | Sequence[str] | None = None,
    margin_m: float | None = None,
    max_gap_s: float | None = None,
    camera: str | None = None,
    output: PathLike | None = None,
    sidecar: bool | None = None,
    force: bool = False,
    progress: Progress = no_progress,
) -> RunResult:
    """Count visits of zones and crossings of lines by the tracks of a log, and write them into the log.

    Parameters
    ----------
    log : path
        The log.
    zones : path or mapping, optional
        A file of GeoJSON, or its content: Polygons are zones, LineStrings are lines, in "units" of "metres" or
        "pixels". By default those that the log was counted with before.
    topic : str or sequence of str, optional
        Count these channels of tracks. By default /camera/tracks, the re-tracked tracks at the rate of the video,
        /camera/truth, and those that were counted before.
    margin_m : float, optional
        A track changes sides where it is farther than this from an edge, so that noise at the edge counts once; by
        default 0.25, at most half of what a narrow zone has room for.
    max_gap_s : float, optional
        A track that is not seen for longer ends its visit; by default 4.
    camera : str, optional
        Name of the camera, if the log has several.
    output : path, optional
        Write to this file instead; the log stays unchanged.
    sidecar : bool, optional
        Write into LOG.results.mcap beside the log (True) or into the log (False). By default beside recordings that
        ROS tools read, otherwise into the log.
    force : bool, default False
        Count again also what is up to date, and overwrite ``output`` if it exists.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    RunResult
        What was made; ``zones`` has the totals by the topic of the tracks.

    Raises
    ------
    McaptrackError
        If the log or the zones cannot be read, if there are no tracks, or none with positions in the units of a zone.

    Examples
    --------
    >>> import mcaptrack
    >>> square = [[-2, -2], [2, -2], [2, 2], [-2, 2], [-2, -2]]
    >>> geometry = {"type": "Polygon", "coordinates": [square], "units": "metres"}
    >>> result = mcaptrack.zones("log.mcap", zones=geometry)
    >>> [total.zone for total in result.zones["/camera/tracks"]]
    ['zone 1']

    """
    wanted, usual = zones_of(zones), ZoneOptions()
    options = None
    if margin_m is not None or max_gap_s is not None:
        changed = {"margin_m": margin_m, "max_gap_s": max_gap_s}
        options = ZoneOptions(
            **{name: getattr(usual, name) if value is None else value for name, value in changed.items()}
        )
    elif zones is not None:
        options = usual

    def plan(opened: logs.Log, prefix: str, *_: object) -> list[Job]:
        if not wanted and not pipeline.counted_zones(opened, prefix):
            raise McaptrackError(f"{opened.path} was not counted yet; give a file of GeoJSON with `zones=`")
        return []

    watch = ZoneWatch(wanted, names_of(topic), options, force)
    return work(Where(log, camera, None, output, sidecar, force), plan, None, progress, None, zones=watch)


@checked()
def draw_zones(
    log: PathLike,
    *,
    camera: str | None = None,
    output: PathLike | None = None,
    force: bool = False,
) -> Path:
    """Write a page on which zones and lines are drawn in a browser, over a picture of the scene.

    The page needs no other file and no network. It downloads the zones as GeoJSON, in pixels of the picture; or in
    metres where the log has no pictures, over the places of its tracks.

    Parameters
    ----------
    log : path
        The log.
    camera : str, optional
        Name of the camera, if the log has several.
    output : path, optional
        Write to this file; by default LOG.zones.html beside the log.
    force : bool, default False
        Overwrite the page if it exists.

    Returns
    -------
    pathlib.Path
        The page.

    Raises
    ------
    McaptrackError
        If the log cannot be read, or has neither pictures nor tracks.

    Examples
    --------
    >>> import mcaptrack
    >>> mcaptrack.draw_zones("log.mcap").name
    'log.zones.html'

    """
    path = log_location(log)
    page = optional_path(output) or local_name(path, _PAGE)
    if page.suffix.lower() not in (".html", ".htm"):
        raise McaptrackError(f"{page} is not a name for a page; give one that ends with .html")
    refuse_overwrite(page, force)
    with logs.read(path) as opened:
        prefix = pipeline.find_camera(opened, camera)
        content = zones_page(opened, prefix, f"{path.stem}.geojson")
    publish_bytes(page, content.encode())
    return page


@checked(person_height_m=(0.1, 10))
def run(
    log: PathLike,
    *,
    topic: str | None = None,
    camera: str | Sequence[str] | None = None,
    frame: str | None = None,
    output: PathLike | None = None,
    sidecar: bool | None = None,
    events: bool | EventOptions = True,
    tables: bool = True,
    zones: ZonesLike | None = None,
    fuse: bool = True,
    force: bool = False,
    fuser: str | Transform | None = None,
    detector: str | Transform | None = None,
    tracker: str | Transform | None = None,
    retracker: str | Transform | None = None,
    predictor: str | Transform | None = None,
    camera_motion: CameraMotionUse | None = None,
    across_classes: bool | None = None,
    class_limits: str | None = None,
    fit_plane: bool | None = None,
    person_height_m: float | None = None,
    ground_frame: str | None = None,
    stages: Mapping[str, str | Transform] | None = None,
    follows: PathLike | Sequence[PathLike] | None = None,
    progress: Progress = no_progress,
) -> RunResult:
    """Run all stages that are missing or out of date, then write events, views, layouts and tables.

    Of a log with several cameras all are run, one after the other. Those that have a measured ground plane are then
    fused to a scene, as ``fuse`` does, and the scene is run, too.

    Channels that are up to date stay as they are; those that are out of date are made again with the options that
    they had.

    Parameters
    ----------
    log : path
        The log.
    topic : str, optional
        Begin with the pictures, or the detections, of this channel.
    camera : str or sequence of str, optional
        Names of the cameras to run, also with commas between them; by default all that have pictures or boxes. One
        name runs this camera, or this scene, alone.
    frame : str, optional
        Bring boxes in space (3D) to this frame. By default as before, or to the root of the tree of frames, such as
        map.
    output : path, optional
        Write to this file instead; the log stays unchanged.
    sidecar : bool, optional
        Write into LOG.results.mcap beside the log (True) or into the log (False). By default beside recordings that
        ROS tools read, otherwise into the log.
    events : bool or EventOptions, default True
        Write events of tracks and errors of predictions, and how tracks are matched with the ground truth for them.
    tables : bool, default True
        Write Parquet tables beside the log.
    zones : path or mapping, optional
        Count visits of zones and crossings of lines, of a file of GeoJSON, or of its content (see ``zones``). By
        default those that the log was counted with before, if any.
    fuse : bool, default True
        Whether several cameras with measured ground planes are fused to a scene, ``/world``, and scenes that were made
        before are brought up to date.
    force : bool, default False
        Run everything again, and overwrite ``output`` if it exists.
    fuser : str or Transform, optional
        Fuse cameras by this one, also where another one was used before: a name, or a transform, as for ``fuse``.
    detector, tracker, retracker, predictor : str or Transform, optional
        Use this one, also where another one was used before: a built-in name, the name of an installed one,
        "module:Class", or a transform.
    camera_motion : {"auto", "on", "off"}, optional
        Whether tracks are compensated for the motion of the camera: if it moves or has cuts, also if it only shakes,
        or never. By default as before, and "auto" where there are no tracks yet.
    across_classes : bool, optional
        Whether a track may continue with a detection, and after re-tracking with a track, of another class. By default
        as before, and False where there are no tracks yet.
    class_limits : str, optional
        Limits of the motion of classes instead of those of the table, for all stages: NAME=SPEED:DRIFT:NOISE:GATE with
        commas between several, as in "car=40,pedestrian=4::0.1". By default as before.
    fit_plane : bool, optional
        Whether to estimate the ground plane from the boxes of a learned detector where none is given. By default as
        before, and True where there is none yet.
    person_height_m : float, optional
        Mean height of people in metres, for a ground plane that is not given. By default as before, or 1.7.
    ground_frame : str, optional
        Frame of reference with the ground as z = 0, for a camera on a robot that has a calibration and transforms. By
        default as before, or the fixed frame.
    stages : mapping of str to str or Transform, optional
        Transforms, or their names, by stage, for channels that are missing; with ``force`` also for those that exist.
    follows : path or sequence of path, optional
        The log before this one, of the same camera: people who are in the picture at the cut keep their ids, and others
        get ids that it doesn't have. Of several logs, in order, it is the one before this one.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    RunResult
        What was made; ``summary`` has what the log holds now, and its scores if it has ground truth.

    Raises
    ------
    McaptrackError
        If the log cannot be read or written, or if there is nothing to start from.

    Examples
    --------
    >>> import mcaptrack
    >>> from mcaptrack.transforms import ByteTrack
    >>> result = mcaptrack.run("log.mcap", output="done.mcap", tracker=ByteTrack(max_age_s=1.0))
    >>> result.summary.tracks > 0
    True

    """
    names = tuple(dict.fromkeys(split_names("camera", camera)))
    if len(names) > 1 and topic is not None:
        raise McaptrackError(f"`topic={topic!r}` is of one camera, and `camera=` names {len(names)}; leave one out")
    named = {"detector": detector, "tracker": tracker, "retracker": retracker, "predictor": predictor}
    chosen = {kind: choice for kind, choice in named.items() if choice is not None}
    transforms = transforms_of(stages)
    transforms |= {s.name: transform_of(s.name, chosen[s.option], {}) for s in STAGES.values() if s.option in chosen}

    joins = None if fuser is None else transform_of(FUSION.name, fuser, {})

    plane = PlaneChoice(fit_plane, person_height_m, frame, ground_frame)
    settings = {"camera_motion": camera_motion, "across_classes": across_classes, "class_limits": class_limits}
    shared = {name: value for name, value in settings.items() if value is not None}

    def plan(
        opened: logs.Log,
        prefix: str,
        say: Callable[[str], None],
        changed: Collection[str],
        renewed: Collection[str],
    ) -> list[Job]:
        others = unfitting(opened, prefix, transforms, say) if len(names) != 1 and topic is None else set()
        kept = {stage: transform for stage, transform in transforms.items() if stage not in others}
        options = chosen.keys() - {STAGES[stage].option for stage in others}
        return pipeline.plan_all(
            opened, prefix, say, topic, kept, force, options, shared, plane, frame or "", changed, renewed
        )

    options = events if isinstance(events, EventOptions) else EventOptions()
    watch = Watch(options, force=force) if events else None
    given_zones = zones_of(zones)
    counted = ZoneWatch(given_zones, options=ZoneOptions() if given_zones else None, force=force)
    where = Where(log, names[0] if len(names) == 1 else None, topic, output, sidecar, force)
    earlier = _log_before(as_location(log), follows)
    return work(where, plan, watch, progress, tables, plane, counted, fuses=Fusing(names, fuse, joins), follows=earlier)


def _log_before(log: Location, follows: PathLike | Sequence[PathLike] | None) -> Location | None:
    """Return the log that a log follows; of several the one before it, None if it is the first."""
    if follows is None or isinstance(follows, str | os.PathLike):
        before = None if follows is None else as_location(follows)
    else:
        order = [as_location(log_before) for log_before in follows]
        if log not in order:
            raise McaptrackError(f"{log} is not one of the logs of `follows=`; their order says which one it follows")
        at = order.index(log)
        before = order[at - 1] if at else None
    if before is not None and before == log:
        raise McaptrackError(f"{log} can't follow itself; `follows=` is the log before it")
    return before


@checked(gate_m=(0.001, 1e6), min_iou=(0.001, 1))
def events(
    log: PathLike,
    *,
    topic: str | Sequence[str] | None = None,
    similarity: Similarity | None = None,
    gate_m: float | None = None,
    min_iou: float | None = None,
    camera: str | None = None,
    output: PathLike | None = None,
    sidecar: bool | None = None,
    force: bool = False,
    progress: Progress = no_progress,
) -> RunResult:
    """Write events of tracks (begin, end, identity switches) and errors of predictions into a log.

    Parameters
    ----------
    log : path
        The log.
    topic : str or sequence of str, optional
        Write events of these channels of tracks. By default of /camera/tracks and /camera/retracks, with the errors
        of predictions.
    similarity : {"iou", "metres", "bev-iou", "3d-iou"}, optional
        How ground truth and tracks are matched: by overlap of boxes or by distance on the ground. By default by
        overlap where tracks are at the video's rate, otherwise by distance.
    gate_m : float, optional
        Largest distance of a match in metres, by default 1.
    min_iou : float, optional
        Least overlap of a match, by default 0.5.
    camera : str, optional
        Name of the camera, if the log has several.
    output : path, optional
        Write to this file instead; the log stays unchanged.
    sidecar : bool, optional
        Write into LOG.results.mcap beside the log (True) or into the log (False).
    force : bool, default False
        Overwrite ``output`` if it exists.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

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
    >>> import mcaptrack
    >>> result = mcaptrack.events("log.mcap", similarity="metres", gate_m=0.5)
    >>> sorted(result.events)
    ['/camera/retracks', '/camera/tracks']

    """

    def plan(*_: object) -> list[Job]:
        if similarity is not None:
            unused = {"min_iou": min_iou is not None} if similarity == "metres" else {"gate_m": gate_m is not None}
            warn_unused(f"ground truth and tracks are compared by {similarity}", **unused)
        return []

    watch = Watch(EventOptions(similarity, gate_m, min_iou), topics=names_of(topic), again=True)
    return work(Where(log, camera, None, output, sidecar, force), plan, watch, progress, None)
