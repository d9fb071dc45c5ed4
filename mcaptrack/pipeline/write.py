"""What stages made goes into the log, with what a person looks at: views, and layouts that show them."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError, call
from mcaptrack.foxglove import views
from mcaptrack.foxglove.layouts import Eye
from mcaptrack.foxglove.views import layouts
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.plane import Planes
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import how_it_came, may_replace
from mcaptrack.schema import DETECTIONS, FORECAST_SCORES, GROUND_PLANE, PREDICTIONS, SCHEMAS, TRACKS, Frame, Schema
from mcaptrack.schema.framing import frame_times
from mcaptrack.schema.provenance import INGEST, VIEW, Provenance, digest
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import VIDEO, Camera, camera_at
from mcaptrack.transforms import FULL, STAGES

#: Log time, number of the channel, sequence and payload of a message.
Numbered = tuple[int, int, int, bytes]


class Made(NamedTuple):
    """A channel that was just made, of frames; or of ``words``, messages of another kind, with their schema record."""

    schema: Schema
    frames: list[Frame]
    provenance: Provenance
    words: list[tuple[int, int, bytes]] | None = None
    record: tuple[str, str, bytes] | None = None

    @classmethod
    def of(cls, schema: Schema, frames: list[Frame], provenance: Provenance) -> Made:
        """Frames through the gate; the digest of their messages goes into the provenance."""
        for frame in frames:
            schema.check(frame.rows)
        made = cls(schema, frames, provenance)
        return made._replace(provenance=replace(provenance, digest=digest(made.messages())))

    def messages(self) -> Iterator[tuple[int, int, bytes]]:
        """Time, frame and payload of each message; made one by one, since all of them take much memory."""
        if self.words is not None:
            return iter(self.words)
        encode = self.schema.codec.encode
        return ((frame.t_ns, frame.index, encode(frame.rows)) for frame in self.frames)

    def size(self) -> int:
        """How many messages there are."""
        return len(self.frames if self.words is None else self.words)


def digest_of(opened: log.Log, topic: str) -> str:
    """The digest of a channel's messages: as its provenance says, or added up."""
    known = Provenance.from_metadata(opened.channel(topic).metadata)
    if known and known.digest:
        return known.digest
    return digest((message.t_ns, message.sequence, message.payload) for message in opened.messages(topic))


def _stamps(opened: log.Log, topic: str, known: Sequence[int]) -> Ints:
    """The stamps of a channel's pictures. Our own are the log's times; those of others stand in the messages."""
    if Provenance.from_metadata(opened.channel(topic).metadata):
        return opened.times(topic)
    return np.array(known, np.int64) if known else foreign.stamps(opened, topic)


def write(
    opened: log.Log,
    prefix: str,
    made: Mapping[str, Made],
    planes: Planes,
    stamps: Mapping[str, Sequence[int]],
    output: Path | None,
) -> dict[str, bytes]:
    """Put what was made, and its views, into the log. Returns the layouts for them by their names.

    ``stamps`` are those of pictures that were read on the way.
    """
    camera = camera_at(opened, prefix)
    usual = f"{prefix}/{VIDEO}"
    video = usual if usual in opened.channels else next(iter(stamps), None) or camera.pictures
    picture_ns = opened.times(video) if video else np.empty(0, np.int64)
    video = video if len(picture_ns) else None
    stamp_ns = _stamps(opened, video, stamps.get(video, ())) if video else picture_ns
    shown = _shown(opened, camera, made)
    outdated = {topic + suffix for topic in shown for suffix in views.SUFFIXES}
    drawn = _Drawn(prefix, picture_ns, stamp_ns, planes)
    if any(channel.schema in _ON_GROUND for channel in shown.values()):
        outdated.add(drawn.frame_topic)
    taken = {topic for topic in outdated if not may_replace(opened, topic, VIEW)}
    outdated -= taken
    for topic in sorted(taken):
        warn(f"no view at {topic}, which {how_it_came(opened, topic)}", "left-out")
    # All that is read, before anything is written: the log is changed in place.
    start_ns = _start_ns(opened, camera, shown, picture_ns)
    eye = layouts.eye_on(_places(opened, prefix, shown), planes, start_ns)
    last_step, is_truth_known = _last_step(opened, prefix, shown), _is_truth_known(opened, prefix, shown)
    # What stays comes first: then what is made again finds the place that it had, and the bytes are the same.
    first, last = ({t: c for t, c in shown.items() if (t in made) is is_made} for is_made in (False, True))
    drawn_first = [view for view in drawn.views(first, start_ns) if view.topic not in taken]
    drawn_last = [view for view in drawn.views(last, start_ns) if view.topic not in taken]
    there = {*opened.channels} - outdated | {*made} | {view.topic for view in (*drawn_first, *drawn_last)}
    layout_files = layouts.make(drawn.there(there, video, eye, last_step, is_truth_known))
    new = {attachment_of(name): content for name, content in layout_files.items()}
    standing = {name for name, content in new.items() if opened.attachment(name) == content}
    replaced = [name for name in ATTACHMENTS if name not in standing]
    new_topics = {*made, *outdated, *(view.topic for view in (*drawn_first, *drawn_last))}
    log.refuse_to_replace_recorded(opened, new_topics, "write to another channel")
    with log.extend(opened, output, drop={*made, *outdated}, drop_attachments=replaced) as writer:
        streams: list[Iterator[Numbered]] = []

        def draw(some: Iterable[View]) -> None:
            for view in some:
                record = foxglove.schema_record(view.schema_name)
                metadata = view.provenance.to_metadata()
                number = writer.add_channel(view.topic, record, "protobuf", metadata, "views", view.group)
                streams.append(_with_number(number, view.messages))

        draw(drawn_first)
        for topic, channel in made.items():
            record = channel.record or (channel.schema.name, "protobuf", channel.schema.descriptor)
            made_by = channel.provenance.transform  # results of one stage share chunks, so that they can go together
            number = writer.add_channel(topic, record, "protobuf", channel.provenance.to_metadata(), group=made_by)
            streams.append(_with_number(number, channel.messages()))
        draw(drawn_last)
        _write_by_time(writer, streams)
        for name, content in new.items():
            if name not in standing:
                writer.add_attachment(name, "application/json", content)
    return layout_files


