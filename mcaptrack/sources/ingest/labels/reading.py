"""Read label files, of boxes in pictures and in space, with detection of their format; and homographies."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.registry import BUILT_IN, find, others
from mcaptrack.schema.spill import SpillFile, Stored
from mcaptrack.sources.ingest.labels.argoverse import is_argoverse, read_argoverse
from mcaptrack.sources.ingest.labels.content import (
    FORMATS_3D,
    ONLY_PEOPLE,
    BoxRows3D,
    ClassIds,
    Format,
    Labels,
    Lines,
    WantedClasses,
    lines_of,
    split,
)
from mcaptrack.sources.ingest.labels.cvat import is_cvat, read_cvat
from mcaptrack.sources.ingest.labels.delimited import (
    MAX_LINE,
    SUPERVISION,
    choose_columns,
    comment_header,
    header_of,
    holds_boxes_3d,
    read_csv,
    read_table_3d,
)
from mcaptrack.sources.ingest.labels.formats import read_kitti_3d
from mcaptrack.sources.ingest.labels.json_boxes import holds_boxes, is_json, read_json
from mcaptrack.sources.ingest.labels.nuscenes import read_nuscenes, tables_folder
from mcaptrack.sources.ingest.labels.of_packages import format_of_package, recognised
from mcaptrack.sources.ingest.labels.yolo import read_yolo

_MOT_COLUMNS: Final = {"frame": 0, "id": 1, "x": 2, "y": 3, "w": 4, "h": 5}
FORMATS: Final = tuple(name for name in BUILT_IN["label_format"] if name not in FORMATS_3D)


def chosen_format(path: Path, label_format: Format, columns: Mapping[str, str] | None = None) -> Format:
    """The format of a file: the one that is given, or for "auto" that of another package that recognises the file, if
    it is of no built-in one.
    """
    if label_format != "auto" or columns or not path.is_file() or not others("label_format") or _is_built_in(path):
        return label_format
    of_package = recognised(path)
    return label_format if of_package is None else of_package.entry.name


def _is_built_in(path: Path) -> bool:
    """Whether a file is of a built-in format, by its beginning; JSON by its content."""
    try:
        if is_argoverse(path) or is_cvat(path):
            return True
        return holds_boxes(path) if is_json(path) else bool(text_format(path))
    except McaptrackError:
        return False


def read_labels(
    path: Path,
    label_format: Format = "auto",
    role: Role = "tracks",
    first_frame: int | None = None,
    columns: Mapping[str, str] | None = None,
    wanted: WantedClasses = ONLY_PEOPLE,
    in_parts: bool = False,
) -> Labels:
    """Read a label file.

    Parameters
    ----------
    path : Path
        A text file, or a folder of YOLO labels.
    label_format : str
        "auto" detects it from the content.
    role : str
        "detections", "tracks" or "truth" (ground truth).
    first_frame : int, optional
        The number of the first picture in the file, if it isn't the one of the format.
    columns : dict, optional
        Names of the columns of a table with a header, by what they hold.
    wanted : WantedClasses
        The classes of tracks and ground truth; detections keep all.
    in_parts : bool
        Read a long file in parts, if it is detections, or tracks of people, in a format without names of classes, and
        sorted by frame.

    Returns
    -------
    Labels
        Sorted by frame and id; ``LongLabels`` if they were read in parts.

    Raises
    ------
    McaptrackError
        With the line, if the file doesn't have this format, or none of the known ones.
    """
    is_alike = role == "detections" or (role == "tracks" and wanted.is_people)
    labels: Labels | None = None
    if in_parts and is_alike and not columns and path.is_file() and path.stat().st_size >= _LONG_BYTES:
        if label_format == "auto" and not is_json(path) and not is_cvat(path):
            label_format = text_format(path)
        labels = _read_in_parts(path, label_format, role, wanted) if label_format in _FORMATS else None
    if labels is None:
        labels = _read(path, label_format, role, columns or {}, wanted)
        if role != "detections":
            labels.refuse_repeated_ids()
        labels = in_order(labels, labels.has_ids)
    if first_frame is not None:
        labels.first_frame, labels.is_first_assumed = first_frame, False
        labels.doubts = [doubt for doubt in labels.doubts if doubt[1] != "clock"]
    return labels


def in_order(labels: Labels, has_ids: bool) -> Labels:
    """The rows sorted by frame, and by id if there are any; otherwise each frame as the file has it."""
    if has_ids:
        return labels.take(np.lexsort((labels.id, labels.frame)))
    return labels.take(np.argsort(labels.frame, kind="stable"))


def _read(path: Path, label_format: Format, role: Role, columns: Mapping[str, str], wanted: WantedClasses) -> Labels:
    refuse_special(path)
    of_package = format_of_package(chosen_format(path, label_format, columns))
    if of_package is not None:
        if columns:
            raise McaptrackError(f"{path}: `columns=` is for tables with a header, not for {label_format}")
        return of_package.labels(path, role, wanted)
    if path.is_dir():
        if label_format not in ("auto", "yolo"):
            raise McaptrackError(f"{path} is a folder, and {label_format} labels are a file")
        label_format = "yolo"
    elif label_format in ("auto", "supervision", "coco") and is_json(path):
        return read_json(path, label_format, role, columns, wanted)
    elif label_format in ("auto", "cvat") and is_cvat(path):
        if columns:
            raise McaptrackError(f"{path}: `columns=` is for tables with a header, not for CVAT")
        return read_cvat(path, role, wanted)
    if label_format == "auto":
        label_format = "csv" if columns else text_format(path)
    if columns and label_format not in ("csv", "supervision"):
        raise McaptrackError(f"{path}: `columns=` is for tables with a header, not for {label_format}")
    if label_format == "cvat":
        raise McaptrackError(f"{path} is neither XML nor a zip file with annotations.xml, as CVAT writes them")
    if label_format == "coco":
        raise McaptrackError(f"{path} is not JSON, as COCO is")
    if label_format == "yolo":
        return read_yolo(path, role, wanted)
    if label_format in ("csv", "supervision"):
        return read_csv(path, role, columns, label_format, wanted)
    return _text_reader(label_format)(path, lines_of(path), role, wanted)


def _text_reader(label_format: Format) -> Callable[[Path, Lines, Role, WantedClasses], Labels]:
    """The function that reads a text in which each line is a box, or a position."""
    return find("label_format", label_format).cls  # type: ignore[no-any-return]


def text_format(path: Path) -> Format:
    """The format of a text by its first row. Raises McaptrackError if it is none of those that are known."""
    number, line = next(lines_of(path, MAX_LINE), (0, ""))
    if not number:
        raise McaptrackError(f"{path} holds no labels")
    header = header_of(path, line)
    if header:
        return "supervision" if set(SUPERVISION) <= set(header) else "csv"
    if _has_other_columns(path, number, line):
        return "csv"
    columns = split(line)
    if "," in line and 6 <= len(columns) <= 10:
        return "mot"
    if len(columns) == 10 and columns[-1].startswith('"'):
        return "sdd"
    if len(columns) in (17, 18) and columns[2][:1].isalpha() and columns[2].replace("_", "").isalnum():
        return "kitti"
    if len(columns) == 4:
        return "trajnet"
    if len(columns) == 8 and "," not in line:
        return "obsmat"
    raise McaptrackError(
        f"{path}:{number}: a row of {len(columns)} columns fits no label format ({', '.join(FORMATS)}): "
        f"{line.strip()[:60]}"
    )


def _has_other_columns(path: Path, number: int, line: str) -> bool:
    """Whether a comment names columns of boxes that are not those of MOTChallenge."""
    names = comment_header(path, line)
    try:
        columns = choose_columns(f"{path}:{number}", names, {}) if names else _MOT_COLUMNS
    except McaptrackError:
        return False
    return any(columns.get(key) != place for key, place in _MOT_COLUMNS.items())


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
#
# Letters: N rows, F frames, C classes.


_Values = TypeVar("_Values", Ints, ClassIds)

#: Files from this size on are read in parts, of about so many rows.
_LONG_BYTES: Final = 20_000_000
_PART_ROWS: Final = 200_000
_FORMATS: Final[tuple[Format, ...]] = ("mot", "trajnet", "obsmat")


@dataclass(kw_only=True)
class LongLabels(Labels):
    """A label file with its rows in a temporary file; ``parts`` reads them. The rows here are none.

    ``stored`` are the places of the columns of each part in ``file``. ``of_frames`` and ``of_classes`` are values,
    sorted, and how many rows have them; ``corner`` is the largest x and y of boxes.
    """

    any_ids: bool
    of_frames: tuple[Ints, Ints]
    of_classes: tuple[ClassIds, Ints]
    corner: Floats
    file: SpillFile
    stored: Sequence[Mapping[str, Stored]]

    @property
    def has_ids(self) -> bool:
        """Whether any row has a track id."""
        return self.any_ids

    def frame_counts(self) -> tuple[Ints, Ints]:
        """The frames with rows (F,), sorted, and the number of rows of each."""
        return self.of_frames

    def class_counts(self) -> tuple[ClassIds, Ints]:
        """The classes of rows (C,), sorted, and the number of rows of each."""
        return self.of_classes

    def corner_px(self) -> Floats:
        """The largest x and y (2,) of boxes."""
        return self.corner

    @property
    def parts(self) -> Sequence[Callable[[], Labels]]:
        """The rows in parts of whole frames, in their order."""
        return [partial(self._part, columns) for columns in self.stored]

    def _part(self, stored: Mapping[str, Stored]) -> Labels:
        columns: dict[str, Any] = {name: getattr(self, name) for name in self.COLUMNS}
        for name, place in stored.items():
            like = columns[name]
            columns[name] = np.frombuffer(self.file.get(place), like.dtype).reshape(-1, *like.shape[1:])
        return in_order(Labels(self.path, self.format, self.at, **columns), self.has_ids)


def _read_in_parts(path: Path, name: Format, role: Role, wanted: WantedClasses) -> LongLabels | None:
    """Read a label file in parts; None if it isn't sorted by frame."""
    lines, file, stored = lines_of(path), SpillFile(), list[Mapping[str, Stored]]()
    frames, classes = list[tuple[Ints, Ints]](), list[tuple[ClassIds, Ints]]()
    corner, has_ids, left_out, first_frame = np.full(2, -np.inf), False, list[str](), 1
    rest: Labels | None = None  # the last frame, which may go on
    while (line := next(lines, None)) is not None:
        read = _text_reader(name)(path, chain([line], islice(lines, _PART_ROWS - 1)), role, wanted)
        if rest is not None and read.frame.min() < rest.frame[0]:
            return None
        frames.append(read.frame_counts())
        classes.append(read.class_counts())
        corner = np.maximum(corner, read.corner_px()) if read.has_boxes else corner
        has_ids, first_frame = has_ids or read.has_ids, min(first_frame, read.first_frame)
        left_out += [read.left_out] if read.left_out else []
        read = in_order(read if rest is None else _joined(rest, read), has_ids=False)
        last = int(np.searchsorted(read.frame, read.frame[-1]))
        if last:
            stored.append(_put(file, read.take(slice(last))))
        rest = read.take(slice(last, None))
    if rest is None:
        return None
    stored.append(_put(file, rest))
    of_frames = _merged(frames)
    about = {"first_frame": first_frame, "left_out": _summed(left_out), "labelled": of_frames[0]}
    out = LongLabels(
        **(vars(rest.take(slice(0))) | about | {"ignored": None}),
        any_ids=has_ids, of_frames=of_frames, of_classes=_merged(classes), corner=corner, file=file, stored=stored,
    )  # fmt: skip
    if has_ids and role != "detections":
        for part in out.parts:
            part().refuse_repeated_ids()
    return out


