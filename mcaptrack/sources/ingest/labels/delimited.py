"""Read tables of boxes with a header, separated by commas, semicolons or tabs: any CSV, and that of supervision.

Letters: N rows, F frames.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats
from mcaptrack.schema.classes import PERSON, is_person
from mcaptrack.sources.ingest.labels.box_rows import NO_CLASS, BoxRows, FrameNames, TrackIds
from mcaptrack.sources.ingest.labels.columns import choose_columns
from mcaptrack.sources.ingest.labels.content import NO_ID, Format, Labels, WantedClasses
from mcaptrack.sources.ingest.labels.formats import ClassNames
from mcaptrack.sources.ingest.labels.number_table import Lines, NumberTable, lines_of

#: Columns that supervision writes before those of the user.
SUPERVISION: Final = ("x_min", "y_min", "x_max", "y_max", "class_id", "confidence", "tracker_id")
_DELIMITERS: Final = ",;\t"
#: Where one of these separates cells, a comma in a number is a decimal comma.
_NOT_COMMAS: Final = (";", "\t")
#: The largest number of characters of a row.
MAX_LINE: Final = 65536
_MAX_COLUMNS: Final = 1024
_LEAST_COLUMNS: Final = 4
#: Between cells of rows that come from JSON.
_SEPARATOR: Final = "\x1f"
#: The column that counts frames from 0, as examples of supervision add it.
_FRAME_INDEX: Final = "frame_index"
#: Keys of columns that make a box.
_OF_BOXES: Final = ("x", "y", "w", "h", "x2", "y2", "cx", "cy")
#: Values of cells that state nothing.
_EMPTY: Final = ("", "nan", "none", "null", "n/a", "na")
#: Seconds per unit, by the end of a column's name.
_UNITS: Final = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3}
#: Times in seconds can't be larger: the year 2262.
_MAX_SECONDS: Final = 2**63 / 1e9


def header_of(path: Path, line: str) -> list[str]:
    """The names of columns if a line is a header, otherwise an empty list: none of its cells is a number."""
    cells = [cell.strip() for cell in split_row(path, delimiter_of(line), line)]
    is_header = len(cells) >= _LEAST_COLUMNS and not any(_is_number(cell) for cell in cells)
    return cells if is_header and any(line.count(delimiter) for delimiter in _DELIMITERS) else []


def comment_header(path: Path, row: str) -> list[str]:
    """The names of columns by a first line that begins with "#", if it fits the first row; otherwise an empty list."""
    _, first = next(lines_of(path, MAX_LINE, has_comments=True), (0, ""))
    names = header_of(path, first.strip().lstrip("#")) if first.lstrip().startswith("#") else []
    delimiter = delimiter_of(row)
    cells = split_row(path, delimiter, row)
    return names if len(names) == len(cells) and delimiter == delimiter_of(first) else []


def is_empty(cell: str) -> bool:
    """Whether a cell states nothing."""
    return cell.strip().lower() in _EMPTY


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def delimiter_of(header: str) -> str:
    """The character that separates the cells of a line."""
    return max(_DELIMITERS, key=header.count)


def split_row(path: Path, delimiter: str, line: str) -> list[str]:
    """The cells of a line. Raises McaptrackError if they can't be told apart."""
    try:
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error as error:
        raise McaptrackError(f"{path}: {error}: {line[:60]!r}") from None


def read_csv(path: Path, role: Role, chosen: Mapping[str, str], name: Format, wanted: WantedClasses) -> Labels:
    """Read a table with a header; ``chosen`` are names of columns by key, see ``columns.KEYS``."""
    lines = lines_of(path, MAX_LINE)
    number, first = next(lines, (0, ""))
    if not number:
        raise McaptrackError(f"{path} holds no labels")
    header = header_of(path, first)
    if not header and (header := comment_header(path, first)):
        lines = chain([(number, first)], lines)
    if not header:
        raise McaptrackError(
            f"{path}:{number}: a table needs a header that names its columns, separated by commas, semicolons or tabs: "
            f"{first.strip()[:60]}"
        )
    delimiter = delimiter_of(first)
    split = partial(split_row, path, delimiter)
    return _read_table(path, number, header, lines, split, role, chosen, name, wanted, delimiter)


