"""KITTI tracking: ``frame id type truncated occluded alpha left top right bottom height width length x y z rotation``,
and a score in column 18, if any; blank separated, frames from 0.

Letters: N rows.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange.pictures import LabelledPicture, LabelledShape, PictureFormat, files_in
from mcaptrack.schema.classes import PERSON, is_person
from mcaptrack.sources.box_files import BoxFile, ExportedBoxes, joined_lines, merged_classes, score_text, unscored
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import FORGIVEN, NOTHING, REGION, Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import (
    ClassNames,
    Numbers,
    as_boxes,
    check_columns,
    lines_of,
    read_numbers,
    states_number,
)

_COLUMNS: Final = (
    "frame id type truncated occluded alpha left top right bottom height width length x y z rotation score"
)
#: People that are occluded more than this, or truncated, are not scored; boxes up to this height are not counted as
#: false positives.
_OCCLUDED: Final = 2
_HEIGHT_PX: Final = 25.0
#: Class ids of the class names. Person in the tracking labels is Person_sitting in the detection labels.
_NAMES: Final = ("pedestrian", "cyclist", "car", "van", "truck", "tram", "person_sitting", "misc")
_CLASSES: Final = {name: number for number, name in enumerate(_NAMES, start=PERSON)} | {"person": 7}
_SITTING: Final = ("person_sitting", "person")
_REGION: Final = "dontcare"
#: The frame of reference of boxes in space: of the camera, with z up.
_FRAME_ID: Final = "camera_link"
#: So many files of a folder tell whether it is of this kind.
_LOOKED_AT: Final = 100


def _rows(file: LabelFile) -> tuple[Numbers, dict[int, str]]:
    """Rows with the type as the number of a name, and the names in lower case."""
    names = ClassNames()

    def parse(parts: list[str]) -> list[float]:
        check_columns(parts, 17, 18)
        numbers = [float(part) if place != 2 else names.number(part) for place, part in enumerate(parts)]
        return numbers + [np.nan] * (18 - len(parts))

    return read_numbers(file.path, file.lines(), f"KITTI tracking ({_COLUMNS})", 18, parse), names.names


def _named(
    kind: np.typing.NDArray[np.int64], names: dict[int, str], wanted: tuple[str, ...]
) -> np.typing.NDArray[np.bool_]:
    return np.isin(kind, [number for number, name in names.items() if name.lower() in wanted])


class Kitti(Format):
    """Boxes in pictures."""

    title = "KITTI tracking"
    row = "`frame id type truncated occluded alpha left top right bottom ...`"

    def recognises(self, file: LabelFile) -> bool:
        """Whether the first row has 17 or 18 columns, and a word in the third."""
        cells = file.cells
        return (
            len(cells) in (17, 18)
            and states_number(cells[0])
            and cells[2][:1].isalpha()
            and cells[2].replace("_", "").isalnum()
        )

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a file."""
        (values, at), names = _rows(file)
        kind = values[:, 2].astype(np.int64)
        aside = np.where(_named(kind, names, (_REGION,)), REGION, NOTHING)
        aside[_named(kind, names, _SITTING)] = FORGIVEN
        facts = LabelFacts(file.path, first_frame=0, names=names, numbering=_CLASSES, named_by="file")
        facts.not_counting, facts.region, facts.least_height_px = "hidden or cut off", "DontCare", _HEIGHT_PX
        return BoxTable(
            facts=facts, at=at, frame=values[:, 0], id=values[:, 1], boxes_px=as_boxes(values[:, 6:10]),
            score=values[:, 17], class_id=kind, counts=(values[:, 3] <= 0) & (values[:, 4] <= _OCCLUDED), aside=aside,
        )  # fmt: skip


