"""Read tables of boxes with a header, separated by commas, semicolons or tabs.

Any CSV of boxes in pictures, and boxes in metres, with headings in radians or degrees, or
quaternions. Columns are those that the user names, or are guessed from common headers.

Letters: N rows, F frames.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from functools import partial
from itertools import chain, islice, takewhile
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S, utc_ns
from mcaptrack.sources.ingest.labels.format import MAX_LINE, Format, LabelFile
from mcaptrack.sources.ingest.labels.table import NO_CLASS, NO_ID, Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import (
    ClassNames,
    FrameNames,
    Lines,
    TrackIds,
    are_numbers,
    headings,
    lines_of,
    numbered,
    read_numbers,
    states_number,
)

_DELIMITERS: Final = ",;\t|"
#: Where one of these separates cells, a comma in a number is a decimal comma.
_NOT_COMMAS: Final = (";", "\t", "|", " ")
_MAX_COLUMNS: Final = 1024
_LEAST_COLUMNS: Final = 4
_MAX_COMMENTS: Final = 1000
#: A name of a column where blanks separate these.
_NAME: Final = re.compile(r"[A-Za-z][\w.%-]*")
#: Objects in objects are read so deep.
_DEEPEST: Final = 2
#: Between cells of rows that come from JSON.
SEPARATOR: Final = "\x1f"
#: The columns of MOTChallenge, in which a comment may name them.
_MOT_COLUMNS: Final = {"frame": 0, "id": 1, "x": 2, "y": 3, "w": 4, "h": 5}
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
    is_header = len(cells) >= _LEAST_COLUMNS and not any(states_number(cell) for cell in cells)
    return cells if is_header and (delimiter_of(line) != " " or all(map(_NAME.fullmatch, cells))) else []


def comment_header(path: Path, row: str) -> list[str]:
    """The names of columns by the last line before the first row, if it begins with "#" and fits; otherwise an empty
    list.
    """
    last = (comments_of(path) or [""])[-1]
    names = header_of(path, last) if last else []
    delimiter = delimiter_of(row)
    cells = split_row(path, delimiter, row)
    return names if len(names) == len(cells) and delimiter == delimiter_of(last) else []


def comments_of(path: Path) -> list[str]:
    """The lines before the first row, which begin with "#", without it."""
    lines = takewhile(lambda line: line.startswith("#"), (line.lstrip() for _, line in lines_of(path, MAX_LINE, True)))
    return [line.strip().lstrip("#").strip() for line in islice(lines, _MAX_COMMENTS)]


def is_empty(cell: str) -> bool:
    """Whether a cell states nothing."""
    return cell.strip().lower() in _EMPTY


def delimiter_of(header: str) -> str:
    """The character that separates the cells of a line; a blank if there is none of the others."""
    most = max(_DELIMITERS, key=header.count)
    return most if most in header else " "


def split_row(path: Path, delimiter: str, line: str) -> list[str]:
    """The cells of a line. Raises McaptrackError if they can't be told apart."""
    if delimiter == " ":
        return line.split()
    try:
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error as error:
        raise McaptrackError(f"{path}: {error}: {line[:60]!r}") from None


class Opened(NamedTuple):
    """A table after its header was read: its place, the names of columns, the rows, and what separates their cells."""

    path: Path
    number: int
    header: list[str]
    lines: Lines
    split: Callable[[str], list[str]]
    delimiter: str = ""
    note: str = ""

    @property
    def where(self) -> str:
        """The place of the header in messages."""
        return f"{self.path}:{self.number}"

    def decimal(self, text: str) -> str:
        """The text of a number, with a point."""
        return text.strip().replace(",", ".") if self.delimiter in _NOT_COMMAS else text.strip()

    def number_in(self, text: str) -> float:
        """The number in a cell; NaN if it states none."""
        return math.nan if is_empty(text) else float(self.decimal(text))


def opened(file: LabelFile) -> Opened:
    """Read the header of a table. Raises McaptrackError if it has none."""
    path, lines = file.path, file.lines(MAX_LINE)
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
    return with_lists(Opened(path, number, header, lines, partial(split_row, path, delimiter), delimiter))


