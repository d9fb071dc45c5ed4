"""``mcaptrack calibrate``: correct the ground planes of cameras by the people that they see together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Final

from mcaptrack.cli import common
from mcaptrack.cli.flags import with_flags
from mcaptrack.cli.fuse import ClockOffsets, offsets_of
from mcaptrack.cli.many import LogWork, process, takes_many

if TYPE_CHECKING:
    from mcaptrack import CalibrateResult, CameraCorrection

#: Kinds of corrections in words.
_IN_WORDS: Final = {
    "shift": "a shift",
    "rigid": "a shift and a rotation",
    "similarity": "a shift, a rotation and a scale",
    "affine": "an affine map",
    "full": "a homography",
    "pose": "another pose of the camera",
}


@common.one_line
@takes_many()
def calibrate(
    logs: common.Logs,
    cameras: Annotated[
        str | None,
        common.option("--cameras", metavar="A,B", help="Cameras to compare.", show_default="all with a ground plane"),
    ] = None,
    reference: Annotated[
        str | None,
        common.option(
            "--reference",
            metavar="A,B",
            help="Cameras that are right: the others are brought to them.",
            show_default="what most cameras agree on",
        ),
    ] = None,
    clock_offset_s: ClockOffsets = None,
    dry_run: Annotated[bool, common.option("--dry-run", help="Only compare; write nothing.")] = False,
    output: common.Output = None,
    sidecar: common.Sidecar = None,
    force: common.Force = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Correct the ground planes of cameras that disagree with the others, by the people that they see together.

    Each camera is compared with what the others agree on. If its feet stand elsewhere, its plane is corrected by a
    shift, a rotation, a scale, or more, as far as that also holds at other times; those that agree stay as they are.

    /CAMERA/ground_plane stays in the log, and the corrected plane in /CAMERA/ground_plane/refined is used instead:
    `run` and `fuse` make again what was made before. `mcaptrack drop log.mcap /CAMERA/ground_plane/refined` takes it
    back.

    The log needs detections and a measured ground plane of each camera. Of two cameras --reference names the right one.

    Example: mcaptrack calibrate log.mcap --dry-run
    """
    import mcaptrack
    from mcaptrack.fleet import find_logs

    options: dict[str, Any] = {
        "cameras": cameras,
        "reference": reference,
        "clock_offset_s": offsets_of(clock_offset_s or ()),
        "dry_run": dry_run,
        "sidecar": sidecar,
        "force": force,
    }
    with common.Talk(quiet, verbose).open() as talk:
        work: LogWork[CalibrateResult] = LogWork(
            "calibrate",
            mcaptrack.calibrate,
            options,
            show=lambda _, result: _print(result, talk),
            data=_as_json,
            line=_in_short,
        )
        results, totals = process(find_logs(logs), work, talk, output)
    if json:
        common.print_json({"results": [_as_json(result) for result in results], **totals})


def _in_short(result: CalibrateResult) -> str:
    would = "would be corrected" if result.is_dry_run else "corrected"
    new = [name for name in result.corrected if name not in result.unchanged]
    names = f": {', '.join(new)}" if new else ""
    before = f", {len(result.unchanged)} already: {', '.join(result.unchanged)}" if result.unchanged else ""
    return f"{len(new)} of {len(result.cameras)} cameras {would}{names}{before}"


def _print(result: CalibrateResult, talk: common.Talk) -> None:
    took = f" in {result.seconds:.1f} s" if result.seconds else ""
    talk.say(f"{result.log}: {_in_short(result)}{took}")
    lines = [(name, _words(camera, name in result.unchanged)) for name, camera in result.cameras.items()]
    dropped = "would be dropped" if result.is_dry_run else "dropped"
    lines += [(dropped, f"{topic}: the camera agrees without it") for topic in result.dropped]
    if result.written_because and result.written_to:
        lines.append(("written", f"the planes are in {result.written_to}: {result.written_because}"))
    width = max(len(name) for name, _ in lines)
    for name, description in lines:
        talk.say(f"  {name:<{width}}  {description}")


def _words(camera: CameraCorrection, is_unchanged: bool) -> str:
    """Describe what was found about a camera."""
    before = _distances(camera.median_before_m, camera.p90_before_m)
    if not camera.correction:
        compared = f"; feet are {before} from those of the others ({camera.pairs:,} compared)" if camera.pairs else ""
        text = f"as it was: {with_flags(camera.why)}{compared}"
    else:
        after = _distances(camera.median_after_m, camera.p90_after_m)
        corrected = "corrected already by" if is_unchanged else "corrected by"
        text = (
            f"{corrected} {_IN_WORDS[camera.correction]}, which moves feet by {camera.moved_m:.2f} m: they are {after} "
            f"from those of the others, and were {before} ({camera.pairs:,} compared)"
        )
        text += f"; {camera.limit}" if camera.limit else ""
    if camera.clock_offset_s:
        late = "late" if camera.clock_offset_s > 0 else "early"
        text += f"; its times are {abs(camera.clock_offset_s):.2f} s {late}"
    return text


def _distances(median_m: float | None, p90_m: float | None) -> str:
    if median_m is None or p90_m is None:
        return "-"
    return f"{median_m:.2f} m (90 %: {p90_m:.2f} m)"


def _as_json(result: CalibrateResult) -> dict[str, Any]:
    """Return the result as values of JSON."""
    return {
        "log": str(result.log),
        "cameras": {name: _camera_as_json(camera) for name, camera in result.cameras.items()},
        "corrected": dict(result.corrected),
        "unchanged": list(result.unchanged),
        "dropped": list(result.dropped),
        "is_dry_run": result.is_dry_run,
        "stale": list(result.stale),
        "written_to": str(result.written_to) if result.written_to else None,
        "written_there_because": with_flags(result.written_because) or None,
        "seconds": result.seconds,
    }


def _camera_as_json(camera: CameraCorrection) -> dict[str, Any]:
    return {
        "correction": camera.correction or None,
        "moved_m": camera.moved_m,
        "pairs": camera.pairs,
        "median_before_m": camera.median_before_m,
        "p90_before_m": camera.p90_before_m,
        "median_after_m": camera.median_after_m,
        "p90_after_m": camera.p90_after_m,
        "why": with_flags(camera.why) or None,
        "limit": camera.limit or None,
        "clock_offset_s": camera.clock_offset_s,
        "homography": list(camera.homography) if camera.homography else None,
    }
