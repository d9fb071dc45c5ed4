"""A log in Python: tables for Arrow, arrays for NumPy, pictures, and any message by where it stands.

    import mcaptrack

    with mcaptrack.open("log.mcap") as log:
        log.table("tracks")                     # a pyarrow.Table, as DuckDB, Polars and pandas take it
        log.array("tracks", "/camera/tracks")   # a structured array, times as datetime64[ns]
        for frame in log.frames("video"):       # frame.t_ns, frame.index, frame.rows: (height, width, 3), blue first
            ...

Letters: N rows, H and W pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from mcaptrack import log as logs
from mcaptrack import tables
from mcaptrack.api.common import as_path, log_output
from mcaptrack.api.rows import supervision_of
from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_overwrite
from mcaptrack.schema import DETECTIONS, SCHEMAS, TRACKS, Frame
from mcaptrack.sources import foreign
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import decode_bgr, decode_gray
from mcaptrack.tables import export

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["FetchedMessage", "Recording", "open"]

Colour = Literal["bgr", "rgb", "grey"]
_NEEDED: Final = ("chunk_offset", "message_offset")


class FetchedMessage(NamedTuple):
    """A message of a log: its channel, times in nanoseconds, and its bytes as they were recorded."""

    topic: str
    t_ns: int
    publish_ns: int
    sequence: int
    payload: bytes


class Recording:
    """A log, open for reading; made by ``mcaptrack.open``. A context manager.

    What it gives stays valid when it is closed. Every method raises McaptrackError, in one line, for what isn't there
    and for what is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._open(path)

    def _open(self, path: Path) -> None:
        self._log = logs.read(path)
        self._contents = export.LogTables(self._log)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"mcaptrack.open({str(self.path)!r})"

    def close(self) -> None:
        """Let go of the file."""
        self._log.__exit__()

    @property
    def path(self) -> Path:
        """The file of the log."""
        return self._log.path

    @property
    def name(self) -> str:
        """What the log is called in the column ``recording`` of all tables."""
        return self._contents.recording

    @property
    def tables(self) -> tuple[str, ...]:
        """The names of all tables; every log has all of them, some without rows."""
        return tuple(tables.TABLES)

    @property
    def topics(self) -> tuple[str, ...]:
        """The channels, in order."""
        return tuple(sorted(self._log.channels))

    def table(self, name: str, topic: str | None = None) -> pa.Table:
        """A table as Arrow: what reading the folder of ``mcaptrack export`` gives, ``recording`` included.

        ``name`` is one of ``tables``, or the topic of any other channel, whose messages are flattened. With ``topic``
        only the rows of that channel.
        """
        if name in tables.TABLES:
            made = self._contents.table(name)
        elif self._log.channels.get(name) is not None:
            made = self._contents.messages(name)[0]
        else:
            raise McaptrackError(
                f"{self.path} has no table {name}; there are {', '.join(self.tables)}, and its channels"
            )
        if topic is not None:
            self._log.channel(topic)
            if "topic" not in made.schema.names:
                raise McaptrackError(f"the table {name} is not by channel")
            made = tables.rows_of_topic(made, topic)
        return tables.with_recording(made, self.name)

    def array(self, name: str, topic: str | None = None) -> NDArray[Any]:
        """The same as a structured array (N,): times as datetime64[ns], missing numbers as NaN.

        Whole numbers of which some are missing become float64.
        """
        return tables.table_to_array(self.table(name, topic))

    def frames(
        self, topic: str = "video", times: Sequence[int] | None = None, colour: Colour = "bgr"
    ) -> Iterator[Frame]:
        """The pictures of a channel, decoded, by time: ``rows`` is (H, W, 3) uint8, or (H, W) for "grey".

        ``topic`` may be the end of one: "video" for /camera/video. With ``times``, in nanoseconds, the picture that is
        shown at each: the last one that is not later. They come by time, each as often as it is asked for.
        """
        channel = self._pictures(topic)
        wanted = None if times is None else self._shown(channel, times)
        frames = self._decoded(channel, wanted, colour)
        return frames if wanted is None else (frame for frame in frames for _ in range(wanted[frame.index]))

    def fetch(self, row: Mapping[str, Any]) -> FetchedMessage:
        """The message that a row of ``frames`` points to, or of any table with its columns; one chunk is read.

        ``file``, ``topic`` and ``t_ns`` are held against what is found, as far as the row has them: a log that was
        changed since its tables were exported is told.
        """
        missing = [name for name in _NEEDED if name not in row]
        if missing:
            raise McaptrackError(f"a row without {', '.join(missing)} points to no message; rows of `frames` do")
        chunk, offset = (_whole(row[name]) for name in _NEEDED)
        file = row.get("file")
        part = next((part for part in self._log.parts if file in (None, part.path.name)), None)
        if part is None or offset is None:
            raise McaptrackError(f"{self.path}: the row is of {file}, at byte {offset}, which is not of this log")
        old = f"{part.path}: no such message stands there; export its tables again"
        try:
            topic, message = part.message_at(chunk, offset)
        except McaptrackError as error:
            raise McaptrackError(f"{old} ({error})") from None
        said = (row.get("topic", topic), _whole(row.get("t_ns", message.t_ns)))
        if said != (topic, message.t_ns):
            raise McaptrackError(old)
        return FetchedMessage(topic, message.t_ns, message.publish_ns, message.sequence, message.payload)

    def supervision(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield detections or tracks as ``supervision.Detections``, frame by frame.

        Parameters
        ----------
        topic : str
            The channel, or the end of its topic: "tracks" for /camera/tracks.

        Yields
        ------
        tuple of int and supervision.Detections
            Time in nanoseconds, and the boxes in pixels, with ``tracker_id`` for tracks and ``class_id`` for
            detections. Rows without a box are left out.

        Raises
        ------
        McaptrackError
            If the channel has neither detections nor tracks, or if supervision is not installed.
        """
        there = {c.topic: SCHEMAS.get(c.schema_name) for c in self._log.channels.values()}
        boxes = {name: schema for name, schema in there.items() if schema in (DETECTIONS, TRACKS)}
        found = [name for name in boxes if topic == name] or [
            name for name in boxes if name.endswith("/" + topic.strip("/"))
        ]
        if len(found) != 1:
            raise McaptrackError(
                f"{self.path} has {len(found) or 'no'} channels {topic} of boxes; it has {', '.join(sorted(boxes))}"
            )
        schema = boxes[found[0]]
        return supervision_of(self._log.frames(found[0], schema or TRACKS))

    def write(self, topic: str, rows: Any, *, replace: bool = False, sidecar: bool | None = None) -> int:
        """Write detections or tracks as a channel of the log; ``track``, ``run`` and ``info`` then use it.

        Parameters
        ----------
        topic : str
            The channel, such as "/camera/detections", or its name below the only camera, "detections". Channels named
            detections hold detections; those named tracks or truth hold tracks.
        rows : iterable of Frame, structured array, pyarrow.Table, or mapping
            Frames as ``mcaptrack.detections`` makes them; or an array or table with a column ``t_ns`` and those of the
            rows; or ``supervision.Detections`` by time in nanoseconds, as a mapping or as pairs.
        replace : bool, default False
            Replace the channel if it exists. Channels that others recorded are never replaced.
        sidecar : bool, optional
            Write into LOG.results.mcap beside the log (True) or into the log (False). By default beside recordings
            that ROS tools read, otherwise into the log.

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

        path = self.path
        count = write_rows(path, topic, rows, replace=replace, sidecar=sidecar)
        self.close()
        self._open(path)
        return count

    def _pictures(self, topic: str) -> str:
        there = [c.topic for c in self._log.channels.values() if foreign.holds_pictures(c)]
        found = [name for name in there if topic in (name, name.removeprefix("/"))]
        found = found or [name for name in there if name.endswith("/" + topic.strip("/"))]
        if len(found) != 1:
            has = f"pictures in {', '.join(sorted(there))}" if there else "no pictures"
            raise McaptrackError(f"{self.path} has {len(found) or 'no'} channels {topic} with pictures; it has {has}")
        return found[0]

    def _shown(self, topic: str, times: Sequence[int]) -> dict[int, int]:
        """The numbers of the pictures that are shown at these times, and how often each is asked for."""
        at = np.searchsorted(self._log.times(topic), np.asarray(times, np.int64), "right") - 1
        if len(at) and at.min() < 0:
            first = int(np.asarray(times)[at.argmin()])
            raise McaptrackError(f"{self.path}: {topic} has no picture at {first} ns yet; it begins later")
        numbers, counts = np.unique(at, return_counts=True)
        return dict(zip(numbers.tolist(), counts.tolist(), strict=True))

    def _decoded(self, topic: str, wanted: Mapping[int, int] | None, colour: Colour) -> Iterator[Frame]:
        pixels = decode_gray if colour == "grey" else decode_bgr
        found = Pictures(self._log, topic)
        for frame in found.frames(range(len(found.t_ns)) if wanted is None else wanted, pixels):
            yield frame._replace(rows=frame.rows[..., ::-1]) if colour == "rgb" else frame


def _whole(value: Any) -> int | None:
    """A whole number as tables have it: pandas makes floats of columns in which some are missing."""
    return None if value is None or value != value else int(value)  # noqa: PLR0124  # NaN is not itself


def open(path: str | Path, *, create: bool = False) -> Recording:  # noqa: A001  # mcaptrack.open is its name
    """Open a log, with its results if they stand beside it.

    Parameters
    ----------
    path : path
        The log.
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
        made = log_output(path, Path(path))
        refuse_overwrite(made, force=False)
        with logs.create(made):
            pass
    return Recording(as_path(path))
