"""An open log: tables for Arrow, arrays for NumPy, pictures, players for notebooks, any message by its place; and own
rows written into it.

Letters: N rows, H and W pixels.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from threading import RLock
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, Self, TypeVar
from weakref import WeakSet

import numpy as np
from mcap.decoder import DecoderFactory
from numpy.typing import NDArray

from mcaptrack import log as logs
from mcaptrack import tables
from mcaptrack.api.arrow_tables import show_tables
from mcaptrack.api.common import as_location, log_output, names_of, split_names
from mcaptrack.api.declared import Option, checked
from mcaptrack.api.messages import DecodedMessage, checked_factories, decoded_messages
from mcaptrack.api.options import PathLike, Progress, no_progress
from mcaptrack.api.rows import supervision_of
from mcaptrack.errors import McaptrackError, call, offer
from mcaptrack.files import refuse_overwrite
from mcaptrack.location import Location, Url
from mcaptrack.log import Log
from mcaptrack.registry import blamed
from mcaptrack.schema import DETECTIONS, SCHEMAS, TRACKS, Frame, Schema
from mcaptrack.schema.classes import class_names
from mcaptrack.sources.cameras import VIDEO
from mcaptrack.sources.foreign import holds_pictures
from mcaptrack.sources.own_rows import nanoseconds_of, times_of
from mcaptrack.sources.pictures import Pictures, find_pictures, only_pictures
from mcaptrack.sources.video import decode_bgr, decode_gray
from mcaptrack.tables import export
from mcaptrack.tables.export.contents import WHOLE, MessagesPart
from mcaptrack.viewing.serving import Choice, log_player

if TYPE_CHECKING:
    import pyarrow as pa
    from supervision import Detections

    from mcaptrack import Player

T = TypeVar("T")
Colour = Literal["bgr", "rgb", "grey"]
_Seconds = Annotated[float | None, Option(least=0, most=1e9)]


# Read single messages of a log by their place in the file, and pictures by their time.


_NEEDED: Final = ("chunk_offset", "message_offset")


class FetchedMessage(NamedTuple):
    """A message of a log.

    Attributes
    ----------
    topic : str
        The channel.
    t_ns, publish_ns : int
        When it was recorded and when it was sent, in nanoseconds.
    sequence : int
        The number that its sender gave it; 0 if none.
    payload : bytes
        Its bytes as they were recorded.

    """

    topic: str
    t_ns: int
    publish_ns: int
    sequence: int
    payload: bytes


def fetch_message(log: Log, row: Mapping[str, Any]) -> FetchedMessage:
    """Read the message that a row points to; see ``Recording.fetch``."""
    if isinstance(row, np.void):
        row = {name: row[name] for name in row.dtype.names or ()}
    missing = [name for name in _NEEDED if name not in row]
    if missing:
        raise McaptrackError(f"a row without {', '.join(missing)} does not say where its message is; rows of frames do")
    chunk, offset = (_whole(row[name]) for name in _NEEDED)
    file = row.get("file")
    part = next((part for part in log.parts if file in (None, part.path.name)), None)
    if part is None or offset is None:
        raise McaptrackError(f"{log.path}: the row points to byte {offset} of {file}, which is not part of this log")
    old = f"{part.path} has no such message at this place; export its tables again"
    try:
        topic, message = part.message_at(chunk, offset)
    except McaptrackError as error:
        raise McaptrackError(f"{old} ({error})") from None
    stated = (row.get("topic", topic), _whole(row.get("t_ns", message.t_ns)))
    if stated != (topic, message.t_ns):
        raise McaptrackError(old)
    return FetchedMessage(topic, message.t_ns, message.publish_ns, message.sequence, message.payload)


def _whole(value: Any) -> int | None:
    """Return a whole number of a table; pandas makes floats of columns in which some are missing."""
    return None if value is None or value != value else int(value)  # noqa: PLR0124  # NaN is not itself


def shown_pictures(opened: Log, topic: str, times: Sequence[int] | NDArray[Any]) -> dict[int, int]:
    """Return the numbers of the pictures that are shown at these times, and how often each occurs."""
    wanted = times_of(times, "`times=`")
    at = np.searchsorted(opened.times(topic), wanted, "right") - 1
    if len(at) and at.min() < 0:
        first = int(wanted[at.argmin()])
        raise McaptrackError(f"{opened.path}: {topic} has no picture at {first} ns; its first picture is later")
    numbers, counts = np.unique(at, return_counts=True)
    return dict(zip(numbers.tolist(), counts.tolist(), strict=True))


class LogReader:
    """An open log that can be read."""

    def __init__(self, path: Location) -> None:
        self._place = path if isinstance(path, Url) else path.absolute()  # wherever the working folder moves
        self._lock, self._process = RLock(), os.getpid()
        self._opened: WeakSet[Log] = WeakSet()  # also earlier ones, which iterators that were begun still read
        self._open(path)
        show_tables()

    def _open(self, path: Location) -> None:
        self._there = logs.read(path)
        self._opened.add(self._there)
        self._contents = export.LogTables(self._there)
        self._is_open = True

    @contextmanager
    def _now(self) -> Iterator[Log]:
        """Give the log as it is now, to this thread alone: it is opened again if its file, or its results, changed."""
        with self._alone():
            self._refuse_closed()
            if not logs.is_current(self._there, self._place):
                self._open(self._path_now())
            yield self._there

    def _alone(self) -> RLock:
        """Return the lock that a thread holds while it reads: what was read is kept, and read on from there."""
        if self._process != os.getpid():  # a fork copies the lock as it was, also if another thread held it
            self._lock, self._process = RLock(), os.getpid()
        return self._lock

    def _refuse_closed(self) -> None:
        if not self._is_open:
            raise McaptrackError(f"{self.path} is closed; {call('open', self.path)} opens it again")

    def _path_now(self) -> Location:
        """Return the path as it was given, unless it leads elsewhere from the present working folder."""
        path = self._there.path
        return path if isinstance(path, Url) or path.absolute() == self._place else self._place

    def __reduce__(self) -> tuple[type[Self], tuple[Location]]:
        """Open the log again where it is unpickled, as in another process."""
        self._refuse_closed()
        return type(self), (self._place,)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"mcaptrack.open({str(self.path)!r})"

    def close(self) -> None:
        """Close the file; iterators that were begun end with an error."""
        with self._alone():
            self._is_open = False
            for opened in self._opened:
                opened.__exit__()

    @property
    def path(self) -> Location:
        """The file of the log, or its URL."""
        return self._there.path

    @property
    def name(self) -> str:
        """The name of the log in the column ``recording`` of all tables."""
        return self._contents.recording

    @property
    def tables(self) -> tuple[str, ...]:
        """The names of all tables. Every log has all of them; some may have no rows."""
        return tuple(tables.TABLES)

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics of all channels, in alphabetical order."""
        if not self._is_open:
            return tuple(sorted(self._there.channels))
        with self._now() as opened:
            return tuple(sorted(opened.channels))

    @checked
    def table(
        self,
        name: str,
        topic: str | None = None,
        *,
        columns: str | Sequence[str] | None = None,
        blobs: bool = False,
        start: int | datetime | np.datetime64 | None = None,
        end: int | datetime | np.datetime64 | None = None,
    ) -> pa.Table:
        """Return a table as Arrow: the same as in the files that ``export`` writes, with the column ``recording``.

        Parameters
        ----------
        name : str
            One of ``tables``; or the topic of any channel, for a table of its rows, or of its flattened messages.
        topic : str, optional
            Return the rows of this channel only.
        columns : str or sequence of str, optional
            Of a channel of other software: read these fields only, as in angular_velocity.z; of a message all its
            fields.
        blobs : bool, default False
            Of a channel of other software: include binary fields, such as pictures and point clouds.
        start, end : int, datetime or numpy.datetime64, optional
            Of a channel of other software: read messages from the first time on, and before the second, in nanoseconds
            since 1970, or with a time zone. Chunks outside of the period are not read.

        Returns
        -------
        pyarrow.Table
            One row for each object and frame. Units and meanings of columns stand in the metadata of its schema.

        Raises
        ------
        McaptrackError
            If there is no such table, channel or column, or if the rows of the table are not by channel.

        Examples
        --------
        >>> import mcaptrack
        >>> with mcaptrack.open("log.mcap") as log:
        ...     log.table("tracks", "/camera/tracks").column_names[:4]
        ['topic', 'frame', 't', 't_ns']

        """
        part = MessagesPart(blobs, split_names("columns", columns), *_span(start, end))
        with self._now() as opened:
            if str(name) in tables.TABLES:
                if part != WHOLE:
                    raise McaptrackError(f"{name} is read whole; fields and times are chosen of channels, by topic")
                whole = self._contents.table(name)
            elif (channel := opened.find(str(name))) in opened.channels:
                whole = self._contents.messages(channel, part)
            else:
                every = offer(str(name), [*self.tables, *opened.channels], "there are")
                raise McaptrackError(f"{self.path} has no table or channel {name}; {every}")
            if topic is not None:
                topic = opened.channel(opened.find(topic)).topic
                if "topic" not in whole.schema.names:
                    raise McaptrackError(f"the rows of the table {name} are not by channel; leave `topic=` out")
                whole = tables.rows_of_topic(whole, topic)
            return tables.with_recording(whole, self.name)

    def array(self, name: str, topic: str | None = None) -> NDArray[Any]:
        """Return a table as a structured NumPy array.

        Parameters
        ----------
        name : str
            One of ``tables``; or the topic of any channel.
        topic : str, optional
            Return the rows of this channel only.

        Returns
        -------
        numpy.ndarray, shape (N,)
            The rows: times as datetime64[ns], missing numbers as NaN. A column of whole numbers of which some are
            missing becomes float64.

        Raises
        ------
        McaptrackError
            If there is no such table or channel, or if the rows of the table are not by channel.

        Examples
        --------
        >>> import mcaptrack
        >>> with mcaptrack.open("log.mcap") as log:
        ...     rows = log.array("tracks", "/camera/tracks")
        >>> rows["t"].dtype, rows["x_px"].shape == rows.shape
        (dtype('<M8[ns]'), True)

        """
        return tables.table_to_array(self.table(name, topic))

    @checked
    def frames(
        self, topic: str | None = None, times: Sequence[int] | NDArray[Any] | None = None, colour: Colour = "bgr"
    ) -> Iterator[Frame]:
        """Decode the pictures of a channel, or read its rows, in the order of time.

        Parameters
        ----------
        topic : str, optional
            The channel, or the end of its topic: "video" for /camera/video; by default the pictures of the only camera.
        times : sequence of int or array of datetime64, optional
            Times in whole nanoseconds: decode the picture that is shown at each, the last one that is not later. By
            default all pictures.
        colour : {"bgr", "rgb", "grey"}, default "bgr"
            Order of the colours of pictures.

        Returns
        -------
        iterator of mcaptrack.schema.Frame
            ``t_ns``, ``index``, and ``rows``: the picture, (H, W, 3) uint8, or (H, W) for "grey"; or the rows of a
            message, (N,) with a field for each column, as ``Recording.write`` takes them. Missing numbers are NaN.

        Raises
        ------
        McaptrackError
            If there is no such channel of pictures or rows, if a picture is damaged, or for a time before the first
            picture.

        Examples
        --------
        >>> import mcaptrack
        >>> with mcaptrack.open("log.mcap") as log:
        ...     picture = next(log.frames("video", colour="grey"))
        >>> picture.index, picture.rows.shape
        (0, (48, 64))

        """
        with self._now() as opened:
            topic = (only_pictures(opened) or VIDEO) if topic is None else topic
            if (of_rows := _topic_of_rows(opened, topic)) is not None:
                if times is not None:
                    text = f"`times=` chooses pictures, and {of_rows[0]} holds rows; choose rows by their t_ns"
                    raise McaptrackError(text)
                return _InTurn(self, iter(opened.frame_columns(*of_rows)))
            channel = find_pictures(opened, topic)
            wanted = None if times is None else shown_pictures(opened, channel, times)
            frames = _decoded(opened, channel, wanted, colour)
            if wanted is not None:
                frames = (frame for frame in frames for _ in range(wanted[frame.index]))
            return _InTurn(self, frames)

    @checked
    def show(
        self,
        at_s: _Seconds = None,
        *,
        topic: str | Sequence[str] | None = None,
        camera: str | None = None,
        start_s: Annotated[float, Option(least=0, most=1e9)] = 0.0,
        end_s: _Seconds = None,
        every: Annotated[int | None, Option(least=1, most=1e9)] = None,
        width: Annotated[int | None, Option(least=16, most=4096)] = None,
        max_mb: Annotated[float, Option(least=0.1, most=100)] = 8.0,
        progress: Progress = no_progress,
    ) -> Player:
        """Return a player for a notebook: the pictures with boxes, trails and predictions, or the ground from above.

        It opens a second before the first identity switch or repair, and marks all of them. Pictures are left out
        evenly as far as they don't fit; the player says how many there are.

        Parameters
        ----------
        at_s : float, optional
            Return a still of this time instead. All times are in seconds since the start of the log.
        topic : str or sequence of str, optional
            Draw these channels, or views; by default those that ``render`` draws. That of pictures shows them alone.
        camera : str, optional
            Name of the camera, if the log has several.
        start_s, end_s : float, optional
            Begin and end at these times.
        every : int, optional
            Show every such picture: 1 for all.
        width : int, optional
            Width in pixels; by default at most 640, for a still 960.
        max_mb : float, default 8.0
            Largest size of the player in megabytes.
        progress : callable, optional
            Called as ``progress(stage, done, total)``.

        Returns
        -------
        Player
            What a notebook shows as the result of a cell. ``save`` writes it as a page.

        Raises
        ------
        McaptrackError
            If the log has neither pictures nor scenes, none in the period, or more than fit with ``every``.

        Examples
        --------
        >>> import mcaptrack
        >>> with mcaptrack.open("log.mcap") as log:
        ...     player = log.show(end_s=1.0)
        >>> player.pictures, player.of
        (11, 11)

        """
        entry, maker = log_player()
        with self._now() as opened, blamed(entry, "failed"):
            player: Player = maker.show(
                opened,
                at_s,
                topics=names_of(topic),
                camera=camera,
                choice=Choice(start_s=start_s, end_s=end_s, every=every, width_px=width),
                max_mb=max_mb,
                progress=progress,
            )
            return player

    def fetch(self, row: Mapping[str, Any]) -> FetchedMessage:
        """Read one message by its place in the file, without a scan.

        Parameters
        ----------
        row : mapping of str to value
            A row of the table ``frames``, or any other with its columns ``chunk_offset`` and ``message_offset``;
            ``file``, ``topic`` and ``t_ns`` are compared with the message, if the row has them.

        Returns
        -------
        FetchedMessage
            The message.

        Raises
        ------
        McaptrackError
            If there is no such message at this place, because the log was changed since its tables were exported.

        Examples
        --------
        >>> import mcaptrack
        >>> with mcaptrack.open("log.mcap") as log:
        ...     row = log.table("frames", "/camera/video").slice(0, 1).to_pylist()[0]
        ...     log.fetch(row).topic
        '/camera/video'

        """
        with self._now() as opened:
            return fetch_message(opened, row)

    def supervision(self, topic: str) -> Iterator[tuple[int, Detections]]:
        """Return detections or tracks as ``supervision.Detections``, frame by frame.

        Parameters
        ----------
        topic : str
            The channel, or the end of its topic: "tracks" for /camera/tracks.

        Returns
        -------
        iterator of (int, supervision.Detections)
            Time in nanoseconds, and the boxes in pixels, with ``class_id``, and ``tracker_id`` for tracks;
            ``confidence`` is NaN where there is none. ``data["class_name"]`` names the classes if the channel names
            others than people. Rows without a box are left out.

        Raises
        ------
        McaptrackError
            If the channel has neither detections nor tracks, or if supervision is not installed.

        Examples
        --------
        >>> import mcaptrack
        >>> with mcaptrack.open("log.mcap") as log:
        ...     t_ns, boxes = next(log.supervision("detections"))
        >>> boxes.xyxy.shape[1]
        4

        """
        with self._now() as opened:
            schemas = {c.topic: SCHEMAS.get(c.schema_name) for c in opened.channels.values()}
            boxes = {name: schema for name, schema in schemas.items() if schema in (DETECTIONS, TRACKS)}
            channel = opened.find(topic, among=boxes)
            if channel not in boxes:
                raise McaptrackError(f"{self.path} has no channels {topic} of boxes; {offer(topic, sorted(boxes))}")
            names = class_names(opened.channel(channel).metadata)
            return supervision_of(opened.frames(channel, boxes[channel] or TRACKS), names)

    @checked
    def messages(
        self,
        topics: str | Iterable[str] | None = None,
        start: int | datetime | np.datetime64 | None = None,
        end: int | datetime | np.datetime64 | None = None,
        *,
        decoder_factories: Iterable[DecoderFactory] = (),
        decode: bool = True,
        reverse: bool = False,
    ) -> Iterator[DecodedMessage]:
        """Return messages in the order of their log times, in the types of the ``mcap`` package.

        They are those of the log and of the results beside it, as of one file: channels of results have ids that count
        on from those of the log, and stand for channels of the same topic. Chunks outside of the period are not read.

        Parameters
        ----------
        topics : str or iterable of str, optional
            Return messages of these channels only, by topic, or by the end of a topic: "tracks" for /camera/tracks.
        start, end : int, datetime or numpy.datetime64, optional
            Return messages from the first time on, and before the second: nanoseconds since 1970, or with a time zone.
        decoder_factories : iterable of mcap.decoder.DecoderFactory, optional
            Decode with the first that can: ``mcap_ros2.decoder.DecoderFactory()``. What none can is decoded as without:
            protobuf and ROS by the definition in the log to messages with fields as attributes, JSON to dictionaries.
        decode : bool, default True
            False leaves ``decoded`` None, which is quicker, and passes over payloads that nothing can decode.
        reverse : bool, default False
            Return the last message first.

        Returns
        -------
        iterator of (mcap.records.Schema or None, mcap.records.Channel, mcap.records.Message, object)
            The last one is the decoded payload. Messages of equal times are in the order of the file. What a decoder of
            a factory raises comes as it is.

        Raises
        ------
        McaptrackError
            If there is no such channel, and for a payload that nothing can decode, which is also a
            ``mcap.exceptions.DecoderNotFoundError`` if it is for want of a decoder.

        Examples
        --------
        >>> import mcaptrack
        >>> with mcaptrack.open("log.mcap") as log:
        ...     for schema, channel, message, decoded in log.messages("/camera/tracks", end=10**9):
        ...         channel.topic, schema.name, message.log_time, decoded.rows[0].track_id
        ...         break
        ('/camera/tracks', 'mcaptrack.Tracks', 0, 1)

        """
        factories = checked_factories(decoder_factories)
        start_ns, end_ns = _span(start, end)
        with self._now() as opened:
            chosen = opened.channels if topics is None else _topics(opened, topics)
            return _InTurn(
                self,
                decoded_messages(opened, chosen, start_ns, end_ns, factories=factories, decode=decode, reverse=reverse),
            )


