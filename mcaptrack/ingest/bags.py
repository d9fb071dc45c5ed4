"""Recordings of others -> a log with everything that is in them: messages, schemas and times as they are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Final

from mcaptrack import foreign, log
from mcaptrack.errors import McaptrackError
from mcaptrack.ingest.job import IngestOptions, PictureJob, Progress
from mcaptrack.ingest.source import Connection, Found, Source
from mcaptrack.plane import GroundPlane
from mcaptrack.video import Encoded, brightness

#: A larger message would make a chunk that no careful reader opens.
_MAX_MESSAGE_BYTES: Final = 2**28 - 2**24
_PROGRESS_EVERY: Final = 256


class LogJob(PictureJob):
    """A recording, with labels beside its pictures."""

    def __init__(self, source: Path, options: IngestOptions, recorded: Source, progress: Progress) -> None:
        self._recorded, self._progress = recorded, progress
        try:
            for given, name in (
                (options.fps, "--fps"),
                (options.start_ns is not None, "--start-time"),
                (options.for_videos(), options.for_videos()),
                (options.role, "--as"),
            ):
                if given:
                    raise McaptrackError(
                        f"{source} is a log: its messages stay as they are, and so do their times; leave {name} out"
                    )
            super().__init__(source, options)
            #: What is passed on as a whole, if anything is.
            self._passed_on: log.Log | None = None
            #: The connections with the pictures that labels belong to.
            self._pictures: list[Connection] = []
            self._channels: dict[Connection, int] = {}
            self._written: dict[int, int] = {}
            if self.labels or self.homography:
                self.prefix, self._pictures = self._find_pictures()
        except BaseException:
            recorded.close()
            raise
        self._close.callback(recorded.close)

    def _find_pictures(self) -> tuple[str, list[Connection]]:
        """The camera that labels belong to: the only one with pictures, or the one that --camera names."""
        by_topic: dict[str, list[Connection]] = {}
        for connection in self._recorded.connections:
            is_empty = self._recorded.claims is not None and not self._recorded.claims[connection]
            if foreign.is_picture(connection.schema[0]) and not is_empty:
                by_topic.setdefault(connection.topic, []).append(connection)
        there = ", ".join(sorted(by_topic)) or "none"
        chosen = [topic for topic in by_topic if _prefix(topic) == self.prefix]
        if not chosen and self.options.camera == "camera":
            chosen = list(by_topic)
        if len(chosen) != 1:
            raise McaptrackError(
                f"{self.source}: labels and ground planes belong to the pictures of one camera; the log has {there}. "
                "Choose one with --camera, the part of its topic before the last /"
            )
        return _prefix(chosen[0]), by_topic[chosen[0]]

    def topics(self) -> Iterator[str]:
        """The topics that are new in the log: of a recording that is passed on, those of labels."""
        if not self._passed_on:
            yield from {connection.topic: None for connection in self._recorded.connections}
        yield from super().topics()

    def opened(self, output: Path, into: log.Log | None, force: bool) -> AbstractContextManager[log.LogWriter]:
        """As for all jobs; an MCAP file that becomes a new log is copied as it is."""
        if into is not None:
            itself = self._recorded.as_it_is
            if itself is not None and itself.real_path == into.real_path:
                raise McaptrackError(f"{self.source} can't be added to itself")
            return log.extend(into, drop=self.taken(into, force))
        self._passed_on = self._recorded.as_it_is
        if self._passed_on is not None:
            return log.extend(self._passed_on, output, drop=self.taken(self._passed_on, force))
        doubled = {c.topic for c in self._recorded.connections} & set(super().topics())
        if doubled:
            raise McaptrackError(f"{self.source} has {', '.join(sorted(doubled))} already; leave those labels out")
        return log.create(output, self._recorded.profile)

    def write(self, writer: log.LogWriter, has_clock: bool) -> None:
        """Write all that the recording holds, then labels."""
        times = self._pass_on(writer) if self._passed_on else self._write_messages(writer)
        self._recorded.extras(writer, has_clock, passed_on=self._passed_on is not None)
        if self._pictures:
            if not times:
                raise McaptrackError(
                    f"{self.source}: {self._pictures[0].topic} has no pictures that labels could be of"
                )
            self.write_plane(writer, self._plane(), times[0])
            self.write_labels(writer, self._plane(), {role: self.label_times(role, times) for role in self.labels})

    def check(self, output: Path) -> None:
        """Every channel has the messages that were given to it."""
        with log.read(output) as done:
            index = done.parts[-1].index
            for number, count in self._written.items():
                there = index.counts.get(number, 0)
                if there != count:
                    topic = index.channels[number].topic if number in index.channels else "a channel"
                    raise McaptrackError(
                        f"{output} is not complete: {there} messages of {topic} where {self.source} has {count}"
                    )

    # Messages

    def _pass_on(self, writer: log.LogWriter) -> list[int]:
        """Count what is in the log that is passed on as it is; returns the times of the pictures."""
        opened = self._passed_on
        assert opened is not None
        for number in writer.channels:
            self._written[number] = opened.index.counts.get(number, 0)
            if not self._written[number]:  # some writers describe channels without messages in the summary alone
                writer.put_description(number)
        self._report({number: channel.topic for number, channel in writer.channels.items()})
        found = Found()
        if not self._pictures:
            return []
        if len(self._pictures) == 1:
            return list(map(int, opened.times(self._pictures[0].topic)))
        return sorted(m.t_ns for c, m in self._recorded.messages(found) if c in self._pictures)

    def _write_messages(self, writer: log.LogWriter) -> list[int]:
        """Write all channels and messages; returns the times of the pictures."""
        found, done, times = Found(), 0, list[int]()
        for connection in self._recorded.connections:
            self._channel(writer, connection)
        total = sum((self._recorded.claims or {}).values())
        for connection, message in self._recorded.messages(found):
            number = self._channels[connection]
            if len(message.payload) > _MAX_MESSAGE_BYTES:
                raise McaptrackError(
                    f"{self.source}: {connection.topic} at {message.t_ns} ns: "
                    f"a message of {len(message.payload)} bytes; at most {_MAX_MESSAGE_BYTES} go into a log"
                )
            writer.add_message(number, message.t_ns, message.sequence, message.payload, message.publish_ns)
            self._written[number] += 1
            if connection in self._pictures:
                times.append(message.t_ns)
            done += 1
            if done % _PROGRESS_EVERY == 0:
                self._progress("ingest", done, max(total, done))
        self._progress("ingest", done, max(total, done))
        self.report.notes += found.notes
        self.report.lost += found.lost
        self._compare()
        self._report({number: connection.topic for connection, number in self._channels.items()})
        return sorted(times)

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
        """What was read with what the recording says that it holds."""
        for connection, said in (self._recorded.claims or {}).items():
            count = self._written[self._channels[connection]]
            if count < said and self.report.lost:
                self.report.lost.append(f"{connection.topic}: {said - count} of {said} messages")
            elif count != said:
                raise McaptrackError(
                    f"{self.source} does not add up: its index counts {said} messages of {connection.topic}, "
                    f"and {count} are there"
                )

    def _report(self, topics: dict[int, str]) -> None:
        counts: Counter[str] = Counter()
        for number, topic in topics.items():
            counts[topic] += self._written.get(number, 0)
        self.report.messages |= counts

    # Pictures

    def _plane(self) -> GroundPlane | None:
        if self.homography is None:
            return None
        first = next(brightness(self._encoded()), None)
        if first is None:
            raise McaptrackError(f"{self.source}: {self._pictures[0].topic} has no picture that can be decoded")
        height, width = first.rows.shape
        return self.plane(width, height)

    def _encoded(self) -> Iterator[Encoded]:
        """The pictures that labels belong to, as far as anybody asks."""
        topic = self._pictures[0].topic
        decoders = {
            connection: foreign.picture_decoder(foreign.Kind(*connection.schema, connection.encoding))
            for connection in self._pictures
        }
        for index, (connection, message) in enumerate(self._recorded.messages(Found())):
            if connection in decoders:
                picture = decoders[connection](message.payload)
                where = f"{self.source}: {topic} at {message.t_ns} ns"
                yield Encoded(message.t_ns, index, picture.format, picture.data, picture.layout, where)


def _prefix(topic: str) -> str:
    """What everything of a camera lies under."""
    folder, slash, _ = topic.strip("/").rpartition("/")
    return f"/{folder}" if slash else "/camera"
