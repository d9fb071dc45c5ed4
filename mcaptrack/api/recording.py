"""An open log: what reading gives, and own rows written into it.

import mcaptrack

with mcaptrack.open("log.mcap") as log:
log.table("tracks")                     # a pyarrow.Table, as DuckDB, Polars and pandas take it
log.array("tracks", "/camera/tracks")   # a structured array, times as datetime64[ns]
for frame in log.frames("video"):       # frame.t_ns, frame.index, frame.rows: (height, width, 3), blue first
...
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mcaptrack import log as logs
from mcaptrack.api.common import as_location, log_output
from mcaptrack.api.declared import checked
from mcaptrack.api.options import PathLike
from mcaptrack.api.reading import LogReader
from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_overwrite
from mcaptrack.schema import Schema

__all__ = ["Recording", "open"]


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
