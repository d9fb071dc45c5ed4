"""Write the channels that stages made into the log, with views of them and layouts for Foxglove."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack import foxglove, log
from mcaptrack.foxglove import views
from mcaptrack.foxglove.views import layouts
from mcaptrack.foxglove.views.layouts import ERRORS, PEOPLE, SPREAD
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.plane import Planes, moved_planes
from mcaptrack.location import sibling
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import describe_origin, may_replace
from mcaptrack.pipeline.drawing import (
    ChannelToDraw,
    View,
    ViewFactory,
    calibrated_cameras,
    frame_topic,
    has_bodies,
    is_drawn_by_viewers,
    new_frames,
    recorded_drawings,
    recorded_sources,
    robot_frame,
)
from mcaptrack.pipeline.scene_views import picture_clock, scene_on_pictures
from mcaptrack.pipeline.staleness import digest_of
from mcaptrack.schema import (
    COUNTS,
    DETECTIONS,
    EVENTS,
    FORECAST_SCORES,
    GROUND_PLANE,
    PREDICTIONS,
    SCHEMAS,
    TRACKS,
    Frame,
    Schema,
)
from mcaptrack.schema.classes import class_names, classes_beside_rows, has_classes, only_class, without_class
from mcaptrack.schema.encodings import PROTOBUF, Encoding, encoded, record_of
from mcaptrack.schema.frame_columns import collect
from mcaptrack.schema.framing import has_any, join_frames, joined_parts, thinned, unique_values
from mcaptrack.schema.provenance import INGEST, VIEW, Provenance, digest, frame_id_of
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import Camera, camera_at, provenance_of
from mcaptrack.sources.fixed_frame import transforms_of
from mcaptrack.sources.ingest.sidecar import check_topics, encoding_for

#: Log time in ns, channel number, sequence number and payload of a message.
Numbered = tuple[int, int, int, bytes]
#: Endings of the topics of forecasts, and of the online tracks that they belong to.
_PREDICTED, _ONLINE = "/predictions", "/online"
#: Where views look from follows from about so many rows at most.
_MOST_ROWS: Final = 200_000


class Made(NamedTuple):
    """A channel that this run made.

    It consists of ``frames`` of ``schema``, or of ``encoded``, messages (time in ns, sequence number, payload) for
    viewers, of the schema ``drawn``.
    """

    schema: Schema
    frames: Sequence[Frame]
    provenance: Provenance
    encoded: Collection[tuple[int, int, bytes]] | None = None
    drawn: str = ""

    @classmethod
    def of(cls, schema: Schema, frames: Sequence[Frame], provenance: Provenance) -> Made:
        """Check the rows of frames against the schema, and put classes and digest of the messages into the provenance.

        ``provenance`` has the names of classes for schemas with classes.
        """
        frames = collect(schema, frames)
        for _, _, joined in joined_parts(schema, frames):
            schema.check(joined.rows)
        names = provenance.classes if has_classes(schema) else {}
        only = only_class(schema, frames)
        provenance = replace(provenance, classes=names, class_id=str(only) if only else "")
        channel = cls(schema, frames, provenance)
        beside = classes_beside_rows(provenance.class_id, names)
        return channel._replace(provenance=replace(provenance, digest=digest(channel.messages(), beside)))

    def messages(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield time in ns, sequence number and payload of each message, one by one: all of them take much memory."""
        if self.encoded is not None:
            return iter(self.encoded)
        encode = self.schema.codec.encode
        if self.provenance.class_id:  # it stands in the metadata instead
            return ((frame.t_ns, frame.index, encode(without_class(frame.rows))) for frame in self.frames)
        return ((frame.t_ns, frame.index, encode(frame.rows)) for frame in self.frames)

    def record_in(self, encoding: Encoding) -> tuple[str, str, bytes]:
        """Return the schema record of the channel for messages in this encoding."""
        return foxglove.record_in(self.drawn, encoding) if self.drawn else record_of(self.schema, encoding)

    def messages_in(self, encoding: Encoding) -> Iterator[tuple[int, int, bytes]]:
        """Yield what ``messages`` does, in this encoding. Rows in CDR state their class, which takes no more bytes."""
        if self.drawn:
            return foxglove.messages_in(self.drawn, self.messages(), encoding)
        return self.messages() if encoding == PROTOBUF else encoded(self.schema, self.frames, encoding)

    def size(self) -> int:
        """Return the number of messages."""
        return len(self.frames if self.encoded is None else self.encoded)