#: Names of columns that hold a box as a list of four numbers, without blanks, "_" and the like; and what these are.
_LISTS: Final = {
    **dict.fromkeys(("", "xywh", "tlwh", "ltwh"), "xywh"),
    **dict.fromkeys(("xyxy", "ltrb", "tlbr"), ("x", "y", "x2", "y2")),
    **dict.fromkeys(("cxcywh", "cxywh"), ("cx", "cy", "w", "h")),
}
_LIST: Final = re.compile(r"(bbox|box|boundingbox|rect)?(" + "|".join(_LISTS) + ")")
_NUMBER: Final = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def with_lists(table: Opened) -> Opened:
    """A table in which four columns, bbox.x and so on, replace one that holds boxes as lists of four numbers, if there
    are no others of boxes.
    """
    plain, header = _plain(table.header), table.header
    lists = [(at, match[2]) for at, name in enumerate(plain) if name and (match := _LIST.fullmatch(name))]
    if not lists or any(name in HEADERS[key] for key in ("x", "cx") for name in plain):
        return table
    at, order = lists[0]
    name, keys = header[at], _LISTS[order]
    note = f"{name} holds {'left, top, width, height' if keys == 'xywh' else ', '.join(keys)}"
    note += f"; a column with the name {name}_xyxy holds corners" if not order else ""

    def split_list(line: str) -> list[str]:
        parts = table.split(line)
        if len(parts) != len(header):
            raise ValueError(f"{len(parts)} columns, and the header has {len(header)}")
        numbers = ["", "", "", ""] if is_empty(parts[at]) else _NUMBER.findall(parts[at])
        if len(numbers) != 4:
            raise ValueError(f"the column {name} holds {parts[at][:40]!r}, which are no four numbers")
        return [*parts[:at], *numbers, *parts[at + 1 :]]

    names = [*header[:at], *(f"bbox.{key}" for key in keys), *header[at + 1 :]]
    return table._replace(header=names, split=split_list, note=note)


class _Cells:
    """The rows of a table as numbers: ``columns`` (N,) by what they hold, and the names that numbers of classes mean.

    ``places`` are the columns that are read; ``readers`` make numbers of those that hold something else.
    """

    def __init__(self, table: Opened, places: Mapping[str, int], readers: Mapping[str, Callable[[str], float]]) -> None:
        header, keys = table.header, sorted(places, key=places.__getitem__)
        if len(header) > _MAX_COLUMNS:
            raise McaptrackError(f"{table.where}: more than {_MAX_COLUMNS} columns")
        self.classes, self.names = ClassNames(), ClassNames()
        of_names = (("class", self.classes), ("name", self.names))
        readers = {**readers, **{key: partial(_number_of_name, numbers) for key, numbers in of_names}}

        def cell(key: str, text: str) -> float:
            try:
                return readers.get(key, table.number_in)(text)
            except ValueError as error:
                if "column" in str(error):
                    raise
                problem = f"the column {header[places[key]]} holds {text.strip()[:40]!r}, which is no number"
                problem += "; times are in seconds" if key == "t" else ""
                if table.delimiter == "," in text:
                    problem += "; decimal commas are read where semicolons or tabs separate the columns"
                raise ValueError(problem) from None

        def parse(parts: list[str]) -> list[float]:
            if len(parts) != len(header):
                raise ValueError(f"{len(parts)} columns, and the header has {len(header)}")
            return [cell(key, parts[places[key]]) for key in keys]

        what = f"a row of {', '.join(header[places[key]] for key in keys)}"
        values, self.at = read_numbers(table.path, table.lines, what, len(keys), parse, table.split)
        self.columns = {key: values[:, place] for place, key in enumerate(keys)}
        self.none = np.full(len(values), np.nan)
        unit = f" in {unit_of(header[places['t']])[0]}" if "t" in places else ""
        used = ", ".join(f"{key}={header[places[key]]}{unit * (key == 't')}" for key in keys)
        unused = [name for place, name in enumerate(header) if name and place not in places.values()]
        more = f"; not read: {', '.join(unused)}"[:300] if unused else ""
        #: Which columns were read, as text.
        self.remark = f"{table.path}: columns {used}{more}{f'; {table.note}' if table.note else ''}"

    def column(self, key: str) -> Floats:
        """A column (N,); NaN if the table has none."""
        return self.columns.get(key, self.none)

    def stacked(self, keys: Iterable[str]) -> Floats:
        """Columns (N, K) side by side."""
        return np.stack([self.column(key) for key in keys], axis=-1)

    def name_classes(self, facts: LabelFacts) -> Floats:
        """The classes of rows (N,), with their names in the facts: numbers, with the names beside them, or names."""
        columns, texts = self.columns, self.classes.names
        kind, name = columns.get("class"), columns.get("name")
        facts.named_by = "file"
        if kind is not None and texts and all(states_number(text) for text in texts.values()):
            stated = np.isfinite(kind)
            number = np.full(len(kind), float(NO_CLASS))
            number[stated] = np.array([float(text) for text in texts.values()])[kind[stated].astype(int)]
            both = stated & np.isfinite(columns.get("name", self.none))
            pairs = {} if name is None else dict(zip(number[both].tolist(), name[both].tolist(), strict=True))
            is_unique = name is not None and len(set(zip(number[both], name[both], strict=True))) == len(pairs)
            if name is None:
                facts.named_by = ""
            elif is_unique and all(own == int(own) for own in pairs):
                facts.names = {int(own): self.names.names[int(other)] for own, other in pairs.items()}
            if name is None or facts.names is not None:
                return number
        kind, names = (kind, texts) if name is None else (name, self.names.names)
        facts.name({} if kind is None else names)
        return np.nan_to_num(self.none if kind is None else kind, nan=NO_CLASS)