def read_rows(path: Path, content: list[Any], role: Role, chosen: Mapping[str, str], wanted: WantedClasses) -> Labels:
    """Read rows of supervision's JSONSink: objects with the same keys."""
    header = [str(key) for key in content[0]][: _MAX_COLUMNS + 1]

    def lines() -> Iterator[tuple[int, str]]:
        for number, row in enumerate(content, start=1):
            if not isinstance(row, dict) or list(row)[: len(header)] != header:
                raise McaptrackError(f"{path}: row {number} has other keys than the first one: {str(row)[:60]}")
            yield number, _SEPARATOR.join(str(value).replace(_SEPARATOR, " ")[:MAX_LINE] for value in row.values())

    def split(line: str) -> list[str]:
        return line.split(_SEPARATOR)

    return _read_table(path, 1, header, lines(), split, role, chosen, "supervision", wanted)


def _read_table(
    path: Path,
    number: int,
    header: list[str],
    lines: Lines,
    split: Callable[[str], list[str]],
    role: Role,
    chosen: Mapping[str, str],
    name: Format,
    wanted: WantedClasses,
    delimiter: str = "",
) -> Labels:
    if len(header) > _MAX_COLUMNS:
        raise McaptrackError(f"{path}:{number}: more than {_MAX_COLUMNS} columns")
    at = choose_columns(f"{path}:{number}", header, chosen)
    classes, names, frames, ids = ClassNames(), ClassNames(), FrameNames(), TrackIds()

    def number_of(text: str) -> float:
        text = text.strip()
        return math.nan if is_empty(text) else float(text.replace(",", ".") if delimiter in _NOT_COMMAS else text)

    def id_of(text: str) -> float:
        try:
            return number_of(text)
        except ValueError:
            return ids.number(text.strip())

    def frame_of(text: str) -> float:
        return float(text) if _is_number(text) else frames.number(text.strip())

    readers: dict[str, Callable[[str], float]] = {"frame": frame_of, "id": id_of}
    readers |= {key: _class_reader(numbers) for key, numbers in (("class", classes), ("name", names))}
    keys = sorted(at, key=at.__getitem__)

    def parse(parts: list[str]) -> list[float]:
        if len(parts) != len(header):
            raise ValueError(f"{len(parts)} columns, and the header has {len(header)}")
        return [cell(key, parts[at[key]]) for key in keys]

    def cell(key: str, text: str) -> float:
        try:
            return readers.get(key, number_of)(text)
        except ValueError as error:
            if "column" in str(error):
                raise
            problem = f"the column {header[at[key]]} holds {text.strip()[:40]!r}, which is no number"
            if delimiter == "," in text:
                problem += "; decimal commas are read where semicolons or tabs separate the columns"
            raise ValueError(problem) from None

    what = f"a row of {', '.join(header[at[key]] for key in keys)}"
    table = NumberTable(path, lines, what, len(keys), parse, split)
    columns = {key: table.values[:, place] for place, key in enumerate(keys)}
    none = np.full(len(table.values), np.nan)
    unit = f" in {unit_of(header[at['t']])[0]}" if "t" in at else ""
    used = ", ".join(f"{key}={header[at[key]]}{unit * (key == 't')}" for key in keys)
    unused = [name for place, name in enumerate(header) if name and place not in at.values()]
    remarks = [f"{path}: columns {used}" + (f"; not read: {', '.join(unused)}"[:300] if unused else "")]
    track_id, said = ids.of(path, columns.get("id", none))
    remarks += said
    if "id" in at and header[at["id"]].lower() == "id" and "id" not in chosen and _are_row_numbers(track_id):
        remarks.append(f"{path}: every box has another {header[at['id']]}, so it numbers rows, not tracks")
        track_id = np.full(len(none), float(NO_ID))
    kind, class_names = _classes(columns, classes, names)
    boxes = _boxes(columns)
    rows = BoxRows(
        path,
        name,
        lambda row: f"{path}:{table.line[row]}",
        columns.get("frame", none),
        boxes,
        track_id,
        columns.get("score", none),
        kind,
        class_names,
        remarks=remarks,
    )
    if "t" in at:
        _number_times(rows, columns["t"] * unit_of(header[at["t"]])[1])
    parts = np.stack([columns[key] for key in _OF_BOXES if key in columns])
    rows.leave_out_empty(np.asarray(np.isnan(parts).all(axis=0), bool))
    if name == "csv":
        rows.take_shares()
    if name == "supervision" and header[at.get("frame", 0)].lower() == _FRAME_INDEX:
        rows.first_frame = 0
    return rows.labels(role, wanted)