class DrawnMessages(Collection[tuple[int, int, bytes]]):
    """Messages for viewers that are made each time they are read: all of them take much memory."""

    def __init__(self, count: int, draw: Callable[[], Iterator[tuple[int, int, bytes]]]) -> None:
        self._count, self._draw = count, draw

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[tuple[int, int, bytes]]:
        return self._draw()

    def __contains__(self, message: object) -> bool:
        return any(message == own for own in self)


class RunState(NamedTuple):
    """A log, the name of a camera in it, and the channels that this run has made so far, by topic.

    What it says about a channel is of this run, or else of the log.
    """

    opened: log.Log
    prefix: str
    results: dict[str, Made]

    def provenance(self, topic: str) -> Provenance | None:
        """Return how a channel was made; None if it is missing or recorded."""
        return self.results[topic].provenance if topic in self.results else provenance_of(self.opened, topic)

    def holds(self, topic: str, schema: Schema) -> bool:
        """Return whether a channel has rows of a schema."""
        if topic in self.results:
            return self.results[topic].schema is schema
        channel = self.opened.channels.get(topic)
        return channel is not None and channel.holds(schema)

    def frames(self, topic: str, schema: Schema = TRACKS) -> Sequence[Frame]:
        """Return the frames of a channel; none if it has no rows of the schema."""
        if not self.holds(topic, schema):
            return ()
        return self.results[topic].frames if topic in self.results else self.opened.frame_columns(topic, schema)

    def digest(self, topic: str) -> str:
        """Return the digest of the messages of a channel."""
        return self.results[topic].provenance.digest if topic in self.results else digest_of(self.opened, topic)

    def classes(self, topic: str) -> dict[int, str]:
        """Return the names of the classes of a channel by number."""
        how = self.results[topic].provenance if topic in self.results else None
        return class_names(how.to_metadata() if how else self.opened.channel(topic).metadata)


# The largest values that the plots of a layout show, so that their axes have room for all of them.


#: The channels of each plot below the prefix of a camera, and the columns of each that it may show. Of forecasts, one
#: channel is shown: the first with such values.
_PLOTS: Final[Mapping[str, tuple[Schema, tuple[str, ...], tuple[str, ...]]]] = {
    PEOPLE: (COUNTS, ("tracks/counts", "retracks/counts", "retracks/full/counts"), ("tracked", "people")),
    ERRORS: (
        FORECAST_SCORES,
        ("predictions/scores", "retracks/predictions/scores"),
        ("ade_m", "fde_m", "later_ade_m", "later_fde_m"),
    ),
    SPREAD: (FORECAST_SCORES, ("retracks/predictions/scores", "predictions/scores"), ("spread_mean_m", "spread_90_m")),
}


def highest_values(prefix: str, frames_of: Callable[[str, Schema], Sequence[Frame]]) -> dict[str, float]:
    """Return the largest value of each plot, as far as it is known.

    ``frames_of`` returns the frames of a topic with rows of a schema; empty if there are none.
    """
    out: dict[str, float] = {}
    for plot, (schema, names, columns) in _PLOTS.items():
        for name in names:
            if plot == SPREAD and plot in out:
                break
            for _, _, joined in joined_parts(schema, frames_of(f"{prefix}/{name}", schema)):
                for column in columns:
                    values = np.asarray(joined.rows[column], np.float64)
                    finite = values[np.isfinite(values)]
                    if len(finite):
                        out[plot] = max(out.get(plot, 0.0), float(finite.max()))
    return out


