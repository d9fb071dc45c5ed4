"""Stanford Drone: ``id xmin ymin xmax ymax frame lost occluded generated "label"``, blank separated, frames from 0."""

from __future__ import annotations

from fractions import Fraction
from typing import Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.schema.classes import PERSON
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import ClassNames, as_boxes, check_columns, read_numbers

_COLUMNS: Final = 'id xmin ymin xmax ymax frame lost occluded generated "label"'
_CLASSES: Final = {"pedestrian": PERSON, "biker": 2, "skater": 3, "cart": 4, "car": 5, "bus": 6}
_FPS: Final = Fraction(30)


class Sdd(Format):
    """Annotations of the Stanford Drone Dataset."""

    title = "Stanford Drone"
    row = f"`{_COLUMNS}`"

    def recognises(self, file: LabelFile) -> bool:
        """Whether the first row has 10 columns, the last one in quotes."""
        return len(file.cells) == 10 and file.cells[-1].startswith('"')

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The rows of a file; those of boxes that are out of sight are left out."""
        names = ClassNames()

        def parse(parts: list[str]) -> list[float]:
            check_columns(parts, 10, 10)
            return [*map(float, parts[:9]), names.number(parts[9].strip('"'))]

        values, at = read_numbers(
            file.path,
            file.lines(),
            f"Stanford Drone annotations ({_COLUMNS}; VATIC writes attributes behind, which are not read)",
            10,
            parse,
        )
        facts = LabelFacts(file.path, first_frame=0, names=names.names, numbering=_CLASSES, named_by="file")
        facts.fps, facts.clock_of, facts.labelled = _FPS, self.title, np.unique(values[:, 5])
        table = BoxTable(
            facts=facts, at=at, frame=values[:, 5], id=values[:, 0], boxes_px=as_boxes(values[:, 1:5]),
            score=np.full(len(values), np.nan), class_id=values[:, 9],
        )  # fmt: skip
        lost = values[:, 6] != 0
        if lost.any():
            table.left_out = f"{int(lost.sum())} boxes out of sight (lost)"
        if len(lost) and lost.all():
            raise McaptrackError(f"{file.path} holds no boxes in sight, only {table.left_out}")
        return table.take(~lost)
