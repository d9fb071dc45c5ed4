"""Compare corrections with the log that they go into: with the ids of its tracks, and with earlier corrections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mcaptrack import log
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.schema import TRACKS
from mcaptrack.schema.framing import frame_times, unique_values
from mcaptrack.sources.corrections import CORRECTED_FROM
from mcaptrack.sources.ingest.labels.content import Labels
from mcaptrack.sources.ingest.labels.timeline import Placed


def with_new_ids(into: log.Log, prefix: str, labels: Labels) -> Labels:
    """Give tracks without an id of their own ids that no track of the log has.

    Otherwise the half of a track that was split could get the id of a track that was removed.
    """
    topics = [f"{prefix}/{name}" for name in CORRECTED_FROM]
    there = [topic for topic in topics if topic in into.channels and into.channels[topic].holds(TRACKS)]
    used = [int(unique_values(TRACKS, into.frame_columns(topic, TRACKS), "track_id").max(initial=0)) for topic in there]
    if labels.made_ids is None or not used:
        return labels
    first = max(*used, int(labels.id.max())) + 1
    is_made = np.isin(labels.id, labels.made_ids)
    new = first + np.searchsorted(labels.made_ids, labels.id)
    return replace(labels, id=np.where(is_made, new, labels.id), made_ids=first + np.arange(len(labels.made_ids)))


def warn_uncovered(into: log.Log, topic: str, placed: Placed) -> None:
    """Warn of pictures that were corrected before, and that new corrections don't cover: they take the place of all."""
    if topic not in into.channels or not into.channels[topic].holds(TRACKS) or not len(placed.t_ns):
        return
    before = frame_times(into.frame_columns(topic, TRACKS))
    lost = before[(before < placed.t_ns[0]) | (before > placed.t_ns[-1])]
    if len(lost):
        span = " to ".join(f"{(int(t_ns) - into.start_ns) / NS_PER_S:.2f}" for t_ns in (lost[0], lost[-1]))
        warn(
            f"{topic} covered {len(lost)} pictures more ({span} s), and these corrections take its place: there the "
            "tracks are those of the tracker again",
            "left-out",
        )