def _number_of_name(numbers: ClassNames, text: str) -> float:
    return math.nan if is_empty(text) else numbers.number(text.strip())


def is_table(file: LabelFile) -> bool:
    """Whether a text has a header, other than a comment with the columns of MOTChallenge."""
    if not file.row:
        return False
    try:
        if header_of(file.path, file.row):
            return True
        names = comment_header(file.path, file.row)
        if are_metres(names, {}):
            return True
        columns = choose_columns(str(file.path), names, {}) if names else _MOT_COLUMNS
    except McaptrackError:
        return False
    return any(columns.get(key) != place for key, place in _MOT_COLUMNS.items())


class Csv(Format):
    """Tables with a header, of boxes in pictures and in metres."""

    title = "tables with a header"
    row = "columns by their names: `frame,x,y,w,h,score,class,id`"
    takes = ("columns",)
    rank = 1

    def recognises(self, file: LabelFile) -> bool:
        """Whether the first row names columns, or a comment before it."""
        return is_table(file)

    def header(self, file: LabelFile) -> list[str]:
        """The names of columns."""
        return header_of(file.path, file.row) or (comment_header(file.path, file.row) if file.row else [])

    def opened(self, file: LabelFile) -> Opened:
        """The table. Raises McaptrackError if it is none."""
        return opened(file)

    def holds_3d(self, file: LabelFile, columns: Mapping[str, str]) -> bool:
        """Whether the columns are those of boxes or positions in metres, by their names, or as the user has it."""
        return are_metres(self.header(file), columns)

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a table."""
        read = read_table_3d if self.holds_3d(file, asked.columns) else read_table
        return read(self.opened(file), asked.columns)


def records(file: LabelFile) -> Opened:
    """JSON as a table: a list of objects, or an object in each line, with the same keys; those of objects in it are
    joined with dots. Raises McaptrackError if it is none.
    """
    path, content = file.path, file.records
    if not content or not all(isinstance(row, dict) for row in content):
        raise McaptrackError(f"{path} holds no rows: a list of objects with the same keys, x_min, y_min, ...")
    header = [*_flat(content[0])][: _MAX_COLUMNS + 1]

    def lines() -> Iterator[tuple[int, str]]:
        for number, row in enumerate(map(_flat, content), start=1):
            if row.keys() - header:
                raise McaptrackError(f"{path}: row {number} has other keys than the first one: {str(row)[:60]}")
            cells = ("" if row.get(name) is None else str(row[name]) for name in header)
            yield number, SEPARATOR.join(cell.replace(SEPARATOR, " ")[:MAX_LINE] for cell in cells)

    return with_lists(Opened(path, 1, header, lines(), lambda line: line.split(SEPARATOR)))


def _flat(row: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """The values of an object by key, also those of objects in it, down to the third."""
    out: dict[str, Any] = {}
    for key, value in row.items():
        is_deeper = isinstance(value, dict) and before.count(".") < _DEEPEST
        out |= _flat(value, f"{before}{key}.") if is_deeper else {f"{before}{key}": value}
    return out


def read_table(table: Opened, chosen: Mapping[str, str]) -> BoxTable:
    """The rows of a table of boxes in pictures. Raises McaptrackError."""
    path, header = table.path, table.header
    places = choose_columns(table.where, header, chosen)
    frames, ids = FrameNames(), TrackIds()

    def id_of(text: str) -> float:
        try:
            return table.number_in(text)
        except ValueError:
            return ids.number(text.strip())

    def frame_of(text: str) -> float:
        return float(text) if states_number(text) else frames.number(text.strip())

    unit, without_zone = unit_of(header[places["t"]])[1] if "t" in places else 1.0, list[str]()

    def time_of(text: str) -> float:
        t_ns = iso_ns(text, without_zone)
        return table.number_in(text) * unit if t_ns is None else t_ns / NS_PER_S

    cells = _Cells(table, places, {"frame": frame_of, "id": id_of, "t": time_of})
    track_id, said = ids.of(path, cells.column("id"))
    remarks, facts = [cells.remark, *said], LabelFacts(path)
    are_rows = "id" in places and header[places["id"]].lower() == "id" and "id" not in chosen
    if are_rows and len(np.unique(track_id)) == len(track_id) > 1:
        remarks.append(f"{path}: every box has another {header[places['id']]}, so it numbers rows, not tracks")
        track_id = np.full(len(track_id), float(NO_ID))
    rows = BoxTable(
        facts=facts, at=cells.at, frame=cells.column("frame"), id=track_id, boxes_px=_boxes(cells.columns),
        score=cells.column("score"), class_id=cells.name_classes(facts), remarks=remarks,
    )  # fmt: skip
    if "t" in places:
        seconds = cells.columns["t"]
        rows.refuse(
            ~(np.isfinite(seconds) & (seconds >= 0) & (seconds < _MAX_SECONDS)),
            lambda row: (
                f"a time is a number of seconds from 0 to the year 2262, not {seconds[row]:g}; the name of its column "
                "may end with _ms, _us or _ns"
            ),
        )
        facts.times_s, rows.frame = np.unique(seconds, return_inverse=True)
        facts.first_frame = 0
        _warn_of_zone(rows, without_zone)
    return rows.with_boxes(cells.stacked(key for key in _OF_BOXES if key in places))


def _boxes(columns: Mapping[str, Floats]) -> Floats:
    """Boxes (N, 4) of left, top, width, height."""
    parts = []
    for low, size, high, centre in (("x", "w", "x2", "cx"), ("y", "h", "y2", "cy")):
        extent = columns[size] if size in columns else columns[high] - columns[low]
        parts.append((columns[low] if low in columns else columns[centre] - extent / 2, extent))
    (left, width), (top, height) = parts
    return np.stack([left, top, width, height], axis=-1)


_ISO: Final = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(?:[.,](\d{1,9})\d*)? ?(Z|UTC|[+-]\d\d:?\d\d)?")


def iso_ns(text: str, without_zone: list[str]) -> int | None:
    """A date and time of ISO 8601 in nanoseconds from 1970 on, in UTC unless it names a zone; None if it is none.

    The first one that names none is added to ``without_zone``.
    """
    match = _ISO.fullmatch(text.strip())
    if match is None:
        return None
    if match[3] is None and not without_zone:
        without_zone.append(text.strip())
    zone = match[3] if match[3] not in (None, "Z", "UTC") else "+00:00"
    return utc_ns(match[1] + zone, match[2] or "")


def unit_of(header: str) -> tuple[str, float]:
    """The unit of a column of times, by its name, and its seconds: s, unless it ends with _ms, _us or _ns, or is that
    of ``rostopic echo -p``.
    """
    text = header.strip().lower()
    if text == _ROSTOPIC:
        return "ns", _UNITS["ns"]
    units = (unit for unit in _UNITS.items() if text.endswith((f"_{unit[0]}", f" {unit[0]}", f"({unit[0]})")))
    return next(units, ("s", 1.0))


# Which columns hold what: as the user names them, or by common headers.


#: What a column may hold: corners, size and centre of a box in pixels, and more.
KEYS: Final = ("x", "y", "w", "h", "x2", "y2", "cx", "cy", "frame", "t", "score", "class", "name", "id")
#: What columns of 3D boxes may hold, beside frame, t, score, class, name and id.
KEYS_3D: Final = (
    *("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad", "heading_deg"),
    *("qw", "qx", "qy", "qz", "vx_m_per_s", "vy_m_per_s"),
)
#: The ways to give a box along x and y. The one is read that the user named most of, else the first that is complete:
#: beside two corners, a width and a height are often those of the picture.
_SPANS: Final = ((("x", "x2"), ("x", "w"), ("cx", "w")), (("y", "y2"), ("y", "h"), ("cy", "h")))
_WITH_UNITS: Final = tuple(f"{what}{unit}" for what in ("t", "time", "timestamp") for unit in ("s", "ms", "us", "ns"))
#: Headers by key, without blanks, "_", "-", "." and brackets, and in lower case.
HEADERS: Final[Mapping[str, tuple[str, ...]]] = {
    "x": ("x", "x1", "xmin", "minx", "left", "bbleft", "bboxleft", "bboxx", "bboxx1", "bboxxmin", "xtl", "xleft"),
    "y": ("y", "y1", "ymin", "miny", "top", "bbtop", "bboxtop", "bboxy", "bboxy1", "bboxymin", "ytl", "ytop"),
    "w": ("w", "width", "bbwidth", "bboxwidth", "bboxw"),
    "h": ("h", "height", "bbheight", "bboxheight", "bboxh"),
    "x2": ("x2", "xmax", "maxx", "right", "bbright", "bboxright", "bboxx2", "bboxxmax", "xbr", "xright"),
    "y2": ("y2", "ymax", "maxy", "bottom", "bbbottom", "bboxbottom", "bboxy2", "bboxymax", "ybr", "ybottom"),
    "cx": ("cx", "xc", "xcenter", "xcentre", "centerx", "centrex"),
    "cy": ("cy", "yc", "ycenter", "ycentre", "centery", "centrey"),
    "frame": ("frame", "frameindex", "frameidx", "framenumber", "frameno", "framenum", "frameid", "fr", "image",
              "imageid", "imagename", "filename", "file"),
    "t": ("t", "time", "timestamp", "seconds", "stamp", "%time", "simtime", *_WITH_UNITS),
    "score": ("score", "confidence", "conf", "probability", "prob"),
    "class": ("class", "classid", "cls", "label", "category", "categoryid", "labelid", "objectclass"),
    "name": ("classname", "categoryname", "labelname", "name"),
    "id": ("trackid", "trackerid", "pedestrianid", "id", "track", "objectid", "targetid", "tid", "trackuuid", "uuid",
           "pedid", "personid", "agentid"),
}  # fmt: skip
#: Keys of which several columns may fit; the first header of the list above is read.
_RANKED: Final = ("frame", "t", "class", "id")
IGNORED: Final = re.compile(r"-pid\d+$|[\s_\-.()\[\]/:]+|px$|pixels$")


#: How names of columns that hold a number of a box may begin.
_BOX: Final = re.compile(r"^(?:boundingbox|box2d|box|rect)(?=(?:x|y|w|h|left|top|right|bottom|width|height)[a-z12]*$)")


def parse_columns(columns: str | Mapping[str, str]) -> dict[str, str]:
    """Columns by key, from "x=left,y=top" or a mapping. Raises McaptrackError if it isn't of this form."""
    out: dict[str, str] = {}
    if isinstance(columns, str):
        parts = (part.partition("=") for part in columns.split(",") if part.strip())
        pairs = [(key.strip(), column.strip()) for key, _, column in parts]
    else:
        pairs = [*columns.items()]
    for key, column in pairs:
        if not isinstance(column, str) or not column:
            part = f"{key}={column}"
            raise McaptrackError(f"`columns=` is like x=left,y=top,w=width,h=height,frame=frame, not {part!r:.60}")
        if key in out:
            raise McaptrackError(f"`columns=` names {key} twice")
        if column in out.values():
            raise McaptrackError(f"`columns=` names {column} for {key} and for another key")
        out[key] = column
    allowed = (*KEYS, *KEYS_3D)
    unknown = [key for key in out if key not in allowed]
    if unknown:
        raise McaptrackError(f"`columns=` knows no {str(unknown[0])!r:.40}; it knows {', '.join(allowed)}")
    return out


