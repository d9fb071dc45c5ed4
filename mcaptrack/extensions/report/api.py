"""Write tables, reports and videos of logs."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

from mcaptrack.api.common import detail, locations_of, log_location, optional_path, warn_unused
from mcaptrack.api.declared import Argument, declared
from mcaptrack.api.options import LOGS, Camera, Force, PathLike, Progress, Reports, no_progress, output
from mcaptrack.errors import McaptrackError
from mcaptrack.files import is_same_file, place_of, publish_bytes, refuse_overwrite
from mcaptrack.location import Location, distinct_names, local_name, parse
from mcaptrack.notices import Notice, collected
from mcaptrack.viewing.formatting import render

#: The largest page in bytes that notebooks show and keep.
_MOST_INLINE: Final = 8_000_000


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

    def _repr_html_(self) -> str:
        """The page in a frame, for notebooks, as long as the file is there and not too large to be kept in one."""
        caption = f"{self.page} ({self.size / 1e6:.1f} MB)"
        try:
            size = self.page.stat().st_size
            page = self.page.read_text(encoding="utf-8") if size <= _MOST_INLINE else None
        except OSError as error:
            return _framed(None, f"{caption} can't be read: {error.strerror}")
        return _framed(page, caption if page is not None else f"{caption} is too large to show here; open the file")


def _framed(page: str | None, caption: str) -> str:
    """Return a page in a frame, without an origin, with a caption; the caption alone without a page."""
    return str(render("framed.html", __package__ or "", page=page or "", caption=caption))


@declared(heading="Start here", printed_by="mcaptrack.extensions.report.command:ReportCommand")
def report(
    log: Annotated[PathLike | Sequence[PathLike], Argument("logs", "LOG", LOGS)],
    output: Annotated[PathLike | None, output()] = None,
    *,
    camera: Camera = None,
    force: Force = False,
    progress: Reports = no_progress,
) -> ReportResult:
    """Write a page about logs: scores, tracks, identity switches.

    It has forecasts and the lineage of results, too. The page needs no network, and runs no script but its own; it
    contains its numbers as JSON, which --json prints. Scores are those of `mcaptrack evaluate`; without ground truth in
    the log there are none. Only reads logs; `mcaptrack run` runs stages that are missing. Of a folder with the tables
    of many logs, the page has totals, trends, the worst logs, outliers and warnings.

    Parameters
    ----------
    log : path or sequence of paths
        The log, or several; or a folder of tables.
    output : path, optional
        Write the page to this file; by default LOG.report.html beside the log.

        In the working folder if the log is in a store. Several logs need a name, and so do tables.

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
    On the command line:

        mcaptrack report log.mcap -o report.html

        mcaptrack report 'logs/*.mcap' -o report.html

        mcaptrack report tables/ -o fleet.html

    >>> import mcaptrack
    >>> mcaptrack.report("log.mcap", "page.html").page.name
    'page.html'

    """
    from mcaptrack.tables.catalogue import is_folder_of_tables

    places = locations_of(log)
    tables = [place for place in places if is_folder_of_tables(place)]
    if not places:
        raise McaptrackError("there is no log to report on; give one, or several")
    if tables and len(places) > 1:
        raise McaptrackError(f"{places[0]} and others: a page is about logs, or about one folder of tables; give one")
    paths = [] if tables else [log_location(path) for path in places]
    target = _page_of(paths, optional_path(output))
    refuse_overwrite(target, force)
    with collected() as warnings:
        if tables:
            warn_unused("the page is about all cameras of all logs", camera=camera is not None)
            text, data = _about_tables(tables[0], target.parent)
        else:
            text, data = _about_logs(paths, camera, progress)
        content = text.encode("utf-8")
        publish_bytes(target, content)
    return ReportResult(target, len(content), data, tuple(dict.fromkeys(warnings)))


def _page_of(logs_: Sequence[Location], output: Path | None) -> Path:
    """Return the page to write: by default beside the only log. Raises McaptrackError for other files than pages."""
    if output is None and len(logs_) != 1:
        what = f"{len(logs_)} logs" if logs_ else "all logs of the tables"
        raise McaptrackError(f"the page about {what} needs a name; give one with `output=`")
    page = output or local_name(logs_[0], ".report.html")
    if any(is_same_file(log, page) for log in logs_):
        raise McaptrackError(f"{page} is a log; give the page another name with `output=`")
    if page.suffix.lower() not in (".html", ".htm"):
        raise McaptrackError(f"{page}: the page is written as HTML; give a name that ends with .html")
    return page


def _about_logs(paths: Sequence[Location], camera: str | None, progress: Progress) -> tuple[str, dict[str, Any]]:
    """Return the page about logs, and its numbers."""
    from mcaptrack import log as logs
    from mcaptrack.extensions.report import page as pages

    real = [place_of(path) for path in paths]
    files, names = (distinct_names(some, real) for some in ([p.name for p in paths], [p.stem for p in paths]))
    reports = []
    for done, path in enumerate(paths):
        progress("report", done, len(paths))
        with logs.read(path) as opened:
            reports.append(pages.gather(opened, camera, detail, files[done], names[done]))
            pages.draw(reports[-1], done, len(paths))
    progress("report", len(paths), len(paths))
    return pages.page(reports), pages.data(reports)


def _about_tables(where: Path, folder: Path) -> tuple[str, dict[str, Any]]:
    """Return the page about all logs in a folder of tables, and its numbers; it links to pages from ``folder``."""
    from mcaptrack.extensions.report import page as pages
    from mcaptrack.tables.catalogue import read_catalogue

    rows = read_catalogue(where)
    data = pages.fleet_data(rows)
    return pages.fleet_page(rows, str(where), pages.ELEMENT, data, partial(_page_beside, folder)), data


def _page_beside(folder: Path, row: Mapping[str, Any]) -> str:
    """Return the page of a log if it stands beside the log, as seen from a folder; "" if it doesn't."""
    location = parse(row.get("location") or "")
    if not isinstance(location, Path) or not location.is_absolute():
        return ""
    page = local_name(location, ".report.html")
    return os.path.relpath(page, folder.absolute()) if page.is_file() else ""