def write(
    state: RunState,
    planes: Planes,
    stamps: Mapping[str, Sequence[int]],
    output: Path | None,
    path: CameraPath | None = None,
    boxes: Mapping[str, foreign.NamedFrames] = {},
    gone: Collection[str] = (),
) -> dict[str, bytes]:
    """Write the channels of a run, their views and layouts into the log, or into a copy at ``output``.

    Returns the layouts by name. Channels at the topics ``gone`` are dropped.

    ``boxes`` are recorded boxes in space that this run has read, by topic; those that viewers don't draw get a view.

    ``path`` is how the camera moves, if its tracks are compensated for it: so are views, and ``planes`` with it.
    ``stamps`` are the capture times in ns of pictures that stages have read, by topic.
    """
    opened, prefix, results = state
    camera = camera_at(opened, prefix)
    video, picture_ns, stamp_ns = picture_clock(opened, prefix, stamps)
    shown = _channels_to_draw(opened, camera, results) | _boxes_to_draw(opened, boxes)
    outdated = {topic + suffix for topic in shown for suffix in views.SUFFIXES}
    planes = moved_planes(planes, path)
    frame_id = _frame_id(opened, prefix, shown)
    is_framed = bool(frame_id) or any(channel.frame_id for channel in shown.values())
    tree = transforms_of(opened) if is_framed else None
    frames = new_frames(prefix, shown, tree.frames() if tree else ())
    solid_in = next((channel.frame_id for channel in shown.values() if channel.is_solid()), "")
    cameras = calibrated_cameras(opened, solid_in) if solid_in and tree else {}
    outdated |= {view for view in opened.channels for topic in shown if view.startswith(f"{topic}{views.SUFFIX}/")}
    scene = scene_on_pictures(state)
    seen_on = (*cameras, *(seen.pictures for seen in scene.cameras))
    outdated |= {topic + views.SUFFIX + pictures for topic in shown for pictures in seen_on}
    drawn = ViewFactory(prefix, picture_ns, stamp_ns, planes, path, frames, cameras, scene)
    if frames:
        outdated.add(frame_topic(prefix))
    recorded = {topic for topic in outdated if not may_replace(opened, topic, VIEW)}
    outdated = (outdated - recorded) | {*gone}
    for topic in sorted(recorded):
        warn(f"no view at {topic}, which {describe_origin(opened, topic)}", "left-out")
    # Read everything before anything is written, because the log is changed in place.
    start_ns = _start_ns(opened, camera, shown, picture_ns)
    current = shown | {topic: _nothing(opened, topic) for topic in gone}
    eye = layouts.eye_on(_positions(opened, prefix, current), planes, start_ns)
    last_step, is_truth_known = (_last_step(opened, prefix, current), _is_truth_known(opened, prefix, current))
    sources = recorded_sources(opened, [*camera.topics, *(channel.provenance.input for channel in results.values())])
    follow = robot_frame(opened, sources, tree, frame_id) if tree and frame_id else ""
    by_viewers = recorded_drawings(opened, sources) if frame_id else {}
    floor_m = _floor_m(opened, prefix, current) if frame_id else 0.0
    highest = highest_values(prefix, lambda topic, schema: _frames(opened, current, topic, schema))
    # Write views of unchanged channels first, so that channels made again keep their place and the log its bytes.
    first, last = ({t: c for t, c in shown.items() if (t in results) is is_made} for is_made in (False, True))
    drawn_first = [view for view in drawn.views(first, start_ns) if view.topic not in recorded]
    drawn_last = [view for view in drawn.views(last, start_ns) if view.topic not in recorded]
    topics = {*opened.channels} - outdated | {*results} | {view.topic for view in (*drawn_first, *drawn_last)}
    by_viewers |= {source + views.SCENE_SUFFIX: True for source in sources if source + views.SCENE_SUFFIX in topics}
    names = frozenset(topic.removeprefix(prefix + "/") for topic in topics if topic.startswith(prefix + "/"))
    frame_id = frame_id or views.ground.frame_of(prefix)
    channels = layouts.CameraChannels(
        prefix, names, video, frame_id, eye._replace(z_m=floor_m), last_step, is_truth_known, follow, by_viewers,
        seen_on, highest,
    )  # fmt: skip
    layout_files = layouts.make(channels)
    new = {attachment_of(name): content for name, content in layout_files.items()}
    unchanged = {name for name, content in new.items() if opened.attachment(name) == content}
    replaced = [name for name in ATTACHMENTS if name not in unchanged]
    new_topics = {*results, *outdated, *(view.topic for view in (*drawn_first, *drawn_last))}
    log.refuse_to_replace_recorded(opened, new_topics, "write to another channel")
    encoding = encoding_for(opened)
    check_topics({*results, *(view.topic for view in (*drawn_first, *drawn_last))}, encoding)
    with log.extend(opened, output, drop={*results, *outdated}, drop_attachments=replaced) as writer:
        streams: list[Iterator[Numbered]] = []

        def add_views(some: Iterable[View]) -> None:
            for view in some:
                record = foxglove.record_in(view.schema_name, encoding)
                metadata = view.provenance.to_metadata()
                number = writer.add_channel(view.topic, record, encoding, metadata, "views", view.group)
                streams.append(_with_number(number, foxglove.messages_in(view.schema_name, view.messages, encoding)))

        add_views(drawn_first)
        for topic, channel in results.items():
            made_by = channel.provenance.transform  # outputs of a stage are dropped together: they share chunks
            record, metadata = channel.record_in(encoding), channel.provenance.to_metadata()
            number = writer.add_channel(topic, record, encoding, metadata, group=made_by)
            streams.append(_with_number(number, channel.messages_in(encoding)))
        add_views(drawn_last)
        _write_by_time(writer, streams)
        for name, content in new.items():
            if name not in unchanged:
                writer.add_attachment(name, "application/json", content)
    return layout_files


