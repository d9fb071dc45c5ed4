"""Read folders of YOLO labels: one text file for each picture, with boxes in shares of its size.

A row is: class, centre x, centre y, width, height[, confidence][, track id].

Letters: N rows.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Floats
from mcaptrack.notices import Code
from mcaptrack.sources.ingest.bags import plain_yaml
from mcaptrack.sources.ingest.labels.content import (
    NO_ID,
    UNKNOWN_FIRST,
    Labels,
    NumberTable,
    WantedClasses,
    lines_of,
    numbers_of_names,
)
from mcaptrack.sources.video.image_folder import IMAGE_SUFFIXES, natural_order

_NAMES: Final = ("classes.txt", "obj.names", "_classes.txt", "labels.txt")
_DATA: Final = ("data.yaml", "data.yml", "dataset.yaml")
_READMES: Final = ("readme.txt", "readme.roboflow.txt", "readme.dataset.txt")
_NOT_LABELS: Final = (*_NAMES, *_READMES, "train.txt", "val.txt", "test.txt")
_MAX_FILES: Final = 1_000_000
_MAX_ROWS: Final = 10_000_000
_MAX_CLASSES: Final = 65536
_MAX_NAME: Final = 256
#: Shares of the picture can't be larger; boxes that are cut off reach a little beyond.
_MOST: Final = 2.0


def label_files(folder: Path) -> list[Path]:
    """The label files of a folder, or of its subfolder "labels", in natural order; none if there are none."""
    for place in (folder, folder / "labels"):
        try:
            files = [path for path in place.iterdir() if path.suffix.lower() == ".txt"]
        except OSError:
            continue
        files = [path for path in files if path.name.lower() not in _NOT_LABELS]
        if files:
            return sorted(files, key=natural_order)
    return []


def is_label_folder(folder: Path) -> bool:
    """Whether a folder holds label files and no pictures."""
    if not folder.is_dir() or any(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.iterdir()):
        return False
    return bool(label_files(folder))


def read_yolo(folder: Path, role: Role, wanted: WantedClasses) -> Labels:
    """Read a folder of YOLO labels. The numbers in the names of files are those of frames."""
    if not folder.is_dir():
        raise McaptrackError(f"{folder} is not a folder; labels of YOLO are a folder with a text file for each picture")
    files = label_files(folder)
    if not files:
        raise McaptrackError(f"{folder} holds no label files (*.txt)")
    if len(files) > _MAX_FILES:
        raise McaptrackError(f"{folder} holds {len(files)} label files; at most {_MAX_FILES} are read")
    numbers = numbers_of_names([path.name for path in files])
    remarks = [f"{folder}: {len(files)} files, frames are numbered by " + ("their names" if numbers else "their order")]
    numbers = numbers or list(range(len(files)))
    values, where = [np.empty((0, 8))], []
    for frame, path in zip(numbers, files, strict=True):
        table = NumberTable(
            path, lines_of(path), "YOLO (class x y width height [confidence] [id])", 7, _parse, str.split
        )
        values.append(np.column_stack([np.full(len(table.values), float(frame)), table.values]))
        where += [(path, int(line)) for line in table.line]
        if len(where) > _MAX_ROWS:
            raise McaptrackError(f"{folder} has more than {_MAX_ROWS} rows; give it in parts")
    rows = np.concatenate(values)

    def at(row: int) -> str:
        path, line = where[row]
        return f"{path}:{line}"

    score, track_id = _score_and_id(rows, role)
    if np.isfinite(rows[:, 6]).any() and not np.isfinite(rows[:, 7]).any():
        remarks.append(f"{folder}: column 6 holds {'confidences' if np.isfinite(score).any() else 'track ids'}")
    centre, size = rows[:, 2:4], rows[:, 4:6]
    boxes = np.concatenate([centre - size / 2, size], axis=1)
    out = Labels(folder, "yolo", at, rows[:, 0], track_id, boxes, score, rows[:, 1], remarks=remarks)
    out.labelled, out.is_normalised, out.first_frame = np.array(sorted(numbers), np.int64), True, UNKNOWN_FIRST
    out.states_labelled = any(len(part) == 0 for part in values[1:])  # others are not written
    names, named_by = _class_names(folder, files[0].parent, out.doubts)
    if named_by is not None:
        out.remark(f": class names by {named_by}")
    largest = np.abs(rows[:, 2:6]).max(axis=1, initial=0)
    out.refuse(
        largest > _MOST, lambda row: f"{largest[row]:g} is no share of the picture's size, as boxes of YOLO are in"
    )
    return out.settled(role, wanted, names)


def _parse(parts: list[str]) -> list[float]:
    if not 5 <= len(parts) <= 7:
        raise ValueError(f"{len(parts)} columns{', as outlines have, which are not read' if len(parts) > 7 else ''}")
    return [*map(float, parts), *[np.nan] * (7 - len(parts))]


def _score_and_id(rows: Floats, role: Role) -> tuple[Floats, Floats]:
    """Scores and ids (N,). A sixth column alone holds ids if all of it are whole numbers that fit."""
    sixth, seventh = rows[:, 6], rows[:, 7]
    if not np.isfinite(seventh).any() and np.isfinite(sixth).all() and len(rows) and (sixth == np.rint(sixth)).all():
        pairs = np.unique(np.stack([rows[:, 0], sixth]), axis=1)
        is_unique = pairs.shape[1] == len(rows)
        if (sixth > 1).any() or (role != "detections" and is_unique):
            return np.full(len(rows), np.nan), sixth
    return sixth, np.nan_to_num(seventh, nan=NO_ID)


def _class_names(
    folder: Path, labels: Path, doubts: list[tuple[str, Code]]
) -> tuple[dict[int, str] | None, Path | None]:
    """Class names by number, and the file that they are from: beside the labels or up to two folders above.

    Files that can't be read are added to ``doubts``.
    """
    for place in dict.fromkeys((labels, folder, folder.parent, folder.parent.parent)):
        for name in _NAMES:
            if (place / name).is_file():
                lines = [" ".join(line.split())[:_MAX_NAME] for _, line in lines_of(place / name)]
                return dict(enumerate(lines[:_MAX_CLASSES])), place / name
        for name in _DATA:
            try:
                names = _names_of_yaml(place / name) if (place / name).is_file() else None
            except McaptrackError as error:
                doubts.append((f"{error}; class names are not known", "classes"))
                continue
            if names:
                return names, place / name
    return None, None


def _names_of_yaml(path: Path) -> dict[int, str] | None:
    """The field "names" of a data.yaml: a list, or a map from numbers to names."""
    with path.open("rb") as stream:
        data = stream.read(plain_yaml.MAX_BYTES + 1)
    try:
        content: Any = plain_yaml.load(data)
    except plain_yaml.UnsupportedYamlError as error:
        raise McaptrackError(f"{path} is not valid YAML ({str(error)[:200]})") from None
    names = content.get("names") if isinstance(content, dict) else None
    if isinstance(names, list):
        names = {str(number): name for number, name in enumerate(names)}
    if not isinstance(names, dict) or not names:
        return None
    if not all(
        isinstance(name, str) and key.isascii() and key.isdigit() and len(key) < 10 for key, name in names.items()
    ):
        raise McaptrackError(f"{path}: `names` is neither a list of names nor a map from numbers to names")
    return {int(key): " ".join(str(name).split())[:_MAX_NAME] for key, name in names.items()}
