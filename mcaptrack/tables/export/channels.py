"""Write the messages of many channels as tables in one pass over a log: each chunk is opened once for all of them.

Pieces of tables are made one after the other, and written by threads where there are several cores; the same bytes
come out, however many.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, nullcontext, suppress
from itertools import islice
from typing import Any, Final

from mcaptrack import environment, log
from mcaptrack.errors import McaptrackError
from mcaptrack.files import writing
from mcaptrack.log.messages import Payloads, Span
from mcaptrack.tables import ParquetTable, TypedMessages
from mcaptrack.tables.build import PendingRows
from mcaptrack.tables.messages import PIECE_BYTES

#: Tables that are written at once, each to an open file.
_MOST_AT_ONCE: Final = 256
#: Rows of all tables together wait for others of their piece in so many bytes at most.
_WAITING_BYTES: Final = 256 * 2**20


class ChannelFile:
    """The table of a channel that is being written; ``is_done`` says whether it was: not if it can't be read."""

    def __init__(self, messages: TypedMessages, file: ParquetTable) -> None:
        self.topic, self.total = messages.source.topic, messages.source.total
        self.messages, self.file = messages, file
        self.waiting, self.is_done = PendingRows(messages.schema, PIECE_BYTES), False
        self.is_open, self._stack = False, ExitStack()
        self._writing: Future[None] | None = None

    def write(self, piece: Any, threads: Executor | None) -> Future[None] | None:
        """Write a piece, behind those before it."""
        self._finish_writing()
        if not self.is_open:
            self._stack.enter_context(self.file.published())
            self.is_open = True
        if threads is None:
            self._add(piece)
        else:
            self._writing = threads.submit(self._add, piece)
        return self._writing

    def _add(self, piece: Any) -> None:
        with writing(self.file.path):
            self.file.add(piece)

    def _finish_writing(self) -> None:
        if self._writing is not None:
            self._writing.result()
            self._writing = None

    def publish(self) -> None:
        """Publish the file, of which all pieces were written."""
        self._finish_writing()
        self._stack.close()
        self.messages.warn()
        self.is_done = True

    def discard(self, error: BaseException) -> None:
        """Remove what was written, because of an error."""
        if self._writing is not None:
            wait([self._writing])
        with suppress(type(error), McaptrackError):  # which the file that failed has raised already
            self._stack.__exit__(type(error), error, error.__traceback__)


def write_in_one_pass(
    opened: log.Log,
    channels: Sequence[ChannelFile],
    span: Span,
    fail: Callable[[str, McaptrackError], None],
    progress: Callable[[int], None],
) -> None:
    """Write the tables of channels, with the messages in a span of time.

    ``fail`` gets the topic of a channel that can't be read, and why: it may raise the error, or leave the channel out.
    ``progress`` gets numbers of channels that are finished.
    """
    everything, done = iter(channels), 0
    while some := list(islice(everything, _MOST_AT_ONCE)):

        def tell(share: float, done: int = done, count: int = len(some)) -> None:
            progress(done + int(share * count))

        try:
            _Pass(some, fail).run(opened, span, tell)
        except BaseException as error:
            for channel in some:
                channel.discard(error)
            raise
        done += len(some)


class _Pass:
    def __init__(self, channels: Sequence[ChannelFile], fail: Callable[[str, McaptrackError], None]) -> None:
        self._by_topic = {channel.topic: channel for channel in channels}
        self._fail = fail
        self._cores = environment.threads()
        self._in_flight: deque[Future[None]] = deque()
        self._waiting_bytes = 0

    def run(self, opened: log.Log, span: Span, progress: Callable[[float], None]) -> None:
        topics, messages, done = list(self._by_topic), sum(channel.total for channel in self._by_topic.values()), 0
        with ThreadPoolExecutor(self._cores) if self._cores > 1 else nullcontext() as threads:
            for topic, batch in opened.payloads_of(topics, *span, self._lose):
                self._add(topic, batch, threads)
                done += len(batch.t_ns)
                progress(done / max(messages, 1))
            for channel in self._by_topic.values():
                if channel.waiting.rows or not channel.is_open:
                    self._write(channel, channel.waiting.rest(), threads)
            for channel in self._by_topic.values():
                channel.publish()

    def _lose(self, topic: str, count: int, why: str) -> None:
        self._try(topic, lambda channel: channel.messages.unread.lose(count, why))

    def _try(self, topic: str, work: Callable[[ChannelFile], None]) -> None:
        if topic in self._by_topic:
            try:
                work(self._by_topic[topic])
            except McaptrackError as error:
                channel = self._by_topic.pop(topic)
                self._waiting_bytes -= channel.waiting.nbytes
                channel.discard(error)
                self._fail(topic, error)

    def _add(self, topic: str, batch: Payloads, threads: Executor | None) -> None:
        def add(channel: ChannelFile) -> None:
            before = channel.waiting.nbytes
            pieces = list(channel.waiting.add(channel.messages.rows(batch)))
            self._waiting_bytes += channel.waiting.nbytes - before
            for piece in pieces:
                self._write(channel, piece, threads)

        self._try(topic, add)
        while self._waiting_bytes > _WAITING_BYTES:
            largest = max(self._by_topic.values(), key=lambda channel: channel.waiting.nbytes)
            self._waiting_bytes -= largest.waiting.nbytes
            self._write(largest, largest.waiting.rest(), threads)

    def _write(self, channel: ChannelFile, piece: Any, threads: Executor | None) -> None:
        """Write a piece; not more wait for that than there are threads."""
        if len(self._in_flight) > self._cores:
            self._in_flight.popleft().result()
        writing = channel.write(piece, threads)
        if writing is not None:
            self._in_flight.append(writing)
