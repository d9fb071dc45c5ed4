"""Read label files, with detection of their format, and homographies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final, get_args

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special
from mcaptrack.sources.ingest.labels.columns import choose_columns
from mcaptrack.sources.ingest.labels.content import FORMATS_3D, ONLY_PEOPLE, Format, Labels, WantedClasses
from mcaptrack.sources.ingest.labels.cvat import is_cvat, read_cvat
from mcaptrack.sources.ingest.labels.delimited import MAX_LINE, SUPERVISION, comment_header, header_of, read_csv
from mcaptrack.sources.ingest.labels.formats import READERS
from mcaptrack.sources.ingest.labels.json_boxes import is_json, read_json
from mcaptrack.sources.ingest.labels.number_table import lines_of, split
from mcaptrack.sources.ingest.labels.yolo import read_yolo

_MOT_COLUMNS: Final = {"frame": 0, "id": 1, "x": 2, "y": 3, "w": 4, "h": 5}
FORMATS: Final = tuple(name for name in get_args(Format) if name not in ("auto", *FORMATS_3D))


def read_labels(
    path: Path,
    label_format: Format = "auto",
    role: Role = "tracks",
    first_frame: int | None = None,
    columns: Mapping[str, str] | None = None,
    wanted: WantedClasses = ONLY_PEOPLE,
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

    Returns
    -------
    Labels
        Sorted by frame and id.

    Raises
    ------
    McaptrackError
        With the line, if the file doesn't have this format, or none of the known ones.
    """
    labels = _read(path, label_format, role, columns or {}, wanted)
    if labels.has_ids and role != "detections":
        refuse_repeated_ids(path, labels)
    return replace(
        in_order(labels, labels.has_ids),
        first_frame=labels.first_frame if first_frame is None else first_frame,
        doubts=tuple(doubt for doubt in labels.doubts if first_frame is None or doubt[1] != "clock"),
    )


def in_order(labels: Labels, has_ids: bool) -> Labels:
    """The rows sorted by frame, and by id if there are any; otherwise each frame as the file has it."""
    if has_ids:
        return labels.take(np.lexsort((labels.id, labels.frame)))
    return labels.take(np.argsort(labels.frame, kind="stable"))


def _read(path: Path, label_format: Format, role: Role, columns: Mapping[str, str], wanted: WantedClasses) -> Labels:
    refuse_special(path)
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
    return READERS[label_format](path, lines_of(path), role, wanted)


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


def refuse_repeated_ids(path: Path, labels: Labels) -> None:
    """Raise McaptrackError if an id appears twice in a frame."""
    order = np.lexsort((labels.id, labels.frame))
    frame, track_id = labels.frame[order], labels.id[order]
    repeats = np.flatnonzero((frame[1:] == frame[:-1]) & (track_id[1:] == track_id[:-1]))
    if len(repeats):
        at = repeats[0]
        raise McaptrackError(f"{path}: id {track_id[at]} appears twice in frame {frame[at]}")


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
