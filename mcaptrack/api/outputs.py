"""Write tables, reports and videos of logs."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

from mcaptrack import log as logs
from mcaptrack.api.common import detail, locations_of, log_location, optional_path, warn_unused
from mcaptrack.api.declared import Argument, declared
from mcaptrack.api.options import LOGS, Camera, Force, PathLike, Reports, no_progress, output
from mcaptrack.errors import McaptrackError
from mcaptrack.files import is_same_file, place_of, publish_bytes, refuse_overwrite
from mcaptrack.location import distinct_names, local_name, parse
from mcaptrack.notices import Notice, collected
from mcaptrack.tables.catalogue import is_folder_of_tables, read_catalogue
from mcaptrack.viewing import report as pages

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
        from mcaptrack.viewing.notebook.page import framed_html

        caption = f"{self.page} ({self.size / 1e6:.1f} MB)"
        try:
            size = self.page.stat().st_size
            page = self.page.read_text(encoding="utf-8") if size <= _MOST_INLINE else None
        except OSError as error:
            return framed_html(None, f"{caption} can't be read: {error.strerror}")
        return framed_html(page, caption if page is not None else f"{caption} is too large to show here; open the file")


@declared()
def report(
    log: Annotated[PathLike | Sequence[PathLike], Argument("logs", "LOG", LOGS)],
    output: Annotated[PathLike | None, output()] = None,
    *,
    camera: Camera = None,
    force: Force = False,
    progress: Reports = no_progress,
) -> ReportResult:
    """Write one page about a log, or several: scores, forecasts, tracks over the scene, identity switches, lineage.

    The page needs no network and has no scripts; it contains its numbers as JSON, which --json prints. Scores are those
    of `mcaptrack evaluate`; without ground truth in the log there are none. Only reads logs; `mcaptrack run` runs
    stages that are missing. Of a folder with the tables of many logs, the page has totals, trends, the worst logs,
    outliers and warnings.

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
    places = locations_of(log)
    for place in places:
        if isinstance(place, Path) and is_folder_of_tables(place):
            if len(places) != 1:
                raise McaptrackError(
                    f"{places[0]} and others: a page is about logs, or about one folder of tables; give one"
                )
            return _report_on_tables(place, optional_path(output), camera, force)
    paths = [log_location(path) for path in places]
    if not paths:
        raise McaptrackError("there is no log to report on; give one, or several")
    if output is None and len(paths) != 1:
        raise McaptrackError(f"{len(paths)} logs become one page; name it with `output=`")
    target = optional_path(output) or local_name(paths[0], ".report.html")
    if any(is_same_file(path, target) for path in paths):
        raise McaptrackError(f"{target} is a log; give the page another name with `output=`")
    refuse_overwrite(target, force)
    real = [place_of(path) for path in paths]
    files, names = (distinct_names(some, real) for some in ([p.name for p in paths], [p.stem for p in paths]))
    reports = []
    with collected() as warnings:
        for done, path in enumerate(paths):
            progress("report", done, len(paths))
            with logs.read(path) as opened:
                reports.append(pages.gather(opened, camera, detail, files[done], names[done]))
                pages.draw(reports[-1], done, len(paths))
        content = pages.page(reports).encode("utf-8")
        publish_bytes(target, content)
        progress("report", len(paths), len(paths))
    return ReportResult(target, len(content), pages.data(reports), tuple(dict.fromkeys(warnings)))


# The page about all logs in a folder of tables.


def page_about(where: Path, folder: Path) -> tuple[bytes, dict[str, Any]]:
    """Return the page about all logs in a folder of tables, and its numbers; it links to pages from ``folder``."""
    rows = read_catalogue(where)
    data = pages.fleet_data(rows)
    text = pages.fleet_page(rows, str(where), pages.ELEMENT, data, partial(_page_beside, folder))
    return text.encode("utf-8"), data


def _page_beside(folder: Path, row: Mapping[str, Any]) -> str:
    """Return the page of a log if it stands beside the log, as seen from a folder; "" if it doesn't."""
    location = parse(row.get("location") or "")
    if not isinstance(location, Path) or not location.is_absolute():
        return ""
    page = local_name(location, ".report.html")
    return os.path.relpath(page, folder.absolute()) if page.is_file() else ""


def _report_on_tables(folder: Path, output: Path | None, camera: str | None, force: bool) -> ReportResult:
    """Write the page about all logs in a folder of tables."""
    if output is None:
        raise McaptrackError(f"the page about all logs in {folder} needs a name; give one with `output=`")
    refuse_overwrite(output, force)
    with collected() as warnings:
        warn_unused("the page is about all cameras of all logs", camera=camera is not None)
        content, data = page_about(folder, output.parent)
        publish_bytes(output, content)
    return ReportResult(output, len(content), data, tuple(dict.fromkeys(warnings)))