def _class_reader(numbers: ClassNames) -> Callable[[str], float]:
    return lambda text: math.nan if is_empty(text) else numbers.number(text.strip())


def _are_row_numbers(track_id: Floats) -> bool:
    return len(track_id) > 1 and len(np.unique(track_id)) == len(track_id)


def _boxes(columns: Mapping[str, Floats]) -> Floats:
    """Boxes (N, 4) of left, top, width, height."""
    parts = []
    for low, size, high, centre in (("x", "w", "x2", "cx"), ("y", "h", "y2", "cy")):
        extent = columns[size] if size in columns else columns[high] - columns[low]
        parts.append((columns[low] if low in columns else columns[centre] - extent / 2, extent))
    (left, width), (top, height) = parts
    return np.stack([left, top, width, height], axis=-1)


def unit_of(header: str) -> tuple[str, float]:
    """The unit of a column of times, by its name, and its seconds: s, unless it ends with _ms, _us or _ns."""
    text = header.strip().lower()
    units = (unit for unit in _UNITS.items() if text.endswith((f"_{unit[0]}", f" {unit[0]}", f"({unit[0]})")))
    return next(units, ("s", 1.0))


def _number_times(rows: BoxRows, seconds: Floats) -> None:
    rows.refuse(
        ~(np.isfinite(seconds) & (seconds >= 0) & (seconds < _MAX_SECONDS)),
        lambda row: (
            f"a time is a number of seconds from 0 to the year 2262, not {seconds[row]:g}; the name of its column may "
            "end with _ms, _us or _ns"
        ),
    )
    rows.times_s, frame = np.unique(seconds, return_inverse=True)
    rows.frame, rows.first_frame = frame.astype(float), 0


def _classes(
    columns: Mapping[str, Floats], classes: ClassNames, names: ClassNames
) -> tuple[Floats, dict[int, str] | None]:
    """The classes of rows as numbers (N,), and their names by number, None if there are none."""
    none = np.full(len(next(iter(columns.values()))), float(NO_CLASS))
    number = columns.get("class")
    if number is not None and classes.names and all(_is_number(name) for name in classes.names):
        stated = np.isfinite(number)
        values = np.array([float(name) for name in classes.names])
        none[stated] = values[number[stated].astype(int)]
        if "name" not in columns:
            return none, None
        both = stated & np.isfinite(columns["name"])
        pairs = set(zip(none[both].tolist(), columns["name"][both].tolist(), strict=True))
        if len({number for number, _ in pairs}) == len(pairs) and all(number == int(number) for number, _ in pairs):
            return none, {int(number): names.names[int(other)] for number, other in pairs}
    column, texts = (columns["name"], names.names) if "name" in columns else (number, classes.names)
    if column is None or not texts:
        return none, None
    others = sorted({text.lower() for text in texts if not is_person(text)})
    places = {text: place for place, text in enumerate(others, start=PERSON + 1)}
    ids = [places.get(text.lower(), PERSON) for text in texts]
    stated = np.isfinite(column)
    none[stated] = np.array(ids, float)[column[stated].astype(int)]
    return none, dict(reversed(list(zip(ids, texts, strict=True))))