def _named(where: str, header: Sequence[str], chosen: Mapping[str, str]) -> dict[str, int]:
    """The columns that the user names. Raises McaptrackError for one that doesn't exist, or several times."""
    out = {}
    for key, column in chosen.items():
        places = [at for at, name in enumerate(header) if name.strip() == column.strip()]
        if len(places) != 1:
            what = f"{len(places)} columns are named {column}" if places else f"no column is named {column}"
            shown = f"its columns are {', '.join(header)}"[:300]
            raise McaptrackError(f"{where}: {what}, as `columns=` says for {key}; {shown}")
        out[key] = places[0]
    return out


def _plain(header: Sequence[str]) -> list[str]:
    return [_BOX.sub("bbox", IGNORED.sub("", name.strip().lower())) for name in header]


def _fitting(names: Sequence[str], plain: Sequence[str], taken: Mapping[str, int]) -> list[int]:
    """The columns that have one of these names and aren't taken, in order of the names."""
    return [at for name in names for at, cell in enumerate(plain) if cell == name and at not in taken.values()]


def choose_columns(where: str, header: Sequence[str], chosen: Mapping[str, str]) -> dict[str, int]:
    """The index of the column for each key: those ``chosen`` by name, and guesses for the other keys.

    Raises McaptrackError if a column doesn't exist, if guesses are ambiguous, or if no box or frame can be made.
    """
    shown = f"its columns are {', '.join(header)}"[:300]
    out, plain = _named(where, header, chosen), _plain(header)
    skipped = _superseded(out)
    for key, names in HEADERS.items():
        fits = _fitting(names, plain, out)
        if key in out or key in skipped or not fits:
            continue
        # In headers of MOTChallenge (bb_left, ..., conf, x, y, z), x and y are a place in the world.
        fits = [at for at in fits if plain[at].startswith("bb")] or fits
        if len(fits) > 1 and key not in _RANKED:
            if len({header[at] for at in fits}) < len(fits):
                raise McaptrackError(f"{where}: several columns are named {header[fits[0]]}; {shown}")
            text = " and ".join(header[at] for at in fits)
            raise McaptrackError(
                f"{where}: {text} could both be {key}; choose with `columns={key + '=' + header[fits[0]]!r}`"
            )
        out[key] = fits[0]
    for axis in _SPANS:
        complete = [pair for pair in axis if all(key in out for key in pair)]
        complete.sort(key=lambda pair: -len(chosen.keys() & pair))
        if not complete:
            x, y = (_fitting(_HEADERS_3D[key], plain, {}) or _by_end(key, header, {}) for key in _PLACE[:2])
            hint = f"x_m={header[x[0]]},y_m={header[y[0]]}" if x and y else ""
            positions = f"; positions in metres are read with `columns={hint!r}`" if hint else ""
            raise McaptrackError(
                f"{where}: no columns for {' and '.join(axis[0])} (or {' and '.join(axis[1])}) of boxes; {shown}; name "
                f"them with `columns='x=left,y=top,w=width,h=height,frame=frame'`{positions}"
            )
        for key in {key for pair in axis for key in pair} - set(complete[0]):
            out.pop(key, None)
    if "name" not in chosen and "class" not in out and "name" in out and plain[out["name"]] == "name":
        out.pop("name")  # of anything: beside a number of a class it is that of the class
    if "frame" in out:
        out.pop("t", None)
    elif "t" not in out:
        raise McaptrackError(
            f"{where}: no column for the frame or the time of boxes; {shown}; name it with `columns='frame=NAME'` or "
            "`columns='t=NAME'` (in seconds)"
        )
    if unread := [key for key in chosen if key not in out]:
        read = ", ".join(key for key in chosen if key in out)
        raise McaptrackError(f"{where}: {unread[0]} is not read beside {read}, which `columns=` names; leave it out")
    return out


