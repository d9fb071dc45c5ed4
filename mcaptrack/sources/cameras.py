"""Assign channels to cameras: pictures, ground truth, and all results made from them.

A camera is a name (``/camera``) below which results are written. A channel's own name does not decide its camera: the
provenance of each channel names its input, and this chain of inputs ends at a channel that was recorded or ingested.
Channels belong to the same camera if their chains end below the same name, even if a stage wrote them elsewhere.
Recorded detections and labels belong to the pictures with the longest common part of the name. Boxes in space (3D) have
a name of their own: they belong to no pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from mcaptrack import log
from mcaptrack.errors import McaptrackError, offer
from mcaptrack.notices import warn
from mcaptrack.schema import CAMERA_MOTION, DETECTIONS, SCHEMAS, TRACKS, Frame, Rows
from mcaptrack.schema.framing import JoinedFrames, has_any, mapped_rows
from mcaptrack.schema.names import shared_parts
from mcaptrack.schema.provenance import FUSE, REFINE, Provenance, frame_id_of, input_of
from mcaptrack.sources import foreign
from mcaptrack.transforms import STAGES

__all__ = [
    "Camera",
    "camera_at",
    "cameras",
    "corrected_plane",
    "detections_of",
    "detections_topic",
    "find_camera",
    "given_plane",
    "provenance_of",
    "repaired_tracks",
    "scenes_of",
]

#: The default name of a camera.
DEFAULT_CAMERA: Final = "camera"
#: The topics of ingested channels, below the name of their camera.
VIDEO, TRUTH, GROUND_PLANE = "video", "truth", "ground_plane"
#: The last part of the topic of a corrected ground plane, below the one that was given.
_REFINED: Final = "refined"
#: The usual topics below the name of a camera, and the stage that makes each; "" for ingested channels.
USUAL: Final[Mapping[str, str]] = {VIDEO: "", TRUTH: "", GROUND_PLANE: ""} | {
    topic: stage.name for stage in STAGES.values() for topic in stage.outputs(stage.output_topic)
}


class Camera(NamedTuple):
    """A camera of a log.

    ``prefix`` is the name below which its results are written; ``names`` are all names below which it has recorded or
    ingested channels. ``pictures`` is the topic of its pictures, and ``boxes`` that of recorded detections, in pictures
    or in space; each is None if there is no such channel, or no unique one. ``in_space`` are the topics of those in
    space. ``truth`` and ``ground_plane`` are the topics for these, whether
    or not the log has them. ``topics`` are all its channels.
    """

    prefix: str
    names: tuple[str, ...]
    pictures: str | None
    boxes: str | None
    truth: str
    ground_plane: str
    topics: frozenset[str]
    in_space: tuple[str, ...] = ()


def name_above(topic: str) -> str:
    """Return the name of the camera that a recorded channel belongs to: "/front" for "/front/image"."""
    bare = topic.strip("/")
    bare = bare.removesuffix(f"/{_REFINED}") if is_plane(bare) else bare
    usual = max((name for name in USUAL if bare.endswith("/" + name)), key=len, default=bare.rpartition("/")[2])
    return "/" + (bare.removesuffix(usual).strip("/") or DEFAULT_CAMERA)


def find_camera(opened: log.Log, name: str | None = None, topic: str | None = None) -> str:
    """Return the prefix of a camera: the one of a topic, the one with this name, or the only one of the log.

    Of several cameras the scene that they were fused to is taken, or the one called "camera", with a warning.

    Raises McaptrackError if the log has several cameras and none is named, or if the topic belongs to another camera
    than the named one, or to none.
    """
    if topic:
        topic = opened.find(topic, "/" + name.strip("/") if name else "")
        prefix = _prefix_of_topic(opened, topic)
        if topic not in opened.channels and not any(prefix in camera.names for camera in cameras(opened)):
            opened.channel(topic)  # refuses it: of no camera of the log, so no stage makes it
        if name and "/" + name.strip("/") not in (prefix, *camera_at(opened, prefix).names):
            raise McaptrackError(
                f"{opened.path}: {topic} belongs to the camera {prefix[1:]}, not to {name}; leave `camera=` out"
            )
        return prefix
    if name:
        names = [prefix.strip("/") for camera in cameras(opened) for prefix in camera.names]
        if names and name.strip("/") not in names:
            raise McaptrackError(f"{opened.path} has no camera {name}; {offer(name, sorted(names))}")
        return camera_at(opened, "/" + name.strip("/")).prefix
    # Cameras that are only boxes in space are left out, unless all are.
    others = [camera for camera in cameras(opened) if not camera.in_space or has_own_channels(opened, camera)]
    shown = others or cameras(opened)
    # Recorded cameras without results count only if no camera has any.
    chosen = [camera for camera in shown if has_own_channels(opened, camera)]
    if not chosen:
        # With several recorded cameras, the planner asks for one by name and lists them.
        if shown and all(camera.in_space for camera in shown):
            _refuse_several(opened, [topic for camera in shown for topic in camera.in_space])
        return shown[0].prefix if len(shown) == 1 else f"/{DEFAULT_CAMERA}"
    if len(chosen) == 1:
        return chosen[0].prefix
    prefixes = ", ".join(camera.prefix for camera in chosen)
    scenes = list(scenes_of(opened))
    kind = "sensors" if any(camera.in_space and camera.prefix not in scenes for camera in chosen) else "cameras"
    usual = scenes if len(scenes) == 1 else [camera.prefix for camera in chosen if f"/{DEFAULT_CAMERA}" in camera.names]
    if not usual:
        raise McaptrackError(f"{opened.path} has several {kind}, {prefixes}; choose one with `camera=`")
    warn(f"several {kind}, {prefixes}: taking {usual[0]}; `camera=` chooses another", "chosen-camera")
    return usual[0]


def camera_to_name(opened: log.Log, topic: str) -> str:
    """Return the name of the camera of a topic, as a command has to name it; "" if the log has no other."""
    return _prefix_of_topic(opened, topic)[1:] if len(cameras(opened)) > 1 else ""


def _refuse_several(opened: log.Log, topics: list[str]) -> None:
    """Raise McaptrackError if there are several channels of boxes in space."""
    if len(topics) > 1:
        raise McaptrackError(f"{opened.path} has boxes in space in {', '.join(topics)}; choose one with `topic=`")


def _prefix_of_topic(opened: log.Log, topic: str) -> str:
    """Return the prefix for results of a topic: the name above its source, unless its camera has results elsewhere."""
    name = name_above(chain_of(opened, topic)[-1])
    camera = camera_at(opened, name)
    has_results = any(
        is_made_by_stage(opened.channels[other]) for other in camera.topics if other.startswith(camera.prefix + "/")
    )
    return camera.prefix if has_results else name


def has_own_channels(opened: log.Log, camera: Camera) -> bool:
    """Return whether a camera has channels that were ingested or made by a stage."""
    return any(Provenance.from_metadata(opened.channels[topic].metadata) for topic in camera.topics)


def detections_topic(prefix: str) -> str:
    """Return the usual topic of the detections of a camera, by its prefix."""
    return f"{prefix}/{STAGES['detect'].output_topic}"


def detections_of(opened: log.Log, camera: Camera) -> str | None:
    """Return the topic of a camera's detections; None if it has none, or no unique one."""
    usual = detections_topic(camera.prefix)
    return usual if usual in opened.channels else camera.boxes


