"""Read label files: which format one is of, its rows, and what is checked and decided after that; and homographies."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial, reduce
from itertools import chain, islice
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError, list_names
from mcaptrack.files import refuse_special, visible
from mcaptrack.schema.classes import ClassMap
from mcaptrack.schema.spill import SpillFile, Stored
from mcaptrack.sources.ingest.labels.checks import OF_ROLE, check
from mcaptrack.sources.ingest.labels.format import PLACES, Format, LabelFile
from mcaptrack.sources.ingest.labels.of_packages import FormatOfPackage, format_named, own_formats, recognised
from mcaptrack.sources.ingest.labels.roles import WantedClasses, rename, settled
from mcaptrack.sources.ingest.labels.table import Asked, BoxTable, Extent
from mcaptrack.sources.ingest.labels.text import lines_of, split

_AUTO: Final = "auto"
_TABLE: Final = "csv"
_LISTED: Final = 6
#: Files from this size on are read in parts, of about so many rows.
_LONG_BYTES: Final = 20_000_000
_PART_ROWS: Final = 200_000


def known_format(file: LabelFile, label_format: str = _AUTO, columns: Mapping[str, str] | None = None) -> Format | None:
    """The format of a file: the one that is given, or by its content; None if it is of no known one.

    Raises McaptrackError if there is no such format, or if formats of several other packages recognise the file.
    """
    if label_format != _AUTO:
        return format_named(label_format)
    for made in own_formats():
        if (not columns or "columns" in made.takes) and made.recognises(file):
            return made
    return format_named("records" if file.is_json else _TABLE) if columns else recognised(file)


def label_file(path: Path, label_format: str = _AUTO) -> LabelFile:
    """A file or folder with labels, or the one inside of a folder where data sets and tools have it (``PLACES``).

    Raises McaptrackError if there are several.
    """
    file = LabelFile(path)
    if label_format != _AUTO or not file.is_folder or file.holds_pictures or known_format(file):
        return file
    for pattern in PLACES:
        inside = [entry for entry in visible(path.glob(pattern)) if known_format(LabelFile(entry))]
        if len(inside) > 1:
            listed = list_names([str(entry.relative_to(path)) for entry in inside], _LISTED)
            raise McaptrackError(f"{path} holds labels in {len(inside)} places, {listed}; give one of them")
        if inside:
            return LabelFile(inside[0])
    return file


def is_3d(path: Path, label_format: str = _AUTO, columns: Mapping[str, str] | None = None) -> bool:
    """Whether a label file holds boxes in metres, by the format that is given, or by its content."""
    if label_format == _AUTO and not path.exists():
        return False
    file = label_file(path, label_format)
    made = known_format(file, label_format, columns)
    return made is not None and made.holds_3d(file, columns or {})


def read_labels(
    path: Path,
    label_format: str = _AUTO,
    role: Role | None = "tracks",
    first_frame: int | None = None,
    columns: Mapping[str, str] | None = None,
    wanted: WantedClasses | None = None,
    in_parts: bool = False,
    scene: str | None = None,
    class_map: ClassMap | None = None,
) -> BoxTable:
    """Read a label file.

    Parameters
    ----------
    path : Path
        A file, or a folder.
    label_format : str
        "auto" detects it from the content.
    role : str, optional
        "detections", "tracks" or "truth" (ground truth); None: tracks if any row has an id.
    first_frame : int, optional
        The number of the first picture in the file, if it isn't the one of the format.
    columns : dict, optional
        Names of the columns of a table with a header, by what they hold.
    wanted : WantedClasses, optional
        The classes of tracks and ground truth, by default people, and of boxes in metres all; detections keep all.
    in_parts : bool
        Read a long file in parts, if it is detections, or tracks of people, in a format in which a row says all about
        itself, and sorted by frame.
    scene : str, optional
        The name of a part of a data set.
    class_map : ClassMap, optional
        Names of classes by what the file calls them.

    Returns
    -------
    BoxTable
        Sorted by frame and id, and checked.

    Raises
    ------
    McaptrackError
        With the line, if the file doesn't have this format, or none of the known ones, or if its rows can't be labels.
    """
    refuse_special(path)
    file = label_file(path, label_format)
    asked = Asked(label_format, role, columns or {}, scene, wanted, first_frame, class_map)
    made = known_format(file, label_format, columns)
    if made is None:
        file.refuse_binary()
        raise file.unknown()
    for option in ("columns", "scene"):
        if getattr(asked, option) and option not in made.takes:
            takers = ", ".join(other.title for other in own_formats() if option in other.takes)
            takers = takers or "formats that aren't installed"
            raise McaptrackError(f"{path}: `{option}=` is for {takers}, not for {made.name}")
    if file.is_folder and not made.reads_folders:
        raise McaptrackError(f"{path} is a folder, and {made.name} labels are a file")
    if not (file.is_folder or made.reads_files):
        text = f"labels of {made.title} are a folder with a text file for each picture"
        raise McaptrackError(f"{path} is not a folder; {text}")
    is_alike = role == "detections" or (role in ("tracks", None) and (wanted is None or wanted.is_people))
    if in_parts and made.in_parts and is_alike and class_map is None and path.stat().st_size >= _LONG_BYTES:
        table = _read_in_parts(file, made, replace(asked, role=role or "tracks"))
        if table is not None:
            return table
    table = read_by(made, file, asked)
    if file.path != path:
        table.remarks.insert(0, f"{path}: its labels are {file.path.relative_to(path)}")
    return table


def read_by(made: Format, file: LabelFile, asked: Asked) -> BoxTable:
    """The rows of a file of a format. Raises McaptrackError as ``read_labels`` does."""
    table = made.read(file, asked)
    table.facts.format = made.name
    table.facts.found_by = "content" if asked.label_format == _AUTO else "option"
    with made.checking() if isinstance(made, FormatOfPackage) else nullcontext():
        if asked.class_map is not None:
            rename(table, asked.class_map)
        check(table, asked)
        role = asked.role or ("tracks" if table.has_ids else "detections")
        table = settled(table, role, asked.classes).in_order()
        check(table, asked, OF_ROLE)
    return table


def read_homography(path: Path) -> tuple[float, ...]:
    """Read a 3x3 homography, separated by commas or blanks, as 9 numbers in row order.

    Raises McaptrackError if invalid.
    """
    text = f"{path} is not a homography: it needs 3 rows of 3 numbers"
    rows: list[list[float]] = []
    for _, line in lines_of(path):
        try:
            rows.append([float(part) for part in split(line)])
        except ValueError:
            raise McaptrackError(f"{text}, separated by commas or blanks") from None
        if len(rows) > 3:
            break
    if len(rows) != 3 or any(len(row) != 3 for row in rows):
        shape = " + ".join(str(len(row)) for row in rows) or "no"
        raise McaptrackError(f"{text}, not {shape}{' + ...' if len(rows) > 3 else ''} numbers")
    return tuple(number for row in rows for number in row)


# Label files that are too long for memory: their rows in a temporary file, in parts of whole frames.
#
# Formats in which a row says all about itself are read so if their rows come in the order of their frames, as
# programs write detections and tracks. Others are in memory as a whole.


def _read_in_parts(file: LabelFile, made: Format, asked: Asked) -> BoxTable | None:
    """Read a label file in parts; None if it isn't sorted by frame, or if parts aren't understood alike."""
    lines, spilled, stored = lines_of(file.path), SpillFile(), list[Mapping[str, Stored]]()
    tables, extents = list[BoxTable](), list[Extent]()
    rest: BoxTable | None = None  # the last frame, which may go on
    assert asked.role is not None
    while (line := next(lines, None)) is not None:
        raw = made.read(LabelFile(file.path, chain([line], islice(lines, _PART_ROWS - 1))), asked)
        check(raw, asked)
        part = settled(raw, asked.role, asked.classes, may_be_empty=True)
        if raw.is_normalised or (tables and raw.facts.meaning != tables[0].facts.meaning):
            return None
        if rest is not None and raw.frame.min() < rest.frame[0]:
            return None
        extents.append(part.extent)
        tables.append(part.take(slice(0)))
        part = part if rest is None else replace(part, **_joined(rest, part))
        part = part.take(np.argsort(part.frame, kind="stable"))
        last = int(np.searchsorted(part.frame, part.frame[-1])) if len(part.frame) else 0
        if last:
            stored.append(_put(spilled, part.take(slice(last))))
        rest = part.take(slice(last, None))
    if rest is None or not len(rest.frame):
        return None
    stored.append(_put(spilled, rest))
    facts = tables[0].facts
    facts.format = made.name
    facts.labelled = np.unique(np.concatenate([part.labelled for part in tables]))
    facts.first_frame = min(part.first_frame for part in tables)
    facts.is_first_assumed = all(part.facts.is_first_assumed for part in tables)
    out = replace(
        tables[0],
        stored=(),
        stored_extent=reduce(Extent.joined, extents),
        left_out=_summed([part.left_out for part in tables if part.left_out]),
        findings=[finding for part in tables for finding in part.findings],
    )
    out.stored = [partial(_part, out, spilled, places) for places in stored]
    if asked.role != "detections":
        for read in out.stored:
            check(read(), asked, OF_ROLE)
    return out


def _part(like: BoxTable, spilled: SpillFile, stored: Mapping[str, Stored]) -> BoxTable:
    """A part of the rows of a table."""
    columns = like.columns()
    for name, place in stored.items():
        values = columns[name]
        columns[name] = np.frombuffer(spilled.get(place), values.dtype).reshape(-1, *values.shape[1:])
    path = like.path
    part = replace(like, **columns, at=lambda _: str(path), stored=(), stored_extent=None, findings=[])
    if like.has_ids:
        return part.take(np.lexsort((part.id, part.frame)))
    return part


def _joined(first: BoxTable, second: BoxTable) -> dict[str, Any]:
    """The columns of both, one after the other."""
    before = first.columns()
    return {
        name: None if values is None else np.concatenate([before[name], values])
        for name, values in second.columns().items()
    }


def _put(spilled: SpillFile, part: BoxTable) -> dict[str, Stored]:
    columns = part.columns()
    return {name: spilled.put(values.tobytes()) for name, values in columns.items() if values is not None}


def _summed(texts: Sequence[str]) -> str:
    """Merge texts that differ only in their numbers, of which the first is summed; "" if there are none."""
    total = sum(int(number[0]) for text in texts if (number := re.search(r"\d+", text)))
    return re.sub(r"\d+", str(total), texts[0], count=1) if texts else ""