def _superseded(chosen: Mapping[str, int]) -> set[str]:
    """Keys that aren't guessed, because others that the user named say the same."""
    out = {key for key, other in (("frame", "t"), ("t", "frame")) if other in chosen}
    for axis in _SPANS:
        if any(all(key in chosen for key in pair) for pair in axis):
            out |= {key for pair in axis for key in pair} - chosen.keys()
    return out


# Boxes in metres.


_PLACE: Final = ("x_m", "y_m", "z_m")
_SIZE: Final = ("length_m", "width_m", "height_m")
_HEADING: Final = ("heading_rad", "heading_deg")
_QUATERNION: Final = ("qw", "qx", "qy", "qz")
_VELOCITY: Final = ("vx_m_per_s", "vy_m_per_s")
_SHARED: Final = ("t", "frame", "id", "class", "name", "score")
_AXES: Final = "xyz"
#: Ids of boxes without a track.
_NO_IDS: Final = ("-1", "-1.0")


def _of_axis(axis: str) -> tuple[str, ...]:
    return (
        *(f"{word}{axis}m" for word in ("", "t", "center", "centre")),
        *(f"{word}{axis}" for word in ("", "t", "center", "centre", "c", "pos", "position", "location", "translation")),
        f"{axis}center",
        f"{axis}centre",
    )


