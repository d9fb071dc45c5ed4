"""Which tracker suits boxes: one for boxes in pictures, or one for positions in metres."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import Job
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.schema.framing import joined_parts
from mcaptrack.schema.provenance import frame_id_of
from mcaptrack.sources.calibrations import holds_calibrations
from mcaptrack.sources.cameras import camera_at, is_made_by_stage
from mcaptrack.sources.fixed_frame import holds_boxes_3d
from mcaptrack.transforms import STAGES, Stage
from mcaptrack.transforms.protocol import Space, traits_of

_BOXES: Final = {"picture": "boxes in pixels", "ground": "positions in metres"}


def spaces_of_boxes(opened: log.Log, topic: str) -> frozenset[Space]:
    """Return in which spaces the boxes of a channel are; empty if it has no boxes or isn't there."""
    channel = opened.channels.get(topic)
    if channel is None:
        return frozenset()
    if holds_boxes_3d(opened, topic):
        return frozenset({"ground"})
    if channel.schema_name != DETECTIONS.name:
        return frozenset({"picture"})
    if not frame_id_of(channel.metadata) and is_made_by_stage(channel):
        return frozenset({"picture"})
    there: dict[Space, str] = {"picture": "x_px", "ground": "x_m"}
    found = set[Space]()
    for _, _, part in joined_parts(DETECTIONS, opened.frame_columns(topic, DETECTIONS)):
        found |= {space for space, column in there.items() if np.isfinite(part.rows[column]).any()}
        if len(found) == len(there):
            break
    return frozenset(found)


def tracker_of(space: str) -> str:
    """Return the name of the first tracker of a space. Raises McaptrackError if there is none."""
    names = _trackers_of(space)
    if not names:
        raise McaptrackError(f"no tracker takes {_BOXES[space]}; `tracker=` names one of your own")
    return names[0]


def _trackers_of(space: str) -> list[str]:
    return [name for name, cls in STAGES["track"].built_in().items() if traits_of(cls).space == space]


def suited_tracker(opened: log.Log, stage: Stage, source: str) -> str:
    """Return the tracker for boxes that the default one can't take; "" for others, and for other stages."""
    if stage.default.reads is not DETECTIONS:
        return ""
    spaces, default = spaces_of_boxes(opened, source), traits_of(STAGES["track"].default).space
    return tracker_of(next(iter(sorted(spaces)))) if spaces and default not in spaces else ""


def check_spaces(opened: log.Log, prefix: str, jobs: Sequence[Job], frame_id: str = "") -> None:
    """Raise McaptrackError if a tracker can't take the boxes of its channel.

    Warns if a frame is named and no boxes can be brought to it.
    """
    sources = {job.source for job in jobs if job.source in opened.channels}
    is_calibrated = any(map(holds_calibrations, opened.channels.values()))
    has_boxes = camera_at(opened, prefix).in_space or any(holds_boxes_3d(opened, one) for one in sources)
    if frame_id and not has_boxes and not is_calibrated:
        warn("`frame=` has no effect: only recorded 3D boxes are brought to a frame", "option-not-used")
    for job in jobs:
        if job.transform.reads is not DETECTIONS or job.transform.writes.get("") is not TRACKS:
            continue
        spaces, space = spaces_of_boxes(opened, job.source), traits_of(job.transform).space
        if spaces and space not in spaces:
            there = " and ".join(_BOXES[one] for one in sorted(spaces))
            name, others = STAGES["track"].choice(job.transform), _trackers_of(next(iter(sorted(spaces))))
            other = f"`tracker={others[0]!r}` takes these" if others else "no built-in one takes these"
            raise McaptrackError(
                f"{opened.path}: {job.source} has {there}, and the tracker {name} takes {_BOXES[space]}; " + other
            )
