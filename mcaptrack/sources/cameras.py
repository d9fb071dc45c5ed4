"""Which channels belong to which camera: its pictures, its ground truth, and all that was made from them.

A camera is a name (``/camera``) below which results are written. Which channels are its own does not follow from their
names: each channel says what it was made from, and such a chain ends at something that was recorded or ingested.
Channels whose chains end below the same name belong together, wherever a stage was told to write them. Boxes that a
detector recorded, and labels, belong to the pictures beside them: the ones with the longest common part of the name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import takewhile
from typing import Final, NamedTuple
from weakref import WeakKeyDictionary

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, SCHEMAS
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources import foreign
from mcaptrack.transforms import STAGES

#: The name of a camera that has no other.
DEFAULT_CAMERA: Final = "camera"
#: What is ingested, below the name of its camera.
VIDEO, TRUTH, GROUND_PLANE = "video", "truth", "ground_plane"
#: What stands below the name of a camera, and the stage that makes it; "" where it comes in.
USUAL: Final[Mapping[str, str]] = {VIDEO: "", TRUTH: "", GROUND_PLANE: ""} | {
    topic: stage.name for stage in STAGES.values() for topic in stage.outputs(stage.output_topic)
}


class Camera(NamedTuple):
    """A camera of a log.

    ``prefix`` is the name below which its results are written; ``names`` are all below which something of it came in.
    ``pictures`` is None where there are none, or several and nothing to tell which; so are ``boxes``, those that others
    detected. ``truth`` and ``ground_plane`` are where these stand, or would stand. ``topics`` are all its channels.
    """

    prefix: str
    names: tuple[str, ...]
    pictures: str | None
    boxes: str | None
    truth: str
    ground_plane: str
    topics: frozenset[str]


def name_above(topic: str) -> str:
    """The name of the camera that a recorded channel belongs to: "/front" for "/front/image"."""
    bare = topic.strip("/")
    usual = max((name for name in USUAL if bare.endswith("/" + name)), key=len, default=bare.rpartition("/")[2])
    return "/" + (bare.removesuffix(usual).strip("/") or DEFAULT_CAMERA)


def find_camera(opened: log.Log, name: str | None = None, topic: str | None = None) -> str:
    """The prefix of the camera that a topic belongs to, or of this name, or of the only one of the log.

    Raises McaptrackError if the log has several and none is named, or if name and topic are of different ones.
    """
    if topic:
        prefix = _of_topic(opened, topic)
        if name and "/" + name.strip("/") not in (prefix, *camera_at(opened, prefix).names):
            raise McaptrackError(
                f"{opened.path}: {topic} belongs to the camera {prefix[1:]}, not to {name}; leave `camera=` out"
            )
        return prefix
    if name:
        _refuse_unknown(opened, name)
        return camera_at(opened, "/" + name.strip("/")).prefix
    known = cameras(opened)
    # Recordings of which nothing was made yet count where there is nothing else.
    chosen = [camera for camera in known if _is_ours(opened, camera)]
    if not chosen:
        # Of several recordings one has to be named: the planner says which there are.
        return known[0].prefix if len(known) == 1 else f"/{DEFAULT_CAMERA}"
    if len(chosen) == 1:
        return chosen[0].prefix
    names = ", ".join(camera.prefix for camera in chosen)
    usual = [camera.prefix for camera in chosen if f"/{DEFAULT_CAMERA}" in camera.names]
    if not usual:
        raise McaptrackError(f"{opened.path} has several cameras, {names}; choose one with `camera=`")
    warn(f"several cameras, {names}: taking {usual[0]}; `camera=` chooses another", "chosen-camera")
    return usual[0]


def _refuse_unknown(opened: log.Log, name: str) -> None:
    """Raise McaptrackError for a name that no camera of the log has, if it has any."""
    names = [one.strip("/") for camera in cameras(opened) for one in camera.names]
    if names and name.strip("/") not in names:
        raise McaptrackError(f"{opened.path} has no camera {name}; it has {', '.join(sorted(names))}")


def _of_topic(opened: log.Log, topic: str) -> str:
    """Results stand beside the channel that they come from, unless its camera has some elsewhere."""
    name = name_above(chain_of(opened, topic)[-1])
    found = camera_at(opened, name)
    has_results = any(
        is_made_by_stage(opened.channels[one]) for one in found.topics if one.startswith(found.prefix + "/")
    )
    return found.prefix if has_results else name


def _is_ours(opened: log.Log, camera: Camera) -> bool:
    """Whether anything of a camera was ingested or made."""
    return any(Provenance.from_metadata(opened.channels[topic].metadata) for topic in camera.topics)


def camera_at(opened: log.Log, prefix: str) -> Camera:
    """The camera of this name, with or without channels in the log."""
    found = next((camera for camera in cameras(opened) if prefix in camera.names), None)
    return found or _Channels(opened).camera([prefix])


def chain_of(opened: log.Log, topic: str) -> list[str]:
    """A channel, what it was made from, what that was made from, and so on: to something that was recorded or ingested,
    or is gone by now.
    """
    chain: list[str] = []
    while topic and topic not in chain:
        chain.append(topic)
        channel = opened.channels.get(topic)
        made = Provenance.from_metadata(channel.metadata) if channel else None
        topic = made.input if made else ""
    return chain


def is_made_by_stage(channel: log.Channel) -> bool:
    """Whether a stage made a channel, so that it can make it again."""
    made = Provenance.from_metadata(channel.metadata)
    return made is not None and made.transform in STAGES


_KNOWN: Final[WeakKeyDictionary[log.Log, list[Camera]]] = WeakKeyDictionary()


def cameras(opened: log.Log) -> list[Camera]:
    """All cameras of a log, by name."""
    if opened not in _KNOWN:
        _KNOWN[opened] = _Channels(opened).cameras()
    return _KNOWN[opened]


class _Channels:
    """The channels of a log that belong to cameras, by the name below which their chains begin."""

    def __init__(self, opened: log.Log) -> None:
        self._opened = opened
        self._made = {topic: Provenance.from_metadata(one.metadata) for topic, one in opened.channels.items()}
        self._below: dict[str, set[str]] = {}
        self._source: dict[str, str] = {}
        for topic, channel in opened.channels.items():
            is_ours = self._made[topic] is not None or channel.schema_name in SCHEMAS
            if is_ours or foreign.holds_pictures(channel) or foreign.holds_detections(channel):
                self._source[topic] = chain_of(opened, topic)[-1]
                self._below.setdefault(name_above(self._source[topic]), set()).add(topic)
        self._pictured = {name for name in self._below if self._pictures([name])}

    def cameras(self) -> list[Camera]:
        """The names put together to cameras."""
        labels = {name for name, topics in self._below.items() if all(_is_label(self._source[one]) for one in topics)}
        joined = {name: [name] for name in self._below}
        for name in sorted(set(self._below) - self._pictured):
            others = self._pictured or (set(self._below) - labels)
            target = _nearest(name, others) if name in labels or self._boxes([name]) else None
            if target in joined and target != name and not (self._results([name]) and self._results(joined[target])):
                joined[target] += joined.pop(name)
        return [self.camera(names) for _, names in sorted(joined.items())]

    def camera(self, names: list[str], prefix: str | None = None) -> Camera:
        """The camera of these names; its results stand, or will stand, below ``prefix``."""
        prefix = prefix or next((name for name in names if self._results([name])), names[0])
        pictures = self._pictures(names)
        nearest = None if pictures else _nearest(prefix, self._pictured)
        return Camera(
            prefix,
            tuple(names),
            self._usual_pictures(names) or _only(pictures or (self._pictures([nearest]) if nearest else [])),
            _only(self._boxes(names)),
            self._given(names, TRUTH) or f"{prefix}/{TRUTH}",
            self._given(names, GROUND_PLANE) or f"{prefix}/{GROUND_PLANE}",
            frozenset(topic for name in names for topic in self._below.get(name, ())),
        )

    def _pictures(self, names: list[str]) -> list[str]:
        return self._those(names, foreign.holds_pictures)

    def _usual_pictures(self, names: list[str]) -> str | None:
        """The video, or what detections were made from."""
        topics = [f"{name}/{VIDEO}" for name in names]
        topics += [made.input for name in names if (made := self._made.get(f"{name}/{STAGES['detect'].output_topic}"))]
        there = [self._opened.channels[topic] for topic in topics if topic in self._opened.channels]
        return next((channel.topic for channel in there if foreign.holds_pictures(channel)), None)

    def _boxes(self, names: list[str]) -> list[str]:
        """What others detected."""
        return self._those(
            names,
            lambda channel: (
                foreign.holds_detections(channel)
                or (channel.schema_name == DETECTIONS.name and not is_made_by_stage(channel))
            ),
        )

    def _results(self, names: list[str]) -> list[str]:
        """What stages made, below these names themselves."""
        return [one for name in names for one in self._those([name], is_made_by_stage) if one.startswith(name + "/")]

    def _given(self, names: list[str], label: str) -> str | None:
        """A label below one of the names; what a stage was told to write there is none."""
        topics = [f"{name}/{label}" for name in names]
        there = [self._opened.channels[topic] for topic in topics if topic in self._opened.channels]
        return next((channel.topic for channel in there if not is_made_by_stage(channel)), None)

    def _those(self, names: list[str], wanted: Callable[[log.Channel], bool]) -> list[str]:
        topics = sorted(topic for name in names for topic in self._below.get(name, ()))
        return [topic for topic in topics if wanted(self._opened.channels[topic])]


def _is_label(topic: str) -> bool:
    return topic.rpartition("/")[2] in (TRUTH, GROUND_PLANE)


def _only(topics: list[str]) -> str | None:
    return topics[0] if len(topics) == 1 else None


def _nearest(name: str, others: set[str]) -> str | None:
    """The other name that shares the longest part with this one; None if there are several."""

    def shared(other: str) -> int:
        pairs = zip(name.split("/"), other.split("/"), strict=False)
        return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))

    most = max(map(shared, others), default=0)
    found = [other for other in others if shared(other) == most]
    return found[0] if len(found) == 1 else None