#: Headers by key, without blanks, "_", "-", "." and brackets, and in lower case.
_HEADERS_3D: Final[Mapping[str, tuple[str, ...]]] = {
    **{f"{axis}_m": _of_axis(axis) for axis in _AXES},
    "length_m": ("lengthm", "length", "lm", "l", "dx", "sizex"),
    "width_m": ("widthm", "width", "wm", "w", "dy", "sizey"),
    "height_m": ("heightm", "height", "hm", "h", "dz", "sizez"),
    "heading_rad": ("headingrad", "heading", "yawrad", "yaw", "theta"),
    "heading_deg": ("headingdeg", "yawdeg", "headingdegrees", "yawdegrees"),
    **{axis: (axis, f"quat{axis[1]}", f"rotation{axis[1]}", f"orientation{axis[1]}") for axis in _QUATERNION},
    "vx_m_per_s": ("vxmpers", "vxms", "vxm/s", "vx", "velocityx"),
    "vy_m_per_s": ("vympers", "vyms", "vym/s", "vy", "velocityy"),
}
#: Headers that only tables of 3D boxes have.
_ONLY_3D: Final = frozenset(("xm", "ym", "zm", "tzm", "lengthm", "headingrad", "headingdeg"))
#: A length in another unit than metres, at the end of a header.
_OTHER_UNIT: Final = re.compile(r"(?:^|[_ \[(])(mm|cm|km|ft|feet|inch|inches|px)[\])]?$", re.IGNORECASE)