class Shown(NamedTuple):
    """A channel to be drawn: ``digest`` is of its messages, ``made_by`` the stage that makes it now, if one does."""

    schema: Schema
    frames: list[Frame]
    digest: str
    made_by: str


def _shown(opened: log.Log, camera: Camera, made: Mapping[str, Made]) -> dict[str, Shown]:
    """The channels that get views: those just made, those ingested since, and those without any."""
    shown = {
        topic: Shown(channel.schema, channel.frames, channel.provenance.digest, channel.provenance.transform)
        for topic, channel in made.items()
    }
    for topic, channel in sorted(opened.channels.items()):
        schema = SCHEMAS.get(channel.schema_name)
        known = Provenance.from_metadata(channel.metadata)
        if topic in shown or topic not in camera.topics or not known or known.transform != INGEST:
            continue
        drawn = opened.channels.get(topic + (views.SUFFIX if schema is DETECTIONS else views.SCENE_SUFFIX))
        drawn_from = Provenance.from_metadata(drawn.metadata) if drawn else None
        is_new = drawn_from is None or drawn_from.input_digest != known.digest
        if schema in (*views.DRAWN, GROUND_PLANE) and is_new:
            shown[topic] = Shown(schema, opened.frames(topic, schema), known.digest, "")
    return shown


class View(NamedTuple):
    """A channel that shows another."""

    topic: str
    schema_name: str
    provenance: Provenance
    group: str
    messages: Iterator[tuple[int, int, bytes]]


class _Drawn:
    """The views of a camera's channels: on its pictures, and on the ground."""

    def __init__(self, prefix: str, picture_ns: Ints, stamp_ns: Ints, planes: Planes) -> None:
        self._prefix, self._picture_ns, self._stamp_ns, self._planes = prefix, picture_ns, stamp_ns, planes
        self._frame_id = views.ground.frame_of(prefix)
        self._is_framed = False
        #: Where the ground's frame is named.
        self.frame_topic = f"{prefix}/view/tf"

    def views(self, shown: Mapping[str, Shown], start_ns: int) -> Iterator[View]:
        """All views of these channels, and the frame in which scenes lie, which is there from the start."""
        for topic, channel in shown.items():
            made_from = Provenance(VIEW, {}, topic, channel.digest)
            group = channel.made_by
            if topic == f"{self._prefix}/ground_plane":
                outline = views.ground.outlines(self._planes, start_ns, self._frame_id)
                yield View(topic + views.SCENE_SUFFIX, foxglove.SCENE, made_from, group, outline)
            if channel.schema not in views.DRAWN or topic.endswith(_NOT_SHOWN) or topic + FULL in shown:
                continue  # others show the same at more times
            is_retracked = channel.made_by in STAGES and STAGES[channel.made_by].repairs_tracks
            drawing = views.Drawing(topic, channel.schema, channel.frames, self._planes, is_retracked)
            if len(self._picture_ns):
                drawn = drawing.on_pictures(self._picture_ns, self._stamp_ns)
                yield View(topic + views.SUFFIX, foxglove.ANNOTATIONS, made_from, group, drawn)
            if channel.schema in _ON_GROUND:
                own_ns = frame_times(channel.frames)
                t_ns = self._picture_ns if len(self._picture_ns) else own_ns
                scene = drawing.on_ground(t_ns, self._frame_id)
                yield View(topic + views.SCENE_SUFFIX, foxglove.SCENE, made_from, group, scene)
        on_ground = {topic: channel for topic, channel in shown.items() if channel.schema in _ON_GROUND}
        if on_ground and not self._is_framed:
            self._is_framed = True
            frame = foxglove.pack_transform(start_ns, views.ground.world_of(self._prefix), self._frame_id)
            topic, channel = next(iter(on_ground.items()))
            made_from = Provenance(VIEW, {}, topic, channel.digest)
            yield View(self.frame_topic, foxglove.TRANSFORM, made_from, "", iter([(start_ns, 0, frame)]))

    def there(
        self, topics: set[str], video: str | None, eye: Eye, last_step: int, is_truth_known: bool
    ) -> layouts.CameraChannels:
        """What layouts can show."""
        front = self._prefix + "/"
        names = frozenset(topic.removeprefix(front) for topic in topics if topic.startswith(front))
        return layouts.CameraChannels(self._prefix, names, video, self._frame_id, eye, last_step, is_truth_known)


