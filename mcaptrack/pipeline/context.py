"""Context: the parameters of transforms that follow from the log, and not from the user."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from mcaptrack import log
from mcaptrack.geometry.clocks import NS_PER_S, parse_ns
from mcaptrack.geometry.plane import Planes, is_assumed
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import Job
from mcaptrack.pipeline.planes import is_poor
from mcaptrack.schema import Frame
from mcaptrack.schema.framing import frame_times
from mcaptrack.schema.provenance import CLOCK
from mcaptrack.sources.cameras import camera_at
from mcaptrack.transforms import STAGES, Sample, Transform
from mcaptrack.transforms.motion_limits import ClassNames, unknown_limits


def in_context(
    opened: log.Log,
    prefix: str,
    job: Job,
    frames: Sequence[Frame],
    planes: Planes,
    classes: Mapping[str, str],
) -> Transform:
    """Return the transform with its context fields filled in.

    They are the ground planes, the start of the clock in ns, the rate in Hz, and the names of classes by number.
    """
    names = {f.name for f in fields(job.transform) if f.metadata.get("context")}
    known: dict[str, Any] = {}
    if "ground_planes" in names:
        known["ground_planes"] = tuple(planes)
    if "class_names" in names:
        known["class_names"] = tuple((int(number), name) for number, name in classes.items())
        _warn_of_limits(str(getattr(job.transform, "class_limits", "")), known["class_names"])
    if "start_ns" in names:
        known["start_ns"] = _clock_start(opened, prefix)
    if "rate_hz" in names:
        steps = np.diff(frame_times(frames))
        if (steps > 0).any():  # frames may share a time
            known["rate_hz"] = round(NS_PER_S / float(np.median(steps[steps > 0])), 6)
            usual = f"{prefix}/{STAGES[job.stage].input_topic}"
            if job.source != usual and known["rate_hz"] > 2 * Sample().rate_hz:
                warn(
                    f"{job.source} has {known['rate_hz']:g} frames a second, and {job.stage} takes steps at that rate; "
                    f"{usual} has {Sample().rate_hz:g} unless it was made otherwise",
                    "clock",
                )
    if "poor_scale" in names and is_assumed(planes):
        known["poor_scale"] = is_poor(frames)
    return replace(job.transform, **known)


def _warn_of_limits(class_limits: str, names: ClassNames) -> None:
    """Warn of limits of classes that there are not."""
    if unknown := unknown_limits(class_limits, names):
        there = ", ".join(sorted({name for _, name in names if name})) or "none with a name"
        words = f"`class_limits=` names {', '.join(unknown)}: no such class is in the table of limits or in the boxes"
        warn(f"{words} (classes of these are: {there})", "option-not-used")


def _clock_start(opened: log.Log, prefix: str) -> int | None:
    """Return the start of the prediction clock in ns: from the log's metadata, or the time of the first picture."""
    clock = opened.metadata(CLOCK)
    if clock and (start := parse_ns(clock.get("start_ns", ""))) is not None:
        return start
    pictures = camera_at(opened, prefix).pictures
    return min(opened.times(pictures).tolist(), default=None) if pictures else None
