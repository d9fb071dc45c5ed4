"""Write logs as tables, as ROS 2 bags, or as files of other programs."""

from __future__ import annotations

import inspect
import operator
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple, cast, get_args

from mcaptrack.api.common import log_location, names_of, optional_path, split_names, warn_unused, warnings_about
from mcaptrack.api.declared import Option, declared
from mcaptrack.api.options import (
    FILES,
    Definitions,
    EachLog,
    Force,
    PathLike,
    Progress,
    Reports,
    named,
    no_progress,
    output,
)
from mcaptrack.choices import BoxFormat, TableFormat
from mcaptrack.errors import McaptrackError
from mcaptrack.files import place_of, publish, publish_folder, refuse_overwrite
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.location import Location, local_name
from mcaptrack.notices import Notice, warn

if TYPE_CHECKING:
    from mcaptrack.api.reading import LogReader
    from mcaptrack.log import Log
    from mcaptrack.registry import Entry
    from mcaptrack.tables.export.contents import MessagesPart

#: What the names of files with tables end with.
_OF_FILES: Final = (*(f".{form}" for form in get_args(TableFormat)), ".json", ".tsv", ".txt", ".xlsx")


@dataclass(frozen=True)
class ExportResult:
    """The tables of a log in a folder, its bag, or the file of another program.

    Attributes
    ----------
    log : pathlib.Path or str
        The log; the URL of one in a store.
    folder : pathlib.Path
        The folder with its tables, the bag, or the file.
    rows : dict of str to int
        Number of rows of each table; of a bag, the number of messages of each topic; of a file, the
        number of boxes of its channel.
    written : tuple of str
        The tables that were written; the others were up to date. Of a bag, its topics; of a
        file, its channel.
    warnings : tuple of mcaptrack.Notice
        What was left out.
    files : tuple of pathlib.Path
        What the export owes: the last of the tables, the bag, or the file.
    left_out : tuple of str
        The tables that have no file here, because they have no rows.

    """

    log: Location
    folder: Path
    rows: Mapping[str, int]
    written: tuple[str, ...]
    warnings: tuple[Notice, ...]
    files: tuple[Path, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def is_up_to_date(self) -> bool:
        """Whether there was nothing to write."""
        return not self.written


class _Part(NamedTuple):
    """The channels of other software that get tables, and what these hold."""

    topics: tuple[str, ...]
    all_topics: bool
    columns: tuple[str, ...]
    blobs: bool
    start_s: float | None
    end_s: float | None

    def chosen(self) -> dict[str, bool]:
        """Whether each option chooses anything, by its name."""
        start, end = self.start_s is not None, self.end_s is not None
        return {"columns": bool(self.columns), "blobs": self.blobs, "start_s": start, "end_s": end}

    def warn_unused(self, why: str, has_topic: bool = False) -> None:
        """Warn of options that choose something without effect."""
        warn_unused(why, **self.chosen(), all_topics=self.all_topics, topic=has_topic and bool(self.topics))

    def check(self) -> None:
        """Raise McaptrackError for options that need others, or contradict each other."""
        needing = [name for name, is_chosen in self.chosen().items() if is_chosen]
        if needing and not self.topics and not self.all_topics:
            raise McaptrackError(
                f"`{needing[0]}=` needs a channel to write; name it with `topic=`, or give `all_topics=True`"
            )
        if self.columns and self.all_topics:
            raise McaptrackError("`columns=` are those of a channel; name it with `topic=` in place of `all_topics=`")
        if self.start_s is not None and self.end_s is not None and self.start_s >= self.end_s:
            raise McaptrackError(f"`end_s={self.end_s:g}` isn't after `start_s={self.start_s:g}`")

    def of(self, opened: Log) -> MessagesPart:
        """The messages and fields that tables of a log's channels hold."""
        from mcaptrack.tables.export.contents import MessagesPart

        span = [
            None if second is None else opened.start_ns + round(second * NS_PER_S)
            for second in (self.start_s, self.end_s)
        ]
        return MessagesPart(self.blobs, self.columns, *span)


@declared(
    most_used=("form", "topic", "all_topics", "output", "force"),
    heading="Results",
    printed_by="mcaptrack.cli.show:Export",
)
def export(
    log: EachLog,
    output: Annotated[PathLike | None, output("LOG.tables, LOG.rosbag2, LOG.cvat.xml, ... beside the log")] = None,
    *,
    form: Annotated[
        TableFormat | BoxFormat | str,
        named("exporter", get_args(TableFormat), FILES, "format"),
    ] = "parquet",
    topic: Annotated[str | Sequence[str] | None, Option(FILES, shown=False)] = None,
    all_topics: Annotated[bool, Option(FILES, flag="all")] = False,
    columns: Annotated[
        str | Sequence[str] | None, Option(FILES, metavar="A,B", commas=True, shown="all fields")
    ] = None,
    blobs: Annotated[bool, Option(FILES)] = False,
    start_s: Annotated[float | None, Option(FILES, 0, 1e9)] = None,
    end_s: Annotated[float | None, Option(FILES, 0, 1e9)] = None,
    definitions: Definitions = None,
    force: Force = False,
    progress: Reports = no_progress,
) -> ExportResult:
    """Write a log as tables, as a ROS 2 bag, or for other programs.

    Tables (Parquet) have one row per object and frame. One folder a table (frames, detections, tracks, track_summary,
    predictions, events, metrics, channels, recordings and others), one file a log in it; several logs can share a
    folder. Exporting again replaces what has changed. `mcaptrack docs tables` lists all columns. A bag (rosbag2) holds
    results as ROS messages, for RViz and `ros2 bag`: `vision_msgs/Detection3DArray` or `Detection2DArray`,
    `nav_msgs/Path`, `visualization_msgs/MarkerArray`, transforms.

    A file (mot, kitti, coco, cvat, boxes-csv) has the boxes of one channel: the re-tracked boxes of the only camera at
    the rate of the video, or else its tracks or detections, or those of ``topic``. `mcaptrack ingest` reads it again;
    what its format can't hold is a warning.

    Parameters
    ----------
    output : path, optional
        Folder for the tables or the bag, or the file.

        By default LOG.tables, LOG.rosbag2, or a file such as LOG.cvat.xml beside the log; of a log in a store, in the
        working folder.
    form : {"parquet", "arrow", "csv", "jsonl", "rosbag2", "rosbag2-sqlite3", "mot", "kitti", "coco", "cvat", ...}
        Tables (parquet, arrow, csv, jsonl), a ROS 2 bag (rosbag2 in MCAP, rosbag2-sqlite3 in a database), or a file
        with the boxes of one channel: MOTChallenge (mot), KITTI tracking (kitti), COCO with tracks (coco), CVAT for
        video (cvat), a table (boxes-csv), or a recording of Rerun (rerun); or the format of an installed package, or
        module:Class.
    topic : str or sequence of str, optional
        Also write a table of all messages of this channel; the channel with the boxes for a file.
    all_topics : bool, default False
        Also write a table of each channel of other software; a warning names those that can't be one.
    columns : str or sequence of str, optional
        With ``topic``: write these fields only, as in header.stamp,angular_velocity.z; of a message all its fields.
    blobs : bool, default False
        With ``topic``: include binary fields, such as pictures and point clouds.
    start_s : float, optional
        With ``topic``: write messages from this time of the log on, in seconds.
    end_s : float, optional
        With ``topic``: write messages before this time of the log, in seconds.
    force : bool, default False
        Write all tables again, also over those of another log of this name; replace a bag or a file.

    Returns
    -------
    ExportResult
        The folder, and the number of rows of each table.

    Raises
    ------
    McaptrackError
        If the log cannot be read, or if the folder holds the tables of another log.

    Examples
    --------
    On the command line:

        mcaptrack export log.mcap -o tables/

        mcaptrack export log.mcap --format cvat -o boxes.xml

        mcaptrack export robot.mcap --topic /imu --format csv

        mcaptrack export robot.mcap --all -o tables/

    >>> import mcaptrack
    >>> mcaptrack.export("log.mcap", "tables").rows["tracks"] > 0
    True

    """
    from mcaptrack import log as logs
    from mcaptrack.sources.foreign.definitions import definitions_of
    from mcaptrack.tables.export import default_folder, main_file
    from mcaptrack.tables.export import export as write_tables

    path = log_location(log)
    part = _Part(names_of(topic), all_topics, split_names("columns", columns), blobs, start_s, end_s)
    with definitions_of(definitions):
        if form not in get_args(TableFormat):
            return _export_by(_exporter(form), path, optional_path(output), part, force, progress)
        folder, kind = optional_path(output) or default_folder(path), cast("TableFormat", form)
        if folder.exists() and not folder.is_dir():
            raise McaptrackError(f"{folder} is a file; tables go to a folder")
        if folder.suffix.lower() in _OF_FILES and not folder.exists():
            raise McaptrackError(
                f"{folder} has the name of a file, and tables are files in a folder; give a name for it"
            )
        part.check()
        with warnings_about(path) as warnings:
            with logs.read(path) as opened:
                which, chosen = None if all_topics else part.topics, part.of(opened)
                done = write_tables(opened, folder, progress, form=kind, topics=which, part=chosen, force=force)
            for note in done.notes:
                warn(note, "left-out")
        owed, spare = (main_file(path, folder, kind),), tuple(done.spare)
        return ExportResult(path, folder, done.rows, tuple(done.written), tuple(dict.fromkeys(warnings)), owed, spare)


class FoundExporter(NamedTuple):
    """An exporter as the registry found it, its object, and what its class says of it.

    ``options`` are those of ``topic`` and ``progress`` that its method ``write`` takes.
    """

    entry: Entry
    exporter: Any
    end: str
    is_folder: bool
    marker: str
    options: frozenset[str]


def file_exporter(form: str) -> FoundExporter | None:
    """The exporter of a format; None for tables. Raises McaptrackError if none works."""
    return None if form in get_args(TableFormat) else _exporter(form)


def _exporter(form: str) -> FoundExporter:
    from mcaptrack.registry import find

    entry = find("exporter", form)
    return exporter_for(entry, entry.made("write"))


def exporter_for(entry: Entry, exporter: Any) -> FoundExporter:
    """An exporter with what its class says. Raises McaptrackError for what it can't say."""
    from mcaptrack.registry import blamed

    end = getattr(exporter, "end", f".{entry.name.rpartition(':')[2].lower()}")
    if not isinstance(end, str) or not re.fullmatch(r"(\.[\w-]+)+", end):
        raise McaptrackError(
            f"{entry} has end = {end!r:.40}; it is the end of the name of a file, such as '.speeds.csv'"
        )
    with blamed(entry, "has a method write without a signature that can be read"):
        options = {"topic", "progress"} & inspect.signature(exporter.write).parameters.keys()
    is_folder, marker = bool(getattr(exporter, "is_folder", False)), str(getattr(exporter, "marker", ""))
    return FoundExporter(entry, exporter, end, is_folder, marker, frozenset(options))


def _export_by(
    by: FoundExporter, path: Location, output: Path | None, part: _Part, force: bool, progress: Progress
) -> ExportResult:
    """Write a log by an exporter."""
    from mcaptrack import log as logs
    from mcaptrack.api.reading import LogReader

    takes_topic = "topic" in by.options
    if takes_topic and len(part.topics) > 1:
        raise McaptrackError(f"the {by.entry} writes one channel, not {', '.join(part.topics)}; give one")
    with warnings_about(path) as warnings:
        part.warn_unused(f"the {by.entry} has no tables of channels", has_topic=not takes_topic)
        target = output or local_name(path, by.end)
        if by.is_folder:
            target = output or local_name(path, f"{by.end}.mcap").with_suffix("")  # room for files of its name
            _refuse_folder(by, target, force)
        else:
            refuse_overwrite(target, force)
        with logs.read(path) as opened:
            places = [place_of(file.path) for file in opened.parts]
        for place in places:
            if isinstance(place, Path) and place_of(target) in (place, *place.parents):
                raise McaptrackError(f"{target} is a log, or holds it; give another name with `output=`")
        with LogReader(path) as recording, (publish_folder if by.is_folder else publish)(target) as new:
            rows = write_by(by, recording, new, {"topic": next(iter(part.topics), None), "progress": progress})
    return ExportResult(path, target, rows, tuple(rows), tuple(dict.fromkeys(warnings)), files=(target,))


def _refuse_folder(by: FoundExporter, folder: Path, force: bool) -> None:
    """Raise McaptrackError for a folder that an exporter may not replace: it may its own, by their file or name."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    is_own = (folder / by.marker).is_file() if by.marker else folder.is_dir() and folder.name.endswith(by.end)
    if not is_own:
        which = f"with {by.marker}" if by.marker else f"named *{by.end}"
        raise McaptrackError(f"{folder} exists, and only folders {which} are replaced; name another folder")
    if not force:
        raise McaptrackError(f"{folder} exists; `force=True` replaces it")


def write_by(by: FoundExporter, recording: LogReader, part: Path, options: Mapping[str, Any]) -> dict[str, int]:
    """Let an exporter write a file or folder, with those of ``options`` that it takes; returns its numbers of rows.

    Raises McaptrackError for what is wrong.
    """
    from mcaptrack.registry import blamed

    with blamed(by.entry, "failed"):
        rows = by.exporter.write(recording, part, **{name: options[name] for name in by.options & options.keys()})
    if not (part.is_dir() if by.is_folder else part.is_file()):
        hint = "its attribute is_folder says which it makes" if part.exists() else "it has to make the path it gets"
        raise McaptrackError(f"{by.entry} wrote no {'folder' if by.is_folder else 'file'}; {hint}")
    with blamed(by.entry, "gave no numbers of rows by the names of tables or channels"):
        return {str(name): operator.index(count) for name, count in dict(rows).items()}


def refuse_same_tables(logs_to_export: Sequence[Location], output: Path | None) -> None:
    """Raise McaptrackError if two different logs would have the same name in the tables of one folder."""
    from mcaptrack.tables.export import default_folder, recording_key, recording_name

    folders: dict[tuple[str, str], Location] = {}
    for path in logs_to_export:
        folder = recording_key(str(output or default_folder(path)))
        other = folders.setdefault((folder, recording_key(recording_name(path))), path)
        if place_of(other) != place_of(path):
            raise McaptrackError(
                f"{other} and {path} would both be {recording_name(path)} in the tables; export them to two folders"
            )
