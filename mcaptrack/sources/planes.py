"""Ground planes of a log."""

from __future__ import annotations

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import GROUND_PLANE
from mcaptrack.schema.ground_plane import rows_to_plane


def planes_in(opened: log.Log, topic: str) -> list[tuple[int, GroundPlane]]:
    """Return the ground planes of a channel, each with its start time in ns.

    Raises McaptrackError, with the log and the topic, if a message does not hold one plane of finite numbers.
    """
    try:
        return [(frame.t_ns, rows_to_plane(frame.rows)) for frame in opened.frames(topic, GROUND_PLANE)]
    except McaptrackError as error:
        if topic in str(error):
            raise
        raise McaptrackError(f"{opened.path}: {topic}: {error}") from None
