"""Folders of YOLO labels: one text file for each picture, with boxes in shares of its size; and JSON that darknet, its
first program, writes (`detector test ... -out`).

A row is: class, centre x, centre y, width, height[, confidence][, track id].

Letters: N rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange.gathered import frame_numbers
from mcaptrack.extensions.exchange.pictures import LabelledPicture, LabelledShape, PictureFormat, files_in
from mcaptrack.geometry.arrays import Floats
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import NO_ID, Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import LISTS, MAX_ROWS, lines_of, name_classes, read_numbers, states_number

_READMES: Final = ("readme.txt", "readme.roboflow.txt", "readme.dataset.txt")
_NOT_LABELS: Final = (*LISTS, *_READMES, "train.txt", "val.txt", "test.txt")
#: So many files of a folder tell whether it is of this kind.
_LOOKED_AT: Final = 100
_ROW: Final = "YOLO (class x y width height [confidence] [id])"


def _label_files(folder: Path) -> list[Path]:
    """The label files of a folder, or of its subfolder "labels", in natural order; none if there are none."""
    for place in (folder, folder / "labels"):
        files = files_in(place, ".txt") if place.is_dir() else []
        if files := [path for path in files if path.name.lower() not in _NOT_LABELS]:
            return files
    return []


class Yolo(Format):
    """Folders of text files."""

    title = "YOLO"
    row = "a folder of text files, one for each picture: `class x y width height [confidence] [id]`"
    rank = 2
    reads_folders, reads_files = True, False

    def recognises(self, file: LabelFile) -> bool:
        """Whether a folder holds label files that begin with numbers, or are all empty."""
        files = _label_files(file.path)[:_LOOKED_AT] if file.is_folder else []
        rows = [LabelFile(path).cells for path in files]
        return bool(rows) and all(map(states_number, next(filter(None, rows), [])))

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of all files. The numbers in the names of files are those of frames."""
        folder, files = file.path, _label_files(file.path)
        if not files:
            raise McaptrackError(f"{folder} holds no label files (*.txt)")
        numbers, by = frame_numbers([path.name for path in files])
        remarks = [f"{folder}: {len(files)} files, frames are numbered by their {by}"]
        parts = [read_numbers(path, lines_of(path), _ROW, 7, _parse, str.split) for path in files]
        counts = [len(part.values) for part in parts]
        ends = np.cumsum(counts)
        if ends[-1] > MAX_ROWS:
            raise McaptrackError(f"{folder} has more than {MAX_ROWS} rows; give it in parts")
        rows, frame = np.concatenate([part.values for part in parts]), np.repeat(numbers, counts)

        def at(row: int) -> str:
            part = int(np.searchsorted(ends, row, "right"))
            return parts[part].at(row - int(ends[part]) + counts[part])

        score, track_id = _score_and_id(frame, rows, asked.role)
        if np.isfinite(rows[:, 5]).any() and not np.isfinite(rows[:, 6]).any():
            remarks.append(f"{folder}: column 6 holds {'confidences' if np.isfinite(score).any() else 'track ids'}")
        facts = LabelFacts(folder, is_normalised=True, first_class=0, labelled=np.array(sorted(numbers), np.int64))
        facts.is_in_order = by == "order"
        facts.states_labelled = 0 in counts  # others write no files without boxes
        table = BoxTable(
            facts=facts, at=at, frame=frame, id=track_id, score=score, class_id=rows[:, 0], remarks=remarks,
            boxes_px=np.concatenate([rows[:, 1:3] - rows[:, 3:5] / 2, rows[:, 3:5]], axis=1),
        )  # fmt: skip
        name_classes(table, [files[0].parent, folder, folder.parent, folder.parent.parent], first=0)
        return table


def _parse(parts: list[str]) -> list[float]:
    if not 5 <= len(parts) <= 7:
        is_named = parts[0][:1].isalpha()
        kitti = (
            ", as a file of KITTI for each picture has; those of a sequence are read, with frame and id before the type"
        )
        more = (kitti if is_named else ", as outlines have, which are not read") if len(parts) > 7 else ""
        raise ValueError(f"{len(parts)} columns{more}")
    return [*map(float, parts), *[np.nan] * (7 - len(parts))]


def _score_and_id(frame: Floats, rows: Floats, role: Role | None) -> tuple[Floats, Floats]:
    """Scores and ids (N,). A sixth column alone holds ids if all of it are whole numbers that fit."""
    sixth, seventh = rows[:, 5], rows[:, 6]
    if not np.isfinite(seventh).any() and np.isfinite(sixth).all() and len(rows) and (sixth == np.rint(sixth)).all():
        pairs = np.unique(np.stack([frame, sixth]), axis=1)
        is_unique = pairs.shape[1] == len(rows)
        if (sixth > 1).any() or (role != "detections" and is_unique):
            return np.full(len(rows), np.nan), sixth
    return sixth, np.nan_to_num(seventh, nan=NO_ID)


class Darknet(PictureFormat):
    """Detections with scores."""

    title, is_normalised = "JSON of darknet", True
    row = "a list of pictures: `frame_id`, `filename` and `objects` with `relative_coordinates`"

    def recognises(self, file: LabelFile) -> bool:
        """Whether JSON is a list of pictures with objects."""
        return {"frame_id", "objects"} <= set(file.keys) and isinstance(file.json, list)

    def pictures(self, file: LabelFile) -> Iterator[LabelledPicture]:
        """The pictures of a file."""
        for entry in file.json:
            picture = LabelledPicture(str(entry.get("filename") or entry["frame_id"]), [])
            for each in entry["objects"]:
                place = each["relative_coordinates"]
                x, y, width, height = (float(place[key]) for key in ("center_x", "center_y", "width", "height"))
                box, label = (x - width / 2, y - height / 2, width, height), each.get("name") or each["class_id"]
                picture.shapes.append(LabelledShape(box, label, each["confidence"]))
            yield picture