def given_plane(camera: Camera) -> str:
    """Return the topic of the ground plane that a camera was given, whether or not it was corrected."""
    return camera.ground_plane.removesuffix(f"/{_REFINED}")


def is_plane(topic: str) -> bool:
    """Return whether this is the topic of a ground plane, by its name."""
    return topic.removesuffix(f"/{_REFINED}").endswith(f"/{GROUND_PLANE}")


def corrected_plane(topic: str) -> str:
    """Return the topic of the correction of a ground plane, by the topic of this."""
    return f"{topic}/{_REFINED}"


def scenes_of(opened: log.Log) -> tuple[str, ...]:
    """Return the prefixes of the scenes that several cameras were fused to."""
    fused = ((camera.prefix, provenance_of(opened, detections_topic(camera.prefix))) for camera in cameras(opened))
    return tuple(prefix for prefix, how in fused if how is not None and how.transform == FUSE)


def members_of(opened: log.Log, scene: str) -> list[str]:
    """Return the prefixes of the cameras that were fused to a scene."""
    how = provenance_of(opened, detections_topic(scene))
    return [f"/{name}" for name in how.parameters["cameras"]] if how else []


def camera_at(opened: log.Log, prefix: str) -> Camera:
    """Return the camera of this name, even if the log has no channels for it."""
    camera = next((camera for camera in cameras(opened) if prefix in camera.names), None)
    return camera or _Channels(opened).camera([prefix])


def chain_of(opened: log.Log, topic: str) -> list[str]:
    """Return a topic, its input, the input of that, and so on, up to a recorded, ingested or missing channel."""
    chain: dict[str, None] = {}  # not a list: a chain may be long, and is searched for each of its topics
    while topic and topic not in chain:
        chain[topic] = None
        channel = opened.channels.get(topic)
        topic = input_of(channel.metadata) if channel else ""
    return list(chain)