class Kitti3d(Format):
    """Boxes in space, of which files look the same.

    In the file, x is right, y down and z forward, the position is the centre of the box's bottom, and the rotation
    about y is 0 for an object that faces right. Here x is forward, y left and z up.
    """

    title = "KITTI tracking, boxes in space"
    row = Kitti.row
    in_space = True

    def recognises(self, file: LabelFile) -> bool:
        """No file: those with boxes in pictures look the same."""
        return False

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a file of one sequence."""
        (values, at), names = _rows(file)
        kind = values[:, 2].astype(np.int64)
        is_region = _named(kind, names, (_REGION,))
        has_no_box = ~is_region & (values[:, 10:13] <= 0).any(axis=1)  # results of detectors in pictures
        if (is_region | has_no_box).all():
            raise McaptrackError(f"{file.path} holds no 3D boxes")
        height, width, length, x, y, z, rotation = values[:, 10:17].T
        left = [f"{int(is_region.sum())} regions (DontCare)"] if is_region.any() else []
        left += [f"{int(has_no_box.sum())} rows without a 3D box"] if has_no_box.any() else []
        facts = LabelFacts(file.path, first_frame=0, names=names, numbering={}, named_by="file")
        facts.frame_id, facts.labelled = _FRAME_ID, np.unique(values[:, 0])
        table = BoxTable(
            facts=facts, at=at, frame=values[:, 0], id=values[:, 1], score=values[:, 17], class_id=kind,
            boxes_m=np.stack([z, -x, -y + height / 2, length, width, height, -rotation - np.pi / 2], axis=-1),
            left_out=" and ".join(left),
        )  # fmt: skip
        axes = "x is forward, y left, z up (in the file x is right, y down, z forward); positions are centres of boxes"
        table.remark(f": {axes}")
        return table.take(~(is_region | has_no_box))


class KittiFrames(PictureFormat):
    """Folders of KITTI's detection labels, a file for each picture, as DeepStream writes them, too."""

    title = "KITTI detection"
    row = "a folder of text files, one for each picture: `type [id] truncated occluded alpha left top right bottom ...`"
    rank = 1
    reads_folders, reads_files = True, False

    def recognises(self, file: LabelFile) -> bool:
        """Whether the first file of a folder that has rows begins so."""
        texts = (LabelFile(path).row.split() for path in file.entries[:_LOOKED_AT] if path.suffix.lower() == ".txt")
        cells = next(filter(None, texts), [])
        return len(cells) in (15, 16, 17) and cells[0][:1].isalpha()

    def pictures(self, file: LabelFile) -> Iterator[LabelledPicture]:
        """The pictures of a folder."""
        for path in files_in(file.path, ".txt"):
            picture, self.where = LabelledPicture(path.name, []), path.name
            for number, line in lines_of(path):
                self.where, cells = f"{path.name}:{number}", line.split()
                check_columns(cells, 15, 17)
                track = cells.pop(1) if len(cells) == 17 else None
                (box,) = as_boxes(np.array([cells[4:8]], float)).tolist()
                picture.shapes.append(LabelledShape(box, cells[0], cells[15] if len(cells) == 16 else None, track))
            yield picture


# Boxes of a channel.


#: What KITTI's tools write for numbers that are not known: size and position of a 3D box, rotation.
_UNKNOWN: Final = "-1 -1 -1 -1000 -1000 -1000 -10"


class KittiFile(BoxFile):
    """KITTI tracking: frame, id, type, truncated, occluded, and the box by its corners; the score as column 18."""

    title, end, holds = "KITTI", ".kitti.txt", frozenset({"scores"})

    def content(self, boxes: ExportedBoxes) -> Iterator[bytes]:
        """Yield the lines."""
        names = {kind: kitti_name(name) for kind, name in boxes.classes.items()}
        has_scores = bool(np.isfinite(boxes.score).any())

        def line(frame: int, track: int, name: str, box: list[float], score: np.float32) -> str:
            x, y, w, h = box
            corners, own = f"{x!r} {y!r} {x + w!r} {y + h!r}", f" {score_text(score) or 1}" if has_scores else ""
            return f"{frame} {track} {name} 0 0 -10 {corners} {_UNKNOWN}{own}\n"

        columns = (boxes.frame.tolist(), boxes.id.tolist(), boxes.class_id.tolist(), boxes.boxes.tolist(), boxes.score)
        yield from joined_lines(
            line(frame, track, names[kind], box, score) for frame, track, kind, box, score in zip(*columns, strict=True)
        )

    def remarks(self, boxes: ExportedBoxes) -> Iterable[str]:
        """Say which boxes have no score, and which classes one name."""
        names = {kind: kitti_name(name) for kind, name in boxes.classes.items()}
        return unscored(boxes), merged_classes(boxes.classes, names)


def kitti_name(name: str) -> str:
    """The name of a class in KITTI: people are pedestrians, and names are single words."""
    word = re.sub(r"[\W_]+", "_", name).strip("_")
    return _NAMES[0].capitalize() if is_person(name) else word if word[:1].isalpha() else f"class_{word}"
