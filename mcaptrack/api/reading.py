"""Read a log: tables for Arrow, arrays for NumPy, pictures, players for notebooks, any message by its place.

Letters: N rows, H and W pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from threading import RLock
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from mcaptrack import log as logs
from mcaptrack import tables
from mcaptrack.api.common import names_of
from mcaptrack.api.declared import Option, checked
from mcaptrack.api.notebook import Choice, Player, show_log, show_tables
from mcaptrack.api.options import Progress, no_progress
from mcaptrack.api.rows import supervision_of
from mcaptrack.errors import McaptrackError, call
from mcaptrack.location import Location, Url
from mcaptrack.log import Log
from mcaptrack.schema import DETECTIONS, SCHEMAS, TRACKS, Frame
from mcaptrack.schema.classes import class_names
from mcaptrack.sources.own_rows import times_of
from mcaptrack.sources.pictures import Pictures, find_pictures
from mcaptrack.sources.video import decode_bgr, decode_gray
from mcaptrack.tables import export

if TYPE_CHECKING:
    import pyarrow as pa
    from supervision import Detections

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
        self._reading = RLock()  # tables are kept once they were made, and several threads may ask for them
        self._open(path)
        show_tables()

    def _open(self, path: Location) -> None:
        self._there = logs.read(path)
        self._contents = export.LogTables(self._there)
        self._is_open = True

    @property
    def _log(self) -> logs.Log:
        if not self._is_open:
            raise McaptrackError(f"{self.path} is closed; {call('open', self.path)} opens it again")
        return self._there

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"mcaptrack.open({str(self.path)!r})"

    def close(self) -> None:
        """Close the file."""
        self._is_open = False
        self._there.__exit__()

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
        return tuple(sorted(self._there.channels))

    @checked
    def table(self, name: str, topic: str | None = None) -> pa.Table:
        """Return a table as Arrow: the same as in the files that ``export`` writes, with the column ``recording``.

        Parameters
        ----------
        name : str
            One of ``tables``; or the topic of any other channel, for a table of its flattened messages.
        topic : str, optional
            Return the rows of this channel only.

        Returns
        -------
        pyarrow.Table
            One row for each object and frame. Units and meanings of columns stand in the metadata of its schema.

        Raises
        ------
        McaptrackError
            If there is no such table or channel, or if the rows of the table are not by channel.

        Examples
        --------
        >>> import mcaptrack
        >>> with mcaptrack.open("log.mcap") as log:
        ...     log.table("tracks", "/camera/tracks").column_names[:4]
        ['topic', 'frame', 't', 't_ns']

        """
        with self._reading:
            channels = self._log.channels
            if str(name) in tables.TABLES:
                whole = self._contents.table(name)
            elif str(name) in channels:
                whole = self._contents.messages(name)[0]
            else:
                raise McaptrackError(
                    f"{self.path} has no table {name}; there are {', '.join(self.tables)}, and its channels"
                )
        if topic is not None:
            self._log.channel(topic)
            if "topic" not in whole.schema.names:
                raise McaptrackError(f"the rows of the table {name} are not by channel; leave `topic=` out")
            whole = tables.rows_of_topic(whole, topic)
        return tables.with_recording(whole, self.name)

    def array(self, name: str, topic: str | None = None) -> NDArray[Any]:
        """Return a table as a structured NumPy array.

        Parameters
        ----------
        name : str
            One of ``tables``; or the topic of any other channel.
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
        self, topic: str = "video", times: Sequence[int] | NDArray[Any] | None = None, colour: Colour = "bgr"
    ) -> Iterator[Frame]:
        """Decode the pictures of a channel, in the order of time.

        Parameters
        ----------
        topic : str, default "video"
            The channel, or the end of its topic: "video" for /camera/video.
        times : sequence of int or array of datetime64, optional
            Times in whole nanoseconds: decode the picture that is shown at each, the last one that is not later. By
            default all pictures.
        colour : {"bgr", "rgb", "grey"}, default "bgr"
            Order of the colours.

        Returns
        -------
        iterator of mcaptrack.schema.Frame
            ``t_ns``, ``index``, and ``rows``: the picture, (H, W, 3) uint8, or (H, W) for "grey".

        Raises
        ------
        McaptrackError
            If there is no such channel of pictures, if a picture is damaged, or for a time before the first picture.

        Examples
        --------
        >>> import mcaptrack
        >>> with mcaptrack.open("log.mcap") as log:
        ...     picture = next(log.frames("video", colour="grey"))
        >>> picture.index, picture.rows.shape
        (0, (48, 64))

        """
        channel = find_pictures(self._log, topic)
        wanted = None if times is None else shown_pictures(self._log, channel, times)
        frames = self._decoded(channel, wanted, colour)
        return frames if wanted is None else (frame for frame in frames for _ in range(wanted[frame.index]))

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
        return show_log(
            self._log,
            at_s,
            topics=names_of(topic),
            camera=camera,
            choice=Choice(start_s=start_s, end_s=end_s, every=every, width_px=width),
            max_mb=max_mb,
            progress=progress,
        )

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
        return fetch_message(self._log, row)

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
        schemas = {c.topic: SCHEMAS.get(c.schema_name) for c in self._log.channels.values()}
        boxes = {name: schema for name, schema in schemas.items() if schema in (DETECTIONS, TRACKS)}
        end = "/" + topic.strip("/")
        topics = [name for name in boxes if name == topic] or [name for name in boxes if name.endswith(end)]
        if len(topics) != 1:
            raise McaptrackError(
                f"{self.path} has {len(topics) or 'no'} channels {topic} of boxes; it has {', '.join(sorted(boxes))}"
            )
        schema = boxes[topics[0]]
        names = class_names(self._log.channel(topics[0]).metadata)
        return supervision_of(self._log.frames(topics[0], schema or TRACKS), names)

    def _decoded(self, topic: str, wanted: Mapping[int, int] | None, colour: Colour) -> Iterator[Frame]:
        pixels = decode_gray if colour == "grey" else decode_bgr
        pictures = Pictures(self._log, topic)
        for frame in pictures.frames(range(len(pictures.t_ns)) if wanted is None else wanted, pixels):
            yield frame._replace(rows=frame.rows[..., ::-1]) if colour == "rgb" else frame
