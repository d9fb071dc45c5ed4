"""Cases of label formats: rows, and for each format a writer of files with them.

A writer of a format of an extension stands in the test file of its module, in ``WRITERS``: that of
``mcaptrack.extensions.exchange.coco`` in ``tests/extensions/exchange/test_coco.py``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.registry import points
from mcaptrack.sources.ingest.labels.reading import read_labels
from mcaptrack.sources.ingest.labels.table import BoxTable


@dataclass(frozen=True)
class Row:
    """A row of labels, as it is in a picture, as a position and as a box in space."""

    frame: int = 0
    id: int | None = 1
    box: tuple[float, ...] = (10, 20, 30, 60)
    xy: tuple[float, ...] = (1.5, 2.5)
    size: tuple[float, ...] = (0.5, 0.5, 1.8)
    heading: float = 0.25
    score: float | None = 0.5
    kind: str | None = "person"


@dataclass(frozen=True)
class Writer:
    """A writer of a format: ``write`` rows to a folder, and the columns that the format lacks.

    ``kind`` is "box", "xy" or "space"; ``names``: classes are names, and no numbers; ``size``: the file states that of
    its pictures, 640x480; ``tracks``: it has ids; ``shares``: boxes are in shares of the picture. ``first``: the number of
    the first picture is "stated" by all files, or is that of the first of those that it has "listed", or "timed": it has
    times; otherwise it is assumed.
    """

    write: Callable[[Path, Sequence[Row]], Path]
    lacks: str = ""
    kind: str = "box"
    names: bool = True
    size: bool = False
    tracks: bool = True
    first: str = ""
    shares: bool = False


#: Two people that walk, without fault.
WALK = [
    Row(frame, who, (10 + 3 * frame + 40 * who, 20, 30, 60), (1.5 + 0.2 * frame, 2.5 * who)) for frame in range(1, 5) for who in (1, 2)
]  # fmt: skip


def text(line: Callable[[Row], str], head: str = "", name: str = "a.txt") -> Callable[[Path, Sequence[Row]], Path]:
    def write(folder: Path, rows: Sequence[Row]) -> Path:
        path = folder / name
        path.write_text("\n".join([*([head] if head else []), *(line(row) for row in rows)]) + "\n")
        return path

    return write


def as_json(content: Callable[[Sequence[Row]], Any]) -> Callable[[Path, Sequence[Row]], Path]:
    def write(folder: Path, rows: Sequence[Row]) -> Path:
        path = folder / "a.json"
        path.write_text(json.dumps(content(rows)))
        return path

    return write


def per_frame(name: str, content: Callable[[int, list[Row]], str]) -> Callable[[Path, Sequence[Row]], Path]:
    """A folder with a file for each frame, and one without rows if there are none."""

    def write(folder: Path, rows: Sequence[Row]) -> Path:
        for frame, mine in (by_frame(rows) or {0: []}).items():
            path = folder / "a" / name.format(frame)
            path.parent.mkdir(exist_ok=True)
            path.write_text(content(frame, mine))
        return folder / "a"

    return write


def number(value: float | None, missing: str = "") -> str:
    return missing if value is None else f"{value:g}"


def corners(row: Row) -> tuple[float, ...]:
    left, top, width, height = row.box
    return left, top, left + width, top + height


def by_frame(rows: Sequence[Row]) -> dict[int, list[Row]]:
    """The rows of each frame from the first to the last."""
    numbers = [row.frame for row in rows]
    frames = range(min(numbers), max(numbers) + 1) if rows else ()
    return {frame: [row for row in rows if row.frame == frame] for frame in frames}


def shares(row: Row) -> tuple[float, ...]:
    """Centre and size of a box as shares of 640x480; those that are shares are far too large then."""
    left, top, width, height = row.box
    across, down = (1, 1) if width <= 2 else (640, 480)
    return (left + width / 2) / across, (top + height / 2) / down, width / across, height / down


def parquet(folder: Path, rows: Sequence[Row]) -> Path:
    keys = ("frame", "id", "x", "y", "w", "h", "score", "class")
    values = [[row.frame, row.id, *map(float, row.box), row.score, row.kind] for row in rows]
    table = pa.table({key: [row[at] for row in values] for at, key in enumerate(keys)})
    pq.write_table(table, folder / "a.parquet")
    return folder / "a.parquet"


def mot(row: Row) -> str:
    kind = {"person": "1", None: "-1"}.get(row.kind, row.kind)
    box = ",".join(map(number, row.box))
    return f"{row.frame + 1},{number(row.id, '-1')},{box},{number(row.score, '1')},{kind},1"


def sdd(row: Row) -> str:
    box = " ".join(map(number, corners(row)))
    return f'{number(row.id, "-1")} {box} {row.frame} 0 0 0 "{ {"person": "Pedestrian"}.get(row.kind, row.kind) }"'


CSV = "frame,id,x,y,w,h,score,class"
WRITERS = {
    "mot": Writer(text(mot), names=False, first="stated"),
    "sdd": Writer(text(sdd), "score kind", first="stated"),
    "trajnet": Writer(text(lambda row: f"{row.frame} {number(row.id, '-1')} {row.xy[0]} {row.xy[1]}"), "score kind", "xy", first="stated"),
    "obsmat": Writer(
        text(lambda row: f"{row.frame} {number(row.id, '-1')} {row.xy[0]} 0 {row.xy[1]} 0 0 0"), "score kind", "xy"
    , first="stated"),
    "csv": Writer(
        text(lambda row: ",".join(
            [f"{row.frame}", number(row.id), *map(number, row.box), number(row.score), row.kind or ""]),
            CSV, "a.csv")),
    "records": Writer(parquet),
}  # fmt: skip


def writers() -> dict[str, Writer]:
    """The writers of all formats that are installed, by name."""
    out = dict(WRITERS)
    for point in points("label_format"):
        parent, _, name = point.value.partition(":")[0].replace("mcaptrack.", "tests.", 1).rpartition(".")
        out |= import_module(f"{parent}.test_{name}").WRITERS if point.is_own else {}
    return out


def read(folder: Path, content: Any, role: str = "detections", name: str = "a", **options: Any) -> BoxTable:
    """Labels of a file with this text, or of JSON of something else."""
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_labels(path, role=role, **options)


def refused(folder: Path, content: Any, role: str = "detections") -> str:
    """What is said of it, after the name of the file."""
    with pytest.raises(McaptrackError) as error:
        read(folder, content, role)
    assert str(error.value).startswith(str(folder / "a"))
    return str(error.value)[len(str(folder / "a")) :]


def said(folder: Path, labels: BoxTable) -> list[str]:
    """Doubts, after the name of the file."""
    assert all(words.startswith(str(folder)) for words, _ in labels.doubts)
    return [words.removeprefix(str(folder / "a")) for words, _ in labels.doubts]


def table(*rows: str, header: str = "frame,x,y,w,h") -> str:
    return "\n".join([header, *rows])
