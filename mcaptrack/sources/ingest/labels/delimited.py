"""Read tables of boxes with a header, separated by commas, semicolons or tabs.

Any CSV of boxes in pictures, that of supervision, and boxes in metres, with headings in radians or degrees, or
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
from itertools import chain
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S
from mcaptrack.schema.classes import PERSON, is_person
from mcaptrack.sources.ingest.labels.content import (
    FRAME,
    MAX_FRAME,
    NO_CLASS,
    NO_ID,
    UNKNOWN_FIRST,
    BoxRows3D,
    Format,
    FrameNames,
    Labels,
    Lines,
    NumberTable,
    TrackIds,
    WantedClasses,
    headings,
    lines_of,
    numbered,
)
from mcaptrack.sources.ingest.labels.formats import ClassNames

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


class _Opened(NamedTuple):
    """A table after its header was read: its place, the names of columns, the rows, and what separates their cells."""

    path: Path
    number: int
    header: list[str]
    lines: Lines
    split: Callable[[str], list[str]]
    delimiter: str = ""

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


def _opened(path: Path) -> _Opened:
    """Read the header of a table. Raises McaptrackError if it has none."""
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
    return _Opened(path, number, header, lines, partial(split_row, path, delimiter), delimiter)


class _Cells(NumberTable):
    """The rows of a table as numbers: ``columns`` (N,) by what they hold, and the names that numbers of classes mean.

    ``at`` are the columns that are read; ``readers`` make numbers of those that hold something else.
    """

    def __init__(self, table: _Opened, at: Mapping[str, int], readers: Mapping[str, Callable[[str], float]]) -> None:
        header, keys = table.header, sorted(at, key=at.__getitem__)
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
                problem = f"the column {header[at[key]]} holds {text.strip()[:40]!r}, which is no number"
                if table.delimiter == "," in text:
                    problem += "; decimal commas are read where semicolons or tabs separate the columns"
                raise ValueError(problem) from None

        def parse(parts: list[str]) -> list[float]:
            if len(parts) != len(header):
                raise ValueError(f"{len(parts)} columns, and the header has {len(header)}")
            return [cell(key, parts[at[key]]) for key in keys]

        what = f"a row of {', '.join(header[at[key]] for key in keys)}"
        super().__init__(table.path, table.lines, what, len(keys), parse, table.split)
        self.columns = {key: self.values[:, place] for place, key in enumerate(keys)}
        self.none = np.full(len(self.values), np.nan)
        unit = f" in {unit_of(header[at['t']])[0]}" if "t" in at else ""
        used = ", ".join(f"{key}={header[at[key]]}{unit * (key == 't')}" for key in keys)
        unused = [name for place, name in enumerate(header) if name and place not in at.values()]
        more = f"; not read: {', '.join(unused)}"[:300] if unused else ""
        #: Which columns were read, as text.
        self.remark = f"{table.path}: columns {used}{more}"

    def column(self, key: str) -> Floats:
        """A column (N,); NaN if the table has none."""
        return self.columns.get(key, self.none)

    def stacked(self, keys: Iterable[str]) -> Floats:
        """Columns (N, K) side by side."""
        return np.stack([self.column(key) for key in keys], axis=-1)


def _number_of_name(numbers: ClassNames, text: str) -> float:
    return math.nan if is_empty(text) else numbers.number(text.strip())


def read_csv(path: Path, role: Role, chosen: Mapping[str, str], name: Format, wanted: WantedClasses) -> Labels:
    """Read a table with a header; ``chosen`` are names of columns by key, see ``KEYS``."""
    return _read_table(_opened(path), role, chosen, name, wanted)


def read_rows(path: Path, content: list[Any], role: Role, chosen: Mapping[str, str], wanted: WantedClasses) -> Labels:
    """Read rows of supervision's JSONSink: objects with the same keys."""
    header = [str(key) for key in content[0]][: _MAX_COLUMNS + 1]

    def lines() -> Iterator[tuple[int, str]]:
        for number, row in enumerate(content, start=1):
            if not isinstance(row, dict) or list(row)[: len(header)] != header:
                raise McaptrackError(f"{path}: row {number} has other keys than the first one: {str(row)[:60]}")
            yield number, _SEPARATOR.join(str(value).replace(_SEPARATOR, " ")[:MAX_LINE] for value in row.values())

    table = _Opened(path, 1, header, lines(), lambda line: line.split(_SEPARATOR))
    return _read_table(table, role, chosen, "supervision", wanted)


