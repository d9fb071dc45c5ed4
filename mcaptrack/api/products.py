"""The files beside a log (layouts, tables), all of them made from the content of the log.

A log is written as a whole, with its views and its layouts; what stands beside it is written afterwards, so a run that
is killed may leave the log without. ``write_products`` is what every command calls after it has written, or found
nothing to write: it makes what is missing or older than the log, and removes what killed runs have left.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api.options import Progress
from mcaptrack.files import publish_bytes, sweep
from mcaptrack.location import Location
from mcaptrack.notices import warn

if TYPE_CHECKING:
    from mcaptrack.sources.fixed_frame import BoxesRead


@dataclass
class Products:
    """The files beside a log: all that are owed; the layouts and tables among them that were written now, by name of
    the table; and the numbers of rows of all tables.
    """

    owed: list[Path] = field(default_factory=list)
    layouts: list[Path] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)
    rows: dict[str, int] = field(default_factory=dict)


def refuse_foreign_products(opened: logs.Log, target: Location) -> None:
    """Raise McaptrackError if the tables of the log at ``target``, made from ``opened``, would replace another's."""
    from mcaptrack.tables.export import default_folder, refuse_tables_of_another

    if isinstance(target, Path):
        refuse_tables_of_another(opened, target, default_folder(target))


def write_products(
    log: Location,
    *,
    is_new: bool,
    tables: bool = False,
    force: bool = False,
    progress: Progress,
    boxes: BoxesRead | None = None,
) -> Products:
    """Bring all files beside a log up to date; ``is_new`` says whether this process has just written the log.

    None are beside an object: the log itself holds its layouts.
    """
    done = Products()
    if not isinstance(log, Path):
        return done
    with logs.read(log) as opened:
        if opened.results is None:
            logs.update_listing(log)
        for path, content in _layouts(opened, log):
            done.owed.append(path)
            sweep(path.parent, path.name)
            if is_new or not _stands(path, content, opened):
                publish_bytes(path, content)
                done.layouts.append(path)
        if tables:
            from mcaptrack.tables.export import default_folder, export, main_file

            exported = export(opened, default_folder(log), progress, force=force, boxes=boxes)
            done.owed.append(main_file(log, default_folder(log)))
            done.rows, done.tables = exported.rows, exported.written
            for note in exported.notes:
                warn(note, "left-out")
    return done


def _layouts(opened: logs.Log, log: Path) -> Iterator[tuple[Path, bytes]]:
    """Yield the layouts that a log holds, each with its path beside the log."""
    for name in pipeline.LAYOUTS:
        content = opened.attachment(pipeline.attachment_of(name))
        if content is not None:
            yield pipeline.layout_path(log, name), content


def _stands(path: Path, content: bytes, opened: logs.Log) -> bool:
    """Return whether a layout is that of the log, or one that a user has edited since the log was written."""
    try:
        changed_ns = path.stat().st_mtime_ns
        written_ns = Path(opened.parts[-1].path).stat().st_mtime_ns
        return path.read_bytes() == content or changed_ns > written_ns
    except OSError:
        return False
