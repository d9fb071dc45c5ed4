"""Fuse the detections of several cameras."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Annotated, Final

import mcaptrack
from mcaptrack.api.common import clock_offsets, split_names
from mcaptrack.api.declared import Option, declared
from mcaptrack.api.options import (
    FILES,
    Cameras,
    ClockOffsets,
    EachLog,
    Force,
    Output,
    Reports,
    Sidecar,
    Views,
    chooser,
    no_progress,
)
from mcaptrack.errors import McaptrackError
from mcaptrack.transforms import FUSION, Transform
from mcaptrack.transforms.fuse import FootFuser

if TYPE_CHECKING:
    from pathlib import Path

    from mcaptrack import log as logs
    from mcaptrack import pipeline
    from mcaptrack.pipeline.several import Say
    from mcaptrack.sources.fixed_frame import BoxesRead

#: The parameters of the usual fuser.
_OPTIONS: Final = ("max_sigma", "max_distance_m", "min_score", "noise", "noise_m")


def _of_feet(name: str) -> Option:
    """The option for a parameter of the usual fuser, which declares its range and its help."""
    (about,) = (field.metadata for field in fields(FootFuser) if field.name == name)
    text = about["help"]
    return Option(
        "", about["least"], about["most"], tuning=True, is_set=not about["flag"], help=f"{text[:1].upper()}{text[1:]}."
    )


@declared(
    most_used=("to", "cameras", "clock_offset_s", "min_score", "output", "force"),
    printed_by="mcaptrack.cli.running:Fuse",
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
    from mcaptrack import pipeline
    from mcaptrack.api.running import Where, change, transform_of

    names = split_names("cameras", cameras if isinstance(cameras, str) else cameras or None)
    values = dict(zip(_OPTIONS, (max_sigma, max_distance_m, min_score, noise, noise_m), strict=True))
    changed = {name: value for name, value in values.items() if value != getattr(FootFuser, name)}
    chosen = transform_of(FUSION.name, fuser, changed)
    offsets = clock_offsets(clock_offset_s)
    if not to.strip("/") or not to.isprintable() or "/" in to.strip("/"):
        raise McaptrackError(f"`to={to!r}` is no name of a scene; give one such as world")

    def act(opened: logs.Log, target: Path | None, say: Say, boxes: BoxesRead) -> tuple[str, pipeline.Report]:
        return pipeline.fuse_cameras(opened, names, to.strip("/"), chosen, offsets, target, progress, views=views)

    return change(Where(log, None, None, output, sidecar, force), act, progress, None)
