"""Whether a channel is out of date."""

from __future__ import annotations

from mcaptrack import log
from mcaptrack.pipeline import corrections, motion
from mcaptrack.pipeline.planes import planes_to_json, read_planes
from mcaptrack.schema.provenance import FUSE, Provenance
from mcaptrack.sources.cameras import camera_at, chain_of, is_plane, name_above, provenance_of


def is_stale(opened: log.Log, topic: str) -> bool:
    """Return whether an input or reference of ``topic``, or its ground plane, has changed since it was made."""
    made = Provenance.from_metadata(opened.channel(topic).metadata)
    if made is None:
        return False
    prefix = name_above(chain_of(opened, topic)[-1])
    if "ground_planes" in made.parameters:
        planes = read_planes(opened, prefix)
        if planes_to_json(planes or ()) != made.parameters["ground_planes"]:
            return True
    if motion.is_motion_new(opened, prefix, made) or corrections.are_new(opened, prefix, made):
        return True
    if _has_other_planes(opened, made):
        return True
    if any((name in opened.channels) != bool(then) for name, then in made.references.items()):
        return True
    for name, then in made.made_from().items():
        now = provenance_of(opened, name)
        if now and now.digest and now.digest != then:
            return True
    return False


def _has_other_planes(opened: log.Log, made: Provenance) -> bool:
    """Return whether a camera of a scene has a corrected ground plane, or has none any more."""
    planes = [name for name in made.references if made.transform == FUSE and is_plane(name)]
    return any(camera_at(opened, name_above(name)).ground_plane != name for name in planes)
