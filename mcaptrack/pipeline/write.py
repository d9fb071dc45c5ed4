"""Write the channels that stages made into the log, with views of them and layouts for Foxglove."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

from mcaptrack import choices, log
from mcaptrack.location import sibling
from mcaptrack.pipeline.staleness import digest_of
from mcaptrack.schema import TRACKS, Frame, Schema
from mcaptrack.schema.classes import class_names, classes_beside_rows, has_classes, only_class, without_class
from mcaptrack.schema.encodings import PROTOBUF, Encoding, encoded, record_of
from mcaptrack.schema.frame_columns import collect
from mcaptrack.schema.framing import frame_numbers, joined_parts
from mcaptrack.schema.own import columns_in_metadata
from mcaptrack.schema.provenance import VIEW, Provenance, digest
from mcaptrack.sources.cameras import provenance_of
from mcaptrack.sources.sidecar import check_topics, encoding_for

#: Log time in ns, channel number, sequence number and payload of a message.
Numbered = tuple[int, int, int, bytes]


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
        """Check the rows of frames against the schema, and put classes, own columns and the digest into the provenance.

        ``provenance`` has the names of classes for schemas with classes.
        """
        frames = collect(schema, frames)
        for _, _, joined in joined_parts(schema, frames):
            schema.check(joined.rows)
        names = provenance.classes if has_classes(schema) else {}
        only = only_class(schema, frames)
        class_id, columns = str(only) if only else "", columns_in_metadata(schema)
        provenance = replace(provenance, classes=names, class_id=class_id, columns=columns)
        channel = cls(schema, frames, provenance)
        beside = classes_beside_rows(provenance.class_id, names)
        return channel._replace(provenance=replace(provenance, digest=digest(channel.messages(), beside)))

    def messages(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield time in ns, sequence number and payload of each message, one by one: all of them take much memory."""
        if self.encoded is not None:
            return iter(self.encoded)
        return self._encoded()

    def _encoded(self) -> Iterator[tuple[int, int, bytes]]:
        for low, high, joined in joined_parts(self.schema, self.frames):
            rows = without_class(joined.rows) if self.provenance.class_id else joined.rows  # it is in the metadata
            numbers = frame_numbers(self.frames[low:high]).tolist()
            yield from zip(joined.t_ns.tolist(), numbers, self.schema.codec.encode_each(rows, joined.ends), strict=True)

    def record_in(self, encoding: Encoding) -> tuple[str, str, bytes]:
        """Return the schema record of the channel for messages in this encoding."""
        return foxglove_record(self.drawn, encoding) if self.drawn else record_of(self.schema, encoding)

    def messages_in(self, encoding: Encoding) -> Iterator[tuple[int, int, bytes]]:
        """Yield what ``messages`` does, in this encoding. Rows in CDR state their class, which takes no more bytes."""
        if self.drawn:
            return foxglove_messages(self.drawn, self.messages(), encoding)
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

    ``gone`` are the topics of the log that this run drops. What it says about a channel is of this run, or else of the
    log.
    """

    opened: log.Log
    prefix: str
    results: dict[str, Made]
    gone: Set[str] = frozenset()

    def provenance(self, topic: str) -> Provenance | None:
        """Return how a channel was made; None if it is missing or recorded."""
        return self.results[topic].provenance if topic in self.results else provenance_of(self.opened, topic)

    def holds(self, topic: str, schema: Schema) -> bool:
        """Return whether a channel has rows of a schema."""
        if topic in self.results:
            return self.results[topic].schema is schema
        return topic not in self.gone and self.opened.holds(topic, schema)

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


class View(NamedTuple):
    """A channel that draws another; ``messages`` are time in ns, sequence number and payload."""

    topic: str
    schema_name: str
    provenance: Provenance
    group: str
    messages: Iterator[tuple[int, int, bytes]]


class Views(NamedTuple):
    """Views of channels that stay as they are, and of those of a run; topics that they replace; layouts by name."""

    first: Sequence[View] = ()
    last: Sequence[View] = ()
    outdated: Collection[str] = frozenset()
    layouts: Mapping[str, bytes] = {}

    @property
    def topics(self) -> set[str]:
        """The topics of all views."""
        return {view.topic for view in (*self.first, *self.last)}


def write(state: RunState, output: Path | None, views: Views | None = None) -> bool:
    """Write the channels of a run into the log, or into a copy at ``output``, with their views and layouts.

    Without ``views`` those of earlier rows are dropped. Returns whether there was anything to write.
    """
    opened, _, results, gone = state
    if not (results or gone) and output is None and not (views and views.topics):
        return False
    replaced = {*gone} | ({*views.outdated} if views else _outdated_views(state))
    drawn = views or Views()
    topics, encoding = {*results, *drawn.topics}, encoding_for(opened)
    log.refuse_to_replace_recorded(opened, topics | replaced, "write to another channel")
    check_topics(topics, encoding)
    made = {attachment_of(name): content for name, content in drawn.layouts.items()}
    layouts = {name: content for name, content in made.items() if opened.attachment(name) != content}
    dropped = {*ATTACHMENTS} - (made.keys() - layouts.keys()) if views else ()
    with log.extend(opened, output, drop={*results, *replaced}, drop_attachments=sorted(dropped)) as writer:
        streams = add_views(writer, drawn.first, encoding)
        for topic, channel in results.items():
            made_by = channel.provenance.transform  # outputs of a stage are dropped together: they share chunks
            record, metadata = channel.record_in(encoding), channel.provenance.to_metadata()
            number = writer.add_channel(topic, record, encoding, metadata, group=made_by)
            streams.append(_with_number(number, channel.messages_in(encoding)))
        write_by_time(writer, [*streams, *add_views(writer, drawn.last, encoding)])
        for name, content in layouts.items():
            writer.add_attachment(name, "application/json", content)
    return True


def _outdated_views(state: RunState) -> set[str]:
    """Return the views of the log that show earlier rows of the channels of this run."""
    provenances = ((topic, Provenance.from_metadata(at.metadata)) for topic, at in state.opened.channels.items())
    return {
        topic
        for topic, how in provenances
        if how and how.transform == VIEW and how.input in state.results
        if how.input_digest != state.digest(how.input)
    }


def add_views(writer: log.LogWriter, views: Iterable[View], encoding: Encoding) -> list[Iterator[Numbered]]:
    """Add the channels of views to a log, and return their messages."""
    streams = []
    for view in views:
        record, metadata = foxglove_record(view.schema_name, encoding), view.provenance.to_metadata()
        number = writer.add_channel(view.topic, record, encoding, metadata, "views", view.group)
        streams.append(_with_number(number, foxglove_messages(view.schema_name, view.messages, encoding)))
    return streams


def foxglove_record(schema_name: str, encoding: Encoding) -> tuple[str, str, bytes]:
    """Return the schema record of messages for viewers; only logs with views need the room that makes them."""
    from mcaptrack import foxglove

    return foxglove.record_in(schema_name, encoding)


def foxglove_messages(
    schema_name: str, messages: Iterable[tuple[int, int, bytes]], encoding: Encoding
) -> Iterator[tuple[int, int, bytes]]:
    """Yield messages for viewers in an encoding."""
    from mcaptrack import foxglove

    return foxglove.messages_in(schema_name, messages, encoding)


def _with_number(number: int, messages: Iterable[tuple[int, int, bytes]]) -> Iterator[Numbered]:
    return ((t_ns, number, sequence, data) for t_ns, sequence, data in messages)


def write_by_time(writer: log.LogWriter, streams: Iterable[Iterator[Numbered]]) -> None:
    """Merge channels that are each sorted by time, so that messages shown together are close together in the log."""
    for t_ns, number, sequence, data in heapq.merge(*streams, key=lambda message: message[0]):
        writer.add_message(number, t_ns, sequence, data)


def layout_path(path: Path, name: str) -> Path:
    """Return the path for the layout of this name, beside the log."""
    return sibling(path, LAYOUTS[name])


def attachment_of(name: str) -> str:
    """Return the name of the attachment for the layout of this name."""
    return f"mcaptrack{LAYOUTS[name]}"


#: The names of all layouts; the first one is the default.
LAYOUTS: Final = choices.LAYOUTS
ATTACHMENTS: Final = tuple(attachment_of(name) for name in LAYOUTS)