#: Columns by which tables of positions in metres are known: of rostopic, SUMO, Vadere and JuPedSim.
_ROSTOPIC: Final = "%time"
_OF_PROGRAMS: Final = (
    (_ROSTOPIC, "field.header.stamp"),
    ("timestep_time",),
    ("pedestrianid", "simtime"),
    ("id", "fr", "x", "y"),
)
#: The frames per second, in a comment of JuPedSim.
_RATE: Final = re.compile(r"framerate:\s*(\d+(?:\.\d+)?)$", re.IGNORECASE)
_PARTS: Final = re.compile(r"[\s._/]+")


def _by_end(key: str, header: Sequence[str], taken: Mapping[str, int]) -> list[int]:
    """The columns with names that end with one of a key, after a dot or "_": the last two words, or the last one if no
    other column has it.
    """
    words = [_PARTS.split(name.strip().lower()) for name in header]
    names = _HEADERS_3D.get(key) or HEADERS[key]
    fits = _fitting(names, ["".join(parts[-2:]) for parts in words], taken)
    last = _fitting(names, [parts[-1] for parts in words], taken)
    return fits or (last if len(last) == 1 else [])


def _is_of_program(header: Sequence[str]) -> bool:
    """Whether the columns are those of a program that writes metres."""
    names = {name.strip().lower() for name in header}
    return any(names >= set(required) for required in _OF_PROGRAMS)


def hold_places(header: Sequence[str]) -> bool:
    """Whether any of the columns holds a number of a place, by its name."""
    plain = {*_plain(header)}
    keys = (*((key, HEADERS[key]) for key in _OF_BOXES), *((key, _HEADERS_3D[key]) for key in _PLACE))
    return any(plain & {*names} for _, names in keys)


def are_metres(header: Sequence[str], chosen: Mapping[str, str]) -> bool:
    """Whether columns with these names hold boxes or positions in metres, or are ``chosen`` as such by key."""
    plain = _plain(header)
    if set(chosen) & set(KEYS_3D) or _ONLY_3D & set(plain) or _is_of_program(header):
        return True
    keys = {key for key, names in _HEADERS_3D.items() if set(names) & set(plain)}
    return set(_PLACE) <= keys and bool(keys & {*_HEADING, "qw"})