def provenance_of(opened: log.Log, topic: str) -> Provenance | None:
    """Return how a channel was made; None if it is missing, or if mcaptrack did not make it."""
    channel = opened.channels.get(topic)
    return Provenance.from_metadata(channel.metadata) if channel else None


def repaired_tracks(tracks: Sequence[Frame], origin: Provenance | None) -> Sequence[Frame]:
    """Return tracks without ``source_id`` where it names detections instead of tracks.

    ``origin`` is the provenance of the tracks, None if others recorded them.
    """
    stage = STAGES.get(origin.transform) if origin else None
    is_from_boxes = stage is not None and stage.reads is DETECTIONS
    if not is_from_boxes or not has_any(TRACKS, tracks, lambda rows: rows["source_id"] >= 0):
        return tracks

    def without_sources(joined: JoinedFrames) -> Rows:
        rows = joined.rows.copy()
        rows["source_id"] = -1
        return rows

    return mapped_rows(TRACKS, tracks, without_sources)


def lineage(
    opened: log.Log, topic: str, provenances: Mapping[str, Provenance] = {}
) -> Iterator[tuple[str, Provenance | None]]:
    """Yield a topic, its input, the input of that and so on, like ``chain_of``, each with its provenance.

    ``provenances`` are those of channels that are not in the log yet, by topic.
    """
    seen: set[str] = set()
    while topic and topic not in seen:
        seen.add(topic)
        provenance = provenances.get(topic) or provenance_of(opened, topic)
        yield topic, provenance
        topic = provenance.input if provenance else ""


def is_made_by_stage(channel: log.Channel) -> bool:
    """Return whether a stage made a channel, and so can make it again."""
    provenance = Provenance.from_metadata(channel.metadata)
    return provenance is not None and provenance.transform in STAGES


@log.kept
def cameras(opened: log.Log) -> list[Camera]:
    """Return all cameras of a log, sorted by name."""
    return _Channels(opened).cameras()


def has_own_rows(channel: log.Channel) -> bool:
    """Return whether a channel has rows of a user's own schema: they may be about anything, and have no camera.

    Those that a stage made belong to the camera of what they were made of.
    """
    return channel.schema is not None and channel.schema.is_own and not input_of(channel.metadata)


def names_by_topic(opened: log.Log) -> dict[str, str]:
    """Return the name above the source of each channel of pictures, rows and views, without reading a message.

    Rows of a user's own schema stand by the channels of that name, if there are any.
    """
    own = {topic for topic, channel in opened.channels.items() if has_own_rows(channel)}
    names = {
        topic: name_above(chain_of(opened, topic)[-1])[1:]
        for topic, channel in opened.channels.items()
        if channel.schema_name in SCHEMAS or provenance_of(opened, topic) or foreign.holds_pictures(channel)
    }
    others = {name for topic, name in names.items() if topic not in own}
    return {topic: name for topic, name in names.items() if name in others}