def _merged(counts: Sequence[tuple[_Values, Ints]]) -> tuple[_Values, Ints]:
    """The values of parts, sorted, and how many rows have each."""
    values, which = np.unique(np.concatenate([part for part, _ in counts]), return_inverse=True)
    return values, np.bincount(which, np.concatenate([count for _, count in counts])).astype(np.int64)


def _joined(first: Labels, second: Labels) -> Labels:
    """The rows of both, one after the other."""
    columns: dict[str, Any] = {}
    for name in Labels.COLUMNS:
        before, other = getattr(first, name), getattr(second, name)
        columns[name] = None if other is None else np.concatenate([before, other])
    return replace(second, **columns)


def _put(file: SpillFile, part: Labels) -> dict[str, Stored]:
    columns = {name: getattr(part, name) for name in Labels.COLUMNS}
    return {name: file.put(values.tobytes()) for name, values in columns.items() if values is not None}


def _summed(texts: Sequence[str]) -> str:
    """Merge texts that differ only in their first number, which is summed; "" if there are none."""
    total = sum(int(number[0]) for text in texts if (number := re.search(r"\d+", text)))
    return re.sub(r"\d+", str(total), texts[0], count=1) if texts else ""


# Recognise label files with 3D boxes, and read them.


_BEGIN_BYTES: Final = 4096