class _InTurn(Iterator[T]):
    """Items that are read from a log bit by bit, each while no other thread reads from it."""

    def __init__(self, reader: LogReader, items: Iterator[T]) -> None:
        self._reader, self._items = reader, items

    def __next__(self) -> T:
        with self._reader._alone():
            self._reader._refuse_closed()
            return next(self._items)


def _span(start: Any, end: Any) -> tuple[int | None, int | None]:
    """Return a period in nanoseconds. Raises McaptrackError if it ends before it starts."""
    start_ns = None if start is None else nanoseconds_of(start, "`start=`")
    end_ns = None if end is None else nanoseconds_of(end, "`end=`")
    if start_ns is not None and end_ns is not None and start_ns > end_ns:
        raise McaptrackError(f"`end=` is before `start=`: {end_ns} and {start_ns} ns")
    return start_ns, end_ns


def _topics(opened: Log, names: Any) -> set[str]:
    """Return the topics of these names. Raises McaptrackError if there is none, or several, of a name."""
    given = [names] if isinstance(names, str) or not isinstance(names, Iterable) else list(names)
    chosen = set()
    for name in given:
        if not isinstance(name, str):
            raise McaptrackError(f"`topics=` is a topic, or several, not {name!r:.40}")
        chosen.add(opened.channel(opened.find(name)).topic)
    return chosen


