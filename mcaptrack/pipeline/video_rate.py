"""Re-tracked tracks at the rate of the tracks that were sampled."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from mcaptrack import log
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.plane import Planes
from mcaptrack.pipeline.checks import Job
from mcaptrack.pipeline.corrections import corrected_tracks, without_filled_in
from mcaptrack.pipeline.write import Made
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.camera_motion import to_pictures, to_scene
from mcaptrack.sources.cameras import provenance_of


def at_video_rate(
    opened: log.Log,
    prefix: str,
    job: Job,
    made: Mapping[str, Made],
    retracked: Sequence[Frame],
    planes: Planes,
    path: CameraPath | None,
    carry: Callable[[Sequence[Frame], Sequence[Frame], Planes], Sequence[Frame]],
) -> Sequence[Frame]:
    """Return re-tracked tracks at the rate of the tracks that were sampled; no frames if there are no such tracks.

    ``carry`` gives these tracks the re-tracked ids. Where the camera moves by ``path``, ``planes`` and the boxes of
    ``retracked`` are those of reference pictures.
    """
    samples = made[job.source].provenance if job.source in made else provenance_of(opened, job.source)
    source = samples.input if samples else ""
    if source in made:
        tracks = made[source].frames if made[source].schema is TRACKS else ()
    else:
        there = source in opened.channels and opened.channels[source].schema_name == TRACKS.name
        tracks = opened.frame_columns(source, TRACKS) if there else ()
    tracks = corrected_tracks(opened, prefix, source, tracks) if len(tracks) else tracks
    carried = without_filled_in(opened, prefix, source, carry(to_scene(tracks, path), retracked, planes))
    return to_pictures(carried, path)
