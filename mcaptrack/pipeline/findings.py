"""Warn about results that are empty or unreliable, and about memory that runs out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack import log
from mcaptrack.errors import call
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import Planes, is_assumed, is_estimated
from mcaptrack.notices import known_code, warn
from mcaptrack.pipeline.planes import plane_in_words
from mcaptrack.schema import VIDEO, Frame
from mcaptrack.schema.framing import frame_times, row_ends
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.cameras import camera_at
from mcaptrack.transforms import STAGES, Transform

#: The stages with results in metres: all except those that read pictures.
_IN_METRES: Final = {name for name, stage in STAGES.items() if stage.default.reads is not VIDEO}
#: The memory that a run needs, in bytes: whatever its length, and for each second that a person is seen (re-tracking
#: has all samples in memory).
_BASE, _A_PERSON_SECOND = 400_000_000, 3_000


def warn_no_rows(stage: str, source: str, transform: Transform, given: Sequence[Frame], made: Sequence[Frame]) -> None:
    """Warn if a stage made no rows, with the likely reason.

    ``given`` are the frames that the stage read, ``made`` those of its first output.
    """
    if row_ends(made)[-1]:
        return
    if transform.reads is not VIDEO and not row_ends(given)[-1]:
        warn(f"{source} holds nothing, so nothing was made of it", "nothing-found")
        return
    reason = transform.why_empty(given, made) if hasattr(transform, "why_empty") else "the transform gave none"
    warn(f"no {STAGES[stage].rows} of {source}: {reason}", "nothing-found")


def warn_clock_jumps(opened: log.Log) -> None:
    """Warn if the clock of a log jumps, or if nothing was recorded for long."""
    if words := log.jumps_text(log.clock_jumps(opened), opened.start_ns):
        warn(
            f"{opened.path}: {words}: the clock jumps, or the recording paused; tracks and forecasts end there",
            "clock-jump",
        )


def warn_memory(frames: Sequence[Frame]) -> None:
    """Warn if the stages that follow need more memory for these boxes than is free."""
    boxes, steps = int(row_ends(frames)[-1]), np.diff(frame_times(frames))
    seen_s = boxes * (float(np.median(steps)) / NS_PER_S if len(steps) else 0.0)
    needed, free = _BASE + seen_s * _A_PERSON_SECOND, free_memory()
    if free is not None and needed > free:
        warn(
            f"{boxes:,} boxes, of people who are seen for {seen_s / 3600:,.0f} hours together, take about "
            f"{needed / 1e9:.1f} GB of memory, and {free / 1e9:.1f} GB are free: re-tracking has all samples in memory",
            "memory",
        )


def free_memory() -> int | None:
    """Return the free memory for this process in bytes, as Linux reports it; None if it isn't known."""
    found = []
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        found += [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
        most, now = (Path(f"/sys/fs/cgroup/memory.{name}").read_text().strip() for name in ("max", "current"))
        found += [int(most) - int(now)] if most != "max" else []
    except (OSError, ValueError):
        pass  # not Linux, or no memory limit for this process's control group
    return min(found, default=None)


def warn_findings(opened: log.Log, prefix: str, made: Mapping[str, Provenance], planes: Planes, is_all: bool) -> None:
    """Repeat the warnings that channels carry in their provenance, and warn about an estimated scale.

    This covers the channels in ``made``, by topic, and the channels that they were made from; with ``is_all`` it covers
    all channels of the camera.
    """
    known = dict(made)
    for topic in sorted(camera_at(opened, prefix).topics):
        provenance = Provenance.from_metadata(opened.channels[topic].metadata)
        if provenance is not None:
            known.setdefault(topic, provenance)
    topics = list(known) if is_all else list(made)
    for topic in topics:
        if known[topic].input in known and known[topic].input not in topics:
            topics.append(known[topic].input)
    stages = {known[topic].transform for topic in topics}
    for topic in topics:
        for code, message in known[topic].warnings:
            warn(message, known_code(code))
    if is_assumed(planes) and stages & _IN_METRES:
        words = plane_in_words(planes, known.get(camera_at(opened, prefix).ground_plane))
        warn(words, "estimated-ground-plane" if is_estimated(planes) else "assumed-ground-plane")
    given = [known[topic].parameters for topic in topics]
    held_back = [one for one in given if one.get("poor_scale") and not one.get("side_view")]
    if held_back:
        by_likelihood = [one for one in held_back if one.get("retracker", "likelihood") == "likelihood"]
        is_linked = any(one.get("link_s") != 0 for one in by_likelihood)
        done = "only linked over gaps, by their boxes in the picture" if is_linked else "not re-tracked but passed on"
        warn(
            f"tracks were {done}: without a measured ground plane, more needs a camera that looks down, and this one "
            f"looks along the ground. To insist: {call('retrack', opened.path, side_view=True)}",
            "held-back",
        )
