"""``mcaptrack fuse``: fuse the detections of several cameras."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Annotated, Any, Final

from mcaptrack.cli import common
from mcaptrack.cli.many import takes_many
from mcaptrack.cli.running import run_on_logs
from mcaptrack.cli.stages import chooser, option_of
from mcaptrack.errors import McaptrackError
from mcaptrack.transforms.fuse import FootFuser

_FIELDS: Final = {field.name: field for field in fields(FootFuser)}
_JOINING: Final = "Joining of boxes"


ClockOffsets = Annotated[
    list[str] | None,
    common.option(
        "--clock-offset-s",
        metavar="CAMERA=SECONDS",
        help="How many seconds the times of a camera are late, as in front=0.3; 0 for none.",
        show_default="estimated from people who walk",
    ),
]


def _number(name: str) -> Any:
    """Return the option for a parameter of the fuser."""
    return option_of(_FIELDS[name], f"--{name.replace('_', '-')}", _JOINING)


@common.one_line
@takes_many()
def fuse(
    logs: common.Logs,
    cameras: Annotated[
        str | None,
        common.option("--cameras", metavar="A,B", help="Cameras to fuse.", show_default="all with a ground plane"),
    ] = None,
    clock_offset_s: ClockOffsets = None,
    fuser: Annotated[str, chooser("fuser")] = "feet",
    max_sigma: Annotated[float, _number("max_sigma")] = FootFuser.max_sigma,
    max_distance_m: Annotated[float, _number("max_distance_m")] = FootFuser.max_distance_m,
    min_score: Annotated[float, _number("min_score")] = FootFuser.min_score,
    noise: Annotated[float, _number("noise")] = FootFuser.noise,
    noise_m: Annotated[float, _number("noise_m")] = FootFuser.noise_m,
    to: Annotated[
        str, common.option("--to", panel=common.FILES, help="Name of the scene; its channels begin with /NAME.")
    ] = "world",
    output: common.Output = None,
    sidecar: common.Sidecar = None,
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Fuse the detections of several cameras with one ground to detections of the whole scene.

    From /CAMERA/detections and /CAMERA/ground_plane to /world/detections: boxes that stand at the same place are
    joined, at most one of each camera, and the score is the probability that a person is there. The ground planes have
    to be in the same metres. /world/detections/sightings has the boxes that each detection was made of.

    Cameras may have other rates. A camera that sees people elsewhere than the others do, or earlier or later, is named.

    `mcaptrack run log.mcap --camera world` tracks them.

    Example: mcaptrack fuse log.mcap --cameras front,left
    """
    import mcaptrack

    shared = {"logs": logs, "output": output, "sidecar": sidecar, "force": force}
    options = {
        "cameras": cameras,
        "to": to,
        "fuser": fuser,
        "clock_offset_s": offsets_of(clock_offset_s or ()),
        "max_sigma": max_sigma,
        "max_distance_m": max_distance_m,
        "min_score": min_score,
        "noise": noise,
        "noise_m": noise_m,
    }
    run_on_logs(shared | {"json": json, "quiet": quiet, "verbose": verbose}, "fuse", mcaptrack.fuse, options)


def offsets_of(texts: Any) -> dict[str, float]:
    """Return the offsets of clocks by camera. Raises McaptrackError for others than CAMERA=SECONDS."""
    out: dict[str, float] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        try:
            seconds = float(value)
        except ValueError:
            seconds = math.nan
        if not equals or not name or not math.isfinite(seconds):
            raise McaptrackError(f"--clock-offset-s {text} is no CAMERA=SECONDS, as in front=0.3")
        if name in out:
            raise McaptrackError(f"--clock-offset-s is given twice for {name}")
        out[name] = seconds
    return out