class _Channels:
    """The channels of a log that belong to cameras, grouped by the name above the source of their chain of inputs."""

    def __init__(self, opened: log.Log) -> None:
        self._opened = opened
        self._provenance = {
            topic: Provenance.from_metadata(channel.metadata) for topic, channel in opened.channels.items()
        }
        self._topics: dict[str, set[str]] = {}
        self._source: dict[str, str] = {}
        for topic, channel in opened.channels.items():
            if has_own_rows(channel):
                continue
            is_ours = self._provenance[topic] is not None or channel.schema_name in SCHEMAS
            if is_ours or foreign.holds_pictures(channel) or foreign.holds_boxes(opened, topic):
                self._source[topic] = chain_of(opened, topic)[-1]
                self._topics.setdefault(name_above(self._source[topic]), set()).add(topic)
        self._with_pictures = {name for name in self._topics if self._picture_topics([name])}
        #: Names with boxes in space, and neither pictures nor boxes in pictures.
        self._in_space = {
            name
            for name in set(self._topics) - self._with_pictures
            if self._space_topics([name]) and not self._detection_topics([name])
        }

    def cameras(self) -> list[Camera]:
        """Group names to cameras: those with labels, detections or what users wrote alone join the nearest camera with
        pictures.
        """
        labels = {
            name
            for name, topics in self._topics.items()
            if {self._source[topic].rpartition("/")[2] for topic in topics} <= {TRUTH, GROUND_PLANE}
        }
        joined = {name: [name] for name in self._topics}
        for name in sorted(set(self._topics) - self._with_pictures - self._in_space):
            others = self._with_pictures or (set(self._topics) - labels)
            is_joined = name in labels or self._detection_topics([name]) or self._are_written([name])
            target = _nearest(name, others) if is_joined else None
            if (
                target in joined
                and target != name
                and not (self._result_topics([name]) and self._result_topics(joined[target]))
            ):
                joined[target] += joined.pop(name)
        return [self.camera(names) for _, names in sorted(joined.items())]

    def camera(self, names: list[str], prefix: str | None = None) -> Camera:
        """Return the camera with these names; ``prefix``: the name for its results, by default the one that has any."""
        prefix = prefix or next((name for name in names if self._result_topics([name])), names[0])
        pictures = self._picture_topics(names)
        is_in_space = not self._in_space.isdisjoint(names)
        nearest = None if pictures or is_in_space else _nearest(prefix, self._with_pictures)
        return Camera(
            prefix,
            tuple(names),
            self._default_pictures(names)
            or foreign.best_form(pictures or (self._picture_topics([nearest]) if nearest else [])),
            _only(self._detection_topics(names) or self._space_topics(names)),
            self._label_topic(names, TRUTH) or f"{prefix}/{TRUTH}",
            self._corrected(self._label_topic(names, GROUND_PLANE) or f"{prefix}/{GROUND_PLANE}"),
            frozenset(topic for name in names for topic in self._topics.get(name, ())),
            tuple(self._space_topics(names)) if is_in_space else (),
        )

    def _picture_topics(self, names: list[str]) -> list[str]:
        return self._select(names, foreign.holds_pictures)

    def _default_pictures(self, names: list[str]) -> str | None:
        """Return the topic of the video, or of the pictures that detections were made from; None if there is none."""
        topics = [f"{name}/{VIDEO}" for name in names]
        topics += [how.input for name in names if (how := self._provenance.get(detections_topic(name)))]
        return self._first(topics, foreign.holds_pictures)

    def _detection_topics(self, names: list[str]) -> list[str]:
        """Return the topics of detections in pictures that no stage made."""
        return self._select(
            names, lambda channel: foreign.holds_boxes(self._opened, channel.topic, False) or _is_ours(channel, False)
        )

    def _space_topics(self, names: list[str]) -> list[str]:
        """Return the topics of detections in space that no stage made."""
        return self._select(
            names, lambda channel: foreign.holds_boxes(self._opened, channel.topic, True) or _is_ours(channel, True)
        )

    def _result_topics(self, names: list[str]) -> list[str]:
        """Return the topics below these names that stages made; the motion of a camera is part of its pictures."""

        def is_result(channel: log.Channel) -> bool:
            return is_made_by_stage(channel) and channel.schema_name != CAMERA_MOTION.name

        return [topic for name in names for topic in self._select([name], is_result) if topic.startswith(name + "/")]

    def _are_written(self, names: list[str]) -> bool:
        """Return whether all channels below these names were written by programs of users, or are views of such."""
        sources = {self._source[topic] for name in names for topic in self._topics[name]}
        return all(how is not None and how.written_by for how in map(self._provenance.get, sources))

    def _label_topic(self, names: list[str], label: str) -> str | None:
        """Return the first topic below one of the names for a label, unless a stage made it; None if there is none."""
        return self._first([f"{name}/{label}" for name in names], lambda channel: not is_made_by_stage(channel))

    def _corrected(self, plane: str) -> str:
        """Return the topic of the correction of a ground plane if the log has it, otherwise the plane itself."""
        topic = corrected_plane(plane)
        after, before = self._provenance.get(topic), self._provenance.get(plane)
        if after is None or after.transform != REFINE or after.input != plane or plane not in self._opened.channels:
            return plane
        is_same = before is None or not before.digest or before.digest == after.input_digest
        return topic if is_same else plane

    def _first(self, topics: list[str], wanted: Callable[[log.Channel], bool]) -> str | None:
        channels = self._opened.channels
        return next((topic for topic in topics if topic in channels and wanted(channels[topic])), None)

    def _select(self, names: list[str], wanted: Callable[[log.Channel], bool]) -> list[str]:
        topics = sorted(topic for name in names for topic in self._topics.get(name, ()))
        return [topic for topic in topics if wanted(self._opened.channels[topic])]


def _is_ours(channel: log.Channel, is_in_space: bool) -> bool:
    """Return whether a channel has rows of detections that no stage made, in space or in pictures."""
    is_recorded = channel.schema_name == DETECTIONS.name and not is_made_by_stage(channel)
    return is_recorded and bool(frame_id_of(channel.metadata)) == is_in_space


def _only(topics: list[str]) -> str | None:
    return topics[0] if len(topics) == 1 else None


def _nearest(name: str, others: set[str]) -> str | None:
    """Return the other name with the longest common part; None if there are several."""
    shared = {other: shared_parts(name, other) for other in others}
    nearest = [other for other in others if shared[other] == max(shared.values())]
    return nearest[0] if len(nearest) == 1 else None
