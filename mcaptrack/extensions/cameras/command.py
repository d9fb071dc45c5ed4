"""``mcaptrack fuse`` and ``mcaptrack calibrate``: what they print."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

from mcaptrack.cli import common
from mcaptrack.cli.many import EachLog
from mcaptrack.cli.running import RunsStages
from mcaptrack.cli.text import with_flags
from mcaptrack.errors import McaptrackError, command
from mcaptrack.location import Location

if TYPE_CHECKING:
    from mcaptrack import CalibrateResult, CameraCorrection, RunResult

#: Kinds of corrections in words.
_IN_WORDS: Final = {
    "shift": "a shift",
    "rigid": "a shift and a rotation",
    "similarity": "a shift, a rotation and a scale",
    "affine": "an affine map",
    "full": "a homography",
    "pose": "another pose of the camera",
}


class Fuse(RunsStages):
    """Fuse the detections of several cameras."""

    def arguments(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the arguments of the function."""
        arguments = super().arguments(names)
        return arguments | {"clock_offset_s": offsets_of(arguments["clock_offset_s"])}

    def next_commands(self, done: RunResult) -> list[str]:
        """Return the command that runs the scene."""
        scene = next(iter(done.frames)).split("/")[1]
        return [command("run", done.log, "--camera", scene).strip("`")]


class Calibrate(EachLog["CalibrateResult"]):
    """Correct the ground planes of cameras."""

    def arguments(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the arguments of the function."""
        arguments = super().arguments(names)
        return arguments | {"clock_offset_s": offsets_of(arguments["clock_offset_s"])}

    def show(self, log: Location, done: CalibrateResult, talk: common.Talk) -> None:
        """Print what was found about each camera."""
        took = f" in {done.seconds:.1f} s" if done.seconds else ""
        talk.say(f"{done.log}: {self.line(done)}{took}")
        lines = [(name, _words(camera, name in done.unchanged)) for name, camera in done.cameras.items()]
        dropped = "would be dropped" if done.is_dry_run else "dropped"
        lines += [(dropped, f"{topic}: the camera agrees without it") for topic in done.dropped]
        if done.written_because and done.written_to:
            lines.append(("written", f"the planes are in {done.written_to}: {done.written_because}"))
        width = max(len(name) for name, _ in lines)
        for name, description in lines:
            talk.say(f"  {name:<{width}}  {description}")

    def line(self, done: CalibrateResult) -> str:
        """Return which cameras were corrected."""
        would = "would be corrected" if done.is_dry_run else "corrected"
        new = [name for name in done.corrected if name not in done.unchanged]
        names = f": {', '.join(new)}" if new else ""
        before = f", {len(done.unchanged)} already: {', '.join(done.unchanged)}" if done.unchanged else ""
        return f"{len(new)} of {len(done.cameras)} cameras {would}{names}{before}"

    def data(self, done: CalibrateResult) -> dict[str, Any]:
        """Return the result as values of JSON."""
        return {
            "log": str(done.log),
            "cameras": {name: _camera_as_json(camera) for name, camera in done.cameras.items()},
            "corrected": dict(done.corrected),
            "unchanged": list(done.unchanged),
            "dropped": list(done.dropped),
            "is_dry_run": done.is_dry_run,
            "stale": list(done.stale),
            "written_to": str(done.written_to) if done.written_to else None,
            "written_there_because": with_flags(done.written_because) or None,
            "seconds": done.seconds,
        }


def offsets_of(texts: Sequence[str] | None) -> dict[str, float]:
    """Return the offsets of clocks by camera. Raises McaptrackError for others than CAMERA=SECONDS."""
    out: dict[str, float] = {}
    for text in texts or ():
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


def _camera_as_json(camera: CameraCorrection) -> dict[str, Any]:
    empty = {"correction": camera.correction or None, "why": with_flags(camera.why) or None}
    return asdict(camera) | empty | {"limit": camera.limit or None, "homography": camera.homography or None}
