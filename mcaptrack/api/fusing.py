"""Fuse the detections of several cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api.checked import checked
from mcaptrack.api.common import Notes, clock_offsets, split_names
from mcaptrack.api.options import PathLike, Progress, no_progress
from mcaptrack.api.running import RunResult, Where, change, transform_of
from mcaptrack.errors import McaptrackError
from mcaptrack.sources.fixed_frame import BoxesRead
from mcaptrack.transforms import FUSION, Transform
from mcaptrack.transforms.fuse import FootFuser
from mcaptrack.transforms.protocol import LARGEST

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