def _channels_to_draw(opened: log.Log, camera: Camera, results: Mapping[str, Made]) -> dict[str, ChannelToDraw]:
    """Return the channels that get views, by topic: those of this run, and ingested ones without a current view."""
    shown = {
        topic: ChannelToDraw(
            channel.schema, channel.frames, how.digest, how.transform, class_names(how.to_metadata()), how.frame_id
        )
        for topic, channel in results.items()
        for how in (channel.provenance,)
    }
    inputs = {topic: channel.provenance.input for topic, channel in results.items()}
    for topic, channel in sorted(opened.channels.items()):
        schema = SCHEMAS.get(channel.schema_name)
        provenance = Provenance.from_metadata(channel.metadata)
        if topic in shown or topic not in camera.topics or not provenance or provenance.transform != INGEST:
            continue
        drawn = opened.channels.get(topic + (views.SUFFIX if schema is DETECTIONS else views.SCENE_SUFFIX))
        drawn_from = Provenance.from_metadata(drawn.metadata) if drawn else None
        is_new = drawn_from is None or drawn_from.input_digest != provenance.digest
        if schema in (*views.DRAWN, GROUND_PLANE) and is_new:
            names, frame_id = class_names(channel.metadata), provenance.frame_id
            shown[topic] = ChannelToDraw(
                schema, opened.frame_columns(topic, schema), provenance.digest, "", names, frame_id
            )
            inputs[topic] = provenance.input
    for topic, drawing in shown.items():
        if drawing.schema is PREDICTIONS:
            shown[topic] = drawing._replace(bodies=_bodies(opened, shown, topic, inputs[topic]))
    return shown


def _nothing(opened: log.Log, topic: str) -> ChannelToDraw:
    """Return a channel that this run drops, as one without frames."""
    return ChannelToDraw(SCHEMAS.get(opened.channel(topic).schema_name, EVENTS), (), "", "", {}, "")


def _boxes_to_draw(opened: log.Log, boxes: Mapping[str, foreign.NamedFrames]) -> dict[str, ChannelToDraw]:
    """Return the recorded boxes that viewers can't draw, by topic."""
    return {
        topic: ChannelToDraw(DETECTIONS, box.frames, digest_of(opened, topic), "", box.classes, box.frame_id)
        for topic, box in boxes.items()
        if not is_drawn_by_viewers(opened.channel(topic)) and has_bodies(DETECTIONS, box.frames)
    }


def _bodies(opened: log.Log, shown: Mapping[str, ChannelToDraw], topic: str, source: str) -> Sequence[Frame]:
    """Return the tracks that forecasts belong to, if they have 3D boxes: those beside them, or those predicted from."""
    beside = topic.removesuffix(_PREDICTED)
    for name in (beside + _ONLINE, beside, source):
        frames = _frames(opened, shown, name, TRACKS)
        if len(frames):
            return frames if has_bodies(TRACKS, frames) else ()
    return ()


def _start_ns(opened: log.Log, camera: Camera, shown: Mapping[str, ChannelToDraw], picture_ns: Ints) -> int:
    """Return the time of a camera's first picture or row in ns; 0 if there is none."""
    row_topics = [channel.topic for channel in opened.channels.values() if channel.schema_name in SCHEMAS]
    times = [picture_ns, *(opened.times(topic) for topic in row_topics if topic in camera.topics)]
    times += [np.array([channel.frames[0].t_ns], np.int64) for channel in shown.values() if len(channel.frames)]
    return min((int(some[0]) for some in times if len(some)), default=0)