def _start_ns(opened: log.Log, camera: Camera, shown: Mapping[str, Shown], picture_ns: Ints) -> int:
    """When a camera's first picture or row is."""
    known = [channel.topic for channel in opened.channels.values() if channel.schema_name in SCHEMAS]
    times = [picture_ns, *(opened.times(topic) for topic in known if topic in camera.topics)]
    times += [np.array([channel.frames[0].t_ns], np.int64) for channel in shown.values() if channel.frames]
    return min((int(some[0]) for some in times if len(some)), default=0)


def _frames(opened: log.Log, shown: Mapping[str, Shown], topic: str, schema: Schema) -> list[Frame]:
    """What was made just now, or stands in the log; nothing if the channel isn't there."""
    if topic in shown:
        return shown[topic].frames
    there = opened.channels.get(topic)
    return opened.frames(topic, schema) if there and there.schema_name == schema.name else []


def _last_step(opened: log.Log, prefix: str, shown: Mapping[str, Shown]) -> int:
    """How many steps forecasts go ahead; 0 if there are none."""
    for name in ("retracks/predictions", "predictions"):
        frames = _frames(opened, shown, f"{prefix}/{name}", PREDICTIONS)
        last = max((int(frame.rows["step"].max()) for frame in frames if len(frame.rows)), default=0)
        if last:
            return last
    return 0


def _is_truth_known(opened: log.Log, prefix: str, shown: Mapping[str, Shown]) -> bool:
    """Whether any forecast is compared with the ground truth."""
    for name in ("retracks/predictions", "predictions"):
        frames = _frames(opened, shown, f"{prefix}/{name}/scores", FORECAST_SCORES)
        if any(np.isfinite(frame.rows["ade_m"]).any() for frame in frames):
            return True
    return False


def _places(opened: log.Log, prefix: str, shown: Mapping[str, Shown]) -> NDArray[np.float64]:
    """Where people are (N, 2) m, by the first channel of tracks that knows."""
    for name in ("retracks", "tracks", "truth", "samples"):
        frames = _frames(opened, shown, f"{prefix}/{name}", TRACKS)
        rows = TRACKS.joined([frame.rows for frame in frames])
        places = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
        if np.isfinite(places).all(axis=1).any():
            return places
    return np.empty((0, 2))


def _with_number(number: int, messages: Iterable[tuple[int, int, bytes]]) -> Iterator[Numbered]:
    return ((t_ns, number, sequence, data) for t_ns, sequence, data in messages)


def _write_by_time(writer: log.LogWriter, streams: Iterable[Iterator[Numbered]]) -> None:
    """Messages of several channels, each by time, all together by time: so that those shown together stand together."""
    for t_ns, number, sequence, data in heapq.merge(*streams, key=lambda message: message[0]):
        writer.add_message(number, t_ns, sequence, data)


#: Channels without a view: they show what others show, at fewer times.
_NOT_SHOWN: Final = ("/samples", "/online")
#: What has a view in metres.
_ON_GROUND: Final = (TRACKS, PREDICTIONS, GROUND_PLANE)


def layout_path(path: Path, name: str) -> Path:
    """Where the layout of this name goes: beside the log."""
    return path.with_suffix(layouts.FILES[name])


def attachment_of(name: str) -> str:
    """The attachment that holds the layout of this name."""
    return f"mcaptrack{layouts.FILES[name]}"


#: The names of the layouts that there can be, the first the usual one.
LAYOUTS: Final = tuple(layouts.FILES)
ATTACHMENTS: Final = tuple(attachment_of(name) for name in layouts.FILES)


def find_views(opened: log.Log, prefix: str, topics: Sequence[str] = ()) -> list[str]:
    """The topics of the views that a layout switches on, or those of these channels.

    Raises McaptrackError if there are none.
    """
    if topics:
        return [opened.channel(_view_of(opened, topic)).topic for topic in topics]
    there = {
        topic.removeprefix(prefix + "/").removesuffix(views.SUFFIX)
        for topic in opened.channels
        if topic.startswith(prefix + "/") and topic.endswith(views.SUFFIX)
    }
    found = [f"{prefix}/{name}{views.SUFFIX}" for name in layouts.best_channels(there)]
    if not found:
        raise McaptrackError(f"{opened.path} has no views of {prefix} yet; {call('run', opened.path)} makes them")
    return found


def _view_of(opened: log.Log, topic: str) -> str:
    """The view that shows a channel: its own, or that of the same at the video's rate."""
    names = [topic] if topic.endswith(views.SUFFIX) else [topic + views.SUFFIX, topic + FULL + views.SUFFIX]
    return next((name for name in names if name in opened.channels), names[0])
