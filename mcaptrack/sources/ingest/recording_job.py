"""Ingest recordings: a log with all of their messages, schemas and times unchanged."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.clocks import LAST_NS
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import warn
from mcaptrack.schema.encodings import CDR
from mcaptrack.sources import foreign
from mcaptrack.sources.calibrations import frame_named
from mcaptrack.sources.foreign.decoding import decoder_with_errors
from mcaptrack.sources.ingest.bags.recording import Connection, ReadingNotes, RecordingReader
from mcaptrack.sources.ingest.job import FOR_VIDEOS, IngestJob, IngestOptions, Progress
from mcaptrack.sources.ingest.labels.timeline import Timeline, choose_camera, picture_predicate, timeline_of
from mcaptrack.sources.ingest.sidecar import encoding_for
from mcaptrack.sources.pictures import size_of
from mcaptrack.sources.video import EncodedPicture

#: A larger message would need a chunk that readers with a size limit refuse.
_MAX_MESSAGE_BYTES: Final = 2**28 - 2**24
_PROGRESS_EVERY: Final = 256


class RecordingJob(IngestJob):
    """A recording, with labels for its pictures."""

    def __init__(
        self, source: Path, options: IngestOptions, recorded: RecordingReader, progress: Progress, into: log.Log | None
    ) -> None:
        self._recorded, self._progress = recorded, progress
        try:
            if name := options.given("fps", "start_ns", *FOR_VIDEOS, "role", "frames"):
                raise McaptrackError(
                    f"{source} is a log: its messages stay as they are, and so do their times; leave {name} out"
                )
            super().__init__(source, options, into)
            #: The MCAP file that is copied as a whole, if the recording is one.
            self._copied_log: log.Log | None = None
            #: The connections of the pictures that labels belong to.
            self._connections: list[Connection] = []
            self._channels: dict[Connection, int] = {}
            self._written: dict[int, int] = {}
            if self.labels or self.has_ground_given or self.motions is not None:
                self._find_pictures()
                self.fit_to_pictures(self._picture_size)
        except BaseException:
            recorded.close()
            raise
        self._close.callback(recorded.close)

    def _find_pictures(self) -> None:
        """Find the camera that labels belong to: the only one with pictures, or the one that ``camera`` names."""
        by_topic: dict[str, list[Connection]] = {}
        for connection in self._recorded.connections:
            is_empty = self._recorded.declared_counts is not None and not self._recorded.declared_counts[connection]
            if foreign.is_picture(connection.schema[0]) and not is_empty:
                by_topic.setdefault(connection.topic, []).append(connection)
        self.prefix, self.pictures = choose_camera(self.source, self.options.camera, by_topic)
        if not self.pictures:
            raise McaptrackError(
                f"{self.source}: labels and ground planes belong to the pictures of one camera; the log has "
                f"{', '.join(sorted(by_topic)) or 'none'}. Choose one with `camera=`, the part of its topic before the "
                "last /"
            )
        self._connections = by_topic[self.pictures]

    def topics(self) -> Iterator[str]:
        """The new topics: only those of labels, if an MCAP file is copied."""
        if not self._copied_log:
            yield from {connection.topic: None for connection in self._recorded.connections}
        yield from super().topics()

    def opened(self, output: Path, into: log.Log | None, force: bool) -> AbstractContextManager[log.LogWriter]:
        """As in the base class; an MCAP file that becomes a new log is copied as a whole."""
        if into is not None:
            itself = self._recorded.as_log
            if itself is not None and itself.real_path == into.real_path:
                raise McaptrackError(f"{self.source} can't be added to itself")
            self._warn_encodings(into)
            return log.extend(into, drop=self.topics_to_replace(into, force))
        self._copied_log = self._recorded.as_log
        if self._copied_log is not None:
            self.encoding = encoding_for(self._copied_log)
            return log.extend(self._copied_log, output, drop=self.topics_to_replace(self._copied_log, force))
        recorded = {connection.topic for connection in self._recorded.connections}
        doubled = recorded & set(super().topics())
        if doubled:
            raise McaptrackError(
                f"{self.source} has {', '.join(sorted(doubled))} already; {super().hint_other_topic(recorded)}"
            )
        return log.create(output, self._recorded.profile)

    def _warn_encodings(self, into: log.Log) -> None:
        """Warn if a recording of ROS 2 gets messages that ROS 2 can't read."""
        odd = sorted({connection.encoding or "none" for connection in self._recorded.connections} - {CDR})
        if self.encoding == CDR and odd:
            text = f"{into.path} gets messages that are not of ROS 2 (encoding: {', '.join(odd)})"
            warn(f"{text}; ROS tools may stumble over them", "other")

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write everything in the recording, then the labels."""
        self.report.notes += self._recorded.findings.notes
        self.report.lost += self._recorded.findings.lost
        timeline = self._count_copied(writer) if self._copied_log else self._write_messages(writer)
        self._recorded.extras(writer, has_clock, self._copied_log is not None)
        if self._connections:
            if not len(timeline.t_ns):
                raise McaptrackError(f"{self.source}: {self.pictures} has no pictures that labels could be of")
            plane = self._plane()
            self.write_plane(writer, plane, int(timeline.t_ns[0]))
            self.write_labels(writer, plane, timeline)
            if self.motions is not None:
                self.write_motion(writer, timeline, self._picture_size())

    def hint_other_topic(self, topics: Collection[str]) -> str:
        """A hint for topics that exist already."""
        return super().hint_other_topic(topics) if self._copied_log else "write it to a separate log with `output=`"

    def check(self, output: Path) -> None:
        """Check that every channel has all of its messages."""
        with log.read(output) as done:
            index = done.parts[-1].index
            for number, count in self._written.items():
                written = index.counts.get(number, 0)
                if written != count:
                    topic = index.channels[number].topic if number in index.channels else "a channel"
                    raise McaptrackError(
                        f"{output} is not complete: {written} messages of {topic} where {self.source} has {count}"
                    )

    # Messages

    def _count_copied(self, writer: log.LogWriter) -> Timeline:
        """Count the messages of the copied log; returns the pictures that labels belong to."""
        opened = self._copied_log
        assert opened is not None
        for number in writer.channels:
            self._written[number] = opened.index.counts.get(number, 0)
            if not self._written[number]:  # some writers write channels without messages only to the summary
                writer.write_description(number)
        self._report({number: channel.topic for number, channel in writer.channels.items()})
        if len(self._connections) == 1:
            return timeline_of(opened, self.pictures)
        holds_picture = self._holds_picture()
        return self._timeline(m.t_ns for c, m in self._recorded.messages(ReadingNotes()) if holds_picture(c, m.payload))

    def _timeline(self, t_ns: Iterable[int]) -> Timeline:
        in_order = sorted(t_ns)
        if in_order and in_order[-1] > LAST_NS:
            raise McaptrackError(
                f"{self.source}: {self.pictures} has pictures later than the year 2262, the last at {in_order[-1]} ns; "
                "labels can't be placed on such times"
            )
        times = np.array(in_order, np.int64)
        return Timeline(np.arange(len(times)), times, f"the pictures of {self.pictures}", not self.report.lost)

    def _holds_picture(self) -> Callable[[Connection, bytes], bool]:
        """A predicate: whether a message is one of the pictures that labels belong to."""
        kinds = {connection: picture_predicate(connection.kind) for connection in self._connections}
        return lambda connection, payload: connection in kinds and kinds[connection](payload)

    def _write_messages(self, writer: log.LogWriter) -> Timeline:
        """Write all channels and messages; returns the pictures that labels belong to."""
        reading_notes, done, times, holds_picture = ReadingNotes(), 0, array("Q"), self._holds_picture()
        for connection in self._recorded.connections:
            self._channel(writer, connection)
        total = sum((self._recorded.declared_counts or {}).values())
        for connection, message in self._recorded.messages(reading_notes):
            number = self._channels[connection]
            if len(message.payload) > _MAX_MESSAGE_BYTES:
                raise McaptrackError(
                    f"{self.source}: {connection.topic} at {message.t_ns} ns: "
                    f"a message of {len(message.payload)} bytes; at most {_MAX_MESSAGE_BYTES} go into a log"
                )
            writer.add_message(number, message.t_ns, message.sequence, message.payload, message.publish_ns)
            self._written[number] += 1
            if holds_picture(connection, message.payload):
                times.append(message.t_ns)
            done += 1
            if done % _PROGRESS_EVERY == 0:
                self._progress("ingest", done, max(total, done))
        self._progress("ingest", done, max(total, done))
        self.report.notes += reading_notes.notes
        self.report.lost += reading_notes.lost
        self._compare()
        self._report({number: connection.topic for connection, number in self._channels.items()})
        return self._timeline(times)

    def _channel(self, writer: log.LogWriter, connection: Connection) -> None:
        number = writer.add_channel(
            connection.topic,
            connection.schema,
            connection.encoding,
            connection.metadata,
            kind="media" if foreign.is_compressed(connection.schema[0]) else "rows",
            another=True,
        )
        self._channels[connection] = number
        self._written[number] = 0

    def _compare(self) -> None:
        """Compare the messages read with the counts that the recording declares."""
        for connection, declared in (self._recorded.declared_counts or {}).items():
            count = self._written[self._channels[connection]]
            if count < declared and self.report.lost:
                self.report.lost.append(f"{connection.topic}: {declared - count} of {declared} messages")
            elif count != declared:
                raise McaptrackError(
                    f"{self.source} does not add up: its index counts {declared} messages of {connection.topic}, "
                    f"and {count} are there"
                )

    def _report(self, topics: dict[int, str]) -> None:
        counts: Counter[str] = Counter()
        for number, topic in topics.items():
            counts[topic] += self._written.get(number, 0)
        self.report.messages |= counts

    # Pictures

    def _plane(self) -> GroundPlane | None:
        if not self.has_ground_given:
            return None
        self.frame_id = self._picture_frame()
        return self.plane(*self._picture_size())

    def _picture_frame(self) -> str:
        """The frame of reference of the pictures that labels belong to, by the first of them; "" if it names none."""
        for connection, message in self._recorded.messages(ReadingNotes()):
            if connection in self._connections:
                kind = connection.kind
                return str(decoder_with_errors(kind, frame_named)(message.payload))
        return ""

    def _picture_size(self) -> tuple[int, int]:
        """Width and height of the pictures that labels belong to."""
        size = size_of(self._encoded())
        if size is None:
            raise McaptrackError(f"{self.source}: {self.pictures} has no picture that can be decoded")
        return size

    def _encoded(self) -> Iterator[EncodedPicture]:
        """The pictures that labels belong to, lazily."""
        decoders = {connection: foreign.picture_decoder(connection.kind) for connection in self._connections}
        for index, (connection, message) in enumerate(self._recorded.messages(ReadingNotes())):
            if connection in decoders:
                where = f"{self.source}: {self.pictures} at {message.t_ns} ns"
                yield decoders[connection](message.payload).encoded(message.t_ns, index, where)