def is_3d(path: Path, label_format: Format = "auto", columns: Mapping[str, str] | None = None) -> bool:
    """Whether a label file holds 3D boxes, by the format that is given, or by its content."""
    if label_format in FORMATS_3D:
        return True
    if label_format not in ("auto", "csv") or not path.exists():
        of_package = format_of_package(label_format)
        return of_package is not None and of_package.in_space
    if path.is_dir():
        return tables_folder(path) is not None or is_argoverse(path)
    if is_argoverse(path):
        return True
    return path.is_file() and not _is_binary(path) and holds_boxes_3d(path, _first_line(path), columns or {})


def _is_binary(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            return b"\0" in stream.read(_BEGIN_BYTES)
    except OSError:
        return True  # the reader of other labels says why


def _first_line(path: Path) -> str:
    try:
        return next(lines_of(path, MAX_LINE), (0, ""))[1]
    except McaptrackError:
        return ""


def read_boxes_3d(
    path: Path,
    role: Role,
    label_format: Format = "auto",
    columns: Mapping[str, str] | None = None,
    scene: str | None = None,
) -> BoxRows3D:
    """Read a label file with 3D boxes.

    Parameters
    ----------
    path : Path
        A text file, a table in Feather format, or the folder of a data set.
    role : str
        "detections", "tracks" or "truth" (ground truth).
    label_format : str
        "auto" detects it from the content.
    columns : dict, optional
        Names of the columns of a table with a header, by what they hold.
    scene : str, optional
        Name of the scene, in nuScenes.

    Returns
    -------
    BoxRows3D

    Raises
    ------
    McaptrackError
        With the place in the file, if it doesn't have this format, or if it can't be boxes in metres with z up.
    """
    refuse_special(path)
    of_package = format_of_package(label_format)
    if label_format == "auto" and path.is_dir():
        label_format = "argoverse" if is_argoverse(path) else "nuscenes"
    elif label_format == "auto":
        label_format = "argoverse" if is_argoverse(path) else "csv"
    if columns and label_format != "csv":
        raise McaptrackError(f"{path}: `columns=` is for tables with a header, not for {label_format}")
    if scene is not None and label_format != "nuscenes":
        raise McaptrackError(f"{path}: `scene=` is for nuScenes, not for {label_format}")
    if path.is_dir() and label_format in ("csv", "kitti-3d"):
        raise McaptrackError(f"{path} is a folder, and {label_format} labels are a file")
    if of_package is not None:
        return of_package.rows_3d(path, role)
    if label_format == "nuscenes":
        rows = read_nuscenes(path, scene)
    elif label_format == "argoverse":
        rows = read_argoverse(path)
    else:
        rows = read_kitti_3d(path) if label_format == "kitti-3d" else read_table_3d(path, columns or {})
    rows.check(role)
    return rows
