"""Which channel of boxes is given to other programs."""

from __future__ import annotations

from typing import Final

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.sources.cameras import cameras

#: Below the name of a camera, the best first: re-tracked boxes of every picture before those of the tracker.
_PREFERRED: Final = ("retracks/full", "tracks", "retracks", "detections")


def boxes_topic(opened: log.Log, topic: str | None = None) -> str:
    """The channel with this topic, or the best tracks of the only camera, or else its detections.

    Raises McaptrackError, with the channels that there are, if there is none or if there are several cameras.
    """
    there = sorted(
        channel.topic
        for channel in log.topics_with_schema(opened, [DETECTIONS.name, TRACKS.name])
        if channel.messages and any(channel.holds(schema) for schema in (DETECTIONS, TRACKS))
    )
    if topic is not None:
        if topic in there:
            return topic
        opened.channel(topic)  # says what there is
        raise McaptrackError(f"{opened.path}: {topic} has no detections and no tracks; {_listed(there)} have")
    if not there:
        raise McaptrackError(f"{opened.path} has no detections and no tracks to write; run a stage first")
    best: list[str] = []
    for camera in cameras(opened):
        names = (f"{prefix}/{name}" for name in _PREFERRED for prefix in (camera.prefix, *camera.names))
        found = next((name for name in names if name in there), None)
        best += [found] if found else []
    best = best or there
    if len(best) > 1:
        raise McaptrackError(f"{opened.path} has boxes in {_listed(best)}; choose one with `topic=`")
    return best[0]


def _listed(topics: list[str]) -> str:
    return ", ".join(topics) or "no channels"