def read_table_3d(table: Opened, chosen: Mapping[str, str]) -> BoxTable:
    """The rows of a table of boxes or positions in metres. Raises McaptrackError."""
    path, places = table.path, _choose_columns_3d(table.where, table.header, chosen)
    times, ids, without_zone = list[int](), list[str](), list[str]()

    def time_in(text: str) -> float:
        times.append(_exact_ns(table.decimal(text), unit_of(table.header[places["t"]])[1], without_zone))
        return 0.0

    def id_in(text: str) -> float:
        ids.append(text.strip())
        return 0.0

    cells = _Cells(table, places, {"t": time_in, "id": id_in})
    remarks, heading = [cells.remark], cells.columns.get("heading_rad", np.radians(cells.column("heading_deg")))
    if "qw" in places:
        has_box, heading = np.isfinite(cells.column("x_m")), cells.none.copy()
        kept = np.flatnonzero(has_box)
        heading[has_box] = headings(cells.stacked(_QUATERNION)[has_box], path, lambda row: cells.at(int(kept[row])))[0]
    track_id = np.full(len(cells.none), NO_ID)
    if "id" in places:
        is_known = np.array([not is_empty(text) and text not in _NO_IDS for text in ids], bool)
        known_ids = [ids[row] for row in np.flatnonzero(is_known)]
        track_id[is_known] = numbered(known_ids)
        if not are_numbers(known_ids):
            remarks.append(f"{path}: its ids are texts; tracks are numbered from 1 on as they come")
    facts = LabelFacts(path, is_timed="t" in places)
    facts.name((cells.names if "name" in places else cells.classes).names)
    boxes = np.column_stack([cells.stacked((*_PLACE, *_SIZE)), heading])
    kind = cells.column("name" if "name" in places else "class")
    rows = BoxTable(
        facts=facts, at=cells.at, frame=np.array(times, np.int64) if "t" in places else cells.column("frame"),
        id=track_id, boxes_m=boxes, score=cells.column("score"), class_id=np.nan_to_num(kind, nan=NO_CLASS),
        velocity=cells.stacked(_VELOCITY), remarks=remarks,
    )  # fmt: skip
    _warn_of_zone(rows, without_zone)
    comments = comments_of(path) if table.delimiter and "t" not in places else []
    rate = next(filter(None, map(_RATE.match, comments)), None)
    if rate is not None and float(rate[1]) > 0:
        rows.frame, facts.is_timed = np.rint(rows.frame * NS_PER_S / float(rate[1])), True
        rows.remark(f": times by its {rate[0]}")
    return rows.with_boxes(boxes[:, :6])


def _choose_columns_3d(where: str, header: Sequence[str], chosen: Mapping[str, str]) -> dict[str, int]:
    """The index of the column for each key. Raises McaptrackError if one is missing, or in another unit."""
    shown = f"its columns are {', '.join(header)}"[:300]
    if others := [key for key in chosen if key not in (*KEYS_3D, *_SHARED)]:
        text = f"`columns=` names {others[0]}, and 3D boxes have none; they have {', '.join(KEYS_3D)}"
        raise McaptrackError(f"{where}: {text}")
    out, plain = _named(where, header, chosen), _plain(header)
    either = ({*_HEADING, *_QUATERNION}, {"t", "frame"})
    for key, names in (*_HEADERS_3D.items(), *((key, HEADERS[key]) for key in _SHARED)):
        fits = _fitting(names, plain, out) or (_by_end(key, header, out) if _is_of_program(header) else [])
        if key in out or not fits or any(key in group and group & chosen.keys() for group in either):
            continue
        out[key] = fits[0]
    for other in (
        {"heading_deg"} if "heading_rad" in out else set(),
        set(_QUATERNION)
        if {"heading_rad", "heading_deg"} & out.keys() or not set(_QUATERNION) <= out.keys()
        else set(),
        {"frame"} if "t" in out else set(),
        {"class"} if "name" in out and "class" in out else set(),
    ):
        for key in other - chosen.keys():
            out.pop(key, None)
    for key in _PLACE[:2]:
        if key not in out:
            units = [name for name in header if _OTHER_UNIT.search(name.strip())]
            why = f"{units[0]} is not in metres" if units else shown
            raise McaptrackError(f"{where}: no column for {key}; {why}; name it with `columns='{key}=NAME'`")
    if not {"t", "frame"} & out.keys():
        raise McaptrackError(
            f"{where}: no column for the time or the frame of boxes; {shown}; name it with `columns='t=NAME'` (in "
            "seconds, unless the name ends with _ms, _us or _ns) or `columns='frame=NAME'`"
        )
    for key, place in out.items():
        if key in (*_PLACE, *_SIZE) and _OTHER_UNIT.search(header[place].strip()):
            raise McaptrackError(f"{where}: {header[place]} is not in metres")
    return out


def _warn_of_zone(rows: BoxTable, without_zone: list[str]) -> None:
    for text in without_zone:
        rows.find(f": its times name no time zone ({text[:40]}); they are taken as UTC", "clock")


def _exact_ns(text: str, unit: float, without_zone: list[str]) -> int:
    """A time in nanoseconds, exactly."""
    try:
        t_ns = iso_ns(text, without_zone)
        t_ns = t_ns if t_ns is not None else int((Decimal(text) * round(unit * NS_PER_S)).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        raise ValueError(f"{text[:30]!r} in the column of times is no number") from None
    if not 0 <= t_ns <= LAST_NS:
        raise ValueError(
            f"{text[:30]} in the column of times is not from 1970 to 2262; _ms, _us or _ns at the end of its name is "
            "its unit"
        )
    return t_ns