def _frames(opened: log.Log, shown: Mapping[str, ChannelToDraw], topic: str, schema: Schema) -> Sequence[Frame]:
    """Return the frames of a channel of this run or of the log; empty if there is none with such rows."""
    if topic in shown:
        return shown[topic].frames if shown[topic].schema is schema else ()
    channel = opened.channels.get(topic)
    return opened.frame_columns(topic, schema) if channel and channel.schema_name == schema.name else ()


def _last_step(opened: log.Log, prefix: str, shown: Mapping[str, ChannelToDraw]) -> int:
    """Return the horizon of forecasts as a number of steps; 0 if there are no forecasts."""
    for name in ("retracks/predictions", "predictions"):
        frames = _frames(opened, shown, f"{prefix}/{name}", PREDICTIONS)
        steps = unique_values(PREDICTIONS, frames, "step")
        if len(steps):
            return int(steps[-1])
    return 0


def _is_truth_known(opened: log.Log, prefix: str, shown: Mapping[str, ChannelToDraw]) -> bool:
    """Return whether any forecast is compared with the ground truth."""
    for name in ("retracks/predictions", "predictions"):
        frames = _frames(opened, shown, f"{prefix}/{name}/scores", FORECAST_SCORES)
        if has_any(FORECAST_SCORES, frames, lambda rows: np.isfinite(rows["ade_m"])):
            return True
    return False


def _positions(opened: log.Log, prefix: str, shown: Mapping[str, ChannelToDraw]) -> NDArray[np.float64]:
    """Return positions of people, (N, 2) in m, from the first channel of tracks that has any."""
    for name in ("retracks", "tracks", "truth", "samples"):
        frames = _frames(opened, shown, f"{prefix}/{name}", TRACKS)
        rows = join_frames(TRACKS, thinned(frames, _MOST_ROWS)).rows
        xy_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
        if np.isfinite(xy_m).all(axis=1).any():
            return xy_m
    return np.empty((0, 2))


def _frame_id(opened: log.Log, prefix: str, shown: Mapping[str, ChannelToDraw]) -> str:
    """Return the frame of the metres of a camera's tracks; "" for that of its ground plane."""
    for name in ("retracks/full", "retracks", "tracks", "truth", "samples"):
        topic = f"{prefix}/{name}"
        if topic in shown:
            return shown[topic].frame_id
        if topic in opened.channels:
            return frame_id_of(opened.channels[topic].metadata)
    return ""


def _floor_m(opened: log.Log, prefix: str, shown: Mapping[str, ChannelToDraw]) -> float:
    """Return the usual height of the bottoms of 3D boxes; 0 if there are none."""
    for name in ("retracks", "tracks", "truth", "samples"):
        frames = _frames(opened, shown, f"{prefix}/{name}", TRACKS)
        rows = join_frames(TRACKS, thinned(frames, _MOST_ROWS)).rows
        base_m = rows["z_m"] - rows["height_m"] / 2
        if np.isfinite(base_m).any():
            return round(float(np.nanmedian(base_m)), 1)
    return 0.0


def _with_number(number: int, messages: Iterable[tuple[int, int, bytes]]) -> Iterator[Numbered]:
    return ((t_ns, number, sequence, data) for t_ns, sequence, data in messages)


def _write_by_time(writer: log.LogWriter, streams: Iterable[Iterator[Numbered]]) -> None:
    """Merge channels that are each sorted by time, so that messages shown together are close together in the log."""
    for t_ns, number, sequence, data in heapq.merge(*streams, key=lambda message: message[0]):
        writer.add_message(number, t_ns, sequence, data)


def layout_path(path: Path, name: str) -> Path:
    """Return the path for the layout of this name, beside the log."""
    return sibling(path, layouts.FILES[name])


def attachment_of(name: str) -> str:
    """Return the name of the attachment for the layout of this name."""
    return f"mcaptrack{layouts.FILES[name]}"


#: The names of all layouts; the first one is the default.
LAYOUTS: Final = tuple(layouts.FILES)
ATTACHMENTS: Final = tuple(attachment_of(name) for name in layouts.FILES)
