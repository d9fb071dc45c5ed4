"""Whether a channel is out of date: whether what it was made from is still what it was then."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

from mcaptrack import log
from mcaptrack.geometry.plane import Planes
from mcaptrack.notices import warn
from mcaptrack.registry import names
from mcaptrack.schema.provenance import FUSE, INGEST, REFINE, VIEW, Provenance, digest
from mcaptrack.sources.camera_motion import motion_topic, planes_in
from mcaptrack.sources.cameras import camera_at, chain_of, is_plane, name_above, provenance_of
from mcaptrack.sources.corrections import ANSWERS, CORRECTED, corrections_of
from mcaptrack.transforms import STAGES

if TYPE_CHECKING:
    from mcaptrack.pipeline.write import RunState

#: The value of ``camera_motion`` that takes no motion into account.
OFF: Final = "off"
#: Of more ground planes than this, a channel holds the digest.
_MOST_RECORDED: Final = 100


def is_stale(opened: log.Log, topic: str) -> bool:
    """Return whether an input or reference of ``topic``, or its ground plane, has changed since it was made."""
    return bool(changed_source(opened, topic))


def changed_source(opened: log.Log, topic: str) -> str:
    """Return the input, reference or ground plane of ``topic`` that has changed since it was made; "" if none has."""
    provenance = Provenance.from_metadata(opened.channel(topic).metadata)
    if provenance is None:
        return ""
    prefix = name_above(chain_of(opened, topic)[-1])
    if _is_plane_new(opened, prefix, provenance):
        return camera_at(opened, prefix).ground_plane
    if is_motion_new(opened, prefix, provenance):
        return motion_topic(camera_at(opened, prefix).prefix)
    if is_of_corrections(opened, prefix, provenance):
        return provenance.input
    changed = [name for name, then in provenance.references.items() if (name in opened.channels) != bool(then)]
    now = {name: how for name in provenance.made_from() if (how := provenance_of(opened, name)) and how.digest}
    changed += [name for name, how in now.items() if how.digest != provenance.made_from()[name]]
    return changed[0] if changed else ""


def is_finished(topic: str, how: Provenance) -> bool:
    """Return whether a finisher, installed or not, made a channel: below its input, as nothing else does."""
    is_other = how.transform in STAGES or how.transform in (INGEST, VIEW, FUSE, REFINE) or bool(how.plugins)
    return not is_other and bool(how.input) and topic.startswith(f"{how.input}/")


def missing_finisher(opened: log.Log, topic: str) -> str:
    """Return the name of the finisher that made a channel, if it isn't installed now; otherwise ""."""
    how = provenance_of(opened, topic)
    is_missing = how and is_finished(topic, how) and how.transform not in names("finisher")
    return how.transform if how and is_missing else ""


def _is_plane_new(opened: log.Log, prefix: str, provenance: Provenance) -> bool:
    """Whether the ground plane was changed or corrected, or a correction is gone."""
    then = provenance.parameters.get("ground_planes")
    if then is not None and planes_to_json(read_planes(opened, prefix) or ()) != then:
        return True
    planes_used = [name for name in provenance.references if provenance.transform == FUSE and is_plane(name)]
    return any(camera_at(opened, name_above(name)).ground_plane != name for name in planes_used)


def takes_corrections(stage: str) -> bool:
    """Return whether a stage takes the corrections that people made of its input."""
    return stage in STAGES and "corrections" in STAGES[stage].before


def is_of_corrections(opened: log.Log, prefix: str, provenance: Provenance) -> bool:
    """Whether what people corrected, or answered about tracks, is new, or was changed or is gone, since then."""
    answers = f"{camera_at(opened, prefix).prefix}/{ANSWERS}"
    is_retracked = provenance.transform in STAGES and STAGES[provenance.transform].kind == "retracker"
    if is_retracked and "transform" not in provenance.plugins:
        now = digest_of(opened, answers) if answers in opened.channels else None
        return provenance.references.get(answers) != now
    if not takes_corrections(provenance.transform):
        return False
    ending = f"/{CORRECTED}"
    then = {topic: digest for topic, digest in provenance.references.items() if topic.endswith(ending)}
    corrections = corrections_of(opened, camera_at(opened, prefix).prefix, provenance.input)
    return then != ({} if corrections is None else {corrections: digest_of(opened, corrections)})


def is_motion_new(opened: log.Log, prefix: str, provenance: Provenance) -> bool:
    """Whether a channel that takes camera motion into account was made before the motion was known."""
    topic = motion_topic(camera_at(opened, prefix).prefix)
    if topic not in opened.channels or topic in provenance.references:
        return False
    usual = OFF
    if provenance.transform in STAGES and "transform" not in provenance.plugins:
        usual = getattr(STAGES[provenance.transform].default, "camera_motion", OFF)
    return bool(provenance.parameters.get("camera_motion", usual) != OFF)


@log.kept
def read_planes(opened: log.Log, prefix: str) -> Planes | None:
    """Return the ground planes of a camera, each with its start time in ns; None if the log has none."""
    topic = camera_at(opened, prefix).ground_plane
    return (planes_in(opened, topic) if topic in opened.channels else []) or None


def planes_to_json(planes: Planes) -> list[Any]:
    """Convert ground planes to the JSON values that the parameters of a channel contain: their digest, if many."""
    values = [
        (t_ns, {name: value for name, value in asdict(plane).items() if value is not None}) for t_ns, plane in planes
    ]
    text = json.dumps(values)
    kept: list[Any] = json.loads(text)
    return kept if len(kept) <= _MOST_RECORDED else [len(kept), hashlib.sha256(text.encode()).hexdigest()]


def digest_of(opened: log.Log, topic: str) -> str:
    """Return the digest of a channel's messages: from its provenance if possible, else computed."""
    provenance = Provenance.from_metadata(opened.channel(topic).metadata)
    if provenance and provenance.digest:
        return provenance.digest
    return digest((message.t_ns, message.sequence, message.payload) for message in opened.messages(topic))


def warn_clock_jumps(opened: log.Log) -> None:
    """Warn if the clock of a log jumps, or if nothing was recorded for long."""
    if jumps := log.jumps_text(log.clock_jumps(opened), opened.start_ns):
        warn(
            f"{opened.path}: {jumps}: the clock jumps, or the recording paused; tracks and forecasts end there",
            "clock-jump",
        )


def is_outdated(state: RunState, topics: Sequence[str]) -> bool:
    """Return whether one of these topics is missing, or an input of the first one has changed since, also in a run."""
    if not all(topic in state.opened.channels for topic in topics) or is_stale(state.opened, topics[0]):
        return True
    provenance = provenance_of(state.opened, topics[0])
    then = provenance.made_from() if provenance else {}
    return not then or any(name in state.results and state.digest(name) != digest for name, digest in then.items())