def _topic_of_rows(opened: Log, topic: str) -> tuple[str, Schema] | None:
    """Return the channel of rows with this topic, or the only one that ends with it, and its schema.

    None if there is none, or if pictures have such a topic.
    """
    pictures = [name for name, channel in opened.channels.items() if holds_pictures(channel)]
    if opened.find(topic, among=pictures) in pictures and topic not in opened.channels:
        return None
    of_rows = {name: channel.schema for name, channel in opened.channels.items() if channel.schema is not None}
    name = opened.find(topic, among=of_rows)
    schema = of_rows.get(name)
    return None if schema is None else (name, schema)


def _decoded(opened: Log, topic: str, wanted: Mapping[int, int] | None, colour: Colour) -> Iterator[Frame]:
    pixels = decode_gray if colour == "grey" else decode_bgr
    pictures = Pictures(opened, topic)
    for frame in pictures.frames(range(len(pictures.t_ns)) if wanted is None else wanted, pixels):
        yield frame._replace(rows=frame.rows[..., ::-1]) if colour == "rgb" else frame


class Recording(LogReader):
    """A log, open for reading and writing; made by ``mcaptrack.open``. A context manager.

    Tables, arrays, pictures and players stay valid when it is closed. All methods raise McaptrackError, in one line,
    for what does not exist and for damage.

    Examples
    --------
    >>> import mcaptrack
    >>> with mcaptrack.open("log.mcap") as log:
    ...     log.topics[0], log.tables[:3]
    ('/camera/detections', ('frames', 'detections', 'tracks'))

    """

    def write(
        self,
        topic: str,
        rows: Any,
        *,
        schema: Schema | None = None,
        classes: Mapping[int, str] | None = None,
        frame_id: str = "",
        by: str | None = None,
        replace: bool = False,
        sidecar: bool | None = None,
    ) -> int:
        """Write rows as a channel of the log: detections or tracks for stages, forecasts, events, or rows of your own.

        Parameters
        ----------
        topic : str
            The channel, such as "/camera/detections", or its name below the only camera, "detections". Channels named
            detections, tracks (or truth), predictions and events hold rows of these schemas.
        rows : iterable of Frame, structured array, table, instances of a dataclass, or mapping
            Frames, as ``mcaptrack.detections`` makes them; or an array, a table of pandas, Polars, Arrow or DuckDB, or
            instances of a dataclass, with ``t_ns`` and the columns of rows; or ``supervision.Detections`` by time in
            nanoseconds, as a mapping or as pairs. A table has no frames without rows. The names in a column ``class``
            are kept.
        schema : Schema, optional
            What the rows are: one of ``mcaptrack.schema``, such as PREDICTIONS, or one of your own, which
            ``mcaptrack.schema_of`` makes. By default the topic or the columns decide; rows with other columns than
            mcaptrack's get a schema of their own, named after the topic.
        classes : mapping of int to str, optional
            Names of classes by ``class_id``; 1 is a person.
        frame_id : str, optional
            The frame that positions are in; "map" for detections in metres alone, and for tracks with 3D boxes.
        by : str, optional
            Who writes, such as "my_tool 1.2"; by default the program that runs. ``mcaptrack info`` shows it.
        replace : bool, default False
            Replace the channel if it exists and holds the same kind of rows, unless others recorded it.
        sidecar : bool, optional
            Write into LOG.results.mcap beside the log (True) or into it (False). By default as ``run`` does.

        Returns
        -------
        int
            Number of frames that were written.

        Raises
        ------
        McaptrackError
            If the rows do not fit, or if the channel exists.

        Examples
        --------
        >>> import mcaptrack
        >>> with mcaptrack.open("log.mcap") as log:
        ...     frames = [mcaptrack.detections([[9, 20, 17, 28]], t_ns=0, box_format="xyxy")]
        ...     log.write("/mine/detections", frames)
        1

        """
        from mcaptrack.api.writing import write_rows

        with self._now():
            path = self._path_now()
            return write_rows(path, topic, rows, schema, classes, frame_id, by, replace, sidecar)


@checked
def open(path: PathLike, *, create: bool = False) -> Recording:  # noqa: A001  # mcaptrack.open is its name
    """Open a log, with its results if they stand beside it.

    Parameters
    ----------
    path : path
        The log, or the URL of one in a store: "s3://bucket/log.mcap".
    create : bool, default False
        Make a new, empty log; one that exists is refused.

    Returns
    -------
    Recording
        The open log; a context manager.

    Raises
    ------
    McaptrackError
        If it is no MCAP file, or damaged; with ``create``, if it exists.

    Examples
    --------
    >>> import mcaptrack
    >>> with mcaptrack.open("log.mcap") as log:
    ...     log.table("tracks", "/camera/tracks").num_rows > 0
    True
    """
    if create:
        target = log_output(path)
        if target.exists():
            raise McaptrackError(f"{target} exists; open it without `create=True`, or give a new log another name")
        refuse_overwrite(target, force=False)
        with logs.create(target):
            pass
    return Recording(as_location(path))
