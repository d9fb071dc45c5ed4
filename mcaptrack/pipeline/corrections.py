"""Corrections by people in the pipeline: samples are of corrected tracks, and re-tracking keeps these as they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from mcaptrack import log
from mcaptrack.pipeline.checks import Job
from mcaptrack.pipeline.write import Made, digest_of
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.cameras import camera_at, provenance_of
from mcaptrack.sources.corrections import CORRECTED, corrections_of, fixed_ids, with_corrections, without_filled

#: The stage that takes corrections.
_STAGE: Final = "sample"


def are_new(opened: log.Log, prefix: str, made: Provenance) -> bool:
    """Whether samples were made before their tracks were corrected."""
    found = corrections_of(opened, camera_at(opened, prefix).prefix, made.input) if made.transform == _STAGE else None
    return found is not None and found not in made.references


def corrected_input(
    opened: log.Log, prefix: str, job: Job, frames: Sequence[Frame]
) -> tuple[Sequence[Frame], Mapping[str, str]]:
    """The frames that a job samples, with corrections, and the digests of these by topic; all others as they are."""
    topic = corrections_of(opened, prefix, job.source) if job.stage == _STAGE else None
    if topic is None:
        return frames, {}
    return with_corrections(frames, opened.frame_columns(topic, TRACKS)), {topic: digest_of(opened, topic)}


def corrected_tracks(opened: log.Log, prefix: str, source: str, tracks: Sequence[Frame]) -> Sequence[Frame]:
    """The tracks at ``source`` with corrections, if they have any."""
    topic = corrections_of(opened, prefix, source)
    return tracks if topic is None else with_corrections(tracks, opened.frame_columns(topic, TRACKS))


def without_filled_in(opened: log.Log, prefix: str, source: str, frames: Sequence[Frame]) -> Sequence[Frame]:
    """Re-tracked tracks at the rate of those at ``source``, without boxes that corrections of these don't have."""
    topic = corrections_of(opened, prefix, source)
    return frames if topic is None else without_filled(frames, opened.frame_columns(topic, TRACKS))


def is_of_corrections(opened: log.Log, prefix: str, made: Provenance) -> bool:
    """Whether samples are out of date because corrections of their tracks are new, changed or gone."""
    if made.transform != _STAGE:
        return False
    ending = f"/{CORRECTED}"
    then = {topic: digest for topic, digest in made.references.items() if topic.endswith(ending)}
    found = corrections_of(opened, camera_at(opened, prefix).prefix, made.input)
    return then != ({} if found is None else {found: digest_of(opened, found)})


def fixed_in(opened: log.Log, prefix: str, source: str, made: Mapping[str, Made]) -> tuple[int, ...]:
    """The ids of corrected tracks in the samples at ``source``; () if they were made without corrections."""
    how = made[source].provenance if source in made else provenance_of(opened, source)
    topic = corrections_of(opened, prefix, how.input) if how and how.transform == _STAGE else None
    if how is None or topic is None or topic not in how.references:
        return ()
    tracks = made[how.input].frames if how.input in made else opened.frame_columns(how.input, TRACKS)
    return fixed_ids(tracks, opened.frame_columns(topic, TRACKS))
