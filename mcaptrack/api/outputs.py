"""Write tables, reports and videos of logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

from mcaptrack import log as logs
from mcaptrack.api.checked import checked
from mcaptrack.api.common import (
    PathLike,
    Progress,
    as_location,
    detail,
    locations_of,
    log_location,
    names_of,
    no_progress,
    optional_path,
    warn_unused,
    warnings_about,
)
from mcaptrack.api.delta import add_to_delta
from mcaptrack.api.fleet_page import page_about
from mcaptrack.errors import McaptrackError
from mcaptrack.files import is_same_file, place_of, publish_bytes, refuse_overwrite
from mcaptrack.location import Location, local_name
from mcaptrack.notices import Notice, collected, warn
from mcaptrack.tables import Format
from mcaptrack.tables.catalogue import is_folder_of_tables
from mcaptrack.tables.export import default_folder, recording_name
from mcaptrack.tables.export import export as write_tables
from mcaptrack.tables.rosbag2 import Storage, write_bag
from mcaptrack.tables.rosbag2 import default_folder as default_bag
from mcaptrack.viewing import report as pages

#: ROS 2 bags by the format of ``export``.
_BAGS: Mapping[str, Storage] = {"rosbag2": "mcap", "rosbag2-sqlite3": "sqlite3"}


@dataclass(frozen=True)
class ExportResult:
    """The tables of a log in a folder, or its bag.

    Attributes
    ----------
    log : pathlib.Path or str
        The log; the URL of one in a store.
    folder : pathlib.Path
        The folder with its tables.
    rows : dict of str to int
        Number of rows of each table; of a bag, the number of messages of each topic.
    written : tuple of str
        The tables that were written; the others were up to date. Of a bag, its topics.
    warnings : tuple of mcaptrack.Notice
        What was left out.
    delta : {"added", "replaced", "unchanged"} or None
        What became of the log in the Delta tables; None if none were named.

    """

    log: Location
    folder: Path
    rows: Mapping[str, int]
    written: tuple[str, ...]
    warnings: tuple[Notice, ...]
    delta: Literal["added", "replaced", "unchanged"] | None = None

    @property
    def is_up_to_date(self) -> bool:
        """Whether there was nothing to write."""
        return not self.written


@checked()
def export(
    log: PathLike,
    output: PathLike | None = None,
    *,
    form: Format | Literal["rosbag2", "rosbag2-sqlite3"] = "parquet",
    topic: str | Sequence[str] | None = None,
    blobs: bool = False,
    delta: PathLike | None = None,
    force: bool = False,
    progress: Progress = no_progress,
) -> ExportResult:
    """Write a log as tables, one row per object and frame, or as a ROS 2 bag.

    A bag has detections and tracks as ``vision_msgs/Detection3DArray`` or ``Detection2DArray``, predictions as
    ``nav_msgs/Path``, drawings of tracks and predictions as ``visualization_msgs/MarkerArray``, and the transforms of
    the log.

    Parameters
    ----------
    log : path
        The log.
    output : path, optional
        Folder for the tables, by default LOG.tables beside the log, or for the bag, by default LOG.rosbag2; of a log
        in a store, in the working folder.
    form : {"parquet", "arrow", "csv", "jsonl", "rosbag2", "rosbag2-sqlite3"}, default "parquet"
        Format of the files. "rosbag2" is a ROS 2 bag in MCAP, "rosbag2-sqlite3" one in a database.
    topic : str or sequence of str, optional
        Also write a table of all messages of these channels.
    blobs : bool, default False
        With ``topic``: include binary fields, such as pictures and point clouds.
    delta : path, optional
        A folder, or its URL in a store, with Delta tables of many logs: the log is added to them, or replaced. Needs
        deltalake.
    force : bool, default False
        Write all tables again, also over those of another log of this name; replace a bag.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

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
    >>> import mcaptrack
    >>> mcaptrack.export("log.mcap", "tables").rows["tracks"] > 0
    True

    """
    path = log_location(log)
    if form in _BAGS:
        if delta is not None:
            raise McaptrackError(f"Delta tables are made of tables, and {form} writes none; leave `form=` out")
        return _export_bag(path, optional_path(output), _BAGS[form], topic, blobs, force, progress)
    if delta is not None and form != "parquet":
        raise McaptrackError(f"Delta tables are made of tables in Parquet, not in {form}; leave `form=` out")
    folder = optional_path(output) or default_folder(path)
    if folder.exists() and not folder.is_dir():
        raise McaptrackError(f"{folder} is a file; tables go to a folder")
    if blobs and not topic:
        raise McaptrackError("`blobs=True` needs a channel to write; name it with `topic=`")
    with warnings_about(path) as warnings:
        with logs.read(path) as opened:
            done = write_tables(
                opened, folder, progress, form=cast("Format", form), topics=names_of(topic), blobs=blobs, force=force
            )
        state = None if delta is None else add_to_delta(as_location(delta), path, folder, force)
        for words in done.notes:
            warn(words, "left-out")
    return ExportResult(path, folder, done.rows, tuple(done.written), tuple(dict.fromkeys(warnings)), state)


def _export_bag(
    path: Location,
    output: Path | None,
    storage: Storage,
    topic: str | Sequence[str] | None,
    blobs: bool,
    force: bool,
    progress: Progress,
) -> ExportResult:
    """Write a log as a ROS 2 bag."""
    with warnings_about(path) as warnings:
        warn_unused("a bag has no tables", topic=bool(topic), blobs=blobs)
        folder = output or default_bag(path)
        with logs.read(path) as opened:
            done = write_bag(opened, folder, progress, storage=storage, force=force)
        for words in done.notes:
            warn(words, "left-out")
    return ExportResult(path, folder, done.messages, tuple(done.messages), tuple(dict.fromkeys(warnings)))


def refuse_same_tables(logs_to_export: Sequence[Location], output: Path | None) -> None:
    """Raise McaptrackError if two different logs would have the same name in the tables of one folder."""
    folders: dict[tuple[Path, str], Location] = {}
    for path in logs_to_export:
        other = folders.setdefault((output or default_folder(path), recording_name(path)), path)
        if place_of(other) != place_of(path):
            raise McaptrackError(
                f"{other} and {path} would both be {recording_name(path)} in the tables; export them to two folders"
            )


@dataclass(frozen=True)
class ReportResult:
    """A report about one or several logs.

    Attributes
    ----------
    page : pathlib.Path
        The HTML file.
    size : int
        Its size in bytes.
    data : dict
        The numbers in the page, as JSON has them.
    warnings : tuple of mcaptrack.Notice
        What could not be compared or looks odd.

    """

    page: Path
    size: int
    data: Mapping[str, Any]
    warnings: tuple[Notice, ...]

    def __repr__(self) -> str:
        return f"ReportResult({str(self.page)!r}, {self.size} bytes)"


@checked()
def report(
    log: PathLike | Sequence[PathLike],
    output: PathLike | None = None,
    *,
    camera: str | None = None,
    force: bool = False,
    progress: Progress = no_progress,
) -> ReportResult:
    """Write one HTML page about a log, or several: scores, predictions, tracks over the scene, identity switches.

    Of a folder with the tables of many logs, the page has the totals, trends, worst logs, outliers and warnings.

    Parameters
    ----------
    log : path or sequence of paths
        The log, or several; or a folder of tables, or the URL of one with Delta tables.
    output : path, optional
        The page, by default LOG.report.html beside the log, or in the working folder if that is in a store; several
        logs need a name, and so do tables.
    camera : str, optional
        Name of the camera, if a log has several.
    force : bool, default False
        Overwrite the page if it exists.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    ReportResult
        The page and its numbers.

    Raises
    ------
    McaptrackError
        If a log cannot be read, or if the page exists.

    Examples
    --------
    >>> import mcaptrack
    >>> mcaptrack.report("log.mcap", "page.html").page.name
    'page.html'

    """
    places = locations_of(log)
    if any(is_folder_of_tables(place) for place in places):
        return _report_on_tables(places, optional_path(output), camera, force)
    paths = [log_location(path) for path in places]
    if not paths:
        raise McaptrackError("there is no log to report on; give one, or several")
    if output is None and len(paths) != 1:
        raise McaptrackError(f"{len(paths)} logs become one page; name it with `output=`")
    target = optional_path(output) or local_name(paths[0], ".report.html")
    if any(is_same_file(path, target) for path in paths):
        raise McaptrackError(f"{target} is a log; give the page another name with `output=`")
    refuse_overwrite(target, force)
    reports = []
    with collected() as warnings:
        for done, path in enumerate(paths):
            progress("report", done, len(paths))
            with logs.read(path) as opened:
                reports.append(pages.gather(opened, camera, detail))
                pages.draw(reports[-1], done, len(paths))
        content = pages.page(reports).encode("utf-8")
        publish_bytes(target, content)
        progress("report", len(paths), len(paths))
    return ReportResult(target, len(content), pages.data(reports), tuple(dict.fromkeys(warnings)))


def _report_on_tables(places: Sequence[Location], output: Path | None, camera: str | None, force: bool) -> ReportResult:
    """Write the page about all logs in a folder of tables."""
    if len(places) != 1:
        raise McaptrackError(f"{places[0]} and others: a page is about logs, or about one folder of tables; give one")
    if output is None:
        raise McaptrackError(f"the page about all logs in {places[0]} needs a name; give one with `output=`")
    refuse_overwrite(output, force)
    with collected() as warnings:
        warn_unused("the page is about all cameras of all logs", camera=camera is not None)
        content, data = page_about(places[0], output.parent)
        publish_bytes(output, content)
    return ReportResult(output, len(content), data, tuple(dict.fromkeys(warnings)))