def _read_table(table: _Opened, role: Role, chosen: Mapping[str, str], name: Format, wanted: WantedClasses) -> Labels:
    path, header = table.path, table.header
    at = choose_columns(table.where, header, chosen)
    frames, ids = FrameNames(), TrackIds()

    def id_of(text: str) -> float:
        try:
            return table.number_in(text)
        except ValueError:
            return ids.number(text.strip())

    def frame_of(text: str) -> float:
        return float(text) if _is_number(text) else frames.number(text.strip())

    cells = _Cells(table, at, {"frame": frame_of, "id": id_of})
    remarks = [cells.remark]
    track_id, said = ids.of(path, cells.column("id"))
    remarks += said
    if (
        "id" in at
        and header[at["id"]].lower() == "id"
        and "id" not in chosen
        and len(np.unique(track_id)) == len(track_id) > 1
    ):
        remarks.append(f"{path}: every box has another {header[at['id']]}, so it numbers rows, not tracks")
        track_id = np.full(len(track_id), float(NO_ID))
    kind, class_names = _classes(cells)
    boxes, frame, score = _boxes(cells.columns), cells.column("frame"), cells.column("score")
    rows = Labels(path, name, cells.at, frame, track_id, boxes, score, kind, remarks=remarks, first_frame=UNKNOWN_FIRST)
    if "t" in at:
        seconds = cells.columns["t"] * unit_of(header[at["t"]])[1]
        rows.refuse(
            ~(np.isfinite(seconds) & (seconds >= 0) & (seconds < _MAX_SECONDS)),
            lambda row: (
                f"a time is a number of seconds from 0 to the year 2262, not {seconds[row]:g}; the name of its column "
                "may end with _ms, _us or _ns"
            ),
        )
        rows.times_s, rows.frame = np.unique(seconds, return_inverse=True)
        rows.first_frame = 0
    rows.frame = rows.whole(rows.frame, FRAME, 0, MAX_FRAME)
    rows = rows.with_boxes(cells.stacked(key for key in _OF_BOXES if key in at))
    if name == "csv":
        rows.take_shares()
    if name == "supervision" and header[at.get("frame", 0)].lower() == _FRAME_INDEX:
        rows.first_frame = 0
    return rows.settled(role, wanted, class_names)


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


