"""Read tables of 3D boxes with a header: columns in metres, headings in radians or degrees, or quaternions.

Letters: N rows.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.clocks import LAST_NS, NS_PER_S
from mcaptrack.sources.ingest.labels.boxes_3d.rows import NO_ID, BoxRows3D, headings, numbered
from mcaptrack.sources.ingest.labels.columns import HEADERS, IGNORED, KEYS_3D
from mcaptrack.sources.ingest.labels.delimited import MAX_LINE, delimiter_of, header_of, is_empty, split_row, unit_of
from mcaptrack.sources.ingest.labels.formats import ClassNames
from mcaptrack.sources.ingest.labels.number_table import NumberTable, lines_of

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
_OF_BOXES: Final = frozenset(("zm", "tzm", "lengthm", "headingrad", "headingdeg"))
#: A length in another unit than metres, at the end of a header.
_OTHER_UNIT: Final = re.compile(r"(?:^|[_ \[(])(mm|cm|km|ft|feet|inch|inches|px)[\])]?$", re.IGNORECASE)


def holds_boxes_3d(path: Path, first: str, chosen: Mapping[str, str]) -> bool:
    """Whether a table has 3D boxes, by its first line and the columns that are ``chosen`` by key."""
    if set(chosen) & set(KEYS_3D):
        return True
    header = header_of(path, first)
    if not header:
        return False
    plain = [IGNORED.sub("", name.strip().lower()) for name in header]
    if {"xm", "ym"} <= set(plain) or _OF_BOXES & set(plain):
        return True
    keys = {key for key, names in _HEADERS_3D.items() if set(names) & set(plain)}
    return set(_PLACE) <= keys and bool(keys & {*_HEADING, "qw"})


def read_table(path: Path, chosen: Mapping[str, str]) -> BoxRows3D:
    """Read a table; ``chosen`` are names of columns by key. Raises McaptrackError, with the line, if it is invalid."""
    lines = lines_of(path, MAX_LINE)
    number, first = next(lines, (0, ""))
    header = header_of(path, first) if number else []
    if not header:
        raise McaptrackError(f"{path}:{number}: a table needs a header that names its columns: {first.strip()[:60]}")
    where = f"{path}:{number}"
    at = _columns(where, header, chosen)
    delimiter = delimiter_of(first)
    has_decimal_commas = delimiter == ";"
    unit = unit_of(header[at["t"]]) if "t" in at else ("s", 1.0)
    classes, ids = ClassNames(), list[str]()
    keys = [key for key in at if key != "t"]

    def point_of(text: str) -> str:
        return text.strip().replace(",", ".") if has_decimal_commas else text.strip()

    def number_in(text: str) -> float:
        return math.nan if is_empty(text) else float(point_of(text))

    def class_in(text: str) -> float:
        return math.nan if is_empty(text) else classes.number(text.strip())

    def id_in(text: str) -> float:
        ids.append(text.strip())
        return 0.0

    readers: dict[str, Callable[[str], float]] = {"class": class_in, "name": class_in, "id": id_in}

    def parse(parts: list[str]) -> list[float]:
        if len(parts) != len(header):
            raise ValueError(f"{len(parts)} columns, and the header has {len(header)}")
        time = _seconds_and_ns(point_of(parts[at["t"]]), unit[1]) if "t" in at else (0, 0)
        return [*time, *(readers.get(key, number_in)(parts[at[key]]) for key in keys)]

    shown = ", ".join(header[place] for place in at.values())
    table = NumberTable(path, lines, f"a row of {shown}", 2 + len(keys), parse, partial(split_row, path, delimiter))
    columns = {key: table.values[:, place] for place, key in enumerate(keys, start=2)}
    rows = _rows(path, table, columns, classes, ids)
    if "t" in at:
        rows.t_ns = table.values[:, 0].astype(np.int64) * NS_PER_S + table.values[:, 1].astype(np.int64)
    else:
        rows.frame = table.whole(2 + keys.index("frame"), "the frame (a count of pictures, no time)", 0)
    used = ", ".join(f"{key}={header[place]}" + f" in {unit[0]}" * (key == "t") for key, place in at.items())
    unused = [name for place, name in enumerate(header) if name and place not in at.values()]
    rows.remarks.insert(0, f"{path}: columns {used}" + (f"; not read: {', '.join(unused)}"[:300] if unused else ""))
    _leave_out_empty(rows)
    return rows


def _rows(
    path: Path, table: NumberTable, columns: Mapping[str, Floats], classes: ClassNames, ids: list[str]
) -> BoxRows3D:
    count = len(table.values)
    none = np.full(count, np.nan)

    def place(row: int) -> str:
        return f"{path}:{table.line[row]}"

    heading = columns.get("heading_rad", np.radians(columns.get("heading_deg", none)))
    remarks = []
    if "qw" in columns:
        quaternions = np.stack([columns[key] for key in _QUATERNION], axis=-1)
        has_box = np.isfinite(columns["x_m"])
        heading = none.copy()
        kept = np.flatnonzero(has_box)
        heading[has_box] = headings(quaternions[has_box], path, lambda row: place(int(kept[row])))[0]
    is_known = np.array([not is_empty(text) and text not in _NO_IDS for text in ids], bool)
    track_id, are_numbers = numbered([ids[row] for row in np.flatnonzero(is_known)])
    all_ids = np.full(count, NO_ID)
    if "id" in columns:
        all_ids[is_known] = track_id
        if not are_numbers:
            remarks.append(f"{path}: its ids are texts; tracks are numbered from 1 on as they come")
    kind = columns["name"] if "name" in columns else columns.get("class", none)
    return BoxRows3D(
        path,
        "csv",
        place,
        np.stack([*(columns.get(key, none) for key in (*_PLACE, *_SIZE)), heading], axis=-1),
        all_ids,
        np.where(np.isfinite(kind), kind, -1).astype(np.int64),
        classes.names,
        columns.get("score", none),
        np.stack([columns.get(key, none) for key in _VELOCITY], axis=-1),
        remarks=remarks,
    )


def _columns(where: str, header: Sequence[str], chosen: Mapping[str, str]) -> dict[str, int]:
    """The index of the column for each key. Raises McaptrackError if one is missing, or in another unit."""
    shown = f"its columns are {', '.join(header)}"[:300]
    out: dict[str, int] = {}
    for key, column in chosen.items():
        if key not in (*KEYS_3D, *_SHARED):
            raise McaptrackError(
                f"{where}: `columns=` names {key}, and 3D boxes have none; they have {', '.join(KEYS_3D)}"
            )
        places = [at for at, name in enumerate(header) if name.strip() == column.strip()]
        if len(places) != 1:
            what = f"{len(places)} columns are named {column}" if places else f"no column is named {column}"
            raise McaptrackError(f"{where}: {what}, as `columns=` says for {key}; {shown}")
        out[key] = places[0]
    plain = [IGNORED.sub("", name.strip().lower()) for name in header]
    either = ({*_HEADING, *_QUATERNION}, {"t", "frame"})
    for key, names in (*_HEADERS_3D.items(), *((key, HEADERS[key]) for key in _SHARED)):
        fits = [at for name in names for at, cell in enumerate(plain) if cell == name and at not in out.values()]
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


def _seconds_and_ns(text: str, unit: float) -> tuple[int, int]:
    """A time as whole seconds and nanoseconds, exactly."""
    try:
        t_ns = int((Decimal(text.strip()) * round(unit * NS_PER_S)).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        raise ValueError(f"{text.strip()[:30]!r} in the column of times is no number") from None
    if not 0 <= t_ns <= LAST_NS:
        raise ValueError(
            f"{text.strip()[:30]} in the column of times is not from 1970 to 2262; _ms, _us or _ns at the end of its "
            "name is its unit"
        )
    return divmod(t_ns, NS_PER_S)


def _leave_out_empty(rows: BoxRows3D) -> None:
    """Remove rows without a box; their times stay, as times without boxes."""
    is_row = ~np.isnan(rows.boxes[:, :6]).all(axis=1)
    rows.labelled = np.unique(rows.number)
    if is_row.all():
        return
    kept, at = np.flatnonzero(is_row), rows.at
    rows.at = lambda row: at(int(kept[row]))
    rows.remarks.append(f"{rows.path}: {int((~is_row).sum())} rows have no box; they only say that frames exist")
    for name in ("boxes", "track_id", "kind", "score", "velocity", "t_ns", "frame"):
        values = getattr(rows, name)
        setattr(rows, name, None if values is None else values[kept])