def _classes(cells: _Cells) -> tuple[Floats, dict[int, str] | None]:
    """The classes of rows as numbers (N,), and their names by number, None if there are none."""
    columns, classes, names = cells.columns, cells.classes, cells.names
    none = np.full(len(cells.none), float(NO_CLASS))
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
    "frame": ("frame", "frameindex", "frameidx", "framenumber", "frameno", "framenum", "frameid", "image", "imageid",
              "imagename", "filename", "file"),
    "t": ("t", "time", "timestamp", "seconds", "stamp", *_WITH_UNITS),
    "score": ("score", "confidence", "conf", "probability", "prob"),
    "class": ("class", "classid", "cls", "label", "category", "categoryid", "labelid", "objectclass"),
    "name": ("classname", "categoryname", "labelname", "name"),
    "id": ("trackid", "trackerid", "id", "track", "objectid", "targetid", "tid", "trackuuid", "uuid"),
}  # fmt: skip
#: Keys of which several columns may fit; the first header of the list above is read.
_RANKED: Final = ("frame", "t", "class", "id")
IGNORED: Final = re.compile(r"[\s_\-.()\[\]/:]+|px$|pixels$")


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
    return [IGNORED.sub("", name.strip().lower()) for name in header]


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
            raise McaptrackError(
                f"{where}: no columns for {' and '.join(axis[0])} (or {' and '.join(axis[1])}) of boxes; {shown}; name "
                "them with `columns='x=left,y=top,w=width,h=height,frame=frame'`"
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
_ONLY_3D: Final = frozenset(("zm", "tzm", "lengthm", "headingrad", "headingdeg"))
#: A length in another unit than metres, at the end of a header.
_OTHER_UNIT: Final = re.compile(r"(?:^|[_ \[(])(mm|cm|km|ft|feet|inch|inches|px)[\])]?$", re.IGNORECASE)


def holds_boxes_3d(path: Path, first: str, chosen: Mapping[str, str]) -> bool:
    """Whether a table has 3D boxes, by its first line and the columns that are ``chosen`` by key."""
    if set(chosen) & set(KEYS_3D):
        return True
    header = header_of(path, first)
    if not header:
        return False
    plain = _plain(header)
    if {"xm", "ym"} <= set(plain) or _ONLY_3D & set(plain):
        return True
    keys = {key for key, names in _HEADERS_3D.items() if set(names) & set(plain)}
    return set(_PLACE) <= keys and bool(keys & {*_HEADING, "qw"})


def read_table_3d(path: Path, chosen: Mapping[str, str]) -> BoxRows3D:
    """Read a table of 3D boxes; ``chosen`` are names of columns by key. Raises McaptrackError, with the line, if it is
    invalid.
    """
    table = _opened(path)
    at = _choose_columns_3d(table.where, table.header, chosen)
    times, ids = list[int](), list[str]()

    def time_in(text: str) -> float:
        times.append(_exact_ns(table.decimal(text), unit_of(table.header[at["t"]])[1]))
        return 0.0

    def id_in(text: str) -> float:
        ids.append(text.strip())
        return 0.0

    cells = _Cells(table, at, {"t": time_in, "id": id_in})
    kind = cells.column("name" if "name" in at else "class")
    remarks = [cells.remark]
    heading = cells.columns.get("heading_rad", np.radians(cells.column("heading_deg")))
    if "qw" in at:
        has_box, heading = np.isfinite(cells.column("x_m")), cells.none.copy()
        kept = np.flatnonzero(has_box)
        quaternions = cells.stacked(_QUATERNION)[has_box]
        heading[has_box] = headings(quaternions, path, lambda row: cells.at(int(kept[row])))[0]
    track_id = np.full(len(cells.none), NO_ID)
    if "id" in at:
        is_known = np.array([not is_empty(text) and text not in _NO_IDS for text in ids], bool)
        track_id[is_known], are_numbers = numbered([ids[row] for row in np.flatnonzero(is_known)])
        if not are_numbers:
            remarks.append(f"{path}: its ids are texts; tracks are numbered from 1 on as they come")
    frame = np.array(times, np.int64) if "t" in at else cells.whole(cells.column("frame"), FRAME, 0, MAX_FRAME)
    boxes = np.column_stack([cells.stacked((*_PLACE, *_SIZE)), heading])
    kind = np.where(np.isfinite(kind), kind, NO_CLASS).astype(np.int64)
    rows = BoxRows3D(path, "csv", cells.at, frame, track_id, boxes, cells.column("score"), kind, remarks=remarks)
    rows.names = (cells.names if "name" in at else cells.classes).names
    rows.velocity, rows.is_timed = cells.stacked(_VELOCITY), "t" in at
    rows.labelled = np.unique(frame)
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
        fits = _fitting(names, plain, out)
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


def _exact_ns(text: str, unit: float) -> int:
    """A time in nanoseconds, exactly."""
    try:
        t_ns = int((Decimal(text) * round(unit * NS_PER_S)).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        raise ValueError(f"{text[:30]!r} in the column of times is no number") from None
    if not 0 <= t_ns <= LAST_NS:
        raise ValueError(
            f"{text[:30]} in the column of times is not from 1970 to 2262; _ms, _us or _ns at the end of its name is "
            "its unit"
        )
    return t_ns
